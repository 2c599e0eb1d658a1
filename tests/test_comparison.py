"""Trajectory errors: against written-out formulas, invariances, and rejected input."""

from __future__ import annotations

import json
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.commands import compare
from sylpose.commands.compare import describe_mismatches
from sylpose.commands.main import main
from sylpose.comparison import Alignment, associate_timestamps, compare_trajectories, compute_statistics
from sylpose.geometry.arrays import FloatArray
from sylpose.report.files import write_tum

N = 30


def motion(seed: int = 0, noise: float = 0.0) -> tuple[FloatArray, RigidTransform]:
    """Return times and a curve in space with rotations."""
    s = np.linspace(0, 2, N)
    places = np.column_stack([np.sin(s), 0.5 * s, np.cos(2 * s)])
    turns = Rotation.from_rotvec(np.column_stack([s, 0.3 * s * s, -0.5 * np.sin(3 * s)]))
    rng = np.random.default_rng(seed)
    off = Rotation.from_rotvec(noise * rng.normal(size=(N, 3)))
    return np.asarray(0.1 * np.arange(N)), RigidTransform.from_components(
        places + noise * rng.normal(size=(N, 3)), off * turns
    )


def any_transform(seed: int) -> RigidTransform:
    rng = np.random.default_rng(seed)
    return RigidTransform.from_components(rng.normal(size=3), Rotation.from_rotvec(rng.normal(size=3)))


def naive(found: RigidTransform, right: RigidTransform, step: int) -> list[FloatArray]:
    """Compute absolute and relative rotation and translation errors by matrices (Sturm et al., equations 1 to 4)."""
    p, q = found.as_matrix(), right.as_matrix()

    def angle(matrix: FloatArray) -> float:
        return float(np.arccos(np.clip((np.trace(matrix[:3, :3]) - 1) / 2, -1, 1)))

    absolute = [np.linalg.inv(q[i]) @ p[i] for i in range(len(p))]
    relative = [
        np.linalg.inv(np.linalg.inv(q[i]) @ q[i + step]) @ (np.linalg.inv(p[i]) @ p[i + step])
        for i in range(len(p) - step)
    ]
    return [
        np.array([angle(e) for e in absolute]),
        np.array([np.linalg.norm(p[i, :3, 3] - q[i, :3, 3]) for i in range(len(p))]),
        np.array([angle(e) for e in relative]),
        np.array([np.linalg.norm(e[:3, 3]) for e in relative]),
    ]


@pytest.mark.parametrize("step", [1, 4])
def test_errors_match_formulas(step: int) -> None:
    (times, found), (_, right) = motion(1, 0.05), motion()
    result = compare_trajectories(times, found, times, right, align="none", step=step)
    errors = (result.rotation, result.position, result.relative_rotation, result.relative_position)
    for ours, theirs in zip(errors, naive(found, right, step), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-7)
    text = compute_statistics(np.array([3.0, 4.0]))
    assert text.pop("rmse") == pytest.approx(12.5**0.5)
    assert text == {"mean": 3.5, "median": 3.5, "std": 0.5, "min": 3.0, "max": 4.0}


def test_first_ignores_the_object_frame() -> None:
    times, right = motion()
    same = compare_trajectories(times, right * any_transform(3), times, right, align="first")
    assert max(same.rotation.max(), same.position.max(), same.relative_position.max()) < 1e-12
    assert compare_trajectories(times, right * any_transform(3), times, right, align="none").position.min() > 0.1


@pytest.mark.parametrize("align", ["se3", "sim3"])
def test_se3_and_sim3_ignore_the_world_frame(align: Alignment) -> None:
    times, right = motion()
    moved = any_transform(5) * right
    same = compare_trajectories(times, moved, times, right, align=align)
    assert max(same.rotation.max(), same.position.max()) < 1e-12
    assert same.scale == pytest.approx(1.0)
    larger = RigidTransform.from_components(2.5 * moved.translation, moved.rotation)
    scaled = compare_trajectories(times, larger, times, right, align=align)
    if align == "sim3":
        assert scaled.position.max() < 1e-12
        assert scaled.scale == pytest.approx(0.4)
    else:
        assert scaled.position.max() > 0.5


def test_both_ignores_world_and_object_frames() -> None:
    times, right = motion()
    other = any_transform(5) * right * any_transform(6)
    same = compare_trajectories(times, other, times, right, align="both")
    assert max(same.rotation.max(), same.position.max(), same.relative_position.max()) < 1e-9
    assert compare_trajectories(times, other, times, right, align="first").rotation.max() > 0.1
    # With noise, the remaining errors are the noise, less the few fitted unknowns.
    _, noisy = motion(3, 0.01)
    plain = compare_trajectories(times, noisy, times, right, align="none")
    result = compare_trajectories(times, any_transform(5) * noisy * any_transform(6), times, right, align="both")
    for left, whole in ((result.rotation, plain.rotation), (result.position, plain.position)):
        assert 0.7 * np.sum(whole**2) < np.sum(left**2) < np.sum(whole**2)


