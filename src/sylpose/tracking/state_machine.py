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
from sylpose.relative_pose.fit import MIN_MATCHES
from sylpose.results import FrameStatus
from sylpose.tracking import anchor_preparation
from sylpose.tracking.box_motion import in_the_middle, middle_stands, still_ones
from sylpose.tracking.camera_motion_correction import steadied, with_nudges
from sylpose.tracking.context import MAX_GROWTH, REGION_GROWTH, Region, Team, features_of, regions_of, split
from sylpose.tracking.fallback_search import is_doubtful, searched
from sylpose.tracking.frame import Frame, Pair, match_pair, standing
from sylpose.tracking.initialization import FirstMotion, agree, first_motion, is_ambiguous, jitter_of
from sylpose.tracking.joint_state import Joint
from sylpose.tracking.klt_frontend import ANCHOR_SHARE, Anchor, Followed
from sylpose.tracking.map_update import accept_first, accepted, first_points, not_found, told_by_matches
from sylpose.tracking.motion_model import Velocity
from sylpose.tracking.object_model import ObjectModel
from sylpose.tracking.pose_search import (
    Found,
    followed_from_anchor,
    is_a_corner,
    is_fast,
    is_the_same,
    looked_for,
    matched,
    recognised_anywhere,
    solved_from,
)
from sylpose.tracking.reports import placed
from sylpose.tracking.tracked_frame import TrackedFrame, looks, unsolved_frame
from sylpose.tracking.window import finished

__all__ = ["Waiting", "finish", "next_frame", "recover", "start", "steady"]

# Without boxes nothing is known of the object until it moves: so many frames wait for that, with their features (choice),
PATIENCE = 60
# and with their images, as long as these are no more than so many bytes (choice).
WAITING_BYTES = 1 << 29
# A motion of which not all is seen, a slide's length or a small turn, has to wait for one that moves by this much in the
# middle, pixels, as long as there is any waiting (choice).
FIRST_PX = 8.0
# A first motion of which little is seen is believed up to this turn, radians (choice).
FIRST_TURN = np.radians(3.0)
# While nothing but boxes tells where the object's surface is, so many frames after the first are matched with it, and every
# `ASKED`th of the later ones (choice).
ASKED_AT_FIRST, ASKED = 6, 4
AMBIGUOUS = (
    "Without boxes, what moves most is tracked; something else moved nearly as much. Boxes or masks of the object would "
    "tell which of the two it is."
)
# Where boxes have fewer features than this in their middle, in the mean over the cameras, faint ones are asked for as well:
# at the rim most may be background (choice).
FEW_AT_FIRST = 40
# In every so manyth frame large images are searched in full for what was lost: it may be small (choice).
IN_FULL = 4
# Features per camera while the object may be anywhere in the image (choice).
START_FEATURES = 4000


class Waiting(NamedTuple):
    """A frame that waits for the object to move; a motion since the first of those waiting that may be the object's."""

    frame: Frame
    frames: FrameSet
    motion: RigidTransform | None = None


def next_frame(
    team: Team, joint: Joint, waiting: Sequence[Waiting], number: int, frames: FrameSet
) -> tuple[Joint, Sequence[Waiting], list[TrackedFrame]]:
    """The next frame, on whichever way it has to go; see `start`."""
    joint, frames = steadied(team, joint, frames)
    team.crew.each(lambda c: team.parts[c].look_anew())
    joint = finished(team, joint, number)
    if joint.last is None:
        joint, waiting, decided = start(team, joint, waiting, number, frames)
    else:
        joint, tracked = (recover if joint.missed else steady)(team, joint, number, frames)
        waiting, decided = [], [tracked]
    return joint, waiting, with_nudges(team, joint, decided)


# --- every frame but the first ones -----------------------------------------------------------------------------------


