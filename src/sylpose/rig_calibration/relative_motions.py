"""Extrinsics of cameras from their own tracks of one moving object: no board, no point observed by two cameras.

Each camera measures the object's poses M_ci = S_c X_c T_i O_c in its own axes and its own unit of length. Motions between
frames give the rotations of the rig, and then positions give its places and the scales (`sylvester.hand_eye`), up to one
common length. Motions that do not determine the rig are refused, each with what to do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.robust_loss import biquartic_weights
from sylpose.rig_calibration.result import CalibrationRefusedError
from sylpose.sylvester.hand_eye import (
    CUTOFF_SIGMAS,
    MEDIAN_SQUARE,
    MIN_AXIS_SPREAD,
    RELATIVE_ANGLE_TOLERANCE,
    HandEyeTranslations,
    select_pairs,
    solve_hand_eye_rotation,
    solve_hand_eye_translations,
)

# Two cameras need so many common frames (choice: fewer leave no redundancy).
MIN_COMMON_FRAMES = 6
# Two cameras observe one object if the rotation angles of pairs of frames agree within so many standard deviations or
# `RELATIVE_ANGLE_TOLERANCE`, whichever is more, in this share of the pairs (measured: docs/calibrating.md).
ANGLE_SDS, MIN_AGREEING = 3.0, 0.7
# Pairs of frames count if both cameras together rotate by so many standard deviations (choice), at least so many pairs.
MIN_ROTATION_SDS, MIN_PAIRS = 6.0, 10
# Rotations of pairs of cameras must close to this, radians (choice: 3 degrees).
MAX_CLOSURE = np.radians(3.0)
# Residual of the positions relative to that with the track depth-reversed (measured: docs/calibrating.md, 0.01 to 0.6 for
# sound tracks).
MAX_REVERSAL_RATIO = 0.9
# Largest relative standard deviation of a scale (choice: three are less than half).
MAX_SCALE_SD = 0.15
# Frames by which cameras may be shifted in the search for a time offset (choice), and the residual at the minimum
# relative to that without shift below which there is one (measured: docs/calibrating.md).
MAX_SHIFT, MAX_SHIFT_RATIO = 5, 0.6
# Half a turn about the optical axis, by which the axes of a depth-reversed track differ.
HALF_TURN = np.diag([-1.0, -1.0, 1.0])


@dataclass(frozen=True, eq=False)
class CameraTrack:
    """Object's poses as one camera measures them alone.

    Attributes:
        name: of the camera.
        frames: (n,) frame numbers, increasing.
        camera_from_object: n poses; lengths in units of the object's first distance.
        rotation_covariance: (n, 3, 3) of their rotations, camera's axes, rad².
        radius: of the object, in the same unit.
    """

    name: str
    frames: IntArray
    camera_from_object: RigidTransform
    rotation_covariance: FloatArray
    radius: float

    @property
    def variance(self) -> FloatArray:
        """(n,) mean variance of the rotations about the axes."""
        return np.asarray(np.trace(self.rotation_covariance, axis1=1, axis2=2) / 3.0)


@dataclass(frozen=True)
class MotionTest:
    """Test whether a recording's motion determines the rig.

    Attributes:
        name: what is tested.
        passed: whether it passed.
        value, limit: as text, with units.
        remedy: one sentence of what to do if it fails.
    """

    name: str
    passed: bool
    value: str
    limit: str
    remedy: str


class MotionRefusedError(CalibrationRefusedError):
    """A recording that does not determine the rig: what failed, and what to do.

    Attributes:
        tests: those done, the last one failed.
    """

    def __init__(self, tests: Sequence[MotionTest]) -> None:
        super().__init__(f"{tests[-1].name}: {tests[-1].value}, needs {tests[-1].limit}: {tests[-1].remedy}")
        self.tests = tuple(tests)


@dataclass(frozen=True, eq=False)
class RelativeExtrinsics:
    """Extrinsics of a rig from relative motions; the first of its cameras is the reference.

    Attributes:
        cameras: indices of the C tracks that are used.
        left_out: names of the others, each with the reason.
        camera_from_reference: C poses X_c; lengths in the unit of the reference's track.
        scales: (C,) s_c: the tracks' lengths times s_c are in that unit.
        object_axes: C poses O_c: the object's axes of each (scaled) track, in those of the reference.
        frames: (N,) frame numbers in which at least one camera measures the object.
        reference_from_object: N poses T_i.
        rotation_sd: (C,) standard deviation of the rotation about the worst axis, radians; 0 for the reference.
        scale_sd: (C,) relative standard deviation of the scales; 0 for the reference.
        tests: the tests, passed.
    """

    cameras: tuple[int, ...]
    left_out: dict[str, str]
    camera_from_reference: RigidTransform
    scales: FloatArray
    object_axes: RigidTransform
    frames: IntArray
    reference_from_object: RigidTransform
    rotation_sd: FloatArray
    scale_sd: FloatArray
    tests: tuple[MotionTest, ...]


@dataclass(frozen=True, eq=False)
class _Pair:
    """Rotation b_from_a of two cameras.

    Attributes:
        rotation: (3, 3).
        information: (3, 3) of w in the axes of b, exp(w) R̂.
        certified: whether the rotation is proved to be the best of all (`sylvester.hand_eye`).
        agreeing: share of the pairs of frames in which both rotate by the same angle; NaN with too few.
    """

    rotation: FloatArray
    information: FloatArray
    certified: bool
    agreeing: float


def solve_relative_extrinsics(
    tracks: Sequence[CameraTrack], *, min_agreeing: float = MIN_AGREEING
) -> RelativeExtrinsics:
    """Solve the extrinsics of cameras from their tracks of one object.

    Args:
        tracks: of two cameras or more, with frame numbers in common.
        min_agreeing: share of the pairs of frames in which two cameras must rotate by the same angle.

    Raises:
        MotionRefusedError: the motion does not determine the rig, or the tracks disagree.
    """
    tests: list[MotionTest] = []
    pairs = {(a, b): _relate(tracks[a], tracks[b]) for a, b in combinations(range(len(tracks)), 2)}
    cameras, left_out = _select_cameras(tracks, pairs, min_agreeing)
    _test_rotations(tracks, pairs, cameras, left_out, tests)
    while True:
        rotations, sds, closure, suspect = _average_rotations(pairs, cameras, min_agreeing)
        reason = f"its rotations do not close by {np.degrees(closure):.2g} degrees"
        if closure < MAX_CLOSURE:
            kept = [tracks[c] for c in cameras]
            frames, body, axes = _average_body_rotations(kept, rotations)
            placed, ratios = _solve_places(kept, rotations, frames, body)
            suspect, reason = int(np.argmax(ratios)), "its track fits as well with reversed depth"
            if ratios[suspect] < MAX_REVERSAL_RATIO or len(cameras) == 2:
                break
        left_out[tracks[cameras[suspect]].name] = reason
        rest = [c for k, c in enumerate(cameras) if k != suspect]
        links = [pair for pair, its in pairs.items() if its is not None and its.agreeing >= min_agreeing]
        cameras = sorted(_find_largest_group(rest, [link for link in links if {*link} <= {*rest}]))
        for c in {*rest} - {*cameras}:
            left_out[tracks[c].name] = "too few common frames in which the object rotates"
        if len(cameras) < 2:
            _test_rotations(tracks, pairs, cameras, left_out, tests)  # raises
    scale_sd = _test_places(kept, placed, ratios, tests)
    assert placed is not None
    X = RigidTransform.from_components(placed.translations, Rotation.from_matrix(rotations))
    O = RigidTransform.from_components(placed.offsets, axes)
    poses = _average_positions(kept, X, O, placed, frames, body)
    return RelativeExtrinsics(tuple(cameras), left_out, X, placed.scales, O, frames, poses, sds, scale_sd, tuple(tests))


def _test_rotations(
    tracks: Sequence[CameraTrack],
    pairs: dict[tuple[int, int], _Pair | None],
    cameras: Sequence[int],
    left_out: dict[str, str],
    tests: list[MotionTest],
) -> None:
    """Test whether cameras rotate alike, about more than one axis, at the same times.

    Raises:
        MotionRefusedError: they do not.
    """
    if len(cameras) < 2 and tracks:
        # A motion about one axis may be the cause, where it makes tracks short: the longest shows it.
        longest = max(tracks, key=lambda track: len(track.frames))
        if _count_rotations(longest) >= MIN_PAIRS:
            _test_axes(_measure_spread(longest), tests)
    add_test(
        tests,
        "cameras that rotate alike",
        len(cameras) > 1,
        f"{len(cameras)} of {len(tracks)}",
        "2",
        "".join(f"{name}: {reason}; " for name, reason in left_out.items())
        + "check that all observe the same object and that their times agree, and rotate it by 30 degrees and more",
    )
    _test_axes(min(_measure_spread(tracks[c]) for c in cameras), tests)
    related = [pair for (a, b), pair in pairs.items() if pair is not None and a in cameras and b in cameras]
    add_test(
        tests,
        "certificate of rotations",
        all(pair.certified for pair in related),
        f"{sum(pair.certified for pair in related)} of {len(related)} pairs",
        "all",
        "rotate the object about a second axis, by 30 degrees and more",
    )
    _check_times([tracks[c] for c in cameras], tests)


def _test_axes(spread: float, tests: list[MotionTest]) -> None:
    """Test whether the object rotates about more than one axis.

    Raises:
        MotionRefusedError: it does not.
    """
    add_test(
        tests,
        "spread of rotation axes",
        spread > MIN_AXIS_SPREAD,
        f"{spread:.3f}",
        f"{MIN_AXIS_SPREAD:g}",
        "the object turns about one axis only: rotate it about a second axis",
    )


def _test_places(
    tracks: Sequence[CameraTrack], placed: HandEyeTranslations | None, ratios: FloatArray, tests: list[MotionTest]
) -> FloatArray:
    """Test depths and scales of tracks; return (C,) relative standard deviations of the scales.

    Raises:
        MotionRefusedError: a track may be depth-reversed, or scales are not determined.
    """
    worst = int(np.argmax(ratios))
    add_test(
        tests,
        "depth of the tracks",
        ratios[worst] < MAX_REVERSAL_RATIO,
        f"residual {ratios[worst]:.2g} of that with reversed depth ({tracks[worst].name})",
        f"{MAX_REVERSAL_RATIO:g}",
        "bring the object closer to the cameras, and carry it about by its own size",
    )
    scale_sd = np.full(len(tracks), np.inf) if placed is None else _scale_sds(placed)
    worst = int(np.argmax(scale_sd))
    add_test(
        tests,
        "scales of the tracks",
        scale_sd[worst] < MAX_SCALE_SD,
        f"standard deviation {scale_sd[worst]:.2g} ({tracks[worst].name})",
        f"{MAX_SCALE_SD:g}",
        "carry the object about by its own size, besides rotating it",
    )
    return scale_sd


def add_test(tests: list[MotionTest], name: str, passed: bool, value: str, limit: str, remedy: str) -> None:
    """Add a test.

    Raises:
        MotionRefusedError: it failed.
    """
    tests.append(MotionTest(name, bool(passed), value, limit, remedy))
    if not passed:
        raise MotionRefusedError(tests)


def _check_times(tracks: Sequence[CameraTrack], tests: list[MotionTest]) -> None:
    """Test whether all cameras are in step with the first.

    Raises:
        MotionRefusedError: one is not.
    """
    for track in tracks[1:]:
        shift, ratio = find_time_offset(tracks[0], track)
        found = f"{track.name} is {abs(shift):.1f} frames {'late' if shift > 0 else 'early'}: " if shift else ""
        add_test(
            tests,
            f"time offset of {track.name}",
            shift == 0.0 or ratio > MAX_SHIFT_RATIO,
            f"{shift:+.1f} frames",
            "none",
            f"{found}shift it with --frame-offset {track.name}={-round(shift) or 'N'}, or set its delay with --offsets FILE",
        )


def _list_names(tracks: Sequence[CameraTrack], cameras: Sequence[int] | range) -> str:
    return ", ".join(tracks[c].name for c in cameras)


# --- rotations --------------------------------------------------------------------------------------------------------


def _relative_rotations(track: CameraTrack, rows: IntArray, pairs: IntArray) -> tuple[Rotation, FloatArray]:
    """Return rotations (m) between pairs (m, 2) of rows (k,) of a track, and their variances (m,)."""
    i, j = rows[pairs].T
    rotation = track.camera_from_object.rotation
    return rotation[j] * rotation[i].inv(), track.variance[i] + track.variance[j]


def _relate(a: CameraTrack, b: CameraTrack) -> _Pair | None:
    """Return the rotation b_from_a; None with too few common frames."""
    _, rows_a, rows_b = np.intersect1d(a.frames, b.frames, return_indices=True)
    if len(rows_a) < MIN_COMMON_FRAMES:
        return None
    pairs = select_pairs(len(rows_a))
    (A, variance_a), (B, variance_b) = (_relative_rotations(t, r, pairs) for t, r in ((a, rows_a), (b, rows_b)))
    variance = variance_a + variance_b
    found = solve_hand_eye_rotation(B.as_matrix(), A.as_matrix(), variance)
    angles, sd = (A.magnitude() + B.magnitude()) / 2.0, np.sqrt(variance)
    moved = angles > MIN_ROTATION_SDS * sd
    different = np.abs(A.magnitude() - B.magnitude())
    agrees = different < np.maximum(ANGLE_SDS * sd, RELATIVE_ANGLE_TOLERANCE * angles)
    agreeing = float(agrees[moved].mean()) if moved.sum() >= MIN_PAIRS else np.nan
    # Of k frames k - 1 motions are independent.
    return _Pair(found.rotation, found.information * (len(rows_a) - 1) / len(pairs), found.certified, agreeing)


def _select_cameras(
    tracks: Sequence[CameraTrack], pairs: dict[tuple[int, int], _Pair | None], min_agreeing: float
) -> tuple[list[int], dict[str, str]]:
    """Return the cameras that rotate alike, and why the others do not: those with the most contradictions leave."""
    kept, left_out = list(range(len(tracks))), dict[str, str]()
    while len(kept) > 1:
        known = [(a, b, p.agreeing) for (a, b), p in pairs.items() if p is not None and a in kept and b in kept]
        bad = [(a, b) for a, b, share in known if share < min_agreeing]
        linked = {c for a, b, share in known if share >= min_agreeing for c in (a, b)}
        lonely = [c for c in kept if c not in linked]
        if not bad and not lonely:  # each has a partner, but there may be several groups
            group = _find_largest_group(kept, [(a, b) for a, b, _ in known])
            lonely = [c for c in kept if c not in group]
        if not bad and not lonely:
            break
        total = {c: sum(c in pair for pair in bad) + len(tracks) * (c in lonely) for c in kept}
        shares = {c: np.nanmean([*(share for a, b, share in known if c in (a, b)), 0.0]) for c in kept}
        worst = max(kept, key=lambda c: (total[c], -shares[c]))
        kept.remove(worst)
        disagreeing = [c for c in kept if (min(c, worst), max(c, worst)) in bad]
        left_out[tracks[worst].name] = (
            f"it rotates differently from {_list_names(tracks, disagreeing)}"
            if disagreeing
            else "too few common frames in which the object rotates"
        )
    return kept, left_out


def _find_largest_group(cameras: Sequence[int], links: Sequence[tuple[int, int]]) -> set[int]:
    """Return the largest set of cameras that links connect, the first of equal ones."""
    groups = [{c} for c in cameras]
    for a, b in links:
        joined = {c for group in groups if a in group or b in group for c in group}
        groups = [group for group in groups if not group & joined] + [joined]
    return max(groups, key=lambda group: (len(group), -min(group)))


def _measure_spread(track: CameraTrack) -> float:
    """Return the spread of the rotation axes of a track's pairs of frames, without that of the noise."""
    vectors, variance = _relative_rotations(track, np.arange(len(track.frames)), select_pairs(len(track.frames)))
    rotation_vectors = vectors.as_rotvec()
    values = np.linalg.svd(rotation_vectors, compute_uv=False) ** 2
    return float(np.sqrt(max(values[1] - variance.sum(), 0.0) / values[0]))


