"""Faulty cameras in two frames are named and removed, good cameras are not (Monte Carlo)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.matches import Matches
from sylpose.relative_pose.motion import estimate_motion
from sylpose.results import Motion
from sylpose.rig import Camera, Rig
from sylpose.simulate import SimulatedPair, arc, box, dome, random_motion, simulate_matches
from sylpose.status import Status
from tests.scenes import BODY, compute_motion_error, compute_rotation_degrees, make_zigzag_rig

BAD = "cam_2"


def make_scene(rig: Rig, seed: int, turn: float = 10.0, **options: object) -> SimulatedPair:
    rng = np.random.default_rng(seed)
    return simulate_matches(rig, BODY, random_motion(turn, 0.02, rng), rng=rng, **options)  # type: ignore[arg-type]


def replace_camera(rig: Rig, camera: Camera) -> Rig:
    return Rig([camera if c.name == camera.name else c for c in rig], rig.unit)


def rotate_bad_camera(rig: Rig, angle: float, seed: int) -> Rig:
    """Return the rig with the bad camera's calibration rotated about a random axis, degrees."""
    axis = np.random.default_rng(seed).standard_normal(3)
    rotation = Rotation.from_rotvec(np.deg2rad(angle) * axis / np.linalg.norm(axis))
    wrong = RigidTransform.from_rotation(rotation) * rig[BAD].camera_from_world
    return replace_camera(rig, replace(rig[BAD], camera_from_world=wrong))


def freeze_bad_camera(rig: Rig, pair: SimulatedPair, seed: int) -> list[Matches]:
    matches = list(pair.matches)
    x = matches[rig.names.index(BAD)].x
    matches[rig.names.index(BAD)] = Matches(x, x + 3e-4 * np.random.default_rng(seed).standard_normal(x.shape))
    return matches


def compute_error_of_others(rig: Rig, pair: SimulatedPair, method: str = "epipolar") -> float:
    """Return the error, degrees, of the other cameras alone."""
    others = [c for c, name in enumerate(rig.names) if name != BAD]
    found = estimate_motion(
        rig.subset([rig.names[c] for c in others]), [pair.matches[c] for c in others], method=method
    )
    return compute_rotation_degrees(compute_motion_error(pair, found))


def is_only_bad_named(found: Motion, rig: Rig) -> bool:
    return bool(
        len(found.faults) == 1
        and found.faults[0].startswith(f"camera {BAD}: ")
        and found.n_inliers[rig.names.index(BAD)] == 0
    )


@pytest.mark.parametrize(
    ("cameras", "angle"),
    [
        *((4, 5.0), (4, 20.0)),
        *(
            pytest.param(*other, marks=pytest.mark.slow)
            for other in ((6, 5.0), (4, 10.0), (6, 10.0), (6, 20.0), (4, 45.0), (6, 45.0))
        ),
    ],
)
def test_wrong_calibration_is_named_and_removed(cameras: int, angle: float) -> None:
    rig, ratios, named = make_zigzag_rig(cameras), [], 0
    # Small calibration errors are visible in some scenes only.
    scenes = 24 if angle < 10 else 8
    for seed in range(scenes):
        pair = make_scene(rig, seed)
        found = estimate_motion(rotate_bad_camera(rig, angle, seed), pair.matches)
        ratios.append(compute_rotation_degrees(compute_motion_error(pair, found)) / compute_error_of_others(rig, pair))
        named += is_only_bad_named(found, rig)
    assert np.median(ratios) < (2.0 if angle > 5 else 4.0)
    # Fewest with few cameras: by 5 degrees, the others often agree without a healthy camera as well. Regression values.
    assert named >= {5.0: 2, 10.0: 4}.get(angle, 6)


@pytest.mark.parametrize("cameras", [3, 4, 6])
@pytest.mark.parametrize("kind", ["junk", "frozen"])
def test_junk_and_frozen_cameras_are_named_and_removed(cameras: int, kind: str) -> None:
    rig, ratios, named = make_zigzag_rig(cameras), [], 0
    for seed in range(4):
        pair = make_scene(rig, seed, junk=(BAD,) if kind == "junk" else ())
        matches = freeze_bad_camera(rig, pair, seed) if kind == "frozen" else pair.matches
        found = estimate_motion(rig, matches)
        ratios.append(compute_rotation_degrees(compute_motion_error(pair, found)) / compute_error_of_others(rig, pair))
        named += is_only_bad_named(found, rig) and kind in found.faults[0]
    assert named >= 3
    assert np.median(ratios) < 2.0


