"""Processing of one recording, by the contract in docs/archive.md, "The contract".

`process_recording` is idempotent: a recording finished with the same inputs, options and version is not processed
again. Results appear in the destination only when they are complete, `done.json` last of all.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec

from sylpose import __version__
from sylpose.archive.claims import RecordingHeldError, hold_claim, host_id, is_process_alive
from sylpose.archive.recordings import Recording
from sylpose.archive.stores import Store

__all__ = [
    "DONE_FILE",
    "FAILED_FILE",
    "Record",
    "RunSettings",
    "Status",
    "Summary",
    "find_finished",
    "mark_crashed",
    "process_recording",
    "read_record",
]

DONE_FILE, FAILED_FILE = "done.json", "failed.json"
# Attempts after disk or network failures, and seconds before the first retry, doubled each time (choice).
MAX_IO_ATTEMPTS, FIRST_RETRY_S = 3, 2.0
SCRATCH_PREFIX = "sylpose-scratch"

Status = Literal["done", "nothing found", "wrong input", "i/o error", "crashed", "bug", "held"]
# Statuses with results, and statuses that would recur with the same inputs.
FINISHED_STATUSES, FINAL_FAILURES = ("done", "nothing found"), ("wrong input",)


class Summary(msgspec.Struct, frozen=True, kw_only=True):
    """Summary of the work on a recording.

    Attributes:
        status: "done", "nothing found" (tracked, but no pose in any frame), or the kind of failure; "held" by another
            worker.
        frames: number of tracked frames.
        coverage: share of frames in which the object was localized; the least of several objects.
        residual_px: median over cameras and frames, pixels; the largest of several objects.
        faults: messages about faulty cameras.
        seconds: processing time.
        error: one sentence; "" without an error.
        notes: unreadable data and other messages.
    """

    status: Status
    frames: int = 0
    coverage: float | None = None
    residual_px: float | None = None
    faults: tuple[str, ...] = ()
    seconds: float = 0.0
    error: str = ""
    notes: tuple[str, ...] = ()

    @property
    def is_done(self) -> bool:
        return self.status == "done"


class Record(msgspec.Struct, frozen=True, kw_only=True):
    """Content of `done.json` and `failed.json`; `files` are the result files in the same folder."""

    summary: Summary
    files: tuple[str, ...] = ()
    digest: str
    version: str
    recording: Recording
    host: str
    traceback: str = ""


# Processes a recording: writes into the folder `results` below the given folder, using the given number of threads.
Work = Callable[[Recording, Path, int], Summary]


@dataclass(frozen=True)
class RunSettings:
    """Settings common to all recordings of a run.

    Attributes:
        run: a unique name of the run.
        work: "package.module:function", a `Work`; by default the tracking.
        threads: number of threads per recording.
        scratch: folder for temporary copies and results; None: the system's temporary folder.
        retry_failed: retry recordings that failed with wrong input.
    """

    run: str
    work: str = "sylpose.archive.worker:track_recording"
    threads: int = 1
    scratch: str | None = None
    retry_failed: bool = False


def _load_work(settings: RunSettings) -> Work:
    module, _, name = settings.work.partition(":")
    work: Work = getattr(__import__(module, fromlist=[name]), name)
    return work


def process_recording(recording: Recording, destination: Store, settings: RunSettings) -> Summary:
    """Process a recording, unless it is finished or another worker holds it; only interrupts are raised.

    Results are written into a scratch folder first, then into the destination, `done.json` last.

    Args:
        recording: the recording.
        destination: where the results go.
        settings: settings of the run.

    Returns:
        The new or existing summary; errors are summaries, too.
    """
    store, start = destination.join(recording.name), time.monotonic()
    try:
        if summary := find_finished(store, recording, settings):
            return summary
        with hold_claim(store, settings.run) as claim:
            # Another worker may have finished meanwhile.
            if summary := find_finished(store, recording, settings):
                return summary
            with _make_scratch(settings.scratch) as folder:
                summary, trace = _run_work(recording, Path(folder), settings)
                summary = msgspec.structs.replace(summary, seconds=round(time.monotonic() - start, 3))
                if not claim.is_current:
                    return Summary(status="held", error="another worker took it over")
                _publish_results(store, Path(folder) / "results", _make_record(recording, summary, trace))
            return summary
    except RecordingHeldError as held:
        return Summary(status="held", error=str(held))
    except OSError as error:
        return Summary(status="i/o error", error=_describe_error(error), seconds=time.monotonic() - start)


def mark_crashed(recording: Recording, destination: Store, settings: RunSettings, reason: str) -> Summary:
    """Mark a recording as crashed after its workers died, unless another run works on it or has finished it."""
    store = destination.join(recording.name)
    try:
        with hold_claim(store, settings.run):
            if summary := find_finished(store, recording, settings):
                return summary
            summary = Summary(status="crashed", error=reason)
            _publish_results(store, None, _make_record(recording, summary, ""))
            return summary
    except RecordingHeldError as held:
        return Summary(status="held", error=str(held))
    except OSError as error:
        return Summary(status="crashed", error=f"{reason}; {_describe_error(error)}")


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


def find_finished(store: Store, recording: Recording, settings: RunSettings) -> Summary | None:
    """Return the summary of a recording that need not be processed again, else None."""
    record = read_record(store)
    if record is None or record.digest != recording.digest:
        return None
    status = record.summary.status
    return (
        record.summary
        if status in FINISHED_STATUSES or (status in FINAL_FAILURES and not settings.retry_failed)
        else None
    )


def _run_work(recording: Recording, folder: Path, settings: RunSettings) -> tuple[Summary, str]:
    """Run the work with retries; return the summary, and the traceback of a bug."""
    work = _load_work(settings)
    for attempt in range(MAX_IO_ATTEMPTS):
        try:
            (folder / "results").mkdir(parents=True, exist_ok=True)
            return work(recording, folder, settings.threads), ""
        except MemoryError:
            return Summary(status="crashed", error="it exceeded the memory limit of one recording"), ""
        except (FileNotFoundError, PermissionError, IsADirectoryError, NotADirectoryError) as error:
            return Summary(status="wrong input", error=_describe_error(error)), ""
        except OSError as error:
            if attempt == MAX_IO_ATTEMPTS - 1:
                return Summary(
                    status="i/o error", error=f"{_describe_error(error)} (tried {MAX_IO_ATTEMPTS} times)"
                ), ""
            shutil.rmtree(folder / "results", ignore_errors=True)
            time.sleep(FIRST_RETRY_S * 2**attempt)
        except Exception as error:
            if isinstance(error, ValueError) and type(error).__name__ != "LinAlgError":
                return Summary(status="wrong input", error=_describe_error(error)), ""
            message = f"{type(error).__name__}: {error}".split("\n", 1)[0]
            return Summary(status="bug", error=f"{message} (failed.json has the traceback)"), traceback.format_exc()
    raise AssertionError("unreachable")


def _publish_results(store: Store, results: Path | None, record: Record) -> None:
    """Replace the results of an earlier run.

    The earlier `done.json` is removed first, and the new one written last. Other files are left unchanged.
    """
    earlier = read_record(store)
    for name in (DONE_FILE, FAILED_FILE, *(earlier.files if earlier else ())):
        store.remove(name)
    done = record.summary.status in FINISHED_STATUSES
    paths = sorted(path for path in results.rglob("*") if path.is_file()) if results is not None and done else []
    names = tuple(path.relative_to(results).as_posix() for path in paths if results is not None)
    for name, path in zip(names, paths, strict=True):
        store.write(name, path)
    record = msgspec.structs.replace(record, files=names)
    store.write(DONE_FILE if done else FAILED_FILE, msgspec.json.format(msgspec.json.encode(record), indent=1))


def _make_record(recording: Recording, summary: Summary, trace: str) -> Record:
    return Record(
        summary=summary,
        digest=recording.digest,
        version=__version__,
        recording=recording,
        host=host_id(),
        traceback=trace,
    )


def _make_scratch(parent: str | None) -> tempfile.TemporaryDirectory[str]:
    """Create a temporary folder, after removing those left by killed workers."""
    root = Path(parent or tempfile.gettempdir())
    root.mkdir(parents=True, exist_ok=True)
    for leftover in root.glob(f"{SCRATCH_PREFIX}-{host_id()}-*"):
        pid = leftover.name.removeprefix(f"{SCRATCH_PREFIX}-{host_id()}-").partition("-")[0]
        if pid.isdigit() and not is_process_alive(int(pid)):
            shutil.rmtree(leftover, ignore_errors=True)
    return tempfile.TemporaryDirectory(
        prefix=f"{SCRATCH_PREFIX}-{host_id()}-{os.getpid()}-", dir=root, ignore_cleanup_errors=True
    )


def _describe_error(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror.lower()}"
    return " ".join(str(error).split()) or type(error).__name__
