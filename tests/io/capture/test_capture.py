"""Sessions: each delivered frame is identified by the camera and frame number painted into it."""

from __future__ import annotations

import shutil
import threading
import warnings
import weakref
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import cast

import av
import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from sylpose.frames import Box, FrameSet
from sylpose.io import calibration
from sylpose.io.capture import Session, open_session
from sylpose.io.capture.names import image_files, image_numbers, match_names, split_takes
from sylpose.io.capture.sources import Source
from sylpose.io.capture.time_tables import find_time_table
from sylpose.io.capture.timeline import build_timeline
from sylpose.rig import Camera, Rig
from sylpose.runs.run import output_path
from tests.paths import DATA

SIZE = (160, 48)
BITS = 10


def paint(camera: int, frame: int, size: tuple[int, int] = SIZE) -> NDArray[np.uint8]:
    """Draw ten dark or white fields: the bits of 256 * camera + frame."""
    bits = [(camera * 256 + frame) >> b & 1 for b in range(BITS)]
    row = np.repeat(np.array(bits, np.uint8) * 208 + 28, size[0] // BITS)
    return np.ascontiguousarray(np.broadcast_to(row[None, :, None], (size[1], size[0], 3)))


def decode_painted(image: NDArray[np.uint8] | None) -> tuple[int, int] | None:
    """Decode the (camera, frame) painted into an image."""
    if image is None:
        return None
    fields = image.mean(axis=(0, 2)).reshape(BITS, -1)[:, 4:-4].mean(axis=1) > 127
    return divmod(int((fields * (1 << np.arange(BITS))).sum()), 256)


def painted_numbers(frame_set: FrameSet) -> tuple[int | None, ...]:
    """Return each camera's frame number, after checking that the image belongs to the camera."""
    numbers: list[int | None] = []
    for c, image in enumerate(frame_set.images):
        code = decode_painted(image)
        assert code is None or code[0] == c
        numbers.append(None if code is None else code[1])
    return tuple(numbers)


def write_video(
    path: Path,
    camera: int,
    frames: Iterable[int],
    codec: str = "mpeg4",
    rate: int = 10,
    size: tuple[int, int] = SIZE,
    pts: Sequence[int] | None = None,
    noise: int = 0,
    movflags: str = "",
) -> None:
    pixels = {"mjpeg": "yuvj420p", "ffv1": "bgr0"}.get(codec, "yuv420p")
    rng = np.random.default_rng(0)
    with av.open(str(path), "w", options={"movflags": movflags} if movflags else {}) as container:
        stream = cast(av.VideoStream, container.add_stream(codec, rate=rate))
        stream.width, stream.height, stream.pix_fmt = *size, pixels
        for i, k in enumerate(frames):
            image = paint(camera, k, size)
            if noise:  # large frames, so that half of the bytes contain about half of the frames
                image = np.clip(image + rng.integers(-noise, noise, image.shape), 0, 255).astype(np.uint8)
            frame = av.VideoFrame.from_ndarray(image, format="bgr24")
            if pts is not None:
                frame.pts = pts[i]
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def write_images(folder: Path, camera: int, frames: Iterable[int], name: str = "{:04d}.png") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for k in frames:
        assert cv2.imwrite(str(folder / name.format(k)), paint(camera, k))


def make_rig(n: int, size: tuple[int, int] = SIZE) -> Rig:
    matrix = np.array([[100.0, 0, size[0] / 2], [0, 100, size[1] / 2], [0, 0, 1]])
    return Rig([Camera(f"cam_{c}", size, matrix, np.zeros(5), RigidTransform.identity()) for c in range(n)])


def make_calibration(path: Path, n: int = 2) -> None:
    calibration.save(make_rig(n), path / "calibration.toml")


def two_videos(folder: Path, n0: int = 8, n1: int = 8) -> None:
    write_video(folder / "cam_0.mp4", 0, range(n0))
    write_video(folder / "cam_1.mp4", 1, range(n1))


def two_folders(folder: Path, n: int = 3) -> None:
    write_images(folder / "cam_0", 0, range(n))
    write_images(folder / "cam_1", 1, range(n))


def read_all_painted(
    session: Session, start: int = 0, stop: int | None = None, every: int = 1
) -> list[tuple[int | None, ...]]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # no warnings expected
        return [painted_numbers(frame_set) for frame_set in session.frames(start, stop, every)]


def read_with_problems(session: Session) -> tuple[list[tuple[int | None, ...]], list[str]]:
    problems: list[str] = []
    return [painted_numbers(frame_set) for frame_set in session.frames(on_problem=problems.append)], problems


# Real recordings


@pytest.mark.skipif(not DATA.is_dir(), reason="the recordings in ../shared/data are not there")
def test_temple() -> None:
    session = open_session(DATA / "temple")
    assert session.n_frames == 7
    assert session.rate is None
    assert session.warnings == ()
    frame_sets = list(session.frames())
    assert [f.time for f in frame_sets] == [0, 1, 2, 3, 4, 5, 6]
    assert all(image is not None and image.shape == (480, 640, 3) for f in frame_sets for image in f.images)
    # cam_0's last and cam_1's second are the same photograph.
    assert np.array_equal(np.asarray(frame_sets[6].images[0]), np.asarray(frame_sets[1].images[1]))


@pytest.mark.skipif(not DATA.is_dir(), reason="the recordings in ../shared/data are not there")
def test_board4() -> None:
    session = open_session(DATA / "board4")
    assert session.n_frames == 48
    assert session.rate == pytest.approx(6, rel=0.01)
    assert session.warnings == ()
    assert session.boxes["cam_1"] == Box(550, 380, 203, 172)
    assert len(session.boxes) == 3
    first, second = (f for f, _ in zip(session.frames(every=2), range(2), strict=False))
    truth = np.loadtxt(DATA / "board4" / "groundtruth.tum")
    assert first.time == pytest.approx(truth[0, 0], abs=1e-6)
    assert second.time == pytest.approx(truth[2, 0], abs=1e-6)
    assert first.times == (0.002936, 0.000010, 0.0, 0.010619)


# Videos


def test_video_with_non_utf8_title_is_accepted(folder: Path) -> None:
    for c in range(2):
        path = folder / f"cam_{c}.mkv"
        with av.open(str(path), "w") as container:
            container.metadata["title"] = "Kamera vorn"
            stream = container.add_stream("ffv1", rate=10)
            stream.width, stream.height, stream.pix_fmt = *SIZE, "bgr0"
            container.mux(stream.encode(av.VideoFrame.from_ndarray(paint(c, 0, SIZE), format="bgr24")))
            container.mux(stream.encode())
        path.write_bytes(path.read_bytes().replace(b"Kamera vorn", b"Kamer\xe4 v\xffrn"))
    assert len(list(open_session(folder).frames())) == 1


@pytest.mark.parametrize(
    ("codec", "suffix"), [("mpeg4", "mp4"), ("mjpeg", "avi"), ("ffv1", "mkv"), ("mpeg4", "MOV"), ("mpeg4", "ts")]
)
def test_all_frames_are_delivered_in_order(folder: Path, codec: str, suffix: str) -> None:
    for c in range(2):
        write_video(folder / f"cam_{c}.{suffix}", c, range(9), codec)
    session = open_session(folder)
    assert session.warnings == ()
    assert session.n_frames == 9
    assert session.rate == 10
    assert [source.kind for source in session.sources] == ["video", "video"]
    assert read_all_painted(session) == [(k, k) for k in range(9)]
    assert [f.time for f in session.frames()] == pytest.approx(np.arange(9) / 10)
    assert next(session.frames()).times == (None, None)


def test_start_stop_every(folder: Path) -> None:
    two_videos(folder, 9, 9)
    session = open_session(folder)
    assert read_all_painted(session, start=2, stop=8, every=3) == [(2, 2), (5, 5)]
    assert read_all_painted(session, start=7, stop=100) == [(7, 7), (8, 8)]
    assert [f.index for f in session.frames(start=2, every=3)] == [2, 5, 8]


@pytest.mark.parametrize(
    "arguments", [{"start": -1}, {"start": 8}, {"stop": 0}, {"stop": -2}, {"start": 3, "stop": 3}, {"every": 0}]
)
def test_start_stop_every_out_of_range_raise_at_call(folder: Path, arguments: dict[str, int]) -> None:
    two_videos(folder)
    session = open_session(folder)
    with pytest.raises(ValueError, match=list(arguments)[-1]):
        session.frames(**arguments)  # type: ignore[arg-type]


def test_mixed_videos_and_folders(folder: Path) -> None:
    write_video(folder / "cam_0.mp4", 0, range(4))
    write_images(folder / "cam_1", 1, range(4), "frame_{}.png")
    session = open_session(folder)
    assert read_all_painted(session) == [(k, k) for k in range(4)]
    assert session.rate == 10


def test_cameras_ending_early(folder: Path) -> None:
    two_videos(folder, 3, 5)
    session = open_session(folder)
    assert session.n_frames == 5
    assert "cam_0 3, cam_1 5" in session.warnings[0]
    assert read_all_painted(session) == [(0, 0), (1, 1), (2, 2), (None, 3), (None, 4)]


def test_offsets(folder: Path) -> None:
    two_videos(folder, 4, 4)
    late = open_session(folder, offsets={"cam_1": 2})
    assert late.n_frames == 6
    assert read_all_painted(late) == [(0, None), (1, None), (2, 0), (3, 1), (None, 2), (None, 3)]
    assert read_all_painted(late, start=1, every=2) == [(1, None), (3, 1), (None, 3)]
    early = open_session(folder, offsets={"cam_1": -2})
    assert read_all_painted(early) == [(0, 2), (1, 3), (2, None), (3, None)]
    assert "cam_1" in early.warnings[0]
    with pytest.raises(ValueError, match="cam_9"):
        open_session(folder, offsets={"cam_9": 1})
    with pytest.raises(ValueError, match=r"cam_0.*whole number"):
        open_session(folder, offsets={"cam_0": 0.5})  # type: ignore[dict-item]
    with pytest.raises(ValueError, match="offsets"):
        open_session(folder, offsets={"cam_0": -4, "cam_1": -5})


def test_frames_hidden_by_edit_list_are_not_counted(folder: Path) -> None:
    write_video(folder / "whole.mp4", 0, range(9))
    with av.open(str(folder / "whole.mp4")) as whole, av.open(str(folder / "cam_0.mp4"), "w") as cut:
        stream = whole.streams.video[0]
        copy = cut.add_stream_from_template(stream)
        for packet in whole.demux(stream):
            if packet.dts is not None and packet.pts is not None:
                shift = round(0.3 / (stream.time_base or 1))
                packet.pts, packet.dts, packet.stream = packet.pts - shift, packet.dts - shift, copy
                cut.mux(packet)
    (folder / "whole.mp4").unlink()
    write_video(folder / "cam_1.mp4", 1, range(3, 9))
    session = open_session(folder)
    assert session.warnings == ()
    assert read_all_painted(session) == [(k, k) for k in range(3, 9)]


def test_memory_is_bounded_while_reading(folder: Path) -> None:
    two_videos(folder, 40, 40)
    references: list[weakref.ref[NDArray[np.uint8]]] = []
    most = 0
    for frame_set in open_session(folder).frames():
        references += [weakref.ref(image) for image in frame_set.images if image is not None]
        most = max(most, sum(reference() is not None for reference in references))
    assert len(references) == 80
    assert most <= 4  # this frame set, and the previous one while it is being replaced


def test_closing_stops_threads(folder: Path) -> None:
    two_videos(folder)
    frames = open_session(folder).frames()
    next(frames)
    assert any(t.name.startswith("sylpose-capture") for t in threading.enumerate())
    frames.close()
    assert not any(t.name.startswith("sylpose-capture") for t in threading.enumerate())


# Damaged videos


def truncate_file(path: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])


