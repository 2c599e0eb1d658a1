"""One camera as a node: it processes its own images, exchanges numbers with the others and computes the same poses."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Protocol, TypeVar, Unpack

import numpy as np

from sylpose.frames import Box, FrameSet
from sylpose.landmarks.alignment import AlignmentStart, LandmarkMatches
from sylpose.landmarks.distributed_alignment import DistributedAligner
from sylpose.methods import MODES
from sylpose.network.codec import (
    ABSENT,
    FRAME_PENDING,
    NO_FRAME,
    FrameAnnouncement,
    choose_frame,
    decode,
    encode,
    find_common_newcomers,
)
from sylpose.network.membership import ExchangeRequest, ExchangeResult, JoinRequest, Request, Response
from sylpose.network.plausibility import find_implausibility
from sylpose.rig import Rig
from sylpose.tracking.camera_side.camera import CameraTracker
from sylpose.tracking.context import Alignment, TrackedFrame
from sylpose.tracking.joint_side.joint_state import JointState, SolvedFrame
from sylpose.tracking.tracker import Handover, TrackerArguments, TrackerBase, check_handover

T = TypeVar("T")

NO_CAMERAS: frozenset[int] = frozenset()
# Largest difference of the cameras' timestamps in one frame set, seconds (choice: no camera waits longer for the
# others).
MAX_TIMESTAMP_DIFFERENCE = 1.0
# Poses that differ by less than this, radians and relative to the distance, are equal up to rounding (choice).
POSE_TOLERANCE = 1e-6
OBJECT_FRAME_CHANGED = "from here on poses refer to another object frame"


class Rollback(Exception):
    """Not all nodes received the same payloads because one is faulty; all roll back to the last common state.

    Attributes:
        is_excluded: this node is excluded and has to join a group.
    """

    def __init__(self, is_excluded: bool) -> None:
        super().__init__("not all nodes received the same messages")
        self.is_excluded = is_excluded


class CameraFrames(Protocol):
    """Frames of one camera; the frames of all cameras in one frame set have the same number."""

    def newest(self, wanted: int) -> tuple[int, float | None]:
        """Wait for the frame of that number, or a later one.

        Returns:
            The number of the newest available frame, and its timestamp in seconds; `NO_FRAME` at the end,
            `FRAME_PENDING` after a timeout.
        """

    def time_of(self, number: int) -> float | None:
        """Return the timestamp of a frame, seconds; None without one."""

    def frame_set(self, number: int, times: Sequence[float | None]) -> FrameSet:
        """Return a frame set with this camera's images and the timestamps of all cameras."""


