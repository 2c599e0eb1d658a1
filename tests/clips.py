"""Small rendered recordings in memory, and common checks of tracking results."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.frames import Box, FrameSet
from sylpose.geometry.arrays import BoolArray, FloatArray, Image, IntArray
from sylpose.rig import Camera, Rig
from sylpose.simulate import Actor, DemoTruth, Scene, TexturedBody, compute_demo_truth, make_demo_scene, render_frames
from sylpose.simulate.render import Path
from sylpose.status import FrameStatus
from sylpose.tracking.context import TrackedFrame
from sylpose.tracking.tracker import track

Images = Sequence[Image | None]
Masks = Sequence[BoolArray | None]

SIZE = (320, 240)
RATE = 30
BLACK = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
# Largest pose error for images of this size, degrees.
HALF_DEGREE = 0.5
# Frames of `turning_clip`.
FRAMES = 8
# Rotation axis of the objects of `moving_scene`.
AXIS = np.array([0.36, 0.8, 0.48])


@dataclass(frozen=True, eq=False)
class Clip:
    """A rendered sequence in memory, with ground truth."""

    rig: Rig
    truth: DemoTruth
    images: list[tuple[Image, ...]]

    @classmethod
    def render(cls, scene: Scene) -> Clip:
        return cls(scene.rig, compute_demo_truth(scene), list(render_frames(scene)))

    @property
    def boxes(self) -> dict[str, Box]:
        return {name: Box(*box) for name, box in self.truth.boxes.items()}

    def frames(self) -> list[FrameSet]:
        return frame_sets(self.images)


@cache
def turning_clip() -> Clip:
    """Render eight frames of three cameras with a rotation by 20 degrees."""
    return Clip.render(make_demo_scene(frames=FRAMES, angle_deg=20, size=SIZE, n_cameras=3))


@cache
def track_turning_clip(with_boxes: bool) -> tuple[TrackedFrame, ...]:
    """Return the tracking result of `turning_clip`, with boxes or without; read only."""
    clip = turning_clip()
    return tuple(track(clip.frames(), clip.rig, clip.boxes if with_boxes else None))


@cache
def _demo(n_cameras: int) -> Scene:
    return make_demo_scene(frames=1, size=SIZE, n_cameras=n_cameras)


def moving_scene(path: Path, frames: int, others: Sequence[Actor] = (), n_cameras: int = 4) -> Scene:
    """Make a scene of the demo's block, 0.3 m long and 1.2 m from the cameras, on a given path among other objects."""
    scene = _demo(n_cameras)
    return replace(scene, actors=(Actor(scene.actors[0].body, path), *others), frames=frames)


def make_rotated_pose(degrees: float, place: ArrayLike = (0, 0, 0)) -> RigidTransform:
    """Return the pose of an object rotated by an angle at a position (3,)."""
    return RigidTransform.from_components(np.asarray(place, float), Rotation.from_rotvec(np.radians(degrees) * AXIS))


def make_drifting_pose(frame: float) -> RigidTransform:
    """Return a pose that changes by three degrees and 7 mm per frame."""
    return make_rotated_pose(3 * frame, np.array([0.006, -0.002, 0.004]) * frame)


