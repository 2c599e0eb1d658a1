"""Synthetic matches: noisy image points of a moving body that are visible in both frames, per camera of a rig."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeVar, get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.validation import (
    check_bool,
    check_choice,
    check_finite,
    check_integer,
    check_list,
    check_number,
    check_type,
    format_value,
)
from sylpose.input_limits import to_one_line
from sylpose.matches import Matches
from sylpose.rig import MAX_FOCAL_PX, MAX_LENGTH, Camera, Rig, check_single_pose
from sylpose.simulate.bodies import Body

OutlierKind = Literal["uniform", "static", "second_motion"]
T = TypeVar("T")

PER_CAMERA = 60  # default number of matches (choice)

# A surface viewed more obliquely than this is not matched (cosine of the angle to its normal; choice).
MIN_FACING_COSINE = 0.1


@dataclass(frozen=True, eq=False)
class SimulatedPair:
    """Matches of one pair of frames, with ground truth.

    Attributes:
        matches: one per camera of the rig, normalized.
        is_outlier: per camera a mask over its matches.
        depths: per camera the matches' depths in frame i, along the optical axis; NaN for outliers.
        motion: the body's motion in the world, X_j = R X_i + t.
        center: (3,) the body's origin at frame i, world.
    """

    matches: tuple[Matches, ...]
    is_outlier: tuple[BoolArray, ...]
    depths: tuple[FloatArray, ...]
    motion: RigidTransform
    center: FloatArray


def random_motion(
    angle_deg: float,
    distance: float,
    rng: np.random.Generator,
    axis: ArrayLike | None = None,
    center: ArrayLike = (0.0, 0.0, 0.0),
) -> RigidTransform:
    """Draw a rigid motion: a rotation about `center`, then a translation d in a random direction.

    X_j = R (X_i - center) + center + d.

    Args:
        angle_deg: rotation angle, degrees.
        distance: length of the translation.
        rng: random generator.
        axis: (3,) rotation axis; None: random.
        center: (3,) point on the axis.

    Raises:
        ValueError: the axis has zero length.
    """
    angle_deg = check_number(angle_deg, "angle_deg", minimum=-360.0, maximum=360.0)
    distance = check_number(distance, "distance", maximum=MAX_LENGTH)
    check_type(rng, np.random.Generator, "rng")
    center = check_finite(center, (3,), "center", maximum=MAX_LENGTH)
    axis_vector = rng.standard_normal(3) if axis is None else check_finite(axis, (3,), "axis", maximum=MAX_LENGTH)
    direction = rng.standard_normal(3)
    if not np.linalg.norm(axis_vector) > 1 / MAX_LENGTH:
        raise ValueError("axis: the rotation axis must not be zero")
    rotation = Rotation.from_rotvec(np.deg2rad(angle_deg) * axis_vector / np.linalg.norm(axis_vector))
    translation = center - rotation.apply(center) + distance * direction / np.linalg.norm(direction)
    return RigidTransform.from_components(translation, rotation)


def simulate_matches(
    rig: Rig,
    body: Body,
    motion: RigidTransform,
    *,
    rng: np.random.Generator,
    per_camera: int | Mapping[str, int] = PER_CAMERA,
    noise_px: float = 0.5,
    outliers: float = 0.0,
    outlier_kind: OutlierKind | RigidTransform = "uniform",
    occlusion: float = 0.0,
    junk: Sequence[str] = (),
    start: RigidTransform | None = None,
    orthographic: bool = False,
) -> SimulatedPair:
    """Simulate the matches of all cameras of a rig for a moving body.

    A point is matched if it faces the camera and is inside its image in both frames. Self-occlusion is not modeled
    otherwise, so the body should be convex. Points are projected to pixels through the lens, noise is added in both
    frames, and the points are undistorted. Given `rng`'s state, the matches of a camera depend only on its name, not on
    the other cameras: a subset of the rig gives the same matches.

    Args:
        rig: the cameras.
        body: the body, with its center at the origin.
        motion: motion of the body in the world, from frame i to j.
        rng: random generator.
        per_camera: matches per camera, outliers included; fewer if fewer points are visible. By camera name: those of
            these cameras, and 60 of the others.
        noise_px: standard deviation per coordinate, pixels, in each frame.
        outliers: share of each camera's matches that are wrong.
        outlier_kind: "uniform": points of the body matched to random positions in its image region at j; "static":
            points in its region that do not move; "second_motion": points of a copy of the body, next to it, that moves
            by the same angle about another axis through the copy; a transform: points of the copy, moved by it.
        occlusion: share of the visible points that are occluded: in each camera those on one side of a line across its
            image.
        junk: names of cameras with wrong matches only, random in both frames.
        start: world_from_body at frame i; None is the identity.
        orthographic: scale points by the depth of the body's origin at frame i instead of their own, in both frames
            (scaled orthographic views).

    Returns:
        The matches with ground truth.

    Raises:
        ValueError: a camera is not in the rig, a share is outside [0, 1], the kind is unknown, or a number is negative.
    """
    check_type(rig, Rig, "rig"), check_type(body, Body, "body"), check_type(rng, np.random.Generator, "rng")
    check_single_pose(motion, "motion")
    start = RigidTransform.identity() if start is None else check_single_pose(start, "start")
    counts = per_camera if isinstance(per_camera, Mapping) else dict.fromkeys(rig.names, per_camera)
    counts = {name: check_integer(n, "per_camera") for name, n in _check_names(counts, rig, "per_camera").items()}
    _check_names(dict.fromkeys(check_list(junk, str, "junk")), rig, "junk")
    check_number(outliers, "outliers", minimum=0.0, maximum=1.0)
    check_number(noise_px, "noise_px", minimum=0.0, maximum=MAX_FOCAL_PX)
    check_bool(orthographic, "orthographic")
    if not check_number(occlusion, "occlusion", minimum=0.0, maximum=1.0) < 1:
        raise ValueError(f"occlusion must be in [0, 1), got {occlusion}")
    key = int(rng.integers(2**63))
    copy_start, copy_motion = _place_copy(body, start, motion, outlier_kind, key)
    matches, masks, depths = [], [], []
    for camera in rig:
        stream = np.random.default_rng([key, zlib.crc32(camera.name.encode())])
        view = _CameraProjection(camera, start.translation, orthographic)
        points_i, points_j, depth = view.visible_points(body, start, motion, stream, occlusion)
        count = min(counts.get(camera.name, PER_CAMERA), len(depth))
        regions = _bounding_box(points_i), _bounding_box(points_j)
        points, depth = np.stack([points_i[:count], points_j[:count]]), depth[:count].copy()
        noise = noise_px * stream.standard_normal((2, count, 2))
        wrong, kept = np.full(count, camera.name in junk), np.arange(count)
        if camera.name in junk:
            points = np.stack([stream.uniform(*region, (count, 2)) for region in regions])
        else:
            wrong[stream.permutation(count)[: round(outliers * count)]] = True
            if outlier_kind == "uniform":
                points[1, wrong] = stream.uniform(*regions[1], (wrong.sum(), 2))
            elif outlier_kind == "static":
                points[:, wrong] = stream.uniform(*regions[0], (wrong.sum(), 2))
            else:
                copies = np.stack(view.visible_points(body, copy_start, copy_motion, stream, occlusion)[:2])
                replaced, dropped = np.split(np.flatnonzero(wrong), [copies.shape[1]])
                points[:, replaced] = copies[:, : len(replaced)]
                kept = np.delete(kept, dropped)  # fewer matches if the copy is not visible
        depth[wrong] = np.nan
        matches.append(Matches.from_pixels(camera, *(points + noise)[:, kept]))
        masks.append(wrong[kept])
        depths.append(depth[kept])
    return SimulatedPair(tuple(matches), tuple(masks), tuple(depths), motion, np.asarray(start.translation))


def _check_names(names: Mapping[str, T], rig: Rig, argument: str) -> Mapping[str, T]:
    """Check that the keys are names of the rig's cameras."""
    for name in names:
        if name not in rig.names:
            known = to_one_line(", ".join(rig.names), 200)
            raise ValueError(f"{argument}: no camera {format_value(name)} in the rig ({known})")
    return names


