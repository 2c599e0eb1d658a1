"""Problems of the studies: simulated matches of a rotating body with ground truth, and estimators of its rotation.

Defaults: bodies of about 0.15 m radius, cameras 1.5 m away, f = 1000 px, 60 matches per camera, noise of 0.5 px in each
frame, and a rotation by 5 degrees about any axis. The error of an estimate is the angle to the true rotation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.moments import PairMoments
from sylpose.rig import Rig, make_look_at_camera
from sylpose.simulate import Body, box, cloud, ellipsoid, plane, random_motion, ring, simulate_matches
from sylpose.sylvester.camera_faults import RobustSolution, solve_robust
from sylpose.sylvester.centralized import solve_centralized
from sylpose.sylvester.depth_plane import solve_depth_plane
from sylpose.sylvester.one_camera import OneCameraSolution, solve_one_camera, solve_unconstrained
from sylpose.sylvester.orthographic import build_cost, compute_views

# Defaults of the studies: pixels, matches per camera, degrees, meters (choice: docs/paper.md).
NOISE_PX, MATCHES, ANGLE_DEG, TRANSLATION = 0.5, 60, 5.0, 0.02
# Points on a body's surface; each camera samples from its visible ones (choice).
POINTS = 1000


class Problem(NamedTuple):
    """Input of an estimator, with the true rotation.

    Attributes:
        rotations: (C, 3, 3) Q of camera_from_world.
        moments: C pair moments.
        aim: as in `compute_views`: False for exactly orthographic views.
        truth: (3, 3) R of the motion, world frame.
        faulty: indices of the faulty cameras.
    """

    rotations: FloatArray
    moments: tuple[PairMoments, ...]
    aim: bool
    truth: FloatArray
    faulty: tuple[int, ...] = ()

    def with_faulty(self, cameras: Sequence[int], other: Problem) -> Problem:
        """Return a copy in which some cameras, marked as faulty, have the data of another problem."""
        chosen = [(other if c in cameras else self).moments[c] for c in range(len(self.moments))]
        rotations = [(other if c in cameras else self).rotations[c] for c in range(len(self.moments))]
        return self._replace(rotations=np.array(rotations), moments=tuple(chosen), faulty=tuple(cameras))

    def subset(self, cameras: Sequence[int]) -> Problem:
        """Return the problem of a subset of the cameras."""
        return Problem(self.rotations[list(cameras)], tuple(self.moments[c] for c in cameras), self.aim, self.truth)


class Scene(NamedTuple):
    """Body and projection of a study. `body` builds it from a number of points and a seed."""

    name: str
    body: Callable[[int, int], Body]
    orthographic: bool


def balanced_cloud(n: int, seed: int) -> Body:
    """Sample `n` points, visible from all sides, with Σ X = 0 and Σ XX' a multiple of the identity.

    In a complete orthographic view depth is then uncorrelated with the image in every camera, as the paper's model
    requires.

    Raises:
        ValueError: there are fewer than four points.
    """
    if n < 4:
        raise ValueError(f"a balanced cloud needs at least 4 points, got {n}")
    points = cloud(n=n, seed=seed).points
    points = points - points.mean(axis=0)
    u, _, vt = np.linalg.svd(points, full_matrices=False)
    # The spread of a uniformly filled ball of 0.15 m.
    return Body(0.15 * np.sqrt(n / 5) * u @ vt, np.zeros((n, 3)))


BALANCED = Scene("orthographic, depth exactly uncorrelated", balanced_cloud, True)
CLOUD = Scene("orthographic, depth uncorrelated on average", lambda _, seed: cloud(n=POINTS, seed=seed), True)
SURFACE = Scene(
    "orthographic, visible surface", lambda _, seed: ellipsoid((0.15, 0.12, 0.1), n=POINTS, seed=seed), True
)
PRACTICE = Scene(
    "perspective, visible surface", lambda _, seed: ellipsoid((0.15, 0.12, 0.1), n=POINTS, seed=seed), False
)
# A balanced cloud stretched along the world's x axis: still uncorrelated in cameras along the world's axes.
STRETCHED = Scene(
    "orthographic, uncorrelated, stretched 10 : 3 : 3", lambda n, seed: _stretch(balanced_cloud(n, seed)), True
)
BODIES = (
    PRACTICE._replace(name="ellipsoid"),
    Scene("box", lambda _, seed: box(n=POINTS, seed=seed), False),
    Scene("board", lambda _, seed: plane(n=POINTS, seed=seed), False),
)


def _stretch(body: Body) -> Body:
    return Body(body.points * [1.0, 0.3, 0.3], body.normals)


@cache
def right_angle_rig() -> Rig:
    """Build a rig of three cameras along the world's axes."""
    centers = 1.5 * np.array([[0, 0, -1], [1, 0, 0], [0, -1, 0]])
    return Rig(
        [make_look_at_camera(f"cam_{k}", o, np.zeros(3), 1000.0, (1280, 960)) for k, o in enumerate(centers)], "m"
    )


