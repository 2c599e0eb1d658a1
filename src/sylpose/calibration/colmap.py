"""COLMAP's models, text or binary: a folder with cameras.txt and images.txt, or .bin; and its rig_config.json.

A camera's lens is in `cameras`, its pose in `images`, which has one of each image: `shots` says which are of one camera.

COLMAP's pixels have the centre of the top-left one at (0.5, 0.5), quaternions w first, and lengths are in no unit.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.calibration.camera_builder import (
    Sizes,
    lens_terms,
    make_camera,
    make_pose,
    make_rig,
    matrix_of,
    numbers,
    sizes_of,
)
from sylpose.calibration.colmap_model import Model
from sylpose.calibration.static_cameras import Shot, path_of, still_cameras, told_apart
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Camera, LensModel, Rig

__all__ = ["HALF", "is_rig_config", "lens_of_model", "read", "read_rig_config", "to_texts"]

# The centre of the top-left pixel.
HALF = 0.5
# Parameters of those models that OpenCV has, too: how many focal lengths, and which of OpenCV's terms the others are.
_MODELS: dict[str, tuple[int, tuple[int, ...], LensModel]] = {
    "SIMPLE_PINHOLE": (1, (), "opencv"),
    "PINHOLE": (2, (), "opencv"),
    "SIMPLE_RADIAL": (1, (0,), "opencv"),
    "RADIAL": (1, (0, 1), "opencv"),
    "OPENCV": (2, (0, 1, 2, 3), "opencv"),
    "FULL_OPENCV": (2, (0, 1, 2, 3, 4, 5, 6, 7), "opencv"),
    "OPENCV_FISHEYE": (2, (0, 1, 2, 3), "fisheye"),
    "SIMPLE_RADIAL_FISHEYE": (1, (0,), "fisheye"),
    "RADIAL_FISHEYE": (1, (0, 1), "fisheye"),
    "SIMPLE_FISHEYE": (1, (), "fisheye"),
    "FISHEYE": (2, (), "fisheye"),
}


class _Numbers(NamedTuple):
    matrix: FloatArray
    distortion: FloatArray
    lens: LensModel


def lens_of_model(model: str, params: Any, where: str) -> _Numbers:
    """Matrix, distortion and lens of a camera of one of COLMAP's models, in pixels whose first one's centre is (0, 0).

    Raises:
        ValueError: a model that OpenCV has not, or another number of parameters than it has.
    """
    if model not in _MODELS:
        raise ValueError(
            f"{where}: COLMAP's model {model} is none of OpenCV's, which sylpose has; {', '.join(_MODELS)} are"
        )
    n_focal, terms, lens = _MODELS[model]
    values = numbers(params, n_focal + 2 + len(terms), f"{where}: the parameters of {model}")
    fx, fy = values[0], values[n_focal - 1]
    cx, cy = values[n_focal : n_focal + 2] - HALF
    distortion = np.zeros(4 if lens == "fisheye" or len(terms) <= 4 else 8)
    distortion[list(terms)] = values[n_focal + 2 :]
    return _Numbers(matrix_of(fx, fy, cx, cy), distortion, lens)


def read(model: Model, path: Path) -> Rig:
    """The rig of a model.

    Raises:
        ValueError: naming the file, and the camera where there is one: images of one camera whose poses are not one.
    """
    images = [
        Shot(path_of(image.name), str(image.camera), image.quaternion, image.translation) for image in model.images
    ]
    if not images:
        raise ValueError(f"{path}: no image of this COLMAP model has a pose")
    cameras = []
    for still in still_cameras(images, path):
        lens = model.lenses.get(int(still.lens))
        where = f"{path}: camera {still.name}"
        if lens is None:
            raise ValueError(f"{where}: its images have a lens, {still.lens}, that is not in COLMAP's cameras")
        found = lens_of_model(lens.model, lens.params, where)
        cameras.append(_camera(path, still.name, lens.size, found, still.camera_from_world))
    return make_rig(path, cameras)


def is_rig_config(data: Any) -> bool:
    """Whether decoded JSON is COLMAP's rig_config: a list of rigs of cameras with prefixes of images."""
    rigs = data if isinstance(data, list) else []
    cameras = [c for rig in rigs if isinstance(rig, dict) and isinstance(c := rig.get("cameras"), list)]
    return any(isinstance(camera, dict) and "image_prefix" in camera for its in cameras for camera in its)


