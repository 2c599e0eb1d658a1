"""Serialization of checkpoints and tracks: bit exact, and invalid files are rejected with a message."""

from __future__ import annotations

import hashlib
import pickle
from pathlib import Path
from types import GenericAlias, SimpleNamespace
from typing import Any, Literal, TypeVar, get_type_hints

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.future import BackgroundResult
from sylpose.io.capture import open_session
from sylpose.rig import Camera
from sylpose.runs.checkpoint import CHECKPOINT, DIGEST_SIZE, FrameFile, load_checkpoint
from sylpose.runs.checkpoint_schema import SERIALIZER, RunState
from sylpose.runs.options import RunOptions
from sylpose.runs.run import track_session
from sylpose.smoothing import Track
from sylpose.status import FrameStatus
from sylpose.tracking.context import TrackedFrame
from sylpose.tracking.options import TrackingOptions
from tests.test_public import types_in

pytestmark = pytest.mark.usefixtures("undrawn")

ARRAYS = tuple[NDArray[np.float64], ...]


def through(value: Any, hint: Any) -> Any:
    return SERIALIZER.load(memoryview(b"".join(SERIALIZER.dump(value))), hint)


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
        SERIALIZER.dump(value)


def packed(root: Any, blocks: bytes = bytes(64)) -> memoryview:
    """Return data with a table that no writer has written."""
    table = msgspec.msgpack.encode(root)
    return memoryview(len(table).to_bytes(8, "little") + table + blocks)


ARRAY: Any = NDArray[np.float64]


@pytest.mark.parametrize(
    ("hint", "root"),
    [
        (RunState, ["system", "ls"]),
        (RunState, "os.system"),
        (RunState, ["x", {}, {}]),
        (RunState, [1, {}]),
        (RunState, [1, {}, {"": 1}]),
        (RunState, [1, {}, {"": [[0, 0, None], -1]}]),
        (RunState, []),
        (Camera, ["a", [0], 1, 2, 3, 4, 5]),
        (BackgroundResult[int], ["eval", "1"]),
        (BackgroundResult[int], ["bundle_frames"]),
        (BackgroundResult[int], []),
        (ARRAYS, [msgspec.msgpack.Ext(0, bytes(4))]),
        (ARRAYS, [["<f8", [8], None, True], msgspec.msgpack.Ext(0, b"\1\0\0\0")]),
        (ARRAYS, [["<f8", [8], None, True], msgspec.msgpack.Ext(0, b"\0")]),
        (tuple[ARRAY, RigidTransform], [["<f8", [8], None, True], msgspec.msgpack.Ext(0, bytes(4))]),
        (ARRAY, ["|O8", [1], None, True]),
        (ARRAY, ["<i8", [8], None, True]),
        (ARRAY, ["<f8", [1 << 62], None, True]),
        (ARRAY, ["<f8", [1 << 62, 0], None, True]),
        (ARRAY, ["<f8", [0, 1 << 62], None, True]),
        (ARRAY, ["<f8", [1] * 60, None, True]),
        (ARRAY, ["|u1", [2], [1 << 40], True]),
        (ARRAY, ["|u1", [-1], None, True]),
        (ARRAY, ["f8,O", [1], None, True]),
        (ARRAY, ["<f8", [4], None, True]),
        (ARRAY, b"\0\0" + bytes(16)),
        (RigidTransform, ["<f8", [8], None, True]),
        (RigidTransform, ["<f8", [2, 4], None, True]),
        (Rotation, ["<f8", [2, 4], None, True]),
        (float, ["<f8", [8], None, True]),
        (float, "1.0"),
        (dict[str, int], 1),
        (dict[str, int], {1: 1}),
        (list[int], [["list"]]),
        (tuple[int, str], [1]),
        (Literal["opencv"], "fisheye"),
        (FrameStatus, "asleep"),
    ],
)
def test_invalid_tables_are_rejected(hint: Any, root: Any) -> None:
    with pytest.raises(ValueError, match=r"."):
        SERIALIZER.load(packed(root), hint)


