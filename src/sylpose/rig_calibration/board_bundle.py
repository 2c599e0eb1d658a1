"""Bundle adjustment of lenses, extrinsics, delays and board poses on the corners of a known board.

The unknowns of a camera are its lens, (fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6) of OpenCV's standard model, its
camera_from_world, and the delay of its images in frames; those of a frame are world_from_board. Poses change by (w, d):
R -> exp(w) R, t -> t + d. Board poses are eliminated (Schur complement), so that the linear system has the cameras'
unknowns only.

Corners of a view share errors: blur, motion between the exposures of two cameras, a bent board. They are modeled as a
random shift of each view, whose standard deviation is estimated by restricted maximum likelihood. Otherwise the lenses
would be bent to explain differences between the cameras.

Source: H. D. Patterson, R. Thompson, "Recovery of inter-block information when block sizes are unequal", 1971.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.robust_loss import biquartic_losses, biquartic_weights

# Unknowns of a camera: lens, pose, delay (derived).
N_LENS, POSE, DELAY = 12, slice(12, 18), 18
N_CAMERA = 19
# Corners further from their projection, in standard deviations of a coordinate, are outliers (choice: as
# `absolute_pose`).
CUTOFF = 5.0
# Quantiles of the residuals that measure noise: the median, of whatever outliers; and while the model is not yet right,
# one that all but few corners contribute to, lest a wrong model fits half of them (choice).
ROBUST_QUANTILE, START_QUANTILE = 0.5, 0.9
# Smallest noise, pixels: rounding of exact data (derived: of single-precision images).
MIN_SIGMA_PX = 1e-6
# Rounds of noise and optimum, iterations in each, and the relative changes of noise and cost at which they have converged
# (choice).
MAX_ROUNDS, MAX_ITERATIONS, SIGMA_TOLERANCE, COST_TOLERANCE = 10, 60, 1e-2, 1e-6
# Regularization of board poses that corners do not determine, in units of the diagonal (derived: of rounding).
RIDGE = 1e-12
# Residuals of poses behind the camera, pixels (choice: beyond any image).
MAX_RESIDUAL_PX = 1e6
# Rounds of weights and shift of a view (choice), and the range of the shifts' standard deviation in those of the noise
# (choice: below, the mean of a view's corners hides it; above, the cameras do not see one board).
SHIFT_ROUNDS, SHIFT_RANGE = 3, (0.01, 300.0)
# Smallest and largest damping of Levenberg-Marquardt, relative to the diagonal (choice).
MIN_DAMPING, MAX_DAMPING = 1e-12, 1e8


@dataclass(frozen=True, eq=False)
class Views:
    """Corners of a board with N points in V views of F frames by C cameras.

    Attributes:
        points: (N, 3) in the board's frame.
        camera, frame: (V,) of each view; no two views have both in common.
        pixels: (V, N, 2) in the images as recorded; any value where not seen.
        seen: (V, N) mask.
        speeds: (V, N, 2) velocities of the corners in the images, pixels per frame; 0 where unknown.
    """

    points: FloatArray
    camera: IntArray
    frame: IntArray
    pixels: FloatArray
    seen: BoolArray
    speeds: FloatArray

    def select(self, kept: BoolArray | IntArray) -> Views:
        """Return some of the views; numbers of cameras and frames remain."""
        columns = {name: getattr(self, name)[kept] for name in ("camera", "frame", "pixels", "seen", "speeds")}
        return replace(self, **columns)


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Lenses and poses of C cameras, and F board poses.

    Attributes:
        lens: (C, 12), see the module.
        rotation, translation: (C, 3, 3), (C, 3) of camera_from_world.
        delay: (C,) frames by which the images of a camera are late.
        board_rotation, board_translation: (F, 3, 3), (F, 3) of world_from_board.
    """

    lens: FloatArray
    rotation: FloatArray
    translation: FloatArray
    delay: FloatArray
    board_rotation: FloatArray
    board_translation: FloatArray

    @classmethod
    def of_camera(cls, lens: FloatArray, rotation: FloatArray, translation: FloatArray) -> Unknowns:
        """Return those of one camera in the world's origin, with camera_from_board (F, 3, 3), (F, 3)."""
        return cls(lens[None], np.eye(3)[None], np.zeros((1, 3)), np.zeros(1), rotation, translation)

    def move(self, cameras: FloatArray, boards: FloatArray) -> Unknowns:
        """Return the unknowns changed by (C, 19) and (F, 6)."""
        return Unknowns(
            self.lens + cameras[:, :N_LENS],
            _rotate(cameras[:, 12:15], self.rotation),
            self.translation + cameras[:, 15:18],
            self.delay + cameras[:, DELAY],
            _rotate(boards[:, :3], self.board_rotation),
            self.board_translation + boards[:, 3:],
        )


