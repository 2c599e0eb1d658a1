"""Simulated detections of a board that is carried about in front of an arc of cameras."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.boards.detection import Detection
from sylpose.boards.specification import Board, parse_board
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Camera, Rig, make_look_at_camera

CHARUCO = "charuco:5x7,square=40mm,marker=30mm,dict=4X4_50"
SIZE = (1280, 720)
DISTORTION = (-0.25, 0.08, 0.001, -0.0008, 0.01)
# Changes the corners (n, 2) of a view of frame f by camera c.
Disturb = Callable[[int, int, FloatArray], FloatArray]


@dataclass(frozen=True, eq=False)
class BoardScene:
    """Rig in the frame of its first camera, board, and detections by frame and camera."""

    rig: Rig
    board: Board
    detections: list[list[Detection]]


def make_cameras(n: int, spread_deg: float = 25.0, distance: float = 1.0) -> Rig:
    """Return cameras on an arc around the origin, with the first one's frame as the world."""
    cameras = []
    for c in range(n):
        angle = np.radians(spread_deg * (c - (n - 1) / 2))
        center = distance * np.array([np.sin(angle), 0.05 * c, -np.cos(angle)])
        cameras.append(make_look_at_camera(f"cam_{c}", center, np.zeros(3), 800 + 20 * c, SIZE, DISTORTION))
    return Rig(cameras, "m")


def draw_poses(board: Board, n: int, rng: np.random.Generator, tilt_deg: float = 45.0) -> list[RigidTransform]:
    """Draw poses of a board around the origin that face the negative z axis, tilted by up to an angle."""
    poses = []
    for _ in range(n):
        axis = rng.normal(size=3) * [1, 1, 0.5]
        tilted = Rotation.from_rotvec(axis / np.linalg.norm(axis) * np.radians(rng.uniform(0, tilt_deg)))
        rotation = tilted * Rotation.from_rotvec([np.pi, 0, 0]) * Rotation.from_rotvec([0, 0, rng.uniform(-0.5, 0.5)])
        place = rng.uniform([-0.35, -0.25, -0.3], [0.35, 0.25, 0.3])
        poses.append(RigidTransform.from_components(place - rotation.apply(board.points.mean(axis=0)), rotation))
    return poses


def observe(rig: Rig, board: Board, poses: Sequence[RigidTransform], disturb: Disturb) -> list[list[Detection]]:
    """Observe a board by all cameras that are in front of it, its corners disturbed."""
    return [
        [_detect(camera, board, pose, partial(disturb, f, c)) for c, camera in enumerate(rig)]
        for f, pose in enumerate(poses)
    ]


def _detect(
    camera: Camera, board: Board, pose: RigidTransform, disturb: Callable[[FloatArray], FloatArray]
) -> Detection:
    pixels = camera.project(pose.apply(board.points).reshape(-1, 3))
    sight = camera.center - pose.apply(board.points.mean(axis=0))
    if pose.rotation.apply([0, 0, 1]) @ sight < 0.2 * np.linalg.norm(sight):
        return Detection()
    inside = (np.isfinite(pixels) & (pixels > 0) & (pixels < SIZE)).all(axis=1)
    return Detection(np.flatnonzero(inside), disturb(pixels)[inside])


def make_scene(
    seed: int, n_cameras: int = 2, frames: int = 20, noise: float = 0.2, text: str = CHARUCO, tilt_deg: float = 45.0
) -> BoardScene:
    """Make a scene with independent noise of the corners, pixels."""
    rng, board, rig = np.random.default_rng(seed), parse_board(text, "m"), make_cameras(n_cameras)
    poses = draw_poses(board, frames, rng, tilt_deg)
    found = observe(rig, board, poses, lambda _f, _c, pixels: pixels + rng.normal(0, noise, pixels.shape))
    return BoardScene(rig.in_world(rig[0].camera_from_world), board, found)


def subtract_pose(a: Camera, b: Camera) -> FloatArray:
    """Return the error (6,) (w, d) of camera_from_world."""
    first, second = a.camera_from_world, b.camera_from_world
    w = (first.rotation * second.rotation.inv()).as_rotvec()
    return np.concatenate([w, first.translation - second.translation])


def list_lens(camera: Camera) -> FloatArray:
    """Return fx, fy, cx, cy and the first five distortion coefficients."""
    return np.concatenate([camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]], camera.distortion[:5]])