def test_video_without_index_is_rejected(folder: Path) -> None:
    two_videos(folder)
    truncate_file(folder / "cam_1.mp4")
    with pytest.raises(ValueError, match=r"cam_1\.mp4: cannot be opened"):
        open_session(folder)


def test_non_video_file_is_rejected(folder: Path) -> None:
    write_video(folder / "cam_0.mp4", 0, range(2))
    (folder / "cam_1.mp4").write_bytes(b"")
    with pytest.raises(ValueError, match=r"cam_1\.mp4"):
        open_session(folder)


def test_video_truncated_in_first_frame_is_rejected(folder: Path) -> None:
    write_video(folder / "cam_0.mp4", 0, range(2))
    write_video(folder / "cam_1.avi", 1, range(2), "mjpeg", noise=20)
    data = (folder / "cam_1.avi").read_bytes()
    (folder / "cam_1.avi").write_bytes(data[: data.index(b"movi") + 100])
    with pytest.raises(ValueError, match=r"cam_1\.avi: no frame of this video is readable"):
        open_session(folder)


@pytest.mark.parametrize(
    ("codec", "suffix", "movflags"),
    [
        ("mjpeg", "mp4", "faststart"),
        ("mjpeg", "avi", ""),
        ("ffv1", "mkv", ""),
        ("mjpeg", "mp4", "frag_keyframe+empty_moov"),
    ],
)
def test_truncated_video_is_read_up_to_its_end(folder: Path, codec: str, suffix: str, movflags: str) -> None:
    write_video(folder / f"cam_0.{suffix}", 0, range(40), codec, noise=20, movflags=movflags)
    write_video(folder / "cam_1.mp4", 1, range(40))
    truncate_file(folder / f"cam_0.{suffix}")
    session = open_session(folder)
    frames, problems = read_with_problems(session)
    assert [row[1] for row in frames] == list(range(40))
    numbers = [row[0] for row in frames]
    n = numbers.index(None)
    assert 5 < n < 30
    assert numbers == [*range(n), *[None] * (40 - n)]
    message = [sentence for sentence in (*session.warnings, *problems) if "is cut off" in sentence]
    assert len(message) == 1
    assert f"cam_0.{suffix}" in message[0]
    assert str(n) in message[0]


