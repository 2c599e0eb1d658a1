"""Workers on a Ray cluster: one task for each recording. Ray tells who died; what is done then is `run.py`'s."""

from __future__ import annotations

import logging
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self

from sylpose.archive.contract import How, Summary, process
from sylpose.archive.processes import MEMORY, thread_limits
from sylpose.archive.recordings import Recording
from sylpose.archive.run import Died
from sylpose.archive.stores import Place, is_url

__all__ = ["RayWorkers"]

# Tasks in flight for each that can run: the next ones lie ready (choice).
AHEAD = 2
# Seconds that tasks have to give their claims back after an interrupt (choice).
PATIENCE = 10.0


class RayWorkers:
    """A context manager; its end cancels what is running.

    Args:
        address: of the cluster: "auto", "host:6379" or "ray://host:10001". If Ray is connected already it stays so.
        memory: bytes that Ray sets aside for each recording.

    Raises:
        ValueError: Ray is not installed; no cluster at the address; a cluster without a computer that is large enough.
    """

    def __init__(self, destination: Place, how: How, address: str, memory: int | None = None) -> None:
        try:
            import ray
        except ImportError:
            raise ValueError("--ray needs Ray: python3 -m pip install 'sylpose[cluster]'") from None
        if is_url(destination.url) and destination.url.startswith("memory://"):
            raise ValueError(f"--out {destination.url}: other processes cannot see it")
        self._ray: Any = ray
        self._connected = not ray.is_initialized()
        self._memory, self._threads = memory or MEMORY, how.threads
        if self._connected:
            try:
                ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
            except (ConnectionError, ValueError, RuntimeError, TimeoutError) as error:
                raise ValueError(f"--ray {address}: {str(error).strip().splitlines()[0]}") from None
        if not self._slots():
            self._leave()
            gigabytes = self._memory / 2**30
            raise ValueError(
                f"--ray {address}: no computer there has {how.threads} cores and {gigabytes:.1f} GB of memory"
            )
        # One policy for all drivers: `run.py` tries again, not Ray.
        task = ray.remote(
            num_cpus=how.threads,
            memory=self._memory,
            max_retries=0,
            runtime_env={"env_vars": thread_limits(how.threads)},
        )(process)
        self._start: Callable[[Recording], Any] = lambda recording: task.remote(recording, destination, how)
        self._tasks: dict[Any, Recording] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        for task in self._tasks:
            self._ray.cancel(task, force=False)
        if self._tasks:
            self._ray.wait(list(self._tasks), num_returns=len(self._tasks), timeout=PATIENCE)
        self._leave()

    def _leave(self) -> None:
        if self._connected:
            self._ray.shutdown()

    def _slots(self) -> int:
        """How many recordings the cluster, as it is now, can work on at once."""
        alive = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
        return sum(
            min(int(node.get("CPU", 0)) // self._threads, int(node.get("memory", 0)) // self._memory) for node in alive
        )

    def has_room(self) -> bool:
        return len(self._tasks) < max(AHEAD * self._slots(), 1)

    def running(self) -> int:
        return len(self._tasks)

    def submit(self, recording: Recording) -> None:
        self._tasks[self._start(recording)] = recording

    def outcomes(self, seconds: float) -> list[tuple[Recording, Summary | Died]]:
        ready, _ = self._ray.wait(list(self._tasks), num_returns=len(self._tasks), timeout=0)
        if not ready:
            ready, _ = self._ray.wait(list(self._tasks), num_returns=1, timeout=seconds)
        return [(self._tasks.pop(task), self._outcome(task)) for task in ready]

    def _outcome(self, task: Any) -> Summary | Died:
        errors = self._ray.exceptions
        try:
            summary: Summary = self._ray.get(task)
        except errors.OutOfMemoryError:
            return Died("Ray ended the worker for want of memory")
        except errors.NodeDiedError:
            return Died("the computer went away", with_node=True)
        except errors.RayError as error:
            return Died(f"the worker died ({type(error).__name__})")
        return summary
