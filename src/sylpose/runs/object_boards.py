"""Object frame from a board or marker on the object, seen in frames with a known object pose."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.absolute_pose.pose import make_frame_pose
from sylpose.boards.board_pose import BoardObservation, find_board
from sylpose.boards.specification import parse_board
from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.robust_loss import chi_squared_bound
from sylpose.io.capture import Session, open_session
from sylpose.results import Status
from sylpose.runs.object_frames import NewFrame
from sylpose.runs.point_selection import ObjectRun
from sylpose.sync.offsets import apply_offsets, find_offsets
from sylpose.units import INITIAL_DISTANCES

__all__ = ["estimate_board_frame"]

# Number of frames that are searched, evenly spread over those with a known object pose (choice).
MAX_FRAMES = 24
# Share of the frames' variance that is common to all of them: the calibration's errors (choice).
COMMON_VARIANCE = 0.5
ROUNDS = 5
# A board with a larger standard deviation, degrees, is rejected (choice).
MAX_ROTATION_SD = 10.0


def estimate_board_frame(result: ObjectRun, recording: Path, text: str) -> NewFrame:
    """Detect a board in a recording and estimate its frame on the object.

    Args:
        result: result of a run on that recording.
        recording: folder of the recording.
        text: specification of the board, see `boards.specification.parse_board`.

    Returns:
        The transform from the object's frame to the board's, with its standard deviations.

    Raises:
        FileNotFoundError, ValueError: no recording, or other cameras; no board, or one with a rotational symmetry; a
            board that is not detected, or that does not move with the object.
    """
    if result.trajectory.unit == INITIAL_DISTANCES:
        raise ValueError(
            "--board: the object was learned with one camera and has no size: set it with sylpose object scale first"
        )
    board = parse_board(text, result.rig.unit)
    if len(board.symmetries) > 1:
        raise ValueError(
            f"--board {text}: it is symmetric under a rotation, so its axes are ambiguous; use a marker or a ChArUco "
            "board"
        )
    session = open_session(recording).with_rig(result.rig)
    offsets = find_offsets(session)
    session = apply_offsets(session, [offsets.get(name, 0.0) for name in session.rig.names])
    known = [pose.index for pose in result.trajectory if pose.is_measured and pose.index < session.n_frames]
    if not known:
        raise ValueError(f"{result.path}: no frame of {recording} has a known object pose")
    chosen = [known[k] for k in np.unique(np.linspace(0, len(known) - 1, MAX_FRAMES).round().astype(int))]
    poses, covariances, n_detected = list[RigidTransform](), list[FloatArray](), 0
    for index in chosen:
        detection = _detect_board(session, index, result, text)
        n_detected += bool(detection.cameras)
        if detection.motion.status is Status.OK:
            board_pose = make_frame_pose(detection.motion, index, 0.0, detection.motion.n_inliers)
            object_pose = result.pose(index)
            assert board_pose.world_from_object is not None
            assert object_pose.world_from_object is not None
            object_from_board = object_pose.world_from_object.inv() * board_pose.world_from_object
            covariance = board_pose.covariance + object_pose.in_object_frame(object_from_board.inv()).covariance
            rotation = block_diag(*[board_pose.world_from_object.rotation.as_matrix().T] * 2)
            poses.append(object_from_board)
            covariances.append(rotation @ covariance @ rotation.T)
    if not poses:
        reason = (
            f"it was detected in {n_detected}, but no pose could be solved" if n_detected else "it was detected in none"
        )
        raise ValueError(f"--board {text}: of {len(chosen)} frames of {recording} {reason}")
    object_from_board, sd, n_agreeing = _average_poses(poses, np.array(covariances))
    if 2 * n_agreeing <= len(poses) or np.rad2deg(sd[:3].max()) > MAX_ROTATION_SD:
        raise ValueError(
            f"--board {text}: its position on the object differs in {len(poses)} frames: not attached, or hardly "
            "visible"
        )
    return NewFrame(object_from_board.inv(), sd, f"{text} on it, detected in {n_agreeing} frames")


def _detect_board(session: Session, index: int, result: ObjectRun, text: str) -> BoardObservation:
    for frames in session.frames(index, index + 1):
        return find_board(result.rig, frames.images, parse_board(text, result.rig.unit))
    raise ValueError(f"{session.path}: no frame {index}")


def _average_poses(poses: list[RigidTransform], covariances: FloatArray) -> tuple[RigidTransform, FloatArray, int]:
    """Average `object_from_board` over frames with a robust, information-weighted fit.

    Args:
        poses: n transforms object_from_board.
        covariances: (n, 6, 6) covariances of (w, d), in the board's axes.

    Returns:
        The average, its standard deviations (6,), and the number of frames that agree with it.
    """
    information = np.asarray(np.linalg.inv(covariances), float)
    mean = min(
        poses, key=lambda pose: float(np.median(_squared_mahalanobis(_pose_differences(pose, poses), information)))
    )
    for _ in range(ROUNDS):
        differences = _pose_differences(mean, poses)
        squared_distances = _squared_mahalanobis(differences, information)
        # They scatter by more than their covariances if the errors in common differ between frames.
        inflation = max(float(np.median(squared_distances)) / 6.0, 1.0)
        inliers = squared_distances <= chi_squared_bound(6) * inflation
        information_sum = information[inliers].sum(axis=0)
        step = np.linalg.solve(information_sum, np.einsum("nij,nj->i", information[inliers], differences[inliers]))
        mean = mean * RigidTransform.from_components(step[3:], Rotation.from_rotvec(step[:3]))
    n = int(inliers.sum())
    covariance = n * max(float(squared_distances[inliers].mean()) / 6.0, 1.0) * np.linalg.inv(information_sum)
    return mean, np.sqrt(np.diag(covariance) * (COMMON_VARIANCE + (1.0 - COMMON_VARIANCE) / n)), n


def _pose_differences(reference: RigidTransform, poses: list[RigidTransform]) -> FloatArray:
    """Return the differences (w, d), (n, 6), from one pose to each of the others, in its axes."""
    relative = [reference.inv() * pose for pose in poses]
    return np.array([np.concatenate([b.rotation.as_rotvec(), b.translation]) for b in relative])


def _squared_mahalanobis(differences: FloatArray, information: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("ni,nij,nj->n", differences, information, differences))
