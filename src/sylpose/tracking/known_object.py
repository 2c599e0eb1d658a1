"""Object model learned in one recording, with which another recording can start.

A tracker that starts with it behaves as if the object had been lost before the first frame.

Cameras that observed the object, in the same arrangement, keep their landmarks. For others its keyframes are
transferred: if an object has the same pose relative to two cameras, both have the same view of it. So each keyframe of
each learning camera becomes a keyframe of each new camera, at the pose that gives the same view. It belongs to that
camera alone, since the others have different views there. These poses contain the arrangement of the learning cameras
and therefore stay fixed in joint refinement.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import RigidTransform

from sylpose.bundle_adjustment.calibration_refinement import TYPICAL_ERROR_PX
from sylpose.display import Printable
from sylpose.features.sift import Features
from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.matrices import rotation_matrix_of
from sylpose.geometry.validation import check_finite, check_number, check_type
from sylpose.input_limits import to_one_line
from sylpose.landmarks.landmark_filter import Landmarks, LandmarkTable
from sylpose.matches import MAX_STATIC_PX
from sylpose.relative_pose.terms import MIN_MATCHES
from sylpose.results import FramePose
from sylpose.rig import MAX_LENGTH, Rig, check_single_pose
from sylpose.status import Observability
from sylpose.tracking.camera_side.camera import CameraTracker
from sylpose.tracking.camera_side.frame import CameraFrame
from sylpose.tracking.joint_side.joint_state import (
    JointState,
    KnownFrames,
    MotionModel,
    ObjectMotion,
    SolvedFrame,
    compute_viewpoints,
)
from sylpose.tracking.joint_side.object_model import ObjectModel
from sylpose.tracking.options import TrackingOptions
from sylpose.units import INITIAL_DISTANCES

# Minimum number of keyframes of a usable object model: depths need two views (derived).
MIN_KEYFRAMES = 2


@dataclass(frozen=True, eq=False)
class CameraLandmarks:
    """One camera's landmarks of an object.

    Attributes:
        landmarks: (n) of the object.
        features: per keyframe, those that are landmarks.
        landmark_ids: per keyframe, (m,) the landmark of each feature (`Landmarks.id`).
    """

    landmarks: Landmarks
    features: tuple[Features, ...]
    landmark_ids: tuple[IntArray, ...]

    def select_keyframe(self, keyframe: int) -> Landmarks:
        """Return the landmarks (m) of a keyframe's features."""
        return self.landmarks.subset(np.searchsorted(self.landmarks.id, self.landmark_ids[keyframe]))


@dataclass(frozen=True, eq=False)
class ObjectFrame:
    """Coordinate frame of an object in which poses are expressed.

    Attributes:
        from_learned: transform from the frame in which the object was learned.
        sd: (6,) standard deviations from the intended frame: radians about its own axes, length units along them; zero
            for a frame given by definition.
        description: short description of how it was defined; "" for the frame in which the object was learned.
    """

    from_learned: RigidTransform = field(default_factory=RigidTransform.identity)
    sd: FloatArray = field(default_factory=lambda: np.zeros(6))
    description: str = ""


