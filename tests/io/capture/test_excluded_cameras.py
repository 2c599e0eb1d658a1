"""Excluded cameras, with or without images, and the data that the recording contains about them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from sylpose.commands.main import main
from sylpose.io import calibration
from sylpose.io.capture import open_session
from sylpose.runs.checkpoint import compute_fingerprint
from sylpose.runs.run_metadata import USED_CALIBRATION, open_source_recording, write_run_metadata
from sylpose.simulate import ring
from sylpose.sync.offsets import find_offsets

SIZE, N = (64, 48), 4
RIG = ring(3, size=SIZE)
A, B, C = RIG.names


def write_images(folder: Path) -> None:
    folder.mkdir(parents=True)
    for k in range(N):
        cv2.imwrite(str(folder / f"{k}.png"), np.full((48, 64, 3), 10 * k, np.uint8))


@pytest.fixture(params=[True, False], ids=["with its images", "without them"])
def session(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A recording with boxes, masks, timestamps and offsets of all cameras, with or without the last camera's images."""
    calibration.save(RIG, tmp_path / "calibration.toml")
    for name in RIG.names if request.param else (A, B):
        write_images(tmp_path / name)
    (tmp_path / "boxes.toml").write_text("".join(f"{name} = [1, 2, 30, 20]\n" for name in RIG.names))
    (tmp_path / "masks").mkdir()
    for name in RIG.names:
        cv2.imwrite(str(tmp_path / "masks" / f"{name}.png"), np.full((48, 64), 255, np.uint8))
    # Only the last camera has a frame in the last row.
    rows = [f"{k},{k / 10},{k / 10 + 0.001},{k / 10 + 0.002}" for k in range(N)]
    (tmp_path / "timestamps.csv").write_text("\n".join([f"frame,{A},{B},{C}", *rows[:-1], f"3,,,{0.302}", ""]))
    (tmp_path / "offsets.toml").write_text(f"{A} = 0.01\n{C} = 0.02\n")
    return tmp_path


def test_data_of_excluded_camera_is_ignored(session: Path) -> None:
    opened = open_session(session, without=[C])
    assert opened.rig.names == (A, B)
    assert opened.without == (C,)
    assert [source.camera for source in opened.sources] == [A, B]
    assert sorted(opened.boxes) == [A, B]
    assert len(opened._masks["object"]) == 2
    assert opened.n_frames == N - 1  # a frame set of the excluded camera alone is dropped
    np.testing.assert_allclose(opened.timeline.stamps, [[k / 10, k / 10 + 0.001] for k in range(N - 1)])
    assert find_offsets(opened) == {A: 0.01}
    (session / "timestamps.csv").write_text(f"frame,{A},{B}\n" + "".join(f"{k},{k / 10},{k / 10}\n" for k in range(N)))
    assert open_session(session, without=[C]).n_frames == N


def test_run_records_exclusion_and_can_be_reopened(session: Path) -> None:
    opened = open_session(session, without=[C])
    write_run_metadata(session / "result", opened, {})
    assert f'\nwithout = ["{C}"]\n' in (session / "result" / "settings.toml").read_text()
    assert calibration.load(session / "result" / USED_CALIBRATION).names == (A, B)
    again = open_source_recording(session / "result")
    assert again.rig.names == (A, B)
    assert [frames.time for frames in again.frames()] == [frames.time for frames in opened.frames()]


def test_run_with_other_cameras_cannot_resume(session: Path) -> None:
    one, other = (compute_fingerprint(open_session(session, without=names)) for names in ([C], [B, C]))
    for name in ("calibration", "images"):
        assert one[name] != other[name]


def test_invalid_exclusions_are_rejected(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for without, message in (
        (["cam_9"], f"without: 'cam_9' is not a camera of calibration.toml \\({A}, {B}, {C}\\)"),
        ([A, B, C], "without: no camera of calibration.toml remains"),
        ("cam", "without"),
    ):
        with pytest.raises((ValueError, TypeError), match=message):
            open_session(session, without=without)
    for command in ("track", "check", "box", "sync"):
        assert main([command, str(session), "--exclude-camera", "cam_9"]) == 2
        assert "--exclude-camera: 'cam_9' is not a camera" in capsys.readouterr().err
    if not (session / C).exists():
        with pytest.raises(
            ValueError,
            match=rf"no video or image folder for camera {C} .*, or exclude a camera with --exclude-camera {C}",
        ):
            open_session(session)
    else:
        assert open_session(session).rig.names == RIG.names


def test_live_cameras_cannot_be_excluded(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["track", str(tmp_path), "--follow", "--exclude-camera", A]) == 2
    assert "--exclude-camera: of live cameras" in capsys.readouterr().err
