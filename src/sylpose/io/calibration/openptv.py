"""OpenPTV's cam1.tif.ori and cam1.tif.addpar of each camera, with parameters/ptv.par. Lengths are millimeters.

.ori: projection center, three angles, rotation matrix D, principal point xh yh, focal length, glass plane. The camera
looks along -z with y up: X_camera = D' (X - X0). Sensor coordinates are x = -f X / Z + xh, relative to the middle of the
sensor, where the lens distortion k1 k2 k3 p1 p2 of .addpar is centered; then they are sheared by she and both scaled by
scx, as in optv 0.3. ptv.par has the image size, the size of a pixel and the refractive indices. The center of the
top-left pixel is (0.5, 0.5), as OpenPTV's detection returns it.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import FloatArray
from sylpose.input_limits import input_errors, read_text
from sylpose.io.calibration.camera_builder import OPENCV_FROM_OPENGL, CameraEntry, Entry, intrinsic_matrix, make_rig
from sylpose.io.calibration.lens_conversion import FittedLens, fit_lens, sample_image_grid
from sylpose.io.calibration.markup import MAX_FILES, read_plain
from sylpose.io.calibration.photogrammetry import PIXEL_CENTER
from sylpose.rig import Camera, Rig

_SUFFIXES = (".ori", ".addpar")
_PARAMETERS = ("imx", "imy", "pix_x", "pix_y", "mmp_n1", "mmp_n2", "mmp_n3")


class _Sensor(NamedTuple):
    """Image size (2,), size of a pixel (2,) in mm, and refractive indices."""

    size: FloatArray
    pixel: FloatArray
    indices: list[float]


def is_openptv(path: Path) -> bool:
    """Return whether a file has a suffix of OpenPTV's calibrations."""
    return path.suffix.lower() in _SUFFIXES


def read_openptv(_: object, path: Path) -> Rig:
    """Read the rig of all .ori files in the folder, named by their images without suffix.

    Raises:
        ValueError: naming the file: no ptv.par, invalid numbers, refraction, a lens that OpenCV does not have.
    """
    files = [file for file in sorted(path.parent.iterdir()) if file.suffix.lower() == ".ori"][:MAX_FILES]
    if not files:
        raise ValueError(f"{path}: this is OpenPTV's file of a lens; the .ori file with its pose is not next to it")
    sensor = _read_sensor(path)
    cameras = []
    for file in files:
        with input_errors(file):
            cameras.append(_read_camera(file, sensor))
    return make_rig(path.parent, cameras, "mm")


def _read_sensor(path: Path) -> _Sensor:
    """Read parameters/ptv.par, or the section ptv of a YAML file, of the experiment's folder."""
    folders = [path.parent, path.parent / "parameters", path.parent.parent / "parameters"]
    texts = [file for folder in folders if (file := folder / "ptv.par").is_file()]
    if texts:
        with input_errors(texts[0]):
            return _parse_sensor_text(texts[0])
    for folder in (path.parent, path.parent.parent):
        for file in sorted(folder.glob("parameters*.y*ml"))[:MAX_FILES]:
            data = read_plain(file)
            if isinstance(data, dict) and isinstance(node := data.get("ptv"), dict):
                entry = Entry(file, "ptv")
                if missing := [key for key in _PARAMETERS if key not in node]:
                    raise entry.error(f"missing {', '.join(missing)}")
                values = [np.ravel(node[key])[0] for key in _PARAMETERS]
                return _to_sensor(entry.parse_numbers(values, len(values), ", ".join(_PARAMETERS)), entry)
    raise ValueError(
        f"{path}: an OpenPTV calibration needs the size of images and pixels; parameters/ptv.par is not in {path.parent} "
        "or next to it"
    )