def steady(team: Team, joint: Joint, number: int, frames: FrameSet) -> tuple[Joint, TrackedFrame]:
    """The object was found in the frame before: it is where it should be, else anywhere."""
    joint = anchor_preparation.joined(team, joint, number)
    ahead = joint.predicted(frames.time)
    regions = regions_of(team, joint, ahead)
    followed, found, soon = None, None, False
    if joint.anchor is not None:
        followed, total, enough, soon = followed_from_anchor(team, joint, frames, ahead, regions)
        # The first motion is not known yet: what is followed with ease may be what stands still.
        if enough and joint.velocity.frames and not asks_first(joint, number):
            frame = team.frame(number, frames, features_of(team, followed))
            joint, found = _found(team, joint, frame, ahead, regions, followed, anew=False)
            if found is not None and not found.matches > ANCHOR_SHARE * total:
                found = None
    if found is None:
        frame = team.frame(number, frames, looked_for(team, joint, frames, ahead, regions, followed))
        joint, found = _found(team, joint, frame, ahead, regions, followed)
    if found is None or is_doubtful(team, joint, found):
        joint, better = _found_thoroughly(team, joint, number, frames, ahead, regions)
        found = better if better is not None or not _is_expected(joint, found, ahead) else found
    if found is None:
        joint, found = _found_anywhere(team, joint, number, frames)
    if found is None:
        return not_found(team, joint, frames, ahead, regions)
    joint, tracked = accepted(team, joint, frames, found)
    if soon and not found.anew and anchor_preparation.wants(joint):
        joint = anchor_preparation.begun(team, joint, frames, found)
    return joint, tracked


def _is_expected(joint: Joint, found: Found | None, ahead: RigidTransform) -> bool:
    """Whether a pose of which little is seen is one all the same: a first motion that hardly is one has little to show for
    itself, and a slow object that little is seen of is where it was going to."""
    if found is None:
        return False
    if not joint.velocity.frames:
        return bool(found.motion.rotation.magnitude() < FIRST_TURN)
    return not is_fast(joint, ahead) and is_the_same(joint, found, ahead)


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
    return not_found(team, joint, frames, ahead, regions) if found is None else accepted(team, joint, frames, found)


