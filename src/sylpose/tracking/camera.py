"""One camera's part of the tracker: what it sees in its own images, and all that it remembers of the object.

It is asked with what all cameras know alike (a pose, the object's radius, numbers of frames) and sees nothing of other
cameras. What it finds is its own; what it tells the others of it are `records`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import RigidTransform

from sylpose.features.sift import ALL_FEATURES, MAX_FEATURES, Features, detect, seen_before
from sylpose.geometry.arrays import BoolArray, FloatArray, Image
from sylpose.landmarks.landmark_filter import Landmarks, learn_landmarks
from sylpose.landmarks.landmark_table import LandmarkTable
from sylpose.matches import STILL_PX
from sylpose.rig import Camera
from sylpose.tracking.camera_motion_detection import View, Watch
from sylpose.tracking.frame import (
    CameraFrame,
    Pair,
    SolvedFrame,
    Sought,
    learn_background,
    match_pair,
    pair_near,
    standing,
)
from sylpose.tracking.klt_frontend import CameraAnchor, Followed, Renewal, begin_anchor, follow, gone_on
from sylpose.tracking.region import polygon_mask
from sylpose.tracking.reobserved import KNOWN_DEPTH, SeenAgain

__all__ = ["CameraPart", "is_large", "still_of"]

# So many of them show it better than what the boxes allow (choice).
MIN_SURFACE = 20
# What is displaced by so many standard deviations of a camera's keypoints has moved; no camera is taken to be worse than
# this, pixels (choice).
STILL_SIGMAS, MOST_STILL_PX = 5.0, 6.0
# Features that are remembered as background (choice).
MOST_SURROUNDINGS = 8000
# The noise is a mean over about so many frames (choice).
NOISE_MEMORY = 5
# Where what is found is found by chance: beside where it should be, in reaches (choice).
BESIDE = ((6.0, 0.0), (0.0, 6.0), (-6.0, 0.0), (0.0, -6.0))
# Images with more pixels than Full HD are made smaller where all of them is searched: what is found there is looked at anew
# in full (choice).
SEARCH_PIXELS = 1920 * 1080
# Around the object's outline its surroundings are looked at up to so many times its size (choice).
SURROUNDINGS = 2.0
# A feature this near to one that is known, pixels, is the same (choice).
KNOWN_PLACE_PX = 1.5


def still_of(noise_px: float) -> float:
    """What is displaced by less than this, pixels, stands still for all that keypoints of this noise can tell."""
    return float(np.clip(STILL_SIGMAS * noise_px, STILL_PX, MOST_STILL_PX))


def is_large(camera: Camera) -> bool:
    """Whether a camera's images are searched reduced."""
    width, height = camera.size
    return width * height > SEARCH_PIXELS


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
        reduced: bool = False,
    ) -> Features:
        """The features of an image, inside an area (h, w; None: everywhere) and the object's mask; the `most` strongest, or
        with `faint` all. `reduced`: of a large area made smaller."""
        if image is None:
            return Features.none()
        if where is None:
            where = np.ones(self.camera.size[::-1], bool)
        where = where if mask is None else where & mask
        most = ALL_FEATURES if faint else most
        return detect(image, self.camera, where, most, faint=faint, max_pixels=SEARCH_PIXELS if reduced else None)

    @property
    def is_large(self) -> bool:
        """Whether its images are searched reduced."""
        return is_large(self.camera)

    def closer(
        self, image: Image | None, mask: BoolArray | None, features: Features, region: FloatArray | None, *, faint: bool
    ) -> Features:
        """The features inside a region's outline (k, 2), by those of a search of the whole image: where that was reduced,
        all that its own pixels show there."""
        if image is None or not self.is_large:
            return features.subset(self.inside(features, region))
        return self.detect(image, mask, polygon_mask(region, self.camera.size), faint=faint)

    def told_apart(
        self,
        image: Image | None,
        mask: BoolArray | None,
        features: Features,
        region: FloatArray | None,
        stood: BoolArray,
    ) -> tuple[Features, Features]:
        """Those of the features of a whole image that may be the object's, inside a region's outline (k, 2), and the others:
        those outside, and those of which it is known that they `stood` (n,)."""
        mine = self.inside(features, region) & ~stood
        if image is None or not self.is_large:
            return features.subset(mine), features.subset(~mine)
        found = self.closer(image, mask, features, region, faint=False)
        still = seen_before(found, features.subset(stood), self.still_px)
        return found.subset(~still), Features.concatenate([features.subset(~mine), found.subset(still)])

    def around(
        self, image: Image | None, mask: BoolArray | None, region: FloatArray | None, *, faint: bool
    ) -> Features:
        """The features outside a region's outline (k, 2); of large images in full where they are near to it."""
        where = ~polygon_mask(region, self.camera.size)
        found = self.detect(image, mask, where, faint=faint, reduced=True)
        if region is None or not self.is_large:
            return found
        middle = region.mean(axis=0)
        near = where & polygon_mask(middle + SURROUNDINGS * (region - middle), self.camera.size)
        return Features.concatenate([found, self.detect(image, mask, near, faint=faint, reduced=True)])

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
