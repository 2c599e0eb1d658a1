"""Calibrations in several files by JARVIS, EasyMocap, MultiCamSelfCal and DeepLabCut, by their own formulas."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sylpose import calibration
from sylpose.geometry.arrays import FloatArray
from tests.calibration.reference_projections import OTHER_TURN, TURN, assert_projects, brown, in_front, write

SHIFT = np.array([0.25, -0.5, 1.5])
OTHER_SHIFT = np.array([-0.75, 0.125, 2.0])


def sizes(names: Sequence[str]) -> dict[str, tuple[int, int]]:
    return dict.fromkeys(names, (640, 480))


def storage(**values: Any) -> str:
    """YAML as OpenCV writes it."""
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


def moved(point: FloatArray, turn: FloatArray, shift: FloatArray) -> FloatArray:
    return np.array([sum(turn[i, j] * point[j] for j in range(3)) + shift[i] for i in range(3)])


# JARVIS


K = np.array([[762.3, 0, 322.25], [0, 761.5, 245.5], [0, 0, 1]])


def jarvis(folder: Path) -> None:
    """Its matrices are written as they stand behind a row of points."""
    for name, turn, shift in (("Camera_T", TURN, SHIFT), ("Camera_LB", OTHER_TURN, OTHER_SHIFT)):
        values = {
            "intrinsicMatrix": K.T,
            "distortionCoefficients": [-0.043, 0.057, 0, 0, 0],
            "R": turn.T,
            "T": shift[:, None],
        }
        write(folder / f"{name}.yaml", storage(**values))


def test_jarvis(tmp_path: Path) -> None:
    jarvis(tmp_path / "set")
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
        rig = calibration.load(tmp_path / "set" / given, sizes)
        assert rig.names == ("Camera_LB", "Camera_T")
        assert_projects(rig["Camera_T"], in_front(TURN, SHIFT), pixel)


def test_jarvis_that_cannot_be_used(tmp_path: Path) -> None:
    jarvis(tmp_path)
    with pytest.raises(ValueError, match="does not say how large the images of Camera_LB, Camera_T are"):
        calibration.load(tmp_path)
    text = storage(intrinsicMatrix=K.T, distortionCoefficients=[0.0] * 5)
    write(tmp_path / "Intrinsics_Camera_T.yaml", text)
    with pytest.raises(ValueError, match=r"Intrinsics_Camera_T\.yaml: this is a JARVIS file of intrinsics alone"):
        calibration.load(tmp_path, sizes)


# EasyMocap


def easymocap(folder: Path) -> None:
    lens = np.array([[-0.1, 0.02, 0.001, -0.002, 0.005]])
    intrinsics = {"K_01": K, "dist_01": lens, "K_02": K + np.diag([10, 20, 0]), "dist_02": lens}
    write(folder / "intri.yml", storage(names=["01", "02"], **intrinsics))
    poses: dict[str, Any] = {}
    for name, turn, shift in (("01", TURN, SHIFT), ("02", OTHER_TURN, OTHER_SHIFT)):
        poses |= {
            f"R_{name}": Rotation.from_matrix(turn).as_rotvec()[:, None],
            f"Rot_{name}": turn,
            f"T_{name}": shift[:, None],
        }
    write(folder / "extri.yml", storage(names=["01", "02"], **poses))


@pytest.mark.parametrize("given", ["", "intri.yml", "extri.yml"])
def test_easymocap(given: str, tmp_path: Path) -> None:
    easymocap(tmp_path)
    rig = calibration.load(tmp_path / given, sizes)
    assert rig.names == ("01", "02")

    def pixel(point: FloatArray) -> tuple[float, float]:
        a, b, c = moved(point, OTHER_TURN, OTHER_SHIFT)
        x, y = brown(a / c, b / c, [-0.1, 0.02, 0.005], [0.001, -0.002])
        return 772.3 * x + 322.25, 781.5 * y + 245.5

    assert_projects(rig["02"], in_front(OTHER_TURN, OTHER_SHIFT), pixel)
    text = (tmp_path / "extri.yml").read_text().replace("Rot_", "Was_")  # the vector says the same
    write(tmp_path / "extri.yml", text)
    assert_projects(calibration.load(tmp_path, sizes)["02"], in_front(OTHER_TURN, OTHER_SHIFT), pixel)


def test_easymocap_says_sizes(tmp_path: Path) -> None:
    easymocap(tmp_path)
    text = (tmp_path / "intri.yml").read_text()
    write(tmp_path / "intri.yml", text + "W_01: 640\nH_01: 480\nW_02: 1920\nH_02: 1080\n")
    assert [camera.size for camera in calibration.load(tmp_path)] == [(640, 480), (1920, 1080)]


def test_easymocap_that_cannot_be_used(tmp_path: Path) -> None:
    easymocap(tmp_path)
    text = (tmp_path / "extri.yml").read_text()
    write(tmp_path / "extri.yml", text.replace("T_02", "S_02"))
    with pytest.raises(ValueError, match="camera 02: missing T_02"):
        calibration.load(tmp_path, sizes)
    (tmp_path / "extri.yml").unlink()
    with pytest.raises(
        ValueError, match=r"intri\.yml: this is one of EasyMocap's two files; the poses are in extri\.yml"
    ):
        calibration.load(tmp_path / "intri.yml", sizes)


# MultiCamSelfCal


def self_calibrated(folder: Path, *, rad: bool, off: float = 0.0) -> None:
    """Projection matrices have any scale and sign; .rad files may have a slightly other K."""
    for i, (turn, shift, scale) in enumerate([(TURN, SHIFT, -2.5), (OTHER_TURN, OTHER_SHIFT, 0.01)], start=1):
        rows = scale * (K @ np.column_stack([turn, shift]))
        write(folder / f"camera{i}.Pmat.cal", "\n".join(" ".join(f"{v:.18e}" for v in row) for row in rows) + "\n")
        if rad:
            text = "".join(
                f"K{r + 1}{c + 1} = {(K + off * (np.eye(3) > 0))[r, c] if r < 2 else K[r, c]}\n"
                for r in range(3)
                for c in range(3)
            )
            write(folder / f"basename{i}.rad", text + "\nkc1 = -0.2\nkc2 = 0.05\nkc3 = 0.001\nkc4 = -0.002\n")
    write(folder / "camera_order.txt", "left\nright\n")
    write(folder / "Res.dat", "640 480\n640 480\n")


@pytest.mark.parametrize("given", ["", "camera2.Pmat.cal", "camera_order.txt"])
def test_multicamselfcal(given: str, tmp_path: Path) -> None:
    self_calibrated(tmp_path, rad=False)
    rig = calibration.load(tmp_path / given)
    assert rig.names == ("left", "right")

    def pixel(point: FloatArray) -> tuple[float, float]:
        rows = 0.01 * (K @ np.column_stack([OTHER_TURN, OTHER_SHIFT]))
        u, v, w = (sum(rows[i, j] * [*point, 1.0][j] for j in range(4)) for i in range(3))
        return u / w, v / w

    assert_projects(rig["right"], in_front(OTHER_TURN, OTHER_SHIFT), pixel)


@pytest.mark.parametrize("off", [0.0, 3.0])
def test_multicamselfcal_with_lenses(off: float, tmp_path: Path) -> None:
    """What the projection matrix sees without a lens, distorted in the points of the .rad file's K: nearly, to 0.02 px."""
    self_calibrated(tmp_path, rad=True, off=off)
    camera = calibration.load(tmp_path / "basename1.rad")["left"]
    points = in_front(TURN, SHIFT)
    rows = K @ np.column_stack([TURN, SHIFT])
    expected = []
    for point in points:
        u, v, w = (sum(rows[i, j] * [*point, 1.0][j] for j in range(4)) for i in range(3))
        x, y = brown((u / w - 322.25) / (762.3 + off), (v / w - 245.5) / (761.5 + off), [-0.2, 0.05], [0.001, -0.002])
        expected.append([(762.3 + off) * x + 322.25, (761.5 + off) * y + 245.5])
    inside = [0 <= u < 640 and 0 <= v < 480 for u, v in expected]
    assert sum(inside) > 10
    gap = camera.project(points)[inside] - np.array(expected)[inside]
    assert np.abs(gap).max() < 0.02


