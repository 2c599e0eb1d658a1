"""Distribution of recordings to local processes or a Ray cluster; a worker that dies loses only its recording."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import suppress
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import Any, Protocol, Self

from sylpose.archive.contract import RunSettings, Summary, mark_crashed, process_recording
from sylpose.archive.recordings import Recording
from sylpose.runs.system_resources import MIN_MEMORY, memory_share, thread_limits

# Attempts if workers die or disks and networks fail (choice: a node of a cluster may go away).
MAX_ATTEMPTS = 3
# Seconds until recordings that other workers hold, or whose worker, disk or network failed, are tried again; between
# checks of the own workers; for workers to release their claims and end (choice).
RETRY_INTERVAL, WORKER_CHECK_INTERVAL, EXIT_TIMEOUT_S = 5.0, 0.5, 10.0
# Tasks in flight per available slot, so that the next ones are queued (choice).
TASKS_PER_SLOT = 2
DEATHS = {
    "OutOfMemoryError": "Ray killed the worker because of low memory",
    "NodeDiedError": "the computer was lost",
}


class Workers(Protocol):
    """Driver interface: runs `process_recording` elsewhere."""

    def capacity(self) -> int:
        """Return how many recordings may be submitted at a time."""

    def submit(self, recording: Recording) -> Future[Summary]:
        """Process a recording; the future has an exception if the worker dies."""


class WorkerDeathError(Exception):
    """The worker process ended before its recording; the message has the reason."""


def process_all(
    recordings: Sequence[Recording],
    settings: RunSettings,
    workers: Workers,
    on_outcome: Callable[[Recording, Summary], None],
    on_progress: Callable[[int, int], None] = lambda *_: None,
) -> None:
    """Distribute all recordings to workers; one whose worker or disk fails is retried, then abandoned.

    Recordings held by other runs are tried again until these finish them or their claim expires.

    Args:
        recordings: to be processed.
        settings: settings of the run.
        workers: the driver.
        on_outcome: called once with each recording.
        on_progress: called regularly with the numbers of running recordings and of those to be tried again later.
    """
    waiting, later, failures = deque(recordings), deque[tuple[float, Recording]](), Counter[str]()
    running: dict[Future[Summary], Recording] = {}
    while waiting or later or running:
        while later and later[0][0] <= time.monotonic():
            waiting.append(later.popleft()[1])
        while waiting and len(running) < workers.capacity():
            recording = waiting.popleft()
            running[workers.submit(recording)] = recording
        on_progress(len(running), len(later))
        if not running:
            time.sleep(WORKER_CHECK_INTERVAL)
        for future in wait(running, WORKER_CHECK_INTERVAL, FIRST_COMPLETED).done:
            recording, death = running.pop(future), future.exception()
            summary = future.result() if death is None else Summary(status="crashed")
            failures[recording.name] += (failed := death is not None or summary.status == "i/o error")
            retry = failed and failures[recording.name] < MAX_ATTEMPTS
            if death is not None and not retry:
                reason = f"{describe_death(death)}, {failures[recording.name]} times"
                summary = mark_crashed(recording, settings, reason)
            if retry or summary.status == "held":
                later.append((time.monotonic() + RETRY_INTERVAL, recording))
            else:
                on_outcome(recording, summary)


def describe_death(error: BaseException) -> str:
    """Return why a worker died, from the exception of its future."""
    name = type(error).__name__
    return str(error) if isinstance(error, WorkerDeathError) else DEATHS.get(name, f"the worker died ({name})")


class ProcessWorkers:
    """Context manager of local worker processes, each replaced when it dies; all end with it.

    Args:
        settings: settings of the run.
        jobs: number of processes.
        memory: memory limit per process on Linux, bytes; None: an equal share of the computer's.
    """

    def __init__(self, settings: RunSettings, jobs: int, memory: int | None = None) -> None:
        self._memory = memory or memory_share(jobs)
        self._settings, self._jobs, self._threads = settings, jobs, ThreadPoolExecutor(jobs)
        self._processes: list[SpawnProcess] = []
        self._idle: list[tuple[SpawnProcess, Connection]] = []

    def __enter__(self) -> Self:
        self._environment = dict(os.environ)  # which processes inherit
        os.environ.update(thread_limits(self._settings.threads))
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._processes:
            process.terminate()
        for process in self._processes:
            process.join(EXIT_TIMEOUT_S)
            process.kill()
        self._threads.shutdown()
        os.environ.clear()
        os.environ.update(self._environment)

    def capacity(self) -> int:
        return self._jobs

    def submit(self, recording: Recording) -> Future[Summary]:
        while self._idle:
            process, pipe = self._idle.pop()
            if process.is_alive():
                break
        else:
            context = multiprocessing.get_context("spawn")
            pipe, other = context.Pipe()
            process = context.Process(target=_run_worker, args=(other, self._settings, self._memory), daemon=True)
            process.start()
            other.close()
            self._processes.append(process)
        return self._threads.submit(self._wait_for_summary, recording, process, pipe)

    def _wait_for_summary(self, recording: Recording, process: SpawnProcess, pipe: Connection) -> Summary:
        try:
            pipe.send(recording)
            summary: Summary = pipe.recv()
        except (EOFError, OSError):
            raise WorkerDeathError(_describe_exit(process)) from None
        self._idle.append((process, pipe))
        return summary


def _describe_exit(process: SpawnProcess) -> str:
    process.join(EXIT_TIMEOUT_S)
    code = process.exitcode
    if code is None or code >= 0:
        return f"the worker ended with exit code {code}"
    name = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"
    return f"the worker was killed by {name}{': out of memory?' if name == 'SIGKILL' else ''}"


def _run_worker(pipe: Connection, settings: RunSettings, memory: int | None) -> None:
    """Run a worker process: receive recordings, send summaries."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # from the terminal, meant for the parent process
    signal.signal(signal.SIGTERM, _interrupt)
    if memory is not None and sys.platform == "linux":
        import resource

        hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
        resource.setrlimit(resource.RLIMIT_DATA, (memory if hard < 0 else min(memory, hard), hard))
    with suppress(KeyboardInterrupt, EOFError, BrokenPipeError):
        while True:
            pipe.send(process_recording(pipe.recv(), settings))