def _count_rotations(track: CameraTrack) -> int:
    """Count a track's pairs of frames whose rotation is clear."""
    rotations, variance = _relative_rotations(track, np.arange(len(track.frames)), select_pairs(len(track.frames)))
    return int((rotations.magnitude() > MIN_ROTATION_SDS * np.sqrt(variance)).sum())


def find_time_offset(a: CameraTrack, b: CameraTrack) -> tuple[float, float]:
    """Find the shift of time at which two cameras see the same rotation angles.

    Returns:
        frames by which b is later than a, 0 if it is in step; and the residual there relative to that without shift.
    """
    residuals = np.full(2 * MAX_SHIFT + 1, np.inf)
    for k, shift in enumerate(range(-MAX_SHIFT, MAX_SHIFT + 1)):
        _, rows_a, rows_b = np.intersect1d(a.frames, b.frames - shift, return_indices=True)
        if len(rows_a) >= MIN_COMMON_FRAMES:
            pairs = select_pairs(len(rows_a))
            (A, variance), (B, other) = (_relative_rotations(t, r, pairs) for t, r in ((a, rows_a), (b, rows_b)))
            residuals[k] = np.median(np.abs(A.magnitude() - B.magnitude()) / np.sqrt(variance + other))
    best, at_zero = int(np.argmin(residuals)), residuals[MAX_SHIFT]
    around = residuals[max(best - 1, 0) : best + 2] ** 2
    # Neither a minimum of the noise, nor one beyond the search range.
    if best == MAX_SHIFT or not ANGLE_SDS < at_zero < np.inf or len(around) < 3 or not np.isfinite(around).all():
        return 0.0, 1.0
    before, at, after = around
    offset = best - MAX_SHIFT + 0.5 * (before - after) / (before - 2.0 * at + after)
    return float(offset), float(residuals[best] / at_zero)


