"""An object as files: object.npz for another take (docs/formats.md, "object.npz"), object.ply to look at."""

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
from sylpose.atomic_io import replacing
from sylpose.features.sift import Features
from sylpose.geometry.arrays import FloatArray
from sylpose.input_limits import told
from sylpose.landmarks.landmark_filter import Landmarks
from sylpose.rig import Camera, Rig
from sylpose.tracking.frame import SolvedFrame
from sylpose.tracking.known_object import FEWEST, CameraMemory, KnownObject, ObjectFrame
from sylpose.tracking.object_transfer import check_unit

__all__ = ["CLOUD", "DRAWN", "OBJECT", "checksum_of", "known_objects", "load_object", "save_object", "write_cloud"]

OBJECT, CLOUD = "object.npz", "object.ply"
FORMAT = "sylpose object 1"
# Bytes of all arrays together; lengths in the calibration's unit (choice).
LARGEST, FARTHEST = 1 << 29, 1e9
# Landmarks whose depth is known to this share of the object's radius are drawn (choice).
DRAWN = 0.1
# Rows of colours, from cameras that are told apart to the eye.
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
    radius: Annotated[float, msgspec.Meta(gt=0, lt=FARTHEST)]
    scale_sd: Annotated[float, msgspec.Meta(ge=0, le=1)]
    object_from_learnt: _POSE
    frame_sd: Annotated[
        list[Annotated[float, msgspec.Meta(ge=0, lt=FARTHEST)]], msgspec.Meta(min_length=6, max_length=6)
    ]
    frame_said: _TEXT
    cameras: Annotated[list[_Camera], msgspec.Meta(min_length=1, max_length=10_000)]


def save_object(known: KnownObject, path: Path | str) -> None:
    """Writes what is known of an object.

    Args:
        known: of `load_object`, or as a run has learnt it.
        path: of the file, object.npz as a rule; replaced when it is there.

    Raises:
        OSError: naming the file, when it cannot be written.
    """
    parts = dict[str, list[NDArray[Any]]]()
    arrays: dict[str, NDArray[Any]] = {
        "points": known._points,
        "keyframe_time": np.array([k.time for k in known._keyframes]),
        "keyframe_age": np.array([k.age for k in known._keyframes]),
        "keyframe_stays": np.array([k.stays for k in known._keyframes]),
        "keyframe_world_from_object": np.array([k.world_from_object.as_matrix() for k in known._keyframes]),
        "keyframe_covariance": np.array([k.covariance for k in known._keyframes]),
    }
    for c, memory in enumerate(known._cameras.values()):
        its = memory.landmarks
        _put(parts, "landmark", camera=np.full(len(its), c), id=its.id, place=its.mean, information=its.information)
        _put(parts, "landmark", seen=its.seen, origin=its.origin)
        for k, (features, numbers) in enumerate(zip(memory.features, memory.numbers, strict=True)):
            n = len(features)
            _put(parts, "feature", camera=np.full(n, c), keyframe=np.full(n, k), landmark=numbers)
            _put(
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
        known.mark,
        known.unit,
        known.radius,
        known.scale_sd,
        frame.from_learnt.as_matrix().tolist(),
        frame.sd.tolist(),
        frame.said,
        [_told(known.rig[name]) for name in known._cameras],
    )
    typed = {name: arrays[name].astype(f"<{kind}") for name, (kind, _) in _ARRAYS.items()}
    with replacing(path) as part, part.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, header=np.array(msgspec.json.encode(header).decode()), **typed)


def _told(camera: Camera) -> _Camera:
    return _Camera(
        camera.name,
        camera.size,
        camera.matrix.tolist(),
        camera.distortion.tolist(),
        camera.camera_from_world.as_matrix().tolist(),
        camera.lens,
        camera.error_px,
    )


def _put(parts: dict[str, list[NDArray[Any]]], of: str, **rows: NDArray[Any]) -> None:
    for name, values in rows.items():
        parts.setdefault(f"{of}_{name}", []).append(values)


