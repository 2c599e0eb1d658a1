"""An object that is known from another take, in what is refined: its keyframes are frames before the first."""

from __future__ import annotations

import numpy as np

from sylpose.results import FramePose, FrameStatus
from sylpose.rig import Rig
from sylpose.smoothing.trajectory import Track
from sylpose.tracking.object_transfer import KnownHere
from sylpose.tracking.tracked_frame import Sightings

__all__ = ["tracks_of"]


def tracks_of(here: KnownHere, rig: Rig, time: float) -> list[Track]:
    """The keyframes as tracks, to go before those of a take that began with the object (`Tracker`).

    Args:
        time: of the take's first frame.
    """
    tracks, n = [], len(here.keyframes)
    for k, frame in enumerate(here.keyframes):
        sightings = []
        for name in rig.names:
            memory = here.memories.get(name)
            if memory is None:
                sightings.append(
                    Sightings(np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 3)), np.empty(0, bool))
                )
                continue
            its = memory.seen_in(k)
            sightings.append(Sightings(memory.numbers[k], memory.features[k].normalized, its.mean, its.moved))
        counts = np.array([len(s.landmark) for s in sightings])
        status = FrameStatus.TRACKED if k else FrameStatus.FIRST
        residuals = np.full(len(rig), np.nan)
        pose = FramePose(k - n, time + k - n, status, frame.world_from_object, frame.covariance, counts, residuals)
        tracks.append(Track(pose, tuple(sightings), np.zeros(len(rig)), here.known.radius, stays=frame.stays))
    return tracks
