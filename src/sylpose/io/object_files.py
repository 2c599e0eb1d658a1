"""Object files: object.npz for other recordings (docs/formats.md, "object.npz") and object.ply for viewing."""

from __future__ import annotations

import hashlib
import json
import re
import zipfile
from collections.abc import Mapping, Sequence
from math import prod
from pathlib import Path
from typing import Annotated, Any, BinaryIO, Literal, TypeAlias

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import RigidTransform

from sylpose import __version__
from sylpose.atomic_io import replace_atomically
from sylpose.features.sift import Features
from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.validation import check_shape
from sylpose.input_limits import input_errors, open_regular_file
from sylpose.landmarks.landmark_filter import Landmarks
from sylpose.rig import Camera, Rig
from sylpose.serialization import make_transforms
from sylpose.tracking.joint_side.joint_state import SolvedFrame
from sylpose.tracking.known_object import MIN_KEYFRAMES, CameraLandmarks, KnownObject, ObjectFrame, check_unit

OBJECT_FILE = "object.npz"
CLOUD_FILE = "object.ply"
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
_NUMBER = Annotated[float, msgspec.Meta(ge=-MAX_LENGTH, le=MAX_LENGTH)]
_SD = Annotated[float, msgspec.Meta(ge=0, lt=MAX_LENGTH)]
# Rows of matrices (3, 3) and (4, 4).
_Row3: TypeAlias = tuple[_NUMBER, _NUMBER, _NUMBER]
_Row4: TypeAlias = tuple[_NUMBER, _NUMBER, _NUMBER, _NUMBER]
_Pose: TypeAlias = tuple[_Row4, _Row4, _Row4, _Row4]
# Names, types and shapes of the arrays: K keyframes, L landmarks, F features, P points.
_ARRAYS: Mapping[str, tuple[str, tuple[str | int, ...]]] = {
    "points": ("<f8", ("P", 3)),
    "keyframe_time": ("<f8", ("K",)),
    "keyframe_age": ("<f8", ("K",)),
    "keyframe_stays": ("<i8", ("K",)),
    "keyframe_world_from_object": ("<f8", ("K", 4, 4)),
    "keyframe_covariance": ("<f8", ("K", 6, 6)),
    "landmark_camera": ("<i8", ("L",)),
    "landmark_id": ("<i8", ("L",)),
    "landmark_place": ("<f8", ("L", 3)),
    "landmark_information": ("<f8", ("L", 3, 3)),
    "landmark_seen": ("<i8", ("L",)),
    "landmark_origin": ("<f8", ("L", 2)),
    "feature_camera": ("<i8", ("F",)),
    "feature_keyframe": ("<i8", ("F",)),
    "feature_landmark": ("<i8", ("F",)),
    "feature_pixels": ("<f8", ("F", 2)),
    "feature_normalized": ("<f8", ("F", 2)),
    "feature_descriptor": ("<f2", ("F", 128)),
}
# Arrays by the attributes of `Landmarks` and `Features` that they contain.
_LANDMARKS = {
    "id": "landmark_id",
    "mean": "landmark_place",
    "information": "landmark_information",
    "n_observations": "landmark_seen",
    "origin": "landmark_origin",
}
_FEATURES = {"pixels": "feature_pixels", "normalized": "feature_normalized", "descriptors": "feature_descriptor"}
# A file of numbers or text in an archive, as NumPy writes it: type and shape, then the content.
_N = rb"(?:0|[1-9]\d{0,9})"
_NPY = re.compile(
    rb"\x93NUMPY\x01\x00..\{'descr': '(\|[biu]1|<[iuf][248]|<U[1-9]\d{0,6})', 'fortran_order': (False|True), "
    rb"'shape': \(((?:%b,)?|(?:%b, )+%b)\), \} *\n" % (_N, _N, _N),
    re.DOTALL,
)


