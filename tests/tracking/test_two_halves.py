"""The tracker's two halves: cameras that see their own images alone, and tell each other small records of numbers, come to
the answer of one process with all images."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import FrozenInstanceError, fields, is_dataclass, replace
from threading import Barrier
from typing import Any, TypeVar, cast

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from benchmarks.kinds_scenes import turned
from sylpose.frames import FrameSet
from sylpose.landmarks.alignment import FIRST_PX, Aligned, OneOfMany, Sights
from sylpose.methods import features_of
from sylpose.numerics.arrays import FloatArray
from sylpose.simulate import demo_scene
from sylpose.tracking.camera import CameraPart
from sylpose.tracking.frame_solvers import SOLVERS
from sylpose.tracking.joint import Joint
from sylpose.tracking.object_model import ObjectModel
from sylpose.tracking.phases import Waiting, next_frame
from sylpose.tracking.team import Team
from sylpose.tracking.tracked_frame import TrackedFrame
from sylpose.tracking.tracker import track
from tests.clips import SIZE, Clip, frame_sets

T = TypeVar("T")
FRAMES = 8


def assert_numbers(told: Any) -> None:
    """Numbers, arrays of them, and frozen records of these: nothing that is an image, a feature or a function."""
    if is_dataclass(told):
        with pytest.raises(FrozenInstanceError):
            setattr(told, fields(told)[0].name, None)
        for field in fields(told):
            assert_numbers(getattr(told, field.name))
    elif isinstance(told, (list, tuple)):
        for part in told:
            assert_numbers(part)
    elif isinstance(told, np.ndarray):
        assert told.dtype in (np.float64, np.int64, np.bool_)
        # 128 numbers of a feature's look, or an image, would be seen here.
        assert told.ndim <= 2
        assert told.size <= 12 * max(len(told), 1)
    else:
        assert told is None or isinstance(told, (bool, int, float, np.bool_, np.int64, RigidTransform)), type(told)


class Wire:
    """What cameras that keep step send each other: every one waits for all."""

    def __init__(self, cameras: int) -> None:
        self._sent = [b""] * cameras
        self._barrier = Barrier(cameras)
        self.bytes = 0

    def exchange(self, camera: int, told: object) -> list[Any]:
        """Everybody's, by camera, as it arrived."""
        self._sent[camera] = pickle.dumps(told)
        self._barrier.wait(60)
        heard = [pickle.loads(sent) for sent in self._sent]
        if camera == 0:
            self.bytes += sum(map(len, self._sent))
        self._barrier.wait(60)
        return heard

    def broken(self) -> None:
        """Nobody waits for a camera that has failed."""
        self._barrier.abort()


class Node:
    """A crew of which one camera is here."""

    def __init__(self, camera: int, cameras: int, wire: Wire) -> None:
        self._camera, self._cameras, self._wire = camera, cameras, wire

    def each(self, do: Callable[[int], T], *, long: bool = False) -> list[T]:  # noqa: ARG002
        mine = do(self._camera)
        return [mine if c == self._camera else cast(T, None) for c in range(self._cameras)]

    def ask(self, do: Callable[[int], T], nothing: T) -> list[T]:  # noqa: ARG002
        told = do(self._camera)
        assert_numbers(told)
        return cast(list[T], self._wire.exchange(self._camera, told))

    def align(
        self, sights: Sequence[Sights], rotation: FloatArray, shift: FloatArray, first_px: float = FIRST_PX
    ) -> tuple[Aligned, list[tuple[FloatArray, FloatArray]]]:
        one = OneOfMany(sights[self._camera], self._camera, lambda told, _: self._wire.exchange(self._camera, told))
        found = one.align(rotation, shift, first_px)
        return found, self.each(lambda _: (found.weights[0], found.residuals[0]))


def tracked_by_nodes(clip: Clip, frames: Sequence[FrameSet], method: str, with_boxes: bool) -> list[list[TrackedFrame]]:
    """By camera, what it says of each frame, having seen its own images alone."""
    n = len(clip.rig)
    wire = Wire(n)

    def node(c: int) -> list[TrackedFrame]:
        parts = [CameraPart(k, camera) if k == c else cast(CameraPart, None) for k, camera in enumerate(clip.rig)]
        follows = features_of(method, "auto") == "klt"
        team = Team(clip.rig, parts, Node(c, n, wire), SOLVERS[method], follows, np.zeros(n), 0, method == "landmarks")
        joint = Joint(ObjectModel.in_boxes(clip.rig, clip.boxes) if with_boxes else ObjectModel())
        waiting: Sequence[Waiting] = []
        found = []
        try:
            for number, frame in enumerate(frames):
                mine = tuple(image if k == c else None for k, image in enumerate(frame.images))
                joint, waiting, decided = next_frame(team, joint, waiting, number, replace(frame, images=mine))
                found += decided
        except BaseException:
            wire.broken()
            raise
        return found

    with ThreadPoolExecutor(n) as pool:
        found = list(pool.map(node, range(n)))
    # Without boxes, the first motion takes all matches once.
    assert wire.bytes / n / len(frames) < 60_000
    return found


