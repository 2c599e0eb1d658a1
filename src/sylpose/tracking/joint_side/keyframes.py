"""Solved frames that later ones are matched with: the anchor, and keyframes from all sides of the object.

Cameras are static and the object rotates, so a keyframe is characterized by the camera's viewpoint in the object's
frame. A new frame is matched with keyframes of similar viewpoints, oldest first: an old pose has drifted less, and the
first keyframe of a side that is observed again closes the loop (docs/method/4-tracking.md, "Drift").
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.matrices import relative_rotvec
from sylpose.rig import Rig
from sylpose.tracking.reports import TrackingReport

# Maximum number of keyframes: a few for every side of the object (choice).
MAX_KEYFRAMES = 100
# A frame becomes a keyframe when the object has rotated by this much relative to the nearest one, or its distance has
# changed by this factor, in a camera's view (choice).
MIN_NEW_ROTATION, MIN_NEW_SCALE = np.radians(6.0), 1.2
# One reference is taken from each ring of angles between viewpoints: near ones match well, far ones limit drift
# (choice).
RING_ANGLES = np.radians([0.0, 10.0, 18.0, 28.0])
# Number of recent frames that are refined with the keyframes (choice).
N_RECENT_FRAMES = 8
# An anchor is used while these shares of its features are still tracked, overall and per camera, at least so many in
# total, and the object has rotated by less than this (radians) since (choice).
MIN_TRACKED_RATIO, MIN_CAMERA_RATIO, MIN_TRACKED, MAX_ANCHOR_ROTATION = 0.4, 0.25, 60, np.radians(30.0)
# Preparation of the next anchor starts when the tracked shares fall below these times this factor, or the rotation
# exceeds that divided by it (choice).
PREPARATION_MARGIN = 1.5
# Number of frames after which a camera without tracks is searched again (choice).
RETRY_FRAMES = 8
# Delay in frames until the next anchor's new features are added: at 30 frames per second the time needed on a busy
# processor (choice).
JOIN_DELAY = 7
# Number of frames for which a sparse anchor is used: by then it is clear which features move with the object (choice).
MAX_SPARSE_AGE = 2


@dataclass(frozen=True, eq=False)
class SolvedFrame:
    """A frame with its pose, shared by all cameras.

    Attributes:
        number, time, time_offsets: as in `context.Frame`; each camera stores its own data under the number.
        world_from_object: the pose.
        covariance: (6, 6) of (w, d), docs/conventions.md.
        viewpoints: (C, 3) camera centers in the object's frame.
        is_visible: (C,) which cameras have features in it.
        landmark_age: typical number of frames in which the landmarks used for its pose were observed.
        is_fixed: whether joint refinement keeps its pose fixed, as for keyframes transferred from another rig.
    """

    number: int
    time: float
    time_offsets: FloatArray
    world_from_object: RigidTransform
    covariance: FloatArray
    viewpoints: FloatArray
    is_visible: BoolArray
    landmark_age: float = 1.0
    is_fixed: bool = False


@dataclass(frozen=True, eq=False)
class Anchor:
    """Frame whose features are tracked by KLT; shared by all cameras.

    Attributes:
        frame: its landmarks are updated by the tracked features.
        age: number of frames solved by its features alone.
        is_sparse: whether it was created right after the first frame in boxes, when new features in them might be
            background.
    """

    frame: SolvedFrame
    age: int = 0
    is_sparse: bool = False


@dataclass(frozen=True, eq=False)
class KnownFrames:
    """Solved frames that later ones may be matched with.

    Attributes:
        last: the last solved frame; None before the first.
        keyframes: solved frames from all sides of the object, in order of time.
        recent: the last few solved frames, in order of time.
        anchor: the anchor frame, whose features are tracked by KLT, if any.
        next_anchor_number: number of the next anchor frame while it is prepared (`tracking.anchor_preparation`).
    """

    last: SolvedFrame | None = None
    keyframes: tuple[SolvedFrame, ...] = ()
    recent: tuple[SolvedFrame, ...] = ()
    anchor: Anchor | None = None
    next_anchor_number: int | None = None

    @property
    def first(self) -> SolvedFrame:
        """The frame whose pose defines the object's frame; only valid once there is one."""
        return self.keyframes[0]

    @property
    def by_number(self) -> Mapping[int, SolvedFrame]:
        """The frames by number; empty before the first."""
        anchor = () if self.anchor is None else (self.anchor.frame,)
        last = () if self.last is None else (self.last,)
        return {frame.number: frame for frame in (*self.keyframes, *self.recent, *last, *anchor)}

    def is_next_anchor_due(self, number: int) -> bool:
        """Return whether the next anchor is to be used from the frame with this number on."""
        due = self.next_anchor_number
        return due is not None and number >= due + JOIN_DELAY and due in self.by_number

    def add(self, solved: SolvedFrame, *, has_new_features: bool) -> KnownFrames:
        """Add a solved frame; with new features it may become a keyframe, and its features are tracked no longer."""
        anchor = self.anchor
        return replace(
            self,
            last=solved,
            keyframes=add_keyframe(self.keyframes, solved) if has_new_features else self.keyframes,
            recent=(*self.recent, solved)[-N_RECENT_FRAMES:],
            anchor=None if has_new_features or anchor is None else replace(anchor, age=anchor.age + 1),
            next_anchor_number=None if has_new_features else self.next_anchor_number,
        )

    def replace_frames(self, frames: Mapping[int, SolvedFrame]) -> KnownFrames:
        """Replace some frames, by number, by refined ones."""
        assert self.last is not None
        anchor = self.anchor
        if anchor is not None and anchor.frame.number in frames:
            anchor = replace(anchor, frame=frames[anchor.frame.number])
        return replace(
            self,
            last=frames.get(self.last.number, self.last),
            keyframes=tuple(frames.get(k.number, k) for k in self.keyframes),
            anchor=anchor,
            recent=tuple(frames.get(k.number, k) for k in self.recent),
        )


