"""Finding an object's pose in a frame: where it should be, or anywhere. Nothing that is found is learnt here.

What is looked at is each camera's own; that all of them come to the same pose follows from what they tell each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.features.sift import MAX_FEATURES, Features
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.matrices import covariance_of
from sylpose.geometry.rigid import turn_between, turn_of
from sylpose.geometry.robust_loss import SIGMA_OF_MEDIAN
from sylpose.landmarks.landmark_filter import Landmarks
from sylpose.landmarks.landmark_table import LandmarkTable
from sylpose.relative_pose.motion import motion_about
from sylpose.results import Status
from sylpose.rig import Rig
from sylpose.tracking.camera_executor import Crew
from sylpose.tracking.context import Region, Team
from sylpose.tracking.frame import CameraFrame, Frame, Pair, Sought, inliers_of, sought_in, still, without_background
from sylpose.tracking.frame_solvers import Agreement, Problem, Solution
from sylpose.tracking.joint_state import Joint
from sylpose.tracking.keyframes import references_of, viewpoints
from sylpose.tracking.klt_frontend import FEATURES as ANCHOR_FEATURES
from sylpose.tracking.klt_frontend import SOON, Followed, suffices, with_new
from sylpose.tracking.relocalization import LOOSE_RATIO, RATIO, pose_of, recognised, to_try
from sylpose.tracking.reobserved import have_moved
from sylpose.tracking.reports import Ages, Agreed, Following, Recognised

__all__ = [
    "WAIT_FOR_MORE",
    "Found",
    "followed_from_anchor",
    "is_a_corner",
    "is_fast",
    "is_the_same",
    "looked_for",
    "matched",
    "noise_of",
    "on_the_move",
    "recognised_anywhere",
    "solved_from",
]

# Features per camera that are detected where features are followed (choice).
KLT_FEATURES = 400
# An object that turns by more than this from frame to frame, radians, shows another side in each (measured:
# benchmarks/loops.py, where more features at 7.6 degrees a frame were no gain) (choice).
FAST_TURN = np.radians(10.0)
# With a turn less certain than this (radians), an object that was missed is not taken as found, for so many frames at
# most (choice).
AGAIN_SD, WAIT_FOR_MORE = 0.005, 2
# A pose found again must be the one that relocalisation found: within this turn (radians) and share of the
# radius (choice).
AGAIN_TURN, AGAIN_SHIFT = 0.17, 0.3
# After so many frames in a row it is known how the object moves (choice).
KNOWN_SPEED = 1
# Matches that are off by this share of the object's radius in the image (root mean square), and by so many pixels, agree
# with anything (choice).
NOISE, NOISE_PX = 0.03, 3.0
# Times that a frame is solved where its cameras' instants differ, each time with the speed that the one before
# found (choice).
SPEED_ROUNDS = 2


@dataclass(frozen=True, eq=False)
class Found:
    """A frame's motion since the last one, and what it was found from.

    Attributes:
        frame: not solved yet.
        rig: the cameras as they stood for it.
        pairs: by camera, each its own: the matches.
        solution: see there.
        motion: of the object since the last solved frame.
        agreed: by camera, what of its matches agrees.
        regions: where it was looked for.
        followed: by camera, each its own: its first features, if they were followed.
        anew: whether it has others, to be matched by their looks.
        first: by camera, each its own: the landmarks of the first frame, where this one tells better where they are.
    """

    frame: Frame
    rig: Rig
    pairs: Sequence[Sequence[Pair]]
    solution: Solution
    motion: RigidTransform
    agreed: Sequence[Agreed]
    regions: Sequence[Region]
    followed: Sequence[Followed] | None
    anew: bool
    first: Sequence[Landmarks] | None = None

    def standing(self) -> Found:
        """The same, taken to show no motion."""
        solution = replace(self.solution, status=Status.NO_MOTION)
        return replace(self, solution=solution, motion=RigidTransform.identity(), first=None)

    @property
    def matches(self) -> int:
        """Number of matches that agree."""
        return sum(a.matches for a in self.agreed)


def followed_from_anchor(
    team: Team, joint: Joint, frames: FrameSet, ahead: RigidTransform, regions: Sequence[Region]
) -> tuple[list[Followed], int, bool, bool]:
    """By camera, each its own: the anchor's features in the next images; and of all cameras, how many they are, whether they
    suffice to do without others, and whether they soon may not."""
    assert joint.anchor is not None
    last, radius = joint.base.world_from_object, joint.object.radius
    followed = team.crew.each(
        lambda c: team.parts[c].follow(last, ahead, frames.images[c], frames.masks[c], radius), long=True
    )
    reports = team.crew.ask(lambda c: followed[c].report(regions[c]), Following.none())
    # While the next anchor is prepared, less is enough.
    least = 1.0 if joint.renewal is None else 1.0 / SOON
    enough, plenty = (suffices(reports, joint.anchor, ahead, margin) for margin in (least, SOON))
    return followed, sum(report.found for report in reports), enough, not plenty


def is_fast(joint: Joint, ahead: RigidTransform) -> bool:
    """Whether the next frame shows another side of the object than the last one (at world_from_object as predicted), or may
    do so for all that is known."""
    turn = np.linalg.norm(turn_between(joint.base.world_from_object, ahead))
    return bool(not joint.velocity.frames or joint.missed > 0 or turn > FAST_TURN)


def looked_for(
    team: Team,
    joint: Joint,
    frames: FrameSet,
    ahead: RigidTransform,
    regions: Sequence[Region],
    followed: Sequence[Followed] | None,
) -> list[Features]:
    """By camera, each its own: the features in the object's regions, after those that were followed; faint ones too, where
    the others hardly suffice.

    Args:
        ahead: world_from_object as predicted.
    """
    # Where features are not seen for long, following is worth little, and every frame has to have enough of them.
    most = (
        (KLT_FEATURES, ANCHOR_FEATURES) if team.follows and not is_fast(joint, ahead) else (MAX_FEATURES, MAX_FEATURES)
    )
    detected = team.detect(frames, regions, most[0], faint=joint.starves)
    if followed is None:
        return detected
    return team.crew.each(
        lambda c: with_new(followed[c], detected[c], team.parts[c].known_background(detected[c]), most[1])
    )


def matched(
    team: Team,
    joint: Joint,
    frame: Frame,
    guess: RigidTransform,
    followed: Sequence[Followed] | None = None,
    *,
    anew: bool = True,
) -> list[list[Pair]]:
    """By camera, each its own: matches with the anchor, of what was followed, and, of what is new, with the last solved
    frame and with keyframes that show the object from about the same side.

    Args:
        guess: world_from_object.
        anew: whether there is anything new.
    """
    here, last = viewpoints(team.rig, guess), joint.base if followed is None else None

    def of(c: int) -> list[Pair]:
        pairs = [followed[c].pair()] if followed is not None and len(followed[c]) else []
        if anew:
            references = [*([] if last is None else [last]), *references_of(joint.keyframes, c, here[c], last)]
            pairs += team.parts[c].match(frame.cameras[c], [reference.number for reference in references])
        team.parts[c].sought = sought_in(frame.cameras[c].features, pairs)
        return pairs

    pairs = team.crew.each(of, long=anew)
    return on_the_move(team, joint, frame, pairs, guess) if joint.velocity.frames >= KNOWN_SPEED else pairs


def on_the_move(
    team: Team, joint: Joint, frame: Frame, pairs: Sequence[Sequence[Pair]], ahead: RigidTransform
) -> list[list[Pair]]:
    """By camera, each its own: the matches without those that are seen to be background by how the object goes on: to be
    at `ahead` (world_from_object)."""
    poses, radius = {number: solved.world_from_object for number, solved in joint.known.items()}, joint.object.radius

    def of(c: int) -> list[Pair]:
        seen = frame.cameras[c], team.rig.cameras[c]
        kept = [without_background(pair, *seen, poses[pair.reference], ahead, radius) for pair in pairs[c]]
        return [pair for pair in kept if len(pair)]

    return team.crew.each(of)


def solved_from(
    team: Team,
    joint: Joint,
    frame: Frame,
    pairs: Sequence[Sequence[Pair]],
    guess: RigidTransform,
    regions: Sequence[Region],
    followed: Sequence[Followed] | None = None,
    *,
    anew: bool = True,
) -> Found | None:
    """A frame's pose by its matches, from a guess (world_from_object); None if it cannot be found from there."""
    base, velocity, crew = joint.base, joint.velocity, team.crew
    center, elapsed = base.world_from_object.translation, frame.time - base.time
    speed, first = velocity.motion(elapsed), None
    for _ in range(SPEED_ROUNDS):
        rig = velocity.rig_seen_at_once(team.rig, frame.late, center, speed, elapsed)
        motion = guess * base.world_from_object.inv()
        hypothesis = (turn_of(motion), motion.apply(center) - center)
        radius = joint.object.radius
        problem = Problem(rig, base, joint.known, radius, hypothesis, team.seed, frame.cameras, pairs)
        solution = team.solve(crew, problem)
        if not solution.status.has_pose or (solution.status is Status.NO_MOTION and joint.missed):
            return None
        if not joint.lost and solution.status is not Status.NO_MOTION:
            known = solution.rotation, solution.shift, solution.information
            rotation, shift, information = velocity.added_to(*known, center, elapsed)
            solution = replace(solution, rotation=rotation, shift=shift, information=information)
        speed = motion = motion_about(center, solution.rotation, solution.shift)
        guess = motion * base.world_from_object
        if not frame.late.any():
            break
        # The cameras' instants were accounted for with the speed of the frame before; now this frame's is known, and
        # after the first motion also the first frame's.
        if base.number == joint.keyframes[0].number and len(joint.keyframes) == 1:
            first = _first_relearnt(team, joint, velocity.rig_seen_at_once(team.rig, base.late, center, speed, elapsed))
            pairs = _with_first(crew, pairs, base.number, first)
    agreement = solution.agreement
    agreed = crew.ask(lambda c: _agreed(pairs[c], agreement[c], frame.cameras[c]), Agreed.none())
    noise = solution.status is not Status.NO_MOTION and _is_noise(team, joint, guess, agreed)
    return None if noise else Found(frame, rig, pairs, solution, motion, agreed, regions, followed, anew, first)


