"""Cameras that stand still, from the poses of their images, of which photogrammetry has one each (COLMAP, Metashape, NeRF).

A camera that does not move has the same pose in all of its images, up to what such a program's own error makes of it. Images
in folders are of the camera that the folder is called after; those in no folder of the camera with their lens, where all
those with one lens have one pose, or else each of a camera of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray

__all__ = ["Shot", "Still", "path_of", "still_cameras", "told_apart"]

# How far a camera's poses, one of each image, may be apart: twice what images with some hundred points have (choice), as an
# angle in degrees and a share of the largest distance between cameras.
MAX_TURN, MAX_SHIFT = 0.2, 0.005
_IMAGES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".pgm", ".ppm", ".jp2", ".dng", ".exr")


class Shot(NamedTuple):
    """An image with a pose camera_from_world: (4,) quaternion, w last, and (3,) translation. `lens` is the key of its lens.

    Its path is without the suffix of its file.
    """

    path: PurePosixPath
    lens: str
    quaternion: FloatArray
    translation: FloatArray


class Still(NamedTuple):
    """A camera that stood still, with the key of its lens."""

    name: str
    lens: str
    camera_from_world: RigidTransform


def path_of(name: str) -> PurePosixPath:
    """An image's path by a name that has a suffix, or has none."""
    path = PurePosixPath(name.replace("\\", "/"))
    return path.with_suffix("") if path.suffix.lower() in _IMAGES else path


def still_cameras(shots: Sequence[Shot], path: Path) -> list[Still]:
    """The cameras of images, in the order of their lenses, then of their names.

    Raises:
        ValueError: naming the file, and the camera of which the images have several poses or lenses; no images.
    """
    if not shots:
        raise ValueError(f"{path}: no image in it has a pose")
    groups = _by_camera(shots)
    means = {name: _mean(its) for name, its in groups.items()}
    centers = np.array([pose.inv().translation for pose in means.values()])
    extent = max(float(np.linalg.norm(centers - center, axis=1).max()) for center in centers)
    order = {lens: k for k, lens in enumerate(dict.fromkeys(shot.lens for shot in shots))}
    found = []
    for name, its in groups.items():
        if len(lenses := sorted({shot.lens for shot in its})) > 1:
            raise ValueError(
                f"{path}: camera {name}: its {len(its)} images have {len(lenses)} lenses: {', '.join(lenses)}"
            )
        _check_still(name, its, means[name], extent, path)
        found.append(Still(name, its[0].lens, means[name]))
    return sorted(found, key=lambda still: (order[still.lens], still.name))


def told_apart(folders: Sequence[PurePosixPath]) -> list[str]:
    """Names of folders: their last parts, where these are different."""
    last = [folder.name for folder in folders]
    return last if len(set(last)) == len(last) else ["_".join(folder.parts) for folder in folders]


def _by_camera(shots: Sequence[Shot]) -> dict[str, list[Shot]]:
    """By the camera's name."""
    in_folders = all(len(shot.path.parts) > 1 for shot in shots)
    of_lens: dict[str, list[Shot]] = {}
    for shot in shots:
        of_lens.setdefault(shot.lens, []).append(shot)
    together = all(_spread(its, _mean(its))[0] <= MAX_TURN for its in of_lens.values())
    found: dict[PurePosixPath, list[Shot]] = {}
    for shot in shots:
        key = shot.path.parent if in_folders else PurePosixPath(shot.lens) if together else shot.path
        found.setdefault(key, []).append(shot)
    if in_folders:
        names = told_apart(list(found))
    else:
        names = [its[0].path.name if len(its) == 1 else str(key) for key, its in found.items()]
    if len(set(names)) < len(names):
        names = [str(key).replace("/", "_") for key in found]
    return dict(zip(names, found.values(), strict=True))


def _poses(shots: Sequence[Shot]) -> RigidTransform:
    """camera_from_world of each image."""
    turns = Rotation.from_quat(np.array([shot.quaternion for shot in shots]))
    return RigidTransform.from_components(np.array([shot.translation for shot in shots]), turns)


def _mean(shots: Sequence[Shot]) -> RigidTransform:
    """camera_from_world of a camera that stood still."""
    poses = _poses(shots)
    if (poses.as_matrix() == poses[0].as_matrix()).all():
        return poses[0]
    rotation = poses.rotation.mean()
    return RigidTransform.from_components(-rotation.apply(poses.inv().translation.mean(axis=0)), rotation)


def _spread(shots: Sequence[Shot], mean: RigidTransform) -> tuple[float, float]:
    """The largest turn, degrees, and the largest distance of an image's pose from their mean."""
    poses = _poses(shots)
    shifts = np.linalg.norm(poses.inv().translation - mean.inv().translation, axis=1)
    return float(np.degrees((poses.rotation * mean.rotation.inv()).magnitude().max())), float(shifts.max())


def _check_still(name: str, shots: Sequence[Shot], mean: RigidTransform, extent: float, path: Path) -> None:
    turn, shift = _spread(shots, mean)
    # One camera alone: how far it is from the origin, which such programs have among the points.
    scale = extent if extent > 0 else float(np.linalg.norm(mean.inv().translation))
    if turn <= MAX_TURN and shift <= MAX_SHIFT * scale:
        return
    raise ValueError(
        f"{path}: camera {name}: its {len(shots)} images do not have one pose: they are up to {turn:.2f} degrees and "
        f"{shift:.2g} units away from their mean; sylpose is for cameras that do not move"
    )
