"""Tracking benchmark: rendered recordings, scores, requirements and regressions."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks import tracking
from benchmarks.rendered_recordings import Recording, compute_visible_shares, write_recording
from benchmarks.tracking_paths import Path as Motion
from benchmarks.tracking_paths import bump_profile, make_tumbling_path, smooth_step, smooth_window, swing_profile
from benchmarks.tracking_report import (
    HEADER,
    ErrorStatistics,
    Row,
    compute_errors,
    find_regressions,
    format_requirements,
    format_row,
    load,
    save,
    score_trajectory,
)
from benchmarks.tracking_scenes import BUILDERS, DISTANCE, build_recording, render_recording
from sylpose.io.capture import open_session
from sylpose.report.files import read_tum, write_tum
from sylpose.simulate import Actor, Scene, arc, chamfered_box


def frame_steps(motion: Motion, frames: int) -> tuple[RigidTransform, np.ndarray, np.ndarray]:
    """Return the poses, and the rotation (degrees) and distance from each to the next."""
    poses = RigidTransform.concatenate([motion(float(k)) for k in range(frames)])
    turns = np.degrees((poses[1:].rotation * poses[:-1].rotation.inv()).magnitude())
    return poses, turns, np.linalg.norm(np.diff(poses.translation, axis=0), axis=1)


def make_small_scene(frames: int = 4) -> Scene:
    """Return a scene of two small boxes and two cameras."""
    rig = arc(2, 60.0, 1.5, 150.0, (96, 64))
    actors = [
        Actor(
            chamfered_box([0.15, 0.12, 0.1], 100.0, seed=k),
            lambda f, x=x: RigidTransform.from_components([x, 0.05 * f, 0.0], Rotation.from_euler("y", 0.1 * f)),  # type: ignore[misc]
        )
        for k, x in enumerate((-0.15, 0.15))
    ]
    return Scene(rig, tuple(actors), frames)


def test_profiles_have_the_specified_limits() -> None:
    t = np.linspace(-5, 40, 91)
    assert smooth_step([-1, 0, 0.5, 1, 2]) == pytest.approx([0, 0, 0.5, 1, 1])
    inside = smooth_window(t, 10, 20, 5)
    assert (inside[(t >= 10) & (t <= 20)] == 1).all()
    assert (inside[(t <= 5) | (t >= 25)] == 0).all()
    assert bump_profile(t, 10, 4).sum() * 0.5 == pytest.approx(4)
    assert swing_profile([-10, 10, 30, 60], [(5, 4), (20, 4), (50, 2)]) == pytest.approx([-0.5, 0.5, -0.5, 0.5])


def test_tumble_has_the_given_speed_and_starts_at_identity() -> None:
    path = make_tumbling_path(
        20, lambda t: 2 + 0.1 * t, lambda t: np.outer(t, [1.0, 2.0, 3.0]), np.random.default_rng(0)
    )
    poses, turns, _ = frame_steps(path, 20)
    assert poses[0].rotation.magnitude() == pytest.approx(0, abs=1e-12)
    assert turns == pytest.approx(2.05 + 0.1 * np.arange(19), abs=0.02)
    assert poses.translation[7] == pytest.approx([7, 14, 21])
    assert np.allclose(path(3.5).rotation.as_matrix(), path(3.5000001).rotation.as_matrix(), atol=1e-6)


@pytest.mark.parametrize(
    "name",
    ["box", "dropped", *(pytest.param(name, marks=pytest.mark.slow) for name in ("body", "occluded-half", "two"))],
)
def test_sequences_rotate_by_more_than_400_degrees(name: str) -> None:
    recording = build_recording(name)
    for actor in recording.scene.actors[: len(recording.objects)]:
        poses, turns, distances = frame_steps(actor.path, recording.scene.frames)
        assert turns.sum() > 400
        assert distances.max() < 0.01
        assert 0.08 < np.ptp(poses.translation, axis=0).max() < 0.4


def test_gone_object_is_invisible_for_30_frames_and_returns_rotated_elsewhere() -> None:
    recording = build_recording("gone")
    unseen = np.flatnonzero((compute_visible_shares(recording.scene) == 0).all(axis=1))
    assert len(unseen) == 30
    assert unseen[-1] - unseen[0] == 29
    poses, turns, _ = frame_steps(recording.scene.actors[0].path, 300)
    left, back = poses[unseen[0] - 12], poses[unseen[-1] + 12]
    assert turns[unseen[0] - 1 : unseen[-1] + 1].sum() == pytest.approx(25, abs=3)
    assert np.linalg.norm(back.translation - left.translation) > 0.1


@pytest.mark.slow
def test_occluders_hide_the_whole_object() -> None:
    for name, cameras, length in (("occluded-half", [0, 2], 20), ("occluded-all", [0, 1, 2, 3], 8)):
        recording = build_recording(name, 60)
        hidden = compute_visible_shares(recording.scene) == 0
        assert hidden.all(axis=1).any() == (len(cameras) == 4)
        assert hidden[:, cameras].all(axis=1).sum() == pytest.approx(length, abs=2)
        assert hidden.sum() == hidden[:, cameras].sum()


def test_fast_bursts_reach_15_degrees_and_a_tenth_of_the_distance() -> None:
    _, turns, distances = frame_steps(build_recording("fast").scene.actors[0].path, 300)
    assert turns.max() == pytest.approx(15, abs=0.5)
    assert distances.max() == pytest.approx(DISTANCE / 10, rel=0.05)


def test_dropped_frames() -> None:
    shown = build_recording("dropped").recorded
    assert shown is not None
    assert shown[0].all()
    assert shown.any(axis=1).all()
    assert not shown[150:, 1].any()
    assert (~shown[:150]).mean() == pytest.approx(0.1, abs=0.03)


def test_recording_is_written_as_session_with_truth(tmp_path: Path) -> None:
    shown = np.array([[True, True], [True, False], [False, True], [True, True]])
    recording = Recording(
        make_small_scene(), ("left", "right"), recorded=shown, time_offsets=(-0.01, 0.01), with_timestamps=True
    )
    write_recording(recording, tmp_path)
    session = open_session(tmp_path)
    assert session.objects == recording.objects
    assert session.timeline.frames.tolist() == [[0, 0], [1, -1], [-1, 1], [2, 2]]
    assert session.timeline.stamps[0] == pytest.approx([-0.01, 0.01])
    assert [sum(image is not None for image in frames.images) for frames in session.frames()] == [2, 1, 1, 2]
    assert (tmp_path / "true_offsets.toml").read_text() == "cam_0 = -0.01\ncam_1 = 0.01\n"
    for k, name in enumerate(recording.objects):
        times, poses = read_tum(tmp_path / f"groundtruth_{name}.tum")
        assert times == pytest.approx(np.arange(4) / 30)
        assert poses.translation[:, 0] == pytest.approx([-0.15 + 0.3 * k] * 4)
        assert np.loadtxt(tmp_path / f"vertices_{name}.txt").shape == (24, 3)


def test_skewed_camera_is_exposed_at_its_time_offset(tmp_path: Path) -> None:
    """A camera exposed one frame late shows at frame k the image of frame k + 1."""
    scene = replace(make_small_scene(3), actors=make_small_scene().actors[:1], noise=0.0)
    write_recording(Recording(scene, time_offsets=(0.0, 0.0), quality=2), tmp_path / "even")
    write_recording(Recording(scene, time_offsets=(0.0, 1 / 30), quality=2), tmp_path / "late")
    even, late = (list(open_session(tmp_path / name).frames()) for name in ("even", "late"))

    def apart(camera: int, k: int) -> float:
        pictures = [np.asarray(frames.images[camera], dtype=float) for frames in (late[1], even[k])]
        return float(np.abs(pictures[0] - pictures[1]).mean())

    # Compression leaves some difference.
    assert apart(0, 1) < 0.5 * apart(0, 2)
    assert apart(1, 2) < 0.5 * apart(1, 1)


def test_repeats_contain_the_same_images(tmp_path: Path) -> None:
    write_recording(Recording(replace(make_small_scene(3), actors=make_small_scene().actors[:1]), repeats=3), tmp_path)
    frames = list(open_session(tmp_path).frames())
    assert len(frames) == 9
    for k in range(3, 9):
        for image, before in zip(frames[k].images, frames[k - 3].images, strict=True):
            assert np.array_equal(np.asarray(image), np.asarray(before))
    times, poses = read_tum(tmp_path / "groundtruth.tum")
    assert times[-1] == pytest.approx(8 / 30)
    assert np.allclose(poses.translation[:3], poses.translation[6:])


def test_scenes_are_rendered_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(
        BUILDERS, "box", lambda n: Recording(replace(make_small_scene(n), actors=make_small_scene().actors[:1]))
    )
    folder = render_recording("box", tmp_path, 2)
    made = (folder / "cam_0.mp4").stat().st_mtime_ns
    assert render_recording("box", tmp_path, 2) == folder
    assert (folder / "cam_0.mp4").stat().st_mtime_ns == made
    (folder / ".done").unlink()  # as after an interrupted run
    render_recording("box", tmp_path, 2)
    assert (folder / "cam_0.mp4").stat().st_mtime_ns > made


def test_errors_do_not_depend_on_the_object_frame() -> None:
    """Another object frame causes no error; a rotation about the center causes no translation error."""
    rng = np.random.default_rng(0)
    times = np.arange(6) / 30
    truth = RigidTransform.from_components(rng.normal(size=(6, 3)), Rotation.random(6, rng=rng))
    other = RigidTransform.from_components([0.1, -0.2, 0.3], Rotation.random(rng=rng))
    center = truth.translation[0]
    frames, off = compute_errors((times[1:], truth[1:] * other), (times, truth), center)
    assert frames.tolist() == [1, 2, 3, 4, 5]
    assert np.abs(off).max() < 1e-12
    turn = np.array([0.0, 0.02, 0.0])
    wrong = RigidTransform.from_components(truth.translation, Rotation.from_rotvec(turn) * truth.rotation)
    wrong = RigidTransform.concatenate([truth[:3], wrong[3:]])
    _, off = compute_errors((times, wrong * other), (times, truth), center)
    assert off[3:, :3] == pytest.approx(np.tile(turn, (3, 1)))
    assert np.abs(off[:, 3:]).max() < 1e-12
    assert not len(compute_errors((times[:0], truth[:0]), (times, truth), center)[0])


def test_score_contains_frames_until_relocalization(tmp_path: Path) -> None:
    n = 20
    times = np.arange(n) / 30
    truth = RigidTransform.from_translation(np.outer(np.arange(n), [0.01, 0, 0]))
    write_tum(tmp_path / "groundtruth.tum", times, truth)
    shares = np.ones((n, 4))
    shares[8:12], shares[12] = 0, 0.5
    lines = ["frame,a,b,c,d", *(f"{k},{','.join(map(str, row))}" for k, row in enumerate(shares))]
    (tmp_path / "visible.csv").write_text("\n".join(lines))
    kept = np.r_[0:9, 14:20]
    off = Rotation.from_rotvec(np.deg2rad([[5.0 * (k == 14), 0, 0.5 * (k > 14)] for k in kept]))
    estimate = RigidTransform.from_components(truth.translation[kept], off)
    write_tum(tmp_path / "trajectory.tum", times[kept], estimate)
    row = score_trajectory(Row("gone", "sylpose"), tmp_path / "trajectory.tum", tmp_path / "groundtruth.tum")
    assert (row.total, row.solved, row.false, row.back) == (20, 15, 1, 2)  # visible in 13, wrong in 14, right in 15
    assert row.after_deg == pytest.approx(0.5)
    assert row.deg is not None
    assert (row.deg.worst, row.deg.last) == pytest.approx((5, 0.5))
    assert "relocalized 2 frames after its return" in format_row(row)
    assert format_row(row).count("|") == HEADER.splitlines()[0].count("|")
    nothing = tmp_path / "nothing.tum"
    write_tum(nothing, times[:1], truth[:1])
    assert score_trajectory(row, nothing, tmp_path / "groundtruth.tum").failed


def test_requirements_and_regressions(tmp_path: Path) -> None:
    ours = Row(
        "box",
        "sylpose sift",
        300,
        300,
        ErrorStatistics(0.1, 0.2, 0.1, 0.1),
        ErrorStatistics(0.1, 0.2, 0.1, 0.1),
        fps=7.0,
    )
    chain = Row("box", "poselib", 300, 300, ErrorStatistics(0.5, 1.0, 1.0, 0.9), ErrorStatistics(1, 1, 1, 1))
    table = format_requirements([ours, chain])
    assert table.count("| yes |") == 3
    assert "NO" not in table
    assert format_requirements([replace(ours, deg=ErrorStatistics(0.1, 0.4, 0.1, 0.2)), chain]).count("| NO |") == 2
    assert "| NO |" in format_requirements([replace(ours, by="sylpose klt")])  # KLT has a higher target
    assert "none" in format_requirements([Row("box", "sylpose", failed="crash")])
    save([ours, chain], tmp_path / "rows.json")
    assert load(tmp_path / "rows.json") == [ours, chain]
    assert not list(find_regressions([ours], [ours, chain]))
    assert list(find_regressions([replace(ours, deg=ErrorStatistics(0.1, 0.3, 0.1, 0.1))], [ours]))
    assert list(find_regressions([replace(ours, solved=299)], [ours]))
    assert list(find_regressions([Row("box", "sylpose sift", failed="crash")], [ours]))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--frames", "0"], "frames must be at least 1"),
        (["--only", "nothing"], "invalid choice"),
        (["--compare", "missing.json"], "not a file of results"),
    ],
)
def test_bad_arguments_are_rejected(
    arguments: list[str], message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["tracking.py", *arguments])
    with pytest.raises(SystemExit) as end:
        tracking.main()
    assert end.value.code == 2
    assert message in capsys.readouterr().err


def test_peer_chains_adjacent_frames(tmp_path: Path) -> None:
    pytest.importorskip("poselib")
    from benchmarks.tracking_peers import run_poselib_chain

    session = render_recording("box", tmp_path, 3)
    poses, _ = run_poselib_chain(open_session(session), 1, None)
    write_tum(tmp_path / "peer.tum", np.arange(3) / 30, RigidTransform.concatenate(list(poses.values())))
    row = score_trajectory(Row("box", "poselib"), tmp_path / "peer.tum", session / "groundtruth.tum")
    assert row.solved == 3
    assert row.deg is not None
    assert row.deg.worst < 0.5