def test_iteration_ends_when_all_videos_are_truncated(folder: Path) -> None:
    for c in range(2):
        write_video(folder / f"cam_{c}.mp4", c, range(40), "mjpeg", noise=20, movflags="faststart")
        truncate_file(folder / f"cam_{c}.mp4")
    session = open_session(folder)
    assert session.n_frames == 40
    frames, problems = read_with_problems(session)
    assert 5 < len(frames) < 30
    assert all(row != (None, None) for row in frames)
    assert len(problems) == 2
    with pytest.warns(UserWarning, match=r"is cut off after \d+ of 40 frames"):
        list(session.frames())


def test_damaged_frames_are_skipped(folder: Path) -> None:
    write_video(folder / "cam_0.mp4", 0, range(40), "mjpeg", noise=20)
    write_video(folder / "cam_1.mp4", 1, range(40))
    data = bytearray((folder / "cam_0.mp4").read_bytes())
    middle = len(data) // 2
    data[middle : middle + 4000] = bytes(4000)
    (folder / "cam_0.mp4").write_bytes(data)
    problems: list[str] = []
    frame_sets = list(open_session(folder).frames(on_problem=problems.append))
    assert len(frame_sets) == 40
    assert [decode_painted(f.images[0]) for f in frame_sets[:15]] == [(0, k) for k in range(15)]
    assert decode_painted(frame_sets[-1].images[0]) in (None, (0, 39))  # never the wrong frame
    assert problems


