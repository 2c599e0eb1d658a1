"""Refinement of small rotations from two starts.

A start that loses the frame that determines the surface is rejected; slides with an uncertain rotation have a
consistent covariance.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.translation_only import DIRECTIONS, RIGS, compute_pose_error, refine_simulated, simulate_poses
from sylpose.bundle_adjustment.bundle import BundleOptions, BundleResult, Observations, bundle_adjust
from sylpose.bundle_adjustment.scale_prior import bundle_adjust_with_scale, has_lost_frame
from sylpose.geometry.arrays import FloatArray
from sylpose.simulate import arc, plane

RADIUS, NOISE_PX, REST = 0.2, 0.15, 10
RIG = arc(2, 35, 2.5)


def make_board_scene(seed: int, turn: float = 7.0) -> tuple[RigidTransform, Observations, FloatArray]:
    """Return a board before two cameras that is almost static and has rotated in the last frame.

    Its poses, its observations, and their positions on it.
    """
    rng, points = np.random.default_rng(seed), plane((0.3, 0.3)).points
    start, axis = Rotation.random(rng=rng), rng.standard_normal(3)
    tremble = np.radians(rng.normal(0, 0.1, (REST, 3)))
    tremble[0] = 0.0
    turns = Rotation.from_rotvec(np.vstack([tremble, np.radians(turn) * axis / np.linalg.norm(axis)]))
    place = np.vstack([np.zeros(3), rng.normal(0, 0.0005, (REST - 1, 3)), 0.02 * rng.standard_normal(3)])
    poses = RigidTransform.from_components(place, turns * start)
    rows, images, landmarks, count = [], [], [], 0
    for c, camera in enumerate(RIG):
        own = points[rng.choice(len(points), 100, replace=False)]
        for k in range(REST + 1):
            kept = np.flatnonzero(rng.random(len(own)) < 0.8)
            seen = camera.camera_from_world.apply(poses[k].apply(own[kept]))
            rows += [(k, c, count + i) for i in kept]
            images.append(seen[:, :2] / seen[:, 2:] + NOISE_PX / camera.focal * rng.standard_normal((len(kept), 2)))
        landmarks.append(own)
        count += len(own)
    frame, camera_of, landmark = np.array(rows).T
    return poses, Observations(frame, camera_of, landmark, np.concatenate(images)), np.concatenate(landmarks)


def test_frame_that_determines_the_surface_is_kept() -> None:
    """Without it all other frames agree better, with any surface."""
    squares, wide = [], 0
    for seed in range(12):
        poses, seen, landmarks = make_board_scene(seed)
        found = bundle_adjust_with_scale(
            RIG, seen, poses, RADIUS, BundleOptions(landmarks=landmarks, max_iterations=12)
        )
        off = (found.world_from_object[-1].rotation * poses[-1].rotation.inv()).as_rotvec()
        squares.append(float(off @ np.linalg.solve(found.covariance[-1, :3, :3], off)))
        assert np.degrees(np.linalg.norm(off)) < 1.0
        wide += bool(np.degrees(np.sqrt(np.linalg.eigvalsh(found.covariance[-1, :3, :3])[-1])) > 1.5)
    # The mean is three for a correct covariance; a covariance of degrees would be consistent with anything.
    assert 1.0 < np.median(squares) < 8.0
    assert wide <= 1


@pytest.mark.slow
def test_slides_of_flat_and_thin_bodies_along_the_view() -> None:
    """Noise taken for relief rotates them by degrees: the covariance must cover that, and not more."""
    squares, degrees = [], []
    for seed, name, where in product((3, 203), ("board", "rod"), ("2 in 40°", "3 in 60°")):
        found = refine_simulated(name, RIGS[where], "slide", DIRECTIONS[3], 1.0, seed, 10)
        off = compute_pose_error(simulate_poses(10, DIRECTIONS[3], "slide")[-1], found.world_from_object[-1])
        squares.append(float(off @ np.linalg.solve(found.covariance[-1], off)))
        degrees.append(float(np.degrees(np.linalg.norm(off[:3]))))
    assert max(degrees) > 1.0
    assert 2.0 < np.mean(squares) < 9.0
    assert max(squares) < 30.0


def refined(seed: int) -> tuple[BundleResult, Observations]:
    poses, seen, landmarks = make_board_scene(seed)
    return bundle_adjust(RIG, seen, poses, RADIUS, BundleOptions(landmarks=landmarks)), seen


def test_has_lost_frame() -> None:
    found, seen = refined(0)
    everything = np.ones(len(seen), bool)
    without = replace(found, weights=np.where(seen.frame == REST, 0.0, found.weights))
    fewer = replace(
        found, weights=np.where((seen.frame == REST) & (np.arange(len(seen)) % 10 == 0), 0.0, found.weights)
    )
    assert has_lost_frame(without, found, seen, everything)
    assert not has_lost_frame(found, without, seen, everything)
    assert not has_lost_frame(found, found, seen, everything)
    assert not has_lost_frame(fewer, found, seen, everything)
    # Uncounted observations are ignored, as is a frame that neither explains.
    assert not has_lost_frame(without, found, seen, seen.frame != REST)
    assert not has_lost_frame(without, replace(fewer, weights=np.where(seen.frame == REST, 0.0, 1.0)), seen, everything)
