"""A tracker that is nodes over a simulated network, fed frame by frame."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from queue import SimpleQueue
from threading import Thread
from typing import Any, Self

import numpy as np

from sylpose.frames import Box, FrameSet
from sylpose.network.simulation import Outcome, track_by_nodes
from sylpose.network.wire_format import HEADER
from sylpose.rig import Rig
from sylpose.tracking.tracked_frame import TrackedFrame

__all__ = ["NodesTracker"]


class NodesTracker:
    """As `tracking.tracker.Tracker`, a node for each camera; with what each kept to itself put together again.

    Args:
        rig, boxes: as of `Tracker`; mode: as of `Node`; options: as of `track_by_nodes`.
    """

    def __init__(self, rig: Rig, boxes: Mapping[str, Box] | None = None, *, mode: str, **options: Any) -> None:
        self._found: list[list[TrackedFrame]] = [[] for _ in rig]
        self._frames: dict[int, FrameSet] = {}
        self._given = 0
        # Frames for the nodes, None after the last one; and None for each that they want, or how it ended.
        self._feed: SimpleQueue[FrameSet | None] = SimpleQueue()
        self._wants: SimpleQueue[Outcome | BaseException | None] = SimpleQueue()
        self.outcome: Outcome | None = None

        def work() -> None:
            try:
                on_frame = self._keep
                self._wants.put(track_by_nodes(self._coming(), rig, boxes, mode=mode, on_frame=on_frame, **options))
            except BaseException as error:
                # Raised where it is waited for.
                self._wants.put(error)

        self._thread = Thread(target=work, daemon=True)
        self._thread.start()
        self._wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def step(self, frames: FrameSet) -> list[TrackedFrame]:
        """See `Tracking.step`: the frames that all nodes have decided, one later at most than in one process."""
        self._frames[frames.index] = frames
        self._feed.put(frames)
        self._wait()
        return self._decided()

    def flush(self) -> list[TrackedFrame]:
        """See `Tracking.flush`."""
        self.close()
        return self._decided()

    def close(self) -> None:
        """End the nodes."""
        if self._thread.is_alive():
            self._feed.put(None)
            self._wait()
            self._thread.join()

    def cost(self) -> str:
        """A sentence on what the nodes told each other."""
        assert self.outcome is not None
        told, n = self.outcome.told, max(self._given, 1)
        rounds = np.mean([len(t) for t in told]) / n
        sent = np.mean([sum(t) + HEADER.size * len(t) for t in told]) / n
        return f"{len(told)} nodes told each other {sent / 1e3:.1f} kB per frame and camera, in {rounds:.1f} rounds"

    def _coming(self) -> Iterator[FrameSet]:
        while True:
            self._wants.put(None)
            frames = self._feed.get()
            if frames is None:
                return
            yield frames

    def _keep(self, camera: int, frame: TrackedFrame) -> None:
        self._found[camera].append(frame)

    def _wait(self) -> None:
        """Until the nodes want another frame, or have ended."""
        said = self._wants.get()
        if isinstance(said, BaseException):
            raise said
        self.outcome = said or self.outcome

    def _decided(self) -> list[TrackedFrame]:
        out = []
        for k in range(self._given, min(map(len, self._found))):
            own = [found[k] for found in self._found]
            frames = self._frames.pop(own[0].pose.index)
            images = tuple(a.frames.images[c] for c, a in enumerate(own))
            masks = tuple(a.frames.masks[c] for c, a in enumerate(own))
            out.append(
                replace(
                    own[0],
                    frames=replace(frames, images=images, masks=masks),
                    matches=tuple(a.matches[c] for c, a in enumerate(own)),
                    regions=tuple(a.regions[c] for c, a in enumerate(own)),
                    sightings=tuple(a.sightings[c] for c, a in enumerate(own)) if own[0].sightings else (),
                )
            )
        self._given += len(out)
        return out