@pytest.fixture(scope="module")
def clip() -> Clip:
    return Clip.render(demo_scene(frames=FRAMES, turn_deg=25, size=SIZE, n_cameras=3, seed=2))


def assert_alike(found: TrackedFrame, wanted: TrackedFrame) -> None:
    """Up to rounding: products of matrices depend on how their arrays lie in memory, and what was sent lies elsewhere."""
    a, b = found.pose, wanted.pose
    assert (a.world_from_object is None) == (b.world_from_object is None)
    if a.world_from_object is not None and b.world_from_object is not None:
        np.testing.assert_allclose(a.world_from_object.as_matrix(), b.world_from_object.as_matrix(), rtol=0, atol=1e-11)
    np.testing.assert_allclose(a.covariance, b.covariance, rtol=1e-6, atol=1e-15)
    np.testing.assert_array_equal(a.inliers, b.inliers)
    np.testing.assert_allclose(a.residuals, b.residuals, rtol=1e-7)
    np.testing.assert_allclose(a.doubt, b.doubt, rtol=1e-7)
    assert found.radius == pytest.approx(wanted.radius, rel=1e-9, nan_ok=True)


@pytest.mark.parametrize(
    ("method", "with_boxes"),
    [("landmarks", True), ("landmarks", False), ("epipolar", True), ("sylvester", False)],
)
def test_cameras_with_their_own_images_come_to_the_same(clip: Clip, method: str, with_boxes: bool) -> None:
    frames = clip.frames()
    # One camera sees nothing for a while; then nobody does, and the object has to be found again.
    frames[3] = replace(frames[3], images=(frames[3].images[0], None, frames[3].images[2]))
    frames[5] = replace(frames[5], images=(None, None, None))
    expected = list(track(frames, clip.rig, clip.boxes if with_boxes else None, method=method))
    assert sum(f.pose.measured for f in expected) >= FRAMES - 2
    for c, of_camera in enumerate(tracked_by_nodes(clip, frames, method, with_boxes)):
        assert [f.pose.status for f in of_camera] == [f.pose.status for f in expected]
        for found, wanted in zip(of_camera, expected, strict=True):
            assert_alike(found, wanted)
            # What stays with the camera is the same as well.
            if wanted.sightings:
                np.testing.assert_array_equal(found.sightings[c].landmark, wanted.sightings[c].landmark)
                np.testing.assert_allclose(found.sightings[c].place, wanted.sightings[c].place, rtol=0, atol=1e-9)


def test_a_nudged_camera_tells_the_others(clip: Clip) -> None:
    """That it was, and by how much: its images it turns back alone."""
    frames = clip.frames()
    for k in range(4, FRAMES):
        seen = list(clip.images[k])
        seen[1] = turned(seen[1], clip.rig.cameras[1], np.radians([0.8, -1.2, 0.5]))
        frames[k] = replace(frames[k], images=tuple(seen))
    expected = list(track(frames, clip.rig, clip.boxes))
    (said,) = expected[-1].pose.faults
    assert said == "camera cam_1 was nudged at frame 4: the background turned by 1.5 degrees"
    for of_camera in tracked_by_nodes(clip, frames, "landmarks", with_boxes=True):
        assert [f.pose.faults for f in of_camera] == [f.pose.faults for f in expected]
        for found, wanted in zip(of_camera, expected, strict=True):
            assert_alike(found, wanted)


def test_known_depths_are_sent_too(clip: Clip) -> None:
    """Products of matrices round by how arrays lie in memory, and a landmark at a threshold makes more of it."""
    frames = clip.frames()
    expected = list(track(frames, clip.rig, clip.boxes, method="known-depth"))
    for of_camera in tracked_by_nodes(clip, frames, "known-depth", with_boxes=True):
        for found, wanted in zip(of_camera, expected, strict=True):
            a, b = found.pose.world_from_object, wanted.pose.world_from_object
            assert a is not None
            assert b is not None
            np.testing.assert_allclose(a.as_matrix(), b.as_matrix(), atol=1e-3)


def test_a_camera_that_sees_nothing_has_the_pose_too(clip: Clip) -> None:
    """The paper's promise: an estimate at each camera, also when the features are not visible to it."""
    blind = [replace(f, images=(f.images[0], None, f.images[2])) for f in frame_sets(clip.images)]
    one, other, _ = tracked_by_nodes(clip, blind, "landmarks", with_boxes=True)
    assert sum(f.pose.measured for f in other) == len(blind)
    for a, b in zip(one, other, strict=True):
        assert b.pose.inliers[1] == 0
        assert_alike(a, b)
