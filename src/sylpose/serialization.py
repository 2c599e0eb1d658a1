"""Bit-exact serialization of objects of a fixed list of types.

The data are a table of entries (MessagePack), followed by the contents of all arrays as in memory. An entry is the name
of a type and its values; a value is a number, a string, or the index of an earlier entry, so that shared objects stay
shared and cycles are impossible. Reading only creates objects of the listed types and validates the types and shapes of
their fields; the data cannot name anything else.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, get_type_hints

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.future import BackgroundResult
from sylpose.geometry.record_validation import Shapes, check_shapes, convert_to_type, get_fields

__all__ = ["SerializableType", "deserialize", "serialize"]

# Permitted types of arrays: little-endian, as on all machines with NumPy wheels.
_DTYPE = re.compile(r"[|<][biuf][1248]")
# Largest total memory of strided arrays, bytes: unlike contiguous ones, they are not bounded by the file's length
# (choice).
MAX_STRIDED_BYTES = 1 << 30
# Largest deviation of a rotation from an orthogonal matrix, from rounding (choice).
ORTHOGONALITY_TOLERANCE = 1e-6
_SCALARS = (bool, int, float, str)


@dataclass(frozen=True)
class SerializableType:
    """Serializable type.

    Attributes:
        type: the class.
        shapes: shapes of its arrays, by field.
        fields: names and types of the fields; None for those of a dataclass or a named tuple.
        sets_attributes: set the attributes directly, for classes whose constructor takes other arguments.
        check: raises ValueError for invalid objects.
    """

    type: type[Any]
    shapes: Shapes = field(default_factory=dict)
    fields: Mapping[str, Any] | None = None
    sets_attributes: bool = False
    check: Callable[[Any], None] | None = None

    def all_fields(self) -> Sequence[tuple[str, Any]]:
        return get_fields(self.type) if self.fields is None else list(self.fields.items())

    def create(self, values: Sequence[Any]) -> Any:
        """Create an object from its fields' values; raise TypeError or ValueError if they are invalid."""
        value_by_field = {
            name: convert_to_type(hint, v) for (name, hint), v in zip(self.all_fields(), values, strict=True)
        }
        if self.sets_attributes:
            out = object.__new__(self.type)
            vars(out).update(value_by_field)
        else:
            out = self.type(**value_by_field)
        check_shapes(out, self.shapes)
        if self.check is not None:
            self.check(out)
        return out


def serialize(
    value: object, kinds: Mapping[str, SerializableType], functions: Mapping[str, Callable[..., Any]]
) -> list[Any]:
    """Serialize a value to the table and the contents of its arrays, to be written one after another.

    Args:
        value: the value.
        kinds: serializable types by name.
        functions: functions by name whose pending results can be serialized (`geometry.future`).

    Raises:
        TypeError: an object of another type.
    """
    writer = _Writer({kind.type: (name, kind) for name, kind in kinds.items()}, {f: n for n, f in functions.items()})
    root = writer.put(value)
    return [msgspec.msgpack.encode([root, writer.entries]), *writer.blocks]


def deserialize(
    data: memoryview,
    length: int,
    hint: Any,
    kinds: Mapping[str, SerializableType],
    functions: Mapping[str, Callable[..., Any]],
) -> Any:
    """Deserialize a value of a given type; the inverse of `serialize`.

    Args:
        data: the serialized value.
        length: length of the table in bytes; the rest are the arrays' contents.
        hint: the value's type.
        kinds: as in `serialize`.
        functions: as in `serialize`.

    Raises:
        ValueError: invalid data.
    """
    try:
        root, entries = msgspec.msgpack.decode(data[:length], type=tuple[Any, list[list[Any]]])
        reader = _Reader(kinds, functions, data[length:])
        for entry in entries:
            reader.objects.append(reader.read(entry))
        if len(reader.rest):
            raise ValueError("more data than the arrays have")
        return convert_to_type(hint, reader.value(root))
    except (msgspec.MsgspecError, RecursionError, TypeError, KeyError, IndexError, OverflowError, MemoryError) as error:
        raise ValueError(f"{type(error).__name__}: {error}") from None


class _Writer:
    def __init__(
        self, kinds: Mapping[type[Any], tuple[str, SerializableType]], functions: Mapping[Callable[..., Any], str]
    ) -> None:
        self._kinds, self._functions = kinds, functions
        self.entries: list[list[Any]] = []
        self.blocks: list[Any] = []
        self._index_by_id: dict[int, int] = {}
        self._references: list[object] = []  # keeps the objects alive, so that their ids stay unique

    def put(self, value: Any) -> Any:
        """Return a value's representation in an entry; a list of one number refers to the entry of that index."""
        if value is None or type(value) in _SCALARS:
            return value
        if isinstance(value, Enum):
            return value.value
        number = self._index_by_id.get(id(value))
        if number is None:
            entry = self._entry(value)
            number = self._index_by_id[id(value)] = len(self.entries)
            self._references.append(value)
            self.entries.append(entry)
        return [number]

    def _entry(self, value: Any) -> list[Any]:
        kind = type(value)
        if kind is np.ndarray:
            return self._write_array(value)
        if kind in self._kinds:
            name, serializable = self._kinds[kind]
            return [name, *(self.put(getattr(value, field)) for field, _ in serializable.all_fields())]
        if kind in (list, tuple):
            return [kind.__name__, *map(self.put, value)]
        if issubclass(kind, Mapping):
            return ["dict", *(self.put(part) for item in value.items() for part in item)]
        if kind is RigidTransform:
            return ["pose", self.put(value.as_matrix())]
        if kind is Rotation:
            return ["rotation", self.put(value.as_quat())]
        if isinstance(value, np.generic):
            return ["scalar", self.put(np.array(value))]
        if kind is BackgroundResult:
            function, arguments = value.call
            return ["later", self._functions[function], *map(self.put, arguments)]
        raise TypeError(f"{kind.__name__} cannot be serialized")

    def _write_array(self, value: NDArray[Any]) -> list[Any]:
        """Serialize an array with its memory layout, which determines the order of summation."""
        if not _DTYPE.fullmatch(value.dtype.str):
            raise TypeError(f"an array of {value.dtype} cannot be serialized")
        self.blocks.append(np.ascontiguousarray(value).reshape(-1).view(np.uint8).data)
        strides = None if value.flags.c_contiguous else list(value.strides)
        return ["array", value.dtype.str, list(value.shape), strides, value.flags.writeable]


