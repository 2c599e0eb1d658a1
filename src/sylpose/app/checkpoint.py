"""Checkpoints: the state of a run that is not at its end, from which `--resume` goes on exactly as if nothing had happened.

A file of: a line that says what it is; a line of JSON with what the run was asked to do and of which recording; the state,
a Python pickle, and so to be loaded only if the file is one's own; a checksum of all this.
"""

from __future__ import annotations

import hashlib
import os
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose import __version__
from sylpose.capture import Session
from sylpose.numerics.arrays import FloatArray
from sylpose.report.files import writing

__all__ = ["CHECKPOINT", "ExactPickler", "fingerprint", "load_checkpoint", "save_checkpoint"]

CHECKPOINT = "checkpoint.bin"
FORMAT = b"sylpose checkpoint 1\n"
DIGEST_SIZE = hashlib.blake2b().digest_size
START_ANEW = "; to start anew leave out --resume"


class _Header(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    version: str
    options: dict[str, str]
    session: dict[str, str]


class ExactPickler(pickle.Pickler):
    """Pickles so that what is loaded computes on with the same bits."""

    def reducer_override(self, obj: object) -> Any:
        """Poses to the last bit, which SciPy normalises when it loads them; arrays with their layout in memory, since
        sums over other layouts are added up in other orders."""
        if isinstance(obj, RigidTransform):
            return _transform, (obj.as_matrix(),)
        if isinstance(obj, Rotation):
            return _rotation, (obj.as_quat(),)
        if type(obj) is np.ndarray and not (obj.dtype.hasobject or _is_plain(obj)):
            return _array, (np.array(obj, order="C"), obj.strides, obj.flags.writeable)
        return NotImplemented


def _transform(matrix: FloatArray) -> RigidTransform:
    return RigidTransform(matrix, normalize=False)


def _rotation(quaternions: FloatArray) -> Rotation:
    return Rotation(quaternions, normalize=False)


def _is_plain(array: NDArray[Any]) -> bool:
    """Whether NumPy's own pickling keeps everything."""
    return array.flags.forc and array.flags.writeable


def _array(values: NDArray[Any], strides: tuple[int, ...], writeable: bool) -> NDArray[Any]:
    """An array (not of views of other arrays) with given strides, in bytes."""
    reach = [(n - 1) * step for n, step in zip(values.shape, strides, strict=True)]
    before = -sum(min(r, 0) for r in reach)
    size = before + sum(max(r, 0) for r in reach) + values.itemsize
    out: NDArray[Any] = np.ndarray(values.shape, values.dtype, np.zeros(size, np.uint8).data, before, strides)
    out[...] = values
    out.setflags(write=writeable)
    return out


class _Sealed:
    """A file whose content is summed up while it is written."""

    def __init__(self, file: BinaryIO) -> None:
        self._file, self._sum = file, hashlib.blake2b()

    def write(self, data: Any) -> int:
        self._sum.update(data)
        return self._file.write(data)

    def close(self) -> None:
        """Put the checksum at the end; the file is then on the disk."""
        self._file.write(self._sum.digest())
        self._file.flush()
        os.fsync(self._file.fileno())


def save_checkpoint(path: Path, options: Mapping[str, str], session: Mapping[str, str], state: object) -> None:
    """Write a checkpoint, or leave the one that is there as it is.

    Args:
        options, session: what must be the same to go on: words by what they are about.

    Raises:
        OSError: naming the file that cannot be written.
    """
    header = _Header(__version__, dict(options), dict(session))
    temporary = path.with_name(f"{path.name}.tmp")
    with writing(path):
        try:
            with temporary.open("wb") as file:
                sealed = _Sealed(file)
                sealed.write(FORMAT + msgspec.json.encode(header) + b"\n")
                ExactPickler(sealed, protocol=5).dump(state)
                sealed.close()
            os.replace(temporary, path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise


def load_checkpoint(path: Path, options: Mapping[str, str], session: Mapping[str, str]) -> Any:
    """The state that was saved.

    Raises:
        FileNotFoundError: no checkpoint.
        ValueError: naming the file: damaged, of another version, other options or another session.
    """
    damaged = ValueError(f"{path}: this checkpoint is damaged, or none of sylpose{START_ANEW}")
    with path.open("rb") as file:
        if file.readline(len(FORMAT)) != FORMAT or not _is_whole(file):
            raise damaged
        file.seek(len(FORMAT))
        try:
            header = msgspec.json.decode(file.readline(), type=_Header)
        except msgspec.MsgspecError:
            raise damaged from None
        if header.version != __version__:
            raise ValueError(f"{path}: written by sylpose {header.version}, this is {__version__}{START_ANEW}")
        _compare(path, header, options, session)
        try:
            return pickle.load(file)
        except (pickle.UnpicklingError, AttributeError, ImportError, TypeError, ValueError, EOFError, KeyError):
            # Whole, and of this version's name: of one that was changed in between.
            raise ValueError(f"{path}: written by another state of sylpose {__version__}{START_ANEW}") from None


def _is_whole(file: BinaryIO) -> bool:
    """Whether the checksum at the end is that of the rest."""
    rest = file.seek(0, os.SEEK_END) - DIGEST_SIZE
    file.seek(0)
    total = hashlib.blake2b()
    while rest > 0:
        part = file.read(min(rest, 1 << 20))
        if not part:
            return False
        total.update(part)
        rest -= len(part)
    return rest == 0 and file.read() == total.digest()


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
    cameras: list[object] = [session.rig.unit]
    for camera in session.rig:
        cameras += [camera.name, camera.size, camera.matrix, camera.distortion, camera.lens]
        cameras.append(camera.camera_from_world.as_matrix())
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
        "calibration": _checksum(cameras),
        "images": _checksum(files),
        "time stamps or offsets": _checksum([timeline.frames, timeline.times, timeline.stamps]),
        "boxes": _checksum(boxes),
        "masks": _checksum(masks),
    }


def _checksum(parts: list[Any]) -> str:
    total = hashlib.blake2b(digest_size=16)
    for part in parts:
        total.update(part.tobytes() if isinstance(part, np.ndarray) else repr(part).encode())
        total.update(b"\0")
    return total.hexdigest()
