"""Synthetic matches: a body moves in front of a rig, and each camera reports noisy points that it sees in both frames."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.validation import finite, kind_of, listed, number, one_of, shown, truth, whole
from sylpose.input_limits import one_line
from sylpose.matches import Matches
from sylpose.rig import MAX_LENGTH, MAX_PX, Camera, Rig, single_pose
from sylpose.simulate.bodies import Body

__all__ = ["OutlierKind", "SimulatedPair", "random_motion", "simulate_matches"]

OutlierKind = Literal["uniform", "static", "second_motion"]

# A surface is not matched when seen more obliquely than this (cosine of the angle to its normal; choice).
GRAZING = 0.1


@dataclass(frozen=True, eq=False)
class SimulatedPair:
    """Matches of one pair of frames, with the truth about them.

    Attributes:
        matches: one per camera of the rig, normalised.
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
    turn_deg: float,
    shift: float,
    rng: np.random.Generator,
    axis: ArrayLike | None = None,
    center: ArrayLike = (0.0, 0.0, 0.0),
) -> RigidTransform:
    """A turn by `turn_deg` about `axis` (3,) (None: any) through `center` (3,), then a shift of length `shift` in any
    direction: X_j = R (X_i - center) + center + shift.

    Raises:
        ValueError: an axis of length zero.
    """
    turn_deg, shift = number(turn_deg, "turn_deg", least=-360.0, most=360.0), number(shift, "shift", most=MAX_LENGTH)
    kind_of(rng, np.random.Generator, "rng")
    center = finite(center, (3,), "center", most=MAX_LENGTH)
    about = rng.standard_normal(3) if axis is None else finite(axis, (3,), "axis", most=MAX_LENGTH)
    direction = rng.standard_normal(3)
    if not np.linalg.norm(about) > 1 / MAX_LENGTH:
        raise ValueError("axis: the axis of a turn must not be zero")
    rotation = Rotation.from_rotvec(np.deg2rad(turn_deg) * about / np.linalg.norm(about))
    moved = center - rotation.apply(center) + shift * direction / np.linalg.norm(direction)
    return RigidTransform.from_components(moved, rotation)


def simulate_matches(
    rig: Rig,
    body: Body,
    motion: RigidTransform,
    *,
    rng: np.random.Generator,
    per_camera: int = 60,
    noise_px: float = 0.5,
    outliers: float = 0.0,
    outlier_kind: OutlierKind = "uniform",
    other_motion: RigidTransform | None = None,
    occlusion: float = 0.0,
    dead: Sequence[str] = (),
    junk: Sequence[str] = (),
    start: RigidTransform | None = None,
    orthographic: bool = False,
) -> SimulatedPair:
    """What the cameras of a rig match while a body moves.

    A point is matched where it faces the camera and lies inside its image, in both frames; the body does not hide
    itself otherwise, so it should be convex. Points are projected to pixels through the lens, noise is added in both
    frames, and the lens is taken out again. Given `rng`'s state, the matches of a camera depend on its name and on
    nothing else about the rig: a subset of the rig sees the same.

    Args:
        motion: of the body in the world, from frame i to j.
        per_camera: matches per camera, outliers included; fewer where the body offers fewer visible points.
        noise_px: standard deviation per coordinate, pixels, in each frame.
        outliers: share of each camera's matches that are wrong.
        outlier_kind: "uniform" joins points of the body to places anywhere in its image region at j; "static" are
            points in its region that stand still; "second_motion" are points of a copy of the body, beside it, that
            moves by `other_motion`.
        other_motion: None draws one with the same angle about another axis through the copy.
        occlusion: share of the visible points that something in front hides: in each camera those on one side of a
            line across its image.
        dead: names of cameras without any match.
        junk: names of cameras all of whose matches are wrong, of the "uniform" kind at both ends.
        start: world_from_body at frame i; None is the identity.
        orthographic: points are scaled by the depth of the body's origin at frame i instead of by their own, in both
            frames (scaled orthographic views).

    Raises:
        ValueError: a camera that the rig does not have, a share outside [0, 1], an unknown kind, a negative number.
    """
    kind_of(rig, Rig, "rig"), kind_of(body, Body, "body"), kind_of(rng, np.random.Generator, "rng")
    for what, names in (("dead", dead), ("junk", junk)):
        for name in listed(names, str, what):
            if name not in rig.names:
                raise ValueError(f"{what}: no camera {shown(name)} in the rig ({one_line(', '.join(rig.names), 200)})")
    for what, pose in (("motion", motion), ("other_motion", other_motion), ("start", start)):
        if pose is not None or what == "motion":
            single_pose(pose, what)
    number(outliers, "outliers", least=0.0, most=1.0), number(noise_px, "noise_px", least=0.0, most=MAX_PX)
    if not number(occlusion, "occlusion", least=0.0, most=1.0) < 1:
        raise ValueError(f"occlusion must be in [0, 1), got {occlusion}")
    one_of(outlier_kind, get_args(OutlierKind), "outlier_kind")
    whole(per_camera, "per_camera"), truth(orthographic, "orthographic")

    start = RigidTransform.identity() if start is None else start
    key = int(rng.integers(2**63))
    # The copy's place and motion come from the pair's own stream: they are the same for all cameras.
    pair_rng = np.random.default_rng([key])
    aside = pair_rng.standard_normal(3)
    copy_start = RigidTransform.from_translation(body.radius * aside / np.linalg.norm(aside)) * start
    angle = np.rad2deg(motion.rotation.magnitude())
    drawn = random_motion(angle, body.radius / 10, pair_rng, center=copy_start.translation)
    other = drawn if other_motion is None else other_motion

    matches, masks, depths = [], [], []
    for camera in rig:
        stream = np.random.default_rng([key, zlib.crc32(camera.name.encode())])
        view = _View(camera, start.translation, orthographic)
        points_i, points_j, depth = view.visible(body, start, motion, stream, occlusion)
        count = 0 if camera.name in dead else min(per_camera, len(points_i))
        region_i, region_j = _region(points_i), _region(points_j)
        points_i, points_j, depth = points_i[:count].copy(), points_j[:count].copy(), depth[:count].copy()
        noise_i, noise_j = noise_px * stream.standard_normal((2, count, 2))

        wrong = np.zeros(count, dtype=bool)
        if camera.name in junk:
            wrong[:] = True
            points_i = stream.uniform(*region_i, (count, 2))
            points_j = stream.uniform(*region_j, (count, 2))
        else:
            wrong[stream.permutation(count)[: round(outliers * count)]] = True
            if outlier_kind == "uniform":
                points_j[wrong] = stream.uniform(*region_j, (wrong.sum(), 2))
            elif outlier_kind == "static":
                points_i[wrong] = points_j[wrong] = stream.uniform(*region_i, (wrong.sum(), 2))
            else:
                copy_i, copy_j, _ = view.visible(body, copy_start, other, stream, occlusion)
                wanted = np.flatnonzero(wrong)
                found = wanted[: len(copy_i)]
                points_i[found], points_j[found] = copy_i[: len(found)], copy_j[: len(found)]
                kept = np.setdiff1d(np.arange(count), wanted[len(copy_i) :])  # a copy out of sight gives fewer matches
                points_i, points_j, depth, wrong = points_i[kept], points_j[kept], depth[kept], wrong[kept]
                noise_i, noise_j = noise_i[kept], noise_j[kept]
        depth[wrong] = np.nan
        matches.append(Matches.from_pixels(camera, points_i + noise_i, points_j + noise_j))
        masks.append(wrong)
        depths.append(depth)
    return SimulatedPair(tuple(matches), tuple(masks), tuple(depths), motion, np.asarray(start.translation))


