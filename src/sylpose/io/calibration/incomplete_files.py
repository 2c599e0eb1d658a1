"""Recognition of incomplete calibration files, to report what is missing.

These weaker checks run only on files that no reader accepts, so they cannot affect valid files.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

from sylpose.io.calibration.native import FORMAT_NAME

_ANIPOSE = {"size", "matrix", "distortions", "rotation", "translation"}
_STEREO = (
    r"(?i:(?:M|K|A|CM|mtx|camera_?matrix|D|dist|dist_?coeffs?|distortions?|R|T|P)_?(?:\d+|left|right|l|r)|[RTQEF]|"
    r"rotation|translation)"
)


def describe_incomplete(kind: str, data: Any) -> str | None:
    """Describe the format that a file seems to have and what is missing; None if unrecognized.

    Args:
        kind, data: as in `markup.Content`.
    """
    return next(
        (f"{name}, without {missing}" for name, missing, matches in _INCOMPLETE_FORMATS.get(kind, ()) if matches(data)),
        None,
    )


def _get_keys(data: Any) -> set[str]:
    return {str(key) for key in data} if isinstance(data, dict) else set()


def _has_key(pattern: str) -> Callable[[Any], bool]:
    return lambda data: any(re.fullmatch(pattern, key, re.DOTALL) for key in _get_keys(data))


def _has_camera_table(data: Any) -> bool:
    return any(isinstance(table, dict) and _ANIPOSE & table.keys() for table in data.values())


def _is_chain(data: Any) -> bool:
    return _has_key(r"cam\d+")(data) or {"camera_model", "intrinsics"} <= _get_keys(data)


def _is_rig_config(data: Any) -> bool:
    return isinstance(data, list) and any("cameras" in _get_keys(rig) for rig in data)


# By kind of content, more specific formats first: format name, missing content, and check for the format.
_INCOMPLETE_FORMATS: dict[str, tuple[tuple[str, str, Callable[[Any], bool]], ...]] = {
    "toml": (
        ("sylpose TOML", f'format = "{FORMAT_NAME}"', lambda data: isinstance(data.get("cameras"), dict)),
        (
            "Anipose TOML",
            "a table for each camera with size, matrix, distortions, rotation and translation",
            lambda data: "metadata" in data or _has_camera_table(data),
        ),
    ),
    "plain": (
        ("COLMAP rig_config", "a camera with an image_prefix", _is_rig_config),
        ("NeRF transforms", "frames with a transform_matrix each", _has_key("camera_angle_x|fl_x|frames|aabb_scale")),
        (
            "Matlab stereoParameters",
            "CameraParameters1 and CameraParameters2 (with IntrinsicMatrix or K, and RadialDistortion)",
            _has_key("CameraParameters[12]|PoseCamera2|RotationOfCamera2|RadialDistortion"),
        ),
        (
            "JARVIS",
            "both of intrinsicMatrix and distortionCoefficients",
            _has_key("intrinsicMatrix|distortionCoefficients"),
        ),
        ("EasyMocap", "names together with K_ and dist_, or R_ and T_, of each", _has_key("(?:K_|Rot_|dist_).*")),
        ("EasyMocap", "K_ and dist_, or R_ and T_, of the cameras in names", _has_key("names")),
        (
            "ROS",
            "a transform, or all of a camera_info: K, P, distortion_model, width and height",
            _has_key("transforms|child_frame_id|distortion_model|rectification_matrix|projection_matrix"),
        ),
        ("Kalibr camchain", "camera_model and a row of intrinsics for each camera", _is_chain),
        ("OpenCV stereo", "M1 D1 and M2 D2, the lenses of two cameras, and R and T between them", _has_key(_STEREO)),
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
