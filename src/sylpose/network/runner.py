"""Thread of a node's work; a node on a real network, by the clock and over links (`simulation` runs it in steps)."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from queue import Empty, SimpleQueue
from threading import Thread

from sylpose.network.membership import (
    Membership,
    Request,
    Response,
    add_inactivity,
    step_membership,
    submit_request,
    take_response,
)
from sylpose.packets import Packet

# Duration of a tick, seconds; timeouts are counted in ticks (choice).
TICK_SECONDS = 0.02
# Ticks for which a finished node still answers nodes that missed its last message (choice: as long as they wait).
LINGER_TICKS = 50


# Work function, called with the function that submits requests; see `Node`.
Work = Callable[[Callable[[Request, int], Response]], None]


class WorkerThread:
    """Thread of a node's work.

    Args:
        work: the function to run.
        on_request: called in the thread for each request, and at the end.

    Attributes:
        is_finished: whether the work has ended.
    """

    def __init__(self, work: Work, on_request: Callable[[], None] = lambda: None) -> None:
        self.is_finished, self._on_request = False, on_request
        self._requests: SimpleQueue[tuple[Request, int] | BaseException | None] = SimpleQueue()
        self._responses: SimpleQueue[Response | None] = SimpleQueue()
        self._thread = Thread(target=self._run, args=(work,), daemon=True)
        self._thread.start()

    def _run(self, work: Work) -> None:
        try:
            work(self._submit)
            self._requests.put(None)
        except BaseException as error:
            # Raised in the waiting thread.
            self._requests.put(error)
        self._on_request()

    def _submit(self, request: Request, frames: int) -> Response:
        self._requests.put((request, frames))
        self._on_request()
        response = self._responses.get()
        if response is None:
            raise SystemExit
        return response

    def next_request(self, wait: bool = True) -> tuple[Request, int] | None:
        """Return the next request and the number of tracked frames.

        Returns None if the work has ended or, without `wait`, is busy.

        Raises:
            Exception: the exception that ended the work.
        """
        try:
            request = self._requests.get(wait)
        except Empty:
            return None
        if isinstance(request, BaseException):
            self.is_finished = True
            raise request
        self.is_finished = request is None
        return request

    def respond(self, response: Response) -> None:
        """Resume the work with the answer to its request."""
        self._responses.put(response)

    def stop(self, *, wait: bool = True) -> None:
        """Stop the work at its pending or next request."""
        self._responses.put(None)
        if wait:
            self._thread.join()


@dataclass
class NodeRunner:
    """Event loop of one node.

    Args:
        membership: membership state at the start.
        work: see `WorkerThread`.
        send: sends packets and returns the number of bytes.

    Attributes:
        bytes_sent, rounds: so far.
    """

    membership: Membership
    work: Work
    send: Callable[[Sequence[Packet]], int]
    bytes_sent: int = 0
    rounds: int = 0

    def __post_init__(self) -> None:
        # Messages; None after a request of the work or a lost link.
        self._events: SimpleQueue[tuple[int, bytes] | None] = SimpleQueue()
        self._lost: SimpleQueue[int] = SimpleQueue()

    def receive(self, sender: int, data: bytes) -> None:
        """Queue a received message, from any thread."""
        self._events.put((sender, data))

    def report_lost(self, camera: int) -> None:
        """Report that a camera's link has ended, which counts as long inactivity. From any thread."""
        self._lost.put(camera)
        self._events.put(None)

    def run(self, on_tick: Callable[[Membership], None], stop: Callable[[], bool]) -> None:
        """Run until the work has ended or `stop` returns True.

        Args:
            on_tick: called every tick.
            stop: polled in each iteration.

        Raises:
            Exception: the exception that ended the work.
        """
        worker = WorkerThread(self.work, on_request=lambda: self._events.put(None))
        due, finished_ticks = time.monotonic() + TICK_SECONDS, 0
        try:
            while not stop() and finished_ticks <= LINGER_TICKS:
                inbox = self._inbox(max(due - time.monotonic(), 0.0))
                tick = time.monotonic() >= due
                if tick:
                    # Not from the old due time: a node that was blocked has not received the others' messages.
                    due = time.monotonic() + TICK_SECONDS
                    finished_ticks += worker.is_finished
                self._step(worker, inbox, tick)
                if tick:
                    on_tick(self.membership)
        finally:
            worker.stop(wait=False)

    def _inbox(self, seconds: float) -> list[tuple[int, bytes]]:
        events = []
        try:
            events.append(self._events.get(timeout=seconds))
            while True:
                events.append(self._events.get_nowait())
        except Empty:
            return [event for event in events if event is not None]

    def _step(self, worker: WorkerThread, inbox: Sequence[tuple[int, bytes]], tick: bool) -> None:
        with suppress(Empty):
            while True:
                self.membership = _mark_inactive(self.membership, self._lost.get_nowait())
        membership, packets = step_membership(self.membership, inbox, tick=tick)
        self.bytes_sent += self.send(packets)
        while True:
            if membership.request is None:
                request = None if worker.is_finished else worker.next_request(wait=False)
                if request is None:
                    break
                membership, packets = submit_request(membership, *request)
                self.bytes_sent += self.send(packets)
            membership, response = take_response(membership)
            if response is None:
                break
            self.rounds += 1
            worker.respond(response)
        self.membership = membership


def _mark_inactive(membership: Membership, camera: int) -> Membership:
    """Count a camera as inactive; later messages of it are still accepted."""
    if membership.round_state is None:
        return membership
    return replace(membership, round_state=add_inactivity(membership.round_state, camera, membership.timeouts.inactive))
