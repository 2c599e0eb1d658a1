"""Arguments of other shapes are rejected by name, never reshaped."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sylpose import Matches
from sylpose.geometry.validation import check_finite_rows, check_rows
from sylpose.simulate import ring

GOOD = np.linspace(-0.1, 0.1, 24).reshape(12, 2)
WRONG: dict[str, tuple[Any, str]] = {
    "transposed": (GOOD.T, r"\(n, 2\), got shape \(2, 12\)"),
    "homogeneous": (np.column_stack([GOOD, np.ones(12)]), r"got shape \(12, 3\)"),
    "OpenCV's": (GOOD[:, None], r"got shape \(12, 1, 2\)"),
    "columns": (GOOD[:, :, None], r"got shape \(12, 2, 1\)"),
    "flat": (GOOD.ravel(), r"got shape \(24,\)"),
    "complex": (GOOD + 0j, "real numbers, got complex128"),
    "objects": (GOOD.astype(object), "real numbers, got object"),
    "words": ([["a", "b"]], "real numbers"),
    "ragged": ([[1.0, 2.0], [1.0]], "different lengths"),
    "nan": (np.where(np.eye(12, 2), np.nan, GOOD), "not finite"),
    "inf": (np.where(np.eye(12, 2), np.inf, GOOD), "not finite"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_matches_are_never_reshaped(wrong: str) -> None:
    array, message = WRONG[wrong]
    with pytest.raises(ValueError, match=f"matches: x.*{message}"):
        Matches(array, GOOD)
    with pytest.raises(ValueError, match=f"matches: y.*{message}"):
        Matches(GOOD, array)
    camera = ring(1).cameras[0]
    with pytest.raises(ValueError, match=f"pixels_i.*{message}"):
        Matches.from_pixels(camera, array, GOOD)
    with pytest.raises(ValueError, match=f"pixels_j.*{message}"):
        Matches.from_pixels(camera, GOOD, array)


@pytest.mark.parametrize("wrong", [w for w in WRONG if w not in ("nan", "inf")])
def test_cameras_never_reshape(wrong: str) -> None:
    camera, array = ring(1).cameras[0], WRONG[wrong][0]
    for function, name in ((camera.normalize, "pixels"), (camera.denormalize, "normalized"), (camera.rays, "pixels")):
        with pytest.raises(ValueError, match=name):
            function(array)
    with pytest.raises(ValueError, match="points"):
        camera.project(GOOD)
    assert camera.project([0.0, 0.0, 0.1]).shape == (1, 2)


def test_valid_shapes_are_accepted() -> None:
    shapes: list[Any] = [[], np.empty((0, 2)), np.empty((0, 3))]
    for empty in shapes:
        assert check_rows(empty, 2, "a").shape == (0, 2)
    assert check_rows([[1, 2]], 2, "a").dtype == float
    assert check_finite_rows(GOOD, 2, "a") is GOOD
    assert Matches(GOOD, GOOD).x is not GOOD
