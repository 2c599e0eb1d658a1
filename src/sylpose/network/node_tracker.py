"""Frame-by-frame tracker made of nodes on a simulated network."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from queue import SimpleQueue
from threading import Thread
from typing import Any, Self

import numpy as np

from sylpose.frames import Box, FrameSet
from sylpose.network.simulation import SimulationResult, track_by_nodes
from sylpose.network.wire_format import HEADER
from sylpose.rig import Rig
from sylpose.tracking.context import TrackedFrame


class NodesTracker:
    """Tracker with the interface of `tracking.tracker.Tracker` and one node per camera.

    The nodes' local results are merged.

    Args:
        rig, boxes: as of `Tracker`.
        mode: as of `Node`.
        options: as of `track_by_nodes`.
    """

    def __init__(self, rig: Rig, boxes: Mapping[str, Box] | None = None, *, mode: str, **options: Any) -> None:
        self._tracked: list[list[TrackedFrame]] = [[] for _ in rig]
        self._frame_sets: dict[int, FrameSet] = {}
        self._n_returned = 0
        # Input frames, None after the last; output: None per requested frame, or the final outcome or error.
        self._inputs: SimpleQueue[FrameSet | None] = SimpleQueue()
        self._outputs: SimpleQueue[SimulationResult | BaseException | None] = SimpleQueue()
        self.outcome: SimulationResult | None = None

        def work() -> None:
            try:
                on_frame = self._store
                self._outputs.put(
                    track_by_nodes(self._iterate_inputs(), rig, boxes, mode=mode, on_frame=on_frame, **options)
                )
            except BaseException as error:
                # Raised in the waiting thread.
                self._outputs.put(error)

        self._thread = Thread(target=work, daemon=True)
        self._thread.start()
        self._wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def step(self, frames: FrameSet) -> list[TrackedFrame]:
        """Track a frame, see `TrackerBase.step`; results are at most one frame later than in one process."""
        self._frame_sets[frames.index] = frames
        self._inputs.put(frames)
        self._wait()
        return self._collect_decided()

    def flush(self) -> list[TrackedFrame]:
        """See `TrackerBase.flush`."""
        self.close()
        return self._collect_decided()

    def close(self) -> None:
        """Stop the nodes."""
        if self._thread.is_alive():
            self._inputs.put(None)
            self._wait()
            self._thread.join()

    def describe_cost(self) -> str:
        """Return a sentence on the communication between the nodes."""
        assert self.outcome is not None
        payload_sizes, n = self.outcome.payload_sizes, max(self._n_returned, 1)
        rounds = np.mean([len(t) for t in payload_sizes]) / n
        sent = np.mean([sum(t) + HEADER.size * len(t) for t in payload_sizes]) / n
        return f"{len(payload_sizes)} nodes exchanged {sent / 1e3:.1f} kB per frame and camera, in {rounds:.1f} rounds"

    def _iterate_inputs(self) -> Iterator[FrameSet]:
        while True:
            self._outputs.put(None)
            frames = self._inputs.get()
            if frames is None:
                return
            yield frames

    def _store(self, camera: int, frame: TrackedFrame) -> None:
        self._tracked[camera].append(frame)

    def _wait(self) -> None:
        """Wait until the nodes request another frame or have ended."""
        output = self._outputs.get()
        if isinstance(output, BaseException):
            raise output
        self.outcome = output or self.outcome

    def _collect_decided(self) -> list[TrackedFrame]:
        out = []
        for k in range(self._n_returned, min(map(len, self._tracked))):
            own = [found[k] for found in self._tracked]
            frames = self._frame_sets.pop(own[0].pose.index)
            images = tuple(a.frames.images[c] for c, a in enumerate(own))
            masks = tuple(a.frames.masks[c] for c, a in enumerate(own))
            out.append(
                replace(
                    own[0],
                    frames=replace(frames, images=images, masks=masks),
                    matches=tuple(a.matches[c] for c, a in enumerate(own)),
                    regions=tuple(a.regions[c] for c, a in enumerate(own)),
                    observations=tuple(a.observations[c] for c, a in enumerate(own)) if own[0].observations else (),
                )
            )
        self._n_returned += len(out)
        return out
