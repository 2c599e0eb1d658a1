"""DeepLabCut's camera_matrix/stereo_params.pickle, from cv2.stereoCalibrate; read without executing its content."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from scipy.spatial.transform import RigidTransform

from sylpose.input_limits import read_bytes
from sylpose.io.calibration.camera_builder import (
    SizeLookup,
    lookup_sizes,
    make_camera,
    make_pose,
    make_rig,
    parse_numbers,
)
from sylpose.io.calibration.safe_pickle import load_safely
from sylpose.rig import Rig

__all__ = ["STEREO_FILE", "is_pickle", "read"]

# Maximum bytes (choice: ten times those of a pair of cameras).
MAX_PICKLE = 2**16
STEREO_FILE = "stereo_params.pickle"
_INTRINSIC_SUFFIX = "_intrinsic_params.pickle"
_KEYS = ("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2", "R", "T")


def is_pickle(path: Path) -> bool:
    """Return whether a file has the suffix of a pickle."""
    return path.suffix.lower() in (".pickle", ".pkl")


def read(_: Any, path: Path, sizes: SizeLookup | None = None) -> Rig:
    """Read the rig of the file, or of the stereo_params.pickle next to the file of a single camera.

    Raises:
        ValueError: naming the file: not such a pickle, content other than numbers, or no pair of cameras.
    """
    if path.name.endswith(_INTRINSIC_SUFFIX):
        stereo = path.with_name(STEREO_FILE)
        if not stereo.is_file():
            raise ValueError(
                f"{path}: this is DeepLabCut's file of a single camera; {STEREO_FILE}, with both, is not next to it"
            )
        path = stereo
    data = load_safely(read_bytes(path, MAX_PICKLE))
    pairs = {key: value for key, value in data.items() if isinstance(value, dict)} if isinstance(data, dict) else {}
    if len(pairs) != 1 or not all(isinstance(key, str) for key in pairs):
        raise ValueError(f"{path}: a pickle, but not DeepLabCut's {STEREO_FILE} with a pair of cameras")
    ((key, pair),) = pairs.items()
    if missing := [name for name in _KEYS if pair.get(name) is None]:
        raise ValueError(f"{path}: a pickle without {', '.join(missing)} of DeepLabCut's {STEREO_FILE}")
    names = _split_names(key, path)
    values = {name: getattr(pair[name], "value", None) for name in _KEYS}
    if any(value is None for value in values.values()):
        raise ValueError(f"{path}: {', '.join(_KEYS)} must be arrays")
    shape = pair.get("image_shape")
    if isinstance(shape, (list, tuple)) and len(shape) == 2:
        known_sizes: dict[str, Any] = {
            name: parse_numbers(size, 2, f"{path}: image_shape") for name, size in zip(names, shape, strict=True)
        }
    else:
        known_sizes = dict(lookup_sizes(path, names, sizes))
    poses = [RigidTransform.identity(), make_pose(path, names[1], values["R"], values["T"])]
    return make_rig(
        path,
        [
            make_camera(
                path,
                name,
                size=known_sizes[name],
                matrix=values[f"cameraMatrix{i}"],
                distortion=values[f"distCoeffs{i}"],
                camera_from_world=pose,
                lens="opencv",
            )
            for i, (name, pose) in enumerate(zip(names, poses, strict=True), start=1)
        ],
    )


def _split_names(key: str, path: Path) -> list[str]:
    """Split a pair's key, two names joined by a dash: by the cameras' own files, or else in its middle."""
    single_names = sorted(
        file.name.removesuffix(_INTRINSIC_SUFFIX) for file in path.parent.glob(f"*{_INTRINSIC_SUFFIX}")
    )
    for first in single_names:
        if key.startswith(f"{first}-") and key.removeprefix(f"{first}-") in single_names:
            return [first, key.removeprefix(f"{first}-")]
    parts = key.split("-")
    half = len(parts) // 2
    if len(parts) % 2:
        raise ValueError(f"{path}: the camera names in {key!r} are ambiguous without their {_INTRINSIC_SUFFIX} files")
    return ["-".join(parts[:half]), "-".join(parts[half:])]