def compute_viewpoints(rig: Rig, world_from_object: RigidTransform) -> FloatArray:
    """Return the camera centers (C, 3) in the object's frame."""
    return np.asarray(world_from_object.inv().apply(np.array([camera.center for camera in rig])).reshape(-1, 3))


def _compute_angles(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the angles (n, m) between viewpoints (n, 3) and (m, 3), seen from the object."""
    a, b = (v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-300) for v in (a, b))
    return np.asarray(np.arccos(np.clip(a @ b.T, -1.0, 1.0)))


def _get_viewpoints(keyframes: Sequence[SolvedFrame], camera: int) -> FloatArray:
    """Return one camera's viewpoints (K, 3); NaN where it has no features."""
    empty = np.full(3, np.nan)
    return np.array([k.viewpoints[camera] if k.is_visible[camera] else empty for k in keyframes]).reshape(-1, 3)


def select_references(
    keyframes: Sequence[SolvedFrame], camera: int, viewpoint: FloatArray, skip: SolvedFrame | None = None
) -> list[SolvedFrame]:
    """Select the oldest keyframe in each ring around a camera's viewpoint (3,).

    Args:
        skip: a frame that is matched anyway.
    """
    if not keyframes:
        return []
    angle = _compute_angles(viewpoint[None], _get_viewpoints(keyframes, camera))[0]
    chosen = []
    for inner, outer in pairwise(RING_ANGLES):
        ring = np.flatnonzero((angle >= inner) & (angle < outer))
        if len(ring) and not (skip is not None and keyframes[ring[0]].number == skip.number):
            chosen.append(keyframes[ring[0]])
    return chosen


def find_nearest_views(
    keyframes: Sequence[SolvedFrame], camera: int, viewpoint: FloatArray, count: int, max_angle: float = np.inf
) -> list[SolvedFrame]:
    """Return up to `count` keyframes nearest to a camera viewpoint (3,), nearest first.

    Args:
        max_angle: maximum angle, radians.
    """
    if not keyframes:
        return []
    angle = np.nan_to_num(_compute_angles(viewpoint[None], _get_viewpoints(keyframes, camera))[0], nan=np.inf)
    order = np.argsort(angle, kind="stable")[:count]
    return [keyframes[i] for i in order if np.isfinite(angle[i]) and angle[i] <= max_angle]


def add_keyframe(keyframes: tuple[SolvedFrame, ...], current: SolvedFrame) -> tuple[SolvedFrame, ...]:
    """Add a solved frame (in order of time) if it shows the object from a new side.

    If there are too many keyframes, the most redundant one is removed.
    """
    if keyframes and not _is_new(keyframes, current):
        return keyframes
    kept = [*keyframes, current]
    if len(kept) > MAX_KEYFRAMES:
        rotations = np.array([k.world_from_object.rotation.as_matrix().ravel() for k in kept])
        # tr(A'B) = 1 + 2 cos: the larger, the more similar. Of the most similar pair the newer is removed; the first
        # one stays.
        similarity = np.tril(rotations @ rotations.T, -1) - 10.0 * np.triu(np.ones((len(rotations), len(rotations))))
        del kept[int(np.unravel_index(np.argmax(similarity), similarity.shape)[0])]
    return tuple(kept)


def inherit_covariance(poses: RigidTransform, covariances: FloatArray, is_fixed: BoolArray) -> FloatArray:
    """Return the covariance (N, 6, 6) of (w, d) that frames inherit from fixed ones.

    The errors of fixed frames have common ancestors, so they are fully correlated, and rotate with the object.

    Args:
        poses: N world_from_object.
        covariances: (N, 6, 6) of the fixed frames.
        is_fixed: (N,) which frames are fixed.
    """
    rotations = np.zeros((len(is_fixed), 6, 6))
    rotations[:, :3, :3] = rotations[:, 3:, 3:] = poses.rotation.as_matrix()
    inverse_rotations = rotations[is_fixed].transpose(0, 2, 1)
    mean = (inverse_rotations @ covariances[is_fixed] @ rotations[is_fixed]).mean(axis=0)
    return np.asarray(rotations @ mean @ rotations.transpose(0, 2, 1))


def _is_new(keyframes: Sequence[SolvedFrame], current: SolvedFrame) -> bool:
    """Return whether most cameras with features have a view unlike that in any keyframe."""
    new = []
    for camera in np.flatnonzero(current.is_visible).tolist():
        views, viewpoint = _get_viewpoints(keyframes, camera), current.viewpoints[camera]
        scale = np.linalg.norm(views, axis=1) / np.linalg.norm(viewpoint)
        is_similar = (
            (_compute_angles(viewpoint[None], views)[0] < MIN_NEW_ROTATION)
            & (scale < MIN_NEW_SCALE)
            & (scale > 1.0 / MIN_NEW_SCALE)
        )
        new.append(not is_similar.any())
    return 2 * sum(new) > len(new)


def has_enough_tracks(
    reports: Sequence[TrackingReport], anchor: Anchor, predicted_pose: RigidTransform, margin: float = 1.0
) -> bool:
    """Return whether an anchor's tracked features suffice without new ones.

    Args:
        reports: of all cameras.
        predicted_pose: predicted world_from_object.
        margin: safety factor on the required numbers.
    """
    angle = np.linalg.norm(relative_rotvec(anchor.frame.world_from_object, predicted_pose))
    found, alive = np.array([r.n_tracked for r in reports]), np.array([r.n_alive for r in reports])
    shares = margin * np.array([MIN_TRACKED_RATIO, MIN_CAMERA_RATIO])
    is_enough = found.sum() >= max(shares[0] * alive.sum(), MIN_TRACKED) and (found >= shares[1] * alive).all()
    for r in reports:
        # A camera that delivers images again is searched at once; one without tracks is searched again after a while.
        is_enough &= not (r.expects_object and not r.has_previous_image)
        is_enough &= not (r.expects_object and r.n_alive == 0 and anchor.age >= RETRY_FRAMES)
    is_lasting = not (anchor.is_sparse and anchor.age >= MAX_SPARSE_AGE)
    return bool(is_enough and is_lasting and angle < MAX_ANCHOR_ROTATION / margin)