@dataclass(frozen=True, eq=False)
class Freedom:
    """Which unknowns of the cameras are estimated, and what is known of them.

    Attributes:
        free: (C, 19) mask; all boards are estimated.
        mean, prior: (C, 12) value of each number of a lens before any view, and its inverse variance; 0 for no prior.
    """

    free: BoolArray
    mean: FloatArray
    prior: FloatArray


@dataclass(frozen=True, eq=False)
class Linearization:
    """Residuals and their derivatives, one block per view, two rows per corner.

    Attributes:
        residuals: (V, N, 2) pixels, observed minus projected; 0 where not seen.
        camera_jacobian, board_jacobian: (V, 2 N, 19), (V, 2 N, 6) of the projections.
    """

    residuals: FloatArray
    camera_jacobian: FloatArray
    board_jacobian: FloatArray


@dataclass(frozen=True, eq=False)
class Optimum:
    """Optimum of a bundle adjustment.

    Attributes:
        at: the unknowns.
        sigma: (C,) noise of a coordinate by camera, pixels.
        weights: (V, N) weight of each corner, 1 for a perfect one, 0 for outliers and where not seen.
        residuals: (V, N, 2) pixels.
        cost: robust cost in units of the noise.
        shift_sd: standard deviation of the shift of a view in each coordinate, pixels.
    """

    at: Unknowns
    sigma: FloatArray
    weights: FloatArray
    residuals: FloatArray
    cost: float
    shift_sd: float = 0.0


def _rotate(w: FloatArray, rotation: FloatArray) -> FloatArray:
    return np.asarray(Rotation.from_rotvec(w).as_matrix() @ rotation) if len(w) else rotation


def project(views: Views, at: Unknowns) -> FloatArray:
    """Return the projections (V, N, 2) of all corners; infinite behind a camera."""
    points = _camera_points(views, at)[1]
    in_front = points[..., 2] > 0
    with np.errstate(all="ignore"):
        x = points[..., :2] / points[..., 2:]
        pixels = _distort(x, at.lens[views.camera]) + at.delay[views.camera][:, None, None] * views.speeds
    return np.where((in_front & np.isfinite(pixels).all(axis=-1))[..., None], pixels, np.inf)


def compute_residuals(views: Views, at: Unknowns) -> FloatArray:
    """Return (V, N, 2) pixels, observed minus projected; 0 where not seen, infinite behind a camera."""
    return np.where(views.seen[..., None], views.pixels - project(views, at), 0.0)


def _camera_points(views: Views, at: Unknowns) -> tuple[FloatArray, FloatArray]:
    """Return the corners (V, N, 3) relative to the board's origin in world axes, and in camera axes."""
    arms = views.points @ at.board_rotation[views.frame].transpose(0, 2, 1)
    world = arms + at.board_translation[views.frame][:, None]
    camera = world @ at.rotation[views.camera].transpose(0, 2, 1) + at.translation[views.camera][:, None]
    return arms, camera


def _distort(x: FloatArray, lens: FloatArray) -> FloatArray:
    """Return pixels (V, N, 2) of normalized points (V, N, 2) by lenses (V, 12)."""
    radial, _, tangential = _compute_distortion(x, lens)
    return np.asarray(lens[:, None, :2] * (x * radial[..., None] + tangential) + lens[:, None, 2:4])


