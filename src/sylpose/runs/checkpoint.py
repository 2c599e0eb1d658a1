"""Checkpoints: saved state of an unfinished run, from which `--resume` continues with bit-identical results.

File layout of a checkpoint: a format line; a line of JSON with the run's options and its recording's fingerprint; the
state as data (`serialization`, `runs.checkpoint_schema`); a checksum of all this. The results of each frame are in a
file of their own that only grows.
"""

from __future__ import annotations

import hashlib
import re
import struct
import time
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Generic, TypeVar

import msgspec
import numpy as np

from sylpose import __version__
from sylpose.atomic_io import GrowingFile, replace_atomically
from sylpose.io.capture import Session
from sylpose.rig import Rig
from sylpose.runs.checkpoint_schema import SERIALIZER, RunState
from sylpose.runs.run_result import StageTimer

CHECKPOINT = "checkpoint.bin"
FORMAT = b"sylpose checkpoint 3\n"
DIGEST_SIZE = hashlib.blake2b().digest_size
RESTART_HINT = "; omit --resume to start over"
# Size limits in bytes of a file, including all images of the frames that wait for a first motion, and of its line of
# options (choice).
MAX_FILE_SIZE, MAX_HEADER_SIZE = 1 << 31, 1 << 20
# Largest share of the running time spent on checkpoints (choice: an acceptable slowdown).
MAX_TIME_SHARE = 0.05
# Header of each record of a `FrameFile`: size and checksum of its content.
_FRAME = struct.Struct("<QI")

T = TypeVar("T")
# Text that is safe to print in a message.
_PrintableText = Annotated[str, msgspec.Meta(pattern=r"^[^\x00-\x1f\x7f]*$", max_length=10_000)]


