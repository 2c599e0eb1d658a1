"""Calibrations in several files of JARVIS, EasyMocap, MultiCamSelfCal and DeepLabCut, by their own formulas."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.io import calibration
from tests.io.calibration.reference_projections import (
    OTHER_TURN,
    TURN,
    apply_brown,
    assert_projects,
    points_in_front,
    write_file,
)

SHIFT = np.array([0.25, -0.5, 1.5])
OTHER_SHIFT = np.array([-0.75, 0.125, 2.0])


def lookup_sizes(names: Sequence[str]) -> dict[str, tuple[int, int]]:
    return dict.fromkeys(names, (640, 480))


def format_storage(**values: Any) -> str:
    """Format YAML as OpenCV does."""
    out = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for name, value in values.items():
        if name == "names":
            out.startWriteStruct(name, cv2.FILE_NODE_SEQ)
            for word in value:
                out.write("", word)
            out.endWriteStruct()
        else:
            out.write(name, np.ascontiguousarray(np.atleast_2d(np.array(value, dtype=float))))
    return str(out.releaseAndGetString())


def transform_point(point: FloatArray, turn: FloatArray, shift: FloatArray) -> FloatArray:
    return np.array([sum(turn[i, j] * point[j] for j in range(3)) + shift[i] for i in range(3)])


# JARVIS


K = np.array([[762.3, 0, 322.25], [0, 761.5, 245.5], [0, 0, 1]])


def write_jarvis(folder: Path) -> None:
    """Write JARVIS files, whose matrices apply to row vectors."""
    for name, turn, shift in (("Camera_T", TURN, SHIFT), ("Camera_LB", OTHER_TURN, OTHER_SHIFT)):
        values = {
            "intrinsicMatrix": K.T,
            "distortionCoefficients": [-0.043, 0.057, 0, 0, 0],
            "R": turn.T,
            "T": shift[:, None],
        }
        write_file(folder / f"{name}.yaml", format_storage(**values))


def test_jarvis(tmp_path: Path) -> None:
    write_jarvis(tmp_path / "set")
    turn, shift = TURN.T, SHIFT  # as in the file

    def pixel(point: FloatArray) -> tuple[float, float]:
        """JARVIS-HybridNet's: [X 1] [R; T] K, then its distortion about the principal point."""
        row = [sum([*point, 1.0][i] * np.vstack([turn, shift])[i, j] for i in range(4)) for j in range(3)]
        u, v, w = (sum(row[i] * K.T[i, j] for i in range(3)) for j in range(3))
        du, dv = u / w - K.T[2, 0], v / w - K.T[2, 1]
        r2 = (du / K[0, 0]) ** 2 + (dv / K[1, 1]) ** 2
        scale = 1 + (-0.043 + 0.057 * r2) * r2
        return du * scale + K.T[2, 0], dv * scale + K.T[2, 1]

    for given in ("", "Camera_T.yaml", "Camera_LB.yaml"):
        rig = calibration.load(tmp_path / "set" / given, lookup_sizes)
        assert rig.names == ("Camera_LB", "Camera_T")
        assert_projects(rig["Camera_T"], points_in_front(TURN, SHIFT), pixel)


def test_invalid_jarvis_is_rejected(tmp_path: Path) -> None:
    write_jarvis(tmp_path)
    with pytest.raises(ValueError, match="has no image size of Camera_LB, Camera_T"):
        calibration.load(tmp_path)
    text = format_storage(intrinsicMatrix=K.T, distortionCoefficients=[0.0] * 5)
    write_file(tmp_path / "Intrinsics_Camera_T.yaml", text)
    with pytest.raises(ValueError, match=r"Intrinsics_Camera_T\.yaml: this is a JARVIS file of intrinsics alone"):
        calibration.load(tmp_path, lookup_sizes)


# EasyMocap


