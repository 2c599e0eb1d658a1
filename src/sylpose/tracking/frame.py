"""A frame: what each camera has of it, and its pose once it is solved; matches between two frames of a camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.features.sift import Features, match_features, match_where_expected
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.landmarks.landmark_filter import Landmarks
from sylpose.landmarks.landmark_table import LandmarkTable
from sylpose.matches import STILL_PX
from sylpose.relative_pose.terms import TermData
from sylpose.rig import Camera

__all__ = [
    "CameraFrame",
    "Frame",
    "Pair",
    "SolvedFrame",
    "Sought",
    "away",
    "inliers_of",
    "learn_background",
    "match_pair",
    "pair_near",
    "sought_in",
    "still",
    "triangulate",
    "without_background",
]

# A feature that stands still where the object's surface moved by this much is background (choice).
BACKGROUND_PX = 4.0
# Faint features stand still less exactly: within this, pixels, if it is no more than this share of what a point on the
# object moves (choice).
FAINTLY_STILL_PX, STILL_SHARE = 4.0, 0.2
# Standard deviations of its depth within which a landmark is looked for (choice).
DEPTH_REACH = 2.0
# Points are added to the object's cloud when their depth is known to this share of it (choice).
DEPTH_SHARE = 0.1


@dataclass(eq=False)
class CameraFrame:
    """What one camera has of one frame, and keeps to itself.

    Attributes:
        features: of its image.
        background: (n,) which of them were found to stand still where the object moved; filled in as they are matched.
        table: the camera's landmarks; numbers: (n,) of the features in it, once the frame is solved.
        still_px: a feature displaced by less than this stands still for all that the camera's keypoints can tell.
    """

    features: Features
    background: BoolArray
    table: LandmarkTable
    numbers: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    still_px: float = STILL_PX

    @property
    def landmarks(self) -> Landmarks:
        """(n) of the features, as they are known by now."""
        return self.table.of(self.numbers)


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame that is not solved: it has no pose.

    Attributes:
        number: frames are numbered as they come.
        time: seconds.
        late: (C,) seconds after `time` that each camera took its image.
        cameras: what each has of it.
    """

    number: int
    time: float
    late: FloatArray
    cameras: Sequence[CameraFrame]


@dataclass(frozen=True, eq=False)
class SolvedFrame:
    """A frame with its pose: what all cameras know of it. What each has of it besides, it keeps under the number.

    Attributes:
        number, time, late: as in `Frame`.
        world_from_object: the pose.
        covariance: (6, 6) of (w, d), docs/conventions.md.
        viewpoints: (C, 3) the cameras' centres in the object's frame.
        sees: (C,) which cameras have features of it.
        age: in how many frames the landmarks were usually seen that it was solved with.
        stays: whether its pose is not refined with others: that of a keyframe which another rig has seen.
    """

    number: int
    time: float
    late: FloatArray
    world_from_object: RigidTransform
    covariance: FloatArray
    viewpoints: FloatArray
    sees: BoolArray
    age: float = 1.0
    stays: bool = False


@dataclass(frozen=True, eq=False)
class Pair:
    """Matches of one camera between an earlier frame and the current one.

    Attributes:
        reference: the earlier frame's number.
        earlier: what the camera has of it.
        indices: (n, 2) into the earlier and the current frame's features.
        pixels_i, pixels_j: (n, 2) as recorded.
        normalized_i, normalized_j: (n, 2).
    """

    reference: int
    earlier: CameraFrame
    indices: IntArray
    pixels_i: FloatArray
    pixels_j: FloatArray
    normalized_i: FloatArray
    normalized_j: FloatArray

    @classmethod
    def of(cls, reference: int, earlier: CameraFrame, later: Features, indices: IntArray) -> Pair:
        """The matches that the indices (n, 2) say."""
        a, (i, j) = earlier.features, indices.T
        return cls(reference, earlier, indices, a.pixels[i], later.pixels[j], a.normalized[i], later.normalized[j])

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

    @property
    def landmarks(self) -> Landmarks:
        """(n) of the matches, by the earlier frame."""
        return self.earlier.table.of(self.earlier.numbers[self.indices[:, 0]])

    @property
    def seen(self) -> IntArray:
        """(n,) in how many frames each match's landmark was seen."""
        return self.earlier.table.seen(self.earlier.numbers[self.indices[:, 0]])

    def term(self, index: int, camera: Camera, moved: RigidTransform | None = None) -> TermData:
        """The matches as a term of a motion.

        Args:
            index: of the camera in the rig.
            moved: takes the object from the earlier frame to the one that the motion starts from; None: the same.
        """
        x, y = self.normalized_i, self.normalized_j
        return TermData(index, x, y, camera.rotation, camera.center, camera.focal, moved)


