"""Errors between trajectories: by formulas written out, invariances, and what cannot be compared."""

from __future__ import annotations

import json
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.app.compare import may_differ
from sylpose.cli import main, results
from sylpose.comparison import Alignment, compared, pairs_in_time, statistics
from sylpose.geometry.arrays import FloatArray
from sylpose.report.files import write_tum

N = 30


def motion(seed: int = 0, noise: float = 0.0) -> tuple[FloatArray, RigidTransform]:
    """A curve in space with turns, and times."""
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
    """Matrix by matrix: absolute and relative errors, turns and shifts (Sturm et al., equations 1 to 4)."""
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
def test_errors_are_those_of_the_formulas(step: int) -> None:
    (times, found), (_, right) = motion(1, 0.05), motion()
    result = compared(times, found, times, right, align="none", step=step)
    errors = (result.rotation, result.position, result.relative_rotation, result.relative_position)
    for ours, theirs in zip(errors, naive(found, right, step), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-7)
    said = statistics(np.array([3.0, 4.0]))
    assert said.pop("rmse") == pytest.approx(12.5**0.5)
    assert said == {"mean": 3.5, "median": 3.5, "std": 0.5, "min": 3.0, "max": 4.0}


def test_another_frame_of_the_object_is_nothing_to_first() -> None:
    times, right = motion()
    same = compared(times, right * any_transform(3), times, right, align="first")
    assert max(same.rotation.max(), same.position.max(), same.relative_position.max()) < 1e-12
    assert compared(times, right * any_transform(3), times, right, align="none").position.min() > 0.1


@pytest.mark.parametrize("align", ["se3", "sim3"])
def test_another_world_is_nothing_to_se3_and_sim3(align: Alignment) -> None:
    times, right = motion()
    moved = any_transform(5) * right
    same = compared(times, moved, times, right, align=align)
    assert max(same.rotation.max(), same.position.max()) < 1e-12
    assert same.scale == pytest.approx(1.0)
    larger = RigidTransform.from_components(2.5 * moved.translation, moved.rotation)
    scaled = compared(times, larger, times, right, align=align)
    if align == "sim3":
        assert scaled.position.max() < 1e-12
        assert scaled.scale == pytest.approx(0.4)
    else:
        assert scaled.position.max() > 0.5


def test_another_world_and_frame_are_nothing_to_both() -> None:
    times, right = motion()
    other = any_transform(5) * right * any_transform(6)
    same = compared(times, other, times, right, align="both")
    assert max(same.rotation.max(), same.position.max(), same.relative_position.max()) < 1e-9
    assert compared(times, other, times, right, align="first").rotation.max() > 0.1
    # With noise, what is left is what it is, less the few unknowns.
    _, noisy = motion(3, 0.01)
    plain = compared(times, noisy, times, right, align="none")
    result = compared(times, any_transform(5) * noisy * any_transform(6), times, right, align="both")
    for left, whole in ((result.rotation, plain.rotation), (result.position, plain.position)):
        assert 0.7 * np.sum(whole**2) < np.sum(left**2) < np.sum(whole**2)


@pytest.mark.parametrize("align", ["se3", "sim3"])
def test_the_alignment_is_the_best_one(align: Alignment) -> None:
    """No small turn, shift or scale of it leaves less."""
    (times, found), (_, right) = motion(2, 0.1), motion()
    result = compared(times, found, times, right, align=align)
    best = np.sum(result.position**2)
    rng = np.random.default_rng(0)
    for _ in range(200):
        turn, shift, scale = Rotation.from_rotvec(0.01 * rng.normal(size=3)), 0.01 * rng.normal(size=3), 1.0
        if align == "sim3":
            scale += 0.01 * rng.normal()
        other = scale * turn.apply(result.found.translation) + shift
        assert np.sum((other - right.translation) ** 2) > best - 1e-12


def test_pairs_in_time() -> None:
    ours, theirs = pairs_in_time(np.array([0.0, 0.11, 0.2, 0.9]), np.array([0.0, 0.1, 0.2, 0.3, 1.0]))
    assert (ours.tolist(), theirs.tolist()) == ([0, 1, 2], [0, 1, 2])
    ours, theirs = pairs_in_time(np.array([0.9]), np.array([0.0, 1.0]), within=0.2)
    assert (ours.tolist(), theirs.tolist()) == ([0], [1])
    ours, theirs = pairs_in_time(np.linspace(0, 1, 121), np.linspace(0, 1, 31))  # four times as often
    assert ours.tolist() == list(range(0, 121, 4))
    assert pairs_in_time(np.empty(0), np.array([0.0, 1.0]))[0].size == 0


