"""The KLT front end: an anchor frame's features, followed from image to image until too few of them are left.

SIFT finds the features of an anchor and matches them with the keyframes; in the frames between two anchors they are only
followed, which takes a tenth of the time and places them better (`features.klt`). The next anchor goes on with those that
are still followed and adds new ones beside them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import RigidTransform

from sylpose.features.klt import Tracks, advance, begin, grey
from sylpose.features.sift import Features
from sylpose.geometry.arrays import BoolArray, FloatArray, Image, IntArray
from sylpose.geometry.future import Later
from sylpose.geometry.rigid import turn_between
from sylpose.rig import Camera
from sylpose.tracking.frame import CameraFrame, Pair, SolvedFrame
from sylpose.tracking.reports import Following

__all__ = ["Anchor", "CameraAnchor", "Followed", "Renewal", "begin_anchor", "follow", "some_of", "suffices", "with_new"]


# Features per camera that an anchor has in all, if there are so many (keyframes are anchors, and are searched by them), and
# how many are followed of them; how many of these are new at least (choice).
FEATURES, FOLLOWED, MIN_NEW = 350, 170, 40
# A new feature this near to one that is followed, pixels, is the same (choice).
SAME_PX = 4.0
# Features that were lost on the way are looked for again where their depth is known to this share of the object's
# radius (choice).
KNOWN_DEPTH = 0.1
# What of an anchor's features must still be seen: these shares of them, in all and in each camera, and so many in all, while
# the object has turned by less than this (radians) since (choice).
ANCHOR_SHARE, CAMERA_SHARE, MIN_FOLLOWED, ANCHOR_TURN = 0.4, 0.25, 60, np.radians(30.0)
# The next anchor is prepared where these shares, times this, are no longer seen, or the turn is more than that over
# this (choice).
SOON = 1.5
# Frames until a camera in which no feature was followed is searched again (choice).
ASK_AGAIN = 8
# An anchor with few features, when more could be followed, lasts for so many frames: by then it shows which of these
# move with the object (choice).
FEW_LAST = 2


@dataclass(frozen=True, eq=False)
class Anchor:
    """A frame whose features are followed: what all cameras know of it.

    Attributes:
        frame: its landmarks learn what the followed features show.
        age: number of frames that were solved by its features alone.
        few: whether it was begun right after the first frame in boxes, when nobody knew of what is new in them what it is.
    """

    frame: SolvedFrame
    age: int = 0
    few: bool = False


@dataclass(frozen=True, eq=False)
class CameraAnchor:
    """One camera's side of it: its features, as far as they have been followed.

    Attributes:
        number: of the anchor's frame; frame: what the camera has of it.
        tracks: a row for each of the frame's features.
        alive: (n,) False for features that turned out not to be on the object.
        image: the last one, grey; None before the camera's first.
    """

    number: int
    frame: CameraFrame
    tracks: Tracks
    alive: BoolArray
    image: Image | None


@dataclass(frozen=True, eq=False)
class Followed:
    """What an anchor's features look like in a camera's image.

    Attributes:
        anchor: whose features they are.
        rows: (m,) which of the anchor's features were found.
        features: those, in the frame.
        before: (m, 2) where they were in the frame before; NaN for those that were lost there.
        tracks: of all of the anchor's features.
        image: the frame's, grey, or None.
    """

    anchor: CameraAnchor
    rows: IntArray
    features: Features
    before: FloatArray
    tracks: Tracks
    image: Image | None

    def __len__(self) -> int:
        return len(self.rows)

    def pair(self) -> Pair:
        """Their matches with the anchor; in the frame they are the camera's first features."""
        indices = np.column_stack([self.rows, np.arange(len(self.rows))])
        return Pair.of(self.anchor.number, self.anchor.frame, self.features, indices)

    def report(self, region: FloatArray | None) -> Following:
        """What `suffices` asks of each camera, given the object's region in its image, None where it is out of sight."""
        looks = self.image is not None and region is not None
        return Following(len(self), int(self.anchor.alive.sum()), looks, self.anchor.image is not None)


@dataclass(frozen=True, eq=False)
class Renewal:
    """One camera's side of the next anchor, while it is prepared (`tracking.anchor_preparation`).

    Attributes:
        number: of its frame; image: its, grey.
        camera: as it stood for it.
        known: how many features of it were followed; rows: (known,) which of the features of the anchor before they are.
        found: the new ones, and their matches (m, 2) with earlier frames, by number.
    """

    number: int
    image: Image
    camera: Camera
    known: int
    rows: IntArray
    found: Later[tuple[Features, dict[int, IntArray]]]


