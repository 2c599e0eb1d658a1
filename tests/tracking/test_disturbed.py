"""The tracker with failing cameras, and with other moving things."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import Image
from sylpose.rig import Camera, Rig
from sylpose.simulate import Actor, chamfered_box
from sylpose.status import FrameStatus
from sylpose.tracking.options import TrackingOptions
from sylpose.tracking.tracker import track
from tests.clips import (
    BLACK,
    FRAMES,
    HALF_DEGREE,
    SIZE,
    Clip,
    Images,
    assert_valid,
    compute_pose_errors,
    frame_sets,
    inliers,
    make_drifting_pose,
    make_rotated_pose,
    make_slab,
    moving_scene,
    statuses,
)

# --- failing cameras


def test_camera_with_missing_frames(clip: Clip) -> None:
    images = [(a, None if k in (0, 4, 5) else b, c) for k, (a, b, c) in enumerate(clip.images)]
    for boxes in ({k: v for k, v in clip.boxes.items() if k != "cam_1"}, None):
        tracked = list(track(frame_sets(images), clip.rig, boxes))
        assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * (FRAMES - 1)
        error = compute_pose_errors(tracked, clip.truth)
        assert error[:, 0].max() < HALF_DEGREE
        assert error[:, 1].max() < 3.2
        seen = inliers(tracked)[:, 1]
        assert not seen[[0, 4, 5]].any()
        assert seen[7] > 20
        assert_valid(tracked)


def test_black_camera(clip: Clip) -> None:
    images = [(a, np.zeros_like(b), c) for a, b, c in clip.images]
    tracked = list(track(frame_sets(images), clip.rig, clip.boxes))
    assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * (FRAMES - 1)
    assert compute_pose_errors(tracked, clip.truth)[:, 0].max() < 0.8
    assert not inliers(tracked)[:, 1].any()
    assert_valid(tracked)


def test_camera_with_other_content(clip: Clip) -> None:
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 255, (240, 320, 3)).astype(np.uint8) for _ in clip.images]
    images = [(a, n, c) for (a, _, c), n in zip(clip.images, noise, strict=True)]
    tracked = list(track(frame_sets(images), clip.rig, clip.boxes))
    assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * (FRAMES - 1)
    assert compute_pose_errors(tracked, clip.truth)[:, 0].max() < 0.8


@pytest.mark.parametrize("method", ["landmarks", pytest.param("epipolar", marks=pytest.mark.slow)])
def test_all_cameras_missing_temporarily(clip: Clip, method: str) -> None:
    gone = (4, 5)
    images: list[Images] = [(None,) * 3 if k in gone else frame for k, frame in enumerate(clip.images)]
    tracked = list(track(frame_sets(images), clip.rig, clip.boxes, method=method))
    expected = [*[FrameStatus.TRACKED] * 3, *[FrameStatus.COASTING] * 2, FrameStatus.RELOCALIZED, FrameStatus.TRACKED]
    assert statuses(tracked) == [FrameStatus.FIRST, *expected]
    assert_valid(tracked)
    assert np.median(compute_pose_errors(tracked, clip.truth)[:, 0]) < HALF_DEGREE


def test_object_found_again_roughly_keeps_its_known_features(clip: Clip) -> None:
    """Nothing is learned from three rough poses, but each next frame is matched with their features."""
    images: list[Images] = [(None,) * 3 if k == 2 else frame for k, frame in enumerate(clip.images)]
    never = TrackingOptions(max_relocalized_rotation_sd=1e-9)
    tracked = list(track(frame_sets(images), clip.rig, clip.boxes, options=never))
    assert tracked[3].pose.status is FrameStatus.RELOCALIZED
    assert statuses(tracked[4:]) == [FrameStatus.TRACKED] * (FRAMES - 4)
    ids = [{(c, k) for c, own in enumerate(f.observations) for k in own.landmark_ids.tolist()} for f in tracked]
    known = ids[0] | ids[1]
    for rough in ids[3:6]:
        assert rough <= known
        assert len(rough) > 50
    assert ids[6] - known
    assert compute_pose_errors(tracked, clip.truth)[-1, 0] < 2 * HALF_DEGREE


@pytest.mark.parametrize(
    ("nothing", "with_boxes"),
    [
        pytest.param(None, True, marks=pytest.mark.slow),
        (None, False),
        pytest.param(BLACK, True, marks=pytest.mark.slow),
    ],
)
def test_initial_frames_without_features(clip: Clip, nothing: Image | None, with_boxes: bool) -> None:
    images: list[Images] = [(nothing,) * 3, (nothing,) * 3, *clip.images[:4]]
    tracked = list(track(frame_sets(images), clip.rig, clip.boxes if with_boxes else None))
    assert statuses(tracked) == [FrameStatus.TOO_FEW_MATCHES] * 2 + [FrameStatus.FIRST] + [FrameStatus.TRACKED] * 3
    found = [replace(f, pose=replace(f.pose, index=f.pose.index - 2)) for f in tracked[2:]]
    assert compute_pose_errors(found, clip.truth)[:, 0].max() < HALF_DEGREE


def test_all_frames_without_features(clip: Clip) -> None:
    images: list[Images] = [(None,) * 3] * 3
    for boxes in (clip.boxes, None):
        tracked = list(track(frame_sets(images), clip.rig, boxes))
        assert len(tracked) == 3
        assert all(f.pose.world_from_object is None for f in tracked)
        assert_valid(tracked)


def test_object_entering_view_of_camera(clip: Clip) -> None:
    """cam_1's image is cropped so that the object is out of view at first, and moves in."""
    camera = clip.rig.cameras[1]
    places = [camera.project(clip.truth.world_from_object[k].apply(clip.truth.vertices))[:, 0] for k in range(FRAMES)]
    to_the_right = places[-1].max() > places[0].max()
    cut = int(np.ceil(places[0].max() if to_the_right else places[0].min()))
    camera_tracker = slice(cut, None) if to_the_right else slice(None, cut)
    matrix = camera.matrix.copy()
    matrix[0, 2] -= cut if to_the_right else 0
    size = (SIZE[0] - cut if to_the_right else cut, SIZE[1])
    narrow = Camera(camera.name, size, matrix, camera.distortion, camera.camera_from_world)
    rig = Rig([clip.rig.cameras[0], narrow, clip.rig.cameras[2]])
    images = [(a, np.ascontiguousarray(b[:, camera_tracker]), c) for a, b, c in clip.images]
    boxes = {name: box for name, box in clip.boxes.items() if name != narrow.name}
    tracked = list(track(frame_sets(images), rig, boxes))
    assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * (FRAMES - 1)
    assert compute_pose_errors(tracked, clip.truth)[:, 0].max() < HALF_DEGREE
    seen = inliers(tracked)[:, 1]
    assert seen[1] < 5
    assert seen[-1] > 10


