"""What the tracker knows of the object itself: its size, a cloud of points on it, and the landmarks of solved frames."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.frames import Box
from sylpose.landmarks.places import learn_landmarks
from sylpose.numerics.arrays import FloatArray
from sylpose.rig import Rig
from sylpose.tracking.frame import Pair, Reference
from sylpose.tracking.frame_solvers import best_landmarks
from sylpose.tracking.region import region_polygon, volume_from_boxes

__all__ = ["ObjectModel"]


# Object points kept to follow the object's region.
MAX_POINTS = 600
# Landmarks whose depth is known to this share of the object's radius show where its surface is.
KNOWN_DEPTH = 0.1
# So many of them show it better than what the boxes allow.
MIN_SURFACE = 20


class ObjectModel:
    """The object's size and points; they grow with what is found on it, unless boxes bound it.

    Attributes:
        center: (3,) in the first frame, world; None while unknown.
        radius: length units; NaN while unknown.
        points: (n, 3) a cloud in the object's frame whose image is the object's region.
        bounded: whether boxes bound it.
        guessed: whether boxes are all that is known of its depth.
    """

    def __init__(self, rig: Rig, boxes: Mapping[str, Box] | None, seed: int) -> None:
        """Raises: ValueError: boxes of cameras that the rig does not have, or that do not meet in space."""
        self.center: FloatArray | None = None
        self.radius = np.nan
        self.points = np.empty((0, 3))
        self.bounded = self.guessed = bool(boxes)
        self._seed = seed
        self._n_landmarks = 0
        if boxes:
            self.center, points = volume_from_boxes(rig, boxes)
            self.points = points - self.center
            self.radius = float(np.quantile(np.linalg.norm(self.points, axis=1), 0.95))

    def regions(self, rig: Rig, world_from_object: RigidTransform, growth: float) -> list[FloatArray | None]:
        """Where it is in each camera at a pose: the outline (k, 2) of its points, with a margin; None if out of view."""
        points = world_from_object.apply(self.points)
        return [region_polygon(camera, points, growth) for camera in rig]

    def learn(
        self,
        current: Reference,
        inliers: Sequence[Pair],
        rig: Rig,
        surface: FloatArray | None = None,
        bulge: float = 0.0,
    ) -> None:
        """The landmarks of a solved frame, and what they add to the cloud.

        Args:
            inliers: its matches.
            rig: as it stood for this frame.
            surface: (n, 3) points on the object, object's frame, where too few landmarks tell where its surface is.
            bulge: see `depth_prior`.
        """
        landmarks = []
        for c, camera in enumerate(rig):
            index, known = best_landmarks(inliers, c)
            good = known.mean[known.depth_sd < KNOWN_DEPTH * self.radius]
            cloud = good if len(good) >= MIN_SURFACE else self.points if surface is None else surface
            features, pose = current.features[c], current.world_from_object
            learnt = learn_landmarks(features, camera, pose, known, index, cloud, self.radius, bulge, self._n_landmarks)
            self._n_landmarks += len(features)
            if current.landmarks:  # they are learnt anew, and stay themselves
                learnt.id[:] = current.landmarks[c].id
            landmarks.append(learnt)
            if not self.bounded:
                self.add_points(good)
        current.landmarks = tuple(landmarks)
        # The same landmarks as the references know them: they are matched again, and should know what is known by then.
        for pair in inliers:
            before, now = pair.reference.landmarks[pair.camera], landmarks[pair.camera]
            before.update(pair.indices[:, 0], now.subset(pair.indices[:, 1]))

    def learn_anew(self, references: Iterable[Reference], rig: Rig, surface: FloatArray) -> None:
        """The landmarks of all references, once it is known where the object's surface is."""
        self.guessed = False
        for reference in {id(r): r for r in references}.values():
            self.learn(reference, [], rig, surface)
            reference.age = 1.0  # as its landmarks are

    def add_points(self, points: FloatArray) -> None:
        """Adds points (n, 3) that are on the object to its cloud."""
        points = np.concatenate([self.points, points[np.linalg.norm(points, axis=1) < 2.0 * self.radius]])
        if len(points) > MAX_POINTS:
            points = points[np.random.default_rng(self._seed).choice(len(points), MAX_POINTS, replace=False)]
        self.points = points
