"""What is known of each feature's place on the object: a mean and an information matrix, growing with every sight of it.

A feature seen once lies on its ray, somewhere in the object's depth; each further sight adds a ray. In the object's frame a
ray from o along r at distance d, with an image noise of σ/f, is the information (I - r r') / (d σ/f)² about the point, so
places are fused by adding information, whatever the order (docs/method.md, "Better than two frames").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import RigidTransform

from sylpose.features.sift import Features
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.numba_linalg import cholesky_solve, kernel, symmetric_eigen
from sylpose.rig import Camera

__all__ = ["Landmarks", "depth_prior", "learn_landmarks", "new_landmarks", "seen_again"]


# Image noise of a ray, pixels. More than a keypoint's own noise: the poses that rays are placed with have errors too,
# and those do not average out over the features of one frame (choice).
RAY_SIGMA_PX = 2.0
# Neighbours in the image that a new feature's depth is guessed from (choice).
NEIGHBOURS = 8


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Places of n features in the object's frame.

    Attributes:
        mean: (n, 3).
        information: (n, 3, 3), the inverse covariances.
        seen: (n,) in how many frames each was seen.
        moved: (n,) whether it was ever seen to move with the object, away from its `origin`. What never was may be
            background.
        origin: (n, 2) pixels where the camera saw it first.
        id: (n,) the number (`LandmarkTable`); the same feature seen again in another frame keeps it. -1: none yet.
    """

    mean: FloatArray
    information: FloatArray
    seen: IntArray
    moved: BoolArray
    origin: FloatArray
    id: IntArray

    @classmethod
    def none(cls) -> Landmarks:
        """No landmarks."""
        nothing = np.empty(0, np.int64)
        return cls(np.empty((0, 3)), np.empty((0, 3, 3)), nothing, np.empty(0, bool), np.empty((0, 2)), nothing)

    @classmethod
    def concatenate(cls, parts: Sequence[Landmarks]) -> Landmarks:
        """All parts after each other."""
        parts = [cls.none(), *parts]
        return cls(
            np.concatenate([p.mean for p in parts]),
            np.concatenate([p.information for p in parts]),
            np.concatenate([p.seen for p in parts]),
            np.concatenate([p.moved for p in parts]),
            np.concatenate([p.origin for p in parts]),
            np.concatenate([p.id for p in parts]),
        )

    def __len__(self) -> int:
        return len(self.mean)

    @property
    def depth_error(self) -> FloatArray:
        """(n, 3) the direction in which each place is least known, one standard deviation long; its sign is open."""
        out = np.empty((len(self), 3))
        _least_known(np.ascontiguousarray(self.information), out)
        return out

    @property
    def depth_sd(self) -> FloatArray:
        """(n,) standard deviation in that direction."""
        return np.asarray(np.linalg.norm(self.depth_error, axis=1))

    def subset(self, index: IntArray | BoolArray) -> Landmarks:
        """Those that a mask or an index array picks."""
        return Landmarks(
            self.mean[index],
            self.information[index],
            self.seen[index],
            self.moved[index],
            self.origin[index],
            self.id[index],
        )


@kernel
def _least_known(information: FloatArray, out: FloatArray) -> None:
    """out (n, 3) becomes `Landmarks.depth_error` of information (n, 3, 3)."""
    matrix, values, vectors = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    for n in range(len(information)):
        matrix[:] = information[n]
        symmetric_eigen(matrix, values, vectors)
        sd = 1.0 / np.sqrt(max(values[0], 1e-30))
        for i in range(3):
            out[n, i] = sd * vectors[i, 0]


def rays(features: Features, camera: Camera, object_from_world: RigidTransform) -> tuple[FloatArray, FloatArray]:
    """Camera's centre (3,) and the features' unit directions (n, 3), object's frame."""
    turn = camera.rotation @ object_from_world.as_matrix()[:3, :3].T
    directions = features.normalized @ turn[:2] + turn[2]
    directions /= np.sqrt(np.einsum("ni,ni->n", directions, directions))[:, None]
    return np.asarray(object_from_world.apply(camera.center)), directions


def new_landmarks(
    features: Features,
    camera: Camera,
    object_from_world: RigidTransform,
    distance: FloatArray,
    sd: FloatArray,
) -> Landmarks:
    """Features seen for the first time: on their rays, at a distance (n,) from the camera give or take sd (n,)."""
    center, directions = rays(features, camera, object_from_world)
    mean = center + distance[:, None] * directions
    across = (camera.focal / (RAY_SIGMA_PX * distance)) ** 2
    along = directions[:, :, None] * directions[:, None, :]
    information = (sd**-2 - across)[:, None, None] * along
    information[:, [0, 1, 2], [0, 1, 2]] += across[:, None]
    n = len(mean)
    nothing = np.zeros(n, bool), features.pixels.copy(), np.full(n, -1, np.int64)
    return Landmarks(mean, information, np.ones(n, np.int64), *nothing)


