"""Distributed smoothing: cameras exchange observations, and each refines the whole trajectory (`sylpose.smoothing`).

Each camera sends its observations once, and all compute the same result. The alternative is to exchange each camera's
part of the reduced system in every solver round. Its blocks couple all frames that share landmarks: six numbers for
each pair of unknowns, growing with every round and with the square of the frames (docs/history/benchmarks.md, "Nodes").
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sylpose.network.node import Node, Rollback
from sylpose.rig import Rig
from sylpose.smoothing import SmoothedTrajectory, Track, smooth_tracks
from sylpose.tracking.camera_side.frame import LandmarkObservations
from sylpose.tracking.context import TrackedFrame
from sylpose.tracking.reports import CameraObservations, quantize_positions

# Frames per message (choice: of 4 MB at most, with 4,000 observations in each).
FRAMES_PER_MESSAGE = 200


def smooth_by_node(node: Node, rig: Rig, frames: Sequence[TrackedFrame], **options: Any) -> SmoothedTrajectory | None:
    """Refine a node's tracked frames as `smooth_tracks`; the result is the same at all nodes that tracked the same frames.

    Args:
        node, rig: as in `track_by_node`, after the last frame.
        frames: the frames that it yielded; those are refined that all nodes tracked, after the last node joined.
        options: options of `smooth_tracks`.

    Returns:
        The refined trajectory; None if this node was excluded as faulty or suspect.
    """
    while True:
        try:
            return _smooth_common_frames(node, rig, frames, **options)
        except Rollback as rollback:
            if rollback.is_excluded:
                return None


def _smooth_common_frames(node: Node, rig: Rig, frames: Sequence[TrackedFrame], **options: Any) -> SmoothedTrajectory:
    last = max((frame.pose.index for frame in frames), default=0)
    first_common = max(first_common for first_common in node.gather([node.first_index], 0) if first_common <= last)
    tracks = [Track.from_tracked(frame) for frame in frames if frame.pose.index >= first_common]
    radius = next((track.radius for track in reversed(tracks) if track.observations), 1.0)
    for start in range(0, len(tracks), FRAMES_PER_MESSAGE):
        block = tracks[start : start + FRAMES_PER_MESSAGE]
        observations = node.gather([_pack_observations(block, node.camera, radius)], CameraObservations())
        by_camera = [_unpack_observations(sighted, len(block)) for sighted in observations]
        for k, track in enumerate(block):
            sightings = tuple(of[k] for of in by_camera) if track.observations else ()
            tracks[start + k] = Track(track.pose, sightings, track.time_offsets, track.radius, track.nudges)
    node.confirm()
    return smooth_tracks(tracks, rig, **options)


def _pack_observations(block: Sequence[Track], c: int, radius: float) -> CameraObservations:
    """Collect a camera's observations in a block of frames."""
    own_sightings = [(k, track.observations[c]) for k, track in enumerate(block) if track.observations]
    if not own_sightings:
        return CameraObservations()
    frame = np.repeat([k for k, _ in own_sightings], [len(s.landmark_ids) for _, s in own_sightings])
    known, landmark = np.unique(np.concatenate([s.landmark_ids for _, s in own_sightings]), return_inverse=True)
    place, moved = np.zeros((len(known), 3)), np.zeros(len(known), np.int64)
    place[landmark] = np.concatenate([s.positions for _, s in own_sightings])  # the latest one counts
    np.maximum.at(moved, landmark, np.concatenate([s.has_moved for _, s in own_sightings]).astype(np.int64))
    image = np.concatenate([s.normalized for _, s in own_sightings])
    return CameraObservations(
        frame.astype(np.int64), landmark.astype(np.int64), image, known, quantize_positions(place, radius), moved
    )


def _unpack_observations(observations: CameraObservations, frames: int) -> list[LandmarkObservations]:
    """Split observations by frame; none if they contain invalid frame or landmark indices."""
    s, m = observations, len(observations.landmark_ids)
    is_valid = (s.frame >= 0) & (s.frame < frames) & (s.landmark >= 0) & (s.landmark < m)
    if not is_valid.all():
        return _unpack_observations(CameraObservations(), frames)
    ids, positions, moved = s.landmark_ids[s.landmark], s.positions[s.landmark], s.has_moved[s.landmark] > 0
    of_frames = [s.frame == k for k in range(frames)]
    return [LandmarkObservations(ids[k], s.image[k], positions[k], moved[k]) for k in of_frames]
