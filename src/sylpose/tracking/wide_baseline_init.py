"""Another path, as two frames far apart tell it: a check of poses that were found one after the other.

Where the object turns slowly, is nearly flat, or few cameras see it, its first small turn is told from its relief by next to
nothing. What is then believed of the relief makes each next pose agree with the last ones, and the refinement of all of them
ends in the nearest minimum, sure of itself. Two frames far apart know nothing of that: the landmarks that both see are
matches, which one large motion explains or does not, with relief as unknown as ever (`estimate_motion`). Where that motion
contradicts the path, the path is bent to agree with it, as another start of the refinement, and the likelier one counts.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.bundle_adjustment.bundle import Observations
from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.robust_loss import chi_squared_bound
from sylpose.matches import Matches
from sylpose.relative_pose.motion import estimate_motion
from sylpose.results import Status
from sylpose.rig import Rig

__all__ = ["another_path"]

# Of a path of fewer frames nothing is asked: what few frames agree on, the next may not (choice).
LEAST = 16
# Two frames are compared where so many landmarks are seen in both of them, by two cameras at least; and believed where so
# large a share of these agree on the motion (choice).
SHARED, CAMERAS, AGREED = 60, 2, 0.75
# A motion contradicts a path where it excludes the path's (chi-squared, once in a thousand times), and is off by more than
# this turn, radians, or share of the object's radius: what matters less is the refinement's to find (choice).
EXCLUDED = chi_squared_bound(6)
TURN, SHIFT = np.deg2rad(0.5), 0.03
# Links of a path that are asked, about; those of so many frames in two halves (choice).
LINKS, LONG = 6, 8


def another_path(rig: Rig, seen: Observations, path: RigidTransform, radius: float) -> RigidTransform | None:
    """The path (N poses), bent to agree with the motions between frames that are far apart; None where these do not
    contradict it.

    From the last frame on, each link leads to the earliest frame that shares enough landmarks; what is halfway is asked as
    well.

    Args:
        radius: of the object.
    """
    if len(path) < LEAST:
        return None
    nodes = [len(path) - 1]
    while nodes[-1] > 0 and len(nodes) <= LINKS:
        earlier = _earliest(seen, nodes[-1])
        if earlier is None:
            break
        if nodes[-1] - earlier >= LONG:
            nodes.append((earlier + nodes[-1]) // 2)
        nodes.append(earlier)
    pairs = list(pairwise(reversed(nodes)))
    offs = [_off(rig, seen, path, *pair, radius) for pair in pairs]
    if all(off is None for off in offs):
        return None
    poses = list(path)
    # From the first link on; what is before it stays.
    for (earlier, later), off in zip(pairs, offs, strict=True):
        poses[earlier + 1 :] = _bent(path, poses[earlier], earlier, later, off)
    return RigidTransform.concatenate(poses)


def _shared(seen: Observations, one: int, other: int) -> list[tuple[IntArray, IntArray]]:
    """Of each camera the observations of the same landmarks in two frames."""
    out = []
    for camera in range(int(seen.camera.max(initial=-1)) + 1):
        mine = [np.flatnonzero((seen.frame == k) & (seen.camera == camera)) for k in (one, other)]
        _, a, b = np.intersect1d(seen.landmark[mine[0]], seen.landmark[mine[1]], return_indices=True)
        out.append((mine[0][a], mine[1][b]))
    return out


def _earliest(seen: Observations, later: int) -> int | None:
    """The earliest frame that shares enough landmarks with a later one."""
    at = seen.frame == later
    also = (seen.frame < later) & np.isin(seen.landmark, seen.landmark[at])
    counts = np.bincount(seen.frame[also], minlength=later)
    for k in np.flatnonzero(counts >= SHARED).tolist():
        if len(np.unique(seen.camera[also & (seen.frame == k)])) >= CAMERAS:
            return int(k)
    return None


def _off(
    rig: Rig, seen: Observations, path: RigidTransform, earlier: int, later: int, radius: float
) -> FloatArray | None:
    """(6,) (w, d) from the later pose to where it would be by the motion between the two frames, about the object's place;
    None where that motion is not known, or does not contradict the path."""
    pairs = _shared(seen, earlier, later)
    matches = [Matches(seen.image[a], seen.image[b]) for a, b in pairs]
    matches += [Matches.none()] * (len(rig) - len(matches))
    found = estimate_motion(rig, matches, center=path[earlier].translation, radius=radius)
    if found.status is not Status.OK or found.motion is None or found.faults or found.second > 0.0:
        return None
    if found.n_inliers.sum() < AGREED * sum(len(m) for m in matches):
        return None
    should = found.motion * path[earlier]
    turn = (should.rotation * path[later].rotation.inv()).as_rotvec()
    off = np.concatenate([turn, should.translation - path[later].translation])
    matters = np.linalg.norm(turn) > TURN or np.linalg.norm(off[3:]) > SHIFT * radius
    return off if matters and off @ found.information @ off > EXCLUDED else None


def _bent(
    path: RigidTransform, start: RigidTransform, earlier: int, later: int, off: FloatArray | None
) -> list[RigidTransform]:
    """The poses after the earlier frame, which begins at another pose; up to the later one a growing share of what that is
    off is added, as the path turns."""
    moved = start * path[earlier].inv()
    turns = (path.rotation * path[earlier].rotation.inv()).magnitude()
    whole, out = max(float(turns[later]), 1e-9), []
    for k in range(earlier + 1, len(path)):
        pose = moved * path[k]
        if off is not None:
            share = min(float(turns[k]) / whole, 1.0) if k < later else 1.0
            turn = Rotation.from_rotvec(share * off[:3])
            pose = RigidTransform.from_components(pose.translation + share * off[3:], turn * pose.rotation)
        out.append(pose)
    return out