def _average_rotations(
    pairs: dict[tuple[int, int], _Pair | None],
    cameras: Sequence[int],
    min_agreeing: float,
) -> tuple[FloatArray, FloatArray, float, int]:
    """Average the rotations of all pairs of cameras: the leading eigenvectors of their block matrix.

    Returns:
        (C, 3, 3) rotations from the first camera; (C,) their standard deviations about the worst axis; the largest
        closure of a pair, radians; and the camera that causes it.
    """
    n = len(cameras)
    blocks, degree = np.zeros((n, 3, n, 3)), np.zeros(n)
    edges = []
    for p, q in combinations(range(n), 2):
        pair = pairs[cameras[p], cameras[q]]
        if pair is None or not pair.agreeing >= min_agreeing:
            continue
        weight = float(np.linalg.eigvalsh(pair.information)[0])
        blocks[q, :, p] = weight * pair.rotation
        blocks[p, :, q] = weight * pair.rotation.T
        degree[[p, q]] += weight
        edges.append((p, q, pair, weight))
    root = 1.0 / np.sqrt(degree)
    blocks *= root[:, None, None, None] * root[:, None]
    vectors = np.linalg.eigh(blocks.reshape(3 * n, 3 * n))[1][:, -3:].reshape(n, 3, 3)
    u, _, v = np.linalg.svd(vectors @ vectors[0].T)
    rotations = u @ v
    rotations *= np.sign(np.linalg.det(rotations))[:, None, None]
    rotations = rotations @ rotations[0].T
    closures = [
        float(Rotation.from_matrix(rotations[q] @ rotations[p].T @ pair.rotation.T).magnitude())
        for p, q, pair, _ in edges
    ]
    worst = int(np.argmax(closures))
    # Of the pair that contradicts the others, the camera of which less is known.
    suspect = min(edges[worst][:2], key=lambda k: degree[k])
    # The graph's Laplacian, as if all axes were as uncertain as the worst.
    laplacian = np.zeros((n, n))
    for p, q, _, weight in edges:
        laplacian[[p, q], [p, q]] += weight
        laplacian[[p, q], [q, p]] -= weight
    sds = np.concatenate([[0.0], np.sqrt(np.diag(np.linalg.inv(laplacian[1:, 1:])))])
    return rotations, sds, closures[worst], suspect


