"""Keyframes of an object model from another recording as additional frames of a refinement."""

from __future__ import annotations

import numpy as np

from sylpose.results import FramePose, FrameStatus
from sylpose.rig import Rig
from sylpose.smoothing.trajectory import Track
from sylpose.tracking.object_transfer import TransferredObject
from sylpose.tracking.tracked_frame import LandmarkObservations

__all__ = ["make_keyframe_tracks"]


def make_keyframe_tracks(transferred: TransferredObject, rig: Rig, time: float) -> list[Track]:
    """Return the model's keyframes as tracks to prepend to those of a recording.

    The recording was tracked with the model from its beginning (`Tracker`).

    Args:
        transferred: the model as transferred to this rig.
        rig: the tracker's.
        time: time of the recording's first frame.
    """
    tracks, n = [], len(transferred.keyframes)
    for k, frame in enumerate(transferred.keyframes):
        observations = []
        for name in rig.names:
            camera_landmarks = transferred.landmarks.get(name)
            if camera_landmarks is None:
                observations.append(
                    LandmarkObservations(np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 3)), np.empty(0, bool))
                )
                continue
            observed = camera_landmarks.select_keyframe(k)
            observations.append(
                LandmarkObservations(
                    camera_landmarks.landmark_ids[k],
                    camera_landmarks.features[k].normalized,
                    observed.mean,
                    observed.has_moved,
                )
            )
        counts = np.array([len(s.landmark_ids) for s in observations])
        status = FrameStatus.TRACKED if k else FrameStatus.FIRST
        residuals = np.full(len(rig), np.nan)
        pose = FramePose(k - n, time + k - n, status, frame.world_from_object, frame.covariance, counts, residuals)
        tracks.append(
            Track(
                pose, tuple(observations), np.zeros(len(rig)), transferred.known_object.radius, is_fixed=frame.is_fixed
            )
        )
    return tracks