def test_poses_of_integers_are_rejected() -> None:
    matrix, quaternion = np.eye(4), np.array([0.0, 0.0, 0.0, 1.0])
    for hint, values in ((RigidTransform, matrix), (Rotation, quaternion)):
        assert SERIALIZER.load(packed(["<f8", list(values.shape), None, True], values.tobytes()), hint) is not None
        integers = values.astype(np.int64).tobytes()
        with pytest.raises(ValueError, match="not a"):
            SERIALIZER.load(packed(["<i8", list(values.shape), None, True], integers), hint)


def test_arrays_need_all_their_data() -> None:
    assert len(SERIALIZER.load(packed(["<f8", [8], None, True]), ARRAY)) == 8
    for size in (63, 65):
        with pytest.raises(ValueError, match="data than the arrays have"):
            SERIALIZER.load(packed(["<f8", [8], None, True], bytes(size)), ARRAY)


@pytest.mark.parametrize(
    "data", [b"", b"\1", bytes(8), b"\xff" * 8, (100_000).to_bytes(8, "little") + b"\x91" * 100_000]
)
def test_truncated_or_deep_tables_are_rejected(data: bytes) -> None:
    with pytest.raises(ValueError, match=r"."):
        SERIALIZER.load(memoryview(data), RunState)


T = TypeVar("T", bound=np.generic)


def aliased(number: type[np.generic]) -> Any:
    """Return NDArray as NumPy 2.5 defines it, which requires Python 3.12."""
    array: Any = np.ndarray
    dtype: Any = np.dtype
    alias: Any = SimpleNamespace(__value__=array[tuple[Any, ...], dtype[T]])
    return GenericAlias(alias, (number,))


@pytest.mark.parametrize("hint", [NDArray[np.float64], aliased(np.float64)], ids=["plain", "alias"])
def test_arrays_are_accepted_by_dtype_kind(hint: Any) -> None:
    assert np.array_equal(through(np.arange(3.0), hint), [0, 1, 2])
    assert np.array_equal(through((np.arange(3.0),), tuple[hint, ...])[0], [0, 1, 2])
    for wrong in (np.zeros(3, int), [0.0, 0.0], 1.0):
        with pytest.raises(ValueError, match=r"."):
            through(wrong, hint)


def test_an_alias_without_parameters() -> None:
    alias: Any = SimpleNamespace(__value__=float)
    assert through(1, alias) == 1.0
    with pytest.raises(ValueError, match="a float was expected, not a str"):
        through("1", alias)


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


@pytest.mark.parametrize("trials", [30, pytest.param(150, marks=pytest.mark.slow)])
def test_tampered_checkpoints(checkpoint: Path, tmp_path: Path, trials: int) -> None:
    """Change, remove or insert bytes, with and without a valid checksum: a one-line error, or a state of valid types."""
    good = checkpoint.read_bytes()[:-DIGEST_SIZE]
    first, line, _ = good.split(b"\n", 2)
    (tmp_path / "header").write_bytes(line)
    begin = len(first) + len(line) + 2
    (length,) = np.frombuffer(good[begin : begin + 8], "<u8")
    path, rng, refused = tmp_path / CHECKPOINT, np.random.default_rng(0), 0
    assert said_of(path, sealed(good)) == ""
    for trial in range(trials):
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
    assert 3 * refused > 2 * trials


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
        between.add(max(between) + 12 + int.from_bytes(good[max(between) : max(between) + 8], "little"))
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


def test_arguments_of_background_work_can_be_written() -> None:
    """A checkpoint while background work is pending contains its arguments."""
    for function in SERIALIZER.functions.values():
        for name, hint in get_type_hints(function).items():
            ours = {kind for kind in types_in(hint) if kind.__module__.startswith("sylpose.")}
            assert name == "return" or ours <= {*SERIALIZER.records}, f"{function.__name__}: {name}"
    options = TrackingOptions(max_keyframes=7)
    assert through(options, TrackingOptions) == options
