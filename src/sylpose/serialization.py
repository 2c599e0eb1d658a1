"""Serialization of records of a fixed list of types: compact for messages, bit-exact for files.

The data are MessagePack without any names: a record is the list of its fields' values. Each value is read as the type
that its field is annotated with, so the data determine neither types nor functions, except those of a list.

Bit-exact data (`Serializer.dump`) are followed by the contents of all arrays as in memory. Records, arrays and poses
that are shared stay shared: the second occurrence is the index of the first, so that cycles are impossible. In compact
data (`Serializer.encode`), integers take as many bits as the range of their column, or of its differences, requires. So
do numbers that become integers when multiplied by a power of two, such as image points on their grid
(`Camera.normalize_to_grid`). Other numbers take four bytes each if that is lossless, otherwise eight.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from enum import Enum
from functools import cached_property
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.future import BackgroundResult
from sylpose.geometry.validation import MAX_MAGNITUDE, ORTHOGONALITY_TOLERANCE, are_rotations, check_shape

Array = NDArray[Any]

# Permitted types of arrays: little-endian, as on all machines with NumPy wheels.
_DTYPE = re.compile(r"[|<][biuf][1248]")
# Largest total memory of strided arrays, bytes: unlike contiguous ones, they are not bounded by the file's length
# (choice).
MAX_STRIDED_BYTES = 1 << 30
_NUMBERS: dict[type[Any], type[Any]] = {float: np.floating, int: np.integer, bool: np.bool_, str: np.void}
_CONTAINERS = (tuple, list, Sequence, dict, Mapping)
# Kinds of numbers that are accepted for another one.
_ACCEPTED_KINDS = {"b": "bi", "i": "iu"}
_LENGTH, _INDEX = struct.Struct("<Q"), struct.Struct("<I")
_READ_ERRORS = (
    msgspec.MsgspecError,
    RecursionError,
    TypeError,
    KeyError,
    IndexError,
    OverflowError,
    MemoryError,
    struct.error,
)


@dataclass(frozen=True)
class RecordType:
    """Record that can be serialized.

    Attributes:
        type: the class.
        shapes: shapes of its arrays, by field; a letter is the same number throughout a record.
        fields: names and types of the fields; None for those of a dataclass or a named tuple.
        sets_attributes: set the attributes directly, for classes whose constructor takes other arguments.
        check: raises ValueError for invalid records.
    """

    type: type[Any]
    shapes: Mapping[str, tuple[int | str, ...]] = field(default_factory=dict)
    fields: Mapping[str, Any] | None = None
    sets_attributes: bool = False
    check: Callable[[Any], None] | None = None

    @cached_property
    def hints(self) -> Mapping[str, Any]:
        """Types of the fields by name; only of those that are arguments."""
        if self.fields is not None:
            return self.fields
        hints, kind = get_type_hints(self.type), self.type
        names = [field.name for field in fields(kind) if field.init] if is_dataclass(kind) else list(kind._fields)
        return {name: hints[name] for name in names}

    def create(self, values: Mapping[str, Any]) -> Any:
        """Create a record from its fields' values; raise TypeError or ValueError if they are invalid."""
        if self.sets_attributes:
            out = object.__new__(self.type)
            vars(out).update(values)
        else:
            out = self.type(**values)
        lengths: dict[str, int] = {}
        for name, shape in self.shapes.items():
            if (array := getattr(out, name)) is not None:
                check_shape(array.shape, shape, f"{self.type.__name__}.{name}", lengths)
        if self.check is not None:
            self.check(out)
        return out