def asks_first(joint: Joint, number: int) -> bool:
    """Whether a frame is matched with the first one, however well it is followed since a later one: only that tells where
    the surface is, and until it is known a pose is hardly known either."""
    since = number - joint.keyframes[0].number
    confirms = joint.first_motion is not None  # what two cameras say is believed once the next frame says so, too
    return joint.object.guessed and (since <= ASKED_AT_FIRST or since % ASKED == 0 or confirms)


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
    """The frame's pose, from a guess."""
    matches = matched(team, joint, frame, guess, followed, anew=anew)
    if joint.object.bounded and not joint.proven and middle_stands(team, joint, frame, matches):
        # What moves in the boxes is not the object: somebody passes by.
        rest = still_ones(team, frame, matches)
        found = solved_from(team, joint, frame, rest, joint.base.world_from_object, regions, followed, anew=anew)
        return joint, None if found is None else found.standing()
    joint, _, guess, pairs = told_by_matches(team, joint, frame, matches, guess)
    found = solved_from(team, joint, frame, pairs, guess, regions, followed, anew=anew)
    if found is not None and joint.may_be_background(found.agreed):
        return replace(joint, only_still=True), None
    return joint, found.standing() if found is not None and joint.stands(found.agreed) else found


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
    reduced = (joint.missed + 1) % IN_FULL != 0
    for faint in (False, True):
        features = team.detect(frames, None, MAX_FEATURES, faint=faint, reduced=reduced)
        pose = recognised_anywhere(team, joint, team.frame(number, frames, features), faint=faint)
        if pose is not None:
            features = team.closer(frames, features, regions_of(team, joint, pose), faint=faint)
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
        middle = sum(team.crew.ask(lambda c: in_the_middle(team, c, features[c], regions[c]), 0))
        joint = replace(joint, starves=middle < FEW_AT_FIRST * len(team.rig))
        seen = team.detect(frames, regions, faint=True) if joint.starves else features
        if sum(team.crew.ask(lambda c: len(seen[c]), 0)) < MIN_MATCHES:
            look = looks(team, seen)
            return joint, [], [unsolved_frame(team, frames, FrameStatus.TOO_FEW_MATCHES, look, regions, model.radius)]
        around = team.around(frames, regions, faint=joint.starves)
        frame = team.frame(number, frames, seen)
        joint, first = accept_first(team, joint, frames, frame, around, model.center, regions)
        return joint, [], [first]
    features = team.detect(frames, None, START_FEATURES, reduced=True)
    if not waiting and sum(team.crew.ask(lambda c: len(features[c]), 0)) < MIN_MATCHES:
        # Later ones need something to be compared with.
        return joint, [], [unsolved_frame(team, frames, FrameStatus.TOO_FEW_MATCHES, looks(team, features))]
    waiting = [*waiting, Waiting(team.frame(number, frames, features), frames)]
    status = FrameStatus.NO_MOTION
    if len(waiting) > 1:
        pairs, found = _first_motion(team, waiting)
        over = len(waiting) > PATIENCE
        if found.certain:
            waiting[-1] = waiting[-1]._replace(motion=found.motion)
            clear = (found.whole or found.shift_px > FIRST_PX) and agree(waiting[-2].motion, found.motion)
            begun = _begun(team, waiting, pairs, found) if clear or over else None
            if begun is not None:
                return replace(begun[0], nudges=joint.nudges), [], begun[1]
        status = found.nothing
    if len(waiting) <= PATIENCE:
        return joint, _lighter(waiting), []
    # What the others have moved by since then is not known.
    others = [waited._replace(motion=None) for waited in waiting[1:]]
    return joint, others, [_waited_in_vain(team, waiting[0], status)]


def _waited_in_vain(team: Team, waited: Waiting, status: FrameStatus) -> TrackedFrame:
    return unsolved_frame(team, waited.frames, status, looks(team, features_of(team, waited.frame.cameras)))


def finish(team: Team, waiting: Sequence[Waiting]) -> list[TrackedFrame]:
    """The frames that still wait at the recording's end: a smaller motion has to do, if there is any."""
    status = FrameStatus.NO_MOTION
    if len(waiting) > 1:
        pairs, found = _first_motion(team, waiting)
        begun = _begun(team, waiting, pairs, found) if found.certain else None
        if begun is not None:
            return begun[1]
        status = found.nothing
    return [_waited_in_vain(team, waited, status) for waited in waiting]


def _lighter(waiting: Sequence[Waiting]) -> list[Waiting]:
    """The frames that wait, without the images of the oldest but the first where they are too many to keep: their features
    have to do."""
    total = [sum(image.nbytes for image in waited.frames.images if image is not None) for waited in waiting]
    kept, light = sum(total), list(waiting)
    for k in range(1, len(waiting)):
        if kept <= WAITING_BYTES:
            break
        its = waiting[k].frames
        light[k] = waiting[k]._replace(frames=replace(its, images=(None,) * len(its.images)))
        kept -= total[k]
    return light


def _first_motion(team: Team, waiting: Sequence[Waiting]) -> tuple[list[list[Pair]], FirstMotion]:
    """The last waiting frame's matches with the first, by camera, each its own, and the motion that they show."""
    first, current = waiting[0].frame, waiting[-1].frame

    def of(c: int) -> list[Pair]:
        pair = match_pair(first.number, first.cameras[c], current.cameras[c])
        return [pair] if len(pair) else []

    pairs = team.crew.each(of, long=True)
    return pairs, first_motion(team.crew, team.rig, pairs, first.number, team.rng())