@cache
def around_rig(n: int) -> Rig:
    """Build a rig of `n` cameras around the body, alternately 0.4 m above and below it."""
    return ring(n, height=[0.4 * (-1) ** k for k in range(n)])


def simulate(
    scene: Scene,
    rng: np.random.Generator,
    rig: Rig,
    *,
    angle_deg: float = ANGLE_DEG,
    axis: Sequence[float] | None = None,
    matches: int = MATCHES,
    noise_px: float = NOISE_PX,
    occlusion: float = 0.0,
    static: bool = False,
    aligned: bool = False,
    junk: Sequence[int] = (),
) -> Problem:
    """Simulate the cameras' input for a rotation by `angle_deg` and a translation by 20 mm.

    Given `rng`'s state, body, start and motion do not depend on the other arguments, and a camera's matches do not
    depend on the other cameras, so that two problems can be combined by `Problem.with_faulty`.

    Args:
        scene: body and projection.
        rng: random generator.
        rig: the cameras.
        angle_deg: rotation angle, degrees.
        axis: (3,) rotation axis; None: random.
        matches: number of matches per camera.
        noise_px: standard deviation of the noise, pixels.
        occlusion: share of the features occluded in each camera, on one side of a line across its image; reduces the
            number of matches.
        static: the body is static, so that all cameras have the same frame twice.
        aligned: the body starts with its axes along the world's instead of a random orientation.
        junk: cameras with wrong matches only.
    """
    body_seed, key = (int(k) for k in rng.integers(2**31, size=2))
    start = random_motion(rng.uniform(0, 180), 0.0, rng)
    motion = random_motion(angle_deg, TRANSLATION, rng, axis)
    pair = simulate_matches(
        rig,
        scene.body(matches, body_seed),
        RigidTransform.identity() if static else motion,
        rng=np.random.default_rng(key),
        per_camera=round(matches * (1 - occlusion)),
        noise_px=noise_px,
        occlusion=occlusion if occlusion < 1 else 0.0,
        junk=[rig.names[c] for c in junk],
        start=RigidTransform.identity() if aligned else start,
        orthographic=scene.orthographic,
    )
    return Problem(
        rotations=np.array([camera.rotation for camera in rig]),
        moments=tuple(PairMoments.from_matches(m.x, m.y) for m in pair.matches),
        aim=not scene.orthographic,
        truth=motion.rotation.as_matrix(),
    )


class Estimate(NamedTuple):
    """Result of an estimator.

    Attributes:
        rotations: (k, 3, 3) equivalent rotations: usually one, two mirrored ones for a single camera, none without a
            result.
        certified: whether it is proved to be the global optimum; None if the estimator computes no certificate.
    """

    rotations: FloatArray
    certified: bool | None = None


