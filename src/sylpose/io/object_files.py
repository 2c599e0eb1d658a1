"""Object files: object.npz for other recordings (docs/formats.md, "object.npz") and object.ply for viewing."""

from __future__ import annotations

import hashlib
import json
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import RigidTransform

from sylpose import __version__
from sylpose.atomic_io import replace_atomically
from sylpose.features.sift import Features
from sylpose.geometry.arrays import FloatArray
from sylpose.input_limits import input_errors
from sylpose.landmarks.landmark_filter import Landmarks
from sylpose.rig import Camera, Rig
from sylpose.tracking.frame import SolvedFrame
from sylpose.tracking.known_object import MIN_KEYFRAMES, CameraLandmarks, KnownObject, ObjectFrame
from sylpose.tracking.object_transfer import check_unit

__all__ = [
    "CLOUD_FILE",
    "MAX_DRAWN_DEPTH_SD",
    "OBJECT_FILE",
    "load_known_objects",
    "load_object",
    "object_checksum",
    "save_object",
    "write_cloud",
]

OBJECT_FILE, CLOUD_FILE = "object.npz", "object.ply"
FORMAT = "sylpose object 1"
# Largest total size of the arrays in bytes, and largest length in the calibration's unit (choice).
MAX_BYTES, MAX_LENGTH = 1 << 29, 1e9
# Landmarks whose depth sd is below this share of the object's radius are drawn (choice).
MAX_DRAWN_DEPTH_SD = 0.1
# Colors of the cameras, easy to distinguish.
COLORS = np.array(
    [[213, 94, 0], [0, 114, 178], [0, 158, 115], [204, 121, 167], [230, 159, 0], [86, 180, 233]], np.uint8
)
_NAME = Annotated[str, msgspec.Meta(pattern=r"^[^\x00-\x1f\x7f]+$", max_length=200)]
_TEXT = Annotated[str, msgspec.Meta(pattern=r"^[^\x00-\x1f\x7f]*$", max_length=200)]
# A matrix's rows.
_POSE = Annotated[
    list[Annotated[list[float], msgspec.Meta(min_length=3, max_length=4)]], msgspec.Meta(min_length=3, max_length=4)
]
# Names, types and shapes of the arrays: K keyframes, L landmarks, F features, P points.
_ARRAYS: Mapping[str, tuple[str, tuple[str | int, ...]]] = {
    "points": ("f8", ("P", 3)),
    "keyframe_time": ("f8", ("K",)),
    "keyframe_age": ("f8", ("K",)),
    "keyframe_stays": ("i8", ("K",)),
    "keyframe_world_from_object": ("f8", ("K", 4, 4)),
    "keyframe_covariance": ("f8", ("K", 6, 6)),
    "landmark_camera": ("i8", ("L",)),
    "landmark_id": ("i8", ("L",)),
    "landmark_place": ("f8", ("L", 3)),
    "landmark_information": ("f8", ("L", 3, 3)),
    "landmark_seen": ("i8", ("L",)),
    "landmark_origin": ("f8", ("L", 2)),
    "feature_camera": ("i8", ("F",)),
    "feature_keyframe": ("i8", ("F",)),
    "feature_landmark": ("i8", ("F",)),
    "feature_pixels": ("f8", ("F", 2)),
    "feature_normalized": ("f8", ("F", 2)),
    "feature_descriptor": ("f2", ("F", 128)),
}


