"""The thorough way to find an object: with all that can be found in a frame and in the last solved one, all keyframes within
reach, and with matches that are more alike than others that are where they should be, if not than all others.

It takes many times as long as the usual way (`find`), and is gone where that has failed, before a frame goes without a pose.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.landmarks.camera_terms import CUTOFF
from sylpose.tracking.find import Found, Region, Team, on_the_move, regions_of, solved_from
from sylpose.tracking.frame import Frame, Pair
from sylpose.tracking.joint import Joint
from sylpose.tracking.keyframes import nearest_views, viewpoints
from sylpose.tracking.learn import with_surface

__all__ = ["searched"]

# Keyframes that each camera's image is matched with besides the last solved frame, at most, and from how far around the
# object, radians (choice).
KEYFRAMES, REACH = 8, np.radians(50.0)
# How far from where a landmark should be it is looked for, as a share of the object's radius in the image: at a pose that is
# predicted, and at one that was solved; pixels at least (choice).
PREDICTED, SOLVED, LEAST_PX = 0.15, 0.03, 3.0
# Noise by which poses are compared, pixels (choice).
VOTE_PX = 0.5


def searched(
    team: Team, joint: Joint, frame: Frame, ahead: RigidTransform, regions: Sequence[Region]
) -> tuple[Joint, Found | None]:
    """The frame's pose: from what looks alike in all frames in reach, and from where it should be.

    Args:
        frame: with all features that there are in the regions.
        ahead: world_from_object as predicted.
    """
    enriched(team, joint)
    references = references_within(team, joint, ahead)
    pairs = team.crew.each(lambda c: team.parts[c].match(frame.cameras[c], references[c]), long=True)
    pairs, seen = on_the_move(team, joint, frame, pairs, ahead), None
    if joint.object.guessed or not joint.velocity.frames:
        joint, seen = with_surface(team, joint, pairs)
        if seen is not None and not joint.velocity.frames:
            ahead, pairs = seen, on_the_move(team, joint, frame, pairs, seen)
    found = solved_from(team, joint, frame, pairs, ahead, regions)
    candidates = [narrowed(team, joint, frame, found, ahead, regions)]
    if joint.velocity.frames or seen is not None:
        near = found_near(team, joint, frame, ahead, ahead, regions, PREDICTED)
        candidates.append(narrowed(team, joint, frame, near, ahead, regions))
    best = max((c for c in candidates if c is not None), key=score, default=None)
    return joint, best


def enriched(team: Team, joint: Joint) -> None:
    """All that can be found in the last solved frame becomes features of it."""
    base, model = joint.base, joint.object
    regions = regions_of(team, joint, base.world_from_object)
    team.crew.each(
        lambda c: team.parts[c].enrich(base.number, base.world_from_object, regions[c], model.points, model.radius),
        long=True,
    )


def references_within(team: Team, joint: Joint, guess: RigidTransform) -> list[list[int]]:
    """By camera the numbers of the last solved frame and of the keyframes in reach."""
    here, base = viewpoints(team.rig, guess), joint.base
    return [
        [base.number]
        + [k.number for k in nearest_views(joint.keyframes, c, here[c], KEYFRAMES, REACH) if k.number != base.number]
        for c in range(len(team.rig))
    ]


def found_near(
    team: Team,
    joint: Joint,
    frame: Frame,
    pose: RigidTransform,
    ahead: RigidTransform,
    regions: Sequence[Region],
    share: float,
) -> Found | None:
    """The frame solved from what is where it should be at a pose, but for what is background by where it is predicted."""
    references = references_within(team, joint, pose)

    def of(c: int) -> list[Pair]:
        camera = team.rig.cameras[c]
        depth = max(float(camera.camera_from_world.apply(pose.translation)[2]), 1e-12)
        reach = max(share * joint.object.radius / depth * camera.focal, LEAST_PX)
        return team.parts[c].match_near(frame.cameras[c], references[c], pose, reach)

    pairs = on_the_move(team, joint, frame, team.crew.each(of, long=True), ahead)
    return solved_from(team, joint, frame, pairs, pose, regions)


def narrowed(
    team: Team, joint: Joint, frame: Frame, found: Found | None, ahead: RigidTransform, regions: Sequence[Region]
) -> Found | None:
    """Solved again from all that is where a solution says."""
    if found is None:
        return None
    pose = found.motion * joint.base.world_from_object
    return found_near(team, joint, frame, pose, ahead, regions, SOLVED)


def score(found: Found) -> float:
    """How many features agree with a pose, at a noise that is the same for all poses."""
    worth = [
        max(1.0 - (a.residual_px / (CUTOFF * VOTE_PX)) ** 2, 0.0) ** 2 if a.features else 0.0 for a in found.agreed
    ]
    return float(sum(w * a.features for w, a in zip(worth, found.agreed, strict=True)))
