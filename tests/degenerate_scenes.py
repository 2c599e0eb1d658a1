"""Scenes in which a motion cannot be found, or not all of it, and the statuses that are true of them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import FloatArray
from sylpose.matches import Matches
from sylpose.relative_pose.motion import estimate_motion
from sylpose.results import Motion, Status
from sylpose.rig import Rig, camera_at
from sylpose.simulate import Body, SimulatedPair, arc, ellipsoid, plane, random_motion, ring, simulate_matches
from tests.scenes import around

OK, SCALE, TURN = Status.OK, Status.SCALE_NOT_OBSERVABLE, Status.TURN_NOT_OBSERVABLE
NOTHING, FEW, JUNK = Status.NO_MOTION, Status.TOO_FEW_MATCHES, Status.NOT_CONSISTENT
UNSETTLED = Status.NOT_CONVERGED
TWOFOLD, MIXED = Status.AMBIGUOUS, Status.MIXED
ANYTHING = {OK, SCALE, TURN, JUNK, UNSETTLED, TWOFOLD}

SIZE = (1280, 960)
BODY = ellipsoid((0.15, 0.12, 0.1))
# Seconds: some thousand times what a call takes. What exceeds it hangs.
LIMIT = 2.0


class Scene(NamedTuple):
    """A rig, what its cameras matched, and the truth about it."""

    rig: Rig
    matches: Sequence[Matches]
    pair: SimulatedPair


class Case(NamedTuple):
    """How a scene is made from a seed, the statuses that are true of it, and the error that an OK may have: its size, and
    its square in units of the covariance (40 is exceeded by chance once in two million times); whether there is a second
    solution that nearly explains the matches as well."""

    make: Callable[[int], Scene]
    allowed: set[Status]
    degrees: float = 1.0
    length: float = 0.01
    nees: float = 40.0
    twofold: bool = False


def seen(rig: Rig, body: Body, motion: RigidTransform, seed: int, **options: object) -> Scene:
    pair = simulate_matches(rig, body, motion, rng=np.random.default_rng([seed, 1]), **options)  # type: ignore[arg-type]
    return Scene(rig, pair.matches, pair)


def some_motion(seed: int, turn: float = 5.0) -> RigidTransform:
    return random_motion(turn, 0.02, np.random.default_rng([seed, 2]))


def translation(seed: int) -> RigidTransform:
    direction = np.random.default_rng([seed, 3]).standard_normal(3)
    return RigidTransform.from_translation(0.04 * direction / np.linalg.norm(direction))


def rod(seed: int) -> tuple[Body, FloatArray]:
    """Points on a line, seen from everywhere, and the line's direction."""
    rng = np.random.default_rng([seed, 4])
    along = rng.standard_normal(3)
    along /= np.linalg.norm(along)
    points = rng.uniform(-0.15, 0.15, (400, 1)) * along
    return Body(points, np.zeros_like(points)), along


def in_one_place(n: int) -> Rig:
    """Cameras with one centre, turned a little away from each other."""
    targets = 0.1 * np.random.default_rng(0).standard_normal((n, 3))
    return Rig([camera_at(f"cam_{i}", [0, 0, -1.5], target, 1000.0, SIZE) for i, target in enumerate(targets)])


def on_a_line(n: int) -> Rig:
    """Cameras along the x axis, all looking at the object."""
    places = np.linspace(-1.2, 1.2, n)
    return Rig([camera_at(f"cam_{i}", [x, 0, -1.5], [0, 0, 0], 1000.0, SIZE) for i, x in enumerate(places)])


def long_lenses(distance: float) -> Rig:
    """Four cameras in one plane around the object, which is as large in their images whatever the distance."""
    return ring(4, distance, 1000.0 * distance / 1.5)


def about_the_normal(seed: int, distance: float) -> Scene:
    """A turn about the normal of the cameras' plane: how far it turned is traded for depth (bas-relief)."""
    motion = random_motion(5.0, 0.0, np.random.default_rng(seed), axis=(0, 1, 0))
    return seen(long_lenses(distance), BODY, motion, seed)


def first_of(scene: Scene, counts: Sequence[int]) -> Scene:
    few = [Matches(m.x[:n], m.y[:n]) for m, n in zip(scene.matches, counts, strict=True)]
    return scene._replace(matches=few)


def repeated(scene: Scene, times: int, count: int | None = None) -> Scene:
    again = [
        Matches(np.repeat(m.x[:count], times, axis=0), np.repeat(m.y[:count], times, axis=0)) for m in scene.matches
    ]
    return scene._replace(matches=again)


