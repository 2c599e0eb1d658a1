"""Nodes in one process on a simulated network: for reproducible tests, and as a frame-by-frame tracker."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from queue import SimpleQueue
from threading import Thread
from typing import Any, NamedTuple, Self

import numpy as np

from sylpose.frames import Box, FrameSet
from sylpose.geometry.arrays import IntArray
from sylpose.methods import MODES
from sylpose.network.codec import NO_FRAME
from sylpose.network.membership import (
    ExchangeRequest,
    Membership,
    Request,
    Response,
    step_membership,
    submit_request,
    take_response,
)
from sylpose.network.node import Node, track_by_node
from sylpose.network.rounds import DEFAULT_TIMEOUTS
from sylpose.network.runner import WorkerThread
from sylpose.network.smoothing import smooth_by_node
from sylpose.network.wire_format import HEADER, Welcome
from sylpose.packets import NO_FAULTS, Inbox, NetworkFaults, Packet, run_network
from sylpose.rig import Rig
from sylpose.smoothing import SmoothedTrajectory
from sylpose.tracking.context import TrackedFrame

# Steps for which a finished node still answers nodes that missed its last message (derived: longer than they wait).
LINGER_STEPS = 2 * DEFAULT_TIMEOUTS.inactive
# Frames kept if all nodes are at the same one (derived: that and the next).
FRAMES_KEPT = 2
# Largest number of network steps (choice: a day of frames).
MAX_STEPS = 10**7


@dataclass(frozen=True, eq=False)
class NodeState:
    """State of a simulated node.

    Attributes:
        membership: its membership.
        worker: its work.
        finished_steps: steps since the work ended.
        payload_sizes: payload bytes per round.
    """

    membership: Membership
    worker: WorkerThread
    finished_steps: int = 0
    payload_sizes: list[int] = field(default_factory=list)

    @property
    def done(self) -> bool:
        """Return whether the node will send nothing more."""
        return self.finished_steps > LINGER_STEPS


class SimulationResult(NamedTuple):
    """Result of tracking a recording.

    Attributes:
        frames: by camera, its tracked frames.
        members: by camera, the final members of its group; empty for one that never began.
        steps: network steps until all nodes were finished.
        payload_sizes: by camera, the payload bytes of each round, without the header of 12.
        refused: by camera, the rejected cameras and the reasons.
        sent, received: (C,) bytes, including retransmissions.
        smoothed: by camera, the refined trajectory, if requested and the node survived.
    """

    frames: list[list[TrackedFrame]]
    members: list[tuple[int, ...]]
    steps: int
    payload_sizes: list[list[int]]
    refused: list[dict[int, str]]
    sent: IntArray
    received: IntArray
    smoothed: list[SmoothedTrajectory | None]


class NodeFault(NamedTuple):
    """Byzantine fault of a node, for tests of the others.

    Attributes:
        alter_payload: alters each payload, for all receivers and for the node itself; None for none.
        alter_message: alters each message, given its bytes and the receiver; None for none.
    """

    alter_payload: Callable[[bytes], bytes] | None = None
    alter_message: Callable[[bytes, int], bytes] | None = None


class FrameBuffer:
    """Recording that is read sequentially on demand; the last `max_kept` frames are stored, None for all."""

    def __init__(self, frames: Iterable[FrameSet], max_kept: int | None = None) -> None:
        self._frames, self._max_kept, self._read = iter(frames), max_kept, 0
        self._frames_kept: dict[int, FrameSet] = {}

    def has_frame(self, number: int) -> bool:
        """Return whether the recording has this frame."""
        while self._read <= number:
            frame = next(self._frames, None)
            if frame is None:
                return False
            self._frames_kept[self._read] = frame
            self._read += 1
            if self._max_kept is not None:
                self._frames_kept.pop(self._read - 1 - self._max_kept, None)
        return True

    def __getitem__(self, number: int) -> FrameSet:
        """Return a frame; an empty one after the end, for a frame that only a faulty node announced."""
        if self.has_frame(number):
            return self._frames_kept[number]
        last = self._frames_kept[self._read - 1]
        nothing = (None,) * len(last.images)
        return replace(last, index=number, time=last.time + number - last.index, images=nothing, masks=nothing)


class RecordedCamera:
    """Frames of one camera of a recording, available immediately."""

    def __init__(self, camera: int, frames: FrameBuffer) -> None:
        self._camera, self._frames = camera, frames

    def newest(self, wanted: int) -> tuple[int, float | None]:
        """See `CameraFrames`."""
        return (wanted, self.time_of(wanted)) if self._frames.has_frame(wanted) else (NO_FRAME, None)

    def time_of(self, number: int) -> float | None:
        """See `CameraFrames`."""
        return self._frames[number].times[self._camera]

    def frame_set(self, number: int, times: Sequence[float | None]) -> FrameSet:
        """See `CameraFrames`."""
        frame, c = self._frames[number], self._camera
        images = tuple(image if k == c else None for k, image in enumerate(frame.images))
        masks = tuple(mask if k == c else None for k, mask in enumerate(frame.masks))
        return replace(frame, times=tuple(times), images=images, masks=masks)


def track_by_nodes(
    frames: Iterable[FrameSet],
    rig: Rig,
    boxes: Mapping[str, Box] | None = None,
    *,
    network_faults: NetworkFaults = NO_FAULTS,
    faults: Mapping[int, NodeFault] | None = None,
    mode: str = MODES[0],
    smooth: bool = False,
    on_frame: Callable[[int, TrackedFrame], None] | None = None,
    **options: Any,
) -> SimulationResult:
    """Track the object as `track`, by simulated nodes, each with its own images only.

    Args:
        frames, rig, boxes: as `track`.
        network_faults: faults of the network.
        faults: camera -> its fault.
        mode: mode of the nodes, see `Node`.
        smooth: refine all poses jointly after the last frame (`smooth_by_node`).
        on_frame: called with a camera and each of its tracked frames.
        options: as of `track`.

    Raises:
        ValueError: as `track`.
    """
    n = len(rig)
    faults = faults or {}
    message_faults = {c: fault.alter_message for c, fault in faults.items() if fault.alter_message is not None}
    # Without faults, nodes work sequentially and none is a frame ahead, so two frames suffice.
    recording = FrameBuffer(frames, FRAMES_KEPT if network_faults == NO_FAULTS and not faults else None)
    smoothed: list[SmoothedTrajectory | None] = [None] * n
    first = [c for c in range(n) if c not in network_faults.joins]
    found: list[list[TrackedFrame]] = [[] for _ in range(n)]
    refused: list[dict[int, str]] = [{} for _ in range(n)]
    workers: list[WorkerThread] = []
    starts = [0] * n

    def start(c: int) -> tuple[NodeState, list[Packet]]:
        starts[c] += 1
        is_founder = starts[c] == 1 and c in first

        def track(request: Callable[[Request, int], Response]) -> None:
            if c in faults and (alter := faults[c].alter_payload) is not None:
                request = _wrap_payload_fault(request, alter)
            node = Node(c, n, request, mode)
            node.refused = refused[c]
            camera_frames = RecordedCamera(c, recording)
            # Stored one by one, so that the frames of a node that fails are kept.
            # A faulty node may fail by its own payloads; the others must not.
            with suppress(Exception) if c in faults else nullcontext():
                for frame in track_by_node(node, rig, camera_frames, boxes, must_join=not is_founder, **options):
                    found[c].append(frame)
                    if on_frame is not None:
                        on_frame(c, frame)
                if smooth:
                    smoothed[c] = smooth_by_node(node, rig, found[c])

        worker = WorkerThread(track)
        workers.append(worker)
        group = Welcome(0, 0, frozenset(first), b"") if is_founder else None
        membership = Membership(c, n, incarnation=starts[c], wait=DEFAULT_TIMEOUTS.inactive, welcome=group)
        return _run_work(NodeState(membership, worker), [])

    try:
        outcome = run_network(
            [partial(start, c) for c in range(n)], _step_node, network_faults, MAX_STEPS, message_faults
        )
    finally:
        for worker in workers:
            worker.stop()
    for c, s in enumerate(outcome.states):
        refused[c] |= {} if s is None else s.membership.all_refused
    members = [() if s is None else s.membership.members for s in outcome.states]
    sizes = [[] if s is None else s.payload_sizes for s in outcome.states]
    return SimulationResult(found, members, outcome.rounds, sizes, refused, outcome.sent, outcome.received, smoothed)


def _wrap_payload_fault(
    request: Callable[[Request, int], Response], falsify: Callable[[bytes], bytes]
) -> Callable[[Request, int], Response]:
    return lambda sent, frames: request(
        sent._replace(payload=falsify(sent.payload)) if isinstance(sent, ExchangeRequest) else sent, frames
    )


def _step_node(state: NodeState, inbox: Inbox) -> tuple[NodeState, list[Packet]]:
    membership, packets = step_membership(state.membership, inbox)
    state = replace(state, membership=membership, finished_steps=state.finished_steps + (state.finished_steps > 0))
    updated, response = take_response(membership)
    if response is None:
        return state, packets
    state.worker.respond(response)
    return _run_work(replace(state, membership=updated), packets)


def _run_work(s: NodeState, packets: list[Packet]) -> tuple[NodeState, list[Packet]]:
    """Run the work as far as the received messages allow."""
    while True:
        request = s.worker.next_request()
        if request is None:
            return replace(s, finished_steps=1), packets
        membership, more = submit_request(s.membership, *request)
        packets = packets + more
        if isinstance(request[0], ExchangeRequest):
            s.payload_sizes.append(len(request[0].payload))
        if len(membership.members) == 1:  # alone in a group, a round also takes one step
            return replace(s, membership=membership), packets
        membership, response = take_response(membership)
        s = replace(s, membership=membership)
        if response is None:
            return s, packets
        s.worker.respond(response)


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
                inputs, store = self._iterate_inputs(), lambda camera, frame: self._tracked[camera].append(frame)
                self._outputs.put(track_by_nodes(inputs, rig, boxes, mode=mode, on_frame=store, **options))
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
            # Each node knows its own camera's part; parts are empty where the frame was not solved.
            parts: dict[str, Any] = {
                name: tuple(getattr(a, name)[c] for c, a in enumerate(own))
                for name in ("matches", "regions", "observations", "detections")
                if getattr(own[0], name)
            }
            out.append(replace(own[0], frames=replace(frames, images=images, masks=masks), **parts))
        self._n_returned += len(out)
        return out