def read_rig_config(data: list[Any], path: Path, sizes: Sizes | None = None) -> Rig:
    """The rig of a rig_config; its world is the frame of the rig, in which the reference sensor stands at the origin.

    Raises:
        ValueError: naming the file, and the camera where there is one.
    """
    if len(data) > 1:
        raise ValueError(
            f"{path}: this is a COLMAP rig_config of {len(data)} rigs, and does not tell how they stand to each other"
        )
    nodes = [node for node in data[0]["cameras"] if isinstance(node, dict)]
    names = told_apart([PurePosixPath(str(node.get("image_prefix", ""))) for node in nodes])
    found = []
    for name, node in zip(names, nodes, strict=True):
        where = f"{path}: camera {name}"
        if "camera_params" not in node or "camera_model_name" not in node:
            raise ValueError(
                f"{where}: this is a COLMAP rig_config without its camera_model_name and camera_params; the folder of the "
                "reconstruction, with cameras.txt and images.txt (or .bin), has them"
            )
        pose = RigidTransform.identity()
        if not node.get("ref_sensor"):
            if not {"cam_from_rig_rotation", "cam_from_rig_translation"} <= node.keys():
                raise ValueError(
                    f"{where}: this is a COLMAP rig_config without its cam_from_rig_rotation and _translation"
                )
            turn = _rotation(numbers(node["cam_from_rig_rotation"], 4, f"{where}: cam_from_rig_rotation"), where)
            pose = make_pose(path, name, turn.as_matrix(), node["cam_from_rig_translation"])
        found.append((name, lens_of_model(str(node["camera_model_name"]), node["camera_params"], where), pose))
    known = sizes_of(path, names, sizes)
    return make_rig(path, [_camera(path, name, known[name], lens, pose) for name, lens, pose in found])


def to_texts(rig: Rig) -> dict[str, str]:
    """cameras.txt, images.txt and points3D.txt of a model with one image of each camera, NAME/0.png, and no points.

    Raises:
        ValueError: a lens that COLMAP has not; a name with blanks, which COLMAP's do not have.
    """
    cameras = "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    images = (
        "# Image list with two lines of data per image:\n"
        "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n#   POINTS2D[] as (X, Y, POINT3D_ID)\n"
    )
    for i, camera in enumerate(rig, start=1):
        if len(camera.name.split()) > 1:
            raise ValueError(f"camera {camera.name}: names in COLMAP have no blanks")
        model, terms = "OPENCV_FISHEYE", camera.distortion
        if camera.lens == "opencv":
            terms = lens_terms(camera, 8, "COLMAP's FULL_OPENCV")
            model, terms = ("FULL_OPENCV", terms) if terms[4:].any() else ("OPENCV", terms[:4])
        params = [*camera.matrix[[0, 1], [0, 1]], *(camera.matrix[:2, 2] + HALF), *terms]
        cameras += f"{i} {model} {camera.size[0]} {camera.size[1]} {_words(params)}\n"
        x, y, z, w = camera.camera_from_world.rotation.as_quat()
        images += f"{i} {_words([w, x, y, z, *camera.camera_from_world.translation])} {i} {camera.name}/0.png\n\n"
    points = "# 3D point list, none\n"
    return {"cameras.txt": cameras, "images.txt": images, "points3D.txt": points}


def _words(values: Iterable[float]) -> str:
    return " ".join(repr(float(value)) for value in values)


def _camera(path: Path, name: str, size: Any, lens: _Numbers, pose: RigidTransform) -> Camera:
    return make_camera(
        path,
        name,
        size=size,
        matrix=lens.matrix,
        distortion=lens.distortion,
        camera_from_world=pose,
        lens=lens.lens,
    )


def _rotation(quaternion: FloatArray, where: str) -> Rotation:
    """Of w, x, y, z."""
    if not abs(np.linalg.norm(quaternion) - 1.0) < 1e-3:
        raise ValueError(f"{where}: {quaternion} is no unit quaternion")
    return Rotation.from_quat(np.roll(quaternion, -1))
