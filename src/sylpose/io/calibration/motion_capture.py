"""XML files of motion capture systems: Qualisys' .qca.txt, Vicon's .xcp, and OptiTrack's .mcal of Motive 3.2 or newer.

If there are video cameras, the marker cameras are skipped.

- Qualisys: sensor coordinates in 1/64 pixel, lengths in mm. A camera looks along -z with y up; r11 ... r33 are the rows
  of the rotation from the world to it: X_camera = r (X_world - (x, y, z)).
- Vicon: quaternions x y z w of the rotation from world to camera, lengths in mm. X_camera = R (X_world - POSITION), x to
  the right, y down, z forward. The lens is given by its undistortion: a pixel at distance r from the center of
  distortion is mapped to (1 + k1 r² + k2 r⁴ + k3 r⁶) times its offset. OpenCV's equivalent is fitted.
- OptiTrack: lengths in meters. A camera looks along -z with y up; OrientMatrix0 ... 8 are the rows of its rotation M to
  the world: X_world = M X_camera + (X, Y, Z). IntrinsicStandardCameraModel has OpenCV's lens; Intrinsic has OptiTrack's
  own model. Color cameras have ImagerIndex 30.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import FloatArray
from sylpose.io.calibration.camera_builder import OPENCV_FROM_OPENGL, CameraEntry, intrinsic_matrix, make_rig
from sylpose.io.calibration.lens_conversion import FittedLens, fit_lens, sample_image_grid
from sylpose.rig import Camera, Rig

SUBPIXELS = 64.0
COLOR_IMAGER = "30"


def is_qualisys(root: Element) -> bool:
    """Return whether XML has cameras with Qualisys' element names."""
    return root.tag == "calibration" and root.find("cameras/camera") is not None


def read_qualisys(root: Element, path: Path) -> Rig:
    """Read the rig of calibrated and active cameras, named by their serial numbers.

    Raises:
        ValueError: invalid content; the message names the file, and the camera if applicable.
    """
    cameras = [
        camera
        for camera in root.findall("cameras/camera")
        if camera.get("active", "1") != "0" and camera.get("calibrated", "true") != "false"
    ]
    videos = [camera for camera in cameras if "video" in camera.get("model", "").lower()]
    return make_rig(path, [_parse_qualisys(camera, path) for camera in videos or cameras], "mm")


def _parse_qualisys(node: Element, path: Path) -> Camera:
    entry = CameraEntry(path, node.get("serial", ""))
    if node.get("viewrotation", "0") not in ("0", ""):
        raise entry.error(
            f"viewrotation is {node.get('viewrotation')}: its video is exported rotated, its calibration is "
            'not; export it unrotated, and write viewrotation="0"'
        )
    lens, transform, view = node.find("intrinsic"), node.find("transform"), node.find("fov_video")
    left, top, right, bottom = entry.parse_attributes(view, "left", "top", "right", "bottom")
    intrinsics = entry.parse_attributes(lens, "focalLengthU", "focalLengthV", "centerPointU", "centerPointV", "skew")
    fx, fy, cx, cy, skew = intrinsics / SUBPIXELS
    k1, k2, k3 = entry.parse_attributes(lens, *(f"radialDistortion{i}" for i in (1, 2, 3)))
    p1, p2 = entry.parse_attributes(lens, *(f"tangentalDistortion{i}" for i in (1, 2)))
    rotation = entry.parse_attributes(transform, *(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))).reshape(3, 3)
    center = entry.parse_attributes(transform, *"xyz")
    pose = OPENCV_FROM_OPENGL * (entry.make_pose(rotation, np.zeros(3)) * RigidTransform.from_translation(-center))
    matrix = [[fx, skew, cx - left], [0, fy, cy - top], [0, 0, 1]]
    return entry.make_camera((right - left + 1, bottom - top + 1), matrix, [k1, k2, p1, p2, k3], pose)


def is_vicon(root: Element) -> bool:
    """Return whether XML has cameras with Vicon's element names."""
    return root.tag == "Cameras" and root.find("Camera") is not None


def read_vicon(root: Element, path: Path) -> Rig:
    """Read the rig of calibrated cameras, named by their DEVICEID.

    Raises:
        ValueError: invalid content; the message names the file, and the camera if applicable.
    """
    cameras = [camera for camera in root.findall("Camera") if camera.find("KeyFrames/KeyFrame") is not None]
    if not cameras:
        raise ValueError(f"{path}: no camera in this Vicon file is calibrated: none has a KeyFrame")
    videos = [node for node in cameras if node.get("ISDV", "0") != "0" or "video" in node.get("TYPE", "").lower()]
    return make_rig(path, [_parse_vicon(camera, path) for camera in videos or cameras], "mm")