LINE = RigidTransform.from_translation(np.outer(np.arange(N), [1.0, 2.0, 3.0]))


@pytest.mark.parametrize(
    ("align", "step", "poses", "message"),
    [
        ("se2", 1, motion()[1], "align must be one of first, none, se3, sim3, both, got 'se2'"),
        ("first", 0, motion()[1], "step must be at least 1"),
        ("first", N, motion()[1], "30 of 30 poses have one of the other trajectory at their time; 31 are needed"),
        ("se3", 1, LINE, "these lie on a line or at a place, which leaves a turn open; take first or none"),
        ("both", 1, LINE, "both aligns by turns about several axes, and these are about one, or none"),
    ],
)
def test_what_cannot_be_compared(align: Alignment, step: int, poses: RigidTransform, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        compared(motion()[0], poses, *motion(), align=align, step=step)


def test_times_must_increase_and_meet() -> None:
    with pytest.raises(ValueError, match="within must be a number of seconds, got nan"):
        pairs_in_time(np.arange(3.0), np.arange(3.0), within=float("nan"))
    times, poses = motion()
    with pytest.raises(ValueError, match="times must increase"):
        compared(times[::-1], poses, times, poses)
    with pytest.raises(ValueError, match="0 of 30 poses have one"):
        compared(times + 100, poses, times, poses)


def test_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert get_args(Alignment) == results.ALIGNMENTS
    (times, found), (_, right) = motion(1, 0.01), motion()
    write_tum(tmp_path / "a.tum", times, found, "m")
    write_tum(tmp_path / "b.tum", times, right, "m")
    ask = ["compare", str(tmp_path / "a.tum"), str(tmp_path / "b.tum"), "--out", str(tmp_path / "out")]
    assert main([*ask, "--align", "se3", "--step", "2"]) == 0
    said = capsys.readouterr().out
    assert "30 of 30 poses, aligned by se3" in said
    assert "over 2 poses, turn" in said
    numbers = json.loads((tmp_path / "out" / "compare.json").read_text())
    result = compared(times, found, times, right, align="se3", step=2)
    assert numbers["absolute"]["position"]["rmse"] == pytest.approx(
        float(np.sqrt(np.mean(result.position**2))), rel=1e-6
    )
    assert len(numbers["relative"]["rotation_deg_of_each"]) == N - 2
    assert cv2.imread(str(tmp_path / "out" / "compare.png")) is not None
    (tmp_path / "a.tum").write_text("# nothing\n")
    assert main(ask) == 2
    assert "a.tum: no pose in it" in capsys.readouterr().err


def test_other_worlds_units_and_calibrations_are_said(tmp_path: Path) -> None:
    def run(name: str, world: str | None, digest: str) -> Path:
        (tmp_path / name).mkdir()
        told = "" if world is None else f'world = "{world}"\n'
        (tmp_path / name / "settings.toml").write_text(f'[options]\n{told}[checksums]\ncalibration = "{digest}"\n')
        return tmp_path / name

    plain, up, other = run("plain", None, "a"), run("up", "up=-y", "b"), run("other", None, "c")
    again = run("again", "up=-y", "b")
    for align in get_args(Alignment):
        assert may_differ(up, again, "m", "m", align) == []
        said = may_differ(plain, up, "m", "m", align)
        assert len(said) == (align != "both")
        assert all("different worlds (its calibration's; up=-y): --align both" in sentence for sentence in said)
        assert len(may_differ(plain, other, "m", "m", align)) == (align != "both")
        assert len(may_differ(plain, plain, "m", "", align)) == (align != "sim3")
    assert may_differ(plain / "a.tum", up, "", "", "first") == []
    assert may_differ(plain / "a.csv", up / "b.csv", "m", "mm", "first") != []
    assert may_differ(plain, other, "m", "mm", "first") == []  # told in the same, and digests have the unit in them
