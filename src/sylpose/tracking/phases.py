"""The way of a frame: through exactly one of `start`, `steady` and `recover`.

Each is a function of what all cameras know alike and of the cameras' answers, and returns what they know by then: first
something is found, then what was found is accepted and learnt, or the frame goes without.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.features.sift import MAX_FEATURES, Features
from sylpose.frames import FrameSet
from sylpose.results import FrameStatus, Status
from sylpose.tracking.anchor import ANCHOR_SHARE, Followed
from sylpose.tracking.find import (
    MAX_GROWTH,
    REGION_GROWTH,
    Found,
    Region,
    Team,
    features_of,
    followed_from_anchor,
    is_a_corner,
    is_fast,
    is_the_same,
    looked_for,
    matched,
    on_the_move,
    recognised_anywhere,
    regions_of,
    solved_from,
    split,
)
from sylpose.tracking.frame import Frame, Pair, match_pair
from sylpose.tracking.joint import Joint
from sylpose.tracking.learn import accept_first, accepted, not_found, triangulated, with_surface
from sylpose.tracking.object_model import ObjectModel
from sylpose.tracking.start import FirstMotion, first_motion, is_ambiguous
from sylpose.tracking.thorough import is_doubtful, searched
from sylpose.tracking.tracked_frame import TrackedFrame, unsolved_frame
from sylpose.two_frames.fit import MIN_MATCHES
from sylpose.two_frames.motion import motion_about

__all__ = ["Waiting", "next_frame", "recover", "start", "steady"]

# Without boxes nothing is known of the object until it moves: so many frames wait for that, with their images (choice).
PATIENCE = 10
# What moves by this much in the middle, pixels, is told from what does not; a smaller motion has to wait for a larger
# one (choice).
FIRST_PX = 8.0
# A first motion of which little is seen is believed up to this turn, radians (choice).
FIRST_TURN = np.radians(3.0)
AMBIGUOUS = (
    "Without boxes, what moves most is tracked; something else moved nearly as much. Boxes or masks of the object would "
    "tell which of the two it is."
)
# Features per camera while the object may be anywhere in the image (choice).
START_FEATURES = 4000


class Waiting(NamedTuple):
    """A frame that waits for the object to move."""

    frame: Frame
    frames: FrameSet


def next_frame(
    team: Team, joint: Joint, waiting: Sequence[Waiting], number: int, frames: FrameSet
) -> tuple[Joint, Sequence[Waiting], list[TrackedFrame]]:
    """The next frame, on whichever way it has to go; see `start`."""
    if joint.last is None:
        return start(team, joint, waiting, number, frames)
    joint, tracked = (recover if joint.missed else steady)(team, joint, number, frames)
    return joint, [], [tracked]


# --- every frame but the first ones -----------------------------------------------------------------------------------


def steady(team: Team, joint: Joint, number: int, frames: FrameSet) -> tuple[Joint, TrackedFrame]:
    """The object was found in the frame before: it is where it should be, else anywhere."""
    ahead = joint.predicted(frames.time)
    regions = regions_of(team, joint, ahead)
    followed, found = None, None
    if joint.anchor is not None:
        followed, total, enough = followed_from_anchor(team, joint, frames, ahead, regions)
        # The first motion is not known yet: what is followed with ease may be what stands still.
        if enough and joint.velocity.frames:
            frame = team.frame(number, frames, features_of(team, followed))
            joint, found = _found(team, joint, frame, ahead, regions, followed, anew=False)
            if found is not None and not found.matches > ANCHOR_SHARE * total:
                found = None
    if found is None:
        frame = team.frame(number, frames, looked_for(team, joint, frames, ahead, regions, followed))
        joint, found = _found(team, joint, frame, ahead, regions, followed)
    if found is None or (is_fast(joint, ahead) and is_doubtful(team, joint, found)):
        joint, better = _found_thoroughly(team, joint, number, frames, ahead, regions)
        # A first motion that hardly is one has little to show for itself; else what is doubtful is no pose.
        begins = found is not None and not joint.velocity.frames and found.motion.rotation.magnitude() < FIRST_TURN
        found = better if better is not None or not begins else found
    if found is None:
        joint, found = _found_anywhere(team, joint, number, frames)
    return not_found(joint, frames, ahead, regions) if found is None else accepted(team, joint, frames, found)


def recover(team: Team, joint: Joint, number: int, frames: FrameSet) -> tuple[Joint, TrackedFrame]:
    """The object was missed in the frame before: it is where it would have gone on to, else anywhere; what is found has to
    be found again from where it is."""
    ahead = joint.predicted(frames.time)
    regions: Sequence[Region] = [None] * len(team.rig)
    found = None
    if not joint.lost or not joint.velocity.frames:  # before its first motion it may be anywhere near
        regions = regions_of(team, joint, ahead, min(REGION_GROWTH * (1 + joint.missed), MAX_GROWTH))
        features = looked_for(team, joint, frames, ahead, regions, None)
        joint, near = _found(team, joint, team.frame(number, frames, features), ahead, regions)
        if near is not None:
            pose = near.motion * joint.base.world_from_object
            joint, found = _confirmed(team, joint, number, frames, features, pose)
        if found is None:
            joint, near = _found_thoroughly(team, joint, number, frames, ahead, regions)
            if near is not None:
                pose = near.motion * joint.base.world_from_object
                features = features_of(team, near.frame.cameras)
                joint, found = _confirmed(team, joint, number, frames, features, pose)
    if found is None:
        joint, found = _found_anywhere(team, joint, number, frames)
    return not_found(joint, frames, ahead, regions) if found is None else accepted(team, joint, frames, found)


def _found(
    team: Team,
    joint: Joint,
    frame: Frame,
    guess: RigidTransform,
    regions: Sequence[Region],
    followed: Sequence[Followed] | None = None,
    *,
    anew: bool = True,
) -> tuple[Joint, Found | None]:
    """The frame's pose, from a guess. While nothing but boxes tells where the object's surface is, its matches may."""
    pairs = matched(team, joint, frame, guess, followed, anew=anew)
    if joint.object.guessed or not joint.velocity.frames:
        joint, seen = with_surface(team, joint, pairs)
        if seen is not None and not joint.velocity.frames:
            # The first motion: what does not take part in it is background, however much of the boxes it fills.
            guess, pairs = seen, on_the_move(team, joint, frame, pairs, seen)
    return joint, solved_from(team, joint, frame, pairs, guess, regions, followed, anew=anew)


def _found_thoroughly(
    team: Team,
    joint: Joint,
    number: int,
    frames: FrameSet,
    ahead: RigidTransform,
    regions: Sequence[Region],
) -> tuple[Joint, Found | None]:
    """The frame's pose, with everything that there is."""
    frame = team.frame(number, frames, team.detect(frames, regions, faint=True))
    return searched(team, joint, frame, ahead, regions)