class _Header(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    version: Annotated[str, msgspec.Meta(pattern=r"^[\w.+-]{1,40}$")]
    options: dict[_PrintableText, _PrintableText]
    session: dict[_PrintableText, _PrintableText]


def save_checkpoint(path: Path, options: Mapping[str, str], session: Mapping[str, str], state: RunState) -> None:
    """Write a checkpoint atomically; on failure an existing one stays intact.

    Args:
        path: file to write.
        options: the run's options by name; they must be the same to resume.
        session: the recording's checksums by subject (see `compute_fingerprint`); they must be the same to resume.
        state: the run's state.

    Raises:
        OSError: the file cannot be written; the message names it.
    """
    header = msgspec.json.encode(_Header(__version__, dict(options), dict(session))) + b"\n"
    with replace_atomically(path) as part, part.open("wb") as file:
        digest = hashlib.blake2b()
        for piece in (FORMAT, header, *SERIALIZER.dump(state)):
            digest.update(piece)
            file.write(piece)
        file.write(digest.digest())


def load_checkpoint(path: Path, options: Mapping[str, str], session: Mapping[str, str]) -> RunState:
    """Return the saved state of a run. The file is read as data; none of its content is executed.

    Args:
        path: file to read.
        options: options of the present run by name.
        session: checksums of the present recording (see `compute_fingerprint`).

    Raises:
        FileNotFoundError: there is no checkpoint.
        ValueError: the file is damaged, or of another version, other options or another session; the message names it.
    """
    damaged = f"{path}: damaged, or not a sylpose checkpoint{RESTART_HINT}"
    with path.open("rb") as file:
        data = memoryview(file.read(MAX_FILE_SIZE + 1))
    first = bytes(data[: len(FORMAT)])
    if first != FORMAT and re.fullmatch(rb"sylpose checkpoint \d+\n?", first):
        raise ValueError(f"{path}: written by another version of sylpose; this is {__version__}{RESTART_HINT}")
    digest = hashlib.blake2b(data[:-DIGEST_SIZE]).digest()
    if first != FORMAT or len(data) > MAX_FILE_SIZE or digest != data[-DIGEST_SIZE:]:
        raise ValueError(damaged)
    line = bytes(data[len(FORMAT) : len(FORMAT) + MAX_HEADER_SIZE]).partition(b"\n")[0]
    try:
        header = msgspec.json.decode(line, type=_Header)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        raise ValueError(damaged) from None
    if header.version != __version__:
        raise ValueError(f"{path}: written by sylpose {header.version}, this is {__version__}{RESTART_HINT}")
    for name in sorted(header.options.keys() | options.keys()):
        before, now = header.options.get(name, "none"), options.get(name, "none")
        if before != now:
            wrong = f"the interrupted run had {name} {before}, not {now}: use the same options to resume"
            raise ValueError(f"{path}: {wrong}{RESTART_HINT}")
    for name in sorted(header.session.keys() | session.keys()):
        if header.session.get(name) != session.get(name):
            raise ValueError(f"{path}: {name} changed since the interrupted run{RESTART_HINT}")
    try:
        state: RunState = SERIALIZER.load(data[len(FORMAT) + len(line) + 1 : -DIGEST_SIZE], RunState)
    except ValueError:
        # Intact and of this version number: written by modified code of the same version, or forged.
        raise ValueError(f"{path}: written by a modified sylpose {__version__}{RESTART_HINT}") from None
    return state


@dataclass(eq=False)
class CheckpointWriter:
    """Writer of periodic checkpoints.

    A run does not start without its first checkpoint. A failure to write a later one is only reported.

    Attributes:
        folder: folder of the run's results.
        options: the run's options by name.
        recording: the recording that is tracked.
        seconds: time between two checkpoints.
        on_message: callback for messages.
        clock: timer that accounts for the time of "saving".
    """

    folder: Path
    options: Mapping[str, object]
    recording: Session
    seconds: float
    on_message: Callable[[str], None]
    clock: StageTimer
    _next: float = field(default=0.0, init=False)
    _failed: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        texts = {name: "none" if value is None else str(value) for name, value in self.options.items()}
        self._of_run = self.folder / CHECKPOINT, texts, compute_fingerprint(self.recording)

    @property
    def is_due(self) -> bool:
        return time.monotonic() >= self._next

    def begin(self, state: RunState) -> None:
        """Write the first checkpoint; raise OSError, which names the file, if that fails."""
        with self.clock.measure("saving"):
            save_checkpoint(*self._of_run, state)
        self._next = time.monotonic() + self.seconds

    def save(self, state: Callable[[], RunState]) -> None:
        begin = time.monotonic()
        with self.clock.measure("saving"):
            try:
                save_checkpoint(*self._of_run, state())
            except OSError as error:
                if not self._failed:
                    self.on_message(f"{error}; --resume can only continue from an earlier checkpoint.")
                self._failed = True
        end = time.monotonic()
        self._next = end + max(self.seconds, (end - begin) / MAX_TIME_SHARE if self.seconds else 0.0)

    def load(self) -> RunState:
        """Return the state to resume from.

        Raises:
            FileNotFoundError: there is no interrupted run.
            ValueError: the checkpoint is damaged or belongs to another run; the message names the file.
        """
        path = self._of_run[0]
        if not path.exists():
            raise FileNotFoundError(f"{self.folder}: no interrupted run to resume (there is no {CHECKPOINT})")
        state = load_checkpoint(*self._of_run)
        objects, cameras = set(self.recording.objects), len(self.recording.rig)
        parts = [[part.index for part in memory.camera_trackers] for memory in state.trackers.values()]
        if {*state.trackers} != objects or {*state.outputs} != objects or parts != [[*range(cameras)]] * len(parts):
            raise ValueError(f"{path}: objects or cameras changed since the interrupted run{RESTART_HINT}")
        return state


class FrameFile(Generic[T]):
    """File that grows by one record per frame; a record that was not written completely is not part of it.

    Args:
        path: the file; or a folder for an unnamed temporary file, which disappears when the process ends.
        kind: type of the records, one of `runs.checkpoint_schema`.
        length: number of bytes of an existing file to keep; the rest is overwritten. 0: a new file.

    Raises:
        OSError: the file cannot be written; the message names it.
        ValueError: the file is shorter than `length`; the message names it.
    """

    def __init__(self, path: Path, kind: type[T], length: int = 0) -> None:
        self._file, self._kind = GrowingFile(path, length or None, temporary=path.is_dir()), kind

    def write(self, record: T) -> None:
        """Append the record of a frame."""
        content = b"".join(SERIALIZER.dump(record))
        self._file.write(_FRAME.pack(len(content), zlib.crc32(content)) + content)

    def length(self) -> int:
        """Return the length in bytes, after flushing everything to the disk."""
        return self._file.flush()

    def read(self) -> Iterator[T]:
        """Yield all records in order.

        Raises:
            ValueError: the file is damaged; the message names it.
        """
        offset = 0
        while offset < self._file.length:
            try:
                size, checksum = _FRAME.unpack(self._file.read(offset, _FRAME.size))
                start, offset = offset + _FRAME.size, offset + _FRAME.size + size
                content = self._file.read(start, size) if offset <= self._file.length else b""
                if len(content) != size or zlib.crc32(content) != checksum:
                    raise ValueError("not the content that was written")
                record: T = SERIALIZER.load(memoryview(content), self._kind)
            except (ValueError, struct.error):
                raise ValueError(f"{self._file.path}: is damaged; omit --resume to start over") from None
            yield record

    def close(self) -> None:
        """Close the file; raise OSError, which names the file, if that fails."""
        self._file.close()


def compute_fingerprint(session: Session) -> dict[str, str]:
    """Return checksums, by subject, of everything in a session that a run's result depends on.

    Images are identified by file names, sizes and frame counts; their contents are not read.
    """
    files: list[object] = []
    for source in session.sources:
        names = [file.name for file in source.files]
        size = source.path.stat().st_size if source.kind != "images" else names
        files += [source.camera, source.path.name, source.n_frames, size]
    timeline = session.timeline
    boxes = [(name, sorted(session.select_object(name).boxes.items())) for name in session.objects]
    masks: list[object] = []
    if session.masks is not None:
        found = sorted(file for file in session.masks.rglob("*") if file.is_file())
        masks = [(file.relative_to(session.masks).as_posix(), file.stat().st_size) for file in found]
    return {
        "calibration": compute_rig_checksum(session.rig),
        "images": _compute_checksum(files),
        "timestamps or offsets": _compute_checksum([timeline.frames, timeline.times, timeline.stamps]),
        "boxes": _compute_checksum(boxes),
        "masks": _compute_checksum(masks),
    }


def compute_rig_checksum(rig: Rig) -> str:
    """Return a checksum of a rig's cameras and its length unit."""
    cameras: list[object] = [rig.unit]
    for camera in rig:
        cameras += [camera.name, camera.size, camera.matrix, camera.distortion, camera.lens]
        cameras.append(camera.camera_from_world.as_matrix())
    return _compute_checksum(cameras)


def _compute_checksum(parts: list[Any]) -> str:
    digest = hashlib.blake2b(digest_size=16)
    for part in parts:
        digest.update(part.tobytes() if isinstance(part, np.ndarray) else repr(part).encode())
        digest.update(b"\0")
    return digest.hexdigest()