def suffices(reports: Sequence[Following], anchor: Anchor, ahead: RigidTransform, margin: float = 1.0) -> bool:
    """Whether enough of an anchor's features are still seen to do without new ones.

    Args:
        ahead: world_from_object as predicted for the frame.
        margin: by how much they have to be more than enough.
    """
    turn = np.linalg.norm(turn_between(anchor.frame.world_from_object, ahead))
    found, alive = np.array([r.found for r in reports]), np.array([r.alive for r in reports])
    shares = margin * np.array([ANCHOR_SHARE, CAMERA_SHARE])
    enough = found.sum() >= max(shares[0] * alive.sum(), MIN_FOLLOWED) and (found >= shares[1] * alive).all()
    for r in reports:
        # A camera that gives images again takes part at once; one that saw nothing is asked again after a while.
        enough &= not (r.looks and not r.follows)
        enough &= not (r.looks and r.alive == 0 and anchor.age >= ASK_AGAIN)
    lasts = not (anchor.few and anchor.age >= FEW_LAST)
    return bool(enough and lasts and turn < ANCHOR_TURN / margin)


def begin_anchor(number: int, current: CameraFrame, image: Image | None, before: Followed | None) -> CameraAnchor:
    """Makes a solved frame an anchor.

    Args:
        image: the frame's.
        before: what was followed up to it: the camera's first features. They keep their patches.
    """
    image = _grey(image) if before is None else before.image
    known = 0 if before is None else len(before)
    # Without an image nothing can be begun.
    new = begin(np.zeros((1, 1), np.uint8) if image is None else image, current.features.pixels[known:])
    tracks = new if before is None else before.tracks.subset(before.rows).join(new)
    return CameraAnchor(number, current, tracks, some_of(tracks.followed & ~current.background, known), image)


def _grey(image: Image | None) -> Image | None:
    return None if image is None else grey(image)


def some_of(followed: BoolArray, known: int) -> BoolArray:
    """(n,) the features that will be followed: the first `known`, and of the others some from all over the list."""
    new = known + np.flatnonzero(followed[known:])
    wanted = max(FOLLOWED - known, MIN_NEW)
    some = followed.copy()
    some[known:] = False
    some[new if len(new) <= wanted else new[np.arange(wanted) * len(new) // wanted]] = True
    return some


def gone_on(followed: Followed, pairs: Sequence[Pair], weights: Sequence[FloatArray]) -> CameraAnchor:
    """The anchor after a frame that was solved by its features alone: what did not agree there is not on the object."""
    anchor, alive = followed.anchor, followed.anchor.alive.copy()
    for pair, w in zip(pairs, weights, strict=True):
        alive[pair.indices[w == 0, 0]] = False
    image = anchor.image if followed.image is None else followed.image
    return CameraAnchor(anchor.number, anchor.frame, followed.tracks, alive, image)


def follow(
    anchor: CameraAnchor,
    camera: Camera,
    last: RigidTransform,
    ahead: RigidTransform,
    image: Image | None,
    mask: BoolArray | None,
    radius: float,
) -> Followed:
    """Looks for an anchor's features in the camera's next image.

    Args:
        last, ahead: world_from_object, of the image they were last followed to and as predicted for this.
        image: the frame's; mask: (h, w), True on the object.
        radius: of the object.
    """
    image, tracks = _grey(image), anchor.tracks
    if image is None or anchor.image is None or not anchor.alive.any():
        return Followed(anchor, np.empty(0, np.int64), Features.none(), np.empty((0, 2)), tracks, image)
    guess, alive = np.full((len(tracks), 2), np.nan), np.flatnonzero(anchor.alive)
    landmarks, followed = anchor.frame.table.of(anchor.frame.numbers[alive]), tracks.followed[alive]
    expected, was = (camera.project(pose.apply(landmarks.mean)) for pose in (ahead, last))
    # Where a feature was is known better than where its landmark's image was; that tells only how it moves.
    guess[alive] = np.where(followed[:, None], tracks.pixels[alive] + expected - was, expected)
    lost = np.flatnonzero(~followed)
    guess[alive[lost[landmarks.subset(lost).depth_sd >= KNOWN_DEPTH * radius]]] = np.nan
    tracks = advance(tracks.keep(anchor.alive), anchor.image, image, guess)
    rows = np.flatnonzero(tracks.followed)
    if mask is not None:
        column, row = np.round(tracks.pixels[rows]).astype(np.int64).T
        rows = rows[mask[row, column]]
    pixels = tracks.pixels[rows]
    old = anchor.frame.features
    features = Features(pixels, camera.normalize_to_grid(pixels), old.descriptors[rows], old.faint[rows])
    return Followed(anchor, rows, features, anchor.tracks.pixels[rows], tracks, image)


def with_new(followed: Followed, detected: Features, background: BoolArray, most: int = FEATURES) -> Features:
    """The followed features, then some of the detected ones that are not near to any of them.

    Args:
        background: (n,), which of the detected ones are known to be background.
        most: so many in all, but `MIN_NEW` detected ones at least.
    """
    a, b = followed.features, detected.subset(~background)
    if len(a) and len(b):
        b = b.subset(cKDTree(a.pixels).query(b.pixels)[0] > SAME_PX)
    wanted = max(most - len(a), MIN_NEW)
    if len(b) > wanted:
        b = b.subset(np.arange(wanted) * len(b) // wanted)
    return Features.concatenate([a, b])
