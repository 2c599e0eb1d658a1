"""Degenerate scenes, in which all or part of the motion is unobservable, and the statuses allowed for them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import FloatArray
from sylpose.matches import Matches
from sylpose.relative_pose.motion import estimate_motion
from sylpose.results import Motion
from sylpose.rig import Rig, make_look_at_camera
from sylpose.simulate import Body, SimulatedPair, arc, ellipsoid, plane, random_motion, ring, simulate_matches
from sylpose.status import Status
from tests.scenes import make_zigzag_rig

OK, SCALE, TURN = Status.OK, Status.SCALE_NOT_OBSERVABLE, Status.ROTATION_NOT_OBSERVABLE
NO_MOTION, FEW, JUNK = Status.NO_MOTION, Status.TOO_FEW_MATCHES, Status.NOT_CONSISTENT
NOT_CONVERGED = Status.NOT_CONVERGED
AMBIGUOUS, MIXED = Status.AMBIGUOUS, Status.MIXED
ANYTHING = {OK, SCALE, TURN, JUNK, NOT_CONVERGED, AMBIGUOUS}

SIZE = (1280, 960)
BODY = ellipsoid((0.15, 0.12, 0.1))
# Timeout in seconds, some thousand times the duration of a call.
LIMIT = 2.0


class Scene(NamedTuple):
    """Rig, the matches of its cameras, and the ground truth."""

    rig: Rig
    matches: Sequence[Matches]
    pair: SimulatedPair


class Case(NamedTuple):
    """Degenerate scene and the expected results.

    Attributes:
        make: creates the scene from a seed.
        allowed: statuses that are correct.
        degrees, length: largest error of an OK result.
        nees: largest normalized squared error of an OK result (40 is exceeded by chance once in two million times).
        is_ambiguous: whether a second solution explains the matches nearly as well.
    """

    make: Callable[[int], Scene]
    allowed: set[Status]
    degrees: float = 1.0
    length: float = 0.01
    nees: float = 40.0
    is_ambiguous: bool = False


def make_scene(rig: Rig, body: Body, motion: RigidTransform, seed: int, **options: object) -> Scene:
    pair = simulate_matches(rig, body, motion, rng=np.random.default_rng([seed, 1]), **options)  # type: ignore[arg-type]
    return Scene(rig, pair.matches, pair)


def draw_motion(seed: int, degrees: float = 5.0) -> RigidTransform:
    return random_motion(degrees, 0.02, np.random.default_rng([seed, 2]))


def draw_translation(seed: int) -> RigidTransform:
    direction = np.random.default_rng([seed, 3]).standard_normal(3)
    return RigidTransform.from_translation(0.04 * direction / np.linalg.norm(direction))


def make_rod(seed: int) -> tuple[Body, FloatArray]:
    """Return collinear points, visible from everywhere, and the line's direction."""
    rng = np.random.default_rng([seed, 4])
    along = rng.standard_normal(3)
    along /= np.linalg.norm(along)
    points = rng.uniform(-0.15, 0.15, (400, 1)) * along
    return Body(points, np.zeros_like(points)), along


def make_concentric_rig(n: int) -> Rig:
    """Return n cameras with one center and slightly different directions."""
    targets = 0.1 * np.random.default_rng(0).standard_normal((n, 3))
    return Rig(
        [make_look_at_camera(f"cam_{i}", [0, 0, -1.5], target, 1000.0, SIZE) for i, target in enumerate(targets)]
    )


def make_linear_rig(n: int) -> Rig:
    """Return n cameras along the x axis, all directed at the object."""
    places = np.linspace(-1.2, 1.2, n)
    return Rig([make_look_at_camera(f"cam_{i}", [x, 0, -1.5], [0, 0, 0], 1000.0, SIZE) for i, x in enumerate(places)])


def make_long_lens_rig(distance: float) -> Rig:
    """Return four cameras in one plane around the object, with the same image size at any distance."""
    return ring(4, distance, 1000.0 * distance / 1.5)


