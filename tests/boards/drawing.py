"""Calibration targets as flat bodies rendered by `sylpose.simulate`, and rigs that look at them from above."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.boards.specification import Board
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.rig import Camera, Rig
from sylpose.simulate import Actor, Scene, TexturedBody, arc, make_demo_scene, render_frames

# Texels per square, per circle spacing, or per four bits of a marker.
TEXELS = 120


def draw_picture(board: Board, legacy: bool = False) -> tuple[Image, float, FloatArray]:
    """Draw a target as printed, with white margins.

    Returns:
        its picture, texels per unit of length, and the position (2,) of the paper's lower left corner in the target's
        frame.
    """
    columns, rows = board.size
    if board.kind == "charuco":
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{board.dictionary}"))
        drawn = cv2.aruco.CharucoBoard(board.size, 1.0, board.marker_ratio, dictionary)
        drawn.setLegacyPattern(legacy)
        square = float(board.points[:, 0].min())
        sheet = np.asarray(drawn.generateImage((columns * TEXELS, rows * TEXELS)), dtype=np.uint8)
        return _paper_coordinates(sheet, TEXELS / square, np.zeros(2), TEXELS)
    if board.kind == "chessboard":
        square = float(board.points[1, 0])
        dark = (np.arange(rows + 1)[:, None] + np.arange(columns + 1)) % 2 == 0
        sheet = np.where(dark[::-1], 0, 255).astype(np.uint8).repeat(TEXELS, 0).repeat(TEXELS, 1)
        return _paper_coordinates(sheet, TEXELS / square, np.array([-square, -square]), TEXELS)
    if board.kind in ("circles", "acircles"):
        step = float(np.abs(board.points[1, 0] - board.points[0, 0])) / (2 if board.kind == "acircles" else 1)
        low, high = board.points[:, :2].min(axis=0) - step, board.points[:, :2].max(axis=0) + step
        width, height = np.rint((high - low) / step * TEXELS).astype(int)
        sheet = np.full((height, width), 255, np.uint8)
        for x, y in (board.points[:, :2] - low) / step * TEXELS:
            center = (round((x - 0.5) * 256), round((height - y - 0.5) * 256))
            cv2.circle(sheet, center, round(board.diameter / step / 2 * TEXELS * 256), (0,), -1, cv2.LINE_AA, 8)
        return _paper_coordinates(sheet, TEXELS / step, low, 0)
    if board.kind == "marker":
        tag = _tag(board, board.first_id)
        texels = len(tag) / (2 * float(board.points[1, 0]))
        return _paper_coordinates(tag, texels, board.points[3, :2], len(tag) // 6)
    tags = board.points[:, :2].reshape(-1, 4, 2)
    size = float(tags[0, 1, 0])
    texels = len(_tag(board, 0)) / size
    extent = np.rint(tags.max(axis=(0, 1)) * texels).astype(int)
    sheet = np.full((extent[1], extent[0]), 255, np.uint8)
    for k, corners in enumerate(tags):
        tag = _tag(board, board.first_id + k)
        left, low = np.rint(corners[0] * texels).astype(int)
        sheet[extent[1] - low - len(tag) : extent[1] - low, left : left + len(tag)] = tag
    return _paper_coordinates(sheet, texels, np.zeros(2), len(_tag(board, 0)) // 4)


def _tag(board: Board, number: int) -> Image:
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{board.dictionary}"))
    bits = dictionary.markerSize + 2 * board.border
    tag = cv2.aruco.generateImageMarker(dictionary, number, bits * TEXELS // 4, borderBits=board.border)
    return np.asarray(tag[::-1, ::-1] if board.is_upside_down else tag, dtype=np.uint8)


def _paper_coordinates(sheet: Image, texels: float, low: FloatArray, margin: int) -> tuple[Image, float, FloatArray]:
    paper = cv2.copyMakeBorder(sheet, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=255)
    return np.asarray(paper, dtype=np.uint8), texels, low - margin / texels


def make_plate(board: Board, legacy: bool = False) -> TexturedBody:
    """Build the target as a one-sided body, in its own frame."""
    sheet, texels, low = draw_picture(board, legacy)
    # Detail below a pixel is filtered out, as by a lens.
    sheet = np.asarray(cv2.GaussianBlur(sheet, (0, 0), 2.0), dtype=np.uint8)
    height, width = sheet.shape
    ends = np.array([[0, 0], [width, 0], [width, height], [0, height]]) / texels + low
    vertices = np.column_stack([ends, np.zeros(4)])
    # Texel centers are at integers; rows go down.
    plane = np.array(
        [
            [1 / texels, 0, low[0] + 0.5 / texels],
            [0, -1 / texels, low[1] + (height - 0.5) / texels],
            [0, 0, 0],
        ]
    )
    face = np.arange(4)
    bgr = np.asarray(cv2.cvtColor(sheet, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    return TexturedBody(vertices, (face,), np.array([[0.0, 0.0, 1.0]]), (bgr,), plane[None])


def compute_middle(board: Board) -> FloatArray:
    return np.asarray((board.points.min(axis=0) + board.points.max(axis=0)) / 2)


def make_rig_above(
    board: Board,
    n: int,
    rng: np.random.Generator,
    *,
    size: tuple[int, int] = (480, 360),
    distance: float = 2.4,
    tilt_deg: float = 45.0,
    distortion: tuple[float, ...] = (-0.08, 0.02, 0.0005, -0.0003, 0.0),
) -> tuple[Rig, RigidTransform]:
    """Place cameras around a target in a random pose, and return world_from_board.

    Args:
        distance: distance as a multiple of the paper's longer side.
        tilt_deg: maximum angle between viewing directions and its normal.
    """
    sheet, texels, _ = draw_picture(board)
    extent = max(sheet.shape) / texels
    world_from_board = RigidTransform.from_components(rng.normal(size=3), Rotation.random(rng=rng))
    cameras = []
    for c in range(n):
        about = 2 * np.pi * (c + rng.uniform(-0.2, 0.2)) / n
        tilt = np.deg2rad(tilt_deg) * rng.uniform(0.4, 1.0)
        view_direction = np.array([np.sin(tilt) * np.cos(about), np.sin(tilt) * np.sin(about), np.cos(tilt)])
        roll = np.array([rng.normal(), rng.normal(), 0.2 * rng.normal()])
        right = np.cross(-view_direction, roll)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(-view_direction, right), -view_direction])
        center = compute_middle(board) + distance * extent * view_direction * rng.uniform(0.9, 1.2)
        camera_from_board = RigidTransform.from_components(-rotation @ center, Rotation.from_matrix(rotation))
        focal = 0.8 * distance * min(size)
        matrix = np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1]])
        cameras.append(
            Camera(f"cam_{c}", size, matrix, np.array(distortion), camera_from_board * world_from_board.inv())
        )
    return Rig(cameras, "m"), world_from_board


def render_target(
    rig: Rig, board: Board, world_from_board: RigidTransform, *, seed: int = 0, legacy: bool = False, noise: float = 2.0
) -> tuple[Image, ...]:
    """Render the target for all cameras, in a room."""
    actor = Actor(make_plate(board, legacy), lambda _: world_from_board)
    return next(iter(render_frames(Scene(rig, (actor,), 1, seed=seed, noise=noise))))


def make_floor_scene(board: Board, *, frames: int, size: tuple[int, int] = (320, 240)) -> tuple[Scene, RigidTransform]:
    """Build the demo's block in front of three cameras that look down on it, with a target on the floor; y points down.

    Returns:
        the scene, and world_from_board.
    """
    rig = arc(
        3, 35.0, 1.1, 1.15 * max(size), size, height=(0.55, 0.7, 0.6), distortion=(-0.09, 0.02, 0.0003, -0.0002, 0.0)
    )
    lying = Rotation.from_matrix(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]))
    about = Rotation.from_rotvec([0, 0.4, 0]) * lying
    floor = RigidTransform.from_components([0.02, 0.18, -0.22], about)
    world_from_board = floor * RigidTransform.from_translation(-compute_middle(board))
    still = Actor(make_plate(board), lambda _: world_from_board)
    scene = make_demo_scene(rig=Rig(rig.cameras, "m"), frames=frames, angle_deg=2.0 * frames, other_actors=(still,))
    return scene, world_from_board
