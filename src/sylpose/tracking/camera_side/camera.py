"""Tracker of one camera: feature detection in its own images and its memory of the object.

Its inputs are shared by all cameras (a pose, the object's radius, frame numbers). It has no access to other cameras'
data and sends them only `reports`.

KLT front end: SIFT detects the features of an anchor frame and matches them with the keyframes. Frames between two
anchors only track them, which takes a tenth of the time and is more precise (`features.klt`). The next anchor keeps the
surviving tracks and adds new features.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import RigidTransform

from sylpose.features.klt import Tracks, start_tracks, to_gray, track_features
from sylpose.features.patches import estimate_noise_variance, find_replaced, sample_patches
from sylpose.features.search_windows import SearchWindows
from sylpose.features.sift import (
    FULL_RESOLUTION,
    MAX_FAINT_FEATURES,
    MAX_FEATURES,
    Features,
    detect_features,
    find_static_features,
    match_features,
)
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import BoolArray, FloatArray, Image, IntArray
from sylpose.geometry.future import BackgroundResult
from sylpose.geometry.matrices import essential_matrix, rotation_matrix_of, sampson_distance
from sylpose.landmarks.landmark_filter import (
    KNOWN_DEPTH_RATIO,
    DepthPrior,
    Landmarks,
    LandmarkTable,
    create_landmarks,
    update_landmarks,
)
from sylpose.matches import STATIC_PX
from sylpose.relative_pose.camera_evidence import CameraEvidence, compare_motions
from sylpose.rig import Camera, Rig
from sylpose.tracking.camera_side.camera_motion import CameraMotionDetector, View
from sylpose.tracking.camera_side.frame import (
    PREDICTED_RADIUS,
    SOLVED_RADIUS,
    CameraFrame,
    DetectedFeatures,
    FrameMatches,
    LandmarkObservations,
    MatchWeights,
    Pairs,
    Region,
    ReobservedFeatures,
    SearchArea,
    collect_detected_features,
    collect_features,
    compute_keypoint_static_px,
    drop_background,
    find_background,
    mark_background,
    match_frames,
    match_near_pose,
    omit_empty,
    rasterize_outline,
    record_observations,
    select_shown_matches,
)
from sylpose.tracking.joint_side.joint_state import AVERAGING_FRAMES, KnownMotion, SolvedFrame
from sylpose.tracking.joint_side.object_model import MIN_SURFACE_POINTS, ObjectModel
from sylpose.tracking.reports import PoseAgreement, TrackingReport

# Maximum number of remembered background features: as many as `detect_surroundings` may find, in the whole of a large image
# and near the object (derived).
MAX_BACKGROUND_FEATURES = 2 * MAX_FAINT_FEATURES
# Offsets at which matches occur by chance only, in search radii of a solved pose: in each direction the nearest one whose
# search area is outside of that of a predicted pose, to whose matches a wrong pose may have been fitted (derived).
CHANCE_OFFSETS = (1.0 + PREDICTED_RADIUS / SOLVED_RADIUS) * np.array([(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)])
# Larger images than Full HD are downscaled where the whole image is searched; detection is repeated at full resolution
# where something was found (choice).
MAX_SEARCH_PIXELS = 1920 * 1080
# The surroundings of the object's outline are searched up to so many times its size (choice).
SURROUNDINGS_SCALE = 2.0
# Features per camera of an anchor (they are also used for matching, as anchors become keyframes); how many of them are
# tracked; minimum number of new ones among those (choice).
MAX_TRACKED, MIN_NEW_FEATURES = 170, 40
# A new feature closer than this to a tracked one, pixels, is the same (choice).
MIN_TRACK_DISTANCE_PX = 4.0


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


def advance_anchor(tracked: TrackedFeatures, pairs: Pairs, weights: Sequence[FloatArray]) -> CameraAnchor:
    """Return the anchor after a frame solved by its features alone: outliers are dropped."""
    anchor, alive = tracked.anchor, tracked.anchor.is_alive.copy()
    for pair, w in zip(pairs, weights, strict=True):
        alive[pair.indices[w == 0, 0]] = False
    image = anchor.image if tracked.image is None else tracked.image
    return CameraAnchor(anchor.number, anchor.frame, tracked.tracks, alive, image)


def track_anchor(
    anchor: CameraAnchor, camera: Camera, view: View, poses: tuple[RigidTransform, RigidTransform], radius: float
) -> TrackedFeatures:
    """Track an anchor's features in the camera's next image.

    Args:
        view: image and mask of the frame.
        poses: world_from_object of the last image with tracks, and the predicted one.
        radius: of the object.
    """
    image, mask = view
    tracks, alive = anchor.tracks, np.flatnonzero(anchor.is_alive)
    if image is None or anchor.image is None or not len(alive):
        nothing = np.empty(0, np.int64), Features.empty(), np.empty((0, 2))
        return TrackedFeatures(anchor, *nothing, tracks, _to_grayscale(image))
    landmarks, tracked = anchor.frame.table.get(anchor.frame.landmark_ids[alive]), tracks.tracked[alive]
    last_pixels, expected = (camera.project(pose.apply(landmarks.mean)) for pose in poses)
    lost = np.flatnonzero(~tracked)
    is_uncertain = landmarks.subset(lost).depth_sd >= KNOWN_DEPTH_RATIO * radius
    # A feature's last pixel is known better than its landmark's projection; the projection gives the expected motion
    # only.
    image, guess = to_gray(image), np.full((len(tracks), 2), np.nan)
    guess[alive] = np.where(tracked[:, None], tracks.pixels[alive] + expected - last_pixels, expected)
    guess[alive[lost[is_uncertain]]] = np.nan
    tracks = track_features(tracks.keep(anchor.is_alive), anchor.image, image, guess)
    rows = np.flatnonzero(tracks.tracked)
    if mask is not None:
        column, row = np.round(tracks.pixels[rows]).astype(np.int64).T
        rows = rows[mask[row, column]]
    pixels = tracks.pixels[rows]
    old = anchor.frame.features
    patches = sample_patches(image, pixels, FULL_RESOLUTION, np.zeros(2))
    features = Features(pixels, camera.normalize_to_grid(pixels), old.descriptors[rows], old.faint[rows], patches)
    return TrackedFeatures(anchor, rows, features, anchor.tracks.pixels[rows], tracks, image)


def append_new_features(
    tracked: TrackedFeatures, detected: Features, background: BoolArray, max_features: int
) -> Features:
    """Append detected features that are not near tracked ones.

    Args:
        background: (n,) which detected features are known to be background.
        max_features: maximum total number, but at least `MIN_NEW_FEATURES` detected features are added.
    """
    a, b = tracked.features, detected.subset(~background)
    if len(a) and len(b):
        b = b.subset(cKDTree(a.pixels).query(b.pixels)[0] > MIN_TRACK_DISTANCE_PX)
    n_wanted = max(max_features - len(a), MIN_NEW_FEATURES)
    if len(b) > n_wanted:
        b = b.subset(np.arange(n_wanted) * len(b) // n_wanted)
    return Features.concatenate([a, b])


def _make_depth_prior(surface: FloatArray, model: ObjectModel) -> DepthPrior:
    """Make the prior of new features from points (n, 3) on the surface, or the model's while they are few."""
    return DepthPrior(surface if len(surface) >= MIN_SURFACE_POINTS else model.points, model.radius)