class Serializer:
    """Serializer of records, numbers, arrays, poses and containers of these.

    Args:
        records: types of the records.
        functions: functions whose pending results can be written bit-exactly (`geometry.future`).
    """

    def __init__(self, records: Iterable[RecordType], functions: Iterable[Callable[..., Any]] = ()) -> None:
        self.records = {record.type: record for record in records}
        self.functions = {function.__name__: function for function in functions}

    def encode(self, value: object) -> bytes:
        """Encode a value compactly.

        Raises:
            TypeError: an unsupported type.
        """
        return msgspec.msgpack.encode(_Writer(self, exact=False).put(value))

    def decode(self, data: bytes, hint: Any) -> Any:
        """Decode the output of `encode`.

        Args:
            data: the bytes.
            hint: type of the value.

        Raises:
            ValueError: the reason why the bytes are no such value.
        """
        return self._read(data, hint, None)

    def dump(self, value: object) -> list[Any]:
        """Return the parts of a value's bit-exact data, to be written one after another.

        Raises:
            TypeError: an unsupported type.
        """
        writer = _Writer(self, exact=True)
        table = msgspec.msgpack.encode(writer.put(value))
        return [_LENGTH.pack(len(table)) + table, *writer.blocks]

    def load(self, data: memoryview, hint: Any) -> Any:
        """Read the output of `dump`; arguments and exceptions as of `decode`."""
        size = _LENGTH.unpack(data[:8])[0] + 8 if len(data) >= 8 else 0
        return self._read(data[8:size], hint, data[size:])

    def _read(self, data: bytes | memoryview, hint: Any, blocks: memoryview | None) -> Any:
        try:
            value = msgspec.msgpack.decode(data)
            reader = _Reader(self, blocks)
            out = reader.get(hint, value)
        except _READ_ERRORS as error:
            raise ValueError(f"not a message: {error}") from None
        if reader.blocks:
            raise ValueError("more data than the arrays have")
        return out


class _Writer:
    def __init__(self, serializer: Serializer, *, exact: bool) -> None:
        self._serializer, self._exact = serializer, exact
        self._names = {function: name for name, function in serializer.functions.items()}
        self.blocks: list[Any] = []
        self._index_by_id: dict[int, int] = {}
        self._references: list[object] = []  # keeps the objects alive, so that their ids stay unique

    def put(self, value: Any) -> Any:
        """Return a value as numbers, strings, bytes, lists and dictionaries."""
        kind = type(value)
        if value is None or kind in _NUMBERS:
            return value
        if isinstance(value, Enum):
            return value.value
        if kind in (list, tuple):
            return [self.put(part) for part in value]
        if issubclass(kind, Mapping):
            return {self.put(key): self.put(part) for key, part in value.items()}
        if isinstance(value, np.generic):
            return self._put_array(np.array(value)) if self._exact else value.item()
        if not self._exact:
            return self._put_object(value)
        index = self._index_by_id.get(id(value))
        if index is not None:
            return msgspec.msgpack.Ext(0, _INDEX.pack(index))
        out = self._put_object(value)
        self._index_by_id[id(value)] = len(self._references)
        self._references.append(value)
        return out

    def _put_object(self, value: Any) -> Any:
        kind = type(value)
        if kind in self._serializer.records:
            return [self.put(getattr(value, name)) for name in self._serializer.records[kind].hints]
        if kind is np.ndarray:
            return self._put_array(value)
        if kind is RigidTransform and not self._exact:
            return np.concatenate([value.rotation.as_quat(), value.translation]).astype("<f8").tobytes()
        if kind in (RigidTransform, Rotation):
            return self._put_array(value.as_matrix() if kind is RigidTransform else value.as_quat())
        if kind is BackgroundResult and self._exact:
            function, arguments = value.call
            return [self._names[function], *map(self.put, arguments)]
        raise TypeError(f"{kind.__name__} cannot be serialized")

    def _put_array(self, value: Array) -> Any:
        """Return an array; bit-exact with its memory layout, which determines the order of summation."""
        if not self._exact:
            return encode_array(value.astype(np.int64) if value.dtype.kind == "b" else value)
        if not _DTYPE.fullmatch(value.dtype.str):
            raise TypeError(f"an array of {value.dtype} cannot be serialized")
        self.blocks.append(np.ascontiguousarray(value).reshape(-1).view(np.uint8).data)
        strides = None if value.flags.c_contiguous else list(value.strides)
        return [value.dtype.str, list(value.shape), strides, value.flags.writeable]


