"""Transfer of a known object to another recording's cameras, and of poses to the object's frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import FloatArray
from sylpose.landmarks.landmark_table import LandmarkTable
from sylpose.results import FramePose, Observability
from sylpose.rig import Rig
from sylpose.tracking.camera import CameraTracker
from sylpose.tracking.cross_rig_transfer import estimate_calibration_sd, transfer_keyframes, transform_frame
from sylpose.tracking.frame import CameraFrame, SolvedFrame
from sylpose.tracking.joint_state import JointState
from sylpose.tracking.keyframes import compute_viewpoints
from sylpose.tracking.known_object import CameraLandmarks, KnownObject
from sylpose.tracking.motion_model import VelocityModel
from sylpose.tracking.object_model import ObjectModel
from sylpose.tracking.pose_search import MAX_WAIT_FRAMES
from sylpose.units import INITIAL_DISTANCES

__all__ = ["PoseConverter", "TransferredObject", "check_unit", "initialize_from_object", "transfer_object"]

# A camera is unchanged if the median reprojection error of its landmarks is at most this, pixels: after a new
# calibration it is one or two, after moving a camera by hand tens (choice).
SAME_RIG_PX = 5.0


@dataclass(frozen=True, eq=False)
class PoseConverter:
    """Conversion of tracked poses to a known object's frame.

    It adds the uncertainty due to calibration differences since the object was learned, and due to its unknown scale.

    Attributes:
        from_learned: transform from the frame in which the object was learned, which the tracker uses, to the object's
            frame.
        calibration_covariance: (6, 6) covariance of (w, d) due to calibration differences.
        scale_sd: relative standard deviation of the object's lengths.
        radius: of the object.
        camera_center: (3,) center of a single camera; None with several.
        measures_distance: whether a single camera measures distance by the object's size.
    """

    from_learned: RigidTransform
    calibration_covariance: FloatArray
    scale_sd: float
    radius: float
    camera_center: FloatArray | None
    measures_distance: bool

    def convert(self, pose: FramePose) -> FramePose:
        """Convert a pose of the tracker, or of the joint refinement of all poses, to the object's frame."""
        if pose.world_from_object is None:
            return pose
        observable = Observability.ALL if self.measures_distance else pose.observability
        inflated = replace(pose, covariance=pose.covariance + self.calibration_covariance, observability=observable)
        converted = inflated.in_object_frame(self.from_learned)
        if self.scale_sd and converted.world_from_object is not None:
            origin = converted.world_from_object.translation
            offset = origin - (pose.world_from_object.translation if self.camera_center is None else self.camera_center)
            sized = np.outer(offset, offset)
            if self.camera_center is None:  # an object of the wrong size is displaced differently for each camera
                sized += self.radius**2 * np.eye(3)
            rotation_block = np.eye(3) if self.camera_center is None else np.zeros((3, 3))
            converted = replace(
                converted, covariance=converted.covariance + self.scale_sd**2 * block_diag(rotation_block, sized)
            )
        return converted.update_uncertain_status()


@dataclass(frozen=True, eq=False)
class TransferredObject:
    """Known object as the cameras of another recording would have observed it.

    Attributes:
        known_object: the object.
        keyframes: in the world frame of these cameras.
        landmarks: by camera name, its landmarks in these keyframes.
        converter: converts poses to the object's frame.
        names: of these cameras.
    """

    known_object: KnownObject
    keyframes: tuple[SolvedFrame, ...]
    landmarks: Mapping[str, CameraLandmarks]
    converter: PoseConverter
    names: tuple[str, ...]

    @property
    def is_other_rig(self) -> bool:
        """Whether the object was learned by other cameras, or by these in a different arrangement."""
        return self.keyframes[0].is_fixed

    @property
    def note(self) -> str:
        """A remark on cameras that have moved since the object was learned; "" if none has."""
        if self.is_other_rig:
            return (
                "Other cameras learned the object, or these have moved since: landmarks are transferred to new views, "
                "and pose uncertainty includes the usual difference between two calibrations."
            )
        moved = [name for name in self.names if name in self.known_object.camera_names and name not in self.landmarks]
        return f"Moved since the object was learned: {', '.join(moved)}, without landmarks so far." if moved else ""


def transfer_object(known: KnownObject, rig: Rig) -> TransferredObject:
    """Transfer a known object to the cameras of a rig.

    These may be cameras that observed it, in the same arrangement and any world frame, or others.

    Raises:
        ValueError: lengths in another unit.
    """
    check_unit(known, rig)
    keyframes, unchanged, errors_px = _align_world(known, rig)
    if unchanged:
        landmarks = {name: known._cameras[name] for name in unchanged}
        position_sd = _estimate_position_sd(rig, keyframes, {name: errors_px[name] for name in unchanged})
    else:
        (keyframes, landmarks), position_sd = transfer_keyframes(known, rig), estimate_calibration_sd(known, rig)
    converter = PoseConverter(
        known.frame.from_learned,
        np.diag(np.repeat([(position_sd / known.radius) ** 2, position_sd**2], 3)),
        known.scale_sd,
        known.radius,
        rig.cameras[0].center if len(rig) == 1 else None,
        len(rig) == 1 and known.unit != INITIAL_DISTANCES,
    )
    return TransferredObject(known, keyframes, landmarks, converter, rig.names)


def check_unit(known: KnownObject, rig: Rig) -> None:
    """Check that a rig and the object use the same length unit.

    Raises:
        ValueError: different units.
    """
    if known.unit == INITIAL_DISTANCES and len(rig) > 1:
        raise ValueError(
            "a single camera learned it, so that its lengths are relative to the first distance; "
            "sylpose object scale sets its size"
        )
    if known.unit not in (rig.unit, INITIAL_DISTANCES):
        units = [f"in {unit}" if unit else "without a unit" for unit in (known.unit, rig.unit)]
        raise ValueError(f"its lengths are {units[0]}, those of the calibration {units[1]}")


