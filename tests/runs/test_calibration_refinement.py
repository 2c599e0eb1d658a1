"""`sylpose track --refine-calibration`: output, files and detection of moved cameras."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.camera_motion import draw_camera_motion, render_images
from sylpose.bundle_adjustment.calibration_refinement import CalibrationCorrection, MovedCamera
from sylpose.commands.main import main
from sylpose.io import calibration
from sylpose.rig import Rig
from sylpose.runs.calibration_refinement import REFINED, REFINED_END, compute_final_rig, describe_changes, write_refined
from sylpose.simulate import compute_demo_truth, make_demo_scene, ring, write_sequence
from sylpose.simulate.recordings import create_session_folder, write_boxes, write_videos

pytestmark = pytest.mark.usefixtures("undrawn")


def test_refinement_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = make_demo_scene(frames=8, angle_deg=24.0, size=(240, 180), n_cameras=3)
    truth = write_sequence(tmp_path / "s", scene, boxes=True)
    assert main(["track", str(tmp_path / "s"), "--refine-calibration", "--no-overlay"]) == 0
    output = capsys.readouterr().out
    assert "Calibration   cam_0: " in output
    assert "cam_2: " in output
    refined = calibration.load(tmp_path / "s" / "sylpose" / REFINED)
    assert refined.names == truth.rig.names
    for a, b in zip(refined, truth.rig, strict=True):
        assert np.rad2deg((a.camera_from_world.rotation * b.camera_from_world.rotation.inv()).magnitude()) < 0.5
    assert (tmp_path / "s" / "sylpose" / "tracked.tum").exists()


def test_bumped_camera_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = make_demo_scene(frames=16, angle_deg=40, size=(320, 240), n_cameras=3, seed=4)
    bump = draw_camera_motion(scene, 1, 2.0, 0.02, 2.0)._replace(frame=6)
    folder = create_session_folder(tmp_path / "s", scene.rig)
    write_boxes(folder, {"object": compute_demo_truth(scene).boxes})
    write_videos(folder, scene.rig, iter(render_images(scene, bump)), scene.frames)
    assert main(["track", str(folder), "--refine-calibration", "--no-overlay"]) == 0
    output = capsys.readouterr().out
    found = re.search(r"cam_1 was moved at frame 6: rotated by (\S+)° ± \S+°, translated by (\S+) ± \S+ m\.", output)
    assert found is not None
    turned, shifted = map(float, found.groups())
    assert abs(turned - 2.0) < 0.5
    assert abs(shifted - np.linalg.norm(bump.translation)) < 0.7 * np.linalg.norm(bump.translation)  # 16 frames only
    then, end = (calibration.load(folder / "sylpose" / name).cameras[1] for name in (REFINED, REFINED_END))
    step = end.camera_from_world.rotation * then.camera_from_world.rotation.inv()
    assert np.rad2deg((step * bump.rotation.inv()).magnitude()) < 1.0
    assert np.linalg.norm(end.center - then.center - bump.translation) < 0.8 * np.linalg.norm(bump.translation)


def test_descriptions_of_changes() -> None:
    rig = ring(2)
    values, prior_sd = np.zeros((2, 10)), np.tile([0.01] * 6 + [0.01, 5.0, 5.0, 0.02], (2, 1))
    sd = 0.1 * prior_sd
    values[0, 0], values[0, 6] = 0.0087, 0.008
    sd[1, 3:6] = prior_sd[1, 3:6]
    one, two = describe_changes(CalibrationCorrection(rig, values, sd, prior_sd, np.diag(sd.ravel() ** 2)), rig, [])
    assert one == "cam_0: rotated by 0.50° (9 standard deviations), focal length +0.80 % (8 standard deviations)."
    assert two == "cam_1: no significant change; not observable in this recording: position."


def test_moved_camera_is_described_and_written_with_its_final_pose(tmp_path: Path) -> None:
    rig, values, sd = ring(2), np.zeros((4, 10)), np.full((4, 10), 1e-3)
    turn, then = np.deg2rad([0.0, 2.0, 0.0]), np.deg2rad([1.0, 0.0, 0.0])
    values[2, 1], values[2, 3], values[3, 5] = np.deg2rad(0.1), 0.008, 0.03
    prior_sd = np.tile([0.03] * 6 + [0.01, 5.0, 5.0, 0.02], (4, 1))
    sd[3, 3:6] = prior_sd[3, 3:6]
    stood = rig.cameras[1].camera_from_world
    places = [rig.cameras[1].center + shift for shift in ([0.008, 0.0, 0.0], [0.008, 0.0, 0.03])]
    turned = Rotation.from_rotvec(values[2, :3]) * stood.rotation
    later = [
        replace(
            rig.cameras[1], name=name, camera_from_world=RigidTransform.from_components(-turned.apply(place), turned)
        )
        for name, place in zip("ab", places, strict=True)
    ]
    correction = CalibrationCorrection(Rig([*rig, *later], "m"), values, sd, prior_sd, np.diag(sd.ravel() ** 2))
    moved = [MovedCamera(1, 25, 0.01, turn), MovedCamera(1, 40, 0.01, then)]
    *_, one, other = describe_changes(correction, rig, moved)
    assert one == "cam_1 was moved at frame 25: rotated by 2.10° ± 0.06°, translated by 0.008 ± 0.001 m."
    assert other == "cam_1 was moved at frame 40: rotated by 1.00° ± 0.06°; not observable in this recording: position."
    end = compute_final_rig(correction, rig.names, moved)
    assert end.names == rig.names
    np.testing.assert_allclose(end.cameras[1].center, places[1], atol=1e-12)
    # The final pose includes both rotations by which images were compensated.
    expected = Rotation.from_rotvec(turn) * Rotation.from_rotvec(then) * turned
    assert (end.cameras[1].camera_from_world.rotation * expected.inv()).magnitude() < 1e-12
    np.testing.assert_array_equal(
        end.cameras[0].camera_from_world.as_matrix(), rig.cameras[0].camera_from_world.as_matrix()
    )
    paths = write_refined(tmp_path, correction, rig.names, moved)
    assert [path.name for path in paths] == [REFINED, REFINED_END]
    np.testing.assert_allclose(calibration.load(paths[1]).cameras[1].center, places[1], atol=1e-9)
    assert [path.name for path in write_refined(tmp_path, correction, rig.names, [])] == [REFINED]
