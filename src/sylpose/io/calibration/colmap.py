"""COLMAP models, text or binary: a folder with cameras.txt and images.txt, or .bin; and rig_config.json.

A camera's lens is in `cameras`, its pose in `images`, with one entry per image: `find_static_cameras` groups them by
camera. Points are skipped. Models of COLMAP 3.12 and newer also have `rigs` and `frames`; an image's pose is then that
of its sensor in the rig times that of the rig in its frame, and the pose in `images` is not used, as in pycolmap.

In COLMAP, the center of the top-left pixel is (0.5, 0.5), quaternions begin with w, and lengths have no unit.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.input_limits import MAX_TABLE_BYTES, input_errors, open_regular_file, to_one_line
from sylpose.io.calibration.camera_builder import (
    CameraEntry,
    SizeLookup,
    intrinsic_matrix,
    lookup_sizes,
    make_rig,
    standard_lens_terms,
)
from sylpose.io.calibration.photogrammetry import (
    PIXEL_CENTER,
    PosedImage,
    StaticCamera,
    find_static_cameras,
    image_path,
    make_unique_names,
)
from sylpose.rig import MAX_LENGTH, Camera, LensModel, Rig

# Maximum number of lenses and of images of a model (choice: a rig of a hundred cameras, a thousand images of each).
MAX_IMAGES = 100_000
# Bytes of a line with an image's pose and name (choice: eight numbers with all digits, and the longest path).
MAX_LINE = 8192
# Bytes of a line with a rig's or frame's sensors (choice: a thousand cameras with all digits).
MAX_RIG_LINE = 2**18
# Maximum number of parameters in a line of cameras.txt or a binary entry (choice: COLMAP's models have 16).
MAX_PARAMS = 100
_FILES = ("cameras", "images", "points3d", "rigs", "frames")
# Model names and parameter counts, indexed by COLMAP's model IDs in binary files.
_MODELS_BY_ID = (
    *(("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8), ("OPENCV_FISHEYE", 8)),
    *(("FULL_OPENCV", 12), ("FOV", 5), ("SIMPLE_RADIAL_FISHEYE", 4), ("RADIAL_FISHEYE", 5), ("THIN_PRISM_FISHEYE", 12)),
    *(("RAD_TAN_THIN_PRISM_FISHEYE", 16), ("SIMPLE_DIVISION", 4), ("DIVISION", 5), ("SIMPLE_FISHEYE", 3)),
    *(("FISHEYE", 4), ("EUCM", 6), ("EQUIRECTANGULAR", 2)),
)
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


class _Lens(NamedTuple):
    """Entry of COLMAP's cameras."""

    model: str
    size: Any
    params: Any


# Poses sensor_from_rig, as quaternion, w first, and translation (7,), by IDs of rig and camera; None if unknown.
_Sensors = dict[tuple[int, int], FloatArray | None]


class _Model(NamedTuple):
    """Lenses by ID, images whose `lens` is such an ID, and the rigs' sensors of a model that has them."""

    lenses: dict[str, _Lens]
    images: list[PosedImage]
    sensors: _Sensors


def is_model(path: Path) -> bool:
    """Return whether a file has the name of a COLMAP model file."""
    return path.stem.lower() in _FILES and path.suffix.lower() in (".txt", ".bin")


def read(_: object, path: Path) -> Rig:
    """Read the rig of the model that a file is part of.

    Raises:
        OSError: a file that cannot be read.
        ValueError: naming the file and the invalid line or entry, or the camera: cameras without images; images of one
            camera with different poses.
    """
    model = _read_model(path)
    if not model.images:
        raise ValueError(f"{path}: no image of this COLMAP model has a pose")
    cameras = []
    for static_camera in _find_cameras(model, path):
        lens, entry = model.lenses.get(static_camera.lens), CameraEntry(path, static_camera.name)
        if lens is None:
            raise entry.error(f"its images have a lens, {static_camera.lens}, that is not in COLMAP's cameras")
        cameras.append(_parse_camera(entry, lens, static_camera.camera_from_world))
    return make_rig(path, cameras)


