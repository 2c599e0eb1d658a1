"""Recordings as public reports describe them; docs/history/field-cases.md lists the reports."""

from __future__ import annotations

import shutil
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from sylpose.io import calibration
from sylpose.io.capture import open_session
from sylpose.io.capture.layouts import list_takes
from sylpose.io.capture.names import image_files, image_numbers, match_names
from sylpose.io.capture.repetitions import RepetitionFilter
from sylpose.rig import Camera, Rig
from sylpose.runs.candidates import list_frames, read_windows
from sylpose.runs.options import RunOptions
from tests.io.capture.test_capture import (
    SIZE,
    make_rig,
    paint,
    read_with_problems,
    two_folders,
    two_videos,
    write_images,
    write_video,
)


@pytest.mark.parametrize(
    ("name", "data", "reason"),
    [
        ("cam_1.mp4", b"", "the file is empty"),
        (
            "cam_1.mp4",
            b"\0\0\0\x14ftypisom" + bytes(8) + b"\0\0\x10\0mdat" + bytes(4088),
            "its index, moov, is missing",
        ),
        ("cam_1.mp4", b"\0\0\0\x14ftypisom" + bytes(8) + b"\0\0\0\x01mdat" + bytes(7) + b"\xff", "moov, is missing"),
        ("cam_1.avi", b"RIFF" + bytes(100), "Invalid data"),
    ],
)
def test_files_that_are_no_videos(folder: Path, name: str, data: bytes, reason: str) -> None:
    write_video(folder / "cam_0.mp4", 0, range(3))
    (folder / name).write_bytes(data)
    with pytest.raises(ValueError, match=rf"{name}: cannot be opened as a video \(.*{reason}"):
        open_session(folder)


@pytest.mark.parametrize(
    ("suffix", "remedy"),
    [
        (".h264", "ffmpeg -r RATE -i FILE"),
        (".zip", "unpack it first"),
        (".bag", "export"),
        (".cine", "maker's program"),
    ],
)
def test_remedies_of_other_files(folder: Path, suffix: str, remedy: str) -> None:
    for c in range(2):
        (folder / f"cam_{c}{suffix}").write_bytes(b"x")
    with pytest.raises(ValueError, match=rf"no videos.*cam_0{suffix}, cam_1{suffix}: .*{remedy}"):
        open_session(folder)
    write_video(folder / "cam_0.mp4", 0, range(3))
    with pytest.raises(ValueError, match=rf"no video .* for camera cam_1 .*{remedy}"):
        open_session(folder)


def test_thumbnails_are_no_cameras(folder: Path) -> None:
    """Of network drives, archives of macOS, Windows and viewers."""
    two_folders(folder)
    for name in ("@eaDir", "__MACOSX", "thumbnails", "#recycle"):
        write_images(folder / name, 0, range(2))
    for c in range(2):
        (folder / f"cam_{c}" / "Thumbs.db").write_bytes(b"x")
        (folder / f"cam_{c}" / "._0000.png").write_bytes(b"x")
        write_images(folder / f"cam_{c}" / "@eaDir", 0, range(2))
    assert read_with_problems(open_session(folder))[0] == [(k, k) for k in range(3)]


def test_videos_in_parts(folder: Path) -> None:
    """Action cameras number them by camera and part; without parts, names need not be equal."""
    for c in range(2):
        (folder / f"cam_{c}").mkdir()
        write_video(folder / f"cam_{c}" / f"GX01001{c}.MP4", c, range(3))
    assert read_with_problems(open_session(folder))[0] == [(k, k) for k in range(3)]
    assert list_takes(folder) == [""]
    for c in range(2):
        shutil.copy(folder / f"cam_{c}" / f"GX01001{c}.MP4", folder / f"cam_{c}" / f"GX02001{c}.MP4")
    with pytest.raises(
        ValueError, match=r"2 videos in cam_0 \(GX010010\.MP4, GX020010\.MP4\).*Join those of each camera"
    ):
        open_session(folder)


