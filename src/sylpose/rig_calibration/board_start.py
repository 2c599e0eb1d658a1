"""Starts of the bundle adjustment: lens of one camera from a board's views, and poses of cameras that see it together.

Sources: Z. Zhang, "A flexible new technique for camera calibration", 2000 (focal length and poses from homographies); D.
Oberkampf, D. DeMenthon, L. Davis, "Iterative pose estimation using coplanar feature points", 1996 (a plane's second
pose, tilted the other way).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.special import ndtri

from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.rig_calibration.board_bundle import (
    MAX_DAMPING,
    MAX_ITERATIONS,
    MAX_RESIDUAL_PX,
    MIN_DAMPING,
    N_CAMERA,
    N_LENS,
    START_QUANTILE,
    Freedom,
    Optimum,
    Unknowns,
    Views,
    compute_loss,
    compute_residuals,
    compute_weights,
    invert_blocks,
    linearize,
    optimize,
    project,
)

# Focal lengths that are tried besides that of the homographies, in image widths (choice: views of 80 and 24 degrees).
FOCAL_STARTS = (0.6, 2.4)
# Noise of a coordinate from the start's quantile of lengths of two (derived: Rayleigh).
RAYLEIGH_START = float(np.sqrt(-2.0 * np.log(1.0 - START_QUANTILE)))
# Rounds of noise and pose of a view, and the relative change of its cost at convergence (choice).
POSE_ROUNDS, POSE_TOLERANCE = 3, 1e-4
# Distortion coefficients, as numbers of the lens: k1, k2, p1, p2, k3 (choice: OpenCV's default), and with k4 to k6, for wide
# lenses that need them.
DISTORTION, WIDE_DISTORTION = (4, 5, 6, 7, 8), (4, 5, 6, 7, 8, 9, 10, 11)
# What is known of lenses before any view: the standard deviation of the displacement by each coefficient at the image's
# corners, relative to the distance from the center, radial and tangential (choice: beyond those of lenses that the
# model fits, so that it matters only where the views determine nothing). The coefficients of wide lenses are those of a
# ratio, whose terms may be large and cancel.
RADIAL_PRIOR_SD, TANGENTIAL_PRIOR_SD, WIDE_PRIOR_SD = 0.3, 0.03, 10.0
# Focal lengths before any view, mean and standard deviation in image widths (choice: a fifth to three times, so that
# frontal views, which do not determine it, do not drive it to 0).
FOCAL_PRIOR, FOCAL_PRIOR_SD = 1.2, 1.0
# Standard errors of a significant gain (derived: normal, probability of 0.001).
SIGNIFICANT = float(ndtri(1.0 - 1e-3))
# Focal lengths and principal point.
PINHOLE = (0, 1, 2, 3)
# Fewest views of each half with which lens models are compared (choice).
MIN_HALF = 4
# Frames whose poses are candidates for that of a pair of cameras, and that vote for them (choice).
MAX_CANDIDATE_FRAMES, MAX_VOTING_FRAMES = 12, 40


def fit_homography(points: FloatArray, pixels: FloatArray) -> FloatArray:
    """Return H (3, 3), pixels ~ H (x, y, 1), by the normalized direct linear transform; 4 points (n, 2) at least."""
    normalizers = []
    for values in (points, pixels):
        mean = values.mean(axis=0)
        scale = np.sqrt(2.0) / max(float(np.sqrt(((values - mean) ** 2).sum(axis=1).mean())), 1e-12)
        normalizers.append(np.array([[scale, 0, -scale * mean[0]], [0, scale, -scale * mean[1]], [0, 0, 1]]))
    a, b = normalizers
    x = np.column_stack([points, np.ones(len(points))]) @ a.T
    u = np.column_stack([pixels, np.ones(len(pixels))]) @ b.T
    zero = np.zeros_like(x)
    rows = np.concatenate([np.hstack([x, zero, -u[:, :1] * x]), np.hstack([zero, x, -u[:, 1:2] * x])])
    matrix = np.linalg.svd(rows)[2][-1].reshape(3, 3)
    return np.asarray(np.linalg.inv(b) @ matrix @ a)


def solve_focal(homographies: FloatArray, center: FloatArray) -> float | None:
    """Solve for the focal length of views (V, 3, 3), pixels, with a known principal point; None for frontal views."""
    shifted = homographies.copy()
    shifted[:, :2] -= center[:, None] * homographies[:, 2:]
    shifted /= np.linalg.norm(shifted[:, :, :2], axis=(1, 2))[:, None, None]
    first, second = shifted[:, :, 0], shifted[:, :, 1]
    # The images of the board's axes are orthogonal, and of equal length: a / f² + b = 0.
    a = np.concatenate([(first * second)[:, :2].sum(axis=1), (first**2 - second**2)[:, :2].sum(axis=1)])
    b = np.concatenate([(first * second)[:, 2], (first**2 - second**2)[:, 2]])
    square = -float(a @ a) / float(a @ b) if a @ b < 0 else 0.0
    return float(np.sqrt(square)) if square > 0 else None


def solve_pose(homography: FloatArray, focal: float, center: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return rotation (3, 3) and translation (3,) of camera_from_board, with the board in front of the camera."""
    matrix = np.array([[focal, 0, center[0]], [0, focal, center[1]], [0, 0, 1]])
    columns = np.linalg.solve(matrix, homography)
    columns = columns / np.linalg.norm(columns[:, :2], axis=0).mean()
    columns = columns if columns[2, 2] > 0 else -columns
    u, _, vt = np.linalg.svd(np.column_stack([columns[:, :2], np.cross(columns[:, 0], columns[:, 1])]))
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt, columns[:, 2]


