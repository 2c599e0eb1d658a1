"""Checkpoints: the state of a run that is not at its end, from which `--resume` goes on exactly as if nothing had happened.

A file of: a line that says what it is; a line of JSON with what the run was asked to do and of which recording; the state,
as data (`encoding`, `state`), with the length of its table before it; a checksum of all this.
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
from sylpose.app.checkpoint_schema import FUNCTIONS, KINDS, RunState
from sylpose.app.serialization import decoded, encoded
from sylpose.atomic_io import replacing
from sylpose.capture import Session
from sylpose.rig import Rig

__all__ = ["CHECKPOINT", "fingerprint", "load_checkpoint", "save_checkpoint"]

CHECKPOINT = "checkpoint.bin"
FORMAT = b"sylpose checkpoint 2\n"
DIGEST_SIZE = hashlib.blake2b().digest_size
START_ANEW = "; to start anew leave out --resume"
# Bytes: of a file, with all images of the frames that wait for a first motion; of its line of options (choice).
LARGEST, MOST_HEADER = 1 << 31, 1 << 20
_LENGTH = struct.Struct("<Q")


# What may be said of in a sentence.
_Word = Annotated[str, msgspec.Meta(pattern=r"^[^\x00-\x1f\x7f]*$", max_length=10_000)]


class _Header(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    version: Annotated[str, msgspec.Meta(pattern=r"^[\w.+-]{1,40}$")]
    options: dict[_Word, _Word]
    session: dict[_Word, _Word]


def save_checkpoint(path: Path, options: Mapping[str, str], session: Mapping[str, str], state: RunState) -> None:
    """Write a checkpoint, or leave the one that is there as it is.

    Args:
        options, session: what must be the same to go on: words by what they are about.

    Raises:
        OSError: naming the file that cannot be written.
    """
    header = _Header(__version__, dict(options), dict(session))
    table, *blocks = encoded(state, KINDS, FUNCTIONS)
    with replacing(path) as part, part.open("wb") as file:
        total = hashlib.blake2b()
        for piece in (FORMAT, msgspec.json.encode(header) + b"\n", _LENGTH.pack(len(table)), table, *blocks):
            total.update(piece)
            file.write(piece)
        file.write(total.digest())


def load_checkpoint(path: Path, options: Mapping[str, str], session: Mapping[str, str]) -> RunState:
    """The state that was saved. It is read as data: whatever is in the file, nothing of it is run.

    Raises:
        FileNotFoundError: no checkpoint.
        ValueError: naming the file: damaged, of another version, other options or another session.
    """
    damaged = f"{path}: this checkpoint is damaged, or none of sylpose{START_ANEW}"
    with path.open("rb") as file:
        data = memoryview(file.read(LARGEST + 1))
    first = bytes(data[: len(FORMAT)])
    if first != FORMAT and re.fullmatch(rb"sylpose checkpoint \d+\n?", first):
        raise ValueError(f"{path}: written by another version of sylpose; this is {__version__}{START_ANEW}")
    if first != FORMAT or len(data) > LARGEST or hashlib.blake2b(data[:-DIGEST_SIZE]).digest() != data[-DIGEST_SIZE:]:
        raise ValueError(damaged)
    line = bytes(data[len(FORMAT) : len(FORMAT) + MOST_HEADER]).partition(b"\n")[0]
    try:
        header = msgspec.json.decode(line, type=_Header)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        raise ValueError(damaged) from None
    if header.version != __version__:
        raise ValueError(f"{path}: written by sylpose {header.version}, this is {__version__}{START_ANEW}")
    _compare(path, header, options, session)
    rest = data[len(FORMAT) + len(line) + 1 : -DIGEST_SIZE]
    try:
        (length,) = _LENGTH.unpack_from(rest)
        state: RunState = decoded(rest[_LENGTH.size :], length, RunState, KINDS, FUNCTIONS)
    except (ValueError, struct.error):
        # Whole, and of this version's name: of one that was changed in between, or somebody made it up.
        raise ValueError(f"{path}: written by another state of sylpose {__version__}{START_ANEW}") from None
    return state


def _compare(path: Path, header: _Header, options: Mapping[str, str], session: Mapping[str, str]) -> None:
    for name in sorted(header.options.keys() | options.keys()):
        then, now = header.options.get(name, "none"), options.get(name, "none")
        if then != now:
            raise ValueError(
                f"{path}: the interrupted run had {name} {then}, not {now}: give the same options to go on{START_ANEW}"
            )
    for name in sorted(header.session.keys() | session.keys()):
        if header.session.get(name) != session.get(name):
            raise ValueError(f"{path}: of a run with other {name} than there are now{START_ANEW}")


def fingerprint(session: Session) -> dict[str, str]:
    """What a run's result depends on in a session: a checksum by what it is of. Contents of images are not read."""
    files: list[object] = []
    for source in session.sources:
        names = [file.name for file in source.files]
        size = source.path.stat().st_size if source.kind == "video" else names
        files += [source.camera, source.path.name, source.n_frames, size]
    timeline = session.timeline
    boxes = [(name, sorted(session.of(name).boxes.items())) for name in session.objects]
    masks: list[object] = []
    if session.masks is not None:
        found = sorted(file for file in session.masks.rglob("*") if file.is_file())
        masks = [(file.relative_to(session.masks).as_posix(), file.stat().st_size) for file in found]
    return {
        "calibration": checksum_of_rig(session.rig),
        "images": _checksum(files),
        "time stamps or offsets": _checksum([timeline.frames, timeline.times, timeline.stamps]),
        "boxes": _checksum(boxes),
        "masks": _checksum(masks),
    }


def checksum_of_rig(rig: Rig) -> str:
    """Of its cameras and its unit."""
    cameras: list[object] = [rig.unit]
    for camera in rig:
        cameras += [camera.name, camera.size, camera.matrix, camera.distortion, camera.lens]
        cameras.append(camera.camera_from_world.as_matrix())
    return _checksum(cameras)


def _checksum(parts: list[Any]) -> str:
    total = hashlib.blake2b(digest_size=16)
    for part in parts:
        total.update(part.tobytes() if isinstance(part, np.ndarray) else repr(part).encode())
        total.update(b"\0")
    return total.hexdigest()
