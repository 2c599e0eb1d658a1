"""OptiTrack's .mcal of Motive 3.2 and newer: XML, lengths in metres.

A camera looks along -z with y up; OrientMatrix0 ... 8 are the rows M of what turns it to the world: X_world = M X_camera +
(X, Y, Z). IntrinsicStandardCameraModel has OpenCV's lens; Intrinsic is of OptiTrack's own model. Where there are colour
cameras (ImagerIndex 30), those that see markers are left out.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from sylpose.calibration.camera_builder import attribute, from_opengl, make_camera, make_pose, make_rig, matrix_of
from sylpose.rig import Camera, Rig

__all__ = ["is_optitrack", "read"]

COLOUR = "30"


def is_optitrack(root: Element) -> bool:
    """Whether XML has cameras by Motive's names."""
    return any(camera.find("Extrinsic") is not None for camera in root.iter("Camera"))


def read(root: Element, path: Path) -> Rig:
    """The rig of cameras with a pose, called by their serial numbers.

    Raises:
        ValueError: naming the file, and the camera where there is one.
    """
    cameras = [camera for camera in root.iter("Camera") if camera.find("Extrinsic") is not None]
    colour = [
        camera for camera in cameras if (p := camera.find("Properties")) is not None and p.get("ImagerIndex") == COLOUR
    ]
    return make_rig(path, [_camera(camera, path) for camera in colour or cameras], "m")


def _camera(node: Element, path: Path) -> Camera:
    name = node.get("Serial", "")
    where = f"{path}: camera {name}"
    lens, place, imager = (node.find(part) for part in ("IntrinsicStandardCameraModel", "Extrinsic", "Attributes"))
    if lens is None:
        raise ValueError(
            f"{where}: no IntrinsicStandardCameraModel: its lens is in OptiTrack's own model alone, which is not known; "
            "newer versions of Motive export both"
        )
    width, height = (attribute(imager, f"ImagerPixel{side}", where)[0] for side in ("Width", "Height"))
    fx, fy, cx, cy = (
        attribute(lens, key, where)[0]
        for key in ("HorizontalFocalLength", "VerticalFocalLength", "LensCenterX", "LensCenterY")
    )
    k1, k2, p1, p2, k3 = (attribute(lens, key, where)[0] for key in ("k1", "k2", "TangentialX", "TangentialY", "k3"))
    turn = np.array([attribute(place, f"OrientMatrix{i}", where)[0] for i in range(9)]).reshape(3, 3)
    center = [attribute(place, axis, where)[0] for axis in "XYZ"]
    return make_camera(
        path,
        name,
        size=(width, height),
        matrix=matrix_of(fx, fy, cx, cy),
        distortion=[k1, k2, p1, p2, k3],
        camera_from_world=from_opengl * make_pose(path, name, turn, center).inv(),
        lens="opencv",
    )
