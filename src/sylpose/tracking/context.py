"""Who tracks, and how: the cameras' parts, and what they are asked for with every frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.features.sift import MAX_FEATURES, Features
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Rig
from sylpose.tracking.camera import CameraPart, is_large
from sylpose.tracking.camera_executor import Crew
from sylpose.tracking.frame import CameraFrame, Frame
from sylpose.tracking.frame_solvers import Solver
from sylpose.tracking.joint_state import Joint
from sylpose.tracking.klt_frontend import Followed
from sylpose.tracking.region import polygon_mask, region_polygon

__all__ = ["MAX_GROWTH", "REGION_GROWTH", "Region", "Team", "features_of", "regions_of", "split"]

Region = FloatArray | None

# Margin of the object's region, as a share of its size in the image; it grows while the object is lost, up to a
# bound (choice).
REGION_GROWTH, MAX_GROWTH = 0.15, 1.0


@dataclass(frozen=True, eq=False)
class Team:
    """Who tracks, and how.

    Attributes:
        rig: C cameras.
        parts: by camera, each its own: what it remembers.
        crew: the cameras at work.
        solve: the method.
        follows: whether features are followed from image to image.
        offsets: (C,) seconds by which each camera's images are later than its time stamps say.
        seed: of the outlier rejection.
        refines: whether frames are refined together while tracking goes on (`window`).
    """

    rig: Rig
    parts: Sequence[CameraPart]
    crew: Crew
    solve: Solver
    follows: bool
    offsets: FloatArray
    seed: int
    refines: bool = False

    def rng(self) -> np.random.Generator:
        """The same outlier rejection for the same frame, whatever came before."""
        return np.random.default_rng(self.seed)

    def detect(
        self,
        frames: FrameSet,
        regions: Sequence[Region] | None,
        most: int = MAX_FEATURES,
        *,
        faint: bool = False,
        reduced: bool = False,
    ) -> list[Features]:
        """By camera, each its own: the features inside the object's regions; None: anywhere. With `faint` all that there
        are, with `reduced` of large images made smaller."""

        def of(c: int) -> Features:
            where = None if regions is None else polygon_mask(regions[c], self.rig.cameras[c].size)
            return self.parts[c].detect(frames.images[c], frames.masks[c], where, most, faint=faint, reduced=reduced)

        return self.crew.each(of, long=True)

    def around(self, frames: FrameSet, regions: Sequence[Region], *, faint: bool) -> list[Features]:
        """By camera, each its own: the features around the object's regions."""
        return self.crew.each(
            lambda c: self.parts[c].around(frames.images[c], frames.masks[c], regions[c], faint=faint), long=True
        )

    def closer(
        self, frames: FrameSet, features: Sequence[Features], regions: Sequence[Region], *, faint: bool = False
    ) -> list[Features]:
        """By camera, each its own: the features inside the object's regions, by those of whole images that were searched
        reduced. See `CameraPart.closer`."""
        return self.crew.each(
            lambda c: self.parts[c].closer(frames.images[c], frames.masks[c], features[c], regions[c], faint=faint),
            long=any(map(is_large, self.rig)),
        )

    def radius_px(self, joint: Joint, c: int, world_from_object: RigidTransform) -> float:
        """The object's radius in a camera's image at a pose, pixels."""
        camera = self.rig.cameras[c]
        depth = max(float(camera.camera_from_world.apply(world_from_object.translation)[2]), 1e-12)
        return joint.object.radius / depth * camera.focal

    def frame(self, number: int, frames: FrameSet, features: Sequence[Features]) -> Frame:
        """A frame to be solved, of each camera's own features."""
        own = [frames.time if time is None else time for time in frames.times]
        late = np.array(own) - frames.time + self.offsets
        return Frame(number, frames.time, late, self.crew.each(lambda c: self.parts[c].frame(features[c])))


def regions_of(
    team: Team, joint: Joint, world_from_object: RigidTransform, growth: float = REGION_GROWTH
) -> list[Region]:
    """By camera, each its own: the outline (k, 2) of the object at a pose, with a margin; None if out of view."""
    points = world_from_object.apply(joint.object.points)
    return team.crew.each(lambda c: region_polygon(team.rig.cameras[c], points, growth))


def features_of(team: Team, seen: Sequence[CameraFrame] | Sequence[Followed]) -> list[Features]:
    """By camera, each its own: the features of what it has."""
    return team.crew.each(lambda c: seen[c].features)


def split(team: Team, features: Sequence[Features], regions: Sequence[Region]) -> tuple[list[Features], list[Features]]:
    """By camera, each its own: the features inside the regions and those outside."""
    inside = team.crew.each(lambda c: team.parts[c].inside(features[c], regions[c]))
    return (
        team.crew.each(lambda c: features[c].subset(inside[c])),
        team.crew.each(lambda c: features[c].subset(~inside[c])),
    )