def write_easymocap(folder: Path) -> None:
    lens = np.array([[-0.1, 0.02, 0.001, -0.002, 0.005]])
    intrinsics = {"K_01": K, "dist_01": lens, "K_02": K + np.diag([10, 20, 0]), "dist_02": lens}
    write_file(folder / "intri.yml", format_storage(names=["01", "02"], **intrinsics))
    poses: dict[str, Any] = {}
    for name, turn, shift in (("01", TURN, SHIFT), ("02", OTHER_TURN, OTHER_SHIFT)):
        poses |= {
            f"R_{name}": Rotation.from_matrix(turn).as_rotvec()[:, None],
            f"Rot_{name}": turn,
            f"T_{name}": shift[:, None],
        }
    write_file(folder / "extri.yml", format_storage(names=["01", "02"], **poses))


@pytest.mark.parametrize("given", ["", "intri.yml", "extri.yml"])
def test_easymocap(given: str, tmp_path: Path) -> None:
    write_easymocap(tmp_path)
    rig = calibration.load(tmp_path / given, lookup_sizes)
    assert rig.names == ("01", "02")

    def pixel(point: FloatArray) -> tuple[float, float]:
        a, b, c = transform_point(point, OTHER_TURN, OTHER_SHIFT)
        x, y = apply_brown(a / c, b / c, [-0.1, 0.02, 0.005], [0.001, -0.002])
        return 772.3 * x + 322.25, 781.5 * y + 245.5

    assert_projects(rig["02"], points_in_front(OTHER_TURN, OTHER_SHIFT), pixel)
    text = (tmp_path / "extri.yml").read_text().replace("Rot_", "Was_")  # the vector is equivalent
    write_file(tmp_path / "extri.yml", text)
    assert_projects(calibration.load(tmp_path, lookup_sizes)["02"], points_in_front(OTHER_TURN, OTHER_SHIFT), pixel)


def test_easymocap_image_sizes(tmp_path: Path) -> None:
    write_easymocap(tmp_path)
    text = (tmp_path / "intri.yml").read_text()
    write_file(tmp_path / "intri.yml", text + "W_01: 640\nH_01: 480\nW_02: 1920\nH_02: 1080\n")
    assert [camera.size for camera in calibration.load(tmp_path)] == [(640, 480), (1920, 1080)]


def test_invalid_easymocap_is_rejected(tmp_path: Path) -> None:
    write_easymocap(tmp_path)
    text = (tmp_path / "extri.yml").read_text()
    write_file(tmp_path / "extri.yml", text.replace("T_02", "S_02"))
    with pytest.raises(ValueError, match="camera 02: missing T_02"):
        calibration.load(tmp_path, lookup_sizes)
    (tmp_path / "extri.yml").unlink()
    with pytest.raises(
        ValueError, match=r"intri\.yml: this is one of EasyMocap's two files; the poses are in extri\.yml"
    ):
        calibration.load(tmp_path / "intri.yml", lookup_sizes)


# MultiCamSelfCal


def write_multicamselfcal(folder: Path, *, rad: bool, off: float = 0.0) -> None:
    """Write MultiCamSelfCal files: projection matrices with any scale and sign; .rad files with a slightly different K."""
    for i, (turn, shift, scale) in enumerate([(TURN, SHIFT, -2.5), (OTHER_TURN, OTHER_SHIFT, 0.01)], start=1):
        rows = scale * (K @ np.column_stack([turn, shift]))
        write_file(folder / f"camera{i}.Pmat.cal", "\n".join(" ".join(f"{v:.18e}" for v in row) for row in rows) + "\n")
        if rad:
            text = "".join(
                f"K{r + 1}{c + 1} = {(K + off * (np.eye(3) > 0))[r, c] if r < 2 else K[r, c]}\n"
                for r in range(3)
                for c in range(3)
            )
            write_file(folder / f"basename{i}.rad", text + "\nkc1 = -0.2\nkc2 = 0.05\nkc3 = 0.001\nkc4 = -0.002\n")
    write_file(folder / "camera_order.txt", "left\nright\n")
    write_file(folder / "Res.dat", "640 480\n640 480\n")


