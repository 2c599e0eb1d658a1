"""Frames are turned as their files specify, as OpenCV turns them."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image as PillowImage

from sylpose.geometry.arrays import Image
from sylpose.io import calibration
from sylpose.io.capture import open_session
from sylpose.io.capture.images import orient, read_exif_focal, read_image, read_orientation
from sylpose.io.capture.random_access import RandomAccessReader
from sylpose.io.capture.session import use_frames_as_coded
from sylpose.rig import Camera, Rig
from sylpose.runs.check import collect_facts
from sylpose.runs.rig_evidence import resolve_orientation
from tests.io.capture.test_capture import make_rig, write_video

WIDTH, HEIGHT = 160, 48
# Display matrices of MP4, of the clockwise angle that OpenCV reports.
MATRICES = {90: (0, 1, -1, 0), 180: (-1, 0, 0, -1), 270: (0, -1, 1, 0)}


def write_rotation(path: Path, degrees: int) -> None:
    """Write a display matrix into the header of an MP4 file's only track."""
    data = bytearray(path.read_bytes())
    a, b, c, d = (value << 16 for value in MATRICES[degrees])
    start = data.index(b"tkhd") + 8 + 20 + 16  # version and flags, times, layer and volume
    data[start : start + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path.write_bytes(data)


def make_folder(path: Path, degrees: int, sizes: tuple[int, int]) -> Path:
    """Make a recording of two cameras of which the second has a rotation; `sizes` is the calibration's of it."""
    first, second = make_rig(2)
    calibration.save(
        Rig([first, Camera("cam_1", sizes, second.matrix, np.zeros(5), second.camera_from_world)]),
        path / "calibration.toml",
    )
    for c in range(2):
        write_video(path / f"cam_{c}.mp4", c, range(4))
    write_rotation(path / "cam_1.mp4", degrees)
    return path


@pytest.mark.parametrize("degrees", MATRICES)
def test_display_matrix_is_applied_as_opencv_does(tmp_path: Path, degrees: int) -> None:
    size = (WIDTH, HEIGHT) if degrees == 180 else (HEIGHT, WIDTH)
    session = open_session(make_folder(tmp_path, degrees, size))
    (image,) = (frame.images[1] for frame in session.frames(2, 3))
    capture = cv2.VideoCapture(str(tmp_path / "cam_1.mp4"))
    expected = [capture.read()[1] for _ in range(3)][2]
    assert image is not None
    assert np.abs(image.astype(int) - expected).max() <= 2
    with RandomAccessReader(session) as reader:
        np.testing.assert_array_equal(reader.read_frame_set(2)[1], image)
    assert ("Turned", "as the files specify (display matrix or EXIF): cam_1") in collect_facts(session, {})
    assert session.has_ambiguous_orientation == (degrees == 180)


def test_frames_as_coded(tmp_path: Path) -> None:
    """If the calibration fits only them, or if the user says so where it fits both."""
    session = open_session(make_folder(tmp_path, 90, (WIDTH, HEIGHT)))
    assert session.sources[1].orientation == 1
    assert "cam_1.mp4 has a rotation that is not applied" in session.warnings[0]
    folder = tmp_path / "both"
    folder.mkdir()
    session = open_session(make_folder(folder, 180, (WIDTH, HEIGHT)), as_coded=True)
    (image,) = (frame.images[1] for frame in session.frames(0, 1))
    (turned,) = (frame.images[1] for frame in open_session(folder).frames(0, 1))
    assert image is not None
    assert turned is not None
    np.testing.assert_array_equal(image[::-1, ::-1], turned)
    coded = use_frames_as_coded(open_session(folder))
    assert [source.orientation for source in coded.sources] == [1, 1]
    # Without anything that moves there is no evidence against the turn.
    assert resolve_orientation(open_session(folder)).sources[1].orientation == 3


def test_size_of_neither(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"images of 160x48 \(48x160 with the file's rotation\)"):
        open_session(make_folder(tmp_path, 270, (96, 96)))


def draw() -> Image:
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[: HEIGHT // 2, : WIDTH // 4], image[HEIGHT // 2 :, : WIDTH // 2] = 255, 120
    return image


def test_missing_file_is_no_upright_one(tmp_path: Path) -> None:
    for read in (read_orientation, read_exif_focal):
        with pytest.raises(OSError, match=r"none\.jpg"):
            read(tmp_path / "none.jpg")


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp"])
@pytest.mark.parametrize("code", range(1, 9))
def test_exif_orientation_is_applied_as_opencv_does(tmp_path: Path, suffix: str, code: int) -> None:
    exif = PillowImage.Exif()
    exif[274] = code
    path = tmp_path / f"a.{suffix}"
    PillowImage.fromarray(draw()).save(path, exif=exif, quality=95, lossless=True)
    assert read_orientation(path) == code
    size = (WIDTH, HEIGHT) if code < 5 else (HEIGHT, WIDTH)
    image = read_image(path, size, code)
    assert np.abs(image.astype(int) - orient(draw(), code)).max() < 40
    np.testing.assert_array_equal(image, cv2.imread(str(path)))


def test_images_of_a_folder_are_turned(tmp_path: Path) -> None:
    first, second = make_rig(2)
    turned = Camera("cam_1", (HEIGHT, WIDTH), second.matrix, np.zeros(5), second.camera_from_world)
    calibration.save(Rig([first, turned]), tmp_path / "calibration.toml")
    exif = PillowImage.Exif()
    exif[274] = 6
    for c in range(2):
        (tmp_path / f"cam_{c}").mkdir()
        for k in range(3):
            PillowImage.fromarray(draw()).save(tmp_path / f"cam_{c}" / f"{k}.jpg", exif=exif if c else b"")
    frames = list(open_session(tmp_path).frames())
    assert len(frames) == 3
    assert frames[0].images[1] is not None
    assert frames[0].images[1].shape == (WIDTH, HEIGHT, 3)
