"""Recordings of one painted box with four cameras: mapped in the first, recognized in the others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.rendered_recordings import Recording, write_recording
from sylpose.boards.specification import Board
from sylpose.results import FramePose
from sylpose.rig import Rig
from sylpose.simulate import Actor, Scene, TexturedBody, arc, chamfered_box
from tests.boards.drawing import draw_picture

__all__ = [
    "BOX",
    "FIRST",
    "NEXT",
    "RIG",
    "Path_",
    "attach_target",
    "compute_pose_error",
    "mapping_path",
    "moved_path",
    "slide",
    "write_box_recording",
]

Path_ = Callable[[float], RigidTransform]
RIG = arc(4, 35, 1.5, 500, (480, 360), height=0.4)
# Sides of the box.
BOX = (0.3, 0.22, 0.26)
# Numbers of frames of the first recording and of the others.
FIRST, NEXT = 50, 10


def mapping_path(k: float) -> RigidTransform:
    """Rotate back and forth by 80 degrees."""
    turn = Rotation.from_rotvec(0.03 * (k + 2 * np.sin(k / 4)) * np.array([0.3, 0.9, 0.3]))
    return RigidTransform.from_components([0.05 * np.sin(k / 9), 0.03 * np.sin(k / 8), 0.04 * np.sin(k / 11)], turn)


def moved_path(k: float) -> RigidTransform:
    """Start 20 degrees and 7 cm away, and rotate about another axis."""
    start = Rotation.from_rotvec([0.1, 0.35, -0.05])
    turn = Rotation.from_rotvec(0.025 * k * np.array([0.8, 0.5, -0.2])) * start
    return RigidTransform.from_components([0.06 - 0.004 * k, 0.03, 0.02 * np.sin(k / 6)], turn)


def slide(k: float) -> RigidTransform:
    """Translate without rotation."""
    return RigidTransform.from_components([0.05 - 0.008 * k, 0.02, 0.003 * k], Rotation.from_rotvec([0.1, 0.3, 0.0]))


def write_box_recording(folder: Path, path: Path_, frames: int, *, seed: int = 0, rig: Rig = RIG) -> Path:
    """Write a recording into a folder, with its calibration."""
    write_recording(Recording(Scene(rig, (Actor(chamfered_box(BOX, 300), path),), frames, seed)), folder)
    return folder


def compute_pose_error(pose: FramePose, true: RigidTransform) -> np.ndarray:
    """Return the (6,) error of (w, d)."""
    assert pose.world_from_object is not None
    turn = (pose.world_from_object.rotation * true.rotation.inv()).as_rotvec()
    return np.concatenate([turn, pose.world_from_object.translation - true.translation])


def attach_target(body: TexturedBody, board: Board, body_from_board: RigidTransform) -> TexturedBody:
    """Return a body with a calibration target attached to one face."""
    sheet, texels, low = draw_picture(board)
    sheet = np.asarray(cv2.GaussianBlur(sheet, (0, 0), 2.0), np.uint8)
    textures = [texture.copy() for texture in body.textures]
    for texture, plane, normal in zip(textures, body.plane_from_texture, body.normals, strict=True):
        if normal @ body_from_board.rotation.apply([0.0, 0.0, 1.0]) < 0.999:
            continue
        v, u = np.mgrid[: texture.shape[0], : texture.shape[1]]
        places = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3) @ plane.T
        x, y, _ = body_from_board.inv().apply(places).T
        column, row = (x - low[0]) * texels - 0.5, sheet.shape[0] - (y - low[1]) * texels - 0.5
        on = (column >= 0) & (column <= sheet.shape[1] - 1) & (row >= 0) & (row <= sheet.shape[0] - 1)
        at = np.flatnonzero(on)
        texture.reshape(-1, 3)[at] = sheet[row[at].round().astype(int), column[at].round().astype(int)][:, None]
    return replace(body, textures=tuple(textures))