def make_normal_rotation(seed: int, distance: float) -> Scene:
    """Return a rotation about the normal of the cameras' plane: its angle is confounded with depth (bas-relief)."""
    motion = random_motion(5.0, 0.0, np.random.default_rng(seed), axis=(0, 1, 0))
    return make_scene(make_long_lens_rig(distance), BODY, motion, seed)


def keep_first_matches(scene: Scene, counts: Sequence[int]) -> Scene:
    few = [Matches(m.x[:n], m.y[:n]) for m, n in zip(scene.matches, counts, strict=True)]
    return scene._replace(matches=few)


def repeat_matches(scene: Scene, times: int, count: int | None = None) -> Scene:
    again = [
        Matches(np.repeat(m.x[:count], times, axis=0), np.repeat(m.y[:count], times, axis=0)) for m in scene.matches
    ]
    return scene._replace(matches=again)


CASES: dict[str, Case] = {
    # One camera alone does not determine the object's distance.
    "one camera": Case(lambda s: make_scene(make_zigzag_rig(1), BODY, draw_motion(s, 10.0), s), {SCALE}),
    "one camera, no noise": Case(
        lambda s: make_scene(make_zigzag_rig(1), BODY, draw_motion(s, 10.0), s, noise_px=0.0), {SCALE}
    ),
    "one camera of four has matches": Case(
        lambda s: make_scene(
            make_zigzag_rig(4), BODY, draw_motion(s, 10.0), s, per_camera={"cam_1": 0, "cam_2": 0, "cam_3": 0}
        ),
        {SCALE},
    ),
    "all cameras in one place": Case(
        lambda s: make_scene(make_concentric_rig(4), BODY, draw_motion(s, 10.0), s), {SCALE}
    ),
    # Without a rotation every depth may be scaled.
    "translation, no noise": Case(
        lambda s: make_scene(make_zigzag_rig(4), BODY, draw_translation(s), s, noise_px=0.0), {SCALE}
    ),
    "translation": Case(lambda s: make_scene(make_zigzag_rig(4), BODY, draw_translation(s), s), {SCALE}),
    "translation, eight cameras, 1 px": Case(
        lambda s: make_scene(make_zigzag_rig(8), BODY, draw_translation(s), s, noise_px=1.0), {SCALE}
    ),
    # No motion.
    "no motion, no noise": Case(
        lambda s: make_scene(make_zigzag_rig(4), BODY, RigidTransform.identity(), s, noise_px=0.0), {NO_MOTION}
    ),
    "no motion, 0.25 px": Case(
        lambda s: make_scene(make_zigzag_rig(4), BODY, RigidTransform.identity(), s, noise_px=0.25), {NO_MOTION}
    ),
    "no motion, 0.5 px": Case(
        lambda s: make_scene(make_zigzag_rig(4), BODY, RigidTransform.identity(), s, noise_px=0.5), {NO_MOTION}
    ),
    "no motion, 1 px": Case(
        lambda s: make_scene(make_zigzag_rig(4), BODY, RigidTransform.identity(), s, noise_px=1.0), {NO_MOTION}
    ),
    "no motion, one camera": Case(
        lambda s: make_scene(make_zigzag_rig(1), BODY, RigidTransform.identity(), s), {NO_MOTION, TURN}
    ),
    # A plane's motion has two solutions in each camera (Faugeras & Lustman 1988). Few cameras in one plane with the
    # object hardly distinguish them; cameras all around do.
    "plane, arc": Case(
        lambda s: make_scene(arc(3, 40), plane(), draw_motion(s), s), {OK, SCALE, AMBIGUOUS}, is_ambiguous=True
    ),
    "plane, arc, 20 degrees": Case(
        lambda s: make_scene(arc(4, 25), plane(), draw_motion(s, 20.0), s), {OK}, is_ambiguous=True
    ),
    "plane, no noise": Case(
        lambda s: make_scene(arc(3, 40), plane(), draw_motion(s), s, noise_px=0.0),
        {OK, SCALE, AMBIGUOUS},
        0.05,
        1e-3,
        is_ambiguous=True,
    ),
    "plane, zigzag": Case(lambda s: make_scene(make_zigzag_rig(6), plane(), draw_motion(s), s), {OK}),
    # A rod may rotate about itself.
    "collinear points": Case(lambda s: make_scene(make_zigzag_rig(4), make_rod(s)[0], draw_motion(s), s), {TURN}),
    "collinear points, no noise": Case(
        lambda s: make_scene(make_zigzag_rig(4), make_rod(s)[0], draw_motion(s), s, noise_px=0.0), {TURN}
    ),
    "collinear points, one camera": Case(
        lambda s: make_scene(make_zigzag_rig(1), make_rod(s)[0], draw_motion(s), s), {TURN}
    ),
    # Two camera centers are always on a line; more of them observe everything just as well.
    "centers on a line": Case(lambda s: make_scene(make_linear_rig(4), BODY, draw_motion(s), s), {OK}),
    "two cameras": Case(lambda s: make_scene(make_linear_rig(2), BODY, draw_motion(s), s), {OK}, 4.0),
    # The farther the cameras, the less perspective distinguishes a rotation from residual depth.
    "turn about the normal, short lenses": Case(lambda s: make_normal_rotation(s, 1.5), {OK, TURN}, 5.0),
    "turn about the normal, long lenses": Case(lambda s: make_normal_rotation(s, 6.0), {TURN}),
    "turn about the normal, telescopes": Case(lambda s: make_normal_rotation(s, 60.0), {TURN}),
    # Few matches.
    "no matches": Case(
        lambda s: keep_first_matches(make_scene(make_zigzag_rig(4), BODY, draw_motion(s), s), [0] * 4), {FEW}
    ),
    "1 match per camera": Case(
        lambda s: keep_first_matches(make_scene(make_zigzag_rig(4), BODY, draw_motion(s), s), [1] * 4), {FEW}
    ),
    "7 matches": Case(
        lambda s: keep_first_matches(make_scene(make_zigzag_rig(4), BODY, draw_motion(s), s), [3, 4, 0, 0]), {FEW}
    ),
    # Two equations more than unknowns: the result must agree with its own covariance.
    "2 matches per camera": Case(
        lambda s: keep_first_matches(make_scene(make_zigzag_rig(4), BODY, draw_motion(s), s), [2] * 4),
        ANYTHING,
        90,
        1,
    ),
    "3 matches per camera": Case(
        lambda s: keep_first_matches(make_scene(make_zigzag_rig(4), BODY, draw_motion(s), s), [3] * 4),
        ANYTHING,
        90,
        1,
    ),
    "4 matches per camera": Case(
        lambda s: keep_first_matches(make_scene(make_zigzag_rig(4), BODY, draw_motion(s), s), [4] * 4),
        ANYTHING,
        15,
        0.1,
    ),
    "16 cameras, 3 matches each": Case(
        lambda s: make_scene(make_zigzag_rig(16), BODY, draw_motion(s), s, per_camera=3), {OK}, 3.0, 0.02
    ),
    "one camera with 60, the others with 0": Case(
        lambda s: keep_first_matches(make_scene(make_zigzag_rig(4), BODY, draw_motion(s, 10.0), s), [60, 0, 0, 0]),
        {SCALE},
    ),
    "one camera with 60, the others with 1": Case(
        lambda s: keep_first_matches(make_scene(make_zigzag_rig(4), BODY, draw_motion(s, 10.0), s), [60, 1, 1, 1]),
        {OK, SCALE, TURN},
        8.0,
        0.05,
    ),
    "one camera with 60, the others with 2": Case(
        lambda s: keep_first_matches(make_scene(make_zigzag_rig(4), BODY, draw_motion(s, 10.0), s), [60, 2, 2, 2]),
        {OK, SCALE},
        8.0,
        0.05,
    ),
    "one camera with 60, the others with 3": Case(
        lambda s: keep_first_matches(make_scene(make_zigzag_rig(4), BODY, draw_motion(s, 10.0), s), [60, 3, 3, 3]),
        {OK, SCALE},
        8.0,
        0.05,
    ),
    "one camera with 60, the others with 4": Case(
        lambda s: keep_first_matches(make_scene(make_zigzag_rig(4), BODY, draw_motion(s, 10.0), s), [60, 4, 4, 4]),
        {OK},
        8.0,
        0.05,
    ),
    "0, 1, 2, 3 and 4 matches with two good cameras": Case(
        lambda s: keep_first_matches(make_scene(make_zigzag_rig(7), BODY, draw_motion(s), s), [60, 0, 1, 2, 3, 4, 60]),
        {OK},
        2.0,
    ),
    "one camera empty": Case(
        lambda s: make_scene(make_zigzag_rig(4), BODY, draw_motion(s), s, per_camera={"cam_2": 0}), {OK}
    ),
    # Duplicated matches: the estimator cannot know that they are not independent measurements.
    "every match five times": Case(
        lambda s: repeat_matches(make_scene(make_zigzag_rig(4), BODY, draw_motion(s), s), 5), {OK}, nees=200.0
    ),
    # Four points in total: four equations for six unknowns.
    "one match per camera, sixty times": Case(
        lambda s: repeat_matches(make_scene(make_zigzag_rig(4), BODY, draw_motion(s), s), 60, 1),
        {TURN, FEW, JUNK, NOT_CONVERGED},
    ),
    "still matches, all the same": Case(
        lambda s: repeat_matches(
            make_scene(make_zigzag_rig(4), BODY, RigidTransform.identity(), s, noise_px=0.0), 60, 1
        ),
        {NO_MOTION, TURN, FEW, JUNK, NOT_CONVERGED},
    ),
}


