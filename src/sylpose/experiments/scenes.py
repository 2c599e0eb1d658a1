"""The scenes of the studies: what some cameras report of a body that turns, with the truth.

Bodies are about 0.15 m in radius, cameras stand 1.5 m away, f = 1000 px; 60 matches per camera, noise of 0.5 px in
either frame and a turn of 5 degrees about any axis, unless a study says otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import FloatArray
from sylpose.moments import PairMoments
from sylpose.rig import Rig, camera_at
from sylpose.simulate import Body, box, cloud, ellipsoid, plane, random_motion, ring, simulate_matches

__all__ = [
    "BALANCED",
    "BODIES",
    "CLOUD",
    "PRACTICE",
    "STRETCHED",
    "SURFACE",
    "Problem",
    "Scene",
    "around",
    "at_right_angles",
    "balanced_cloud",
    "simulate",
]


# Where no study says otherwise: pixels, per camera, degrees, metres (choice: docs/paper.md).
NOISE_PX, MATCHES, TURN_DEG, SHIFT = 0.5, 60, 5.0, 0.02
# Points of a body's surface; each camera draws its own from those that it sees (choice).
POINTS = 1000


class Problem(NamedTuple):
    """What an estimator gets, and the truth.

    Attributes:
        rotations: (C, 3, 3) Q of camera_from_world.
        moments: C pair moments.
        aim: what `views_of` is to do: False for views that are exactly orthographic.
        truth: (3, 3) R of the motion, world frame.
        bad: the cameras that were made to fail.
    """

    rotations: FloatArray
    moments: tuple[PairMoments, ...]
    aim: bool
    truth: FloatArray
    bad: tuple[int, ...] = ()

    def spoilt(self, cameras: Sequence[int], other: Problem) -> Problem:
        """The same, but some cameras, which are bad then, have what they have in another problem."""
        chosen = [(other if c in cameras else self).moments[c] for c in range(len(self.moments))]
        rotations = [(other if c in cameras else self).rotations[c] for c in range(len(self.moments))]
        return self._replace(rotations=np.array(rotations), moments=tuple(chosen), bad=tuple(cameras))

    def only(self, cameras: Sequence[int]) -> Problem:
        """Of some of the cameras."""
        return Problem(self.rotations[list(cameras)], tuple(self.moments[c] for c in cameras), self.aim, self.truth)


class Scene(NamedTuple):
    """A body and how it is seen. `body` makes it for a number of points, with a seed."""

    name: str
    body: Callable[[int, int], Body]
    orthographic: bool


def balanced_cloud(n: int, seed: int) -> Body:
    """`n` points, each visible from everywhere, with Σ X = 0 and Σ XX' a multiple of the identity: seen whole and
    orthographically, depth is uncorrelated with the image in every camera, which is what the paper's model asks for.

    Raises:
        ValueError: fewer than four points.
    """
    if n < 4:
        raise ValueError(f"a balanced cloud needs at least 4 points, got {n}")
    points = cloud(n=n, seed=seed).points
    points = points - points.mean(axis=0)
    u, _, vt = np.linalg.svd(points, full_matrices=False)
    # As far spread as a ball of 0.15 m evenly filled.
    return Body(0.15 * np.sqrt(n / 5) * u @ vt, np.zeros((n, 3)))


BALANCED = Scene("orthographic, depth exactly uncorrelated", balanced_cloud, True)
CLOUD = Scene("orthographic, depth uncorrelated on average", lambda _, seed: cloud(n=POINTS, seed=seed), True)
SURFACE = Scene(
    "orthographic, visible surface", lambda _, seed: ellipsoid((0.15, 0.12, 0.1), n=POINTS, seed=seed), True
)
PRACTICE = Scene(
    "perspective, visible surface", lambda _, seed: ellipsoid((0.15, 0.12, 0.1), n=POINTS, seed=seed), False
)
# The same, longer along the world's x axis than across: uncorrelated still in cameras along the world's axes.
STRETCHED = Scene(
    "orthographic, uncorrelated, stretched 10 : 3 : 3", lambda n, seed: _stretched(balanced_cloud(n, seed)), True
)
BODIES = (
    PRACTICE._replace(name="ellipsoid"),
    Scene("box", lambda _, seed: box(n=POINTS, seed=seed), False),
    Scene("board", lambda _, seed: plane(n=POINTS, seed=seed), False),
)


def _stretched(body: Body) -> Body:
    return Body(body.points * [1.0, 0.3, 0.3], body.normals)


@cache
def at_right_angles() -> Rig:
    """Three cameras, along the world's axes."""
    centers = 1.5 * np.array([[0, 0, -1], [1, 0, 0], [0, -1, 0]])
    return Rig([camera_at(f"cam_{k}", o, np.zeros(3), 1000.0, (1280, 960)) for k, o in enumerate(centers)], "m")


@cache
def around(n: int) -> Rig:
    """`n` cameras around the body, alternately 0.4 m above and below it."""
    return ring(n, height=[0.4 * (-1) ** k for k in range(n)])


def simulate(
    scene: Scene,
    rng: np.random.Generator,
    rig: Rig,
    *,
    turn_deg: float = TURN_DEG,
    axis: Sequence[float] | None = None,
    matches: int = MATCHES,
    noise_px: float = NOISE_PX,
    hidden: float = 0.0,
    still: bool = False,
    aligned: bool = False,
    junk: Sequence[int] = (),
) -> Problem:
    """What the cameras of a rig report of a motion by `turn_deg` about `axis` (None: any) and a shift of 20 mm.

    Given `rng`'s state, body, start and motion are the same whatever the other arguments, and a camera's matches do not
    depend on the other cameras: of two problems, `Problem.spoilt` makes a third.

    Args:
        hidden: share of the features in each camera that something in front hides, on one side of a line across its
            image; there are fewer matches by that.
        still: the body stands, so that all cameras see one frame twice.
        aligned: the body starts with its axes along the world's, and not in any orientation.
        junk: cameras whose matches are all wrong.
    """
    body_seed, key = (int(k) for k in rng.integers(2**31, size=2))
    start = random_motion(rng.uniform(0, 180), 0.0, rng)
    motion = random_motion(turn_deg, SHIFT, rng, axis)
    pair = simulate_matches(
        rig,
        scene.body(matches, body_seed),
        RigidTransform.identity() if still else motion,
        rng=np.random.default_rng(key),
        per_camera=round(matches * (1 - hidden)),
        noise_px=noise_px,
        occlusion=hidden if hidden < 1 else 0.0,
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