class _Camera(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: _NAME
    size: tuple[int, int]
    matrix: tuple[_Row3, _Row3, _Row3]
    distortion: Annotated[list[float], msgspec.Meta(max_length=14)]
    camera_from_world: _Pose
    lens: Literal["opencv", "fisheye"]
    error_px: float | None


class _Format(msgspec.Struct, frozen=True):
    format: str


class _Header(_Format, frozen=True, forbid_unknown_fields=True):
    version: Annotated[str, msgspec.Meta(pattern=r"^[\w.+-]{1,40}$")]
    mark: Annotated[str, msgspec.Meta(pattern=r"^[0-9a-f]{1,64}$")]
    unit: _TEXT
    radius: Annotated[float, msgspec.Meta(gt=0, lt=MAX_LENGTH)]
    scale_sd: Annotated[float, msgspec.Meta(ge=0, le=1)]
    object_from_learned: _Pose
    frame_sd: tuple[_SD, _SD, _SD, _SD, _SD, _SD]
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
    keyframes, frame = known._keyframes, known.frame
    landmarks = [memory.landmarks for memory in known._cameras.values()]
    views = [
        (c, k, features, ids)
        for c, memory in enumerate(known._cameras.values())
        for k, (features, ids) in enumerate(zip(memory.features, memory.landmark_ids, strict=True))
    ]
    cameras, numbers, features, ids = zip(*views, strict=True)
    arrays: dict[str, ArrayLike] = {
        "points": known._points,
        "keyframe_time": [k.time for k in keyframes],
        "keyframe_age": [k.landmark_age for k in keyframes],
        "keyframe_stays": [k.is_fixed for k in keyframes],
        "keyframe_world_from_object": [k.world_from_object.as_matrix() for k in keyframes],
        "keyframe_covariance": [k.covariance for k in keyframes],
        "landmark_camera": np.repeat(np.arange(len(landmarks)), [len(of) for of in landmarks]),
        "feature_camera": np.repeat(cameras, [len(of) for of in features]),
        "feature_keyframe": np.repeat(numbers, [len(of) for of in features]),
        "feature_landmark": np.concatenate(ids),
    }
    for names, records in ((_LANDMARKS, landmarks), (_FEATURES, features)):
        arrays |= {name: np.concatenate([getattr(of, field) for of in records]) for field, name in names.items()}
    header = {
        "format": FORMAT,
        "version": __version__,
        "mark": known.fingerprint,
        "unit": known.unit,
        "radius": known.radius,
        "scale_sd": known.scale_sd,
        "frame_sd": frame.sd.tolist(),
        "object_from_learned": frame.from_learned.as_matrix().tolist(),
        "frame_description": frame.description,
        "cameras": [_encode_camera(known.rig[name]) for name in known._cameras],
    }
    typed = {name: np.asarray(arrays[name]).astype(kind) for name, (kind, _) in _ARRAYS.items()}
    with replace_atomically(path) as part, part.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, header=np.array(msgspec.json.encode(header).decode()), **typed)


def _encode_camera(camera: Camera) -> dict[str, Any]:
    return {
        "name": camera.name,
        "size": camera.size,
        "lens": camera.lens,
        "error_px": camera.error_px,
        "matrix": camera.matrix.tolist(),
        "distortion": camera.distortion.tolist(),
        "camera_from_world": camera.camera_from_world.as_matrix().tolist(),
    }


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
        with open_regular_file(path, MAX_BYTES) as file:
            arrays = read_npz(file)
        header = _decode_header(arrays.pop("header", np.empty(0)))
        if arrays.keys() != _ARRAYS.keys():
            raise ValueError("its arrays are not those of a sylpose object")
        lengths = dict[str, int]()
        for name, (kind, shape) in _ARRAYS.items():
            values = arrays[name]
            if values.dtype != np.dtype(kind):
                raise ValueError(f"{name} has the type {values.dtype}")
            check_shape(values.shape, shape, name, lengths)
            if kind != "<i8" and not (np.abs(values.astype(float)) <= MAX_LENGTH**2).all():
                raise ValueError(f"{name} has numbers that are not finite or too large")
        return _decode_object(header, arrays)


def read_npz(file: BinaryIO, max_bytes: int = MAX_BYTES, by_columns: bool = False) -> dict[str, NDArray[Any]]:
    """Read an archive of arrays of numbers and text, as `numpy.savez` writes them; anything else is refused.

    Args:
        file: the archive.
        max_bytes: maximum size, unpacked.
        by_columns: also read arrays that are stored by columns.

    NumPy's own reader evaluates the arrays' headers before their checksums, and raises many kinds of errors.

    Raises:
        ValueError: damaged, not such an archive, or of more than `max_bytes` unpacked. To be converted by `input_errors`.
    """
    try:
        with zipfile.ZipFile(file) as archive:
            infos = archive.infolist()
            if sum(info.file_size for info in infos) > max_bytes:
                raise ValueError(f"more than {max_bytes >> 20} MB")
            # Reading so many bytes, and no more, unpacks no others, and verifies the checksum.
            contents = {info.filename: archive.open(info).read(info.file_size) for info in infos}
        return {name.removesuffix(".npy"): _decode_array(content, by_columns) for name, content in contents.items()}
    except Exception as error:
        # A damaged archive can raise anything.
        raise ValueError(f"not a sylpose object file, or damaged ({str(error) or type(error).__name__})") from None