@dataclass(frozen=True, eq=False)
class Sought:
    """What a camera looked at in a frame, pixels: (n, 2) all features, and (m, 2) those that match what is known of the
    object and do not agree with its pose, or are of no pose."""

    features: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    rejected: FloatArray = field(default_factory=lambda: np.empty((0, 2)))


def sought_in(features: Features, pairs: Sequence[Pair] = (), weights: Sequence[FloatArray] | None = None) -> Sought:
    """Of a frame's features, its matches, and the weight (n,) of each pair's in the pose; None without one."""
    tried, agrees = np.zeros(len(features), bool), np.zeros(len(features), bool)
    for k, pair in enumerate(pairs):
        tried[pair.indices[:, 1]] = True
        if weights is not None:
            agrees[pair.indices[weights[k] > 0, 1]] = True
    return Sought(features.pixels, features.pixels[tried & ~agrees])


def base_from_reference(pair: Pair, base: SolvedFrame, known: Mapping[int, SolvedFrame]) -> RigidTransform | None:
    """What `Pair.term` takes as `moved`, of the frames whose poses are known."""
    if pair.reference == base.number:
        return None
    return base.world_from_object * known[pair.reference].world_from_object.inv()


def match_pair(reference: int, earlier: CameraFrame, current: CameraFrame, indices: IntArray | None = None) -> Pair:
    """Matches of one camera, without the earlier frame's known background (which is passed on to the current frame); indices
    (m, 2) where they are known."""
    a, b = earlier.features, current.features
    indices = match_features(a, b) if indices is None else indices
    known = earlier.background[indices[:, 0]]
    stands = np.linalg.norm(a.pixels[indices[:, 0]] - b.pixels[indices[:, 1]], axis=1) < current.still_px
    current.background[indices[known & stands, 1]] = True
    return Pair.of(reference, earlier, b, indices[~known & ~current.background[indices[:, 1]]])


def pair_near(
    reference: int,
    earlier: CameraFrame,
    current: CameraFrame,
    camera: Camera,
    pose: RigidTransform,
    reach_px: float,
    beside_px: tuple[float, float] = (0.0, 0.0),
) -> Pair:
    """Matches of one camera between the earlier frame's landmarks and what is where they should be.

    Args:
        pose: world_from_object, of the current frame.
        reach_px: how far from there, pixels, besides what the landmarks' depth leaves open.
        beside_px: looked for so far beside where they should be: what is found there is found by chance.
    """
    landmarks = earlier.landmarks
    away = DEPTH_REACH * landmarks.depth_error
    ends = np.stack([camera.project(pose.apply(landmarks.mean + s * away).reshape(-1, 3)) for s in (-1, 1)], axis=1)
    ends[earlier.background] = np.nan
    indices = match_where_expected(earlier.features, current.features, ends + np.array(beside_px), reach_px)
    return Pair.of(reference, earlier, current.features, indices[~current.background[indices[:, 1]]])


def inliers_of(pairs: Sequence[Pair], weights: Sequence[FloatArray]) -> list[Pair]:
    """The pairs' inliers, given one weight array per pair; pairs without any are left out."""
    kept = [pair.subset(w > 0) for pair, w in zip(pairs, weights, strict=True)]
    return [pair for pair in kept if len(pair)]