def _find_cameras(model: _Model, path: Path) -> list[StaticCamera]:
    """Find the cameras in the world, or, if the model is of one rig that moves, in the rig."""
    try:
        return find_static_cameras(model.images, path)
    except ValueError:
        in_rig = {str(camera): pose for (_, camera), pose in model.sensors.items()}
        is_one_rig = len({rig for rig, _ in model.sensors}) == 1 < len({image.lens for image in model.images})
        if not is_one_rig or any(in_rig.get(image.lens) is None for image in model.images):
            raise
    poses = {lens: pose for lens, pose in in_rig.items() if pose is not None}
    return find_static_cameras(
        [
            image._replace(quaternion=np.roll(poses[image.lens][:4], -1), translation=poses[image.lens][4:])
            for image in model.images
        ],
        path,
    )


def _parse_camera(entry: CameraEntry, lens: _Lens, pose: RigidTransform) -> Camera:
    """Build the camera of a lens, with the top-left pixel's center at (0, 0)."""
    if lens.model not in _MODELS:
        raise entry.error(f"COLMAP's model {lens.model} is not supported; OpenCV's are: {', '.join(_MODELS)}")
    n_focal, terms, kind = _MODELS[lens.model]
    values = entry.parse_numbers(lens.params, n_focal + 2 + len(terms), f"the parameters of {lens.model}")
    cx, cy = values[n_focal : n_focal + 2] - PIXEL_CENTER
    distortion = np.zeros(4 if kind == "fisheye" or len(terms) <= 4 else 8)
    distortion[list(terms)] = values[n_focal + 2 :]
    matrix = intrinsic_matrix(values[0], values[n_focal - 1], cx, cy)
    return entry.make_camera(lens.size, matrix, distortion, pose, kind)


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
    poses = []
    for name, node in zip(names, nodes, strict=True):
        entry = CameraEntry(path, name)
        if "camera_params" not in node or "camera_model_name" not in node:
            raise entry.error(
                "this is a COLMAP rig_config without its camera_model_name and camera_params; the folder of "
                "the reconstruction, with cameras.txt and images.txt (or .bin), has them"
            )
        pose = RigidTransform.identity()
        if not node.get("ref_sensor"):
            if not {"cam_from_rig_rotation", "cam_from_rig_translation"} <= node.keys():
                raise entry.error("this is a COLMAP rig_config without its cam_from_rig_rotation and _translation")
            quaternion = entry.parse_numbers(node["cam_from_rig_rotation"], 4, "cam_from_rig_rotation")
            rotation = entry.parse_quaternion(np.roll(quaternion, -1), f"{quaternion} is not a unit quaternion")
            pose = entry.make_pose(rotation.as_matrix(), node["cam_from_rig_translation"])
        poses.append(pose)
    known_sizes = lookup_sizes(path, names, sizes)
    cameras = []
    for name, node, pose in zip(names, nodes, poses, strict=True):
        lens = _Lens(str(node["camera_model_name"]), known_sizes[name], node["camera_params"])
        cameras.append(_parse_camera(CameraEntry(path, name), lens, pose))
    return make_rig(path, cameras)


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


