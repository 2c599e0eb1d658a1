"""A known object before the cameras of another take: where these would have seen what is known of it, and how its poses are
told."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import FloatArray
from sylpose.landmarks.landmark_table import LandmarkTable
from sylpose.results import FramePose, Observable
from sylpose.rig import Rig
from sylpose.tracking.camera import CameraPart
from sylpose.tracking.cross_rig_transfer import calibrated_apart, carried, elsewhere
from sylpose.tracking.frame import CameraFrame, SolvedFrame
from sylpose.tracking.joint_state import Joint
from sylpose.tracking.keyframes import viewpoints
from sylpose.tracking.known_object import CameraMemory, KnownObject
from sylpose.tracking.motion_model import Velocity
from sylpose.tracking.object_model import ObjectModel
from sylpose.tracking.pose_search import WAIT_FOR_MORE
from sylpose.units import FIRST_DISTANCES

__all__ = ["KnownHere", "Telling", "begun_with", "check_unit", "known_here"]

# Landmarks are where these cameras saw them, within so many pixels in the middle, unless they are other cameras or stand
# elsewhere: calibrated anew they are a pixel or two off, moved by hand tens (choice).
SAME_RIG_PX = 5.0


@dataclass(frozen=True, eq=False)
class Telling:
    """How poses of a known object are told: of its frame, and less certain by what its cameras are calibrated otherwise than
    when it was learnt, and by what is not known of its size.

    Attributes:
        from_learnt: from the frame that the object was learnt in, which the tracker has poses of, to its frame.
        anew: (6, 6) covariance of (w, d): how far poses may be off where cameras are calibrated otherwise.
        scale_sd: relative standard deviation of the object's lengths; radius: of the object.
        eye: (3,) where a single camera stands; None of several.
        sized: whether a single camera sees how far away it is, by its size.
    """

    from_learnt: RigidTransform
    anew: FloatArray
    scale_sd: float
    radius: float
    eye: FloatArray | None
    sized: bool

    def of(self, pose: FramePose) -> FramePose:
        """A pose as the tracker, or the refinement of all poses, has it, as it is told."""
        if pose.world_from_object is None:
            return pose
        observable = Observable.ALL if self.sized else pose.observable
        wider = replace(pose, covariance=pose.covariance + self.anew, observable=observable)
        told = wider.of_frame(self.from_learnt)
        if self.scale_sd and told.world_from_object is not None:
            origin = told.world_from_object.translation
            off = origin - (pose.world_from_object.translation if self.eye is None else self.eye)
            sized = np.outer(off, off)
            if self.eye is None:  # what is too large, or too small, lies elsewhere for each camera
                sized += self.radius**2 * np.eye(3)
            about = np.eye(3) if self.eye is None else np.zeros((3, 3))
            told = replace(told, covariance=told.covariance + self.scale_sd**2 * block_diag(about, sized))
        return told.judged()


@dataclass(frozen=True, eq=False)
class KnownHere:
    """A known object, as the cameras of another take would have seen it.

    Attributes:
        known: the object.
        keyframes: in the world of these cameras; memories: by the name of a camera, what it knows, of these keyframes.
        telling: how poses are told; names: of these cameras.
    """

    known: KnownObject
    keyframes: tuple[SolvedFrame, ...]
    memories: Mapping[str, CameraMemory]
    telling: Telling
    names: tuple[str, ...]

    @property
    def another_rig(self) -> bool:
        """Whether it was learnt by other cameras, or by these as they stood elsewhere."""
        return self.keyframes[0].stays

    @property
    def note(self) -> str:
        """A sentence on cameras that do not stand where they stood; "" of those that do."""
        if self.another_rig:
            return (
                "Other cameras have learnt the object, or these as they stood elsewhere: what those saw is taken to be what "
                "these would see, and poses are no better known than two calibrations usually agree."
            )
        moved = [name for name in self.names if name in self.known.camera_names and name not in self.memories]
        return (
            f"Elsewhere than when the object was learnt: {', '.join(moved)}, which knows nothing of it yet."
            if moved
            else ""
        )


def known_here(known: KnownObject, rig: Rig) -> KnownHere:
    """A known object before the cameras of a rig: of those that saw it, where they stood to each other, in any world; or of
    others.

    Raises:
        ValueError: lengths in another unit.
    """
    check_unit(known, rig)
    keyframes, same, off = _in_this_world(known, rig)
    if same:
        memories = {name: known._cameras[name] for name in same}
        shift = _calibrated_anew(rig, keyframes, {name: off[name] for name in same})
    else:
        (keyframes, memories), shift = carried(known, rig), calibrated_apart(known, rig)
    telling = Telling(
        known.frame.from_learnt,
        np.diag(np.repeat([(shift / known.radius) ** 2, shift**2], 3)),
        known.scale_sd,
        known.radius,
        rig.cameras[0].center if len(rig) == 1 else None,
        len(rig) == 1 and known.unit != FIRST_DISTANCES,
    )
    return KnownHere(known, keyframes, memories, telling, rig.names)


def check_unit(known: KnownObject, rig: Rig) -> None:
    """Whether a rig can tell the object's lengths.

    Raises:
        ValueError: they are in another unit.
    """
    if known.unit == FIRST_DISTANCES and len(rig) > 1:
        raise ValueError(
            "one camera has learnt it, so that its lengths are relative to its first distance; "
            "sylpose object scale gives it a size"
        )
    if known.unit not in (rig.unit, FIRST_DISTANCES):
        said = [f"in {unit}" if unit else "in no unit that is said" for unit in (known.unit, rig.unit)]
        raise ValueError(f"its lengths are {said[0]}, those of the calibration {said[1]}")


def _in_this_world(
    known: KnownObject, rig: Rig
) -> tuple[tuple[SolvedFrame, ...], tuple[str, ...], dict[str, FloatArray]]:
    """The keyframes in the rig's world; the cameras that stand there as those did that saw it, none where these are too few
    for the same rig; and what `_off` says of all.

    The world is that of the cameras that saw it, or the one in which one of them stands where it stood: whichever has most
    of them stand so.
    """
    names = [name for name in rig.names if name in known._cameras]
    worlds = [RigidTransform.identity()]
    worlds += [rig[name].camera_from_world.inv() * known.rig[name].camera_from_world for name in names]
    found = []
    for new_from_world in worlds:
        keyframes = tuple(elsewhere(frame, new_from_world) for frame in known._keyframes)
        off = _off(known, rig, keyframes, names)
        far = _medians(off)
        same = tuple(name for name in names if far[name] <= SAME_RIG_PX)
        found.append(((-len(same), sum(min(px, 1e6) for px in far.values())), keyframes, same, off))
    # As it is, unless another one is clearly better: it would be known no better, calibrated anew, by one camera alone.
    as_it_is, *others = found
    best = min(others, key=lambda world: world[0], default=as_it_is)
    best = best if best[0][0] < as_it_is[0][0] else as_it_is
    _, keyframes, same, off = best
    # Of a single one, any world may be that in which it stands as before; of a few of many, others know more.
    enough = len(same) > 1 or best is as_it_is
    return keyframes, same if enough and 2 * len(same) >= min(len(rig), len(known._cameras)) else (), off


def _off(known: KnownObject, rig: Rig, keyframes: Sequence[SolvedFrame], names: Sequence[str]) -> dict[str, FloatArray]:
    """By camera, (n, 2) pixels from where its landmarks were seen to where the rig's cameras see them."""
    off = {}
    for name in names:
        memory, pieces = known._cameras[name], [np.empty((0, 2))]
        for k, (frame, features) in enumerate(zip(keyframes, memory.features, strict=True)):
            places = frame.world_from_object.apply(memory.seen_in(k).mean).reshape(-1, 3)
            pieces.append(rig[name].project(places) - features.pixels)
        off[name] = np.concatenate(pieces)
    return off


