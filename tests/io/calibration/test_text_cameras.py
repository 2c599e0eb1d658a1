"""Text files of a camera each: mrcal, KWIVER and VIAME, XMALab, DLT coefficients and OpenPTV."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.io import calibration
from sylpose.rig import Rig
from tests.io.calibration.reference_projections import (
    OTHER_TURN,
    TURN,
    apply_brown,
    assert_projects,
    points_in_front,
    write_file,
)

SHIFT = np.array([-0.5, 0.25, 6.5])
TURNS = {"a": TURN, "b": OTHER_TURN}
SIZE = (640, 480)


def known_sizes(names: Any) -> dict[str, tuple[int, int]]:
    return dict.fromkeys(names, SIZE)


def join(values: Any) -> str:
    return " ".join(map(repr, np.ravel(values).tolist()))


def check_brown(rig: Rig, k: list[float], p: list[float]) -> None:
    """Compare cameras a and b with OpenCV's formulas: focal lengths 500.5 and 501.5, center (320.25, 240.5)."""
    assert rig.names == tuple(TURNS)
    for name, turn in TURNS.items():

        def pixel(point: FloatArray, turn: FloatArray = turn) -> tuple[float, float]:
            a, b, c = turn @ point + SHIFT
            x, y = apply_brown(a / c, b / c, k, p)
            return 500.5 * x + 320.25, 501.5 * y + 240.5

        assert rig[name].size == SIZE
        assert_projects(rig[name], points_in_front(turn, SHIFT), pixel)


# mrcal

OBSERVATIONS = "b'" + "X7K&Wd-8" * 500_000 + "'"


def format_cameramodel(turn: FloatArray, *, old: bool = False, **changes: Any) -> str:
    """Format a model as mrcal writes it, with comments and the observations of its calibration."""
    rt = ", ".join(map(repr, [*Rotation.from_matrix(turn).as_rotvec().tolist(), *SHIFT.tolist()]))
    values = {
        "distortion_model" if old else "lensmodel": "'DISTORTION_OPENCV5'" if old else "'LENSMODEL_OPENCV5'",
        "intrinsics": "[ 500.5, 501.5, 320.25, 240.5, -0.1, 0.02, 0.001, -0.002, 0.01,]",
        "extrinsics": f"[ {rt},]",
        "imagersize": "[ 640, 480,]",
        "icam_intrinsics": "0",
        "optimization_inputs": OBSERVATIONS,
    }
    lines = [f"    '{key}': {value},\n" for key, value in (values | changes).items() if value]
    return "# generated on 2024-01-01 with mrcal-calibrate-cameras\n{\n    # a comment\n" + "".join(lines) + "}\n"


@pytest.mark.parametrize("old", [False, True])
def test_mrcal(old: bool, tmp_path: Path) -> None:
    for name, turn in TURNS.items():
        write_file(tmp_path / f"{name}.cameramodel", format_cameramodel(turn, old=old))
    for path in (tmp_path, tmp_path / "b.cameramodel"):
        rig = calibration.load(path)
        assert (calibration.format_name(path), rig.unit) == ("mrcal cameramodel", "m")
        check_brown(rig, [-0.1, 0.02, 0.01], [0.001, -0.002])


def test_mrcal_lenses(tmp_path: Path) -> None:
    path = tmp_path / "a.cameramodel"
    for model, n in (("PINHOLE", 0), ("OPENCV4", 4), ("OPENCV8", 8), ("OPENCV12", 12)):
        intrinsics = str([500.5, 501.5, 320.25, 240.5, *[0.01] * n])
        write_file(path, format_cameramodel(TURN, lensmodel=f"'LENSMODEL_{model}'", intrinsics=intrinsics))
        assert calibration.load(path)["a"].distortion.sum() == pytest.approx(0.01 * n)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"lensmodel": "'LENSMODEL_CAHVOR'"},
            "mrcal's lens model CAHVOR is not one of OpenCV's .* mrcal-convert-lensmodel",
        ),
        ({"intrinsics": "[1, 2, 3]"}, "intrinsics of OPENCV5 must be 9 numbers, got 3"),
        ({"extrinsics": ""}, "missing extrinsics of mrcal's model"),
        ({"imagersize": "__import__('os')"}, "not a Python dict of literals"),
        ({"imagersize": "(" * 500 + ")" * 500}, "not a Python dict of literals"),
        ({"imagersize": "[ 640,"}, "not a Python dict of literals"),
    ],
)
def test_invalid_mrcal_is_rejected(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=rf"a\.cameramodel: .*{message}"):
        calibration.load(write_file(tmp_path / "a.cameramodel", format_cameramodel(TURN, **changes)))