def _is_noise(team: Team, joint: Joint, pose: RigidTransform, agreed: Sequence[Agreed]) -> bool:
    """Whether what agrees with a pose (world_from_object) does so in no camera any better than anything else would."""
    limit = [max(NOISE * team.radius_px(joint, c, pose), NOISE_PX) for c in range(len(team.rig))]
    noise = np.array([a.residual_px for a in agreed])
    return bool((np.isnan(noise) | (noise > limit)).all())


def _first_relearnt(team: Team, joint: Joint, seen_from: Rig) -> list[Landmarks]:
    """By camera, each its own: the landmarks of the first frame, by cameras as they stood for it."""
    first, cloud, radius = joint.base, joint.object.points, joint.object.radius
    return team.crew.each(
        lambda c: team.parts[c].relearnt(first.number, seen_from.cameras[c], first.world_from_object, cloud, radius)
    )


def _with_first(
    crew: Crew, pairs: Sequence[Sequence[Pair]], number: int, landmarks: Sequence[Landmarks]
) -> list[list[Pair]]:
    """The pairs, with other landmarks of the first frame."""

    tables = crew.each(lambda c: LandmarkTable.holding(landmarks[c]))

    def of(c: int) -> list[Pair]:
        return [
            replace(pair, earlier=replace(pair.earlier, table=tables[c])) if pair.reference == number else pair
            for pair in pairs[c]
        ]

    return crew.each(of)


