"""Pose of a known model from many cameras: exact, robust, and consistent about unobservable directions."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose import simulate
from sylpose.absolute_pose.p3p import solve_p3p
from sylpose.absolute_pose.pose import estimate_pose
from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.results import Motion
from sylpose.rig import Camera, Rig
from sylpose.status import Status

BODY = simulate.ellipsoid((0.15, 0.12, 0.10))
BOARD = simulate.plane((0.3, 0.3))
LENS = (-0.3, 0.12, 0.001, -0.001, 0.0)


@dataclass(frozen=True)
class Scene:
    """Observations of a body, and the ground truth."""

    rig: Rig
    points: list[FloatArray]
    pixels: list[FloatArray]
    wrong: list[BoolArray]
    truth: RigidTransform

    def error(self, found: Motion) -> FloatArray:
        """Return the (6,) error of (w, d): radians, and the translation of the model's center."""
        assert found.motion is not None, found.status
        turn = (self.truth.rotation * found.motion.rotation.inv()).as_rotvec()
        return np.concatenate([turn, self.truth.apply(found.center) - found.motion.apply(found.center)])


def rig_of(n: int) -> Rig:
    return simulate.arc(n, 50.0, height=0.3) if n < 4 else simulate.dome(n)


def scene_of(
    rig: Rig,
    seed: int,
    per_camera: int = 60,
    *,
    noise_px: float = 0.5,
    outliers: float = 0.0,
    second: bool = False,
    junk: int = 0,
    body: simulate.Body = BODY,
) -> Scene:
    """Return points of a body near the origin; each camera observes those that face it, and the model's frame is off
    its
    center."""
    rng = np.random.default_rng(seed)
    offset, place = np.array([0.3, -0.2, 0.5]), rng.uniform(-0.1, 0.1, 3)
    # A board is viewed at an angle, not edge-on.
    turns = [
        Rotation.random(rng=rng) if body is BODY else Rotation.from_rotvec(rng.uniform(-1, 1, 3)) for _ in range(2)
    ]
    truth, other = (
        RigidTransform.from_components(p - r.apply(offset), r)
        for p, r in zip((place, place + rng.uniform(-0.1, 0.1, 3)), turns, strict=True)
    )
    points, pixels, wrong = [], [], []
    for c, camera in enumerate(rig):
        placed = truth.apply(body.points + offset)
        towards = camera.center - placed
        faces = np.einsum("ni,ni->n", turns[0].apply(np.array(body.normals)), towards) > 0.1 * np.linalg.norm(
            towards, axis=1
        )
        chosen = rng.permutation(np.flatnonzero(faces | ~body.normals.any(axis=1)))[:per_camera]
        image = camera.project(placed[chosen])
        bad = np.zeros(len(chosen), bool)
        bad[: len(chosen) if c < junk else round(outliers * len(chosen))] = True
        if second:
            image[bad] = camera.project(other.apply(body.points[chosen[bad]] + offset))
        else:
            image[bad] = rng.uniform(image.min(axis=0), image.max(axis=0), (bad.sum(), 2))
        points.append(body.points[chosen] + offset)
        pixels.append(image + noise_px * rng.standard_normal(image.shape))
        wrong.append(bad)
    return Scene(rig, points, pixels, wrong, truth)


def solve(scene: Scene, seed: int = 0) -> Motion:
    return estimate_pose(scene.rig, scene.points, scene.pixels, seed=seed)


def degrees_mm(error: FloatArray) -> tuple[float, float]:
    return float(np.rad2deg(np.linalg.norm(error[:3]))), 1e3 * float(np.linalg.norm(error[3:]))


@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    cameras=st.sampled_from([1, 2, 4, 16]),
    per_camera=st.sampled_from([6, 20]),
    body=st.sampled_from([BODY, BOARD]),
)
def test_exact_without_noise(seed: int, cameras: int, per_camera: int, body: simulate.Body) -> None:
    scene = scene_of(rig_of(cameras), seed, per_camera, noise_px=0.0, body=body)
    found = solve(scene)
    if cameras == 1 and (body is BOARD or per_camera == 6) and found.status is Status.ROTATION_NOT_OBSERVABLE:
        return  # the noise prior is not zero, and another pose may be as likely
    assert found.status is Status.OK
    assert np.abs(scene.error(found)).max() < 1e-9
    assert all(mask.all() for mask in found.inliers)


