"""Poses as lines of JSON, for whoever listens while they are found."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np

from sylpose.geometry.arrays import IntArray
from sylpose.results import FramePose

__all__ = ["pose_line"]


def pose_line(pose: FramePose, camera_names: Sequence[str], unit: str, **more: object) -> str:
    """A frame as one line of JSON, without its end: see docs/formats.md, "Lines of JSON".

    Args:
        camera_names: (C,) in the order of `FramePose.inliers`.
        unit: of lengths, or "".
        more: fields that come first.
    """
    place = pose.world_from_object
    said = {
        **more,
        "frame": pose.index,
        "time": pose.time,
        "status": pose.status.value,
        "observability": pose.observable.value,
        "position": None if place is None else pose.position.tolist(),
        "quaternion": None if place is None else place.rotation.as_quat().tolist(),
        "sigma_deg": [_number_or_none(np.degrees(s)) for s in pose.sigma[:3]],
        "sigma_position": [_number_or_none(s) for s in pose.sigma[3:]],
        "unit": unit,
        "inliers": _by_camera(camera_names, pose.inliers),
        "matches": _by_camera(camera_names, pose.matches),
        "faults": list(pose.faults),
        "reason": pose.reason,
    }
    return json.dumps(said)


def _by_camera(names: Sequence[str], counts: IntArray) -> dict[str, int]:
    """Nothing where they are not known."""
    return {name: int(n) for name, n in zip(names, counts, strict=True)} if len(counts) else {}


def _number_or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