# Image folders


def test_natural_order_and_image_formats(tmp_path: Path) -> None:
    for name in ("10.png", "9.PNG", "2.png", ".hidden.png", "notes.txt"):
        (tmp_path / name).touch()
    files = image_files(tmp_path)
    assert [f.name for f in files] == ["2.png", "9.PNG", "10.png"]
    assert image_numbers(files) == (2, 9, 10)
    assert image_numbers([Path(f"cam_1_{k}_left2.png") for k in (3, 5)]) == (3, 5)
    assert image_numbers([Path("a.png"), Path("b.png")]) is None
    (tmp_path / "9.jpg").touch()
    with pytest.raises(ValueError, match=r"9\.PNG"):
        image_files(tmp_path)


def test_images_are_aligned_by_number(folder: Path) -> None:
    write_images(folder / "cam_0", 0, [10, 20, 30, 40])
    write_images(folder / "cam_1", 1, [20, 40, 50], "img{}.png")
    session = open_session(folder)
    assert read_all_painted(session) == [(10, None), (20, 20), (30, None), (40, 40), (None, 50)]
    assert [f.time for f in session.frames()] == [0, 1, 2, 3, 4]
    assert "cam_1: 2 images are missing that other cameras have, the first is number 10" in " ".join(session.warnings)


def test_images_without_common_numbers_are_numbered_in_order(folder: Path) -> None:
    write_images(folder / "cam_0", 0, range(3))
    write_images(folder / "cam_1", 1, range(100, 103))
    session = open_session(folder)
    assert read_all_painted(session) == [(0, 100), (1, 101), (2, 102)]
    assert "numbered in order" in session.warnings[0]


def test_gray_and_16_bit_images(folder: Path) -> None:
    two_folders(folder, 4)
    images = folder / "cam_0"
    cv2.imwrite(str(images / "0000.png"), paint(0, 0)[:, :, 0])
    cv2.imwrite(str(images / "0001.png"), paint(0, 1)[:, :, 0].astype(np.uint16) * 257)
    cv2.imwrite(str(images / "0002.png"), paint(0, 2).astype(np.uint16) * 16)  # 12 bits
    cv2.imwrite(str(images / "0003.png"), np.dstack([paint(0, 3), np.full(SIZE[::-1], 255, np.uint8)]))
    frame_sets = list(open_session(folder).frames())
    for k, frame_set in enumerate(frame_sets):
        image = frame_set.images[0]
        assert image is not None
        assert image.dtype == np.uint8
        assert np.array_equal(image, paint(0, k))


def test_unreadable_and_wrong_size_images_are_reported(folder: Path) -> None:
    two_folders(folder, 5)
    (folder / "cam_0" / "0001.png").write_bytes(b"no image")
    cv2.imwrite(str(folder / "cam_1" / "0002.png"), paint(1, 2, (80, 48)))
    (folder / "cam_1" / "0003.png").write_bytes(b"")
    frames, problems = read_with_problems(open_session(folder))
    assert frames == [(0, 0), (None, 1), (2, None), (3, None), (4, 4)]
    assert len(problems) == 3
    assert "cam_0" in problems[0]
    assert "0001.png" in problems[0]
    assert "80x48, not 160x48" in problems[1]


