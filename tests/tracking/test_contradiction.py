"""Frames in which the cameras contradict each other are not tracked, nor are those that rest on them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from sylpose.commands.main import main
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.methods import METHODS
from sylpose.relative_pose.camera_evidence import MAX_F_RATIO, MIN_KEPT_POOLED, CameraEvidence
from sylpose.simulate import make_demo_scene, render_frames
from sylpose.simulate.recordings import create_session_folder, write_videos
from sylpose.smoothing import Track, smooth_tracks
from sylpose.status import FrameStatus
from sylpose.tracking import map_update
from sylpose.tracking.camera_side import frame as frame_module
from sylpose.tracking.camera_side.frame import CameraFrame, FrameMatches, add_evidence
from sylpose.tracking.context import Context, LocalExecutor
from sylpose.tracking.first_motion import FirstMotion
from sylpose.tracking.joint_side.joint_state import JointState, ObjectMotion, SolvedFrame, compute_viewpoints
from sylpose.tracking.joint_side.object_model import ObjectModel
from sylpose.tracking.map_update import (
    _is_rig_contradicted,
    _pool_evidence,
    add_f_ratio,
    is_contradicted,
    measure_f_ratio,
    pool_known,
)
from sylpose.tracking.options import TrackingOptions
from sylpose.tracking.reports import PoseAgreement
from sylpose.tracking.tracker import Tracker, track
from tests.clips import Clip, frame_sets, statuses, turning_clip


@pytest.fixture(scope="module")
def clip() -> Clip:
    return turning_clip()


def mirror(images: Sequence[Image]) -> list[Image]:
    return [np.ascontiguousarray(image[:, ::-1]) for image in images]


def turn_upside_down(images: Sequence[Image]) -> list[Image]:
    return [np.ascontiguousarray(image[::-1, ::-1]) for image in images]


def exchange(images: Sequence[Image]) -> list[Image]:
    return [images[1], images[2], images[0]]


@pytest.mark.parametrize("corrupt", [mirror, turn_upside_down, exchange])
def test_wrong_rig_is_not_tracked(clip: Clip, corrupt: Callable[[Sequence[Image]], list[Image]]) -> None:
    tracked = list(track(frame_sets([tuple(corrupt(images)) for images in clip.images]), clip.rig))
    refined = smooth_tracks([Track.from_tracked(frame) for frame in tracked], clip.rig).poses
    sure = FrameStatus.TRACKED, FrameStatus.RELOCALIZED
    assert not [pose for pose in refined if pose.status in sure]
    contradicted = [pose for pose in refined if pose.status is FrameStatus.CONTRADICTED]
    # Where no pose is found, there is none to contradict.
    assert contradicted or not [pose for pose in refined if pose.world_from_object is not None]
    assert all("different motions" in pose.reason for pose in contradicted)


def test_command_names_the_remedy(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = make_demo_scene(frames=8, n_cameras=3)
    folder = create_session_folder(tmp_path / "recording", scene.rig)
    frames = (turn_upside_down([image for image in images if image is not None]) for images in render_frames(scene))
    write_videos(folder, scene.rig, frames, scene.frames)
    assert main(["track", str(folder), "--no-overlay", "-q"]) == 1
    assert "Check that the calibration belongs to these images" in capsys.readouterr().err


def test_right_rig_is_tracked(clip: Clip) -> None:
    tracked = list(track(clip.frames(), clip.rig))
    assert statuses(tracked)[1:] == [FrameStatus.TRACKED] * (len(clip.images) - 1)


@pytest.mark.parametrize("f_ratio", [4.0, 6.0])
def test_contradicted_first_motion_determines_no_depth(
    clip: Clip, monkeypatch: pytest.MonkeyPatch, f_ratio: float
) -> None:
    monkeypatch.setattr(FirstMotion, "compute_f_ratio", lambda _motion: f_ratio)
    with Tracker(clip.rig, clip.boxes) as tracker:
        for frame in clip.frames()[:8]:
            tracker.step(frame)
        assert tracker.copy_snapshot().state.object.is_depth_guessed == (f_ratio > TrackingOptions().max_pooled_f_ratio)


def test_tracked_frames_replace_the_evidence_of_the_recording(clip: Clip, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other bodies, or a camera that was nudged, may have contradicted the rig in the recording."""
    monkeypatch.setattr(Context, "is_contradicted", True)
    found = statuses(track(clip.frames(), clip.rig, options=TrackingOptions(n_pooled_f_ratios=3)))[1:]
    n = found.index(FrameStatus.TRACKED)
    assert n >= 2
    assert found == [FrameStatus.CONTRADICTED] * n + [FrameStatus.TRACKED] * (len(found) - n)