@dataclass(frozen=True, eq=False)
class CameraSolution:
    """One camera's part of a candidate pose.

    Attributes:
        current: its data of the frame.
        pairs: its matches with earlier frames.
        weights: weights and residuals of the matches.
        tracked: its tracked features, which come first in the frame; None without KLT.
        first_landmarks: landmarks of the first frame, where this frame improves them.
    """

    current: CameraFrame
    pairs: Pairs
    weights: MatchWeights
    tracked: TrackedFeatures | None
    first_landmarks: Landmarks | None


@dataclass(frozen=True, eq=False)
class AcceptedPose:
    """An accepted pose, with which every camera updates its memory of the object.

    Attributes:
        solved: the frame.
        images: its images.
        rig: the cameras with their poses at this frame.
        motion: motion of the object from the solved frames before it.
        last_number: number of the last solved frame before it.
        agreements: per camera of the rig, how its matches agree with the pose.
        has_moved: whether the object has been observed to move. Until then all features may be background, and would follow
            a slowly moving object halfway.
        is_uncertain: whether landmarks learned from the pose would remain wrong.
        has_new_features: whether the frame has newly detected features.
    """

    solved: SolvedFrame
    images: FrameSet
    rig: Rig
    motion: KnownMotion
    last_number: int
    agreements: Sequence[PoseAgreement]
    has_moved: bool
    is_uncertain: bool
    has_new_features: bool

    @property
    def updates_map(self) -> bool:
        """Whether landmarks and background are updated."""
        return self.has_moved and not self.is_uncertain