def test_truncated_jpeg_is_missing(folder: Path) -> None:
    for c in range(2):
        write_images(folder / f"cam_{c}", c, range(3), "{}.jpg")
    data = (folder / "cam_0" / "1.jpg").read_bytes()
    (folder / "cam_0" / "1.jpg").write_bytes(data[: len(data) - 40])
    frames, problems = read_with_problems(open_session(folder))
    assert frames == [(0, 0), (None, 1), (2, 2)]
    assert "1.jpg" in problems[0]


@pytest.mark.parametrize("kind", ["video", "images"])
def test_sizes_must_match_calibration(folder: Path, kind: str) -> None:
    write_images(folder / "cam_0", 0, range(2))
    if kind == "video":
        write_video(folder / "cam_1.mp4", 1, range(2), size=(80, 48))
    else:
        (folder / "cam_1").mkdir()
        cv2.imwrite(str(folder / "cam_1" / "0.png"), paint(1, 0, (80, 48)))
    with pytest.raises(ValueError, match=r"80x48, but camera cam_1 is calibrated at 160x48: they are neither"):
        open_session(folder)


# Names


@pytest.mark.parametrize("name", ["cam_0", "0", "cam0", "Cam-0", "CAM 00", "port_0", "camera.0"])
def test_names_are_matched_tolerantly(name: str) -> None:
    assert match_names([name, "cam_1"], ["cam_0", "cam_1"]) == {name: "cam_0", "cam_1": "cam_1"}
    assert match_names(["cam_0"], [name]) == {"cam_0": name}


def test_ambiguous_names_are_rejected() -> None:
    assert match_names(["cam_1", "left"], ["cam_0", "right"]) == {}
    assert match_names(["0_1"], ["cam_01"]) == {}
    assert match_names(["Left"], ["cam_left"]) == {"Left": "cam_left"}
    assert match_names(["0", "cam_0"], ["cam_0"]) == {"cam_0": "cam_0"}
    with pytest.raises(ValueError, match="0, cam0"):
        match_names(["0", "cam0"], ["cam_0"])
    with pytest.raises(ValueError, match="port_0"):
        match_names(["0"], ["cam_0", "port_0"])


def test_other_entries_are_not_cameras(folder: Path) -> None:
    two_videos(folder, 3, 3)
    (folder / "sylpose").mkdir()
    (folder / "run2").mkdir()
    for path in ("sylpose/report.png", "run2/report.png"):
        cv2.imwrite(str(folder / path), paint(0, 0))
    (folder / "run2" / "trajectory.tum").touch()
    write_video(folder / "sylpose" / "overlay.mp4", 0, range(3))
    write_video(folder / "overlay.mp4", 0, range(3))
    (folder / "._cam_0.mp4").write_bytes(b"made by another system")
    (folder / "empty").mkdir()
    assert read_all_painted(open_session(folder)) == [(k, k) for k in range(3)]


def test_unmatched_cameras_and_videos_are_all_listed(tmp_path: Path) -> None:
    make_calibration(tmp_path, 4)
    for name in ("cam_0", "cam_2", "cam_7"):
        write_video(tmp_path / f"{name}.mp4", 0, range(2))
    with pytest.raises(ValueError, match=r"camera cam_1, cam_3 .* for cam_7\.mp4; found cam_0\.mp4, cam_2\.mp4"):
        open_session(tmp_path)


def test_two_sources_for_one_camera_are_rejected(folder: Path) -> None:
    two_videos(folder, 2, 2)
    write_images(folder / "cam_1", 1, range(2))
    with pytest.raises(ValueError, match=r"cam_1 and cam_1\.mp4 are both for camera cam_1"):
        open_session(folder)


def test_missing_folder_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="nowhere: no such folder"):
        open_session(tmp_path / "nowhere")
    make_calibration(tmp_path)
    with pytest.raises(ValueError, match="not a file"):
        open_session(tmp_path / "calibration.toml")
    with pytest.raises(ValueError, match="no videos"):
        open_session(tmp_path)


# Boxes