@pytest.mark.parametrize("is_bounded", [True, False])
def test_one_contradicted_frame_matters_without_boxes(clip: Clip, is_bounded: bool) -> None:
    """In boxes an arm may cross the object; without boxes, what two cameras follow may be another body."""
    rig, options = clip.rig, TrackingOptions()
    executor = LocalExecutor(len(rig), 1)
    context = Context(rig, [], executor, METHODS[0], True, True, np.zeros(len(rig)), 0, options, f_ratio=11.0)
    executor.close()
    known = ObjectModel(is_bounded=is_bounded)
    for ratios, is_over in (((0.1, 0.2), False), ((0.1, 0.2, 0.3), True), ((0.1, 39.0, 0.2, 0.4), is_bounded)):
        assert _is_rig_contradicted(context, JointState(object=known, f_ratios=ratios)) != is_over


def make_frame(number: int, is_contradicted: bool) -> SolvedFrame:
    pose, none = RigidTransform.identity(), np.zeros(2)
    views = np.zeros((2, 3)), np.ones(2, bool)
    return SolvedFrame(number, float(number), none, pose, np.eye(6), *views, is_contradicted=is_contradicted)


def test_frame_is_as_reliable_as_those_that_support_it() -> None:
    good, bad = make_frame(1, False), make_frame(2, True)
    known = {frame.number: frame for frame in (good, bad)}
    agreeing = PoseAgreement(evidence=CameraEvidence(20, 0.3, 0.4, 5.0))
    on_good, on_bad = (replace(agreeing, evidence_reference=frame.number) for frame in (good, bad))
    assert not is_contradicted([on_good, on_good], known, good, TrackingOptions())
    assert not is_contradicted(
        [on_good, on_good, on_bad], known, bad, TrackingOptions()
    )  # two cameras connect it with a reliable frame
    assert is_contradicted([on_good, on_bad], known, good, TrackingOptions())
    assert is_contradicted([on_bad, on_bad], known, good, TrackingOptions())
    # Without evidence it is as reliable as the last frame.
    assert is_contradicted([PoseAgreement(), PoseAgreement()], known, bad, TrackingOptions())
    assert is_contradicted([PoseAgreement(), on_good], known, bad, TrackingOptions())
    assert not is_contradicted([PoseAgreement(), PoseAgreement()], known, good, TrackingOptions())
    # Two cameras that disagree contradict any pose.
    other = replace(on_good, evidence=CameraEvidence(20, 0.3, 9.0, 4.5 * MAX_F_RATIO))
    assert is_contradicted([on_good, other], known, good, TrackingOptions())
    # Of three, one may be at fault: the pose rests on the others.
    assert not is_contradicted([on_good, on_good, other], known, good, TrackingOptions())
    # So it may where the object hardly moves as seen from others, which agree without evidence.
    resting = PoseAgreement(n_matches=30, n_inlier_matches=30)
    assert not is_contradicted([on_good, other, resting], known, good, TrackingOptions())
    assert is_contradicted([on_good, other, replace(resting, n_inlier_matches=3)], known, good, TrackingOptions())
    # A camera whose object rests contradicts the only one that sees a motion, as a still picture does.
    assert is_contradicted([resting, other], known, good, TrackingOptions())
    assert not is_contradicted([resting, on_good], known, good, TrackingOptions())
    # Several of them neither hide that others disagree, nor do they contradict the only one of them that sees a motion.
    strong = replace(other, evidence=CameraEvidence(20, 0.3, 9.0, 200.0))
    assert is_contradicted([resting] * 2 + [strong] * 2, known, good, TrackingOptions())
    assert np.isnan(measure_f_ratio([resting] * 3 + [strong]))


def test_two_cameras_of_three_are_no_evidence_for_a_motion_that_the_third_does_not_follow() -> None:
    agreeing, others = PoseAgreement(evidence=CameraEvidence(20, 0.3, 0.4, 5.0)), PoseAgreement(n_matches=30)
    alone, silent = [agreeing] * 2, replace(others, n_inlier_matches=30)
    assert np.isfinite(
        [measure_f_ratio(its, MIN_KEPT_POOLED) for its in (alone, [*alone, silent], [agreeing] * 3)]
    ).all()
    assert np.isnan([measure_f_ratio([*alone, its], MIN_KEPT_POOLED) for its in (others, PoseAgreement())]).all()