def _agreed(pairs: Sequence[Pair], agreement: Agreement, current: CameraFrame) -> Agreed:
    """What a camera tells the others of a solution."""
    inliers = inliers_of(pairs, [w for w, _ in agreement])
    squares = np.concatenate([np.empty(0), *(r[w > 0] ** 2 for w, r in agreement)])
    indices = _features_of([pair.indices for pair in inliers])
    tried, landmarks = _features_of([pair.indices for pair in pairs]), [pair.landmarks for pair in pairs]
    agrees = np.concatenate([np.empty(0, bool), *(w > 0 for w, _ in agreement)])
    every = Landmarks.concatenate(landmarks)
    known = every.subset(agrees)
    moves = np.concatenate([np.empty(0, bool), *(~still(pair) for pair in inliers)])
    return Agreed(
        matches=len(indices),
        tried=len(tried),
        references=tuple(pair.reference for pair in pairs),
        weights=tuple(float(w.sum()) for w, _ in agreement),
        ages=Ages.of(known.seen.astype(float)),
        features=_different(indices),
        moved=_different(indices[have_moved(inliers, known, agreement, current.still_px)]),
        tried_moved=_different(tried[every.moved]),
        residual_px=float(np.sqrt(squares.mean())) if len(squares) else np.nan,
        sees=len(current.features) > 0,
        strong=_different(indices[~current.features.faint[indices]]),
        noise_px=noise_of(np.sqrt(squares)),
        moving=_different(indices[moves]),
        tried_features=_different(tried),
    )