def flip_poses(points: FloatArray, rotation: FloatArray, translation: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the poses (V, 3, 3), (V, 3) of a plane tilted the other way about its center, which look alike from afar."""
    middle = points.mean(axis=0)
    center = rotation @ middle + translation
    sight = center / np.linalg.norm(center, axis=1, keepdims=True)
    normal = rotation[:, :, 2]
    # A rotation by twice the angle between normal and line of sight, in their plane.
    cosine = (normal * sight).sum(axis=1, keepdims=True)
    axis = np.cross(normal, np.sign(cosine) * sight)
    length = np.linalg.norm(axis, axis=1, keepdims=True)
    angle = 2.0 * np.arctan2(length, np.abs(cosine))
    flipped = Rotation.from_rotvec(axis * angle / np.maximum(length, 1e-12)).as_matrix() @ rotation
    return flipped, center - flipped @ middle


def refine_poses(views: Views, at: Unknowns, sigma: FloatArray) -> tuple[Unknowns, FloatArray]:
    """Refine the board pose of each view on its own, with the cameras held.

    Args:
        views: V views of V frames, in their order.
        at: the start.
        sigma: (C,) noise, pixels.

    Returns:
        the unknowns, and the robust cost (V,) of each view.
    """
    known, lengths = sigma[views.camera], np.where(views.seen, 0.0, np.nan)
    for _ in range(POSE_ROUNDS):
        # Noise of its own while a view is not yet right: with the lens' noise, all of its corners would be outliers.
        lengths[views.seen] = np.linalg.norm(compute_residuals(views, at), axis=2)[views.seen]
        own = np.nanquantile(np.minimum(lengths, MAX_RESIDUAL_PX), START_QUANTILE, axis=1) / RAYLEIGH_START
        at = _minimize_poses(views, at, np.maximum(known, own))
    return at, compute_loss(views, compute_residuals(views, at), known).sum(axis=1)


def _minimize_poses(views: Views, at: Unknowns, noise: FloatArray) -> Unknowns:
    """Minimize the robust cost of each view with a constant noise (V,)."""
    n, still = len(views.frame), np.zeros((len(at.lens), N_CAMERA))
    cost, damping = compute_loss(views, compute_residuals(views, at), noise).sum(axis=1), np.full(n, 1e-3)
    is_done = np.zeros(n, bool)
    for _ in range(MAX_ITERATIONS):
        lin = linearize(views, at, with_cameras=False)
        weights = compute_weights(views, lin.residuals, noise) / noise[:, None] ** 2
        weighted = np.repeat(weights, 2, axis=1)[..., None] * lin.board_jacobian
        information = weighted.transpose(0, 2, 1) @ lin.board_jacobian
        gradient = weighted.transpose(0, 2, 1) @ lin.residuals.reshape(n, -1, 1)
        diagonal = damping[:, None, None] * np.einsum("vii->vi", information)[..., None] * np.eye(6)
        moved = at.move(still, (invert_blocks(information + diagonal) @ gradient)[..., 0])
        moved_cost = compute_loss(views, compute_residuals(views, moved), noise).sum(axis=1)
        is_better = moved_cost <= cost
        at = replace(
            at,
            board_rotation=np.where(is_better[:, None, None], moved.board_rotation, at.board_rotation),
            board_translation=np.where(is_better[:, None], moved.board_translation, at.board_translation),
        )
        is_done |= (is_better & (cost - moved_cost <= POSE_TOLERANCE * cost)) | (damping >= MAX_DAMPING)
        cost = np.where(is_better, moved_cost, cost)
        damping = np.clip(np.where(is_better, damping / 10.0, damping * 10.0), MIN_DAMPING, MAX_DAMPING)
        if is_done.all():
            break
    return at


def make_freedom(size: tuple[int, int], focal: float, numbers: Sequence[int]) -> Freedom:
    """Return the freedom of one camera whose lens values with these numbers are estimated, with their priors.

    Args:
        size: (width, height) of its images, pixels.
        focal: about its focal length, pixels.
        numbers: of the lens.
    """
    corner, prior, mean = float(np.hypot(*size)) / 2 / focal, np.zeros(N_LENS), np.zeros(N_LENS)
    mean[:2], prior[:2] = FOCAL_PRIOR * size[0], (FOCAL_PRIOR_SD * size[0]) ** -2.0
    sd = WIDE_PRIOR_SD if 9 in numbers else RADIAL_PRIOR_SD
    prior[[4, 5, 8, 9, 10, 11]] = (corner ** np.array([2, 4, 6, 2, 4, 6]) / sd) ** 2
    # Three times the coefficient times the radius, in the direction of the largest displacement.
    prior[[6, 7]] = (3.0 * corner / TANGENTIAL_PRIOR_SD) ** 2
    free = np.zeros((1, N_CAMERA), bool)
    free[:, [*numbers]] = True
    return Freedom(free, mean[None], np.where(free[:, :N_LENS], prior, 0.0))


def calibrate_camera(views: Views, size: tuple[int, int]) -> tuple[Optimum, Freedom]:
    """Calibrate one camera from its views of a board.

    Args:
        views: V views of camera 0, of frames 0 to V - 1.
        size: (width, height) of its images, pixels.

    Returns:
        the optimum; its board poses are camera_from_board. And which values of its lens were estimated.
    """
    center = (np.array(size) - 1) / 2
    homographies = np.array(
        [fit_homography(views.points[s, :2], p[s]) for s, p in zip(views.seen, views.pixels, strict=True)]
    )
    solved = solve_focal(homographies, center)
    starts = [] if solved is None else [solved]
    starts += [ratio * size[0] for ratio in FOCAL_STARTS]
    fits = [_fit_pinhole(views, homographies, make_freedom(size, focal, (0, 1)), focal, center) for focal in starts]
    best = min(fits, key=lambda fit: float(fit.sigma[0]))
    radial = make_freedom(size, _get_focal(best), (*PINHOLE, 4, 5))
    best = optimize(views, best.at, radial, START_QUANTILE)
    best = optimize(views, choose_flips(views, best), radial, START_QUANTILE)
    usual, wide = (make_freedom(size, _get_focal(best), (*PINHOLE, *its)) for its in (DISTORTION, WIDE_DISTORTION))
    best = optimize(views, best.at, usual, START_QUANTILE)
    if not _is_wide(views, best, usual, wide):
        return optimize(views, best.at, usual), usual
    best = optimize(views, best.at, wide, START_QUANTILE)
    return optimize(views, best.at, wide), wide


def _get_focal(fit: Optimum) -> float:
    return float(np.sqrt(fit.at.lens[0, 0] * fit.at.lens[0, 1]))


def _fit_pinhole(views: Views, homographies: FloatArray, freedom: Freedom, focal: float, center: FloatArray) -> Optimum:
    poses = [solve_pose(matrix, focal, center) for matrix in homographies]
    lens = np.array([focal, focal, *center, *np.zeros(8)])
    rotation, translation = np.array([r for r, _ in poses]), np.array([t for _, t in poses])
    start = Unknowns.of_camera(lens, rotation, translation)
    return optimize(views, start, freedom, START_QUANTILE)


def choose_flips(views: Views, fit: Optimum) -> Unknowns:
    """Return the unknowns with each board tilted the other way where that fits better."""
    at = fit.at
    rotation, translation = flip_poses(views.points, at.board_rotation, at.board_translation)
    flipped, cost = refine_poses(views, replace(at, board_rotation=rotation, board_translation=translation), fit.sigma)
    is_better = cost < compute_loss(views, fit.residuals, fit.sigma[views.camera]).sum(axis=1)
    return replace(
        at,
        board_rotation=np.where(is_better[:, None, None], flipped.board_rotation, at.board_rotation),
        board_translation=np.where(is_better[:, None], flipped.board_translation, at.board_translation),
    )


def _is_wide(views: Views, fit: Optimum, usual: Freedom, wide: Freedom) -> bool:
    """Return whether all coefficients predict views significantly better to which they were not fitted (halves)."""
    n = len(views.frame)
    if n < 2 * MIN_HALF:
        return False
    losses, is_first = np.empty((2, n)), np.arange(n) % 2 == 0
    for i, freedom in enumerate((usual, wide)):
        for half in (is_first, ~is_first):
            own, others = _number_frames(views.select(half)), _number_frames(views.select(~half))
            trained = optimize(own, _select_frames(fit.at, half), freedom, START_QUANTILE)
            tested = replace(_select_frames(fit.at, ~half), lens=trained.at.lens)
            losses[i, ~half] = refine_poses(others, tested, fit.sigma)[1]
    gains = losses[0] - losses[1]
    return bool(gains.sum() > SIGNIFICANT * gains.std() * np.sqrt(n))


def _number_frames(views: Views) -> Views:
    """Return the views of one camera with their frames numbered by view."""
    return replace(views, frame=np.arange(len(views.frame)))


def _select_frames(at: Unknowns, kept: BoolArray | IntArray) -> Unknowns:
    return replace(at, board_rotation=at.board_rotation[kept], board_translation=at.board_translation[kept])


# --- several cameras ------------------------------------------------------------------------------------------------------


class CameraPoses:
    """Candidate poses of the board in the views of one camera: as found, tilted the other way, and its symmetries.

    Attributes:
        by_frame: (2 S, 4, 4) camera_from_board by frame, for both tilts all symmetries.
        symmetries: (S, 4, 4) of the board.
        views: of this camera.
        lens, sigma: (12,) of this camera, and its noise, pixels.
    """

    def __init__(self, views: Views, fit: Optimum, symmetries: FloatArray) -> None:
        """Compute the candidates.

        Args:
            views: of this camera, with the recording's numbers of frames.
            fit: from `calibrate_camera`.
            symmetries: (S, 4, 4) rigid motions under which the board looks the same.
        """
        own = replace(_number_frames(views), camera=np.zeros(len(views.camera), np.int64))
        rotation, translation = flip_poses(views.points, fit.at.board_rotation, fit.at.board_translation)
        flipped = replace(fit.at, board_rotation=rotation, board_translation=translation)
        flipped = refine_poses(own, flipped, fit.sigma)[0]
        poses = np.stack([_to_matrices(at.board_rotation, at.board_translation) for at in (fit.at, flipped)], axis=1)
        candidates = (poses[:, :, None] @ symmetries).reshape(len(poses), -1, 4, 4)
        self.by_frame = dict(zip(views.frame.tolist(), candidates, strict=True))
        self.views, self.symmetries, self.lens, self.sigma = views, symmetries, fit.at.lens[0], float(fit.sigma[0])
        self._row = {frame: row for row, frame in enumerate(views.frame.tolist())}

    def measure_misfits(self, frame: int, camera_from_board: FloatArray) -> FloatArray:
        """Return (K,) mean distances of the corners in a view from their places by poses (K, 4, 4).

        They are relative to the distance of neighboring corners, and 1 at most.
        """
        row = self._row[frame]
        k = len(camera_from_board)
        views = Views(
            self.views.points,
            np.zeros(k, np.int64),
            np.arange(k),
            np.broadcast_to(self.views.pixels[row], (k, *self.views.pixels[row].shape)),
            np.broadcast_to(self.views.seen[row], (k, len(self.views.points))),
            np.zeros((1, 1, 1)),
        )
        at = Unknowns.of_camera(self.lens, camera_from_board[:, :3, :3], camera_from_board[:, :3, 3])
        seen = self.views.seen[row]
        lengths = np.linalg.norm(self.views.pixels[row] - project(views, at), axis=2)[:, seen]
        spacing = measure_spacing(self.views.pixels[row][seen])
        return np.asarray(np.minimum(lengths / spacing, 1.0).mean(axis=1))


def measure_spacing(pixels: FloatArray) -> float:
    """Return the mean distance of image points (n, 2) from their nearest neighbors, pixels."""
    distances = np.linalg.norm(pixels[:, None] - pixels, axis=2)
    np.fill_diagonal(distances, np.inf)
    return max(float(distances.min(axis=1).mean()), 1.0)


def _to_matrices(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    matrices = np.tile(np.eye(4), (len(rotation), 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = rotation, translation
    return matrices


def find_symmetries(points: FloatArray, permutations: Sequence[IntArray]) -> FloatArray:
    """Return (S, 4, 4) rigid motions that map each point to the one with which a permutation exchanges it."""
    motions = []
    for way in permutations:
        a, b = points.mean(axis=0), points[way].mean(axis=0)
        # Adding the normal makes the fit of a plane unique.
        arms = np.vstack([points - a, [0.0, 0.0, 1.0]]), np.vstack([points[way] - b, [0.0, 0.0, 1.0]])
        rotation = Rotation.align_vectors(arms[1], arms[0])[0]
        motions.append(RigidTransform.from_components(b - rotation.apply(a), rotation).as_matrix())
    return np.array(motions)


def relate_cameras(a: CameraPoses, b: CameraPoses) -> tuple[FloatArray, float]:
    """Return the pose a_from_b (4, 4) on which most common frames agree, and how many do.

    Each frame proposes the poses that its candidates imply, and agrees with a pose in so far as the corners that it
    predicts in b are near. Views of a plane leave the tilt ambiguous, but only the right poses agree between frames.
    """
    frames = sorted(a.by_frame.keys() & b.by_frame.keys())
    if not frames:
        return np.eye(4), 0.0
    chosen = np.unique(np.linspace(0, len(frames) - 1, MAX_CANDIDATE_FRAMES).round().astype(int))
    voting = np.unique(np.linspace(0, len(frames) - 1, MAX_VOTING_FRAMES).round().astype(int))
    proposals = np.concatenate(
        [
            (a.by_frame[f][:, None] @ np.linalg.inv(b.by_frame[f][:: len(b.symmetries)])[None]).reshape(-1, 4, 4)
            for f in (frames[k] for k in chosen)
        ]
    )
    inverse = np.linalg.inv(proposals)
    votes = np.zeros(len(proposals))
    for f in (frames[k] for k in voting):
        predicted = (inverse[:, None] @ a.by_frame[f][None]).reshape(-1, 4, 4)
        votes += 1.0 - b.measure_misfits(f, predicted).reshape(len(proposals), -1).min(axis=1)
    best = int(np.argmax(votes))
    return proposals[best], float(votes[best]) * len(frames) / len(voting)


def link_cameras(poses: Sequence[CameraPoses]) -> tuple[list[FloatArray | None], list[list[int]]]:
    """Chain the poses of the cameras along the pairs that agree in most frames (a maximum spanning tree).

    Returns:
        (4, 4) camera_from_first by camera, None for those that are not linked; and the groups of linked cameras, that of
        the first camera first.
    """
    n = len(poses)
    relations = {(a, b): relate_cameras(poses[a], poses[b]) for a in range(n) for b in range(a + 1, n)}
    edges = sorted((votes, pair) for pair, (_, votes) in relations.items() if votes > 0)
    group, neighbors = list(range(n)), {c: list[tuple[int, FloatArray]]() for c in range(n)}
    for _, (a, b) in reversed(edges):
        if group[a] != group[b]:
            group = [group[a] if g == group[b] else g for g in group]
            a_from_b = relations[a, b][0]
            neighbors[a].append((b, np.asarray(np.linalg.inv(a_from_b), dtype=float)))
            neighbors[b].append((a, a_from_b))
    found: list[FloatArray | None] = [None] * n
    found[0], waiting = np.eye(4), [0]
    while waiting:
        c = waiting.pop()
        own = found[c]
        for other, other_from_own in neighbors[c]:
            if found[other] is None and own is not None:
                found[other] = np.asarray(other_from_own @ own)
                waiting.append(other)
    groups = [[c for c in range(n) if group[c] == g] for g in dict.fromkeys(group)]
    return found, groups


def place_boards(
    poses: Sequence[CameraPoses], camera_from_world: FloatArray, n_frames: int
) -> tuple[FloatArray, dict[tuple[int, int], int]]:
    """Place the board in all frames, each time the candidate of any camera that fits all views best.

    Args:
        poses: candidates by camera.
        camera_from_world: (C, 4, 4).
        n_frames: F.

    Returns:
        (F, 4, 4) world_from_board, and the symmetry of each view by camera and frame.
    """
    world_from_camera, found = np.linalg.inv(camera_from_world), np.tile(np.eye(4), (n_frames, 1, 1))
    ways = dict[tuple[int, int], int]()
    for f in range(n_frames):
        own = [c for c, its in enumerate(poses) if f in its.by_frame]
        if not own:
            continue
        candidates = np.concatenate([world_from_camera[c] @ poses[c].by_frame[f] for c in own])
        misfits = []
        for c in own:
            each = (camera_from_world[c] @ candidates)[:, None] @ poses[c].symmetries
            misfits.append(poses[c].measure_misfits(f, each.reshape(-1, 4, 4)).reshape(len(candidates), -1))
        best = int(np.argmin(sum(its.min(axis=1) for its in misfits)))
        found[f] = candidates[best]
        ways |= {(c, f): int(np.argmin(its[best])) for c, its in zip(own, misfits, strict=True)}
    return found, ways
