"""The contract by which an archive is tracked, whoever calls it: docs/archive.md, "The contract".

`process` is idempotent: what is finished with the same inputs, options and version is not done again. Results appear in the
destination only when they are complete, `done.json` last of all.
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
from sylpose.archive.claims import Held, claimed, here, process_lives
from sylpose.archive.recordings import Recording
from sylpose.archive.stores import Place

__all__ = [
    "DONE",
    "FAILED",
    "How",
    "Record",
    "Status",
    "Summary",
    "finished",
    "give_up",
    "process",
    "read_record",
]

DONE, FAILED = "done.json", "failed.json"
# How often what a disk or a network failed at is tried, and seconds before it is tried again, doubled each time (choice).
IO_TRIES, PAUSE = 3, 2.0
SCRATCH = "sylpose-scratch"

Status = Literal["done", "nothing found", "wrong input", "i/o error", "crashed", "bug", "held"]
# What has results, and what would only fail again with the same inputs.
FINISHED, HOPELESS = ("done", "nothing found"), ("wrong input",)


class Summary(msgspec.Struct, frozen=True, kw_only=True):
    """What is known of a recording after it was worked on.

    Attributes:
        status: "done", "nothing found" (tracked, but no pose in any frame), or why it failed; "held" by another worker.
        frames: tracked.
        coverage: the share of them in which the object was found; of several objects, the least.
        residual_px: median over cameras and frames; of several objects, the largest.
        faults: sentences about cameras at fault.
        seconds: that it took.
        error: one sentence; "" where nothing is wrong.
        notes: what could not be read, and other things to know.
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
    """What `done.json` and `failed.json` hold; `files` are those beside it that belong to it."""

    summary: Summary
    files: tuple[str, ...] = ()
    digest: str
    version: str
    recording: Recording
    host: str
    traceback: str = ""


# Works on a recording: writes results into the folder `results` below the one given, with so many threads.
Work = Callable[[Recording, Path, int], Summary]


@dataclass(frozen=True)
class How:
    """What is the same for all recordings of a run.

    Attributes:
        run: a name that no other run has.
        work: "package.module:function", a `Work`; the tracking itself.
        threads: that one recording may use.
        scratch: where recordings and results lie while they are worked on; None: the system's folder for that.
        retry_failed: try again what failed as wrong input.
    """

    run: str
    work: str = "sylpose.archive.worker:track_recording"
    threads: int = 1
    scratch: str | None = None
    retry_failed: bool = False


def _work_of(how: How) -> Work:
    module, _, name = how.work.partition(":")
    work: Work = getattr(__import__(module, fromlist=[name]), name)
    return work


def process(recording: Recording, destination: Place, how: How) -> Summary:
    """Work on a recording, unless it is done already or another worker is at it; nothing but interrupts is raised.

    Everything is written into a scratch folder first, then into the destination, which has `done.json` last.

    Returns:
        What is found out, or was: errors too are summaries.
    """
    place, start = destination.below(recording.name), time.monotonic()
    try:
        if summary := finished(place, recording, how):
            return summary
        with claimed(place, how.run) as claim:
            # Another one may have finished between the two.
            if summary := finished(place, recording, how):
                return summary
            with _scratch(how.scratch) as folder:
                summary, trace = _worked(recording, Path(folder), how)
                summary = msgspec.structs.replace(summary, seconds=round(time.monotonic() - start, 3))
                if not claim.counts:
                    return Summary(status="held", error="another worker has taken it over")
                _publish(place, Path(folder) / "results", _record(recording, summary, trace))
            return summary
    except Held as held:
        return Summary(status="held", error=str(held))
    except OSError as error:
        return Summary(status="i/o error", error=_sentence(error), seconds=time.monotonic() - start)


def give_up(recording: Recording, destination: Place, how: How, why: str) -> Summary:
    """What becomes of a recording whose worker died, and died again; unless another run is at it by now, or was."""
    place = destination.below(recording.name)
    try:
        with claimed(place, how.run):
            if summary := finished(place, recording, how):
                return summary
            summary = Summary(status="crashed", error=why)
            _publish(place, None, _record(recording, summary, ""))
            return summary
    except Held as held:
        return Summary(status="held", error=str(held))
    except OSError as error:
        return Summary(status="crashed", error=f"{why}; {_sentence(error)}")


