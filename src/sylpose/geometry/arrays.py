"""Array types of all signatures; shapes are given in docstrings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
# (h, w) gray or (h, w, 3) BGR.
Image = NDArray[np.uint8]
FloatImage = NDArray[np.float32]
