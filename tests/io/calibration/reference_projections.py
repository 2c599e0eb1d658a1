"""Shared helpers of the calibration format tests: points, and reference projection formulas."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Camera

# No rotation here is symmetric: a transposed one is detected.
TURN: FloatArray = Rotation.from_euler("ZYX", [0.4, -0.3, 0.7]).as_matrix()
OTHER_TURN: FloatArray = Rotation.from_euler("XYZ", [-0.5, 0.2, 1.1]).as_matrix()


def points_in_front(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """Return (20, 3) world points within 30 degrees of the axis of a camera with X_c = turn X + shift that looks along
    z."""
    rng = np.random.default_rng(1)
    z = rng.uniform(2.0, 5.0, 20)
    in_camera = np.column_stack([z * rng.uniform(-0.5, 0.5, 20), z * rng.uniform(-0.4, 0.4, 20), z])
    return np.asarray((in_camera - translation) @ rotation)


def apply_brown(x: float, y: float, k: list[float], p: list[float]) -> tuple[float, float]:
    """Apply Brown's lens model with OpenCV's order of tangential terms to a point on the plane z = 1."""
    r2 = x * x + y * y
    radial = 1.0 + sum(term * r2 ** (i + 1) for i, term in enumerate(k))
    return (
        x * radial + 2 * p[0] * x * y + p[1] * (r2 + 2 * x * x),
        y * radial + p[0] * (r2 + 2 * y * y) + 2 * p[1] * x * y,
    )


def apply_equidistant(x: float, y: float, k: list[float]) -> tuple[float, float]:
    """Apply Kannala and Brandt's lens model to a point on the plane z = 1."""
    r = float(np.hypot(x, y))
    theta = float(np.arctan(r))
    scale = theta * (1 + sum(term * theta ** (2 * i + 2) for i, term in enumerate(k))) / r
    return x * scale, y * scale


def assert_projects(camera: Camera, points: FloatArray, pixel: Callable[[FloatArray], tuple[float, float]]) -> None:
    """Assert that the camera projects points as the format's formulas do, with the first pixel's center at (0, 0)."""
    expected = np.array([pixel(point) for point in points])
    assert np.isfinite(expected).all()
    np.testing.assert_allclose(camera.project(points), expected, atol=1e-9, rtol=0)


def write_file(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path