# KWIVER and VIAME


def format_krtd(turn: FloatArray, terms: str = "-0.1 0.02 0.001 -0.002 0.01", scale: float = 1.0) -> str:
    matrix = scale * np.array([[500.5, 0, 320.25], [0, 501.5, 240.5], [0, 0, 1]])
    rows = ["\n".join(map(join, part)) for part in (matrix, turn)]
    return f"{rows[0]}\n\n{rows[1]}\n\n{join(SHIFT)}\n\n{terms}\n"


def test_krtd(tmp_path: Path) -> None:
    for name, turn in TURNS.items():
        write_file(tmp_path / f"{name}.krtd", format_krtd(turn, scale=1.0 if name == "a" else 2.0))
    rig = calibration.load(tmp_path, known_sizes)
    assert calibration.format_name(tmp_path) == "KWIVER KRTD"
    check_brown(rig, [-0.1, 0.02, 0.01], [0.001, -0.002])
    # A single 0, or nothing, means no distortion.
    for terms in ("0", ""):
        path = write_file(tmp_path / "a.krtd", format_krtd(TURN, terms))
        assert not calibration.load(path, known_sizes)["a"].distortion.any()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("500.5", "five", "K, R, t and the distortion must be numbers"),
        ("500.5 0.0", "500.5 3.0", "camera a: the matrix has skew"),
        (join(SHIFT), "1", "K, R, t and the distortion must be 21 or"),
        ("240.5\n0.0 0.0 1.0", "240.5\n0.0 0.0 0.0", "camera a: the last number of K must be positive"),
    ],
)
def test_invalid_krtd_is_rejected(old: str, new: str, message: str, tmp_path: Path) -> None:
    text = format_krtd(TURN, "")
    assert old in text
    with pytest.raises(ValueError, match=rf"a\.krtd: .*{message}"):
        calibration.load(write_file(tmp_path / "a.krtd", text.replace(old, new)), known_sizes)


def make_viame(**changes: Any) -> dict[str, Any]:
    """Return VIAME's calibration.json."""
    data: dict[str, Any] = {"R": TURN.ravel().tolist(), "T": SHIFT.tolist(), "square_size_mm": 80.0}
    data |= {"image_width": 640, "image_height": 480, "grid_width": 6, "rms_error_stereo": 0.4}
    lens = {"fx": 500.5, "fy": 501.5, "cx": 320.25, "cy": 240.5, "k1": -0.1, "k2": 0.02, "p1": 0.001, "p2": -0.002}
    data |= {f"{key}_{side}": value for side in ("left", "right") for key, value in lens.items()}
    return {key: value for key, value in (data | {"k3_right": 0.01} | changes).items() if value is not None}


def test_viame(tmp_path: Path) -> None:
    path = write_file(tmp_path / "calibration.json", json.dumps(make_viame()))
    rig = calibration.load(path)
    assert (calibration.format_name(path), rig.names, rig.unit) == ("VIAME stereo", ("left", "right"), "mm")
    for name, turn, shift, k3 in (("left", np.eye(3), np.zeros(3), 0.0), ("right", TURN, SHIFT, 0.01)):

        def pixel(point: FloatArray, turn: Any = turn, shift: Any = shift, k3: float = k3) -> tuple[float, float]:
            a, b, c = turn @ point + shift
            x, y = apply_brown(a / c, b / c, [-0.1, 0.02, k3], [0.001, -0.002])
            return 500.5 * x + 320.25, 501.5 * y + 240.5

        assert_projects(rig[name], points_in_front(turn, shift), pixel)
    for changes, message in (
        ({"fy_right": None, "T": None}, "missing fy_right, T of VIAME's stereo calibration"),
        ({"R": [1, 2]}, "camera right: R must be 9 numbers"),
        ({"image_width": None}, "no image size of left, right"),
        ({"cx_left": "a"}, "cx_left must be numbers"),
    ):
        with pytest.raises(ValueError, match=message):
            calibration.load(write_file(path, json.dumps(make_viame(**changes))))


