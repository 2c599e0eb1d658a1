"""Processing of one recording, by the contract in docs/archive.md, "The contract".

`process_recording` is idempotent: a recording finished with the same inputs, options and version is not processed
again. Results appear in the destination only when they are complete, `done.json` last of all.

A claim separates two workers: a file `claim-N` that is created only if it does not exist, which every store
supports. The claim with the highest number counts. Its worker rewrites it. A claim is superseded by creating number
N + 1, which again only one worker can: if it was not rewritten for two minutes, if its process has ended on this
computer, or if it is of the same run, whose driver knows that its worker died. A worker that was only suspended detects
that it was superseded.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import socket
import tempfile
import threading
import time
import traceback
import uuid
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from sylpose import __version__
from sylpose.archive.recordings import Recording
from sylpose.io.stores import Store, is_inside

DONE_FILE, FAILED_FILE, CLAIM = "done.json", "failed.json", re.compile(r"claim-[0-9]{6}")
# Seconds between renewals, and until a claim expires (choice: eight missed renewals; a recording waits that long after
# its computer crashed; the clocks of computers must agree better than that).
RENEW_INTERVAL, CLAIM_LIFETIME = 15.0, 120.0
# Number of parallel reads (choice: object stores have high latency).
N_PARALLEL_READS = 16

Status = Literal[
    "done", "nothing found", "wrong input", "i/o error", "crashed", "bug", "held", "waiting", "running", "outdated"
]
FINISHED_STATUSES = ("done", "nothing found")  # those with results
# The first that fits counts; errors of the operating system that do not come from the input may be temporary.
STATUS_BY_ERROR: tuple[tuple[type[Exception] | tuple[type[Exception], ...], Status], ...] = (
    (MemoryError, "crashed"),
    (np.linalg.LinAlgError, "bug"),
    ((FileNotFoundError, PermissionError, IsADirectoryError, NotADirectoryError, ValueError), "wrong input"),
    (OSError, "i/o error"),
    (Exception, "bug"),
)


class Summary(msgspec.Struct, frozen=True, kw_only=True):
    """Summary of the work on a recording.

    Attributes:
        status: "done", "nothing found" (tracked, but no pose in any frame), or the kind of failure; "held" by another
            worker. In overviews also "waiting", "running", and "outdated" (finished with other inputs, options or
            version).
        frames: number of tracked frames.
        coverage: share of frames in which the object was localized; the least of several objects.
        residual_px: median over cameras and frames, pixels; the largest of several objects.
        faults: messages about faulty cameras.
        seconds: processing time.
        error: one sentence; "" without an error.
        notes: unreadable data and other messages.
    """

    status: Status
    frames: int | None = None
    coverage: float | None = None
    residual_px: float | None = None
    faults: tuple[str, ...] = ()
    seconds: float | None = None
    error: str = ""
    notes: tuple[str, ...] = ()


class Record(msgspec.Struct, frozen=True):
    """Content of `done.json` and `failed.json`; `files` are the result files in the same folder."""

    summary: Summary
    files: tuple[str, ...]
    digest: str
    version: str
    recording: Recording
    host: str
    traceback: str


class RecordingHeldError(Exception):
    """Another worker holds the recording."""


@dataclass(frozen=True)
class RunSettings:
    """Settings common to all recordings of a run.

    Attributes:
        destination: where the results go.
        work: processes a recording: writes into the folder `results` below the given folder, using the given number of
            threads.
        run: a unique name of the run.
        threads: number of threads per recording.
        scratch: folder for temporary copies and results; None: the system's temporary folder.
        retry_failed: retry recordings that failed with wrong input.
    """

    destination: Store
    work: Callable[[Recording, Path, int], Summary]
    run: str = field(default_factory=lambda: uuid.uuid4().hex)
    threads: int = 1
    scratch: str | None = None
    retry_failed: bool = False


def process_recording(recording: Recording, settings: RunSettings) -> Summary:
    """Process a recording, unless it is finished or another worker holds it; only interrupts are raised.

    Results are written into a scratch folder first, then into the destination, `done.json` last.

    Args:
        recording: the recording.
        settings: settings of the run.

    Returns:
        The new or existing summary; errors are summaries, too.
    """
    store, start = settings.destination.join(recording.name), time.monotonic()
    try:
        with hold_claim(store, settings.run) as is_current:
            record = read_record(store)
            if record and record.digest == recording.digest and is_final(record.summary, settings):
                return record.summary
            with _make_scratch(store, settings.scratch) as folder:
                summary, trace = _run_work(recording, folder, settings)
                summary = msgspec.structs.replace(summary, seconds=round(time.monotonic() - start, 3))
                if not is_current():
                    return Summary(status="held", error="another worker took it over")
                _publish_results(store, folder / "results", recording, summary, trace)
            return summary
    except RecordingHeldError as held:
        return Summary(status="held", error=str(held))
    except OSError as error:
        return Summary(status="i/o error", error=_describe_error(error), seconds=time.monotonic() - start)


def mark_crashed(recording: Recording, settings: RunSettings, reason: str) -> Summary:
    """Mark a recording as crashed after its workers died, unless another run works on it or has finished it."""
    summary = process_recording(recording, replace(settings, work=lambda *_: Summary(status="crashed", error=reason)))
    if summary.status == "i/o error":
        return Summary(status="crashed", error=f"{reason}; {summary.error}")
    return summary


def read_record(store: Store) -> Record | None:
    """Return the record of a finished or failed recording, else None."""
    for name in (DONE_FILE, FAILED_FILE):
        content = store.read(name)
        if content is not None:
            try:
                return msgspec.json.decode(content, type=Record)
            except msgspec.MsgspecError:  # written by another version
                return None
    return None


def is_final(summary: Summary, settings: RunSettings) -> bool:
    """Return whether a recording need not be processed again."""
    return summary.status in FINISHED_STATUSES or (summary.status == "wrong input" and not settings.retry_failed)


def collect_summaries(destination: Store, recordings: Sequence[Recording] | None = None) -> dict[str, Summary]:
    """Collect the summaries of all recordings by name, sorted; their status may be that of work in progress.

    The destination is listed once; only the records and claims that exist are read.

    Args:
        destination: where the results are.
        recordings: None for all in the destination.
    """
    claims, recorded = dict[str, dict[str, float]](), set[str]()
    for file in destination.files():
        folder, _, name = file.name.rpartition("/")
        if name in (DONE_FILE, FAILED_FILE):
            recorded.add(folder)
        elif CLAIM.fullmatch(name):
            claims.setdefault(folder, {})[name] = file.modified
    found = dict.fromkeys(filter(None, recorded | claims.keys()))
    wanted = found if recordings is None else {recording.name: recording for recording in recordings}

    def collect(name: str) -> Summary:
        store, recording = destination.join(name), wanted[name]
        if owner := _read_live_claim(store, claims.get(name, {}))[1]:
            return Summary(status="running", error=f"by {owner}")
        # The work may have ended since the listing.
        record = read_record(store) if name in recorded | claims.keys() else None
        if record is None:
            return Summary(status="waiting")
        if recording is not None and record.digest != recording.digest:
            return Summary(status="outdated", error="its files, the options or the version of sylpose have changed")
        return record.summary

    with ThreadPoolExecutor(N_PARALLEL_READS) as pool:
        return dict(zip(sorted(wanted), pool.map(collect, sorted(wanted)), strict=True))


@contextmanager
def hold_claim(store: Store, run: str) -> Iterator[Callable[[], bool]]:
    """Hold the claim on a recording within the context.

    Args:
        store: the recording's folder in the destination.
        run: an earlier worker of the same run is superseded immediately, since the run's driver knows that it has died.

    Yields:
        returns whether no other claim has superseded it.

    Raises:
        RecordingHeldError: another live worker holds it; the message names it.
        OSError: the store does not respond.
    """
    claims = _list_claims(store)
    other_run, owner = _read_live_claim(store, claims)
    if owner and other_run != run:
        raise RecordingHeldError(f"held by {owner}")
    # By the same listing: if another worker has created this number meanwhile, it holds the recording.
    name = f"claim-{int(max(claims)[6:]) + 1 if claims else 0:06}"
    content = f"{run}\nprocess {os.getpid()} of {socket.gethostname()}\n{os.getpid()} {_identify_computer()}".encode()
    if not store.create(name, content):
        raise RecordingHeldError("held by another worker")
    ended = threading.Event()

    def is_current() -> bool:
        return max(_list_claims(store), default="") == name

    def renew() -> None:
        while not ended.wait(RENEW_INTERVAL):
            with suppress(OSError):  # retried at the next renewal
                if is_current():
                    store.write(name, content)

    thread = threading.Thread(target=renew, daemon=True, name="sylpose-claim")
    try:
        thread.start()
        yield is_current
    finally:
        ended.set()
        thread.join()
        with suppress(OSError):  # it expires
            for claim in _list_claims(store):
                if claim <= name:
                    store.remove(claim)


def _read_live_claim(store: Store, claims: dict[str, float]) -> tuple[str, str]:
    """Return the run and the process of the latest claim; empty if it has expired or its process has ended."""
    if not claims or time.time() - claims[max(claims)] > CLAIM_LIFETIME:
        return "", ""
    if (content := store.read(max(claims))) is None:  # removed meanwhile
        return "", ""
    run, owner, process = (*content.decode(errors="replace").split("\n"), "", "")[:3]
    return ("", "") if _has_ended(process) else (run, owner or "another worker")


def _identify_computer() -> str:
    """Return where process IDs are those of this process: its computer and container; empty if unknown."""
    with suppress(OSError):  # not Linux
        boot = Path("/proc/sys/kernel/random/boot_id").read_text()
        return f"{boot.strip().replace('-', '')}{os.stat('/proc/self/ns/pid').st_ino}"
    return ""


def _has_ended(process: str) -> bool:
    """Return whether a process, "ID computer", has ended; False if it may still be at work."""
    pid, _, computer = process.partition(" ")
    if computer and computer == _identify_computer():
        try:
            os.kill(int(pid), 0)
        except ProcessLookupError:
            return True
        except (OSError, ValueError, OverflowError):  # of another user, or no process ID
            pass
    return False


def _list_claims(store: Store) -> dict[str, float]:
    """Return when each claim was written, by name."""
    return {file.name: file.modified for file in store.files() if CLAIM.fullmatch(file.name)}


def _run_work(recording: Recording, folder: Path, settings: RunSettings) -> tuple[Summary, str]:
    """Run the work; return the summary, and the traceback of a bug."""
    try:
        return settings.work(recording, folder, settings.threads), ""
    except Exception as error:
        status = next(status for kinds, status in STATUS_BY_ERROR if isinstance(error, kinds))
        if status != "bug":
            return Summary(status=status, error=_describe_error(error)), ""
        message = f"{type(error).__name__}: {error}".split("\n", 1)[0]
        return Summary(status="bug", error=f"{message} (failed.json has the traceback)"), traceback.format_exc()


def _publish_results(store: Store, results: Path, recording: Recording, summary: Summary, trace: str) -> None:
    """Replace the results of an earlier run.

    The earlier `done.json` is removed first, and the new one written last. Other files are left unchanged.
    """
    earlier, done = read_record(store), summary.status in FINISHED_STATUSES
    for name in (DONE_FILE, FAILED_FILE, *filter(is_inside, earlier.files if earlier else ())):
        store.remove(name)
    paths = sorted(path for path in results.rglob("*") if path.is_file() and done)
    names = tuple(path.relative_to(results).as_posix() for path in paths)
    for name, path in zip(names, paths, strict=True):
        store.write(name, path)
    record = Record(summary, names, recording.digest, __version__, recording, socket.gethostname(), trace)
    store.write(DONE_FILE if done else FAILED_FILE, msgspec.json.format(msgspec.json.encode(record), indent=1))


@contextmanager
def _make_scratch(store: Store, parent: str | None) -> Iterator[Path]:
    """Create a temporary folder with `results`, after removing those of killed workers.

    These are of processes that have ended on this computer, and others with the same recording.
    """
    root = Path(parent or tempfile.gettempdir())
    prefix = f"sylpose-scratch-{hashlib.blake2b(store.url.encode(), digest_size=8).hexdigest()}-"
    for leftover in root.glob("sylpose-scratch-*"):
        if leftover.name.startswith(prefix) or _has_ended(" ".join(leftover.name.split("-")[3:5])):
            shutil.rmtree(leftover, ignore_errors=True)
    root.mkdir(parents=True, exist_ok=True)
    prefix += f"{os.getpid()}-{_identify_computer()}-"
    with tempfile.TemporaryDirectory(prefix=prefix, dir=root, ignore_cleanup_errors=True) as folder:
        Path(folder, "results").mkdir()
        yield Path(folder)


def _describe_error(error: Exception) -> str:
    if isinstance(error, MemoryError):
        return "it exceeded the memory limit of one recording"
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror.lower()}"
    return " ".join(str(error).split()) or type(error).__name__
