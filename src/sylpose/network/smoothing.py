"""A trajectory refined as a whole (`sylpose.smoothing`) by cameras each of which knows its own sights alone.

Each camera tells what it saw, once, and all compute the same. What they could tell instead in every round of the solver is
their part of the reduced system, whose blocks tie all frames that share landmarks: six numbers for each pair of unknowns,
more with every round and with the square of the frames (docs/benchmarks.md, "Nodes").
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sylpose.network.node import Again, Node
from sylpose.rig import Rig
from sylpose.smoothing.trajectory import Smoothed, Track, smooth
from sylpose.tracking.reports import Sighted, placed
from sylpose.tracking.tracked_frame import Sightings, TrackedFrame

__all__ = ["smooth_by_node"]

# Frames whose sights are told in one message (choice: of 4 MB at most, with 4,000 sights in each).
TOGETHER = 200


def smooth_by_node(node: Node, rig: Rig, frames: Sequence[TrackedFrame], **options: Any) -> Smoothed | None:
    """`smooth`, of what a node has tracked, the same at all nodes that have tracked the same.

    Args:
        node, rig: as in `track_by_node`, after the last frame.
        frames: that it yielded. Those are refined that all nodes have tracked together, since the last of them came.
        options: of `smooth`.

    Returns:
        None where this node has lied, or one of two of which the others do not know which one did.
    """
    while True:
        try:
            return _smoothed(node, rig, frames, **options)
        except Again as again:
            if again.outcast:
                return None


def _smoothed(node: Node, rig: Rig, frames: Sequence[TrackedFrame], **options: Any) -> Smoothed:
    last = max((frame.pose.index for frame in frames), default=0)
    since = max(since for since in node.ask(lambda _: node.since, 0) if since <= last)
    tracks = [Track.of(frame) for frame in frames if frame.pose.index >= since]
    radius = next((track.radius for track in reversed(tracks) if track.sightings), 1.0)
    for start in range(0, len(tracks), TOGETHER):
        block = tracks[start : start + TOGETHER]
        told = node.ask(lambda c, block=block: _told(block, c, radius), Sighted.none())  # type: ignore[misc]
        of_cameras = [_sightings(sighted, len(block)) for sighted in told]
        for k, track in enumerate(block):
            sightings = tuple(of[k] for of in of_cameras) if track.sightings else ()
            tracks[start + k] = Track(track.pose, sightings, track.late, track.radius, track.nudges)
    node.confirm()
    return smooth(tracks, rig, **options)


def _told(block: Sequence[Track], c: int, radius: float) -> Sighted:
    """What a camera saw in some frames."""
    mine = [(k, track.sightings[c]) for k, track in enumerate(block) if track.sightings]
    if not mine:
        return Sighted.none()
    frame = np.repeat([k for k, _ in mine], [len(s.landmark) for _, s in mine])
    known, landmark = np.unique(np.concatenate([s.landmark for _, s in mine]), return_inverse=True)
    place, moved = np.zeros((len(known), 3)), np.zeros(len(known), np.int64)
    place[landmark] = np.concatenate([s.place for _, s in mine])  # the last one counts
    np.maximum.at(moved, landmark, np.concatenate([s.moved for _, s in mine]).astype(np.int64))
    image = np.concatenate([s.normalized for _, s in mine])
    return Sighted(frame.astype(np.int64), landmark.astype(np.int64), image, known, placed(place, radius), moved)


def _sightings(told: Sighted, frames: int) -> list[Sightings]:
    """By frame; nothing of what names frames or landmarks that are not there."""
    m = len(told.known)
    good = (told.frame >= 0) & (told.frame < frames) & (told.landmark >= 0) & (told.landmark < m)
    if not good.all():
        return _sightings(Sighted.none(), frames)
    of_frames = [told.frame == k for k in range(frames)]
    numbers, places, moved = told.known[told.landmark], told.place[told.landmark], told.moved[told.landmark] > 0
    return [Sightings(numbers[k], told.image[k], places[k], moved[k]) for k in of_frames]
