"""In boxes it is the middle that tells whether the object moves, or somebody who passes by."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from sylpose.features.sift import Features
from sylpose.geometry.arrays import FloatArray
from sylpose.landmarks.landmark_filter import Landmarks
from sylpose.landmarks.landmark_table import LandmarkTable
from sylpose.results import FrameStatus
from sylpose.rig import Rig
from sylpose.simulate import Actor, ring
from sylpose.tracking.box_motion import middle_stands, still_ones
from sylpose.tracking.camera import CameraPart
from sylpose.tracking.camera_executor import OneProcess
from sylpose.tracking.context import Team
from sylpose.tracking.frame import CameraFrame, Frame, Pair, SolvedFrame
from sylpose.tracking.frame_solvers import SOLVERS
from sylpose.tracking.joint_state import Joint
from sylpose.tracking.object_model import ObjectModel
from sylpose.tracking.tracker import track
from tests.clips import Clip, errors, moving_scene, slab, statuses, turned

RADIUS = 0.15
RIG = ring(3, 1.5, 1000.0)


def asked(shifts: list[tuple[float, float]], rig: Rig = RIG) -> tuple[bool, list[int]]:
    """Whether the middle stands where in each camera what is at the middle, and what is at the edge, moves by so many pixels
    (NaN: nothing is seen there); and how many matches of each stand."""
    crew = OneProcess(len(rig), 1)
    start, rng = RigidTransform.identity(), np.random.default_rng(0)
    cloud = rng.uniform(-RADIUS, RADIUS, (200, 3))
    n = len(rig)
    first = SolvedFrame(0, 0.0, np.zeros(n), start, np.zeros((6, 6)), np.zeros((n, 3)), np.ones(n, bool))
    joint = Joint(ObjectModel(np.zeros(3), RADIUS, cloud, bounded=True, guessed=True)).begun(first)
    pairs, cameras = [], []
    for camera, moves in zip(rig, shifts, strict=True):
        outline = camera.project(cloud)
        low, size = outline.min(axis=0), np.ptp(outline, axis=0)
        at = rng.uniform(0.3, 0.7, (30, 2)), rng.uniform(0.0, 0.1, (30, 2))
        seen = [(low + size * where, px) for where, px in zip(at, moves, strict=True) if np.isfinite(px)]
        before = np.concatenate([np.empty((0, 2)), *(places for places, _ in seen)])
        after = before + np.repeat([px for _, px in seen], 30)[:, None] * np.array([0.6, 0.8])
        pairs.append([pair_of(before, after)] if len(before) else [])
        cameras.append(
            CameraFrame(features(after), np.zeros(len(after), bool), LandmarkTable(), np.full(len(after), -1))
        )
    frame = Frame(1, 1.0, np.zeros(len(rig)), cameras)
    parts = [CameraPart(c, camera) for c, camera in enumerate(rig)]
    team = Team(rig, parts, crew, SOLVERS["landmarks"], False, np.zeros(len(rig)), 0)
    rest = still_ones(team, frame, pairs)
    return middle_stands(team, joint, frame, pairs), [sum(map(len, of)) for of in rest]


def features(pixels: FloatArray) -> Features:
    return Features(pixels, pixels / 1000.0, np.zeros((len(pixels), 128), np.float32))


def pair_of(before: FloatArray, after: FloatArray) -> Pair:
    n = len(before)
    table = LandmarkTable()
    known = Landmarks(
        np.zeros((n, 3)), np.tile(np.eye(3), (n, 1, 1)), np.ones(n, int), np.zeros(n, bool), before, np.full(n, -1)
    )
    earlier = CameraFrame(features(before), np.zeros(n, bool), table, table.learn(known))
    return Pair.of(0, earlier, features(after), np.column_stack([np.arange(n), np.arange(n)]))


@pytest.mark.parametrize(
    ("shifts", "stands"),
    [
        ([(0.1, 12.0), (0.1, 12.0), (0.1, 0.1)], True),  # somebody passes by behind it
        ([(0.1, 12.0), (0.1, 0.1), (0.1, 0.1)], True),
        ([(12.0, 0.1), (12.0, 0.1), (12.0, 0.1)], False),  # the object moves before a wall
        ([(12.0, 0.1), (12.0, 0.1), (0.1, 0.1)], False),  # something stands before one camera
        ([(5.0, 60.0), (5.0, 60.0), (5.0, 60.0)], False),  # it moves, too, and somebody faster
        ([(0.1, 0.1), (0.1, 0.1), (0.1, 0.1)], False),  # nothing moves: nothing is to be told apart
        ([(3.0, 9.0), (3.0, 9.0), (3.0, 9.0)], False),  # it turns about its middle
        ([(np.nan, 12.0), (np.nan, 12.0), (np.nan, 12.0)], False),  # the middle has no features
        ([(np.nan, np.nan)] * 3, False),
    ],
)
def test_the_middle_tells(shifts: list[tuple[float, float]], stands: bool) -> None:
    assert asked(shifts)[0] is stands


def test_what_is_left_is_what_stands() -> None:
    assert asked([(0.1, 12.0), (12.0, 0.1), (np.nan, np.nan)])[1] == [30, 30, 0]


def test_somebody_passes_by_behind_an_object_at_rest() -> None:
    """He is seen in the boxes of most cameras, and is larger than the object; then the object moves, too."""
    rest, moving = 8, 4

    def path(frame: float) -> RigidTransform:
        return turned(3.0 * max(frame - rest + 1, 0.0))

    def walks(frame: float) -> RigidTransform:
        return turned(1.0 * frame, [-0.45 + 0.08 * frame, 0.0, 0.45])

    clip = Clip.render(moving_scene(path, rest + moving, [Actor(slab((0.4, 0.8, 0.2), 30), walks)]))
    tracked = list(track(clip.frames(), clip.rig, clip.boxes))
    assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * (rest + moving - 1)
    error = errors(tracked, clip.truth)
    assert error[: rest - 1, 0].max() < 0.1
    assert error[: rest - 1, 1].max() < 1.0
    assert error[:, 0].max() < 1.0
