"""What was learnt of an object in one take, so that another begins with it: as if it went on after the object was lost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sylpose.features.sift import Features
from sylpose.landmarks.places import Landmarks
from sylpose.landmarks.table import LandmarkTable
from sylpose.numerics.arrays import FloatArray, IntArray
from sylpose.rig import Rig
from sylpose.told import Telling, Told, length, named
from sylpose.tracking.camera import CameraPart
from sylpose.tracking.find import WAIT_FOR_MORE
from sylpose.tracking.frame import CameraFrame, SolvedFrame
from sylpose.tracking.joint import Joint
from sylpose.tracking.keyframes import viewpoints
from sylpose.tracking.object_model import ObjectModel
from sylpose.tracking.velocity import Velocity

__all__ = ["FEWEST", "CameraMemory", "KnownObject", "begun_with", "calibrated_anew", "check_rig", "learnt_of"]

# Landmarks are where these cameras saw them, within so many pixels in the middle, unless they are other cameras or stand
# elsewhere: calibrated anew they are a pixel or two off, moved by hand tens (choice).
SAME_RIG_PX = 5.0
# From fewer keyframes next to nothing is known of an object (choice).
FEWEST = 2


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


@dataclass(frozen=True, eq=False, repr=False)
class KnownObject(Told):
    """An object as a take has learnt it (object.npz, `load_object`), for another one to begin with.

    Attributes:
        unit: of lengths, or "".
        radius: of the object.
        points: (n, 3) a cloud on it, object's frame.
    """

    unit: str
    radius: float
    points: FloatArray
    # Frames that show it from all sides, in order of time; by the name of a camera, what that knows.
    _keyframes: tuple[SolvedFrame, ...]
    _cameras: Mapping[str, CameraMemory]

    @property
    def camera_names(self) -> tuple[str, ...]:
        """That have seen it."""
        return tuple(self._cameras)

    @property
    def places(self) -> FloatArray:
        """(n, 3) of its landmarks, of all cameras, object's frame."""
        return np.concatenate([memory.landmarks.mean for memory in self._cameras.values()])

    def _told(self) -> Telling:
        brief = (
            f"radius {length(self.radius, self.unit)}, {len(self.places)} landmarks, {len(self._keyframes)} keyframes"
        )
        cameras = [(name, f"{len(memory.landmarks.mean)} landmarks") for name, memory in self._cameras.items()]
        return Telling(brief, named(cameras))


def learnt_of(rig: Rig, joint: Joint, parts: Sequence[CameraPart]) -> KnownObject | None:
    """What is known of the object by now; None before it was seen to move and turn: what is known may be the background."""
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
    return KnownObject(rig.unit, joint.object.radius, joint.object.points, joint.keyframes, cameras)


def check_rig(known: KnownObject, rig: Rig) -> None:
    """Whether a rig has the cameras that saw an object, where they stood.

    Raises:
        ValueError: another unit, none of its cameras, or one that stands elsewhere.
    """
    if known.unit != rig.unit:
        said = [f"in {unit}" if unit else "in no unit that is said" for unit in (known.unit, rig.unit)]
        raise ValueError(f"its lengths are {said[0]}, those of the calibration {said[1]}")
    if not {*known._cameras} & {*rig.names}:
        raise ValueError(
            f"it was seen by {', '.join(known._cameras)}, and the calibration has none of these ({', '.join(rig.names)})"
        )
    for name, off in _off(known, rig).items():
        far = np.nan_to_num(np.linalg.norm(off, axis=1), nan=np.inf)
        if len(far) and np.median(far) > SAME_RIG_PX:
            raise ValueError(
                f"{name} is another camera than the one that saw it, or stands elsewhere: what is known of it would be "
                f"{np.median(far):.0f} px off in its images"
            )


def _off(known: KnownObject, rig: Rig) -> dict[str, FloatArray]:
    """By camera that both have, (n, 2) pixels from where its landmarks were seen to where the rig's cameras see them."""
    off = {}
    for camera in rig:
        memory = known._cameras.get(camera.name)
        if memory is None:
            continue
        pieces = [np.empty((0, 2))]
        for k, (frame, features) in enumerate(zip(known._keyframes, memory.features, strict=True)):
            places = memory.seen_in(k).mean
            pieces.append(camera.project(frame.world_from_object.apply(places).reshape(-1, 3)) - features.pixels)
        off[camera.name] = np.concatenate(pieces)
    return off


def calibrated_anew(known: KnownObject, rig: Rig) -> FloatArray:
    """(6, 6) covariance of (w, d): how far poses may be off where cameras are calibrated otherwise than when the object was
    learnt. They are drawn by what its landmarks are off as a whole in each camera's images."""
    far = []
    for name, off in _off(known, rig).items():
        if len(off):
            camera = rig[name]
            away = np.median(
                [camera.camera_from_world.apply(k.world_from_object.translation)[2] for k in known._keyframes]
            )
            far.append(float(np.linalg.norm(np.nanmedian(off, axis=0))) * away / camera.focal)
    # Of cameras that are off independently of each other, the mean.
    shift = float(np.sqrt(np.sum(np.square(far)))) / len(far) if far else 0.0
    return np.diag(np.repeat([(shift / known.radius) ** 2, shift**2], 3))


def begun_with(known: KnownObject, rig: Rig, parts: Sequence[CameraPart], time: float) -> Joint:
    """The state of a tracker that has lost an object that it knows from its frames 0 to K - 1; the cameras' parts get what
    they know.

    Args:
        time: of the first frame to come.
    """
    sees = np.zeros((len(known._keyframes), len(rig)), bool)
    for c, part in enumerate(parts):
        memory = known._cameras.get(part.camera.name)
        if memory is None:
            part.frames = {k: part.blind() for k in range(len(sees))}
            continue
        part.table = LandmarkTable.holding(memory.landmarks)
        for k, (features, numbers) in enumerate(zip(memory.features, memory.numbers, strict=True)):
            part.frames[k] = CameraFrame(features, np.zeros(len(features), bool), part.table, numbers.copy())
            sees[k, c] = len(features) > 0
    keyframes = tuple(
        replace(
            frame,
            number=k,
            time=time + k - len(sees),
            late=np.zeros(len(rig)),
            viewpoints=viewpoints(rig, frame.world_from_object),
            sees=sees[k],
        )
        for k, frame in enumerate(known._keyframes)
    )
    return Joint(
        ObjectModel(None, known.radius, known.points),
        last=keyframes[-1],
        keyframes=keyframes,
        velocity=Velocity(frames=1, interval=1.0),
        missed=1,
        seen_again=WAIT_FOR_MORE,  # poses are wanted from the first frame on, however little of it is seen there
        lost=True,
        proven=True,
    )
