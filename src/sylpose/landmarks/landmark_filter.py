"""Information filter of landmark positions in the object's frame: a mean and an information matrix per feature.

A feature observed once is on its ray, within the object's depth range; each further observation adds a ray. In the
object's frame a ray from o along r at distance d, with an image noise of σ/f, is the information (I - r r') / (d σ/f)²
on the point, so positions are fused by adding information, in any order
(docs/method/4-tracking.md, "Landmark alignment").

`LandmarkTable` has all landmarks of one camera, by number. Frames store numbers, so updates apply to all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import RigidTransform

from sylpose.features.sift import Features
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.numba_linalg import cholesky_solve, kernel, symmetric_eigen
from sylpose.rig import Camera

# A landmark's depth is known if its standard deviation is at most this share of the object's radius (choice).
KNOWN_DEPTH_RATIO = 0.1
# Image noise of a ray, pixels. It is larger than a keypoint's noise: the poses of the rays have errors as well, which
# do not average out over the features of one frame (choice).
RAY_SIGMA_PX = 2.0
# Neighbors in the image from which a new feature's depth is predicted (choice).
N_NEIGHBORS = 8
# Initial number of a table's rows; it is doubled when they are full (choice).
INITIAL_CAPACITY = 1024
# Neighbors whose median displacement a moved landmark follows (choice).
N_MOVED_NEIGHBORS = 8


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Positions of n features in the object's frame.

    Attributes:
        mean: (n, 3).
        information: (n, 3, 3), the inverse covariances.
        n_observations: (n,) number of frames with observations of each.
        has_moved: (n,) whether it was ever observed to move with the object, away from its `origin`; the others may be
            background.
        origin: (n, 2) pixels of the camera's first observation.
        id: (n,) the number (`LandmarkTable`), constant for a feature observed in several frames; -1: none yet.
    """

    mean: FloatArray
    information: FloatArray
    n_observations: IntArray
    has_moved: BoolArray
    origin: FloatArray
    id: IntArray

    @classmethod
    def empty(cls) -> Landmarks:
        """Return an empty set."""
        nothing = np.empty(0, np.int64)
        return cls(np.empty((0, 3)), np.empty((0, 3, 3)), nothing, np.empty(0, bool), np.empty((0, 2)), nothing)

    @classmethod
    def concatenate(cls, parts: Sequence[Landmarks]) -> Landmarks:
        """Concatenate landmarks."""
        parts = [cls.empty(), *parts]
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)))

    def __len__(self) -> int:
        return len(self.mean)

    @property
    def depth_error(self) -> FloatArray:
        """(n, 3) direction of each position's largest uncertainty, one standard deviation long; arbitrary sign."""
        out = np.empty((len(self), 3))
        _compute_depth_errors(np.ascontiguousarray(self.information), out)
        return out

    @property
    def depth_sd(self) -> FloatArray:
        """(n,) standard deviation in that direction."""
        return np.asarray(np.linalg.norm(self.depth_error, axis=1))

    def subset(self, index: IntArray | BoolArray) -> Landmarks:
        """Return the landmarks selected by a mask or an index array."""
        rows = np.flatnonzero(index) if index.dtype == np.bool_ else index
        return Landmarks(*(getattr(self, f.name).take(rows, axis=0) for f in fields(self)))


@kernel
def _compute_depth_errors(information: FloatArray, out: FloatArray) -> None:
    """Write `Landmarks.depth_error` of information (n, 3, 3) to out (n, 3)."""
    matrix, values, vectors = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    for n in range(len(information)):
        matrix[:] = information[n]
        symmetric_eigen(matrix, values, vectors)
        sd = 1.0 / np.sqrt(max(values[0], 1e-30))
        for i in range(3):
            out[n, i] = sd * vectors[i, 0]


def compute_rays(
    features: Features, camera: Camera, object_from_world: RigidTransform
) -> tuple[FloatArray, FloatArray]:
    """Return the camera's center (3,) and the features' unit directions (n, 3), object's frame."""
    rotation = camera.rotation @ object_from_world.as_matrix()[:3, :3].T
    directions = features.normalized @ rotation[:2] + rotation[2]
    directions /= np.sqrt(np.einsum("ni,ni->n", directions, directions))[:, None]
    return np.asarray(object_from_world.apply(camera.center)), directions


def initialize_landmarks(
    features: Features, camera: Camera, object_from_world: RigidTransform, distance: FloatArray, sd: FloatArray
) -> Landmarks:
    """Initialize landmarks of features on their rays.

    Args:
        distance, sd: (n,) from the camera, with their standard deviations.
    """
    center, directions = compute_rays(features, camera, object_from_world)
    mean = center + distance[:, None] * directions
    ray_information = (camera.focal / (RAY_SIGMA_PX * distance)) ** 2
    ray_projector = directions[:, :, None] * directions[:, None, :]
    information = (sd**-2 - ray_information)[:, None, None] * ray_projector
    information[:, [0, 1, 2], [0, 1, 2]] += ray_information[:, None]
    n = len(mean)
    initial_fields = np.zeros(n, bool), features.pixels.copy(), np.full(n, -1, np.int64)
    return Landmarks(mean, information, np.ones(n, np.int64), *initial_fields)


