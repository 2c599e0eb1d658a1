"""Programs with a node per camera in OpenCV's terms, but their own keys and poses: MC-Calib and CMU Panoptic.

- MC-Calib: calibrated_cameras_data.yml with camera_0, camera_1, ... `camera_pose_matrix` is world_from_camera, in the
  board's unit; `distortion_type` is 0 for OpenCV's standard lens, 1 for its fisheye. Poses of cameras of different
  `camera_group` are not related.
- CMU Panoptic: calibration_SEQUENCE.json, a list `cameras` with `distCoef`; X_camera = R X_world + t in centimeters.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sylpose.io.calibration import filestorage
from sylpose.io.calibration.camera_builder import CameraEntry, SizeLookup
from sylpose.rig import Rig

_POSE, _LENS_TYPE, _GROUP = "camera_pose_matrix", "distortion_type", "camera_group"


def is_mc_calib(data: Any) -> bool:
    """Return whether a decoded file has nodes with MC-Calib's poses."""
    return isinstance(data, dict) and any(isinstance(node, dict) and _POSE in node for node in data.values())


def read_mc_calib(data: dict[str, Any], path: Path, sizes: SizeLookup | None = None) -> Rig:
    """Read the rig; cameras are named camera_0, camera_1, ..., as in the file.

    Raises:
        ValueError: cameras of several groups; otherwise as `filestorage.read`.
    """
    nodes = {name: node for name, node in data.items() if isinstance(node, dict) and "camera_matrix" in node}
    groups: dict[Any, list[str]] = {}
    cameras = {}
    for name, node in nodes.items():
        entry = CameraEntry(path, name)
        groups.setdefault(str(node.get(_GROUP)), []).append(name)
        if (lens_type := node.get(_LENS_TYPE, 0.0)) not in (0, 1):
            raise entry.error(f"{_LENS_TYPE} must be 0 (standard) or 1 (fisheye), got {lens_type!r}")
        if node.get(_POSE) is None:
            raise entry.error(f"missing {_POSE!r}")
        kept = {key: value for key, value in node.items() if key not in (_POSE, _LENS_TYPE, _GROUP)}
        cameras[name] = kept | {"fisheye": float(lens_type), "world_from_camera": node[_POSE]}
    if len(groups) > 1:
        names = " and ".join(", ".join(group) for group in groups.values())
        raise ValueError(f"{path}: MC-Calib found no pose between its {len(groups)} groups of cameras, {names}")
    return filestorage.read({"cameras": cameras}, path, sizes)


def is_panoptic(data: Any) -> bool:
    """Return whether decoded JSON has a list of cameras with CMU Panoptic's distCoef."""
    cameras = data.get("cameras") if isinstance(data, dict) else None
    return isinstance(cameras, list) and any(
        isinstance(camera, dict) and {"K", "distCoef"} <= camera.keys() for camera in cameras
    )


def read_panoptic(data: dict[str, Any], path: Path, sizes: SizeLookup | None = None) -> Rig:
    """Read the rig; lengths are centimeters.

    Raises:
        ValueError: as `filestorage.read`.
    """
    return filestorage.read({"unit": "cm"} | data, path, sizes)
