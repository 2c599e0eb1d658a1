"""Scenes in which a motion cannot be found, or not all of it: what `estimate_motion` must say of each.

A table: how a scene is made, the statuses that are true of it and, where a motion is given, how wrong it may be. Scenes
that a solver might take for degenerate, and must not, are there as well.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.matches import Matches
from sylpose.relative_pose.motion import estimate_motion
from sylpose.rig import Camera
from sylpose.simulate import box
from tests.degenerate_scenes import (
    BODY,
    CASES,
    JUNK,
    LIMIT,
    OK,
    SCALE,
    SIZE,
    TURN,
    TWOFOLD,
    UNSETTLED,
    Scene,
    check_fields,
    rod,
    seen,
    some_motion,
    within,
)
from tests.scenes import around, data_of, degrees, epipolar_px, error, nees, shift, truth

SEEDS = range(5)


@pytest.fixture(scope="module", autouse=True)
def compiled() -> None:
    """Kernels are compiled before anything is timed."""
    scene = seen(around(2), BODY, some_motion(0), 0)
    estimate_motion(scene.rig, scene.matches)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", CASES)
def test_status(name: str, seed: int) -> None:
    case = CASES[name]
    rig, matches, pair = case.make(seed)
    found = within(LIMIT, rig, matches)
    check_fields(rig, matches, found)
    assert found.status in case.allowed
    if found.status is OK:
        off = error(pair, found)
        if case.twofold and degrees(off) > case.degrees:
            assert found.motion is not None
            assert degrees(off) < 5.0
            moved = found.motion.apply(found.center) - found.center
            scene, count = Scene(rig, matches, pair), sum(len(m) for m in matches)
            there, here = (
                np.sqrt(squares_px(scene, turn, by, found.center) / count)
                for turn, by in ((found.motion.rotation.as_matrix(), moved), truth(pair, found.center))
            )
            assert there < here + 0.15
            return
        assert degrees(off) < case.degrees
        assert shift(off) < case.length
        assert nees(off, found) < case.nees


# --- what is unseen is unseen -------------------------------------------------------------------------------------------


def squares_px(scene: Scene, rotation: FloatArray, displacement: FloatArray, center: FloatArray) -> float:
    """Sum of squared epipolar distances, pixels."""
    terms = data_of(scene.rig, scene.matches)
    return float(sum(np.sum(epipolar_px(t, center, rotation, displacement) ** 2) for t in terms))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(
    "name",
    # One camera and a rod: the mirrored solution is as good as the truth, which the test starts from.
    [
        "one camera",
        "all cameras in one place",
        "translation, no noise",
        "translation",
        "collinear points",
        "turn about the normal, telescopes",
    ],
)
def test_a_motion_along_what_is_unseen_explains_the_matches_as_well(name: str, seed: int) -> None:
    scene = CASES[name].make(seed)
    found = within(LIMIT, scene.rig, scene.matches)
    assert len(found.unseen) > 0
    rotation, displacement = truth(scene.pair, found.center)
    here = squares_px(scene, rotation, displacement, found.center)
    size = np.hypot(0.15 * np.linalg.norm(Rotation.from_matrix(rotation).as_rotvec()), np.linalg.norm(displacement))
    rng = np.random.default_rng(seed)
    for row in found.unseen:
        rise = []
        other = rng.standard_normal((20, 6)) * np.array([1 / 0.15] * 3 + [1.0] * 3)
        for step in (row, *other):
            # A twentieth of the motion's size, as what moves the object's surface by so much.
            step = 0.05 * size * step / np.linalg.norm(step * np.array([0.15] * 3 + [1.0] * 3))
            turned = Rotation.from_rotvec(step[:3]).as_matrix() @ rotation
            rise.append(squares_px(scene, turned, displacement + step[3:], found.center) - here)
        assert rise[0] < 0.05 * np.median(rise[1:]) + 1.0, (rise[0], np.median(rise[1:]))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", ["one camera", "one camera, no noise", "translation, no noise", "translation"])
def test_the_covariance_does_not_contradict_the_status(name: str, seed: int) -> None:
    """A scale that is not observable is not known at all, though the surfaces are believed to be where the rays meet."""
    rig, matches, _ = CASES[name].make(seed)
    found = within(LIMIT, rig, matches)
    assert found.status is SCALE
    assert found.motion is not None
    size = np.linalg.norm(found.motion.apply(found.center) - found.center)
    for row in found.unseen:
        known = np.isfinite(np.diag(found.covariance))
        of_row = row[known] @ found.covariance[np.ix_(known, known)] @ row[known]
        assert not known.all() or np.sqrt(of_row) > 100 * size
        # The information knows nothing of it at all.
        along = row @ found.information @ row
        assert abs(along) < 1e-6 * row @ np.diag(np.diag(found.information)) @ row


@pytest.mark.parametrize("seed", SEEDS)
def test_what_one_camera_does_not_see_is_the_scale(seed: int) -> None:
    rig, matches, pair = CASES["one camera"].make(seed)
    found = within(LIMIT, rig, matches)
    assert found.motion is not None
    assert found.unseen.shape == (1, 6)
    # Bringing everything nearer to the camera moves the object's centre along the translation as the camera sees it.
    camera = rig.cameras[0].center
    along = found.motion.apply(camera) - camera
    unseen = found.unseen[0] / np.linalg.norm(found.unseen[0, 3:])
    assert abs(unseen[3:] @ along) / np.linalg.norm(along) > 0.98
    assert np.linalg.norm(unseen[:3]) * 0.15 < 0.2
    # The turn is known, as well as is said.
    turn = error(pair, found)[:3]
    assert turn @ np.linalg.solve(found.covariance[:3, :3], turn) < 25


@pytest.mark.parametrize("name", ["translation, no noise", "translation"])
@pytest.mark.parametrize("seed", SEEDS)
def test_what_a_translation_leaves_open_is_its_length(name: str, seed: int) -> None:
    rig, matches, pair = CASES[name].make(seed)
    found = within(LIMIT, rig, matches)
    assert found.motion is not None
    assert found.unseen.shape == (1, 6)
    direction = pair.motion.translation / np.linalg.norm(pair.motion.translation)
    unseen = found.unseen[0] / np.linalg.norm(found.unseen[0, 3:])
    assert abs(unseen[3:] @ direction) > 0.95
    assert np.linalg.norm(unseen[:3]) * 0.15 < 0.2
    # Its direction is found, and its length is not absurd: the object is believed to be where the rays meet.
    moved = found.motion.apply(found.center) - found.center
    assert moved @ direction / np.linalg.norm(moved) > 0.98
    assert np.rad2deg(found.motion.rotation.magnitude()) < 0.6


@pytest.mark.parametrize("seed", SEEDS)
def test_what_a_rod_leaves_open_is_the_turn_about_itself(seed: int) -> None:
    scene = CASES["collinear points"].make(seed)
    found = within(LIMIT, scene.rig, scene.matches)
    assert found.unseen.shape == (1, 6)
    about = scene.pair.motion.rotation.apply(rod(seed)[1])
    axis = found.unseen[0, :3] / np.linalg.norm(found.unseen[0, :3])
    assert abs(axis @ about) > 0.98


# --- bad input ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("frame", ["x", "y"])
def test_points_that_are_not_finite_are_refused(frame: str, bad: float) -> None:
    scene = CASES["two cameras"].make(0)
    m = scene.matches[0]
    points = {"x": m.x.copy(), "y": m.y.copy()}
    points[frame][7, 1] = bad
    with pytest.raises(ValueError, match="not finite"):
        Matches(**points)
    with pytest.raises(ValueError, match="not finite"):
        replace(m, **{frame: points[frame]})


def test_pixels_that_are_not_finite_are_refused() -> None:
    camera = around(1).cameras[0]
    pixels = np.full((10, 2), 300.0)
    bad = pixels.copy()
    bad[3] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        Matches.from_pixels(camera, pixels, bad)


def test_matches_of_another_rig_are_refused() -> None:
    scene = CASES["two cameras"].make(0)
    with pytest.raises(ValueError, match="matches: 2 for 3 cameras"):
        estimate_motion(around(3), scene.matches)


# --- outliers only, and too much of everything ---------------------------------------------------------------------------


def outliers_only(seed: int) -> Scene:
    rig = around(4)
    return seen(rig, BODY, some_motion(seed), seed, junk=rig.names)


def partners_mixed(seed: int) -> Scene:
    return seen(around(4), BODY, some_motion(seed), seed, outliers=1.0)


def noise_everywhere(seed: int) -> Scene:
    """Points anywhere in the images."""
    scene, rng = outliers_only(seed), np.random.default_rng(seed)
    cameras: tuple[Camera, ...] = scene.rig.cameras
    matches = [Matches.from_pixels(c, *rng.uniform(0, SIZE, (2, 60, 2))) for c in cameras]
    return scene._replace(matches=matches)


@pytest.mark.parametrize("make", [outliers_only, partners_mixed, noise_everywhere])
def test_outliers_only(make: Callable[[int], Scene]) -> None:
    wrong, unsettled = [], 0
    for seed in range(20):
        scene = make(seed)
        found = within(LIMIT, scene.rig, scene.matches)
        check_fields(scene.rig, scene.matches, found)
        unsettled += found.status is UNSETTLED
        if found.status not in (JUNK, UNSETTLED):
            wrong.append((seed, found.status, int(found.n_inliers.sum())))
        if found.status is OK:
            assert nees(error(scene.pair, found), found) < 100, seed
    assert len(wrong) <= 1, wrong
    assert unsettled <= 3


MANY = """
import resource, time
import numpy as np
from sylpose import simulate
from sylpose.relative_pose.motion import estimate_motion