Estimator = Callable[[Problem], Estimate]
NO_ROTATION = np.empty((0, 3, 3))


def angle_deg(a: FloatArray, b: FloatArray) -> float:
    """Return the angle between two rotation matrices, degrees."""
    return float(np.degrees(Rotation.from_matrix(a @ b.T).magnitude()))


def error_deg(estimate: Estimate, truth: FloatArray) -> float:
    """Return the angle between estimate and truth, degrees: the smallest of mirrored results; NaN without a result."""
    return min((angle_deg(r, truth) for r in estimate.rotations), default=np.nan)


def estimate_centralized(problem: Problem) -> Estimate:
    """Run the paper's estimator for all cameras jointly."""
    solution = solve_centralized(problem.rotations, problem.moments, aim=problem.aim)
    return Estimate(solution.rotation[None], solution.certified)


def estimate_unconstrained(problem: Problem) -> Estimate:
    """Solve least squares of all cameras for any 3x3 matrix, then project to the nearest rotation."""
    q = build_cost(compute_views(problem.rotations, problem.moments, aim=problem.aim))
    u, _, vt = np.linalg.svd(np.linalg.lstsq(q.H, q.h, rcond=1e-9)[0].reshape(3, 3))
    return Estimate((u * [1, 1, np.linalg.det(u @ vt)] @ vt)[None])


def estimate_one_camera(problem: Problem) -> Estimate:
    """Run the paper's estimator for the first camera alone: two mirrored results."""
    return _finite_rotations(solve_one_camera(problem.rotations[0], problem.moments[0], aim=problem.aim))


def estimate_other_mirror(problem: Problem) -> Estimate:
    """Return the worse of the first camera's two mirrored results, which it cannot distinguish."""
    rotations = estimate_one_camera(problem).rotations
    return Estimate(np.array(sorted(rotations, key=lambda R: angle_deg(R, problem.truth))[1:]))


def estimate_mean_of_single(problem: Problem) -> Estimate:
    """Return the mean of all single-camera results."""
    rotations = [estimate_one_camera(problem.subset([c])).rotations for c in range(len(problem.moments))]
    return Estimate(Rotation.from_matrix(np.concatenate(rotations)).mean().as_matrix()[None])


def estimate_one_unconstrained(problem: Problem) -> Estimate:
    """Solve unconstrained least squares for the first camera alone, then project: two mirrored results."""
    return _finite_rotations(solve_unconstrained(problem.rotations[0], problem.moments[0], aim=problem.aim))


def _finite_rotations(solution: OneCameraSolution) -> Estimate:
    return Estimate(solution.rotations[np.isfinite(solution.rotations).all(axis=(1, 2))])


def estimate_depth_plane(problem: Problem) -> Estimate:
    """Run the estimator with a local depth plane per camera, for all cameras jointly."""
    solution = solve_depth_plane(problem.rotations, problem.moments, aim=problem.aim)
    return Estimate(solution.rotation[None] if np.isfinite(solution.rotation).all() else NO_ROTATION)


def estimate_without_faulty(problem: Problem) -> Estimate:
    """Run the paper's estimator without the known faulty cameras."""
    return estimate_centralized(problem.subset([c for c in range(len(problem.moments)) if c not in problem.faulty]))


def estimate_robust(problem: Problem) -> Estimate:
    """Run the robust estimator, which detects the faulty cameras."""
    solution = _solve_robust(problem).solution
    return Estimate(NO_ROTATION) if solution is None else Estimate(solution.rotation[None], solution.certified)


def detected_faults(problem: Problem) -> set[int]:
    """Return the cameras that `estimate_robust` detects as faulty."""
    return {c for c, fault in enumerate(_solve_robust(problem).faults) if fault is not None}


def _solve_robust(problem: Problem) -> RobustSolution:
    return solve_robust(problem.rotations, problem.moments, aim=problem.aim)
