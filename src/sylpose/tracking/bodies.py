"""Bodies that move in a recording: the candidates for the object where no boxes are given.

A person who holds the object moves as well, and over a second a trunk is as rigid as a board. So all bodies are found,
in windows of consecutive frames spread over the recording. In each window the motion with the most matches is fitted,
its inliers are removed, and so on, while a motion is rigid. A body is followed through the windows by the descriptors of
its features and by its place. The one with the most matches is tracked. If another one that moves at the same time has a
notable share of its matches, which of them is the object is the user's knowledge.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from math import isqrt
from weakref import WeakKeyDictionary

import numpy as np

from sylpose.features.sift import Features, match_features, reduce_image
from sylpose.frames import Box, FrameSet
from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.blas_threads import limit_blas_threads
from sylpose.geometry.robust_loss import chi_squared_bound
from sylpose.methods import METHODS
from sylpose.relative_pose.affine_ransac import QUADRUPLES, find_inliers
from sylpose.relative_pose.camera_evidence import TREMBLE_SD, pool_f_ratios
from sylpose.relative_pose.rig_hypotheses import CameraMatches, Hypothesis, compute_f_ratios
from sylpose.relative_pose.terms import MIN_MATCHES
from sylpose.rig import Camera, Rig
from sylpose.status import Status
from sylpose.tracking.camera_side.camera import CameraTracker
from sylpose.tracking.camera_side.frame import (
    REGION_MARGIN,
    CameraPairs,
    FrameMatches,
    Region,
    find_static,
    match_frames,
    omit_empty,
    widen_outline,
)
from sylpose.tracking.context import Candidate, Context, Frame, LocalExecutor
from sylpose.tracking.first_motion import (
    RAYLEIGH_MEDIAN,
    FirstMotion,
    collect_indices,
    count_rival,
    estimate_jitter,
    find_bodies,
    remove_inliers,
)
from sylpose.tracking.joint_side.joint_state import MIN_TRACKED_RATIO
from sylpose.tracking.options import TrackingOptions

# Windows are searched in so many places, in long recordings in more (`select_windows`), at least so far from each other
# (choice).
N_WINDOWS, MIN_WINDOW_STEP = 8, 6
# Numbers of frames between the two that are compared (choice).
GAPS = (1, 2, 4, 8, 16)
# Maximum number of frames of a window (derived).
WINDOW_FRAMES = GAPS[-1] + 1
# If a body moves farther than this, pixels, the next window's frames are nearer to each other (choice).
MAX_DISPLACEMENT_PX = 32.0
# Larger images are downscaled to so many pixels (choice).
MAX_PIXELS = 480 * 360
# Two bodies of different windows are one if this share of the smaller one's features match (choice),
MIN_LINK_RATIO = 0.2
# or if their centers are nearer to each other than this, radii of the smaller one (derived: the side that is visible
# changes, and is at most a radius away).
MAX_DISTANCE_RADII = 1.0
# Features farther from their median position than this, in median distances, are mismatches: once in a thousand times one of
# normally distributed features is farther (derived).
MAX_DISTANCE_RATIO = float(np.sqrt(chi_squared_bound(2))) / RAYLEIGH_MEDIAN
# A camera's matches are mismatches unless most of them have common affine epipolar lines, within this share of the
# image's diagonal (choice).
RIGID_TOLERANCE = 0.005


@dataclass(frozen=True, eq=False)
class SearchContext(Context):
    """Settings and components of a search. Its windows overlap: the features of a frame set are detected once.

    Attributes:
        known: by frame set, normal and faint: per camera, local: its features.
    """

    known: WeakKeyDictionary[FrameSet, dict[bool, Sequence[Features]]] = field(default_factory=WeakKeyDictionary)

    def detect_frame(self, number: int, images: FrameSet, *, faint: bool = False) -> Frame:
        """Create a frame with the features of the whole images, without these: those of all windows are kept."""
        known = self.known.setdefault(images, {})
        if faint not in known:
            n = self.options.max_start_features
            known[faint] = self.detect_everywhere(images, n, faint=faint, max_pixels=MAX_PIXELS)
        nothing = (None,) * len(images.images)
        frame = self.create_frame(number, replace(images, images=nothing, masks=nothing))
        return self.with_features(frame, known[faint])


@dataclass(frozen=True, eq=False)
class WindowBody:
    """A body in one window.

    Attributes:
        last: the later of the two frames, with features.
        motion: from the window's first frame to it.
    """

    last: Frame
    motion: FirstMotion

    def is_clear(self, options: TrackingOptions) -> bool:
        """Return whether tracking can start with this motion."""
        motion = self.motion
        is_large = motion.is_observable or motion.displacement_px > options.min_first_motion_px
        return motion.is_significant and motion.fit.status is Status.OK and is_large


# A body in several windows, by number of the window.
Chain = Mapping[int, WindowBody]


@dataclass(frozen=True, eq=False)
class Window:
    """A window of consecutive frames.

    Attributes:
        first: its first frame, with features.
        bodies: those that move in it, by decreasing number of matches.
        f_ratio: by which the cameras contradict the motion of the largest one; NaN if unknown.
    """

    first: Frame
    bodies: Sequence[WindowBody]
    f_ratio: float = np.nan


def find_candidates(
    rig: Rig,
    windows: Iterable[Sequence[FrameSet]],
    *,
    time_offsets: FloatArray | None = None,
    seed: int = 0,
    workers: int | None = None,
    options: TrackingOptions | None = None,
) -> list[Candidate]:
    """Find the bodies that might be the object.

    Args:
        rig: C cameras.
        windows: consecutive frames from several places of a recording, in order of time; they may overlap. Empty ones,
            of frames that cannot be read, are skipped.
        time_offsets: (C,) seconds by which each camera's images are later than its time stamps; None: none.
        seed: of outlier rejection.
        workers: threads for detection and matching; None: one per core, at most one per camera.
        options: limits and sizes; None: the default ones.

    Returns:
        by decreasing number of matches; empty if nothing moves as a rigid body.
    """
    with open_search(rig, time_offsets, seed, workers, options) as context:
        found, with_faint, gap = list[Window](), list[Window](), GAPS[0]
        for frames in filter(len, windows):
            window, gap = _search_window(context, frames, gap)
            found.append(window)
            with_faint.append(_search_faint(context, window, frames))
        candidates = _make_candidates(context, found)
        if candidates and not candidates[0].is_ambiguous(context.options):
            others = _make_candidates(context, with_faint)
            return others if others and others[0].is_ambiguous(context.options) else candidates
        return candidates


def _search_faint(context: SearchContext, window: Window, frames: Sequence[FrameSet]) -> Window:
    """Search a window in which one body is found once more, with faint features as well.

    Of a plain object that a person holds there may be no others, and the person would be tracked. Faint features are no
    evidence on the cameras, and tracking does not start with them.
    """
    if len(window.bodies) != 1:
        return window
    (body,) = window.bodies
    first, last = (context.detect_frame(k, frames[k], faint=True) for k in (0, body.last.number))
    bodies = [WindowBody(last, motion) for motion in find_bodies(context, _match(context, first, last), 0)]
    return Window(first, bodies, window.f_ratio)


def compare_cameras(
    rig: Rig,
    frames: Sequence[FrameSet],
    boxes: Mapping[str, Box] | None = None,
    *,
    time_offsets: FloatArray | None = None,
    workers: int | None = None,
    options: TrackingOptions | None = None,
) -> float:
    """Compare the motions that the cameras see of what is in the boxes, between the first frame and some later ones.

    Args:
        rig: C cameras.
        frames: the first ones of a recording.
        boxes: per camera, the object's box in the first frame, pixels; None: it is all that moves.
        time_offsets, workers, options: as `find_candidates`.

    Returns:
        the F ratio pooled over the later frames, see `pool_f_ratios`; NaN unless it is known for several.
    """
    with open_search(rig, time_offsets, 0, workers, options) as context:
        gaps = [gap for gap in GAPS if gap < len(frames)]
        if not gaps:
            return np.nan
        first, ratios = context.detect_frame(0, frames[0]), list[float]()
        for gap in gaps:
            last = context.detect_frame(gap, frames[gap])
            pairs = _match(context, first, last)
            if boxes:
                local = [rig.cameras[c] for c in context.executor.local]
                pairs = [_select_boxed(own, boxes.get(its.name)) for its, own in zip(local, pairs, strict=True)]
            ratios.append(_compute_f_ratio(context, first, last, pairs))
        return float(pool_f_ratios(np.array(ratios))) if np.count_nonzero(~np.isnan(ratios)) > 1 else np.nan


def _select_boxed(pairs: Sequence[FrameMatches], box: Box | None) -> list[FrameMatches]:
    """Return a camera's matches of features that are in the box in the earlier frame; none without a box."""
    if box is None:
        return []
    first, last = np.array([box.x, box.y]), np.array([box.x + box.width, box.y + box.height])
    selected = list[FrameMatches]()
    for pair in pairs:
        is_inside: BoolArray = np.all((pair.pixels_i >= first) & (pair.pixels_i <= last), axis=1)
        selected.append(pair.subset(is_inside))
    return omit_empty(selected)