rig, body = simulate.dome(4), simulate.cloud(n=250_000)
few = simulate.simulate_matches(rig, simulate.cloud(), simulate.random_motion(5, 0.02, np.random.default_rng(0)),
                                rng=np.random.default_rng(0))
estimate_motion(rig, few.matches)
pair = simulate.simulate_matches(rig, body, few.motion, rng=np.random.default_rng(0), per_camera=250_000, outliers=0.1)
assert sum(len(m) for m in pair.matches) == 1_000_000
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
start = time.monotonic()
found = estimate_motion(rig, pair.matches)
seconds = time.monotonic() - start
mib = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
turn = np.rad2deg((pair.motion.rotation * found.motion.rotation.inv()).magnitude())
print(found.status.name, seconds, mib, turn)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="memory is read from the resource module")
def test_a_million_matches() -> None:
    """In a process of its own, whose peak of memory is this call's: 32 MiB of points come in."""
    done = subprocess.run([sys.executable, "-c", MANY], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    status, seconds, mib, turn = done.stdout.split()
    assert status == "OK"
    assert float(seconds) < 10
    assert float(mib) < 1000
    assert float(turn) < 0.05


def test_a_tiny_object_is_an_object() -> None:
    """Of six turns by 10 degrees each is found to less than its size, with a covariance that fits."""
    errors, squares = [], []
    for seed in range(6):
        scene = seen(around(4), box((0.01, 0.01, 0.01)), some_motion(seed, 10.0), seed)
        found = within(LIMIT, scene.rig, scene.matches)
        check_fields(scene.rig, scene.matches, found)
        assert found.status is OK
        off = error(scene.pair, found)
        assert shift(off) < 0.003
        errors.append(degrees(off))
        squares.append(nees(off, found))
    assert np.max(errors) < 9.0
    assert np.sort(errors)[-2] < 3.5
    assert 2.0 < np.median(squares) < 13.0
    assert np.sort(squares)[-2] < 20.0


def test_of_a_long_thin_object_the_turn_about_its_length_is_not_sure() -> None:
    """A box of 60 x 1 x 1 cm, 7 px wide: what its sides slope by is no evidence. All else is found."""
    open_ = 0
    for seed in range(6):
        scene = seen(around(4), box((0.6, 0.01, 0.01)), some_motion(seed, 10.0), seed)
        found = within(LIMIT, scene.rig, scene.matches)
        check_fields(scene.rig, scene.matches, found)
        off = error(scene.pair, found)
        assert shift(off) < 0.003
        # A camera that looks along it sees the turn.
        assert found.status in (TURN, TWOFOLD, OK)
        if found.status is OK:
            assert nees(off, found) < 40.0
        elif found.status is TURN:
            open_ += 1
            along = found.unseen[0, :3] / np.linalg.norm(found.unseen[0, :3])
            assert abs(along @ scene.pair.motion.rotation.apply([1.0, 0.0, 0.0])) > 0.98
            across = off[:3] - along * (along @ off[:3])
            assert np.rad2deg(np.linalg.norm(across)) < 0.5
    assert open_ >= 4