class _Reader:
    """Reader of compact data, or of bit-exact data with the contents of their arrays."""

    def __init__(self, serializer: Serializer, blocks: memoryview | None) -> None:
        self._serializer, self.blocks = serializer, blocks
        self._objects: list[Any] = []
        self._strided_bytes = 0

    def get(self, hint: Any, value: Any) -> Any:
        """Return a value as the type of a hint; raise one of the exceptions that `Serializer` catches."""
        hint = _resolve_alias(hint)
        kind, arguments = get_origin(hint) or hint, get_args(hint)
        if kind is Annotated:  # an array with its shape
            out = self.get(arguments[0], value)
            check_shape(out.shape, arguments[1], "the array")
            return out
        if kind in (UnionType, Union):
            (kind,) = (part for part in arguments if part is not NoneType)
            return None if value is None else self.get(kind, value)
        if kind in _NUMBERS:
            return self._get_number(kind, value)
        if kind is Literal and value in arguments:
            return value
        if isinstance(kind, type) and issubclass(kind, Enum):
            return kind(value)
        if kind in _CONTAINERS:
            return self._get_container(kind, arguments, value)
        if isinstance(value, msgspec.msgpack.Ext) and self.blocks is not None:
            return _check_kind(self._objects[_INDEX.unpack(value.data)[0]], kind, arguments)
        out = _check_kind(self._get_object(kind, value), kind, arguments)
        self._objects.append(out)
        return out

    def _get_container(self, kind: Any, arguments: tuple[Any, ...], value: Any) -> Any:
        if not isinstance(value, dict if kind in (dict, Mapping) else list):
            raise _mismatch(kind, value)
        if isinstance(value, dict):
            return {self.get(arguments[0], key): self.get(arguments[1], item) for key, item in value.items()}
        if kind is not tuple:
            return [self.get(arguments[0], item) for item in value]
        kinds = [arguments[0]] * len(value) if arguments[1:] == (Ellipsis,) else arguments
        if len(value) != len(kinds):
            raise ValueError(f"{len(kinds)} values were expected, not {len(value)}")
        return tuple([self.get(part, item) for part, item in zip(kinds, value, strict=True)])

    def _get_number(self, kind: type[Any], value: Any) -> Any:
        if type(value) is kind or (kind is float and type(value) is int):
            return kind(value)
        number = self._get_array(value)[()] if isinstance(value, list) and self.blocks is not None else value
        if not isinstance(number, _NUMBERS[kind]):
            raise _mismatch(kind, value)
        return number

    def _get_object(self, kind: Any, value: Any) -> Any:
        if kind is np.ndarray:
            return self._get_array(value)
        if kind is RigidTransform:
            return _decode_pose(value) if self.blocks is None else make_transforms(self._get_array(value))
        if kind is Rotation:
            return _make_rotation(self._get_array(value))
        if not isinstance(value, list):
            raise _mismatch(kind, value)
        if kind is BackgroundResult:
            function = self._serializer.functions[value[0]]
            hints = [hint for name, hint in get_type_hints(function).items() if name != "return"]
            return BackgroundResult(function, *(self.get(h, v) for h, v in zip(hints, value[1:], strict=True)))
        record = self._serializer.records[kind]
        if len(value) != len(record.hints):
            raise ValueError(f"not a {kind.__name__}: {len(record.hints)} fields were expected")
        values = {}
        for (name, hint), part in zip(record.hints.items(), value, strict=True):
            try:
                values[name] = self.get(hint, part)
            except ValueError as error:
                raise ValueError(f"{kind.__name__}.{name}: {error}") from None
        return record.create(values)

    def _get_array(self, value: Any) -> Array:
        """Create an array with its own memory."""
        if self.blocks is None:
            if not isinstance(value, bytes):
                raise _mismatch(np.ndarray, value)
            return decode_array(value)
        dtype, shape, strides, is_writeable = value
        if not _DTYPE.fullmatch(dtype) or not all(type(n) is int and n >= 0 for n in shape) or len(shape) > 8:
            raise ValueError("an array with elements that are not numbers")
        kind = np.dtype(dtype)
        size = kind.itemsize
        for n in shape:  # Python integers do not overflow
            size *= n
        if size > len(self.blocks):
            raise ValueError("less data than the arrays have")
        values: Array = np.frombuffer(self.blocks[:size], kind).reshape(shape)
        self.blocks = self.blocks[size:]
        if kind.kind == "b":  # unused rows may contain any bytes, and bytes above 1 are not valid booleans
            values = values.view(np.uint8) != 0
        out = values.copy() if strides is None else self._apply_strides(values, strides)
        out.setflags(write=bool(is_writeable))
        return out

    def _apply_strides(self, values: Array, strides: list[int]) -> Array:
        """Copy values into an array with these strides, in bytes."""
        if not all(type(step) is int for step in strides):
            raise ValueError("strides that are not integers")
        reach = [max(n - 1, 0) * step for n, step in zip(values.shape, strides, strict=True)]
        offset = -sum(min(r, 0) for r in reach)
        size = offset + sum(max(r, 0) for r in reach) + values.itemsize
        self._strided_bytes += size
        if self._strided_bytes > MAX_STRIDED_BYTES or any(step % values.itemsize for step in strides):
            raise ValueError("arrays that take too much memory")
        out: Array = np.ndarray(values.shape, values.dtype, np.zeros(size, np.uint8).data, offset, strides)
        out[...] = values
        return out