def _compute_distortion(x: FloatArray, lens: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return radial factor (V, N), numerator and denominator in one (2, V, N), and tangential shift (V, N, 2)."""
    a, b = x[..., 0], x[..., 1]
    k1, k2, p1, p2, k3, k4, k5, k6 = lens[:, 4:].T[..., None]
    a2, b2 = a * a, b * b
    r2, ab = a2 + b2, 2 * a * b
    terms = np.stack([1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + r2 * (k4 + r2 * (k5 + r2 * k6))])
    tangential = np.stack([p1 * ab + p2 * (r2 + 2 * a2), p1 * (r2 + 2 * b2) + p2 * ab], axis=-1)
    return terms[0] / terms[1], terms, tangential


def _differentiate_distortion(x: FloatArray, lens: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return `_distort`, its derivatives (V, N, 2, 2) by x, and (V, N, 2, 12) by lens."""
    a, b = x[..., 0], x[..., 1]
    f = lens[:, None, :2]
    k1, k2, p1, p2, k3, k4, k5, k6 = lens[:, 4:].T[..., None]
    g, (_, denominator), tangential = _compute_distortion(x, lens)
    r2 = a * a + b * b
    r4, r6 = r2 * r2, r2 * r2 * r2
    slope = (k1 + 2 * k2 * r2 + 3 * k3 * r4 - g * (k4 + 2 * k5 * r2 + 3 * k6 * r4)) / denominator
    distorted = x * g[..., None] + tangential
    by_x = np.empty((*x.shape, 2))
    by_x[..., 0, 0] = g + 2 * a * a * slope + 2 * p1 * b + 6 * p2 * a
    by_x[..., 0, 1] = by_x[..., 1, 0] = 2 * a * b * slope + 2 * p1 * a + 2 * p2 * b
    by_x[..., 1, 1] = g + 2 * b * b * slope + 6 * p1 * b + 2 * p2 * a
    by_lens = np.zeros((*x.shape, N_LENS))
    for i in range(2):
        by_lens[..., i, i], by_lens[..., i, 2 + i] = distorted[..., i], 1.0
    radial = x / denominator[..., None]
    for column, power in ((4, r2), (5, r4), (8, r6), (9, -g * r2), (10, -g * r4), (11, -g * r6)):
        by_lens[..., column] = radial * power[..., None]
    by_lens[..., 6] = np.stack([2 * a * b, r2 + 2 * b * b], axis=-1)
    by_lens[..., 7] = np.stack([r2 + 2 * a * a, 2 * a * b], axis=-1)
    by_lens[..., 4:] *= f[..., None]
    return f * distorted + lens[:, None, 2:4], f[..., None] * by_x, by_lens


def linearize(views: Views, at: Unknowns, *, with_cameras: bool = True) -> Linearization:
    """Compute residuals and analytic derivatives, on request by boards only; corners that are not seen have rows of 0."""
    arms, points = _camera_points(views, at)
    points = np.where(views.seen[..., None], points, [0.0, 0.0, 1.0])
    x = points[..., :2] / points[..., 2:]
    pixels, by_x, by_lens = _differentiate_distortion(x, at.lens[views.camera])
    by_point = np.concatenate([by_x, -(by_x @ x[..., None])], axis=-1) / points[..., 2, None, None]
    rotation = at.rotation[views.camera]
    pixels += at.delay[views.camera][:, None, None] * views.speeds
    by_world = by_point @ rotation[:, None]
    rotated = points - at.translation[views.camera][:, None]
    # The derivative by w of exp(w) p is -[p]x, and of a row h: h (w x p) = (p x h) w.
    by_camera = by_lens[..., :0]
    if with_cameras:
        by_pose = np.cross(rotated[..., None, :], by_point), by_point
        by_camera = np.concatenate([by_lens, *by_pose, views.speeds[..., None]], axis=-1)
    by_board = np.concatenate([np.cross(arms[..., None, :], by_world), by_world], axis=-1)
    seen = views.seen[..., None]
    n = 2 * len(views.points)
    return Linearization(
        np.where(seen, views.pixels - pixels, 0.0),
        np.where(seen[..., None], by_camera, 0.0).reshape(len(x), n, by_camera.shape[-1]),
        np.where(seen[..., None], by_board, 0.0).reshape(len(x), n, 6),
    )


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Normal equations of weighted residuals: blocks of cameras, boards, and views, which couple one of each.

    Attributes:
        cameras, boards: (C, 19, 19), (F, 6, 6).
        coupling: (C, F, 19, 6).
        camera_gradient, board_gradient: (C, 19), (F, 6), J' W r.
    """

    cameras: FloatArray
    boards: FloatArray
    coupling: FloatArray
    camera_gradient: FloatArray
    board_gradient: FloatArray

    @classmethod
    def build(
        cls, views: Views, lin: Linearization, weights: FloatArray, at: Unknowns, freedom: Freedom
    ) -> NormalEquations:
        """Build the equations at some unknowns, with weights (V, N) in inverse variances, and the priors of lenses."""
        n_cameras, n_frames = len(at.lens), len(at.board_rotation)
        w = np.repeat(weights, 2, axis=1)[..., None]
        residuals = lin.residuals.reshape(len(w), -1, 1)
        camera, board = lin.camera_jacobian, lin.board_jacobian
        camera_t, board_t = (camera * w).transpose(0, 2, 1), (board * w).transpose(0, 2, 1)
        cameras, boards = np.zeros((n_cameras, N_CAMERA, N_CAMERA)), np.zeros((n_frames, 6, 6))
        coupling = np.zeros((n_cameras, n_frames, N_CAMERA, 6))
        camera_gradient, board_gradient = np.zeros((n_cameras, N_CAMERA)), np.zeros((n_frames, 6))
        np.add.at(cameras, views.camera, camera_t @ camera)
        np.add.at(boards, views.frame, board_t @ board)
        coupling[views.camera, views.frame] = camera_t @ board
        np.add.at(camera_gradient, views.camera, (camera_t @ residuals)[..., 0])
        np.add.at(board_gradient, views.frame, (board_t @ residuals)[..., 0])
        lens = np.arange(N_LENS)
        cameras[:, lens, lens] += freedom.prior
        camera_gradient[:, lens] -= freedom.prior * (at.lens - freedom.mean)
        return cls(cameras, boards, coupling, camera_gradient, board_gradient)

    def eliminate_boards(self, damping: float = 0.0) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Eliminate the board poses.

        Returns:
            (C 19, C 19) reduced matrix and (C 19,) gradient; (C, F, 19, 6) coupling times the boards' inverse; (F, 6, 6)
            this inverse.
        """
        inverse = invert_blocks(_damp(self.boards, damping))
        n, n_frames = len(self.cameras) * N_CAMERA, len(self.boards)
        through = self.coupling @ inverse
        flat = self.coupling.transpose(0, 2, 1, 3).reshape(n, 6 * n_frames)
        flat_through = through.transpose(0, 2, 1, 3).reshape(n, 6 * n_frames)
        matrix = -(flat_through @ flat.T)
        for c, block in enumerate(_damp(self.cameras, damping)):
            matrix[c * N_CAMERA : (c + 1) * N_CAMERA, c * N_CAMERA : (c + 1) * N_CAMERA] += block
        gradient = self.camera_gradient.ravel() - flat_through @ self.board_gradient.ravel()
        return matrix, gradient, through, inverse

    def solve(self, free: BoolArray, damping: float) -> tuple[FloatArray, FloatArray]:
        """Return the steps (C, 19), 0 for those that are not free, and (F, 6)."""
        matrix, gradient, through, inverse = self.eliminate_boards(damping)
        cameras, chosen = np.zeros(free.size), np.flatnonzero(free)
        if len(chosen):
            cameras[chosen] = solve_scaled(matrix[np.ix_(chosen, chosen)], gradient[chosen])
        steps = cameras.reshape(free.shape)
        boards = (inverse @ self.board_gradient[..., None])[..., 0] - np.einsum("cfij,ci->fj", through, steps)
        return steps, boards


def _damp(blocks: FloatArray, damping: float) -> FloatArray:
    diagonal = np.einsum("kii->ki", blocks)
    return np.asarray(blocks + damping * diagonal[..., None] * np.eye(blocks.shape[-1]))


def invert_blocks(blocks: FloatArray) -> FloatArray:
    """Invert positive semidefinite blocks (K, n, n), regularized in units of their diagonals."""
    diagonal = np.einsum("kii->ki", blocks)
    # Without any information, the inverse is 0: no step.
    scale = np.where(diagonal > 0, 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)), 0.0)
    both = scale[:, :, None] * scale[:, None]
    return np.asarray(both * np.linalg.inv(blocks * both + RIDGE * np.eye(blocks.shape[-1])))


