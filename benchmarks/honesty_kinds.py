"""Kinds of two-frame and pose problems, regular and hard ones, each with any number of seeded scenes.

A kind's name is part of the seed of its scenes.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.matches import Matches
from sylpose.rig import Camera, Rig
from sylpose.simulate import (
    Body,
    OutlierKind,
    SimulatedPair,
    arc,
    box,
    dome,
    ellipsoid,
    plane,
    random_motion,
    ring,
    simulate_matches,
)

__all__ = ["EXPECTED_PX", "MOTIONS", "POSES", "Kind", "Problem", "make_problem"]

# Usual keypoint noise, pixels.
EXPECTED_PX = 0.5
BODIES: dict[str, Body] = {
    "ellipsoid": ellipsoid((0.15, 0.12, 0.1)),
    "sphere": ellipsoid((0.12, 0.12, 0.12)),
    "box": box((0.25, 0.2, 0.15)),
    "board": plane((0.3, 0.2)),
    "slab": box((0.3, 0.2, 0.006)),
    "bar": box((0.5, 0.05, 0.04)),
    "rod": box((0.6, 0.01, 0.01)),
}
SOLID, FLAT = ("ellipsoid", "box"), ("board",)
Span = tuple[float, float]


@dataclass(frozen=True)
class Kind:
    """Distributions of the scenes of a kind: uniform, and log-uniform for rotations and translations.

    Attributes:
        is_regular: an ordinary problem, whose result must be OK.
        bodies, cameras: names of bodies, and numbers of cameras.
        rig: "around": zigzag ring or dome; "any": two cameras 5 to 180 degrees apart, at any height; "opposite": 175 to
            185 degrees apart; "narrow": neighbors 2 to 15 degrees apart.
        rotation_deg, translation_m: ranges of the motion.
        matches: range of the number of matches per camera, outliers included.
        has_unequal_counts: each camera keeps between 2 % and all of its matches.
        noise_factor: noise in units of `EXPECTED_PX`.
        outliers, outlier_kind: range of the outlier ratio, and the kind of outliers.
        has_junk_camera: all matches of one camera are outliers.
        is_undetectable: the matches contain no evidence of the error; the kind is not counted.
        camera_rotation_deg, camera_translation_m: ranges of one camera's calibration error.
        copies: numbers of copies per match, of all matches or of a random part.
        copy_px: noise of each copy, in addition to that of the match, pixels.
        drift_px: range of the rms of an error that varies smoothly over the image, as of features that drift, pixels.
        model_scale: range of the scale error of the known points of pose problems.
        focal_factor: factor of focal lengths and distances.
        axes: pixels are counted along these axes instead of to the right and down.
    """

    is_regular: bool = False
    bodies: tuple[str, ...] = SOLID
    cameras: tuple[int, ...] = (3, 4, 8)
    rig: Literal["around", "any", "opposite", "narrow"] = "around"
    rotation_deg: Span = (2.0, 15.0)
    translation_m: Span = (0.01, 0.05)
    matches: tuple[int, int] = (40, 80)
    has_unequal_counts: bool = False
    noise_factor: float = 1.0
    outliers: Span = (0.0, 0.0)
    outlier_kind: OutlierKind = "uniform"
    has_junk_camera: bool = False
    is_undetectable: bool = False
    camera_rotation_deg: Span | None = None
    camera_translation_m: Span = (0.0, 0.0)
    copies: tuple[int, ...] = ()
    copy_px: float = 0.0
    drift_px: Span | None = None
    model_scale: Span | None = None
    focal_factor: float = 1.0
    axes: tuple[Span, Span] | None = None


class Problem(NamedTuple):
    """Input of an estimator, and the truth.

    Attributes:
        rig: the rig as calibrated.
        matches: per camera, of two frames; empty for a pose problem.
        points, pixels: per camera, of a known object; empty for a two-frame problem.
        truths: motion or world_from_object; of both bodies if two have about equally many matches.
        radius: radius of the object.
        calibrated: the calibration is correct.
    """

    rig: Rig
    matches: tuple[Matches, ...]
    points: tuple[FloatArray, ...]
    pixels: tuple[FloatArray, ...]
    truths: tuple[RigidTransform, ...]
    radius: float
    is_calibrated: bool = True


TWO_CAMERAS, UP_TO_EIGHT_CAMERAS = (2,), (2, 3, 4, 8)
OUTLIERS_30_60, OUTLIERS_30_50 = (0.3, 0.6), (0.3, 0.5)
MOTIONS: dict[str, Kind] = {
    "solid": Kind(is_regular=True),
    "sphere": Kind(is_regular=True, bodies=("sphere",)),
    "bar": Kind(is_regular=True, bodies=("bar",)),
    "solid, wrong 30 to 50 %": Kind(is_regular=True, outliers=OUTLIERS_30_50),
    "solid, wrong 50 to 60 %": Kind(outliers=(0.5, 0.6)),
    "solid, unequal": Kind(matches=(60, 200), has_unequal_counts=True),
    "solid, unequal, wrong 30 to 60 %": Kind(matches=(60, 200), has_unequal_counts=True, outliers=OUTLIERS_30_60),
    "solid, long lens": Kind(focal_factor=6.0),
    "solid, long lens, wrong 30 to 60 %": Kind(focal_factor=6.0, outliers=OUTLIERS_30_60),
    "solid, tiny turn": Kind(rotation_deg=(0.05, 0.5), translation_m=(0.001, 0.02)),
    "solid, large turn": Kind(rotation_deg=(30.0, 80.0)),
    "solid, large turn, wrong 30 to 60 %": Kind(rotation_deg=(30.0, 80.0), outliers=OUTLIERS_30_60),
    "flat": Kind(bodies=FLAT),
    "flat, wrong 30 to 60 %": Kind(bodies=FLAT, outliers=OUTLIERS_30_60),
    "flat, long lens": Kind(bodies=FLAT, focal_factor=6.0),
    "flat, tiny turn": Kind(bodies=FLAT, rotation_deg=(0.05, 0.5), translation_m=(0.001, 0.02)),
    "slab": Kind(bodies=("slab",)),
    "rod": Kind(bodies=("rod",), cameras=UP_TO_EIGHT_CAMERAS),
    "one camera": Kind(bodies=(*SOLID, *FLAT), cameras=(1,)),
    "two cameras": Kind(cameras=TWO_CAMERAS, rig="any"),
    "two cameras, wrong 30 to 60 %": Kind(cameras=TWO_CAMERAS, rig="any", outliers=OUTLIERS_30_60),
    "two cameras, flat": Kind(bodies=FLAT, cameras=TWO_CAMERAS, rig="any"),
    "two cameras, flat, wrong 30 to 50 %": Kind(bodies=FLAT, cameras=TWO_CAMERAS, rig="any", outliers=OUTLIERS_30_50),
    "two cameras, flat, long lens": Kind(bodies=FLAT, cameras=TWO_CAMERAS, rig="any", focal_factor=6.0),
    "two cameras, long lens": Kind(cameras=TWO_CAMERAS, rig="any", focal_factor=6.0),
    "two opposite": Kind(cameras=TWO_CAMERAS, rig="opposite"),
    "two opposite, flat": Kind(bodies=("board", "slab"), cameras=TWO_CAMERAS, rig="opposite"),
    "two opposite, wrong 30 to 60 %": Kind(cameras=TWO_CAMERAS, rig="opposite", outliers=OUTLIERS_30_60),
    "narrow": Kind(cameras=(2, 3, 4), rig="narrow"),
    "narrow, flat": Kind(bodies=("board", "slab"), cameras=(2, 3, 4), rig="narrow"),
    "narrow, wrong 30 to 60 %": Kind(cameras=(2, 3, 4), rig="narrow", outliers=OUTLIERS_30_60),
    "second 20 %": Kind(outliers=(0.2, 0.2), outlier_kind="second_motion"),
    "second 40 %": Kind(outliers=(0.4, 0.4), outlier_kind="second_motion"),
    "second 60 %": Kind(outliers=(0.6, 0.6), outlier_kind="second_motion"),
    "second 40 %, flat": Kind(bodies=FLAT, outliers=(0.4, 0.4), outlier_kind="second_motion"),
    "second 20 to 60 %, two cameras": Kind(
        cameras=TWO_CAMERAS, rig="any", outliers=(0.2, 0.6), outlier_kind="second_motion"
    ),
    "static 30 to 60 %": Kind(outliers=OUTLIERS_30_60, outlier_kind="static"),
    "static 30 to 60 %, small": Kind(
        rotation_deg=(0.3, 2.0), translation_m=(0.001, 0.005), outliers=OUTLIERS_30_60, outlier_kind="static"
    ),
    "static 30 to 60 %, two cameras": Kind(
        cameras=TWO_CAMERAS, rig="any", outliers=OUTLIERS_30_60, outlier_kind="static"
    ),
    "junk": Kind(cameras=(3, 4), has_junk_camera=True),
    "junk, two cameras": Kind(cameras=TWO_CAMERAS, rig="any", has_junk_camera=True),
    "junk, flat": Kind(bodies=FLAT, cameras=(3, 4), has_junk_camera=True),
    "turned by 1 to 5": Kind(cameras=(3, 4), camera_rotation_deg=(1.0, 5.0)),
    "turned by 5 to 90, displaced": Kind(
        cameras=(3, 4), camera_rotation_deg=(5.0, 90.0), camera_translation_m=(0.01, 0.3)
    ),
    "turned by 2 to 45, two cameras": Kind(
        cameras=TWO_CAMERAS, rig="any", camera_rotation_deg=(2.0, 45.0), is_undetectable=True
    ),
    "y upwards": Kind(bodies=(*SOLID, *FLAT), axes=((1.0, 0.0), (0.0, -1.0))),
    "x to the left": Kind(bodies=(*SOLID, *FLAT), axes=((-1.0, 0.0), (0.0, 1.0))),
    "row, column": Kind(bodies=(*SOLID, *FLAT), axes=((0.0, 1.0), (1.0, 0.0))),
    "noise x 3": Kind(bodies=(*SOLID, *FLAT), cameras=UP_TO_EIGHT_CAMERAS, noise_factor=3.0),
    "noise x 10": Kind(bodies=(*SOLID, *FLAT), cameras=UP_TO_EIGHT_CAMERAS, noise_factor=10.0),
    "noise x 10, wrong 30 to 60 %": Kind(
        bodies=(*SOLID, *FLAT), cameras=UP_TO_EIGHT_CAMERAS, noise_factor=10.0, outliers=OUTLIERS_30_60
    ),
    "copies": Kind(matches=(10, 60), copies=(2, 5, 20)),
    "copies, wrong 30 to 60 %": Kind(matches=(10, 60), copies=(2, 5, 20), outliers=OUTLIERS_30_60),
    "copies, few": Kind(bodies=(*SOLID, *FLAT), cameras=(2, 3, 4), matches=(4, 12), copies=(2, 5, 20)),
    "near copies": Kind(copies=(2, 3, 5), copy_px=0.15),
    "near copies, wrong 30 to 60 %": Kind(copies=(2, 3, 5), copy_px=0.15, outliers=OUTLIERS_30_60),
    "drift": Kind(drift_px=(0.2, 1.0)),
    "drift, two cameras": Kind(cameras=TWO_CAMERAS, rig="any", drift_px=(0.2, 1.0)),
    "few": Kind(bodies=(*SOLID, *FLAT), matches=(4, 12)),
    "few, wrong 30 to 60 %": Kind(bodies=(*SOLID, *FLAT), matches=(4, 12), outliers=OUTLIERS_30_60),
    "few, two cameras": Kind(bodies=(*SOLID, *FLAT), cameras=TWO_CAMERAS, rig="any", matches=(4, 12)),
    "all wrong": Kind(bodies=(*SOLID, *FLAT), cameras=UP_TO_EIGHT_CAMERAS, outliers=(1.0, 1.0)),
}
POSES: dict[str, Kind] = {
    "pose": Kind(is_regular=True, bodies=(*SOLID, *FLAT)),
    "pose, wrong 30 to 60 %": Kind(bodies=(*SOLID, *FLAT), outliers=OUTLIERS_30_60),
    "pose, wrong 70 to 95 %": Kind(bodies=(*SOLID, *FLAT), cameras=(1, 2, 4), outliers=(0.7, 0.95)),
    "pose, one camera": Kind(bodies=SOLID, cameras=(1,)),
    "pose, one camera, flat, long lens": Kind(bodies=("board", "slab"), cameras=(1,), focal_factor=6.0),
    "pose, two cameras, flat": Kind(bodies=("board", "slab"), cameras=TWO_CAMERAS, rig="any", matches=(4, 40)),
    "pose, few": Kind(bodies=(*SOLID, *FLAT), cameras=(1, 2, 3, 4), matches=(2, 8)),
    "pose, few, wrong 30 to 60 %": Kind(
        bodies=(*SOLID, *FLAT), cameras=(1, 2, 3, 4), matches=(3, 12), outliers=OUTLIERS_30_60
    ),
    "pose, junk": Kind(cameras=(2, 3, 4), has_junk_camera=True),
    "pose, turned by 1 to 45": Kind(cameras=(3, 4), camera_rotation_deg=(1.0, 45.0)),
    "pose, turned by 5 to 45, two cameras": Kind(cameras=TWO_CAMERAS, rig="any", camera_rotation_deg=(5.0, 45.0)),
    "pose, noise x 10": Kind(bodies=(*SOLID, *FLAT), cameras=(1, 2, 4), noise_factor=10.0),
    "pose, another size": Kind(bodies=(*SOLID, *FLAT), cameras=(2, 3, 4, 8), matches=(8, 80), model_scale=(1e-3, 1e3)),
    "pose, copies": Kind(
        bodies=(*SOLID, *FLAT), cameras=(1, 2, 4), matches=(3, 20), copies=(2, 5, 20), outliers=(0.0, 0.5)
    ),
}


def _count_along(camera: Camera, points: FloatArray, axes: tuple[Span, Span] | None) -> FloatArray:
    """Return the normalized points (n, 2) that a camera takes others for whose pixels are counted along other axes."""
    if axes is None:
        return points
    directions = np.array(axes)
    first = np.where(directions.sum(axis=1) < 0.0, np.array(camera.size) - 1.0, 0.0)
    return camera.normalize(camera.denormalize(points) @ directions.T + first)


def make_problem(name: str, seed: int, *, has_right_axes: bool = False) -> Problem:
    """Make scene number `seed` of a kind, the same in every run; with the right axes of pixels if requested."""
    kind = MOTIONS[name] if name in MOTIONS else POSES[name]
    rng = np.random.default_rng([zlib.crc32(name.encode()), seed])
    body = BODIES[str(rng.choice(kind.bodies))]
    rig = _draw_rig(kind, rng)
    start = RigidTransform.from_components(rng.uniform(-0.02, 0.02, 3), Rotation.random(rng=rng))
    motion = _draw_motion(kind, rng, start.translation) if name in MOTIONS else RigidTransform.identity()
    other = _draw_motion(kind, rng, start.translation)
    true_rig, faulty_camera = rig, int(rng.integers(len(rig)))
    if kind.camera_rotation_deg is not None:
        perturbed = _perturb_camera(
            rig.cameras[faulty_camera],
            rng,
            rng.uniform(*kind.camera_rotation_deg),
            rng.uniform(*kind.camera_translation_m),
        )
        true_rig = Rig([perturbed if c == faulty_camera else camera for c, camera in enumerate(rig)], rig.unit)
    pair = simulate_matches(
        true_rig,
        body,
        motion,
        rng=rng,
        per_camera=int(rng.integers(kind.matches[0], kind.matches[1] + 1)),
        noise_px=kind.noise_factor * EXPECTED_PX if name in MOTIONS else 0.0,
        outliers=float(rng.uniform(*kind.outliers)) if name in MOTIONS else 0.0,
        outlier_kind=other if kind.outlier_kind == "second_motion" else kind.outlier_kind,
        junk=rig.names[faulty_camera : faulty_camera + 1] if kind.has_junk_camera else (),
        start=start,
    )
    if name in POSES:
        return _make_pose_problem(kind, rig, true_rig, pair, start, body.radius, rng, faulty_camera)
    selected = [_select_matches(kind, len(m), rng) for m in pair.matches]
    matches = tuple(
        Matches(
            *(
                _count_along(camera, points, None if has_right_axes else kind.axes)
                for points in _add_shared_errors(kind, camera, m.x[k], m.y[k], rng)
            )
        )
        for camera, m, k in zip(rig, pair.matches, selected, strict=True)
    )
    is_outlier = [w[k] for w, k in zip(pair.is_outlier, selected, strict=True)]
    share = sum(w.sum() for w in is_outlier) / max(sum(map(len, is_outlier)), 1)
    truths: tuple[RigidTransform, ...] = (motion,)
    if kind.outlier_kind == "second_motion" and share > 0.45:
        truths = (other,) if share > 0.55 else (motion, other)
    return Problem(rig, matches, (), (), truths, body.radius, kind.camera_rotation_deg is None and not kind.axes)


def _make_pose_problem(
    kind: Kind,
    rig: Rig,
    true_rig: Rig,
    pair: SimulatedPair,
    start: RigidTransform,
    radius: float,
    rng: np.random.Generator,
    faulty_camera: int,
) -> Problem:
    """Make a pose problem from the points that each camera sees; only their pixels are noisy."""
    points, pixels = [], []
    share = rng.uniform(*kind.outliers)
    size = 1.0 if kind.model_scale is None else float(np.exp(rng.uniform(*np.log(kind.model_scale))))
    for c, (camera, m, depth) in enumerate(zip(true_rig, pair.matches, pair.depths, strict=True)):
        selected = _select_matches(kind, len(m), rng)
        if kind.has_junk_camera and c == faulty_camera:
            model_points = start.inv().apply(start.translation + 0.1 * rng.standard_normal((len(m), 3)))
        else:
            rays = np.column_stack([m.x, np.ones(len(m))]) * depth[:, None]
            model_points = (start.inv() * camera.camera_from_world.inv()).apply(rays) if len(m) else np.empty((0, 3))
        noisy_pixels = camera.denormalize(m.x) + kind.noise_factor * EXPECTED_PX * rng.standard_normal(m.x.shape)
        if len(m):
            wrong = rng.permutation(len(m))[: round(share * len(m))]
            noisy_pixels[wrong] = rng.uniform(noisy_pixels.min(axis=0), noisy_pixels.max(axis=0), (len(wrong), 2))
        points.append(size * model_points[selected])
        pixels.append(noisy_pixels[selected])
    return Problem(rig, (), tuple(points), tuple(pixels), (start,), radius, kind.camera_rotation_deg is None)


def _draw_rig(kind: Kind, rng: np.random.Generator) -> Rig:
    n, distance, focal = int(rng.choice(kind.cameras)), 1.5 * kind.focal_factor, 1000.0 * kind.focal_factor
    if kind.rig == "around" and n > 1:
        if n > 2 and rng.random() < 0.3:
            return dome(n, distance, focal)
        zigzag = [rng.uniform(0.1, 0.5) * distance * (-1) ** k for k in range(n)]
        return (
            ring(n, distance, focal, height=zigzag)
            if n > 2
            else arc(2, rng.uniform(40, 140), distance, focal, height=zigzag)
        )
    if kind.rig == "narrow":
        return arc(n, rng.uniform(2.0, 15.0), distance, focal, height=rng.uniform(-0.05, 0.05, n) * distance)
    spacing_deg = 180.0 + rng.uniform(-5.0, 5.0) if kind.rig == "opposite" else rng.uniform(5.0, 180.0)
    height = rng.uniform(-0.02, 0.02, n) if kind.rig == "opposite" else rng.uniform(-0.5, 0.5, n)
    return arc(n, spacing_deg, distance, focal, height=height * distance)


def _draw_motion(kind: Kind, rng: np.random.Generator, center: FloatArray) -> RigidTransform:
    rotation_deg, translation_m = (
        float(np.exp(rng.uniform(*np.log(span)))) for span in (kind.rotation_deg, kind.translation_m)
    )
    return random_motion(rotation_deg, translation_m, rng, center=center)


def _perturb_camera(camera: Camera, rng: np.random.Generator, degrees: float, length: float) -> Camera:
    """Rotate a camera about a random axis through its center and translate it in a random direction."""
    axis, by = rng.standard_normal((2, 3))
    turn = RigidTransform.from_rotation(Rotation.from_rotvec(np.deg2rad(degrees) * axis / np.linalg.norm(axis)))
    move = RigidTransform.from_translation(length * by / np.linalg.norm(by))
    return replace(camera, camera_from_world=turn * camera.camera_from_world * move)


def _add_shared_errors(
    kind: Kind, camera: Camera, x: FloatArray, y: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return matches (n, 2) with errors that differ from copy to copy, or little from place to place."""
    if kind.copy_px:
        x, y = (points + kind.copy_px / camera.focal * rng.standard_normal(points.shape) for points in (x, y))
    if kind.drift_px is not None and len(x):
        centered = x - x.mean(axis=0)
        u = centered / np.abs(centered).max()
        field = np.column_stack([np.ones(len(u)), u, u**2]) @ rng.standard_normal((5, 2))
        y = y + rng.uniform(*kind.drift_px) * field / np.sqrt((field**2).sum(axis=1).mean() / 2) / camera.focal
    return x, y


def _select_matches(kind: Kind, count: int, rng: np.random.Generator) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Return the indices of a camera's matches to use, with repetitions if the kind has copies."""
    index = np.arange(count)
    if kind.has_unequal_counts and count:
        index = index[: max(1, round(count * float(np.exp(rng.uniform(np.log(0.02), 0.0)))))]
    if kind.copies and count:
        times = int(rng.choice(kind.copies))
        part = index if rng.random() < 0.5 else index[rng.random(count) < rng.uniform(0.1, 0.9)]
        index = rng.permutation(np.concatenate([index, np.repeat(part, times - 1)]))
    return index
