"""The KLT front end: an anchor frame's features, followed from image to image until too few of them are left.

SIFT finds the features of an anchor and matches them with the keyframes; in the frames between two anchors they are only
followed, which takes a tenth of the time and places them better (`features.klt`). The next anchor goes on with those that
are still followed and adds new ones beside them.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import RigidTransform

from sylpose.features.klt import Tracks, advance, begin, grey
from sylpose.features.sift import Features
from sylpose.numerics.arrays import BoolArray, FloatArray, Image, IntArray
from sylpose.rig import Rig
from sylpose.tracking.frame import Pair, Reference

__all__ = ["Anchor", "Followed", "begin_anchor", "follow", "with_new"]

Images = Sequence[Image | None]
Regions = Sequence[FloatArray | None]

# Features per camera that an anchor has in all, if there are so many (keyframes are anchors, and are searched by them), and
# how many are followed of them; how many of these are new at least.
FEATURES, FOLLOWED, MIN_NEW = 350, 170, 40
# A new feature this near to one that is followed, pixels, is the same.
SAME_PX = 4.0
# Features that were lost on the way are looked for again where their depth is known to this share of the object's radius.
KNOWN_DEPTH = 0.1
# What of an anchor's features must still be seen: these shares of them, in all and in each camera, and so many in all, while
# the object has turned by less than this (radians) since.
ANCHOR_SHARE, CAMERA_SHARE, MIN_FOLLOWED, ANCHOR_TURN = 0.4, 0.25, 60, np.radians(20.0)
# Frames until a camera in which no feature was followed is searched again.
ASK_AGAIN = 8


@dataclass(eq=False)
class Anchor:
    """A frame whose features are followed, as far as they have been.

    Attributes:
        reference: the frame; its landmarks learn what the followed features show.
        tracks: per camera, a row for each of the reference's features.
        alive: per camera (n,), False for features that turned out not to be on the object.
        images: per camera the last one, grey; None before the camera's first.
        age: number of frames that were solved by its features alone.
    """

    reference: Reference
    tracks: list[Tracks]
    alive: list[BoolArray]
    images: list[Image | None]
    age: int = 0

    def suffices(self, followed: Followed, ahead: RigidTransform, regions: Regions) -> bool:
        """Whether enough of the features are still seen to do without new ones.

        Args:
            ahead: world_from_object as predicted for the frame.
            regions: of the object, per camera; None where it is out of sight.
        """
        turn = (ahead.rotation * self.reference.world_from_object.rotation.inv()).magnitude()
        found, alive = np.array([len(rows) for rows in followed.rows]), np.array([n.sum() for n in self.alive])
        enough = found.sum() >= max(ANCHOR_SHARE * alive.sum(), MIN_FOLLOWED) and (found >= CAMERA_SHARE * alive).all()
        for image, region, before, n in zip(followed.images, regions, self.images, alive, strict=True):
            # A camera that gives images again takes part at once; one that saw nothing is asked again after a while.
            looks = image is not None and region is not None
            enough &= not (looks and before is None)
            enough &= not (looks and n == 0 and self.age >= ASK_AGAIN)
        return bool(enough and turn < ANCHOR_TURN)

    def go_on(self, followed: Followed, pairs: Sequence[Pair], weights: Sequence[FloatArray]) -> None:
        """A frame was solved by its features alone: what did not agree there is not on the object."""
        for pair, w in zip(pairs, weights, strict=True):
            self.alive[pair.camera][pair.indices[w == 0, 0]] = False
        self.tracks = followed.tracks
        self.images = [old if new is None else new for old, new in zip(self.images, followed.images, strict=True)]
        self.age += 1


@dataclass(frozen=True, eq=False)
class Followed:
    """What an anchor's features look like in a frame.

    Attributes:
        anchor: whose features they are.
        rows: per camera (m,) which of the anchor's features were found.
        features: per camera, those features in the frame.
        before: per camera (m, 2) where they were in the frame before; NaN for those that were lost there.
        tracks: per camera, of all of the anchor's features.
        images: per camera the frame's, grey, or None.
    """

    anchor: Anchor
    rows: tuple[IntArray, ...]
    features: tuple[Features, ...]
    before: tuple[FloatArray, ...]
    tracks: list[Tracks]
    images: list[Image | None]

    def __len__(self) -> int:
        return sum(len(rows) for rows in self.rows)

    def pairs(self) -> list[Pair]:
        """Their matches with the anchor; in the frame they are the first features of each camera."""
        anchor, found = self.anchor.reference, []
        for c, (rows, b) in enumerate(zip(self.rows, self.features, strict=True)):
            if len(rows):
                a = anchor.features[c]
                indices = np.column_stack([rows, np.arange(len(rows))])
                found.append(Pair(c, anchor, indices, a.pixels[rows], b.pixels, a.normalized[rows], b.normalized))
        return found


def begin_anchor(current: Reference, images: Images, before: Followed | None) -> Anchor:
    """Makes a solved frame an anchor.

    Args:
        images: the frame's, per camera.
        before: what was followed up to it: the first features of each of its cameras. They keep their patches.
    """
    greys = _greys(images) if before is None else before.images
    tracks = []
    for c, (features, image) in enumerate(zip(current.features, greys, strict=True)):
        known = 0 if before is None else len(before.rows[c])
        if image is None:
            image = np.zeros((1, 1), np.uint8)  # where nothing can be begun
        new = begin(image, features.pixels[known:])
        tracks.append(new if before is None else before.tracks[c].subset(before.rows[c]).join(new))
    carried = [0] * len(tracks) if before is None else [len(rows) for rows in before.rows]
    alive = [_some(t.followed, n) for t, n in zip(tracks, carried, strict=True)]
    return Anchor(current, tracks, alive, greys)


def _greys(images: Images) -> list[Image | None]:
    return [None if image is None else grey(image) for image in images]


def _some(followed: BoolArray, known: int) -> BoolArray:
    """(n,) the features that will be followed: the first `known`, and of the others some from all over the list."""
    new = known + np.flatnonzero(followed[known:])
    wanted = max(FOLLOWED - known, MIN_NEW)
    some = followed.copy()
    some[known:] = False
    some[new if len(new) <= wanted else new[np.arange(wanted) * len(new) // wanted]] = True
    return some


def follow(
    anchor: Anchor,
    rig: Rig,
    last: RigidTransform,
    ahead: RigidTransform,
    images: Images,
    masks: Sequence[BoolArray | None],
    radius: float,
    pool: Executor,
) -> Followed:
    """Looks for an anchor's features in the next images.

    Args:
        last, ahead: world_from_object, of the images they were last followed to and as predicted for these.
        images: the frame's, per camera; masks: (h, w), True on the object.
        radius: of the object.
        pool: one job per camera.
    """

    def run(c: int) -> tuple[IntArray, Features, Tracks]:
        camera, image, before, tracks = rig.cameras[c], greys[c], anchor.images[c], anchor.tracks[c]
        if image is None or before is None or not anchor.alive[c].any():
            return np.empty(0, np.int64), Features.none(), tracks
        landmarks = anchor.reference.landmarks[c]
        expected, was = (camera.project(pose.apply(landmarks.mean)) for pose in (ahead, last))
        # Where a feature was is known better than where its landmark's image was; that tells only how it moves.
        guess = np.where(tracks.followed[:, None], tracks.pixels + expected - was, expected)
        guess[~(tracks.followed | (landmarks.depth_sd < KNOWN_DEPTH * radius)) | ~anchor.alive[c]] = np.nan
        tracks = advance(tracks.keep(anchor.alive[c]), before, image, guess)
        rows = np.flatnonzero(tracks.followed)
        mask = masks[c]
        if mask is not None:
            column, row = np.round(tracks.pixels[rows]).astype(np.int64).T
            rows = rows[mask[row, column]]
        pixels = tracks.pixels[rows]
        features = Features(pixels, camera.normalize(pixels), anchor.reference.features[c].descriptors[rows])
        return rows, features, tracks

    greys = _greys(images)
    was_at = [tracks.pixels for tracks in anchor.tracks]
    found = list(pool.map(run, range(len(rig))))
    before = tuple(pixels[f[0]] for pixels, f in zip(was_at, found, strict=True))
    rows, features = tuple(f[0] for f in found), tuple(f[1] for f in found)
    return Followed(anchor, rows, features, before, [f[2] for f in found], greys)


def with_new(followed: Followed, detected: Sequence[Features], known: Sequence[BoolArray]) -> tuple[Features, ...]:
    """Per camera the followed features, then some of the detected ones that are not near to any of them.

    Args:
        known: per camera (n,), which of the detected ones are known to be background.
    """
    merged = []
    for a, b, background in zip(followed.features, detected, known, strict=True):
        b = b.subset(~background)
        if len(a) and len(b):
            b = b.subset(cKDTree(a.pixels).query(b.pixels)[0] > SAME_PX)
        wanted = max(FEATURES - len(a), MIN_NEW)
        if len(b) > wanted:
            b = b.subset(np.arange(wanted) * len(b) // wanted)
        merged.append(
            Features(
                np.concatenate([a.pixels, b.pixels]),
                np.concatenate([a.normalized, b.normalized]),
                np.concatenate([a.descriptors, b.descriptors]),
            )
        )
    return tuple(merged)
