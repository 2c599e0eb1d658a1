"""Frames read in any order equal those read sequentially."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import Image
from sylpose.io import calibration
from sylpose.io.capture import frame_readers, open_session
from sylpose.io.capture.frame_readers import MAX_SEQUENTIAL_FRAMES
from sylpose.io.capture.random_access import RandomAccessReader
from sylpose.rig import Camera, Rig
from sylpose.runs.candidates import find_session_candidates
from sylpose.runs.options import RunOptions

SIZE, FRAMES = (64, 48), 3 * MAX_SEQUENTIAL_FRAMES
# Containers and codecs with different seek behavior: with and without frames that reference later ones, with keyframes
# that earlier frames reference, too, and without timestamps.
KINDS = {
    "mp4": ("libx264", {"bf": "3", "g": "30"}),
    "mkv": ("libx264", {"bf": "2", "g": "25", "x264-params": "open-gop=1"}),
    "avi": ("mpeg4", {"g": "20"}),
    "ts": ("libx264", {"bf": "2", "g": "25"}),
}


def picture(k: int) -> Image:
    image = np.full((SIZE[1], SIZE[0], 3), 40, np.uint8)
    cv2.putText(image, str(k), (2, 34), cv2.FONT_HERSHEY_SIMPLEX, 0.9, (255, 255, 255), 2)
    return image


def folder_of(path: Path, names: tuple[str, ...] = ("cam_0",)) -> Path:
    path.mkdir()
    matrix = np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
    cameras = [Camera(name, SIZE, matrix, np.zeros(5), RigidTransform.identity()) for name in names]
    calibration.save(Rig(cameras), path / "calibration.toml")
    return path


def write_video(path: Path, codec: str, options: dict[str, str], n: int = FRAMES) -> None:
    with av.open(str(path), "w", options={"movflags": "faststart"} if path.suffix == ".mp4" else {}) as file:
        stream: Any = file.add_stream(codec, rate=30, options=options)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        for k in range(n):
            file.mux(stream.encode(av.VideoFrame.from_ndarray(picture(k), format="bgr24")))
        file.mux(stream.encode())


@pytest.fixture
def work(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Return how many videos the readers "opened" and how many frames they "decoded"."""
    counts = Counter[str]()

    def count(owner: object, name: str, kind: str) -> None:
        function = getattr(owner, name)

        def counted(*args: Any, **options: Any) -> Any:
            counts[kind] += 1
            return function(*args, **options)

        monkeypatch.setattr(owner, name, counted)

    count(frame_readers, "open_video", "opened")
    count(frame_readers.READERS["video"], "_find_number", "decoded")
    return counts


@pytest.mark.parametrize("kind", KINDS)
def test_random_access_to_videos(kind: str, tmp_path: Path) -> None:
    codec, options = KINDS[kind]
    if codec not in av.codecs_available:
        pytest.skip(f"FFmpeg here has no {codec}")
    folder = folder_of(tmp_path / "recording")
    write_video(folder / f"cam_0.{kind}", codec, options)
    session = open_session(folder)
    every = [frames.images[0] for frames in session.frames()]
    assert len(every) == FRAMES
    order = [*np.random.default_rng(5).integers(0, FRAMES, 25).tolist(), 7, 8, 9, 9, FRAMES - 1, 0]
    with RandomAccessReader(session) as stills:
        for k in order:
            (image,) = stills.read_frame_set(k)
            np.testing.assert_array_equal(image, every[k], err_msg=f"frame {k}")
        with pytest.raises(ValueError, match=f"index must be in 0 ... {FRAMES - 1}"):
            stills.read_frame_set(FRAMES)
    chosen = [3, 4, 50, 51, 100, FRAMES - 1]
    frames_at = {frames.index: frames.images[0] for frames in session.frames_at(chosen)}
    assert [*frames_at] == chosen
    for k, image in frames_at.items():
        np.testing.assert_array_equal(image, every[k], err_msg=f"frame {k}")