def read_record(place: Place) -> Record | None:
    """What the last worker left: of a recording that is finished or failed, else None."""
    for name in (DONE, FAILED):
        content = place.read(name)
        if content is not None:
            try:
                return msgspec.json.decode(content, type=Record)
            except msgspec.MsgspecError:  # of another version
                return None
    return None


def finished(place: Place, recording: Recording, how: How) -> Summary | None:
    """What is known of a recording that need not be worked on again."""
    record = read_record(place)
    if record is None or record.digest != recording.digest:
        return None
    status = record.summary.status
    return record.summary if status in FINISHED or (status in HOPELESS and not how.retry_failed) else None


def _worked(recording: Recording, folder: Path, how: How) -> tuple[Summary, str]:
    """What came out, and the traceback of a bug."""
    work = _work_of(how)
    for attempt in range(IO_TRIES):
        try:
            (folder / "results").mkdir(parents=True, exist_ok=True)
            return work(recording, folder, how.threads), ""
        except MemoryError:
            return Summary(status="crashed", error="more memory was needed than one recording may have"), ""
        except (FileNotFoundError, PermissionError, IsADirectoryError, NotADirectoryError) as error:
            return Summary(status="wrong input", error=_sentence(error)), ""
        except OSError as error:
            if attempt == IO_TRIES - 1:
                return Summary(status="i/o error", error=f"{_sentence(error)} (tried {IO_TRIES} times)"), ""
            shutil.rmtree(folder / "results", ignore_errors=True)
            time.sleep(PAUSE * 2**attempt)
        except Exception as error:
            if isinstance(error, ValueError) and type(error).__name__ != "LinAlgError":
                return Summary(status="wrong input", error=_sentence(error)), ""
            said = f"{type(error).__name__}: {error}".split("\n", 1)[0]
            return Summary(status="bug", error=f"{said} (failed.json has the traceback)"), traceback.format_exc()
    raise AssertionError("unreachable")


def _publish(place: Place, results: Path | None, record: Record) -> None:
    """What an earlier run wrote makes room first, its `done.json` before all else; what says that it is whole comes last.
    Other files that lie there are left alone."""
    earlier = read_record(place)
    for name in (DONE, FAILED, *(earlier.files if earlier else ())):
        place.remove(name)
    done = record.summary.status in FINISHED
    paths = sorted(path for path in results.rglob("*") if path.is_file()) if results is not None and done else []
    names = tuple(path.relative_to(results).as_posix() for path in paths if results is not None)
    for name, path in zip(names, paths, strict=True):
        place.write(name, path)
    record = msgspec.structs.replace(record, files=names)
    place.write(DONE if done else FAILED, msgspec.json.format(msgspec.json.encode(record), indent=1))


def _record(recording: Recording, summary: Summary, trace: str) -> Record:
    return Record(
        summary=summary,
        digest=recording.digest,
        version=__version__,
        recording=recording,
        host=here(),
        traceback=trace,
    )


def _scratch(parent: str | None) -> tempfile.TemporaryDirectory[str]:
    """A folder that is removed afterwards; what workers that were killed have left is removed before."""
    root = Path(parent or tempfile.gettempdir())
    root.mkdir(parents=True, exist_ok=True)
    for left in root.glob(f"{SCRATCH}-{here()}-*"):
        pid = left.name.removeprefix(f"{SCRATCH}-{here()}-").partition("-")[0]
        if pid.isdigit() and not process_lives(int(pid)):
            shutil.rmtree(left, ignore_errors=True)
    return tempfile.TemporaryDirectory(
        prefix=f"{SCRATCH}-{here()}-{os.getpid()}-", dir=root, ignore_cleanup_errors=True
    )


def _sentence(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror.lower()}"
    return " ".join(str(error).split()) or type(error).__name__
