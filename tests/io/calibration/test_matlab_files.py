"""DANNCE's and Label3D's Matlab files, and OpenCap's pickles."""

from __future__ import annotations

import pickle
import struct
import sys
import zlib
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from sylpose.geometry.arrays import FloatArray
from sylpose.input_limits import UnreadableFileError
from sylpose.io import calibration
from tests.io.calibration.reference_projections import (
    OTHER_TURN,
    TURN,
    apply_brown,
    assert_projects,
    points_in_front,
    write_file,
)

K: FloatArray = np.array([[800.5, 0, 321.0], [0, 801.5, 241.0], [0, 0, 1]])
SHIFTS = {1: np.array([-120.5, 3.25, 515.0]), 2: np.array([20.0, -8.5, 610.25])}
TURNS = {1: TURN, 2: OTHER_TURN}
RADIAL, TANGENTIAL = {1: [-0.2, 0.05], 2: [-0.3, 0.1, -0.02]}, [0.001, -0.002]
SIZE = (640, 480)


def make_parameters(number: int) -> dict[str, Any]:
    """Return the variables of a camera for row vectors, as DANNCE's convert_calibration.m saves them."""
    return {
        "K": K.T,
        "RDistort": np.array([RADIAL[number]]),
        "TDistort": np.array([TANGENTIAL]),
        "r": TURNS[number].T,
        "t": SHIFTS[number].reshape(1, 3),
    }


def known_sizes(names: Any) -> dict[str, tuple[int, int]]:
    return dict.fromkeys(names, SIZE)


def check(path: Path, format_: str) -> None:
    """Compare pixels with [X 1] [r; t] K and Matlab's lens, whose first pixel is (1, 1)."""
    rig = calibration.load(path, known_sizes)
    assert (calibration.format_name(path), rig.names, rig.unit) == (format_, ("Camera1", "Camera2"), "mm")
    for number, camera in enumerate(rig, start=1):

        def pixel(point: FloatArray, number: int = number) -> tuple[float, float]:
            row = np.append(point, 1.0) @ np.vstack([TURNS[number].T, SHIFTS[number]])
            x, y = apply_brown(row[0] / row[2], row[1] / row[2], RADIAL[number], TANGENTIAL)
            u, v, _ = np.array([x, y, 1.0]) @ K.T
            return u - 1.0, v - 1.0

        assert_projects(camera, points_in_front(TURNS[number], SHIFTS[number]), pixel)


@pytest.mark.parametrize("compressed", [False, True])
def test_dannce(compressed: bool, tmp_path: Path) -> None:
    for number in (2, 1):
        savemat(tmp_path / f"hires_cam{number}_params.mat", make_parameters(number), do_compression=compressed)
    check(tmp_path / "hires_cam2_params.mat", "DANNCE")
    check(tmp_path, "DANNCE")


