"""A moved camera is reported; one hidden for a moment, or cameras that all contradict each other, are not."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.frames import FrameSet
from sylpose.geometry.arrays import FloatArray
from sylpose.report.camera_consistency import (
    RECOVERY_FRAMES,
    WINDOW_FRAMES,
    describe_camera_problems,
    find_disagreements,
    find_noisy_cameras,
)
from sylpose.report.files import TrajectoryWriter, read_trajectory
from sylpose.report.plots import save_trajectory_plot
from sylpose.results import FramePose, Trajectory
from sylpose.rig import Rig
from sylpose.simulate import make_demo_scene, render_frames
from sylpose.status import FrameStatus
from sylpose.tracking.tracker import track
from tests.clips import SIZE, Clip

N = 60


def make_trajectory(inflation: FloatArray, faults: Mapping[int, tuple[str, ...]] | None = None) -> Trajectory:
    """Make a trajectory of frames 100, 101, ... with variance inflations (n, C)."""
    cameras = inflation.shape[1]
    some = np.full(cameras, 50), np.full(cameras, 0.4)
    frames = [
        FramePose(
            100 + k,
            k / 30,
            FrameStatus.TRACKED,
            RigidTransform.from_translation([k, 0, 0]),
            np.eye(6),
            *some,
            variance_inflation=row,
            faults=(faults or {}).get(k, ()),
        )
        for k, row in enumerate(inflation)
    ]
    return Trajectory(frames, [f"cam_{c}" for c in range(cameras)], "m")


def make_inflation(cameras: int = 4) -> FloatArray:
    return np.ones((N, cameras))


def test_consistent_cameras_are_not_reported() -> None:
    rng = np.random.default_rng(0)
    assert find_disagreements(make_trajectory(make_inflation() + rng.exponential(0.2, (N, 4)))) == []
    assert describe_camera_problems(make_trajectory(make_inflation())) == []


def test_camera_inflated_from_a_frame_on_is_reported() -> None:
    inflation = make_inflation()
    inflation[23:, 2] = 7.0
    (found,) = find_disagreements(make_trajectory(inflation))
    assert (found.camera, found.first, found.last, found.is_ongoing) == ("cam_2", 123, 159, True)
    assert found.text == "cam_2 disagrees with the others since frame 123: was it moved?"
    assert describe_camera_problems(make_trajectory(inflation)) == [found.text]


def test_disagreement_can_end() -> None:
    inflation = make_inflation()
    inflation[10:30, 1] = np.inf
    inflation[[14, 25], 1] = 1.0  # single consistent frames do not end it
    (found,) = find_disagreements(make_trajectory(inflation))
    assert found.text == "cam_1 disagreed with the others from frame 110 to 129: was it moved?"


@pytest.mark.parametrize("length", [WINDOW_FRAMES - 2, WINDOW_FRAMES])
def test_short_disagreement_is_ignored(length: int) -> None:
    inflation = make_inflation()
    inflation[20 : 20 + length, 0] = np.inf
    assert len(find_disagreements(make_trajectory(inflation))) == (length == WINDOW_FRAMES)


def test_frames_with_unknown_inflation_are_skipped() -> None:
    inflation = make_inflation()
    inflation[20:50, 0] = np.nan
    inflation[20:50:3, 0] = 9.0
    (found,) = find_disagreements(make_trajectory(inflation))
    assert (found.camera, found.first) == ("cam_0", 120)


def test_contradicting_cameras_are_not_named() -> None:
    inflation = make_inflation()
    inflation[20:] = 8.0
    assert find_disagreements(make_trajectory(inflation)) == []
    (remark,) = describe_camera_problems(make_trajectory(inflation))
    assert remark.startswith("the cameras contradict each other in 40 of 60 frames")
    # Half as often, as for a slightly miscalibrated camera.
    inflation[40:] = 1.0
    assert describe_camera_problems(make_trajectory(inflation)) == []
    # Of two cameras, the faulty one cannot be identified.
    pair = make_inflation(2)
    pair[20:, 0] = 50.0
    assert find_disagreements(make_trajectory(pair)) == []


def test_alternating_cameras_are_not_reported() -> None:
    """All are slightly miscalibrated: cameras alternate, one of them more often inflated."""
    inflation = make_inflation()
    inflation[12:, 2] = 9.0
    assert [d.camera for d in find_disagreements(make_trajectory(inflation))] == ["cam_2"]
    inflation[22::5, 2], inflation[22::5, 0] = 1.0, 9.0
    assert find_disagreements(make_trajectory(inflation)) == []


def test_swapped_calibrations_are_reported() -> None:
    inflation = make_inflation()
    inflation[10:, [0, 3]] = np.inf
    (remark,) = describe_camera_problems(make_trajectory(inflation))
    assert remark == "cam_0 and cam_3 agree with no pose of the other cameras: are their calibrations swapped?"


def test_separate_disagreements_are_separate() -> None:
    inflation = make_inflation()
    inflation[5:15, 3] = inflation[15 + RECOVERY_FRAMES + 1 :, 3] = 20.0
    first, second = find_disagreements(make_trajectory(inflation))
    assert (first.is_ongoing, second.is_ongoing) == (False, True)
    assert (first.first, first.last, second.first) == (105, 114, 100 + 15 + RECOVERY_FRAMES + 1)


def test_faults_are_counted() -> None:
    faults = dict.fromkeys((3, 4, 9), ("camera cam_1: its image does not move",))
    assert describe_camera_problems(make_trajectory(make_inflation(), faults)) == [
        "camera cam_1: its image does not move (in 3 frames)"
    ]


def test_inflation_and_faults_are_in_the_files(tmp_path: Path) -> None:
    inflation = make_inflation()
    inflation[23:, 2] = 7.25
    inflation[30, 2], inflation[31, 1] = np.inf, np.nan
    trajectory = make_trajectory(inflation, {7: ("one", "two")})
    with TrajectoryWriter(tmp_path, trajectory.camera_names, "m") as writer:
        for pose in trajectory:
            writer.write(pose)
    back = read_trajectory(tmp_path / "trajectory.csv")
    np.testing.assert_array_equal(np.array([f.variance_inflation for f in back]), inflation)
    assert [f.faults for f in back] == [f.faults for f in trajectory]
    assert find_disagreements(back) == find_disagreements(trajectory)
    save_trajectory_plot(back, tmp_path / "report.png")
    assert (tmp_path / "report.png").stat().st_size > 10_000


# --- end to end


def render_bumped_clip(degrees: float, camera: int, at: int) -> Clip:
    """Render a rotation during which a camera is rotated from a frame on, unknown to the tracker."""
    scene = make_demo_scene(frames=24, angle_deg=30, size=SIZE, n_cameras=4, seed=7)
    clip, cameras = Clip.render(scene), list(scene.rig)
    if not degrees:
        return clip
    turn = RigidTransform.from_rotation(Rotation.from_rotvec(np.radians(degrees) * np.array([0.6, 0.64, 0.48])))
    cameras[camera] = replace(cameras[camera], camera_from_world=turn * cameras[camera].camera_from_world)
    after = list(render_frames(replace(scene, rig=Rig(cameras, "m"))))
    return Clip(clip.rig, clip.truth, clip.images[:at] + after[at:])


@pytest.mark.slow
@pytest.mark.parametrize(("degrees", "camera"), [(0.0, 0), (0.7, 1)])
def test_bumped_camera_is_reported(degrees: float, camera: int) -> None:
    clip = render_bumped_clip(degrees, camera, 11)
    frames = [FrameSet(k, k / 30, (None,) * 4, images, (None,) * 4) for k, images in enumerate(clip.images)]
    poses = [f.pose for f in track(frames, clip.rig, clip.boxes)]
    found = find_disagreements(Trajectory(poses, clip.rig.names))
    if not degrees:
        assert found == []
        return
    assert [d.camera for d in found] == [f"cam_{camera}"]
    assert 11 <= found[0].first <= 15


@pytest.mark.parametrize(
    ("residuals", "named"),
    [
        ([0.3, 0.2, 3.0, 0.3], [2]),
        ([0.3, 0.2, 0.9, 0.3], []),  # irrelevant below a pixel
        ([1.5, 2.0, 3.0, 1.4], []),  # all are noisy
        ([np.nan, 0.4, 2.0], [2]),
        ([np.nan, np.nan, 9.0], []),  # no camera to compare with
        ([5.0], []),
    ],
)
def test_noisy_camera_is_reported(residuals: list[float], named: list[int]) -> None:
    assert np.flatnonzero(find_noisy_cameras(np.array(residuals))).tolist() == named
    whole = make_trajectory(np.ones((N, len(residuals))))
    frames = [replace(frame, residuals=np.array(residuals)) for frame in whole]
    sentences = describe_camera_problems(Trajectory(frames, whole.camera_names, "m"))
    assert [sentence.split()[0] for sentence in sentences] == [f"cam_{c}" for c in named]
    assert all(f"{residuals[c]:.1f} px" in sentence for c, sentence in zip(named, sentences, strict=True))