def _begun(
    team: Team, waiting: Sequence[Waiting], pairs: Sequence[Sequence[Pair]], found: FirstMotion
) -> tuple[Joint, list[TrackedFrame]] | None:
    """The first motion, to the last of the frames that waited for it, tells where the object is. That one is solved first;
    with what it teaches of the object, the frames between are solved in order. None if what moved was no rigid body after
    all.

    Args:
        pairs: matches of the last one with the first.
    """
    crew, rig, parts = team.crew, team.rig, team.parts
    (first, first_frames, _), *others = waiting
    before = RigidTransform.from_translation(found.middle)
    now = found.motion * before
    # Where another motion says as much, how deep the surface is depends on which of them it is.
    model = ObjectModel(found.middle, found.radius, guessed=found.fit.other is not None)
    points = crew.ask(
        lambda c: placed(first_points(team, c, found.inliers[c], before, now), found.radius), np.empty((0, 3))
    )
    joint = Joint(model.with_points(np.concatenate(points), team.seed))
    regions = regions_of(team, joint, before)

    def told_apart(c: int) -> tuple[Features, Features]:
        """The first frame's features that may be the object's, and those that are around it or stood still as it moved."""
        part, features = parts[c], first.cameras[c].features
        for pair in pairs[c]:
            part.learn_noise(jitter_of(pair))
        stood = np.zeros(len(features), bool)
        for pair in pairs[c]:
            still = standing(pair, part.frame(Features.none()), part.camera, before, now, found.radius)
            stood[pair.indices[still, 0]] = True
        return part.told_apart(first_frames.images[c], first_frames.masks[c], features, regions[c], stood)

    apart = crew.each(told_apart)
    inside, around = crew.each(lambda c: apart[c][0]), crew.each(lambda c: apart[c][1])
    frame = team.frame(first.number, first_frames, inside)
    joint, tracked = accept_first(team, joint, first_frames, frame, around, found.middle, regions)
    decided, begin, ends = [tracked], joint.base, others.pop()
    joint, tracked = _solved_later(team, joint, ends, now)
    if not (joint.proven and tracked.pose.seen):
        # What moved was no rigid body, or not for long: wait for another motion.
        crew.each(lambda c: parts[c].forget())
        return None
    end, last = joint.base, tracked
    # Nothing of the object's speed is known for the frames between.
    joint = replace(joint, last=begin, keyframes=(begin, end), anchor=None, velocity=Velocity())
    for waited in others:
        joint, tracked = _solved_later(team, joint, waited, joint.predicted(waited.frames.time))
        decided.append(tracked)
    if end.number in joint.known:
        motion = end.world_from_object * joint.base.world_from_object.inv()
        joint = joint.accepted(end, motion, anew=False)
        joint = replace(joint, keyframes=tuple(sorted(joint.keyframes, key=lambda k: k.number)))
        if team.follows:
            crew.each(lambda c: parts[c].anchor_at(end.number, ends.frames.images[c], None))
            joint = replace(joint, anchor=Anchor(end))
    else:  # one of them told where the surface is; what had been believed of it, and the end by it, is forgotten
        joint, last = _solved_later(team, joint, ends, joint.predicted(ends.frames.time))
    if is_ambiguous(crew, rig, pairs, first.number, found, team.rng()):
        decided[0] = replace(decided[0], note=AMBIGUOUS)
    return joint, [*decided, last]


def _solved_later(team: Team, joint: Joint, waited: Waiting, pose: RigidTransform) -> tuple[Joint, TrackedFrame]:
    """A frame that has waited, from a guess of its pose (world_from_object). It was searched everywhere: what was at rest
    with the object would seem to belong to it."""
    regions = regions_of(team, joint, pose)
    inside = team.closer(waited.frames, features_of(team, waited.frame.cameras), regions)
    joint, found = _found(team, joint, team.frame(waited.frame.number, waited.frames, inside), pose, regions)
    if found is None:
        return not_found(team, joint, waited.frames, pose, regions)
    return accepted(team, joint, waited.frames, found)