def _average_body_rotations(
    tracks: Sequence[CameraTrack], rotations: FloatArray
) -> tuple[IntArray, FloatArray, Rotation]:
    """Average the object's rotations over cameras.

    Returns:
        (N,) frames; (N, 3, 3) rotations of T_i; C rotations of O_c.
    """
    frames = np.unique(np.concatenate([track.frames for track in tracks]))
    rows = [np.searchsorted(frames, track.frames) for track in tracks]
    measured = [
        np.einsum("ji,njk->nik", X, track.camera_from_object.rotation.as_matrix())
        for X, track in zip(rotations, tracks, strict=True)
    ]
    axes = np.zeros((len(tracks), 3, 3))
    axes[0] = np.eye(3)
    total = np.zeros((len(frames), 3, 3))
    waiting, placed = list(range(1, len(tracks))), [0]
    np.add.at(total, rows[0], _weigh(measured[0], tracks[0]))
    while waiting:
        common = [int((np.linalg.norm(total[rows[c]], axis=(1, 2)) > 0).sum()) for c in waiting]
        c = waiting.pop(int(np.argmax(common)))
        known = np.linalg.norm(total[rows[c]], axis=(1, 2)) > 0
        body = _project_to_rotations(total[rows[c]][known])
        axes[c] = _mean_rotation(body.transpose(0, 2, 1) @ measured[c][known], tracks[c].variance[known])
        np.add.at(total, rows[c], _weigh(measured[c] @ axes[c].T, tracks[c]))
        placed.append(c)
    return frames, _project_to_rotations(total), Rotation.from_matrix(axes)


