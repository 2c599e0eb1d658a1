"""Frame sets by the time stamps of the videos' frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import av
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sylpose.io.capture import open_session
from sylpose.io.capture.alignment import align, read_clocks
from sylpose.io.capture.sources import Source
from sylpose.runs.check import describe_clocks, find_session_warnings
from tests.io.capture.test_capture import (
    SIZE,
    paint,
    painted_numbers,
    read_with_problems,
    write_images,
    write_video,
)


def write_timed(path: Path, camera: int, frames: Sequence[int], codec: str = "ffv1", rate: int = 10) -> None:
    """Write frames at their own times."""
    write_video(path, camera, frames, codec, rate, pts=frames)


def make_sources(stamps: Sequence[Sequence[int]]) -> list[Source]:
    """Make videos with time stamps in milliseconds."""
    return [
        Source(f"cam_{c}", Path(f"cam_{c}.mp4"), "video", (64, 48), len(its), 30.0, pts=tuple(its), time_base=1e-3)
        for c, its in enumerate(stamps)
    ]


@pytest.mark.parametrize(("suffix", "codec"), [("mkv", "ffv1"), ("mp4", "mpeg4"), ("mp4", "libx264"), ("mov", "mjpeg")])
def test_cameras_that_lose_different_frames(folder: Path, suffix: str, codec: str) -> None:
    shown = [k for k in range(12) if k not in (3, 7)], [k for k in range(12) if k not in (4, 8, 9)]
    for c, frames in enumerate(shown):
        write_timed(folder / f"cam_{c}.{suffix}", c, frames, codec)
    session = open_session(folder)
    rows, problems = read_with_problems(session)
    assert rows == [tuple(k if k in frames else None for frames in shown) for k in range(12)]
    assert not problems
    np.testing.assert_allclose(session.timeline.times, np.arange(12) / 10, atol=1e-9)
    text = " ".join(find_session_warnings(session))
    assert "cam_0 has 0 to 11 without 2 in between (3, 7)" in text
    assert "cam_1 has 0 to 11 without 3 in between (4, 8, 9)" in text
    assert describe_clocks(session.timeline, session.rig.names) == [
        "cam_0 10 frames per second, 2 lost, the longest gap 0.2 s, jitter 0.0 ms",
        "cam_1 10 frames per second, 3 lost, the longest gap 0.3 s, jitter 0.0 ms",
    ]
    # Frame 5 is read directly as well.
    assert painted_numbers(next(session.frames(5, 6))) == (5, 5)


def test_jump_of_a_clock_is_a_gap(folder: Path) -> None:
    write_video(folder / "cam_0.mkv", 0, range(6), "ffv1", pts=[0, 1, 2, 30, 31, 32])
    write_timed(folder / "cam_1.mkv", 1, range(34))
    rows, _ = read_with_problems(open_session(folder))
    seen = {0: 0, 1: 1, 2: 2, 30: 3, 31: 4, 32: 5}
    assert rows == [(seen.get(k), k) for k in range(34)]


def test_different_rates(folder: Path) -> None:
    write_video(folder / "cam_0.mp4", 0, range(8), rate=30)
    write_video(folder / "cam_1.mp4", 1, range(4), rate=15)
    session = open_session(folder)
    rows, _ = read_with_problems(session)
    assert rows == [(2 * k, k) for k in range(4)]  # one camera alone shows nothing of the other's moments
    np.testing.assert_allclose(session.timeline.times, np.arange(4) / 15, atol=1e-4)
    assert session.rate == pytest.approx(15, rel=1e-3)
    assert "cam_0: 4 frames are not used" in " ".join(session.warnings)


def test_rates_of_two_pairs() -> None:
    """The slower cameras are in every second frame set."""
    sources = make_sources([[k * 1000 // 15 for k in range(6)], [k * 1000 // 30 for k in range(12)]] * 2)
    clocks = read_clocks(sources, {}, [])
    assert clocks is not None
    frames, times, _ = align(sources, clocks, [])
    assert frames[:, 1].tolist() == list(range(12))
    assert frames[:, 0].tolist() == [k // 2 if k % 2 == 0 else -1 for k in range(12)]
    np.testing.assert_allclose(times, np.arange(12) / 30, atol=1e-3)


def test_constant_rates_are_numbered(folder: Path) -> None:
    """Rates that differ by rounding, and stamps that are rounded, are nominal."""
    write_video(folder / "cam_0.mkv", 0, range(40), rate=30)
    write_video(folder / "cam_1.mp4", 1, range(40), rate=30)
    session = open_session(folder)
    assert read_with_problems(session)[0] == [(k, k) for k in range(40)]
    assert np.isnan(session.timeline.stamps).all()
    assert not session.warnings


def test_videos_that_start_at_different_times(folder: Path) -> None:
    write_video(folder / "cam_0.mkv", 0, range(30), "ffv1", pts=range(30))
    write_video(folder / "cam_1.mkv", 1, range(20), "ffv1", pts=range(8, 28))
    session = open_session(folder)
    rows, _ = read_with_problems(session)
    assert rows == [(k, k - 8 if k < 28 else None) for k in range(8, 30)]
    assert "frames before the last one starts are not used: cam_0 8" in " ".join(session.warnings)
    # What the user says of the starts comes first.
    given_start = open_session(folder, offsets={"cam_1": 3})
    assert read_with_problems(given_start)[0][3:6] == [(3, 0), (4, 1), (5, 2)]


def test_time_stamps_of_other_clocks(folder: Path) -> None:
    write_video(folder / "cam_0.mkv", 0, [0, 1, 3, 4, 5], "ffv1", pts=[0, 1, 3, 4, 5])
    write_video(folder / "cam_1.mkv", 1, range(6), "ffv1", pts=range(900, 906))
    session = open_session(folder)
    assert read_with_problems(session)[0] == [(k if k != 2 else None, k) for k in range(6)]
    assert "no time in common" in session.warnings[0]


def test_time_stamps_that_do_not_increase(folder: Path) -> None:
    sources = make_sources([[0, 33, 66, 100], [0, 40, 66, 100]])
    assert read_clocks(sources, {}, []) is not None
    write_video(folder / "cam_0.mkv", 0, range(6), "ffv1")
    path = folder / "cam_1.avi"
    write_video(path, 1, range(6), "mjpeg")
    session = open_session(folder)  # AVI: by its chunks
    assert read_with_problems(session)[0] == [(k, k) for k in range(6)]


def test_empty_chunks_of_avi_are_lost_frames(folder: Path) -> None:
    """A recorder that is too slow writes chunks without data, which players show as the last picture."""
    write_video(folder / "cam_0.avi", 0, range(12), "mjpeg")
    with av.open(str(folder / "cam_1.avi"), "w") as container:
        stream = container.add_stream("mjpeg", rate=10)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuvj420p"
        for k in range(12):
            frame = av.VideoFrame.from_ndarray(paint(1, k, SIZE), format="bgr24")
            frame.pts = k
            if k not in (5, 6):
                container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    session = open_session(folder)
    rows, problems = read_with_problems(session)
    assert rows == [(k, k if k not in (5, 6) else None) for k in range(12)]
    assert not problems
    assert "cam_1 has 0 to 11 without 2 in between (5, 6)" in " ".join(find_session_warnings(session))


def test_images_have_no_time_stamps(folder: Path) -> None:
    write_timed(folder / "cam_0.mkv", 0, [0, 2, 3])
    write_images(folder / "cam_1", 1, range(3))
    assert read_with_problems(open_session(folder))[0] == [(0, 0), (2, 1), (3, 2)]


@pytest.mark.parametrize("codec", ["mjpeg", "libx264"])
def test_undecodable_frame_is_skipped(folder: Path, codec: str) -> None:
    """Its time is kept; frames that are predicted from it are skipped too, up to the next keyframe."""
    for c in range(2):
        with av.open(str(folder / f"cam_{c}.mkv"), "w") as container:
            options = {"g": "5", "bf": "0"} if codec == "libx264" else {}
            stream = cast(av.VideoStream, container.add_stream(codec, rate=10, options=options))
            stream.width, stream.height = SIZE
            stream.pix_fmt = "yuv420p" if codec == "libx264" else "yuvj420p"
            frames = [av.VideoFrame.from_ndarray(paint(c, k, SIZE), format="bgr24") for k in range(15)]
            packets = [packet for frame in [*frames, None] for packet in stream.encode(frame)]
            for k, packet in enumerate(packets):
                if (c, k) == (0, 6):
                    damaged = av.Packet(bytes(packet)[:5] + np.random.default_rng(0).bytes(max(packet.size, 16)))
                    damaged.pts, damaged.dts, damaged.time_base = packet.pts, packet.dts, packet.time_base
                    damaged.stream = stream
                    packet = damaged
                container.mux(packet)
    rows, problems = read_with_problems(open_session(folder))
    missing = {6} if codec == "mjpeg" else {6, 7, 8, 9}
    assert rows == [(None if k in missing else k, k) for k in range(15)]
    assert len(problems) == 1
    assert "cam_0.mkv, frame 6" in problems[0]


@given(st.integers(0, 10_000), st.integers(2, 5), st.floats(0.0, 0.2))
def test_frames_of_one_instant_are_one_set(seed: int, n_cameras: int, jitter: float) -> None:
    """Whatever each camera loses, and with jitter below a quarter of the interval."""
    rng = np.random.default_rng(seed)
    n, interval = 40, 100
    shown = [np.sort(rng.choice(n, rng.integers(n // 2, n + 1), replace=False)) for _ in range(n_cameras)]
    for its in shown:
        its[0] = 0
    stamps = [np.unique(np.round(its * interval + rng.uniform(-1, 1, len(its)) * jitter * interval)) for its in shown]
    sources = make_sources([its.astype(int).tolist() for its in stamps])
    clocks = read_clocks(sources, {}, [])
    if clocks is None:
        return
    frames, times, times_by_camera = align(sources, clocks, [])
    assert (np.diff(times) > 0).all()
    assert times[0] == 0
    for row, own in zip(frames, times_by_camera, strict=True):
        assert (np.isnan(own) == (row < 0)).all()
        assert len({int(shown[c][k]) for c, k in enumerate(row) if k >= 0}) == 1
    for c in range(n_cameras):
        used = frames[frames[:, c] >= 0, c]
        assert (np.diff(used) == 1).all()
        assert len(used) >= len(shown[c]) - 1


def test_drifting_clocks_keep_all_frames_of_the_slower_camera() -> None:
    sources = make_sources([[33 * k for k in range(1000)], [35 * k for k in range(943)]])
    clocks = read_clocks(sources, {}, [])
    assert clocks is not None
    frames, times, stamps = align(sources, clocks, [])
    assert (np.diff(times) > 0).all()
    assert np.count_nonzero(frames[:, 1] >= 0) > 930
    both = (frames >= 0).all(axis=1)
    assert np.abs(np.diff(stamps[both], axis=1)).max() <= 0.0165


def test_a_single_camera_with_a_variable_rate() -> None:
    sources = make_sources([[0, 33, 100, 133, 166]])
    clocks = read_clocks(sources, {}, [])
    assert clocks is not None
    frames, times, _ = align(sources, clocks, [])
    assert frames[:, 0].tolist() == [0, 1, 2, 3, 4]
    np.testing.assert_allclose(times, [0, 0.033, 0.1, 0.133, 0.166])
    assert read_clocks(make_sources([[0, 33, 67, 100]]), {}, []) is None


def test_a_single_lost_frame_is_not_rounding() -> None:
    """Also in AVI, whose unit is the interval, and in long recordings, where the mean rate hardly changes."""
    sources = [
        replace(its, time_base=0.1)
        for its in make_sources([[k for k in range(1000) if k != 500], [k for k in range(1000) if k != 200]])
    ]
    clocks = read_clocks(sources, {}, [])
    assert clocks is not None
    frames, _, _ = align(sources, clocks, [])
    assert len(frames) == 1000
    assert frames[800].tolist() == [799, 799]
    assert frames[300].tolist() == [300, 299]


def test_offsets_between_cameras_are_kept() -> None:
    """Beyond the rounding of time stamps, whatever the file's unit."""
    tables = [np.arange(10) / 30, np.arange(10) / 30 + 0.004]
    _, times, stamps = align(make_sources([range(10), range(10)]), tables, [])
    np.testing.assert_allclose(stamps[:, 1] - times, 0.004, atol=1e-9)


def test_a_single_frame_of_each_camera() -> None:
    frames, times, stamps = align(make_sources([[5], [7]]), [np.array([0.0]), np.array([0.002])], [])
    assert frames.tolist() == [[0, 0]]
    np.testing.assert_allclose(stamps - times[:, None], [[0.0, 0.002]])