def _found_anywhere(team: Team, joint: Joint, number: int, frames: FrameSet) -> tuple[Joint, Found | None]:
    """The frame's pose, wherever the object is in the images: by the strongest features, or by all."""
    for faint in (False, True):
        features = team.detect(frames, None, MAX_FEATURES, faint=faint)
        pose = recognised_anywhere(team, joint, team.frame(number, frames, features))
        if pose is not None:
            joint, found = _confirmed(team, joint, number, frames, features, pose)
            # Where it was seen, but not well enough, it is waited for.
            if found is not None or joint.seen_again:
                return joint, found
    return joint, None


def _confirmed(
    team: Team, joint: Joint, number: int, frames: FrameSet, features: Sequence[Features], pose: RigidTransform
) -> tuple[Joint, Found | None]:
    """The frame solved from a pose after a wide search, by what may be on the object alone."""
    regions = regions_of(team, joint, pose)
    inside, _ = split(team, features, regions)
    joint, found = _found(team, joint, team.frame(number, frames, inside), pose, regions)
    if found is None or not is_the_same(joint, found, pose) or is_doubtful(team, joint, found):
        return joint, None
    if is_a_corner(joint, found):
        return replace(joint, seen_again=joint.seen_again + 1), None
    return joint, found


# --- the first frames -------------------------------------------------------------------------------------------------


