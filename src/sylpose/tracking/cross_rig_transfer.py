"""Transfer of a known object's keyframes to cameras that never observed it.

If an object has the same pose relative to two cameras, both have the same view of it. So each keyframe of each learning
camera becomes a keyframe of each new camera, at the pose that gives the same view. It belongs to that camera alone,
since the others have different views there. These poses contain the arrangement of the learning cameras and therefore
stay fixed in joint refinement.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import RigidTransform

from sylpose.features.sift import Features
from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.rigid import rotation_matrix_of
from sylpose.landmarks.landmark_filter import Landmarks
from sylpose.rig import Rig
from sylpose.tracking.frame import SolvedFrame
from sylpose.tracking.keyframes import MAX_KEYFRAMES, MIN_NEW_ROTATION
from sylpose.tracking.known_object import CameraLandmarks, KnownObject

__all__ = ["estimate_calibration_sd", "transfer_keyframes", "transform_frame"]

# Keyframes with fewer landmarks of a camera are not transferred (choice).
MIN_LANDMARKS = 8
# Number of keyframes reserved for the new recording (choice).
N_RESERVED_KEYFRAMES = 30
# Factor by which the spacing of views grows while there are too many (choice).
SPACING_FACTOR = 1.3
# Assumed systematic image error of each of two calibrations, pixels, as no data determines it (choice).
CALIBRATION_ERROR_PX = 1.0


class _View(NamedTuple):
    """One camera's view in a keyframe: camera name, keyframe, direction (3,) and number of landmarks."""

    camera: str
    keyframe: int
    direction: FloatArray
    landmarks: int


def transfer_keyframes(known: KnownObject, rig: Rig) -> tuple[tuple[SolvedFrame, ...], dict[str, CameraLandmarks]]:
    """Transfer the keyframes to another rig.

    Returns:
        keyframes, each of one camera of the rig; by camera name, its landmarks in them.
    """
    views = _select_views(known, max((MAX_KEYFRAMES - N_RESERVED_KEYFRAMES) // len(rig), MIN_LANDMARKS))
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


def _select_views(known: KnownObject, max_views: int) -> list[_View]:
    """Select the views to transfer: from all sides, those with most landmarks first."""
    candidates = list[_View]()
    for name, memory in known._cameras.items():
        for k, (frame, features) in enumerate(zip(known._keyframes, memory.features, strict=True)):
            if len(features) >= MIN_LANDMARKS:
                eye = frame.world_from_object.inv().apply(known.rig[name].center)
                candidates.append(_View(name, k, eye / np.linalg.norm(eye), len(features)))
    candidates.sort(key=lambda view: -view.landmarks)
    min_angle = MIN_NEW_ROTATION
    while True:
        chosen = list[_View]()
        for view in candidates:
            if all(view.direction @ other.direction < np.cos(min_angle) for other in chosen):
                chosen.append(view)
        if len(chosen) <= max_views:
            return chosen
        min_angle *= SPACING_FACTOR


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

    Both calibrations are assumed to have the usual accuracy. The result is in length units.
    """
    positions = np.array([keyframe.world_from_object.translation for keyframe in known._keyframes])
    distance = float(np.median([np.linalg.norm(positions - camera.center, axis=1) for camera in known.rig]))
    # Mean over cameras with independent errors.
    variances = [
        sum((CALIBRATION_ERROR_PX * distance / camera.focal) ** 2 for camera in cameras) / len(cameras) ** 2
        for cameras in (known.rig, rig)
    ]
    return float(np.sqrt(sum(variances)))