@pytest.mark.parametrize(("size", "noise", "n", "least"), [(0.06, 0.1, 20, 30), (0.12, 0.3, 4, 20), (0.2, 0.6, 8, 30)])
def test_flat_models_are_not_confused_with_mirror_images(size: float, noise: float, n: int, least: int) -> None:
    """Two tilts look nearly alike: ambiguity is reported, and wrong results of status OK are very rare."""
    rng, rig, found, wrong = np.random.default_rng(3), simulate.arc(1, 0, 1.5, 500, (480, 360)), 0, 0
    camera = rig.cameras[0]
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * size / 2
    for _ in range(100):
        points = square if n == 4 else np.column_stack([rng.uniform(-size / 2, size / 2, (n, 2)), np.zeros(n)])
        axis, spin = rng.uniform(0, 2 * np.pi), Rotation.from_rotvec([0, 0, rng.uniform(0, 2 * np.pi)])
        tilt = Rotation.from_rotvec(rng.uniform(0, 1.2) * np.array([np.cos(axis), np.sin(axis), 0]))
        towards = Rotation.from_matrix(camera.rotation.T) * Rotation.from_rotvec([np.pi, 0, 0])
        truth = RigidTransform.from_components(0.1 * rng.normal(size=3), towards * tilt * spin)
        pixels = camera.project(truth.apply(points)) + noise * rng.normal(size=(n, 2))
        scene = Scene(rig, [points], [pixels], [np.zeros(n, bool)], truth)
        pose = solve(scene)
        if pose.status is Status.OK:
            off = scene.error(pose)
            found += 1
            wrong += bool(np.linalg.norm(off[:3]) > 0.2 and off @ pose.information @ off > 38.0)
    assert found > least
    assert wrong <= 1


@pytest.mark.parametrize("lens", ["opencv", "fisheye"])
def test_lens_distortion_is_removed(lens: str) -> None:
    coefficients = LENS if lens == "opencv" else (0.1, -0.05, 0.01, 0.002)
    rig = Rig([replace(c, distortion=np.array(coefficients), lens=lens) for c in rig_of(4)])  # type: ignore[arg-type]
    scene = scene_of(rig, 3, noise_px=0.0)
    assert np.abs(scene.error(solve(scene))).max() < 1e-7


@pytest.mark.parametrize("central", [True, False])
def test_p3p_poses_are_exact(central: bool) -> None:
    rng = np.random.default_rng(0)
    rotations, places = np.empty((8, 3, 3)), np.empty((8, 3))
    hits = 0
    for _ in range(300):
        model = rng.standard_normal((3, 3))
        rotation, place = Rotation.random(rng=rng).as_matrix(), rng.uniform(-1, 1, 3)
        points = model @ rotation.T + place
        origins = np.tile(rng.uniform(4, 6, 3), (3, 1)) if central else 6.0 * rng.standard_normal((3, 3))
        rays = points - origins
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        n = solve_p3p(origins, rays, model, rotations, places)
        hit = False
        for r, g in zip(rotations[:n], places[:n], strict=True):
            assert np.allclose(r @ r.T, np.eye(3), atol=1e-9)
            assert np.linalg.det(r) == pytest.approx(1.0)
            offsets = model @ r.T + g - origins
            assert np.abs(np.cross(offsets, rays)).max() < 1e-3
            assert np.einsum("ij,ij->i", offsets, rays).min() > 0
            hit |= np.abs(r - rotation).max() + np.abs(g - place).max() < 1e-3
        hits += hit
    # Two very close poses may both be missed.
    assert hits >= 0.97 * 300


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("body", [BODY, BOARD])
def test_matches_solve_pnp(seed: int, body: simulate.Body) -> None:
    camera = replace(rig_of(1).cameras[0], distortion=np.array(LENS))
    scene = scene_of(Rig([camera]), seed, body=body)
    found = solve(scene)
    start = camera.camera_from_world * scene.truth
    _, w, t = cv2.solvePnP(
        scene.points[0],
        scene.pixels[0],
        camera.matrix,
        camera.distortion,
        start.rotation.as_rotvec(),
        start.translation.copy(),
        useExtrinsicGuess=True,
        flags=cv2.SOLVEPNP_ITERATIVE,
    )
    pnp = RigidTransform.from_components(t[:, 0], Rotation.from_rotvec(w[:, 0]))
    e = replace(scene, truth=camera.camera_from_world.inv() * pnp).error(found)
    # Robust weights cost a hundredth of the variance: the two differ by a tenth of a standard deviation.
    assert e @ found.information @ e < 6 * 0.2**2


