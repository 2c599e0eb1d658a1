"""One camera's part of the tracker: what it sees in its own images, and all that it remembers of the object.

It is asked with what all cameras know alike (a pose, the object's radius, numbers of frames) and sees nothing of other
cameras. What it finds is its own; what it tells the others of it are `records`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import RigidTransform

from sylpose.features.sift import ALL_FEATURES, MAX_FEATURES, Features, detect, seen_before
from sylpose.landmarks.places import Landmarks, learn_landmarks
from sylpose.landmarks.table import LandmarkTable
from sylpose.matches import STILL_PX
from sylpose.numerics.arrays import BoolArray, FloatArray, Image, IntArray
from sylpose.rig import Camera
from sylpose.tracking.anchor import CameraAnchor, Followed, Renewal, begin_anchor, follow, gone_on
from sylpose.tracking.frame import (
    CameraFrame,
    Pair,
    SolvedFrame,
    Sought,
    away,
    inliers_of,
    learn_background,
    match_pair,
    pair_near,
    standing,
)
from sylpose.tracking.region import polygon_mask
from sylpose.tracking.watch import View, Watch

__all__ = ["CameraPart", "SeenAgain", "have_moved", "still_of"]

# Landmarks whose depth is known to this share of the object's radius show where its surface is (choice).
KNOWN_DEPTH = 0.1
# So many of them show it better than what the boxes allow (choice).
MIN_SURFACE = 20
# A landmark has moved with the object where the pose leaves no more than this share of the way from where it was first seen
# unexplained (choice).
CLEARLY = 0.5
# What is displaced by so many standard deviations of a camera's keypoints has moved; no camera is taken to be worse than
# this, pixels (choice).
STILL_SIGMAS, MOST_STILL_PX = 5.0, 6.0
# Features that are remembered as background (choice).
MOST_SURROUNDINGS = 8000
# The noise is a mean over about so many frames (choice).
NOISE_MEMORY = 5
# Where what is found is found by chance: beside where it should be, in reaches (choice).
BESIDE = ((6.0, 0.0), (0.0, 6.0), (-6.0, 0.0), (0.0, -6.0))
# A feature this near to one that is known, pixels, is the same (choice).
KNOWN_PLACE_PX = 1.5


@dataclass(frozen=True, eq=False)
class SeenAgain:
    """The features of one camera's frame that were seen before.

    Attributes:
        inliers: the matches with earlier frames that say so.
        index: (k,) into the frame's features.
        known: (k) what is known of each, the best of the landmarks that it is matched with.
        surface: (m, 3) places of those that are known well enough to tell where the object's surface is.
    """

    inliers: Sequence[Pair]
    index: IntArray
    known: Landmarks
    surface: FloatArray

    @classmethod
    def none(cls) -> SeenAgain:
        """Nothing: all features are new."""
        return cls([], np.empty(0, np.int64), Landmarks.none(), np.empty((0, 3)))

    @classmethod
    def of(
        cls, pairs: Sequence[Pair], agreement: Sequence[tuple[FloatArray, FloatArray]], still_px: float, radius: float
    ) -> SeenAgain:
        """What a frame's matches say, of which some agree with its pose.

        A landmark has moved if any that its feature is matched with has, or does so now: it is where the pose says, and
        that is far from where it was first seen.

        Args:
            agreement: weights and residuals, pixels, (n,) of each pair.
            still_px: what is less far may stand still.
        """
        inliers = inliers_of(pairs, [w for w, _ in agreement])
        if not inliers:
            return cls.none()
        known = Landmarks.concatenate([pair.landmarks for pair in inliers])
        index, sd = np.concatenate([pair.indices[:, 1] for pair in inliers]), known.depth_sd
        # Of landmarks that are known alike, the oldest: rounding must not decide, which is another one elsewhere.
        order = np.lexsort((known.id, sd.astype(np.float32), index))
        _, first = np.unique(index[order], return_index=True)
        pick = order[first]
        moved = have_moved(inliers, known, agreement, still_px)
        ever = np.zeros(int(index.max()) + 1, bool)
        np.logical_or.at(ever, index, moved)
        # Where it was first seen is a matter of all that its feature is matched with: of the oldest.
        best = replace(known.subset(pick), moved=ever[index[pick]], origin=_oldest_origin(index, known)[index[pick]])
        return cls(inliers, index[pick], best, best.mean[sd[pick] < KNOWN_DEPTH * radius])


def have_moved(
    inliers: Sequence[Pair], known: Landmarks, agreement: Sequence[tuple[FloatArray, FloatArray]], still_px: float
) -> BoolArray:
    """(n,) which of the matches that agree with a frame's pose are known to be no background: whose landmark, `known` (n),
    has moved before, or does so now.

    Args: the rest as in `SeenAgain.of`.
    """
    residual = np.concatenate([np.empty(0), *(np.abs(r[w > 0]) for w, r in agreement)])
    far = away(known, np.concatenate([np.empty((0, 2)), *(pair.pixels_j for pair in inliers)]))
    return np.asarray(known.moved | ((far > still_px) & (residual < CLEARLY * far)))


def _oldest_origin(index: IntArray, known: Landmarks) -> FloatArray:
    """(m, 2) by feature, where the landmark with the lowest number was first seen that it (n,) is matched with."""
    origin = np.zeros((int(index.max()) + 1, 2))
    order = np.argsort(-known.id, kind="stable")
    origin[index[order]] = known.origin[order]
    return origin


def still_of(noise_px: float) -> float:
    """What is displaced by less than this, pixels, stands still for all that keypoints of this noise can tell."""
    return float(np.clip(STILL_SIGMAS * noise_px, STILL_PX, MOST_STILL_PX))


class CameraPart:
    """What one camera remembers.

    Attributes:
        index: in the rig.
        camera: its calibration.
        table: its landmarks.
        frames: what it has of solved frames, by number: the keyframes, the last one and the anchor.
        anchor: its side of the frame whose features are followed, if any; renewal: of the next one, while it is prepared.
        surroundings: the first frame's features outside the object's region, and what was found to be background since:
            what is later seen at the same place is background.
        noise_px: of its keypoints, as the frames so far have it.
        view: image and mask of the last solved frame, until all is found in it that there is.
        watch: whether it stands, whatever becomes of the object.
        sought: what it looked at last, in the present frame.
    """

    def __init__(self, index: int, camera: Camera) -> None:
        self.index, self.camera = index, camera
        self.frames: dict[int, CameraFrame] = {}
        self.anchor: CameraAnchor | None = None
        self.renewal: Renewal | None = None
        self.surroundings = Features.none()
        self.table = LandmarkTable()
        self.noise_px = 0.0
        self.view: View = (None, None)
        self.watch = Watch(camera)
        self.sought = Sought()

    @property
    def still_px(self) -> float:
        """What is displaced by less than this, pixels, stands still for all that the camera's keypoints can tell."""
        return still_of(self.noise_px)

    # --- seeing: nothing of it is remembered -------------------------------------------------------------------------

    def detect(
        self,
        image: Image | None,
        mask: BoolArray | None,
        where: BoolArray | None,
        most: int = MAX_FEATURES,
        *,
        faint: bool = False,
    ) -> Features:
        """The features of an image, inside an area (h, w; None: everywhere) and the object's mask; the `most` strongest, or
        with `faint` all."""
        if image is None:
            return Features.none()
        if where is None:
            where = np.ones(self.camera.size[::-1], bool)
        where = where if mask is None else where & mask
        return detect(image, self.camera, where, ALL_FEATURES if faint else most, faint=faint)

    def inside(self, features: Features, region: FloatArray | None) -> BoolArray:
        """(n,) which features are inside a region's outline (k, 2)."""
        row, column = np.round(features.pixels).astype(np.int64).T[::-1]
        return np.asarray(polygon_mask(region, self.camera.size)[row, column])

    def frame(self, features: Features) -> CameraFrame:
        """A frame to be solved; what the first frame has at the same place around the object is background."""
        return CameraFrame(features, self.known_background(features), self.table, still_px=self.still_px)

    def blind(self) -> CameraFrame:
        """A frame of which nothing is seen."""
        return self.frame(Features.none())

    def known_background(self, features: Features) -> BoolArray:
        """(n,) features that the first frame had at the same place, outside the object's region."""
        return seen_before(features, self.surroundings, self.still_px)

    def follow(
        self,
        last: RigidTransform,
        ahead: RigidTransform,
        image: Image | None,
        mask: BoolArray | None,
        radius: float,
    ) -> Followed:
        """The anchor's features in the next image. See `anchor.follow`."""
        assert self.anchor is not None
        return follow(self.anchor, self.camera, last, ahead, image, mask, radius)

    def match(self, current: CameraFrame, references: Sequence[int]) -> list[Pair]:
        """Matches by their looks with earlier frames, in this order: each passes on what it knows of the background, and the
        next one uses it."""
        pairs = [match_pair(number, self.frames[number], current) for number in references]
        return [pair for pair in pairs if len(pair)]

    def match_near(
        self, current: CameraFrame, references: Sequence[int], pose: RigidTransform, reach_px: float
    ) -> list[Pair]:
        """Matches with earlier frames of what is where it should be at a pose (world_from_object), within some pixels."""
        pairs = [pair_near(number, self.frames[number], current, self.camera, pose, reach_px) for number in references]
        return [pair for pair in pairs if len(pair)]

    def evidence(
        self, current: CameraFrame, references: Sequence[int], pose: RigidTransform, reach_px: float
    ) -> tuple[int, float]:
        """How many features look like landmarks that should be there at a pose, within some pixels; and how many do where
        these should not be, by chance."""

        def count(dx: float, dy: float) -> int:
            beside = dx * reach_px, dy * reach_px
            pairs = [
                pair_near(number, self.frames[number], current, self.camera, pose, reach_px, beside)
                for number in references
            ]
            return len(np.unique(np.concatenate([np.empty(0, np.int64), *(pair.indices[:, 1] for pair in pairs)])))

        return count(0.0, 0.0), float(np.mean([count(*beside) for beside in BESIDE]))

    # --- learning: once a frame is accepted --------------------------------------------------------------------------

    def learn_background(
        self,
        pairs: Sequence[Pair],
        current: CameraFrame,
        now: RigidTransform,
        known: Mapping[int, SolvedFrame],
        radius: float,
    ) -> None:
        """What stood still where the object, at `now` (world_from_object), had moved by then is background."""
        before = current.background.copy()
        for pair in pairs:
            pose = known[pair.reference].world_from_object
            learn_background(pair, current, standing(pair, current, self.camera, pose, now, radius))
        found = current.features.subset(current.background & ~before)
        if len(self.surroundings) < MOST_SURROUNDINGS:
            self.surroundings = Features.concatenate([self.surroundings, found])

    def learn_noise(self, noise_px: float) -> None:
        """What the features of another frame showed of the keypoints' noise; NaN: nothing."""
        if np.isfinite(noise_px):
            self.noise_px += (noise_px - self.noise_px) / (NOISE_MEMORY if self.noise_px else 1)

    def learn(
        self,
        current: CameraFrame,
        seen_from: Camera,
        world_from_object: RigidTransform,
        seen: SeenAgain,
        cloud: FloatArray,
        radius: float,
        bulge: float = 0.0,
    ) -> None:
        """The landmarks of a solved frame.

        Args:
            seen_from: the camera as it stood for this frame.
            seen: those of its features that were seen before.
            cloud: (n, 3) points on the object, object's frame, where too few landmarks tell where its surface is.
            bulge: see `depth_prior`.
        """
        surface = seen.surface if len(seen.surface) >= MIN_SURFACE else cloud
        current.numbers = self.table.learn(
            learn_landmarks(
                current.features, seen_from, world_from_object, seen.known, seen.index, surface, radius, bulge
            )
        )
        # What the earlier frames took for other landmarks is one.
        for pair in seen.inliers:
            pair.earlier.numbers[pair.indices[:, 0]] = current.numbers[pair.indices[:, 1]]

    def relearnt(
        self, number: int, seen_from: Camera, world_from_object: RigidTransform, cloud: FloatArray, radius: float
    ) -> Landmarks:
        """A frame's landmarks as if none of them had been seen elsewhere. See `learn`."""
        frame, none = self.frames[number], SeenAgain.none()
        new = learn_landmarks(frame.features, seen_from, world_from_object, none.known, none.index, cloud, radius)
        return replace(new, id=frame.numbers)

    def begin(self, number: int, first: CameraFrame, surroundings: Features, view: View) -> None:
        """The first solved frame, with its image; the features around the object in it."""
        self.frames, self.anchor, self.view = {number: first}, None, view
        self.surroundings = surroundings

    def enrich(
        self, number: int, pose: RigidTransform, region: FloatArray | None, cloud: FloatArray, radius: float
    ) -> None:
        """All that can still be found in the image of the last solved frame becomes features of it, once.

        Args:
            pose: its world_from_object; region: (k, 2) the object's outline in it, None out of sight.
            cloud: (n, 3) points on the object, object's frame, where too few landmarks tell where its surface is.
        """
        (image, mask), self.view = self.view, (None, None)
        old = self.frames[number]
        found = self.detect(image, mask, polygon_mask(region, self.camera.size), faint=True)
        if len(found) and len(old.features):
            found = found.subset(cKDTree(old.features.pixels).query(found.pixels)[0] > KNOWN_PLACE_PX)
        if not len(found):
            return
        known, none = old.landmarks, SeenAgain.none()
        surface = known.mean[known.depth_sd < KNOWN_DEPTH * radius]
        cloud = surface if len(surface) >= MIN_SURFACE else cloud
        new = learn_landmarks(found, self.camera, pose, none.known, none.index, cloud, radius)
        self.frames[number] = CameraFrame(
            Features.concatenate([old.features, found]),
            np.concatenate([old.background, self.known_background(found)]),
            self.table,
            np.concatenate([old.numbers, self.table.learn(new)]),
        )

    def keep(self, number: int, current: CameraFrame, numbers: set[int], view: View) -> None:
        """A solved frame, with its image; of those with other numbers than these nothing is kept."""
        self.frames[number], self.view = current, view
        self.frames = {k: frame for k, frame in self.frames.items() if k in numbers}
        self.table.keep(np.concatenate([frame.numbers for frame in self.frames.values()]))

    def anchor_at(self, number: int, image: Image | None, before: Followed | None) -> None:
        """A solved frame becomes the anchor. See `anchor.begin_anchor`."""
        self.anchor, self.renewal = begin_anchor(number, self.frames[number], image, before), None

    def go_on(self, followed: Followed, pairs: Sequence[Pair], weights: Sequence[FloatArray]) -> None:
        """A frame was solved by the anchor's features alone."""
        self.anchor = gone_on(followed, pairs, weights)

    @property
    def knows(self) -> bool:
        """Whether it has seen anything of the object that it would know again."""
        return any(len(frame.features) for frame in self.frames.values())

    def constants(self) -> list[object]:
        """What it holds that is never written to."""
        anchor, watch = self.anchor, self.watch
        of_anchor = () if anchor is None else (anchor.tracks, anchor.image, anchor.frame.features)
        features = (self.surroundings, *(frame.features for frame in self.frames.values()))
        return [self.camera, self.view, self.renewal, watch.backdrop, watch.steady, *of_anchor, *features]

    def look_anew(self) -> None:
        """Another frame: nothing was looked at in it yet."""
        self.sought = Sought()

    def forget(self) -> None:
        """Everything: the object is looked for anew."""
        self.frames, self.anchor, self.surroundings, self.view = {}, None, Features.none(), (None, None)
        self.renewal = None
        self.noise_px = 0.0
        self.table = LandmarkTable()
