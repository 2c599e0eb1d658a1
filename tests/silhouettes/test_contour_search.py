"""Search for poses by silhouettes alone: covers of SO(3), bodies with and without symmetry, evidence, nothing to find."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.silhouettes.background import Silhouette
from sylpose.silhouettes.contour_search import MAX_CHANCE, cover_rotations, is_less_likely, search_contour_poses
from sylpose.silhouettes.contours import Outline
from tests.silhouettes.test_contours import RIG, draw_outlines, draw_pose, error_of, join, make_box, make_bracket


def test_rotations_cover_all() -> None:
    cover, others = cover_rotations(1000), Rotation.random(300, rng=np.random.default_rng(1))
    nearest = [(cover * other.inv()).magnitude().min() for other in others]
    assert np.degrees(np.max(nearest)) < 22
    assert np.degrees(np.median(nearest)) < 13


def test_body_is_found_without_a_start() -> None:
    mesh, pose = make_bracket(), draw_pose(11)
    (found,) = search_contour_poses(mesh, draw_outlines(mesh, RIG, pose))
    assert found.is_unique
    error = error_of(found.world_from_object, pose)
    assert np.degrees(np.linalg.norm(error[:3])) < 0.1
    assert np.linalg.norm(error[3:]) < 5e-4 * 1.5


def test_camera_that_looks_away_does_not_matter() -> None:
    mesh, pose = make_bracket(), draw_pose(11)
    outlines = draw_outlines(mesh, RIG, pose)
    turn = RigidTransform.from_rotation(Rotation.from_rotvec([0, np.pi, 0]))
    last = outlines[-1]
    away = replace(last.camera, camera_from_world=turn * last.camera.camera_from_world)
    empty = Outline.of(away, Silhouette.from_mask(np.zeros(last.distance.shape, bool)))
    found = search_contour_poses(mesh, [*outlines[:-1], empty])
    assert np.degrees(np.linalg.norm(error_of(found[0].world_from_object, pose)[:3])) < 0.1


def test_all_poses_of_a_block_are_found() -> None:
    """A block looks the same after half a turn about each of its axes: four poses, one of them true."""
    mesh, pose = join(make_box([1.0, 0.7, 0.5])), draw_pose(12)
    found = search_contour_poses(mesh, draw_outlines(mesh, RIG, pose))
    assert not any(alignment.is_unique for alignment in found)
    turns = [(pose.rotation.inv() * alignment.world_from_object.rotation).as_rotvec() for alignment in found]
    half_turns = np.pi * np.concatenate([np.zeros((1, 3)), np.eye(3)])
    for expected in half_turns:
        seen = [(Rotation.from_rotvec(turn) * Rotation.from_rotvec(expected)).magnitude() for turn in turns]
        assert np.degrees(np.min(seen)) < 0.2


def test_twin_is_found_before_an_unknown_background() -> None:
    """A body with a handle looks the same after half a turn about it; a part of each image is not known."""
    mesh, pose = join(make_box([1.0, 0.8, 1.2]), make_box([0.6, 0.2, 0.8], [0.7, 0, 0])), draw_pose(14)
    outlines = []
    for outline in draw_outlines(mesh, RIG, pose):
        is_known = outline.is_known.copy()
        is_known[: int(outline.camera.project(pose.translation)[0, 1])] = False
        pixels = outline.pixels[is_known[outline.pixels[:, 1], outline.pixels[:, 0]]]
        outlines.append(replace(outline, is_known=is_known, pixels=pixels))
    found = search_contour_poses(mesh, outlines)
    assert not any(alignment.is_unique for alignment in found)
    for twin in (Rotation.identity(), Rotation.from_rotvec([np.pi, 0, 0])):
        errors = [(pose.rotation * twin * a.world_from_object.rotation.inv()).magnitude() for a in found]
        assert np.degrees(np.min(errors)) < 1


def test_sectors_that_differ_by_chance_are_no_evidence() -> None:
    rng = np.random.default_rng(15)
    symmetric = 1e3 * rng.standard_cauchy((20_000, 48))
    assert np.mean([is_less_likely(losses, np.zeros(48)) for losses in symmetric]) < MAX_CHANCE
    one, many = 1e4 * np.eye(48)[0], np.full(48, 1.0)
    assert not is_less_likely(one, np.zeros(48))
    assert is_less_likely(many, np.zeros(48))


def test_no_pose_without_an_object() -> None:
    mesh, pose = make_bracket(), draw_pose(13)
    away = RigidTransform.from_translation([0, 50.0, 0]) * pose
    assert search_contour_poses(mesh, draw_outlines(mesh, RIG, away)) == []
