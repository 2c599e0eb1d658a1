"""Objects as data, and back to the same bits: of a fixed list of kinds, and nothing else.

What is written is a table of entries (MessagePack), then the numbers of all arrays as they are in memory. An entry is the
name of a kind and its values; a value is a number, a word, or the number of an earlier entry, so that what is shared stays
shared and nothing goes in circles. Reading makes objects of the kinds that are listed and looks at the types and shapes of
their fields; no word in the data can name anything else.
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

from sylpose.geometry.future import Later
from sylpose.geometry.record_validation import Shapes, check_shapes, fields_of, typed

__all__ = ["Kind", "decoded", "encoded"]

# Types of numbers that arrays may have: little-endian on all machines that NumPy has wheels for.
_DTYPE = re.compile(r"[|<][biuf][1248]")
# Bytes of memory that arrays which are no blocks may reach over, all together: the numbers in the file are bounded by its
# length, these are not (choice).
MOST_SPREAD = 1 << 30
# Rotations differ from orthogonal matrices by rounding only (choice).
ORTHOGONAL = 1e-6
_SCALARS = (bool, int, float, str)


@dataclass(frozen=True)
class Kind:
    """A kind of objects.

    Attributes:
        type: of the objects.
        shapes: of its arrays, by field.
        fields: names and types; None: those of a dataclass or a named tuple.
        plain: whether its attributes are set, as in a class whose constructor makes them of something else.
        check: raises ValueError for objects that cannot be.
    """

    type: type[Any]
    shapes: Shapes = field(default_factory=dict)
    fields: Mapping[str, Any] | None = None
    plain: bool = False
    check: Callable[[Any], None] | None = None

    def all_fields(self) -> Sequence[tuple[str, Any]]:
        return fields_of(self.type) if self.fields is None else list(self.fields.items())

    def made(self, values: Sequence[Any]) -> Any:
        """Raises TypeError, ValueError: these values are not its fields'."""
        named = {name: typed(hint, v) for (name, hint), v in zip(self.all_fields(), values, strict=True)}
        if self.plain:
            out = object.__new__(self.type)
            vars(out).update(named)
        else:
            out = self.type(**named)
        check_shapes(out, self.shapes)
        if self.check is not None:
            self.check(out)
        return out


def encoded(value: object, kinds: Mapping[str, Kind], functions: Mapping[str, Callable[..., Any]]) -> list[Any]:
    """The table and the arrays' numbers, to be written one after the other.

    Args:
        kinds: by their names; functions: whose values may be awaited (`geometry.future`).

    Raises:
        TypeError: something of another kind.
    """
    writer = _Writer({kind.type: (name, kind) for name, kind in kinds.items()}, {f: n for n, f in functions.items()})
    root = writer.put(value)
    return [msgspec.msgpack.encode([root, writer.entries]), *writer.blocks]


def decoded(
    data: memoryview, length: int, hint: Any, kinds: Mapping[str, Kind], functions: Mapping[str, Callable[..., Any]]
) -> Any:
    """The inverse of `encoded`, of a type.

    Args:
        length: of the table, bytes; the rest are the arrays' numbers.

    Raises:
        ValueError: this is no such thing.
    """
    try:
        root, entries = msgspec.msgpack.decode(data[:length], type=tuple[Any, list[list[Any]]])
        reader = _Reader(kinds, functions, data[length:])
        for entry in entries:
            reader.found.append(reader.read(entry))
        if len(reader.rest):
            raise ValueError("more numbers than arrays have")
        return typed(hint, reader.value(root))
    except (msgspec.MsgspecError, RecursionError, TypeError, KeyError, IndexError, OverflowError, MemoryError) as error:
        raise ValueError(f"{type(error).__name__}: {error}") from None


class _Writer:
    def __init__(
        self, kinds: Mapping[type[Any], tuple[str, Kind]], functions: Mapping[Callable[..., Any], str]
    ) -> None:
        self._kinds, self._functions = kinds, functions
        self.entries: list[list[Any]] = []
        self.blocks: list[Any] = []
        self._known: dict[int, int] = {}
        self._kept: list[object] = []  # a number of an object is its own only as long as that lives

    def put(self, value: Any) -> Any:
        """A value as it stands in an entry: a list of one number is the entry of that number."""
        if value is None or type(value) in _SCALARS:
            return value
        if isinstance(value, Enum):
            return value.value
        number = self._known.get(id(value))
        if number is None:
            entry = self._entry(value)
            number = self._known[id(value)] = len(self.entries)
            self._kept.append(value)
            self.entries.append(entry)
        return [number]

    def _entry(self, value: Any) -> list[Any]:
        kind = type(value)
        if kind is np.ndarray:
            return self._array(value)
        if kind in self._kinds:
            name, its = self._kinds[kind]
            return [name, *(self.put(getattr(value, field)) for field, _ in its.all_fields())]
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
        if kind is Later:
            function, arguments = value.asked
            return ["later", self._functions[function], *map(self.put, arguments)]
        raise TypeError(f"{kind.__name__} is no data")

    def _array(self, value: NDArray[Any]) -> list[Any]:
        """With its layout in memory, since sums over other layouts are added up in other orders."""
        if not _DTYPE.fullmatch(value.dtype.str):
            raise TypeError(f"an array of {value.dtype} is no data")
        self.blocks.append(np.ascontiguousarray(value).reshape(-1).view(np.uint8).data)
        strides = None if value.flags.c_contiguous else list(value.strides)
        return ["array", value.dtype.str, list(value.shape), strides, value.flags.writeable]


