"""Workers on this computer: processes of their own, each replaced when it dies."""

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

from sylpose.app.system_resources import cores, memory_of_machine
from sylpose.archive.contract import How, Summary, process
from sylpose.archive.recordings import Recording
from sylpose.archive.run import Died
from sylpose.archive.stores import Place

__all__ = ["MEMORY", "Processes", "default_jobs", "thread_limits"]

# Bytes that one recording needs at least (choice: several times what docs/benchmarks.md measures), and the share of the
# computer's memory that all may have together (choice).
MEMORY, SHARE = 2 << 30, 0.9
# Seconds that workers have to end in order after an interrupt (choice).
PATIENCE = 10.0


def default_jobs(threads: int) -> int:
    """As many as there are cores and memory for."""
    total = memory_of_machine()
    by_memory = cores() if total is None else int(SHARE * total) // MEMORY
    return max(1, min(cores() // threads, by_memory))


def thread_limits(threads: int) -> dict[str, str]:
    """Environment in which libraries use no more threads."""
    names = ("OMP", "OPENBLAS", "MKL", "NUMBA", "VECLIB_MAXIMUM")
    return {**{f"{name}_NUM_THREADS": str(threads) for name in names}, "OPENCV_FOR_THREADS_NUM": str(threads)}


class _Worker:
    def __init__(self, destination: Place, how: How, memory: int | None) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, other = context.Pipe()
        self.recording: Recording | None = None
        self.process: SpawnProcess = context.Process(
            target=_serve, args=(other, destination, how, memory), daemon=True, name="sylpose-batch"
        )
        with _environment(thread_limits(how.threads)):
            self.process.start()
        other.close()


class Processes:
    """A context manager; its end, by an interrupt too, ends all processes.

    Args:
        jobs: how many at once.
        memory: bytes that each may have, on Linux; None: what there is, divided by them.
    """

    def __init__(self, destination: Place, how: How, jobs: int, memory: int | None = None) -> None:
        total = memory_of_machine()
        self._memory = memory or (None if total is None else int(SHARE * total) // jobs)
        self._destination, self._how, self._jobs = destination, how, jobs
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
            worker.process.join(PATIENCE)
            worker.process.kill()
            worker.process.join()
            worker.pipe.close()

    def has_room(self) -> bool:
        return self.running() < self._jobs

    def running(self) -> int:
        return sum(worker.recording is not None for worker in self._workers)

    def submit(self, recording: Recording) -> None:
        idle = next((w for w in self._workers if w.recording is None and w.process.is_alive()), None)
        if idle is None:
            idle = _Worker(self._destination, self._how, self._memory)
            self._workers.append(idle)
        idle.recording = recording
        with suppress(OSError):  # dead, which is noticed like any other death
            idle.pipe.send(recording)

    def outcomes(self, seconds: float) -> list[tuple[Recording, Summary | Died]]:
        busy = {worker.pipe: worker for worker in self._workers if worker.recording is not None}
        found: list[tuple[Recording, Summary | Died]] = []
        for pipe in wait(list(busy), seconds):
            worker = busy[pipe]  # type: ignore[index]
            assert worker.recording is not None
            try:
                found.append((worker.recording, worker.pipe.recv()))
            except (EOFError, OSError):
                worker.process.join(PATIENCE)
                found.append((worker.recording, Died(_how_it_died(worker.process.exitcode))))
                worker.pipe.close()
                self._workers.remove(worker)
            worker.recording = None
        return found


def _serve(pipe: Connection, destination: Place, how: How, memory: int | None) -> None:
    """A worker's life: recordings come, summaries go."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of the terminal, meant for the one that started us
    signal.signal(signal.SIGTERM, _interrupt)
    if memory is not None and sys.platform == "linux":
        import resource

        hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
        resource.setrlimit(resource.RLIMIT_DATA, (memory if hard < 0 else min(memory, hard), hard))
    with suppress(KeyboardInterrupt, EOFError, BrokenPipeError):
        while (recording := pipe.recv()) is not None:
            pipe.send(process(recording, destination, how))


def _interrupt(*_: Any) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # SLURM tells every process, and then our own parent does
    raise KeyboardInterrupt


def _how_it_died(code: int | None) -> str:
    if code is not None and code < 0:
        name = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"
        more = ": out of memory?" if name == "SIGKILL" else ""
        return f"the worker was ended by {name}{more}"
    return f"the worker ended with exit code {code}"


@contextmanager
def _environment(values: Mapping[str, str]) -> Iterator[None]:
    """What a process that is started within it inherits."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