@dataclass(frozen=True)
class _View:
    """How one camera sees bodies: in perspective, or orthographically at the scale of a centre's depth."""

    camera: Camera
    center: FloatArray
    orthographic: bool

    def visible(
        self, body: Body, start: RigidTransform, motion: RigidTransform, rng: np.random.Generator, occlusion: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Pixels (m, 2) at i and j and depths (m,) at i of the points seen in both frames, in random order."""
        order = rng.permutation(len(body.points))
        line = rng.standard_normal(2)
        end = motion * start
        points_i, points_j = start.apply(body.points[order]), end.apply(body.points[order])
        facing = self._faces(points_i, start.rotation.apply(body.normals[order]))
        facing &= self._faces(points_j, end.rotation.apply(body.normals[order]))
        points_i, points_j = points_i[facing], points_j[facing]
        pixels_i, pixels_j = self._pixels(points_i), self._pixels(points_j)
        inside = self._inside(pixels_i) & self._inside(pixels_j)
        pixels_i, pixels_j, points_i = pixels_i[inside], pixels_j[inside], points_i[inside]
        if occlusion > 0 and len(pixels_i):
            along = pixels_i @ line
            shown = along >= np.quantile(along, occlusion)
            pixels_i, pixels_j, points_i = pixels_i[shown], pixels_j[shown], points_i[shown]
        return pixels_i, pixels_j, self.camera.camera_from_world.apply(points_i)[:, 2]

    def _faces(self, points: FloatArray, normals: FloatArray) -> BoolArray:
        if self.orthographic:
            cosines = -(normals @ self.camera.direction)
        else:
            towards = self.camera.center - points
            cosines = np.einsum("ni,ni->n", normals, towards) / np.linalg.norm(towards, axis=1)
        return np.asarray((cosines > GRAZING) | ~normals.any(axis=1))

    def _pixels(self, points: FloatArray) -> FloatArray:
        if not self.orthographic:
            return self.camera.project(points)
        pose = self.camera.camera_from_world
        scale = pose.apply(self.center)[2]
        if scale <= 0:
            return np.full((len(points), 2), np.nan)
        return self.camera.denormalize(pose.apply(points)[:, :2] / scale)

    def _inside(self, pixels: FloatArray) -> BoolArray:
        with np.errstate(invalid="ignore"):
            return np.asarray(((pixels >= 0) & (pixels <= np.array(self.camera.size) - 1)).all(axis=1))


def _region(pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The corners (2,), (2,) of the points' bounding box; zeros without points."""
    if not len(pixels):
        return np.zeros(2), np.zeros(2)
    return pixels.min(axis=0), pixels.max(axis=0)