@pytest.mark.parametrize("given", ["", "camera2.Pmat.cal", "camera_order.txt"])
def test_multicamselfcal(given: str, tmp_path: Path) -> None:
    write_multicamselfcal(tmp_path, rad=False)
    rig = calibration.load(tmp_path / given)
    assert rig.names == ("left", "right")

    def pixel(point: FloatArray) -> tuple[float, float]:
        rows = 0.01 * (K @ np.column_stack([OTHER_TURN, OTHER_SHIFT]))
        u, v, w = (sum(rows[i, j] * [*point, 1.0][j] for j in range(4)) for i in range(3))
        return u / w, v / w

    assert_projects(rig["right"], points_in_front(OTHER_TURN, OTHER_SHIFT), pixel)


@pytest.mark.parametrize("off", [0.0, 3.0])
def test_multicamselfcal_with_lenses(off: float, tmp_path: Path) -> None:
    """The pinhole projection, distorted in points normalized by the .rad file's K: to 0.02 px."""
    write_multicamselfcal(tmp_path, rad=True, off=off)
    camera = calibration.load(tmp_path / "basename1.rad")["left"]
    points = points_in_front(TURN, SHIFT)
    rows = K @ np.column_stack([TURN, SHIFT])
    expected = []
    for point in points:
        u, v, w = (sum(rows[i, j] * [*point, 1.0][j] for j in range(4)) for i in range(3))
        x, y = apply_brown(
            (u / w - 322.25) / (762.3 + off), (v / w - 245.5) / (761.5 + off), [-0.2, 0.05], [0.001, -0.002]
        )
        expected.append([(762.3 + off) * x + 322.25, (761.5 + off) * y + 245.5])
    inside = [0 <= u < 640 and 0 <= v < 480 for u, v in expected]
    assert sum(inside) > 10
    gap = camera.project(points)[inside] - np.array(expected)[inside]
    assert np.abs(gap).max() < 0.02


def test_invalid_multicamselfcal_is_rejected(tmp_path: Path) -> None:
    write_multicamselfcal(tmp_path, rad=True)
    write_file(tmp_path / "camera_order.txt", "left\n")
    with pytest.raises(ValueError, match="1 cameras, and 2 projection matrices"):
        calibration.load(tmp_path)
    (tmp_path / "camera_order.txt").unlink()
    assert calibration.load(tmp_path).names == ("1", "2")
    text = (tmp_path / "basename2.rad").read_text()
    write_file(tmp_path / "basename2.rad", text.replace("kc3", "ka3"))
    with pytest.raises(ValueError, match=r"basename2\.rad: missing kc3"):
        calibration.load(tmp_path)
    write_file(tmp_path / "basename2.rad", text)
    skewed = K + np.diag([20.0, 0.0], 1)
    rows = (skewed @ np.column_stack([OTHER_TURN, OTHER_SHIFT])).ravel().tolist()
    write_file(tmp_path / "camera2.Pmat.cal", " ".join(map(str, rows)))
    with pytest.raises(ValueError, match=r"basename2\.rad: camera 2: none of OpenCV's lens models"):
        calibration.load(tmp_path)
    write_file(tmp_path / "camera2.Pmat.cal", "1 0 0 0\n0 1 0 0\n0 0 0 1\n")
    with pytest.raises(ValueError, match=r"camera2\.Pmat\.cal: camera 2: the projection matrix is invalid"):
        calibration.load(tmp_path)
    for file in tmp_path.glob("*.Pmat.cal"):
        file.unlink()
    with pytest.raises(ValueError, match=r"this is a MultiCamSelfCal file, but no camera1\.Pmat\.cal"):
        calibration.load(tmp_path / "basename1.rad")


# DeepLabCut


def write_deeplabcut(folder: Path, protocol: int = 4, **changes: Any) -> Path:
    """Write a pickle as DeepLabCut's calibrate_cameras does."""
    lens = np.array([[-0.1, 0.02, 0.001, -0.002, 0.005]])
    pair = {
        "cameraMatrix1": K,
        "cameraMatrix2": K + np.diag([10.0, 20.0, 0.0]),
        "distCoeffs1": lens,
        "distCoeffs2": lens[:, :4],
        "R": np.asfortranarray(OTHER_TURN),
        "T": OTHER_SHIFT[:, None],
        "E": np.eye(3),
        "R1": np.eye(3),
        "P1": np.ones((3, 4)),
        "roi1": (1, 2, 3, 4),
        "image_shape": [(640, 480), (1280, 720)],
    }
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "stereo_params.pickle"
    file.write_bytes(pickle.dumps({"camera-1-camera-2": pair | changes}, protocol=protocol))
    return file