def start(
    team: Team, joint: Joint, waiting: Sequence[Waiting], number: int, frames: FrameSet
) -> tuple[Joint, list[Waiting], list[TrackedFrame]]:
    """Nothing is solved yet. In boxes, the object is what can be seen there; without, it is what moves.

    Returns:
        what is known by then; the frames that wait, and those that are decided.
    """
    model = joint.object
    if model.center is not None:
        regions = regions_of(team, joint, RigidTransform.from_translation(model.center))
        features = team.detect(frames, regions, MAX_FEATURES)
        if sum(team.crew.ask(lambda c: len(features[c]))) < MIN_MATCHES:
            return joint, [], [unsolved_frame(frames, FrameStatus.TOO_FEW_MATCHES, regions, model.radius)]
        around = team.detect(frames, regions, MAX_FEATURES, around=True)
        frame = team.frame(number, frames, features)
        joint, first = accept_first(team, joint, frames, frame, around, model.center, regions)
        return joint, [], [first]
    features = team.detect(frames, None, START_FEATURES)
    if not waiting and sum(team.crew.ask(lambda c: len(features[c]))) < MIN_MATCHES:
        # Later ones need something to be compared with.
        return joint, [], [unsolved_frame(frames, FrameStatus.TOO_FEW_MATCHES)]
    current = Waiting(team.frame(number, frames, features), frames)
    if waiting:
        pairs = _matched_with_first(team, waiting[0].frame, current.frame)
        found = first_motion(team.crew, team.rig, pairs, waiting[0].frame.number, team.rng())
        if found.fit.status is Status.OK and (found.shift_px > FIRST_PX or len(waiting) == PATIENCE):
            return _begun(team, [*waiting, current], pairs, found)
    if len(waiting) < PATIENCE:
        return joint, [*waiting, current], []
    return joint, [*waiting[1:], current], [unsolved_frame(waiting[0].frames, FrameStatus.NO_MOTION)]


def _matched_with_first(team: Team, first: Frame, current: Frame) -> list[list[Pair]]:
    """By camera, each its own: matches of two frames of which none is solved."""

    def of(c: int) -> list[Pair]:
        pair = match_pair(first.number, first.cameras[c], current.cameras[c])
        return [pair] if len(pair) else []

    return team.crew.each(of, long=True)


def _begun(
    team: Team, waiting: Sequence[Waiting], pairs: Sequence[Sequence[Pair]], found: FirstMotion
) -> tuple[Joint, list[Waiting], list[TrackedFrame]]:
    """The first motion, to the last of the frames that waited for it, tells where the object is; then they are solved in
    order.

    Args:
        pairs: matches of the last one with the first.
    """
    crew, rig = team.crew, team.rig
    (first, first_frames), *others = waiting
    before = RigidTransform.from_translation(found.middle)
    now = motion_about(found.center, found.fit.rotation, found.fit.shift) * before
    model = ObjectModel(found.middle, found.radius)
    points = crew.ask(lambda c: triangulated(team, c, found.inliers[c], before, now))
    joint = Joint(model.with_points(np.concatenate(points), team.seed))
    regions = regions_of(team, joint, before)
    inside, around = split(team, features_of(team, first.cameras), regions)
    frame = team.frame(first.number, first_frames, inside)
    joint, tracked = accept_first(team, joint, first_frames, frame, around, found.middle, regions)
    decided = [tracked]
    for waited, its in others:
        # They were searched everywhere: what was at rest with the object would seem to belong to it.
        pose = now if waited is others[-1].frame else joint.predicted(its.time)
        regions = regions_of(team, joint, pose)
        inside, _ = split(team, features_of(team, waited.cameras), regions)
        joint, solved = _found(team, joint, team.frame(waited.number, its, inside), pose, regions)
        if solved is None:
            joint, tracked = not_found(joint, its, pose, regions)
        else:
            joint, tracked = accepted(team, joint, its, solved)
        decided.append(tracked)
    if not any(frame.pose.measured for frame in decided[1:]):
        # What moved was no rigid body, or not for long: wait for another motion.
        crew.each(lambda c: team.parts[c].forget())
        return Joint(), list(others), [unsolved_frame(first_frames, FrameStatus.NOT_CONSISTENT)]
    if is_ambiguous(crew, rig, pairs, first.number, found, team.rng()):
        decided[0] = replace(decided[0], note=AMBIGUOUS)
    return joint, [], decided