def load_object(path: Path | str) -> KnownObject:
    """Reads what `save_object` has written.

    Args:
        path: of object.npz.

    Raises:
        FileNotFoundError: no such file.
        ValueError: naming the file: it is no object of sylpose, of another format, damaged or absurd.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; the object.npz of another run is expected")
    with told(path):
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
            raise ValueError(f"not an object of sylpose, or damaged ({error})") from None
        return _object(header, arrays)


def _read(path: Path) -> tuple[_Header, dict[str, NDArray[Any]]]:
    with zipfile.ZipFile(path) as archive:
        infos = archive.infolist()
        if sorted(info.filename for info in infos) != sorted(f"{name}.npy" for name in (*_ARRAYS, "header")):
            raise ValueError("other arrays than an object has")
        if sum(info.file_size for info in infos) > LARGEST:
            raise ValueError(f"more than {LARGEST >> 20} MB")
    arrays, sizes = dict[str, NDArray[Any]](), dict[str, int]()
    with np.load(path, allow_pickle=False) as file:
        word = file["header"]
        if word.dtype.kind != "U" or word.shape:
            raise ValueError("its header is no word")
        header = msgspec.json.decode(str(word), type=_Header)
        if header.format != FORMAT:
            raise ValueError(f"the format is {header.format!r}; this version of sylpose reads {FORMAT!r}")
        for name, (kind, shape) in _ARRAYS.items():
            values = file[name]
            rows = len(values) if values.ndim else 0
            wanted = tuple(n if isinstance(n, int) else sizes.setdefault(n, rows) for n in shape)
            if values.dtype != np.dtype(f"<{kind}") or values.shape != wanted:
                raise ValueError(f"{name} has the type {values.dtype} and the shape {values.shape}")
            if kind != "i8" and not (np.abs(values.astype(float)) <= FARTHEST**2).all():
                raise ValueError(f"{name} has numbers that are not finite, or absurd")
            arrays[name] = values
    return header, arrays


def _object(header: _Header, a: Mapping[str, NDArray[Any]]) -> KnownObject:
    """Raises ValueError: arrays that contradict each other."""
    k, c = len(a["keyframe_time"]), len(header.cameras)
    if k < FEWEST or (np.diff(a["keyframe_time"]) <= 0).any():
        raise ValueError("too few keyframes, or out of order")
    poses = _poses("keyframe_world_from_object", a["keyframe_world_from_object"])
    for name in ("keyframe_covariance", "landmark_information"):
        if not _are_covariances(a[name]):
            raise ValueError(f"{name} has matrices that are not symmetric and positive")
    whole = {"landmark_camera": c, "feature_camera": c, "feature_keyframe": k}
    for name, most in {**whole, "keyframe_stays": 2, "landmark_id": 1 << 31, "landmark_seen": 1 << 31}.items():
        if ((a[name] < 0) | (a[name] >= most)).any():
            raise ValueError(f"{name} has numbers of what is not there")
    frames = tuple(
        SolvedFrame(
            number=i,
            time=float(a["keyframe_time"][i]),
            late=np.empty(0),
            world_from_object=poses[i],
            covariance=a["keyframe_covariance"][i],
            viewpoints=np.empty((0, 3)),
            sees=np.empty(0, bool),
            age=float(a["keyframe_age"][i]),
            stays=bool(a["keyframe_stays"][i]),
        )
        for i in range(k)
    )
    cameras = [_camera(told) for told in header.cameras]
    (from_learnt,) = _poses("object_from_learnt", [header.object_from_learnt])
    frame = ObjectFrame(from_learnt, np.array(header.frame_sd), header.frame_said)
    return KnownObject(
        Rig(cameras, header.unit),
        header.radius,
        header.mark,
        a["points"],
        frames,
        {camera.name: _memory(i, k, a) for i, camera in enumerate(cameras)},
        frame,
        header.scale_sd,
    )


def _camera(told: _Camera) -> Camera:
    (pose,) = _poses(f"camera {told.name}: camera_from_world", [told.camera_from_world])
    matrix = _matrices(f"camera {told.name}: matrix", [told.matrix], 3)[0]
    return Camera(told.name, told.size, matrix, np.array(told.distortion), pose, told.lens, told.error_px)


def _matrices(name: str, given: ArrayLike, n: int) -> FloatArray:
    """(k, n, n) of lists of rows, which may be of any length."""
    matrices = np.array(given, dtype=object)
    if matrices.shape[1:] != (n, n):
        raise ValueError(f"{name}: no {n} x {n} matrix")
    return matrices.astype(float)


def _poses(name: str, given: ArrayLike) -> list[RigidTransform]:
    """Of matrices (k, 4, 4), to the bit."""
    matrices = _matrices(name, given, 4)
    about = matrices[:, :3, :3]
    known = bool((np.abs(matrices) <= FARTHEST).all())
    rigid = known and np.abs(about @ about.swapaxes(1, 2) - np.eye(3)).max() < 1e-6 and (np.linalg.det(about) > 0).all()
    if not rigid or not (matrices[:, 3] == [0, 0, 0, 1]).all():
        raise ValueError(f"{name} has matrices that are no poses")
    return [RigidTransform(matrix, normalize=False) for matrix in matrices]


def _are_covariances(matrices: FloatArray) -> bool:
    """Whether matrices (n, d, d) are symmetric and positive, to rounding."""
    rounding = 1e-6 * np.abs(matrices).max(axis=(1, 2), initial=0.0)[:, None]
    symmetric = np.abs(matrices - matrices.swapaxes(1, 2)).max(axis=(1, 2), initial=0.0)[:, None] <= rounding
    return bool(symmetric.all() and (np.linalg.eigvalsh(matrices) >= -rounding).all())


def _memory(c: int, keyframes: int, a: Mapping[str, NDArray[Any]]) -> CameraMemory:
    mine = a["landmark_camera"] == c
    ids = a["landmark_id"][mine]
    if (np.diff(ids) <= 0).any():
        raise ValueError("landmark_id: numbers that are not in order")
    landmarks = Landmarks(
        mean=a["landmark_place"][mine],
        information=a["landmark_information"][mine],
        seen=a["landmark_seen"][mine],
        moved=np.ones(len(ids), bool),
        origin=a["landmark_origin"][mine],
        id=ids,
    )
    features, numbers = [], []
    for k in range(keyframes):
        at = (a["feature_camera"] == c) & (a["feature_keyframe"] == k)
        looks = a["feature_descriptor"][at].astype(np.float32)
        features.append(Features(a["feature_pixels"][at], a["feature_normalized"][at], looks))
        numbers.append(a["feature_landmark"][at])
    if not np.isin(np.concatenate(numbers), ids).all():
        raise ValueError("feature_landmark has numbers of what is not there")
    return CameraMemory(landmarks, tuple(features), tuple(numbers))


def known_objects(given: Sequence[str] | None, objects: Sequence[str], rig: Rig) -> dict[str, KnownObject]:
    """What `--object` asks for, by name of the object.

    Args:
        given: FILE, or NAME=FILE where there are several.
        objects: their names.
        rig: that is going to see them.

    Raises:
        FileNotFoundError, ValueError: as `load_object` and `check_unit`; names that there are not, or twice.
    """
    known: dict[str, KnownObject] = {}
    for text in given or ():
        name, found, file = text.partition("=")
        if len(objects) == 1 and (not found or name != objects[0]):
            name, file = objects[0], text
        elif name not in objects or not found:
            raise ValueError(f"--object: NAME=FILE is expected, for one of {', '.join(objects)}, got {text!r}")
        if name in known:
            raise ValueError(f"--object: given twice for {name}")
        its = load_object(file)
        with told(file):
            check_unit(its, rig)
        known[name] = its
    return known


def checksum_of(known: KnownObject) -> str:
    """Of what a result depends on in it."""
    total, frame = hashlib.blake2b(digest_size=16), known.frame.from_learnt.as_matrix().tolist()
    told = [known.unit, known.radius, known.scale_sd, frame, [k.time for k in known._keyframes]]
    total.update(json.dumps(told).encode())
    for name, memory in known._cameras.items():
        total.update(name.encode())
        total.update(memory.landmarks.mean.tobytes())
    return total.hexdigest()


def write_cloud(known: KnownObject, path: Path | str) -> None:
    """The places of the landmarks that are known well, as points in the object's frame with the colour of the camera that
    saw them and their standard deviation, in PLY.

    Raises:
        OSError: naming the file, when it cannot be written.
    """
    rows = []
    for c, memory in enumerate(known._cameras.values()):
        sd = memory.landmarks.depth_sd
        good = sd < DRAWN * known.radius
        table = np.zeros(int(good.sum()), [("place", "<f4", 3), ("color", "u1", 3), ("sd", "<f4")])
        places = known.frame.from_learnt.apply(memory.landmarks.mean[good]).reshape(-1, 3)
        table["place"], table["color"], table["sd"] = places, COLORS[c % len(COLORS)], sd[good]
        rows.append(table)
    points, unit = np.concatenate(rows), known.unit or "units of the calibration"
    said = [f"comment places on the object, in {unit}; cameras: {', '.join(known._cameras)}"]
    said += [f"element vertex {len(points)}", *(f"property float {n}" for n in "xyz")]
    said += [*(f"property uchar {n}" for n in ("red", "green", "blue")), "property float sd", "end_header"]
    head = "\n".join(["ply", "format binary_little_endian 1.0", *said]) + "\n"
    with replacing(path) as part:
        part.write_bytes(head.encode("ascii", "replace") + points.tobytes())