@pytest.mark.parametrize("names", [pytest.param(("cam_0", "cam_2"), marks=pytest.mark.slow), ("cam_0", "cam_1")])
def test_two_cameras_with_boxes(clip: Clip, names: tuple[str, str]) -> None:
    """Two boxes allow far more depth than the object has, which must not be used as its true depth."""
    rig = clip.rig.subset(names)
    picked = [clip.rig.names.index(name) for name in names]
    images = [tuple(frame[c] for c in picked) for frame in clip.images[:5]]
    tracked = list(track(frame_sets(images), rig, {name: clip.boxes[name] for name in names}))
    assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * 4
    assert compute_pose_errors(tracked, clip.truth)[:, 0].max() < (0.5 if names[1] == "cam_2" else 2)


def test_returning_camera_is_used_at_once(clip: Clip) -> None:
    images: list[Images] = [(a, None if k < 3 else b, c) for k, (a, b, c) in enumerate(clip.images)]
    boxes = {name: box for name, box in clip.boxes.items() if name != "cam_1"}
    seen = inliers(list(track(frame_sets(images), clip.rig, boxes)))[:, 1]
    assert not seen[:3].any()
    assert (seen[5:] > 20).all()


# --- other moving objects


NOWHERE = RigidTransform.from_translation([0, 9, 0])