def _weigh(rotations: FloatArray, track: CameraTrack) -> FloatArray:
    """Return rotations (n, 3, 3) times their information; the first frame, the definition, has that of the others."""
    variance = np.maximum(track.variance, np.median(track.variance))
    return np.asarray(rotations / variance[:, None, None])


def _project_to_rotations(matrices: FloatArray) -> FloatArray:
    """Return the rotations (n, 3, 3) nearest to matrices."""
    u, _, v = np.linalg.svd(matrices)
    u[..., -1] *= np.sign(np.linalg.det(u @ v))[..., None]
    return np.asarray(u @ v)


def _mean_rotation(rotations: FloatArray, variance: FloatArray) -> FloatArray:
    """Return the robust mean (3, 3) of rotations (n, 3, 3) with variances (n,)."""
    base = 1.0 / np.maximum(variance, np.median(variance))
    weights = np.ones(len(rotations))
    for _ in range(10):
        mean = _project_to_rotations(np.einsum("n,nij->ij", base * weights, rotations)[None])[0]
        squares = ((rotations - mean) ** 2).sum(axis=(1, 2)) / 2.0 * base
        factor = max(float(np.median(squares)) / MEDIAN_SQUARE, 1e-300)
        weights = biquartic_weights(squares / (factor * CUTOFF_SIGMAS**2))
    return np.asarray(mean)


