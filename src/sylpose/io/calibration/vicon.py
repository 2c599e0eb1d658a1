"""Vicon's .xcp: XML; quaternions x y z w of the rotation from world to camera, lengths in mm.

X_camera = R (X_world - POSITION), x to the right, y down, z forward. The lens is given by its undistortion: a pixel
at distance r from the center of distortion is mapped to (1 + k1 r² + k2 r⁴ + k3 r⁶) times its offset. OpenCV's
equivalent is fitted. If there are video cameras, the marker cameras are skipped.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.io.calibration.camera_builder import make_camera, make_rig, parse_attribute, parse_numbers
from sylpose.io.calibration.lens_conversion import FittedLens, fit_lens, sample_image_grid
from sylpose.rig import Camera, Rig

__all__ = ["is_vicon", "read"]


def is_vicon(root: Element) -> bool:
    """Return whether XML has cameras with Vicon's element names."""
    return root.tag == "Cameras" and root.find("Camera") is not None


def read(root: Element, path: Path) -> Rig:
    """Read the rig of calibrated cameras, named by their DEVICEID.

    Raises:
        ValueError: invalid content; the message names the file, and the camera if applicable.
    """
    cameras = [camera for camera in root.findall("Camera") if camera.find("KeyFrames/KeyFrame") is not None]
    if not cameras:
        raise ValueError(f"{path}: no camera in this Vicon file is calibrated: none has a KeyFrame")
    videos = [camera for camera in cameras if _is_video(camera)]
    return make_rig(path, [_parse_camera(camera, path) for camera in videos or cameras], "mm")


def _is_video(node: Element) -> bool:
    return node.get("ISDV", "0") != "0" or "video" in node.get("TYPE", "").lower()


def _parse_camera(node: Element, path: Path) -> Camera:
    name = node.get("DEVICEID") or node.get("NAME") or ""
    where = f"{path}: camera {name}"
    frames = node.findall("KeyFrames/KeyFrame")
    if len({(frame.get("POSITION"), frame.get("ORIENTATION")) for frame in frames}) > 1:
        raise ValueError(f"{where}: it moves: it has {len(frames)} KeyFrames; sylpose requires static cameras")
    frame = frames[0]
    size = parse_attribute(node, "SENSOR_SIZE", where, 2)
    aspect = parse_attribute(node, "PIXEL_ASPECT_RATIO", where)[0] if node.get("PIXEL_ASPECT_RATIO") else 1.0
    skew = parse_attribute(node, "SKEW", where)[0] if node.get("SKEW") else 0.0
    focal, principal_point = (
        parse_attribute(frame, "FOCAL_LENGTH", where)[0],
        parse_attribute(frame, "PRINCIPAL_POINT", where, 2),
    )
    if not aspect > 0 or not focal > 0:
        raise ValueError(f"{where}: FOCAL_LENGTH and PIXEL_ASPECT_RATIO must be positive")
    matrix = np.array([[focal, skew, principal_point[0]], [0.0, focal / aspect, principal_point[1]], [0.0, 0.0, 1.0]])
    quaternion, center = parse_attribute(frame, "ORIENTATION", where, 4), parse_attribute(frame, "POSITION", where, 3)
    if not abs(np.linalg.norm(quaternion) - 1.0) < 1e-3:
        raise ValueError(f"{where}: ORIENTATION must be a quaternion x y z w of length 1")
    rotation = Rotation.from_quat(quaternion)
    lens = _fit_lens(frame, matrix, size, aspect, where)
    error = parse_attribute(frame, "IMAGE_ERROR", where)[0] if frame.get("IMAGE_ERROR") else 0.0
    return make_camera(
        path,
        name,
        size=size,
        matrix=lens.matrix,
        distortion=lens.distortion,
        camera_from_world=RigidTransform.from_components(-rotation.apply(center), rotation),
        lens="opencv",
        error_px=error if error > 0 else None,
    )


def _fit_lens(frame: Element, matrix: FloatArray, size: FloatArray, aspect: float, where: str) -> FittedLens:
    """Fit OpenCV's lens to the undistortion VICON_RADIAL2, or VICON_RADIAL: k1 k2 about the principal point."""
    distortion_center, terms = matrix[:2, 2], np.zeros(3)
    if words := (frame.get("VICON_RADIAL2") or "").split()[1:]:
        values = parse_numbers(words, 5, f"{where}: VICON_RADIAL2 after its first word")
        distortion_center, terms = values[:2], values[2:]
    elif frame.get("VICON_RADIAL"):
        terms[:2] = parse_attribute(frame, "VICON_RADIAL", where, 2)
    if not terms.any():
        return FittedLens(matrix, np.zeros(5))
    if aspect != 1.0:
        raise ValueError(
            f"{where}: lens distortion with non-square pixels is not supported (PIXEL_ASPECT_RATIO {aspect:g})"
        )
    if not (size > 0).all() or not (size <= 2**16).all():
        raise ValueError(f"{where}: SENSOR_SIZE must be two numbers of pixels")
    pixels = sample_image_grid((int(size[0]), int(size[1])))
    from_middle = pixels - distortion_center
    r2 = np.sum(from_middle**2, axis=1, keepdims=True)
    with np.errstate(all="ignore"):
        undistorted = distortion_center + from_middle * (1 + r2 * (terms[0] + r2 * (terms[1] + r2 * terms[2])))
    normalized = (undistorted - matrix[:2, 2]) / matrix[[0, 1], [0, 1]]
    return fit_lens(normalized, pixels, matrix, where)