def _resolve_alias(hint: Any) -> Any:
    """Return the type that a `type` alias stands for, as NumPy's NDArray is one since 2.5; other types unchanged."""
    resolved = getattr(get_origin(hint) or hint, "__value__", None)
    if resolved is None:
        return hint
    return resolved[get_args(hint)] if get_args(hint) else resolved


def _check_kind(value: Any, kind: Any, arguments: tuple[Any, ...]) -> Any:
    """Return an object of this type, and an array of this kind of numbers."""
    if not isinstance(value, kind):
        raise _mismatch(kind, value)
    if kind is np.ndarray:
        expected = np.dtype(get_args(arguments[1])[0])
        if value.dtype.kind not in _ACCEPTED_KINDS.get(expected.kind, expected.kind):
            raise ValueError(f"an array of {expected} was expected, not of {value.dtype}")
        return value.astype(bool) if expected.kind == "b" and value.dtype.kind != "b" else value
    return value


def _mismatch(kind: Any, value: Any) -> ValueError:
    return ValueError(f"a {getattr(kind, '__name__', kind)} was expected, not a {type(value).__name__}")


def make_transforms(matrices: FloatArray) -> RigidTransform:
    """Create transforms (n, 4, 4), or one (4, 4), without SciPy's normalization, which would change their values.

    Raises:
        ValueError: they are not rigid transforms.
    """
    is_matrix = matrices.dtype.kind == "f" and matrices.ndim in (2, 3) and matrices.shape[-2:] == (4, 4)
    if not (
        is_matrix
        and (np.abs(matrices) < MAX_MAGNITUDE).all()
        and np.all(are_rotations(matrices[..., :3, :3]))
        and (matrices[..., 3, :] == [0, 0, 0, 1]).all()
    ):
        raise ValueError("not a rigid transform")
    return RigidTransform(matrices, normalize=False)


def _decode_pose(data: Any) -> RigidTransform:
    numbers = np.frombuffer(data, "<f8") if isinstance(data, bytes) and len(data) == 56 else np.full(7, np.nan)
    # The largest component of a unit quaternion is at least one half.
    if not (np.abs(numbers) < MAX_MAGNITUDE).all() or not 0.4 < np.abs(numbers[:4]).max() < 1.1:
        raise ValueError("not a pose")
    return RigidTransform.from_components(numbers[4:], Rotation.from_quat(numbers[:4]))


def _make_rotation(quaternions: FloatArray) -> Rotation:
    deviation = np.abs(np.linalg.norm(quaternions, axis=-1) - 1.0).max(initial=0.0)
    if quaternions.dtype.kind != "f" or not deviation < ORTHOGONALITY_TOLERANCE:
        raise ValueError("not a unit quaternion")
    return Rotation(quaternions, normalize=False)


# Largest number of elements: a few bytes must not announce an array that exhausts the memory (choice).
MAX_NUMBERS = 2_000_000
# Encoding of the numbers, its lowest bit set for floats; number of columns, 0 for one dimension.
_HEADER = struct.Struct("<BB")
# Column header: bits per number, the first number if the others are differences, else 0; and the subtracted minimum.
_COLUMN = struct.Struct("<Bqq")
_EIGHT_BYTES, _FOUR_BYTES, _BIT_PACKED = 0, 1, 2
# Largest exponent of the power of two that makes numbers integers (choice: a millionth of a focal length).
MAX_EXPONENT = 24
# Larger integers are not compressed: sums and differences of smaller ones are exact (derived).
MAX_INTEGER = 2**50
MAX_COLUMNS = 6  # (choice)