# XMALab


def format_rows(values: Any) -> str:
    return "\n".join(",".join(map(repr, np.atleast_1d(row).tolist())) for row in np.asarray(values))


def format_mayacam(turn: FloatArray) -> str:
    matrix = np.array([[500.5, 0, 320.25], [0, 501.5, 240.5], [0, 0, 1]])
    return (
        f"image size\n640,480\n\ncamera matrix\n{format_rows(matrix)}\n\nrotation\n{format_rows(turn)}\n\n"
        f"translation\n{format_rows(SHIFT)}\n"
    )


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_mayacam_2(newline: str, tmp_path: Path) -> None:
    for name, turn in TURNS.items():
        (tmp_path / f"{name}.txt").write_bytes(format_mayacam(turn).replace("\n", newline).encode())
    write_file(tmp_path / "notes.txt", "hello")
    (tmp_path / "other.txt").write_bytes(b"\xff\xfe\x00")
    path = tmp_path / "b.txt"
    assert calibration.format_name(path) == "XMALab MayaCam"
    check_brown(calibration.load(path), [], [0, 0])


def test_mayacam_1(tmp_path: Path) -> None:
    """Compare with Maya: a camera at a position, rotated about x, then y, then z, looks along -z with y up."""
    angles, position, focal = [10.0, -25.0, 40.0], np.array([12.5, -3.0, 90.0]), 1500.5
    rows = [position, angles, [0.1, 0.2, -3.0], [330.5, 250.25, -focal], [0.001, 640, 480]]
    path = write_file(tmp_path / "mayaCam_a.csv", format_rows(rows) + "\n")
    camera = calibration.load(path)["mayaCam_a"]
    assert (calibration.format_name(path), camera.size) == ("XMALab MayaCam", (640, 480))
    x, y, z = np.radians(angles)
    about_x = np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]])
    about_y = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
    about_z = np.array([[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]])
    turn = about_z @ about_y @ about_x

    def pixel(point: FloatArray) -> tuple[float, float]:
        a, b, c = turn.T @ (point - position)
        u, v_from_bottom = 330.5 - focal * a / c, 250.25 - focal * b / c
        return u - 1, 480 - v_from_bottom

    flip = np.diag([1.0, -1.0, -1.0]) @ turn.T
    assert_projects(camera, points_in_front(flip, -flip @ position), pixel)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("\ntranslation", "\nshift", "missing translation of MayaCam 2.0"),
        ("640,480", "640", "image size must be 2 numbers"),
        ("320.25", "wide", "camera matrix must be numbers"),
    ],
)
def test_invalid_mayacam_is_rejected(old: str, new: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=rf"a\.txt: .*{message}"):
        calibration.load(write_file(tmp_path / "a.txt", format_mayacam(TURN).replace(old, new)))


# DLT coefficients


def make_dlt(turn: FloatArray, from_bottom: bool, skew: float = 0.0) -> Any:
    """Compute eleven coefficients, of pixels from (1, 1) at the top left, or (0.5, 0.5) at the bottom left."""
    matrix = np.array([[500.5, skew, 321.25], [0, 501.5, 241.5], [0, 0, 1]])
    if from_bottom:
        matrix[:2] = [[500.5, skew, 320.75], [0, -501.5, 480 - 0.5 - 240.5]]
    projection = matrix @ np.column_stack([turn, SHIFT])
    return (projection / projection[2, 3]).ravel()[:11]


