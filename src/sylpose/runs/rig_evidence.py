"""Evidence in a recording for or against its rig: do the cameras agree, and if not, why.

Compared are features that move in windows of frames spread over the recording, whatever they belong to: neither boxes nor
a motion that was found under the given rig are used, since both are wrong if the rig is.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from heapq import nlargest
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from sylpose.features.sift import enlarge_image
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.io.capture import Session
from sylpose.io.capture.session import use_frames_as_coded
from sylpose.relative_pose.camera_evidence import (
    MAX_POOLED_F_RATIO,
    MIN_MATCHES,
    MIN_POOLED,
    MIN_REDUCTION,
    explains_as_well,
    pool_f_ratios,
)
from sylpose.relative_pose.rig_hypotheses import (
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
from sylpose.rig import Camera, Rig, intersect_rays
from sylpose.runs.candidates import ReadFrames, list_frames, read_windows
from sylpose.runs.options import RunOptions
from sylpose.tracking.bodies import (
    GAPS,
    N_WINDOWS,
    SearchContext,
    find_rigid_motion,
    open_search,
    reduce_frame_set,
)
from sylpose.tracking.camera_side.frame import CameraFrame, match_frames
from sylpose.tracking.context import Frame
from sylpose.tracking.joint_side.joint_state import JointState, Nudge
from sylpose.tracking.options import TrackingOptions
from sylpose.tracking.state_machine import compensate_camera_motion
from sylpose.units import METERS

# Median displacement of what moves between the frames of a pair, as a share of the image's diagonal (choice: 24 pixels of
# 640x480; the rotation of a small one shows nothing of the rig).
MIN_MOTION = 0.03
# A camera may be late or early by so many frames (choice).
MAX_LAG = 3
# So many identical images in a row are a frozen picture (choice).
MIN_FROZEN_FRAMES = 6

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
    """What moves in a recording.

    Attributes:
        frames: numbers (i, j) of the frames of each pair.
        pairs: P pairs: matches of moving features, of the cameras that see a rigid motion.
        static: P, C: pixels (n, 2) of the features that do not move.
        sees_motion: (C,) cameras that see a rigid motion between any two frames that were tried.
        numbers: (F,) of all frames that were read.
        has_image: (F, C) whether each camera has an image; repeated and black pictures have been removed.
        nudges: rotations of cameras; their later images are rotated back before matching.
    """

    frames: tuple[tuple[int, int], ...]
    pairs: tuple[FramePair, ...]
    static: tuple[Sequence[FloatArray], ...]
    sees_motion: BoolArray
    numbers: IntArray
    has_image: BoolArray
    nudges: tuple[Nudge, ...] = ()


@dataclass(frozen=True, eq=False)
class RigFindings:
    """What a recording shows of a rig.

    Attributes:
        frames: numbers of the first and the last frame compared; None if too little moves.
        exceeds_limit: whether the F ratio exceeds the limit of the tracker.
        explanations: the mistakes that explain a contradiction equally well, best first; empty if none does, or too many.
        suspect: without explanations, index of the camera without which the median F ratio is least, if that is clear.
        frozen: by camera index, the first and the last frame without a new image while others have one.
        still: indices of cameras in which nothing moves where the others see the object, or in which too little moves while
            the only other one sees motion.
        nudges: rotations of cameras.
    """

    frames: tuple[int, int] | None
    exceeds_limit: bool = False
    explanations: tuple[HypothesisFit, ...] = ()
    suspect: int | None = None
    frozen: Mapping[int, tuple[int, int]] = field(default_factory=dict)
    still: tuple[int, ...] = ()
    nudges: tuple[Nudge, ...] = ()

    @property
    def is_contradicted(self) -> bool:
        """Whether the cameras contradict each other, so that poses would be wrong."""
        return self.exceeds_limit or self.is_rig_wrong

    @property
    def is_rig_wrong(self) -> bool:
        """Whether a mistake is known without which the cameras agree, and no camera is just to be left out."""
        return any(fit.hypothesis.mistake is not Mistake.INCONSISTENT for fit in self.explanations)


def examine_rig(rig: Rig, numbers: range, read: ReadFrames, f_ratio: float = np.nan) -> RigFindings:
    """Compare the cameras of a recording in what moves.

    Args:
        rig: the cameras.
        numbers: of the frames that are tracked.
        read: reads some of them, see `list_frames`; called again if the cameras contradict each other.
        f_ratio: by which the cameras contradict each other in the motion of the object alone; NaN if unknown. It decides
            where no mistake explains a contradiction: other things may move as well.
    """
    evidence = collect_motion(rig, read_windows(numbers, read))
    frozen = find_frozen(evidence)
    still = tuple(c for c in find_still(rig, evidence) if c not in frozen)
    findings = RigFindings(None, frozen=frozen, still=still, nudges=evidence.nudges)
    if not evidence.pairs:
        return findings
    span = evidence.frames[0][0], max(last for _, last in evidence.frames)
    given = compute_f_ratios(rig, evidence.pairs, Hypothesis())
    if not np.fmax(pool_f_ratios(given), f_ratio) > MAX_POOLED_F_RATIO:
        return replace(findings, frames=span)
    fits = [
        summarize(hypothesis, compute_f_ratios(rig, evidence.pairs, hypothesis), given)
        for hypothesis in list_hypotheses(rig)
    ]
    explanations = select_explanations(fits)
    # Of two cameras, one that is late may look like other mistakes; of more, only like one that is to be left out.
    is_found = len(rig) > 2 and any(fit.hypothesis.mistake is not Mistake.INCONSISTENT for fit in explanations)
    # Images at other times are not rotated back.
    if not (is_found or evidence.nudges):
        lags = _evaluate_lags(rig, numbers, read, evidence, given)
        explanations = select_explanations([*fits, *lags])
    if len(explanations) > 1 and all(fit.hypothesis.mistake is Mistake.INCONSISTENT for fit in explanations):
        # Any two cameras nearly agree: the one without which they do so best is a suspect only.
        explanations = []
    if np.isnan(f_ratio):
        f_ratio = float(pool_f_ratios(given))
    suspect = None if explanations else find_suspect(fits)
    is_exceeded = f_ratio > MAX_POOLED_F_RATIO
    return replace(findings, frames=span, exceeds_limit=is_exceeded, explanations=tuple(explanations), suspect=suspect)


def resolve_orientation(session: Session) -> Session:
    """Return a recording with its frames as coded if the cameras agree only then, else turned as the files specify.

    Calibration programs that are not based on OpenCV or FFmpeg ignore what the files specify.
    """
    coded = use_frames_as_coded(session)
    found = (examine_rig(own.rig, *list_frames(own, RunOptions())).is_contradicted for own in (session, coded))
    if not next(found) or next(found):
        return session
    text = "The files' rotation is not applied: the cameras agree only without it."
    return replace(coded, warnings=(*coded.warnings, text))


def _evaluate_lags(
    rig: Rig, numbers: range, read: ReadFrames, evidence: MotionEvidence, given: FloatArray
) -> list[HypothesisFit]:
    """Evaluate whether a camera is late; given are the F ratios (P,) without that."""
    lags = [lag for lag in range(-MAX_LAG, MAX_LAG + 1) if lag]
    shifted = _match_shifted(rig, numbers, read, evidence.frames, lags)
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


def find_suspect(fits: Sequence[HypothesisFit]) -> int | None:
    """Find the camera without which the F ratio is least, of the fits of all hypotheses, if no other one comes near."""
    left_out = [fit for fit in fits if fit.hypothesis.mistake is Mistake.INCONSISTENT]
    best, *others = sorted(left_out, key=lambda fit: fit.f_ratio) or (None,)
    if best is None or best.n_pairs < MIN_POOLED:
        return None
    if not best.given_ratio > max(MIN_REDUCTION * best.f_ratio, MAX_POOLED_F_RATIO):
        return None
    is_clear = not others or not explains_as_well(others[0].f_ratio, best.f_ratio)
    return best.hypothesis.cameras[0] if is_clear else None


def find_frozen(evidence: MotionEvidence) -> dict[int, tuple[int, int]]:
    """Find cameras without a new image in many frames in a row while another camera has one in each.

    Returns:
        by camera index, the first and the last frame of the longest row.
    """
    found = {}
    for c, column in enumerate(evidence.has_image.T):
        edges = [-1, *np.flatnonzero(column).tolist(), len(column)]
        begin, end = max(pairwise(edges), key=lambda edge: edge[1] - edge[0])
        rows = evidence.has_image[begin + 1 : end]
        if len(rows) >= MIN_FROZEN_FRAMES and rows.all(axis=0).any():
            found[c] = int(evidence.numbers[begin + 1]), int(evidence.numbers[end - 1])
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


def collect_motion(rig: Rig, windows: Iterable[Sequence[FrameSet]]) -> MotionEvidence:
    """Match what moves in windows of frames.

    A pair is the first frame of a window and one in which what moves has moved by `MIN_MOTION`, or else the best of `GAPS`.
    """
    chosen, sees_motion, gap = list[_TriedPair](), np.zeros(len(rig), bool), 0
    shown, known, state = dict[int, list[bool]](), dict[int, FrameSet](), JointState()
    with open_search(rig) as context:
        for window in filter(len, windows):
            known = {images.index: known[images.index] for images in window if images.index in known}
            for images in (own for own in window if own.index not in known):
                shown[images.index] = [image is not None for image in images.images]
                state, known[images.index] = _stabilize(context, state, images)
            frames = [known[images.index] for images in window]
            first, tried = context.detect_frame(frames[0].index, frames[0]), list[_TriedPair]()
            # What moves slowly does not become fast at once.
            for last in (frames[g] for g in GAPS if gap <= 2 * g < 2 * len(frames)):
                tried.append(_measure(rig, first, context.detect_frame(last.index, last)))
                sees_motion |= [len(x) > 0 for x, _ in tried[-1].pair]
                if tried[-1].motion >= MIN_MOTION:
                    break
            best = max(tried, key=lambda own: own.information, default=None)
            # Two cameras see the motion.
            if best is not None and best.information > 0:
                chosen.append(best)
                gap = best.frames[1] - best.frames[0]
    # Long recordings have more windows; all hypotheses are evaluated in each pair.
    chosen = sorted(nlargest(N_WINDOWS, chosen, key=lambda own: own.information), key=lambda own: own.frames)
    return MotionEvidence(
        tuple(own.frames for own in chosen),
        tuple(own.pair for own in chosen),
        tuple(own.static for own in chosen),
        sees_motion,
        np.array([*shown]),
        np.array([*shown.values()]).reshape(-1, len(rig)),
        state.nudges,
    )


def _stabilize(context: SearchContext, state: JointState, images: FrameSet) -> tuple[JointState, FrameSet]:
    """Detect rotations of cameras in the next frame set, which is downscaled.

    Images of such cameras are rotated back, and removed while the rotation is not confirmed.
    """
    both = zip(context.rig, images.images, strict=True)
    enlarged = [image if image is None else enlarge_image(image, camera.size) for camera, image in both]
    state, stable = compensate_camera_motion(context, state, replace(images, images=tuple(enlarged)))
    moved = {nudge.camera for nudge in state.nudges}
    kept = tuple(
        after if after is None or c in moved else before
        for c, (before, after) in enumerate(zip(images.images, stable.images, strict=True))
    )
    return state, reduce_frame_set(replace(images, images=kept, masks=stable.masks))


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


def _measure(rig: Rig, first: Frame, second: Frame) -> _TriedPair:
    """Match two frames and measure the motion between them."""
    sides = zip(rig, first.cameras, second.cameras, strict=True)
    matched = [_match_moving(camera, first.number, *own) for camera, *own in sides]
    motion, information = [0.0, 0.0], [0.0, 0.0]
    for camera, ((x, y), _) in zip(rig, matched, strict=True):
        if len(x):
            motion.append(float(np.median(np.linalg.norm(y - x, axis=1)) / np.hypot(*camera.size)))
            information.append(len(x) * motion[-1] ** 2)
    pair, static = [matches for matches, _ in matched], [pixels for _, pixels in matched]
    return _TriedPair((first.number, second.number), pair, static, sorted(motion)[-2], sorted(information)[-2])


def _match_moving(
    camera: Camera, number: int, first: CameraFrame, second: CameraFrame
) -> tuple[CameraMatches, FloatArray]:
    """Match what moves between two frames of a camera.

    Returns:
        the matches, none if they are mismatches or displaced by little; pixels (m, 2) of static features.
    """
    pair = match_frames(number, first, second)
    is_static, is_rigid = find_rigid_motion(camera, pair, TrackingOptions())
    moving = pair.subset(~is_static if is_rigid else np.zeros(len(pair), bool))
    return (moving.pixels_i, moving.pixels_j), pair.pixels_i[is_static]


def _match_shifted(
    rig: Rig, numbers: range, read: ReadFrames, frames: Sequence[tuple[int, int]], lags: Sequence[int]
) -> dict[int, list[FramePair]]:
    """Match what moves between the same frames, all later by a lag; without matches where there are no such frames."""
    wanted = {k + lag for pair in frames for k in pair for lag in lags}
    available = sorted(k for k in wanted if numbers.start <= k < numbers.stop)
    with open_search(rig) as context, closing(read(available)) as reader:
        detected = {images.index: context.detect_frame(images.index, reduce_frame_set(images)) for images in reader}
    nothing = [(np.empty((0, 2)), np.empty((0, 2)))] * len(rig)
    return {
        lag: [
            _measure(rig, detected[i + lag], detected[j + lag]).pair
            if i + lag in detected and j + lag in detected
            else nothing
            for i, j in frames
        ]
        for lag in lags
    }


# --- descriptions ------------------------------------------------------------------------------------------------------


def describe_findings(session: Session, findings: RigFindings) -> list[str]:
    """Describe what a recording shows of the rig, and what to do; empty without a problem."""
    names = session.rig.names
    found = [
        f"{names[c]}: no new picture from frame {begin} to {end}, while other cameras have some. Its video is frozen or "
        f"black: record again, or exclude it (--exclude-camera {names[c]})."
        for c, (begin, end) in findings.frozen.items()
        if (session.timeline.frames[begin : end + 1, c] >= 0).all()
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
    found += [
        f"{names[nudge.camera]} seems to have been moved before frame {nudge.frame}: what it sees turned by "
        f"{np.degrees(nudge.angle):.2g} degrees as a whole. `sylpose track` rotates its images back; calibrate it again for "
        "later recordings."
        for nudge in findings.nudges
    ]
    if findings.frames is None or not (findings.is_contradicted or findings.explanations):
        return found
    begin, end = findings.frames
    start = f"The cameras contradict each other in what moves from frame {begin} to {end}"
    explanations = [describe_mistake(session, fit.hypothesis) for fit in findings.explanations]
    if not explanations:
        suspect = None if findings.suspect is None else names[findings.suspect]
        remedy = (
            "Check that the calibration belongs to these images (camera names, lenses, moved cameras), or calibrate again"
            if suspect is None
            else f"They do so least without {suspect}: calibrate it again, or exclude it (--exclude-camera {suspect})"
        )
        return [
            *found,
            f"{start}, and no usual mistake explains it. {remedy}, and check that the cameras are synchronized (sylpose "
            "sync). Several moving things, and bodies that are not rigid, have the same effect.",
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
    if mistake is Mistake.UNIT:
        own, others = hypothesis.units
        return (
            f"the position of {names[c]} in {calibration} is in {own} and those of the others in {others}, or in units of "
            f"the same ratio: multiply its translation by {METERS[own] / METERS[others]:.6g}."
        )
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