@contextmanager
def open_search(
    rig: Rig,
    time_offsets: FloatArray | None = None,
    seed: int = 0,
    workers: int | None = None,
    options: TrackingOptions | None = None,
) -> Iterator[SearchContext]:
    """Create cameras for a search, on worker threads of its own. See `find_candidates`."""
    offsets = np.zeros(len(rig)) if time_offsets is None else time_offsets
    executor = LocalExecutor(len(rig), workers or min(len(rig), os.cpu_count() or 1))
    try:
        cameras = [CameraTracker(c, camera) for c, camera in enumerate(rig)]
        with limit_blas_threads():
            yield SearchContext(
                rig, cameras, executor, METHODS[0], True, True, offsets, seed, options or TrackingOptions()
            )
    finally:
        executor.close()


def select_windows(n_frames: int) -> list[range]:
    """Select the frames of windows spread over a recording of so many frames.

    Their number grows with the root of its length, up to the square: a motion between windows is missed, but the search
    must not take as long as tracking.
    """
    if not n_frames:
        return []
    last = max(n_frames - MIN_WINDOW_STEP, 0)
    n_windows = min(max(N_WINDOWS, isqrt(n_frames // 2)), N_WINDOWS**2, 1 + last // MIN_WINDOW_STEP)
    starts = np.unique(np.linspace(0, last, n_windows).round().astype(int)).tolist()
    return [range(start, min(start + WINDOW_FRAMES, n_frames)) for start in starts]


def _search_window(context: SearchContext, frames: Sequence[FrameSet], gap: int) -> tuple[Window, int]:
    """Find the bodies of a window over the time that shows most of a second one, else the longest with enough matches.

    Over a short time two bodies differ too little to be separated, over a long one their features change.

    Args:
        gap: number of frames to begin with.

    Returns:
        the window; the number of frames for the next one.
    """
    first, best = context.detect_frame(0, frames[0]), list[WindowBody]()
    best_gap, max_matches, max_others = gap, 0, 0
    best_pairs: CameraPairs = ()
    gap = min(gap, max(len(frames) - 1, GAPS[0]))
    gaps = [*(g for g in GAPS if g >= gap), *(g for g in GAPS[::-1] if g < gap)]
    for g in (g for g in gaps if g < len(frames)):
        if g < gap and best:
            break
        last = context.detect_frame(g, frames[g])
        pairs = _match(context, first, last)
        motions = find_bodies(context, pairs, 0)
        n = sum(motion.n_inliers for motion in motions)
        max_matches = max(n, max_matches)
        if best and n < MIN_TRACKED_RATIO * max_matches:
            break
        significant = [motion for motion in motions if motion.is_significant]
        # Two motions may not be separable over some times: a mixed fit is worse than one without a second body.
        n_others = sum(motion.n_inliers for motion in significant[1:]) - any(m.fit.is_mixed for m in significant)
        is_enough = bool(best) and best[0].motion.displacement_px > context.options.min_first_motion_px
        if significant and (not best or n_others >= max_others + is_enough):
            best, best_gap, max_others = [WindowBody(last, motion) for motion in motions], g, n_others
            best_pairs = pairs
        # A second body may be slower than the largest one.
        limit = context.options.min_first_motion_px if max_others > 0 else MAX_DISPLACEMENT_PX
        if n_others >= 0 and best and best[0].motion.displacement_px > limit:
            break
    is_far = bool(best) and best[0].motion.displacement_px > MAX_DISPLACEMENT_PX
    for body in best[1:]:
        best_pairs = remove_inliers(best_pairs, body.motion)
    window = Window(first, best, _compute_f_ratio(context, first, best[0].last, best_pairs) if best else np.nan)
    return window, max(best_gap // 2, GAPS[0]) if is_far else best_gap


def _compute_f_ratio(context: Context, first: Frame, last: Frame, pairs: CameraPairs) -> float:
    """Return the F ratio of the moving matches between two frames; NaN without evidence.

    A camera with time offsets sees the motion between other times. It is evidence if the object moves by no more within
    them than what a camera may tremble: it may accelerate.
    """
    offsets = np.maximum(*(np.abs(frame.time_offsets - np.median(frame.time_offsets)) for frame in (first, last)))
    shares = offsets / max(last.time - first.time, 1e-9)
    matches = list[CameraMatches]()
    for c, own in zip(context.executor.local, pairs, strict=True):
        x, y = _select_rigid(context.rig.cameras[c], own, context.options)
        limit = TREMBLE_SD * context.rig.cameras[c].focal
        is_evidence = len(x) and shares[c] * float(np.median(np.linalg.norm(y - x, axis=1))) <= limit
        matches.append((x, y) if is_evidence else (x[:0], y[:0]))
    return float(compute_f_ratios(context.rig, [matches], Hypothesis())[0])


def find_rigid_motion(camera: Camera, pair: FrameMatches, options: TrackingOptions) -> tuple[BoolArray, bool]:
    """Find what moves between two frames of a camera.

    Returns:
        (n,) the static matches; whether the others move as a rigid body, by more than the noise. Of mismatches, and of
        keypoints that scatter with compression, at most a few have common epipolar lines.
    """
    is_static = find_static(pair, estimate_jitter(pair))
    x, y = pair.pixels_i[~is_static], pair.pixels_j[~is_static]
    if len(x) < MIN_MATCHES or np.median(np.linalg.norm(y - x, axis=1)) < options.min_displacement_px:
        return is_static, False
    is_inlier = np.empty(len(x))
    find_inliers(x, y, RIGID_TOLERANCE * float(np.hypot(*camera.size)), QUADRUPLES, is_inlier)
    return is_static, bool(is_inlier.mean() > 0.5)


def _select_rigid(camera: Camera, pairs: Sequence[FrameMatches], options: TrackingOptions) -> CameraMatches:
    """Return the pixels (n, 2) of a camera's matches in the earlier and the later frame, if they move as a rigid body."""
    for pair in pairs:
        is_static, is_rigid = find_rigid_motion(camera, pair, options)
        if is_rigid:
            return pair.pixels_i[~is_static], pair.pixels_j[~is_static]
    return np.empty((0, 2)), np.empty((0, 2))


def reduce_frame_set(frames: FrameSet) -> FrameSet:
    """Downscale a frame set's images to what the search of moving bodies examines, so that it may hold many of them.

    Images with masks are kept: they are searched inside these only, in as many pixels.
    """
    images = (
        image if image is None or mask is not None else reduce_image(image, MAX_PIXELS)
        for image, mask in zip(frames.images, frames.masks, strict=True)
    )
    return replace(frames, images=tuple(images))


def _match(context: Context, first: Frame, last: Frame) -> list[list[FrameMatches]]:
    """Match two frames; per camera, local."""
    matches = context.executor.run(partial(match_frames, first.number), first.cameras, last.cameras)
    return [omit_empty([pair]) for pair in matches]


# --- bodies of all windows ----------------------------------------------------------------------------------------------


def _make_candidates(context: Context, windows: Sequence[Window]) -> list[Candidate]:
    """Link the bodies of all windows and make the candidates."""
    chains = list[dict[int, WindowBody]]()
    for number, window in enumerate(windows):
        open_chains = list(chains)
        for body in window.bodies:
            earlier = [chain[max(chain)] for chain in open_chains]
            shares = [_measure_link(before, window, body) for before in earlier]
            if not max(shares, default=0.0) > MIN_LINK_RATIO:
                # A body that has turned shows other features, at the same place.
                shares = [MIN_LINK_RATIO + 1.0 if _is_same_place(before, body) else 0.0 for before in earlier]
            if max(shares, default=0.0) > MIN_LINK_RATIO:
                open_chains.pop(int(np.argmax(shares)))[number] = body
            else:
                chains.append({number: body})
    moving = [chain for chain in chains if any(body.motion.is_significant for body in chain.values())]
    candidates = [_make_candidate(context, windows, chain, moving) for chain in moving]
    return sorted(candidates, key=lambda candidate: -candidate.n_matches)


def _is_same_place(earlier: WindowBody, body: WindowBody) -> bool:
    """Return whether a body is where another one was at the end of an earlier window."""
    a, b = earlier.motion, body.motion
    distance = np.linalg.norm(a.motion.apply(a.inlier_center) - b.inlier_center)
    return bool(distance < MAX_DISTANCE_RADII * min(a.radius, b.radius))


def _measure_link(earlier: WindowBody, window: Window, body: WindowBody) -> float:
    """Return which share of the smaller body's features match, of a body in an earlier window and one in this."""
    n_matched = n_smaller = 0
    sides = zip(earlier.last.cameras, window.first.cameras, earlier.motion.inliers, body.motion.inliers, strict=True)
    for last, first, earlier_pairs, pairs in sides:
        i, j = np.unique(collect_indices(earlier_pairs, 1)), np.unique(collect_indices(pairs, 0))
        n_matched += len(match_features(last.features.subset(i), first.features.subset(j)))
        n_smaller += min(len(i), len(j))
    return n_matched / max(n_smaller, 1)


def _make_candidate(context: Context, windows: Sequence[Window], chain: Chain, moving: Sequence[Chain]) -> Candidate:
    """Make the candidate of a body, one of those that are moving."""
    n_matches = _count_matches(chain)
    n_shared = n_rivals = 0
    for number, body in chain.items():
        others = [other.motion for other in windows[number].bodies if other is not body]
        n = max((count_rival(context, body.motion, other) for other in others), default=0)
        n_shared, n_rivals = n_shared + (body.motion.n_inliers if n else 0), n_rivals + n
    # One that neither features nor place link with it, at the times when it does not move.
    n_later = max((_count_significant(other, chain) for other in moving if other is not chain), default=0)
    sizes = {k: body.motion.n_inliers * body.motion.is_significant for k, body in chain.items()}
    clear = {k: sizes[k] for k, body in chain.items() if body.is_clear(context.options)} or sizes
    # While a body comes in, little of it is visible.
    number = next(k for k, n in clear.items() if n >= MIN_TRACKED_RATIO * max(clear.values()))
    first, pairs = _find_first_frame(context, windows[: number + 1], chain[number])
    last = chain[number].last.images.index
    features = tuple(_concatenate([pair.pixels_i for pair in own]) for own in pairs)
    return Candidate(
        first.images.index,
        last,
        tuple(map(_draw_outline, features)),
        features,
        np.array(list(map(_measure_displacement, pairs))),
        n_matches,
        n_rivals / max(n_shared, 1),
        n_later / n_matches,
        float(pool_f_ratios(np.array([window.f_ratio for window in windows]))),
    )


def _count_matches(chain: Chain) -> int:
    return sum(body.motion.n_inliers for body in chain.values())


def _count_significant(chain: Chain, without: Chain) -> int:
    """Count the matches of significant motions in windows that the other chain is not in."""
    own = (body.motion for number, body in chain.items() if number not in without)
    return sum(motion.n_inliers for motion in own if motion.is_significant)


def _find_first_frame(context: Context, windows: Sequence[Window], body: WindowBody) -> tuple[Frame, CameraPairs]:
    """Find the earliest frame from which the motion of a body in the last window can be measured: it may have rested.

    Returns:
        the frame; per camera, local: its matches on the body.
    """
    own = [collect_indices(pairs, 1) for pairs in body.motion.inliers]
    for window in windows[:-1]:
        for motion in find_bodies(context, _match(context, window.first, body.last), 0):
            both = zip(own, motion.inliers, strict=True)
            n_kept = sum(len(np.intersect1d(indices, collect_indices(pairs, 1))) for indices, pairs in both)
            if n_kept > MIN_TRACKED_RATIO * body.motion.n_inliers:
                return window.first, motion.inliers
    return windows[-1].first, body.motion.inliers


def _concatenate(pixels: Sequence[FloatArray]) -> FloatArray:
    return np.concatenate([np.empty((0, 2)), *pixels])


def _measure_displacement(pairs: Sequence[FrameMatches]) -> float:
    """Return the median displacement of one camera's matches, pixels; NaN without any."""
    shifts = [np.linalg.norm(pair.pixels_j - pair.pixels_i, axis=1) for pair in pairs]
    return float(np.median(np.concatenate(shifts))) if shifts else np.nan


def _draw_outline(pixels: FloatArray) -> Region:
    """Return the outline (k, 2) of features (n, 2), without the most distant ones; None without features."""
    if not len(pixels):
        return None
    distances = np.linalg.norm(pixels - np.median(pixels, axis=0), axis=1)
    return widen_outline(pixels[distances <= MAX_DISTANCE_RATIO * np.median(distances)], REGION_MARGIN)