@pytest.mark.parametrize("compressed", [False, True])
def test_label3d(compressed: bool, tmp_path: Path) -> None:
    """Labels of a long recording do not matter, before or after the parameters."""
    cells = np.empty((2, 1), dtype=object)
    cells[:, 0] = [make_parameters(1), make_parameters(2)]
    names = np.empty((1, 2), dtype=object)
    names[0] = ["Camera1", "Camera2"]
    labels = np.arange(300_000.0)
    data = {"labelData": labels, "params": cells, "camnames": names, "sync": labels}
    savemat(tmp_path / "recording_dannce.mat", data, do_compression=compressed)
    check(tmp_path / "recording_dannce.mat", "Label3D")
    savemat(tmp_path / "recording_dannce.mat", {"camParams": cells}, do_compression=compressed)
    check(tmp_path / "recording_dannce.mat", "Label3D")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"t": None}, "camera Camera1: missing t of DANNCE's parameters"),
        ({"K": K}, "camera Camera1: K must be Matlab's, for row vectors"),
        ({"r": np.eye(3) + 0.1}, "camera Camera1: the rotation is not a rotation matrix"),
        ({"RDistort": np.ones(4)}, "camera Camera1: RDistort must be 2 or 3 numbers"),
        ({"m": 1.0}, "camera Camera1: views through a mirror"),
    ],
)
def test_invalid_dannce_is_rejected(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    parameters = {key: value for key, value in (make_parameters(1) | changes).items() if value is not None}
    savemat(tmp_path / "hires_cam1_params.mat", parameters)
    with pytest.raises(ValueError, match=message):
        calibration.load(tmp_path, known_sizes)


def write_hdf5(path: Path, struct_array: bool = False) -> None:
    """Write Label3D's own file as Matlab does with -v7.3: transposed arrays, cells of references, text as numbers."""
    h5py = pytest.importorskip("h5py", reason="the extra `matlab`")
    with h5py.File(path, "w", userblock_size=512) as file:
        refs = file.create_group("#refs#")

        def put(group: Any, key: str, value: Any) -> Any:
            data = group.create_dataset(key, data=np.asarray(value, dtype=float).T)
            data.attrs["MATLAB_class"] = np.bytes_("double")
            return data

        def put_cell(key: str, items: list[Any]) -> None:
            cell = file.create_dataset(key, (1, len(items)), h5py.ref_dtype)
            cell.attrs["MATLAB_class"] = np.bytes_("cell")
            for k, item in enumerate(items):
                cell[0, k] = item.ref

        names = [
            refs.create_dataset(f"name{k}", data=np.array([[ord(c)] for c in f"Camera{k}"], np.uint16)) for k in (1, 2)
        ]
        for name in names:
            name.attrs["MATLAB_class"] = np.bytes_("char")
        put_cell("camnames", names)
        put(file, "imageSize", [[480, 640], [480, 640]])
        put(file, "data_3D", np.zeros((400, 300)))
        if struct_array:
            group = file.create_group("camParams")
            group.attrs["MATLAB_class"] = np.bytes_("struct")
            for key in make_parameters(1):
                values = [put(refs, f"{key}{k}", make_parameters(k)[key]) for k in (1, 2)]
                field = group.create_dataset(key, (2, 1), h5py.ref_dtype)
                field[0, 0], field[1, 0] = values[0].ref, values[1].ref
        else:
            structs = [refs.create_group(f"struct{k}") for k in (1, 2)]
            for k, group in enumerate(structs, start=1):
                group.attrs["MATLAB_class"] = np.bytes_("struct")
                for key, value in make_parameters(k).items():
                    put(group, key, value)
            put_cell("camParams", structs)
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\0\2IM")


@pytest.mark.parametrize("struct_array", [False, True])
def test_label3d_of_version_73(struct_array: bool, tmp_path: Path) -> None:
    path = tmp_path / "20200623_174153_Label3D.mat"
    write_hdf5(path, struct_array)
    check(path, "Label3D")
    assert [camera.size for camera in calibration.load(path)] == [SIZE, SIZE]


def test_damaged_hdf5_gives_one_sentence(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="the extra `matlab`")
    path = tmp_path / "a_Label3D.mat"
    write_hdf5(path)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(ValueError, match=r"a_Label3D\.mat: not a valid Matlab file of version 7\.3"):
        calibration.load(path)
    (tmp_path / "other.mat").write_bytes(data)
    with h5py.File(path, "w") as file:
        file["camParams"] = h5py.ExternalLink("other.mat", "/camParams")
    with pytest.raises(ValueError, match="params or camParams must be a cell of structs"):
        calibration.load(path)


def test_unreadable_matlab_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "h5py", None)
    path = tmp_path / "hires_cam1_params.mat"
    savemat(path, make_parameters(1))
    with pytest.raises(ValueError, match="no image size of Camera1"):
        calibration.load(path)
    data = path.read_bytes()
    header = data[:128]
    bomb = zlib.compress(struct.pack("<II", 14, 2**28 - 8) + bytes(2**28 - 8))
    for content, message in (
        (
            b"MATLAB 7.3 MAT-file, Platform: GLNXA64" + bytes(600),
            r"7\.3 \(HDF5\), which needs h5py: .*; or save it with '-v7'",
        ),
        (b"hello", "not a Matlab file of version 6 or 7"),
        (data[:200], "missing K, t"),
        (header + struct.pack("<II", 15, len(bomb)) + bomb, "missing K, t"),
        (header + struct.pack("<II", 15, 9) + b"no stream", "not a valid Matlab file: Error -3"),
    ):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=f"hires_cam1_params.mat: .*{message}"):
            calibration.load(path, known_sizes)
    (tmp_path / "session.mat").write_bytes(b"MATLAB 7.3 MAT-file" + bytes(600))
    with pytest.raises(ValueError, match=r"session\.mat: a Matlab file of version 7\.3"):
        calibration.load(tmp_path / "session.mat")


