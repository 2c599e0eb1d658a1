"""What surfaces may have done to rotations that ignore depth: covariances that hold, and directions that are not seen."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.moments import PairMoments
from sylpose.results import Status
from sylpose.rig import Rig
from sylpose.simulate import Body, arc, box, dome, ellipsoid, plane, random_motion, ring, simulate_matches
from sylpose.sylvester import depth_bias
from sylpose.sylvester.centralized import CentralizedSolution, solve_centralized
from sylpose.sylvester.one_camera import solve_one_camera
from sylpose.sylvester.orthographic import views_of
from tests.scenes import around


class Judged(NamedTuple):
    """A solution, its error in degrees, the squared error in units of its covariance, and of noise alone."""

    solution: CentralizedSolution
    degrees: float
    nees: float
    by_noise: float


def judged(solution: CentralizedSolution, truth: FloatArray) -> Judged:
    w = Rotation.from_matrix(truth @ solution.rotation.T).as_rotvec()
    of_noise = w @ solution.noise_information @ w
    return Judged(solution, float(np.degrees(np.linalg.norm(w))), float(w @ solution.information @ w), float(of_noise))


def modelled(seed: int, lean: float, turn_deg: float = 8.0, n: int = 8) -> Judged:
    """Orthographic cameras that see what is assumed: planes that lean by chance, in part by the body's shape."""
    rng = np.random.default_rng(seed)
    cameras, moments = np.asarray(Rotation.random(n, rng=rng).as_matrix()), []
    truth = random_motion(turn_deg, 0.0, rng).rotation.as_matrix()
    shape = rng.standard_normal((3, 3))
    for q in cameras:
        x = 0.05 * rng.standard_normal((60, 2))
        common = -q[:2] @ (shape + shape.T) @ q[2] / 2
        slopes = lean * (depth_bias.OWN * rng.standard_normal(2) + depth_bias.SHAPE * common)
        points = np.column_stack([x, x @ slopes + 0.01 * rng.standard_normal(60)])
        y = np.exp(depth_bias.LOG_SCALE * rng.standard_normal()) * (points @ (q @ truth @ q.T).T)[:, :2]
        moments.append(PairMoments.from_matches(*(p + 3e-4 * rng.standard_normal(p.shape) for p in (x, y))))
    return judged(solve_centralized(cameras, moments, aim=False), truth)


def seen(rig: Rig, body: Body, turn_deg: float, seeds: range) -> Iterator[Judged]:
    """A body of any orientation that turns about any axis, through perspective lenses, with noise."""
    rotations = np.array([camera.rotation for camera in rig])
    for seed in seeds:
        rng = np.random.default_rng(seed)
        motion, start = random_motion(turn_deg, 0.02, rng), RigidTransform.from_rotation(Rotation.random(rng=rng))
        matches = simulate_matches(rig, body, motion, rng=rng, start=start).matches
        moments = [PairMoments.from_matches(m.x, m.y) for m in matches]
        yield judged(solve_centralized(rotations, moments), motion.rotation.as_matrix())


@pytest.mark.parametrize("lean", [0.25, 0.5, 1.0])
def test_where_surfaces_lean_as_assumed_errors_are_what_the_covariance_says(lean: float) -> None:
    """3 in the mean is right, 2.4 in the median: where slopes are 1, the bias is not linear in them. Noise alone would be
    tens to hundreds of times too sure."""
    found = [modelled(seed, lean) for seed in range(150)]
    assert 1.4 < np.median([f.nees for f in found]) < 3.0
    assert 2.0 < np.mean([f.nees for f in found]) < 6.0
    assert np.mean([f.by_noise for f in found]) > 15.0


def test_where_depth_is_uncorrelated_no_more_is_said_than_noise_and_chance_leave_open() -> None:
    """The paper's model: the data tell that nothing leans."""
    found = [modelled(seed, 0.0) for seed in range(150)]
    assert 0.3 < np.mean([f.nees for f in found]) < 3.5
    said = [np.trace(f.solution.covariance) / np.trace(np.linalg.inv(f.solution.noise_information)) for f in found]
    assert np.median(said) < 4.0
    assert {f.solution.status for f in found} == {Status.OK}


BODIES = {"ellipsoid": ellipsoid((0.15, 0.12, 0.1)), "box": box(), "board": plane()}
QUICK = (("ellipsoid", 1.0), ("box", 5.0), ("board", 20.0))


@pytest.mark.parametrize(
    ("body", "turn"),
    [
        pytest.param(body, turn, marks=() if (body, turn) in QUICK else pytest.mark.slow)
        for body in BODIES
        for turn in (1.0, 5.0, 20.0)
    ],
)
def test_errors_on_surfaces_are_what_the_covariance_says(body: str, turn: float) -> None:
    found = list(seen(around(5), BODIES[body], turn, range(30)))
    assert 1.0 < np.mean([f.nees for f in found]) < 6.0
    assert max(f.nees for f in found) < 30.0
    if turn > 1.0:
        assert np.mean([f.by_noise for f in found]) > 12.0


