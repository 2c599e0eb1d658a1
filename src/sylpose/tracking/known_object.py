"""What was learnt of an object in one take, so that another begins with it: as if it went on after the object was lost."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.display import Telling, Told, length, named
from sylpose.features.sift import Features
from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.validation import finite, kind_of, number
from sylpose.input_limits import one_line
from sylpose.landmarks.landmark_filter import Landmarks
from sylpose.rig import MAX_LENGTH, Rig, single_pose
from sylpose.tracking.camera import CameraPart
from sylpose.tracking.frame import SolvedFrame
from sylpose.tracking.joint_state import Joint
from sylpose.units import FIRST_DISTANCES

__all__ = ["FEWEST", "CameraMemory", "KnownObject", "ObjectFrame", "learnt_of"]

# From fewer keyframes next to nothing is known of an object (choice).
FEWEST = 2
# Characters that say how a frame was found (choice).
SAID = 200


@dataclass(frozen=True, eq=False)
class CameraMemory:
    """What one camera knows of an object.

    Attributes:
        landmarks: (n) of the object.
        features: of each keyframe, those that are landmarks; numbers: (m,) which of them each is (`Landmarks.id`).
    """

    landmarks: Landmarks
    features: tuple[Features, ...]
    numbers: tuple[IntArray, ...]

    def seen_in(self, keyframe: int) -> Landmarks:
        """(m) of the features of a keyframe."""
        return self.landmarks.subset(np.searchsorted(self.landmarks.id, self.numbers[keyframe]))


@dataclass(frozen=True, eq=False)
class ObjectFrame:
    """The frame of an object that poses are told in.

    Attributes:
        from_learnt: from the frame that it was learnt in.
        sd: (6,) how far it may be from the one that was meant: radians about its own axes, length units along them; zero
            where it is one by definition.
        said: how it was found, a few words; "" of the frame that it was learnt in.
    """

    from_learnt: RigidTransform = field(default_factory=RigidTransform.identity)
    sd: FloatArray = field(default_factory=lambda: np.zeros(6))
    said: str = ""


@dataclass(frozen=True, eq=False, repr=False)
class KnownObject(Told):
    """An object as a take has learnt it (object.npz, `load_object`), for another one to begin with.

    Landmarks and keyframes stay in the frame that it was learnt in, whose origin is in the object's middle: there the
    tracker expects it, and what it decides is the same to the bit whatever frame poses are told in.

    Attributes:
        rig: that saw it.
        radius: of the object.
        mark: a word that this object, learnt in this take, has in all files that come of it.
        frame: that poses are told in.
        scale_sd: relative standard deviation of all its lengths, where they were not measured by cameras.
    """

    rig: Rig
    radius: float
    mark: str
    # Learnt frame: (n, 3) a cloud on it; frames that show it from all sides, in order of time; by the name of a camera, what
    # that knows.
    _points: FloatArray
    _keyframes: tuple[SolvedFrame, ...]
    _cameras: Mapping[str, CameraMemory]
    frame: ObjectFrame = field(default_factory=ObjectFrame)
    scale_sd: float = 0.0

    @property
    def unit(self) -> str:
        """Of its lengths, "" where that is not said; `FIRST_DISTANCES` where one camera alone has seen it."""
        return self.rig.unit

    @property
    def camera_names(self) -> tuple[str, ...]:
        """That have seen it."""
        return tuple(self._cameras)

    @property
    def points(self) -> FloatArray:
        """(n, 3) a cloud on it, object's frame."""
        return np.asarray(self.frame.from_learnt.apply(self._points)).reshape(-1, 3)

    @property
    def places(self) -> FloatArray:
        """(n, 3) of its landmarks, of all cameras, object's frame."""
        learnt = np.concatenate([memory.landmarks.mean for memory in self._cameras.values()])
        return np.asarray(self.frame.from_learnt.apply(learnt)).reshape(-1, 3)

    @property
    def depth_sd(self) -> FloatArray:
        """(n,) standard deviations of these places where each is known least."""
        return np.concatenate([memory.landmarks.depth_sd for memory in self._cameras.values()])

    def in_frame(self, new_from_object: RigidTransform, sd: FloatArray | None = None, said: str = "") -> KnownObject:
        """The same object, whose poses are told in another frame.

        Args:
            sd: (6,) of the new frame, as in `ObjectFrame`; None: zero.
            said: how it was found.

        Raises:
            TypeError, ValueError: naming the argument: no single transform of finite values, no standard deviations.
        """
        sd = finite(np.zeros(6) if sd is None else sd, (6,), "sd")
        if (sd < 0.0).any():
            raise ValueError("sd: standard deviations are not negative")
        from_learnt = single_pose(new_from_object, "new_from_object") * self.frame.from_learnt
        frame = ObjectFrame(from_learnt, sd, one_line(kind_of(said, str, "said"), SAID))
        return replace(self, frame=frame)

    def sized(self, factor: float, unit: str, sd: float = 0.0) -> KnownObject:
        """The same object so many times as large, of one that a single camera has learnt: before that camera nothing changes
        by it but how far away everything is.

        Args:
            unit: of its lengths then, or "".
            sd: relative standard deviation of the factor.

        Raises:
            ValueError: lengths that cameras have measured; no factor, no standard deviation.
        """
        if self.unit != FIRST_DISTANCES:
            raise ValueError("cameras have measured its lengths: scaled they would contradict every calibration")
        factor, sd = number(factor, "factor", above=0.0, most=MAX_LENGTH), number(sd, "sd", least=0.0, most=1.0)
        eye, size = self.rig.cameras[0].center, np.repeat([1.0, factor], 3)

        def larger(frame: SolvedFrame) -> SolvedFrame:
            pose, covariance = frame.world_from_object, frame.covariance * np.outer(size, size)
            there = RigidTransform.from_components(eye + factor * (pose.translation - eye), pose.rotation)
            return replace(frame, world_from_object=there, covariance=covariance)

        def enlarged(memory: CameraMemory) -> CameraMemory:
            its = memory.landmarks
            return replace(
                memory, landmarks=replace(its, mean=factor * its.mean, information=its.information / factor**2)
            )

        frame = self.frame.from_learnt
        return replace(
            self,
            rig=Rig(self.rig.cameras, kind_of(unit, str, "unit")),
            radius=factor * self.radius,
            _points=factor * self._points,
            _keyframes=tuple(map(larger, self._keyframes)),
            _cameras={name: enlarged(memory) for name, memory in self._cameras.items()},
            frame=replace(
                self.frame,
                from_learnt=RigidTransform.from_components(factor * frame.translation, frame.rotation),
                sd=self.frame.sd * size,
            ),
            scale_sd=sd,
        )

    def _told(self) -> Telling:
        brief = (
            f"radius {length(self.radius, self.unit)}, {len(self.places)} landmarks, {len(self._keyframes)} keyframes"
        )
        cameras = [(name, f"{len(memory.landmarks.mean)} landmarks") for name, memory in self._cameras.items()]
        return Telling(brief, named(cameras))


