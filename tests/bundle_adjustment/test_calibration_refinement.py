"""The calibration refined with the poses: exact without noise, nearer the truth with it, honest either way."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.calibration import common, disturbed, path, pose_errors, scored, seen_as, tracked
from benchmarks.translation_only import tracks
from sylpose.bundle_adjustment.bundle import Bundled, Observations, bundle
from sylpose.bundle_adjustment.calibration_refinement import (
    Moved,
    corrected,
    lens_slopes,
    usual_doubt,
    with_doubt,
    with_moved,
)
from sylpose.bundle_adjustment.camera_parameters import offsets_and_surfaces, usual_surfaces
from sylpose.geometry.arrays import FloatArray
from sylpose.results import Status
from sylpose.rig import Rig
from sylpose.simulate import box, ring
from sylpose.smoothing.trajectory import smooth

LENS = (-0.2, 0.05, 0.0004, -0.0003, 0)
RIG = ring(4, 1.5, 1000.0, height=(0.4, -0.1, 0.2, 0.5), distortion=LENS)
BODY = box((0.3, 0.24, 0.26))
TRUE = path(14, 100.0)


def refined(told: Rig, seen: Observations, *, recalibrate: bool = True) -> Bundled:
    return bundle(told, seen, TRUE, BODY.radius, doubt=usual_doubt(told), recalibrate=recalibrate)


def left(rig: Rig) -> FloatArray:
    """(2,) rms degrees and millimetres that the cameras are off."""
    return np.asarray(np.sqrt((common(rig, RIG)[3] ** 2).mean(axis=0)))


@pytest.mark.parametrize("lens", [np.zeros(4), np.array([0.02, 8.0, -5.0, 0.03])])
def test_lens_slopes(lens: FloatArray) -> None:
    rng = np.random.default_rng(0)
    image, cameras = rng.uniform(-0.4, 0.4, (40, 2)), np.repeat(np.arange(4), 10)
    moved, slopes = lens_slopes(RIG, cameras, image, [lens] * 4)
    values = np.zeros((4, 14))
    for change in (np.zeros(4), np.array([1e-4, 0.1, 0.1, 1e-4])):
        values[:, 10:] = lens + change
        now = corrected(RIG, values)
        pixels = [c.denormalize(image[cameras == k]) for k, c in enumerate(RIG)]
        expected = np.concatenate([c.normalize(p) for c, p in zip(now, pixels, strict=True)])
        np.testing.assert_allclose(moved + slopes[:, :2] @ (lens + change), expected, atol=2e-7)
    np.testing.assert_allclose(
        slopes[:, 2, 0], 1.0 / (1.0 + lens[0]), atol=1e-4
    )  # a pixel is as much larger as the lens is longer


def test_what_turns_all_cameras_is_no_error() -> None:
    doubt = usual_doubt(RIG)
    shared = with_doubt(offsets_and_surfaces(4, None, np.arange(4), *usual_surfaces(0.2, 4)), RIG, doubt)
    covariance = shared.flat @ shared.flat.T
    for turn, shift in ((np.array([1e-4, 2e-4, -1e-4]), np.zeros(3)), (np.zeros(3), np.array([1e-3, 0.0, 2e-3]))):
        world = RigidTransform.from_components(shift, Rotation.from_rotvec(turn))
        common = np.zeros((4, 14))
        for c, camera in enumerate(RIG):
            moved = camera.camera_from_world * world.inv()
            common[c, 4:7] = (moved.rotation * camera.camera_from_world.rotation.inv()).as_rotvec() / doubt.turn[c] ** 2
            common[c, 7:10] = (moved.inv().translation - camera.center) / doubt.shift[c] ** 2
        size = np.sum(
            common
            * common
            * np.concatenate([np.zeros(4), doubt.turn[:1].repeat(3) ** 2, doubt.shift[:1].repeat(3) ** 2, np.zeros(4)])
        )
        assert common.ravel() @ covariance @ common.ravel() < 1e-6 * size


@pytest.mark.parametrize("recalibrate", [False, True])
def test_groups_of_one_camera_that_say_nothing_add_nothing(recalibrate: bool) -> None:
    rig = Rig(RIG.cameras[:1])
    seen = tracks(BODY, TRUE, rig, 40, 0.3, 0)
    found = bundle(rig, seen, TRUE, BODY.radius, doubt=usual_doubt(rig), recalibrate=recalibrate)
    assert np.median(found.excess) < 1.4


def test_exact_without_noise() -> None:
    seen = tracks(BODY, TRUE, RIG, 40, 0.0, 0)
    found = refined(RIG, seen)
    assert found.correction is not None
    assert found.status is Status.OK
    assert left(found.correction.rig)[0] < 0.01
    told = disturbed(RIG, 2.0, 1)
    found = refined(told, seen_as(seen, RIG, told))
    assert found.correction is not None
    before, after = left(told), left(found.correction.rig)
    assert (after < 0.1 * before).all()
    assert [c.name for c in found.correction.rig] == [c.name for c in RIG]


def test_five_times_better_and_honest() -> None:
    ratios: list[FloatArray] = []
    normalised: list[float] = []
    given: list[float] = []
    for seed in range(2):
        told = disturbed(RIG, 3.0, seed)
        seen = seen_as(tracks(BODY, TRUE, RIG, 50, 0.3, seed), RIG, told)
        for recalibrate in (False, True):
            found = refined(told, seen, recalibrate=recalibrate)
            now = told if found.correction is None else found.correction.rig
            e = pose_errors(found.world_from_object, now, RIG, TRUE)[1:]
            nees = np.einsum("ni,nij,nj->n", e, np.linalg.inv(found.covariance[1:]), e)
            (normalised if recalibrate else given).append(np.median(nees))
        ratios.append(left(told) / left(now))
        assert (found.doubt_shares[1:] > 0.3).all()
    assert np.median(ratios) > 5.0
    assert 0.5 < np.mean(normalised) < 25.0  # the similarity by which they are compared has errors of its own
    assert 0.2 < np.mean(given) < 25.0  # six times as far off as is believed: nearly told
    assert (refined(RIG, seen, recalibrate=False).doubt_shares[0]) == 1.0


def test_an_exact_calibration_is_found_to_be_so() -> None:
    """It is not made much worse, and what is not known of it is not much of what is not known of the poses."""
    normalised: list[float] = []
    for seed in range(2):
        seen = tracks(BODY, TRUE, RIG, 50, 0.3, seed)
        found = refined(RIG, seen)
        assert found.correction is not None
        assert left(found.correction.rig)[0] < 0.05
        given = refined(RIG, seen, recalibrate=False)
        assert (given.doubt_shares[[1, 3]] < 0.25).all()
        e = pose_errors(given.world_from_object, RIG, RIG, TRUE)[1:]
        normalised.append(float(np.median(np.einsum("ni,nij,nj->n", e, np.linalg.inv(given.covariance[1:]), e))))
    assert 0.1 < np.mean(normalised) < 17.0


def test_a_camera_that_was_moved() -> None:
    """Two cameras in one: before and after, with one lens."""
    values = np.zeros((4, 14))
    values[1, 4:7] = np.deg2rad([0.8, -1.5, 1.0])
    values[1, 7:10] = [0.004, 0.0, -0.006]
    after = corrected(RIG, values)
    both = [tracks(BODY, TRUE, rig, 50, 0.2, 3) for rig in (RIG, after)]
    late = [s.frame >= 7 for s in both]
    parts = [(s, keep) for s, keep in zip(both, (~late[0], late[1]), strict=True)]
    # The same random numbers: the same landmarks, which go on after the bump.
    seen = Observations(
        *(np.concatenate([getattr(s, n)[k] for s, k in parts]) for n in ("frame", "camera", "landmark", "image"))
    )
    rig, doubt = with_moved(RIG, usual_doubt(RIG), [Moved(1, 7)])
    camera = np.where((seen.camera == 1) & (seen.frame >= 7), 4, seen.camera)
    found = bundle(rig, replace(seen, camera=camera), TRUE, BODY.radius, doubt=doubt, recalibrate=True)
    assert found.correction is not None
    assert found.correction.rig.names[4] == "cam_1 from frame 7"
    now = found.correction.rig.cameras
    step = (now[4].camera_from_world.rotation * now[1].camera_from_world.rotation.inv()).as_rotvec()
    assert np.rad2deg(np.linalg.norm(step - values[1, 4:7])) < 0.2
    np.testing.assert_array_equal(now[4].matrix, now[1].matrix)


@pytest.mark.parametrize(("degrees", "seed"), [(0.0, 3), (3.0, 4)])
def test_errors_that_are_alike_are_no_calibration(degrees: float, seed: int) -> None:
    """Of tracked images, whose neighbouring features err alike: an exact rig stays nearly so, one that is off is mended."""
    tracked_frames, told, rig, true = tracked(seed, degrees, frames=30)
    found = smooth(tracked_frames, told, doubt=usual_doubt(told), recalibrate=True)
    assert found.correction is not None
    poses = [pose for pose in found.poses if pose.measured]
    stacked = RigidTransform.concatenate([p.world_from_object for p in poses if p.world_from_object is not None])
    covariance = np.array([pose.covariance for pose in poses])
    off, _, _, _, last, nees = scored(stacked, covariance, found.correction.rig, rig, true[[p.index for p in poses]])
    assert 0.2 < nees < 9.0
    if degrees:
        assert off < common(told, rig)[3][:, 0].mean() / 5.0
    else:
        assert np.sqrt(np.mean((found.correction.values / found.correction.sd) ** 2)) < 1.0
        assert off < 0.25
        assert last < 5.0
