"""Distribution of all recordings to workers; a worker that dies loses only its current recording."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from sylpose.archive.contract import RunSettings, Summary, mark_crashed
from sylpose.archive.recordings import Recording
from sylpose.archive.stores import Store

__all__ = ["WorkerDeath", "Workers", "process_all", "select_shard"]

# Worker crashes, and lost computers, after which a recording is abandoned (choice: a crash is retried once; lost
# computers are not a recording's fault).
MAX_CRASHES, MAX_LOST_NODES = 2, 10
# Seconds between checks of recordings held by other workers, and of the own workers (choice).
HELD_CHECK_INTERVAL, WORKER_CHECK_INTERVAL = 5.0, 0.5


@dataclass(frozen=True)
class WorkerDeath:
    """A worker that ended without a result.

    Attributes:
        reason: why it ended.
        with_node: the whole computer was lost.
    """

    reason: str
    with_node: bool = False


class Workers(Protocol):
    """Driver interface: accepts recordings and returns the results of `process_recording`."""

    def has_room(self) -> bool:
        """Return whether one more recording may be submitted."""

    def submit(self, recording: Recording) -> None: ...

    def count_running(self) -> int:
        """Return the number of submitted recordings without an outcome."""

    def wait_for_outcomes(self, seconds: float) -> list[tuple[Recording, Summary | WorkerDeath]]:
        """Return new outcomes, after waiting up to `seconds` for the first."""


def process_all(
    recordings: Sequence[Recording],
    destination: Store,
    settings: RunSettings,
    workers: Workers,
    on_outcome: Callable[[Recording, Summary], None],
    on_progress: Callable[[int, int], None] = lambda *_: None,
) -> None:
    """Distribute all recordings to workers; one whose worker dies is retried once, then abandoned.

    Recordings held by other runs are checked again until these finish them or their claim expires.

    Args:
        recordings: to be processed.
        destination: where the results go.
        settings: settings of the run.
        workers: the driver.
        on_outcome: called once with each recording.
        on_progress: called regularly with the numbers of running recordings and of those held by others.
    """
    waiting, deaths, lost_nodes = deque(recordings), Counter[str](), Counter[str]()
    held: list[tuple[float, Recording]] = []
    while waiting or held or workers.count_running():
        now = time.monotonic()
        waiting.extend(recording for due, recording in held if due <= now)
        held = [(due, recording) for due, recording in held if due > now]
        while waiting and workers.has_room():
            workers.submit(waiting.popleft())
        on_progress(workers.count_running(), len(held))
        if not workers.count_running():
            time.sleep(WORKER_CHECK_INTERVAL)
            continue
        for recording, outcome in workers.wait_for_outcomes(WORKER_CHECK_INTERVAL):
            if isinstance(outcome, WorkerDeath):
                count = lost_nodes if outcome.with_node else deaths
                count[recording.name] += 1
                if deaths[recording.name] < MAX_CRASHES and lost_nodes[recording.name] < MAX_LOST_NODES:
                    waiting.appendleft(recording)
                    continue
                outcome = mark_crashed(
                    recording, destination, settings, f"{outcome.reason}, {count[recording.name]} times"
                )
            if outcome.status == "held":
                held.append((time.monotonic() + HELD_CHECK_INTERVAL, recording))
            else:
                on_outcome(recording, outcome)


def select_shard(recordings: Sequence[Recording], shard: str) -> list[Recording]:
    """Return every N-th recording, starting with the K-th, for a shard "K/N".

    Raises:
        ValueError: not of this form, or K not in 1 ... N.
    """
    k, _, n = shard.partition("/")
    if not (k.isdigit() and n.isdigit() and 1 <= int(k) <= int(n)):
        raise ValueError(
            f"--shard: one of 1/N to N/N is expected, such as 3/100, got {shard!r} (for SLURM: --array=1-100)"
        )
    return list(recordings[int(k) - 1 :: int(n)])