def make_slab(sides: ArrayLike, seed: int) -> TexturedBody:
    """Make a textured box (3 sides) at the block's distance."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * np.asarray(sides) / 2
    return TexturedBody.from_hull(corners, 400, seed)


def make_occluding_board(camera: Camera, first: int, last: int) -> Actor:
    """Make a textured board that occludes one camera from the first to the last frame, both included."""
    near, nowhere = 0.3, RigidTransform.from_translation([0, 100, 0])
    width, height = 1.5 * near * np.array(camera.size) / camera.focal
    world_from_board = camera.camera_from_world.inv() * RigidTransform.from_translation([0, 0, near])
    body = make_slab([width, height, 0.01], int(camera.name.removeprefix("cam_")))
    return Actor(body, lambda frame: world_from_board if first <= frame <= last else nowhere)


@cache
def hidden_clip() -> Clip:
    """Render the drifting object, occluded in all four cameras in frames 7 to 9 of 15."""
    rig = moving_scene(make_drifting_pose, 1).rig
    return Clip.render(moving_scene(make_drifting_pose, 15, [make_occluding_board(camera, 7, 9) for camera in rig]))


def surface_points(
    camera: Camera, normalized: FloatArray, world_from_object: RigidTransform, vertices: FloatArray
) -> FloatArray:
    """Return (n, 3) first intersections of rays with a convex object, in its frame; NaN for rays that miss it."""
    planes = ConvexHull(vertices).equations
    object_from_world = world_from_object.inv()
    center = object_from_world.apply(camera.center)
    homogeneous = np.column_stack([normalized, np.ones(len(normalized))])
    rays = object_from_world.rotation.apply(homogeneous @ camera.rotation).reshape(-1, 3)
    along = rays @ planes[:, :3].T
    depth = -(planes[:, 3] + planes[:, :3] @ center) / along
    enters = np.where(along < 0, depth, -np.inf).max(axis=1)
    leaves = np.where(along > 0, depth, np.inf).min(axis=1)
    return np.where((enters < leaves)[:, None], center + enters[:, None] * rays, np.nan)


def frame_sets(images: Sequence[Images], masks: Sequence[Masks] | None = None) -> list[FrameSet]:
    n = len(images[0])
    return [
        FrameSet(k, k / RATE, (k / RATE,) * n, tuple(frame), (None,) * n if masks is None else tuple(masks[k]))
        for k, frame in enumerate(images)
    ]


def prepend_rest(scene: Scene, rest: int, moving: int) -> Scene:
    """Return the scene with its object at rest for some frames first."""
    actor = scene.actors[0]
    path = actor.path
    return replace(scene, frames=rest + moving, actors=(Actor(actor.body, lambda f: path(max(f - rest, 0.0))),))


def compute_pose_errors(tracked: Iterable[TrackedFrame], truth: DemoTruth) -> FloatArray:
    """Return (n, 2) errors of the frames with a pose except the first.

    Degrees, and millimeters of the object's center, of the motion since the first of them.
    """
    poses = [(f.pose.index, f.pose.world_from_object) for f in tracked if f.pose.world_from_object is not None]
    start, first = poses[0]
    assert first is not None
    center = truth.world_from_object[start].translation
    rows = []
    for index, pose in poses[1:]:
        found = pose * first.inv()
        true = truth.world_from_object[index] * truth.world_from_object[start].inv()
        turn = np.rad2deg((found.rotation * true.rotation.inv()).magnitude())
        rows.append((turn, 1e3 * np.linalg.norm(found.apply(center) - true.apply(center))))
    return np.array(rows).reshape(-1, 2)


def compute_squared_mahalanobis(tracked: Sequence[TrackedFrame], truth: DemoTruth) -> FloatArray:
    """Return (n,) squared Mahalanobis errors of the frames with a pose except the first.

    Their mean is 6 for a correct covariance.
    """
    (start, first), *others = [(f.pose.index, f.pose) for f in tracked if f.pose.world_from_object is not None]
    assert first.world_from_object is not None
    squares = []
    for index, pose in others:
        found = pose.world_from_object
        assert found is not None
        true = truth.world_from_object[index] * truth.world_from_object[start].inv() * first.world_from_object
        w = (found.rotation * true.rotation.inv()).as_rotvec()
        error = np.concatenate([w, found.translation - true.translation])
        squares.append(float(error @ np.linalg.solve(pose.covariance, error)))
    return np.array(squares)


def statuses(tracked: Iterable[TrackedFrame]) -> list[FrameStatus]:
    return [f.pose.status for f in tracked]


def inliers(tracked: Iterable[TrackedFrame]) -> IntArray:
    return np.array([f.pose.inliers for f in tracked])


def assert_valid(tracked: Sequence[TrackedFrame]) -> None:
    """Check properties that hold for any result."""
    for f in tracked:
        pose = f.pose
        assert pose.inliers.shape == pose.residuals.shape == (len(f.frames.images),)
        if not pose.is_measured:
            assert pose.status not in (FrameStatus.TRACKED, FrameStatus.FIRST, FrameStatus.RELOCALIZED)
        if not pose.is_observed:
            assert not pose.inliers.any()
            assert np.isnan(pose.residuals).all()
            assert f.observations == ()
        if pose.world_from_object is None:
            assert pose.status is not FrameStatus.COASTING
            assert np.isnan(pose.covariance).all()
            continue
        assert pose.status.has_pose
        assert np.isfinite(pose.world_from_object.as_matrix()).all()
        assert np.isfinite(pose.covariance).all()
        np.testing.assert_allclose(pose.covariance, pose.covariance.T, rtol=1e-6, atol=1e-15)
        scale = np.sqrt(np.maximum(np.diag(pose.covariance), 1e-300))
        if pose.status is FrameStatus.FIRST:
            assert not pose.covariance.any()
            continue
        assert np.linalg.eigvalsh(pose.covariance / np.outer(scale, scale)).min() > 0
        assert (pose.residuals[pose.inliers > 0] < 5).all()
        assert np.isnan(pose.residuals[pose.inliers == 0]).all()