def test_boxes_are_read(folder: Path) -> None:
    two_folders(folder)
    (folder / "boxes.toml").write_text("1 = [-0.4, 2, 160.2, 20.5]")
    (folder / "other.toml").write_text("cam_0 = [1, 2, 3, 4]")
    box = open_session(folder, calibration=folder / "calibration.toml").boxes["cam_1"]
    assert (box.x, box.y, box.width, box.height) == pytest.approx((0, 2, 159.8, 20.5))
    other = open_session(folder, calibration=folder / "calibration.toml", boxes=folder / "other.toml")
    assert other.boxes == {"cam_0": Box(1, 2, 3, 4)}


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("cam_5 = [1, 2, 3, 4]", "cam_5"),
        ("cam_0 = [1, 2, 3]", "cam_0"),
        ("cam_0 = [1, 2, 3, nan]", "cam_0.*finite"),
        ("cam_0 = [1, 2, -3, 4]", "cam_0.*positive"),
        ("cam_0 = [1, 2, 0, 4]", "cam_0.*positive"),
        ("cam_0 = [200, 2, 10, 4]", "cam_0.*not inside"),
        ("cam_0 = [150, 2, 20, 4]", "cam_0.*160x48"),
        ("cam_0 = [", "boxes.toml"),
        ('cam_0 = "here"', "cam_0"),
    ],
)
def test_invalid_boxes_are_rejected(folder: Path, text: str, match: str) -> None:
    two_folders(folder)
    (folder / "boxes.toml").write_text(text)
    with pytest.raises(ValueError, match=match):
        open_session(folder, calibration=folder / "calibration.toml")


# Masks


def write_mask(folder: Path, name: str, white: bool = True, size: tuple[int, int] = SIZE) -> None:
    image = np.zeros(size[::-1], np.uint8)
    image[5:10, 5 : 10 + int("".join(filter(str.isdigit, name)) or 0) % 100] = 255 * white
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(folder / name), image)


def test_static_masks(folder: Path) -> None:
    two_videos(folder, 3, 2)
    write_mask(folder, "masks/cam_1.png")
    session = open_session(folder)
    assert session.masks == folder / "masks"
    masks = [f.masks for f in session.frames()]
    assert [m[0] for m in masks] == [None] * 3
    assert masks[0][1] is not None
    assert masks[0][1].dtype == np.bool_
    assert masks[0][1].shape == SIZE[::-1]
    assert masks[0][1].sum() == 30
    assert masks[1][1] is masks[0][1]
    assert masks[2][1] is None  # no mask without an image


@pytest.mark.parametrize("kind", ["video", "images"])
def test_masks_by_frame_number(folder: Path, kind: str) -> None:
    write_video(folder / "cam_0.mp4", 0, range(3))
    first = 0 if kind == "video" else 7
    if kind == "video":
        write_video(folder / "cam_1.mp4", 1, range(3))
    else:
        write_images(folder / "cam_1", 1, range(7, 10))
    silhouettes = folder / "silhouettes"
    write_mask(silhouettes, f"1/mask_{first}.png")
    write_mask(silhouettes, f"1/mask_{first + 2}.png")
    write_mask(silhouettes, "1/mask_55.png")
    session = open_session(folder, masks=silhouettes)
    assert "the first is number 55" in session.warnings[0]
    areas = [None if f.masks[1] is None else int(f.masks[1].sum()) for f in session.frames()]
    assert areas == [25 + 5 * (10 + first), None, 25 + 5 * (12 + first)]


def test_invalid_masks_are_rejected(folder: Path) -> None:
    two_videos(folder, 3, 3)
    cases: list[tuple[str, bool, tuple[int, int], str]] = [
        ("m1/cam_0.png", False, SIZE, r"cam_0\.png: the mask is empty"),
        ("m2/cam_0.png", True, (80, 48), r"cam_0\.png: 80x48, not 160x48 pixels"),
        ("m3/cam_8.png", True, SIZE, "cam_8 is not a camera"),
        ("m4/cam_0/0001.png", False, SIZE, r"0001\.png: this and all later masks are empty"),
        ("m5/cam_0/0001.png", True, (80, 48), r"0001\.png: 80x48, not 160x48 pixels"),
        ("m6/cam_0/0100.png", True, SIZE, "no mask number matches a frame"),
        ("m7/cam_0/first.png", True, SIZE, "number"),
    ]
    for name, white, size, match in cases:
        write_mask(folder, name, white, size)
        with pytest.raises(ValueError, match=match):
            open_session(folder, masks=(folder / name.split("/")[0]), offsets={"cam_1": 0})
        for entry in sorted((folder / name.split("/")[0]).rglob("*"), reverse=True):
            entry.rmdir() if entry.is_dir() else entry.unlink()
    with pytest.raises(ValueError, match="contains no masks"):
        open_session(folder, masks=folder / "m1")
    with pytest.raises(FileNotFoundError, match="nowhere"):
        open_session(folder, masks=folder / "nowhere")


