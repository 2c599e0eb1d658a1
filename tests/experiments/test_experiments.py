"""Experiments of the paper: files written by the command, reproducibility, and findings of the tables."""

from __future__ import annotations

from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sylpose.commands.main import main
from sylpose.experiments import STUDIES, Study, Table, distributed
from sylpose.experiments.accuracy import (
    ALL_CAMERAS,
    CONSTRAINT,
    CONSTRAINT_ESTIMATORS,
    DEPTH_PLANE,
    FAULT_KINDS,
    SENSORS,
)
from sylpose.experiments.distributed import DISTRIBUTED
from sylpose.experiments.problems import (
    BALANCED,
    BODIES,
    CLOUD,
    PRACTICE,
    STRETCHED,
    SURFACE,
    Estimate,
    Scene,
    angle_deg,
    around_rig,
    balanced_cloud,
    error_deg,
    simulate,
)
from sylpose.experiments.study import compute_error_cells, compute_quartiles
from sylpose.experiments.timing import fit_line
from sylpose.geometry.arrays import FloatArray

TIMES = ("time_cameras", "time_matches")
PNG = b"\x89PNG\r\n\x1a\n"
BY_NAME = {study.name: study for study in STUDIES}


def medians(table: Table, level: str, **equal: str) -> dict[float, float]:
    """Return the median error by level."""
    rows = table.filter_rows(**equal)
    return dict(zip(rows.column_values(level), rows.column_values("median_deg"), strict=True))