CASES: dict[str, Case] = {
    # One camera never knows how far away the object is.
    "one camera": Case(lambda s: seen(around(1), BODY, some_motion(s, 10.0), s), {SCALE}),
    "one camera, no noise": Case(lambda s: seen(around(1), BODY, some_motion(s, 10.0), s, noise_px=0.0), {SCALE}),
    "one camera of four has matches": Case(
        lambda s: seen(around(4), BODY, some_motion(s, 10.0), s, dead=("cam_1", "cam_2", "cam_3")), {SCALE}
    ),
    "all cameras in one place": Case(lambda s: seen(in_one_place(4), BODY, some_motion(s, 10.0), s), {SCALE}),
    # Without a turn every depth may be scaled.
    "translation, no noise": Case(lambda s: seen(around(4), BODY, translation(s), s, noise_px=0.0), {SCALE}),
    "translation": Case(lambda s: seen(around(4), BODY, translation(s), s), {SCALE}),
    "translation, eight cameras, 1 px": Case(lambda s: seen(around(8), BODY, translation(s), s, noise_px=1.0), {SCALE}),
    # Nothing moves.
    "no motion, no noise": Case(lambda s: seen(around(4), BODY, RigidTransform.identity(), s, noise_px=0.0), {NOTHING}),
    "no motion, 0.25 px": Case(lambda s: seen(around(4), BODY, RigidTransform.identity(), s, noise_px=0.25), {NOTHING}),
    "no motion, 0.5 px": Case(lambda s: seen(around(4), BODY, RigidTransform.identity(), s, noise_px=0.5), {NOTHING}),
    "no motion, 1 px": Case(lambda s: seen(around(4), BODY, RigidTransform.identity(), s, noise_px=1.0), {NOTHING}),
    "no motion, one camera": Case(lambda s: seen(around(1), BODY, RigidTransform.identity(), s), {NOTHING, TURN}),
    # A plane's motion has two solutions in each camera (Faugeras & Lustman 1988), which few cameras in one plane with the
    # object hardly tell apart. All around it they do.
    "plane, arc": Case(lambda s: seen(arc(3, 40), plane(), some_motion(s), s), {OK, SCALE, TWOFOLD}, twofold=True),
    "plane, arc, 20 degrees": Case(lambda s: seen(arc(4, 25), plane(), some_motion(s, 20.0), s), {OK}, twofold=True),
    "plane, no noise": Case(
        lambda s: seen(arc(3, 40), plane(), some_motion(s), s, noise_px=0.0),
        {OK, SCALE, TWOFOLD},
        0.05,
        1e-3,
        twofold=True,
    ),
    "plane, zigzag": Case(lambda s: seen(around(6), plane(), some_motion(s), s), {OK}),
    # A rod may turn about itself.
    "collinear points": Case(lambda s: seen(around(4), rod(s)[0], some_motion(s), s), {TURN}),
    "collinear points, no noise": Case(lambda s: seen(around(4), rod(s)[0], some_motion(s), s, noise_px=0.0), {TURN}),
    "collinear points, one camera": Case(lambda s: seen(around(1), rod(s)[0], some_motion(s), s), {TURN}),
    # Two camera centres always are on a line; more of them see everything just as well.
    "centres on a line": Case(lambda s: seen(on_a_line(4), BODY, some_motion(s), s), {OK}),
    "two cameras": Case(lambda s: seen(on_a_line(2), BODY, some_motion(s), s), {OK}, 4.0),
    # The farther the cameras, the less perspective tells a turn from relief.
    "turn about the normal, short lenses": Case(lambda s: about_the_normal(s, 1.5), {OK, TURN}, 5.0),
    "turn about the normal, long lenses": Case(lambda s: about_the_normal(s, 6.0), {TURN}),
    "turn about the normal, telescopes": Case(lambda s: about_the_normal(s, 60.0), {TURN}),
    # A handful of matches.
    "no matches": Case(lambda s: first_of(seen(around(4), BODY, some_motion(s), s), [0] * 4), {FEW}),
    "1 match per camera": Case(lambda s: first_of(seen(around(4), BODY, some_motion(s), s), [1] * 4), {FEW}),
    "7 matches": Case(lambda s: first_of(seen(around(4), BODY, some_motion(s), s), [3, 4, 0, 0]), {FEW}),
    # Two equations more than unknowns: whatever is said must not be far from the truth in its own units.
    "2 matches per camera": Case(
        lambda s: first_of(seen(around(4), BODY, some_motion(s), s), [2] * 4),
        ANYTHING,
        90,
        1,
    ),
    "3 matches per camera": Case(
        lambda s: first_of(seen(around(4), BODY, some_motion(s), s), [3] * 4),
        ANYTHING,
        90,
        1,
    ),
    "4 matches per camera": Case(
        lambda s: first_of(seen(around(4), BODY, some_motion(s), s), [4] * 4),
        ANYTHING,
        15,
        0.1,
    ),
    "16 cameras, 3 matches each": Case(
        lambda s: seen(around(16), BODY, some_motion(s), s, per_camera=3), {OK}, 3.0, 0.02
    ),
    "one camera with 60, the others with 0": Case(
        lambda s: first_of(seen(around(4), BODY, some_motion(s, 10.0), s), [60, 0, 0, 0]), {SCALE}
    ),
    "one camera with 60, the others with 1": Case(
        lambda s: first_of(seen(around(4), BODY, some_motion(s, 10.0), s), [60, 1, 1, 1]), {OK, SCALE}, 8.0, 0.05
    ),
    "one camera with 60, the others with 2": Case(
        lambda s: first_of(seen(around(4), BODY, some_motion(s, 10.0), s), [60, 2, 2, 2]), {OK, SCALE}, 8.0, 0.05
    ),
    "one camera with 60, the others with 3": Case(
        lambda s: first_of(seen(around(4), BODY, some_motion(s, 10.0), s), [60, 3, 3, 3]), {OK, SCALE}, 8.0, 0.05
    ),
    "one camera with 60, the others with 4": Case(
        lambda s: first_of(seen(around(4), BODY, some_motion(s, 10.0), s), [60, 4, 4, 4]), {OK}, 8.0, 0.05
    ),
    "0, 1, 2, 3 and 4 matches beside two good cameras": Case(
        lambda s: first_of(seen(around(7), BODY, some_motion(s), s), [60, 0, 1, 2, 3, 4, 60]), {OK}, 2.0
    ),
    "one camera empty": Case(lambda s: seen(around(4), BODY, some_motion(s), s, dead=("cam_2",)), {OK}),
    # The same again and again: nobody can tell that it is not as many measurements.
    "every match five times": Case(lambda s: repeated(seen(around(4), BODY, some_motion(s), s), 5), {OK}, nees=200.0),
    # Four points in all: four equations for six unknowns.
    "one match per camera, sixty times": Case(
        lambda s: repeated(seen(around(4), BODY, some_motion(s), s), 60, 1), {TURN, FEW, JUNK, UNSETTLED}
    ),
    "still matches, all the same": Case(
        lambda s: repeated(seen(around(4), BODY, RigidTransform.identity(), s, noise_px=0.0), 60, 1),
        {NOTHING, TURN, FEW, JUNK, UNSETTLED},
    ),
}


