"""Checkpoints: saved state of an unfinished run, from which `--resume` continues with bit-identical results.

File layout: a format line; a line of JSON with the run's options and its recording's fingerprint; the length of the
state's table and the state as data (`serialization`, `runs.checkpoint_schema`); a checksum of all this.
"""

from __future__ import annotations

import hashlib
import re
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from sylpose import __version__
from sylpose.atomic_io import replace_atomically
from sylpose.io.capture import Session
from sylpose.rig import Rig
from sylpose.runs.checkpoint_schema import FUNCTIONS, RECORD_TYPES, RunState
from sylpose.serialization import deserialize, serialize

__all__ = ["CHECKPOINT", "compute_fingerprint", "load_checkpoint", "save_checkpoint"]

CHECKPOINT = "checkpoint.bin"
FORMAT = b"sylpose checkpoint 2\n"
DIGEST_SIZE = hashlib.blake2b().digest_size
RESTART_HINT = "; omit --resume to start over"
# Size limits in bytes of a file, including all images of the frames that wait for a first motion, and of its line of
# options (choice).
MAX_FILE_SIZE, MAX_HEADER_SIZE = 1 << 31, 1 << 20
_LENGTH = struct.Struct("<Q")


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
    header = _Header(__version__, dict(options), dict(session))
    table, *blocks = serialize(state, RECORD_TYPES, FUNCTIONS)
    with replace_atomically(path) as part, part.open("wb") as file:
        digest = hashlib.blake2b()
        for piece in (FORMAT, msgspec.json.encode(header) + b"\n", _LENGTH.pack(len(table)), table, *blocks):
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
    if (
        first != FORMAT
        or len(data) > MAX_FILE_SIZE
        or hashlib.blake2b(data[:-DIGEST_SIZE]).digest() != data[-DIGEST_SIZE:]
    ):
        raise ValueError(damaged)
    line = bytes(data[len(FORMAT) : len(FORMAT) + MAX_HEADER_SIZE]).partition(b"\n")[0]
    try:
        header = msgspec.json.decode(line, type=_Header)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        raise ValueError(damaged) from None
    if header.version != __version__:
        raise ValueError(f"{path}: written by sylpose {header.version}, this is {__version__}{RESTART_HINT}")
    _check_header(path, header, options, session)
    rest = data[len(FORMAT) + len(line) + 1 : -DIGEST_SIZE]
    try:
        (length,) = _LENGTH.unpack_from(rest)
        state: RunState = deserialize(rest[_LENGTH.size :], length, RunState, RECORD_TYPES, FUNCTIONS)
    except (ValueError, struct.error):
        # Intact and of this version number: written by modified code of the same version, or forged.
        raise ValueError(f"{path}: written by a modified sylpose {__version__}{RESTART_HINT}") from None
    return state


def _check_header(path: Path, header: _Header, options: Mapping[str, str], session: Mapping[str, str]) -> None:
    for name in sorted(header.options.keys() | options.keys()):
        before, now = header.options.get(name, "none"), options.get(name, "none")
        if before != now:
            raise ValueError(
                f"{path}: the interrupted run had {name} {before}, not {now}: use the same options to "
                f"resume{RESTART_HINT}"
            )
    for name in sorted(header.session.keys() | session.keys()):
        if header.session.get(name) != session.get(name):
            raise ValueError(f"{path}: {name} changed since the interrupted run{RESTART_HINT}")


def compute_fingerprint(session: Session) -> dict[str, str]:
    """Return checksums, by subject, of everything in a session that a run's result depends on.

    Images are identified by file names, sizes and frame counts; their contents are not read.
    """
    files: list[object] = []
    for source in session.sources:
        names = [file.name for file in source.files]
        size = source.path.stat().st_size if source.kind == "video" else names
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