class _Reader:
    def __init__(
        self, kinds: Mapping[str, SerializableType], functions: Mapping[str, Callable[..., Any]], rest: memoryview
    ) -> None:
        self._kinds, self._functions, self.rest = kinds, functions, rest
        self.objects: list[Any] = []
        self._strided_bytes = 0

    def value(self, value: Any) -> Any:
        if value is None or type(value) in _SCALARS:
            return value
        (number,) = value
        if type(number) is not int or not 0 <= number < len(self.objects):
            raise ValueError("a reference to a missing entry")
        return self.objects[number]

    def read(self, entry: Sequence[Any]) -> Any:
        """Create the object of an entry; raise one of the exceptions that `deserialize` catches."""
        name, *values = entry
        if name == "array":
            return self._read_array(*values)
        if name == "later":
            return self._read_future(values[0], [self.value(value) for value in values[1:]])
        content = [self.value(value) for value in values]
        if name in ("list", "tuple"):
            return content if name == "list" else tuple(content)
        if name == "dict":
            return dict(zip(content[::2], content[1::2], strict=True))
        if name in ("pose", "rotation", "scalar"):
            (numbers,) = content
            return _CONSTRUCTORS[name](
                convert_to_type(np.ndarray if name == "scalar" else NDArray[np.float64], numbers)
            )
        return self._kinds[name].create(content)

    def _read_future(self, name: str, arguments: Sequence[Any]) -> BackgroundResult[Any]:
        function = self._functions[name]
        hints = [hint for name, hint in get_type_hints(function).items() if name != "return"]
        return BackgroundResult(function, *(convert_to_type(hint, v) for hint, v in zip(hints, arguments, strict=True)))

    def _read_array(self, dtype: str, shape: list[int], strides: list[int] | None, writeable: bool) -> NDArray[Any]:
        """Create an array with its own memory."""
        if not _DTYPE.fullmatch(dtype) or not all(type(n) is int and n >= 0 for n in shape) or len(shape) > 8:
            raise ValueError("an array with elements that are not numbers")
        kind = np.dtype(dtype)
        size = kind.itemsize
        for n in shape:  # Python integers do not overflow
            size *= n
        if size > len(self.rest):
            raise ValueError("less data than the arrays have")
        values = np.frombuffer(self.rest[:size], kind).reshape(shape)
        self.rest = self.rest[size:]
        if kind.kind == "b":  # unused rows may contain any bytes, and bytes above 1 are not valid booleans
            values = values.view(np.uint8) != 0
        out = values.copy() if strides is None else self._apply_strides(values, strides)
        out.setflags(write=bool(writeable))
        return out

    def _apply_strides(self, values: NDArray[Any], strides: list[int]) -> NDArray[Any]:
        """Copy values into an array with these strides, in bytes."""
        if not all(type(step) is int for step in strides):
            raise ValueError("strides that are not integers")
        reach = [max(n - 1, 0) * step for n, step in zip(values.shape, strides, strict=True)]
        offset = -sum(min(r, 0) for r in reach)
        size = offset + sum(max(r, 0) for r in reach) + values.itemsize
        self._strided_bytes += size
        if self._strided_bytes > MAX_STRIDED_BYTES or any(step % values.itemsize for step in strides):
            raise ValueError("arrays that take too much memory")
        out: NDArray[Any] = np.ndarray(values.shape, values.dtype, np.zeros(size, np.uint8).data, offset, strides)
        out[...] = values
        return out


def _make_transform(matrix: NDArray[Any]) -> RigidTransform:
    """Create transforms from matrices without SciPy's normalization, which would change their values."""
    rotation = matrix[..., :3, :3]
    deviation = np.abs(rotation @ np.swapaxes(rotation, -1, -2) - np.eye(3)).max(initial=0.0)
    if (
        matrix.ndim not in (2, 3)
        or not deviation < ORTHOGONALITY_TOLERANCE
        or not (matrix[..., 3, :] == [0, 0, 0, 1]).all()
    ):
        raise ValueError("not a rigid transform")
    return RigidTransform(matrix, normalize=False)


def _make_rotation(quaternions: NDArray[Any]) -> Rotation:
    if not np.abs(np.linalg.norm(quaternions, axis=-1) - 1.0).max(initial=0.0) < ORTHOGONALITY_TOLERANCE:
        raise ValueError("not a unit quaternion")
    return Rotation(quaternions, normalize=False)


def _make_scalar(array: NDArray[Any]) -> Any:
    if array.ndim:
        raise ValueError("not a single number")
    return array[()]


_CONSTRUCTORS: dict[str, Callable[[Any], Any]] = {
    "pose": _make_transform,
    "rotation": _make_rotation,
    "scalar": _make_scalar,
}