@pytest.mark.parametrize(
    ("files", "cameras"),
    [
        (["Video110374", "Video110376"], ["10374", "10376"]),
        (["trialleft", "trialright"], ["left", "right"]),
    ],
)
def test_names_within_words(files: list[str], cameras: list[str]) -> None:
    assert match_names(files, cameras) == dict(zip(files, cameras, strict=True))
    assert match_names(["Video10", "Video11"], ["0", "1"]) == {}
    assert match_names(["Video110374", "Video210374"], ["10374", "10376"]) == {}


def test_larger_of_several_video_streams(folder: Path) -> None:
    """The first one is a preview."""
    for c in range(2):
        with av.open(str(folder / f"cam_{c}.mkv"), "w") as container:
            streams = [container.add_stream("ffv1", rate=10) for _ in range(2)]
            for stream, size in zip(streams, ((80, 24), SIZE), strict=True):
                stream.width, stream.height, stream.pix_fmt = *size, "bgr0"
            for k in range(4):
                for stream in streams:
                    image = paint(c, k)[: stream.height, : stream.width]
                    container.mux(
                        stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="bgr24"))
                    )
            for stream in streams:
                container.mux(stream.encode(None))
    session = open_session(folder)
    assert read_with_problems(session)[0] == [(k, k) for k in range(4)]
    assert "cam_0: cam_0.mkv has 2 video streams; that of 160x48 is used." in session.warnings