def encode_array(value: Array) -> bytes:
    """Encode a one- or two-dimensional array of floats or integers compactly.

    Raises:
        TypeError: any other array.
    """
    if value.ndim not in (1, 2) or value.dtype.kind not in "fi":
        raise TypeError(f"an array of {value.ndim} dimensions of {value.dtype} cannot be serialized")
    columns = value.shape[1] if value.ndim == 2 else 0
    floats = value.dtype.kind == "f"
    with np.errstate(over="ignore"):
        four = floats and np.array_equal(value.astype("<f4"), value, equal_nan=True)
    encoding = _FOUR_BYTES if four else _EIGHT_BYTES
    content = value.astype("<f4" if four else "<f8" if floats else "<i8").tobytes()
    exponent = _find_exponent(value)
    if exponent is not None:
        integers = np.round(value * 2.0**exponent).astype(np.int64) if floats else value.astype(np.int64)
        packed = b"".join(_encode_column(part) for part in integers.reshape(len(value), -1).T)
        if len(packed) < len(content):
            encoding, content = _BIT_PACKED + exponent, _INDEX.pack(len(value)) + packed
    return _HEADER.pack(2 * encoding + floats, columns) + content


def decode_array(data: bytes) -> Array:
    """Decode the output of `encode_array`.

    Raises:
        ValueError: the bytes are not an array.
    """
    if len(data) < _HEADER.size:
        raise ValueError("not an array: too short")
    code, columns = _HEADER.unpack_from(data)
    encoding, floats, n_columns, position = code // 2, code % 2 == 1, max(columns, 1), _HEADER.size
    if columns > MAX_COLUMNS or encoding > _BIT_PACKED + MAX_EXPONENT or (encoding == _FOUR_BYTES and not floats):
        raise ValueError("not an array: invalid header")
    if encoding < _BIT_PACKED:
        kind = np.dtype("<f4" if encoding == _FOUR_BYTES else "<f8" if floats else "<i8")
        if (len(data) - position) % (n_columns * kind.itemsize):
            raise ValueError("not an array: its shape and size disagree")
        out = np.frombuffer(data, kind, offset=position).astype(float if floats else np.int64)
    else:
        rows = _INDEX.unpack_from(data, position)[0] if len(data) >= position + _INDEX.size else 0
        if not 0 < rows <= min(8 * len(data), MAX_NUMBERS // n_columns):
            raise ValueError("not an array: its shape and size disagree")
        out, position = np.empty((rows, n_columns), np.int64), position + _INDEX.size
        for k in range(n_columns):
            position = _decode_column(data, position, out[:, k])
        if position != len(data):
            raise ValueError("not an array: its shape and size disagree")
        out = out / 2.0 ** (encoding - _BIT_PACKED) if floats else out
    return out.reshape(-1, columns) if columns else out.reshape(-1)


def _find_exponent(value: Array) -> int | None:
    """Return the least exponent of a power of two that makes all numbers integers; None if there is none."""
    if value.size == 0 or not (np.abs(value) < MAX_INTEGER / 2.0**MAX_EXPONENT).all():
        return None
    if value.dtype.kind == "i":
        return 0
    return next((k for k in range(MAX_EXPONENT + 1) if (np.rint(value * 2.0**k) == value * 2.0**k).all()), None)


def _encode_column(integers: IntArray) -> bytes:
    steps = np.diff(integers)
    use_differences = len(steps) > 0 and int(np.ptp(steps)) < int(np.ptp(integers))
    first, rest = (int(integers[0]), steps) if use_differences else (0, integers)
    least = int(rest.min())
    bits = max(int(rest.max() - least).bit_length(), 1)
    spread = ((rest - least)[:, None] >> np.arange(bits)) & 1
    head = _COLUMN.pack(bits | (0x80 if use_differences else 0), first, least)
    return head + np.packbits(spread.astype(np.uint8)).tobytes()


def _decode_column(data: bytes, position: int, out: IntArray) -> int:
    """Decode a column into `out` (n,).

    Returns:
        The position of the next column.
    """
    if len(data) < position + _COLUMN.size:
        raise ValueError("not an array: too short")
    column_code, first, least = _COLUMN.unpack_from(data, position)
    use_differences, bits, position = column_code >> 7, column_code & 0x7F, position + _COLUMN.size
    count = len(out) - use_differences
    end = position + (count * bits + 7) // 8
    if not 0 < bits < 63 or count < 1 or len(data) < end or max(abs(first), abs(least)) > MAX_INTEGER:
        raise ValueError("not an array: its shape and size disagree")
    bit_rows = np.unpackbits(np.frombuffer(data[position:end], np.uint8), count=count * bits).reshape(count, bits)
    numbers = least + bit_rows.astype(np.int64) @ (np.int64(1) << np.arange(bits, dtype=np.int64))
    out[use_differences:] = numbers
    if use_differences:
        out[0] = first
        np.cumsum(out, out=out)
    return int(end)
