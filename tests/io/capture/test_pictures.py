"""Unusual pictures: repeated ones, 16 bits, interlaced fields, names of other operating systems."""

from __future__ import annotations

import unicodedata
from pathlib import Path

import av
import numpy as np
import pytest

from sylpose.geometry.arrays import Image
from sylpose.io import calibration
from sylpose.io.capture import open_session
from sylpose.io.capture.repetitions import RepetitionFilter
from sylpose.rig import Camera, Rig
from tests.io.capture.test_capture import SIZE, make_rig, paint, read_with_problems, write_video


def add_noise(image: Image, rng: np.random.Generator, sigma: float = 2.0) -> Image:
    return np.clip(image + rng.normal(0, sigma, image.shape), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("codec", ["ffv1", "libx264", "mjpeg"])
def test_repeated_pictures_are_not_used(folder: Path, codec: str) -> None:
    """As after conversion to a constant frame rate, also when reading starts with one."""
    write_video(folder / "cam_0.mkv", 0, [0, 1, 2, 3, 3, 5, 6, 7, 7, 9], codec)
    write_video(folder / "cam_1.mkv", 1, range(10), codec)
    session = open_session(folder)
    expected = [(k if k not in (4, 8) else None, k) for k in range(10)]
    rows, problems = read_with_problems(session)
    assert rows == expected
    assert len(problems) == 1
    assert "cam_0: frame 4 shows the same picture as before" in problems[0]
    assert [frame.images[0] is None for frame in session.frames(4, 9)] == [True, False, False, False, True]
    assert [frame.images[0] is None for frame in session.frames(2, 9, 2)] == [False] * 4


def test_frozen_and_black_cameras_are_not_used() -> None:
    rng = np.random.default_rng(0)
    names = ["frozen", "black", "live", "other"]
    pictures = RepetitionFilter(names)
    still = add_noise(paint(0, 7), rng)
    reported = list[str]()
    for k in range(5):
        images = [still, np.zeros_like(still), add_noise(paint(2, k), rng), add_noise(paint(3, k), rng)]
        kept, messages = pictures.remove(k, images)
        reported += messages
        assert [image is None for image in kept] == [k > 0, True, False, False]
    assert [message.split(":")[0] for message in reported] == ["black", "frozen"]


def test_a_resting_scene_is_not_repeated() -> None:
    """Neither while nothing moves in any camera, nor in a live camera that sees no motion."""
    rng = np.random.default_rng(0)
    pictures = RepetitionFilter(["cam_0", "cam_1"])
    for k in range(3):
        kept, _ = pictures.remove(k, [paint(0, 1), paint(1, 1)])
        assert all(image is not None for image in kept)
    pictures = RepetitionFilter(["cam_0", "cam_1"])
    for k in range(3):
        moving = paint(1, 1).copy()
        moving[10:30, 30 * k : 30 * k + 40] = 90
        kept, _ = pictures.remove(k, [add_noise(paint(0, 1), rng), add_noise(moving, rng)])
        assert all(image is not None for image in kept)
    assert pictures.remove(3, [None, paint(1, 9)])[0][0] is None


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
def test_depth_of_gray_videos(folder: Path, bits: int) -> None:
    for c in range(2):
        with av.open(str(folder / f"cam_{c}.mkv"), "w") as container:
            stream = container.add_stream("ffv1", rate=10)
            stream.width, stream.height, stream.pix_fmt = *SIZE, "gray16le"
            for k in range(4):
                pixels = np.left_shift(paint(c, k)[:, :, 0].astype(np.uint16), bits - 8, dtype=np.uint16)
                container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="gray16le")))
            container.mux(stream.encode(None))
    session = open_session(folder)
    assert read_with_problems(session)[0] == [(k, k) for k in range(4)]
    (frame,) = session.frames(2, 3)
    assert frame.images[1] is not None
    np.testing.assert_array_equal(frame.images[1], paint(1, 2))


def test_one_field_of_interlaced_videos(folder: Path) -> None:
    """The lower field shows another moment; the upper one keeps its place."""
    rows = np.linspace(40, 200, SIZE[1])
    picture = np.broadcast_to(rows[:, None, None], (SIZE[1], SIZE[0], 3)).astype(np.uint8).copy()
    picture[1::2] = 0
    for c in range(2):
        with av.open(str(folder / f"cam_{c}.mpg"), "w") as container:
            stream = container.add_stream("mpeg2video", rate=25, options={"flags": "+ildct+ilme", "qscale": "1"})
            stream.width, stream.height, stream.pix_fmt, stream.bit_rate = *SIZE, "yuv420p", 8_000_000
            for _ in range(5):
                frame = av.VideoFrame.from_ndarray(picture, format="bgr24").reformat(format="yuv420p")
                container.mux(stream.encode(frame))
            container.mux(stream.encode(None))
    image = next(open_session(folder).frames()).images[0]
    assert image is not None
    assert np.abs(image[:-1].mean(axis=(1, 2)) - rows[:-1]).max() < 6


def test_decomposed_letters_in_names(tmp_path: Path) -> None:
    """As macOS writes them; the calibration has composed ones."""
    names = ["Kamera s\u00fcd", "Kamera n\u00f6rd"]
    first, second = (
        Camera(name, its.size, its.matrix, np.zeros(5), its.camera_from_world)
        for name, its in zip(names, make_rig(2), strict=True)
    )
    calibration.save(Rig([first, second]), tmp_path / "calibration.toml")
    for c, name in enumerate(names):
        write_video(tmp_path / (unicodedata.normalize("NFD", name) + ".mp4"), c, range(4))
    assert read_with_problems(open_session(tmp_path))[0] == [(k, k) for k in range(4)]
