"""Recordings opened with lenses in place of a calibration: which entries are cameras, in every layout."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pictures
from PIL.ExifTags import IFD, Base
from PIL.TiffImagePlugin import IFDRational

from sylpose.io import calibration
from sylpose.io.calibration.lenses import LensFile, parse_fov
from sylpose.io.capture import open_session
from sylpose.io.capture.images import read_exif_focal
from sylpose.io.capture.session import open_uncalibrated
from tests.io.capture.test_capture import SIZE, make_rig, two_folders, two_videos, write_images, write_video

NAMES = ("cam_0", "cam_1")


def nest_videos(folder: Path) -> None:
    for c, name in enumerate(NAMES):
        (folder / name).mkdir()
        write_video(folder / name / "0001.mp4", c, range(8))


def in_videos_folder(folder: Path) -> None:
    (folder / "videos").mkdir()
    nest_videos(folder / "videos")


@pytest.fixture
def lens(tmp_path: Path) -> LensFile:
    """Return a file of one lens, outside of the recording."""
    file = tmp_path / "lens.json"
    file.write_text(json.dumps({"K": make_rig(1)[0].matrix.tolist(), "dist": [0.0] * 5}))
    return None, file


@pytest.mark.parametrize("make", [two_videos, two_folders, nest_videos, in_videos_folder])
def test_cameras_are_the_same_in_all_ways(make: Callable[[Path], None], lens: LensFile, tmp_path: Path) -> None:
    """Masks, results and pictures of boards are none of them."""
    folder = tmp_path / "recording"
    folder.mkdir()
    make(folder)
    for other in ("masks", "sylpose", "calibration_images", "silhouettes"):
        for c, name in enumerate(NAMES):
            write_images(folder / other / name, c, range(2))
    calibration.save(make_rig(2), tmp_path / "both.toml")
    sessions = (
        open_session(folder, lenses=[lens], masks=folder / "silhouettes"),
        open_session(folder, lenses=[(None, tmp_path / "both.toml")]),
        open_session(folder, fov=60.0),
        open_uncalibrated(folder),
    )
    for session in sessions:
        assert session.rig.names == NAMES
        assert [source.path.stem for source in session.sources] in ([*NAMES], ["0001"] * 2)
    assert [session.masks and session.masks.name for session in sessions] == ["silhouettes", "masks", "masks", None]
    assert sessions[2].rig[0].matrix[0, 0] == pytest.approx(0.5 * SIZE[0] / np.tan(np.radians(30.0)))
    assert sessions[3].rig[0].matrix[0, 0] == pytest.approx(SIZE[0], rel=1e-4)


def test_folder_of_masks_beside_image_folders(lens: LensFile, tmp_path: Path) -> None:
    """A folder given as that of the masks is no camera, though it has images."""
    folder = tmp_path / "recording"
    two_folders(folder)
    (folder / "silhouettes").mkdir()
    for name in NAMES:
        Pictures.new("L", SIZE, 255).save(folder / "silhouettes" / f"{name}.png")
    assert open_session(folder, lenses=[lens], masks=folder / "silhouettes").rig.names == NAMES


def test_takes_are_selected(lens: LensFile, tmp_path: Path) -> None:
    folder = tmp_path / "recording"
    for take in ("walk", "throw"):
        (folder / take).mkdir(parents=True)
        two_videos(folder / take)
    for take in ("walk", "throw"):
        assert open_session(folder, lenses=[lens], take=take).path == folder / take
        assert open_uncalibrated(folder, take=take).rig.names == NAMES
    several = r"several takes \(throw, walk\); select one with --take NAME"
    with pytest.raises(ValueError, match=several):
        open_session(folder, fov=60.0)
    with pytest.raises(ValueError, match=several):
        open_uncalibrated(folder)


def test_cameras_are_excluded(lens: LensFile, tmp_path: Path) -> None:
    """By the names of the sources, or of the lenses; an excluded camera needs no lens."""
    folder = tmp_path / "recording"
    folder.mkdir()
    for c in range(3):
        write_video(folder / f"{c}.mp4", c, range(8))
    own: list[LensFile] = [("0", lens[1]), ("2", lens[1])]
    assert open_session(folder, lenses=own, without=["1"]).rig.names == ("0", "2")
    assert open_session(folder, lenses=[lens], without=["1"]).rig.names == ("0", "2")
    calibration.save(make_rig(3), tmp_path / "all.toml")
    session = open_session(folder, lenses=[(None, tmp_path / "all.toml")], without=["cam_1"])
    assert (session.rig.names, session.without) == (("cam_0", "cam_2"), ("cam_1",))
    assert [source.path.name for source in session.sources] == ["0.mp4", "2.mp4"]
    for lenses in (own, [lens], [(None, tmp_path / "all.toml")]):
        with pytest.raises(ValueError, match="without: 'cam_9' is not a camera of"):
            open_session(folder, lenses=lenses, without=["1", "cam_9"])
    with pytest.raises(ValueError, match=r"without: no camera of .* remains"):
        open_session(folder, lenses=[lens], without=["0", "1", "2"])


def write_photos(folder: Path, tags: dict[int, object], size: tuple[int, int] = (400, 300)) -> Path:
    folder.mkdir(parents=True)
    exif = Pictures.Exif()
    exif.get_ifd(IFD.Exif).update(tags)
    for k in range(3):
        Pictures.new("RGB", size, (50 * k, 0, 0)).save(folder / f"{k}.jpg", exif=exif)
    return folder / "0.jpg"


SENSOR = {
    Base.FocalLength: IFDRational(24),
    Base.FocalPlaneXResolution: IFDRational(5000),
    Base.FocalPlaneResolutionUnit: 3,
    Base.ExifImageWidth: 4000,
    Base.ExifImageHeight: 3000,
}


@pytest.mark.parametrize(
    ("tags", "expected"),
    [
        ({Base.FocalLengthIn35mmFilm: 26}, 26.0 * 500.0 / np.hypot(36.0, 24.0)),
        # 500 pixels per mm on a sensor of which the image has a tenth of the width.
        (SENSOR, 24.0 * 500.0 / 10.0),
        ({**SENSOR, Base.FocalLengthIn35mmFilm: 0}, 1200.0),
        ({**SENSOR, Base.FocalPlaneXResolution: IFDRational(0)}, None),
        ({Base.FocalLength: IFDRational(24)}, None),
        ({}, None),
    ],
)
def test_focal_length_of_photographs(tags: dict[int, object], expected: float | None, tmp_path: Path) -> None:
    for size in ((400, 300), (300, 400)):
        found = read_exif_focal(write_photos(tmp_path / f"{size[0]}", tags, size))
        assert found == (None if expected is None else pytest.approx(expected, rel=1e-4))


def test_recording_of_photographs(tmp_path: Path) -> None:
    folder = tmp_path / "recording"
    for name, focal in (("cam_0", 26), ("cam_1", 52)):
        write_photos(folder / name, {Base.FocalLengthIn35mmFilm: focal})
    rig = open_session(folder, fov="exif").rig
    assert rig[1].matrix[0, 0] == pytest.approx(2.0 * rig[0].matrix[0, 0])
    assert rig[0].matrix[0, 0] == pytest.approx(26.0 * 500.0 / 43.267, rel=1e-4)
    write_photos(folder / "cam_2", {})
    write_video(folder / "cam_3.mp4", 3, range(3))
    with pytest.raises(ValueError, match=r"fov: no focal length in the EXIF of cam_2, cam_3 .*videos do not"):
        open_session(folder, fov="exif")
    write_photos(folder / "cam_4", {Base.FocalLengthIn35mmFilm: 5000})
    with pytest.raises(ValueError, match=re.escape("got 0.396641 in the EXIF of cam_4")):
        open_session(folder, fov="exif", without=["cam_2", "cam_3"])


def test_field_of_view_is_parsed() -> None:
    assert [parse_fov(text) for text in (None, "exif", "60")] == [None, "exif", 60.0]
    with pytest.raises(ValueError, match="fov: degrees, or exif for photographs, are expected, got 'wide'"):
        parse_fov("wide")