def _features_of(indices: Sequence[IntArray]) -> IntArray:
    """(n,) features of the current frame, of matches (m, 2) each."""
    return np.concatenate([np.empty(0, np.int64), *(index[:, 1] for index in indices)])


def _different(features: IntArray) -> int:
    """How many different ones there are."""
    return int(np.count_nonzero(np.bincount(features)))


def noise_of(off: FloatArray) -> float:
    """Standard deviation of what agrees, by how far it is off (n,): the root of the mean square, or by the median where
    that is less, since a few of many faint features may be far off; NaN without any."""
    return float(min(np.sqrt(np.mean(off**2)), SIGMA_OF_MEDIAN * np.median(np.abs(off)))) if len(off) else np.nan


def recognised_anywhere(team: Team, joint: Joint, frame: Frame, *, faint: bool = False) -> RigidTransform | None:
    """world_from_object by the keyframes' landmarks alone, wherever the object is; None if it is not found.

    Args:
        frame: with the features of the whole images.
        faint: whether these are all that there are, and need not be as much alike.
    """
    ratio = LOOSE_RATIO if faint else RATIO

    def of(c: int) -> Recognised:
        part = team.parts[c]
        tried = to_try(joint.keyframes, c, joint.base, joint.missed)
        own = recognised([part.frames[k.number] for k in tried], frame.cameras[c], joint.object.radius, ratio)
        if not len(part.sought.rejected):
            part.sought = Sought(frame.cameras[c].features.pixels, own.pixels)
        return own

    found = team.crew.each(of, long=True)
    return pose_of(team.rig, team.crew.ask(lambda c: found[c], Recognised.none()))


def is_the_same(joint: Joint, found: Found, pose: RigidTransform) -> bool:
    """Whether what was found is what was recognised: solvers that start there may end elsewhere."""
    away = found.motion * joint.base.world_from_object * pose.inv()
    far = np.linalg.norm(away.apply(pose.translation) - pose.translation) > AGAIN_SHIFT * joint.object.radius
    return bool(not far and away.rotation.magnitude() <= AGAIN_TURN)


def is_a_corner(joint: Joint, found: Found) -> bool:
    """Whether so little of an object that was missed is back that the next frame will show more, and what would be learnt
    now stay wrong."""
    uncertain = bool(np.sqrt(np.diag(covariance_of(found.solution.information))[:3].max()) > AGAIN_SD)
    return joint.missed > 0 and uncertain and joint.seen_again < WAIT_FOR_MORE