def add_observations(
    known: Landmarks, features: Features, camera: Camera, object_from_world: RigidTransform
) -> Landmarks:
    """Update known landmarks (n) with each feature's ray (n)."""
    center, directions = compute_rays(features, camera, object_from_world)
    mean, information = known.mean.copy(), known.information.copy()
    _add_rays(center, directions, camera.focal / RAY_SIGMA_PX, mean, information)
    return replace(known, mean=mean, information=information, n_observations=known.n_observations + 1)


@kernel
def _add_rays(
    center: FloatArray, directions: FloatArray, weight: float, mean: FloatArray, information: FloatArray
) -> None:
    """Update mean (n, 3) and information (n, 3, 3) by rays from a center (3,) along directions (n, 3).

    Args:
        weight: standard deviations per radian.
    """
    root, residual = np.empty((3, 3)), np.empty(3)
    for n in range(len(mean)):
        squared_distance = 0.0
        for i in range(3):
            residual[i] = center[i] - mean[n, i]
            squared_distance += residual[i] * residual[i]
        ray_information = (weight / max(np.sqrt(squared_distance), 1e-12)) ** 2
        along = residual[0] * directions[n, 0] + residual[1] * directions[n, 1] + residual[2] * directions[n, 2]
        for i in range(3):
            # The distance from the ray times its information; then the information is added.
            residual[i] = ray_information * (residual[i] - along * directions[n, i])
            for j in range(3):
                information[n, i, j] += ray_information * (
                    (1.0 if i == j else 0.0) - directions[n, i] * directions[n, j]
                )
        root[:] = information[n]
        if not cholesky_solve(root, residual):
            residual[:] = np.nan
        for i in range(3):
            mean[n, i] += residual[i]


class DepthPrior(NamedTuple):
    """Prior of the depths of new features.

    Attributes:
        cloud: (m, 3) points on or in the object, object's frame.
        radius: of the object, which limits the standard deviation: from three tenths of it to the radius.
        bulge: how much nearer than the cloud the surface is assumed to be at the object's center, in radii, decreasing
            to zero at its edge like a sphere's.
    """

    cloud: FloatArray
    radius: float
    bulge: float = 0.0


def predict_depths(
    features: Features, camera: Camera, world_from_object: RigidTransform, prior: DepthPrior
) -> tuple[FloatArray, FloatArray]:
    """Predict the distance of new features from the object's points around them in the image.

    Args:
        features: of one camera.
        camera: the camera.
        world_from_object: pose of the object.
        prior: the object's points.

    Returns:
        distance (n,) from the camera; sd (n,).
    """
    n, (cloud, radius, bulge) = len(features), prior
    if n == 0:
        return np.empty(0), np.empty(0)
    points = world_from_object.apply(cloud).reshape(-1, 3)
    pixels = camera.project(points)
    is_visible = np.isfinite(pixels).all(axis=1)
    center_distance = float(np.linalg.norm(world_from_object.translation - camera.center))
    if is_visible.sum() < N_NEIGHBORS:
        return np.full(n, center_distance), np.full(n, radius)
    distance = np.linalg.norm(points[is_visible] - camera.center, axis=1)
    gap, index = cKDTree(pixels[is_visible]).query(features.pixels, N_NEIGHBORS)
    neighbor_distances = distance[index]
    # A gap in the image may be a gap of the same size in depth.
    extrapolation = gap.mean(axis=1) / camera.focal * center_distance
    if bulge:
        offset = np.linalg.norm(features.pixels - camera.project(world_from_object.translation), axis=1)
        rim = 1.1 * offset.max()
        neighbor_distances = neighbor_distances - (bulge * radius * np.sqrt(1.0 - (offset / rim) ** 2))[:, None]
    sd = np.sqrt(neighbor_distances.var(axis=1) + extrapolation**2)
    return neighbor_distances.mean(axis=1), sd.clip(0.3 * radius, radius)


def create_landmarks(
    features: Features, camera: Camera, world_from_object: RigidTransform, prior: DepthPrior
) -> Landmarks:
    """Create landmarks of features that are observed for the first time. See `predict_depths`."""
    depths = predict_depths(features, camera, world_from_object, prior)
    return initialize_landmarks(features, camera, world_from_object.inv(), *depths)


