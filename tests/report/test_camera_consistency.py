"""A camera that was moved is named; one that is hidden for a moment, or cameras that all contradict each other, are not."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.frames import FrameSet
from sylpose.geometry.arrays import FloatArray
from sylpose.report.camera_consistency import AT_EASE, WINDOW, disagreements, noisy, remarks
from sylpose.report.files import TrajectoryWriter, read_trajectory
from sylpose.report.plots import plot_trajectory
from sylpose.results import FramePose, FrameStatus, Trajectory
from sylpose.rig import Rig
from sylpose.simulate import demo_scene, render_frames
from sylpose.tracking.tracker import track
from tests.clips import SIZE, Clip

N = 60


def said(doubt: FloatArray, faults: Mapping[int, tuple[str, ...]] | None = None) -> Trajectory:
    """A trajectory of frames 100, 101, ... with doubts (n, C)."""
    cameras = doubt.shape[1]
    some = np.full(cameras, 50), np.full(cameras, 0.4)
    frames = [
        FramePose(
            100 + k,
            k / 30,
            FrameStatus.TRACKED,
            RigidTransform.from_translation([k, 0, 0]),
            np.eye(6),
            *some,
            doubt=row,
            faults=(faults or {}).get(k, ()),
        )
        for k, row in enumerate(doubt)
    ]
    return Trajectory(frames, [f"cam_{c}" for c in range(cameras)], "m")


def doubts(cameras: int = 4) -> FloatArray:
    return np.ones((N, cameras))


def test_nobody_is_named_where_all_agree() -> None:
    rng = np.random.default_rng(0)
    assert disagreements(said(doubts() + rng.exponential(0.2, (N, 4)))) == []
    assert remarks(said(doubts())) == []


def test_a_camera_that_is_doubted_from_a_frame_on_is_named_with_it() -> None:
    doubt = doubts()
    doubt[23:, 2] = 7.0
    (found,) = disagreements(said(doubt))
    assert (found.camera, found.first, found.last, found.lasts) == ("cam_2", 123, 159, True)
    assert found.text == "cam_2 disagrees with the others since frame 123: was it moved?"
    assert remarks(said(doubt)) == [found.text]


def test_one_that_agrees_again_did_so_for_a_while() -> None:
    doubt = doubts()
    doubt[10:30, 1] = np.inf
    doubt[[14, 25], 1] = 1.0  # a frame now and then says nothing
    (found,) = disagreements(said(doubt))
    assert found.text == "cam_1 disagreed with the others from frame 110 to 129: was it moved?"


@pytest.mark.parametrize("length", [WINDOW - 2, WINDOW])
def test_a_moment_is_not_enough(length: int) -> None:
    doubt = doubts()
    doubt[20 : 20 + length, 0] = np.inf
    assert len(disagreements(said(doubt))) == (length == WINDOW)


def test_frames_in_which_it_was_not_asked_do_not_count() -> None:
    doubt = doubts()
    doubt[20:50, 0] = np.nan
    doubt[20:50:3, 0] = 9.0
    (found,) = disagreements(said(doubt))
    assert (found.camera, found.first) == ("cam_0", 120)


def test_where_all_contradict_each_other_nobody_is_named() -> None:
    doubt = doubts()
    doubt[20:] = 8.0
    assert disagreements(said(doubt)) == []
    (told,) = remarks(said(doubt))
    assert told.startswith("the cameras contradict each other in 40 of 60 frames")
    # Half as often, as one that is calibrated a little off is doubted with the others.
    doubt[40:] = 1.0
    assert remarks(said(doubt)) == []
    # Of two, nobody knows which one.
    pair = doubts(2)
    pair[20:, 0] = 50.0
    assert disagreements(said(pair)) == []


def test_where_cameras_take_turns_nobody_was_moved() -> None:
    """All are calibrated a little off: now one is doubted and now another, one of them more often."""
    doubt = doubts()
    doubt[12:, 2] = 9.0
    assert [d.camera for d in disagreements(said(doubt))] == ["cam_2"]
    doubt[22::5, 2], doubt[22::5, 0] = 1.0, 9.0
    assert disagreements(said(doubt)) == []


def test_cameras_that_see_something_else_are_named() -> None:
    doubt = doubts()
    doubt[10:, [0, 3]] = np.inf
    (told,) = remarks(said(doubt))
    assert told == "what cam_0 and cam_3 see agrees with no pose of the others: are their calibrations exchanged?"


def test_two_times_are_two() -> None:
    doubt = doubts()
    doubt[5:15, 3] = doubt[15 + AT_EASE + 1 :, 3] = 20.0
    first, second = disagreements(said(doubt))
    assert (first.lasts, second.lasts) == (False, True)
    assert (first.first, first.last, second.first) == (105, 114, 100 + 15 + AT_EASE + 1)


def test_faults_are_counted() -> None:
    faults = dict.fromkeys((3, 4, 9), ("camera cam_1: its image does not move",))
    assert remarks(said(doubts(), faults)) == ["camera cam_1: its image does not move (in 3 frames)"]


def test_doubt_and_faults_are_in_the_files(tmp_path: Path) -> None:
    doubt = doubts()
    doubt[23:, 2] = 7.25
    doubt[30, 2], doubt[31, 1] = np.inf, np.nan
    trajectory = said(doubt, {7: ("one", "two")})
    with TrajectoryWriter(tmp_path, trajectory.camera_names, "m") as writer:
        for pose in trajectory:
            writer.write(pose)
    back = read_trajectory(tmp_path / "trajectory.csv")
    np.testing.assert_array_equal(np.array([f.doubt for f in back]), doubt)
    assert [f.faults for f in back] == [f.faults for f in trajectory]
    assert disagreements(back) == disagreements(trajectory)
    plot_trajectory(back, tmp_path / "report.png")
    assert (tmp_path / "report.png").stat().st_size > 10_000


# --- the whole way


def bumped(degrees: float, camera: int, at: int) -> Clip:
    """A rendered turn in which a camera is turned by so much from a frame on, and nobody says so."""
    scene = demo_scene(frames=32, turn_deg=40, size=SIZE, n_cameras=4, seed=7)
    clip, cameras = Clip.render(scene), list(scene.rig)
    if not degrees:
        return clip
    turn = RigidTransform.from_rotation(Rotation.from_rotvec(np.radians(degrees) * np.array([0.6, 0.64, 0.48])))
    cameras[camera] = replace(cameras[camera], camera_from_world=turn * cameras[camera].camera_from_world)
    after = list(render_frames(replace(scene, rig=Rig(cameras, "m"))))
    return Clip(clip.rig, clip.truth, clip.images[:at] + after[at:])


@pytest.mark.parametrize(("degrees", "camera"), [(0.0, 0), (0.7, 1)])
def test_a_camera_that_is_bumped_into_is_named(degrees: float, camera: int) -> None:
    clip = bumped(degrees, camera, 18)
    frames = [FrameSet(k, k / 30, (None,) * 4, images, (None,) * 4) for k, images in enumerate(clip.images)]
    poses = [f.pose for f in track(frames, clip.rig, clip.boxes)]
    found = disagreements(Trajectory(poses, clip.rig.names))
    if not degrees:
        assert found == []
        return
    assert [d.camera for d in found] == [f"cam_{camera}"]
    assert 18 <= found[0].first <= 22


@pytest.mark.parametrize(
    ("residuals", "named"),
    [
        ([0.3, 0.2, 3.0, 0.3], [2]),
        ([0.3, 0.2, 0.9, 0.3], []),  # below a pixel nobody cares
        ([1.5, 2.0, 3.0, 1.4], []),  # all are noisy
        ([np.nan, 0.4, 2.0], [2]),
        ([np.nan, np.nan, 9.0], []),  # nobody to compare with
        ([5.0], []),
    ],
)
def test_a_camera_of_many_times_the_others_noise_is_named(residuals: list[float], named: list[int]) -> None:
    assert np.flatnonzero(noisy(np.array(residuals))).tolist() == named
    whole = said(np.ones((N, len(residuals))))
    frames = [replace(frame, residuals=np.array(residuals)) for frame in whole]
    sentences = remarks(Trajectory(frames, whole.camera_names, "m"))
    assert [sentence.split()[0] for sentence in sentences] == [f"cam_{c}" for c in named]
    assert all(f"{residuals[c]:.1f} px" in sentence for c, sentence in zip(named, sentences, strict=True))
