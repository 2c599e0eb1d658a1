"""Image sizes missing in a calibration: from the recording's videos, or from options."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from sylpose import open_session
from sylpose.commands.main import main
from sylpose.io import calibration


def remove_sizes(session: Path) -> Path:
    """Replace the session's calibration by JSON without image sizes."""
    file = session / "calibration.json"
    calibration.save(calibration.load(session / "calibration.toml"), file)
    data = json.loads(file.read_text())
    for camera in data["cameras"]:
        del camera["image_width"], camera["image_height"]
    file.write_text(json.dumps(data))
    (session / "calibration.toml").unlink()
    return file


def test_sizes_from_videos(session: Path) -> None:
    remove_sizes(session)
    assert [camera.size for camera in open_session(session).rig] == [(320, 240)] * 3


def test_video_names_are_matched(session: Path) -> None:
    remove_sizes(session)
    for video in session.glob("*.mp4"):
        video.rename(session / video.name.replace("cam_", "Port-0"))
    assert [camera.size for camera in open_session(session).rig] == [(320, 240)] * 3
    odd = next(session.glob("*.mp4")).rename(session / "left.mp4")
    with pytest.raises(ValueError, match="no video or image folder for camera cam_"):
        open_session(session)
    name = next(n for n in ("cam_0", "cam_1", "cam_2") if not (session / f"Port-0{n[-1]}.mp4").exists())
    assert len(open_session(session, cameras={name: odd.name}).rig) == 3


def test_sizes_from_options(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = remove_sizes(session)
    command = ["calibration", "convert", str(file), str(session / "a.toml")]
    assert main(command) == 2
    assert "--size WIDTHxHEIGHT" in capsys.readouterr().err
    assert main([*command, "--size", "320x240", "--size", "cam_1=640x480"]) == 0
    assert [c.size for c in calibration.load(session / "a.toml")] == [(320, 240), (640, 480), (320, 240)]
    assert main([*command, "--size", "320"]) == 2
    assert "CAM=WIDTHxHEIGHT, such as 1280x720, got '320'" in capsys.readouterr().err
    assert main([*command, "--size", "cam_9=3x2"]) == 2
