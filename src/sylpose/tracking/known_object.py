"""Object model learned in one recording, with which another recording can start.

A tracker that starts with it behaves as if the object had been lost before the first frame.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.display import Printable
from sylpose.features.sift import Features
from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.validation import check_finite, check_number, check_type
from sylpose.input_limits import to_one_line
from sylpose.landmarks.landmark_filter import Landmarks
from sylpose.rig import MAX_LENGTH, Rig, check_single_pose
from sylpose.tracking.camera_side.camera import CameraTracker
from sylpose.tracking.joint_side.joint_state import JointState, SolvedFrame
from sylpose.units import INITIAL_DISTANCES

# Minimum number of keyframes of a usable object model (choice).
MIN_KEYFRAMES = 2
# Maximum length of a frame's description, characters (choice).
MAX_DESCRIPTION_CHARS = 200


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
        description = to_one_line(check_type(description, str, "description"), MAX_DESCRIPTION_CHARS)
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

    Before that, the landmarks may be background.

    Args:
        initial: object model that the recording started with.
    """
    if (
        state.frames.last is None
        or not state.motion.has_moved
        or len(state.frames.keyframes) < MIN_KEYFRAMES
        or state.object.is_depth_guessed
    ):
        return None
    cameras, keyframes = {}, state.frames.keyframes
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