@pytest.mark.parametrize("method", ["sylvester", "depth-plane"])
@pytest.mark.parametrize("kind", ["junk", "frozen", "calibration"])
def test_paper_methods_work_without_a_faulty_camera(method: str, kind: str) -> None:
    rig = make_zigzag_rig(8)
    pair = make_scene(rig, 4, junk=(BAD,) if kind == "junk" else ())
    matches = freeze_bad_camera(rig, pair, 0) if kind == "frozen" else pair.matches
    found = estimate_motion(rotate_bad_camera(rig, 20.0, 0) if kind == "calibration" else rig, matches, method=method)
    assert is_only_bad_named(found, rig)
    assert kind in found.faults[0]
    assert (
        compute_rotation_degrees(compute_motion_error(pair, found))
        < 2 * compute_error_of_others(rig, pair, method) + 0.05
    )


def test_two_wrong_calibrations_are_found() -> None:
    rig, pair = make_zigzag_rig(8), make_scene(make_zigzag_rig(8), 1)
    faulty_rig = rotate_bad_camera(rig, 20.0, 1)
    wrong = RigidTransform.from_rotation(Rotation.from_rotvec([0.2, -0.2, 0.1])) * rig["cam_5"].camera_from_world
    faulty_rig = replace_camera(faulty_rig, replace(rig["cam_5"], camera_from_world=wrong))
    found = estimate_motion(faulty_rig, pair.matches)
    assert [text.split(":")[0] for text in found.faults] == ["camera cam_2", "camera cam_5"]
    assert compute_rotation_degrees(compute_motion_error(pair, found)) < 2 * compute_error_of_others(rig, pair)


def test_faulty_camera_of_two_is_not_named() -> None:
    rig = make_zigzag_rig(3).subset(["cam_1", BAD])
    found = estimate_motion(rotate_bad_camera(rig, 20.0, 0), make_scene(rig, 0).matches)
    assert found.faults == ()


@pytest.mark.parametrize(
    "rig",
    [make_zigzag_rig(4), arc(4, 20.0), pytest.param(dome(8), marks=pytest.mark.slow)],
    ids=["around", "arc", "dome"],
)
@pytest.mark.parametrize("kind", ["uniform", "static", "second_motion"])
def test_good_cameras_with_outliers_are_not_named(rig: Rig, kind: str) -> None:
    named = 0
    for seed in range(3):
        for turn in (2.0, 10.0):
            assert estimate_motion(rig, make_scene(rig, seed, turn).matches).faults == ()
            pair = make_scene(rig, seed, turn, outliers=0.3, outlier_kind=kind)
            named += bool(estimate_motion(rig, pair.matches).faults)
    # Two small motions are hard to distinguish from one that a wrongly calibrated camera sees.
    assert named <= (1 if kind == "second_motion" else 0)


def test_good_camera_with_background_is_restored() -> None:
    # Seeds at which a camera fitted the background and biased the others.
    rig, body = arc(8, 20.0), box((0.2, 0.15, 0.1))
    for seed in (0, 1):
        rng = np.random.default_rng(seed)
        pair = simulate_matches(rig, body, random_motion(10.0, 0.02, rng), rng=rng, outliers=0.5, outlier_kind="static")
        found = estimate_motion(rig, pair.matches)
        assert found.status is Status.OK
        assert found.faults == ()
        assert found.n_inliers.min() > 0


def test_result_is_deterministic() -> None:
    rig = make_zigzag_rig(6)
    pair, faulty_rig = make_scene(rig, 3), rotate_bad_camera(rig, 10.0, 3)
    first, again = (estimate_motion(faulty_rig, pair.matches) for _ in range(2))
    assert first.motion is not None
    assert again.motion is not None
    np.testing.assert_array_equal(first.motion.as_matrix(), again.motion.as_matrix())
    assert first.faults == again.faults


@pytest.mark.parametrize("count", [4, 8])
@pytest.mark.parametrize("signs", [(1.0, -1.0), (-1.0, 1.0)])
def test_pixels_along_other_axes_are_never_wrong_and_ok(count: int, signs: tuple[float, float]) -> None:
    """Counted up or to the left, pixels of each camera show a motion, and the cameras contradict each other."""
    rig, statuses = make_zigzag_rig(count), set()
    for seed in range(8):
        pair = make_scene(rig, seed)
        found = estimate_motion(rig, [Matches(m.x * signs, m.y * signs) for m in pair.matches])
        assert estimate_motion(rig, pair.matches).status is Status.OK
        statuses.add(found.status)
        if found.status is Status.NOT_CONSISTENT and found.faults:
            causes = (
                "right and down from the upper left corner",
                "mirrored" if signs[0] < 0 else "flipped vertically",
            )
            assert any(cause in found.faults[0] for cause in causes)
    assert Status.OK not in statuses
    assert Status.NOT_CONSISTENT in statuses