# --- places -----------------------------------------------------------------------------------------------------------


def _solve_places(
    tracks: Sequence[CameraTrack], rotations: FloatArray, frames: IntArray, body: FloatArray
) -> tuple[HandEyeTranslations | None, FloatArray]:
    """Solve places and scales; also with each track depth-reversed.

    A reversed track has the same rotation angles, about axes turned by half a turn about the optical axis. Only its
    positions contradict the others.

    Returns:
        the solution, None if undetermined; and (C,) its residual relative to that with each track reversed, 0 if only
        the solution is determined.
    """
    n = len(tracks)
    positions, covariances = np.full((n, len(frames), 3), np.nan), np.tile(np.eye(3), (n, len(frames), 1, 1))
    for c, track in enumerate(tracks):
        rows = np.searchsorted(frames, track.frames)
        positions[c, rows] = track.camera_from_object.translation
        covariances[c, rows] = _position_covariance(track)

    def solve(X: FloatArray, R: FloatArray) -> HandEyeTranslations | None:
        try:
            found = solve_hand_eye_translations(X, R, positions, covariances)
        except ValueError:
            return None
        return found if _scale_sds(found).max() < MAX_SCALE_SD else None

    placed, ratios = solve(rotations, body), np.zeros(n)
    for c in range(n):
        if c == 0:
            turned, turned_body = (
                np.concatenate([rotations[:1], rotations[1:] @ HALF_TURN]),
                HALF_TURN @ body @ HALF_TURN,
            )
        else:
            turned, turned_body = rotations.copy(), body
            turned[c] = HALF_TURN @ rotations[c]
        other = solve(turned, turned_body)
        if other is not None:
            ratios[c] = np.inf if placed is None else np.sqrt(placed.variance_factor / other.variance_factor)
    return placed, ratios