def make_matches(reference: int, shifts: FloatArray) -> FrameMatches:
    """Make matches that moved to the right by `shifts` (n,) pixels since an earlier frame."""
    n = len(shifts)
    before, indices = np.zeros((n, 2)), np.column_stack([np.arange(n)] * 2)
    after = np.column_stack([shifts, np.zeros(n)])
    return FrameMatches(reference, cast(CameraFrame, None), indices, before, after, before, after, np.zeros(n, bool))


def test_mismatches_do_not_choose_the_evidence(clip: Clip, monkeypatch: pytest.MonkeyPatch) -> None:
    def choose(*pairs: FrameMatches) -> int:
        known = {pair.reference: make_solved(pair.reference) for pair in pairs}
        current = cast(CameraFrame, SimpleNamespace(noise_px=0.3))
        return add_evidence(PoseAgreement(), pairs, current, clip.rig[0], 0, make_solved(9), known).evidence_reference

    def make_solved(number: int) -> SolvedFrame:
        pose = RigidTransform.from_translation(clip.rig[0].center + clip.rig[0].rotation[2])
        viewpoints = compute_viewpoints(clip.rig, pose)
        return SolvedFrame(number, 0.0, np.zeros(3), pose, np.zeros((6, 6)), viewpoints, np.ones(3, bool))

    monkeypatch.setattr(frame_module, "compare_motions", lambda x, *_: (len(x), 0.0, 0.0, 0.0))
    near, far = make_matches(1, np.full(20, 8.0)), make_matches(2, np.full(20, 12.0))
    assert choose(near, far) == choose(far, near) == 2
    # A period of 100 pixels: these moved as little as `near`, and less than `far`.
    mismatched = make_matches(3, np.r_[np.full(14, 8.0), np.full(6, 108.0)])
    assert choose(near, mismatched) == 1
    assert choose(mismatched, near) == 3
    assert choose(mismatched, far) == choose(far, mismatched) == 2


def test_last_frames_are_pooled() -> None:
    ratios: tuple[float, ...] = ()
    for f_ratio, expected in [(12.0, False), (1.0, False), (12.0, True), (np.nan, True), (1.0, False), (200.0, True)]:
        ratios = add_f_ratio(ratios, f_ratio, TrackingOptions())
        assert (pool_known(ratios) > TrackingOptions().max_pooled_f_ratio) is expected
    for _ in range(8):
        ratios = add_f_ratio(ratios, 1.0, TrackingOptions())
    assert pool_known(ratios) == 1.0


def test_frames_since_the_object_was_found_again_are_pooled_on_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """The frames before show the pose that was lost, and may agree."""
    context = cast("Context", SimpleNamespace(options=TrackingOptions(), rig=range(3)))
    monkeypatch.setattr(map_update, "measure_f_ratio", lambda *_: 20.0)
    state, pooled = JointState(f_ratios=(0.0,) * 15, n_new_f_ratios=9), list[list[float]]()
    for n_missed in (0, 2, 0, 0, 0, 1):
        state, *value = _pool_evidence(context, replace(state, motion=ObjectMotion(n_missed=n_missed)), [])
        pooled.append(value)
    assert pooled == [*[[0.0, 15]] * 3, [20.0, 3], [20.0, 4], [0.0, 15]]
    assert state.n_new_f_ratios == 1
    assert len(state.f_ratios) == TrackingOptions().n_pooled_f_ratios


def test_nothing_is_predicted_from_a_contradicted_pose(clip: Clip, monkeypatch: pytest.MonkeyPatch) -> None:
    blank = tuple(np.zeros_like(image) for image in clip.images[0])
    frames = frame_sets([*clip.images, blank, blank])
    assert statuses(track(frames, clip.rig, clip.boxes))[-3:] == [FrameStatus.TRACKED, *[FrameStatus.COASTING] * 2]
    monkeypatch.setattr(map_update, "measure_f_ratio", lambda *_: 2.0 * MAX_F_RATIO)
    contradicted = statuses(track(frames, clip.rig, clip.boxes))
    assert contradicted[-3:] == [FrameStatus.CONTRADICTED, *[FrameStatus.LOST] * 2]