def test_unreadable_later_mask_is_reported(folder: Path) -> None:
    two_videos(folder, 3, 3)
    write_mask(folder, "masks/cam_0/0.png")
    write_mask(folder, "masks/cam_0/1.png", size=(80, 48))
    write_mask(folder, "masks/cam_0/2.png", white=False)  # empty masks are allowed after the first object mask
    problems: list[str] = []
    masks = [f.masks[0] for f in open_session(folder).frames(on_problem=problems.append)]
    assert [None if m is None else bool(m.any()) for m in masks] == [True, None, False]
    assert "cam_0" in problems[0]
    assert "1.png" in problems[0]


# Timestamps


def test_timestamps_assign_frames(folder: Path) -> None:
    two_videos(folder, 4, 3)
    (folder / "timestamps.csv").write_text("frame,cam_1,cam_0\n0,0.10,0.12\n1,,0.31\n2,0.50,0.52\n3,0.70,0.72\n")
    session = open_session(folder)
    assert session.warnings == ()
    assert session.rate == pytest.approx(5)
    assert read_all_painted(session) == [(0, 0), (1, None), (2, 1), (3, 2)]
    frame_sets = list(session.frames())
    assert [f.time for f in frame_sets] == pytest.approx([0.11, 0.31, 0.51, 0.71])
    assert frame_sets[1].times == (0.31, None)
    assert frame_sets[2].times == (0.52, 0.50)
    with pytest.raises(ValueError, match="offsets"):
        open_session(folder, offsets={"cam_0": 1})


def test_mismatched_timestamp_counts_are_reported(folder: Path) -> None:
    two_videos(folder, 5, 2)
    (folder / "timestamps.csv").write_text("frame,cam_0,cam_1\n" + "".join(f"{k},{k},{k}.5\n" for k in range(4)))
    session = open_session(folder)
    assert session.warnings == ("cam_0 has 4 timestamps and 5 frames.", "cam_1 has 4 timestamps and 2 frames.")
    assert read_all_painted(session) == [(0, 0), (1, 1), (2, None), (3, None)]


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "line 1"),
        ("frame,cam_0\n0,1\n", "line 1.*cam_1"),
        ("frame,cam_0,cam_1,cam_2\n", "line 1.*cam_2"),
        ("frame,cam_0,cam_1,cam_1\n0,1,1,1\n", "line 1"),
        ("cam_0,cam_1\n0,1\n", "line 1.*frame"),
        ("frame,cam_0,cam_1\n", "no timestamps"),
        ("frame,cam_0,cam_1\n0,1,1\n2,2,2\n", "line 3.*frame 1"),
        ("frame,cam_0,cam_1\n0,1,1\n1,1,2\n", "line 3.*increase"),
        ("frame,cam_0,cam_1\n0,1,1\n1,,\n", "line 3.*no camera"),
        ("frame,cam_0,cam_1\n0,1,9\n1,2,\n", "line 3.*increase"),
        ("frame,cam_0,cam_1\n0,1,one\n", "line 2.*one"),
        ("frame,cam_0,cam_1\n0,1,nan\n", "line 2.*finite"),
        ("frame,cam_0,cam_1\n0,1\n", "line 2.*3 columns"),
    ],
)
def test_invalid_timestamps_are_rejected(tmp_path: Path, text: str, match: str) -> None:
    path = tmp_path / "timestamps.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=match):
        find_time_table(tmp_path, ["cam_0", "cam_1"])


def test_timeline_without_files() -> None:
    sources = tuple(Source(f"cam_{c}", Path(f"cam_{c}.mp4"), "video", SIZE, n, 5.0) for c, n in enumerate((2, 3)))
    timeline, message = build_timeline(sources, None, {"cam_0": 2})
    assert timeline.frames.tolist() == [[-1, 0], [-1, 1], [0, 2], [1, -1]]
    assert timeline.times.tolist() == [0, 0.2, 0.4, pytest.approx(0.6)]
    assert len(message) == 1


@pytest.mark.parametrize(
    ("files", "cameras"),
    [
        (["cam01", "cam02", "cam10"], ["int_cam01_img", "int_cam02_img", "int_cam10_img"]),  # Pose2Sim
        (["vid1-camA", "vid1-camB", "vid1-camC"], ["A", "B", "C"]),  # Anipose
        (["2024-05-01 left raw", "2024-05-01 right raw"], ["Left", "Right"]),
    ],
)
def test_names_are_matched_by_distinguishing_words(files: list[str], cameras: list[str]) -> None:
    assert match_names(files, cameras) == dict(zip(files, cameras, strict=True))
    assert match_names(files[::-1], cameras) == dict(zip(files, cameras, strict=True))
    # Not if one remains unmatched, on either side, or if the names do not differ.
    assert match_names([*files, f"{files[0]}x"], cameras) == {}
    assert match_names(files, [*cameras, "x_y"]) == {}
    assert match_names(["run a", "run b"], ["top", "side"]) == {}