def _parse_sensor_text(file: Path) -> _Sensor:
    """Parse ptv.par: the number of cameras, two names of each, three flags, and the numbers, a line each."""
    entry, lines = Entry(file), [line.strip() for line in read_text(file).split("\n")]
    n = entry.parse_number(lines[0], "the number of cameras")
    if not 0 < n <= MAX_FILES or n != round(n):
        raise entry.error(f"the number of cameras must be positive, got {n:g}")
    numbers = lines[int(n) * 2 + 4 : int(n) * 2 + 12]
    if len(numbers) < 8:
        raise entry.error("expected imx, imy, pix_x, pix_y, chfield and the refractive indices at its end")
    values = entry.parse_numbers(numbers, 8, "imx, imy, pix_x, pix_y, chfield and the refractive indices")
    return _to_sensor(np.delete(values, 4), entry)


def _to_sensor(values: FloatArray, entry: Entry) -> _Sensor:
    if not (values[2:4] > 0).all():
        raise entry.error("pix_x and pix_y must be positive")
    return _Sensor(values[:2], values[2:4], values[4:].tolist())


def _read_camera(file: Path, sensor: _Sensor) -> Camera:
    entry = CameraEntry(file, file.name.removesuffix(file.suffix).partition(".")[0])
    words = read_text(file).split()
    numbers = entry.parse_numbers(words, (18, 21), "the numbers of an .ori file")
    center, axes, (xh, yh, focal) = numbers[:3], numbers[6:15].reshape(3, 3), numbers[15:18]
    if not focal > 0:
        raise entry.error("the focal length must be positive")
    # Light that enters water or glass does not go through one center.
    if any(index != sensor.indices[0] for index in sensor.indices[1:]):
        raise entry.error(
            f"the refractive indices in ptv.par are {', '.join(f'{index:g}' for index in sensor.indices)}: views "
            "through glass or water are not supported"
        )
    terms = np.array([0.0, 0, 0, 0, 0, 1, 0])
    lens_file = file.with_suffix(".addpar")
    if lens_file.is_file():
        with input_errors(lens_file):
            terms = Entry(lens_file).parse_numbers(read_text(lens_file).split(), 7, "k1 k2 k3 p1 p2 scx she")
    pose = OPENCV_FROM_OPENGL * (entry.make_pose(axes.T, np.zeros(3)) * RigidTransform.from_translation(-center))
    lens = _convert_lens(np.array([xh, yh]), float(focal), terms, sensor, str(entry))
    return entry.make_camera(sensor.size, lens.matrix, lens.distortion, pose)


def _convert_lens(principal: FloatArray, focal: float, terms: FloatArray, sensor: _Sensor, where: str) -> FittedLens:
    """Convert OpenPTV's lens to OpenCV's: exactly if both have the same form, otherwise by a fit."""
    *k, p1, p2, scale, shear = terms
    fx, fy = scale * focal / sensor.pixel
    middle = 0.5 * sensor.size - PIXEL_CENTER
    if not shear and (not principal.any() or not terms[:5].any()):
        # In OpenPTV's y up and millimeters, p1 and p2 are exchanged.
        distortion = [k[0] * focal**2, k[1] * focal**4, -p2 * focal, p1 * focal, k[2] * focal**6]
        cx, cy = middle + scale * principal / sensor.pixel * [1.0, -1.0]
        return FittedLens(intrinsic_matrix(fx, fy, cx, cy), np.array(distortion))
    matrix = intrinsic_matrix(fx, fy, *(middle + scale * principal / sensor.pixel * [1.0, -1.0]))
    size = int(sensor.size[0]), int(sensor.size[1])
    normalized = (sample_image_grid(size, margin=0.1) - matrix[:2, 2]) / [fx, fy]
    x, y = (focal * normalized * [1.0, -1.0] + principal).T
    r2 = x * x + y * y
    with np.errstate(all="ignore"):
        radial = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[2]))
        xd = x * radial + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y
        yd = y * radial + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
        metric = scale * np.column_stack([xd - np.sin(shear) * yd, np.cos(shear) * yd])
    pixels = metric / sensor.pixel * [1.0, -1.0] + middle
    inside = ((pixels > -0.1 * sensor.size) & (pixels < 1.1 * sensor.size)).all(axis=1)
    return fit_lens(normalized[inside], pixels[inside], matrix, where)