def _scale_sds(placed: HandEyeTranslations) -> FloatArray:
    """Return (C,) relative standard deviations of the scales."""
    sds = np.sqrt(np.diag(placed.covariance)[1 - len(placed.scales) :])
    return np.concatenate([[0.0], sds / placed.scales[1:]])


def _position_covariance(track: CameraTrack) -> FloatArray:
    """Return (n, 3, 3) covariance of the positions, up to what is common to all frames.

    A rotation's standard deviation times the radius is a point's, and that of the object's center across the line of
    sight. Along it, the distance is measured by the size: distance over radius times less precisely.
    """
    positions = track.camera_from_object.translation
    distances = np.linalg.norm(positions, axis=1)
    depth = positions[:, :, None] * positions[:, None, :] / distances[:, None, None] ** 2
    variance = np.maximum(track.variance, np.median(track.variance)) * track.radius**2
    excess = np.maximum(distances / track.radius, 1.0) ** 2 - 1.0
    return np.asarray(variance[:, None, None] * (np.eye(3) + excess[:, None, None] * depth))


def _average_positions(
    tracks: Sequence[CameraTrack],
    X: RigidTransform,
    O: RigidTransform,
    placed: HandEyeTranslations,
    frames: IntArray,
    body: FloatArray,
) -> RigidTransform:
    """Return the object's poses (N) in the reference's axes: positions averaged over cameras."""
    total, information = np.zeros((len(frames), 3)), np.zeros((len(frames), 3, 3))
    for c, track in enumerate(tracks):
        rows = np.searchsorted(frames, track.frames)
        R = X[c].rotation.as_matrix()
        inner = np.linalg.inv(_position_covariance(track)) / placed.scales[c] ** 2
        weights = np.maximum(placed.weights[c, rows], 1e-6)[:, None, None]
        inner = weights * (R.T @ inner @ R)
        position = X[c].inv().apply(placed.scales[c] * track.camera_from_object.translation)
        position = position - body[rows] @ O[c].translation
        information[rows] += inner
        total[rows] += np.einsum("nij,nj->ni", inner, position)
    positions = np.linalg.solve(information, total[..., None])[..., 0]
    return RigidTransform.from_components(positions, Rotation.from_matrix(body))
