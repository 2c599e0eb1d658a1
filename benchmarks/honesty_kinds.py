"""Kinds of two-frame and of pose problems, the ordinary and the nasty, each with any number of seeded scenes."""

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

# The noise of keypoints that is taken for usual, pixels.
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
    """What the scenes of a kind are drawn from, evenly; turns and shifts evenly in their logarithm.

    Attributes:
        regular: nothing is unusual, so that the answer must be OK.
        bodies, cameras: names, and how many.
        rig: "around" on a zigzag ring or a dome; "any": two cameras at any angle from 5 to 180 degrees, at any height;
            "opposite": 180 degrees apart, give or take 5; "narrow": neighbours 2 to 15 degrees apart.
        turn, shift: degrees, metres.
        matches: per camera, wrong ones included.
        unequal: cameras have from 2 % to all of them.
        noise: times `EXPECTED_PX`.
        outliers, of: their share, and what they are.
        junk: all matches of one camera are wrong.
        untold: nothing in the matches can tell that the answer is wrong.
        turned, displaced: one camera against its calibration, degrees and metres.
        copies: so many times each match is given, all matches or a random part of them.
        size: so many times as large the known points are given as they are, of poses.
        lens: focal lengths and distances, times those of the ordinary scene.
    """

    regular: bool = False
    bodies: tuple[str, ...] = SOLID
    cameras: tuple[int, ...] = (3, 4, 8)
    rig: Literal["around", "any", "opposite", "narrow"] = "around"
    turn: Span = (2.0, 15.0)
    shift: Span = (0.01, 0.05)
    matches: tuple[int, int] = (40, 80)
    unequal: bool = False
    noise: float = 1.0
    outliers: Span = (0.0, 0.0)
    of: OutlierKind = "uniform"
    junk: bool = False
    untold: bool = False
    turned: Span | None = None
    displaced: Span = (0.0, 0.0)
    copies: tuple[int, ...] = ()
    size: Span | None = None
    lens: float = 1.0


class Problem(NamedTuple):
    """What an estimator is given, and the truth.

    Attributes:
        rig: as it is calibrated.
        matches: per camera, of two frames; empty for a pose.
        points, pixels: per camera, of a known object; empty for two frames.
        truths: the motion, or world_from_object; where two bodies have about as many matches, those of both.
        radius: of the object.
        calibrated: whether the rig stands as its calibration says.
    """

    rig: Rig
    matches: tuple[Matches, ...]
    points: tuple[FloatArray, ...]
    pixels: tuple[FloatArray, ...]
    truths: tuple[RigidTransform, ...]
    radius: float
    calibrated: bool = True