def seen_again(known: Landmarks, features: Features, camera: Camera, object_from_world: RigidTransform) -> Landmarks:
    """Adds each feature's ray (n) to what is known of its landmark (n)."""
    center, directions = rays(features, camera, object_from_world)
    mean, information = known.mean.copy(), known.information.copy()
    _add_rays(center, directions, camera.focal / RAY_SIGMA_PX, mean, information)
    return replace(known, mean=mean, information=information, seen=known.seen + 1)


@kernel
def _add_rays(
    center: FloatArray, directions: FloatArray, weight: float, mean: FloatArray, information: FloatArray
) -> None:
    """Changes mean (n, 3) and information (n, 3, 3) by rays from a centre (3,) along directions (n, 3); the weight is in
    standard deviations per radian."""
    root, off = np.empty((3, 3)), np.empty(3)
    for n in range(len(mean)):
        far = 0.0
        for i in range(3):
            off[i] = center[i] - mean[n, i]
            far += off[i] * off[i]
        across = (weight / max(np.sqrt(far), 1e-12)) ** 2
        along = off[0] * directions[n, 0] + off[1] * directions[n, 1] + off[2] * directions[n, 2]
        for i in range(3):
            # By how much the ray is off, times its information; and that added.
            off[i] = across * (off[i] - along * directions[n, i])
            for j in range(3):
                information[n, i, j] += across * ((1.0 if i == j else 0.0) - directions[n, i] * directions[n, j])
        root[:] = information[n]
        if not cholesky_solve(root, off):
            off[:] = np.nan
        for i in range(3):
            mean[n, i] += off[i]


def depth_prior(
    features: Features,
    camera: Camera,
    world_from_object: RigidTransform,
    cloud: FloatArray,
    radius: float,
    bulge: float = 0.0,
) -> tuple[FloatArray, FloatArray]:
    """How far away features are that were never seen before, from the object's points around them in the image.

    Args:
        cloud: (m, 3) points on or in the object, object's frame.
        radius: of the object, which bounds the answer's uncertainty: above and, at three tenths of it, below.
        bulge: how much nearer than the cloud the surface is thought to be at the middle of the object, in radii, falling to
            nothing at its rim like a sphere's.

    Returns:
        distance (n,) from the camera; sd (n,).
    """
    n = len(features)
    if n == 0:
        return np.empty(0), np.empty(0)
    points = world_from_object.apply(cloud).reshape(-1, 3)
    pixels = camera.project(points)
    seen = np.isfinite(pixels).all(axis=1)
    middle = float(np.linalg.norm(world_from_object.translation - camera.center))
    if seen.sum() < NEIGHBOURS:
        return np.full(n, middle), np.full(n, radius)
    distance = np.linalg.norm(points[seen] - camera.center, axis=1)
    gap, index = cKDTree(pixels[seen]).query(features.pixels, NEIGHBOURS)
    near = distance[index]
    # A gap in the image may be a gap of the same size in depth.
    extrapolation = gap.mean(axis=1) / camera.focal * middle
    if bulge:
        offset = np.linalg.norm(features.pixels - camera.project(world_from_object.translation), axis=1)
        rim = 1.1 * offset.max()
        near = near - (bulge * radius * np.sqrt(1.0 - (offset / rim) ** 2))[:, None]
    return near.mean(axis=1), np.sqrt(near.var(axis=1) + extrapolation**2).clip(0.3 * radius, radius)


def learn_landmarks(
    features: Features,
    camera: Camera,
    world_from_object: RigidTransform,
    known: Landmarks,
    index: IntArray,
    cloud: FloatArray,
    radius: float,
    bulge: float = 0.0,
) -> Landmarks:
    """The landmarks of a solved frame's features: known ones (k) seen again at `index` (k,), the others new.

    Args: see `depth_prior`.
    """
    object_from_world = world_from_object.inv()
    new_ones = np.ones(len(features), bool)
    new_ones[index] = False
    unknown = np.flatnonzero(new_ones)
    young = features.subset(unknown)
    distance, sd = depth_prior(young, camera, world_from_object, cloud, radius, bulge)
    new = new_landmarks(young, camera, object_from_world, distance, sd)
    old = seen_again(known, features.subset(index), camera, object_from_world)
    order = np.argsort(np.concatenate([index, unknown]))
    return Landmarks.concatenate([old, new]).subset(order)
