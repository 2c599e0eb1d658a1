"""Tracker of a body of known shape by its outlines in all cameras.

A pose follows from the one before it by `align_contours`. It is sure as long as no other pose can have been taken for it: a
search has found it to be the only one, its rotation has been well determined since, and each step was small. Otherwise it is
uncertain, and the search is repeated, after pauses that double.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.frames import UNNUMBERED, FrameSet, check_frame_set
from sylpose.geometry.arrays import BoolArray, FloatArray, Image
from sylpose.geometry.validation import check_sequence, check_type
from sylpose.mesh import Mesh
from sylpose.relative_pose.camera_evidence import MIN_KEPT_POOLED, compute_f_ratio
from sylpose.results import FramePose
from sylpose.rig import Camera, Rig
from sylpose.silhouettes.background import (
    OUTLINE_PX,
    Silhouette,
    estimate_background,
    find_silhouette,
    level_image,
    level_images,
)
from sylpose.silhouettes.contour_search import MIN_INLIER_RATIO, search_contour_poses
from sylpose.silhouettes.contours import (
    ANY_ANGLE_SD,
    MAX_STEP,
    N_OWN,
    OFFSET_SD,
    Alignment,
    Outline,
    align_contours,
    move,
)
from sylpose.silhouettes.rendering import draw_mask, reduce_camera, reduce_image, reduce_mask
from sylpose.status import FrameStatus
from sylpose.tracking.context import TrackedFrame
from sylpose.tracking.map_update import add_f_ratio, pool_known
from sylpose.tracking.options import TrackingOptions

# Frames from one search to the next at most (choice: a search takes as long as some thirty frames).
MAX_PAUSE = 32
# Standard deviation of a rotation from which the next frame may begin on another side of the body, radians (derived: three
# of them are the largest step).
MAX_SURE_SD = MAX_STEP / 3
# Poses with which a background is estimated again at first (derived: more than twice the images that determine a pixel).
MIN_POSES = 8
# Largest residuals that are errors of the mesh, as a share of the object's radius (measured: right poses of rendered bodies
# have 0.003, wrong ones where the alignment ends from 0.04).
MAX_MISFIT = 0.02


@dataclass(frozen=True, eq=False)
class _Followed:
    """The pose that is followed.

    Attributes:
        time: seconds.
        pose: world_from_mesh, of the mesh about its middle.
        velocity: (6,) of (w, d), per second.
        is_sure: whether no other pose can have been taken for it.
    """

    time: float
    pose: RigidTransform
    velocity: FloatArray
    is_sure: bool


class SampledBackground:
    """Background of a camera from some images of a recording, improved by poses of the body in them.

    At first colors that may be the body's are not known. Where the body is known to be elsewhere in some images, they are.

    Args:
        frames: (n,) numbers of the frames of the images.
        images: (n,) images that `reduce_image` has reduced.
    """

    def __init__(self, frames: Sequence[int], images: Sequence[Image]) -> None:
        self._images = dict(zip(frames, level_images(images), strict=True))
        self._covered = dict[int, BoolArray]()
        self.background = self._first = estimate_background(list(self._images.values()))

    def add_pose(self, frame: int, mesh: Mesh, camera: Camera, world_from_mesh: RigidTransform) -> None:
        """Use a pose if the frame is one of the images; the background is estimated again as their number doubles."""
        if frame not in self._images:
            return
        mask = draw_mask(mesh, camera, world_from_mesh.apply(mesh.vertices)).astype(np.uint8)
        self._covered[frame] = cv2.dilate(mask, np.ones((4 * OUTLINE_PX + 1,) * 2, np.uint8)) > 0
        n, n_all = len(self._covered), len(self._images)
        if n < n_all and (n < MIN_POSES or n & (n - 1)):
            return
        everywhere = np.ones(mask.shape, bool)
        covered = [self._covered.get(k, everywhere) for k in self._images]
        elsewhere, first = estimate_background(list(self._images.values()), covered), self._first
        is_new = elsewhere.is_known & ~first.is_known
        color = np.where(is_new[..., None], elsewhere.color, first.color)
        self.background = replace(first, color=color, is_known=first.is_known | is_new)


class ContourTracker:
    """Tracker of a body of known shape, with the steps of `tracking.tracker.Tracker`.

    Args:
        rig: C cameras.
        mesh: surface in the object's frame, in the rig's unit.
        backgrounds: per camera; None: only its masks are used.
        options: limits of the F ratio; None: the default ones.

    Raises:
        TypeError, ValueError: naming the argument: no rig, no mesh, or not one background for each camera.
    """

    def __init__(
        self,
        rig: Rig,
        mesh: Mesh,
        backgrounds: Sequence[SampledBackground | None],
        options: TrackingOptions | None = None,
    ) -> None:
        self._rig, self._options = check_type(rig, Rig, "rig"), options or TrackingOptions()
        self._backgrounds = check_sequence(backgrounds, "backgrounds", len(rig), "rig")
        vertices = check_type(mesh, Mesh, "mesh").vertices
        middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
        self._mesh = Mesh(vertices - middle, mesh.faces)
        self._object_from_mesh = RigidTransform.from_translation(middle)
        self._radius = float(np.linalg.norm(self._mesh.vertices, axis=1).max())
        self._cameras = [reduce_camera(camera) for camera in rig]
        self._followed: _Followed | None = None
        self._f_ratios: tuple[float, ...] = ()
        # Frames until the next search, and from that one to the one after it.
        self._wait, self._pause = 0, 1
        self._n_frames, self._is_lost = 0, False

    def step(self, frames: FrameSet) -> list[TrackedFrame]:
        """Return the next frame with the object's pose, in a list.

        Raises:
            TypeError, ValueError: as `check_frame_set`.
        """
        check_frame_set(frames, self._rig)
        if frames.index == UNNUMBERED:
            frames = replace(frames, index=self._n_frames)
        self._n_frames += 1
        outlines = self._find_outlines(frames)
        found, status = self._find_pose(list(outlines.values()), frames.time)
        pose = self._make_pose(frames, [*outlines], found, status)
        if found is not None and pose.is_measured:
            self._wait, self._pause = 0, 1
            for camera, background in zip(self._cameras, self._backgrounds, strict=True):
                if background is not None:
                    background.add_pose(frames.index, self._mesh, camera, found.world_from_object)
        elif self._followed is not None:  # nothing is sure that continues a pose that the cameras contradict
            self._followed = replace(self._followed, is_sure=False)
        regions = [None if found is None else _draw_region(self._mesh, c, found.world_from_object) for c in self._rig]
        return [TrackedFrame(pose, frames, (None,) * len(self._rig), tuple(regions), self._radius)]

    def flush(self) -> list[TrackedFrame]:
        """Return the frames that are still undecided: none."""
        return []

    def _find_outlines(self, frames: FrameSet) -> dict[int, Outline]:
        """Return the outlines by camera, of all with a mask, or an image and a background."""
        found = {}
        for c, camera in enumerate(self._cameras):
            image, mask, background = frames.images[c], frames.masks[c], self._backgrounds[c]
            if mask is not None:
                found[c] = Outline.of(camera, Silhouette.from_mask(reduce_mask(mask)))
            elif image is not None and background is not None:
                leveled = level_image(reduce_image(image), background.background.color)
                found[c] = Outline.of(camera, find_silhouette(background.background, leveled))
        return found

    def _find_pose(self, outlines: Sequence[Outline], time: float) -> tuple[Alignment | None, FrameStatus]:
        """Follow the last pose, and search if the result is not sure; return a pose if there is any, and its status."""
        before, status = self._followed, FrameStatus.TRACKED
        found = self._follow(outlines, time)
        is_sure = found is not None and before is not None and before.is_sure and _is_determined(found)
        if found is None and not self._is_lost:
            self._wait, self._pause = 0, 1
        continued = None if found is None else before
        if not is_sure and (searched := self._search(outlines)):
            # Of poses that look alike, the one that is followed goes on.
            near = searched[0] if found is None else found
            found = min(searched, key=lambda one: _measure_angle(one, near.world_from_object))
            is_sure, continued = found.is_unique and _is_determined(found), None
            status = FrameStatus.LOCALIZED if before is None else FrameStatus.RELOCALIZED
        self._is_lost = found is None
        if found is not None:
            self._followed = _follow_on(continued, time, found.world_from_object, is_sure)
        elif before is not None:
            self._followed = replace(before, velocity=np.zeros(6), is_sure=False)
        return found, status if is_sure else FrameStatus.UNCERTAIN

    def _follow(self, outlines: Sequence[Outline], time: float) -> Alignment | None:
        """Return the pose after the last one at constant velocity, else after the last one itself; None without."""
        if self._followed is None:
            return None
        last = self._followed.pose
        moved = move(last, last.translation, (time - self._followed.time) * self._followed.velocity)
        for start in (moved, last) if self._followed.velocity.any() else (last,):
            found = align_contours(self._mesh, outlines, start)
            if found is not None and self._is_supported(found, outlines) and _measure_angle(found, start) < MAX_STEP:
                return found
        return None

    def _search(self, outlines: Sequence[Outline]) -> list[Alignment]:
        """Return the poses that a search finds; none in the pauses between searches."""
        if self._wait:
            self._wait -= 1
            return []
        self._wait, self._pause = self._pause - 1, min(2 * self._pause, MAX_PAUSE)
        return [one for one in search_contour_poses(self._mesh, outlines) if self._is_supported(one, outlines)]

    def _is_supported(self, found: Alignment, outlines: Sequence[Outline]) -> bool:
        """Return whether a pose explains most of its outline, up to errors of outlines and mesh."""
        distances = [np.linalg.norm(found.world_from_object.translation - o.camera.center) for o in outlines]
        radius = np.mean([self._radius * o.camera.focal / d for o, d in zip(outlines, distances, strict=True)])
        is_exact = found.sigma**2 < OFFSET_SD**2 + (MAX_MISFIT * radius) ** 2
        return bool(is_exact and found.inliers.sum() >= MIN_INLIER_RATIO * found.points.sum())

    def _make_pose(
        self, frames: FrameSet, cameras: Sequence[int], found: Alignment | None, status: FrameStatus
    ) -> FramePose:
        """Return the result of a frame from the alignment of some cameras' outlines."""
        n = len(self._rig)
        counts, points, residuals = np.zeros(n, np.int64), np.zeros(n, np.int64), np.full(n, np.nan)
        if found is None:
            reason = "no pose of the mesh explains the outlines" if cameras else "no image with a background or a mask"
            nothing = None, np.full((6, 6), np.nan), counts, residuals
            return FramePose(frames.index, frames.time, FrameStatus.LOST, *nothing, matches=points, reason=reason)
        counts[cameras], points[cameras], residuals[cameras] = found.inliers, found.points, found.residuals
        own = float(compute_f_ratio(found.excess, 2, N_OWN))
        pooled_with = float(compute_f_ratio(found.excess, MIN_KEPT_POOLED, N_OWN))
        self._f_ratios = add_f_ratio(self._f_ratios, pooled_with, self._options)
        pooled = pool_known(self._f_ratios)
        reason = ""
        if own > self._options.max_f_ratio or pooled > self._options.max_pooled_f_ratio:
            ratio = own if own > self._options.max_f_ratio else pooled
            status = FrameStatus.CONTRADICTED
            reason = f"no pose explains the outlines of all cameras (F ratio {ratio:.0f})"
        elif not _is_determined(found):
            reason = "a rotation of the object hardly changes its outlines"
        elif status is FrameStatus.UNCERTAIN:
            reason = "other poses may explain the outlines as well"
        covariance = found.covariance
        if status is FrameStatus.UNCERTAIN:
            # The rotation may be that of any other pose.
            covariance = covariance + np.diag(np.repeat([ANY_ANGLE_SD, 0.0], 3) ** 2)
        pose = FramePose(
            frames.index,
            frames.time,
            status,
            found.world_from_object,
            covariance,
            counts,
            residuals,
            matches=points,
            reason=reason,
            f_ratio=pooled,
        )
        return pose.in_object_frame(self._object_from_mesh).mark_uncertain()