@pytest.fixture(autouse=True)
def few_cameras(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limit the number of cameras: sixteen cameras that exchange messages take half of the test time."""
    monkeypatch.setattr(distributed, "CAMERA_COUNTS", (3, 8))


# --- The command ------------------------------------------------------------------------------------------------------


def test_command_writes_table_and_figure_per_study(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "deep" / "results"
    out.mkdir(parents=True)
    kept = {"README.md": "mine", "layout.csv": "mine", "paper_noise.csv": "of an earlier run"}
    for name, words in kept.items():
        (out / name).write_text(words)
    (out / "paper_layout.csv").write_text("of an earlier run")
    assert main(["experiments", "--out", str(out), "--quick", "--only", "time_matches", "--only", "layout"]) == 0
    output = capsys.readouterr().out
    written = {f"paper_{name}.{kind}" for name in ("layout", "time_matches") for kind in ("csv", "png")}
    assert {path.name for path in out.iterdir()} == {*written, *kept, "paper_index.md"}
    assert all(name in output for name in written)
    assert {name: (out / name).read_text() for name in kept} == kept
    lines = (out / "paper_layout.csv").read_text().splitlines()
    assert lines[0] == "scene,method,trials,failed,certified,q25_deg,median_deg,q75_deg"
    assert len(lines) > 10
    index = (out / "paper_index.md").read_text()
    for name in ("layout", "time_matches"):
        assert (out / f"paper_{name}.png").read_bytes().startswith(PNG)
        assert f"paper_{name}.csv" in index
        assert BY_NAME[name].question in output
    # The same seed writes identical files.
    again = tmp_path / "again"
    assert main(["experiments", "--out", str(again), "--quick", "--only", "layout"]) == 0
    for file in ("paper_layout.csv", "paper_layout.png"):
        assert (again / file).read_bytes() == (out / file).read_bytes()


def test_unknown_study_raises(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["experiments", "--out", str(tmp_path / "new"), "--only", "noise", "--only", "nosie"]) == 2
    output = capsys.readouterr().err
    assert len(output.strip().splitlines()) == 1
    assert "no study 'nosie'" in output
    assert all(study.name in output for study in STUDIES)
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("place", ["file", "file/below"])
def test_unwritable_folder_raises(tmp_path: Path, capsys: pytest.CaptureFixture[str], place: str) -> None:
    (tmp_path / "file").write_text("")
    assert main(["experiments", "--out", str(tmp_path / place), "--quick"]) == 2
    output = capsys.readouterr().err
    assert len(output.strip().splitlines()) == 1
    assert str(tmp_path / place) in output


def test_negative_seed_raises(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["experiments", "--out", str(tmp_path), "--seed", "-1"]) == 2
    assert "--seed" in capsys.readouterr().err


def test_interrupted_run_keeps_finished_studies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: int) -> Table:
        raise KeyboardInterrupt

    finished = BY_NAME["layout"]._replace(run=lambda *_: study_table("layout"))
    chosen = [finished, BY_NAME["noise"]._replace(run=interrupted), BY_NAME["turn"]]
    monkeypatch.setattr("sylpose.experiments.STUDIES", chosen)
    assert main(["experiments", "--out", str(tmp_path), "--quick"]) == 130
    assert "after 1 of 3 studies" in capsys.readouterr().err
    assert {path.name for path in tmp_path.iterdir()} == {"paper_layout.csv", "paper_layout.png", "paper_index.md"}
    index = (tmp_path / "paper_index.md").read_text()
    assert "## layout" in index
    assert "## noise" not in index


# --- All studies ------------------------------------------------------------------------------------------------------


@cache
def study_table(name: str) -> Table:
    """Return a study's table of one trial, with the same motion and noise at every level, so that levels are comparable."""
    return BY_NAME[name].run(5, 1)


@pytest.mark.parametrize("study", [s for s in STUDIES if s.name not in TIMES], ids=lambda study: study.name)
def test_study_creates_table_figure_and_findings(study: Study, tmp_path: Path) -> None:
    table = study_table(study.name)
    assert {len(row) for row in table.rows} == {len(table.columns)}
    path = tmp_path / "figure.png"
    study.draw(table, path)
    assert path.read_bytes().startswith(PNG)
    findings = study.summarize(table)
    assert findings
    assert not any("nan" in sentence for sentence in findings)


@pytest.mark.parametrize("name", ["constraint", pytest.param("schemes", marks=pytest.mark.slow)])
def test_study_is_reproducible(name: str) -> None:
    again, other = (BY_NAME[name].run(seed, 1) for seed in (5, 6))
    assert again.to_csv() == study_table(name).to_csv()
    assert other.to_csv() != again.to_csv()


def test_study_names_and_trials() -> None:
    assert len(BY_NAME) == len(STUDIES)
    assert all(study.quick_trials <= study.trials / 2 for study in STUDIES)


# --- Findings of the tables ------------------------------------------------------------------------------------------


def test_error_grows_with_noise() -> None:
    table = study_table("noise")
    exact = medians(table, "noise_px", scene=BALANCED.name, method=ALL_CAMERAS)
    assert exact[0.0] < 1e-6
    values = [exact[noise] for noise in sorted(exact)]
    assert values == sorted(values)
    # To first order the error is proportional to the noise ...
    assert exact[1.0] / exact[0.1] == pytest.approx(10, rel=0.3)
    # ... except for the bias by a visible surface, which remains without noise.
    real = medians(table, "noise_px", scene=PRACTICE.name, method=ALL_CAMERAS)
    assert real[0.0] > 100 * exact[0.0]
    assert real[0.5] < 2 * real[0.0]


def test_error_decreases_with_points_and_cameras() -> None:
    points = medians(study_table("points"), "matches", scene=BALANCED.name, method=ALL_CAMERAS)
    assert points[320] < 0.5 * points[6]
    cameras = medians(study_table("cameras"), "cameras", scene=BALANCED.name, method=ALL_CAMERAS)
    assert cameras[32] < 0.5 * cameras[3]


def test_surface_causes_bias() -> None:
    exact, real = (
        medians(study_table("turn"), "turn_deg", scene=s.name, method=ALL_CAMERAS) for s in (BALANCED, PRACTICE)
    )
    assert max(exact.values()) < 0.5
    assert real[20.0] > 1.0


def test_depth_plane_improves_perspective() -> None:
    for scene in BODIES:
        of = partial(medians, study_table("depth_plane"), "turn_deg", scene=scene.name)
        assert of(method=DEPTH_PLANE)[5.0] < of(method=ALL_CAMERAS)[5.0], scene.name


@pytest.mark.slow
def test_constraint_is_better_than_projection() -> None:
    table = CONSTRAINT.run(4, 10)
    for kind in ("one camera", "all cameras"):
        both = [method for method in CONSTRAINT_ESTIMATORS if method.startswith(kind)]
        adjusted, constrained = (medians(table, "noise_px", scene=STRETCHED.name, method=method) for method in both)
        assert constrained[0.5] < adjusted[0.5], kind


def test_fully_occluded_cameras_equal_no_cameras() -> None:
    for scene in (CLOUD, PRACTICE):
        of = partial(medians, study_table("occlusion"), "hidden_percent", scene=scene.name)
        everyone, others, alone = (
            of(method=method) for method in ("all 8 cameras", "the 4 others only", "an occluded camera alone")
        )
        assert everyone[100] == pytest.approx(others[100], abs=1e-9)
        assert np.isnan(alone[100])
    failed = study_table("occlusion").value(
        "failed", scene=CLOUD.name, method="an occluded camera alone", hidden_percent=100
    )
    assert failed == 1


def test_faulty_cameras_are_detected() -> None:
    for kind in FAULT_KINDS:
        everyone, robust, by_hand = (medians(study_table("sensors"), "bad", scene=kind, method=m) for m in SENSORS)
        assert robust[1] < 2 * by_hand[1], kind
        assert robust[1] < 1.05 * everyone[1], kind
        assert everyone[0] == pytest.approx(by_hand[0])


def test_distributed_equals_centralized() -> None:
    table = study_table("schemes")
    apart = table.column_values("from_centralized_rad")
    assert np.isfinite(apart).sum() == 2 * len(DISTRIBUTED)
    assert np.nanmax(apart) < 1e-8
    for scene in (BALANCED, PRACTICE):
        together = table.value("median_deg", scene=scene.name, method="all cameras, centralized")
        assert together < table.value("median_deg", scene=scene.name, method="one camera, better mirror image")
    rounds = study_table("rounds").filter_rows(scene="around the object", method="8 cameras")
    distance = rounds.column_values("median_rad")
    assert distance[0] > 1e-3
    assert distance[-1] < 1e-8


# --- Scenes, errors, tables, fits -------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [4, 10, 60])
def test_balanced_cloud_has_uncorrelated_depth(n: int) -> None:
    body = balanced_cloud(n, 1)
    assert body.points.shape == (n, 3)
    np.testing.assert_allclose(body.points.sum(axis=0), 0, atol=1e-12)
    scatter = body.points.T @ body.points / n
    np.testing.assert_allclose(scatter, scatter[0, 0] * np.eye(3), atol=1e-12)
    with pytest.raises(ValueError, match="at least 4"):
        balanced_cloud(3, 1)


def test_scenes_differ_only_in_the_arguments() -> None:
    def draw(scene: Scene, **options: Any) -> tuple[FloatArray, list[FloatArray]]:
        problem = simulate(scene, np.random.default_rng(1), around_rig(4), **options)
        return problem.truth, [m.matrix for m in problem.moments]

    for scene in (BALANCED, CLOUD, SURFACE, PRACTICE):
        truth, moments = draw(scene)
        again, other = draw(scene, noise_px=5.0)
        np.testing.assert_array_equal(truth, again)
        assert not np.allclose(moments, other, rtol=1e-3)
        assert all(m[8, 8] == 60 for m in moments)
    assert angle_deg(np.eye(3), draw(BALANCED, angle_deg=12.0)[0]) == pytest.approx(12)
    assert [m[8, 8] for m in draw(PRACTICE, occlusion=0.75)[1]] == [15] * 4
    assert [m[8, 8] for m in draw(PRACTICE, occlusion=1.0)[1]] == [0] * 4


def test_faulty_cameras_have_data_of_the_other_problem() -> None:
    good, other = (simulate(PRACTICE, np.random.default_rng(k), around_rig(4)) for k in (1, 2))
    mixed = good.with_faulty([1, 3], other)
    assert mixed.faulty == (1, 3)
    for c in range(4):
        assert mixed.moments[c] is (other if c in (1, 3) else good).moments[c]
    left = mixed.subset([0, 2])
    assert left.moments == (good.moments[0], good.moments[2])
    np.testing.assert_array_equal(left.rotations, good.rotations[[0, 2]])


def test_error_of_mirrored_and_missing_results() -> None:
    turns = np.array([Rotation.from_rotvec([0, 0, np.deg2rad(a)]).as_matrix() for a in (3, -4)])
    assert error_deg(Estimate(turns), np.eye(3)) == pytest.approx(3)
    assert np.isnan(error_deg(Estimate(turns[:0]), np.eye(3)))
    cells = compute_error_cells([1.0, 2.0, 3.0, np.nan], [True, False, True, True])
    assert cells == (4, 1, 0.75, 1.5, 2.0, 2.5)
    assert compute_error_cells([1.0], [None])[2] is None
    assert all(np.isnan(q) for q in compute_quartiles([np.nan, np.inf]))


def test_table_queries_and_csv() -> None:
    table = Table(("scene", "x", "y"), (("a", 1, 0.1), ("a", 2, 1 / 3), ("b", 1, None), ("c", 1, np.nan)))
    assert table.distinct("scene") == ["a", "b", "c"]
    assert table.value("y", scene="a", x=2) == 1 / 3
    assert np.isnan(table.value("y", scene="b"))
    with pytest.raises(ValueError, match="unpack"):
        table.value("y", scene="a")
    assert table.to_csv() == "scene,x,y\na,1,0.1\na,2,0.333333\nb,1,\nc,1,\n"


def test_line_fit() -> None:
    x = np.array([1, 10, 100, 1000, 10_000])
    fit = fit_line(x, 0.2 + 0.003 * x)
    assert fit.intercept == pytest.approx(0.2)
    assert fit.slope == pytest.approx(0.003)
    assert fit.r2 == pytest.approx(1)
    assert fit.deviation < 1e-9
    np.testing.assert_allclose(fit.evaluate([0, 1]), [0.2, 0.203])
    assert fit_line(x, 0.001 * x**2).deviation > 0.5
