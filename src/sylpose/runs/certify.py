"""Certificate of a recording: the accuracy of its result, measured with the recording itself.

The recording is tracked again with parts of the cameras and backwards. For independent cameras of equal information, the
result of m of C cameras differs from that of all by (C / m - 1) of the latter's variance: the delete-a-group jackknife
centered at the complete result (J. Shao and D. Tu, "The Jackknife and Bootstrap", 1995). Errors within a run are
correlated over time, which leaves few effectively independent frames: each quantity has its degrees of freedom.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.special import chdtri

from sylpose.display import format_length
from sylpose.frames import Box
from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.robust_loss import chi_squared_bound
from sylpose.io.capture import Session
from sylpose.io.capture.session import ReversedSession
from sylpose.results import FramePose, Trajectory
from sylpose.rig import Camera, Rig
from sylpose.runs.options import RunOptions
from sylpose.runs.run import track_session
from sylpose.status import FrameStatus, Observability
from sylpose.sync.offsets import apply_offsets, find_offsets
from sylpose.tracking.context import TrackedFrame

# A result that has poses in a smaller share of the frames is a failure, whatever its poses are (choice: those left are
# the easy ones).
MIN_COVERAGE = 0.5
# Fewest compared frames (derived: one besides the reference has no correlation over time).
MIN_FRAMES = 3
# Probability with which the true values lie within the stated intervals and bounds (choice: the usual one).
CONFIDENCE = 0.95
# Share of the absolute deviations below the percentile that ASTM E3064 reports: three standard deviations (derived).
BAR_PERCENTILE = 99.7
# Points on the sphere whose image is the object's box in the last frame (choice: its outline within some percent).
SPHERE_POINTS = 256
# Share of the parts' mean square from which on one of them is named: it may have followed something else (choice).
DOMINANT_SHARE = 0.9
# Largest number of splits of the cameras (choice: as many as are independent with four cameras).
MAX_SPLITS = 3
ROTATION, POSITION = slice(0, 3), slice(3, 6)


@dataclass(frozen=True, eq=False)
class Differences:
    """Differences of the object's motion since a common frame, between two results of n frames.

    Attributes:
        reference: number of the common frame, the first one with a pose in both.
        index: (n,) frame numbers.
        times: (n,) seconds.
        rotation: (n, 3) rotation vectors w, R_a = exp(w) R_b, radians, world axes.
        position: (n, 3) differences of a common point on the object, the center of the complete result; NaN if a result
            has no scale.
        covariance_a, covariance_b: (n, 6, 6) stated covariances of the motions since the common frame, of (w, d).
    """

    reference: int
    index: IntArray
    times: FloatArray
    rotation: FloatArray
    position: FloatArray
    covariance_a: FloatArray
    covariance_b: FloatArray


@dataclass(frozen=True)
class Agreement:
    """Agreement of two results in rotation or position.

    Attributes:
        difference: rms of the differences, radians or length units.
        error: rms error of the complete result that they imply.
        largest: the largest of these errors in any frame.
        factor: factor on the stated standard deviations by which the errors agree with them; NaN if none is finite.
        in_bounds: share of the differences inside their stated 95 % bounds.
        n_effective: number of effectively independent frames.
        freedom: degrees of freedom of the errors' variance: at most three per independent frame.
    """

    difference: float
    error: float
    largest: float
    factor: float
    in_bounds: float
    n_effective: float
    freedom: float


@dataclass(frozen=True, eq=False)
class ConsistencyTest:
    """Comparison of two results of one object.

    Attributes:
        kind: "part" (some cameras against all), "split" (some cameras against others) or "direction" (forwards against
            backwards).
        a, b: names of the results; a part is a, and the complete result b.
        coverage: share of the frames of the complete result that are compared.
        differences: None if the test failed.
        rotation, position: None if the test failed, or cannot determine the quantity.
        reason: one sentence on what failed or is not determined; "" for a complete test.
    """

    kind: str
    a: str
    b: str
    coverage: float
    differences: Differences | None
    rotation: Agreement | None
    position: Agreement | None
    reason: str = ""


@dataclass(frozen=True)
class Estimate:
    """Accuracy in rotation or position that all tests together show.

    Attributes:
        error: rms error of the motion since the first frame, radians or length units.
        bound: its upper confidence bound, 95 %.
        largest: the largest error of any frame in any test.
        factor: by which the stated standard deviations are to be multiplied.
        factor_interval: its confidence interval, 95 %.
        freedom: degrees of freedom of the error's variance.
        n_effective: number of effectively independent frames, over all tests.
        basis: the test with the largest error: "parts" of the cameras, or "direction"; "direction only" is a lower bound.
    """

    error: float
    bound: float
    largest: float
    factor: float
    factor_interval: tuple[float, float]
    freedom: float
    n_effective: float
    basis: str

    @property
    def is_lower_bound(self) -> bool:
        """Whether no part of the cameras determines the quantity: the error may be larger by any factor."""
        return self.basis == "direction only"


@dataclass(frozen=True, eq=False)
class BarTest:
    """Constancy of the relative pose of two objects at the ends of a stiff bar, as in ASTM E3064.

    Attributes:
        a, b: names of the objects.
        index, times: (n,) of the frames with a pose of both.
        coverage: share of the recording's frames.
        length: mean distance of the objects' origins.
        length_deviations: (n,) deviations from it.
        rotation_deviations: (n,) angles from the mean relative rotation, radians.
        extent: (3,) extent of the bar's middle in the world.
        turn: largest rotation of the bar since its first frame, radians.
        length_statistics, rotation_statistics: "rms", "max" and "p99.7" of the absolute deviations.
    """

    a: str
    b: str
    index: IntArray
    times: FloatArray
    coverage: float
    length: float
    length_deviations: FloatArray
    rotation_deviations: FloatArray
    extent: FloatArray
    turn: float
    length_statistics: dict[str, float]
    rotation_statistics: dict[str, float]


@dataclass(frozen=True, eq=False)
class Certificate:
    """Accuracy of the result of one object.

    Attributes:
        name: the object.
        unit: length unit, or "".
        cameras: names of the cameras.
        n_frames, n_measured: number of frames, and of those with a measured pose.
        turn: largest rotation since the first measured frame, radians.
        path: length of the path of its center.
        stated: rms over the frames of the stated standard deviations of rotation (radians) and position.
        tests: all comparisons.
        rotation, position: the accuracy; None if no test determines it.
        remarks: sentences on tests that failed and on what is not determined.
    """

    name: str
    unit: str
    cameras: tuple[str, ...]
    n_frames: int
    n_measured: int
    turn: float
    path: float
    stated: tuple[float, float]
    tests: tuple[ConsistencyTest, ...]
    rotation: Estimate | None
    position: Estimate | None
    remarks: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class SessionCertificate:
    """Certificates of all objects of a recording, and of the bar between two of them.

    Attributes:
        objects: the objects' certificates.
        bar: None if it was not requested.
        problems: messages about files and frames that could not be read.
    """

    objects: tuple[Certificate, ...]
    bar: BarTest | None
    problems: tuple[str, ...]


def choose_splits(names: Sequence[str]) -> list[tuple[tuple[str, ...], tuple[str, ...]]]:
    """Choose the parts of the cameras that are compared with each other.

    Four cameras or more are split in halves by Walsh functions, whose differences are independent of each other if the
    cameras' errors are. Of three cameras every pair is compared, each without one camera: a single one has no scale. Two
    cameras are compared with each other; one cannot be split.
    """
    if len(names) < 3:
        return [((names[0],), (names[1],))] if len(names) == 2 else []
    if len(names) == 3:
        pairs = list(combinations(names, 2))
        return list(combinations(pairs, 2))
    sides = [[(c & mask).bit_count() % 2 for c in range(len(names))] for mask in range(1, MAX_SPLITS + 1)]
    return [
        (
            tuple(name for name, side in zip(names, split, strict=True) if not side),
            tuple(name for name, side in zip(names, split, strict=True) if side),
        )
        for split in sides
    ]


def compare_results(complete: Trajectory, a: Trajectory, b: Trajectory) -> tuple[Differences | None, float]:
    """Compare two results in the frames in which all three have a measured pose.

    Args:
        complete: the complete result, whose object center in the first common frame is the common point.
        a, b: the results, numbered as the complete one.

    Returns:
        The differences, None with fewer than three of them; and the share of the complete result's frames compared.
    """
    measured = [{f.index: f for f in result if f.is_measured} for result in (complete, a, b)]
    common = sorted(set.intersection(*map(set, measured)))
    coverage = max(len(common) - 1, 0) / max(len(measured[0]) - 1, 1)
    if len(common) < MIN_FRAMES + 1:
        return None, coverage
    center = measured[0][common[0]].position
    of_a, of_b = (compute_motions(frames, common, center) for frames in measured[1:])
    position = of_a.positions - of_b.positions
    has_scale = all(measured[i][k].observability is not Observability.NO_SCALE for i in (0, 1, 2) for k in common[1:])
    times = np.array([measured[0][k].time for k in common[1:]])
    rotation = (of_a.rotations * of_b.rotations.inv()).as_rotvec()
    if not has_scale:
        position = np.full_like(position, np.nan)
    compared = np.array(common[1:]), times, rotation, position, of_a.covariance, of_b.covariance
    return Differences(common[0], *compared), coverage


@dataclass(frozen=True, eq=False)
class Motions:
    """Motions since a reference frame: rotations, positions (n, 3) of a point on the object, covariances (n, 6, 6)."""

    rotations: Rotation
    positions: FloatArray
    covariance: FloatArray


def compute_motions(frames: Mapping[int, FramePose], index: Sequence[int], center: FloatArray) -> Motions:
    """Compute the motions since the first frame of an index, of a point on the object that is at `center` there."""
    poses = RigidTransform.concatenate([pose for k in index if (pose := frames[k].world_from_object) is not None])
    motions = poses * poses[0].inv()
    positions = np.asarray(motions.apply(center))
    # A rotation error also translates a point that is not the object's origin: d + w x r.
    jacobian = np.tile(np.eye(6), (len(index), 1, 1))
    for axis, (x, y, z) in enumerate(np.eye(3)):
        lever = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
        jacobian[:, 3:, :3] += (positions - poses.translation)[:, axis, None, None] * lever
    covariance = jacobian @ np.array([frames[k].covariance for k in index]) @ jacobian.transpose(0, 2, 1)
    # The covariance of the first pose is zero where it defines the object's frame.
    return Motions(motions[1:].rotation, positions[1:], covariance[1:] + covariance[0])


def assess_agreement(
    differences: FloatArray, covariance: FloatArray, error_ratio: float, variance_ratio: float
) -> Agreement:
    """Assess the differences of two results in rotation or position.

    Args:
        differences: (n, 3) at successive frames.
        covariance: (n, 3, 3) stated covariances to compare with.
        error_ratio: rms error of the complete result, relative to the rms difference.
        variance_ratio: expected variance of the differences, relative to the stated covariances.
    """
    lengths = np.linalg.norm(differences, axis=1)
    n_effective, freedom = count_effective(differences)
    rms = float(np.sqrt(np.mean(lengths**2)))
    largest = error_ratio * float(lengths.max())
    normalized = normalize_differences(differences, variance_ratio * covariance)
    squares = np.sum(normalized**2, axis=1)
    factor, in_bounds = np.nan, np.nan
    if len(squares):
        n_effective, freedom = count_effective(normalized)
        factor = float(np.sqrt(squares.mean() / 3))
        in_bounds = float(np.mean(squares <= chi_squared_bound(3, 1 - CONFIDENCE)))
    return Agreement(rms, error_ratio * rms, largest, factor, in_bounds, n_effective, freedom)


def normalize_differences(differences: FloatArray, covariance: FloatArray) -> FloatArray:
    """Multiply differences (n, 3) by the symmetric inverse roots of their covariances (n, 3, 3).

    Frames whose covariance is not finite and positive are left out. The symmetric root is equivariant to rotations of the
    world, and so is the correlation over time.
    """
    is_finite = np.asarray(np.isfinite(covariance).all(axis=(1, 2)) & np.isfinite(differences).all(axis=1))
    values, vectors = np.linalg.eigh(np.where(is_finite[:, None, None], covariance, np.eye(3)))
    is_usable = is_finite & (values[:, 0] > 0)
    projected = np.einsum("nij,ni->nj", vectors[is_usable], differences[is_usable]) / np.sqrt(values[is_usable])
    return np.asarray(np.einsum("nij,nj->ni", vectors[is_usable], projected))


def count_effective(series: FloatArray) -> tuple[float, float]:
    """Count the effectively independent samples of a series (n, 3) of expectation zero.

    The variance of a mean square is that of n / (1 + 2 sum of squared autocorrelations) independent samples (M. S.
    Bartlett, 1946); the sum ends at the first correlation that is not positive (C. Geyer, 1992). The autocorrelation is
    about zero, not about the mean: a constant difference is one sample.

    Returns:
        the number of independent frames, at least 1 and at most n; and the degrees of freedom, which are 1 to 3 for each,
        as the covariance of the components is concentrated in one direction or not (F. E. Satterthwaite, 1946).
    """
    n, total = len(series), float(np.sum(series**2))
    if not total > 0:
        return float(n), 3.0 * n
    correlations = 0.0
    for lag in range(1, n):
        correlation = float(np.sum(series[lag:] * series[:-lag])) / total
        if correlation <= 0:
            break
        correlations += correlation**2
    second_moments = series.T @ series
    components = total**2 / float(np.sum(second_moments**2))
    n_effective = max(n / (1 + 2 * correlations), 1.0)
    return n_effective, n_effective * components


def pool_agreements(agreements: Sequence[Agreement], rank_ratio: float, basis: str) -> Estimate:
    """Pool the agreements of several tests, by their mean squares.

    Args:
        agreements: of the tests, at least one.
        rank_ratio: number of linearly independent tests, relative to the number of tests.
        basis: see `Estimate`.
    """
    squares = np.array([agreement.error**2 for agreement in agreements])
    freedoms = np.array([agreement.freedom for agreement in agreements])
    largest = max(agreement.largest for agreement in agreements)
    n_effective = rank_ratio * sum(agreement.n_effective for agreement in agreements)
    freedom = max(rank_ratio * _pool_freedom(squares, freedoms), 1.0)
    error, tail = float(np.sqrt(squares.mean())), (1 - CONFIDENCE) / 2
    bound = error * float(np.sqrt(freedom / chdtri(freedom, CONFIDENCE)))
    factors = np.array([agreement.factor for agreement in agreements])
    factor_freedom = max(rank_ratio * _pool_freedom(factors**2, freedoms), 1.0)
    factor = float(np.sqrt(np.mean(factors**2)))
    low, high = (factor * float(np.sqrt(factor_freedom / chdtri(factor_freedom, p))) for p in (tail, 1 - tail))
    return Estimate(error, bound, largest, factor, (low, high), freedom, n_effective, basis)


def _pool_freedom(variances: FloatArray, freedoms: FloatArray) -> float:
    """Return the degrees of freedom of a mean of variances (Satterthwaite)."""
    total = float(variances.sum())
    return total**2 / float(np.sum(variances**2 / freedoms)) if total > 0 else float(freedoms.sum())


def compare_pair(
    kind: str, complete: Trajectory, a: tuple[str, Trajectory], b: tuple[str, Trajectory], ratios: tuple[float, float]
) -> ConsistencyTest:
    """Compare two results.

    Args:
        kind: see `ConsistencyTest`.
        complete: the complete result.
        a, b: names and results.
        ratios: error and variance ratio, see `assess_agreement`.
    """
    differences, coverage = compare_results(complete, a[1], b[1])
    if differences is None or coverage < MIN_COVERAGE:
        return ConsistencyTest(kind, a[0], b[0], coverage, None, None, None, _describe_loss(complete, a, b))
    # A part is tested against what the complete result states, all others against both results.
    stated = differences.covariance_b + (0.0 if kind == "part" else differences.covariance_a)
    rotation = assess_agreement(differences.rotation, stated[:, ROTATION, ROTATION], *ratios)
    if np.isnan(differences.position).any():
        reason = f"{a[0]} against {b[0]}: position is not compared, since a single camera has no scale."
        return ConsistencyTest(kind, a[0], b[0], coverage, differences, rotation, None, reason)
    position = assess_agreement(differences.position, stated[:, POSITION, POSITION], *ratios)
    reason = "" if coverage == 1 else _describe_loss(complete, a, b)
    return ConsistencyTest(kind, a[0], b[0], coverage, differences, rotation, position, reason)


def _describe_loss(complete: Trajectory, *results: tuple[str, Trajectory]) -> str:
    total = int(complete.measured_mask.sum())
    measured = {frame.index for frame in complete if frame.is_measured}
    counts = {name: len(measured & {f.index for f in result if f.is_measured}) for name, result in results}
    parts = [f"{name} found the object in {count}" for name, count in counts.items() if count < total]
    return f"{' and '.join(parts) or 'the poses'} of {total} frames."


def part_ratios(n: int, m: int) -> tuple[float, float]:
    """Return error and variance ratio of m of n cameras against all.

    With independent cameras of equal information, the difference has n / m - 1 of the complete result's variance.
    """
    variance = n / m - 1
    return variance**-0.5, variance


def split_ratios(n: int, a: Sequence[str], b: Sequence[str]) -> tuple[float, float]:
    """Return error and variance ratio of two parts of n cameras against each other; they may share cameras."""
    separate = 1 / len(a) + 1 / len(b)
    variance = separate - 2 * len({*a} & {*b}) / (len(a) * len(b))
    return (n * variance) ** -0.5, variance / separate


def certify_results(
    name: str,
    complete: Trajectory,
    parts: Mapping[tuple[str, ...], Trajectory | str],
    backwards: Trajectory | str,
) -> Certificate:
    """Certify a result by the results of parts of the cameras, and of the reversed recording.

    Args:
        name: the object's name.
        complete: the result of all cameras.
        parts: results by their cameras, as `choose_splits` chooses them; or why there is none.
        backwards: the result of the reversed recording, with the frame numbers of the recording; or why there is none.
    """
    cameras, tests, remarks = complete.camera_names, list[ConsistencyTest](), list[str]()
    n, everything = len(cameras), ("all cameras", complete)
    for part, result in parts.items():
        if isinstance(result, str):
            remarks.append(f"{_join(part)}: {result}")
            tests.append(ConsistencyTest("part", _join(part), everything[0], 0.0, None, None, None, result))
            continue
        test = compare_pair("part", complete, (_join(part), result), everything, part_ratios(n, len(part)))
        tests.append(test)
        remarks += [test.reason] if test.reason else []
    for a, b in choose_splits(cameras):
        of_a, of_b = parts.get(a, "missing"), parts.get(b, "missing")
        if not isinstance(of_a, str) and not isinstance(of_b, str):
            tests.append(compare_pair("split", complete, (_join(a), of_a), (_join(b), of_b), split_ratios(n, a, b)))
    if isinstance(backwards, str):
        remarks.append(f"backwards: {backwards}")
        tests.append(ConsistencyTest("direction", "backwards", "forwards", 0.0, None, None, None, backwards))
    else:
        # Two runs of equal and independent errors; they share images and calibration, so the errors are larger.
        test = compare_pair("direction", complete, ("backwards", backwards), ("forwards", complete), (0.5**0.5, 1.0))
        tests.append(test)
        remarks += [test.reason] if test.reason else []
    rotation, position = (_estimate(tests, quantity, n) for quantity in ("rotation", "position"))
    remarks += _describe_dominant_parts(tests, complete.unit)
    return _summarize(name, complete, tests, (rotation, position), remarks)


def _join(cameras: Iterable[str]) -> str:
    return ", ".join(cameras)


def _estimate(tests: Sequence[ConsistencyTest], quantity: str, cameras: int) -> Estimate | None:
    """Return the larger of the estimates from the parts and from both directions; the factor is that of the parts."""
    by_kind: dict[str, list[Agreement]] = {"part": [], "split": [], "direction": []}
    for test in tests:
        agreement: Agreement | None = getattr(test, quantity)
        if agreement is not None:
            by_kind[test.kind].append(agreement)
    estimates = list[Estimate]()
    if parts := by_kind["part"]:
        # Parts of C cameras have at most C - 1 independent differences from all.
        estimates.append(pool_agreements(parts, min(1.0, (cameras - 1) / len(parts)), "parts"))
    if direction := by_kind["direction"]:
        estimates.append(pool_agreements(direction, 1.0, "direction"))
    if not estimates:
        return None
    largest = max(estimates, key=lambda estimate: estimate.error)
    if not parts:
        return replace(largest, factor=np.nan, factor_interval=(np.nan, np.nan), basis="direction only")
    return replace(largest, factor=estimates[0].factor, factor_interval=estimates[0].factor_interval)


def _describe_dominant_parts(tests: Sequence[ConsistencyTest], unit: str) -> list[str]:
    """Describe, for each quantity, a part of the cameras that alone makes most of the certified error."""
    sentences = []
    for quantity in ("rotation", "position"):
        errors = {
            test.a: a.error for test in tests if test.kind == "part" and (a := getattr(test, quantity)) is not None
        }
        squares = np.square([*errors.values()])
        if len(errors) < 3 or squares.max() <= DOMINANT_SHARE * squares.sum():
            continue
        worst = max(errors, key=errors.__getitem__)
        others = float((squares.sum() - squares.max()) / (len(errors) - 1)) ** 0.5
        texts = [
            f"{np.degrees(error):.2g}°" if quantity == "rotation" else format_length(error, unit)
            for error in (errors[worst], others)
        ]
        sentences.append(
            f"{worst} alone makes most of the error of {quantity}: {texts[0]}, the other parts {texts[1]}. It may have "
            "followed something else, or its cameras are wrong."
        )
    return sentences


def _summarize(
    name: str,
    complete: Trajectory,
    tests: Sequence[ConsistencyTest],
    estimates: tuple[Estimate | None, Estimate | None],
    remarks: Sequence[str],
) -> Certificate:
    measured = [frame for frame in complete if frame.is_measured]
    positions = np.array([frame.position for frame in measured]).reshape(-1, 3)
    turns = complete.rotation_angles[complete.measured_mask]
    covariance = np.array([f.covariance for f in measured if f.status is not FrameStatus.FIRST]).reshape(-1, 6, 6)
    sizes = [np.sqrt(np.trace(covariance[:, s, s], axis1=1, axis2=2)) for s in (ROTATION, POSITION)]
    stated = [float(np.sqrt(np.mean(size**2))) if len(size) else np.nan for size in sizes]
    return Certificate(
        name,
        complete.unit,
        complete.camera_names,
        len(complete),
        len(measured),
        float(turns.max(initial=0.0)),
        float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()),
        (stated[0], stated[1]),
        tuple(tests),
        *estimates,
        tuple(remarks),
    )


def measure_bar(names: tuple[str, str], a: Trajectory, b: Trajectory) -> BarTest:
    """Compute the deviations of the relative pose of two objects on a stiff bar from its mean.

    Raises:
        ValueError: fewer than three frames in which both have a measured pose.
    """
    poses = [{f.index: f.world_from_object for f in result if f.is_measured} for result in (a, b)]
    common = sorted(set(poses[0]) & set(poses[1]))
    if len(common) < MIN_FRAMES:
        raise ValueError(
            f"bar: {names[0]} and {names[1]} have poses in {len(common)} common frames; {MIN_FRAMES} are needed"
        )
    of_a, of_b = (RigidTransform.concatenate([p for k in common if (p := own[k]) is not None]) for own in poses)
    lengths = np.linalg.norm(of_b.translation - of_a.translation, axis=1)
    relative = of_a.rotation.inv() * of_b.rotation
    deviations, turns = lengths - lengths.mean(), (relative * relative.mean().inv()).magnitude()
    middle = (of_a.translation + of_b.translation) / 2
    turn = (of_a.rotation * of_a[0].rotation.inv()).magnitude()
    times = {frame.index: frame.time for frame in a}
    return BarTest(
        *names,
        np.array(common),
        np.array([times[k] for k in common]),
        len(common) / len(a),
        float(lengths.mean()),
        deviations,
        np.asarray(turns),
        np.ptp(middle, axis=0),
        float(np.max(turn)),
        _bar_statistics(deviations),
        _bar_statistics(np.asarray(turns)),
    )


def _bar_statistics(deviations: FloatArray) -> dict[str, float]:
    sizes = np.abs(deviations)
    rms, percentile = np.sqrt(np.mean(sizes**2)), np.percentile(sizes, BAR_PERCENTILE)
    return {"rms": float(rms), "max": float(sizes.max()), f"p{BAR_PERCENTILE:g}": float(percentile)}


# Called with the name of a run, the number of frames tracked in all runs, and the expected total.
CertifyProgress = Callable[[str, int, int], None]


def certify_session(
    session: Session,
    *,
    start: int = 0,
    stop: int | None = None,
    seed: int = 0,
    candidate: int | None = None,
    bar: tuple[str, str] | None = None,
    progress: CertifyProgress | None = None,
    on_result: Callable[[str, Trajectory], None] | None = None,
) -> SessionCertificate:
    """Track a recording with all cameras, with parts of them and backwards, and certify the results.

    Nothing is written but temporary files, which are removed.

    Args:
        session: session from `open_session`; each of several objects is certified.
        start, stop, seed, candidate: as in `track_session`. Parts of the cameras follow the selected body from boxes about
            its first pose: they may see another one best.
        bar: names of two objects at the ends of a stiff bar, whose relative pose must be constant.
        progress: called after each tracked frame.
        on_result: called with each object's name and the result of all cameras.

    Raises:
        ValueError: a bar of other objects than two of the session's; as `track_session` with all cameras.
        OSError: a file cannot be read; the message names it.
    """
    check_bar(session, bar)
    offsets = find_offsets(session)
    session = apply_offsets(session, offsets)
    # The offsets are applied; those of the folder would be applied a second time.
    options = RunOptions(offsets={}, start=start, stop=stop, seed=seed, candidate=candidate, overlay=False)
    frames = len(range(start, min(session.n_frames, session.n_frames if stop is None else stop)))
    parts = sorted({part for split in choose_splits(session.rig.names) for part in split})
    runs = _Runs(progress or _ignore, len(session.objects) * (len(parts) + 2) * frames)
    certificates, complete = list[Certificate](), dict[str, Trajectory]()
    for name in session.objects:
        selected = session.select_object(name)
        label = f"{name}, " if len(session.objects) > 1 else ""
        complete[name] = runs.track(f"{label}all cameras", selected, options)
        radius = runs.radius
        (on_result or _ignore)(name, complete[name])
        measured = [frame for frame in complete[name] if frame.is_measured]
        of_parts = dict[tuple[str, ...], Trajectory | str]()
        backwards: Trajectory | str = "the complete result has too few poses."
        if len(measured) > MIN_FRAMES:
            again = options
            if candidate is not None:
                again = replace(options, candidate=None, start=measured[0].index)
                selected = selected.with_boxes({name: bound_sphere(session.rig, measured[0].position, radius)})
            of_parts = {part: runs.track_part(f"{label}{_join(part)}", selected, again, part) for part in parts}
            backwards = runs.track_backwards(f"{label}backwards", selected, again, measured[-1], radius)
        certificates.append(certify_results(name, complete[name], of_parts, backwards))
    of_bar = None if bar is None else measure_bar(bar, complete[bar[0]], complete[bar[1]])
    return SessionCertificate(tuple(certificates), of_bar, tuple(dict.fromkeys(runs.problems)))


def check_bar(session: Session, bar: tuple[str, str] | None) -> None:
    """Check that a bar is between two different objects of a session.

    Raises:
        ValueError: it is not; the message lists the objects.
    """
    if bar is not None and (bar[0] == bar[1] or not {*bar} <= {*session.objects}):
        raise ValueError(
            f"bar: two different objects of {session.path} are expected ({', '.join(session.objects)}), "
            f"got {bar[0]} and {bar[1]}"
        )


def _ignore(*_: object) -> None:
    pass


class _Runs:
    """Runs of the tracker for a certificate.

    Args:
        progress: called after each tracked frame.
        total: expected number of frames of all runs.

    Attributes:
        radius: of the object, in the last measured frame of the last run.
        problems: messages about files and frames that could not be read, of the runs with all cameras.
    """

    def __init__(self, progress: CertifyProgress, total: int) -> None:
        self._progress, self._total, self._done = progress, total, 0
        self.radius, self.problems = 0.0, list[str]()

    def track(self, label: str, session: Session, options: RunOptions) -> Trajectory:
        """Track the only object of a session, as `sylpose track` does.

        Raises:
            ValueError, OSError: as `track_session`.
        """

        def count(_: str, tracked: TrackedFrame) -> None:
            self._done += 1
            if tracked.pose.is_measured:
                self.radius = tracked.radius
            self._progress(label, self._done, self._total)

        with TemporaryDirectory(prefix="sylpose-certify-") as folder:
            run = track_session(session, Path(folder) / "run", options, on_frame=count)
        self.problems += run.problems
        return run.trajectory

    def track_part(
        self, label: str, session: Session, options: RunOptions, cameras: tuple[str, ...]
    ) -> Trajectory | str:
        """Track with some of the cameras; return why that is not possible."""
        part = session.select_cameras(cameras)
        if session.boxes and not part.boxes:
            return "no box of the object in these cameras."
        try:
            return self.track(label, part, options)
        except np.linalg.LinAlgError:  # a bug
            raise
        except ValueError as error:  # boxes whose rays do not meet, a camera without frames
            return f"{error}."

    def track_backwards(
        self, label: str, session: Session, options: RunOptions, last: FramePose, radius: float
    ) -> Trajectory | str:
        """Track backwards from the last measured frame, which has boxes if the first one has; return why not."""
        end, turned = session.n_frames - 1, ReversedSession.from_session(session)
        first = end - last.index
        if session.boxes:
            turned = turned.with_boxes({session.objects[0]: bound_sphere(session.rig, last.position, radius)})
        try:
            result = self.track(label, turned, replace(options, start=first, stop=end + 1 - options.start))
        except np.linalg.LinAlgError:  # a bug
            raise
        except ValueError as error:
            return f"{error}."
        times = session.timeline.times
        frames = [replace(f, index=end - f.index, time=float(times[end - f.index])) for f in result]
        return Trajectory(frames[::-1], result.camera_names, result.unit)


def bound_sphere(rig: Rig, center: FloatArray, radius: float) -> dict[str, Box]:
    """Return the boxes about the image of a sphere, by camera; cameras that do not see it are missing."""
    k = np.arange(SPHERE_POINTS) + 0.5
    z, angle = 1 - 2 * k / SPHERE_POINTS, np.pi * (1 + 5**0.5) * k
    directions = np.column_stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z])
    boxes = {camera.name: _bound_pixels(camera, camera.project(center + radius * directions)) for camera in rig}
    return {name: box for name, box in boxes.items() if box is not None}


def _bound_pixels(camera: Camera, pixels: FloatArray) -> Box | None:
    if not np.isfinite(pixels).all():
        return None
    low, high = np.maximum(pixels.min(axis=0), 0.0), np.minimum(pixels.max(axis=0), np.array(camera.size) - 1.0)
    return Box(*low.tolist(), *(high - low).tolist()) if (high > low).all() else None