def _decode_array(data: bytes, by_columns: bool) -> NDArray[Any]:
    head = _NPY.match(data)
    if head is None or (head[2] == b"True" and not by_columns):
        raise ValueError("an array with elements that are not numbers")
    kind, shape = np.dtype(head[1].decode()), [int(n) for n in head[3].split(b",") if n.strip()]
    if prod(shape) * kind.itemsize != len(data) - head.end():
        raise ValueError("an array whose shape and size disagree")
    return np.frombuffer(data, kind, offset=head.end()).reshape(shape, order="F" if head[2] == b"True" else "C").copy()


def _decode_header(text: NDArray[Any]) -> _Header:
    if text.dtype.kind != "U" or text.shape:
        raise ValueError("not a sylpose object file, or damaged (its header is not a string)")
    found = msgspec.json.decode(str(text), type=_Format).format
    if found != FORMAT:
        raise ValueError(f"the format is {found!r}; this version of sylpose reads {FORMAT!r}")
    return msgspec.json.decode(str(text), type=_Header)


def _decode_object(header: _Header, a: Mapping[str, NDArray[Any]]) -> KnownObject:
    """Build the object model; raise ValueError for arrays that contradict each other."""
    k, c = len(a["keyframe_time"]), len(header.cameras)
    if k < MIN_KEYFRAMES or (np.diff(a["keyframe_time"]) <= 0).any():
        raise ValueError("too few keyframes, or out of order")
    poses = _decode_pose("keyframe_world_from_object", a["keyframe_world_from_object"])
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
    from_learned = _decode_pose("object_from_learned", header.object_from_learned)
    frame = ObjectFrame(from_learned, np.array(header.frame_sd), header.frame_description)
    memories = {camera.name: _decode_camera_landmarks(i, k, a) for i, camera in enumerate(cameras)}
    rig = Rig(cameras, header.unit)
    return KnownObject(rig, header.radius, header.mark, a["points"], frames, memories, frame, header.scale_sd)


def _decode_camera(stored: _Camera) -> Camera:
    pose = _decode_pose(f"camera {stored.name}: camera_from_world", stored.camera_from_world)
    matrix, distortion = np.array(stored.matrix), np.array(stored.distortion)
    return Camera(stored.name, stored.size, matrix, distortion, pose, stored.lens, stored.error_px)


def _decode_pose(name: str, matrices: ArrayLike) -> RigidTransform:
    poses = np.asarray(matrices, float)
    try:
        if not (np.abs(poses) <= MAX_LENGTH).all():
            raise ValueError("too large")
        return make_transforms(poses)
    except ValueError:
        raise ValueError(f"{name} has matrices that are not rigid transforms") from None


def _are_covariances(matrices: FloatArray) -> bool:
    """Return whether matrices (n, d, d) are symmetric and positive semidefinite, up to rounding."""
    rounding = 1e-6 * np.abs(matrices).max(axis=(1, 2), initial=0.0)[:, None]
    symmetric = np.abs(matrices - matrices.swapaxes(1, 2)).max(axis=(1, 2), initial=0.0)[:, None] <= rounding
    return bool(symmetric.all() and (np.linalg.eigvalsh(matrices) >= -rounding).all())


def _decode_camera_landmarks(c: int, keyframes: int, a: Mapping[str, NDArray[Any]]) -> CameraLandmarks:
    of_camera = a["landmark_camera"] == c
    landmarks = {field: a[name][of_camera] for field, name in _LANDMARKS.items()}
    ids = landmarks["id"]
    if (np.diff(ids) <= 0).any():
        raise ValueError("landmark_id: ids are not increasing")
    features, numbers = [], []
    for k in range(keyframes):
        selected = (a["feature_camera"] == c) & (a["feature_keyframe"] == k)
        found = {field: a[name][selected] for field, name in _FEATURES.items()}
        features.append(Features(**{**found, "descriptors": found["descriptors"].astype(np.float32)}))
        numbers.append(a["feature_landmark"][selected])
    if not np.isin(np.concatenate(numbers), ids).all():
        raise ValueError("feature_landmark refers to missing landmarks")
    return CameraLandmarks(Landmarks(**landmarks, has_moved=np.ones(len(ids), bool)), tuple(features), tuple(numbers))


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