TWO, NEARLY_ALL = (2,), (2, 3, 4, 8)
MANY, SOME = (0.3, 0.6), (0.3, 0.5)
MOTIONS: dict[str, Kind] = {
    "solid": Kind(regular=True),
    "sphere": Kind(regular=True, bodies=("sphere",)),
    "bar": Kind(regular=True, bodies=("bar",)),
    "solid, wrong 30 to 50 %": Kind(regular=True, outliers=SOME),
    "solid, wrong 50 to 60 %": Kind(outliers=(0.5, 0.6)),
    "solid, unequal": Kind(matches=(60, 200), unequal=True),
    "solid, unequal, wrong 30 to 60 %": Kind(matches=(60, 200), unequal=True, outliers=MANY),
    "solid, long lens": Kind(lens=6.0),
    "solid, long lens, wrong 30 to 60 %": Kind(lens=6.0, outliers=MANY),
    "solid, tiny turn": Kind(turn=(0.05, 0.5), shift=(0.001, 0.02)),
    "solid, large turn": Kind(turn=(30.0, 80.0)),
    "solid, large turn, wrong 30 to 60 %": Kind(turn=(30.0, 80.0), outliers=MANY),
    "flat": Kind(bodies=FLAT),
    "flat, wrong 30 to 60 %": Kind(bodies=FLAT, outliers=MANY),
    "flat, long lens": Kind(bodies=FLAT, lens=6.0),
    "flat, tiny turn": Kind(bodies=FLAT, turn=(0.05, 0.5), shift=(0.001, 0.02)),
    "slab": Kind(bodies=("slab",)),
    "rod": Kind(bodies=("rod",), cameras=NEARLY_ALL),
    "one camera": Kind(bodies=(*SOLID, *FLAT), cameras=(1,)),
    "two cameras": Kind(cameras=TWO, rig="any"),
    "two cameras, wrong 30 to 60 %": Kind(cameras=TWO, rig="any", outliers=MANY),
    "two cameras, flat": Kind(bodies=FLAT, cameras=TWO, rig="any"),
    "two cameras, flat, wrong 30 to 50 %": Kind(bodies=FLAT, cameras=TWO, rig="any", outliers=SOME),
    "two cameras, flat, long lens": Kind(bodies=FLAT, cameras=TWO, rig="any", lens=6.0),
    "two cameras, long lens": Kind(cameras=TWO, rig="any", lens=6.0),
    "two opposite": Kind(cameras=TWO, rig="opposite"),
    "two opposite, flat": Kind(bodies=("board", "slab"), cameras=TWO, rig="opposite"),
    "two opposite, wrong 30 to 60 %": Kind(cameras=TWO, rig="opposite", outliers=MANY),
    "narrow": Kind(cameras=(2, 3, 4), rig="narrow"),
    "narrow, flat": Kind(bodies=("board", "slab"), cameras=(2, 3, 4), rig="narrow"),
    "narrow, wrong 30 to 60 %": Kind(cameras=(2, 3, 4), rig="narrow", outliers=MANY),
    "second 20 %": Kind(outliers=(0.2, 0.2), of="second_motion"),
    "second 40 %": Kind(outliers=(0.4, 0.4), of="second_motion"),
    "second 60 %": Kind(outliers=(0.6, 0.6), of="second_motion"),
    "second 40 %, flat": Kind(bodies=FLAT, outliers=(0.4, 0.4), of="second_motion"),
    "second 20 to 60 %, two cameras": Kind(cameras=TWO, rig="any", outliers=(0.2, 0.6), of="second_motion"),
    "static 30 to 60 %": Kind(outliers=MANY, of="static"),
    "static 30 to 60 %, small": Kind(turn=(0.3, 2.0), shift=(0.001, 0.005), outliers=MANY, of="static"),
    "static 30 to 60 %, two cameras": Kind(cameras=TWO, rig="any", outliers=MANY, of="static"),
    "junk": Kind(cameras=(3, 4), junk=True),
    "junk, two cameras": Kind(cameras=TWO, rig="any", junk=True),
    "junk, flat": Kind(bodies=FLAT, cameras=(3, 4), junk=True),
    "turned by 1 to 5": Kind(cameras=(3, 4), turned=(1.0, 5.0)),
    "turned by 5 to 90, displaced": Kind(cameras=(3, 4), turned=(5.0, 90.0), displaced=(0.01, 0.3)),
    "turned by 2 to 45, two cameras": Kind(cameras=TWO, rig="any", turned=(2.0, 45.0), untold=True),
    "noise x 3": Kind(bodies=(*SOLID, *FLAT), cameras=NEARLY_ALL, noise=3.0),
    "noise x 10": Kind(bodies=(*SOLID, *FLAT), cameras=NEARLY_ALL, noise=10.0),
    "noise x 10, wrong 30 to 60 %": Kind(bodies=(*SOLID, *FLAT), cameras=NEARLY_ALL, noise=10.0, outliers=MANY),
    "copies": Kind(matches=(10, 60), copies=(2, 5, 20)),
    "copies, wrong 30 to 60 %": Kind(matches=(10, 60), copies=(2, 5, 20), outliers=MANY),
    "copies, few": Kind(bodies=(*SOLID, *FLAT), cameras=(2, 3, 4), matches=(4, 12), copies=(2, 5, 20)),
    "few": Kind(bodies=(*SOLID, *FLAT), matches=(4, 12)),
    "few, wrong 30 to 60 %": Kind(bodies=(*SOLID, *FLAT), matches=(4, 12), outliers=MANY),
    "few, two cameras": Kind(bodies=(*SOLID, *FLAT), cameras=TWO, rig="any", matches=(4, 12)),
    "all wrong": Kind(bodies=(*SOLID, *FLAT), cameras=NEARLY_ALL, outliers=(1.0, 1.0)),
}
POSES: dict[str, Kind] = {
    "pose": Kind(regular=True, bodies=(*SOLID, *FLAT)),
    "pose, wrong 30 to 60 %": Kind(bodies=(*SOLID, *FLAT), outliers=MANY),
    "pose, wrong 70 to 95 %": Kind(bodies=(*SOLID, *FLAT), cameras=(1, 2, 4), outliers=(0.7, 0.95)),
    "pose, one camera": Kind(bodies=SOLID, cameras=(1,)),
    "pose, one camera, flat, long lens": Kind(bodies=("board", "slab"), cameras=(1,), lens=6.0),
    "pose, two cameras, flat": Kind(bodies=("board", "slab"), cameras=TWO, rig="any", matches=(4, 40)),
    "pose, few": Kind(bodies=(*SOLID, *FLAT), cameras=(1, 2, 3, 4), matches=(2, 8)),
    "pose, few, wrong 30 to 60 %": Kind(bodies=(*SOLID, *FLAT), cameras=(1, 2, 3, 4), matches=(3, 12), outliers=MANY),
    "pose, junk": Kind(cameras=(2, 3, 4), junk=True),
    "pose, turned by 1 to 45": Kind(cameras=(3, 4), turned=(1.0, 45.0)),
    "pose, turned by 5 to 45, two cameras": Kind(cameras=TWO, rig="any", turned=(5.0, 45.0)),
    "pose, noise x 10": Kind(bodies=(*SOLID, *FLAT), cameras=(1, 2, 4), noise=10.0),
    "pose, another size": Kind(bodies=(*SOLID, *FLAT), cameras=(2, 3, 4, 8), matches=(8, 80), size=(1e-3, 1e3)),
    "pose, copies": Kind(
        bodies=(*SOLID, *FLAT), cameras=(1, 2, 4), matches=(3, 20), copies=(2, 5, 20), outliers=(0.0, 0.5)
    ),
}