def _align_world(
    known: KnownObject, rig: Rig
) -> tuple[tuple[SolvedFrame, ...], tuple[str, ...], dict[str, FloatArray]]:
    """Transform the keyframes to the rig's world frame.

    Candidates are the unchanged world frame and those that align one camera with its former pose; the one that keeps
    most cameras unchanged is used.

    Returns:
        keyframes; names of the unchanged cameras, empty if too few for the same rig; `_compute_reprojection_errors` of
        all cameras.
    """
    names = [name for name in rig.names if name in known._cameras]
    candidates = [RigidTransform.identity()]
    candidates += [rig[name].camera_from_world.inv() * known.rig[name].camera_from_world for name in names]
    found = []
    for new_from_world in candidates:
        keyframes = tuple(transform_frame(frame, new_from_world) for frame in known._keyframes)
        errors_px = _compute_reprojection_errors(known, rig, keyframes, names)
        medians = _compute_median_errors(errors_px)
        unchanged = tuple(name for name in names if medians[name] <= SAME_RIG_PX)
        found.append(((-len(unchanged), sum(min(px, 1e6) for px in medians.values())), keyframes, unchanged, errors_px))
    # Keep the world frame unless another one is clearly better, as aligning one recalibrated camera alone gains
    # nothing.
    original, *others = found
    best = min(others, key=lambda world: world[0], default=original)
    best = best if best[0][0] < original[0][0] else original
    _, keyframes, unchanged, errors_px = best
    # A single camera can be aligned in any world frame; a few of many do not suffice.
    is_enough = len(unchanged) > 1 or best is original
    return (
        keyframes,
        unchanged if is_enough and 2 * len(unchanged) >= min(len(rig), len(known._cameras)) else (),
        errors_px,
    )


def _compute_reprojection_errors(
    known: KnownObject, rig: Rig, keyframes: Sequence[SolvedFrame], names: Sequence[str]
) -> dict[str, FloatArray]:
    """Return each camera's reprojection errors (n, 2) of its landmarks in the new rig, pixels."""
    errors_px = {}
    for name in names:
        own, pieces = known._cameras[name], [np.empty((0, 2))]
        for k, (frame, features) in enumerate(zip(keyframes, own.features, strict=True)):
            positions = frame.world_from_object.apply(own.select_keyframe(k).mean).reshape(-1, 3)
            pieces.append(rig[name].project(positions) - features.pixels)
        errors_px[name] = np.concatenate(pieces)
    return errors_px


def _compute_median_errors(errors_px: Mapping[str, FloatArray]) -> dict[str, float]:
    """Return each camera's median error, pixels; infinite if landmarks are behind it, 0 without any."""
    distances = {name: np.nan_to_num(np.linalg.norm(its, axis=1), nan=np.inf) for name, its in errors_px.items()}
    return {name: float(np.median(its)) if len(its) else 0.0 for name, its in distances.items()}


def _estimate_position_sd(rig: Rig, keyframes: Sequence[SolvedFrame], errors_px: Mapping[str, FloatArray]) -> float:
    """Return the object's position uncertainty due to recalibrated cameras, length units.

    It is derived from the landmarks' median displacement in each camera's images.
    """
    deviations = []
    for name, its in errors_px.items():
        if len(its):
            camera = rig[name]
            away = np.median([camera.camera_from_world.apply(k.world_from_object.translation)[2] for k in keyframes])
            deviations.append(float(np.linalg.norm(np.nanmedian(its, axis=0))) * away / camera.focal)
    # Mean over cameras with independent errors.
    return float(np.sqrt(np.sum(np.square(deviations)))) / len(deviations) if deviations else 0.0


def initialize_from_object(
    transferred: TransferredObject, rig: Rig, camera_trackers: Sequence[CameraTracker], time: float
) -> JointState:
    """Create the state of a tracker that lost a known object.

    The object's keyframes are frames 0 to K - 1. The cameras' trackers receive their landmarks.

    Args:
        time: of the first frame to come.
    """
    is_visible = np.zeros((len(transferred.keyframes), len(rig)), bool)
    for c, camera_tracker in enumerate(camera_trackers):
        own = transferred.landmarks.get(camera_tracker.camera.name)
        if own is None:
            camera_tracker.frames = {k: camera_tracker.create_empty_frame() for k in range(len(is_visible))}
            continue
        camera_tracker.table = LandmarkTable.from_landmarks(own.landmarks)
        for k, (features, numbers) in enumerate(zip(own.features, own.landmark_ids, strict=True)):
            camera_tracker.frames[k] = CameraFrame(
                features, np.zeros(len(features), bool), camera_tracker.table, numbers.copy()
            )
            is_visible[k, c] = len(features) > 0
    keyframes = tuple(
        replace(
            frame,
            number=k,
            time=time + k - len(is_visible),
            time_offsets=np.zeros(len(rig)),
            viewpoints=compute_viewpoints(rig, frame.world_from_object),
            is_visible=is_visible[k],
        )
        for k, frame in enumerate(transferred.keyframes)
    )
    return JointState(
        ObjectModel(None, transferred.known_object.radius, transferred.known_object._points),
        last=keyframes[-1],
        keyframes=keyframes,
        velocity=VelocityModel(n_frames=1, interval=1.0),
        n_missed=1,
        n_reobserved=MAX_WAIT_FRAMES,  # poses are required from the first frame on, even if little is visible
        is_lost=True,
        has_moved=True,
    )
