"""Serialization of checkpoints and tracks: bit exact, and invalid files are rejected with a message."""

from __future__ import annotations

import hashlib
import pickle
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.io.capture import open_session
from sylpose.runs.checkpoint import CHECKPOINT, DIGEST_SIZE, load_checkpoint
from sylpose.runs.checkpoint_schema import FUNCTIONS, RECORD_TYPES, RunState
from sylpose.runs.frame_store import FrameFile
from sylpose.runs.options import RunOptions
from sylpose.runs.run import track_session
from sylpose.serialization import deserialize, serialize
from sylpose.smoothing.trajectory import Track
from sylpose.tracking.tracked_frame import TrackedFrame

pytestmark = pytest.mark.usefixtures("undrawn")

ARRAYS = tuple[NDArray[np.float64], ...]


def through(value: Any, hint: Any) -> Any:
    table, *blocks = serialize(value, RECORD_TYPES, FUNCTIONS)
    return deserialize(memoryview(b"".join([table, *blocks])), len(table), hint, RECORD_TYPES, FUNCTIONS)


@given(st.integers(0, 2**32 - 1), st.sampled_from([(3,), (4, 3), (3, 2, 5)]))
def test_round_trip_is_bit_exact(seed: int, shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(seed)
    values, fixed = rng.normal(size=tuple(2 * n for n in shape)), rng.normal(size=shape)
    fixed.setflags(write=False)
    views = (values[..., ::2], values[::-1], values.T, np.moveaxis(values, 0, -1).copy("K"), values[:0])
    given = (*views, np.broadcast_to(fixed, (2, *shape)), fixed)
    for a, b in zip(given, through(given, ARRAYS), strict=True):
        assert np.array_equal(a, b)
        assert a.flags.writeable == b.flags.writeable
        assert a.size == 0 or a.strides == b.strides or a.flags.forc
    turns = Rotation.random(5, rng=rng) * Rotation.random(5, rng=rng)
    poses = RigidTransform.from_components(rng.normal(size=(5, 3)), turns)
    poses = poses * poses * poses.inv()  # rounding errors that normalization would remove
    assert np.array_equal(through(turns, Rotation).as_quat(), turns.as_quat())
    for pose in (poses, poses[0]):
        assert np.array_equal(through(pose, RigidTransform).as_matrix(), pose.as_matrix())


def test_shared_objects_stay_shared() -> None:
    array = np.zeros(3)
    one, other = through((array, array), ARRAYS)
    assert one is other
    number = through(np.float64(0.1) + np.float64(0.2), float)
    assert type(number) is np.float64
    assert number == 0.1 + 0.2


@pytest.mark.parametrize("value", [object(), {1, 2}, print, np.array([object()]), b"bytes", 1j, RuntimeError("x")])
def test_other_types_are_not_serialized(value: Any) -> None:
    with pytest.raises(TypeError, match="cannot be serialized"):
        serialize(value, RECORD_TYPES, FUNCTIONS)


@pytest.mark.parametrize(
    "entries",
    [
        [["system", "ls"]],
        [["os.system", "ls"]],
        [["builtins.eval", "1"]],
        [["later", "eval", "1"]],
        [["later", "bundled_together"]],
        [["JointState"]],
        [["list", [0]]],
        [["list", [-1]]],
        [["list", [1]], ["list"]],
        [["array", "|O8", [1], None, True]],
        [["array", "<f8", [1 << 62], None, True]],
        [["array", "<f8", [1 << 62, 0], None, True]],
        [["array", "<f8", [0, 1 << 62], None, True]],
        [["array", "<f8", [1] * 60, None, True]],
        [["array", "|u1", [2], [1 << 40], True]],
        [["array", "|u1", [-1], None, True]],
        [["array", "f8,O", [1], None, True]],
        [["pose", [0]]],
        [["dict", 1]],
        [[]],
        [[["list"]]],
        [["RunState", "x", {}, {}]],
        [["Camera", "a", [0], 1, 2, 3, 4, 5]],
    ],
)
def test_invalid_tables_are_rejected(entries: list[Any]) -> None:
    table = msgspec.msgpack.encode([[len(entries) - 1], entries])
    with pytest.raises(ValueError, match=r"."):
        deserialize(memoryview(table + bytes(64)), len(table), RunState, RECORD_TYPES, FUNCTIONS)


def test_deep_nesting_is_rejected() -> None:
    with pytest.raises(ValueError, match=r"."):
        deserialize(memoryview(b"\x91" * 100_000), 100_000, RunState, RECORD_TYPES, FUNCTIONS)


@pytest.fixture(scope="module")
def checkpoint(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the checkpoint of a run that failed after three frames, with its tracks."""
    out = tmp_path_factory.mktemp("part")

    def breaks(_: str, tracked: TrackedFrame) -> None:
        if tracked.pose.index == 3:
            raise RuntimeError("a bug")

    with pytest.raises(RuntimeError):
        track_session(open_session(recording), out, RunOptions(overlay=False, checkpoint_seconds=0), on_frame=breaks)
    return out / CHECKPOINT


def sealed(data: bytes) -> bytes:
    return data + hashlib.blake2b(data).digest()


def said_of(path: Path, data: bytes) -> str:
    """Return the error message for a file with this content; "" if it is read."""
    path.write_bytes(data)
    header = msgspec.json.decode(path.parent.joinpath("header").read_bytes())
    try:
        load_checkpoint(path, header["options"], header["session"])
    except ValueError as error:
        return str(error)
    return ""


def test_tampered_checkpoints(checkpoint: Path, tmp_path: Path) -> None:
    """Change, remove or insert bytes, with and without a valid checksum: a one-line error, or a state of valid types."""
    good = checkpoint.read_bytes()[:-DIGEST_SIZE]
    first, line, _ = good.split(b"\n", 2)
    (tmp_path / "header").write_bytes(line)
    begin = len(first) + len(line) + 2
    (length,) = np.frombuffer(good[begin : begin + 8], "<u8")
    path, rng, refused = tmp_path / CHECKPOINT, np.random.default_rng(0), 0
    assert said_of(path, sealed(good)) == ""
    for trial in range(150):
        data = bytearray(good)
        for _ in range(rng.integers(1, 4)):
            at = int(rng.integers(0, begin + 8 + int(length)))
            how = trial % 3
            if how == 0:
                data[at] ^= 1 << int(rng.integers(8))
            elif how == 1:
                del data[at : at + int(rng.integers(1, 5))]
            else:
                data[at:at] = rng.bytes(int(rng.integers(1, 5)))
        if trial % 10 == 9:
            del data[int(rng.integers(len(data))) :]
        message = said_of(path, sealed(bytes(data)) if trial % 5 else bytes(data))
        refused += bool(message)
        assert not message or str(path) in message
        assert "\n" not in message
        assert len(message) < 2000
    assert refused > 100


def test_pickles_are_not_loaded(checkpoint: Path, tmp_path: Path) -> None:
    (tmp_path / "ran").unlink(missing_ok=True)

    class Runs:
        def __reduce__(self) -> tuple[Any, ...]:
            return Path.touch, (tmp_path / "ran",)

    first, line, rest = checkpoint.read_bytes().split(b"\n", 2)
    (tmp_path / "header").write_bytes(line)
    payload = pickle.dumps(Runs())
    for data in (
        b"\n".join([first, line, payload]),
        b"\n".join([first, line, len(payload).to_bytes(8, "little") + payload]),
        b"\n".join([b"sylpose checkpoint 1", line, payload]),
    ):
        assert str(tmp_path / CHECKPOINT) in said_of(tmp_path / CHECKPOINT, sealed(data))
    assert rest
    assert not (tmp_path / "ran").exists()


@settings(max_examples=40)
@given(at=st.integers(0, 10**6), bit=st.integers(0, 7), cut=st.booleans())
def test_tampered_tracks(checkpoint: Path, at: int, bit: int, cut: bool) -> None:
    good = (checkpoint.parent / "tracks.bin").read_bytes()
    path, data, between = checkpoint.parent / "tampered.bin", bytearray(good), {0}
    while max(between) < len(good):
        between.add(max(between) + 20 + int.from_bytes(good[max(between) + 8 : max(between) + 16], "little"))
    at %= len(data)
    if cut:
        del data[at:]
    else:
        data[at] ^= 1 << bit
    path.write_bytes(data)
    file = FrameFile(path, Track, len(data))
    if cut and at in between:  # the remaining frames are complete
        assert len(list(file.read())) == sorted(between).index(at)
    else:
        with pytest.raises(ValueError, match="is damaged; omit --resume to start over"):
            list(file.read())
    file.close()
