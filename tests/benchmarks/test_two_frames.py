"""Two-frame benchmark: command, scenes, bounds, regressions, and solvers that hang."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks import two_frames
from benchmarks.two_frames_bound import compute_bounds, sample_errors
from benchmarks.two_frames_report import (
    FAILED_DEG,
    Figures,
    Results,
    SolverResult,
    compute_figures,
    find_misses,
    find_regressions,
    find_slow_rows,
    load,
    save,
    select_fastest,
)
from benchmarks.two_frames_scenes import ROWS, Row, Scene, make_scene
from benchmarks.two_frames_solvers import Options, Prepare, Worker
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Camera
from tests.paths import REPOSITORY

SCRIPT = REPOSITORY / "benchmarks" / "two_frames.py"
BASE = ROWS[0]


Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Return a function that runs the benchmark in this process and returns its exit code, output and errors."""

    def command(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", [str(SCRIPT), *map(str, arguments)])
        try:
            code = two_frames.main()
        except SystemExit as ended:
            code = int(ended.code or 0)
        return code, *capsys.readouterr()

    return command


@pytest.fixture(scope="module")
def results_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run one scene of the base rows of both problems without peers."""
    path = tmp_path_factory.mktemp("benchmark") / "results.json"
    arguments = ["--rows", "*ring of 4*", "--scenes", "1", "--no-peers", "--out", str(path), "--table", "markdown"]
    done = subprocess.run(
        [sys.executable, str(SCRIPT), *arguments], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    assert f"| {BASE.name}" in done.stdout
    return path


def test_one_scene_of_sylpose(results_file: Path) -> None:
    results = load(results_file)
    assert [r.name for r in results.rows] == [BASE.name, "pose: ring of 4, 60 points"]
    for r in results.rows:
        assert len(r.deg) == len(r.mm) == 1
        assert r.deg[0] < 10 * r.bound_depth_unknown.deg[0]
        assert r.ours.ms > 0
        assert not r.peers


def test_saved_results_load_the_same(results_file: Path, tmp_path: Path) -> None:
    save(load(results_file), tmp_path / "again.json")
    assert (tmp_path / "again.json").read_text() == results_file.read_text()


def test_invalid_baseline_is_rejected(run: Run, tmp_path: Path) -> None:
    (tmp_path / "other.json").write_text("{}")
    for name in ("other.json", "missing.json"):
        code, _, errors = run("--no-peers", "--compare", tmp_path / name)
        assert code == 2
        assert f"{name}: not a file of results" in errors


def test_unknown_rows_are_rejected(run: Run) -> None:
    code, _, errors = run("--no-peers", "--rows", "no such row")
    assert code == 2
    assert "no row matches 'no such row'" in errors


@pytest.mark.slow
def test_regression_exits_with_1(run: Run, results_file: Path, tmp_path: Path) -> None:
    results = load(results_file)
    better = [replace(r, deg=[0.5 * v for v in r.deg], loop_ms=r.loop_ms / 10) for r in results.rows[:1]]
    save(replace(results, rows=better), tmp_path / "baseline.json")
    code, output, errors = run(
        "--rows", BASE.name, "--scenes", 1, "--no-peers", "--compare", tmp_path / "baseline.json"
    )
    assert code == 1, errors
    assert f"- {BASE.name}: median deg" in output


def test_regressions(results_file: Path) -> None:
    old = load(results_file)
    first = old.rows[0]

    def now(**changes: object) -> Results:
        return replace(old, rows=[replace(first, **changes)])  # type: ignore[arg-type]

    assert not list(find_regressions(old, old))
    assert not list(find_regressions(now(mm=[1.05 * first.mm[0]]), old))
    assert list(find_regressions(now(mm=[1.2 * first.mm[0]]), old))
    assert "without a pose" in list(find_regressions(now(deg=[FAILED_DEG]), old))[-1]
    assert "time" in next(find_regressions(now(ours=replace(first.ours, ms=2 * first.ours.ms)), old))
    # A slower machine is not a slower solver.
    assert not list(
        find_regressions(now(ours=replace(first.ours, ms=2 * first.ours.ms), loop_ms=2 * first.loop_ms), old)
    )


def test_targets(results_file: Path) -> None:
    """Missed targets are errors beyond a tie, a gain below a required 1.5, and a slow first call."""
    results = load(results_file)
    ours = results.rows[0]
    figures = compute_figures(ours.deg, ours.mm)

    def missed(row: Row, factor: float) -> str:
        peer = Figures(*((a * factor, b * factor, c * factor) for a, b, c in figures))
        tried = SolverResult("", 1, peer, 1.0, {})
        result = replace(ours, name=row.name, peers={"poselib": [tried]})
        now = replace(results, rows=[result], first_call_s=0.5)
        return "\n".join([*find_misses(now, by_chance=True), *find_misses(now, by_chance=False), *find_slow_rows(now)])

    small_turn = next(row for row in ROWS if row.name == "turn 1")
    assert missed(BASE, 0.97) == ""
    assert missed(BASE, 0.8).count("smaller") == 4
    assert missed(small_turn, 1.6) == ""
    assert missed(small_turn, 1.4).count("wanted x1.5") == 4
    assert list(find_slow_rows(replace(results, first_call_s=1.5)))


def test_peer_is_judged_at_its_fastest_setting_that_is_as_accurate(results_file: Path) -> None:
    row = load(results_file).rows[0]

    def setting(options: str, factor: float, ms: float, spread: float = 1.1) -> SolverResult:
        """Errors `factor` times as large as sylpose's, with a bootstrap interval of the ratio of this spread."""
        figures = Figures(*((a * factor, b * factor, c * factor) for a, b, c in row.ours.figures))
        lower = Figures(*(((1 / factor / spread,) * 3,) * 2))
        return SolverResult(options, 1, figures, ms, {}, lower)

    quick, equal, exact = setting("quick", 2.0, 1.0), setting("equal", 1.05, 5.0), setting("exact", 0.5, 50.0)
    # A peer's time does not count the effort of being more accurate than sylpose.
    assert select_fastest(row, [exact, quick, equal]) == (equal, True)
    assert select_fastest(row, [exact, quick]) == (exact, True)
    # A difference that other scenes may undo is no difference.
    assert select_fastest(row, [exact, setting("noisy", 2.0, 1.0, spread=3.0)])[0].options == "noisy"
    # If no set is as accurate as sylpose, the fastest of the peer's best ones counts.
    assert select_fastest(row, [quick, setting("slow", 1.96, 9.0)]) == (quick, False)


@pytest.mark.parametrize("row", [r for r in ROWS if r.cameras <= 16 and r.matches <= 60], ids=lambda r: r.name)
def test_scenes_match_the_row(row: Row) -> None:
    """Points agree with the truth within the noise, the outlier count is as required, and scenes are reproducible."""
    scene = make_scene(row, 0)
    again = make_scene(row, 0)
    assert all(np.array_equal(a, b) for a, b in zip(scene.after, again.after, strict=True))
    assert len(scene.rig) == row.cameras
    for c, (camera, y, points) in enumerate(zip(scene.rig, scene.after, scene.points, strict=True)):
        true = np.isfinite(points).all(axis=1)
        off = (row.has_junk_camera or row.calibration_error_deg > 0) and c == 1
        assert len(y) <= row.matches
        if row.outlier_kind != "second_motion":  # whose copy may be outside the image
            assert true.sum() == (0 if off else len(y) - round(row.outliers * len(y)))
        error = y[true] - camera.project(scene.truth.apply(points[true]))
        if true.any():
            # The noise of frame i changes the points' direction and propagates to frame j.
            assert np.abs(error).max() < 6 * row.noise * (1.0 if row.problem == "pose" else 2.0)


def numerical_bound(scene: Scene, depth_known: bool) -> FloatArray:
    """Return the covariance (6, 6) from all observations, point positions eliminated, by finite differences."""
    center, information, step = scene.truth.apply(scene.center), np.zeros((6, 6)), 1e-5
    places = 0 if scene.problem == "pose" else 2 if depth_known else 3
    for camera, points in zip(scene.rig, scene.points, strict=True):
        for point in points[np.isfinite(points).all(axis=1)]:

            def observed(change: FloatArray, camera: Camera = camera, point: FloatArray = point) -> FloatArray:
                turn = Rotation.from_rotvec(change[:3])
                motion = RigidTransform.from_components(center + change[3:6] - turn.apply(center), turn) * scene.truth
                if scene.problem == "pose":
                    return np.asarray(camera.project(motion.apply(point))[0])
                x, y, z = camera.camera_from_world.apply(point)
                ray = np.array([x / z + change[6], y / z + change[7], 1.0])
                point = camera.camera_from_world.inv().apply(z * (1 + change[8]) * ray)
                return np.concatenate([camera.project(point)[0], camera.project(motion.apply(point))[0]])

            jacobian = np.column_stack(
                [(observed(step * e) - observed(-step * e)) / (2 * step) for e in np.eye(9)[: 6 + places]]
            )
            of_motion, of_place = jacobian[:, :6], jacobian[:, 6:]
            rest = np.eye(len(jacobian)) - of_place @ np.linalg.pinv(of_place)
            information += of_motion.T @ rest @ of_motion / scene.noise**2
    return np.asarray(np.linalg.inv(information))


@pytest.mark.parametrize("name", [pytest.param("20 matches", marks=pytest.mark.slow), "pose: 16 cameras x 2 points"])
def test_bound_equals_the_numerical_bound(name: str) -> None:
    scene = make_scene(next(row for row in ROWS if row.name == name), 0)
    for bound, depth_known in zip(compute_bounds(scene), (False, True), strict=True):
        expected = numerical_bound(scene, depth_known)
        sigma = np.sqrt(np.diag(expected))
        np.testing.assert_allclose(bound / np.outer(sigma, sigma), expected / np.outer(sigma, sigma), atol=1e-4)


def test_unknown_depth_increases_the_bound() -> None:
    unknown, known = compute_bounds(make_scene(BASE, 0))
    assert np.linalg.eigvalsh(unknown - known).min() > -1e-9 * np.abs(unknown).max()
    deg, mm = sample_errors([known])
    assert np.sqrt(np.mean(np.deg2rad(deg) ** 2)) == pytest.approx(np.sqrt(np.trace(known[:3, :3])), rel=0.15)
    assert np.sqrt(np.mean((1e-3 * mm) ** 2)) == pytest.approx(np.sqrt(np.trace(known[3:, 3:])), rel=0.15)


def load_fake() -> Prepare:
    """Load a solver that hangs in native code with the interpreter lock, dies, raises, or answers."""

    def prepare(scene: Scene, options: Options) -> Callable[[], RigidTransform | None]:
        def call() -> RigidTransform | None:
            if options.get("hang"):
                sum(range(10**15))
            if options.get("die"):
                os.abort()
            if options.get("raise"):
                raise ValueError("no")
            return None if options.get("none") else scene.truth

        return call

    return prepare


@pytest.mark.slow
def test_hanging_or_dying_solver_is_replaced() -> None:
    scene = make_scene(BASE, 0)
    with Worker(load_fake, limit_s=3.0) as worker:
        worker.start()
        process = worker._process
        assert process is not None
        start = time.perf_counter()
        assert worker.solve(scene, {"hang": True}).failure == "hang"
        assert time.perf_counter() - start < 60
        assert not worker.is_alive
        assert process.exitcode == -signal.SIGKILL
        answer = worker.solve(scene, {})
        assert answer.pose is not None
        assert scene.compute_error(answer.pose) == pytest.approx((0, 0), abs=1e-6)
        assert worker.solve(scene, {"die": True}).failure == "crash"
        assert worker.solve(scene, {"raise": True}).failure == "ValueError: no"
        assert worker.solve(scene, {"none": True}).failure == "no pose"
    assert not worker.is_alive