def _medians(off: Mapping[str, FloatArray]) -> dict[str, float]:
    """By camera how far it is off in the middle, pixels; infinite where landmarks are behind it, 0 of one without any."""
    far = {name: np.nan_to_num(np.linalg.norm(its, axis=1), nan=np.inf) for name, its in off.items()}
    return {name: float(np.median(its)) if len(its) else 0.0 for name, its in far.items()}


def _calibrated_anew(rig: Rig, keyframes: Sequence[SolvedFrame], off: Mapping[str, FloatArray]) -> float:
    """How far off the place of an object may be, length units, where cameras are calibrated otherwise than when it was
    learnt. It is drawn by what its landmarks are off as a whole in each camera's images."""
    far = []
    for name, its in off.items():
        if len(its):
            camera = rig[name]
            away = np.median([camera.camera_from_world.apply(k.world_from_object.translation)[2] for k in keyframes])
            far.append(float(np.linalg.norm(np.nanmedian(its, axis=0))) * away / camera.focal)
    # Of cameras that are off independently of each other, the mean.
    return float(np.sqrt(np.sum(np.square(far)))) / len(far) if far else 0.0


def begun_with(here: KnownHere, rig: Rig, parts: Sequence[CameraPart], time: float) -> Joint:
    """The state of a tracker that has lost an object that it knows from its frames 0 to K - 1; the cameras' parts get what
    they know.

    Args:
        time: of the first frame to come.
    """
    sees = np.zeros((len(here.keyframes), len(rig)), bool)
    for c, part in enumerate(parts):
        memory = here.memories.get(part.camera.name)
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
        for k, frame in enumerate(here.keyframes)
    )
    return Joint(
        ObjectModel(None, here.known.radius, here.known._points),
        last=keyframes[-1],
        keyframes=keyframes,
        velocity=Velocity(frames=1, interval=1.0),
        missed=1,
        seen_again=WAIT_FOR_MORE,  # poses are wanted from the first frame on, however little of it is seen there
        lost=True,
        proven=True,
    )
