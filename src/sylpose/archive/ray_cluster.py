"""Workers on a Ray cluster: one task per recording. Ray reports deaths; `run.py` handles them."""

from __future__ import annotations

import logging
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self

from sylpose.archive.contract import RunSettings, Summary, process_recording
from sylpose.archive.processes import MIN_MEMORY, thread_environment
from sylpose.archive.recordings import Recording
from sylpose.archive.run import WorkerDeath
from sylpose.archive.stores import Store, is_url

__all__ = ["RayWorkers"]

# Tasks in flight per available slot, so that the next ones are queued (choice).
TASKS_PER_SLOT = 2
# Seconds for tasks to release their claims after an interrupt (choice).
RELEASE_TIMEOUT_S = 10.0


class RayWorkers:
    """Context manager of Ray tasks; its end cancels running tasks.

    Args:
        destination: where the results go.
        settings: settings of the run.
        address: address of the cluster: "auto", "host:6379" or "ray://host:10001". An existing Ray connection is kept.
        memory: bytes that Ray reserves for each recording.

    Raises:
        ValueError: Ray is not installed, no cluster at the address, or no computer in it is large enough.
    """

    def __init__(self, destination: Store, settings: RunSettings, address: str, memory: int | None = None) -> None:
        try:
            import ray
        except ImportError:
            raise ValueError("--ray needs Ray: python3 -m pip install 'sylpose[cluster]'") from None
        if is_url(destination.url) and destination.url.startswith("memory://"):
            raise ValueError(f"--out {destination.url}: other processes cannot see it")
        self._ray: Any = ray
        self._connected = not ray.is_initialized()
        self._memory, self._n_threads = memory or MIN_MEMORY, settings.threads
        if self._connected:
            try:
                ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
            except (ConnectionError, ValueError, RuntimeError, TimeoutError) as error:
                raise ValueError(f"--ray {address}: {str(error).strip().splitlines()[0]}") from None
        if not self._count_slots():
            self._disconnect()
            gigabytes = self._memory / 2**30
            raise ValueError(
                f"--ray {address}: no computer in the cluster has {settings.threads} cores and {gigabytes:.1f} GB of "
                "memory"
            )
        # One retry policy for all drivers: that of `run.py`, not Ray's.
        task = ray.remote(
            num_cpus=settings.threads,
            memory=self._memory,
            max_retries=0,
            runtime_env={"env_vars": thread_environment(settings.threads)},
        )(process_recording)
        self._start: Callable[[Recording], Any] = lambda recording: task.remote(recording, destination, settings)
        self._tasks: dict[Any, Recording] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        for task in self._tasks:
            self._ray.cancel(task, force=False)
        if self._tasks:
            self._ray.wait(list(self._tasks), num_returns=len(self._tasks), timeout=RELEASE_TIMEOUT_S)
        self._disconnect()

    def _disconnect(self) -> None:
        if self._connected:
            self._ray.shutdown()

    def _count_slots(self) -> int:
        """Return how many recordings the cluster can currently process in parallel."""
        alive = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
        return sum(
            min(int(node.get("CPU", 0)) // self._n_threads, int(node.get("memory", 0)) // self._memory)
            for node in alive
        )

    def has_room(self) -> bool:
        return len(self._tasks) < max(TASKS_PER_SLOT * self._count_slots(), 1)

    def count_running(self) -> int:
        return len(self._tasks)

    def submit(self, recording: Recording) -> None:
        self._tasks[self._start(recording)] = recording

    def wait_for_outcomes(self, seconds: float) -> list[tuple[Recording, Summary | WorkerDeath]]:
        ready, _ = self._ray.wait(list(self._tasks), num_returns=len(self._tasks), timeout=0)
        if not ready:
            ready, _ = self._ray.wait(list(self._tasks), num_returns=1, timeout=seconds)
        return [(self._tasks.pop(task), self._get_outcome(task)) for task in ready]

    def _get_outcome(self, task: Any) -> Summary | WorkerDeath:
        errors = self._ray.exceptions
        try:
            summary: Summary = self._ray.get(task)
        except errors.OutOfMemoryError:
            return WorkerDeath("Ray killed the worker because of low memory")
        except errors.NodeDiedError:
            return WorkerDeath("the computer was lost", with_node=True)
        except errors.RayError as error:
            return WorkerDeath(f"the worker died ({type(error).__name__})")
        return summary
