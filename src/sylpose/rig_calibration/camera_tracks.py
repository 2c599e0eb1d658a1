"""Track of the object by each camera alone, refined: what `relative_motions` compares.

A camera alone is a rig of one camera at the origin; lengths are in units of the object's first distance. A bundle
adjustment of the camera's poses and landmarks removes the tracker's drift. It starts twice, from the track and with
reversed depth, since small or planar objects look alike in both; perspective decides.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.bundle_adjustment.bundle import ROUGH_PX, BundleOptions, BundleResult, Observations, bundle_adjust
from sylpose.bundle_adjustment.scale_prior import find_lost_frames
from sylpose.frames import Box, FrameSet
from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.results import MAX_ROTATION_SD
from sylpose.rig import Camera, Rig
from sylpose.rig_calibration.relative_motions import CameraTrack
from sylpose.smoothing import Track, collect_observations, stack_poses
from sylpose.status import Status
from sylpose.tracking.tracker import track

# A track needs so many frames (choice: fewer leave no redundancy).
MIN_FRAMES = 6
# Reverses depth.
MIRROR = np.array([1.0, 1.0, -1.0])


@dataclass(frozen=True, eq=False)
class RefinedTrack:
    """A camera's own track after bundle adjustment.

    Attributes:
        track: the poses of the frames in which the object was observed.
        times: (n,) seconds, when the camera took these frames.
        observations: of the landmarks in these frames; `frame` counts the track's poses.
        landmarks: (M, 3) positions, object's frame.
        sigma_px: noise, pixels.
        inlier_ratio: share of the observations that agree.
        reversal_ratio: noise relative to inliers, compared with that of reversed depth: below 1, the smaller the
            clearer.
    """

    track: CameraTrack
    times: FloatArray
    observations: Observations
    landmarks: FloatArray
    sigma_px: float
    inlier_ratio: float
    reversal_ratio: float

    def restrict(self, frames: IntArray) -> RefinedTrack:
        """Return the part of the track in the frames with these numbers."""
        kept = np.isin(self.track.frames, frames)
        if kept.all():
            return self
        track = replace(
            self.track,
            frames=self.track.frames[kept],
            camera_from_object=self.track.camera_from_object[kept],
            rotation_covariance=self.track.rotation_covariance[kept],
        )
        return replace(self, track=track, times=self.times[kept], observations=self.observations.select_frames(kept))


def make_single_rig(camera: Camera) -> Rig:
    """Return the rig of one camera at the origin."""
    return Rig([replace(camera, camera_from_world=RigidTransform.identity())])


def track_alone(frames: Iterable[FrameSet], camera: Camera, box: Box | None = None) -> list[Track]:
    """Track the object by one camera.

    Args:
        frames: of this camera only.
        camera: its pose is not used.
        box: the object in the camera's first frame; None: the body that moves with the most features.
    """
    boxes = None if box is None else {camera.name: box}
    return [Track.from_tracked(frame) for frame in track(frames, make_single_rig(camera), boxes)]


def refine_track(tracks: Sequence[Track], camera: Camera) -> RefinedTrack | None:
    """Refine a camera's own track; None if it has too few frames.

    Args:
        tracks: of all frames, in order, as of `track_alone`.
        camera: its pose is not used.
    """
    observed = [t for t in tracks if t.pose.is_observed and any(len(o.landmark_ids) for o in t.observations)]
    if len(observed) < MIN_FRAMES:
        return None
    rig, radius = make_single_rig(camera), observed[-1].radius
    observations, landmarks = collect_observations(observed)
    options = BundleOptions(landmarks=landmarks, rough_px=ROUGH_PX)
    straight = bundle_adjust(rig, observations, stack_poses([t.pose for t in observed]), radius, options)
    poses, landmarks = reverse_depth(straight.world_from_object, straight.landmarks)
    mirrored = bundle_adjust(rig, observations, poses, radius, replace(options, landmarks=landmarks))
    results = sorted([straight, mirrored], key=_badness)
    return _make_track(camera.name, observed, observations, results, radius)


def reverse_depth(camera_from_object: RigidTransform, landmarks: FloatArray) -> tuple[RigidTransform, FloatArray]:
    """Return poses (N) and landmarks (M, 3) that look alike in a camera without perspective: R -> D R D, X -> D X."""
    rotations = MIRROR[:, None] * camera_from_object.rotation.as_matrix() * MIRROR
    poses = RigidTransform.from_components(camera_from_object.translation, Rotation.from_matrix(rotations))
    return poses, landmarks * MIRROR


def _badness(result: BundleResult) -> float:
    """Return the noise relative to the share of inliers."""
    if result.status is Status.TOO_FEW_MATCHES:
        return np.inf
    return float(result.sigma_px[0] / max(float((result.weights > 0).mean()), 1e-9))


def _make_track(
    name: str, tracks: Sequence[Track], observations: Observations, results: Sequence[BundleResult], radius: float
) -> RefinedTrack | None:
    """Make the refined track of the best result, without the frames that it lost; None if too few are left."""
    best, second = results
    covariance = best.covariance[:, :3, :3]
    sd = np.sqrt(np.linalg.eigvalsh(covariance)[:, -1])
    good = best.connected & ~find_lost_frames(best, observations) & (sd < MAX_ROTATION_SD)
    if best.status is Status.TOO_FEW_MATCHES or good.sum() < MIN_FRAMES:
        return None
    kept = good[observations.frame]
    renumbered = Observations(
        (np.cumsum(good) - 1)[observations.frame[kept]],
        observations.camera[kept],
        observations.landmark[kept],
        observations.image[kept],
    )
    numbers = np.array([t.pose.index for t in tracks])[good]
    times = np.array([t.pose.time + t.time_offsets[0] for t in tracks])[good]
    own = CameraTrack(name, numbers, best.world_from_object[good], covariance[good], radius)
    inlier_ratio, ratio = float((best.weights[kept] > 0).mean()), _badness(best) / _badness(second)
    return RefinedTrack(own, times, renumbered, best.landmarks, float(best.sigma_px[0]), inlier_ratio, ratio)
