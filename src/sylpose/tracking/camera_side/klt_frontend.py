"""KLT front end: tracks an anchor frame's features from image to image.

SIFT detects the anchor's features and matches them with the keyframes. Frames between two anchors only track them,
which takes a tenth of the time and is more precise (`features.klt`). The next anchor keeps the surviving tracks and
adds new features.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import RigidTransform

from sylpose.features.klt import Tracks, start_tracks, to_gray, track_features
from sylpose.features.sift import Features
from sylpose.geometry.arrays import BoolArray, FloatArray, Image, IntArray
from sylpose.geometry.future import BackgroundResult
from sylpose.rig import Camera
from sylpose.tracking.camera_side.frame import CameraFrame, FrameMatches
from sylpose.tracking.reports import TrackingReport

# Features per camera of an anchor (they are also used for matching, as anchors become keyframes); how many of them are
# tracked; minimum number of new ones among those (choice).
N_ANCHOR_FEATURES, MAX_TRACKED, MIN_NEW_FEATURES = 350, 170, 40
# A new feature closer than this to a tracked one, pixels, is the same (choice).
DUPLICATE_PX = 4.0
# Lost features are searched again where their depth is known to this share of the object's radius (choice).
MAX_DEPTH_SD_RATIO = 0.1


@dataclass(frozen=True, eq=False)
class CameraAnchor:
    """One camera's side of an anchor: the tracks of its features.

    Attributes:
        number: of the anchor's frame.
        frame: the camera's data of it.
        tracks: one row per feature of the frame.
        is_alive: (n,) False for features found not to be on the object.
        image: the last one, grayscale; None before the camera's first.
    """

    number: int
    frame: CameraFrame
    tracks: Tracks
    is_alive: BoolArray
    image: Image | None


@dataclass(frozen=True, eq=False)
class TrackedFeatures:
    """An anchor's features tracked in a camera's image.

    Attributes:
        anchor: the camera's anchor.
        rows: (m,) indices of the anchor's features that were found.
        features: these features, in the frame.
        previous_pixels: (m, 2) their pixels in the previous frame; NaN for those that were lost there.
        tracks: of all of the anchor's features.
        image: the frame's, grayscale, or None.
    """

    anchor: CameraAnchor
    rows: IntArray
    features: Features
    previous_pixels: FloatArray
    tracks: Tracks
    image: Image | None

    def __len__(self) -> int:
        return len(self.rows)

    def match_with_anchor(self) -> FrameMatches:
        """Return the matches with the anchor; tracked features come first in the frame."""
        indices = np.column_stack([self.rows, np.arange(len(self.rows))])
        return FrameMatches.from_indices(self.anchor.number, self.anchor.frame, self.features, indices)

    def create_report(self, region: FloatArray | None) -> TrackingReport:
        """Create the camera's report for `has_enough_tracks`.

        Args:
            region: (k, 2) the object's outline in the image, None if out of view.
        """
        expects_object = self.image is not None and region is not None
        return TrackingReport(len(self), int(self.anchor.is_alive.sum()), expects_object, self.anchor.image is not None)


@dataclass(frozen=True, eq=False)
class NextAnchor:
    """One camera's side of the next anchor, while it is prepared (`tracking.anchor_preparation`).

    Attributes:
        number: of its frame.
        image: its image, grayscale.
        camera: with its pose at that frame.
        n_tracked: number of its features that are tracked.
        rows: (n_tracked,) their indices in the previous anchor.
        result: the new features and their matches (m, 2) with earlier frames, by number.
    """

    number: int
    image: Image
    camera: Camera
    n_tracked: int
    rows: IntArray
    result: BackgroundResult[tuple[Features, dict[int, IntArray]]]


def create_anchor(
    number: int, current: CameraFrame, image: Image | None, tracked: TrackedFeatures | None
) -> CameraAnchor:
    """Create a camera's anchor from a solved frame.

    Args:
        image: the frame's.
        tracked: features tracked up to it: the camera's first features. They keep their patches.
    """
    image = _to_grayscale(image) if tracked is None else tracked.image
    known = 0 if tracked is None else len(tracked)
    # Without an image no tracks can be started.
    new = start_tracks(np.zeros((1, 1), np.uint8) if image is None else image, current.features.pixels[known:])
    tracks = new if tracked is None else tracked.tracks.subset(tracked.rows).concatenate(new)
    return CameraAnchor(number, current, tracks, select_tracked(tracks.tracked & ~current.background, known), image)


def _to_grayscale(image: Image | None) -> Image | None:
    return None if image is None else to_gray(image)


def select_tracked(tracked: BoolArray, n_tracked: int) -> BoolArray:
    """Select features (n,) to track: the first `n_tracked`, and some of the others spread over the list."""
    new = n_tracked + np.flatnonzero(tracked[n_tracked:])
    n_wanted = max(MAX_TRACKED - n_tracked, MIN_NEW_FEATURES)
    is_selected = tracked.copy()
    is_selected[n_tracked:] = False
    is_selected[new if len(new) <= n_wanted else new[np.arange(n_wanted) * len(new) // n_wanted]] = True
    return is_selected


def advance_anchor(
    tracked: TrackedFeatures, pairs: Sequence[FrameMatches], weights: Sequence[FloatArray]
) -> CameraAnchor:
    """Return the anchor after a frame solved by its features alone: outliers are dropped."""
    anchor, alive = tracked.anchor, tracked.anchor.is_alive.copy()
    for pair, w in zip(pairs, weights, strict=True):
        alive[pair.indices[w == 0, 0]] = False
    image = anchor.image if tracked.image is None else tracked.image
    return CameraAnchor(anchor.number, anchor.frame, tracked.tracks, alive, image)


def track_anchor(
    anchor: CameraAnchor,
    camera: Camera,
    last_pose: RigidTransform,
    predicted_pose: RigidTransform,
    image: Image | None,
    mask: BoolArray | None,
    radius: float,
) -> TrackedFeatures:
    """Track an anchor's features in the camera's next image.

    Args:
        last_pose: world_from_object of the last image with tracks.
        predicted_pose: predicted world_from_object.
        image: the frame's.
        mask: (h, w), True on the object.
        radius: of the object.
    """
    image, tracks = _to_grayscale(image), anchor.tracks
    if image is None or anchor.image is None or not anchor.is_alive.any():
        return TrackedFeatures(anchor, np.empty(0, np.int64), Features.empty(), np.empty((0, 2)), tracks, image)
    guess, alive = np.full((len(tracks), 2), np.nan), np.flatnonzero(anchor.is_alive)
    landmarks, tracked = anchor.frame.table.get(anchor.frame.landmark_ids[alive]), tracks.tracked[alive]
    expected, last_pixels = (camera.project(pose.apply(landmarks.mean)) for pose in (predicted_pose, last_pose))
    # A feature's last pixel is known better than its landmark's projection; the projection gives the expected motion
    # only.
    guess[alive] = np.where(tracked[:, None], tracks.pixels[alive] + expected - last_pixels, expected)
    lost = np.flatnonzero(~tracked)
    guess[alive[lost[landmarks.subset(lost).depth_sd >= MAX_DEPTH_SD_RATIO * radius]]] = np.nan
    tracks = track_features(tracks.keep(anchor.is_alive), anchor.image, image, guess)
    rows = np.flatnonzero(tracks.tracked)
    if mask is not None:
        column, row = np.round(tracks.pixels[rows]).astype(np.int64).T
        rows = rows[mask[row, column]]
    pixels = tracks.pixels[rows]
    old = anchor.frame.features
    features = Features(pixels, camera.normalize_to_grid(pixels), old.descriptors[rows], old.faint[rows])
    return TrackedFeatures(anchor, rows, features, anchor.tracks.pixels[rows], tracks, image)


def append_new_features(
    tracked: TrackedFeatures, detected: Features, background: BoolArray, max_features: int = N_ANCHOR_FEATURES
) -> Features:
    """Append detected features that are not near tracked ones.

    Args:
        background: (n,) which detected features are known to be background.
        max_features: maximum total number, but at least `MIN_NEW_FEATURES` detected features are added.
    """
    a, b = tracked.features, detected.subset(~background)
    if len(a) and len(b):
        b = b.subset(cKDTree(a.pixels).query(b.pixels)[0] > DUPLICATE_PX)
    n_wanted = max(max_features - len(a), MIN_NEW_FEATURES)
    if len(b) > n_wanted:
        b = b.subset(np.arange(n_wanted) * len(b) // n_wanted)
    return Features.concatenate([a, b])