class CameraRecord(NamedTuple):
    """One camera's part of a frame's result, see `TrackedFrame`."""

    matches: tuple[FloatArray, FloatArray] | None
    observations: LandmarkObservations
    detections: DetectedFeatures


class CameraTracker:
    """Tracker state of one camera.

    Attributes:
        index: in the rig.
        camera: its calibration.
        table: its landmarks.
        frames: its data of solved frames, by number: the keyframes, the last frame and the anchor.
        anchor: its tracks of the anchor frame, if any.
        next_anchor: those of the next anchor, while it is prepared.
        background_features: those outside the object's region in the first frame, and those found later. Features
            observed later at the same place are background.
        noise_px: running estimate of keypoint noise.
        view: image and mask of the last solved frame, until all features have been detected in it.
        motion_detector: detects motion of the camera itself.
        windows: those searched since the object was lost; None while it is not.
        detections: features detected in the current frame.
    """

    def __init__(self, index: int, camera: Camera) -> None:
        self.index, self.camera = index, camera
        self.motion_detector = CameraMotionDetector(camera)
        self.detections = DetectedFeatures()
        self.reset()

    def reset(self) -> None:
        """Discard everything known of the object."""
        self.frames: dict[int, CameraFrame] = {}
        self.anchor: CameraAnchor | None = None
        self.next_anchor: NextAnchor | None = None
        self.background_features = Features.empty()
        self.table = LandmarkTable()
        self.noise_px = 0.0
        self.view: View = (None, None)
        self.windows: SearchWindows | None = None

    @property
    def static_px(self) -> float:
        """Displacements below this are within the camera's keypoint noise, pixels."""
        return compute_keypoint_static_px(self.noise_px)

    @property
    def is_large(self) -> bool:
        """Whether the camera's images are downscaled for searching."""
        width, height = self.camera.size
        return width * height > MAX_SEARCH_PIXELS

    @property
    def has_observations(self) -> bool:
        """Whether it has observations by which it could recognize the object."""
        return any(len(frame.features) for frame in self.frames.values())

    def list_immutable(self) -> list[object]:
        """List the objects of its state that are never modified."""
        anchor, watch = self.anchor, self.motion_detector
        of_anchor = () if anchor is None else (anchor.tracks, anchor.image, anchor.frame.features)
        features = (self.background_features, *(frame.features for frame in self.frames.values()))
        return [
            self.camera,
            self.view,
            self.windows,
            self.next_anchor,
            watch.background,
            watch.stabilizer,
            *of_anchor,
            *features,
        ]

    # --- detection: state is not changed ------------------------------------------------------------------------------

    def view_of(self, images: FrameSet) -> View:
        """Return its image and mask of a frame."""
        return images.images[self.index], images.masks[self.index]

    def detect(
        self,
        view: View,
        area: BoolArray | None,
        max_features: int = MAX_FEATURES,
        *,
        faint: bool = False,
        max_pixels: int | None = None,
    ) -> Features:
        """Detect features inside an area and the object's mask.

        Args:
            view: image and mask; the image may be reduced if there are neither mask nor area (`reduce_image`).
            area: (h, w) area; None: the whole image.
            max_features: maximum number of features, the strongest.
            faint: whether to keep low-contrast features and ignore `max_features`.
            max_pixels: larger areas are downscaled; None for full resolution.
        """
        image, mask = view
        if image is None:
            return Features.empty()
        if mask is not None:
            area = mask if area is None else area & mask
        max_features = MAX_FAINT_FEATURES if faint else max_features
        step = self.camera.size / np.array(image.shape[1::-1])
        return detect_features(image, self.camera, area, max_features, faint=faint, max_pixels=max_pixels, step=step)

    def detect_in(
        self, region: Region, images: FrameSet, max_features: int, *, faint: bool, max_pixels: int | None = None
    ) -> Features:
        """Detect features inside a region. See `detect`."""
        area = self.rasterize(region)
        return self.detect(self.view_of(images), area, max_features, faint=faint, max_pixels=max_pixels)

    def search_window(self, side_px: float, images: FrameSet, *, oldest: bool, max_pixels: int) -> Features:
        """Detect all features in one window of the image, the next one in which a lost object is searched for.

        Args:
            side_px: side of the windows, pixels; later calls until the object is found keep that of the first.
            oldest, max_pixels: see `SearchWindows.select` and `detect`.
        """
        image, mask = self.view_of(images)
        if image is None:
            return Features.empty()
        if self.windows is None:
            # Changes count from the last image with the object on.
            self.windows = SearchWindows.create(side_px, image if self.view[0] is None else self.view[0])
        self.windows, area = self.windows.select(image, oldest=oldest)
        return self.detect((image, mask), area, faint=True, max_pixels=max_pixels)

    def detect_at_full_res(self, features: Features, region: Region, images: FrameSet, *, faint: bool) -> Features:
        """Return the features inside a region, detected at full resolution.

        Args:
            features: of the whole image; used as they are unless the image was searched downscaled.
        """
        if images.images[self.index] is None or not self.is_large:
            return features.subset(self.find_inside(features, region))
        return self.detect(self.view_of(images), self.rasterize(region), faint=faint)

    def split_foreground(
        self, features: Features, region: Region, is_static: BoolArray, images: FrameSet
    ) -> tuple[Features, Features]:
        """Split a whole image's features into possible object features and background.

        Args:
            region: of the object.
            is_static: (n,) which features are known to be static.

        Returns:
            features inside the region that may be the object's; all others.
        """
        is_foreground = self.find_inside(features, region) & ~is_static
        if images.images[self.index] is None or not self.is_large:
            return features.subset(is_foreground), features.subset(~is_foreground)
        detected = self.detect_at_full_res(features, region, images, faint=False)
        is_background = find_static_features(detected, features.subset(is_static), self.static_px)
        around = [features.subset(~is_foreground), detected.subset(is_background)]
        return detected.subset(~is_background), Features.concatenate(around)

    def detect_surroundings(self, region: Region, images: FrameSet, *, faint: bool) -> Features:
        """Detect features outside a region; in large images at full resolution near it."""
        area, view = ~self.rasterize(region), self.view_of(images)
        detected = self.detect(view, area, faint=faint, max_pixels=MAX_SEARCH_PIXELS)
        if region is None or not self.is_large:
            return detected
        middle = region.mean(axis=0)
        near_area = area & self.rasterize(middle + SURROUNDINGS_SCALE * (region - middle))
        return Features.concatenate([detected, self.detect(view, near_area, faint=faint, max_pixels=MAX_SEARCH_PIXELS)])

    def rasterize(self, region: Region) -> BoolArray:
        """Return a region's area (h, w)."""
        return rasterize_outline(region, self.camera.size)

    def find_inside(self, features: Features, region: Region) -> BoolArray:
        """Return which features (n,) are inside a region."""
        row, column = np.round(features.pixels).astype(np.int64).T[::-1]
        return np.asarray(self.rasterize(region)[row, column])

    def create_frame(self, features: Features) -> CameraFrame:
        """Create a frame to be solved; features at the place of known background are marked."""
        return CameraFrame(features, self.find_known_background(features), self.table, noise_px=self.noise_px)

    def create_empty_frame(self) -> CameraFrame:
        """Create a frame without features."""
        return self.create_frame(Features.empty())

    def find_known_background(self, features: Features) -> BoolArray:
        """Return which features (n,) coincide with known background."""
        return find_static_features(features, self.background_features, self.static_px)

    # --- matching -----------------------------------------------------------------------------------------------------

    def begin_frame(self) -> None:
        """Clear the detected features at the start of a frame."""
        self.detections = DetectedFeatures()

    def track_anchor(
        self, images: FrameSet, poses: tuple[RigidTransform, RigidTransform], radius: float
    ) -> TrackedFeatures:
        """Track the anchor's features in the next image. See `track_anchor`."""
        assert self.anchor is not None
        return track_anchor(self.anchor, self.camera, self.view_of(images), poses, radius)

    def match(self, current: CameraFrame, references: Sequence[int]) -> list[FrameMatches]:
        """Match by descriptors with earlier frames, in the given order.

        Each pair passes its known background on to the frame, and so to the next pair.
        """
        return omit_empty([match_frames(number, self.frames[number], current) for number in references])

    def match_all(
        self,
        current: CameraFrame,
        tracked: TrackedFeatures | None,
        references: Sequence[int],
        motion: KnownMotion | None,
    ) -> list[FrameMatches]:
        """Match tracked features with the anchor and others with earlier frames; record what was detected.

        Args:
            motion: predicted motion, by which background is dropped; None while it is unknown.
        """
        pairs = [tracked.match_with_anchor()] if tracked is not None and len(tracked) else []
        pairs += self.match(current, references)
        self.detections = collect_detected_features(current.features, pairs)
        return pairs if motion is None else drop_background(pairs, current, self.camera, motion)

    def match_near(self, current: CameraFrame, references: Sequence[int], area: SearchArea) -> list[FrameMatches]:
        """Match with landmarks of earlier frames near their projections. See `match_near_pose`."""
        return omit_empty(match_near_pose(n, self.frames[n], current, self.camera, area) for n in references)

    def count_supporting_features(
        self, current: CameraFrame, references: Sequence[int], area: SearchArea
    ) -> tuple[int, float]:
        """Count features that match landmarks near their projections, and those that match by chance.

        Returns:
            number of features near the projections; mean number at offset places.
        """
        offsets = ((0.0, 0.0), *((dx * area.radius_px, dy * area.radius_px) for dx, dy in CHANCE_OFFSETS))
        areas = [area._replace(offset_px=offset_px) for offset_px in offsets]
        near, *by_chance = (
            len(np.unique(collect_features(self.match_near(current, references, own)))) for own in areas
        )
        return near, float(np.mean(by_chance))

    def compare_surroundings(
        self, images: FrameSet, first: SolvedFrame, pose: RigidTransform
    ) -> tuple[float, CameraEvidence, float, CameraEvidence]:
        """Compare the matches with the first frame, inside and outside of the object's region there, with its motion.

        Args:
            pose: world_from_object of the images.

        Returns:
            inside, then outside: the number of matches that follow the motion, without those expected by chance, displaced
            in random directions; the evidence of the camera's own motion. Outside the number is 0 unless more stand still: a
            camera that trembles displaces all.
        """
        if first.number not in self.frames:
            return 0.0, CameraEvidence(), 0.0, CameraEvidence()
        camera_from_world = self.camera.camera_from_world
        motion = camera_from_world * pose * first.world_from_object.inv() * camera_from_world.inv()
        distance = float(np.linalg.norm(camera_from_world.apply(first.world_from_object.translation)))
        current = self.detect(self.view_of(images), None, max_pixels=MAX_SEARCH_PIXELS)
        inside, of_inside, _ = self._compare_motion(self.frames[first.number].features, current, motion, distance)
        outside, of_outside, n_static = self._compare_motion(self.background_features, current, motion, distance)
        return inside, of_inside, outside if outside < n_static else 0.0, of_outside

    def _compare_motion(
        self, earlier: Features, current: Features, motion: RigidTransform, distance: float
    ) -> tuple[float, CameraEvidence, int]:
        """Compare matches with a motion in the camera's axes.

        Args:
            distance: of the object.

        Returns:
            the number of matches that follow the motion beyond chance; the evidence of those that have moved; the number of
            those that have not.
        """
        i, j = match_features(earlier, current).T
        before_px, after_px = earlier.pixels[i], current.pixels[j]
        displacement_px = np.linalg.norm(after_px - before_px, axis=1)
        has_moved = displacement_px > self.static_px
        x, y = (self.camera.normalize(pixels[has_moved]) for pixels in (before_px, after_px))
        rotation = np.ascontiguousarray(rotation_matrix_of(motion))
        essential = essential_matrix(rotation, motion.translation)
        residual_px = self.camera.focal * np.abs(sampson_distance(essential, x, y))
        by_chance = np.arcsin(self.static_px / displacement_px[has_moved]) * (2.0 / np.pi)
        following = ((residual_px < self.static_px) - by_chance).sum()
        compared = compare_motions(x, y, self.camera.focal, rotation, motion.translation / distance, 0.0)
        return float(following), CameraEvidence(*compared), int(np.count_nonzero(~has_moved))

    def count_replaced(self, center: Region, images: FrameSet, first: SolvedFrame) -> tuple[int, int]:
        """Count the first frame's features in a region, and those at whose place the image shows something else.

        Those without texture, compared with the noise, or outside of the image's mask do not count.
        """
        image, mask = self.view_of(images)
        if image is None or center is None or first.number not in self.frames:
            return 0, 0
        gray, features, around = to_gray(image), self.frames[first.number].features, self.background_features
        features = features.subset(np.flatnonzero(self.find_inside(features, center)))
        at_features, at_others = (
            sample_patches(gray, own.pixels, FULL_RESOLUTION, np.zeros(2)) for own in (features, around)
        )
        noise_variance = estimate_noise_variance(around.patches, at_others)
        is_known, is_replaced = find_replaced(features.patches, at_features, noise_variance)
        if mask is not None:
            column, row = np.round(features.pixels).astype(np.int64).T
            is_known, is_replaced = is_known & mask[row, column], is_replaced & mask[row, column]
        return int(np.count_nonzero(is_known)), int(np.count_nonzero(is_replaced))

    # --- update after a frame is accepted -----------------------------------------------------------------------------

    def initialize(self, first: SolvedFrame, current: CameraFrame, background: Features, images: FrameSet) -> None:
        """Start with the first solved frame and the background features around the object."""
        self.frames, self.anchor, self.view = {first.number: current}, None, self.view_of(images)
        self.background_features = background

    def collect_reobserved(self, solution: CameraSolution, accepted: AcceptedPose) -> ReobservedFeatures:
        """Collect the features that were observed before, and learn background and noise."""
        if solution.first_landmarks is not None:
            self.table.update(solution.first_landmarks)
        if not accepted.has_moved:
            return ReobservedFeatures.empty()
        current = solution.current
        if not accepted.is_uncertain:
            if accepted.has_new_features:
                self.learn_background(solution.pairs, current, accepted.motion)
            self.update_noise(accepted.agreements[self.index].residual_px)
        return ReobservedFeatures.from_matches(
            solution.pairs, solution.weights, current.static_px, accepted.motion.radius
        )

    def update_map(
        self,
        solution: CameraSolution,
        reobserved: ReobservedFeatures,
        accepted: AcceptedPose,
        model: ObjectModel,
        kept: set[int],
        *,
        begins_anchor: bool,
    ) -> CameraRecord:
        """Update landmarks, frames and anchor with an accepted pose.

        Args:
            reobserved: of `collect_reobserved`.
            model: of the object.
            kept: numbers of the frames to keep.
            begins_anchor: whether the frame becomes the anchor.
        """
        number, updates_map = accepted.solved.number, accepted.updates_map
        current, tracked = solution.current if accepted.has_moved else self.create_empty_frame(), solution.tracked
        pose, weights = accepted.solved.world_from_object, [w for w, _ in solution.weights]
        if tracked is not None and not accepted.has_new_features:
            # Until the object has moved, disagreeing features may be the object's and the others background.
            self.anchor = advance_anchor(tracked, solution.pairs if updates_map else [], weights if updates_map else [])
        before = None if tracked is None else tracked.previous_pixels
        if accepted.is_uncertain:
            (reobserved, current), before = reobserved.omit_new_features(current), None
        else:
            self.update_landmarks(current, accepted.rig.cameras[self.index], pose, reobserved, model)
        # No more features of an uncertain pose are added later.
        self.view = (None, None) if accepted.is_uncertain else self.view_of(accepted.images)
        self.frames[number], self.windows = current, None
        self.frames = {k: frame for k, frame in self.frames.items() if k in kept}
        self.table.prune(np.concatenate([frame.landmark_ids for frame in self.frames.values()]))
        if begins_anchor:
            self.set_anchor(number, accepted.images, tracked if updates_map else None)
        detected = collect_detected_features(solution.current.features, solution.pairs, weights)
        return CameraRecord(
            select_shown_matches(reobserved.inliers, current, accepted.last_number, before),
            record_observations(reobserved.inliers, current),
            detected,
        )

    def learn_background(self, pairs: Pairs, current: CameraFrame, motion: KnownMotion) -> None:
        """Mark features as background that were static while the object moved."""
        before = current.background.copy()
        for pair in pairs:
            mark_background(pair, current, find_background(pair, current, self.camera, motion))
        background = current.features.subset(current.background & ~before)
        if len(self.background_features) < MAX_BACKGROUND_FEATURES:
            self.background_features = Features.concatenate([self.background_features, background])

    def update_noise(self, noise_px: float) -> None:
        """Update the keypoint noise with another frame's; NaN: unchanged."""
        if np.isfinite(noise_px):
            self.noise_px += (noise_px - self.noise_px) / (AVERAGING_FRAMES if self.noise_px else 1)

    def update_landmarks(
        self,
        current: CameraFrame,
        frame_camera: Camera,
        world_from_object: RigidTransform,
        reobserved: ReobservedFeatures,
        model: ObjectModel,
        bulge: float = 0.0,
    ) -> None:
        """Update the landmarks with a solved frame.

        Args:
            frame_camera: the camera, with its pose at this frame.
            reobserved: features that were observed before.
            model: of the object; its points are used while too few landmarks describe the surface.
            bulge: see `DepthPrior`.
        """
        prior = _make_depth_prior(reobserved.surface_points, model)._replace(bulge=bulge)
        observed = current.features, frame_camera, world_from_object
        landmarks = update_landmarks(*observed, prior, reobserved.landmarks, reobserved.index)
        current.landmark_ids = self.table.update(landmarks)
        # Landmarks that earlier frames kept apart are merged.
        for pair in reobserved.inliers:
            pair.earlier.landmark_ids[pair.indices[:, 0]] = current.landmark_ids[pair.indices[:, 1]]

    def reinitialize_landmarks(self, frame: SolvedFrame, frame_camera: Camera, model: ObjectModel) -> Landmarks:
        """Compute a frame's landmarks as if they were observed in this frame only. See `update_landmarks`."""
        own, prior = self.frames[frame.number], DepthPrior(model.points, model.radius)
        new = create_landmarks(own.features, frame_camera, frame.world_from_object, prior)
        return replace(new, id=own.landmark_ids)

    def add_remaining_features(self, region: Region, last: SolvedFrame, model: ObjectModel) -> None:
        """Add all remaining features in the last solved frame's image to that frame, once.

        Args:
            region: of the object in it.
            model: of the object; its points are used while too few landmarks describe the surface.
        """
        view, self.view = self.view, (None, None)
        old = self.frames[last.number]
        detected = self.detect(view, self.rasterize(region), faint=True)
        if len(detected) and len(old.features):
            # Nearer ones are the same within the accuracy of keypoints.
            detected = detected.subset(cKDTree(old.features.pixels).query(detected.pixels)[0] > STATIC_PX)
        if not len(detected):
            return
        known, new = old.landmarks, self.create_frame(detected)
        prior = _make_depth_prior(known.mean[known.depth_sd < KNOWN_DEPTH_RATIO * model.radius], model)
        new.landmark_ids = self.table.update(create_landmarks(detected, self.camera, last.world_from_object, prior))
        self.frames[last.number] = old.append(new)

    def set_anchor(self, number: int, images: FrameSet, tracked: TrackedFeatures | None) -> None:
        """Make a solved frame the anchor. See `create_anchor`."""
        image = images.images[self.index]
        self.anchor, self.next_anchor = create_anchor(number, self.frames[number], image, tracked), None
