"""Search for poses by silhouettes alone: covers of SO(3), a body without symmetry, a block, nothing to find."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.silhouettes.contour_search import cover_rotations, search_contour_poses
from tests.silhouettes.test_contours import RIG, draw_outlines, draw_pose, error_of, join, make_box, make_bracket


def test_rotations_cover_all() -> None:
    cover, others = cover_rotations(1000), Rotation.random(300, rng=np.random.default_rng(1))
    nearest = [(cover * other.inv()).magnitude().min() for other in others]
    assert np.degrees(np.max(nearest)) < 22
    assert np.degrees(np.median(nearest)) < 13


def test_body_is_found_without_a_start() -> None:
    mesh, pose = make_bracket(), draw_pose(11)
    (found,) = search_contour_poses(mesh, draw_outlines(mesh, RIG, pose))
    error = error_of(found.world_from_object, pose)
    assert np.degrees(np.linalg.norm(error[:3])) < 0.1
    assert np.linalg.norm(error[3:]) < 5e-4 * 1.5


def test_all_poses_of_a_block_are_found() -> None:
    """A block looks the same after half a turn about each of its axes: four poses, one of them true."""
    mesh, pose = join(make_box([1.0, 0.7, 0.5])), draw_pose(12)
    found = search_contour_poses(mesh, draw_outlines(mesh, RIG, pose))
    turns = [(pose.rotation.inv() * alignment.world_from_object.rotation).as_rotvec() for alignment in found]
    half_turns = np.pi * np.concatenate([np.zeros((1, 3)), np.eye(3)])
    for expected in half_turns:
        seen = [(Rotation.from_rotvec(turn) * Rotation.from_rotvec(expected)).magnitude() for turn in turns]
        assert np.degrees(np.min(seen)) < 0.2


def test_no_pose_without_an_object() -> None:
    mesh, pose = make_bracket(), draw_pose(13)
    away = RigidTransform.from_translation([0, 50.0, 0]) * pose
    assert search_contour_poses(mesh, draw_outlines(mesh, RIG, away)) == []