class _Reader:
    def __init__(
        self, kinds: Mapping[str, Kind], functions: Mapping[str, Callable[..., Any]], rest: memoryview
    ) -> None:
        self._kinds, self._functions, self.rest = kinds, functions, rest
        self.found: list[Any] = []
        self._spread = 0

    def value(self, value: Any) -> Any:
        if value is None or type(value) in _SCALARS:
            return value
        (number,) = value
        if type(number) is not int or not 0 <= number < len(self.found):
            raise ValueError("an entry that is not there")
        return self.found[number]

    def read(self, entry: Sequence[Any]) -> Any:
        """The object of an entry; Raises what `decoded` catches."""
        name, *values = entry
        if name == "array":
            return self._array(*values)
        if name == "later":
            return self._later(values[0], [self.value(value) for value in values[1:]])
        content = [self.value(value) for value in values]
        if name in ("list", "tuple"):
            return content if name == "list" else tuple(content)
        if name == "dict":
            return dict(zip(content[::2], content[1::2], strict=True))
        if name in ("pose", "rotation", "scalar"):
            (numbers,) = content
            return _READ[name](typed(np.ndarray if name == "scalar" else NDArray[np.float64], numbers))
        return self._kinds[name].made(content)

    def _later(self, name: str, arguments: Sequence[Any]) -> Later[Any]:
        function = self._functions[name]
        hints = [hint for name, hint in get_type_hints(function).items() if name != "return"]
        return Later(function, *(typed(hint, v) for hint, v in zip(hints, arguments, strict=True)))

    def _array(self, dtype: str, shape: list[int], strides: list[int] | None, writeable: bool) -> NDArray[Any]:
        """An array, not a view of another one."""
        if not _DTYPE.fullmatch(dtype) or not all(type(n) is int and n >= 0 for n in shape) or len(shape) > 8:
            raise ValueError("an array of something else than numbers")
        kind = np.dtype(dtype)
        size = kind.itemsize
        for n in shape:  # whole numbers of Python: they have no end
            size *= n
        if size > len(self.rest):
            raise ValueError("fewer numbers than arrays have")
        values = np.frombuffer(self.rest[:size], kind).reshape(shape)
        self.rest = self.rest[size:]
        if kind.kind == "b":  # rows that are not used yet may have anything; more than 1 is no truth value
            values = values.view(np.uint8) != 0
        out = values.copy() if strides is None else self._laid_out(values, strides)
        out.setflags(write=bool(writeable))
        return out

    def _laid_out(self, values: NDArray[Any], strides: list[int]) -> NDArray[Any]:
        """With these strides, in bytes."""
        if not all(type(step) is int for step in strides):
            raise ValueError("no steps in memory")
        reach = [max(n - 1, 0) * step for n, step in zip(values.shape, strides, strict=True)]
        before = -sum(min(r, 0) for r in reach)
        size = before + sum(max(r, 0) for r in reach) + values.itemsize
        self._spread += size
        if self._spread > MOST_SPREAD or any(step % values.itemsize for step in strides):
            raise ValueError("arrays that reach too far")
        out: NDArray[Any] = np.ndarray(values.shape, values.dtype, np.zeros(size, np.uint8).data, before, strides)
        out[...] = values
        return out


def _pose(matrix: NDArray[Any]) -> RigidTransform:
    """To the last bit: SciPy would normalise it."""
    about = matrix[..., :3, :3]
    off = np.abs(about @ np.swapaxes(about, -1, -2) - np.eye(3)).max(initial=0.0)
    if matrix.ndim not in (2, 3) or not off < ORTHOGONAL or not (matrix[..., 3, :] == [0, 0, 0, 1]).all():
        raise ValueError("no pose")
    return RigidTransform(matrix, normalize=False)


def _rotation(quaternions: NDArray[Any]) -> Rotation:
    if not np.abs(np.linalg.norm(quaternions, axis=-1) - 1.0).max(initial=0.0) < ORTHOGONAL:
        raise ValueError("no rotation")
    return Rotation(quaternions, normalize=False)


def _scalar(array: NDArray[Any]) -> Any:
    if array.ndim:
        raise ValueError("no single number")
    return array[()]


_READ: dict[str, Callable[[Any], Any]] = {"pose": _pose, "rotation": _rotation, "scalar": _scalar}
