"""Tracker of one camera: feature detection in its own images and its memory of the object.

Its inputs are shared by all cameras (a pose, the object's radius, frame numbers). It has no access to other cameras'
data and sends them only `reports`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import RigidTransform

from sylpose.features.sift import MAX_FAINT_FEATURES, MAX_FEATURES, Features, detect_features, find_static_features
from sylpose.geometry.arrays import BoolArray, FloatArray, Image
from sylpose.landmarks.landmark_filter import Landmarks, update_landmarks
from sylpose.landmarks.landmark_table import LandmarkTable
from sylpose.matches import STATIC_PX
from sylpose.rig import Camera
from sylpose.tracking.camera_motion_detection import CameraMotionDetector, View
from sylpose.tracking.frame import (
    CameraFrame,
    DetectedFeatures,
    FrameMatches,
    SolvedFrame,
    find_background,
    mark_background,
    match_frames,
    match_near_pose,
)
from sylpose.tracking.klt_frontend import (
    CameraAnchor,
    NextAnchor,
    TrackedFeatures,
    advance_anchor,
    create_anchor,
    track_anchor,
)
from sylpose.tracking.region import rasterize_outline
from sylpose.tracking.reobserved import SURFACE_DEPTH_SD_RATIO, ReobservedFeatures

__all__ = ["CameraTracker", "compute_static_px", "is_large"]

# With so many landmarks of known depth they describe the surface better than the volume inside the boxes (choice).
MIN_SURFACE_LANDMARKS = 20
# A feature has moved if displaced by so many standard deviations of the camera's keypoint noise, which is limited to
# this maximum, pixels (choice).
STATIC_SIGMAS, MAX_STATIC_PX = 5.0, 6.0
# Maximum number of remembered background features (choice).
MAX_BACKGROUND_FEATURES = 8000
# The noise is averaged over about so many frames (choice).
NOISE_AVERAGING_FRAMES = 5
# Offsets at which matches occur by chance only, in search radii from the expected place (choice).
CHANCE_OFFSETS = ((6.0, 0.0), (0.0, 6.0), (-6.0, 0.0), (0.0, -6.0))
# Larger images than Full HD are downscaled where the whole image is searched; detection is repeated at full resolution
# where something was found (choice).
MAX_SEARCH_PIXELS = 1920 * 1080
# The surroundings of the object's outline are searched up to so many times its size (choice).
SURROUNDINGS_SCALE = 2.0
# Features closer than this, pixels, are the same (choice).
DUPLICATE_PX = 1.5


def compute_static_px(noise_px: float) -> float:
    """Return the displacement, pixels, below which keypoints of this noise are static."""
    return float(np.clip(STATIC_SIGMAS * noise_px, STATIC_PX, MAX_STATIC_PX))


def is_large(camera: Camera) -> bool:
    """Return whether a camera's images are downscaled for searching."""
    width, height = camera.size
    return width * height > MAX_SEARCH_PIXELS


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
        detections: features detected in the current frame.
    """

    def __init__(self, index: int, camera: Camera) -> None:
        self.index, self.camera = index, camera
        self.frames: dict[int, CameraFrame] = {}
        self.anchor: CameraAnchor | None = None
        self.next_anchor: NextAnchor | None = None
        self.background_features = Features.empty()
        self.table = LandmarkTable()
        self.noise_px = 0.0
        self.view: View = (None, None)
        self.motion_detector = CameraMotionDetector(camera)
        self.detections = DetectedFeatures()

    @property
    def static_px(self) -> float:
        """Displacements below this are within the camera's keypoint noise, pixels."""
        return compute_static_px(self.noise_px)

    # --- detection and matching: state is not changed -----------------------------------------------------------------

    def detect(
        self,
        image: Image | None,
        mask: BoolArray | None,
        area: BoolArray | None,
        max_features: int = MAX_FEATURES,
        *,
        faint: bool = False,
        reduced: bool = False,
    ) -> Features:
        """Detect features inside an area and the object's mask.

        Args:
            area: (h, w) area; None: the whole image.
            max_features: maximum number of features, the strongest.
            faint: whether to keep low-contrast features and ignore `max_features`.
            reduced: whether to downscale a large area.
        """
        if image is None:
            return Features.empty()
        if area is None:
            area = np.ones(self.camera.size[::-1], bool)
        area = area if mask is None else area & mask
        max_features = MAX_FAINT_FEATURES if faint else max_features
        return detect_features(
            image, self.camera, area, max_features, faint=faint, max_pixels=MAX_SEARCH_PIXELS if reduced else None
        )

    @property
    def is_large(self) -> bool:
        """Whether the camera's images are downscaled for searching."""
        return is_large(self.camera)

    def detect_at_full_res(
        self, image: Image | None, mask: BoolArray | None, features: Features, region: FloatArray | None, *, faint: bool
    ) -> Features:
        """Return the features inside a region's outline (k, 2), detected at full resolution.

        Args:
            features: of the whole image; used as they are unless the image was searched downscaled.
        """
        if image is None or not self.is_large:
            return features.subset(self.find_inside(features, region))
        return self.detect(image, mask, rasterize_outline(region, self.camera.size), faint=faint)

    def split_foreground(
        self,
        image: Image | None,
        mask: BoolArray | None,
        features: Features,
        region: FloatArray | None,
        is_static: BoolArray,
    ) -> tuple[Features, Features]:
        """Split a whole image's features into possible object features and background.

        Args:
            region: (k, 2) outline of the object.
            is_static: (n,) which features are known to be static.

        Returns:
            features inside the region that may be the object's; all others.
        """
        is_foreground = self.find_inside(features, region) & ~is_static
        if image is None or not self.is_large:
            return features.subset(is_foreground), features.subset(~is_foreground)
        detected = self.detect_at_full_res(image, mask, features, region, faint=False)
        is_background = find_static_features(detected, features.subset(is_static), self.static_px)
        return detected.subset(~is_background), Features.concatenate(
            [features.subset(~is_foreground), detected.subset(is_background)]
        )

    def detect_surroundings(
        self, image: Image | None, mask: BoolArray | None, region: FloatArray | None, *, faint: bool
    ) -> Features:
        """Detect features outside a region's outline (k, 2); in large images at full resolution near it."""
        area = ~rasterize_outline(region, self.camera.size)
        detected = self.detect(image, mask, area, faint=faint, reduced=True)
        if region is None or not self.is_large:
            return detected
        middle = region.mean(axis=0)
        near_area = area & rasterize_outline(middle + SURROUNDINGS_SCALE * (region - middle), self.camera.size)
        return Features.concatenate([detected, self.detect(image, mask, near_area, faint=faint, reduced=True)])

    def find_inside(self, features: Features, region: FloatArray | None) -> BoolArray:
        """Return which features (n,) are inside a region's outline (k, 2)."""
        row, column = np.round(features.pixels).astype(np.int64).T[::-1]
        return np.asarray(rasterize_outline(region, self.camera.size)[row, column])

    def create_frame(self, features: Features) -> CameraFrame:
        """Create a frame to be solved; features at the place of known background are marked."""
        return CameraFrame(features, self.find_known_background(features), self.table, static_px=self.static_px)

    def create_empty_frame(self) -> CameraFrame:
        """Create a frame without features."""
        return self.create_frame(Features.empty())

    def find_known_background(self, features: Features) -> BoolArray:
        """Return which features (n,) coincide with known background."""
        return find_static_features(features, self.background_features, self.static_px)

    def track_anchor(
        self,
        last_pose: RigidTransform,
        predicted_pose: RigidTransform,
        image: Image | None,
        mask: BoolArray | None,
        radius: float,
    ) -> TrackedFeatures:
        """Track the anchor's features in the next image. See `klt_frontend.track_anchor`."""
        assert self.anchor is not None
        return track_anchor(self.anchor, self.camera, last_pose, predicted_pose, image, mask, radius)

    def match(self, current: CameraFrame, references: Sequence[int]) -> list[FrameMatches]:
        """Match by descriptors with earlier frames, in the given order.

        Each pair passes its known background on to the frame, and so to the next pair.
        """
        pairs = [match_frames(number, self.frames[number], current) for number in references]
        return [pair for pair in pairs if len(pair)]

    def match_near(
        self, current: CameraFrame, references: Sequence[int], pose: RigidTransform, radius_px: float
    ) -> list[FrameMatches]:
        """Match with landmarks of earlier frames near their projections.

        Args:
            pose: world_from_object.
            radius_px: search radius, pixels.
        """
        pairs = [
            match_near_pose(number, self.frames[number], current, self.camera, pose, radius_px) for number in references
        ]
        return [pair for pair in pairs if len(pair)]

    def count_supporting_features(
        self, current: CameraFrame, references: Sequence[int], pose: RigidTransform, radius_px: float
    ) -> tuple[int, float]:
        """Count features that match landmarks near their projections, and those that match by chance.

        Args:
            pose: world_from_object.
            radius_px: search radius, pixels.

        Returns:
            number of features near the projections; mean number at offset places.
        """

        def count(dx: float, dy: float) -> int:
            offset = dx * radius_px, dy * radius_px
            pairs = [
                match_near_pose(number, self.frames[number], current, self.camera, pose, radius_px, offset)
                for number in references
            ]
            return len(np.unique(np.concatenate([np.empty(0, np.int64), *(pair.indices[:, 1] for pair in pairs)])))

        return count(0.0, 0.0), float(np.mean([count(*chance_offset) for chance_offset in CHANCE_OFFSETS]))

    # --- update after a frame is accepted -----------------------------------------------------------------------------

    def learn_background(
        self,
        pairs: Sequence[FrameMatches],
        current: CameraFrame,
        pose_j: RigidTransform,
        known_frames: Mapping[int, SolvedFrame],
        radius: float,
    ) -> None:
        """Mark features as background that were static while the object moved.

        Args:
            pose_j: the current world_from_object.
        """
        before = current.background.copy()
        for pair in pairs:
            pose_i = known_frames[pair.reference].world_from_object
            mark_background(pair, current, find_background(pair, current, self.camera, pose_i, pose_j, radius))
        background = current.features.subset(current.background & ~before)
        if len(self.background_features) < MAX_BACKGROUND_FEATURES:
            self.background_features = Features.concatenate([self.background_features, background])

    def update_noise(self, noise_px: float) -> None:
        """Update the keypoint noise with another frame's; NaN: unchanged."""
        if np.isfinite(noise_px):
            self.noise_px += (noise_px - self.noise_px) / (NOISE_AVERAGING_FRAMES if self.noise_px else 1)

    def update_landmarks(
        self,
        current: CameraFrame,
        frame_camera: Camera,
        world_from_object: RigidTransform,
        reobserved: ReobservedFeatures,
        cloud: FloatArray,
        radius: float,
        bulge: float = 0.0,
    ) -> None:
        """Update the landmarks with a solved frame.

        Args:
            frame_camera: the camera, with its pose at this frame.
            reobserved: features that were observed before.
            cloud: (n, 3) points on the object, object's frame, used while too few landmarks describe its surface.
            bulge: see `predict_depths`.
        """
        surface = reobserved.surface_points if len(reobserved.surface_points) >= MIN_SURFACE_LANDMARKS else cloud
        current.landmark_ids = self.table.update(
            update_landmarks(
                current.features,
                frame_camera,
                world_from_object,
                reobserved.landmarks,
                reobserved.index,
                surface,
                radius,
                bulge,
            )
        )
        # Landmarks that earlier frames kept apart are merged.
        for pair in reobserved.inliers:
            pair.earlier.landmark_ids[pair.indices[:, 0]] = current.landmark_ids[pair.indices[:, 1]]

    def reinitialize_landmarks(
        self, number: int, frame_camera: Camera, world_from_object: RigidTransform, cloud: FloatArray, radius: float
    ) -> Landmarks:
        """Compute a frame's landmarks as if they were observed in this frame only. See `update_landmarks`."""
        frame, none = self.frames[number], ReobservedFeatures.empty()
        new = update_landmarks(
            frame.features, frame_camera, world_from_object, none.landmarks, none.index, cloud, radius
        )
        return replace(new, id=frame.landmark_ids)

    def initialize(self, number: int, first: CameraFrame, background_features: Features, view: View) -> None:
        """Start with the first solved frame, its image and the background features around the object."""
        self.frames, self.anchor, self.view = {number: first}, None, view
        self.background_features = background_features

    def add_remaining_features(
        self, number: int, pose: RigidTransform, region: FloatArray | None, cloud: FloatArray, radius: float
    ) -> None:
        """Add all remaining features in the last solved frame's image to that frame, once.

        Args:
            number: of the frame.
            pose: its world_from_object.
            region: (k, 2) the object's outline in it, None if out of view.
            cloud: (n, 3) points on the object, object's frame, used while too few landmarks describe its surface.
        """
        (image, mask), self.view = self.view, (None, None)
        old = self.frames[number]
        detected = self.detect(image, mask, rasterize_outline(region, self.camera.size), faint=True)
        if len(detected) and len(old.features):
            detected = detected.subset(cKDTree(old.features.pixels).query(detected.pixels)[0] > DUPLICATE_PX)
        if not len(detected):
            return
        known, none = old.landmarks, ReobservedFeatures.empty()
        surface = known.mean[known.depth_sd < SURFACE_DEPTH_SD_RATIO * radius]
        cloud = surface if len(surface) >= MIN_SURFACE_LANDMARKS else cloud
        new = update_landmarks(detected, self.camera, pose, none.landmarks, none.index, cloud, radius)
        self.frames[number] = CameraFrame(
            Features.concatenate([old.features, detected]),
            np.concatenate([old.background, self.find_known_background(detected)]),
            self.table,
            np.concatenate([old.landmark_ids, self.table.update(new)]),
        )

    def store_frame(self, number: int, current: CameraFrame, kept_numbers: set[int], view: View) -> None:
        """Store a solved frame and its image; discard frames whose numbers are not listed."""
        self.frames[number], self.view = current, view
        self.frames = {k: frame for k, frame in self.frames.items() if k in kept_numbers}
        self.table.prune(np.concatenate([frame.landmark_ids for frame in self.frames.values()]))

    def set_anchor(self, number: int, image: Image | None, tracked: TrackedFeatures | None) -> None:
        """Make a solved frame the anchor. See `klt_frontend.create_anchor`."""
        self.anchor, self.next_anchor = create_anchor(number, self.frames[number], image, tracked), None

    def advance_anchor(
        self, tracked: TrackedFeatures, pairs: Sequence[FrameMatches], weights: Sequence[FloatArray]
    ) -> None:
        """Update the anchor after a frame solved by its tracked features alone."""
        self.anchor = advance_anchor(tracked, pairs, weights)

    @property
    def has_observations(self) -> bool:
        """Whether it has observations by which it could recognize the object."""
        return any(len(frame.features) for frame in self.frames.values())

    def list_immutable(self) -> list[object]:
        """List the objects of its state that are never modified."""
        anchor, watch = self.anchor, self.motion_detector
        of_anchor = () if anchor is None else (anchor.tracks, anchor.image, anchor.frame.features)
        features = (self.background_features, *(frame.features for frame in self.frames.values()))
        return [self.camera, self.view, self.next_anchor, watch.background, watch.stabilizer, *of_anchor, *features]

    def begin_frame(self) -> None:
        """Clear the detected features at the start of a frame."""
        self.detections = DetectedFeatures()

    def reset(self) -> None:
        """Discard everything known of the object."""
        self.frames, self.anchor, self.background_features, self.view = {}, None, Features.empty(), (None, None)
        self.next_anchor = None
        self.noise_px = 0.0
        self.table = LandmarkTable()