def within(seconds: float, rig: Rig, matches: Sequence[Matches]) -> Motion:
    """`estimate_motion`, given up after a while: compiled code cannot be interrupted, but it can be left alone."""
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
    """Whatever the status: everything is finite, or infinite where that is documented."""
    assert (found.motion is not None) == (found.status.has_pose or found.status in (TURN, TWOFOLD, MIXED))
    if found.motion is not None:
        assert np.isfinite(found.motion.as_matrix()).all()
    assert np.isfinite(found.center).all() or found.status is FEW
    assert np.isfinite(found.information).all()
    np.testing.assert_allclose(found.information, found.information.T, rtol=1e-9, atol=1e-9)
    assert np.linalg.eigvalsh(found.information).min() >= -1e-7 * max(np.trace(found.information), 1e-300)
    known = np.isfinite(np.diag(found.covariance))
    assert np.isposinf(np.diag(found.covariance)[~known]).all()
    assert np.isfinite(found.covariance[~np.eye(6, dtype=bool)]).all()
    assert (np.diag(found.covariance)[known] >= 0).all()
    assert found.unseen.shape == (len(found.unseen), 6)
    assert np.isfinite(found.unseen).all()
    assert (len(found.unseen) > 0) == (found.status in (SCALE, TURN))
    for mask, m in zip(found.inliers, matches, strict=True):
        assert mask.shape == (len(m),)
    np.testing.assert_array_equal(np.isfinite(found.residuals), found.n_inliers > 0)
    assert len(found.residuals) == len(rig)
    assert 0 <= found.iterations < 2000