def test_multicamselfcal_that_cannot_be_used(tmp_path: Path) -> None:
    self_calibrated(tmp_path, rad=True)
    write(tmp_path / "camera_order.txt", "left\n")
    with pytest.raises(ValueError, match="1 cameras, and 2 projection matrices"):
        calibration.load(tmp_path)
    (tmp_path / "camera_order.txt").unlink()
    assert calibration.load(tmp_path).names == ("1", "2")
    text = (tmp_path / "basename2.rad").read_text()
    write(tmp_path / "basename2.rad", text.replace("kc3", "ka3"))
    with pytest.raises(ValueError, match=r"basename2\.rad: missing kc3"):
        calibration.load(tmp_path)
    write(tmp_path / "basename2.rad", text)
    skewed = K + np.diag([20.0, 0.0], 1)
    rows = (skewed @ np.column_stack([OTHER_TURN, OTHER_SHIFT])).ravel().tolist()
    write(tmp_path / "camera2.Pmat.cal", " ".join(map(str, rows)))
    with pytest.raises(ValueError, match=r"basename2\.rad: camera 2: none of OpenCV's lens models"):
        calibration.load(tmp_path)
    write(tmp_path / "camera2.Pmat.cal", "1 0 0 0\n0 1 0 0\n0 0 0 1\n")
    with pytest.raises(ValueError, match=r"camera2\.Pmat\.cal: camera 2: the projection matrix is of no camera"):
        calibration.load(tmp_path)
    for file in tmp_path.glob("*.Pmat.cal"):
        file.unlink()
    with pytest.raises(ValueError, match=r"this is of MultiCamSelfCal, but no camera1\.Pmat\.cal"):
        calibration.load(tmp_path / "basename1.rad")


