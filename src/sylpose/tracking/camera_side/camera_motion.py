"""Detection of one camera's motion from its own background.

Corners all over the image are observed (`features.static_background`). If nearly all static ones move by one rotation
about the camera's center, outside the object's region, the camera was nudged. The decision is made with all cameras
(`tracking.state_machine`).
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.features.static_background import (
    MIN_CORNERS,
    MIN_INLIER_RATIO,
    CameraRotation,
    RotationRectifier,
    StaticBackground,
    detect_corners,
    estimate_camera_rotation,
    find_unchanged_corners,
)
from sylpose.geometry.arrays import BoolArray, FloatArray, Image
from sylpose.geometry.robust_loss import chi_squared_bound
from sylpose.relative_pose.second_motion import MIN_OUTLIER_RATIO
from sylpose.rig import Camera
from sylpose.tracking.camera_side.frame import REGION_MARGIN, project_outline, rasterize_outline
from sylpose.tracking.joint_side.joint_state import RETRY_FRAMES
from sylpose.tracking.reports import CameraMotionReport

# An image, and the object's mask (h, w) in it.
View = tuple[Image | None, BoolArray | None]

# A camera is static while this share of the corners that were static in the previous frame look unchanged (measured: of
# "background" in benchmarks/kinds.py, 0.8 at least where it is static, less than 0.1 where it was nudged by a degree;
# 0.6 where an object that fills half of the image starts to move).
MIN_UNCHANGED_RATIO = 0.4
# A rotation is detected if `MIN_INLIER_RATIO` of the corners tested, `MIN_CORNERS` at least, agree on it, spread over such a
# share of the image (choice), while at most `MIN_OUTLIER_RATIO` of them are static: otherwise the camera sees both.
MIN_SPREAD = 0.1
# A nudge has at least this median displacement, pixels, and this many standard deviations (choice).
NUDGE_PX, MIN_NUDGE_SDS = 2.0, 10.0
# Two rotations are equal within so many pixels at the image center (choice),
SAME_PX = 0.5
# or so many standard deviations (chi-squared of three, once in a thousand times).
SAME_SDS = float(np.sqrt(chi_squared_bound(3)))


class CameraMotionDetector:
    """Motion detector of one camera.

    Attributes:
        camera: its calibration.
        background: corners of a reference image of the static camera; None while detection is paused.
        is_static: (n,) corners unchanged when the camera was last static; after that, without those on the object.
        stabilizer: rotates the images back once the camera was nudged.
        last_rotation: rotation since the reference image in the last frame, if any.
        first_frame: the recording's number of the first such frame.
        n_changed: number of consecutive frames in which the image disagrees with a static camera.
        pause: frames until detection restarts.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.background: StaticBackground | None = None
        self.is_static: BoolArray = np.zeros(0, bool)
        self.stabilizer: RotationRectifier | None = None
        self.last_rotation: CameraRotation | None = None
        self.first_frame = self.n_changed = self.pause = 0

    def stabilize(self, image: Image | None, mask: BoolArray | None) -> View:
        """Rotate an image and the object's mask back by the known camera rotation."""
        if image is None or self.stabilizer is None:
            return image, mask
        return self.stabilizer.rectify_image(image), self.stabilizer.rectify_mask(mask)

    def detect(self, image: Image | None, points: FloatArray | None, index: int) -> CameraMotionReport:
        """Check whether the camera has moved.

        Args:
            image: corrected; None without one.
            points: (n, 3) points on the object, world; None while unknown.
            index: the recording's number of the frame.
        """
        if image is None:
            return CameraMotionReport(has_changed=self.n_changed > 0)
        if self.background is None:
            self.pause -= 1
            if self.pause < 0:
                self._begin(image)
            return CameraMotionReport()
        is_unchanged = find_unchanged_corners(self.background, image)
        if (is_unchanged & self.is_static).sum() >= MIN_UNCHANGED_RATIO * self.is_static.sum():
            self.is_static, self.last_rotation, self.n_changed = is_unchanged, None, 0
            if is_unchanged.sum() < MIN_CORNERS:
                self.restart(RETRY_FRAMES)
            return CameraMotionReport()
        if not self.n_changed:
            # The object's position may become less certain in the next frames, without this camera.
            self.is_static = self.is_static & ~self._is_on_object(points)
        is_enough = self.is_static.sum() >= MIN_CORNERS
        rotation = estimate_camera_rotation(self.background, image, self.camera, self.is_static) if is_enough else None
        self.n_changed += 1
        if rotation is None or not _is_nudge(rotation):
            self.last_rotation = None
            if self.n_changed > RETRY_FRAMES:
                self.restart(RETRY_FRAMES)
            return CameraMotionReport(has_changed=True)
        is_confirmed = self.last_rotation is not None and _is_same(rotation, self.last_rotation, self.camera)
        self.first_frame = self.first_frame if self.last_rotation is not None else index
        self.last_rotation = rotation
        if self.n_changed > RETRY_FRAMES and not is_confirmed:
            self.restart(RETRY_FRAMES)
        return CameraMotionReport(
            True, Rotation.from_matrix(rotation.rotation).as_rotvec(), rotation.sd, self.first_frame, is_confirmed
        )

    def apply_correction(self) -> None:
        """Apply the last frame's rotation as a correction."""
        assert self.background is not None
        assert self.last_rotation is not None
        previous_rotation = np.eye(3) if self.stabilizer is None else self.stabilizer.rotation
        self.stabilizer = RotationRectifier(self.camera, previous_rotation @ self.last_rotation.rotation)
        columns, rows = self.background.pixels.astype(np.int64).T
        self.is_static = self.is_static & self.stabilizer.valid[rows, columns]
        self.last_rotation, self.n_changed = None, 0

    def restart(self, pause: int) -> None:
        """Restart detection after so many frames."""
        self.background, self.last_rotation, self.n_changed, self.pause = None, None, 0, pause

    def _begin(self, image: Image) -> None:
        self.background = detect_corners(image, None if self.stabilizer is None else self.stabilizer.valid)
        self.is_static = np.ones(len(self.background), bool)
        if len(self.background) < MIN_CORNERS:
            self.restart(RETRY_FRAMES)

    def _is_on_object(self, points: FloatArray | None) -> BoolArray:
        """Return which corners (n,) are on the object."""
        assert self.background is not None
        region = None if points is None else project_outline(self.camera, points, REGION_MARGIN)
        columns, rows = self.background.pixels.astype(np.int64).T
        return np.asarray(rasterize_outline(region, self.camera.size)[rows, columns])


def _is_nudge(rotation: CameraRotation) -> bool:
    """Return whether a rotation is that of the whole camera and significant."""
    is_majority = (
        rotation.n_inliers >= MIN_CORNERS
        and rotation.n_inliers >= MIN_INLIER_RATIO * rotation.n_evaluated
        and rotation.n_static <= MIN_OUTLIER_RATIO * rotation.n_evaluated
    )
    is_significant = _rotation_angle(rotation.rotation) > MIN_NUDGE_SDS * rotation.sd
    return bool(
        is_majority and rotation.spread >= MIN_SPREAD and rotation.displacement_px > NUDGE_PX and is_significant
    )


def _is_same(a: CameraRotation, b: CameraRotation, camera: Camera) -> bool:
    """Return whether two rotations are equal, so that the camera is static again."""
    angle = _rotation_angle(a.rotation @ b.rotation.T)
    return bool(angle < max(SAME_PX / camera.focal, SAME_SDS * np.hypot(a.sd, b.sd)))


def _rotation_angle(rotation: FloatArray) -> float:
    return float(Rotation.from_matrix(rotation).magnitude())