def update_landmarks(
    features: Features,
    camera: Camera,
    world_from_object: RigidTransform,
    prior: DepthPrior,
    known: Landmarks,
    index: IntArray,
) -> Landmarks:
    """Return the landmarks of a frame's features: known ones updated, the others created. See `predict_depths`.

    Args:
        known: (k) landmarks that are observed in the frame.
        index: (k,) their features.
    """
    is_new = np.ones(len(features), bool)
    is_new[index] = False
    new_index = np.flatnonzero(is_new)
    new = create_landmarks(features.subset(new_index), camera, world_from_object, prior)
    updated = add_observations(known, features.subset(index), camera, world_from_object.inv())
    order = np.argsort(np.concatenate([index, new_index]))
    return Landmarks.concatenate([updated, new]).subset(order)


class LandmarkTable:
    """Table of one camera's landmarks that grows as needed.

    Numbers are not reused; those of removed landmarks are missing.
    """

    def __init__(self) -> None:
        self._rows = _allocate(INITIAL_CAPACITY)  # sorted by number; the first `_used` of them are valid
        self._used = self._next = 0

    @classmethod
    def from_landmarks(cls, landmarks: Landmarks) -> LandmarkTable:
        """Return a table of these landmarks, with the numbers that they have."""
        table = cls()
        table._rows = landmarks.subset(np.unique(landmarks.id, return_index=True)[1])
        table._used, table._next = len(table._rows), int(landmarks.id.max(initial=-1)) + 1
        return table

    def __len__(self) -> int:
        return self._used

    def get(self, numbers: IntArray) -> Landmarks:
        """Return the landmarks with the numbers (n,)."""
        return self._rows.subset(self._find_rows(numbers))

    def update(self, landmarks: Landmarks) -> IntArray:
        """Store landmarks (n): those with a number are replaced, the others are added. The last of equal numbers wins.

        Returns:
            their numbers (n,).
        """
        numbers, new = landmarks.id.copy(), landmarks.id < 0
        numbers[new] = self._next + np.arange(new.sum())
        existing = landmarks.subset(~new)
        _write_rows(self._rows, self._find_rows(existing.id), existing)
        first, self._used, self._next = self._used, self._used + int(new.sum()), self._next + int(new.sum())
        if self._used > len(self._rows):
            self._rows = Landmarks.concatenate([self._rows.subset(np.arange(first)), _allocate(2 * self._used - first)])
        rows = np.arange(first, self._used)
        _write_rows(self._rows, rows, landmarks.subset(new))
        self._rows.id[rows] = numbers[new]
        return numbers

    def move(self, numbers: IntArray, positions: FloatArray) -> None:
        """Move the landmarks with some numbers (n,) to positions (n, 3), with unchanged information.

        The others move with the nearest of them, to stay consistent. Numbers of removed landmarks are ignored.
        """
        exists = np.isin(numbers, self._rows.id[: self._used])
        numbers, positions = numbers[exists], positions[exists]
        rows, means = self._find_rows(numbers), self._rows.mean[: self._used]
        is_other = np.asarray(np.isfinite(means).all(axis=1))
        is_other[rows] = False
        displacements, others = positions - means[rows], np.flatnonzero(is_other)
        if len(rows) >= N_MOVED_NEIGHBORS and len(others) and np.isfinite(displacements).all():
            _, nearest = cKDTree(means[rows]).query(means[others], N_MOVED_NEIGHBORS)
            # The median of so few, an even number, is found by sorting in half of the time of NumPy's.
            ordered, middle = np.sort(displacements.T[:, nearest], axis=2), N_MOVED_NEIGHBORS // 2
            means[others] += ordered[:, :, middle - 1 : middle + 1].mean(axis=2).T
        means[rows] = positions

    def prune(self, numbers: IntArray) -> None:
        """Remove all but those with some numbers, once they are less than half of all."""
        is_kept = np.zeros(self._next, bool)
        is_kept[numbers] = True
        rows = np.flatnonzero(is_kept[self._rows.id[: self._used]])
        if 2 * len(rows) < self._used:
            self._rows, self._used = self._rows.subset(rows), len(rows)

    def _find_rows(self, numbers: IntArray) -> IntArray:
        """Return (n,) the rows of existing numbers (n,)."""
        rows = np.searchsorted(self._rows.id[: self._used], numbers)
        assert (self._rows.id[rows] == numbers).all()
        return np.asarray(rows)


def _allocate(n: int) -> Landmarks:
    numbers, moved = np.full(n, -1, np.int64), np.empty(n, bool)
    return Landmarks(np.empty((n, 3)), np.empty((n, 3, 3)), np.empty(n, np.int64), moved, np.empty((n, 2)), numbers)


def _write_rows(rows: Landmarks, index: IntArray, landmarks: Landmarks) -> None:
    """Write everything except the numbers."""
    for f in fields(landmarks):
        if f.name != "id":
            getattr(rows, f.name)[index] = getattr(landmarks, f.name)