@pytest.mark.parametrize("align", ["se3", "sim3"])
def test_alignment_is_optimal(align: Alignment) -> None:
    """No small rotation, translation or scale of the result reduces the error."""
    (times, found), (_, right) = motion(2, 0.1), motion()
    result = compare_trajectories(times, found, times, right, align=align)
    best = np.sum(result.position**2)
    rng = np.random.default_rng(0)
    for _ in range(200):
        turn, shift, scale = Rotation.from_rotvec(0.01 * rng.normal(size=3)), 0.01 * rng.normal(size=3), 1.0
        if align == "sim3":
            scale += 0.01 * rng.normal()
        other = scale * turn.apply(result.estimate.translation) + shift
        assert np.sum((other - right.translation) ** 2) > best - 1e-12


def test_pairs_in_time() -> None:
    ours, theirs = associate_timestamps(np.array([0.0, 0.11, 0.2, 0.9]), np.array([0.0, 0.1, 0.2, 0.3, 1.0]))
    assert (ours.tolist(), theirs.tolist()) == ([0, 1, 2], [0, 1, 2])
    ours, theirs = associate_timestamps(np.array([0.9]), np.array([0.0, 1.0]), max_time_diff=0.2)
    assert (ours.tolist(), theirs.tolist()) == ([0], [1])
    ours, theirs = associate_timestamps(np.linspace(0, 1, 121), np.linspace(0, 1, 31))  # four times as often
    assert ours.tolist() == list(range(0, 121, 4))
    assert associate_timestamps(np.empty(0), np.array([0.0, 1.0]))[0].size == 0


LINE = RigidTransform.from_translation(np.outer(np.arange(N), [1.0, 2.0, 3.0]))


@pytest.mark.parametrize(
    ("align", "step", "poses", "message"),
    [
        ("se2", 1, motion()[1], "align must be one of first, none, se3, sim3, both, got 'se2'"),
        ("first", 0, motion()[1], "step must be at least 1"),
        ("first", N, motion()[1], "30 of 30 poses have a corresponding pose at their time; 31 are needed"),
        (
            "se3",
            1,
            LINE,
            "these are on a line or at one point, which leaves the rotation undetermined; use first or none",
        ),
        ("both", 1, LINE, "both needs rotations about several axes, but these are about one or none"),
    ],
)
def test_invalid_comparisons_are_rejected(align: Alignment, step: int, poses: RigidTransform, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        compare_trajectories(motion()[0], poses, *motion(), align=align, step=step)


def test_times_must_increase_and_overlap() -> None:
    with pytest.raises(ValueError, match="max_time_diff must be a number of seconds, got nan"):
        associate_timestamps(np.arange(3.0), np.arange(3.0), max_time_diff=float("nan"))
    times, poses = motion()
    with pytest.raises(ValueError, match="times must increase"):
        compare_trajectories(times[::-1], poses, times, poses)
    with pytest.raises(ValueError, match="0 of 30 poses have a corresponding pose"):
        compare_trajectories(times + 100, poses, times, poses)


def test_compare_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert get_args(Alignment) == compare.ALIGNMENTS
    (times, found), (_, right) = motion(1, 0.01), motion()
    write_tum(tmp_path / "a.tum", times, found, "m")
    write_tum(tmp_path / "b.tum", times, right, "m")
    command = ["compare", str(tmp_path / "a.tum"), str(tmp_path / "b.tum"), "--out", str(tmp_path / "out")]
    assert main([*command, "--align", "se3", "--step", "2"]) == 0
    text = capsys.readouterr().out
    assert "30 of 30 poses, aligned by se3" in text
    assert "2-pose rotation" in text
    numbers = json.loads((tmp_path / "out" / "compare.json").read_text())
    result = compare_trajectories(times, found, times, right, align="se3", step=2)
    assert numbers["absolute"]["position"]["rmse"] == pytest.approx(
        float(np.sqrt(np.mean(result.position**2))), rel=1e-6
    )
    assert len(numbers["relative"]["rotation_deg_of_each"]) == N - 2
    assert cv2.imread(str(tmp_path / "out" / "compare.png")) is not None
    (tmp_path / "a.tum").write_text("# nothing\n")
    assert main(command) == 2
    assert "a.tum: contains no pose" in capsys.readouterr().err


def test_different_worlds_units_and_calibrations_are_reported(tmp_path: Path) -> None:
    def run(name: str, world: str | None, digest: str) -> Path:
        (tmp_path / name).mkdir()
        reported = "" if world is None else f'world = "{world}"\n'
        (tmp_path / name / "settings.toml").write_text(f'[options]\n{reported}[checksums]\ncalibration = "{digest}"\n')
        return tmp_path / name

    plain, up, other = run("plain", None, "a"), run("up", "up=-y", "b"), run("other", None, "c")
    again = run("again", "up=-y", "b")
    for align in get_args(Alignment):
        assert describe_mismatches(up, again, "m", "m", align) == []
        text = describe_mismatches(plain, up, "m", "m", align)
        assert len(text) == (align != "both")
        assert all("different worlds (its calibration's; up=-y): --align both" in sentence for sentence in text)
        assert len(describe_mismatches(plain, other, "m", "m", align)) == (align != "both")
        assert len(describe_mismatches(plain, plain, "m", "", align)) == (align != "sim3")
    assert describe_mismatches(plain / "a.tum", up, "", "", "first") == []
    assert describe_mismatches(plain / "a.csv", up / "b.csv", "m", "mm", "first") != []
    assert describe_mismatches(plain, other, "m", "mm", "first") == []  # same world, and digests include the unit