def make_problem(name: str, seed: int) -> Problem:
    """Scene number `seed` of a kind: the same in every run."""
    kind = MOTIONS[name] if name in MOTIONS else POSES[name]
    rng = np.random.default_rng([zlib.crc32(name.encode()), seed])
    body = BODIES[str(rng.choice(kind.bodies))]
    rig = _rig(kind, rng)
    start = RigidTransform.from_components(rng.uniform(-0.02, 0.02, 3), Rotation.random(rng=rng))
    motion = _motion(kind, rng, start.translation) if name in MOTIONS else RigidTransform.identity()
    other = _motion(kind, rng, start.translation)
    seen_by, bad = rig, int(rng.integers(len(rig)))
    if kind.turned is not None:
        wrong = _disturbed(rig.cameras[bad], rng, rng.uniform(*kind.turned), rng.uniform(*kind.displaced))
        seen_by = Rig([wrong if c == bad else camera for c, camera in enumerate(rig)], rig.unit)
    pair = simulate_matches(
        seen_by,
        body,
        motion,
        rng=rng,
        per_camera=int(rng.integers(kind.matches[0], kind.matches[1] + 1)),
        noise_px=kind.noise * EXPECTED_PX if name in MOTIONS else 0.0,
        outliers=float(rng.uniform(*kind.outliers)) if name in MOTIONS else 0.0,
        outlier_kind=kind.of,
        other_motion=other,
        junk=rig.names[bad : bad + 1] if kind.junk else (),
        start=start,
    )
    if name in POSES:
        return _pose_problem(kind, rig, seen_by, pair, start, body.radius, rng, bad)
    kept = [_kept(kind, len(m), rng) for m in pair.matches]
    matches = tuple(Matches(m.x[k], m.y[k]) for m, k in zip(pair.matches, kept, strict=True))
    wrong_ones = [w[k] for w, k in zip(pair.is_outlier, kept, strict=True)]
    share = sum(w.sum() for w in wrong_ones) / max(sum(map(len, wrong_ones)), 1)
    truths: tuple[RigidTransform, ...] = (motion,)
    if kind.of == "second_motion" and share > 0.45:
        truths = (other,) if share > 0.55 else (motion, other)
    return Problem(rig, matches, (), (), truths, body.radius, kind.turned is None)