@pytest.mark.parametrize("seed", range(5))
def test_equivariance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = scene_of(rig_of(4), seed, outliers=0.2)
    first = solve(scene)
    world, model = (RigidTransform.from_components(rng.standard_normal(3), Rotation.random(rng=rng)) for _ in range(2))
    moved = Rig([replace(c, camera_from_world=c.camera_from_world * world.inv()) for c in scene.rig])
    found = estimate_pose(moved, [model.apply(p) for p in scene.points], scene.pixels)
    assert first.motion is not None
    assert found.motion is not None
    gap = (world * first.motion * model.inv()).as_matrix() - found.motion.as_matrix()
    assert np.abs(gap).max() < 1e-6
    turn = np.kron(np.eye(2), world.rotation.as_matrix())
    assert np.allclose(turn @ first.covariance @ turn.T, found.covariance, rtol=1e-3, atol=1e-12)
    order = rng.permutation(4)
    shuffles = [rng.permutation(len(scene.points[c])) for c in order]
    found = estimate_pose(
        Rig([scene.rig.cameras[c] for c in order]),
        [scene.points[c][s] for c, s in zip(order, shuffles, strict=True)],
        [scene.pixels[c][s] for c, s in zip(order, shuffles, strict=True)],
    )
    assert found.motion is not None
    assert np.abs((first.motion.inv() * found.motion).as_matrix() - np.eye(4)).max() < 1e-6
    for k, c in enumerate(order):
        assert np.array_equal(first.inliers[c][shuffles[k]], found.inliers[k])


def test_seeds_are_deterministic_and_agree() -> None:
    scene = scene_of(rig_of(4), 1, outliers=0.3)
    first, again, other = solve(scene), solve(scene), solve(scene, seed=7)
    assert first.motion is not None
    assert again.motion is not None
    assert other.motion is not None
    assert np.array_equal(first.motion.as_matrix(), again.motion.as_matrix())
    assert np.array_equal(first.covariance, again.covariance)
    assert np.allclose(first.motion.as_matrix(), other.motion.as_matrix(), atol=1e-6)


@pytest.mark.parametrize(
    ("cameras", "per_camera", "options", "degrees", "mm"),
    [
        (1, 60, {"outliers": 0.5}, 0.5, 3.0),
        (1, 60, {"outliers": 0.3, "second": True}, 0.5, 3.0),
        (2, 60, {"outliers": 0.5}, 0.3, 0.5),
        (4, 60, {"outliers": 0.5}, 0.15, 0.3),
        (4, 60, {"outliers": 0.45, "second": True}, 0.15, 0.3),
        (4, 60, {"junk": 1, "outliers": 0.3}, 0.15, 0.3),
        (16, 2, {"outliers": 0.5}, 0.4, 0.7),
        (4, 60, {"outliers": 0.3, "body": BOARD}, 0.15, 0.3),
    ],
)
def test_outliers_do_not_matter(
    cameras: int, per_camera: int, options: dict[str, object], degrees: float, mm: float
) -> None:
    errors = []
    for seed in range(12):
        scene = scene_of(rig_of(cameras), seed, per_camera, **options)  # type: ignore[arg-type]
        found = solve(scene)
        errors.append(degrees_mm(scene.error(found)))
        taken, wrong = np.concatenate(found.inliers), np.concatenate(scene.wrong)
        assert (taken & wrong).sum() <= max(1, 0.03 * wrong.sum())
        assert (taken & ~wrong).sum() >= 0.95 * (~wrong).sum()
    assert np.median(errors, axis=0)[0] < degrees
    assert np.median(errors, axis=0)[1] < mm
    assert np.max(errors, axis=0)[0] < 5 * degrees


