"""Reader of named variables in Matlab files of version 7.3, which are HDF5; it needs h5py (extra `matlab`).

Arrays are stored transposed; cells as arrays of references; structs as groups, and struct arrays as groups of arrays of
references; text as numbers. The class of a value is in its attribute MATLAB_class.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sylpose.input_limits import MAX_DEPTH

# Maximum number of elements of an array, cell or struct (choice: a hundred times those of parameters of cameras).
MAX_ELEMENTS = 100_000


def read_hdf5_variables(path: Path, names: Sequence[str]) -> dict[str, Any]:
    """Return those of the variables that exist, as `matlab_format.read_variables`; large arrays as None.

    Raises:
        ValueError: h5py is not installed, or the file is not HDF5, or damaged.
    """
    try:
        import h5py
    except ModuleNotFoundError:
        raise ValueError(
            "a Matlab file of version 7.3 (HDF5), which needs h5py: pip install 'sylpose[matlab]'; or save it with '-v7'"
        ) from None
    try:
        with h5py.File(path, "r") as file:
            # Only values in the file itself: links may lead to other files.
            found = {name: file.get(name, getlink=True) for name in names}
            return {
                name: _convert(file[name], file, h5py, 0)
                for name, link in found.items()
                if isinstance(link, h5py.HardLink)
            }
    except (OSError, RuntimeError, KeyError, TypeError, AttributeError, ValueError) as error:
        raise ValueError(f"not a valid Matlab file of version 7.3 ({type(error).__name__})") from None


def _convert(node: Any, file: Any, h5py: Any, depth: int) -> Any:
    if depth > MAX_DEPTH:
        raise ValueError("values are nested too deep")
    kind = node.attrs.get("MATLAB_class", b"")
    if isinstance(node, h5py.Group):
        if len(node) > MAX_ELEMENTS or any(not isinstance(node.get(key, getlink=True), h5py.HardLink) for key in node):
            raise ValueError("a struct with links or too many fields")
        fields = {str(key): _convert(child, file, h5py, depth + 1) for key, child in node.items()}
        # The fields of a struct array are references, which have no class.
        if fields and all("MATLAB_class" not in child.attrs for child in node.values()):
            return [dict(zip(fields, values, strict=True)) for values in zip(*fields.values(), strict=True)]
        return fields
    if node.size is None or node.size > MAX_ELEMENTS or node.external or node.is_virtual:
        return None
    if "MATLAB_empty" in node.attrs:
        return [] if kind == b"cell" else np.zeros(0)
    values = node[()]
    if h5py.check_ref_dtype(node.dtype) is not None:
        return [_convert(file[reference], file, h5py, depth + 1) for reference in np.ravel(values)]
    if kind == b"char":
        return "".join(map(chr, np.ravel(values).tolist()))
    return np.asarray(values, dtype=float).T