def estimate_with_timeout(seconds: float, rig: Rig, matches: Sequence[Matches]) -> Motion:
    """Run `estimate_motion` with a timeout; a thread that hangs in compiled code is abandoned."""
    found: list[Motion | BaseException] = []

    def call() -> None:
        try:
            found.append(estimate_motion(rig, matches))
        except BaseException as problem:
            found.append(problem)

    thread = threading.Thread(target=call, daemon=True)
    thread.start()
    thread.join(seconds)
    assert found, f"no answer within {seconds} s"
    if isinstance(found[0], BaseException):
        raise found[0]
    return found[0]


def check_fields(rig: Rig, matches: Sequence[Matches], found: Motion) -> None:
    """Check that all fields are finite, or infinite where documented, whatever the status."""
    assert (found.motion is not None) == (found.status.has_pose or found.status in (TURN, AMBIGUOUS, MIXED))
    if found.motion is not None:
        assert np.isfinite(found.motion.as_matrix()).all()
    assert np.isfinite(found.center).all() or found.status is FEW
    assert np.isfinite(found.information).all()
    np.testing.assert_allclose(found.information, found.information.T, rtol=1e-9, atol=1e-9)
    assert np.linalg.eigvalsh(found.information).min() >= -1e-7 * max(np.trace(found.information), 1e-300)
    is_finite = np.isfinite(np.diag(found.covariance))
    assert np.isposinf(np.diag(found.covariance)[~is_finite]).all()
    assert np.isfinite(found.covariance[~np.eye(6, dtype=bool)]).all()
    assert (np.diag(found.covariance)[is_finite] >= 0).all()
    assert found.unobservable.shape == (len(found.unobservable), 6)
    assert np.isfinite(found.unobservable).all()
    assert (len(found.unobservable) > 0) == (found.status in (SCALE, TURN))
    for mask, m in zip(found.inliers, matches, strict=True):
        assert mask.shape == (len(m),)
    np.testing.assert_array_equal(np.isfinite(found.residuals), found.n_inliers > 0)
    assert len(found.residuals) == len(rig)
    assert 0 <= found.iterations < 2000