class _Camera(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: _NAME
    size: tuple[int, int]
    matrix: _POSE
    distortion: Annotated[list[float], msgspec.Meta(max_length=14)]
    camera_from_world: _POSE
    lens: Literal["opencv", "fisheye"]
    error_px: float | None


class _Header(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    format: str
    version: Annotated[str, msgspec.Meta(pattern=r"^[\w.+-]{1,40}$")]
    mark: Annotated[str, msgspec.Meta(pattern=r"^[0-9a-f]{1,64}$")]
    unit: _TEXT
    radius: Annotated[float, msgspec.Meta(gt=0, lt=MAX_LENGTH)]
    scale_sd: Annotated[float, msgspec.Meta(ge=0, le=1)]
    object_from_learned: _POSE
    frame_sd: Annotated[
        list[Annotated[float, msgspec.Meta(ge=0, lt=MAX_LENGTH)]], msgspec.Meta(min_length=6, max_length=6)
    ]
    frame_description: _TEXT
    cameras: Annotated[list[_Camera], msgspec.Meta(min_length=1, max_length=10_000)]


def save_object(known: KnownObject, path: Path | str) -> None:
    """Write an object model to a file.

    Args:
        known: from `load_object` or from a run.
        path: the file, usually object.npz; replaced if it exists.

    Raises:
        OSError: the file cannot be written; the message names it.
    """
    parts = dict[str, list[NDArray[Any]]]()
    arrays: dict[str, NDArray[Any]] = {
        "points": known._points,
        "keyframe_time": np.array([k.time for k in known._keyframes]),
        "keyframe_age": np.array([k.landmark_age for k in known._keyframes]),
        "keyframe_stays": np.array([k.is_fixed for k in known._keyframes]),
        "keyframe_world_from_object": np.array([k.world_from_object.as_matrix() for k in known._keyframes]),
        "keyframe_covariance": np.array([k.covariance for k in known._keyframes]),
    }
    for c, memory in enumerate(known._cameras.values()):
        landmarks = memory.landmarks
        _append_rows(
            parts,
            "landmark",
            camera=np.full(len(landmarks), c),
            id=landmarks.id,
            place=landmarks.mean,
            information=landmarks.information,
        )
        _append_rows(parts, "landmark", seen=landmarks.n_observations, origin=landmarks.origin)
        for k, (features, numbers) in enumerate(zip(memory.features, memory.landmark_ids, strict=True)):
            n = len(features)
            _append_rows(parts, "feature", camera=np.full(n, c), keyframe=np.full(n, k), landmark=numbers)
            _append_rows(
                parts,
                "feature",
                pixels=features.pixels,
                normalized=features.normalized,
                descriptor=features.descriptors,
            )
    arrays |= {name: np.concatenate(rows) for name, rows in parts.items()}
    frame = known.frame
    header = _Header(
        FORMAT,
        __version__,
        known.fingerprint,
        known.unit,
        known.radius,
        known.scale_sd,
        frame.from_learned.as_matrix().tolist(),
        frame.sd.tolist(),
        frame.description,
        [_encode_camera(known.rig[name]) for name in known._cameras],
    )
    typed = {name: arrays[name].astype(f"<{kind}") for name, (kind, _) in _ARRAYS.items()}
    with replace_atomically(path) as part, part.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, header=np.array(msgspec.json.encode(header).decode()), **typed)


def _encode_camera(camera: Camera) -> _Camera:
    return _Camera(
        camera.name,
        camera.size,
        camera.matrix.tolist(),
        camera.distortion.tolist(),
        camera.camera_from_world.as_matrix().tolist(),
        camera.lens,
        camera.error_px,
    )


def _append_rows(parts: dict[str, list[NDArray[Any]]], prefix: str, **rows: NDArray[Any]) -> None:
    for name, values in rows.items():
        parts.setdefault(f"{prefix}_{name}", []).append(values)


def load_object(path: Path | str) -> KnownObject:
    """Read an object model that `save_object` has written.

    Args:
        path: the file, usually object.npz.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not a sylpose object file, another format, damaged, or values out of range; the message names it.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; expected the object.npz of an earlier run")
    with input_errors(path):
        try:
            header, arrays = _read(path)
        except (
            zipfile.BadZipFile,
            zlib.error,
            EOFError,
            KeyError,
            RuntimeError,
            SyntaxError,
            OSError,
            ValueError,
        ) as error:
            raise ValueError(f"not a sylpose object file, or damaged ({error})") from None
        return _decode_object(header, arrays)


def _read(path: Path) -> tuple[_Header, dict[str, NDArray[Any]]]:
    with zipfile.ZipFile(path) as archive:
        infos = archive.infolist()
        if sorted(info.filename for info in infos) != sorted(f"{name}.npy" for name in (*_ARRAYS, "header")):
            raise ValueError("its arrays are not those of a sylpose object")
        if sum(info.file_size for info in infos) > MAX_BYTES:
            raise ValueError(f"more than {MAX_BYTES >> 20} MB")
    arrays, sizes = dict[str, NDArray[Any]](), dict[str, int]()
    with np.load(path, allow_pickle=False) as file:
        header_text = file["header"]
        if header_text.dtype.kind != "U" or header_text.shape:
            raise ValueError("its header is not a string")
        header = msgspec.json.decode(str(header_text), type=_Header)
        if header.format != FORMAT:
            raise ValueError(f"the format is {header.format!r}; this version of sylpose reads {FORMAT!r}")
        for name, (kind, shape) in _ARRAYS.items():
            values = file[name]
            rows = len(values) if values.ndim else 0
            expected = tuple(n if isinstance(n, int) else sizes.setdefault(n, rows) for n in shape)
            if values.dtype != np.dtype(f"<{kind}") or values.shape != expected:
                raise ValueError(f"{name} has the type {values.dtype} and the shape {values.shape}")
            if kind != "i8" and not (np.abs(values.astype(float)) <= MAX_LENGTH**2).all():
                raise ValueError(f"{name} has numbers that are not finite or too large")
            arrays[name] = values
    return header, arrays


def _decode_object(header: _Header, a: Mapping[str, NDArray[Any]]) -> KnownObject:
    """Build the object model; raise ValueError for arrays that contradict each other."""
    k, c = len(a["keyframe_time"]), len(header.cameras)
    if k < MIN_KEYFRAMES or (np.diff(a["keyframe_time"]) <= 0).any():
        raise ValueError("too few keyframes, or out of order")
    poses = _decode_poses("keyframe_world_from_object", a["keyframe_world_from_object"])
    for name in ("keyframe_covariance", "landmark_information"):
        if not _are_covariances(a[name]):
            raise ValueError(f"{name} has matrices that are not positive semidefinite")
    limits = {"landmark_camera": c, "feature_camera": c, "feature_keyframe": k}
    for name, limit in {**limits, "keyframe_stays": 2, "landmark_id": 1 << 31, "landmark_seen": 1 << 31}.items():
        if ((a[name] < 0) | (a[name] >= limit)).any():
            raise ValueError(f"{name} has indices out of range")
    frames = tuple(
        SolvedFrame(
            number=i,
            time=float(a["keyframe_time"][i]),
            time_offsets=np.empty(0),
            world_from_object=poses[i],
            covariance=a["keyframe_covariance"][i],
            viewpoints=np.empty((0, 3)),
            is_visible=np.empty(0, bool),
            landmark_age=float(a["keyframe_age"][i]),
            is_fixed=bool(a["keyframe_stays"][i]),
        )
        for i in range(k)
    )
    cameras = [_decode_camera(camera) for camera in header.cameras]
    (from_learned,) = _decode_poses("object_from_learned", [header.object_from_learned])
    frame = ObjectFrame(from_learned, np.array(header.frame_sd), header.frame_description)
    return KnownObject(
        Rig(cameras, header.unit),
        header.radius,
        header.mark,
        a["points"],
        frames,
        {camera.name: _decode_camera_landmarks(i, k, a) for i, camera in enumerate(cameras)},
        frame,
        header.scale_sd,
    )


def _decode_camera(stored: _Camera) -> Camera:
    (pose,) = _decode_poses(f"camera {stored.name}: camera_from_world", [stored.camera_from_world])
    matrix = _decode_matrices(f"camera {stored.name}: matrix", [stored.matrix], 3)[0]
    return Camera(stored.name, stored.size, matrix, np.array(stored.distortion), pose, stored.lens, stored.error_px)


def _decode_matrices(name: str, values: ArrayLike, n: int) -> FloatArray:
    """Convert lists of rows, whose lengths are checked, to matrices (k, n, n)."""
    matrices = np.array(values, dtype=object)
    if matrices.shape[1:] != (n, n):
        raise ValueError(f"{name}: expected a {n} x {n} matrix")
    return matrices.astype(float)


def _decode_poses(name: str, values: ArrayLike) -> list[RigidTransform]:
    """Convert matrices (k, 4, 4) to transforms without changing their values."""
    matrices = _decode_matrices(name, values, 4)
    rotations = matrices[:, :3, :3]
    finite = bool((np.abs(matrices) <= MAX_LENGTH).all())
    rigid = (
        finite
        and np.abs(rotations @ rotations.swapaxes(1, 2) - np.eye(3)).max() < 1e-6
        and (np.linalg.det(rotations) > 0).all()
    )
    if not rigid or not (matrices[:, 3] == [0, 0, 0, 1]).all():
        raise ValueError(f"{name} has matrices that are not rigid transforms")
    return [RigidTransform(matrix, normalize=False) for matrix in matrices]


def _are_covariances(matrices: FloatArray) -> bool:
    """Return whether matrices (n, d, d) are symmetric and positive semidefinite, up to rounding."""
    rounding = 1e-6 * np.abs(matrices).max(axis=(1, 2), initial=0.0)[:, None]
    symmetric = np.abs(matrices - matrices.swapaxes(1, 2)).max(axis=(1, 2), initial=0.0)[:, None] <= rounding
    return bool(symmetric.all() and (np.linalg.eigvalsh(matrices) >= -rounding).all())


def _decode_camera_landmarks(c: int, keyframes: int, a: Mapping[str, NDArray[Any]]) -> CameraLandmarks:
    of_camera = a["landmark_camera"] == c
    ids = a["landmark_id"][of_camera]
    if (np.diff(ids) <= 0).any():
        raise ValueError("landmark_id: ids are not increasing")
    landmarks = Landmarks(
        mean=a["landmark_place"][of_camera],
        information=a["landmark_information"][of_camera],
        n_observations=a["landmark_seen"][of_camera],
        has_moved=np.ones(len(ids), bool),
        origin=a["landmark_origin"][of_camera],
        id=ids,
    )
    features, numbers = [], []
    for k in range(keyframes):
        selected = (a["feature_camera"] == c) & (a["feature_keyframe"] == k)
        descriptors = a["feature_descriptor"][selected].astype(np.float32)
        features.append(Features(a["feature_pixels"][selected], a["feature_normalized"][selected], descriptors))
        numbers.append(a["feature_landmark"][selected])
    if not np.isin(np.concatenate(numbers), ids).all():
        raise ValueError("feature_landmark refers to missing landmarks")
    return CameraLandmarks(landmarks, tuple(features), tuple(numbers))


def load_known_objects(values: Sequence[str] | None, objects: Sequence[str], rig: Rig) -> dict[str, KnownObject]:
    """Load the object models of `--object`, by name.

    Args:
        values: FILE, or NAME=FILE for several objects.
        objects: names of the session's objects.
        rig: cameras of the session.

    Raises:
        FileNotFoundError, ValueError: as `load_object` and `check_unit`; a name that is unknown or given twice.
    """
    known: dict[str, KnownObject] = {}
    for text in values or ():
        name, separator, file = text.partition("=")
        if len(objects) == 1 and (not separator or name != objects[0]):
            name, file = objects[0], text
        elif name not in objects or not separator:
            raise ValueError(f"--object: expected NAME=FILE, for one of {', '.join(objects)}, got {text!r}")
        if name in known:
            raise ValueError(f"--object: given twice for {name}")
        model = load_object(file)
        with input_errors(file):
            check_unit(model, rig)
        known[name] = model
    return known


def object_checksum(known: KnownObject) -> str:
    """Return a checksum of the parts of an object model on which a run's result depends."""
    total, frame = hashlib.blake2b(digest_size=16), known.frame.from_learned.as_matrix().tolist()
    content = [known.unit, known.radius, known.scale_sd, frame, [k.time for k in known._keyframes]]
    total.update(json.dumps(content).encode())
    for name, memory in known._cameras.items():
        total.update(name.encode())
        total.update(memory.landmarks.mean.tobytes())
    return total.hexdigest()


def write_cloud(known: KnownObject, path: Path | str) -> None:
    """Write the landmarks with small depth uncertainty as a point cloud (PLY) in the object's frame.

    Each point has the color of its camera and its standard deviation.

    Raises:
        OSError: the file cannot be written; the message names it.
    """
    rows = []
    for c, memory in enumerate(known._cameras.values()):
        sd = memory.landmarks.depth_sd
        precise = sd < MAX_DRAWN_DEPTH_SD * known.radius
        table = np.zeros(int(precise.sum()), [("place", "<f4", 3), ("color", "u1", 3), ("sd", "<f4")])
        positions = known.frame.from_learned.apply(memory.landmarks.mean[precise]).reshape(-1, 3)
        table["place"], table["color"], table["sd"] = positions, COLORS[c % len(COLORS)], sd[precise]
        rows.append(table)
    points, unit = np.concatenate(rows), known.unit or "units of the calibration"
    header_lines = [f"comment landmarks on the object, in {unit}; cameras: {', '.join(known._cameras)}"]
    header_lines += [f"element vertex {len(points)}", *(f"property float {n}" for n in "xyz")]
    header_lines += [*(f"property uchar {n}" for n in ("red", "green", "blue")), "property float sd", "end_header"]
    head = "\n".join(["ply", "format binary_little_endian 1.0", *header_lines]) + "\n"
    with replace_atomically(path) as part:
        part.write_bytes(head.encode("ascii", "replace") + points.tobytes())
