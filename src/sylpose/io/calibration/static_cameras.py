"""Static cameras from the poses of individual images, as photogrammetry has them (COLMAP, Metashape, NeRF).

A static camera has the same pose in all of its images, up to the program's own error. Images in folders belong to the
camera named after the folder. Images without folder belong to the camera of their lens if all images of each lens
agree in rotation; otherwise each belongs to its own camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray

__all__ = ["PosedImage", "StaticCamera", "find_static_cameras", "image_path", "make_unique_names"]

# Maximum deviation among a camera's poses: twice that of images with some hundred points (choice), as an angle in
# degrees and a fraction of the largest distance between cameras.
MAX_ROTATION_DEG, MAX_TRANSLATION_RATIO = 0.2, 0.005
_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".pgm", ".ppm", ".jp2", ".dng", ".exr")


class PosedImage(NamedTuple):
    """Image with a pose camera_from_world: (4,) quaternion, w last, and (3,) translation.

    Its path has no file suffix; `lens` is the key of its lens.
    """

    path: PurePosixPath
    lens: str
    quaternion: FloatArray
    translation: FloatArray


class StaticCamera(NamedTuple):
    """Static camera, with the key of its lens."""

    name: str
    lens: str
    camera_from_world: RigidTransform


def image_path(name: str) -> PurePosixPath:
    """Return an image's path from a name with or without suffix."""
    path = PurePosixPath(name.replace("\\", "/"))
    return path.with_suffix("") if path.suffix.lower() in _IMAGE_SUFFIXES else path


def find_static_cameras(images: Sequence[PosedImage], path: Path) -> list[StaticCamera]:
    """Find the cameras of images, in the order of their lenses, then of their names.

    Raises:
        ValueError: naming the file, and the camera whose images have several poses or lenses; no images.
    """
    if not images:
        raise ValueError(f"{path}: no image in it has a pose")
    groups = _group_by_camera(images)
    means = {name: _mean_pose(camera_images) for name, camera_images in groups.items()}
    centers = np.array([pose.inv().translation for pose in means.values()])
    extent = max(float(np.linalg.norm(centers - center, axis=1).max()) for center in centers)
    order = {lens: k for k, lens in enumerate(dict.fromkeys(shot.lens for shot in images))}
    found = []
    for name, camera_images in groups.items():
        if len(lenses := sorted({shot.lens for shot in camera_images})) > 1:
            raise ValueError(
                f"{path}: camera {name}: its {len(camera_images)} images have {len(lenses)} lenses: {', '.join(lenses)}"
            )
        _check_static(name, camera_images, means[name], extent, path)
        found.append(StaticCamera(name, camera_images[0].lens, means[name]))
    return sorted(found, key=lambda still: (order[still.lens], still.name))


def make_unique_names(folders: Sequence[PurePosixPath]) -> list[str]:
    """Return unique names of folders: their last parts if these differ, else their full paths."""
    last = [folder.name for folder in folders]
    return last if len(set(last)) == len(last) else ["_".join(folder.parts) for folder in folders]


def _group_by_camera(images: Sequence[PosedImage]) -> dict[str, list[PosedImage]]:
    """Group images by the camera's name."""
    in_folders = all(len(image.path.parts) > 1 for image in images)
    images_by_lens: dict[str, list[PosedImage]] = {}
    for image in images:
        images_by_lens.setdefault(image.lens, []).append(image)
    poses_agree = all(_compute_spread(its, _mean_pose(its))[0] <= MAX_ROTATION_DEG for its in images_by_lens.values())
    found: dict[PurePosixPath, list[PosedImage]] = {}
    for image in images:
        key = image.path.parent if in_folders else PurePosixPath(image.lens) if poses_agree else image.path
        found.setdefault(key, []).append(image)
    if in_folders:
        names = make_unique_names(list(found))
    else:
        names = [its[0].path.name if len(its) == 1 else str(key) for key, its in found.items()]
    if len(set(names)) < len(names):
        names = [str(key).replace("/", "_") for key in found]
    return dict(zip(names, found.values(), strict=True))


def _stack_poses(images: Sequence[PosedImage]) -> RigidTransform:
    """Return camera_from_world of each image."""
    rotations = Rotation.from_quat(np.array([shot.quaternion for shot in images]))
    return RigidTransform.from_components(np.array([shot.translation for shot in images]), rotations)


def _mean_pose(images: Sequence[PosedImage]) -> RigidTransform:
    """Return the mean camera_from_world of a static camera."""
    poses = _stack_poses(images)
    if (poses.as_matrix() == poses[0].as_matrix()).all():
        return poses[0]
    rotation = poses.rotation.mean()
    return RigidTransform.from_components(-rotation.apply(poses.inv().translation.mean(axis=0)), rotation)


def _compute_spread(images: Sequence[PosedImage], mean: RigidTransform) -> tuple[float, float]:
    """Return the largest deviation of an image's pose from the mean: rotation in degrees, and distance."""
    poses = _stack_poses(images)
    distances = np.linalg.norm(poses.inv().translation - mean.inv().translation, axis=1)
    return float(np.degrees((poses.rotation * mean.rotation.inv()).magnitude().max())), float(distances.max())


def _check_static(name: str, images: Sequence[PosedImage], mean: RigidTransform, extent: float, path: Path) -> None:
    rotation, distance = _compute_spread(images, mean)
    # With a single camera, use its distance from the origin, which such programs place among the points.
    scale = extent if extent > 0 else float(np.linalg.norm(mean.inv().translation))
    if rotation <= MAX_ROTATION_DEG and distance <= MAX_TRANSLATION_RATIO * scale:
        return
    raise ValueError(
        f"{path}: camera {name}: its {len(images)} images do not have one pose: they are up to {rotation:.2f} degrees "
        f"and {distance:.2g} units away from their mean; sylpose requires static cameras"
    )