@dataclass(frozen=True, eq=False, repr=False)
class KnownObject(Printable):
    """Object model learned in one recording and used by another (object.npz, `load_object`).

    Landmarks and keyframes stay in the frame in which they were learned, with its origin at the object's center. The
    tracker works in that frame, so its results are bit-identical whatever frame poses are expressed in.

    Attributes:
        rig: of the cameras that learned it.
        radius: of the object.
        fingerprint: identifier of this model, stored in all files derived from it.
        frame: in which poses are expressed.
        scale_sd: relative standard deviation of all its lengths, if they were not measured by calibrated cameras.
    """

    rig: Rig
    radius: float
    fingerprint: str
    # In the learned frame: (n, 3) points on the object; keyframes from all sides, in order of time; landmarks by camera
    # name.
    _points: FloatArray
    _keyframes: tuple[SolvedFrame, ...]
    _cameras: Mapping[str, CameraLandmarks]
    frame: ObjectFrame = field(default_factory=ObjectFrame)
    scale_sd: float = 0.0

    @property
    def unit(self) -> str:
        """Length unit, "" if undefined; `INITIAL_DISTANCES` if a single camera learned the object."""
        return self.rig.unit

    @property
    def camera_names(self) -> tuple[str, ...]:
        """Names of the cameras that observed the object."""
        return tuple(self._cameras)

    @property
    def points(self) -> FloatArray:
        """Points on the object (n, 3), object's frame."""
        return np.asarray(self.frame.from_learned.apply(self._points)).reshape(-1, 3)

    @property
    def positions(self) -> FloatArray:
        """Landmark positions (n, 3) of all cameras, object's frame."""
        learned = np.concatenate([memory.landmarks.mean for memory in self._cameras.values()])
        return np.asarray(self.frame.from_learned.apply(learned)).reshape(-1, 3)

    @property
    def depth_sd(self) -> FloatArray:
        """Standard deviations (n,) of the landmark positions in their least certain direction."""
        return np.concatenate([memory.landmarks.depth_sd for memory in self._cameras.values()])

    def to_frame(
        self, new_from_object: RigidTransform, sd: FloatArray | None = None, description: str = ""
    ) -> KnownObject:
        """Return the object with poses expressed in another frame.

        Args:
            new_from_object: transform from the present frame to the new one.
            sd: (6,) of the new frame, as in `ObjectFrame`; None: zero.
            description: description of the new frame.

        Raises:
            TypeError, ValueError: an argument is not a single finite transform or not valid standard deviations.
        """
        sd = check_finite(np.zeros(6) if sd is None else sd, (6,), "sd")
        if (sd < 0.0).any():
            raise ValueError("sd: standard deviations are not negative")
        from_learned = check_single_pose(new_from_object, "new_from_object") * self.frame.from_learned
        description = to_one_line(check_type(description, str, "description"))
        frame = ObjectFrame(from_learned, sd, description)
        return replace(self, frame=frame)

    def scaled(self, factor: float, unit: str, sd: float = 0.0) -> KnownObject:
        """Return an object learned by a single camera, scaled by a factor.

        For that camera only the distances change.

        Args:
            factor: ratio of new to old lengths.
            unit: of the new lengths, or "".
            sd: relative standard deviation of the factor.

        Raises:
            ValueError: the lengths were measured by calibrated cameras; invalid factor or standard deviation.
        """
        if self.unit != INITIAL_DISTANCES:
            raise ValueError("calibrated cameras measured its lengths: scaling would contradict the calibration")
        factor, sd = (
            check_number(factor, "factor", above=0.0, maximum=MAX_LENGTH),
            check_number(sd, "sd", minimum=0.0, maximum=1.0),
        )
        camera_center, size = self.rig.cameras[0].center, np.repeat([1.0, factor], 3)

        def scale_frame(frame: SolvedFrame) -> SolvedFrame:
            pose, covariance = frame.world_from_object, frame.covariance * np.outer(size, size)
            scaled_pose = RigidTransform.from_components(
                camera_center + factor * (pose.translation - camera_center), pose.rotation
            )
            return replace(frame, world_from_object=scaled_pose, covariance=covariance)

        def scale_landmarks(own: CameraLandmarks) -> CameraLandmarks:
            its = own.landmarks
            return replace(own, landmarks=replace(its, mean=factor * its.mean, information=its.information / factor**2))

        frame = self.frame.from_learned
        return replace(
            self,
            rig=Rig(self.rig.cameras, check_type(unit, str, "unit")),
            radius=factor * self.radius,
            _points=factor * self._points,
            _keyframes=tuple(map(scale_frame, self._keyframes)),
            _cameras={name: scale_landmarks(memory) for name, memory in self._cameras.items()},
            frame=replace(
                self.frame,
                from_learned=RigidTransform.from_components(factor * frame.translation, frame.rotation),
                sd=self.frame.sd * size,
            ),
            scale_sd=sd,
        )


