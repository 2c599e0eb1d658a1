"""Malicious or damaged recordings cause a short message, quickly and with little memory (SECURITY.md)."""

from __future__ import annotations

import os
import struct
import time
import tracemalloc
import zlib
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import PIL.ExifTags
import PIL.Image
import pytest

from sylpose import open_session
from sylpose.input_limits import UnreadableFileError
from sylpose.io import calibration
from sylpose.io.capture.growing import DONE_FILE
from sylpose.io.capture.images import image_size_from_header, read_image, read_image_size
from sylpose.io.capture.live import open_live
from sylpose.io.capture.names import match_names
from sylpose.simulate import ring

SIZE = (64, 48)
FORMATS = (".png", ".jpg", ".tif", ".bmp", ".webp", ".ppm", ".jp2")


def picture(frame: int, suffix: str = ".png", size: tuple[int, int] = SIZE) -> bytes:
    image = np.random.default_rng(frame).integers(0, 255, (size[1], size[0], 3), np.uint8)
    return bytes(cv2.imencode(suffix, image)[1])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two cameras with five images each."""
    calibration.save(ring(2, size=SIZE), tmp_path / "calibration.toml")
    for camera in ("cam_0", "cam_1"):
        (tmp_path / camera).mkdir()
        for k in range(5):
            (tmp_path / camera / f"{k:04d}.bmp").write_bytes(picture(k, ".bmp"))
    return tmp_path


@pytest.mark.parametrize("suffix", FORMATS)
def test_header_size_matches_decoded_size(suffix: str) -> None:
    for size in ((640, 480), (33, 100), SIZE):
        data = picture(0, suffix, size)
        assert image_size_from_header(data) == size
        for cut in range(0, 200, 3):
            assert image_size_from_header(data[:cut]) in (None, size)


@pytest.mark.filterwarnings("error")
def test_headers_of_all_pixel_types_are_read() -> None:
    """Of 1, 8 and 16 bits, with palette, transparency, compression and rotation, as OpenCV decodes them."""
    rng, written = np.random.default_rng(0), list[bytes]()
    for shape, values in (
        ((48, 64), np.uint16),
        ((48, 64, 3), np.uint16),
        ((48, 64), np.uint8),
        ((48, 64, 4), np.uint8),
    ):
        image: Any = rng.integers(0, 255, shape).astype(values)
        written += [bytes(cv2.imencode(suffix, image)[1]) for suffix in (".png", ".tif", ".jp2")]
    rotated = PIL.Image.Exif()
    rotated[PIL.ExifTags.Base.Orientation] = 6
    cases: list[tuple[str, str, dict[str, Any]]] = [
        *[(mode, kind, {}) for mode in ("1", "L", "P", "RGB") for kind in ("TIFF", "PNG", "BMP", "WEBP")],
        ("CMYK", "JPEG", {}),
        ("RGB", "JPEG", {"progressive": True, "exif": rotated}),
        ("RGB", "TIFF", {"big_tiff": True}),
        ("RGB", "TIFF", {"compression": "tiff_lzw"}),
        ("RGB", "JPEG2000", {"no_jp2": True}),
    ]
    for mode, kind, options in cases:
        file = BytesIO()
        PIL.Image.new(mode, SIZE).save(file, kind, **options)
        written.append(file.getvalue())
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    for data in written:
        decoded = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        assert decoded is not None
        assert image_size_from_header(data) == decoded.shape[1::-1] == SIZE


@pytest.mark.filterwarnings("error")
def test_sizes_of_large_images_are_returned_without_warnings(tmp_path: Path) -> None:
    """Pillow's own limits are below the size of a camera."""
    file = tmp_path / "a.png"
    PIL.Image.new("1", (11_000, 10_000)).save(file)
    assert read_image_size(file) == (11_000, 10_000)
    header = b"RIFF" + struct.pack("<I", 22) + b"WEBPVP8X" + struct.pack("<II", 10, 0)
    file.write_bytes(header + 2 * (16_000).to_bytes(3, "little"))
    with pytest.raises(UnreadableFileError, match=r"a\.png: more than the 134217728 pixels that an image may have"):
        read_image_size(file)


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("order", "<>")
def test_overlapping_tags_of_small_images_do_not_take_memory(order: str) -> None:
    """The value of each tag is the whole file."""
    n, n_padding = 1000, 20_000
    n_bytes = 8 + 2 + 12 * (n + 2) + 4 + n_padding
    sides = [struct.pack(f"{order}HHII", 256 + i, 4, 1, side) for i, side in enumerate(SIZE)]
    tags = [struct.pack(f"{order}HHII", 1000 + i, 7, n_bytes - i, 0) for i in range(n)]
    start = struct.pack(f"{order}2sHIH", b"II" if order == "<" else b"MM", 42, 8, n + 2)
    data = start + b"".join(sides + tags) + bytes(4 + n_padding)
    tracemalloc.start()
    assert image_size_from_header(data) == SIZE
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10 * len(data)


