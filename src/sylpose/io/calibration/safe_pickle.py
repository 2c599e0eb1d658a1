"""Safe reader of pickles with dicts, lists, tuples, strings, numbers and NumPy arrays, without executing their content.

The only callables a pickle may name are those of NumPy's arrays and numbers, replaced by the stand-ins below; any
other name aborts the reading. NumPy is only called with an array's bytes, dtype and shape.
"""

from __future__ import annotations

import io
import pickle
import pickletools
import re
from typing import Any

import numpy as np

from sylpose.input_limits import to_one_line

# Numeric dtypes, as NumPy spells them: f8, <i4, ...
_TYPE = re.compile("[<>=|]?([fiub][1248])")
# Opcodes of protocols up to 5 that build, store and fetch values; none calls anything other than the names in
# `_Unpickler`. Left out are those for persistent objects, extensions, buffers, sets and instances of classes.
_OPCODES = {opcode.name for opcode in pickletools.opcodes if opcode.proto <= 5} - {
    *("PERSID", "BINPERSID", "EXT1", "EXT2", "EXT4", "NEXT_BUFFER", "READONLY_BUFFER", "EMPTY_SET", "ADDITEMS"),
    *("FROZENSET", "INST", "OBJ", "NEWOBJ", "NEWOBJ_EX"),
}


def load_safely(data: bytes) -> Any:
    """Load a pickle; arrays become float64.

    Raises:
        ValueError: not a pickle, or, by name, content other than numbers, strings, dicts, lists and arrays.
    """
    problem = ""
    try:
        for opcode, argument, _ in pickletools.genops(data):
            if opcode.name not in _OPCODES:
                problem = problem or f"a pickle with the opcode {opcode.name}, which numbers and arrays do not need"
            elif opcode.name in ("PUT", "LONG_BINPUT") and not 0 <= int(argument or 0) <= len(data):
                problem = problem or "a pickle with invalid memo indices"
        if problem:
            raise _UnsafePickleError(problem)
        return _Unpickler(io.BytesIO(data)).load()
    except _UnsafePickleError:
        raise
    except RecursionError:
        raise
    except Exception as error:  # malformed bytes can raise any exception
        raise ValueError(f"not a pickle of numbers and arrays ({type(error).__name__})") from None


class _UnsafePickleError(ValueError):
    """Content that is not allowed in a pickle."""


class _NumericType:
    """Numeric dtype of an array."""

    def __init__(self, name: Any, *_: Any) -> None:
        if not isinstance(name, str) or not (match := _TYPE.fullmatch(name)):
            raise _UnsafePickleError(f"a pickle with an array of {to_one_line(repr(name), 40)} instead of numbers")
        self.name = match[1]
        self.order = "<"

    def __setstate__(self, state: Any) -> None:
        self.order = ">" if isinstance(state, tuple) and len(state) > 1 and state[1] == ">" else "<"

    def numbers(self, raw: Any) -> Any:
        if not isinstance(raw, bytes):
            raise _UnsafePickleError("a pickle with an array without data")
        # A single byte has no order.
        return np.frombuffer(raw, self.order + self.name).astype(float)


class _Array:
    """Array under construction; `value` is set at the end."""

    value: Any = None

    def __setstate__(self, state: Any) -> None:
        _, shape, kind, by_columns, raw = state
        if not isinstance(kind, _NumericType) or not all(isinstance(n, int) and n >= 0 for n in shape):
            raise _UnsafePickleError("a pickle with an array without shape or type")
        self.value = kind.numbers(raw).reshape(shape, order="F" if by_columns else "C")


def _array(*_: Any) -> _Array:
    return _Array()


def _scalar(kind: Any, raw: Any) -> float:
    if not isinstance(kind, _NumericType):
        raise _UnsafePickleError("a pickle with a number without type")
    return float(kind.numbers(raw)[0])


def _from_buffer(raw: Any, kind: Any, shape: Any, order: Any) -> _Array:
    array = _Array()
    array.__setstate__((1, shape, kind, order == "F", bytes(raw)))
    return array


def _encode_latin1(text: Any, encoding: Any = "latin1") -> bytes:
    """Return the bytes of a Python 2 string, as protocols below 3 store them."""
    if not isinstance(text, str) or encoding != "latin1":
        raise _UnsafePickleError("a pickle with encoded strings")
    return text.encode("latin1")


_REPLACEMENTS: dict[str, Any] = {"_codecs.encode": _encode_latin1}
for _core in ("numpy.core", "numpy._core"):
    _REPLACEMENTS[f"{_core}.multiarray._reconstruct"] = _array
    _REPLACEMENTS[f"{_core}.multiarray.scalar"] = _scalar
    _REPLACEMENTS[f"{_core}.numeric._frombuffer"] = _from_buffer
_REPLACEMENTS["numpy.dtype"] = _NumericType
# Named, but never called: the type argument of `_reconstruct`.
_REPLACEMENTS["numpy.ndarray"] = "numpy.ndarray"


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str, /) -> Any:
        full = f"{module}.{name}"
        if full not in _REPLACEMENTS:
            raise _UnsafePickleError(f"a pickle that refers to {to_one_line(full, 60)}, which is not allowed")
        return _REPLACEMENTS[full]
