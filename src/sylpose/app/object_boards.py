"""The frame of a board or marker that is on an object, by frames of a recording in which the object's pose is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.absolute_pose.pose_frame import frame_pose
from sylpose.app.object_frames import Found
from sylpose.app.point_selection import Result
from sylpose.boards.board_pose import Sighting, find_board
from sylpose.boards.specification import parse_board
from sylpose.capture import Session, open_session
from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.robust_loss import chi_squared_bound
from sylpose.results import Status
from sylpose.sync.offsets import find_offsets, retimed
from sylpose.units import FIRST_DISTANCES

__all__ = ["board_frame"]

# So many frames are looked at, evenly spread over those in which the object's pose is known (choice).
FRAMES = 24
# What frames tell of it is half in common: the calibration's errors (choice).
COMMON = 0.5
ROUNDS = 5
# A board that is less certain, degrees, is not where it is said to be (choice).
UNTOLD = 10.0


def board_frame(result: Result, recording: Path, text: str) -> Found:
    """Looks for a board in a recording, and where on the object it is.

    Args:
        result: of that recording.
        text: see `boards.specification.parse_board`.

    Raises:
        FileNotFoundError, ValueError: no recording, or of other cameras; no board, or one that cannot be told from itself
            turned; it is not seen, or is no part of the object.
    """
    if result.trajectory.unit == FIRST_DISTANCES:
        raise ValueError(
            "--board: one camera has learnt the object, without a size: sylpose object scale sets it first"
        )
    board = parse_board(text, result.rig.unit)
    if len(board.alike) > 1:
        raise ValueError(
            f"--board {text}: it looks the same after a turn, so that it tells no axes; markers and ChArUco do"
        )
    session = open_session(recording).with_rig(result.rig)
    offsets = find_offsets(session)
    session = retimed(session, [offsets.get(name, 0.0) for name in session.rig.names])
    known = [pose.index for pose in result.trajectory if pose.measured and pose.index < session.n_frames]
    if not known:
        raise ValueError(f"{result.path}: the object's pose is known in no frame of {recording}")
    chosen = [known[k] for k in np.unique(np.linspace(0, len(known) - 1, FRAMES).round().astype(int))]
    poses, covariances, seen = list[RigidTransform](), list[FloatArray](), 0
    for index in chosen:
        sighting = _seen_in(session, index, result, text)
        seen += bool(sighting.cameras)
        if sighting.motion.status is Status.OK:
            at = frame_pose(sighting.motion, index, 0.0, sighting.motion.n_inliers)
            its = result.pose(index)
            assert at.world_from_object is not None
            assert its.world_from_object is not None
            object_from_board = its.world_from_object.inv() * at.world_from_object
            both = at.covariance + its.of_frame(object_from_board.inv()).covariance
            turn = block_diag(*[at.world_from_object.rotation.as_matrix().T] * 2)
            poses.append(object_from_board)
            covariances.append(turn @ both @ turn.T)
    if not poses:
        said = f"it was seen in {seen}, but its pose is not known in any" if seen else "it was not seen in any"
        raise ValueError(f"--board {text}: of {len(chosen)} frames of {recording} {said}")
    object_from_board, sd, agree = _together(poses, np.array(covariances))
    if 2 * agree <= len(poses) or np.rad2deg(sd[:3].max()) > UNTOLD:
        raise ValueError(
            f"--board {text}: in {len(poses)} frames it is in different places on the object: no part of it, or hardly seen"
        )
    return Found(object_from_board.inv(), sd, f"{text} on it, seen in {agree} frames")


def _seen_in(session: Session, index: int, result: Result, text: str) -> Sighting:
    for frames in session.frames(index, index + 1):
        return find_board(result.rig, frames.images, parse_board(text, result.rig.unit))
    raise ValueError(f"{session.path}: no frame {index}")


def _together(poses: list[RigidTransform], covariances: FloatArray) -> tuple[RigidTransform, FloatArray, int]:
    """What several of `object_from_board` come to; its standard deviations (6,), and how many agree with it.

    Args:
        covariances: (n, 6, 6) of (w, d), board's axes.
    """
    information = np.asarray(np.linalg.inv(covariances), float)
    found = min(poses, key=lambda pose: float(np.median(_squares(_offs(pose, poses), information))))
    for _ in range(ROUNDS):
        off = _offs(found, poses)
        squares = _squares(off, information)
        # They scatter by more than each says, where what they have in common is not the same in all.
        wider = max(float(np.median(squares)) / 6.0, 1.0)
        good = squares <= chi_squared_bound(6) * wider
        total = information[good].sum(axis=0)
        step = np.linalg.solve(total, np.einsum("nij,nj->i", information[good], off[good]))
        found = found * RigidTransform.from_components(step[3:], Rotation.from_rotvec(step[:3]))
    n = int(good.sum())
    one = n * max(float(squares[good].mean()) / 6.0, 1.0) * np.linalg.inv(total)
    return found, np.sqrt(np.diag(one) * (COMMON + (1.0 - COMMON) / n)), n


def _offs(found: RigidTransform, poses: list[RigidTransform]) -> FloatArray:
    """(n, 6) (w, d) from a pose to each of others, in its axes."""
    between = [found.inv() * pose for pose in poses]
    return np.array([np.concatenate([b.rotation.as_rotvec(), b.translation]) for b in between])


def _squares(off: FloatArray, information: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("ni,nij,nj->n", off, information, off))