def _is_determined(found: Alignment) -> bool:
    """Return whether the pose is known well enough to follow it to the next frame."""
    return bool(np.linalg.eigvalsh(found.covariance[:3, :3])[-1] < MAX_SURE_SD**2)


def _measure_angle(found: Alignment, pose: RigidTransform) -> float:
    return float((found.world_from_object.rotation * pose.rotation.inv()).magnitude())


def _follow_on(before: _Followed | None, time: float, pose: RigidTransform, is_sure: bool) -> _Followed:
    """Return the pose that is followed, with the velocity since the one that it continues, if any."""
    velocity = np.zeros(6)
    if before is not None and time > before.time:
        turn = (pose.rotation * before.pose.rotation.inv()).as_rotvec()
        velocity = np.concatenate([turn, pose.translation - before.pose.translation]) / (time - before.time)
    return _Followed(time, pose, velocity, is_sure)


def _draw_region(mesh: Mesh, camera: Camera, world_from_mesh: RigidTransform) -> FloatArray | None:
    """Return the outline (k, 2) of a mesh's largest part in an image; None if it is not in it."""
    mask = draw_mask(mesh, camera, world_from_mesh.apply(mesh.vertices)).astype(np.uint8)
    parts, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    return np.asarray(max(parts, key=cv2.contourArea)[:, 0], float) if parts else None