def test_damaged_matlab_files_give_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "hires_cam1_params.mat"
    savemat(path, make_parameters(1))
    data, rng = path.read_bytes(), np.random.default_rng(0)
    for _ in range(1000):
        damaged = bytearray(data)
        for place in rng.integers(128, len(data), 3):
            damaged[place] = int(rng.integers(256))
        path.write_bytes(damaged)
        with suppress(UnreadableFileError):  # which names the file
            calibration.load(path, known_sizes)


# OpenCap


def make_opencap(number: int, **changes: Any) -> bytes:
    """Return a pickle of a camera in portrait format, as OpenCap writes it."""
    data = {
        "distortion": np.array([[0.1, -0.2, 0.001, 0.002, 0.05]]),
        "intrinsicMat": np.array([[1100.5, 0, 360.25], [0, 1101.5, 641.5], [0, 0, 1]]),
        "imageSize": np.array([[1280.0], [720.0]]),
        "rotation": TURNS[number],
        "translation": SHIFTS[number].reshape(3, 1),
        "rotation_EulerAngles": np.zeros((3, 1)),
    }
    return pickle.dumps({key: value for key, value in (data | changes).items() if value is not None})


def check_opencap(path: Path, names: tuple[str, ...]) -> None:
    rig = calibration.load(path)
    assert (calibration.format_name(path), rig.names, rig.unit) == ("OpenCap pickle", names, "mm")
    for number, camera in enumerate(rig, start=1):
        assert camera.size == (720, 1280)

        def pixel(point: FloatArray, number: int = number) -> tuple[float, float]:
            a, b, c = TURNS[number] @ point + SHIFTS[number]
            x, y = apply_brown(a / c, b / c, [0.1, -0.2, 0.05], [0.001, 0.002])
            return 1100.5 * x + 360.25, 1101.5 * y + 641.5

        assert_projects(camera, points_in_front(TURNS[number], SHIFTS[number]), pixel)


def test_opencap(tmp_path: Path) -> None:
    """Files of one name in the cameras' folders, or several files in one folder as for Pose2Sim."""
    for number in (1, 2):
        for file in (f"Videos/Cam{number - 1}/cameraIntrinsicsExtrinsics.pickle", f"flat/cam0{number}.pickle"):
            write_file(tmp_path / file, "").write_bytes(make_opencap(number))
    check_opencap(tmp_path / "Videos/Cam1/cameraIntrinsicsExtrinsics.pickle", ("Cam0", "Cam1"))
    check_opencap(tmp_path / "Videos", ("Cam0", "Cam1"))
    check_opencap(tmp_path / "flat/cam01.pickle", ("cam01", "cam02"))
    # Some files have (width, height).
    swapped = make_opencap(1, imageSize=np.array([[720.0], [1280.0]]))
    (tmp_path / "flat/cam01.pickle").write_bytes(swapped)
    check_opencap(tmp_path / "flat/cam01.pickle", ("cam01", "cam02"))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (make_opencap(1, rotation=None), "camera Cam0: this is OpenCap's file of intrinsics alone"),
        (make_opencap(1, imageSize=None), "camera Cam0: missing imageSize"),
        (make_opencap(1, intrinsicMat=np.eye(2)), "camera Cam0: intrinsicMat must be 9 numbers"),
        (pickle.dumps([1, 2]), "a pickle, but not a dict"),
        (pickle.dumps({"intrinsicMat": Path}), "a pickle that refers to pathlib"),
    ],
)
def test_invalid_opencap_is_rejected(data: bytes, message: str, tmp_path: Path) -> None:
    path = write_file(tmp_path / "Cam0" / "cameraIntrinsicsExtrinsics.pickle", "")
    path.write_bytes(data)
    with pytest.raises(ValueError, match=message):
        calibration.load(path)