def build_known_object(
    rig: Rig, state: JointState, camera_trackers: Sequence[CameraTracker], initial: KnownObject | None = None
) -> KnownObject | None:
    """Build the object model learned so far; None until the object has moved and rotated.

    Before that, the landmarks may be background. Keyframes that the cameras contradict are left out.

    Args:
        initial: object model that the recording started with.
    """
    keyframes = tuple(keyframe for keyframe in state.frames.keyframes if not keyframe.is_contradicted)
    if (
        state.frames.last is None
        or not state.motion.has_moved
        or len(keyframes) < MIN_KEYFRAMES
        or state.object.is_depth_guessed
    ):
        return None
    cameras = {}
    for camera_tracker in camera_trackers:
        features, numbers = list[Features](), list[IntArray]()
        for keyframe in keyframes:
            frame = camera_tracker.frames[keyframe.number]
            known = frame.landmarks
            good = known.has_moved & ~frame.background & np.isfinite(known.mean).all(axis=1)
            features.append(frame.features.subset(good))
            numbers.append(frame.landmark_ids[good])
        landmarks = camera_tracker.table.get(np.unique(np.concatenate(numbers)))
        cameras[camera_tracker.camera.name] = CameraLandmarks(landmarks, tuple(features), tuple(numbers))
    model = state.object
    if initial is not None:
        new_rig = Rig(rig.cameras, initial.unit)
        return replace(
            initial, rig=new_rig, radius=model.radius, _points=model.points, _keyframes=keyframes, _cameras=cameras
        )
    new_rig = rig if len(rig) > 1 else Rig(rig.cameras, INITIAL_DISTANCES)
    return KnownObject(
        new_rig, model.radius, _compute_fingerprint(keyframes, cameras), model.points, keyframes, cameras
    )


def _compute_fingerprint(keyframes: Sequence[SolvedFrame], cameras: Mapping[str, CameraLandmarks]) -> str:
    total = hashlib.blake2b(digest_size=8)
    for keyframe in keyframes:
        total.update(np.ascontiguousarray(keyframe.world_from_object.as_matrix()).tobytes())
    for memory in cameras.values():
        total.update(np.ascontiguousarray(memory.landmarks.mean).tobytes())
    return total.hexdigest()


# --- transfer to another recording's cameras --------------------------------------------------------------------------


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
        return converted.mark_uncertain()


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


def transfer_object(known: KnownObject, rig: Rig, options: TrackingOptions) -> TransferredObject:
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
        (keyframes, landmarks), position_sd = (
            transfer_keyframes(known, rig, options),
            estimate_calibration_sd(known, rig),
        )
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
        # One or two pixels after a new calibration, tens after moving a camera by hand.
        unchanged = tuple(name for name in names if medians[name] <= MAX_STATIC_PX)
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
    transferred: TransferredObject, rig: Rig, cameras: Sequence[CameraTracker], time: float
) -> JointState:
    """Create the state of a tracker that lost a known object.

    The object's keyframes are frames 0 to K - 1. The cameras' trackers receive their landmarks.

    Args:
        time: of the first frame to come.
    """
    is_visible = np.zeros((len(transferred.keyframes), len(rig)), bool)
    for camera_tracker in cameras:
        own = transferred.landmarks.get(camera_tracker.camera.name)
        if own is None:
            camera_tracker.frames = {k: camera_tracker.create_empty_frame() for k in range(len(is_visible))}
            continue
        camera_tracker.table = LandmarkTable.from_landmarks(own.landmarks)
        for k, (features, numbers) in enumerate(zip(own.features, own.landmark_ids, strict=True)):
            camera_tracker.frames[k] = CameraFrame(
                features, np.zeros(len(features), bool), camera_tracker.table, numbers.copy()
            )
            is_visible[k, camera_tracker.index] = len(features) > 0
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
    motion = ObjectMotion(
        MotionModel(n_frames=1, interval=1.0),
        has_moved=True,
        n_missed=1,
        is_lost=True,
    )
    model = ObjectModel(None, transferred.known_object.radius, transferred.known_object._points)
    return JointState(model, KnownFrames(keyframes[-1], keyframes), motion)


# --- other cameras ------------------------------------------------------------------------------------------------------


class _View(NamedTuple):
    """One camera's view in a keyframe: camera name, keyframe, direction (3,) and number of landmarks."""

    camera: str
    keyframe: int
    direction: FloatArray
    landmarks: int