def _place_copy(
    body: Body, start: RigidTransform, motion: RigidTransform, kind: str | RigidTransform, key: int
) -> tuple[RigidTransform, RigidTransform]:
    """Return where a copy of the body starts and how it moves, the same for all cameras."""
    pair_rng = np.random.default_rng([key])
    direction = pair_rng.standard_normal(3)
    copy_start = RigidTransform.from_translation(body.radius * direction / np.linalg.norm(direction)) * start
    if isinstance(kind, RigidTransform):
        return copy_start, check_single_pose(kind, "outlier_kind")
    check_choice(kind, get_args(OutlierKind), "outlier_kind")
    angle = np.rad2deg(motion.rotation.magnitude())
    return copy_start, random_motion(angle, body.radius / 10, pair_rng, center=copy_start.translation)


@dataclass(frozen=True)
class _CameraProjection:
    """Projection of one camera: perspective, or orthographic at the scale of a center's depth."""

    camera: Camera
    center: FloatArray
    orthographic: bool

    def visible_points(
        self, body: Body, start: RigidTransform, motion: RigidTransform, rng: np.random.Generator, occlusion: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return pixels (m, 2) at i and j and depths (m,) at i of the points visible in both frames.

        The order is random.
        """
        order = rng.permutation(len(body.points))
        line = rng.standard_normal(2)
        end = motion * start
        points_i, points_j = start.apply(body.points[order]), end.apply(body.points[order])
        is_facing = self._is_facing(points_i, start.rotation.apply(body.normals[order]))
        is_facing &= self._is_facing(points_j, end.rotation.apply(body.normals[order]))
        points_i, points_j = points_i[is_facing], points_j[is_facing]
        pixels_i, pixels_j = self._project(points_i), self._project(points_j)
        is_inside = self._is_inside(pixels_i) & self._is_inside(pixels_j)
        pixels_i, pixels_j, points_i = pixels_i[is_inside], pixels_j[is_inside], points_i[is_inside]
        if occlusion > 0 and len(pixels_i):
            along = pixels_i @ line
            not_occluded = along >= np.quantile(along, occlusion)
            pixels_i, pixels_j, points_i = pixels_i[not_occluded], pixels_j[not_occluded], points_i[not_occluded]
        return pixels_i, pixels_j, self.camera.camera_from_world.apply(points_i)[:, 2]

    def _is_facing(self, points: FloatArray, normals: FloatArray) -> BoolArray:
        if self.orthographic:
            cosines = -(normals @ self.camera.direction)
        else:
            towards = self.camera.center - points
            cosines = np.einsum("ni,ni->n", normals, towards) / np.linalg.norm(towards, axis=1)
        return np.asarray((cosines > MIN_FACING_COSINE) | ~normals.any(axis=1))

    def _project(self, points: FloatArray) -> FloatArray:
        if not self.orthographic:
            return self.camera.project(points)
        pose = self.camera.camera_from_world
        scale = pose.apply(self.center)[2]
        if scale <= 0:
            return np.full((len(points), 2), np.nan)
        return self.camera.denormalize(pose.apply(points)[:, :2] / scale)

    def _is_inside(self, pixels: FloatArray) -> BoolArray:
        with np.errstate(invalid="ignore"):
            return np.asarray(((pixels >= 0) & (pixels <= np.array(self.camera.size) - 1)).all(axis=1))


def _bounding_box(pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the corners (2,), (2,) of the points' bounding box; zeros without points."""
    if not len(pixels):
        return np.zeros(2), np.zeros(2)
    return pixels.min(axis=0), pixels.max(axis=0)
