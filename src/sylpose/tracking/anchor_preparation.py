"""The next anchor, prepared beside the frames.

New features are wanted while enough of the anchor's are still followed: what is in a solved frame's image besides those is
found, and matched with the keyframes by its looks, by a thread of its own. So many frames later it joins them: that frame is
the anchor from then on. It has been solved without, by features that were followed, so each camera judges by itself which of
the new matches agree with its pose. That depends on the frames' numbers alone, never on how long anything took.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sylpose.features.klt import advance, begin
from sylpose.features.sift import ALL_FEATURES, Features, detect, match_features, seen_before
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import BoolArray, Image, IntArray
from sylpose.geometry.future import Later
from sylpose.landmarks.alignment import stack
from sylpose.landmarks.camera_terms import camera_terms, own_of
from sylpose.rig import Camera
from sylpose.tracking.camera import CameraPart
from sylpose.tracking.context import Region, Team
from sylpose.tracking.frame import CameraFrame, Pair, SolvedFrame, match_pair, without_background
from sylpose.tracking.joint_state import Joint
from sylpose.tracking.keyframes import references_of, with_keyframe
from sylpose.tracking.klt_frontend import (
    FEATURES,
    Anchor,
    CameraAnchor,
    Followed,
    Renewal,
    begin_anchor,
    some_of,
    with_new,
)
from sylpose.tracking.observations import cut, sights_of
from sylpose.tracking.pose_search import KLT_FEATURES, Found
from sylpose.tracking.region import polygon_mask
from sylpose.tracking.reobserved import SeenAgain

__all__ = ["begun", "joined", "looked_for", "wants"]

# Frames until what is found in one joins: at 30 per second the time that it takes on a processor with other work (choice).
LATER = 7
# Noise of a match by which it is judged, pixels, at least (choice).
NOISE_PX = 1.0


def wants(joint: Joint) -> bool:
    """Whether the last frame, one that was solved by followed features alone, is one that may be the next anchor."""
    return joint.renewal is None and joint.proven and not joint.object.guessed


def begun(team: Team, joint: Joint, frames: FrameSet, found: Found) -> Joint:
    """New features are looked for in the frame just solved."""
    assert found.followed is not None
    last, followed = joint.base, found.followed

    def begin_for(c: int) -> None:
        part, its = team.parts[c], followed[c]
        part.renewal = None
        if its.image is None:
            return
        keyframes = references_of(joint.keyframes, c, last.viewpoints[c], last)
        references = {k.number: part.frames[k.number].features for k in keyframes}
        where = _where(found.regions[c], frames.masks[c], part.camera)
        looking = Later(
            looked_for, its.image, part.camera, where, joint.starves, its, part.surroundings, part.still_px, references
        )
        part.renewal = Renewal(last.number, its.image, found.rig.cameras[c], len(its), its.rows, looking)

    team.crew.each(begin_for)
    return replace(joint, renewal=last.number)


def _where(region: Region, mask: BoolArray | None, camera: Camera) -> BoolArray:
    where = polygon_mask(region, camera.size)
    return where if mask is None else where & mask


def looked_for(
    image: Image,
    camera: Camera,
    where: BoolArray,
    faint: bool,
    followed: Followed,
    surroundings: Features,
    still_px: float,
    references: dict[int, Features],
) -> tuple[Features, dict[int, IntArray]]:
    """New features in an area (h, w) of an image, and their matches with those of earlier frames, by number.

    Args:
        faint: whether faint ones are asked for.
    """
    detected = detect(image, camera, where, ALL_FEATURES if faint else KLT_FEATURES, faint=faint)
    new = with_new(followed, detected, seen_before(detected, surroundings, still_px), FEATURES)
    new = new.subset(np.arange(len(followed), len(new)))
    return new, {number: match_features(features, new) for number, features in references.items()}


def joined(team: Team, joint: Joint, number: int) -> Joint:
    """With the next anchor, once it is to be there in the frame with this number; else as it was."""
    if joint.renewal is None or number < joint.renewal + LATER or joint.renewal not in joint.known:
        return joint
    frame = joint.known[joint.renewal]
    team.crew.each(lambda c: _join(team.parts[c], joint, frame), long=True)
    keyframes = tuple(sorted(with_keyframe(joint.keyframes, frame), key=lambda k: k.number))
    return replace(joint, anchor=Anchor(frame, joint.base.number - frame.number), keyframes=keyframes, renewal=None)


def _join(part: CameraPart, joint: Joint, frame: SolvedFrame) -> None:
    """One camera's side of `joined`: the frame has the new features as well, and its features are followed from now on."""
    its, old, before = part.renewal, part.frames[frame.number], part.anchor
    part.renewal = None
    if its is None or before is None or its.number != frame.number or its.known != len(old.features):
        # It saw nothing of the frame, or was not believed.
        part.anchor = begin_anchor(frame.number, old, None, None)
        return
    features, matches = its.found.value()
    new, pose, radius = part.frame(features), frame.world_from_object, joint.object.radius
    pairs = []
    for number, indices in matches.items():
        if number in part.frames and number in joint.known:
            pair = match_pair(number, part.frames[number], new, indices)
            then = joint.known[number].world_from_object
            pairs.append(without_background(pair, new, its.camera, then, pose, radius))
    seen = _agreeing(its.camera, [pair for pair in pairs if len(pair)], new, frame, radius)
    part.learn(new, its.camera, pose, seen, joint.object.points, radius)
    both = CameraFrame(
        Features.concatenate([old.features, features]),
        np.concatenate([old.background, new.background]),
        part.table,
        np.concatenate([old.numbers, new.numbers]),
        part.still_px,
    )
    part.frames[frame.number] = both
    part.anchor = _followed_since(its, new, both, frame, joint.base, before)


def _agreeing(camera: Camera, pairs: list[Pair], new: CameraFrame, frame: SolvedFrame, radius: float) -> SeenAgain:
    """What of a camera's matches agrees with its frame's pose."""
    if not pairs:
        return SeenAgain.none()
    sights, _ = sights_of(camera, pairs, new, frame)
    stacked = stack([replace(sights, trust=np.ones(len(sights.trust)))])
    own = own_of(stacked)
    camera_terms(stacked, 0, np.eye(3), np.zeros(3), NOISE_PX, True, own, np.empty((6, 7)))
    return SeenAgain.of(pairs, cut(own.weights, own.across * camera.focal, pairs), new.still_px, radius)


def _followed_since(
    its: Renewal, new: CameraFrame, both: CameraFrame, frame: SolvedFrame, last: SolvedFrame, before: CameraAnchor
) -> CameraAnchor:
    """The frame's features as they are in the last image: those that were followed all the time are where they are, the new
    ones are followed from there in one go.

    Args:
        before: the anchor until now.
    """
    tracks, fresh = before.tracks.subset(its.rows), begin(its.image, new.features.pixels)
    alive = some_of(np.concatenate([before.alive[its.rows], fresh.followed & ~new.background]), its.known)
    alive[: its.known] = before.alive[its.rows]
    if before.image is not None:
        means = new.landmarks.mean
        then, now = (its.camera.project(at.world_from_object.apply(means)) for at in (frame, last))
        fresh = advance(fresh.keep(alive[its.known :]), its.image, before.image, fresh.pixels + now - then)
    alive[its.known :] &= fresh.followed
    return CameraAnchor(frame.number, both, tracks.join(fresh), alive, before.image)
