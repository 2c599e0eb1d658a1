"""A node on a real network: what `simulated` does in steps, by the clock and with links."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from queue import Empty, SimpleQueue

from sylpose.network.membership import Present, answer, asked, present_step, silenced
from sylpose.network.worker_thread import Talk, Work
from sylpose.sylvester.distributed.messages import Packet

__all__ = ["TICK", "Runner"]

# Seconds of a tick: patience is counted in these (choice).
TICK = 0.02
# Ticks for which a node that is through answers those that have missed its last word (choice: as long as they wait).
LINGERS = 50


@dataclass
class Runner:
    """One node at work.

    Args:
        present: at its start.
        work: see `Talk`.
        send: packets to the others.

    Attributes:
        bytes_sent, rounds: so far.
    """

    present: Present
    work: Work
    send: Callable[[Sequence[Packet]], int]
    bytes_sent: int = 0
    rounds: int = 0

    def __post_init__(self) -> None:
        # Messages, and None where the work has asked for something, or somebody has gone.
        self._events: SimpleQueue[tuple[int, bytes] | None] = SimpleQueue()
        self._gone: SimpleQueue[int] = SimpleQueue()

    def heard(self, sender: int, data: bytes) -> None:
        """A message, from any thread."""
        self._events.put((sender, data))

    def gone(self, camera: int) -> None:
        """Its link has ended: it is as if it had been silent for long. From any thread."""
        self._gone.put(camera)
        self._events.put(None)

    def run(self, on_tick: Callable[[Present], None], stop: Callable[[], bool]) -> None:
        """Until the work is through, or is to be stopped.

        Args:
            on_tick: called every tick.

        Raises:
            Exception: of the work.
        """
        talk = Talk(self.work, on_ask=lambda: self._events.put(None))
        due, through = time.monotonic() + TICK, 0
        try:
            while not stop() and through <= LINGERS:
                inbox = self._inbox(max(due - time.monotonic(), 0.0))
                tick = time.monotonic() >= due
                if tick:
                    # However late: while this node stood still, it has not heard the others.
                    due = time.monotonic() + TICK
                    through += talk.through
                self._step(talk, inbox, tick)
                if tick:
                    on_tick(self.present)
        finally:
            talk.end(wait=False)

    def _inbox(self, seconds: float) -> list[tuple[int, bytes]]:
        events = []
        try:
            events.append(self._events.get(timeout=seconds))
            while True:
                events.append(self._events.get_nowait())
        except Empty:
            return [event for event in events if event is not None]

    def _step(self, talk: Talk, inbox: Sequence[tuple[int, bytes]], tick: bool) -> None:
        with suppress(Empty):
            while True:
                self.present = _without(self.present, self._gone.get_nowait())
        present, packets = present_step(self.present, inbox, tick=tick)
        self.bytes_sent += self.send(packets)
        while True:
            if present.ask is None:
                asks = None if talk.through else talk.asks(wait=False)
                if asks is None:
                    break
                present, packets = asked(present, *asks)
                self.bytes_sent += self.send(packets)
            present, answered = answer(present)
            if answered is None:
                break
            self.rounds += 1
            talk.hears(answered)
        self.present = present


def _without(present: Present, camera: int) -> Present:
    """A word of it, should it come, is heard all the same."""
    if present.agreeing is None:
        return present
    return replace(present, agreeing=silenced(present.agreeing, camera, present.patience.silent))