def alias_scene(seed: int, noise_px: float, is_region: bool) -> Scene:
    """Return matches of which a quarter agree with the truth and the others have random pixels.

    Those that agree are a region of the model, as of a partly visible object, or spread among the others, as the corners of
    an object that looks alike from its other side.
    """
    scene = scene_of(rig_of(3), seed, noise_px=0.0)
    rng = np.random.default_rng(seed)
    for c, points in enumerate(scene.points):
        order = np.argsort(points @ rng.standard_normal(3)) if is_region else rng.permutation(len(points))
        bad, image = order[len(points) // 4 :], scene.pixels[c]
        image += noise_px * rng.standard_normal(image.shape)
        image[bad] = rng.uniform(image.min(axis=0), image.max(axis=0), (len(bad), 2))
        scene.wrong[c][bad] = True
    return scene


def test_alias_is_not_a_pose() -> None:
    """Few inexact inliers among matches that disagree are no pose, although random matches never reach their number."""
    statuses = [solve(alias_scene(seed, 2.0, False)).status for seed in range(30)]
    assert Status.OK not in statuses


@pytest.mark.parametrize(("noise_px", "is_region"), [(0.5, False), (1.0, True)])
def test_minority_of_right_matches_is_a_pose(noise_px: float, is_region: bool) -> None:
    """Inliers that are exact among random matches, or nearly all matches of a region, give the pose."""
    found = [(scene, solve(scene)) for scene in (alias_scene(seed, noise_px, is_region) for seed in range(30))]
    right = [
        scene for scene, motion in found if motion.status is Status.OK and degrees_mm(scene.error(motion))[0] < 3.0
    ]
    assert len(right) >= 28


@pytest.mark.parametrize(
    ("cameras", "per_camera", "options"),
    [
        (1, 60, {"outliers": 0.3}),
        pytest.param(4, 60, {"outliers": 0.5}, marks=pytest.mark.slow),
        pytest.param(16, 2, {}, marks=pytest.mark.slow),
        (4, 30, {"body": BOARD, "noise_px": 1.0}),
    ],
)
def test_covariance_is_consistent(cameras: int, per_camera: int, options: dict[str, object]) -> None:
    nees = []
    for seed in range(150):
        scene = scene_of(rig_of(cameras), seed, per_camera, **options)  # type: ignore[arg-type]
        found = solve(scene)
        e = scene.error(found)
        nees.append(e @ np.linalg.solve(found.covariance, e))
    assert 5.0 < np.mean(nees) < 7.0


def test_information_matches_reprojection_errors() -> None:
    """Compare with numerical derivatives of the projections, with all weights 1."""
    scene = scene_of(Rig([replace(c, distortion=np.array(LENS)) for c in rig_of(4)]), 0, per_camera=300)
    found = solve(scene)
    assert found.motion is not None
    motion, center = found.motion, found.center

    def project(step: FloatArray) -> FloatArray:
        turned = Rotation.from_rotvec(step[:3]) * motion.rotation
        place = motion.apply(center) + step[3:]
        return np.concatenate(
            [c.project(turned.apply(p - center) + place).ravel() for c, p in zip(scene.rig, scene.points, strict=True)]
        )

    h = 1e-5
    jacobian = np.stack([(project(h * e) - project(-h * e)) / (2 * h) for e in np.eye(6)], axis=1)
    residual = project(np.zeros(6)) - np.concatenate(scene.pixels).ravel()
    expected = jacobian.T @ jacobian / (residual @ residual / (len(residual) - 6))
    scale = np.sqrt(np.diag(expected))
    assert np.abs((found.information - expected) / np.outer(scale, scale)).max() < 0.05
    of_camera = np.split(residual.reshape(-1, 2), 4)
    assert found.residuals == pytest.approx([np.sqrt((r**2).sum(axis=1).mean()) for r in of_camera], rel=0.02)


def test_noisy_camera_is_down_weighted() -> None:
    errors, alone = [], []
    for seed in range(20):
        scene = scene_of(rig_of(4), seed, noise_px=0.3)
        scene.pixels[0] += 0.8 * np.random.default_rng(seed).standard_normal(scene.pixels[0].shape)
        found = solve(scene)
        errors.append(np.linalg.norm(scene.error(found)[:3]))
        assert found.residuals[0] > 2 * np.max(found.residuals[1:])
        assert found.n_inliers[0] > 55
        without = Scene(Rig(scene.rig.cameras[1:]), scene.points[1:], scene.pixels[1:], scene.wrong[1:], scene.truth)
        alone.append(np.linalg.norm(without.error(solve(without))[:3]))
    assert np.mean(errors) < 1.1 * np.mean(alone)


def test_misrotated_camera_is_rejected() -> None:
    scene = scene_of(rig_of(4), 5)
    off = RigidTransform.from_rotation(Rotation.from_rotvec([0.0, np.deg2rad(2.0), 0.0]))
    first = scene.rig.cameras[0]
    rig = Rig([replace(first, camera_from_world=off * first.camera_from_world), *scene.rig.cameras[1:]])
    found = estimate_pose(rig, scene.points, scene.pixels)
    assert degrees_mm(scene.error(found))[0] < 0.3
    assert not found.inliers[0].any()


@pytest.mark.parametrize("cameras", [2, 3, 8])
@pytest.mark.parametrize("size", [1e-3, 0.6, 25.4, 1e3])
@pytest.mark.parametrize("body", [BODY, BOARD])
def test_wrong_model_scale_is_reported(cameras: int, size: float, body: simulate.Body) -> None:
    """Each camera alone estimates another distance; the required scale is reported."""
    scene = scene_of(rig_of(cameras), 11, 30, body=body)
    found = estimate_pose(scene.rig, [size * points for points in scene.points], scene.pixels)
    assert found.status is Status.NOT_CONSISTENT
    (fault,) = found.faults
    reported = re.search(r"if they were (\S+) times as large", fault)
    assert reported is not None
    assert float(reported[1]) == pytest.approx(1 / size, rel=0.05)


def test_contradicting_cameras_are_counted() -> None:
    """Two that agree outvote two that each support a different pose; one does not outvote one."""

    def turned(scene: Scene, degrees: dict[int, float]) -> Motion:
        by = {c: RigidTransform.from_rotation(Rotation.from_rotvec([0, np.deg2rad(a), 0])) for c, a in degrees.items()}
        cameras = [
            replace(camera, camera_from_world=by[c] * camera.camera_from_world) if c in by else camera
            for c, camera in enumerate(scene.rig)
        ]
        return estimate_pose(Rig(cameras), scene.points, scene.pixels)

    four, two = scene_of(rig_of(4), 3), scene_of(rig_of(2), 3)
    found = turned(four, {0: 10.0, 2: -20.0})
    assert found.status is Status.OK
    assert degrees_mm(four.error(found))[0] < 0.5
    assert [bool(mask.any()) for mask in found.inliers] == [False, True, False, True]
    assert turned(four, {0: 10.0, 2: -20.0, 3: 30.0}).status is Status.NOT_CONSISTENT
    one = turned(two, {1: 10.0})
    assert one.status is Status.NOT_CONSISTENT
    assert not one.faults  # no scale makes them agree


def on_a_line(n: int, points: int = 20) -> Scene:
    rng = np.random.default_rng(0)
    rig, truth = rig_of(n), RigidTransform.from_rotation(Rotation.random(rng=rng))
    line = np.linspace(-0.1, 0.1, points)[:, None] * rng.standard_normal(3)
    pixels = [c.project(truth.apply(line)) + 0.3 * rng.standard_normal((points, 2)) for c in rig]
    return Scene(rig, [line] * n, pixels, [np.zeros(points, bool)] * n, truth)


def first_few(cameras: int, n: int, copies: int = 1) -> Scene:
    scene = scene_of(rig_of(cameras), 0)
    points, pixels = (
        [np.repeat(a[: n // cameras], copies, axis=0) for a in part] for part in (scene.points, scene.pixels)
    )
    return replace(scene, points=points, pixels=pixels)


def far_away(size_px: float, body: simulate.Body) -> Scene:
    camera = simulate.make_look_at_camera("far", (0, 0, -0.2 * 1000 / size_px), (0, 0, 0), 1000.0, (1280, 960))
    return scene_of(Rig([camera]), 0, 40, body=body)


def in_one_place() -> Rig:
    return Rig(
        [
            simulate.make_look_at_camera(f"cam_{k}", (0, 0, -1.5), (0.3 * k, 0.2 * k, 0), 1000.0, (1280, 960))
            for k in (-1, 0, 1)
        ]
    )


def one_view() -> Scene:
    scene = scene_of(rig_of(4), 2)
    return replace(
        scene,
        points=[scene.points[0], *[np.empty((0, 3))] * 3],
        pixels=[scene.pixels[0], *[np.empty((0, 2))] * 3],
    )


@pytest.mark.parametrize(
    ("scene", "status"),
    [
        (first_few(4, 0), Status.TOO_FEW_MATCHES),
        (first_few(1, 3), Status.TOO_FEW_MATCHES),
        (first_few(1, 3, copies=20), Status.TOO_FEW_MATCHES),
        (first_few(4, 8, copies=20), Status.OK),
        (on_a_line(1), Status.ROTATION_NOT_OBSERVABLE),
        (on_a_line(4), Status.ROTATION_NOT_OBSERVABLE),
        (far_away(1.0, BODY), Status.ROTATION_NOT_OBSERVABLE),
        (far_away(5.0, BOARD), Status.ROTATION_NOT_OBSERVABLE),
        (scene_of(rig_of(1), 0, 6, junk=1), Status.NOT_CONSISTENT),
        (scene_of(rig_of(1), 0, junk=1), Status.NOT_CONSISTENT),
        (scene_of(rig_of(4), 0, junk=4), Status.NOT_CONSISTENT),
        (scene_of(rig_of(16), 0, 2, junk=16), Status.NOT_CONSISTENT),
        (scene_of(in_one_place(), 0), Status.OK),
        (one_view(), Status.OK),
    ],
)
def test_unobservable_scenes_have_their_status(scene: Scene, status: Status) -> None:
    found = solve(scene)
    assert found.status is status
    assert (found.motion is not None) == status.has_pose
    assert (len(found.unobservable) > 0) == (status is Status.ROTATION_NOT_OBSERVABLE)
    assert [len(mask) for mask in found.inliers] == [len(p) for p in scene.points]


def test_point_behind_a_camera_is_not_an_inlier() -> None:
    scene = scene_of(rig_of(4), 0)
    camera = scene.rig.cameras[0]
    # Mirrored at the camera's center a point has the same image, from behind.
    behind = scene.truth.inv().apply(2 * camera.center - scene.truth.apply(scene.points[0][:5]))
    scene.points[0][:5] = behind
    found = solve(scene)
    assert found.status is Status.OK
    assert not found.inliers[0][:5].any()
    assert found.inliers[0][5:].all()


def test_many_matches_terminate() -> None:
    scene = scene_of(rig_of(4), 0, 300, outliers=0.3)
    many = replace(
        scene,
        points=[np.tile(p, (200, 1)) for p in scene.points],
        pixels=[np.tile(u, (200, 1)) for u in scene.pixels],
    )
    found = solve(many)
    assert degrees_mm(scene.error(found))[0] < 0.1
    assert found.n_inliers.sum() > 0.69 * 240_000


def test_world_far_from_its_origin() -> None:
    scene = scene_of(rig_of(4), 0)
    there = RigidTransform.from_translation([5e5, 4e6, 100.0])
    rig = Rig([replace(c, camera_from_world=c.camera_from_world * there.inv()) for c in scene.rig])
    found, near = estimate_pose(rig, scene.points, scene.pixels), solve(scene)
    assert found.motion is not None
    assert near.motion is not None
    assert np.allclose((there.inv() * found.motion).as_matrix(), near.motion.as_matrix(), atol=1e-6)


def camera_named(name: str) -> Camera:
    return simulate.make_look_at_camera(name, (0, 0, -1), (0, 0, 0), 1000.0, (640, 480))


@pytest.mark.parametrize(
    ("points", "pixels", "message"),
    [
        ([np.zeros((4, 3))], [np.zeros((4, 2))] * 2, "points: 1 for 2 cameras"),
        ([np.zeros((4, 3))] * 2, [np.zeros((4, 2))], "pixels: 1 for 2 cameras"),
        ([np.zeros((4, 3)), np.zeros((4, 2))], [np.zeros((4, 2))] * 2, r"camera right: points must be \(n, 3\)"),
        ([np.zeros((4, 3))] * 2, [np.zeros((4, 2)), np.zeros((5, 2))], "camera right: 4 points but 5 pixels"),
        ([np.zeros((4, 3))] * 2, [np.zeros((4, 2)), np.full((4, 2), np.nan)], "camera right: pixels .* not finite"),
        ([np.full((4, 3), np.inf), np.zeros((4, 3))], [np.zeros((4, 2))] * 2, "camera left: points .* not finite"),
    ],
)
def test_bad_input(points: list[FloatArray], pixels: list[FloatArray], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        estimate_pose(Rig([camera_named("left"), camera_named("right")]), points, pixels)


@pytest.mark.parametrize("max_error_px", [0.0, -1.0, np.nan])
def test_bad_bound(max_error_px: float) -> None:
    with pytest.raises(ValueError, match="max_error_px"):
        estimate_pose(Rig([camera_named("a")]), [np.zeros((5, 3))], [np.zeros((5, 2))], max_error_px=max_error_px)
