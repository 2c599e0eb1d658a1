"""Poses as JSON lines, for streaming."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np

from sylpose.geometry.arrays import IntArray
from sylpose.results import FramePose

__all__ = ["format_pose_line"]


def format_pose_line(pose: FramePose, camera_names: Sequence[str], unit: str, **extra_fields: object) -> str:
    """Format a frame as one line of JSON without line end: see docs/formats.md, "Lines of JSON".

    Args:
        pose: the frame's pose.
        camera_names: (C,) in the order of `FramePose.inliers`.
        unit: unit of lengths, or "".
        extra_fields: fields that come first.
    """
    transform = pose.world_from_object
    fields = {
        **extra_fields,
        "frame": pose.index,
        "time": pose.time,
        "status": pose.status.value,
        "observability": pose.observability.value,
        "position": None if transform is None else pose.position.tolist(),
        "quaternion": None if transform is None else transform.rotation.as_quat().tolist(),
        "sigma_deg": [_number_or_none(np.degrees(s)) for s in pose.sigma[:3]],
        "sigma_position": [_number_or_none(s) for s in pose.sigma[3:]],
        "unit": unit,
        "inliers": _map_by_camera(camera_names, pose.inliers),
        "matches": _map_by_camera(camera_names, pose.matches),
        "faults": list(pose.faults),
        "reason": pose.reason,
    }
    return json.dumps(fields)


def _map_by_camera(names: Sequence[str], counts: IntArray) -> dict[str, int]:
    """Map camera names to counts; empty if the counts are unknown."""
    return {name: int(n) for name, n in zip(names, counts, strict=True)} if len(counts) else {}


def _number_or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