class Node:
    """Executor (`tracking.context.CameraExecutor`) with one local camera; the others are remote nodes.

    Args:
        camera: number of the local camera.
        cameras: number of cameras of the rig.
        request: submits a request to the node's membership (`network.membership`), with the number of frames tracked.
        mode: of `MODES`: exact as in one process, or compact with fewer rounds (`landmarks.distributed_alignment`); the
            same at all cameras.

    Attributes:
        camera, cameras: as given.
        members: members of the last round.
        refused: camera -> reason why its first invalid payload was rejected.
        frames: number of tracked frames, while any member of the group knows the object.
        first_index: index of the first frame since it joined its group.
    """

    def __init__(
        self, camera: int, cameras: int, request: Callable[[Request, int], Response], mode: str = MODES[0]
    ) -> None:
        if mode not in MODES:
            raise ValueError(f"mode {mode!r}: expected {' or '.join(MODES)}")
        self.camera, self.cameras, self._request, self._mode = camera, cameras, request, mode
        self.members: tuple[int, ...] = ()
        self.refused: dict[int, str] = {}
        self.frames, self.first_index = 0, 0
        self._last_result = ExchangeResult({}, NO_CAMERAS, False)
        self._pending_newcomers: tuple[frozenset[int], bytes] = NO_CAMERAS, b""

    # --- executor interface -------------------------------------------------------------------------------------------

    @property
    def local(self) -> Sequence[int]:
        """See `CameraExecutor`."""
        return (self.camera,)

    def run(self, function: Callable[..., T], *arguments: Iterable[object]) -> list[T]:
        """See `CameraExecutor`."""
        return list(map(function, *arguments))

    def gather(self, reports: Sequence[T], default: T) -> list[T]:
        """See `CameraExecutor`."""
        return self._exchange(reports[0], default)

    def align(self, observations: Sequence[LandmarkMatches], starts: Sequence[AlignmentStart]) -> list[Alignment]:
        """See `CameraExecutor`."""
        compact = self._mode == "compact"
        aligner = DistributedAligner(observations[0], self.camera, self.cameras, self._exchange, compact=compact)
        return [(one, [(one.weights[0], one.residuals[0])]) for one in aligner.align(starts)]

    def _exchange(self, own_value: T, nothing: T, /) -> list[T]:
        payloads = self._run_round(encode(own_value))
        return [self._decode_payload(c, payloads.get(c), nothing) for c in range(self.cameras)]

    def _run_round(self, payload: bytes) -> Mapping[int, bytes]:
        """Run one round. The result includes this camera's payload as the others received it."""
        result = self._request(ExchangeRequest(payload, *self._pending_newcomers), self.frames)
        assert isinstance(result, ExchangeResult)
        self._last_result, self._pending_newcomers = result, (NO_CAMERAS, b"")
        if result.is_rollback:
            raise Rollback(result.is_excluded)
        self.members = tuple(result.payloads)
        return result.payloads

    def _decode_payload(self, camera: int, data: bytes | None, nothing: T) -> T:
        """Decode and validate a camera's payload; `nothing` if it is missing or invalid."""
        if data is None:
            return nothing
        try:
            value = decode(data, nothing)
            reason = find_implausibility(value, camera)
        except ValueError as error:
            reason = str(error)
        if reason is None:
            return value
        self.refused.setdefault(camera, reason)
        return nothing

    def confirm(self) -> None:
        """Confirm that all members have received the same so far.

        Raises:
            Rollback: they have not.
        """
        self._run_round(b"")

    # --- group membership ---------------------------------------------------------------------------------------------

    def exchange_announcements(self, newest: int, time: float | None, has_object: bool) -> list[FrameAnnouncement]:
        """Exchange frame announcements with all members. Arguments as in `FrameAnnouncement`."""
        stamp = np.nan if time is None else time
        own_announcement = FrameAnnouncement(
            newest, stamp, tuple(sorted(self._last_result.newcomers)), self._last_result.is_outranked, has_object
        )
        announcements = self._exchange(own_announcement, ABSENT)
        return [announcements[c] for c in self.members]

    def admit(self, newcomers: frozenset[int], shared_state: bytes) -> None:
        """Admit newcomers with the next round and send them the shared state."""
        self._pending_newcomers = newcomers, shared_state

    def join_group(self) -> tuple[Handover, int] | None:
        """Wait until the node is in a group.

        Returns:
            The shared state, and the number of the next frame; None if this node founds a group.
        """
        while True:
            joined = self._request(JoinRequest(), self.frames)
            assert not isinstance(joined, ExchangeResult)
            self._last_result = ExchangeResult({}, joined.newcomers, False)
            if joined.shared_state is None:
                return None
            try:
                handover, wanted = decode(joined.shared_state, (Handover(JointState(), (), 0), 0))
                check_handover(handover, self.cameras)
            except ValueError:  # others may welcome it as well
                continue
            if wanted >= 0:
                return handover, wanted


