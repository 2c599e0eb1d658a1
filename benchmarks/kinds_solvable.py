"""Detection of solvable frames among those that a tracker did not solve, for `benchmarks/kinds.py`.

A frame is solvable if at least two cameras have 15 true matches with one earlier solved frame. True matches are SIFT matches
(mutual, with ratio test, of up to 4,000 keypoints per image) within 3 pixels of the true motion of the true surface.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform

from benchmarks.kinds_scenes import Variation
from sylpose import FramePose, FrameSet
from sylpose.features.sift import Features, detect_features, match_features
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Camera
from sylpose.simulate import TexturedBody

__all__ = ["count_true_matches", "find_solvable_frames"]

MIN_CAMERAS, MIN_MATCHES, MAX_ERROR_PX = 2, 15, 3.0
# Number of earlier frames to compare with: those with the smallest rotation against the current frame.
N_EARLIER = 3
MAX_KEYPOINTS = 4000


def find_solvable_frames(variation: Variation, poses: Sequence[FramePose], frames: Sequence[FrameSet]) -> list[int]:
    """Return the numbers of the solvable frames without a measured pose, after the first solved frame."""
    truth, solved, found = variation.scene.object_poses(), [], []
    for k, pose in enumerate(poses):
        if pose.is_measured:
            solved.append(k)
        elif solved:
            rotation_angles = [(truth[k].rotation * truth[j].rotation.inv()).magnitude() for j in solved]
            nearest = [solved[i] for i in np.argsort(rotation_angles, kind="stable")[:N_EARLIER]]
            if any(is_solvable(variation, frames[j], frames[k]) for j in nearest):
                found.append(k)
    return found


def is_solvable(variation: Variation, earlier: FrameSet, later: FrameSet) -> bool:
    """Return whether at least two cameras have enough true matches between two frames."""
    counts = [count_true_matches(variation, c, earlier, later) for c in range(len(variation.scene.rig))]
    return sum(count >= MIN_MATCHES for count in counts) >= MIN_CAMERAS


def count_true_matches(variation: Variation, c: int, earlier: FrameSet, later: FrameSet) -> int:
    """Count the matches of one camera between two frames that agree with the truth."""
    camera, body, truth = variation.scene.rig.cameras[c], variation.scene.actors[0].body, variation.scene.object_poses()
    before, after = (_detect_features(camera, frames, c) for frames in (earlier, later))
    pairs = match_features(before, after)
    surface_points = intersect_surface(camera, before.normalized[pairs[:, 0]], truth[earlier.index], body)
    expected = camera.project(truth[later.index].apply(surface_points).reshape(-1, 3))
    return int((np.linalg.norm(expected - after.pixels[pairs[:, 1]], axis=1) < MAX_ERROR_PX).sum())


def _detect_features(camera: Camera, frames: FrameSet, c: int) -> Features:
    image = frames.images[c]
    return Features.empty() if image is None else detect_features(image, camera, None, MAX_KEYPOINTS)


def intersect_surface(camera: Camera, normalized: FloatArray, pose: RigidTransform, body: TexturedBody) -> FloatArray:
    """Intersect rays (n, 2) with a convex body; return points (n, 3) in its frame, NaN for rays that miss it."""
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
