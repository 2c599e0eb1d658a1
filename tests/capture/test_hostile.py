"""Recordings that mean ill, or were damaged: a sentence and no more, at once, in little memory (SECURITY.md)."""

from __future__ import annotations

import os
import struct
import time
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from sylpose import calibration, open_session
from sylpose.capture.growing import DONE
from sylpose.capture.headers import said_size
from sylpose.capture.images import read_image
from sylpose.capture.live import open_live
from sylpose.capture.names import match_names
from sylpose.input_limits import Unreadable
from sylpose.simulate import ring

SIZE = (64, 48)
FORMATS = (".png", ".jpg", ".tif", ".bmp", ".webp", ".ppm", ".jp2")


def picture(frame: int, suffix: str = ".png", size: tuple[int, int] = SIZE) -> bytes:
    image = np.random.default_rng(frame).integers(0, 255, (size[1], size[0], 3), np.uint8)
    return bytes(cv2.imencode(suffix, image)[1])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two cameras of five images each."""
    calibration.save(ring(2, size=SIZE), tmp_path / "calibration.toml")
    for camera in ("cam_0", "cam_1"):
        (tmp_path / camera).mkdir()
        for k in range(5):
            (tmp_path / camera / f"{k:04d}.bmp").write_bytes(picture(k, ".bmp"))
    return tmp_path


@pytest.mark.parametrize("suffix", FORMATS)
def test_headers_tell_what_is_decoded(suffix: str) -> None:
    for size in ((640, 480), (33, 100), SIZE):
        data = picture(0, suffix, size)
        assert said_size(data) == size
        for cut in range(0, 200, 3):
            assert said_size(data[:cut]) in (None, size)


def test_a_broken_header_in_mid_recording_costs_one_frame(folder: Path) -> None:
    data = bytearray(picture(2, ".bmp"))
    data[19] = 0x7D  # of the width
    (folder / "cam_0" / "0002.bmp").write_bytes(data)
    data = bytearray(picture(3, ".bmp"))
    data[28] = 77  # bits of a pixel
    (folder / "cam_1" / "0003.bmp").write_bytes(data)
    problems: list[str] = []
    sets = list(open_session(folder).frames(on_problem=problems.append))
    assert [[image is not None for image in s.images] for s in sets] == [
        *([[True, True]] * 2),
        [False, True],
        [True, False],
        [True, True],
    ]
    assert [p.split(":")[0] for p in problems] == ["cam_0", "cam_1"]
    assert "32064x48, not 64x48 pixels; this camera misses the frame" in problems[0]
    assert "cannot be read as an image; this camera misses the frame" in problems[1]


def test_gigabytes_of_pixels_are_not_decoded(tmp_path: Path) -> None:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    black = zlib.compress(
        bytes(100 * (1 + 3 * 32_000))
    )  # decoders take memory for all before they find that some are missing
    header = struct.pack(">IIBBBBB", 32_000, 32_000, 8, 2, 0, 0, 0)
    file = tmp_path / "a.png"
    file.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", black) + chunk(b"IEND", b""))
    begin = time.process_time()  # machines may be busy
    with pytest.raises(Unreadable, match=r"a\.png: 32000x32000, not 64x48 pixels") as caught:
        read_image(file, SIZE)
    assert time.process_time() - begin < 0.2
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("lossless", [False, True])
@pytest.mark.parametrize(("step", "name"), [(50_000_123, "{:019d}.bmp"), (10**7, "{}.bmp")])
def test_numbers_far_apart_are_followed_at_once(folder: Path, step: int, name: str, lossless: bool) -> None:
    """Nanoseconds since 1970 name the images of EuRoC and ROS."""
    start = 1_403_636_579_763_555_584
    for camera in ("cam_0", "cam_1"):
        for k in range(5):
            # No two intervals are quite the same.
            (folder / camera / f"{k:04d}.bmp").rename(folder / camera / name.format(start + k * step + k * k))
    (folder / DONE).touch()
    begin = time.perf_counter()
    sets = list(open_live(folder, follow=True, idle=0.3, lossless=lossless).frames(on_problem=pytest.fail))
    assert time.perf_counter() - begin < 30  # one by one it would be minutes
    assert len(sets) == 5
    assert all(image is not None for s in sets for image in s.images)


def test_nanoseconds_are_instants_of_recordings_too(folder: Path) -> None:
    for camera in ("cam_0", "cam_1"):
        for k in range(5):
            (folder / camera / f"{k:04d}.bmp").rename(folder / camera / f"{10**25 + 7 * k}.bmp")
    (folder / "cam_1" / f"{10**25 + 14}.bmp").unlink()
    session = open_session(folder)
    assert session.timeline.frames.tolist() == [[0, 0], [1, 1], [2, -1], [3, 2], [4, 3]]


@pytest.mark.parametrize("frames", [99_999_999_999, -99_999_999_999, 6])
def test_offsets_beyond_the_recording_are_refused(folder: Path, frames: int) -> None:
    with pytest.raises(ValueError, match=r"offsets: the offset of cam_0, -?[0-9]+, is more than the 5 frames"):
        open_session(folder, offsets={"cam_0": frames})


@pytest.mark.skipif(os.name == "nt", reason="there are no pipes in folders")
def test_pipes_and_circles_hold_nobody_up(folder: Path) -> None:
    for name in ("timestamps.csv", "boxes.toml", "cam_0/0009.bmp", "cam_1.mp4"):
        os.mkfifo(folder / name)
    (folder / "masks").symlink_to(folder / "masks")
    (folder / "cam_2").symlink_to(folder / "cam_3")
    (folder / "cam_3").symlink_to(folder / "cam_2")
    with pytest.raises(ValueError, match="both for camera cam_1"):
        open_session(folder)
    (folder / "cam_1.mp4").unlink()
    assert open_session(folder).n_frames == 5
    with pytest.raises(ValueError, match=r"boxes\.toml: a file is expected, not a folder, a pipe or a device"):
        open_session(folder, boxes=folder / "boxes.toml")
    with pytest.raises(ValueError, match=r"boxes\.toml: a file is expected, not a folder, a pipe or a device"):
        open_session(folder, calibration=folder / "boxes.toml")


@pytest.mark.parametrize(
    "content", ["#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n{}\n#EXT-X-ENDLIST\n", "ffconcat version 1.0\nfile {}\n"]
)
def test_a_list_of_other_files_is_no_video(folder: Path, content: str) -> None:
    """FFmpeg would open what it names, other people's files and URLs included."""
    for camera in ("cam_0", "cam_1"):
        for file in (folder / camera).iterdir():
            file.unlink()
        (folder / f"{camera}.mp4").write_text(content.format("http://127.0.0.1:9/secret.mp4"))
    with pytest.raises(ValueError, match=r"cam_0\.mp4: cannot be opened as a video"):
        open_session(folder)


def test_names_of_many_files_take_no_square_of_time() -> None:
    begin = time.process_time()  # machines may be busy
    match_names([f"frame {k}" for k in range(50_000)], [f"cam_{c}" for c in range(100)])
    assert time.process_time() - begin < 2