def _interrupt(*_: Any) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # SLURM signals every process, and then the parent does
    raise KeyboardInterrupt


class RayWorkers:
    """Context manager of Ray tasks; its end cancels running tasks.

    Args:
        settings: settings of the run.
        address: address of the cluster: "auto", "host:6379" or "ray://host:10001".
        memory: bytes that Ray reserves for each recording.

    Raises:
        ValueError: Ray is not installed, no cluster at the address, or no computer in it is large enough.
    """

    def __init__(self, settings: RunSettings, address: str, memory: int | None = None) -> None:
        try:
            import ray
        except ImportError:
            raise ValueError("--ray needs Ray: python3 -m pip install 'sylpose[cluster]'") from None
        if settings.destination.url.startswith("memory://"):
            raise ValueError(f"--out {settings.destination.url}: other processes cannot see it")
        self._ray: Any = ray
        self._memory, self._settings = memory or MIN_MEMORY, settings
        try:
            ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
        except (ConnectionError, ValueError, RuntimeError, TimeoutError) as error:
            raise ValueError(f"--ray {address}: {str(error).strip().splitlines()[0]}") from None
        if not self._count_slots():
            ray.shutdown()
            needed = f"{settings.threads} cores and {self._memory / 2**30:.1f} GB of memory"
            raise ValueError(f"--ray {address}: no computer in the cluster has {needed}")
        # One retry policy for all drivers: that of `run.py`, not Ray's.
        environment = {"env_vars": thread_limits(settings.threads)}
        options = {"num_cpus": settings.threads, "memory": self._memory, "max_retries": 0, "runtime_env": environment}
        self._task, self._futures = ray.remote(**options)(process_recording), set[Any]()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        tasks = [future.object_ref for future in self._futures if not future.done()]
        for task in tasks:
            self._ray.cancel(task, force=False)
        if tasks:
            self._ray.wait(tasks, num_returns=len(tasks), timeout=EXIT_TIMEOUT_S)
        self._ray.shutdown()

    def _count_slots(self) -> int:
        """Return how many recordings the cluster can currently process in parallel."""
        alive = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
        cores, memory = self._settings.threads, self._memory
        return sum(min(int(node.get("CPU", 0)) // cores, int(node.get("memory", 0)) // memory) for node in alive)

    def capacity(self) -> int:
        return max(TASKS_PER_SLOT * self._count_slots(), 1)

    def submit(self, recording: Recording) -> Future[Summary]:
        future: Future[Summary] = self._task.remote(recording, self._settings).future()
        self._futures = {other for other in self._futures if not other.done()} | {future}
        return future