def test_damaged_frames_are_decoded_once(tmp_path: Path, work: Counter[str]) -> None:
    folder = folder_of(tmp_path / "recording")
    path = folder / "cam_0.mp4"
    write_video(path, "mpeg4", {"g": "80"})
    with av.open(str(path)) as file:
        packet = [bytes(packet) for packet in file.demux(video=0)][20]
    path.write_bytes(path.read_bytes().replace(packet, b"\xff" * len(packet)))
    session, problems = open_session(folder), list[str]()
    work.clear()
    shown = [frames.images[0] is not None for frames in session.frames(on_problem=problems.append)]
    assert shown == [not 20 <= k < 80 for k in range(FRAMES)]  # those up to the key frame are predicted from it
    assert work["opened"] == 1
    assert work["decoded"] <= FRAMES
    assert len(problems) == 1


def test_cut_videos_are_decoded_once(tmp_path: Path, work: Counter[str]) -> None:
    folder, n = folder_of(tmp_path / "recording", ("cam_0", "cam_1")), 5 * FRAMES
    for name in ("cam_0", "cam_1"):
        write_video(folder / f"{name}.mp4", "mpeg4", {"g": "20"}, n)
    data = (folder / "cam_0.mp4").read_bytes()
    (folder / "cam_0.mp4").write_bytes(data[: len(data) // 3])
    session, problems = open_session(folder), list[str]()
    work.clear()
    shown = [frames.images[0] is not None for frames in session.frames(on_problem=problems.append)]
    end = shown.index(False)
    assert MAX_SEQUENTIAL_FRAMES < end < n - MAX_SEQUENTIAL_FRAMES
    assert not any(shown[end:])
    assert work["opened"] == 2
    assert work["decoded"] <= n + end
    assert len(problems) == 1
    assert f"is cut off after {end} of {n} frames" in problems[0]
    with RandomAccessReader(session) as stills:
        for k in (n - 1, 0, n - 1):
            first, second = stills.read_frame_set(k)
            assert (first is not None) == (k == 0)
            assert second is not None


@pytest.mark.parametrize(
    ("kind", "options", "most"),
    [
        ("mkv", {"g": "30"}, 0.6),  # its index has the key frames only
        ("mkv", {"g": "200"}, 0.9),
        ("ts", {"g": "200"}, 1.3),
        ("mp4", {"intra-refresh": "1", "g": "30"}, 1.3),  # there is no key frame to seek to
    ],
)
def test_seeks_cost_no_decoding(
    kind: str, options: dict[str, str], most: float, tmp_path: Path, work: Counter[str]
) -> None:
    if "libx264" not in av.codecs_available:
        pytest.skip("FFmpeg here has no libx264")
    folder, n = folder_of(tmp_path / "recording"), 8 * FRAMES
    write_video(folder / f"cam_0.{kind}", "libx264", options, n)
    session = open_session(folder)
    chosen = range(0, n, 60)
    work.clear()
    assert [frames.index for frames in session.frames_at(chosen) if frames.images[0] is not None] == [*chosen]
    assert work["decoded"] < most * n


def test_chosen_frames_are_checked(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "recording")
    (folder / "cam_0").mkdir()
    for k in range(4):
        cv2.imwrite(str(folder / "cam_0" / f"{k}.png"), picture(k))
    session = open_session(folder)
    wrong: Any
    for wrong in ([-1], [4], [0.5], [True], ["1"]):
        with pytest.raises(ValueError, match=r"indices: .* is not a whole number from 0 to 3"):
            session.frames_at(wrong)
    with pytest.raises(ValueError, match=r"indices must increase, got \[3, 3\]"):
        session.frames_at([3, 3])
    chosen: Any = np.array([0, 2])
    assert [frames.index for frames in session.frames_at(chosen)] == [0, 2]
    assert not [*session.frames_at([])]
    assert find_session_candidates(session, RunOptions(start=4)) == []


def test_random_access_with_missing_images(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "recording", ("cam_0", "cam_1"))
    for name in ("cam_0", "cam_1"):
        (folder / name).mkdir()
        for k in range(4):
            cv2.imwrite(str(folder / name / f"{k}.png"), picture(k))
    (folder / "cam_1" / "2.png").write_bytes(b"no image")
    session = open_session(folder, offsets={"cam_1": 1})
    with RandomAccessReader(session) as stills:
        first, second = stills.read_frame_set(3)
        np.testing.assert_array_equal(first, picture(3))
        assert second is None  # its third image, which is damaged
        first, second = stills.read_frame_set(0)
        np.testing.assert_array_equal(first, picture(0))
        assert second is None
        first, second = stills.read_frame_set(4)
        assert first is None
        np.testing.assert_array_equal(second, picture(3))
