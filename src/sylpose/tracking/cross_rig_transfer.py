"""What a known object looks like to cameras that never saw it: as it did to those that learnt it, from where they looked.

A camera sees of an object what another one saw of it once it stands to the object as that one did. So each keyframe of each
camera that learnt it is a keyframe of each camera of another rig, at the pose in which that one would see the same. It is
one of that camera alone: in it the others see something else. How the cameras that learnt the object stood to each other is
in these poses, which therefore stay as they are when frames are refined together.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import RigidTransform

from sylpose.features.sift import Features
from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.rigid import turn_of
from sylpose.landmarks.landmark_filter import Landmarks
from sylpose.rig import Rig
from sylpose.tracking.frame import SolvedFrame
from sylpose.tracking.keyframes import MAX_KEYFRAMES, NEW_TURN
from sylpose.tracking.known_object import CameraMemory, KnownObject

__all__ = ["calibrated_apart", "carried", "elsewhere"]

# A keyframe in which a camera saw fewer landmarks is not carried over (choice).
LEAST = 8
# Of the keyframes that there may be, so many are left to the take (choice).
OWN = 30
# Views this much further from each other are left where there are too many (choice).
SPARSER = 1.3
# What each of two calibrations puts things apart by in an image as a whole, pixels, for nothing tells it (choice).
APART_PX = 1.0


class _View(NamedTuple):
    """What one camera saw in a keyframe: its name, the keyframe, from which direction (3,), and how many landmarks."""

    camera: str
    keyframe: int
    direction: FloatArray
    landmarks: int


def carried(known: KnownObject, rig: Rig) -> tuple[tuple[SolvedFrame, ...], dict[str, CameraMemory]]:
    """The keyframes that another rig has of an object, each of one of its cameras, and by camera what it knows of them."""
    views = _views(known, max((MAX_KEYFRAMES - OWN) // len(rig), LEAST))
    every, first = _landmarks(known)
    keyframes = list[SolvedFrame]()
    features: dict[str, list[Features]] = {name: [] for name in rig.names}
    numbers: dict[str, list[IntArray]] = {name: [] for name in rig.names}
    for camera in rig:
        for view in views:
            memory = known._cameras[view.camera]
            its, new_from_old = memory.features[view.keyframe], camera.camera_from_world.inv()
            new_from_old = new_from_old * known.rig[view.camera].camera_from_world
            keyframes.append(replace(elsewhere(known._keyframes[view.keyframe], new_from_old), stays=True))
            for name in rig.names:
                mine = name == camera.name
                seen = Features(camera.denormalize(its.normalized), its.normalized, its.descriptors)
                features[name].append(seen if mine else Features.none())
                own = memory.numbers[view.keyframe] + first[view.camera]
                numbers[name].append(own if mine else np.empty(0, np.int64))
    memories = {}
    for name in rig.names:
        used = np.unique(np.concatenate(numbers[name]))
        landmarks = every.subset(np.searchsorted(every.id, used))
        memories[name] = CameraMemory(landmarks, tuple(features[name]), tuple(numbers[name]))
    return tuple(keyframes), memories


def _views(known: KnownObject, most: int) -> list[_View]:
    """Which keyframes of which cameras are carried over: from all sides, those first that show most."""
    every = list[_View]()
    for name, memory in known._cameras.items():
        for k, (frame, features) in enumerate(zip(known._keyframes, memory.features, strict=True)):
            if len(features) >= LEAST:
                eye = frame.world_from_object.inv().apply(known.rig[name].center)
                every.append(_View(name, k, eye / np.linalg.norm(eye), len(features)))
    every.sort(key=lambda view: -view.landmarks)
    apart = NEW_TURN
    while True:
        chosen = list[_View]()
        for view in every:
            if all(view.direction @ other.direction < np.cos(apart) for other in chosen):
                chosen.append(view)
        if len(chosen) <= most:
            return chosen
        apart *= SPARSER


def _landmarks(known: KnownObject) -> tuple[Landmarks, dict[str, int]]:
    """All cameras' landmarks as those of one, and by camera the number that its first one has got."""
    parts, first, number = list[Landmarks](), dict[str, int](), 0
    for name, memory in known._cameras.items():
        first[name] = number
        parts.append(replace(memory.landmarks, id=memory.landmarks.id + number))
        number += int(memory.landmarks.id.max(initial=-1)) + 1
    return Landmarks.concatenate(parts), first


def elsewhere(frame: SolvedFrame, new_from_world: RigidTransform) -> SolvedFrame:
    """A keyframe in another world."""
    if (new_from_world.as_matrix() == np.eye(4)).all():
        return frame
    turn = block_diag(*[turn_of(new_from_world)] * 2)
    pose = new_from_world * frame.world_from_object
    return replace(frame, world_from_object=pose, covariance=turn @ frame.covariance @ turn.T)


def calibrated_apart(known: KnownObject, rig: Rig) -> float:
    """How far off an object's place may be, length units, as two rigs have it whose calibrations are as good as usual."""
    places = np.array([keyframe.world_from_object.translation for keyframe in known._keyframes])
    away = float(np.median([np.linalg.norm(places - camera.center, axis=1) for camera in known.rig]))
    # Of cameras that are off independently of each other, the mean.
    variances = [
        sum((APART_PX * away / camera.focal) ** 2 for camera in its) / len(its) ** 2 for its in (known.rig, rig)
    ]
    return float(np.sqrt(sum(variances)))
