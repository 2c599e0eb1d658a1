"""OptiTrack's .mcal of Motive 3.2 and newer: XML, lengths in meters.

A camera looks along -z with y up; OrientMatrix0 ... 8 are the rows of its rotation M to the world: X_world =
M X_camera + (X, Y, Z). IntrinsicStandardCameraModel has OpenCV's lens; Intrinsic has OptiTrack's own model. If there
are color cameras (ImagerIndex 30), the marker cameras are skipped.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from sylpose.io.calibration.camera_builder import (
    OPENCV_FROM_OPENGL,
    intrinsic_matrix,
    make_camera,
    make_pose,
    make_rig,
    parse_attribute,
)
from sylpose.rig import Camera, Rig

__all__ = ["is_optitrack", "read"]

COLOR_IMAGER = "30"


def is_optitrack(root: Element) -> bool:
    """Return whether XML has cameras with Motive's element names."""
    return any(camera.find("Extrinsic") is not None for camera in root.iter("Camera"))


def read(root: Element, path: Path) -> Rig:
    """Read the rig of cameras with a pose, named by their serial numbers.

    Raises:
        ValueError: invalid content; the message names the file, and the camera if applicable.
    """
    cameras = [camera for camera in root.iter("Camera") if camera.find("Extrinsic") is not None]
    color_cameras = [
        camera
        for camera in cameras
        if (p := camera.find("Properties")) is not None and p.get("ImagerIndex") == COLOR_IMAGER
    ]
    return make_rig(path, [_parse_camera(camera, path) for camera in color_cameras or cameras], "m")


def _parse_camera(node: Element, path: Path) -> Camera:
    name = node.get("Serial", "")
    where = f"{path}: camera {name}"
    lens, extrinsic, imager = (node.find(part) for part in ("IntrinsicStandardCameraModel", "Extrinsic", "Attributes"))
    if lens is None:
        raise ValueError(
            f"{where}: no IntrinsicStandardCameraModel: its lens has only OptiTrack's own model, which is not "
            "supported; newer versions of Motive export both"
        )
    width, height = (parse_attribute(imager, f"ImagerPixel{side}", where)[0] for side in ("Width", "Height"))
    fx, fy, cx, cy = (
        parse_attribute(lens, key, where)[0]
        for key in ("HorizontalFocalLength", "VerticalFocalLength", "LensCenterX", "LensCenterY")
    )
    k1, k2, p1, p2, k3 = (
        parse_attribute(lens, key, where)[0] for key in ("k1", "k2", "TangentialX", "TangentialY", "k3")
    )
    rotation = np.array([parse_attribute(extrinsic, f"OrientMatrix{i}", where)[0] for i in range(9)]).reshape(3, 3)
    center = [parse_attribute(extrinsic, axis, where)[0] for axis in "XYZ"]
    return make_camera(
        path,
        name,
        size=(width, height),
        matrix=intrinsic_matrix(fx, fy, cx, cy),
        distortion=[k1, k2, p1, p2, k3],
        camera_from_world=OPENCV_FROM_OPENGL * make_pose(path, name, rotation, center).inv(),
        lens="opencv",
    )