def test_pixels_that_are_not_square(tmp_path: Path) -> None:
    """Calibrated at the size in which players show them."""
    first, second = make_rig(2)
    wide = Camera(second.name, (320, 48), second.matrix, np.zeros(5), second.camera_from_world)
    calibration.save(Rig([first, wide]), tmp_path / "calibration.toml")
    two_videos(tmp_path)
    with av.open(str(tmp_path / "cam_1.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        stream.codec_context.sample_aspect_ratio = Fraction(2)
        frame = av.VideoFrame.from_ndarray(paint(1, 0), format="bgr24").reformat(format="yuv420p")
        container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    with pytest.raises(ValueError, match=r"160x48, but camera cam_1 is calibrated at 320x48, .* not square \(2\)"):
        open_session(tmp_path)


def test_color_and_depth_in_one_folder(folder: Path) -> None:
    for c in range(2):
        write_images(folder / f"cam_{c}", c, range(3), "color_{:03d}.png")
        write_images(folder / f"cam_{c}", c, range(3), "depth_{:03d}.png")
    with pytest.raises(ValueError, match=r"color_000\.png and depth_000\.png are of two series"):
        open_session(folder)


@pytest.mark.parametrize(
    "stems",
    [
        ["image_1738133056.9658000", "image_1738133056.45788000", "image_1738133057.145716000"],
        ["1738133056_009658000", "1738133056_045788000", "1738133057_145716000"],
        ["1738133056.009658", "1738133056.045788", "1738133057.145716"],
        ["1738133056.009658", "1738133056.045788", "1738133057.1"],
    ],
)
def test_names_of_seconds_and_fractions(tmp_path: Path, stems: list[str]) -> None:
    """Nanoseconds without leading zeros, and decimals without the last ones."""
    for stem in reversed(stems):
        (tmp_path / f"{stem}.png").write_bytes(b"")
    files = image_files(tmp_path)
    assert [file.stem for file in files] == stems
    numbers = image_numbers(files)
    assert numbers is not None
    last = 1.1 if stems[-1].endswith(".1") else 1.145716
    np.testing.assert_allclose([n - 1738133056 * 10**9 for n in numbers], [9658000, 45788000, last * 1e9], atol=1)


def test_serial_numbers_are_no_times(tmp_path: Path) -> None:
    for k in range(3):
        (tmp_path / f"1234567890_{k:04d}.png").write_bytes(b"")
    assert image_numbers(image_files(tmp_path)) == (0, 1, 2)


def test_decimals_are_sorted_as_numbers(tmp_path: Path) -> None:
    for stem in ("1738133056.5", "1738133056.25", "1738133056.125"):
        (tmp_path / f"{stem}.png").write_bytes(b"")
    assert [file.stem for file in image_files(tmp_path)] == ["1738133056.125", "1738133056.25", "1738133056.5"]


@pytest.mark.parametrize(("delimiter", "encoding"), [(";", "utf-8-sig"), ("\t", "utf-16")])
def test_tables_of_spreadsheets(folder: Path, delimiter: str, encoding: str) -> None:
    """Semicolons and decimal commas, or tabs and UTF-16."""
    two_videos(folder, 4, 4)
    rows = ["frame,cam_0,cam_1", *(f"{k},{k / 10:.3f},{k / 10 + 0.001:.3f}" for k in range(4))]
    rows = [row.replace(",", delimiter).replace(".", ",") for row in rows]
    (folder / "timestamps.csv").write_bytes("\r\n".join(rows).encode(encoding))
    session = open_session(folder)
    np.testing.assert_allclose(session.timeline.stamps, [[k / 10, k / 10 + 0.001] for k in range(4)])


def test_time_codes_of_each_camera(folder: Path) -> None:
    """As rpicam-vid and mkvextract write them, milliseconds."""
    two_videos(folder, 4, 4)
    for c in range(2):
        rows = ["# timecode format v2", *(f"{33.333 * k + c:.3f}" for k in range(4))]
        (folder / f"cam_{c}_timestamps.txt").write_text("\n".join(rows) + "\n")
    session = open_session(folder)
    np.testing.assert_allclose(np.diff(session.timeline.times), 0.033333, atol=1e-9)
    assert read_with_problems(session)[0] == [(k, k) for k in range(4)]


def test_time_that_is_there_twice(folder: Path) -> None:
    two_videos(folder, 4, 4)
    rows = [f"{c},{k}" for k in (0, 1, 1, 2) for c in range(2)]
    (folder / "timestamps.csv").write_text("cam_id,frame_time\n" + "\n".join(rows))
    with pytest.raises(ValueError, match=r"cam_0: .* frame 2 has 1 after 1; remove what is there twice"):
        open_session(folder)


def test_black_pictures_at_the_ends() -> None:
    """As programs pad videos to one length; a dark scene in all cameras is not black."""
    rng = np.random.default_rng(0)
    pictures = RepetitionFilter(["cam_0", "cam_1"])
    for k in range(6):
        black = rng.normal(4, 2, (48, 160, 3)).clip(0, 255).astype(np.uint8)
        kept, messages = pictures.remove(k, [paint(0, k), black if k in (0, 1, 5) else paint(1, k)])
        assert [image is None for image in kept] == [False, k in (0, 1, 5)]
        assert messages == (["cam_1: frame 0 is black; such frames of it are not used."] if k == 0 else [])
    pictures = RepetitionFilter(["cam_0", "cam_1"])
    kept, messages = pictures.remove(0, [np.full((48, 160, 3), 9, np.uint8)] * 2)
    assert not messages
    assert all(image is not None for image in kept)


def test_damage_without_a_later_keyframe(folder: Path) -> None:
    two_videos(folder)
    for c in range(2):
        (folder / f"cam_{c}.mp4").unlink(missing_ok=True)
        write_video(folder / f"cam_{c}.mp4", c, range(12), "libx264")
    with av.open(str(folder / "cam_1.mp4")) as container:
        packet = [packet for packet in container.demux(video=0) if packet.size][5]
        position, size = packet.pos, packet.size
    assert position is not None
    data = bytearray((folder / "cam_1.mp4").read_bytes())
    data[position : position + size] = np.random.default_rng(0).integers(0, 256, size, np.uint8).tobytes()
    (folder / "cam_1.mp4").write_bytes(data)
    problems = read_with_problems(open_session(folder))[1]
    assert any("is damaged, and the later ones are predicted from it" in problem for problem in problems)


def test_search_for_motion_begins_with_all_cameras(folder: Path) -> None:
    """One camera is black at first; where all have images, the window begins at the first frame."""
    for c in range(2):
        write_video(folder / f"cam_{c}.mkv", c, range(16), "ffv1")
    assert next(window[0].index for window in read_windows(*list_frames(open_session(folder), RunOptions()))) == 0
    with av.open(str(folder / "cam_1.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=10)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "bgr0"
        for k in range(16):
            image = paint(1, k) if k >= 3 else np.zeros_like(paint(1, k))
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        container.mux(stream.encode(None))
    windows = list(read_windows(*list_frames(open_session(folder), RunOptions())))
    assert [frames.index for frames in windows[0]] == [*range(3, 16)]