@pytest.mark.parametrize("sides", [pytest.param((0.11, 0.13, 0.01), marks=pytest.mark.slow), (0.25, 0.3, 0.2)])
def test_occluder_passes_in_front(sides: tuple[float, float, float]) -> None:
    """Small, and as large as the object: it hides the object from some cameras and has features itself."""

    def crossing(frame: float) -> RigidTransform:
        return make_rotated_pose(2 * frame, [-0.5 + 0.05 * frame, -0.02, -0.4])

    clip = Clip.render(moving_scene(make_drifting_pose, 20, [Actor(make_slab(sides, 30), crossing)]))
    tracked = list(track(clip.frames(), clip.rig, clip.boxes))
    assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * 19
    error = compute_pose_errors(tracked, clip.truth)
    assert error[:, 0].max() < 0.8
    assert error[:, 1].max() < 4


@pytest.mark.parametrize(("gap", "seed"), [(0, 12), pytest.param(4, 11, marks=pytest.mark.slow)])
def test_other_body_in_same_place_is_rejected(gap: int, seed: int) -> None:
    """Of the same shape with different textures."""
    extent = np.ptp(moving_scene(make_drifting_pose, 1).actors[0].body.vertices, axis=0)
    other = chamfered_box(extent, 430, seed=seed)

    def path(frame: float) -> RigidTransform:
        return make_rotated_pose(3 * frame) if frame < 8 else NOWHERE

    def other_path(frame: float) -> RigidTransform:
        return NOWHERE if frame < 8 + gap else make_rotated_pose(3 * frame)

    clip = Clip.render(moving_scene(path, 12 + gap, [Actor(other, other_path)], n_cameras=3))
    tracked = list(track(clip.frames(), clip.rig, clip.boxes))
    assert statuses(tracked[1:8]) == [FrameStatus.TRACKED] * 7
    # A pose that it suggests is contradicted by the cameras.
    missed = {FrameStatus.COASTING, FrameStatus.LOST, FrameStatus.BACKGROUND_ONLY}
    assert set(statuses(tracked[8:])) <= missed | {FrameStatus.CONTRADICTED}


@pytest.mark.slow
def test_unknown_side_is_rejected() -> None:
    """The object returns rotated by 180 degrees about the vertical."""

    def path(frame: float) -> RigidTransform:
        if frame < 6:
            return make_rotated_pose(3 * frame)
        return NOWHERE if frame < 8 else RigidTransform.from_rotation(Rotation.from_rotvec([0, np.pi, 0]))

    clip = Clip.render(moving_scene(path, 10, n_cameras=3))
    tracked = list(track(clip.frames(), clip.rig, clip.boxes))
    assert statuses(tracked[1:6]) == [FrameStatus.TRACKED] * 5
    assert set(statuses(tracked[6:])) <= {FrameStatus.COASTING, FrameStatus.LOST, FrameStatus.BACKGROUND_ONLY}


@pytest.mark.parametrize(("is_alike", "angle_deg"), [(True, 0), (True, 180), (False, 0)])
def test_side_that_looks_alike_is_rejected(is_alike: bool, angle_deg: float) -> None:
    """A cube turns by 90 degrees, is gone, and comes back: if its faces are equal, any of them may be in front."""
    body = make_slab((0.25, 0.25, 0.25), 30)
    if is_alike:
        body = replace(body, textures=(body.textures[0],) * len(body.textures))

    def path(frame: float) -> RigidTransform:
        if 7 <= frame < 10:
            return NOWHERE
        turn = np.radians(15 * frame if frame < 7 else angle_deg)
        return RigidTransform.from_rotation(Rotation.from_rotvec([0, turn, 0]))

    clip = Clip.render(replace(moving_scene(path, 12, n_cameras=3), actors=(Actor(body, path),)))
    found = statuses(list(track(clip.frames(), clip.rig, clip.boxes)))
    assert found[1:7] == [FrameStatus.TRACKED] * 6
    assert (FrameStatus.RELOCALIZED in found) != is_alike
    assert (found[-1] is FrameStatus.TRACKED) != is_alike
