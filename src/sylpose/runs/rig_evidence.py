"""Evidence in the first frames of a recording for or against its rig: do the cameras agree, and if not, why.

Compared are features that move, whatever they belong to: neither boxes nor a motion that was found under the given rig
are used, since both are wrong if the rig is.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice, pairwise
from typing import NamedTuple

import numpy as np

from sylpose.frames import FrameSet
from sylpose.geometry.arrays import BoolArray, FloatArray, Image
from sylpose.io.capture import Session
from sylpose.io.capture.session import use_frames_as_coded
from sylpose.relative_pose.camera_evidence import MAX_F_RATIO, MIN_MATCHES
from sylpose.relative_pose.rig_hypotheses import (
    MAX_PAIR_RATIO,
    MIN_PAIRS,
    CameraMatches,
    FramePair,
    Hypothesis,
    HypothesisFit,
    Mistake,
    compute_f_ratios,
    list_hypotheses,
    select_explanations,
    summarize,
)
from sylpose.rig import Rig, intersect_rays
from sylpose.tracking.bodies import find_rigid_motion
from sylpose.tracking.camera_side.camera import MAX_SEARCH_PIXELS, CameraTracker
from sylpose.tracking.camera_side.frame import CameraFrame, match_frames
from sylpose.tracking.context import LocalExecutor
from sylpose.tracking.options import TrackingOptions

# Pairs of frames that are compared (choice).
MAX_PAIRS = 5
# Median displacement of what moves between the frames of a pair, as a share of the image's diagonal, and numbers of frames
# between them that are tried (choice: 24 pixels of 640x480; the rotation of a small one shows nothing of the rig).
MIN_MOTION, GAPS = 0.03, (1, 2, 4, 6, 8, 12, 16)
# A camera may be late or early by so many frames (choice).
MAX_LAG = 3
# Images are compared in so many frames; so many identical ones in a row are a frozen picture (choice).
MAX_COMPARED_FRAMES, MIN_FROZEN_FRAMES = 30, 6

# What is seen of images, and the filter of FFmpeg that undoes it.
IMAGE_MISTAKES = {
    Mistake.MIRRORED: ("mirrored", "hflip"),
    Mistake.TURNED: ("turned by 180 degrees", "hflip,vflip"),
    Mistake.FLIPPED: ("flipped vertically", "vflip"),
    Mistake.CLOCKWISE: ("turned clockwise by 90 degrees", "transpose=cclock"),
    Mistake.COUNTERCLOCKWISE: ("turned counterclockwise by 90 degrees", "transpose=clock"),
}


@dataclass(frozen=True, eq=False)
class MotionEvidence:
    """What moves in the first frames of a recording.

    Attributes:
        frames: numbers (i, j) of the frames of each pair.
        pairs: P pairs: matches of moving features, of the cameras that see a rigid motion.
        static: P, C: pixels (n, 2) of the features that do not move.
        sees_motion: (C,) cameras that see a rigid motion between any two frames that were tried.
        changes: (F - 1, C) whether each camera's image differs from its previous one.
    """

    frames: tuple[tuple[int, int], ...]
    pairs: tuple[FramePair, ...]
    static: tuple[Sequence[FloatArray], ...]
    sees_motion: BoolArray
    changes: BoolArray


@dataclass(frozen=True, eq=False)
class RigFindings:
    """What the first frames show of a rig.

    Attributes:
        frames: numbers of the first and the last frame compared; None if too little moves.
        is_contradicted: whether the cameras contradict each other.
        explanations: the mistakes that explain it equally well, best first; empty if none does, or too many.
        frozen: by camera index, the first and the last frame of identical images while others change.
        still: indices of cameras in which nothing moves where the others see the object, or in which too little moves while
            the only other one sees motion.
    """

    frames: tuple[int, int] | None
    is_contradicted: bool
    explanations: tuple[HypothesisFit, ...]
    frozen: dict[int, tuple[int, int]]
    still: tuple[int, ...]

    @property
    def is_rig_wrong(self) -> bool:
        """Whether a mistake is known without which the cameras agree, and no camera is just to be left out."""
        return any(fit.hypothesis.mistake is not Mistake.INCONSISTENT for fit in self.explanations)


def examine_rig(rig: Rig, read_frames: Callable[[], Iterable[FrameSet]]) -> RigFindings:
    """Compare the cameras of a recording in its first moving frames.

    Args:
        rig: the cameras.
        read_frames: returns the frame sets from the first on; called again if the cameras contradict each other.
    """
    evidence = collect_motion(rig, read_frames())
    frozen = find_frozen(evidence.changes)
    still = tuple(c for c in find_still(rig, evidence) if c not in frozen)
    if not evidence.pairs:
        return RigFindings(None, False, (), frozen, still)
    span = evidence.frames[0][0], evidence.frames[-1][1]
    given = compute_f_ratios(rig, evidence.pairs, Hypothesis())
    fit = summarize(Hypothesis(), given, given)
    if not (fit.n_pairs >= MIN_PAIRS and fit.given_ratio > MAX_PAIR_RATIO):
        return RigFindings(span, False, (), frozen, still)
    fits = [
        summarize(hypothesis, compute_f_ratios(rig, evidence.pairs, hypothesis), given)
        for hypothesis in list_hypotheses(rig)
    ]
    explanations = select_explanations(fits)
    # Of two cameras, one that is late may look like other mistakes; of more, only like one that is to be left out.
    if len(rig) == 2 or not any(fit.hypothesis.mistake is not Mistake.INCONSISTENT for fit in explanations):
        lags = _evaluate_lags(rig, read_frames, evidence, given)
        explanations = select_explanations([*fits, *lags])
    if not explanations:
        # Of three or more cameras, one may see something else that moves.
        given = compute_f_ratios(rig, evidence.pairs, Hypothesis(), without_worst=True)
    is_contradicted = bool(explanations) or summarize(Hypothesis(), given, given).given_ratio > MAX_F_RATIO
    return RigFindings(span, is_contradicted, tuple(explanations), frozen, still)


def resolve_orientation(session: Session) -> Session:
    """Return a recording with its frames as coded if the cameras agree only then, else turned as the files specify.

    Calibration programs that are not based on OpenCV or FFmpeg ignore what the files specify.
    """
    coded = use_frames_as_coded(session)
    if not examine_rig(session.rig, session.frames).is_contradicted:
        return session
    if examine_rig(coded.rig, coded.frames).is_contradicted:
        return session
    text = "The files' rotation is not applied: the cameras agree only without it."
    return replace(coded, warnings=(*coded.warnings, text))


def _evaluate_lags(
    rig: Rig, read_frames: Callable[[], Iterable[FrameSet]], evidence: MotionEvidence, given: FloatArray
) -> list[HypothesisFit]:
    """Evaluate whether a camera is late; given are the F ratios (P,) without that."""
    lags = [lag for lag in range(-MAX_LAG, MAX_LAG + 1) if lag]
    shifted = _match_shifted(rig, read_frames(), evidence.frames, lags)
    fits = []
    # Of two cameras, one that is late is the same as the other one that is early.
    for c in range(1 if len(rig) == 2 else 0, len(rig)):
        for lag in lags:
            both = zip(evidence.pairs, shifted[lag], strict=True)
            pairs = [[*pair[:c], later[c], *pair[c + 1 :]] for pair, later in both]
            # Without the camera's matches, the others do not show whether it is late.
            has_matches = np.array([len(pair[c][0]) > 0 for pair in pairs])
            hypothesis = Hypothesis(Mistake.LATE, (c,), lag)
            ratios = np.where(has_matches, compute_f_ratios(rig, pairs, hypothesis), np.nan)
            fits.append(summarize(hypothesis, ratios, given))
    return fits


def find_frozen(changes: BoolArray) -> dict[int, tuple[int, int]]:
    """Find cameras whose images are identical while another camera's images change.

    Args:
        changes: (F - 1, C) whether each camera's image differs from its previous one.

    Returns:
        by camera index, the first and the last of the longest row of identical images.
    """
    found = {}
    for c, column in enumerate(changes.T):
        edges = [-1, *np.flatnonzero(column).tolist(), len(column)]
        begin, end = max(pairwise(edges), key=lambda edge: edge[1] - edge[0])
        rows = changes[begin + 1 : end]
        if len(rows) + 1 >= MIN_FROZEN_FRAMES and rows.all(axis=0).any():
            found[c] = begin + 1, end
    return found


def find_still(rig: Rig, evidence: MotionEvidence) -> list[int]:
    """Find cameras (indices) that see static features only where the others see the object move.

    Of two cameras, it is the one without motion if the other one sees any.
    """
    if not evidence.pairs:
        is_one_of_two = len(rig) == 2 and np.count_nonzero(evidence.sees_motion) == 1
        return np.flatnonzero(~evidence.sees_motion).tolist() if is_one_of_two else []
    both = list(zip(evidence.pairs, evidence.static, strict=True))
    return [c for c in range(len(rig)) if all(_is_still(rig, pair, static[c], c) for pair, static in both)]


def _is_still(rig: Rig, pair: FramePair, static: FloatArray, c: int) -> bool:
    """Return whether a camera without moving matches has static features (n, 2), pixels, at the place of the object."""
    if len(pair[c][0]):
        return False
    views = [(camera, x) for camera, (x, _) in zip(rig, pair, strict=True) if len(x)]
    middles = [np.median(x, axis=0) for _, x in views]
    rays = [camera.rays(middle[None])[0] for (camera, _), middle in zip(views, middles, strict=True)]
    center = intersect_rays([camera.center for camera, _ in views], rays)
    sizes = [
        np.median(np.linalg.norm(x - middle, axis=1)) / camera.focal * np.linalg.norm(center - camera.center)
        for (camera, x), middle in zip(views, middles, strict=True)
    ]
    camera = rig.cameras[c]
    radius = float(np.median(sizes)) * camera.focal / max(float(np.linalg.norm(center - camera.center)), 1e-12)
    # NaN behind the camera: no feature is near.
    return int((np.linalg.norm(static - camera.project(center[None]), axis=1) < radius).sum()) >= MIN_MATCHES


# --- matches of what moves --------------------------------------------------------------------------------------------


def collect_motion(rig: Rig, frames: Iterable[FrameSet]) -> MotionEvidence:
    """Match what moves in the first frames.

    The frames of a pair are so far from each other that what moves has moved by `MIN_MOTION`, or else the best of `GAPS`;
    each pair begins where the last one ends.
    """
    cameras = [CameraTracker(c, camera) for c, camera in enumerate(rig)]
    chosen, tried = list[_TriedPair](), list[_TriedPair]()
    sees_motion, changes = np.zeros(len(rig), bool), list[list[bool]]()
    first: tuple[int, list[CameraFrame]] | None = None
    previous: FrameSet | None = None
    with closing(_make_executor(rig)) as executor:
        for k, images in enumerate(frames):
            if k >= (MAX_COMPARED_FRAMES if len(chosen) == MAX_PAIRS else TrackingOptions.max_buffered_frames):
                break
            if previous is not None:
                changes.append([not _are_identical(*own) for own in zip(previous.images, images.images, strict=True)])
            previous = images
            if len(chosen) == MAX_PAIRS or (first is not None and k - first[0] not in _list_gaps(chosen)):
                continue
            current = executor.run(partial(_detect, images), cameras)
            if first is not None:
                tried.append(_measure(cameras, (first[0], k), first[1], current))
                sees_motion |= [len(x) > 0 for x, _ in tried[-1].pair]
                if tried[-1].motion < MIN_MOTION and k - first[0] < GAPS[-1]:
                    continue
                chosen += _select_best(tried)
                tried = []
            first = k, current
    chosen = [*chosen, *_select_best(tried)][:MAX_PAIRS]
    return MotionEvidence(
        tuple(own.frames for own in chosen),
        tuple(own.pair for own in chosen),
        tuple(own.static for own in chosen),
        sees_motion,
        np.array(changes, bool).reshape(-1, len(rig)),
    )


class _TriedPair(NamedTuple):
    """Pair of frames that may be compared.

    Attributes:
        frames: numbers (i, j).
        pair: moving matches.
        static: C: pixels (n, 2) of the features that do not move.
        motion: median displacement in image diagonals, of the camera with the second largest.
        information: its square times the number of matches, likewise.
    """

    frames: tuple[int, int]
    pair: FramePair
    static: Sequence[FloatArray]
    motion: float
    information: float


def _select_best(tried: Sequence[_TriedPair]) -> list[_TriedPair]:
    """Return the pair of frames with most information, if two cameras see the motion."""
    best = max(tried, key=lambda own: own.information, default=None)
    return [best] if best is not None and best.information > 0 else []


def _are_identical(image: Image | None, other: Image | None) -> bool:
    return image is not None and other is not None and np.array_equal(image, other)


def _list_gaps(chosen: Sequence[_TriedPair]) -> list[int]:
    """Return the numbers of frames between those of the next pair: what moves slowly does not become fast at once."""
    last = chosen[-1].frames[1] - chosen[-1].frames[0] if chosen else 0
    return [gap for gap in GAPS if 2 * gap >= last]


def _make_executor(rig: Rig) -> LocalExecutor:
    return LocalExecutor(len(rig), min(len(rig), os.cpu_count() or 1))


def _detect(images: FrameSet, camera: CameraTracker) -> CameraFrame:
    max_features = TrackingOptions.max_start_features
    features = camera.detect(camera.view_of(images), None, max_features, max_pixels=MAX_SEARCH_PIXELS)
    return camera.create_frame(features)


def _measure(
    cameras: Sequence[CameraTracker],
    frames: tuple[int, int],
    first: Sequence[CameraFrame],
    second: Sequence[CameraFrame],
) -> _TriedPair:
    """Match two frames and measure the motion between them."""
    matched = [
        _match_moving(camera, frames[0], *own)
        for camera, own in zip(cameras, zip(first, second, strict=True), strict=True)
    ]
    motion, information = [0.0, 0.0], [0.0, 0.0]
    for camera, ((x, y), _) in zip(cameras, matched, strict=True):
        if len(x):
            motion.append(float(np.median(np.linalg.norm(y - x, axis=1)) / np.hypot(*camera.camera.size)))
            information.append(len(x) * motion[-1] ** 2)
    pair, static = [matches for matches, _ in matched], [pixels for _, pixels in matched]
    return _TriedPair(frames, pair, static, sorted(motion)[-2], sorted(information)[-2])


def _match_moving(
    camera: CameraTracker, number: int, first: CameraFrame, second: CameraFrame
) -> tuple[CameraMatches, FloatArray]:
    """Match what moves between two frames of a camera.

    Returns:
        the matches, none if they are mismatches or displaced by little; pixels (m, 2) of static features.
    """
    pair = match_frames(number, first, second)
    is_static, is_rigid = find_rigid_motion(camera.camera, pair, TrackingOptions())
    moving = pair.subset(~is_static if is_rigid else np.zeros(len(pair), bool))
    return (moving.pixels_i, moving.pixels_j), pair.pixels_i[is_static]


def _match_shifted(
    rig: Rig, frames: Iterable[FrameSet], numbers: Sequence[tuple[int, int]], lags: Sequence[int]
) -> dict[int, list[FramePair]]:
    """Match what moves between the same frames, all later by a lag; without matches where there are no such frames."""
    cameras = [CameraTracker(c, camera) for c, camera in enumerate(rig)]
    wanted = {k + lag for pair in numbers for k in pair for lag in lags}
    with closing(_make_executor(rig)) as executor:
        detected = {
            k: executor.run(partial(_detect, images), cameras)
            for k, images in enumerate(islice(frames, max(wanted) + 1))
            if k in wanted
        }
    nothing = [(np.empty((0, 2)), np.empty((0, 2)))] * len(rig)
    return {
        lag: [
            _measure(cameras, (i + lag, j + lag), detected[i + lag], detected[j + lag]).pair
            if i + lag in detected and j + lag in detected
            else nothing
            for i, j in numbers
        ]
        for lag in lags
    }


# --- descriptions ------------------------------------------------------------------------------------------------------


def describe_findings(session: Session, findings: RigFindings) -> list[str]:
    """Describe what the first frames show of the rig, and what to do; empty without a problem."""
    names = session.rig.names
    found = [
        f"{names[c]}: the images of frames {begin} to {end} are identical, while other cameras see changes. If it sees the "
        f"object, its video is frozen: record again, or exclude it (--exclude-camera {names[c]})."
        for c, (begin, end) in findings.frozen.items()
    ]
    seen = (
        "too little moves to compare it with the other camera"
        if len(names) == 2
        else "nothing moves at the object's place"
    )
    found += [
        f"{names[c]}: {seen}. Its video may be frozen or show a picture, or the object is hidden from it."
        for c in findings.still
    ]
    if not findings.is_contradicted or findings.frames is None:
        return found
    begin, end = findings.frames
    start = f"The cameras contradict each other in what moves from frame {begin} to {end}"
    explanations = [describe_mistake(session, fit.hypothesis) for fit in findings.explanations]
    if not explanations:
        return [
            *found,
            f"{start}, and no usual mistake explains it. Check that the calibration belongs to these images (camera names, "
            "lenses, moved cameras) and that the cameras are synchronized (sylpose sync). Several moving things, and bodies "
            "that are not rigid, have the same effect.",
        ]
    if len(explanations) == 1:
        return [*found, f"{start}. They agree if {explanations[0]}"]
    listed = " Or ".join(f"({k}) {text}" for k, text in enumerate(explanations, 1))
    return [
        *found,
        f"{start}. They agree in {len(explanations)} cases, which this motion does not distinguish: {listed}",
    ]


def describe_mistake(session: Session, hypothesis: Hypothesis) -> str:
    """Describe a mistake and its remedy, to follow "They agree if"."""
    names, mistake = session.rig.names, hypothesis.mistake
    calibration = session.calibration.name
    if mistake is Mistake.EXCHANGED:
        moved = [c for c, source in enumerate(hypothesis.cameras) if source != c]
        paths = {c: session.sources[hypothesis.cameras.index(c)].path for c in moved}
        options = " ".join(f"--video {names[c]}={shlex.quote(path.name)}" for c, path in paths.items())
        return f"the videos of {_join([names[c] for c in moved])} are exchanged: {options}."
    if mistake is Mistake.INVERTED:
        return f"{calibration} contains the inverse poses: it holds world_from_camera instead of camera_from_world."
    if mistake is Mistake.OPENGL:
        return (
            f"{calibration} has the camera axes of OpenGL or Blender (y up, z backwards): change the signs of the second "
            "and the third row of each camera_from_world."
        )
    if mistake is Mistake.INVERTED_OPENGL:
        return (
            f"{calibration} contains the inverse poses (world_from_camera) with the camera axes of OpenGL or Blender, y up "
            "and z backwards: change the signs of the second and the third column, then invert the poses."
        )
    if mistake in IMAGE_MISTAKES:
        seen, ffmpeg = IMAGE_MISTAKES[mistake]
        whose = f"the images of {names[hypothesis.cameras[0]]}" if hypothesis.cameras else "all images"
        text = f"{whose} are {seen}: convert the videos (ffmpeg -i IN -vf {ffmpeg} OUT)"
        if mistake is Mistake.FLIPPED:
            return (
                f"{text}; or if {calibration} is of a left-handed world with y up (Unity): reverse the second row and the "
                "second column of each camera_from_world."
            )
        return f"{text}, or calibrate with images like these."
    (c,) = hypothesis.cameras
    if mistake is Mistake.LATE:
        when, lag = ("late", hypothesis.lag) if hypothesis.lag > 0 else ("early", -hypothesis.lag)
        others = f"relative to {names[1 - c]}" if len(names) == 2 else "relative to the others"
        return (
            f"{names[c]} is {when} by {lag} frame{'s' if lag > 1 else ''} {others}: --frame-offset "
            f"{names[c]}={-hypothesis.lag}; sylpose sync measures fractions."
        )
    return (
        f"{names[c]} is left out (--exclude-camera {names[c]}). It has moved, has another lens or calibration, shows other "
        "images or something else that moves, or is not synchronized: calibrate it again, or try sylpose sync."
    )


def _join(names: Sequence[str]) -> str:
    return f"{', '.join(names[:-1])} and {names[-1]}"