def transfer_keyframes(
    known: KnownObject, rig: Rig, options: TrackingOptions
) -> tuple[tuple[SolvedFrame, ...], dict[str, CameraLandmarks]]:
    """Transfer the keyframes to another rig.

    Returns:
        keyframes, each of one camera of the rig; by camera name, its landmarks in them.
    """
    # The new recording needs as many keyframes as are refined jointly.
    max_views = max((options.max_keyframes - options.max_window_frames) // len(rig), MIN_MATCHES)
    views = _select_views(known, max_views, options.min_keyframe_rotation)
    all_landmarks, first_ids = _merge_landmarks(known)
    keyframes = list[SolvedFrame]()
    features: dict[str, list[Features]] = {name: [] for name in rig.names}
    numbers: dict[str, list[IntArray]] = {name: [] for name in rig.names}
    for camera in rig:
        for view in views:
            own_landmarks = known._cameras[view.camera]
            keyframe_features, new_from_old = own_landmarks.features[view.keyframe], camera.camera_from_world.inv()
            new_from_old = new_from_old * known.rig[view.camera].camera_from_world
            keyframes.append(replace(transform_frame(known._keyframes[view.keyframe], new_from_old), is_fixed=True))
            for name in rig.names:
                is_own = name == camera.name
                seen = Features(
                    camera.denormalize(keyframe_features.normalized),
                    keyframe_features.normalized,
                    keyframe_features.descriptors,
                )
                features[name].append(seen if is_own else Features.empty())
                own = own_landmarks.landmark_ids[view.keyframe] + first_ids[view.camera]
                numbers[name].append(own if is_own else np.empty(0, np.int64))
    landmarks_by_camera = {}
    for name in rig.names:
        used = np.unique(np.concatenate(numbers[name]))
        landmarks = all_landmarks.subset(np.searchsorted(all_landmarks.id, used))
        landmarks_by_camera[name] = CameraLandmarks(landmarks, tuple(features[name]), tuple(numbers[name]))
    return tuple(keyframes), landmarks_by_camera


def _select_views(known: KnownObject, max_views: int, min_angle: float) -> list[_View]:
    """Select the views to transfer: from all sides, those with most landmarks first."""
    candidates = list[_View]()
    for name, memory in known._cameras.items():
        for k, (frame, features) in enumerate(zip(known._keyframes, memory.features, strict=True)):
            if len(features) >= MIN_MATCHES:
                eye = frame.world_from_object.inv().apply(known.rig[name].center)
                candidates.append(_View(name, k, eye / np.linalg.norm(eye), len(features)))
    candidates.sort(key=lambda view: -view.landmarks)
    while True:
        chosen = list[_View]()
        for view in candidates:
            if all(view.direction @ other.direction < np.cos(min_angle) for other in chosen):
                chosen.append(view)
        if len(chosen) <= max_views:
            return chosen
        # The number of views at some distance from each other on a sphere decreases with its square.
        min_angle *= np.sqrt(len(chosen) / max_views)


def _merge_landmarks(known: KnownObject) -> tuple[Landmarks, dict[str, int]]:
    """Merge all cameras' landmarks; also return each camera's first number."""
    camera_trackers, first, number = list[Landmarks](), dict[str, int](), 0
    for name, memory in known._cameras.items():
        first[name] = number
        camera_trackers.append(replace(memory.landmarks, id=memory.landmarks.id + number))
        number += int(memory.landmarks.id.max(initial=-1)) + 1
    return Landmarks.concatenate(camera_trackers), first


def transform_frame(frame: SolvedFrame, new_from_world: RigidTransform) -> SolvedFrame:
    """Transform a keyframe to another world frame."""
    if (new_from_world.as_matrix() == np.eye(4)).all():
        return frame
    rotation = block_diag(*[rotation_matrix_of(new_from_world)] * 2)
    pose = new_from_world * frame.world_from_object
    return replace(frame, world_from_object=pose, covariance=rotation @ frame.covariance @ rotation.T)


def estimate_calibration_sd(known: KnownObject, rig: Rig) -> float:
    """Return the standard deviation of an object's position between two rigs.

    Both calibrations are assumed to have the usual image error, as no data determines it. The result is in length units.
    """
    positions = np.array([keyframe.world_from_object.translation for keyframe in known._keyframes])
    distance = float(np.median([np.linalg.norm(positions - camera.center, axis=1) for camera in known.rig]))
    # Mean over cameras with independent errors.
    variances = [
        sum((TYPICAL_ERROR_PX * distance / camera.focal) ** 2 for camera in cameras) / len(cameras) ** 2
        for cameras in (known.rig, rig)
    ]
    return float(np.sqrt(sum(variances)))