def solve_scaled(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solve a positive semidefinite system whose unknowns have different units."""
    scale: FloatArray = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scaled = matrix * np.outer(scale, scale)
    rows = scale.reshape(-1, *[1] * (right.ndim - 1))
    return np.asarray(rows * (np.linalg.pinv(scaled, rcond=1e-13, hermitian=True) @ (rows * right)))


def estimate_sigma(
    views: Views, residuals: FloatArray, relative: FloatArray, quantile: float = ROBUST_QUANTILE
) -> FloatArray:
    """Return (C,) noise of a coordinate by camera from a quantile of all residuals, pixels.

    The ratios (C,) of the cameras' noise are given: estimated as well, the camera with the least residual would gain more
    and more weight, until the boards follow it alone.
    """
    lengths = (np.linalg.norm(residuals, axis=-1) / relative[views.camera][:, None])[views.seen]
    # Of the length of two normal coordinates (Rayleigh).
    unit = float(np.quantile(lengths, quantile)) / np.sqrt(-2.0 * np.log(1.0 - quantile))
    return np.asarray(np.maximum(unit * relative, MIN_SIGMA_PX))


def compute_loss(views: Views, residuals: FloatArray, noise: FloatArray) -> FloatArray:
    """Return the robust loss (V, N) of each corner with noise (V,): its squared residual in variances up to the cutoff."""
    q = (residuals**2).sum(axis=-1) / (CUTOFF * noise[:, None]) ** 2
    return CUTOFF**2 * np.where(views.seen, biquartic_losses(np.nan_to_num(q, nan=np.inf, posinf=np.inf)), 0.0)


def compute_weights(views: Views, residuals: FloatArray, noise: FloatArray) -> FloatArray:
    """Return the robust weight (V, N) of each corner with noise (V,); 0 where not seen."""
    q = (residuals**2).sum(axis=-1) / (CUTOFF * noise[:, None]) ** 2
    return np.where(views.seen & np.isfinite(q), biquartic_weights(q), 0.0)


def estimate_shifts(views: Views, residuals: FloatArray, noise: FloatArray, shift_sd: float) -> FloatArray:
    """Return the likeliest shift (V, 1, 2) of each view with noise (V,), robustly; 0 without a standard deviation."""
    shifts = np.zeros((len(residuals), 1, 2))
    if not shift_sd:
        return shifts
    bounded = np.clip(np.where(views.seen[..., None], residuals, np.nan), -MAX_RESIDUAL_PX, MAX_RESIDUAL_PX)
    shifts[:, 0] = np.nanmedian(bounded, axis=1)
    bounded, variances = np.nan_to_num(bounded), noise[:, None] ** 2
    for _ in range(SHIFT_ROUNDS):
        weights = (compute_weights(views, bounded - shifts, noise) / variances)[..., None]
        shifts = (weights * bounded).sum(axis=1, keepdims=True) / (weights.sum(axis=1, keepdims=True) + shift_sd**-2)
    return shifts


def whiten_shifts(lin: Linearization, weights: FloatArray, shift_sd: float) -> Linearization:
    """Return residuals and derivatives whose squares, with weights (V, N), are those with the shifts eliminated.

    With the sum of weights w of a view and s = 1 / sd², the shift's elimination subtracts w² / (w + s) times the product
    of means; the same follows if a part 1 - sqrt(s / (w + s)) of each mean is subtracted.
    """
    if not shift_sd:
        return lin
    total = weights.sum(axis=1)
    part = 1.0 - 1.0 / np.sqrt(1.0 + total * shift_sd**2)
    share = weights * (part / np.maximum(total, 1e-300))[:, None]

    def center(rows: FloatArray) -> FloatArray:
        each = rows.reshape(*weights.shape, 2, -1)
        return np.asarray(each - np.einsum("vn,vnij->vij", share, each)[:, None]).reshape(rows.shape)

    return Linearization(center(lin.residuals), center(lin.camera_jacobian), center(lin.board_jacobian))


def estimate_shift_sd(views: Views, at: Unknowns, freedom: Freedom, noise: FloatArray, shift_sd: float) -> float:
    """Estimate the standard deviation of the shifts with noise (V,) at an optimum, pixels; 0 if none is likelier."""
    lin = linearize(views, at)
    shifts = estimate_shifts(views, lin.residuals, noise, shift_sd)
    weights = compute_weights(views, lin.residuals - shifts, noise) / noise[:, None] ** 2
    total = weights.sum(axis=1)

    def compute_deviance(sd: float) -> float:
        """Return -2 times the restricted log likelihood, of the problem as linearized here."""
        whitened = whiten_shifts(lin, weights, sd)
        equations = NormalEquations.build(views, whitened, weights, at, freedom)
        matrix, gradient, _, inverse = equations.eliminate_boards()
        chosen = np.flatnonzero(freedom.free)
        matrix, gradient = matrix[np.ix_(chosen, chosen)], gradient[chosen]
        squares = float((weights[..., None] * whitened.residuals**2).sum())
        squares -= float(np.einsum("fi,fij,fj->", equations.board_gradient, inverse, equations.board_gradient))
        squares -= float(gradient @ solve_scaled(matrix, gradient))
        scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        determinants = 2.0 * float(np.log(scale).sum()) + float(np.linalg.slogdet(matrix / np.outer(scale, scale))[1])
        determinants -= float(np.linalg.slogdet(inverse)[1].sum())
        return squares + determinants + 2.0 * float(np.log1p(total * sd**2).sum())

    logs = np.log(float(np.median(noise))) + np.log(SHIFT_RANGE)
    found = minimize_scalar(lambda log: compute_deviance(float(np.exp(log))), bounds=tuple(logs), method="bounded")
    return float(np.exp(found.x)) if found.fun < compute_deviance(0.0) else 0.0


def optimize(
    views: Views,
    at: Unknowns,
    freedom: Freedom,
    quantile: float = ROBUST_QUANTILE,
    relative: FloatArray | None = None,
    *,
    with_shifts: bool = False,
) -> Optimum:
    """Minimize the robust reprojection error by Levenberg-Marquardt.

    Args:
        views: the corners.
        at: the start.
        freedom: which unknowns are estimated.
        quantile: of the residuals, measures the noise; from the start on, so that gross errors of the start are tolerated.
        relative: (C,) ratios of the cameras' noise; None for equal noise.
        with_shifts: whether views are shifted at random; only differences between cameras show that.
    """
    relative = np.ones(len(at.lens)) if relative is None else relative
    residuals, shift_sd = compute_residuals(views, at), 0.0
    sigma = estimate_sigma(views, residuals, relative, quantile)
    for _ in range(MAX_ROUNDS):
        noise, old_sd = sigma, shift_sd
        at, cost = _minimize(views, at, freedom, noise[views.camera], shift_sd)
        residuals = compute_residuals(views, at)
        if with_shifts:
            shift_sd = estimate_shift_sd(views, at, freedom, noise[views.camera], old_sd)
        shifts = estimate_shifts(views, residuals, noise[views.camera], shift_sd)
        sigma = estimate_sigma(views, np.where(views.seen[..., None], residuals - shifts, 0.0), relative, quantile)
        is_converged = (np.abs(sigma - noise) <= SIGMA_TOLERANCE * noise).all()
        if is_converged and abs(shift_sd - old_sd) <= SIGMA_TOLERANCE * (shift_sd + float(noise.min())):
            break
    shifts = estimate_shifts(views, residuals, noise[views.camera], old_sd)
    weights = compute_weights(views, residuals - shifts, noise[views.camera])
    return Optimum(at, noise, weights, residuals, cost, old_sd)


def _minimize(
    views: Views, at: Unknowns, freedom: Freedom, noise: FloatArray, shift_sd: float
) -> tuple[Unknowns, float]:
    """Minimize with a constant noise (V,) of each view; return the optimum and its cost."""

    def compute_cost(at: Unknowns) -> float:
        residuals = compute_residuals(views, at)
        shifts = estimate_shifts(views, residuals, noise, shift_sd)
        cost = float(compute_loss(views, residuals - shifts, noise).sum())
        cost += float((shifts**2).sum()) / shift_sd**2 if shift_sd else 0.0
        return cost + float((freedom.prior * (at.lens - freedom.mean) ** 2).sum())

    cost, damping = compute_cost(at), 1e-3
    for _ in range(MAX_ITERATIONS):
        lin = linearize(views, at)
        shifts = estimate_shifts(views, lin.residuals, noise, shift_sd)
        weights = compute_weights(views, lin.residuals - shifts, noise) / noise[:, None] ** 2
        equations = NormalEquations.build(views, whiten_shifts(lin, weights, shift_sd), weights, at, freedom)
        while damping <= MAX_DAMPING:
            moved = at.move(*equations.solve(freedom.free, damping))
            moved_cost = compute_cost(moved)
            if moved_cost <= cost:
                break
            damping *= 10.0
        else:
            break
        decrease, at, cost = cost - moved_cost, moved, moved_cost
        damping = max(damping / 10.0, MIN_DAMPING)
        if decrease <= COST_TOLERANCE * cost:
            break
    return at, cost
