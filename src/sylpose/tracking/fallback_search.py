"""The thorough way to find an object: with all that can be found in a frame and in the last solved one, all keyframes within
reach, and with matches that are more alike than others that are where they should be, if not than all others.

It takes many times as long as the usual way (`find`), and is gone where that has failed, before a frame goes without a pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import FloatArray
from sylpose.results import Status
from sylpose.tracking.context import Region, Team, regions_of
from sylpose.tracking.frame import Frame, Pair
from sylpose.tracking.joint_state import Joint
from sylpose.tracking.keyframes import nearest_views, viewpoints
from sylpose.tracking.map_update import told_by_matches
from sylpose.tracking.pose_search import Found, is_the_same, on_the_move, solved_from

__all__ = ["is_doubtful", "searched"]

# Keyframes that each camera's image is matched with besides the last solved frame, at most, and from how far around the
# object, radians (choice).
KEYFRAMES, REACH = 4, np.radians(50.0)
# How far from where a landmark should be it is looked for, as a share of the object's radius in the image: at a pose that is
# predicted, and at one that was solved; pixels at least (choice).
PREDICTED, SOLVED, LEAST_PX = (0.15, 0.07), 0.03, 3.0
# References that show whether more is where a pose says than by chance (choice).
ASKED = 2
# Features that a wrong pose has more than by chance, since it was chosen by them: two for each of its six unknowns (choice).
CHOSEN = 12.0
# Noise that makes what agrees with a pose worth nothing, as a share of the object's radius in the image, and pixels at
# least. What is found near a wrong pose is spread evenly over the reach: six tenths of it from the middle (root mean
# square) (derived).
WORTHLESS, WORTHLESS_PX = 0.4 * SOLVED, 0.58 * LEAST_PX
# Of less than so many features another pose may have as much: a body of the same outline has about twenty (measured:
# tests/tracking/test_relocalization.py). What a feature must be worth to count, and how many a camera needs for an opinion
# (choice).
ENOUGH, GOOD_SHARE, FEW = 20.0, 0.5, 15
# Among all that there is, what stands still in the regions agrees with itself, and once the object is gone nothing else
# does: this share of what agrees with a pose has to be seen to move (measured: 0.97 and more of true poses of
# benchmarks/kinds.py faint-jumps and jumps-25, 0.05 to 0.18 of an empty room's in back) (choice).
MOVED = 0.5


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
    matches = team.crew.each(lambda c: team.parts[c].match(frame.cameras[c], references[c]), long=True)
    matches = on_the_move(team, joint, frame, matches, ahead)
    joint, seen, ahead, pairs = told_by_matches(team, joint, frame, matches, ahead)
    candidates = [solved_from(team, joint, frame, pairs, ahead, regions)]
    if joint.velocity.frames or seen is not None:
        # Where another side comes into view nothing is known for long, and what goes on as predicted may be believed.
        young = replace(joint, last=replace(joint.base, age=1.0))
        for share in PREDICTED:
            found = found_near(team, young, frame, ahead, ahead, regions, share)
            candidates.append(found if found is not None and is_the_same(joint, found, ahead) else None)
    candidates += [narrowed(team, joint, frame, found, ahead, regions) for found in candidates]
    sound = [found for found in candidates if found is not None and not joint.may_be_background(found.agreed, MOVED)]
    good = [found for found in sound if not is_doubtful(team, joint, found)]
    best = max(good, key=lambda found: score(team, joint, found), default=None)
    return joint, best if best is not None and is_convincing(team, joint, best) else None


def is_convincing(team: Team, joint: Joint, found: Found) -> bool:
    """Whether more features are where a pose says than are there by chance."""
    pose, frame = found.motion * joint.base.world_from_object, found.frame
    references = references_within(team, joint, pose)
    counts = team.crew.each(
        lambda c: team.parts[c].evidence(
            frame.cameras[c], references[c][:ASKED], pose, max(SOLVED * team.radius_px(joint, c, pose), LEAST_PX)
        ),
        long=True,
    )
    there, by_chance = np.array(team.crew.ask(lambda c: counts[c], (0, 0.0))).sum(axis=0)
    return bool(there > CHOSEN + by_chance + 3.0 * np.sqrt(by_chance))


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
        reach = max(share * team.radius_px(joint, c, pose), LEAST_PX)
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
    joint = replace(joint, last=replace(joint.base, age=1.0))
    return found_near(team, joint, frame, pose, ahead, regions, SOLVED)


def worth(team: Team, joint: Joint, found: Found) -> FloatArray:
    """(C,) how much of a feature one that agrees with a pose is worth, by each camera's noise: from 1 to 0, at a noise that
    is the same for all poses."""
    pose = found.motion * joint.base.world_from_object
    cutoff = [max(WORTHLESS * team.radius_px(joint, c, pose), WORTHLESS_PX) for c in range(len(team.rig))]
    noise = np.nan_to_num(np.array([a.noise_px for a in found.agreed]), nan=np.inf)
    return np.asarray(np.maximum(1.0 - (np.minimum(noise, 1e6) / cutoff) ** 2, 0.0) ** 2)


def score(team: Team, joint: Joint, found: Found) -> float:
    """How many features agree with a pose, by what they are worth."""
    return float(worth(team, joint, found) @ np.array([a.features for a in found.agreed]))


def is_doubtful(team: Team, joint: Joint, found: Found) -> bool:
    """Whether so little agrees with a pose, or so badly, that another may be the true one.

    A camera in which much else is seen does not count, if two others agree; nor one that sees next to nothing; nor, while
    no motion is known yet, what stands still: the background agrees with itself.
    """
    known = joint.velocity.frames > 0 or found.solution.status is Status.NO_MOTION
    features = np.array([a.features if known else a.moving for a in found.agreed])
    share = worth(team, joint, found)
    good = share > GOOD_SHARE
    agree, see = int(((features >= FEW) & good).sum()), int((features >= FEW).sum())
    return bool((features * share)[good].sum() < ENOUGH or agree < min(2, see))
