"""A solved frame that later ones are matched against, and what is learnt of its features."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.features.sift import Features, match_features
from sylpose.landmarks.places import Landmarks
from sylpose.matches import STILL_PX
from sylpose.numerics.arrays import BoolArray, FloatArray, IntArray
from sylpose.rig import Rig
from sylpose.two_frames.terms import TermData

__all__ = ["Pair", "Reference", "inliers_of", "learn_background", "match_pair", "still", "triangulate"]


# A feature that stands still where the object's surface moved by this much is background.
BACKGROUND_PX = 4.0
# Points are added to the object's cloud when their depth is known to this share of it.
DEPTH_SHARE = 0.1


@dataclass(eq=False)
class Reference:
    """One frame: its features, which of them are background, and its pose once it is solved.

    Attributes:
        index: frame number.
        time: seconds.
        features: per camera.
        landmarks: per camera, set when the frame is solved.
        background: per camera (n,), features that were found to stand still where the object moved.
        world_from_object: set when the frame is solved.
        covariance: (6, 6) of (w, d), docs/conventions.md.
        viewpoints: (C, 3) the cameras' centres in the object's frame, set when the frame is solved.
        age: in how many frames the landmarks were usually seen that it was solved with.
        late: (C,) seconds after `time` that each camera took its image.
    """

    index: int
    time: float
    features: tuple[Features, ...]
    background: tuple[BoolArray, ...]
    landmarks: tuple[Landmarks, ...] = ()
    world_from_object: RigidTransform = field(default_factory=RigidTransform.identity)
    covariance: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))
    viewpoints: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    age: float = 1.0
    late: FloatArray = field(default_factory=lambda: np.empty(0))


@dataclass(frozen=True, eq=False)
class Pair:
    """Matches of one camera between a reference and the current frame.

    Attributes:
        camera: index in the rig.
        reference: the earlier frame.
        indices: (n, 2) into the reference's and the current frame's features.
        pixels_i, pixels_j: (n, 2) as recorded.
        normalized_i, normalized_j: (n, 2).
    """

    camera: int
    reference: Reference
    indices: IntArray
    pixels_i: FloatArray
    pixels_j: FloatArray
    normalized_i: FloatArray
    normalized_j: FloatArray

    def __len__(self) -> int:
        return len(self.indices)

    def subset(self, mask: BoolArray) -> Pair:
        """The matches where the mask (n,) is True."""
        return replace(
            self,
            indices=self.indices[mask],
            pixels_i=self.pixels_i[mask],
            pixels_j=self.pixels_j[mask],
            normalized_i=self.normalized_i[mask],
            normalized_j=self.normalized_j[mask],
        )

    def term(self, rig: Rig, base: Reference) -> TermData:
        """The matches as a term of the motion that starts at the frame `base`."""
        camera = rig.cameras[self.camera]
        moved = None
        if base is not self.reference:
            moved = base.world_from_object * self.reference.world_from_object.inv()
        return TermData(
            self.camera, self.normalized_i, self.normalized_j, camera.rotation, camera.center, camera.focal, moved
        )


def match_pair(reference: Reference, current: Reference, camera: int) -> Pair:
    """Matches of one camera, without the reference's known background (which is passed on to the current frame)."""
    a, b = reference.features[camera], current.features[camera]
    indices = match_features(a, b)
    known = reference.background[camera][indices[:, 0]]
    standing = np.linalg.norm(a.pixels[indices[:, 0]] - b.pixels[indices[:, 1]], axis=1) < STILL_PX
    current.background[camera][indices[known & standing, 1]] = True
    indices = indices[~known & ~current.background[camera][indices[:, 1]]]
    i, j = indices.T
    return Pair(camera, reference, indices, a.pixels[i], b.pixels[j], a.normalized[i], b.normalized[j])


def inliers_of(pairs: Sequence[Pair], weights: Sequence[FloatArray]) -> list[Pair]:
    """The pairs' inliers, given one weight array per pair; pairs without any are left out."""
    kept = [pair.subset(w > 0) for pair, w in zip(pairs, weights, strict=True)]
    return [pair for pair in kept if len(pair)]


def still(pair: Pair) -> BoolArray:
    """(n,) matches that stand still in the image."""
    return np.asarray(np.linalg.norm(pair.pixels_i - pair.pixels_j, axis=1) < STILL_PX)


def learn_background(pairs: Sequence[Pair], rig: Rig, current: Reference, radius: float) -> None:
    """Marks features as background in both frames: those that stand still where a point on the object moved."""
    for pair in pairs:
        camera = rig.cameras[pair.camera]
        reference = pair.reference
        # Where each point would be now if it were on the object, at the depth of its centre.
        middle = camera.camera_from_world.apply(reference.world_from_object.translation)[2]
        motion = current.world_from_object * reference.world_from_object.inv()
        moved = np.full(len(pair), np.inf)
        for depth in (middle - radius, middle, middle + radius):
            points = max(depth, 0.1 * middle) * np.column_stack([pair.normalized_i, np.ones(len(pair))])
            expected = camera.project(motion.apply(camera.camera_from_world.inv().apply(points)))
            moved = np.fmin(moved, np.linalg.norm(expected - pair.pixels_i, axis=1))
        background = still(pair) & (moved > BACKGROUND_PX)
        reference.background[pair.camera][pair.indices[background, 0]] = True
        current.background[pair.camera][pair.indices[background, 1]] = True


def triangulate(pair: Pair, rig: Rig, current: Reference) -> FloatArray:
    """The matches' places in the object's frame (m, 3), those whose depth is known well enough.

    Each camera's two views of a moving object are two views of a standing object from a moving camera.
    """
    camera = rig.cameras[pair.camera]
    object_from_world_i, object_from_world_j = (frame.world_from_object.inv() for frame in (pair.reference, current))
    start, end = object_from_world_i.apply(camera.center), object_from_world_j.apply(camera.center)
    ones = np.ones((len(pair), 1))
    u = object_from_world_i.rotation.apply(np.hstack([pair.normalized_i, ones]) @ camera.rotation)
    v = object_from_world_j.rotation.apply(np.hstack([pair.normalized_j, ones]) @ camera.rotation)
    # Depths s, t with start + s u nearest to end + t v.
    across = np.cross(u, v)
    square = (across**2).sum(axis=1)
    sine = np.sqrt(square) / (np.linalg.norm(u, axis=1) * np.linalg.norm(v, axis=1))
    good = sine > 1.0 / (DEPTH_SHARE * camera.focal)  # one pixel over the sine: the relative error of the depth
    offset = end - start
    s = np.einsum("ni,ni->n", np.cross(offset, v[good]), across[good]) / square[good]
    return np.asarray((start + s[:, None] * u[good])[s > 0])
