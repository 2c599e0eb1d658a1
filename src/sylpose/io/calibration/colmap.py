"""COLMAP models, text or binary: a folder with cameras.txt and images.txt, or .bin; and rig_config.json.

A camera's lens is in `cameras`, its pose in `images`, with one entry per image: `static_cameras` groups them by camera.

In COLMAP, the center of the top-left pixel is (0.5, 0.5), quaternions begin with w, and lengths have no unit.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.io.calibration.camera_builder import (
    SizeLookup,
    intrinsic_matrix,
    lookup_sizes,
    make_camera,
    make_pose,
    make_rig,
    parse_numbers,
    standard_lens_terms,
)
from sylpose.io.calibration.colmap_model import Model
from sylpose.io.calibration.static_cameras import PosedImage, find_static_cameras, image_path, make_unique_names
from sylpose.rig import Camera, LensModel, Rig

__all__ = ["PIXEL_CENTER", "is_rig_config", "parse_lens", "read", "read_rig_config", "to_texts"]

# Center of the top-left pixel.
PIXEL_CENTER = 0.5
# Parameters of the models that OpenCV supports: number of focal lengths, indices of the other parameters among OpenCV's
# terms, and lens model.
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


class _LensParameters(NamedTuple):
    matrix: FloatArray
    distortion: FloatArray
    lens: LensModel


def parse_lens(model: str, params: Any, where: str) -> _LensParameters:
    """Parse a camera of a COLMAP model into matrix, distortion and lens, with the top-left pixel's center at (0, 0).

    Raises:
        ValueError: a model that OpenCV does not have, or a wrong number of parameters.
    """
    if model not in _MODELS:
        raise ValueError(f"{where}: COLMAP's model {model} is not supported; OpenCV's are: {', '.join(_MODELS)}")
    n_focal, terms, lens = _MODELS[model]
    values = parse_numbers(params, n_focal + 2 + len(terms), f"{where}: the parameters of {model}")
    fx, fy = values[0], values[n_focal - 1]
    cx, cy = values[n_focal : n_focal + 2] - PIXEL_CENTER
    distortion = np.zeros(4 if lens == "fisheye" or len(terms) <= 4 else 8)
    distortion[list(terms)] = values[n_focal + 2 :]
    return _LensParameters(intrinsic_matrix(fx, fy, cx, cy), distortion, lens)


def read(model: Model, path: Path) -> Rig:
    """Read the rig of a model.

    Raises:
        ValueError: naming the file, and the camera if applicable: images of one camera with different poses.
    """
    images = [
        PosedImage(image_path(image.name), str(image.camera), image.quaternion, image.translation)
        for image in model.images
    ]
    if not images:
        raise ValueError(f"{path}: no image of this COLMAP model has a pose")
    cameras = []
    for static_camera in find_static_cameras(images, path):
        lens = model.lenses.get(int(static_camera.lens))
        where = f"{path}: camera {static_camera.name}"
        if lens is None:
            raise ValueError(f"{where}: its images have a lens, {static_camera.lens}, that is not in COLMAP's cameras")
        found = parse_lens(lens.model, lens.params, where)
        cameras.append(_make_camera(path, static_camera.name, lens.size, found, static_camera.camera_from_world))
    return make_rig(path, cameras)


def is_rig_config(data: Any) -> bool:
    """Return whether decoded JSON is COLMAP's rig_config: a list of rigs whose cameras have image prefixes."""
    rigs = data if isinstance(data, list) else []
    cameras = [c for rig in rigs if isinstance(rig, dict) and isinstance(c := rig.get("cameras"), list)]
    return any(
        isinstance(camera, dict) and "image_prefix" in camera for cameras_of_rig in cameras for camera in cameras_of_rig
    )