def test_takes_in_one_folder(folder: Path) -> None:
    two_videos(folder)
    text = (folder / "calibration.toml").read_text()
    (folder / "calibration.toml").write_text(text.replace("cam_0", "A").replace("cam_1", "B"))
    for k, letter in enumerate("AB"):
        video = folder / f"cam_{k}.mp4"
        for take in (1, 2):
            shutil.copy(video, folder / f"vid{take}-cam{letter}.mp4")
        video.unlink()
    with pytest.raises(ValueError, match=r"several takes \(vid1, vid2\); select one with --take NAME"):
        open_session(folder)
    with pytest.raises(ValueError, match=r"no take 'vid3' \(vid1, vid2\)"):
        open_session(folder, take="vid3")
    session = open_session(folder, take="vid2")
    assert [source.path.name for source in session.sources] == ["vid2-camA.mp4", "vid2-camB.mp4"]
    assert output_path(session) == folder / "sylpose" / "vid2"
    session = open_session(folder, cameras={"A": "vid2-camA.mp4", "B": "vid2-camB.mp4"})
    assert [source.path.name for source in session.sources] == ["vid2-camA.mp4", "vid2-camB.mp4"]


def test_splitting_of_names_into_takes() -> None:
    assert split_takes(["a1", "b1"], ["a", "b"]) == {}
    assert split_takes(["x_a", "y_a", "x_b"], ["a", "b"]) == {"x": {"a": "x_a", "b": "x_b"}}
    names = [f"mouse_{take}_cam_{c}_day-3" for take in "pq" for c in range(2)]
    expected = {f"mouse_{t}_day-3": {f"cam_{c}": f"mouse_{t}_cam_{c}_day-3" for c in range(2)} for t in "pq"}
    assert split_takes(names, ["cam_0", "cam_1"]) == expected
    assert split_takes(["cam0 a", "cam1 a", "cam0 b", "cam1 b"], ["cam_0", "cam_1"]).keys() == {"a", "b"}


def test_cameras_can_be_assigned_explicitly(folder: Path) -> None:
    two_videos(folder)
    (folder / "cam_0.mp4").rename(folder / "GX010042.mp4")
    (folder / "cam_1.mp4").rename(folder / "GX010007.mp4")
    with pytest.raises(ValueError, match="--video NAME=FILE"):
        open_session(folder)
    named: dict[str, Path | str] = {"cam_0": "GX010042.mp4", "cam_1": folder / "GX010007.mp4"}
    session = open_session(folder, cameras=named)
    assert [source.path.name for source in session.sources] == ["GX010042.mp4", "GX010007.mp4"]
    numbers, problems = read_with_problems(session)
    assert numbers == [(k, k) for k in range(8)]
    assert not problems
    swapped = open_session(folder, cameras={"cam_1": "GX010042.mp4", "cam_0": "GX010007.mp4"})
    assert [source.path.name for source in swapped.sources] == ["GX010007.mp4", "GX010042.mp4"]
    # Only the other one is searched.
    (folder / "GX010007.mp4").rename(folder / "cam_1.mp4")
    assert open_session(folder, cameras={"cam_0": "GX010042.mp4"}).sources[1].path.name == "cam_1.mp4"
    for cameras, message in (
        ({"cam_9": "GX010042.mp4"}, "'cam_9' is not a camera"),
        ({"cam_0": "GX010042.mp4", "cam_1": "GX010042.mp4"}, "assigned to both camera cam_0 and camera cam_1"),
        ({"cam_0": "."}, "no images in this folder"),
    ):
        with pytest.raises(ValueError, match=message):
            open_session(folder, cameras=cameras)
    with pytest.raises(FileNotFoundError, match="gone"):
        open_session(folder, cameras={"cam_0": "gone.mp4"})


def test_images_use_given_rate(folder: Path) -> None:
    two_folders(folder)
    session = open_session(folder, rate=25)
    assert session.rate == 25
    np.testing.assert_allclose(session.timeline.times, [0, 0.04, 0.08])
    for rate in (0, -1, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="rate: frames per second"):
            open_session(folder, rate=rate)
    (folder / "timestamps.csv").write_text("frame,cam_0,cam_1\n0,0,0\n1,1,1\n2,2,2\n")
    with pytest.raises(ValueError, match=r"come from timestamps\.csv"):
        open_session(folder, rate=25)


def test_with_rig_requires_same_cameras(folder: Path) -> None:
    two_videos(folder)
    session = open_session(folder)
    assert session.with_rig(Rig(session.rig.cameras, "m")).rig.unit == "m"
    with pytest.raises(ValueError, match="cam_0, cam_1"):
        session.with_rig(make_rig(1))
