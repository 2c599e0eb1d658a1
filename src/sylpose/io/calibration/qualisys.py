"""Qualisys' .qca.txt: XML, with sensor coordinates in 1/64 pixel and lengths in mm.

A camera looks along -z with y up, and r11 ... r33 are the rows of the rotation from the world to it: X_camera =
r (X_world - (x, y, z)). If there are video cameras, the marker cameras are skipped.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.io.calibration.camera_builder import OPENCV_FROM_OPENGL, make_camera, make_pose, make_rig, parse_attribute
from sylpose.rig import Camera, Rig

__all__ = ["is_qualisys", "read"]

SUBPIXELS = 64.0


def is_qualisys(root: Element) -> bool:
    """Return whether XML has cameras with Qualisys' element names."""
    return root.tag == "calibration" and root.find("cameras/camera") is not None


def read(root: Element, path: Path) -> Rig:
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
    return make_rig(path, [_parse_camera(camera, path) for camera in videos or cameras], "mm")


def _parse_camera(node: Element, path: Path) -> Camera:
    name = node.get("serial", "")
    where = f"{path}: camera {name}"
    if node.get("viewrotation", "0") not in ("0", ""):
        raise ValueError(
            f"{where}: viewrotation is {node.get('viewrotation')}: its video is exported rotated, its calibration is "
            "not; "
            'export it unrotated, and write viewrotation="0"'
        )
    lens, transform, view = node.find("intrinsic"), node.find("transform"), node.find("fov_video")
    left, top, right, bottom = (parse_attribute(view, side, where)[0] for side in ("left", "top", "right", "bottom"))
    fx, fy, cx, cy, skew = (
        parse_attribute(lens, key, where)[0] / SUBPIXELS
        for key in ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV", "skew")
    )
    k1, k2, k3 = (parse_attribute(lens, f"radialDistortion{i}", where)[0] for i in (1, 2, 3))
    p1, p2 = (parse_attribute(lens, f"tangentalDistortion{i}", where)[0] for i in (1, 2))
    rotation = np.array([[parse_attribute(transform, f"r{i}{j}", where)[0] for j in (1, 2, 3)] for i in (1, 2, 3)])
    center = np.array([parse_attribute(transform, axis, where)[0] for axis in "xyz"])
    pose = make_pose(path, name, rotation, np.zeros(3)) * RigidTransform.from_translation(-center)
    return make_camera(
        path,
        name,
        size=(right - left + 1, bottom - top + 1),
        matrix=[[fx, skew, cx - left], [0, fy, cy - top], [0, 0, 1]],
        distortion=[k1, k2, p1, p2, k3],
        camera_from_world=OPENCV_FROM_OPENGL * pose,
        lens="opencv",
    )
