"""Pickles of numbers, read without anything in them being run: dicts, lists, tuples, words, numbers and NumPy's arrays.

The names that a pickle may call are those of NumPy's arrays and numbers, and they are answered by stand-ins below; every
other name ends the reading. NumPy's own functions are called with the bytes of an array, its type and shape alone.
"""

from __future__ import annotations

import io
import pickle
import pickletools
import re
from typing import Any

import numpy as np

from sylpose.input_limits import one_line

__all__ = ["unpickled"]

# Of numbers, as NumPy spells them: f8, <i4, ...
_TYPE = re.compile("[<>=|]?([fiub][1248])")
# What makes values, and keeps and takes them; no opcode that would call, other than with what is in `_Unpickler`.
_OPCODES = frozenset(
    (
        *("PROTO", "FRAME", "STOP", "MARK", "POP", "POP_MARK", "DUP", "NONE", "NEWTRUE", "NEWFALSE", "INT", "BININT"),
        *(
            "BININT1",
            "BININT2",
            "LONG",
            "LONG1",
            "LONG4",
            "FLOAT",
            "BINFLOAT",
            "STRING",
            "BINSTRING",
            "SHORT_BINSTRING",
        ),
        *(
            "BINBYTES",
            "SHORT_BINBYTES",
            "BINBYTES8",
            "BYTEARRAY8",
            "UNICODE",
            "SHORT_BINUNICODE",
            "BINUNICODE",
            "BINUNICODE8",
        ),
        *("EMPTY_LIST", "APPEND", "APPENDS", "LIST", "EMPTY_TUPLE", "TUPLE", "TUPLE1", "TUPLE2", "TUPLE3"),
        *("EMPTY_DICT", "DICT", "SETITEM", "SETITEMS", "GET", "BINGET", "LONG_BINGET", "PUT", "BINPUT", "LONG_BINPUT"),
        *("MEMOIZE", "GLOBAL", "STACK_GLOBAL", "REDUCE", "BUILD"),
    )
)


def unpickled(data: bytes) -> Any:
    """What is in a pickle; arrays are of float64.

    Raises:
        ValueError: it is none, or has anything but numbers, words, dicts, lists and arrays in it, which is named.
    """
    wrong = ""
    try:
        for opcode, argument, _ in pickletools.genops(data):
            if opcode.name not in _OPCODES:
                wrong = wrong or f"a pickle with {opcode.name} in it, which numbers and arrays do not need"
            elif opcode.name in ("PUT", "LONG_BINPUT") and not 0 <= int(argument or 0) <= len(data):
                wrong = wrong or "a pickle that keeps values in places that it cannot have"
        if wrong:
            raise _Refused(wrong)
        return _Unpickler(io.BytesIO(data)).load()
    except _Refused:
        raise
    except RecursionError:
        raise
    except Exception as error:  # whatever the bytes make of the machine that reads them
        raise ValueError(f"not a pickle of numbers and arrays ({type(error).__name__})") from None


class _Refused(ValueError):
    """What a pickle has in it and may not."""


class _Type:
    """A type of numbers, as an array's `dtype` is kept."""

    def __init__(self, name: Any, *_: Any) -> None:
        if not isinstance(name, str) or not (match := _TYPE.fullmatch(name)):
            raise _Refused(f"a pickle with an array of {one_line(repr(name), 40)}, and not of numbers, in it")
        self.name = match[1]
        self.order = "<"

    def __setstate__(self, state: Any) -> None:
        self.order = ">" if isinstance(state, tuple) and len(state) > 1 and state[1] == ">" else "<"

    def numbers(self, raw: Any) -> Any:
        if not isinstance(raw, bytes):
            raise _Refused("a pickle with an array without its bytes in it")
        # Beside a single byte there is no order.
        return np.frombuffer(raw, self.order + self.name).astype(float)


class _Array:
    """An array that is being read; `value` once it is."""

    value: Any = None

    def __setstate__(self, state: Any) -> None:
        _, shape, kind, by_columns, raw = state
        if not isinstance(kind, _Type) or not all(isinstance(n, int) and n >= 0 for n in shape):
            raise _Refused("a pickle with an array of no shape or type in it")
        self.value = kind.numbers(raw).reshape(shape, order="F" if by_columns else "C")


def _array(*_: Any) -> _Array:
    return _Array()


def _scalar(kind: Any, raw: Any) -> float:
    if not isinstance(kind, _Type):
        raise _Refused("a pickle with a number of no type in it")
    return float(kind.numbers(raw)[0])


def _from_buffer(raw: Any, kind: Any, shape: Any, order: Any) -> _Array:
    array = _Array()
    array.__setstate__((1, shape, kind, order == "F", bytes(raw)))
    return array


def _encoded(text: Any, encoding: Any = "latin1") -> bytes:
    """Bytes, as Python 2 had them and protocols below 3 write them."""
    if not isinstance(text, str) or encoding != "latin1":
        raise _Refused("a pickle with words in an encoding in it")
    return text.encode("latin1")


_STAND_INS: dict[str, Any] = {"_codecs.encode": _encoded}
for _core in ("numpy.core", "numpy._core"):
    _STAND_INS[f"{_core}.multiarray._reconstruct"] = _array
    _STAND_INS[f"{_core}.multiarray.scalar"] = _scalar
    _STAND_INS[f"{_core}.numeric._frombuffer"] = _from_buffer
_STAND_INS["numpy.dtype"] = _Type
# Named, but never called: the type that `_reconstruct` is told.
_STAND_INS["numpy.ndarray"] = "numpy.ndarray"


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str, /) -> Any:
        full = f"{module}.{name}"
        if full not in _STAND_INS:
            raise _Refused(f"a pickle that wants {one_line(full, 60)}, which is not read: it would be run")
        return _STAND_INS[full]