def read_rig_config(data: list[Any], path: Path, sizes: SizeLookup | None = None) -> Rig:
    """Read the rig of a rig_config; its world is the frame of the rig, with the reference sensor at the origin.

    Raises:
        ValueError: invalid content; the message names the file, and the camera if applicable.
    """
    if len(data) > 1:
        raise ValueError(f"{path}: this is a COLMAP rig_config of {len(data)} rigs, without the poses between them")
    nodes = [node for node in data[0]["cameras"] if isinstance(node, dict)]
    names = make_unique_names([PurePosixPath(str(node.get("image_prefix", ""))) for node in nodes])
    found = []
    for name, node in zip(names, nodes, strict=True):
        where = f"{path}: camera {name}"
        if "camera_params" not in node or "camera_model_name" not in node:
            raise ValueError(
                f"{where}: this is a COLMAP rig_config without its camera_model_name and camera_params; the folder of "
                "the reconstruction, with cameras.txt and images.txt (or .bin), has them"
            )
        pose = RigidTransform.identity()
        if not node.get("ref_sensor"):
            if not {"cam_from_rig_rotation", "cam_from_rig_translation"} <= node.keys():
                raise ValueError(
                    f"{where}: this is a COLMAP rig_config without its cam_from_rig_rotation and _translation"
                )
            rotation = _to_rotation(
                parse_numbers(node["cam_from_rig_rotation"], 4, f"{where}: cam_from_rig_rotation"), where
            )
            pose = make_pose(path, name, rotation.as_matrix(), node["cam_from_rig_translation"])
        found.append((name, parse_lens(str(node["camera_model_name"]), node["camera_params"], where), pose))
    known_sizes = lookup_sizes(path, names, sizes)
    return make_rig(path, [_make_camera(path, name, known_sizes[name], lens, pose) for name, lens, pose in found])


def to_texts(rig: Rig) -> dict[str, str]:
    """Format a model as cameras.txt, images.txt and points3D.txt, with one image NAME/0.png per camera and no points.

    Raises:
        ValueError: a lens that COLMAP does not have; a name with blanks, which COLMAP does not allow.
    """
    cameras = "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    images = (
        "# Image list with two lines of data per image:\n"
        "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n#   POINTS2D[] as (X, Y, POINT3D_ID)\n"
    )
    for i, camera in enumerate(rig, start=1):
        if len(camera.name.split()) > 1:
            raise ValueError(f"camera {camera.name}: names in COLMAP must not have blanks")
        model, terms = "OPENCV_FISHEYE", camera.distortion
        if camera.lens == "opencv":
            terms = standard_lens_terms(camera, 8, "COLMAP's FULL_OPENCV")
            model, terms = ("FULL_OPENCV", terms) if terms[4:].any() else ("OPENCV", terms[:4])
        params = [*camera.matrix[[0, 1], [0, 1]], *(camera.matrix[:2, 2] + PIXEL_CENTER), *terms]
        cameras += f"{i} {model} {camera.size[0]} {camera.size[1]} {_format_numbers(params)}\n"
        x, y, z, w = camera.camera_from_world.rotation.as_quat()
        images += (
            f"{i} {_format_numbers([w, x, y, z, *camera.camera_from_world.translation])} {i} {camera.name}/0.png\n\n"
        )
    points = "# 3D point list, none\n"
    return {"cameras.txt": cameras, "images.txt": images, "points3D.txt": points}


def _format_numbers(values: Iterable[float]) -> str:
    return " ".join(repr(float(value)) for value in values)


def _make_camera(path: Path, name: str, size: Any, lens: _LensParameters, pose: RigidTransform) -> Camera:
    return make_camera(
        path,
        name,
        size=size,
        matrix=lens.matrix,
        distortion=lens.distortion,
        camera_from_world=pose,
        lens=lens.lens,
    )


def _to_rotation(quaternion: FloatArray, where: str) -> Rotation:
    """Convert a quaternion w, x, y, z."""
    if not abs(np.linalg.norm(quaternion) - 1.0) < 1e-3:
        raise ValueError(f"{where}: {quaternion} is not a unit quaternion")
    return Rotation.from_quat(np.roll(quaternion, -1))
