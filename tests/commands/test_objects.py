"""Several objects in one recording: one pass over the videos, files for each, one overlay."""

from __future__ import annotations

import re
import shutil
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from benchmarks.rendered_recordings import Recording, write_recording
from sylpose.atomic_io import format_boxes_toml
from sylpose.commands.main import main
from sylpose.comparison import compare_trajectories
from sylpose.io.capture import open_session
from sylpose.report.files import read_trajectory, read_tum
from sylpose.runs.options import RunOptions
from sylpose.runs.run import track_session
from sylpose.simulate import Actor, Scene, chamfered_box, make_demo_scene
from sylpose.tracking.context import TrackedFrame

pytestmark = pytest.mark.usefixtures("undrawn")

FRAMES = 5
TRAJECTORIES = ("trajectory.tum", "trajectory.csv")


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording of two textured blocks side by side with different rotations; read only."""

    def small(scene: Scene, by: float, seed: int) -> Actor:
        body, path = chamfered_box([0.12, 0.1, 0.11], 600.0, seed=seed), scene.actors[0].path
        shift = RigidTransform.from_translation([by, 0.0, 0.0])
        return Actor(body, lambda frame: shift * path(frame))

    size = (480, 360)
    mug = make_demo_scene(frames=48, angle_deg=90.0, size=size, n_cameras=3)
    tray = make_demo_scene(frames=48, angle_deg=-120.0, size=size, n_cameras=3, seed=4)
    scene = replace(mug, actors=(small(mug, -0.1, 1), small(tray, 0.1, 2)), frames=FRAMES)
    folder = tmp_path_factory.mktemp("two")
    write_recording(Recording(scene, objects=("mug", "tray")), folder)
    return folder


@pytest.fixture(scope="module")
def out(two: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the results of a complete run."""
    folder = tmp_path_factory.mktemp("out")
    assert main(["track", str(two), "--out", str(folder)]) == 0
    return folder


def test_each_object_has_its_files(out: Path) -> None:
    found = {file.relative_to(out).as_posix() for file in out.rglob("*") if file.is_file()}
    own = ("trajectory.tum", "trajectory.csv", "tracked.tum", "tracked.csv", "report.png", "report.html")
    of_all = ("overlay.mp4", "settings.toml", "calibration.used.toml")
    assert found == {*of_all, *(f"{name}/{file}" for name in ("mug", "tray") for file in own)}
    page = (out / "mug" / "report.html").read_text(encoding="utf-8")
    assert 'href="../overlay.mp4"' in page
    assert ", mug</h1>" in page
    with av.open(str(out / "overlay.mp4")) as video:
        assert sum(1 for _ in video.decode(video=0)) == FRAMES


@pytest.mark.parametrize("name", ["mug", "tray"])
def test_each_object_has_correct_poses(two: Path, out: Path, name: str) -> None:
    times, truth = read_tum(two / f"groundtruth_{name}.tum")
    result = compare_trajectories(*read_tum(out / name / "trajectory.tum"), times, truth)
    assert len(result.times) == result.n_reference
    assert np.degrees(result.rotation).max() < 1.5
    assert result.position.max() < 0.003


def test_result_is_independent_of_other_objects(two: Path, out: Path, tmp_path: Path) -> None:
    """Tracking one object alone with the same boxes yields the same files."""
    session = Path(shutil.copytree(two, tmp_path / "session"))
    boxes = tomllib.loads((two / "boxes.toml").read_text())
    (session / "boxes.toml").write_text(format_boxes_toml({"": boxes["tray"]}))
    assert main(["track", str(session), "--no-overlay"]) == 0
    for name in TRAJECTORIES:
        assert (session / "sylpose" / name).read_bytes() == (out / "tray" / name).read_bytes()


def test_terminal_output(two: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["track", str(two), "--out", str(tmp_path), "--stop", "3"]) == 0
    message = capsys.readouterr().out
    assert "2 objects: mug, tray" in message
    assert len(re.findall("Tracked +3 of 3 frames", message)) == 2
    assert re.search("^mug$", message, re.MULTILINE)
    assert str(tmp_path / "tray" / "report.png") in message
    assert main(["check", str(two), "--out", str(tmp_path)]) == 0
    message = capsys.readouterr().out
    for words in ("Boxes, mug", "Boxes, tray", "Object, mug", "Object, tray", "Ready to track"):
        assert words in message


def test_missing_object_is_named(two: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    session = Path(shutil.copytree(two, tmp_path / "session"))
    boxes = tomllib.loads((session / "boxes.toml").read_text())
    (session / "boxes.toml").unlink()
    for name in ("mug", "tray"):
        (session / "masks" / name).mkdir(parents=True)
        for camera, (left, top, width, height) in boxes[name].items():
            mask = np.zeros((360, 480), np.uint8)
            mask[:4, :4] = 255
            if name == "tray":
                mask[max(top - 20, 0) : top + height + 20, max(left - 20, 0) : left + width + 20] = 255
            cv2.imwrite(str(session / "masks" / name / f"{camera}.png"), mask)
    assert main(["track", str(session)]) == 0
    _, err = capsys.readouterr()
    # A slow machine also reports its progress.
    (line,) = (line for line in err.splitlines() if not line.startswith("sylpose: tracked "))
    assert line.startswith("sylpose: mug: no frame could be solved.")
    assert "tray" not in line
    # Both objects become final in all frames, but at different times: the overlay waits for both.
    with av.open(str(session / "sylpose" / "overlay.mp4")) as video:
        assert sum(1 for _ in video.decode(video=0)) == FRAMES


def test_inconsistent_boxes_name_the_object(two: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    boxes = tmp_path / "boxes.toml"
    boxes.write_text((two / "boxes.toml").read_text() + "[lamp]\ncam_0 = [0, 0, 40, 40]\ncam_2 = [430, 310, 40, 40]\n")
    assert main(["check", str(two), "--boxes", str(boxes), "--out", str(tmp_path)]) == 2
    assert "lamp: " in capsys.readouterr().err


def test_python_call_and_resume(two: Path, out: Path, tmp_path: Path) -> None:
    session = open_session(two)
    part = tmp_path / "part"

    def breaks(after: int) -> Callable[[str, TrackedFrame], None]:
        seen: list[TrackedFrame] = []

        def on_frame(_: str, tracked: TrackedFrame) -> None:
            seen.append(tracked)
            if len(seen) == after:
                raise RuntimeError("between the two objects of a frame")

        return on_frame

    with pytest.raises(RuntimeError):
        track_session(session, part, RunOptions(overlay=False, checkpoint_seconds=0), on_frame=breaks(5))
    assert len(read_trajectory(part / "mug" / "trajectory.csv")) == 3
    assert len(read_trajectory(part / "tray" / "trajectory.csv")) == 2
    run = track_session(session, part, RunOptions(overlay=False, resume=True))
    for name in ("mug", "tray"):
        assert len(run.trajectories[name]) == FRAMES
        for file in TRAJECTORIES:
            assert (part / name / file).read_bytes() == (out / name / file).read_bytes()
    with pytest.raises(ValueError, match="several objects"):
        _ = run.trajectory