# DeepLabCut


def deeplabcut(folder: Path, protocol: int = 4, **changes: Any) -> Path:
    """As its calibrate_cameras writes it."""
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
    file = deeplabcut(tmp_path / "camera_matrix", protocol)
    for given in (file, file.parent):
        rig = calibration.load(given)
        assert rig.names == ("camera-1", "camera-2")
        assert [camera.size for camera in rig] == [(640, 480), (1280, 720)]

    def pixel(point: FloatArray) -> tuple[float, float]:
        a, b, c = moved(point, OTHER_TURN, OTHER_SHIFT)
        x, y = brown(a / c, b / c, [-0.1, 0.02], [0.001, -0.002])
        return 772.3 * x + 322.25, 781.5 * y + 245.5

    assert_projects(rig["camera-2"], in_front(OTHER_TURN, OTHER_SHIFT), pixel)


def test_deeplabcut_names(tmp_path: Path) -> None:
    """A dash in one name alone: by the cameras' own files."""
    file = deeplabcut(tmp_path)
    data = pickle.loads(file.read_bytes())
    file.write_bytes(pickle.dumps({"left-top-right": data["camera-1-camera-2"]}))
    with pytest.raises(ValueError, match="which two cameras 'left-top-right' means is not clear"):
        calibration.load(file)
    for name in ("left-top", "right"):
        (tmp_path / f"{name}_intrinsic_params.pickle").write_bytes(b"")
    assert calibration.load(file).names == ("left-top", "right")
    assert calibration.load(tmp_path / "right_intrinsic_params.pickle").names == ("left-top", "right")
    file.unlink()
    with pytest.raises(ValueError, match="this is DeepLabCut's of one camera alone"):
        calibration.load(tmp_path / "right_intrinsic_params.pickle")


class Harm:
    """What a pickle can do to those who run it."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return Path.write_text, (self.path, "harm")


def test_pickles_are_not_run(tmp_path: Path) -> None:
    file = deeplabcut(tmp_path, R=Harm(tmp_path / "done"))
    pickle.loads(file.read_bytes())
    assert (tmp_path / "done").exists()  # so it would be
    (tmp_path / "done").unlink()
    with pytest.raises(ValueError, match=r"stereo_params\.pickle: a pickle .*(PosixPath|write_text|getattr|NEWOBJ)"):
        calibration.load(file)
    assert not (tmp_path / "done").exists()


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.array([None]), "an array of 'O8', and not of numbers"),
        (np.array(["a"]), "an array of '[<]?U1'"),
        (np.ones(3, dtype=complex), "an array of 'c16'"),
        (len, "wants builtins.len"),
        (np.random.default_rng, "wants numpy.random"),
        (slice(1), "wants builtins.slice"),
        ({1, 2}, "EMPTY_SET"),
        (np.ma.masked_array([1.0]), "wants numpy.ma"),
    ],
)
def test_pickles_of_more_than_numbers(value: Any, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=rf"stereo_params\.pickle: .*{message}"):
        calibration.load(deeplabcut(tmp_path, R=value))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"R": None}, "without R of DeepLabCut's"),
        ({"R": [1, 2]}, "must be arrays"),
        ({"R": np.eye(2)}, "the rotation must be 3x3"),
        ({"image_shape": [(1, 2, 3), 4]}, "image_shape must be 2 numbers"),
        ({"image_shape": None}, "does not say how large the images of camera-1, camera-2 are"),
    ],
)
def test_deeplabcut_that_cannot_be_used(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=rf"stereo_params\.pickle: .*{message}"):
        calibration.load(deeplabcut(tmp_path, **changes))


@pytest.mark.parametrize("content", [b"", b"hello", b"\x80\x04.", b"\x80\x04K\x01.", pickle.dumps({"a": 1})])
def test_other_pickles(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.pickle").write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.pickle: (not a pickle|a pickle, but not DeepLabCut's)"):
        calibration.load(tmp_path / "a.pickle")
