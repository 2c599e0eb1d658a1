"""Shared tracking context: rig, per-camera trackers, executor and pose solver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.features.sift import MAX_FEATURES, Features
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Rig
from sylpose.tracking.camera import CameraTracker, is_large
from sylpose.tracking.camera_executor import CameraExecutor
from sylpose.tracking.frame import CameraFrame, Frame
from sylpose.tracking.frame_solvers import Solver
from sylpose.tracking.joint_state import JointState
from sylpose.tracking.klt_frontend import TrackedFeatures
from sylpose.tracking.region import project_outline, rasterize_outline

__all__ = [
    "MAX_REGION_MARGIN",
    "REGION_MARGIN",
    "Region",
    "TrackerContext",
    "collect_features",
    "project_regions",
    "split_by_region",
]

Region = FloatArray | None

# Margin of the object's search region, as a share of its size in the image. It grows while the object is lost, up to a
# maximum (choice).
REGION_MARGIN, MAX_REGION_MARGIN = 0.15, 1.0


@dataclass(frozen=True, eq=False)
class TrackerContext:
    """Fixed settings and components of one tracking run.

    Lists marked "per camera, local" have one entry per camera of the rig. In a distributed run only the entry of the
    process's own camera is meaningful (`camera_executor`).

    Attributes:
        rig: C cameras.
        camera_trackers: per camera, local: its state and feature detection.
        executor: executes functions for all cameras.
        solver: pose solver of the chosen method (`frame_solvers`).
        uses_klt: whether features are tracked by KLT between anchor frames.
        time_offsets: (C,) seconds by which each camera's images are later than its time stamps.
        seed: random seed of outlier rejection.
        refines_window: whether recent frames are refined jointly during tracking (`window`).
    """

    rig: Rig
    camera_trackers: Sequence[CameraTracker]
    executor: CameraExecutor
    solver: Solver
    uses_klt: bool
    time_offsets: FloatArray
    seed: int
    refines_window: bool = False

    def create_rng(self) -> np.random.Generator:
        """Create a random generator that gives each frame the same sequence."""
        return np.random.default_rng(self.seed)

    def detect(
        self,
        frames: FrameSet,
        regions: Sequence[Region] | None,
        max_features: int = MAX_FEATURES,
        *,
        faint: bool = False,
        reduced: bool = False,
    ) -> list[Features]:
        """Detect features in the object's regions.

        Args:
            frames: images and masks of one frame.
            regions: per camera, local: (k, 2) outline in pixels; None for the whole image.
            max_features: maximum number of features per camera.
            faint: whether to keep low-contrast features and ignore `max_features`.
            reduced: whether to downscale large images.

        Returns:
            per camera, local: features.
        """

        def detect_in_camera(c: int) -> Features:
            area = None if regions is None else rasterize_outline(regions[c], self.rig.cameras[c].size)
            return self.camera_trackers[c].detect(
                frames.images[c], frames.masks[c], area, max_features, faint=faint, reduced=reduced
            )

        return self.executor.map_cameras(detect_in_camera, is_slow=True)

    def detect_surroundings(self, frames: FrameSet, regions: Sequence[Region], *, faint: bool) -> list[Features]:
        """Detect features outside the object's regions; per camera, local."""
        return self.executor.map_cameras(
            lambda c: self.camera_trackers[c].detect_surroundings(
                frames.images[c], frames.masks[c], regions[c], faint=faint
            ),
            is_slow=True,
        )

    def detect_at_full_res(
        self, frames: FrameSet, features: Sequence[Features], regions: Sequence[Region], *, faint: bool = False
    ) -> list[Features]:
        """Detect features in the regions at full resolution; per camera, local.

        See `CameraTracker.detect_at_full_res`.
        """
        return self.executor.map_cameras(
            lambda c: self.camera_trackers[c].detect_at_full_res(
                frames.images[c], frames.masks[c], features[c], regions[c], faint=faint
            ),
            is_slow=any(map(is_large, self.rig)),
        )

    def object_radius_px(self, state: JointState, c: int, world_from_object: RigidTransform) -> float:
        """Return the object's radius in a camera's image at a pose, pixels."""
        camera = self.rig.cameras[c]
        depth = max(float(camera.camera_from_world.apply(world_from_object.translation)[2]), 1e-12)
        return state.object.radius / depth * camera.focal

    def create_frame(self, number: int, frames: FrameSet, features: Sequence[Features]) -> Frame:
        """Create an unsolved frame from each camera's features."""
        times = [frames.time if time is None else time for time in frames.times]
        time_offsets = np.array(times) - frames.time + self.time_offsets
        return Frame(
            number,
            frames.time,
            time_offsets,
            self.executor.map_cameras(lambda c: self.camera_trackers[c].create_frame(features[c])),
        )


def project_regions(
    context: TrackerContext, state: JointState, world_from_object: RigidTransform, growth: float = REGION_MARGIN
) -> list[Region]:
    """Project the object at a pose into each camera.

    Args:
        growth: margin as a share of the object's size in the image.

    Returns:
        per camera, local: (k, 2) outline with margin, pixels; None if out of view.
    """
    points = world_from_object.apply(state.object.points)
    return context.executor.map_cameras(lambda c: project_outline(context.rig.cameras[c], points, growth))


def collect_features(
    context: TrackerContext, frames: Sequence[CameraFrame] | Sequence[TrackedFeatures]
) -> list[Features]:
    """Return the features of each camera's frame or tracks; per camera, local."""
    return context.executor.map_cameras(lambda c: frames[c].features)


def split_by_region(
    context: TrackerContext, features: Sequence[Features], regions: Sequence[Region]
) -> tuple[list[Features], list[Features]]:
    """Split features into those inside and those outside the regions; per camera, local."""
    inside = context.executor.map_cameras(lambda c: context.camera_trackers[c].find_inside(features[c], regions[c]))
    return (
        context.executor.map_cameras(lambda c: features[c].subset(inside[c])),
        context.executor.map_cameras(lambda c: features[c].subset(~inside[c])),
    )