def _read_model(path: Path) -> _Model:
    """Read the model that a file is part of."""
    found = {(file.stem.lower(), file.suffix.lower()): file for file in path.parent.iterdir() if is_model(file)}
    # If a model exists in both forms, prefer the suffix of the given file, then binary, as COLMAP does.
    for suffix in dict.fromkeys((path.suffix.lower(), ".bin", ".txt")):
        if ("cameras", suffix) in found and ("images", suffix) in found:
            cameras, images = found["cameras", suffix], found["images", suffix]
            break
    else:
        missing = [name for name in ("cameras", "images") if not any(name == stem for stem, _ in found)]
        raise ValueError(
            f"{path}: this is part of a COLMAP model, whose lenses are in cameras.txt and poses in images.txt, or in "
            f".bin; {' and '.join(missing) or 'both of one kind'} must be next to it"
        )
    with input_errors(cameras):
        lenses = _read_text_lenses(cameras) if suffix == ".txt" else _read_binary_lenses(cameras)
    sensors = _read_sensors(path, found, suffix)
    poses = _compose_poses(found["frames", suffix], sensors, suffix) if sensors else None
    with input_errors(images):
        read_images = _read_text_images if suffix == ".txt" else _read_binary_images
        posed = [_replace_pose(image, number, poses) for number, image in read_images(images)]
    return _Model(lenses, posed, sensors)


def _read_text_lenses(path: Path) -> dict[str, _Lens]:
    lenses = {}
    with open_regular_file(path, MAX_TABLE_BYTES) as file:
        for number, line in _iterate_lines(file):
            words = line.split(maxsplit=MAX_PARAMS)
            if not words or words[0].startswith("#"):
                continue
            try:
                key, size = int(words[0]), (int(words[2]), int(words[3]))
                lenses[str(key)] = _Lens(words[1], size, np.array([float(word) for word in words[4:]]))
            except (ValueError, IndexError):
                raise ValueError(
                    f"line {number}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS[] of a COLMAP model"
                ) from None
            if len(lenses) > MAX_IMAGES:
                raise ValueError(f"more than {MAX_IMAGES} cameras")
    return lenses


def _read_text_images(path: Path) -> list[tuple[int, PosedImage]]:
    images = []
    with open_regular_file(path, MAX_TABLE_BYTES) as file:
        lines = _iterate_lines(file)
        for number, line in lines:
            words = line.split(maxsplit=9)
            if not words or words[0].startswith("#"):
                continue
            try:
                image_id, camera, name = int(float(words[0])), int(words[8]), words[9].strip()
                values = [float(word) for word in words[1:8]]
            except (ValueError, IndexError):
                raise ValueError(f"line {number}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME") from None
            images.append((image_id, _make_image(name, camera, np.array(values), f"line {number}: ")))
            next(lines, None)  # its points, possibly none
            if len(images) > MAX_IMAGES:
                raise ValueError(f"more than {MAX_IMAGES} images")
    return images


def _iterate_lines(file: BinaryIO) -> Iterator[tuple[int, str]]:
    """Yield number and beginning of each line, however long it is."""
    number = 0
    while line := file.readline(MAX_LINE):
        number += 1
        rest = line
        while not rest.endswith(b"\n") and (rest := file.readline(2**16)):
            pass
        yield number, line.decode("utf-8", "replace")


def _read_binary_lenses(path: Path) -> dict[str, _Lens]:
    lenses = {}
    with open_regular_file(path, MAX_TABLE_BYTES) as file:
        for _ in range(_read_count(file)):
            key, model, width, height = _unpack(file, "<IiQQ")
            if not 0 <= model < len(_MODELS_BY_ID):
                raise ValueError(f"camera {key}: COLMAP's model number {model} is unknown")
            name, n = _MODELS_BY_ID[model]
            lenses[str(key)] = _Lens(name, (width, height), np.array(_unpack(file, f"<{n}d")))
    return lenses


def _read_binary_images(path: Path) -> list[tuple[int, PosedImage]]:
    images = []
    with open_regular_file(path, MAX_TABLE_BYTES) as file:
        for _ in range(_read_count(file)):
            image_id, *values, camera = _unpack(file, "<I7dI")
            name = bytearray()
            while (byte := file.read(1)) != b"\0":
                name += byte
                if not byte or len(name) > MAX_LINE:
                    raise ValueError("the file is truncated in an image's name")
            images.append((image_id, _make_image(name.decode("utf-8", "replace"), camera, np.array(values))))
            (points,) = _unpack(file, "<Q")
            # Each point has x, y and the ID of a 3D point.
            if points > MAX_TABLE_BYTES:
                raise ValueError(f"an image has an implausible number of points, {points}")
            file.seek(24 * points, 1)
    return images


