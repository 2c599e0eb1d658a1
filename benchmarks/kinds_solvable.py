"""Which frames that a tracker did not solve could have been solved: those of which at least two cameras have 15 true matches
with one earlier frame that it did solve. A part of `benchmarks/kinds.py`.

True matches are SIFT's (mutual, with the ratio test, of up to 4,000 keypoints a picture) that the true motion of the true
surface confirms within 3 pixels.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform

from benchmarks.kinds_scenes import Take
from sylpose import FramePose, FrameSet
from sylpose.features.sift import Features, detect, match_features
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Camera
from sylpose.simulate import TexturedBody

__all__ = ["true_matches", "unsolved_but_solvable"]

CAMERAS, MATCHES, NEAR_PX = 2, 15, 3.0
# Earlier frames that each is compared with: those in which the object was turned the least against now.
EARLIER = 3
KEYPOINTS = 4000


def unsolved_but_solvable(take: Take, poses: Sequence[FramePose], frames: Sequence[FrameSet]) -> list[int]:
    """Numbers of the frames without a measured pose after the first solved one that could have been solved."""
    truth, solved, found = take.scene.poses(), [], []
    for k, pose in enumerate(poses):
        if pose.measured:
            solved.append(k)
        elif solved:
            turns = [(truth[k].rotation * truth[j].rotation.inv()).magnitude() for j in solved]
            nearest = [solved[i] for i in np.argsort(turns, kind="stable")[:EARLIER]]
            if any(is_solvable(take, frames[j], frames[k]) for j in nearest):
                found.append(k)
    return found


def is_solvable(take: Take, earlier: FrameSet, later: FrameSet) -> bool:
    """Whether at least two cameras have enough true matches between two frames."""
    counts = [true_matches(take, c, earlier, later) for c in range(len(take.scene.rig))]
    return sum(count >= MATCHES for count in counts) >= CAMERAS


def true_matches(take: Take, c: int, earlier: FrameSet, later: FrameSet) -> int:
    """How many matches of one camera between two frames the truth confirms."""
    camera, body, truth = take.scene.rig.cameras[c], take.scene.actors[0].body, take.scene.poses()
    before, after = (_features(camera, frames, c) for frames in (earlier, later))
    pairs = match_features(before, after)
    places = on_surface(camera, before.normalized[pairs[:, 0]], truth[earlier.index], body)
    expected = camera.project(truth[later.index].apply(places).reshape(-1, 3))
    return int((np.linalg.norm(expected - after.pixels[pairs[:, 1]], axis=1) < NEAR_PX).sum())


def _features(camera: Camera, frames: FrameSet, c: int) -> Features:
    image = frames.images[c]
    return Features.none() if image is None else detect(image, camera, None, KEYPOINTS)


def on_surface(camera: Camera, normalized: FloatArray, pose: RigidTransform, body: TexturedBody) -> FloatArray:
    """(n, 3) where rays (n, 2) meet a convex body, body's frame; NaN where they miss it."""
    origin = pose.inv().apply(camera.center)
    world = np.column_stack([normalized, np.ones(len(normalized))]) @ camera.rotation
    rays = pose.rotation.inv().apply(world).reshape(-1, 3)
    on_faces = body.vertices[[face[0] for face in body.faces]]
    slope, gap = rays @ body.normals.T, ((on_faces - origin) * body.normals).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = gap / slope
    enters = np.where(slope < 0, depth, -np.inf).max(axis=1)
    leaves = np.where(slope > 0, depth, np.inf).min(axis=1)
    return np.asarray(np.where((enters < leaves)[:, None], origin + enters[:, None] * rays, np.nan))
