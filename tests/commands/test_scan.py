"""`sylpose scan` as typed: its files, its output and wrong input."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.kinds_feature_poor import reduce_contrast
from benchmarks.silhouettes import measure_surface
from sylpose import FramePose, FrameStatus, Trajectory, open_session
from sylpose.commands.main import main
from sylpose.report.files import write_trajectory
from sylpose.rig import Rig
from sylpose.runs.run_metadata import write_run_metadata
from sylpose.simulate import Actor, Scene, arc, chamfered_box
from sylpose.simulate.recordings import write_sequence
from sylpose.units import INITIAL_DISTANCES
from tests.conftest import make_once

pytest.importorskip("skimage")

RIG = arc(4, 55, 1.5, 330, (240, 180), height=0.4)
SIDES = (0.3, 0.22, 0.26)
BLOCK = reduce_contrast(chamfered_box(SIDES, 200), 0.0)


def path(k: float) -> RigidTransform:
    turn = Rotation.from_rotvec(0.2 * k * np.array([0.5, 0.8, 0.3]))
    return RigidTransform.from_components([0.15 * np.sin(k / 3), 0.06 * np.cos(k / 2), 0.1 * np.sin(k / 5)], turn)


def turn_nearly_in_place(k: float) -> RigidTransform:
    pose = path(k)
    return RigidTransform.from_components(0.4 * pose.translation, pose.rotation)


def write_result(
    folder: Path, path: Callable[[float], RigidTransform] = path, rig: Rig = RIG, unit: str = RIG.unit
) -> None:
    """Write a recording of a plain block and its true poses as a result."""
    scene = Scene(rig, (Actor(BLOCK, path),), 20)
    truth = write_sequence(folder, scene)
    frames, counts = [], np.ones(len(rig), np.int64)
    for k, time in enumerate(truth.times):
        covariance = 1e-8 * np.eye(6)
        frames.append(FramePose(k, float(time), FrameStatus.TRACKED, path(k), covariance, counts, np.ones(len(rig))))
    frames[3] = replace(frames[3], status=FrameStatus.LOST, world_from_object=None)
    (folder / "sylpose").mkdir()
    write_trajectory(folder / "sylpose", Trajectory(frames, rig.names, unit))
    write_run_metadata(folder / "sylpose", open_session(folder), {})


@pytest.fixture
def tracked(tmp_path_factory: pytest.TempPathFactory, tmp_path: Path) -> Path:
    kept = make_once(tmp_path_factory, "plain", write_result)
    folder = Path(shutil.copytree(kept, tmp_path / "plain"))
    write_run_metadata(folder / "sylpose", open_session(folder), {})
    return folder


def test_scan_of_a_plain_block(tracked: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trimesh = pytest.importorskip("trimesh")
    assert main(["scan", str(tracked), "--frames", "16"]) == 0
    out = capsys.readouterr().out
    assert "64 of 16 frames and 4 cameras" in out
    assert "! " not in out
    mesh = trimesh.load(tracked / "sylpose" / "shape.glb", force="mesh", process=False)
    errors = np.abs(measure_surface([BLOCK], mesh.vertices))
    # The block is 66 pixels long, of which a hundredth is two thirds of a pixel.
    assert np.median(errors) < 0.01 * max(SIDES)
    assert np.quantile(errors, 0.9) < 0.05 * max(SIDES)
    assert (tracked / "sylpose" / "shape.png").stat().st_size > 10_000


def test_masks_of_a_search_region(tracked: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A mask in one frame does not discard the other images; one for all frames is ignored with a warning."""
    trimesh = pytest.importorskip("trimesh")
    (tracked / "masks" / "cam_0").mkdir(parents=True)
    cv2.imwrite(str(tracked / "masks" / "cam_0" / "0000.png"), np.full((180, 240), 255, np.uint8))
    cv2.imwrite(str(tracked / "masks" / "cam_1.png"), np.full((180, 240), 255, np.uint8))
    assert main(["scan", str(tracked), "--frames", "16"]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "64 of 16 frames and 4 cameras" in out
    assert out.count("! ") == 1
    assert "Camera cam_1: one mask for all frames is no outline" in out
    mesh = trimesh.load(tracked / "sylpose" / "shape.glb", force="mesh", process=False)
    assert np.median(np.abs(measure_surface([BLOCK], mesh.vertices))) < 0.01 * max(SIDES)


def test_a_single_camera_needs_known_lengths(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_result(tmp_path / "known", rig=RIG.subset(["cam_0"]))
    assert main(["scan", str(tmp_path / "known")]) == 0
    assert "19 of 19 frames and 1 cameras" in capsys.readouterr().out
    write_result(tmp_path / "unknown", rig=RIG.subset(["cam_0"]), unit=INITIAL_DISTANCES)
    assert main(["scan", str(tmp_path / "unknown")]) == 2
    assert "a single camera" in capsys.readouterr().err


def test_wrong_input(tracked: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scan", str(tmp_path / "nothing")]) == 2
    assert "nothing" in capsys.readouterr().err
    assert main(["scan", str(tracked), "--frames", "8"]) == 2
    assert "camera cam_0: 8 images without masks, of at least 15" in capsys.readouterr().err
    assert main(["scan", str(tracked), "--frames", "121"]) == 2
    assert "120" in capsys.readouterr().err
    (tracked / "cam_0.mp4").unlink()
    assert main(["scan", str(tracked)]) == 2
    assert "cam_0" in capsys.readouterr().err


def test_a_body_that_turns_nearly_in_place_causes_a_warning(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It covers the same pixels always, whose background is not known."""
    write_result(tmp_path / "plain", turn_nearly_in_place)
    assert main(["scan", str(tmp_path / "plain")]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "of the outline the background is not known" in out
