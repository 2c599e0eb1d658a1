"""The tracker on rendered sequences: accuracy, and status when nothing can be found."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from sylpose.frames import Box, FrameSet
from sylpose.geometry.arrays import BoolArray
from sylpose.methods import METHODS
from sylpose.rig import Camera, Rig
from sylpose.simulate import arc, make_demo_scene
from sylpose.status import FrameStatus, Observability
from sylpose.tracking.camera_side.frame import CameraFrame, project_outline, rasterize_outline
from sylpose.tracking.context import TrackedFrame
from sylpose.tracking.options import TrackingOptions
from sylpose.tracking.tracker import Tracker, track
from tests.clips import (
    FRAMES,
    HALF_DEGREE,
    SIZE,
    Clip,
    Images,
    Masks,
    assert_valid,
    compute_pose_errors,
    compute_squared_mahalanobis,
    frame_sets,
    inliers,
    prepend_rest,
    statuses,
    track_turning_clip,
)


@pytest.fixture(scope="module")
def tracked() -> tuple[TrackedFrame, ...]:
    return track_turning_clip(True)


# --- the main job


def test_with_boxes(clip: Clip, tracked: Sequence[TrackedFrame]) -> None:
    assert [f.pose.index for f in tracked] == list(range(FRAMES))
    np.testing.assert_allclose([f.pose.time for f in tracked], clip.truth.times)
    assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * (FRAMES - 1)
    error = compute_pose_errors(tracked, clip.truth)
    assert error[:, 0].max() < HALF_DEGREE
    assert error[:, 1].max() < 1.5
    assert (inliers(tracked)[1:] > 10).all()
    assert (inliers(tracked)[1:].sum(axis=1) > 150).all()
    assert_valid(tracked)


def test_without_boxes(clip: Clip) -> None:
    tracked = track_turning_clip(False)
    assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * (FRAMES - 1)
    error = compute_pose_errors(tracked, clip.truth)
    assert error[:, 0].max() < HALF_DEGREE
    assert error[:, 1].max() < 1.5
    assert_valid(tracked)


def test_object_frame_is_as_documented(clip: Clip, tracked: Sequence[TrackedFrame]) -> None:
    """Axes parallel to the world's, origin at the object's center, in the first frame."""
    first = tracked[0].pose.world_from_object
    assert first is not None
    np.testing.assert_array_equal(first.rotation.as_matrix(), np.eye(3))
    extent = np.ptp(clip.truth.vertices, axis=0).max()
    assert np.linalg.norm(first.translation - clip.truth.world_from_object[0].translation) < 0.2 * extent
    assert 0.3 * extent < tracked[0].radius < 1.5 * extent


def test_matches_and_regions_are_on_object(clip: Clip, tracked: Sequence[TrackedFrame]) -> None:
    shown = 0
    for f in tracked[1:]:
        vertices = clip.truth.world_from_object[f.pose.index].apply(clip.truth.vertices)
        for camera, matches, region in zip(clip.rig, f.matches, f.regions, strict=True):
            assert region is not None
            if matches is None:  # matches with other frames only
                continue
            shown += 1
            before, now = matches
            assert before.shape == now.shape
            outline = project_outline(camera, vertices, 0.0)
            assert outline is not None
            on_object = rasterize_outline(outline, camera.size)
            searched = rasterize_outline(region, camera.size)
            column, row = np.round(now).astype(int).T
            assert on_object[row, column].mean() > 0.9
            assert searched[row, column].mean() > 0.97
    assert shown >= 3


def test_late_start_and_skipped_frames(clip: Clip) -> None:
    frames = clip.frames()[1::2]
    tracked = list(track(frames, clip.rig))
    assert [f.pose.index for f in tracked] == [1, 3, 5, 7]
    assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * 3
    assert compute_pose_errors(tracked, clip.truth)[:, 0].max() < HALF_DEGREE


def test_cameras_of_different_sizes() -> None:
    rig = arc(3, 40, 1.2, 400, SIZE, height=(0.4, -0.1, 0.3))
    sizes = [(320, 240), (256, 320), (400, 200)]
    cameras = []
    for camera, size, focal in zip(rig, sizes, (420, 380, 400), strict=True):
        matrix = np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1]])
        cameras.append(Camera(camera.name, size, matrix, np.empty(0), camera.camera_from_world))
    clip = Clip.render(make_demo_scene(rig=Rig(cameras), frames=4, angle_deg=12))
    for boxes in (clip.boxes, None):
        tracked = list(track(clip.frames(), clip.rig, boxes))
        assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * 3
        assert compute_pose_errors(tracked, clip.truth)[:, 0].max() < HALF_DEGREE


# The first one is the tracker's default: `test_with_boxes`.
@pytest.mark.parametrize(
    "method",
    [pytest.param(m, marks=pytest.mark.slow if m == METHODS[0] else ()) for m in METHODS],
)
def test_all_methods_run(clip: Clip, method: str) -> None:
    tracked = list(track(clip.frames(), clip.rig, clip.boxes, method=method))
    assert statuses(tracked)[0] is FrameStatus.FIRST
    assert set(statuses(tracked)[1:]) == {FrameStatus.TRACKED}
    assert_valid(tracked)
    error = compute_pose_errors(tracked, clip.truth)
    if method == "sylvester":  # depth is ignored (docs/method/2-sylvester.md, "The paper"): it drifts
        assert error[0, 0] < 2.5
        assert error[:, 0].max() < 20
    elif method == "epipolar":  # in small images single frames are off by some degrees
        assert np.median(error[:, 0]) < HALF_DEGREE
        assert error[:, 0].max() < 4
    else:
        assert error[:, 0].max() < HALF_DEGREE


# --- static objects


@pytest.mark.parametrize("features", [pytest.param("sift", marks=pytest.mark.slow), "klt"])
def test_initially_static_object_in_box(features: str) -> None:
    """Landmarks with depths from boxes only age before the object moves."""
    clip = Clip.render(prepend_rest(make_demo_scene(frames=10, angle_deg=25, size=SIZE, n_cameras=3, seed=1), 6, 3))
    tracked = list(track(clip.frames(), clip.rig, clip.boxes, features=features))
    assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * 8
    assert compute_pose_errors(tracked, clip.truth)[:, 0].max() < HALF_DEGREE


@pytest.mark.parametrize("n_cameras", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_initially_static_object(n_cameras: int) -> None:
    rest, moving = 5, 4
    scene = make_demo_scene(frames=10, angle_deg=25, size=SIZE, n_cameras=n_cameras, seed=1)
    clip = Clip.render(prepend_rest(scene, rest, moving))
    given = []
    with Tracker(clip.rig) as tracker:
        for frame in clip.frames():
            given.append(tracker.step(frame))
        assert tracker.flush() == []
    # Results are held back until it moves, then returned at once and in order.
    counts = [len(g) for g in given]
    assert counts[:rest] == [0] * rest
    assert sum(counts) == rest + moving
    tracked = [f for g in given for f in g]
    assert [f.pose.index for f in tracked] == list(range(rest + moving))
    assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * (rest + moving - 1)
    error = compute_pose_errors(tracked, clip.truth)
    assert error[: rest - 1, 0].max() < 0.1
    assert error[: rest - 1, 1].max() < 0.3
    assert error[:, 0].max() < HALF_DEGREE
    assert error[:, 1].max() < (5 if n_cameras == 2 else 1.5)
    # The room was static too, but is not part of the object.
    assert (inliers(tracked)[rest + 1 :] > 20).all()
    assert_valid(tracked)


def test_long_static_object(clip: Clip) -> None:
    images = [clip.images[0]] * 6 + clip.images[1:4]
    with Tracker(clip.rig, options=TrackingOptions(max_buffered_frames=3)) as tracker:
        given = [tracker.step(frame) for frame in frame_sets(images)]
    tracked = [f for g in given for f in g]
    assert [f.pose.index for f in tracked] == list(range(9))
    # Memory is bounded: the oldest frames are dropped.
    first = statuses(tracked).index(FrameStatus.FIRST)
    assert 2 <= first <= 5
    assert statuses(tracked) == [FrameStatus.NO_MOTION] * first + [FrameStatus.FIRST] + [FrameStatus.TRACKED] * (
        8 - first
    )
    assert all(f.pose.world_from_object is None for f in tracked[:first])
    found = tracked[-1].pose.world_from_object
    assert found is not None
    true = clip.truth.world_from_object[3].rotation * clip.truth.world_from_object[0].rotation.inv()
    assert np.rad2deg((found.rotation * true.inv()).magnitude()) < HALF_DEGREE


def test_never_moving_object() -> None:
    scene = make_demo_scene(frames=2, size=SIZE, n_cameras=2)
    clip = Clip.render(prepend_rest(scene, 4, 0))
    tracked = list(track(clip.frames(), clip.rig))
    assert statuses(tracked) == [FrameStatus.NO_MOTION] * 4
    assert [f.pose.index for f in tracked] == [0, 1, 2, 3]
    assert all(f.pose.world_from_object is None for f in tracked)
    assert_valid(tracked)


@pytest.mark.parametrize(
    "method", ["landmarks", *(pytest.param(method, marks=pytest.mark.slow) for method in ("epipolar", "sylvester"))]
)
def test_pausing_object(clip: Clip, method: str) -> None:
    images = [*clip.images[:3], clip.images[2], clip.images[2], *clip.images[3:5]]
    tracked = list(track(frame_sets(images), clip.rig, clip.boxes, method=method))
    assert all(f.pose.world_from_object is not None for f in tracked)
    poses = [f.pose.world_from_object for f in tracked]
    for pose in poses[3:5]:
        assert pose is not None
        assert poses[2] is not None
        step = pose * poses[2].inv()
        assert np.rad2deg(step.rotation.magnitude()) < {"landmarks": 0.1, "epipolar": 2.0, "sylvester": 1.0}[method]
    assert_valid(tracked)


# --- masks


def silhouettes(clip: Clip) -> list[list[BoolArray]]:
    """Masks of the object, slightly enlarged."""
    masks = []
    for k in range(len(clip.images)):
        vertices = clip.truth.world_from_object[k].apply(clip.truth.vertices)
        outlines = [project_outline(camera, vertices, 0.0) for camera in clip.rig]
        masks.append(
            [rasterize_outline(o, camera.size) for o, camera in zip(outlines, clip.rig, strict=True) if o is not None]
        )
    return masks


def test_masks_bound_detection(clip: Clip) -> None:
    masks: list[Masks] = [list(m) for m in silhouettes(clip)]
    # The left half of the object in cam_0 is covered.
    for k, frame in enumerate(masks):
        covered = np.array(frame[0])
        covered[:, : int(np.flatnonzero(covered.any(axis=0)).mean())] = False
        masks[k] = [covered, *frame[1:]]
    tracked = list(track(frame_sets(clip.images, masks), clip.rig))
    assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * (FRAMES - 1)
    assert compute_pose_errors(tracked, clip.truth)[:, 0].max() < HALF_DEGREE
    for f, frame in zip(tracked[1:], masks[1:], strict=True):
        for matches, mask in zip(f.matches, frame, strict=True):
            assert mask is not None
            if matches is None:
                continue
            # Within a pixel, due to rounding at the border.
            near = np.pad(mask, 1)
            wide = near[:-2, 1:-1] | near[2:, 1:-1] | near[1:-1, :-2] | near[1:-1, 2:] | mask
            column, row = np.round(matches[1]).astype(int).T
            assert wide[row, column].all()


def test_empty_mask_excludes_camera(clip: Clip) -> None:
    masks: list[Masks] = [[m[0], np.zeros_like(m[1]), None] for m in silhouettes(clip)]
    tracked = list(track(frame_sets(clip.images, masks), clip.rig, clip.boxes))
    assert not inliers(tracked)[:, 1].any()
    assert (inliers(tracked)[1:, [0, 2]] > 20).all()
    assert compute_pose_errors(tracked, clip.truth)[:, 0].max() < 0.8


# --- one camera


@pytest.fixture(scope="module")
def monocular() -> Clip:
    return Clip.render(make_demo_scene(frames=6, angle_deg=22, size=(480, 360), n_cameras=1))


@pytest.mark.parametrize("with_boxes", [pytest.param(True, marks=pytest.mark.slow), False])
def test_single_camera_measures_rotation_without_scale(monocular: Clip, with_boxes: bool) -> None:
    tracked = list(track(monocular.frames(), monocular.rig, monocular.boxes if with_boxes else None))
    assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * 5
    assert [f.pose.observability for f in tracked[1:]] == [Observability.NO_SCALE] * 5
    assert_valid(tracked)
    assert compute_pose_errors(tracked, monocular.truth)[:, 0].max() < 2
    first = tracked[0].pose.world_from_object
    assert first is not None
    # At distance 1 from the camera.
    assert np.linalg.norm(first.translation - monocular.rig.cameras[0].center) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("method", ["epipolar", pytest.param("sylvester", marks=pytest.mark.slow)])
def test_single_camera_with_other_methods(monocular: Clip, method: str) -> None:
    tracked = list(track(monocular.frames(), monocular.rig, monocular.boxes, method=method))
    assert len(tracked) == 6
    assert statuses(tracked)[0] is FrameStatus.FIRST
    assert all(f.pose.observability is Observability.NO_SCALE for f in tracked[1:] if f.pose.is_measured)
    assert_valid(tracked)


def test_single_camera_relocalizes(monocular: Clip) -> None:
    images: list[Images] = [(None,) if k == 3 else frame for k, frame in enumerate(monocular.images)]
    tracked = list(track(frame_sets(images), monocular.rig, monocular.boxes))
    assert statuses(tracked)[3] is FrameStatus.COASTING
    # The status reports relocalization despite the unobservable scale.
    assert statuses(tracked)[4:] == [FrameStatus.RELOCALIZED, FrameStatus.TRACKED]
    assert [f.pose.observability for f in tracked[4:]] == [Observability.NO_SCALE] * 2


# --- reproducibility


def assert_same(a: Sequence[TrackedFrame], b: Sequence[TrackedFrame]) -> None:
    assert statuses(a) == statuses(b)
    for one, other in zip(a, b, strict=True):
        p, q = one.pose.world_from_object, other.pose.world_from_object
        assert (p is None) == (q is None)
        if p is not None and q is not None:
            np.testing.assert_array_equal(p.as_matrix(), q.as_matrix())
        np.testing.assert_array_equal(one.pose.covariance, other.pose.covariance)
        np.testing.assert_array_equal(one.pose.inliers, other.pose.inliers)
        np.testing.assert_array_equal(one.pose.residuals, other.pose.residuals)


@pytest.mark.parametrize("with_boxes", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_thread_count_does_not_change_results(clip: Clip, with_boxes: bool) -> None:
    boxes, frames = clip.boxes if with_boxes else None, clip.frames()[:4]
    one, four = (list(track(frames, clip.rig, boxes, workers=n)) for n in (1, 4))
    assert_same(one, four)


def test_repeated_run_gives_equal_results(clip: Clip, tracked: Sequence[TrackedFrame]) -> None:
    assert_same(list(track(clip.frames()[:4], clip.rig, clip.boxes)), tracked[:4])


# --- uncertainty


@pytest.mark.parametrize(
    ("features", "with_boxes"),
    [
        ("klt", True),
        pytest.param("klt", False, marks=pytest.mark.slow),
        pytest.param("sift", True, marks=pytest.mark.slow),
        pytest.param("sift", False, marks=pytest.mark.slow),
    ],
)
def test_restored_snapshot_is_exact(clip: Clip, with_boxes: bool, features: str) -> None:
    """After restoring a snapshot, all results equal those of a tracker that never processed the frame."""
    boxes, frames = clip.boxes if with_boxes else None, clip.frames()[:3]
    with Tracker(clip.rig, boxes, features=features, workers=1) as tracker:
        plain = [f for frame in frames for f in tracker.step(frame)]
    with Tracker(clip.rig, boxes, features=features, workers=1) as tracker:
        found = []
        for k, frame in enumerate(frames):
            memory = tracker.copy_snapshot()
            tracker.step(replace(frame, images=frame.images[::-1]))  # different images first, then the true ones
            tracker.restore(memory)
            memory = tracker.copy_snapshot()
            tracker.step(frame)
            for later in frames[k + 1 : k + 3]:
                tracker.step(later)
            tracker.restore(memory)
            found += tracker.step(frame)
    assert len(found) == len(plain) > 2
    for one, other in zip(found, plain, strict=True):
        assert one.pose.status is other.pose.status
        np.testing.assert_array_equal(one.pose.covariance, other.pose.covariance)
        if other.pose.world_from_object is not None:
            assert one.pose.world_from_object is not None
            a, b = one.pose.world_from_object.as_matrix(), other.pose.world_from_object.as_matrix()
            np.testing.assert_array_equal(a, b)
        for mine, its in zip(one.observations, other.observations, strict=True):
            np.testing.assert_array_equal(mine.positions, its.positions)


def test_uncertainty_grows_and_covers_error(clip: Clip, tracked: Sequence[TrackedFrame]) -> None:
    sigmas = np.array([f.pose.sigma for f in tracked])
    assert not sigmas[0].any()
    assert (sigmas[1:] > 0).all()
    spread = np.linalg.norm(sigmas[:, :3], axis=1)
    assert spread[-1] > spread[1]
    assert (spread[2:] > 0.7 * spread[1:-1]).all()
    assert np.rad2deg(spread[-1]) < 2
    assert compute_squared_mahalanobis(tracked, clip.truth).max() < 60


def test_fewer_cameras_are_less_certain(clip: Clip, tracked: Sequence[TrackedFrame]) -> None:
    rig = clip.rig.subset(["cam_0", "cam_1"])
    boxes = {name: box for name, box in clip.boxes.items() if name in rig.names}
    two = list(track(frame_sets([frame[:2] for frame in clip.images]), rig, boxes))
    assert np.linalg.norm(two[-1].pose.sigma[3:]) > np.linalg.norm(tracked[-1].pose.sigma[3:])


# --- memory


def test_images_are_released_and_references_bounded(clip: Clip) -> None:
    # Nearly every frame is a keyframe.
    options = TrackingOptions(max_keyframes=3, min_keyframe_rotation=np.radians(1.0))
    alive: list[list[weakref.ref[Any]]] = []
    references = []

    def frames() -> Iterable[FrameSet]:
        for k, original in enumerate([*clip.images, *clip.images[-2:2:-1]]):
            images = tuple(image.copy() for image in original)
            alive.append([weakref.ref(image) for image in images])
            yield FrameSet(k, float(k), (None,) * 3, images, (None,) * 3)
            del images
            if k % 4 == 3:
                gc.collect()
                # The caller may still hold the last one.
                assert not any(ref() is not None for refs in alive[: k - 1] for ref in refs)
                # Not `isinstance`, which raises for a proxy of an object that is gone, as Numba has.
                references.append(sum(type(o) is CameraFrame for o in gc.get_objects()))

    for f in track(frames(), clip.rig, clip.boxes, lookahead=0, options=options):
        del f
    assert len(alive) == 2 * FRAMES - 4
    # The keyframes, the last frames and the current one, in each of three cameras.
    assert max(references) <= 3 * (3 + options.n_recent_frames + 1)
    assert references[-1] >= 3 * 3


def test_number_of_buffered_frames_is_bounded(clip: Clip) -> None:
    refs: list[weakref.ref[Any]] = []
    with Tracker(clip.rig, options=TrackingOptions(max_buffered_frames=2)) as tracker:
        for k in range(6):
            images = tuple(image.copy() for image in clip.images[0])
            refs.append(weakref.ref(images[0]))
            tracker.step(FrameSet(k, float(k), (None,) * 3, images, (None,) * 3))
            del images
        gc.collect()
        assert 2 <= sum(ref() is not None for ref in refs) <= 3


# --- bad input


def test_unknown_method_is_rejected(clip: Clip) -> None:
    with pytest.raises(ValueError, match=r"method: 'magic' is not one of landmarks, epipolar, sylvester"):
        list(track(clip.frames(), clip.rig, clip.boxes, method="magic"))


@pytest.mark.parametrize(
    ("boxes", "message"),
    [
        ({"cam_7": Box(10, 10, 50, 50)}, "cam_7"),
        ({"cam_0": Box(0, 0, 20, 20), "cam_1": Box(290, 210, 20, 20)}, "the boxes of cam_0, cam_1 do not intersect"),
    ],
)
def test_impossible_boxes_are_rejected(clip: Clip, boxes: Mapping[str, Box], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Tracker(clip.rig, boxes)


def test_no_frames_give_no_results(clip: Clip) -> None:
    assert list(track([], clip.rig)) == []
    assert list(track([], clip.rig, clip.boxes)) == []


def test_single_frame(clip: Clip) -> None:
    assert statuses(track(clip.frames()[:1], clip.rig, clip.boxes)) == [FrameStatus.FIRST]
    assert statuses(track(clip.frames()[:1], clip.rig)) == [FrameStatus.NO_MOTION]


def test_results_are_streamed(clip: Clip) -> None:
    """Without lookahead no frame is read in advance, and results are available when a recording ends abruptly."""
    taken = 0

    def frames() -> Iterable[FrameSet]:
        nonlocal taken
        for frame in clip.frames():
            taken += 1
            if taken == 5:
                raise OSError("broken off")
            yield frame

    found = []
    with pytest.raises(OSError, match="broken off"):  # noqa: PT012
        for f in track(frames(), clip.rig, clip.boxes, lookahead=0):
            found.append(f)
            assert f.pose.index == taken - 1
    assert statuses(found) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * 3


def test_poses_are_rigid_transforms(tracked: Sequence[TrackedFrame]) -> None:
    assert all(isinstance(f.pose.world_from_object, RigidTransform) for f in tracked)
