"""`sylpose track --mesh` as typed: a plain body, one that looks the same from several sides, and wrong input."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.contours import draw_cup, make_mesh
from benchmarks.silhouettes import convex, draw_irregular
from sylpose import Mesh, Trajectory, load_trajectory
from sylpose.commands.main import main
from sylpose.io.mesh_files import write_mesh
from sylpose.rig import Rig
from sylpose.silhouettes.rendering import render_mesh
from sylpose.simulate import Actor, Scene, TexturedBody, arc
from sylpose.simulate.recordings import write_sequence
from tests.conftest import make_once

pytest.importorskip("trimesh")

RIG, RADIUS, FRAMES = arc(4, 55, 1.5, 330, (240, 180), height=0.4), 0.2, 16
# The files' axes are not in the middle of the bodies.
ORIGIN = np.array([0.1, -0.02, 0.05])


def path(k: float) -> RigidTransform:
    turn = Rotation.from_rotvec(0.11 * k * np.array([0.5, 0.8, 0.3])) * Rotation.from_rotvec([0.4, 0.2, 1.0])
    return RigidTransform.from_components([0.28 * np.cos(k / 5), 0.12 * np.cos(k / 4), 0.2 * np.sin(k / 5)], turn)


def write_plain(folder: Path, draw: Callable[[np.random.Generator, Rig, float], list[TexturedBody]]) -> None:
    """Write a recording of a body of one color, with masks of all frames, and its mesh in millimeters."""
    parts = [
        replace(part, textures=tuple(np.full_like(texture, 200) for texture in part.textures))
        for part in draw(np.random.default_rng(4), RIG, RADIUS)
    ]
    write_sequence(folder, Scene(RIG, tuple(Actor(part, path) for part in parts), FRAMES, 3))
    mesh = make_mesh(parts)
    for camera in RIG:
        (folder / "outlines" / camera.name).mkdir(parents=True)
        for k in range(FRAMES):
            mask = render_mesh(mesh, camera, path(k)).mask
            cv2.imwrite(str(folder / "outlines" / camera.name / f"{k:04}.png"), np.where(mask, 255, 0).astype(np.uint8))
    write_mesh(replace(mesh, vertices=mesh.vertices + ORIGIN), folder / "part.glb")


def measure_errors(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Return degrees and relative distances (n,) of the poses from the true ones; NaN without a pose."""
    degrees, shares = np.full((2, len(trajectory)), np.nan)
    for k, pose in enumerate(trajectory):
        if pose.world_from_object is not None:
            true = path(pose.index) * RigidTransform.from_translation(-ORIGIN)
            degrees[k] = np.degrees((pose.world_from_object.rotation * true.rotation.inv()).magnitude())
            shares[k] = np.linalg.norm(pose.world_from_object.translation - true.translation) / 1.5
    return degrees, shares


@pytest.fixture
def irregular(tmp_path_factory: pytest.TempPathFactory, tmp_path: Path) -> Path:
    kept = make_once(tmp_path_factory, "irregular", lambda folder: write_plain(folder, draw_irregular))
    return Path(shutil.copytree(kept, tmp_path / "irregular"))


def test_plain_body_before_its_background(irregular: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["track", str(irregular), "--mesh", str(irregular / "part.glb")]) == 0
    out = capsys.readouterr().out
    assert "16 of 16 frames" in out
    trajectory = load_trajectory(irregular / "sylpose" / "trajectory.csv")
    assert all(pose.is_measured for pose in trajectory)
    degrees, shares = measure_errors(trajectory)
    assert degrees.max() < 1.0
    assert shares.max() < 0.005
    sd = np.array([pose.sigma for pose in trajectory])
    assert (np.degrees(sd[:, :3]) < 1).all()
    assert (irregular / "sylpose" / "overlay.mp4").stat().st_size > 10_000
    assert (irregular / "sylpose" / "report.html").exists()


def test_few_frames_with_masks(irregular: Path) -> None:
    command = ["track", str(irregular), "--mesh", str(irregular / "part.glb"), "--masks", str(irregular / "outlines")]
    assert main([*command, "--stop", "3", "--no-overlay"]) == 0
    degrees, shares = measure_errors(load_trajectory(irregular / "sylpose" / "trajectory.csv"))
    assert degrees.max() < 1.0
    assert shares.max() < 0.005


def test_body_of_revolution_is_never_sure(tmp_path: Path) -> None:
    """The rotation about its axis changes nothing: the pose has its place, and a standard deviation of any angle."""
    write_plain(tmp_path, convex(draw_cup))
    command = ["track", str(tmp_path), "--mesh", str(tmp_path / "part.glb"), "--masks", str(tmp_path / "outlines")]
    assert main([*command, "--stop", "1", "--no-overlay"]) == 1
    for pose in load_trajectory(tmp_path / "sylpose" / "trajectory.csv"):
        assert not pose.is_measured
        assert pose.reason
        assert pose.world_from_object is not None
        assert np.degrees(pose.sigma[:3].max()) > 20


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--mesh", "missing.stl"], "missing.stl"),
        (["--mesh", "calibration.toml"], "calibration.toml: a mesh is expected"),
        (["--mesh", "empty.stl"], "empty.stl"),
        (["--mesh", "points.obj"], "points.obj"),
        (["--mesh", "fine.glb"], "faces, of at most"),
        (["--mesh", "part.glb", "--mesh-unit", "mm"], "is its unit right?"),
        (["--mesh", "part.glb", "--mesh-unit", "parsec"], "--mesh-unit"),
        (["--mesh-unit", "mm"], "--mesh-unit"),
        (["--mesh", "part.glb", "--boxes", "boxes.toml"], "--boxes"),
        (["--mesh", "part.glb", "--object", "1"], "--object"),
        (["--mesh", "part.glb", "--smooth"], "--smooth"),
        (["--mesh", "part.glb", "--self-calibrate"], "--self-calibrate"),
        (["--mesh", "part.glb", "--method", "epipolar"], "--method"),
        (["--mesh", "part.glb", "--resume"], "--resume"),
        (["--mesh", "part.glb", "--stop", "10"], "10 images per camera"),
    ],
)
def test_wrong_input(
    irregular: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(irregular)
    Path("empty.stl").write_bytes(b"")
    write_mesh(
        Mesh(np.random.default_rng(1).random((100, 3)), np.arange(90_000).reshape(-1, 3) % 100), Path("fine.glb")
    )
    Path("points.obj").write_text("v 0 0 0\nv 1 0 0\n")
    assert main(["track", ".", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("sylpose: ") == 1
    assert "Traceback" not in error