# Rigs and frames


class _FrameEntry(NamedTuple):
    """Frame: its rig, pose rig_from_world (7,), and (camera ID, image ID) of each image."""

    rig: int
    rig_from_world: FloatArray
    images: list[tuple[int, int]]


_CAMERA_SENSOR = 0


def _read_sensors(path: Path, found: dict[tuple[str, str], Path], suffix: str) -> _Sensors:
    """Read the poses of cameras in their rigs; empty for models without rigs and frames.

    Raises:
        ValueError: one of the two files alone, or an invalid pose.
    """
    present = [name for name in ("rigs", "frames") if (name, suffix) in found]
    if not present:
        return {}
    if len(present) == 1:
        raise ValueError(
            f"{path}: this COLMAP model has {present[0]}{suffix} without the other one of rigs{suffix} and "
            f"frames{suffix}, which contain the poses of its images together"
        )
    rigs = found["rigs", suffix]
    with input_errors(rigs):
        sensors = dict(_iterate_text_sensors(rigs) if suffix == ".txt" else _iterate_binary_sensors(rigs))
        for (rig, camera), pose in sensors.items():
            if pose is not None:
                _check_pose(pose, f"camera {camera} of rig {rig}")
        if not sensors:
            raise ValueError("no rig with a camera")
    return sensors


def _compose_poses(frames: Path, sensors: _Sensors, suffix: str) -> dict[int, FloatArray]:
    """Compose camera_from_world of each image from rigs and frames.

    Returns:
        (7,) quaternion, w last, and translation, by image ID.

    Raises:
        ValueError: naming the file: a frame whose rig, or a sensor whose pose in the rig, is unknown.
    """
    in_rig, in_world, images = list[FloatArray](), list[FloatArray](), list[int]()
    with input_errors(frames):
        for frame in _iterate_text_frames(frames) if suffix == ".txt" else _iterate_binary_frames(frames):
            _check_pose(frame.rig_from_world, f"a frame of rig {frame.rig}")
            for camera, image in frame.images:
                if (pose := sensors.get((frame.rig, camera))) is None:
                    raise ValueError(f"camera {camera} of rig {frame.rig} has no pose in rigs{suffix}")
                in_rig.append(pose)
                in_world.append(frame.rig_from_world)
                images.append(image)
                if len(images) > MAX_IMAGES:
                    raise ValueError(f"more than {MAX_IMAGES} images")
    if not images:
        return {}
    composed = _to_poses(in_rig) * _to_poses(in_world)
    values = np.column_stack([composed.rotation.as_quat(), composed.translation])
    return dict(zip(images, values, strict=True))


def _to_poses(values: list[FloatArray]) -> RigidTransform:
    """Build the (n,) poses of quaternions, w first, and translations."""
    array = np.array(values)
    return RigidTransform.from_components(array[:, 4:], Rotation.from_quat(np.roll(array[:, :4], -1, axis=1)))


def _replace_pose(image: PosedImage, number: int, poses: dict[int, FloatArray] | None) -> PosedImage:
    """Return an image with its pose by rigs and frames, if the model has these."""
    if poses is None:
        return image
    if number not in poses:
        raise ValueError(f"image {to_one_line(str(image.path), 100)} is in no frame of the model's frames file")
    return image._replace(quaternion=poses[number][:4], translation=poses[number][4:])


_IDENTITY = np.array([1.0, 0, 0, 0, 0, 0, 0])


def _iterate_text_rows(path: Path, what: str) -> Iterator[tuple[Iterator[str], str]]:
    """Yield the words of each line that is no comment, and the error for a malformed one."""
    with open_regular_file(path, MAX_TABLE_BYTES) as file:
        for number, line in enumerate(iter(lambda: file.readline(MAX_RIG_LINE), b""), start=1):
            words = line.decode("utf-8", "replace").split()
            if words and not words[0].startswith("#"):
                yield iter(words), f"line {number}: expected {what} of a COLMAP model"