def _parse_vicon(node: Element, path: Path) -> Camera:
    entry = CameraEntry(path, node.get("DEVICEID") or node.get("NAME") or "")
    frames = node.findall("KeyFrames/KeyFrame")
    if len({(frame.get("POSITION"), frame.get("ORIENTATION")) for frame in frames}) > 1:
        raise entry.error(f"it moves: it has {len(frames)} KeyFrames; sylpose requires static cameras")
    frame = frames[0]
    size = entry.parse_attribute(node, "SENSOR_SIZE", 2)
    aspect = entry.parse_attribute(node, "PIXEL_ASPECT_RATIO")[0] if node.get("PIXEL_ASPECT_RATIO") else 1.0
    skew = entry.parse_attribute(node, "SKEW")[0] if node.get("SKEW") else 0.0
    focal = entry.parse_attribute(frame, "FOCAL_LENGTH")[0]
    cx, cy = entry.parse_attribute(frame, "PRINCIPAL_POINT", 2)
    if not aspect > 0 or not focal > 0:
        raise entry.error("FOCAL_LENGTH and PIXEL_ASPECT_RATIO must be positive")
    matrix = np.array([[focal, skew, cx], [0.0, focal / aspect, cy], [0.0, 0.0, 1.0]])
    quaternion, center = entry.parse_attribute(frame, "ORIENTATION", 4), entry.parse_attribute(frame, "POSITION", 3)
    rotation = entry.parse_quaternion(quaternion, "ORIENTATION must be a quaternion x y z w of length 1")
    lens = _fit_vicon_lens(frame, matrix, size, aspect, entry)
    error = entry.parse_attribute(frame, "IMAGE_ERROR")[0] if frame.get("IMAGE_ERROR") else 0.0
    pose = RigidTransform.from_components(-rotation.apply(center), rotation)
    return entry.make_camera(size, lens.matrix, lens.distortion, pose, "opencv", error if error > 0 else None)


def _fit_vicon_lens(
    frame: Element, matrix: FloatArray, size: FloatArray, aspect: float, entry: CameraEntry
) -> FittedLens:
    """Fit OpenCV's lens to the undistortion VICON_RADIAL2, or VICON_RADIAL: k1 k2 about the principal point."""
    distortion_center, terms = matrix[:2, 2], np.zeros(3)
    if words := (frame.get("VICON_RADIAL2") or "").split()[1:]:
        values = entry.parse_numbers(words, 5, "VICON_RADIAL2 after its first word")
        distortion_center, terms = values[:2], values[2:]
    elif frame.get("VICON_RADIAL"):
        terms[:2] = entry.parse_attribute(frame, "VICON_RADIAL", 2)
    if not terms.any():
        return FittedLens(matrix, np.zeros(5))
    if aspect != 1.0:
        raise entry.error(f"lens distortion with non-square pixels is not supported (PIXEL_ASPECT_RATIO {aspect:g})")
    if not (size > 0).all() or not (size <= 2**16).all():
        raise entry.error("SENSOR_SIZE must be two numbers of pixels")
    pixels = sample_image_grid((int(size[0]), int(size[1])))
    from_middle = pixels - distortion_center
    r2 = np.sum(from_middle**2, axis=1, keepdims=True)
    with np.errstate(all="ignore"):
        undistorted = distortion_center + from_middle * (1 + r2 * (terms[0] + r2 * (terms[1] + r2 * terms[2])))
    normalized = (undistorted - matrix[:2, 2]) / matrix[[0, 1], [0, 1]]
    return fit_lens(normalized, pixels, matrix, str(entry))


def is_optitrack(root: Element) -> bool:
    """Return whether XML has cameras with Motive's element names."""
    return any(camera.find("Extrinsic") is not None for camera in root.iter("Camera"))


def read_optitrack(root: Element, path: Path) -> Rig:
    """Read the rig of cameras with a pose, named by their serial numbers.

    Raises:
        ValueError: invalid content; the message names the file, and the camera if applicable.
    """
    cameras = [camera for camera in root.iter("Camera") if camera.find("Extrinsic") is not None]
    colors = [node for node in cameras if node.find(f"Properties[@ImagerIndex='{COLOR_IMAGER}']") is not None]
    return make_rig(path, [_parse_optitrack(camera, path) for camera in colors or cameras], "m")


def _parse_optitrack(node: Element, path: Path) -> Camera:
    entry = CameraEntry(path, node.get("Serial", ""))
    lens, extrinsic, imager = (node.find(part) for part in ("IntrinsicStandardCameraModel", "Extrinsic", "Attributes"))
    if lens is None:
        raise entry.error(
            "no IntrinsicStandardCameraModel: its lens has only OptiTrack's own model, which is not "
            "supported; newer versions of Motive export both"
        )
    size = entry.parse_attributes(imager, "ImagerPixelWidth", "ImagerPixelHeight")
    fx, fy, cx, cy = entry.parse_attributes(
        lens, "HorizontalFocalLength", "VerticalFocalLength", "LensCenterX", "LensCenterY"
    )
    terms = entry.parse_attributes(lens, "k1", "k2", "TangentialX", "TangentialY", "k3")
    rotation = entry.parse_attributes(extrinsic, *(f"OrientMatrix{i}" for i in range(9))).reshape(3, 3)
    pose = OPENCV_FROM_OPENGL * entry.make_pose(rotation, entry.parse_attributes(extrinsic, *"XYZ")).inv()
    return entry.make_camera(size, intrinsic_matrix(fx, fy, cx, cy), terms, pose)
