"""Rigs written in other programs' formats: read back they agree to 1e-12; unsupported properties are rejected."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.commands import calibration as calibration_command
from sylpose.commands.main import main
from sylpose.io import calibration
from sylpose.io.calibration.formats import OUTPUT_FORMATS
from sylpose.rig import Camera, LensModel, Rig
from sylpose.simulate import ring


def make_rig(lenses: list[tuple[LensModel, int]], unit: str = "") -> Rig:
    """Return a rig with one camera per lens and number of terms."""
    rng = np.random.default_rng(7)
    cameras = []
    for i, (lens, n) in enumerate(lenses):
        matrix = np.array([[rng.uniform(500, 900), 0, 320.25], [0, rng.uniform(500, 900), 239.75], [0, 0, 1]])
        pose = RigidTransform.from_components(rng.normal(size=3), Rotation.from_rotvec(rng.normal(size=3)))
        cameras.append(Camera(f"view-{i}", (640, 480), matrix, rng.normal(size=n) / 10, pose, lens))
    return Rig(cameras, unit)


def assert_equal_rigs(rig: Rig, back: Rig) -> None:
    """Assert equality to 1e-12, apart from zero terms."""
    for camera, its in zip(rig, back, strict=True):
        assert (camera.size, camera.lens) == (its.size, its.lens)
        np.testing.assert_allclose(its.matrix, camera.matrix, atol=1e-12)
        terms = [np.pad(c.distortion, (0, 14 - len(c.distortion))) for c in (camera, its)]
        np.testing.assert_allclose(terms[1], terms[0], atol=1e-12)
        np.testing.assert_allclose(its.camera_from_world.as_matrix(), camera.camera_from_world.as_matrix(), atol=1e-12)


ALL: list[tuple[LensModel, int]] = [("opencv", n) for n in (4, 5, 8, 12, 14)]


@pytest.mark.parametrize(
    ("to", "name", "lenses", "keeps_world"),
    [
        ("anipose", "a.toml", [*ALL, ("fisheye", 4)], True),
        ("kalibr", "a.yaml", [("opencv", 4), ("fisheye", 4), ("opencv", 4)], False),
        ("colmap", "model", [("opencv", 4), ("opencv", 5), ("fisheye", 4), ("opencv", 8)], True),
        ("opencv-stereo", "a.yml", [("opencv", 5), ("opencv", 14)], False),
        ("opencv-stereo", "a.json", [("fisheye", 4), ("fisheye", 4)], False),
        ("opencv", "a.xml", [*ALL, ("fisheye", 4)], True),
        ("sylpose", "a.toml", [*ALL, ("fisheye", 4)], True),
    ],
)
def test_round_trips(
    to: str, name: str, lenses: list[tuple[LensModel, int]], keeps_world: bool, tmp_path: Path
) -> None:
    rig = make_rig(lenses)
    notes = calibration.save(rig, tmp_path / name, to)
    back = calibration.load(tmp_path / name)
    assert_equal_rigs(rig if keeps_world else rig.in_world(rig.cameras[0].camera_from_world), back)
    if to not in ("kalibr", "opencv-stereo"):
        assert back.names == rig.names
    assert ("its world is the frame of camera view-0" in notes) == (not keeps_world)


def test_names_imply_the_format(tmp_path: Path) -> None:
    rig = make_rig([("opencv", 4), ("opencv", 4)])
    for name, format_ in (
        ("a.toml", "sylpose TOML"),
        ("a.yml", "OpenCV FileStorage"),
        ("camchain-lab.yaml", "Kalibr camchain"),
        ("model", "COLMAP model"),
    ):
        calibration.save(rig, tmp_path / name)
        assert calibration.format_name(tmp_path / name) == format_
    calibration.save(rig, tmp_path / "model")  # overwrite
    assert not list(tmp_path.rglob("*.part*"))


@pytest.mark.parametrize(
    ("to", "name", "lenses", "message"),
    [
        ("kalibr", "a.yaml", [("opencv", 5)], "camera view-0: Kalibr's radtan does not have the terms k3 of its lens"),
        (
            "colmap",
            "a",
            [("opencv", 4), ("opencv", 12)],
            "camera view-1: .* does not have the terms s1, s2, s3, s4 of its",
        ),
        ("opencv-stereo", "a.yml", ALL, "has two cameras, not 5"),
        (
            "opencv-stereo",
            "a.yml",
            [("opencv", 4), ("fisheye", 4)],
            "requires equal lens models: those of view-0 and view-1 differ",
        ),
        ("kalibr", "a.toml", [("opencv", 4)], r"a\.toml: kalibr is written as one of \.yaml, \.yml"),
        (
            "theia",
            "a.toml",
            [("opencv", 4)],
            "to must be one of sylpose, opencv, opencv-stereo, anipose, kalibr, colmap, got",
        ),
        (
            None,
            "a.csv",
            [("opencv", 4)],
            r"a\.csv: a calibration is written as one of \.toml, .*; or specify the format",
        ),
    ],
)
def test_unsupported_rigs_are_rejected(
    to: str | None, name: str, lenses: list[tuple[LensModel, int]], message: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=message):
        calibration.save(make_rig(lenses), tmp_path / name, to)
    assert not list(tmp_path.iterdir())


def test_colmap_rejects_names_with_blanks(tmp_path: Path) -> None:
    rig = Rig([replace(ring(1).cameras[0], name="left camera")])
    with pytest.raises(ValueError, match="camera left camera: names in COLMAP must not have blanks"):
        calibration.save(rig, tmp_path / "model")


def test_kalibr_is_in_meters(tmp_path: Path) -> None:
    rig = make_rig([("opencv", 4), ("opencv", 4)], "mm")
    notes = calibration.save(rig, tmp_path / "camchain.yaml")
    assert "lengths are in m" in notes
    assert "cam0 is view-0, cam1 is view-1" in notes
    back = calibration.load(tmp_path / "camchain.yaml")
    assert back.unit == "m"
    assert_equal_rigs(rig.in_world(rig.cameras[0].camera_from_world).in_unit("m"), back)


def test_stereo_is_read_by_opencv(tmp_path: Path) -> None:
    rig = make_rig([("opencv", 5), ("opencv", 5)])
    calibration.save(rig, tmp_path / "stereo.yml", "opencv-stereo")
    storage = cv2.FileStorage(str(tmp_path / "stereo.yml"), cv2.FILE_STORAGE_READ)
    np.testing.assert_array_equal(storage.getNode("M2").mat(), rig.cameras[1].matrix)
    turn, shift = storage.getNode("R").mat(), storage.getNode("T").mat().ravel()
    x = np.array([0.3, -0.2, 4.0])
    first, second = (camera.camera_from_world.apply(x) for camera in rig)
    np.testing.assert_allclose(turn @ first + shift, second, atol=1e-12)


def test_colmap_is_read_by_pycolmap(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    rig = make_rig([("opencv", 4), ("opencv", 8), ("fisheye", 4)])
    calibration.save(rig, tmp_path / "model")
    model = pycolmap.Reconstruction(tmp_path / "model")
    for image in model.images.values():
        camera = rig[image.name.partition("/")[0]]
        point = camera.camera_from_world.inv().apply([0.1, -0.2, 2.0])
        pixel = model.cameras[image.camera_id].img_from_cam(image.cam_from_world() * point)
        np.testing.assert_allclose(pixel - 0.5, camera.project(point)[0], atol=1e-6)


def test_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert tuple(OUTPUT_FORMATS) == calibration_command.OUTPUT_FORMATS
    rig = make_rig([("opencv", 4), ("opencv", 4)])
    calibration.save(rig, tmp_path / "a.toml")
    command = ["calibration", "convert", str(tmp_path / "a.toml")]
    assert main([*command, str(tmp_path / "b.toml"), "--to", "anipose"]) == 0
    assert calibration.format_name(tmp_path / "b.toml") == "Anipose TOML"
    assert main([*command, str(tmp_path / "camchain.yaml")]) == 0
    assert "its world is the frame of camera view-0; cam0 is view-0, cam1 is view-1" in capsys.readouterr().out
    assert main([*command, str(tmp_path / "b.toml"), "--to", "maya"]) == 2
    assert "to must be one of sylpose" in capsys.readouterr().err
