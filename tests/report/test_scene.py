"""3D scene of a result."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.io import calibration
from sylpose.report.files import write_trajectory
from sylpose.report.scene import FRUSTUM_DEPTH_RATIO, IMAGE_GRID, PointCloud, Scene, build_scene
from sylpose.results import FramePose, Trajectory
from sylpose.rig import Rig, make_look_at_camera
from sylpose.runs.page import read_scene
from sylpose.runs.run_metadata import USED_CALIBRATION
from sylpose.status import FrameStatus

CAMERAS = ("left", "right", "above")


def rig(unit: str = "m") -> Rig:
    eyes = ((1.0, 0, 0), (0, 1.2, 0), (0, 0.1, 0.9))
    return Rig(
        [make_look_at_camera(n, eye, (0, 0, 0), 800, (640, 480)) for n, eye in zip(CAMERAS, eyes, strict=True)], unit
    )


def trajectory(n: int = 5, lost: tuple[int, ...] = ()) -> Trajectory:
    frames = []
    for k in range(n):
        pose = RigidTransform.from_components([0.01 * k, 0, 0], Rotation.from_rotvec([0, 0.02 * k, 0]))
        frame = FramePose(10 + k, k / 30, FrameStatus.TRACKED, pose, 1e-6 * np.eye(6), np.full(3, 50), np.full(3, 0.2))
        if k in lost:
            frame = replace(frame, status=FrameStatus.LOST, world_from_object=None, reason="nothing was seen")
        frames.append(frame)
    return Trajectory(frames, CAMERAS, "m")


def test_scene_geometry() -> None:
    bent = [replace(camera, distortion=np.array([-0.2, 0.05, 0.001, 0, 0])) for camera in rig()]
    its = Rig(bent, "m")
    scene = build_scene(trajectory(lost=(3,)), its)
    for c, camera in enumerate(its):
        assert np.allclose(scene.world_from_camera[c, :3, 3], camera.center)
        # The far plane is the back-projection of image points at one depth.
        sheet = scene.image_planes[c]
        assert np.allclose(camera.project(sheet[0]), [[x, 0] for x in np.linspace(0, 639, IMAGE_GRID)], atol=0.05)
        assert np.allclose(camera.project(sheet[:, -1]), [[639, y] for y in np.linspace(0, 479, IMAGE_GRID)], atol=0.05)
        depth = (sheet - camera.center) @ camera.direction
        assert np.allclose(depth, FRUSTUM_DEPTH_RATIO * scene.camera_distance)
    assert np.isnan(scene.world_from_object[3]).all()
    assert np.isfinite(np.delete(scene.world_from_object, 3, axis=0)).all()
    assert np.allclose(scene.world_from_object[2, :3, 3], [0.02, 0, 0])
    assert scene.status[3] == "lost"
    assert scene.reason == ("", "", "", "nothing was seen", "")
    assert scene.measured.tolist() == [True, True, True, False, True]
    assert 0.9 < scene.camera_distance < 1.2
    assert len(scene.points) == 0 < scene.axis_length


def test_points_have_their_cameras_color() -> None:
    cloud = PointCloud(np.eye(3), np.array([2, 0, 2]), 0.1)
    scene = build_scene(trajectory(), rig(), cloud)
    assert scene.axis_length == 0.1
    assert np.array_equal(scene.point_colors, scene.colors[[2, 0, 2]])
    assert len({*map(tuple, scene.colors.tolist())}) == 3


@pytest.mark.parametrize("lost", [(), (0, 1, 2, 3, 4)])
def test_a_result_folder_is_read_with_and_without_poses(tmp_path: Path, lost: tuple[int, ...]) -> None:
    write_trajectory(tmp_path, trajectory(lost=lost))
    calibration.save(rig(), tmp_path / USED_CALIBRATION)
    scene = read_scene(tmp_path)
    assert isinstance(scene, Scene)
    assert scene.index.tolist() == [10, 11, 12, 13, 14]
    assert np.isfinite(scene.world_from_object).all() == (not lost)
    # Without a pose, the center is the point the cameras look at.
    assert np.linalg.norm(scene.center) < 0.03
    assert scene.covariance.shape == (5, 6, 6)


def test_other_rig_is_rejected(tmp_path: Path) -> None:
    write_trajectory(tmp_path, trajectory())
    calibration.save(rig().subset(CAMERAS[:2]), tmp_path / USED_CALIBRATION)
    with pytest.raises(ValueError, match=r"it has the cameras left, right, the trajectory left, right, above"):
        read_scene(tmp_path)
    with pytest.raises(ValueError, match="trajectory: of the cameras"):
        build_scene(trajectory(), rig().subset(CAMERAS[:2]))
