"""DeepLabCut's camera_matrix/stereo_params.pickle, of cv2.stereoCalibrate; read without running what is in it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from scipy.spatial.transform import RigidTransform

from sylpose.calibration.camera_builder import Sizes, make_camera, make_pose, make_rig, numbers, sizes_of
from sylpose.calibration.safe_pickle import unpickled
from sylpose.input_limits import bytes_of
from sylpose.rig import Rig

__all__ = ["STEREO", "is_pickle", "read"]

# Bytes (choice: ten times those of a pair of cameras).
MAX_PICKLE = 2**16
STEREO = "stereo_params.pickle"
_INTRINSIC = "_intrinsic_params.pickle"
_KEYS = ("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2", "R", "T")


def is_pickle(path: Path) -> bool:
    """Whether a file's name is a pickle's."""
    return path.suffix.lower() in (".pickle", ".pkl")


def read(_: Any, path: Path, sizes: Sizes | None = None) -> Rig:
    """The rig of the file, or of the stereo_params.pickle beside one of a camera alone.

    Raises:
        ValueError: naming the file: not such a pickle, anything in it but numbers, or no pair of cameras.
    """
    if path.name.endswith(_INTRINSIC):
        stereo = path.with_name(STEREO)
        if not stereo.is_file():
            raise ValueError(
                f"{path}: this is DeepLabCut's of one camera alone; {STEREO}, which has both, is not beside it"
            )
        path = stereo
    data = unpickled(bytes_of(path, MAX_PICKLE))
    pairs = {key: value for key, value in data.items() if isinstance(value, dict)} if isinstance(data, dict) else {}
    if len(pairs) != 1 or not all(isinstance(key, str) for key in pairs):
        raise ValueError(f"{path}: a pickle, but not DeepLabCut's {STEREO} with a pair of cameras")
    ((key, pair),) = pairs.items()
    if lacking := [name for name in _KEYS if pair.get(name) is None]:
        raise ValueError(f"{path}: a pickle without {', '.join(lacking)} of DeepLabCut's {STEREO}")
    names = _names(key, path)
    values = {name: getattr(pair[name], "value", None) for name in _KEYS}
    if any(value is None for value in values.values()):
        raise ValueError(f"{path}: {', '.join(_KEYS)} must be arrays")
    shape = pair.get("image_shape")
    if isinstance(shape, (list, tuple)) and len(shape) == 2:
        known: dict[str, Any] = {
            name: numbers(size, 2, f"{path}: image_shape") for name, size in zip(names, shape, strict=True)
        }
    else:
        known = dict(sizes_of(path, names, sizes))
    poses = [RigidTransform.identity(), make_pose(path, names[1], values["R"], values["T"])]
    return make_rig(
        path,
        [
            make_camera(
                path,
                name,
                size=known[name],
                matrix=values[f"cameraMatrix{i}"],
                distortion=values[f"distCoeffs{i}"],
                camera_from_world=pose,
                lens="opencv",
            )
            for i, (name, pose) in enumerate(zip(names, poses, strict=True), start=1)
        ],
    )


def _names(key: str, path: Path) -> list[str]:
    """The two names that a pair's key is made of, with a dash between: by the cameras' own files, or in its middle."""
    alone = sorted(file.name.removesuffix(_INTRINSIC) for file in path.parent.glob(f"*{_INTRINSIC}"))
    for first in alone:
        if key.startswith(f"{first}-") and key.removeprefix(f"{first}-") in alone:
            return [first, key.removeprefix(f"{first}-")]
    parts = key.split("-")
    half = len(parts) // 2
    if len(parts) % 2:
        raise ValueError(f"{path}: which two cameras {key!r} means is not clear without their {_INTRINSIC} beside it")
    return ["-".join(parts[:half]), "-".join(parts[half:])]