def learnt_of(
    rig: Rig, joint: Joint, parts: Sequence[CameraPart], begun: KnownObject | None = None
) -> KnownObject | None:
    """What is known of the object by now; None before it was seen to move and turn: what is known may be the background.

    Args:
        begun: what the take has begun with.
    """
    if joint.last is None or not joint.proven or len(joint.keyframes) < FEWEST or joint.object.guessed:
        return None
    cameras = {}
    for part in parts:
        features, numbers = list[Features](), list[IntArray]()
        for keyframe in joint.keyframes:
            frame = part.frames[keyframe.number]
            known = frame.landmarks
            good = known.moved & ~frame.background & np.isfinite(known.mean).all(axis=1)
            features.append(frame.features.subset(good))
            numbers.append(frame.numbers[good])
        landmarks = part.table.of(np.unique(np.concatenate(numbers)))
        cameras[part.camera.name] = CameraMemory(landmarks, tuple(features), tuple(numbers))
    model = joint.object
    if begun is not None:
        seen_by = Rig(rig.cameras, begun.unit)
        return replace(
            begun,
            rig=seen_by,
            radius=model.radius,
            _points=model.points,
            _keyframes=joint.keyframes,
            _cameras=cameras,
        )
    seen_by = rig if len(rig) > 1 else Rig(rig.cameras, FIRST_DISTANCES)
    return KnownObject(seen_by, model.radius, _mark(joint.keyframes, cameras), model.points, joint.keyframes, cameras)


def _mark(keyframes: Sequence[SolvedFrame], cameras: Mapping[str, CameraMemory]) -> str:
    total = hashlib.blake2b(digest_size=8)
    for keyframe in keyframes:
        total.update(np.ascontiguousarray(keyframe.world_from_object.as_matrix()).tobytes())
    for memory in cameras.values():
        total.update(np.ascontiguousarray(memory.landmarks.mean).tobytes())
    return total.hexdigest()
