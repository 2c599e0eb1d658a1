"""Folders of other programs are opened as they are."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from sylpose.archive.recordings import TrackingOptions, find_recordings
from sylpose.io import calibration
from sylpose.io.capture import open_session
from sylpose.io.capture.layouts import find_layouts, list_takes
from sylpose.rig import Camera, Rig
from tests.io.capture.test_capture import make_rig, read_with_problems, write_images, write_video

N_FRAMES = 4
ALL = [(k, k) for k in range(N_FRAMES)]


def name_cameras(names: Sequence[str]) -> Rig:
    return Rig(
        [
            Camera(name, its.size, its.matrix, np.zeros(5), its.camera_from_world)
            for name, its in zip(names, make_rig(len(names)), strict=True)
        ]
    )


def write_videos(folder: Path, names: Sequence[str]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for c, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_video(folder / name, c, range(N_FRAMES))


def save(rig: Rig, path: Path, to: str | None = None) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    calibration.save(rig, path, to)


def make_pose2sim(root: Path) -> None:
    save(name_cameras(["cam01", "cam02"]), root / "calibration" / "Calib_qualisys.toml", "anipose")
    write_videos(root / "calibration" / "intrinsics", ["int_cam01.mp4", "int_cam02.mp4"])
    (root / "Config.toml").write_text("[project]\n")
    for trial in ("Trial_1", "Trial_2"):
        write_videos(root / trial / "videos", ["cam01.mp4", "cam02.mp4"])
        (root / trial / "pose").mkdir()


def make_anipose(root: Path) -> None:
    save(name_cameras(["A", "B"]), root / "calibration" / "calibration.toml", "anipose")
    write_videos(root / "calibration", ["calib-camA.avi", "calib-camB.avi"])
    write_videos(root / "videos-raw", [f"vid1-cam{c}.avi" for c in "AB"])
    write_videos(root / "videos-raw", [f"vid2-cam{c}.avi" for c in "AB"])


def make_freemocap(root: Path) -> None:
    names = ["Camera_000_synchronized", "Camera_001_synchronized"]
    save(name_cameras(["cam_0", "cam_1"]), root / "recording_1_camera_calibration.toml", "anipose")
    write_videos(root / "synchronized_videos", [f"{name}.mp4" for name in names])
    write_videos(root / "annotated_videos", [f"{name}_annotated.mp4" for name in names])
    (root / "output_data").mkdir()


def make_caliscope(root: Path) -> None:
    save(name_cameras(["port_1", "port_2"]), root / "camera_array.toml", "sylpose")
    write_videos(root / "calibration" / "extrinsic", ["port_1.mp4", "port_2.mp4"])
    for name in ("walk", "sit"):
        write_videos(root / "recordings" / name, ["port_1.mp4", "port_2.mp4"])


def make_dannce(root: Path) -> None:
    save(name_cameras(["Camera1", "Camera2"]), root / "calibration" / "calibration.toml")
    write_videos(root / "videos", ["Camera1/0.mp4", "Camera2/0.mp4"])


def make_opencap(root: Path) -> None:
    save(name_cameras(["Cam0", "Cam1"]), root / "calibration.toml")
    for trial in ("neutral", "squat"):
        write_videos(root / "Videos", [f"Cam{c}/InputMedia/{trial}/{trial}.mov" for c in range(2)])


def make_easymocap(root: Path) -> None:
    save(name_cameras(["01", "02"]), root / "calibration.yml", "opencv")
    write_videos(root / "videos", ["01.mp4", "02.mp4"])
    for c in range(2):
        write_images(root / "images" / f"0{c + 1}", c, range(2), "{:06d}.jpg")


def make_multical(root: Path) -> None:
    save(name_cameras(["cam1", "cam2"]), root / "calibration.json", "opencv")
    for c in range(2):
        write_images(root / f"cam{c + 1}", c, range(N_FRAMES))


def make_deeplabcut(root: Path) -> None:
    save(name_cameras(["camera-1", "camera-2"]), root / "camera_matrix" / "calibration.toml")
    write_images(root / "calibration_images", 0, range(2))
    write_videos(root / "videos", ["mouse_camera-1.avi", "mouse_camera-2.avi"])


@pytest.mark.parametrize(
    ("make", "takes"),
    [
        (make_pose2sim, ["Trial_1", "Trial_2"]),
        (make_anipose, ["vid1", "vid2"]),
        (make_freemocap, []),
        (make_caliscope, ["sit", "walk"]),
        (make_dannce, []),
        (make_opencap, ["neutral", "squat"]),
        (make_easymocap, []),
        (make_multical, []),
        (make_deeplabcut, []),
    ],
)
def test_folder_as_it_is(tmp_path: Path, make: Callable[[Path], None], takes: list[str]) -> None:
    make(tmp_path)
    if takes:
        with pytest.raises(ValueError, match=rf"several takes \({', '.join(takes)}\); select one with --take NAME"):
            open_session(tmp_path)
        with pytest.raises(ValueError, match=r"no take 'other'"):
            open_session(tmp_path, take="other")
    for take in takes or [""]:
        session = open_session(tmp_path, take=take)
        assert read_with_problems(session)[0] == ALL
        assert all(take in str(source.path) for source in session.sources)


def test_trial_of_a_project(tmp_path: Path) -> None:
    """Its calibration is in the project; its boxes and results are in the trial."""
    make_pose2sim(tmp_path)
    for folder in (tmp_path / "Trial_2", tmp_path / "Trial_2" / "videos"):
        session = open_session(folder)
        assert read_with_problems(session)[0] == ALL
        assert session.calibration.resolve().is_relative_to((tmp_path / "calibration").resolve())
    assert open_session(tmp_path, take="Trial_1").path == tmp_path / "Trial_1"


def test_nearest_calibration(tmp_path: Path) -> None:
    make_pose2sim(tmp_path)
    own = tmp_path / "Trial_1" / "calibration.toml"
    save(name_cameras(["cam01", "cam02"]), own)
    assert find_layouts(tmp_path)[0].calibration == own
    shutil.copy(own, tmp_path / "calibration" / "Calib_other.toml")
    with pytest.raises(ValueError, match=r"Calib_other.toml, Calib_qualisys.toml"):
        open_session(tmp_path, take="Trial_2")
    given = open_session(tmp_path, take="Trial_2", calibration=own)
    assert given.calibration == own


def test_without_videos(tmp_path: Path) -> None:
    save(name_cameras(["a", "b"]), tmp_path / "calibration.toml")
    with pytest.raises(ValueError, match="no videos and no folders of images"):
        open_session(tmp_path)


@pytest.mark.parametrize(
    ("make", "takes"),
    [(make_pose2sim, ["Trial_1", "Trial_2"]), (make_anipose, ["vid1", "vid2"]), (make_opencap, ["neutral", "squat"])],
)
def test_batch_finds_all_takes(tmp_path: Path, make: Callable[[Path], None], takes: list[str]) -> None:
    make(tmp_path)
    assert list_takes(tmp_path) == takes
    found, _ = find_recordings([str(tmp_path)], TrackingOptions())
    assert [recording.take for recording in found] == takes
    assert len({recording.digest for recording in found}) == len(takes)


def test_batch_of_a_recording_of_another_program(tmp_path: Path) -> None:
    make_freemocap(tmp_path / "recording_1")
    (recording,), _ = find_recordings([str(tmp_path / "recording_1")], TrackingOptions())
    assert (recording.name, recording.take) == ("recording_1", "")