def track_by_node(
    node: Node,
    rig: Rig,
    frame_source: CameraFrames,
    boxes: Mapping[str, Box] | None = None,
    *,
    must_join: bool = False,
    **arguments: Unpack[TrackerArguments],
) -> Iterator[TrackedFrame]:
    """Track the object as `track`, on one node with its own images only.

    Args:
        node: the local camera; the nodes of all cameras call this with the same other arguments.
        rig: as `track`.
        frame_source: its frames.
        boxes: as `track`.
        must_join: whether the node has to join a group; else it begins in one.
        arguments: as `track`; no known object.

    Yields:
        As `track`, the frames in which it took part.

    Raises:
        ValueError: as `track`.
    """
    cameras = [CameraTracker(node.camera, rig.cameras[node.camera])]
    tracking = TrackerBase(rig, cameras, node, boxes, **arguments)
    wanted, admitted_at, found = 0, -1, list[TrackedFrame]()
    defining: SolvedFrame | None = None
    while True:
        if must_join:
            joined, must_join = node.join_group(), False
            if joined is not None:
                handover, wanted = joined
                admitted_at = wanted
                node.first_index = -1
                tracking.apply_handover(handover, is_new=True)
        # The last common state.
        checkpoint = tracking.copy_snapshot()
        try:
            announcements = node.exchange_announcements(*frame_source.newest(wanted), tracking.has_observations)
            is_object_known = any(announcement.has_object for announcement in announcements)
            node.frames = tracking.next_number if is_object_known else 0
            if all(announcement.is_outranked for announcement in announcements):
                must_join = True
                continue
            if not is_object_known:
                # All nodes that knew the object have left, so it cannot be relocalized.
                tracking.restart()
            newcomers = find_common_newcomers(announcements)
            # At most once per frame: a node that joins repeatedly but never takes part must not block the others.
            if newcomers and admitted_at != wanted:
                admitted_at = wanted
                shared_state = encode((tracking.create_handover(), wanted))
                # All continue with the state as sent, whose numbers may be rounded.
                tracking.apply_handover(decode(shared_state, (tracking.create_handover(), wanted))[0], is_new=False)
                node.admit(newcomers, shared_state)
                continue
            number = choose_frame(announcements, wanted)
            if number == FRAME_PENDING:
                continue
            if number == NO_FRAME:
                found = tracking.flush()
            else:
                frames = frame_source.frame_set(number, _collect_timestamps(node, frame_source, announcements, number))
                found = tracking.step(frames)
            node.confirm()
        except Rollback as rollback:
            tracking.restore(checkpoint)
            must_join = rollback.is_excluded
            continue
        if number == NO_FRAME:
            break
        node.first_index = node.first_index if node.first_index >= 0 else frames.index
        wanted = number + 1
        if tracking.first_frame is not None and found:
            if defining is not None and not _is_same_object_frame(defining, tracking.first_frame):
                found[0] = _add_fault(found[0], OBJECT_FRAME_CHANGED)
            defining = tracking.first_frame
        yield from found
    yield from found


def _is_same_object_frame(one: SolvedFrame, other: SolvedFrame) -> bool:
    """Return whether two frames define the same object frame: the same time and the same pose."""
    a, b = one.world_from_object, other.world_from_object
    angle, distance = (a.rotation * b.rotation.inv()).magnitude(), np.linalg.norm(a.translation - b.translation)
    max_distance = POSE_TOLERANCE * np.linalg.norm(one.viewpoints, axis=1).max()
    return bool(one.time == other.time and angle < POSE_TOLERANCE and distance < max_distance)


def _add_fault(tracked: TrackedFrame, message: str) -> TrackedFrame:
    return replace(tracked, pose=replace(tracked.pose, faults=(*tracked.pose.faults, message)))


def _collect_timestamps(
    node: Node, frame_source: CameraFrames, announcements: Sequence[FrameAnnouncement], number: int
) -> tuple[float | None, ...]:
    """Return the timestamp of a frame by camera."""
    by_camera = {c: announcement.time for c, announcement in zip(node.members, announcements, strict=True)}
    if any(announcement.newest >= 0 and announcement.newest != number for announcement in announcements):
        own = frame_source.time_of(number)
        timestamps = node.gather([np.nan if own is None else own], np.nan)
        by_camera = {c: timestamps[c] for c in node.members}
    blind = {c for c, announcement in zip(node.members, announcements, strict=True) if announcement.newest < 0}
    times = {c: time for c, time in by_camera.items() if np.isfinite(time) and c not in blind}
    median_time = float(np.median(list(times.values()))) if times else 0.0
    for c, time in list(times.items()):
        if abs(time - median_time) > MAX_TIMESTAMP_DIFFERENCE:
            message = f"its clock differs by {abs(time - median_time):.3g} s from the others'"
            node.refused.setdefault(c, f"{message}: its timestamps are not used")
            del times[c]
    return tuple(times.get(c) for c in range(node.cameras))
