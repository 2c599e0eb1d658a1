"""Hypotheses on why cameras contradict each other: the usual mistakes with images, calibrations and clocks.

If all cameras see one rigid motion, its joint estimate fits each camera's matches about as well as the camera's own
motion does (`camera_evidence`). Where it does not, the comparison is repeated with each usual mistake undone: images
mirrored or turned, poses inverted, axes of other programs, one camera's position in another unit, cameras exchanged or
late, one camera left out. The mistake
that was made is the one without which the cameras agree. F ratios of several pairs of frames are pooled by their median.

Some mistakes have the same epipolar geometry:

- Images flipped vertically, and a left-handed world with y reversed (Unity): the world is a reflection in both.
- Mirrored images, and OpenGL axes: depths have opposite signs. The joint motion has a surface in front of the cameras
  (`terms`), hence only one of the two fits.
- Rigs that a mistake maps to themselves: two cameras, and cameras in one plane with their axes, do not distinguish
  mirrored images from turned ones. Motion does not reveal the length unit of the whole rig, only that of one camera.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import combinations, permutations

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.relative_pose.camera_evidence import (
    MAX_F_RATIO,
    MAX_POOLED_F_RATIO,
    MIN_BASELINE,
    MIN_MATCHES,
    MIN_POOLED,
    MIN_REDUCTION,
    compute_f_ratio,
    explains_as_well,
    measure_excess,
    transfer_motion,
)
from sylpose.relative_pose.solver import fit_terms
from sylpose.relative_pose.terms import TermData, locate_object
from sylpose.rig import Camera, Rig
from sylpose.units import METERS

# One camera's matches of moving features between two frames: pixels (n, 2) of both, as recorded.
CameraMatches = tuple[FloatArray, FloatArray]
# Those of each camera of the rig, in its order.
FramePair = Sequence[CameraMatches]

# Number of cameras up to which all combinations are tried: orders, 23, of more only pairwise exchanges and cyclic shifts;
# and pairs of those that see two bodies, any one of which may suffice (choice).
MAX_COMBINED = 4
# A hypothesis explains a contradiction if it reduces the F ratio to at most this value (measured: right hypotheses have
# at most 1.4, others at least 3; docs/calibrating.md).
MAX_AGREEING = 2.0
# Other axes of pixels explain the contradiction of one pair of frames if they reduce the F ratio by at least this factor
# (measured: right motions seem to be explained by 4 at most, wrong axes are by 11 and more: docs/history/benchmarks.md).
MIN_AXES_REDUCTION = 8.0
# A contradiction needs so many pairs of frames, and so does its explanation (choice); that of a late camera needs
# `MIN_POOLED`, since six lags of each camera are tried.
MIN_PAIRS = 2
# More hypotheses that fit alike name nothing (choice).
MAX_NAMED = 3
# Units that a calibration may mix up, larger and smaller one (choice: a displaced camera of three may agree in inches
# instead of centimeters, and hardly anybody uses both).
UNIT_PAIRS = ("m", "cm"), ("m", "mm"), ("cm", "mm"), ("m", "in"), ("in", "mm")
# Axes of an OpenGL camera, y upwards and z backwards, in OpenCV's (derived).
OPENCV_FROM_OPENGL = RigidTransform.from_rotation(Rotation.from_matrix(np.diag([1.0, -1.0, -1.0])))


class Mistake(StrEnum):
    """Usual mistakes with the images, the calibration or the clock of all cameras or of one."""

    NONE = "none"
    MIRRORED = "images mirrored"
    TURNED = "images turned by 180 degrees"
    FLIPPED = "images flipped vertically"
    CLOCKWISE = "images turned clockwise"
    COUNTERCLOCKWISE = "images turned counterclockwise"
    TRANSPOSED = "rows and columns exchanged"
    INVERTED = "poses inverted"
    OPENGL = "OpenGL axes"
    INVERTED_OPENGL = "poses inverted, OpenGL axes"
    EXCHANGED = "cameras exchanged"
    UNIT = "another unit"
    LATE = "late"
    INCONSISTENT = "inconsistent"


@dataclass(frozen=True)
class Hypothesis:
    """A mistake that may have been made.

    Attributes:
        mistake: its kind.
        cameras: indices of the affected cameras, () for all; for `Mistake.EXCHANGED` (C,), the camera whose images
            each camera has.
        lag: number of frames by which the camera's images are late; negative if they are early.
        units: for `Mistake.UNIT`, the unit of the camera's position, and that of the others.
    """

    mistake: Mistake = Mistake.NONE
    cameras: tuple[int, ...] = ()
    lag: int = 0
    units: tuple[str, str] = ("m", "m")


@dataclass(frozen=True)
class HypothesisFit:
    """How well the cameras agree under a hypothesis.

    Attributes:
        hypothesis: the hypothesis.
        f_ratio: median of the F ratios of all pairs of frames with evidence; infinite without any.
        given_ratio: the same of these pairs without the hypothesis; of two in the middle, the smaller one.
        worst_ratio: largest F ratio of the pairs that agree clearly better without the hypothesis; 0 if there are none,
            infinite without evidence.
        n_pairs: number of these pairs.
    """

    hypothesis: Hypothesis
    f_ratio: float
    given_ratio: float
    n_pairs: int
    worst_ratio: float = 0.0

    @property
    def is_agreement(self) -> bool:
        """Whether the hypothesis explains a contradiction."""
        min_pairs = MIN_POOLED if self.hypothesis.mistake is Mistake.LATE else MIN_PAIRS
        # Two pairs have no majority: a larger ratio makes up for that.
        min_given = MAX_POOLED_F_RATIO if self.n_pairs > MIN_PAIRS else MAX_F_RATIO
        is_contradiction = self.n_pairs >= min_pairs and self.given_ratio > min_given
        return is_contradiction and self.f_ratio <= MAX_AGREEING and self.worst_ratio <= MAX_POOLED_F_RATIO


# Axes of pixels other than to the right and down, and what they look like.
PIXEL_AXES = {
    Mistake.MIRRORED: "pixels are counted to the left, or the images are mirrored",
    Mistake.FLIPPED: "pixels are counted upwards, or the images are flipped vertically",
    Mistake.TURNED: "pixels are counted to the left and upwards, or the images are turned by 180 degrees",
    Mistake.TRANSPOSED: "pixels are given as row and column",
}


def list_hypotheses(rig: Rig) -> Iterator[Hypothesis]:
    """Yield the hypotheses on a rig apart from late cameras."""
    whole = Mistake.MIRRORED, Mistake.TURNED, Mistake.FLIPPED, Mistake.INVERTED, Mistake.OPENGL, Mistake.INVERTED_OPENGL
    yield from map(Hypothesis, whole)
    for c, camera in enumerate(rig):
        square = (Mistake.CLOCKWISE, Mistake.COUNTERCLOCKWISE) if camera.size[0] == camera.size[1] else ()
        yield from (Hypothesis(mistake, (c,)) for mistake in (Mistake.MIRRORED, Mistake.TURNED, *square))
        if len(rig) > 2:
            yield Hypothesis(Mistake.INCONSISTENT, (c,))
        for a, b in UNIT_PAIRS:
            yield from (Hypothesis(Mistake.UNIT, (c,), units=units) for units in ((a, b), (b, a)))
    for order in _list_orders(len(rig)):
        if all(rig.cameras[c].size == rig.cameras[source].size for c, source in enumerate(order)):
            yield Hypothesis(Mistake.EXCHANGED, order)


def _list_orders(n: int) -> Iterator[tuple[int, ...]]:
    """Yield the orders of n cameras that are tried."""
    in_order = tuple(range(n))
    orders = set(permutations(in_order)) if n <= MAX_COMBINED else {in_order[k:] + in_order[:k] for k in in_order}
    for i, j in combinations(in_order, 2):
        order = [*in_order]
        order[i], order[j] = j, i
        orders.add(tuple(order))
    yield from sorted(orders - {in_order})


def compute_f_ratios(rig: Rig, pairs: Sequence[FramePair], hypothesis: Hypothesis) -> FloatArray:
    """Compute the F ratio of each pair of frames once a mistake is undone.

    Args:
        rig: C cameras.
        pairs: P pairs of frames; for `Mistake.LATE` with the camera's matches at the times of the others.
        hypothesis: the mistake.

    Returns:
        (P,) the ratios; infinite without a joint motion, NaN if fewer than two cameras have evidence.
    """
    return np.array([_compare_cameras(_undo(rig, pair, hypothesis)) for pair in pairs])


def summarize(hypothesis: Hypothesis, ratios: FloatArray, given: FloatArray) -> HypothesisFit:
    """Summarize the F ratios (P,) under a hypothesis, and those of the same pairs of frames without it."""
    known = ~np.isnan(ratios) & ~np.isnan(given)
    if not known.any():
        return HypothesisFit(hypothesis, np.inf, np.inf, 0, np.inf)
    ratios, given = ratios[known], given[known]
    f_ratio, given_ratio = float(np.median(ratios)), float(np.quantile(given, 0.5, method="lower"))
    worst_ratio = float(ratios.max(initial=0.0, where=ratios > MIN_REDUCTION * given))
    return HypothesisFit(hypothesis, f_ratio, given_ratio, len(ratios), worst_ratio)


def select_explanations(fits: Sequence[HypothesisFit]) -> list[HypothesisFit]:
    """Select the hypotheses that explain a contradiction, best first.

    Args:
        fits: of all hypotheses.

    Returns:
        those that fit about as well as the best one; none if these are too many to name.
    """
    agreeing = sorted((fit for fit in fits if fit.is_agreement), key=lambda fit: fit.f_ratio)
    best = [fit for fit in agreeing if explains_as_well(fit.f_ratio, agreeing[0].f_ratio)]
    # A camera that agrees once its mistake is undone can be left out as well. Similar lags of a camera are one mistake.
    chosen = dict[tuple[Mistake, tuple[int, ...]], HypothesisFit]()
    for fit in best:
        chosen.setdefault((fit.hypothesis.mistake, fit.hypothesis.cameras), fit)
    specific = [fit for fit in chosen.values() if fit.hypothesis.mistake is not Mistake.INCONSISTENT]
    selected = specific or [*chosen.values()]
    return selected if len(selected) <= MAX_NAMED else []


def find_pixel_axes(rig: Rig, data: Sequence[TermData], excess: FloatArray) -> str:
    """Find the axes of pixels with which cameras that contradict each other agree.

    Args:
        rig: C cameras.
        data: T terms, one per camera, all of the same frames.
        excess: (T,) as they are (`camera_evidence`).

    Returns:
        those of `PIXEL_AXES` that explain the contradiction, as text; "" if there is none.
    """
    cameras = [rig.cameras[term.camera] for term in data]
    pixels = [(camera.denormalize(t.x), camera.denormalize(t.y)) for camera, t in zip(cameras, data, strict=True)]
    ratios, given = list[float](), compute_f_ratio(excess, len(excess))
    for mistake in PIXEL_AXES:
        found = _measure_excess([(c, _undo_image(c, p, mistake)) for c, p in zip(cameras, pixels, strict=True)])
        # Without a camera the others agree more easily.
        is_known = np.isfinite(found).sum() >= np.isfinite(excess).sum()
        ratios.append(compute_f_ratio(found, len(found)) if is_known else np.inf)
    limit = min(MAX_AGREEING, given / MIN_AXES_REDUCTION)
    alike = [ratio < limit and explains_as_well(ratio, min(ratios)) for ratio in ratios]
    return "; or ".join(text for text, agrees in zip(PIXEL_AXES.values(), alike, strict=True) if agrees)


def _undo(rig: Rig, pair: FramePair, hypothesis: Hypothesis) -> list[tuple[Camera, CameraMatches]]:
    """Return the cameras and their matches as they are without a mistake."""
    mistake, affected = hypothesis.mistake, hypothesis.cameras
    if mistake is Mistake.EXCHANGED:
        return [(camera, pair[affected.index(c)]) for c, camera in enumerate(rig)]
    views = list(zip(rig, pair, strict=True))
    if mistake is Mistake.INCONSISTENT:
        return [view for c, view in enumerate(views) if c not in affected]
    return [
        (_undo_pose(camera, hypothesis), _undo_image(camera, matches, mistake))
        if c in affected or not affected
        else (camera, matches)
        for c, (camera, matches) in enumerate(views)
    ]


def _undo_pose(camera: Camera, hypothesis: Hypothesis) -> Camera:
    pose, mistake = camera.camera_from_world, hypothesis.mistake
    if mistake in (Mistake.INVERTED, Mistake.INVERTED_OPENGL):
        pose = pose.inv()
    if mistake in (Mistake.OPENGL, Mistake.INVERTED_OPENGL):
        pose = OPENCV_FROM_OPENGL * pose
    if mistake is Mistake.UNIT:
        own, others = (METERS[unit] for unit in hypothesis.units)
        pose = RigidTransform.from_components(own / others * pose.translation, pose.rotation)
    return replace(camera, camera_from_world=pose)


def _undo_image(camera: Camera, matches: CameraMatches, mistake: Mistake) -> CameraMatches:
    right, bottom = camera.size[0] - 1.0, camera.size[1] - 1.0

    def undo(pixels: FloatArray) -> FloatArray:
        u, v = pixels.T
        if mistake is Mistake.TRANSPOSED:
            return np.column_stack([v, u])
        if mistake is Mistake.CLOCKWISE:
            return np.column_stack([v, bottom - u])
        if mistake is Mistake.COUNTERCLOCKWISE:
            return np.column_stack([right - v, u])
        u = right - u if mistake in (Mistake.MIRRORED, Mistake.TURNED) else u
        return np.column_stack([u, bottom - v if mistake in (Mistake.FLIPPED, Mistake.TURNED) else v])

    return undo(matches[0]), undo(matches[1])


def _compare_cameras(views: Sequence[tuple[Camera, CameraMatches]]) -> float:
    """Return the F ratio of a pair of frames; infinite without a joint motion, NaN without evidence."""
    excess = _measure_excess(views)
    return np.inf if np.isposinf(excess).any() else compute_f_ratio(excess, len(excess))


def _measure_excess(views: Sequence[tuple[Camera, CameraMatches]]) -> FloatArray:
    """Measure the excess of the cameras with enough matches; NaN without evidence, infinite without a joint motion."""
    terms = [
        TermData(c, camera.normalize(x), camera.normalize(y), camera.rotation, camera.center, camera.focal)
        for c, (camera, (x, y)) in enumerate(views)
        if len(x) >= MIN_MATCHES
    ]
    if len(terms) < 2:
        return np.full(len(terms), np.nan)
    center, radius = locate_object(terms)
    fit = fit_terms(terms, center, radius, [], np.random.default_rng(0))
    motion = center, fit.rotation, fit.translation
    # Without a baseline every match fits, whatever the rig.
    has_baseline = fit.status.has_pose and all(
        np.linalg.norm(transfer_motion(term, *motion)[1]) > MIN_BASELINE for term in terms
    )
    return measure_excess(terms, *motion) if has_baseline else np.full(len(terms), np.inf)