@pytest.mark.parametrize("from_bottom", [False, True])
@pytest.mark.parametrize("separator", [",", "\t"])
def test_dlt(from_bottom: bool, separator: str, tmp_path: Path) -> None:
    columns = np.column_stack([make_dlt(turn, from_bottom) for turn in TURNS.values()])
    text = format_rows(columns).replace(",", separator)
    path = write_file(tmp_path / "wand_dltCoefs.csv", text)
    rig = calibration.load(path, known_sizes)
    assert (calibration.format_name(tmp_path), rig.names) == ("DLT coefficients", ("cam1", "cam2"))
    for camera, turn in zip(rig, TURNS.values(), strict=True):
        assert camera.error_px is None
        np.testing.assert_allclose(camera.matrix[:2, 2], [320.25, 240.5], rtol=1e-12)
        np.testing.assert_allclose(camera.matrix[[0, 1], [0, 1]], [500.5, 501.5], rtol=1e-12)
        np.testing.assert_allclose(camera.rotation, turn, atol=1e-12)
        np.testing.assert_allclose(camera.camera_from_world.translation, SHIFT, atol=1e-12)


def test_dlt_with_skew(tmp_path: Path) -> None:
    """Skew that no camera has: the nearest camera, with its distance as error; refused beyond two pixels."""
    column = make_dlt(TURN, False, skew=4.0)
    camera = calibration.load(write_file(tmp_path / "a.csv", format_rows(column)), known_sizes)["cam1"]
    points = points_in_front(TURN, SHIFT)
    projected = np.column_stack([points, np.ones(len(points))]) @ np.append(column, 1.0).reshape(3, 4).T
    gaps = np.linalg.norm(camera.project(points) - (projected[:, :2] / projected[:, 2:] - 1), axis=1)
    assert 0.1 < gaps.max() < 2.0
    assert camera.error_px is not None
    assert 0.2 * gaps.max() < camera.error_px < gaps.max()
    column = make_dlt(TURN, False, skew=20.0)
    with pytest.raises(ValueError, match=r"camera cam1: its DLT coefficients have a skew of 2\.3 degrees, which no"):
        calibration.load(write_file(tmp_path / "a.csv", format_rows(column)), known_sizes)


def test_invalid_dlt_is_rejected(tmp_path: Path) -> None:
    columns = np.column_stack([make_dlt(TURN, False), make_dlt(OTHER_TURN, True)])
    for table, message in (
        (columns, "DLT coefficients of cam1 are mirror images of those of cam2: the origin"),
        (np.zeros((11, 2)), "camera cam1: the projection matrix is invalid"),
        (np.full((11, 1), np.nan), "the coefficients has values that are not finite"),
        (columns[:10], "tables are not supported as calibrations, apart from DLT"),
    ):
        with pytest.raises(ValueError, match=rf"a\.csv: .*{message}"):
            calibration.load(write_file(tmp_path / "a.csv", format_rows(table)), known_sizes)
    with pytest.raises(ValueError, match=r"a\.csv: has no image size of cam1"):
        calibration.load(write_file(tmp_path / "a.csv", format_rows(make_dlt(TURN, False))))


# OpenPTV

POSITION = np.array([-10.5, 20.25, 200.0])
ANGLES = 0.1, -0.2, 0.3
PARAMETERS = """2
img/cam1.10002
cal/cam1.tif
img/cam2.10002
cal/cam2.tif
1
0
1
1280
1024
0.012
0.011
0
1
1
1
0
"""


def format_ori(principal: tuple[float, float] = (0.0, 0.0)) -> str:
    turn = Rotation.from_euler("XYZ", ANGLES).as_matrix()
    rows = "\n".join(f"    {join(row)}" for row in turn)
    return f"{join(POSITION)}\n    {join(ANGLES)}\n\n{rows}\n\n{join(principal)}\n70.5\n\n0.0 0.0 50.0\n"


def project_openptv(point: FloatArray, principal: tuple[float, float], terms: list[float]) -> tuple[float, float]:
    """Project a point as OpenPTV's flat_image_coord, flat_to_dist and metric_to_pixel do."""
    k1, k2, k3, p1, p2, scx, she = terms
    a, b, c = Rotation.from_euler("XYZ", ANGLES).as_matrix().T @ (point - POSITION)
    x, y = -70.5 * a / c + principal[0], -70.5 * b / c + principal[1]
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    xd = x * radial + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y
    yd = y * radial + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
    xs, ys = scx * (xd - np.sin(she) * yd), scx * np.cos(she) * yd
    return xs / 0.012 + 1280 / 2 - 0.5, 1024 / 2 - ys / 0.011 - 0.5