def _iterate_text_sensors(path: Path) -> Iterator[tuple[tuple[int, int], FloatArray | None]]:
    rows = _iterate_text_rows(path, "RIG_ID NUM_SENSORS REF_SENSOR_TYPE REF_SENSOR_ID SENSORS[]")
    for words, problem in rows:
        try:
            rig, count = int(next(words)), int(next(words))
            for k in range(count):
                kind, sensor = next(words), int(next(words))
                values: FloatArray | None = _IDENTITY
                if k:
                    has_pose = int(next(words))
                    values = np.array([float(next(words)) for _ in range(7)]) if has_pose else None
                if kind == "CAMERA":
                    yield (rig, sensor), values
        except (ValueError, StopIteration):
            raise ValueError(problem) from None


def _iterate_text_frames(path: Path) -> Iterator[_FrameEntry]:
    rows = _iterate_text_rows(path, "FRAME_ID RIG_ID QW QX QY QZ TX TY TZ NUM_DATA_IDS DATA_IDS[]")
    for words, problem in rows:
        try:
            _, rig, values = next(words), int(next(words)), np.array([float(next(words)) for _ in range(7)])
            items = [(next(words), int(next(words)), int(next(words))) for _ in range(int(next(words)))]
        except (ValueError, StopIteration, RuntimeError):  # StopIteration in a comprehension is a RuntimeError
            raise ValueError(problem) from None
        yield _FrameEntry(rig, values, [(sensor, image) for kind, sensor, image in items if kind == "CAMERA"])


def _iterate_binary_sensors(path: Path) -> Iterator[tuple[tuple[int, int], FloatArray | None]]:
    with open_regular_file(path, MAX_TABLE_BYTES) as file:
        for _ in range(_read_count(file)):
            rig, count = _unpack(file, "<II")
            for k in range(count):
                kind, sensor = _unpack(file, "<iI")
                values: FloatArray | None = _IDENTITY
                if k:
                    (has_pose,) = _unpack(file, "<B")
                    values = np.array(_unpack(file, "<7d")) if has_pose else None
                if kind == _CAMERA_SENSOR:
                    yield (rig, sensor), values


def _iterate_binary_frames(path: Path) -> Iterator[_FrameEntry]:
    with open_regular_file(path, MAX_TABLE_BYTES) as file:
        for _ in range(_read_count(file)):
            _, rig, *values, count = _unpack(file, "<II7dI")
            items = [_unpack(file, "<iIQ") for _ in range(count)]
            yield _FrameEntry(
                rig, np.array(values), [(sensor, image) for kind, sensor, image in items if kind == _CAMERA_SENSOR]
            )


def _read_count(file: BinaryIO) -> int:
    (count,) = _unpack(file, "<Q")
    if count > MAX_IMAGES:
        raise ValueError(f"more than {MAX_IMAGES} entries")
    return int(count)


def _unpack(file: BinaryIO, layout: str) -> tuple[Any, ...]:
    data = file.read(struct.calcsize(layout))
    if len(data) < struct.calcsize(layout):
        raise ValueError("the file is truncated: not a complete binary file of a COLMAP model")
    return struct.unpack(layout, data)


def _make_image(name: str, camera: int, values: FloatArray, where: str = "") -> PosedImage:
    """Build an image from quaternion, w first, and translation."""
    _check_pose(values, f"{where}image {to_one_line(name, 100)}")
    return PosedImage(image_path(name), str(camera), np.roll(values[:4], -1), values[4:])


def _check_pose(values: FloatArray, what: str) -> None:
    if not np.abs(values).max() <= MAX_LENGTH or not abs(np.linalg.norm(values[:4]) - 1.0) < 1e-3:
        raise ValueError(f"{what}: its pose is not a unit quaternion, w first, and a translation")