def still(pair: Pair, still_px: float = STILL_PX) -> BoolArray:
    """(n,) matches that stand still in the image."""
    return np.asarray(np.linalg.norm(pair.pixels_i - pair.pixels_j, axis=1) < still_px)


def away(known: Landmarks, pixels: FloatArray) -> FloatArray:
    """(n,) how far landmarks are, now seen at some pixels (n, 2), from where they were seen first."""
    return np.asarray(np.linalg.norm(pixels - known.origin, axis=1))


def standing(
    pair: Pair, current: CameraFrame, camera: Camera, before: RigidTransform, now: RigidTransform, radius: float
) -> BoolArray:
    """(n,) matches that stand still where a point on the object moved.

    Args:
        before, now: world_from_object.
        radius: of the object.
    """
    stands = still(pair, current.still_px)
    at = np.flatnonzero(stands)
    moved = _moved_px(pair.pixels_i[at], pair.normalized_i[at], camera, before, now, radius)
    stands[at] = moved > BACKGROUND_PX - STILL_PX + current.still_px
    return stands


def without_background(
    pair: Pair, current: CameraFrame, camera: Camera, before: RigidTransform, ahead: RigidTransform, radius: float
) -> Pair:
    """The matches without those that stand still and were never seen to move, where a point on the object would have moved:
    they are marked as `learn_background` marks them, before the pose is known.

    Args:
        ahead: world_from_object as predicted. An object that stops instead is still known by what was seen to move.
    """
    shift = np.linalg.norm(pair.pixels_i - pair.pixels_j, axis=1)
    background = (shift < FAINTLY_STILL_PX) & ~pair.landmarks.moved
    if not background.any():
        return pair
    at = np.flatnonzero(background)
    moved = _moved_px(pair.pixels_i[at], pair.normalized_i[at], camera, before, ahead, radius)
    background[at] = (moved > BACKGROUND_PX) & (shift[at] < np.maximum(STILL_SHARE * moved, STILL_PX))
    learn_background(pair, current, background)
    return pair.subset(~background)


def learn_background(pair: Pair, current: CameraFrame, background: BoolArray) -> None:
    """Marks matches (n,) as background in both frames."""
    pair.earlier.background[pair.indices[background, 0]] = True
    current.background[pair.indices[background, 1]] = True


def learn_only(pairs: Sequence[Pair], current: CameraFrame) -> None:
    """Marks all of a frame's features but those of some matches as background."""
    own = np.concatenate([np.empty(0, np.int64), *(pair.indices[:, 1] for pair in pairs)])
    current.background[np.setdiff1d(np.arange(len(current.features)), own)] = True


def _moved_px(
    pixels: FloatArray,
    normalized: FloatArray,
    camera: Camera,
    before: RigidTransform,
    now: RigidTransform,
    radius: float,
) -> FloatArray:
    """(n,) by how many pixels what was seen at pixels (n, 2), normalised (n, 2), would move at least if it were on the
    object, at any depth of it."""
    middle = camera.camera_from_world.apply(before.translation)[2]
    moves = now.as_matrix() @ before.inv().as_matrix() @ camera.camera_from_world.inv().as_matrix()
    along = np.column_stack([normalized, np.ones(len(normalized))]) @ moves[:3, :3].T
    moved = np.full(len(pixels), np.inf)
    for depth in (middle - radius, middle, middle + radius):
        expected = camera.project(max(depth, 0.1 * middle) * along + moves[:3, 3])
        moved = np.fmin(moved, np.linalg.norm(expected - pixels, axis=1))
    return moved


def triangulate(pair: Pair, camera: Camera, before: RigidTransform, now: RigidTransform) -> FloatArray:
    """The matches' places in the object's frame (m, 3), those whose depth is known well enough.

    A camera's two views of a moving object are two views of a standing object from a moving camera.

    Args:
        before, now: world_from_object.
    """
    object_from_world_i, object_from_world_j = before.inv(), now.inv()
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
