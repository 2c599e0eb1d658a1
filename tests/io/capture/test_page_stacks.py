"""Page stacks: TIFF files with one picture per page."""

from __future__ import annotations

import struct
import time
from pathlib import Path

import numpy as np
import PIL.Image
import pytest

from sylpose.input_limits import UnreadableFileError
from sylpose.io.capture import open_session
from sylpose.io.capture.page_stacks import PageStack, is_page_stack
from sylpose.io.capture.random_access import RandomAccessReader
from sylpose.io.capture.sources import find_recording_folders
from sylpose.runs.checkpoint import compute_fingerprint
from tests.io.capture.test_capture import (
    SIZE,
    make_calibration,
    paint,
    painted_numbers,
    read_with_problems,
    write_images,
    write_video,
)


def write_stack(
    path: Path, camera: int, n: int, shift: int = 0, compression: str | None = None, big_tiff: bool = False
) -> None:
    pages = []
    for k in range(n):
        gray = paint(camera, k)[:, :, 0]
        pages.append(PIL.Image.fromarray(gray.astype(np.uint16) << shift if shift else gray))
    pages[0].save(path, save_all=True, append_images=pages[1:], compression=compression, big_tiff=big_tiff)


@pytest.mark.parametrize("shift", [0, 4])
@pytest.mark.parametrize("compression", [None, "tiff_lzw", "tiff_deflate"])
def test_stack_for_each_camera(folder: Path, shift: int, compression: str | None) -> None:
    """8 bits, and 12 in 16."""
    for c, suffix in enumerate(("tif", "TIFF")):
        write_stack(folder / f"cam_{c}.{suffix}", c, 6, shift, compression, big_tiff=c == 1)
    session = open_session(folder)
    assert [(source.kind, source.n_frames, source.size) for source in session.sources] == [("pages", 6, SIZE)] * 2
    assert read_with_problems(session) == ([(k, k) for k in range(6)], [])
    images = next(session.frames(3)).images
    assert images[1] is not None
    np.testing.assert_array_equal(images[1], paint(1, 3))
    with RandomAccessReader(session) as reader:
        for k in (5, 0, 3):
            (frame,) = session.frames(k, k + 1)
            for image, other in zip(reader.read_frame_set(k), frame.images, strict=True):
                np.testing.assert_array_equal(image, other)
            assert painted_numbers(frame) == (k, k)
    assert compute_fingerprint(session)


def test_stack_beside_a_video_and_a_single_picture(folder: Path) -> None:
    write_stack(folder / "cam_0.tif", 0, 4)
    write_video(folder / "cam_1.mp4", 1, range(4))
    PIL.Image.fromarray(paint(0, 0)).save(folder / "poster.tif")
    PIL.Image.fromarray(paint(0, 0)).save(folder / "poster.png")
    assert read_with_problems(open_session(folder))[0] == [(k, k) for k in range(4)]


def test_batch_finds_page_stacks(tmp_path: Path) -> None:
    """Beside the calibration; videos with a picture beside them and folders of TIFF images remain what they are."""
    for name in ("a", "b", "c"):
        (tmp_path / name).mkdir()
        make_calibration(tmp_path / name)
        for c in range(2):
            if name == "a":
                write_stack(tmp_path / name / f"cam_{c}.tif", c, 3)
            elif name == "b":
                write_video(tmp_path / name / f"cam_{c}.mp4", c, range(3))
            else:
                write_images(tmp_path / name / f"cam_{c}", c, range(3), "{:04d}.tif")
    PIL.Image.fromarray(paint(0, 0)).save(tmp_path / "b" / "poster.tif")
    files = [path.relative_to(tmp_path) for path in tmp_path.rglob("*") if path.is_file()]
    assert find_recording_folders(files, False)[0] == [Path(name) for name in "abc"]


def test_pages_without_directories(folder: Path) -> None:
    """ImageJ's stacks of more than 4 GB."""
    width, height = SIZE
    text = b"ImageJ=1.53t\nimages=3\nslices=3\n\0"
    tags = [
        (256, 4, 1, width), (257, 4, 1, height), (258, 3, 1, 8), (262, 3, 1, 1), (270, 2, len(text), 200),
        (273, 4, 1, 300), (277, 3, 1, 1), (278, 4, 1, height), (279, 4, 1, width * height),
    ]  # fmt: skip
    head = b"II*\0" + struct.pack("<IH", 8, len(tags)) + b"".join(struct.pack("<HHII", *tag) for tag in tags)
    for c in range(2):
        data = (head + bytes(4)).ljust(200, b"\0") + text
        (folder / f"cam_{c}.tif").write_bytes(data.ljust(300, b"\0") + bytes(3 * width * height))
    with pytest.raises(ValueError, match=r"cam_0\.tif: its pages have no directories .* image sequence"):
        open_session(folder)


def test_damaged_stacks(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    sizes = [PIL.Image.new("L", SIZE), PIL.Image.new("L", (64, 48))]
    sizes[0].save(path, save_all=True, append_images=sizes[1:])
    with pytest.raises(UnreadableFileError, match=r"a\.tif: its pages have different sizes \(64x48, 160x48\)"):
        PageStack(path)
    PIL.Image.new("F", SIZE).save(path, save_all=True, append_images=[PIL.Image.new("F", SIZE)])
    with PageStack(path) as stack, pytest.raises(UnreadableFileError, match=r"page 1 has pixels of type F"):
        stack.read(1)
    write_stack(path, 0, 5)
    whole = path.read_bytes()
    path.write_bytes(whole[:-40])
    with PageStack(path) as stack, pytest.raises(UnreadableFileError, match=r"a\.tif: page 4 cannot be read"):
        stack.read(4)
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(UnreadableFileError, match=r"a\.tif: the directory of page \d cannot be read"):
        PageStack(path)
    path.write_bytes(b"II*\0" + bytes(100))
    assert not is_page_stack(path)
    with pytest.raises(UnreadableFileError, match=r"it has no pages"):
        PageStack(path)


def test_overlapping_directories_take_neither_time_nor_memory(tmp_path: Path) -> None:
    """Each of many directories has the same large tag."""
    path, n = tmp_path / "a.tif", 20_000
    tags = [(256, 4, 1, 8), (257, 4, 1, 8), (270, 2, 40 * n, 8)]
    data = b"II*\0" + struct.pack("<I", 8)
    for k in range(n):
        after = 0 if k == n - 1 else 8 + 42 * (k + 1)
        data += struct.pack("<H", 3) + b"".join(struct.pack("<HHII", *tag) for tag in tags) + struct.pack("<I", after)
    path.write_bytes(data)
    begin = time.perf_counter()
    with pytest.raises(UnreadableFileError, match=r"a\.tif: the directory of page \d+ cannot be read"):
        PageStack(path)
    assert time.perf_counter() - begin < 5