def test_broken_header_loses_one_frame(folder: Path) -> None:
    data = bytearray(picture(2, ".bmp"))
    data[19] = 0x7D  # image width
    (folder / "cam_0" / "0002.bmp").write_bytes(data)
    data = bytearray(picture(3, ".bmp"))
    data[28] = 77  # bits per pixel
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
    assert "32064x48, not 64x48 pixels; this frame is missing" in problems[0]
    assert "cannot be read as an image; this frame is missing" in problems[1]


def test_huge_images_are_not_decoded(tmp_path: Path) -> None:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    black = zlib.compress(bytes(100 * (1 + 3 * 32_000)))  # decoders allocate all pixels before they detect missing data
    header = struct.pack(">IIBBBBB", 32_000, 32_000, 8, 2, 0, 0, 0)
    file = tmp_path / "a.png"
    file.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", black) + chunk(b"IEND", b""))
    begin = time.process_time()  # machines may be busy
    with pytest.raises(UnreadableFileError, match=r"a\.png: 32000x32000, not 64x48 pixels") as caught:
        read_image(file, SIZE)
    assert time.process_time() - begin < 0.2
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("lossless", [False, True])
@pytest.mark.parametrize(("step", "name"), [(50_000_123, "{:019d}.bmp"), (10**7, "{}.bmp")])
def test_sparse_numbers_are_followed_quickly(folder: Path, step: int, name: str, lossless: bool) -> None:
    """EuRoC and ROS name images by nanoseconds since 1970."""
    start = 1_403_636_579_763_555_584
    for camera in ("cam_0", "cam_1"):
        for k in range(5):
            # All intervals differ slightly.
            (folder / camera / f"{k:04d}.bmp").rename(folder / camera / name.format(start + k * step + k * k))
    (folder / DONE_FILE).touch()
    begin = time.perf_counter()
    sets = list(open_live(folder, follow=True, idle=0.3, lossless=lossless).frames(on_problem=pytest.fail))
    assert time.perf_counter() - begin < 30  # counting by ones would take minutes
    assert len(sets) == 5
    assert all(image is not None for s in sets for image in s.images)


def test_nanosecond_numbers_in_recordings(folder: Path) -> None:
    for camera in ("cam_0", "cam_1"):
        for k in range(5):
            (folder / camera / f"{k:04d}.bmp").rename(folder / camera / f"{10**25 + 7 * k}.bmp")
    (folder / "cam_1" / f"{10**25 + 14}.bmp").unlink()
    session = open_session(folder)
    assert session.timeline.frames.tolist() == [[0, 0], [1, 1], [2, -1], [3, 2], [4, 3]]


@pytest.mark.parametrize("frames", [99_999_999_999, -99_999_999_999, 6])
def test_offsets_beyond_recording_are_rejected(folder: Path, frames: int) -> None:
    with pytest.raises(ValueError, match=r"offsets: the offset of cam_0, -?[0-9]+, exceeds the number of frames, 5"):
        open_session(folder, offsets={"cam_0": frames})


@pytest.mark.skipif(os.name == "nt", reason="there are no pipes in folders")
def test_pipes_and_circular_links_do_not_block(folder: Path) -> None:
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
def test_playlists_are_rejected(folder: Path, content: str) -> None:
    """FFmpeg would open the listed files, including other people's files and URLs."""
    for camera in ("cam_0", "cam_1"):
        for file in (folder / camera).iterdir():
            file.unlink()
        (folder / f"{camera}.mp4").write_text(content.format("http://127.0.0.1:9/secret.mp4"))
    with pytest.raises(ValueError, match=r"cam_0\.mp4: cannot be opened as a video"):
        open_session(folder)


def test_name_matching_time_is_subquadratic() -> None:
    begin = time.process_time()  # machines may be busy
    match_names([f"frame {k}" for k in range(50_000)], [f"cam_{c}" for c in range(100)])
    assert time.process_time() - begin < 2