@pytest.mark.parametrize("rig", [ring(4), ring(8), arc(4, 38.0), arc(2, 60.0)])
def test_cameras_in_one_plane_never_pretend_to_see_the_turn_about_its_normal(rig: Rig) -> None:
    """Their errors are as large as the turn itself, certified or not."""
    for body in BODIES.values():
        found = list(seen(rig, body, 6.0, range(12)))
        assert max(f.degrees for f in found) > 3.0
        assert any(f.solution.certified for f in found) or len(rig) == 2
        for f in found:
            assert f.solution.status is Status.TURN_NOT_OBSERVABLE or f.nees < 12.0
        vertical = [np.abs(f.solution.unseen[:, 1]).max(initial=0.0) for f in found]
        assert np.median(vertical) > 0.9


def test_good_rigs_see_all_of_the_turn() -> None:
    for rig in (around(8), dome(6)):
        found = list(seen(rig, BODIES["ellipsoid"], 5.0, range(20)))
        assert {f.solution.status for f in found} == {Status.OK}
        # The covariance is not wide for the sake of it.
        sd = [np.degrees(np.sqrt(np.linalg.eigvalsh(f.solution.covariance)[-1])) for f in found]
        assert np.median(sd) < 1.2


def test_two_cameras_never_say_that_all_is_seen() -> None:
    """Of a board between two that look at each other an answer was 160 degrees off, and certified."""
    found = [f for body in BODIES.values() for f in seen(ring(2), body, 6.0, range(20))]
    assert {f.solution.status for f in found} == {Status.TURN_NOT_OBSERVABLE}
    assert min(len(f.solution.unseen) for f in found) == 1
    assert any(f.solution.certified for f in found)


def test_one_camera_does_not_see_turns_out_of_its_image() -> None:
    """Both of its answers may be far off."""
    for f in seen(around(1), BODIES["ellipsoid"], 5.0, range(10)):
        assert f.solution.status is Status.TURN_NOT_OBSERVABLE
        assert len(f.solution.unseen) == 2


def test_the_bias_is_linear_in_slopes_as_said() -> None:
    """A naive twin: exact affine images with known small slopes, solved, against the derivative."""
    rng = np.random.default_rng(3)
    cameras = np.asarray(Rotation.random(4, rng=rng).as_matrix())
    truth = Rotation.from_rotvec([0.2, -0.1, 0.15]).as_matrix()
    slopes, x = 1e-4 * rng.standard_normal((4, 2)), rng.standard_normal((4, 20, 2)) @ np.diag([1.0, 0.5])
    moments = []
    for q, a, points in zip(cameras, slopes, x, strict=True):
        seen_from = (q @ truth @ q.T)[:2]
        moments.append(PairMoments.from_matches(points, np.column_stack([points, points @ a]) @ seen_from.T))
    found = solve_centralized(cameras, moments, aim=False).rotation
    views = views_of(cameras, moments, aim=False)
    maps = depth_bias._maps(views, truth)
    of_axes = np.einsum("cji,cj->ci", np.linalg.eigh(views.s_xx)[1], slopes)
    moved = np.zeros((4, 4))  # both sides in the same units
    moved[:, :2] = maps.by_slopes * of_axes
    B = np.einsum("cik,cil->kl", maps.by_turn, maps.by_turn)
    expected = np.linalg.solve(B, np.einsum("cik,ci->k", maps.by_turn, moved))
    w = Rotation.from_matrix(found @ truth.T).as_rotvec()
    np.testing.assert_allclose(w, expected, atol=0.01 * float(np.linalg.norm(expected)))
    assert np.linalg.norm(expected) > 1e-6


def test_it_turns_with_the_world_and_is_the_same_for_both_of_one_cameras_answers() -> None:
    rng = np.random.default_rng(5)
    q, new = (np.asarray(Rotation.random(rng=rng).as_matrix()) for _ in range(2))
    x = 0.05 * rng.standard_normal((30, 2))
    y = x @ np.array([[0.98, 0.1], [-0.1, 0.9]]) + 1e-3 * rng.standard_normal((30, 2))
    moments = PairMoments.from_matches(x, y)
    here, there = solve_one_camera(q, moments), solve_one_camera(q @ new.T, moments)
    scale = np.abs(here.information).max()
    np.testing.assert_allclose(there.information, new @ here.information @ new.T, atol=1e-8 * scale)
    of_one, of_other = np.linalg.eigvalsh(here.information)
    np.testing.assert_allclose(of_one, of_other, rtol=1e-6, atol=1e-9 * scale)
