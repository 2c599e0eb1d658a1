"""XFeat: the network in OpenCV equals a direct implementation, and invalid weights are rejected."""

from __future__ import annotations

import pickle
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.ndimage import correlate

from benchmarks.xfeat import CELL, EPSILON, build_onnx_model, match_xfeat, read_weights
from sylpose.features.sift import Features
from sylpose.geometry.arrays import FloatArray

SIZE = (64, 96)
LAYERS = {
    "block1": [(1, 4, 3), (4, 8, 3), (8, 8, 3), (8, 24, 3)],
    "block2": [(24, 24, 3), (24, 24, 3)],
    "block3": [(24, 64, 3), (64, 64, 3), (64, 64, 1)],
    "block4": [(64, 64, 3)] * 3,
    "block5": [(64, 128, 3), (128, 128, 3), (128, 128, 3), (128, 64, 1)],
    "block_fusion": [(64, 64, 3), (64, 64, 3)],
    "heatmap_head": [(64, 64, 1), (64, 64, 1)],
    "keypoint_head": [(64, 64, 1)] * 3,
}
PLAIN = {"skip1.1": (1, 24), "block_fusion.2": (64, 64), "heatmap_head.2": (64, 1), "keypoint_head.3": (64, 65)}


@pytest.fixture(scope="module")
def weights() -> dict[str, Any]:
    rng, out = np.random.default_rng(0), {}
    for block, layers in LAYERS.items():
        for i, (n, m, size) in enumerate(layers):
            name = f"{block}.{i}.layer"
            out[f"{name}.0.weight"] = rng.normal(0, np.sqrt(2 / (n * size**2)), (m, n, size, size)).astype(np.float32)
            out[f"{name}.1.running_mean"] = rng.normal(0, 0.1, m).astype(np.float32)
            out[f"{name}.1.running_var"] = rng.uniform(0.5, 2, m).astype(np.float32)
    for name, (n, m) in PLAIN.items():
        out[f"{name}.weight"] = rng.normal(0, n**-0.5, (m, n, 1, 1)).astype(np.float32)
        out[f"{name}.bias"] = rng.normal(0, 0.1, m).astype(np.float32)
    return out


def naive(w: dict[str, Any], image: FloatArray) -> dict[str, FloatArray]:
    """Evaluate the network directly, as its authors define it."""

    def conv(x: FloatArray, weight: FloatArray, stride: int = 1) -> FloatArray:
        full = [sum(correlate(x[i], kernel, mode="constant") for i, kernel in enumerate(kernels)) for kernels in weight]
        return np.asarray(np.array(full)[:, ::stride, ::stride])

    def layer(x: FloatArray, name: str, stride: int = 1) -> FloatArray:
        y = conv(x, w[f"{name}.layer.0.weight"], stride)
        mean, variance = (w[f"{name}.layer.1.running_{part}"][:, None, None] for part in ("mean", "var"))
        return np.asarray(np.maximum((y - mean) / np.sqrt(variance + EPSILON), 0))

    def plain(x: FloatArray, name: str) -> FloatArray:
        return np.asarray(conv(x, w[f"{name}.weight"]) + w[f"{name}.bias"][:, None, None])

    def layers(x: FloatArray, block: str, strides: tuple[int, ...]) -> FloatArray:
        for i, stride in enumerate(strides):
            x = layer(x, f"{block}.{i}", stride)
        return x

    def wide(x: FloatArray, like: FloatArray) -> FloatArray:
        size = like.shape[:0:-1]
        return np.array([cv2.resize(m, size, interpolation=cv2.INTER_LINEAR) for m in x])

    height, width = image.shape
    blocks = image.reshape(height // 4, 4, width // 4, 4).mean(axis=(1, 3))
    x2 = layers(layers(image[None], "block1", (1, 2, 1, 2)) + plain(blocks[None], "skip1.1"), "block2", (1, 1))
    x3 = layers(x2, "block3", (2, 1, 1))
    x4 = layers(x3, "block4", (2, 1, 1))
    x5 = layers(x4, "block5", (2, 1, 1, 1))
    looks = plain(layers(x3 + wide(x4, x3) + wide(x5, x3), "block_fusion", (1, 1)), "block_fusion.2")
    reliable = 1 / (1 + np.exp(-plain(layers(looks, "heatmap_head", (1, 1)), "heatmap_head.2")))
    fields = image.reshape(height // CELL, CELL, width // CELL, CELL).transpose(1, 3, 0, 2)
    keys = plain(
        layers(fields.reshape(-1, *looks.shape[1:]), "keypoint_head", (1, 1, 1)),
        "keypoint_head.3",
    )
    return {"looks": looks, "keys": keys, "reliable": reliable}


def test_network_equals_direct_implementation(weights: dict[str, Any]) -> None:
    image = np.random.default_rng(1).normal(size=SIZE)
    net = cv2.dnn.readNetFromONNX(np.frombuffer(build_onnx_model(weights, *SIZE), np.uint8))
    net.setInput(image[None, None].astype(np.float32), "image")
    expected = naive(weights, image)
    for name, found in zip(expected, net.forward(list(expected)), strict=True):
        np.testing.assert_allclose(found[0], expected[name], atol=1e-3 * np.abs(expected[name]).max())


def test_invalid_weights_are_rejected(tmp_path: Path) -> None:
    text, other, code = tmp_path / "text", tmp_path / "other", tmp_path / "code"
    text.write_text("weights")
    with zipfile.ZipFile(other, "w") as archive:
        archive.writestr("a/b", "c")
    with zipfile.ZipFile(code, "w") as archive:
        archive.writestr("a/data.pkl", pickle.dumps(Path))
    for path in (text, other, code):
        with pytest.raises(ValueError, match=f"{path.name}: no weights"):
            read_weights(path)


def test_matches_are_mutual_and_similar() -> None:
    looks = np.eye(4, 64, dtype=np.float32)
    pixels = np.zeros((4, 2))
    a = Features(pixels, pixels, looks)
    b = Features(pixels, pixels, looks[[2, 0, 1, 1]])
    assert match_xfeat(a, b).tolist() == [[0, 1], [1, 2], [2, 0]]
    assert match_xfeat(a, Features.empty()).shape == (0, 2)
