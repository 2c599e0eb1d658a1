"""Local worker processes, each replaced when it dies."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from types import TracebackType
from typing import Any, Self

from sylpose.archive.contract import RunSettings, Summary, process_recording
from sylpose.archive.recordings import Recording
from sylpose.archive.run import WorkerDeath
from sylpose.archive.stores import Store
from sylpose.runs.system_resources import available_cores, available_memory

__all__ = ["MIN_MEMORY", "ProcessWorkers", "choose_default_jobs", "thread_environment"]

# Least memory of one recording, bytes (choice: several times the figure in docs/benchmarks.md), and largest share of
# the computer's memory for all (choice).
MIN_MEMORY, MAX_MEMORY_RATIO = 2 << 30, 0.9
# Seconds for workers to end after an interrupt (choice).
EXIT_TIMEOUT_S = 10.0


def choose_default_jobs(threads: int) -> int:
    """Return the number of processes that cores and memory allow."""
    total = available_memory()
    by_memory = available_cores() if total is None else int(MAX_MEMORY_RATIO * total) // MIN_MEMORY
    return max(1, min(available_cores() // threads, by_memory))


def thread_environment(threads: int) -> dict[str, str]:
    """Return environment variables that limit the threads of libraries."""
    names = ("OMP", "OPENBLAS", "MKL", "NUMBA", "VECLIB_MAXIMUM")
    return {**{f"{name}_NUM_THREADS": str(threads) for name in names}, "OPENCV_FOR_THREADS_NUM": str(threads)}


class _Worker:
    def __init__(self, destination: Store, settings: RunSettings, memory: int | None) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, other = context.Pipe()
        self.recording: Recording | None = None
        self.process: SpawnProcess = context.Process(
            target=_run_worker, args=(other, destination, settings, memory), daemon=True, name="sylpose-batch"
        )
        with _set_environment(thread_environment(settings.threads)):
            self.process.start()
        other.close()


class ProcessWorkers:
    """Context manager of local worker processes; all end with it, also after an interrupt.

    Args:
        destination: where the results go.
        settings: settings of the run.
        jobs: number of processes.
        memory: memory limit per process on Linux, bytes; None: an equal share of the computer's.
    """

    def __init__(self, destination: Store, settings: RunSettings, jobs: int, memory: int | None = None) -> None:
        total = available_memory()
        self._memory = memory or (None if total is None else int(MAX_MEMORY_RATIO * total) // jobs)
        self._destination, self._settings, self._jobs = destination, settings, jobs
        self._workers: list[_Worker] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        for worker in self._workers:
            with suppress(OSError):
                worker.pipe.send(None)
            if worker.recording is not None:  # interrupted
                worker.process.terminate()
        for worker in self._workers:
            worker.process.join(EXIT_TIMEOUT_S)
            worker.process.kill()
            worker.process.join()
            worker.pipe.close()

    def has_room(self) -> bool:
        return self.count_running() < self._jobs

    def count_running(self) -> int:
        return sum(worker.recording is not None for worker in self._workers)

    def submit(self, recording: Recording) -> None:
        idle = next((w for w in self._workers if w.recording is None and w.process.is_alive()), None)
        if idle is None:
            idle = _Worker(self._destination, self._settings, self._memory)
            self._workers.append(idle)
        idle.recording = recording
        with suppress(OSError):  # dead, which `outcomes` detects
            idle.pipe.send(recording)

    def wait_for_outcomes(self, seconds: float) -> list[tuple[Recording, Summary | WorkerDeath]]:
        busy = {worker.pipe: worker for worker in self._workers if worker.recording is not None}
        found: list[tuple[Recording, Summary | WorkerDeath]] = []
        for pipe in wait(list(busy), seconds):
            worker = busy[pipe]  # type: ignore[index]
            assert worker.recording is not None
            try:
                found.append((worker.recording, worker.pipe.recv()))
            except (EOFError, OSError):
                worker.process.join(EXIT_TIMEOUT_S)
                found.append((worker.recording, WorkerDeath(_describe_exit(worker.process.exitcode))))
                worker.pipe.close()
                self._workers.remove(worker)
            worker.recording = None
        return found


def _run_worker(pipe: Connection, destination: Store, settings: RunSettings, memory: int | None) -> None:
    """Run a worker process: receive recordings, send summaries."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # from the terminal, meant for the parent process
    signal.signal(signal.SIGTERM, _interrupt)
    if memory is not None and sys.platform == "linux":
        import resource

        hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
        resource.setrlimit(resource.RLIMIT_DATA, (memory if hard < 0 else min(memory, hard), hard))
    with suppress(KeyboardInterrupt, EOFError, BrokenPipeError):
        while (recording := pipe.recv()) is not None:
            pipe.send(process_recording(recording, destination, settings))


def _interrupt(*_: Any) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # SLURM signals every process, and then the parent does
    raise KeyboardInterrupt


def _describe_exit(code: int | None) -> str:
    if code is not None and code < 0:
        name = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"
        more = ": out of memory?" if name == "SIGKILL" else ""
        return f"the worker was killed by {name}{more}"
    return f"the worker ended with exit code {code}"


@contextmanager
def _set_environment(values: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables for processes started within the context."""
    previous = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in previous.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
