"""All recordings of an archive given to workers, wherever these are; a worker that dies costs only what it was at."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from sylpose.archive.contract import How, Summary, give_up
from sylpose.archive.recordings import Recording
from sylpose.archive.stores import Place

__all__ = ["Died", "Workers", "run_all", "shard_of"]

# How often a recording may cost a worker its life, and how often a computer that is gone may have had it (choice: a crash is
# tried again once; computers that are taken away say nothing about a recording).
CRASHES, LOST_NODES = 2, 10
# Seconds between two looks at what other workers hold, and at the workers (choice).
LOOK_AGAIN, WAIT = 5.0, 0.5


@dataclass(frozen=True)
class Died:
    """A worker that ended without an answer.

    Attributes:
        why: a sentence.
        with_node: the whole computer went away.
    """

    why: str
    with_node: bool = False


class Workers(Protocol):
    """What a driver is: takes recordings and gives what `process` says of them."""

    def has_room(self) -> bool:
        """Whether one more recording may be submitted."""

    def submit(self, recording: Recording) -> None: ...

    def running(self) -> int:
        """How many recordings are submitted and have no outcome."""

    def outcomes(self, seconds: float) -> list[tuple[Recording, Summary | Died]]:
        """What has come since the last time; waits so long for the first."""


def run_all(
    recordings: Sequence[Recording],
    destination: Place,
    how: How,
    workers: Workers,
    on_outcome: Callable[[Recording, Summary], None],
    on_look: Callable[[int, int], None] = lambda *_: None,
) -> None:
    """Gives all recordings to workers. One whose worker dies is tried once more, then given up.

    What other runs hold is looked at again until they have finished it or their claim has expired.

    Args:
        on_outcome: called once with each recording.
        on_look: called now and then with how many are worked on, and how many others hold.
    """
    waiting, deaths, lost = deque(recordings), Counter[str](), Counter[str]()
    held: list[tuple[float, Recording]] = []
    while waiting or held or workers.running():
        now = time.monotonic()
        waiting.extend(recording for due, recording in held if due <= now)
        held = [(due, recording) for due, recording in held if due > now]
        while waiting and workers.has_room():
            workers.submit(waiting.popleft())
        on_look(workers.running(), len(held))
        if not workers.running():
            time.sleep(WAIT)
            continue
        for recording, outcome in workers.outcomes(WAIT):
            if isinstance(outcome, Died):
                count = lost if outcome.with_node else deaths
                count[recording.name] += 1
                if deaths[recording.name] < CRASHES and lost[recording.name] < LOST_NODES:
                    waiting.appendleft(recording)
                    continue
                outcome = give_up(recording, destination, how, f"{outcome.why}, {count[recording.name]} times")
            if outcome.status == "held":
                held.append((time.monotonic() + LOOK_AGAIN, recording))
            else:
                on_outcome(recording, outcome)


def shard_of(recordings: Sequence[Recording], shard: str) -> list[Recording]:
    """Every N-th recording, from the K-th on, for "K/N".

    Raises:
        ValueError: not of this form, or K not in 1 ... N.
    """
    k, _, n = shard.partition("/")
    if not (k.isdigit() and n.isdigit() and 1 <= int(k) <= int(n)):
        raise ValueError(
            f"--shard: one of 1/N to N/N is expected, such as 3/100, got {shard!r} (for SLURM: --array=1-100)"
        )
    return list(recordings[int(k) - 1 :: int(n)])
