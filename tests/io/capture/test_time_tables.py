"""Times of frames in tables of several recorders."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sylpose.io.capture import open_session
from sylpose.io.capture.time_tables import find_time_table
from tests.io.capture.test_capture import make_calibration, read_with_problems, two_videos, write_images

CAMERAS = ["cam_0", "cam_1"]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    make_calibration(tmp_path)
    two_videos(tmp_path, 6, 6)
    return tmp_path


def write_rows(folder: Path, scale: float, begin: float = 0.0) -> None:
    """Write timestamps.csv at 20 frames per second, the second camera 2 ms late."""
    times = np.round((begin + np.arange(6) / 20) * scale), np.round((begin + 0.002 + np.arange(6) / 20) * scale)
    rows = [f"{k},{a:.0f},{b:.0f}" for k, (a, b) in enumerate(zip(*times, strict=True))]
    (folder / "timestamps.csv").write_text("\n".join(["frame,cam_0,cam_1", *rows]))


@pytest.mark.parametrize(("unit", "scale"), [("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9)])
@pytest.mark.parametrize("begin", [0.0, 5234.0, 1.7e9])
def test_units_follow_from_the_frame_rate(folder: Path, unit: str, scale: float, begin: float) -> None:
    write_rows(folder, scale, begin)
    session = open_session(folder)
    assert f"timestamps.csv is read as {unit}: 0.05 s between frames" in " ".join(session.warnings)
    np.testing.assert_allclose(np.diff(session.timeline.times), 0.05, atol=1e-6)
    assert session.timeline.times[0] == pytest.approx(begin + 0.001, abs=1e-6)
    assert session.rate == pytest.approx(20, rel=1e-5)


def test_times_that_are_no_camera_s_are_refused(folder: Path) -> None:
    rows = [f"{k},{k * 4e-7},{k * 4e-7}" for k in range(6)]
    (folder / "timestamps.csv").write_text("\n".join(["frame,cam_0,cam_1", *rows]))
    with pytest.raises(ValueError, match=r"timestamps.csv: times of 4e-07 between frames.*write the times in seconds"):
        open_session(folder)


def test_seconds_since_1970_of_slow_cameras(folder: Path) -> None:
    rows = [f"{k},{1.7e9 + 5 * k},{1.7e9 + 5 * k}" for k in range(6)]
    (folder / "timestamps.csv").write_text("\n".join(["frame,cam_0,cam_1", *rows]))
    session = open_session(folder)
    assert session.rate == pytest.approx(0.2)
    assert not session.warnings


@pytest.mark.parametrize("header", ["cam_id,frame_time", "sync_index,port,frame_index,frame_time"])
def test_table_with_a_row_for_each_frame(folder: Path, header: str) -> None:
    """Caliscope's, whose cameras are numbered; the second camera has lost its frame 2."""
    rows = []
    for k in range(7):
        for c in range(2):
            if (c, k) not in ((1, 2), (0, 6)):
                row = {
                    "cam_id": c,
                    "port": c,
                    "frame_time": 900.5 + k / 20 + 1e-4 * c,
                    "sync_index": k,
                    "frame_index": k,
                }
                rows.append(",".join(str(row[name]) for name in header.split(",")))
    (folder / "timestamps.csv").write_text("\n".join([header, *rows]))
    session = open_session(folder)
    seen, _ = read_with_problems(session)
    assert seen == [(0, 0), (1, 1), (2, None), (3, 2), (4, 3), (5, 4), (None, 5)]
    np.testing.assert_allclose(session.timeline.times, np.arange(7) / 20, atol=1e-3)
    assert session.timeline.origin == "timestamps.csv"


@pytest.mark.parametrize("suffix", ["csv", "npy", "plain"])
def test_a_file_for_each_camera(folder: Path, suffix: str) -> None:
    place = folder if suffix == "npy" else folder / "timestamps"
    place.mkdir(exist_ok=True)
    for c, name in enumerate(CAMERAS):
        times = 1.7e9 + np.array([0, 1, 2, 4, 5, 6] if c else [0, 1, 2, 3, 4, 5]) / 20
        if suffix == "npy":
            np.save(place / f"{name}_TS.npy", times)
        elif suffix == "plain":
            (place / f"{name}_timestamps.csv").write_text("\n".join(map(repr, times.tolist())))
        else:
            rows = [f"{k},{t!r}" for k, t in enumerate(times.tolist())]
            (place / f"{name}_timestamps.csv").write_text("\n".join(["frame_number,timestamp_unix_seconds", *rows]))
    seen, _ = read_with_problems(open_session(folder))
    assert seen == [(0, 0), (1, 1), (2, 2), (3, None), (4, 3), (5, 4), (None, 5)]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("cam_id,frame_time\n0,1.0\n0,1.1\n", "no times of cam_1 in the column cam_id"),
        ("cam_id,frame_time\n0,1.0\n1,1.0\n0,0.9\n1,1.1\n", "cam_0: times that increase"),
        ("cam_id,frame_time\n0,x\n", "line 2: a time is expected, got 'x'"),
        ("cam_id,frame_time\n0\n", "line 2: 2 columns are expected, got 1"),
        ("cam_id,frame_time\n7,1.0\n", "7 is not a camera"),
    ],
)
def test_tables_of_another_form(folder: Path, text: str, message: str) -> None:
    (folder / "timestamps.csv").write_text(text)
    with pytest.raises(ValueError, match=message):
        open_session(folder)


def test_tables_of_each_camera_of_another_form(folder: Path) -> None:
    (folder / "cam_1_TS.npy").write_bytes(b"")
    assert find_time_table(folder, CAMERAS) is None  # no times of the other camera
    np.save(folder / "cam_0_TS.npy", np.zeros((3, 2)))
    with pytest.raises(ValueError, match=r"cam_0_TS.npy.*2 dimensions"):
        open_session(folder)
    (folder / "cam_0_TS.npy").write_bytes(b"not an array")
    with pytest.raises(ValueError, match=r"cam_0_TS.npy"):
        open_session(folder)


def test_names_of_images_that_are_time_stamps(tmp_path: Path) -> None:
    """Milliseconds of each camera's own clock since 1970: only the first ones, of the trigger, are equal."""
    make_calibration(tmp_path)
    for c in range(2):
        numbers = [1_700_000_000_000 + round(k * 1000 / 30) + (2 * c if k else 0) for k in range(9)]
        write_images(tmp_path / f"cam_{c}", c, range(9))
        for k, number in enumerate(numbers):
            (tmp_path / f"cam_{c}" / f"{k:04d}.png").rename(tmp_path / f"cam_{c}" / f"{number}.png")
    (tmp_path / "cam_0" / "1700000000133.png").unlink()
    session = open_session(tmp_path)
    seen, _ = read_with_problems(session)
    assert seen == [(k if k != 4 else None, k) for k in range(9)]
    np.testing.assert_allclose(session.timeline.times, np.arange(9) / 30, atol=2.6e-3)
    assert session.timeline.origin == "the images' names"


def test_equal_numbers_by_chance(tmp_path: Path) -> None:
    make_calibration(tmp_path)
    for c in range(2):
        (tmp_path / f"cam_{c}").mkdir()
        write_images(tmp_path / f"cam_{c}", c, range(6))
        for k in range(6):
            (tmp_path / f"cam_{c}" / f"{k:04d}.png").rename(tmp_path / f"cam_{c}" / f"{7000 + k * (3 + c)}.png")
    session = open_session(tmp_path)
    assert read_with_problems(session)[0] == [(k, k) for k in range(6)]
    assert "few common frame numbers" in session.warnings[0]
