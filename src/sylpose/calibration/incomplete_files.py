"""Files of a format without what makes it a calibration: told by less than readers ask for, named with what is missing.

They are asked only about files that no format tells, so that nothing which can be read depends on them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from typing import Any

from sylpose.calibration.native import FORMAT

__all__ = ["unfinished"]

_CAMERA_OF_CHAIN = re.compile(r"cam\d+")
_STEREO = re.compile(
    r"(?:M|K|A|CM|mtx|camera_?matrix|D|dist|dist_?coeffs?|distortions?|R|T|P)_?(?:\d+|left|right|l|r)|[RTQEF]|rotation|translation",
    re.IGNORECASE,
)
_ANIPOSE = {"size", "matrix", "distortions", "rotation", "translation"}
_NERF = {"camera_angle_x", "fl_x", "frames", "aabb_scale"}
_MATLAB = {"CameraParameters1", "CameraParameters2", "PoseCamera2", "RotationOfCamera2", "RadialDistortion"}
_ROS = {"transforms", "child_frame_id", "distortion_model", "rectification_matrix", "projection_matrix"}


def unfinished(kind: str, data: Any) -> str | None:
    """The format that a file seems to be of, and what is missing in it; None where nothing tells.

    Args:
        kind, data: as `content.Content` has them.
    """
    return next((f"{name}, without {lacks}" for name, lacks, has in _SIGNS.get(kind, ()) if has(data)), None)


def _keys(data: Any) -> set[str]:
    return {str(key) for key in data} if isinstance(data, dict) else set()


def _nodes(data: Any) -> Iterator[tuple[str, dict[str, Any]]]:
    """What is a map in a map, by its name."""
    return ((str(k), v) for k, v in data.items() if isinstance(v, dict)) if isinstance(data, dict) else iter(())


def _any_key(*begins: str) -> Callable[[Any], bool]:
    return lambda data: any(key.startswith(begins) for key in _keys(data))


def _has(names: set[str]) -> Callable[[Any], bool]:
    return lambda data: bool(names & _keys(data))


def _is_chain(data: Any) -> bool:
    return any(_CAMERA_OF_CHAIN.fullmatch(name) for name in _keys(data)) or {"camera_model", "intrinsics"} <= _keys(
        data
    )


def _is_rig_config(data: Any) -> bool:
    return isinstance(data, list) and any("cameras" in _keys(rig) for rig in data)


def _is_stereo(data: Any) -> bool:
    return any(_STEREO.fullmatch(key) for key in _keys(data))


# What of a file tells its format, those that tell more before those that tell less; what such a file needs that others of it
# have; whether it is one.
_SIGNS: dict[str, tuple[tuple[str, str, Callable[[Any], bool]], ...]] = {
    "toml": (
        ("sylpose TOML", f'format = "{FORMAT}"', lambda data: isinstance(data.get("cameras"), dict)),
        (
            "Anipose TOML",
            "a table for each camera with size, matrix, distortions, rotation and translation",
            lambda data: "metadata" in data or any(_ANIPOSE & table.keys() for _, table in _nodes(data)),
        ),
    ),
    "plain": (
        ("COLMAP rig_config", "a camera with an image_prefix", _is_rig_config),
        ("NeRF transforms", "frames with a transform_matrix each", _has(_NERF)),
        (
            "Matlab stereoParameters",
            "CameraParameters1 and CameraParameters2 (with IntrinsicMatrix or K, and RadialDistortion)",
            _has(_MATLAB),
        ),
        (
            "JARVIS",
            "both of intrinsicMatrix and distortionCoefficients",
            _has({"intrinsicMatrix", "distortionCoefficients"}),
        ),
        ("EasyMocap", "names together with K_ and dist_, or R_ and T_, of each", _any_key("K_", "Rot_", "dist_")),
        ("EasyMocap", "K_ and dist_, or R_ and T_, of the cameras in names", _has({"names"})),
        ("ROS", "a transform, or all of a camera_info: K, P, distortion_model, width and height", _has(_ROS)),
        ("Kalibr camchain", "camera_model and a row of intrinsics for each camera", _is_chain),
        ("OpenCV stereo", "M1 D1 and M2 D2, the lenses of two cameras, and R and T between them", _is_stereo),
    ),
    "xml": (
        ("Qualisys", "a camera in cameras", lambda root: root.tag == "calibration"),
        ("Vicon", "a Camera", lambda root: root.tag == "Cameras"),
        (
            "OptiTrack",
            "a Camera with its Extrinsic",
            lambda root: root.tag.lower() == "calibrationprofile" or next(root.iter("Camera"), None) is not None,
        ),
        ("Metashape XML", "a chunk with sensors and cameras", lambda root: root.tag == "document"),
    ),
}