@pytest.mark.parametrize("protocol", range(6))
def test_deeplabcut(protocol: int, tmp_path: Path) -> None:
    file = write_deeplabcut(tmp_path / "camera_matrix", protocol)
    for given in (file, file.parent):
        rig = calibration.load(given)
        assert rig.names == ("camera-1", "camera-2")
        assert [camera.size for camera in rig] == [(640, 480), (1280, 720)]

    def pixel(point: FloatArray) -> tuple[float, float]:
        a, b, c = transform_point(point, OTHER_TURN, OTHER_SHIFT)
        x, y = apply_brown(a / c, b / c, [-0.1, 0.02], [0.001, -0.002])
        return 772.3 * x + 322.25, 781.5 * y + 245.5

    assert_projects(rig["camera-2"], points_in_front(OTHER_TURN, OTHER_SHIFT), pixel)


def test_deeplabcut_names(tmp_path: Path) -> None:
    """With a dash in a single name, the cameras' own files decide."""
    file = write_deeplabcut(tmp_path)
    data = pickle.loads(file.read_bytes())
    file.write_bytes(pickle.dumps({"left-top-right": data["camera-1-camera-2"]}))
    with pytest.raises(ValueError, match="the camera names in 'left-top-right' are ambiguous"):
        calibration.load(file)
    for name in ("left-top", "right"):
        (tmp_path / f"{name}_intrinsic_params.pickle").write_bytes(b"")
    assert calibration.load(file).names == ("left-top", "right")
    assert calibration.load(tmp_path / "right_intrinsic_params.pickle").names == ("left-top", "right")
    file.unlink()
    with pytest.raises(ValueError, match="this is DeepLabCut's file of a single camera"):
        calibration.load(tmp_path / "right_intrinsic_params.pickle")


class MaliciousObject:
    """Object that executes code when unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return Path.write_text, (self.path, "harm")


def test_pickles_are_not_executed(tmp_path: Path) -> None:
    file = write_deeplabcut(tmp_path, R=MaliciousObject(tmp_path / "done"))
    pickle.loads(file.read_bytes())
    assert (tmp_path / "done").exists()  # unpickling would execute it
    (tmp_path / "done").unlink()
    with pytest.raises(ValueError, match=r"stereo_params\.pickle: a pickle .*(PosixPath|write_text|getattr|NEWOBJ)"):
        calibration.load(file)
    assert not (tmp_path / "done").exists()


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.array([None]), "an array of 'O8' instead of numbers"),
        (np.array(["a"]), "an array of '[<]?U1'"),
        (np.ones(3, dtype=complex), "an array of 'c16'"),
        (len, "refers to builtins.len"),
        (np.random.default_rng, "refers to numpy.random"),
        (slice(1), "refers to builtins.slice"),
        ({1, 2}, "EMPTY_SET"),
        (np.ma.masked_array([1.0]), "refers to numpy.ma"),
    ],
)
def test_pickles_with_other_content_are_rejected(value: Any, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=rf"stereo_params\.pickle: .*{message}"):
        calibration.load(write_deeplabcut(tmp_path, R=value))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"R": None}, "without R of DeepLabCut's"),
        ({"R": [1, 2]}, "must be arrays"),
        ({"R": np.eye(2)}, "the rotation must be 3x3"),
        ({"image_shape": [(1, 2, 3), 4]}, "image_shape must be 2 numbers"),
        ({"image_shape": None}, "has no image size of camera-1, camera-2"),
    ],
)
def test_invalid_deeplabcut_is_rejected(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=rf"stereo_params\.pickle: .*{message}"):
        calibration.load(write_deeplabcut(tmp_path, **changes))


@pytest.mark.parametrize("content", [b"", b"hello", b"\x80\x04.", b"\x80\x04K\x01.", pickle.dumps({"a": 1})])
def test_other_pickles(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.pickle").write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.pickle: (not a pickle|a pickle, but not DeepLabCut's)"):
        calibration.load(tmp_path / "a.pickle")