NO_TERMS = [0.0, 0, 0, 0, 0, 1, 0]


@pytest.mark.parametrize(
    ("principal", "terms", "tolerance"),
    [
        ((0.0, 0.0), [1e-4, -2e-6, 1e-8, 2e-5, -3e-5, 1.001, 0], 1e-9),
        ((0.2, -0.1), NO_TERMS, 1e-9),
        ((0.2, -0.1), [1e-4, 0, 0, 0, 1e-5, 1.001, 0], 0.02),
    ],
)
@pytest.mark.parametrize("in_yaml", [False, True])
def test_openptv(
    principal: tuple[float, float], terms: list[float], tolerance: float, in_yaml: bool, tmp_path: Path
) -> None:
    path = write_file(tmp_path / "cal" / "cam1.tif.ori", format_ori(principal))
    write_file(tmp_path / "cal" / "cam1.tif.addpar", join(terms))
    write_file(tmp_path / "cal" / "cam2.tif.ori", format_ori(principal))
    if in_yaml:
        lines = ("imx: 1280", "imy: 1024", "pix_x: 0.012", "pix_y: 0.011", "mmp_n1: 1.0", "mmp_n2: [1.0]", "mmp_n3: 1")
        write_file(tmp_path / "parameters_Run1.yaml", "ptv:\n" + "".join(f"  {line}\n" for line in lines))
    else:
        write_file(tmp_path / "parameters" / "ptv.par", PARAMETERS)
    rig = calibration.load(path)
    assert (calibration.format_name(path.parent), rig.names, rig.unit) == ("OpenPTV", ("cam1", "cam2"), "mm")
    assert rig["cam1"].size == (1280, 1024)
    turn = np.diag([1.0, -1.0, -1.0]) @ Rotation.from_euler("XYZ", ANGLES).as_matrix().T
    rng = np.random.default_rng(0)
    rays = np.column_stack([rng.uniform(-0.1, 0.1, 30), rng.uniform(-0.08, 0.08, 30), np.ones(30)])
    points = (rays * 200.0) @ turn + POSITION
    for name, kinds in (("cam1", terms), ("cam2", NO_TERMS)):
        expected = np.array([project_openptv(point, principal, kinds) for point in points])
        limit = tolerance if name == "cam1" else 1e-9
        np.testing.assert_allclose(rig[name].project(points), expected, atol=limit, rtol=0)


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        (
            "parameters/ptv.par",
            "0\n1\n1\n1\n0\n",
            "0\n1\n1.46\n1.33\n6\n",
            "cam1.tif.ori: camera cam1: the refractive indices",
        ),
        ("parameters/ptv.par", "0.012\n", "0\n", "ptv.par: pix_x and pix_y must be positive"),
        ("parameters/ptv.par", PARAMETERS[20:], "", "ptv.par: expected imx, imy"),
        ("cal/cam1.tif.ori", "70.5", "-70.5", "camera cam1: the focal length must be positive"),
        ("cal/cam1.tif.ori", "70.5", "", "camera cam1: the numbers of an .ori file must be 18 or 21 numbers"),
        ("cal/cam1.tif.addpar", "1 0", "1", "cam1.tif.addpar: .* must be 7 numbers, got 6"),
        ("cal/cam1.tif.addpar", "1 0", "1 0.1", "none of OpenCV's lens models matches its lens"),
    ],
)
def test_invalid_openptv_is_rejected(file: str, old: str, new: str, message: str, tmp_path: Path) -> None:
    texts = {"cal/cam1.tif.ori": format_ori(), "parameters/ptv.par": PARAMETERS, "cal/cam1.tif.addpar": "0 0 0 0 0 1 0"}
    assert old in texts[file]
    for name, text in texts.items():
        write_file(tmp_path / name, text.replace(old, new) if name == file else text)
    with pytest.raises(ValueError, match=message):
        calibration.load(tmp_path / "cal" / "cam1.tif.ori")
    (tmp_path / "parameters" / "ptv.par").unlink()
    with pytest.raises(ValueError, match=r"parameters/ptv\.par is not in"):
        calibration.load(tmp_path / "cal" / "cam1.tif.addpar")