def _pose_problem(
    kind: Kind,
    rig: Rig,
    seen_by: Rig,
    pair: SimulatedPair,
    start: RigidTransform,
    radius: float,
    rng: np.random.Generator,
    bad: int,
) -> Problem:
    """Points of the body where each camera sees them, with noise in their pixels alone."""
    points, pixels = [], []
    share = rng.uniform(*kind.outliers)
    size = 1.0 if kind.size is None else float(np.exp(rng.uniform(*np.log(kind.size))))
    for c, (camera, m, depth) in enumerate(zip(seen_by, pair.matches, pair.depths, strict=True)):
        kept = _kept(kind, len(m), rng)
        if kind.junk and c == bad:
            known = start.inv().apply(start.translation + 0.1 * rng.standard_normal((len(m), 3)))
        else:
            rays = np.column_stack([m.x, np.ones(len(m))]) * depth[:, None]
            known = (start.inv() * camera.camera_from_world.inv()).apply(rays) if len(m) else np.empty((0, 3))
        seen = camera.denormalize(m.x) + kind.noise * EXPECTED_PX * rng.standard_normal(m.x.shape)
        if len(m):
            wrong = rng.permutation(len(m))[: round(share * len(m))]
            seen[wrong] = rng.uniform(seen.min(axis=0), seen.max(axis=0), (len(wrong), 2))
        points.append(size * known[kept])
        pixels.append(seen[kept])
    return Problem(rig, (), tuple(points), tuple(pixels), (start,), radius, kind.turned is None)


def _rig(kind: Kind, rng: np.random.Generator) -> Rig:
    n, away, focal = int(rng.choice(kind.cameras)), 1.5 * kind.lens, 1000.0 * kind.lens
    if kind.rig == "around" and n > 1:
        if n > 2 and rng.random() < 0.3:
            return dome(n, away, focal)
        zigzag = [rng.uniform(0.1, 0.5) * away * (-1) ** k for k in range(n)]
        return (
            ring(n, away, focal, height=zigzag) if n > 2 else arc(2, rng.uniform(40, 140), away, focal, height=zigzag)
        )
    if kind.rig == "narrow":
        return arc(n, rng.uniform(2.0, 15.0), away, focal, height=rng.uniform(-0.05, 0.05, n) * away)
    apart = 180.0 + rng.uniform(-5.0, 5.0) if kind.rig == "opposite" else rng.uniform(5.0, 180.0)
    height = rng.uniform(-0.02, 0.02, n) if kind.rig == "opposite" else rng.uniform(-0.5, 0.5, n)
    return arc(n, apart, away, focal, height=height * away)


def _motion(kind: Kind, rng: np.random.Generator, center: FloatArray) -> RigidTransform:
    turn, shift = (float(np.exp(rng.uniform(*np.log(span)))) for span in (kind.turn, kind.shift))
    return random_motion(turn, shift, rng, center=center)


def _disturbed(camera: Camera, rng: np.random.Generator, degrees: float, length: float) -> Camera:
    """The camera, turned about any axis through its centre and moved in any direction."""
    axis, by = rng.standard_normal((2, 3))
    turn = RigidTransform.from_rotation(Rotation.from_rotvec(np.deg2rad(degrees) * axis / np.linalg.norm(axis)))
    move = RigidTransform.from_translation(length * by / np.linalg.norm(by))
    return replace(camera, camera_from_world=turn * camera.camera_from_world * move)


def _kept(kind: Kind, count: int, rng: np.random.Generator) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Which matches of a camera are given, some of them several times."""
    index = np.arange(count)
    if kind.unequal and count:
        index = index[: max(1, round(count * float(np.exp(rng.uniform(np.log(0.02), 0.0)))))]
    if kind.copies and count:
        times = int(rng.choice(kind.copies))
        part = index if rng.random() < 0.5 else index[rng.random(count) < rng.uniform(0.1, 0.9)]
        index = rng.permutation(np.concatenate([index, np.repeat(part, times - 1)]))
    return index
