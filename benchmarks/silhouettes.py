"""Surface errors of objects carved from their silhouettes (`carve_object`), rendered with known bodies and poses.

    python benchmarks/silhouettes.py [--seeds 3] [--first 0] [--frames 31] [--kinds NAME ...] [--tracked]

Plain bodies move and turn before four cameras. Errors are distances of the mesh's vertices from the true surface, in percent
of the body's size; the worst seed of each kind is reported, and the area that no vertex represents is not (concave places).
With `--tracked` the bodies have texture, and the poses are those of `track` with smoothing off.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from benchmarks.kinds_feature_poor import reduce_contrast
from benchmarks.kinds_scenes import draw_block, draw_rounded_body, texture_resolution
from benchmarks.trust_effects import cast_shadows, scale_brightness
from benchmarks.trust_people import add_actors, add_person, make_person
from benchmarks.trust_takes import Take, draw_motion, draw_photo, draw_trust_rig, warn_without_photographs
from sylpose import FrameSet, carve_object, track
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Rig
from sylpose.simulate import Actor, Scene, TexturedBody

SIZE = (480, 360)
Body = Callable[[np.random.Generator, Rig, float], list[TexturedBody]]


def draw_irregular(rng: np.random.Generator, rig: Rig, radius: float) -> list[TexturedBody]:
    """Draw a block with two smaller ones on its sides: concave edges."""
    parts = []
    for center, sides in (
        ([0, 0, 0], [1.3, 0.5, 0.6]),
        ([0.45, 0.45, 0.05], [0.4, 0.6, 0.45]),
        ([-0.4, -0.1, 0.4], [0.35, 0.3, 0.5]),
    ):
        half = radius * np.array(sides) / 2 * rng.uniform(0.85, 1.0, 3)
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
        parts.append(TexturedBody.from_hull(corners + radius * np.array(center), texture_resolution(rig)))
    return parts


def draw_plain_take(
    rng: np.random.Generator,
    body: Body,
    frames: int,
    *,
    color: float | None = None,
    texture: float = 0.0,
    travel: float = 0.6,
) -> Take:
    """Draw a take of a body of one color (None: a random one) that turns by half a turn or more."""
    rig, radius = draw_trust_rig(rng, 4, share=0.55, size=SIZE)
    path = draw_motion(rng, radius, float(rng.uniform(200, 360)) / frames, travel=travel)
    bodies = []
    paint = rng.uniform(30, 225, 3) if color is None else np.full(3, color)
    for part in body(rng, rig, radius):
        faded = reduce_contrast(part, texture)
        if not texture:
            faded = replace(faded, textures=tuple(np.zeros_like(t) + paint.astype(np.uint8) for t in faded.textures))
        bodies.append(faded)
    scene = Scene(rig, tuple(Actor(part, path) for part in bodies), frames, int(rng.integers(1 << 30)), 2.0)
    return Take(scene, None, radius)


def convex(draw: Callable[[np.random.Generator, Rig, float], TexturedBody]) -> Body:
    return lambda rng, rig, radius: [draw(rng, rig, radius)]


def make_take(kind: str, rng: np.random.Generator, frames: int, texture: float) -> Take:
    """Draw a take of a kind; see `KINDS`."""
    bodies: dict[str, Body] = {"block": convex(draw_block), "rounded": convex(draw_rounded_body)}
    body = bodies.get(kind, draw_irregular)
    travel = 0.15 if kind == "turns in place" else 0.6
    take = draw_plain_take(rng, body, frames, color=115.0 if kind == "gray" else None, texture=texture, travel=travel)
    if kind == "photograph behind":
        take = replace(take, photos=tuple(draw_photo(rng, camera.size) for camera in take.scene.rig))
    if kind == "person behind":
        take = add_person(take, rng)
    if kind == "passer-by":
        speed = 40.0 / frames * float(rng.uniform(0.15, 0.3))
        walker = make_person(rng, take.scene.rig, take.radius, behind=2.5, aside=-frames / 2 * speed, walk=speed)
        take = add_actors(take, walker)
    if kind == "shadows":
        start, drift = rng.choice([-1, 1], (1, 4, 2)) * rng.uniform(30, 90, (1, 4, 2)), rng.uniform(-60, 60, (1, 4, 2))
        shifts = start + np.linspace(0, 1, frames)[:, None, None] * drift
        take = replace(take, effects=(cast_shadows(shifts, float(rng.uniform(0.3, 0.6)), 1.1),))
    if kind == "exposure":
        take = replace(take, effects=(scale_brightness(rng.uniform(0.7, 1.1, (frames, 4))),))
    return take


KINDS = (
    "block",
    "rounded",
    "irregular",
    "turns in place",
    "gray",
    "photograph behind",
    "person behind",
    "passer-by",
    "shadows",
    "exposure",
)


def measure_surface(parts: Sequence[TexturedBody], points: FloatArray) -> FloatArray:
    """Return signed distances (n,) of points near the surface of convex parts together, positive outside."""
    of_parts = []
    for part in parts:
        on_faces = part.vertices[[face[0] for face in part.faces]]
        of_parts.append((points @ part.normals.T - (part.normals * on_faces).sum(axis=1)).max(axis=1))
    return np.asarray(np.min(of_parts, axis=0))


def evaluate(kind: str, seed: int, frames: int, tracked: bool) -> tuple[float, float, float, float, str]:
    """Return median, mean and 95th percentile of the errors, percent of the size; seconds, and a failure or ""."""
    rng = np.random.default_rng([KINDS.index(kind), seed])
    take = make_take(kind, rng, frames, 1.0 if tracked else 0.0)
    path = take.scene.actors[0].path
    parts = [actor.body for actor in take.scene.actors if actor.path is path]
    corners = np.concatenate([part.vertices for part in parts])
    sets, poses = list(take.frames()), RigidTransform.concatenate([path(float(k)) for k in range(frames)])
    begin = time.perf_counter()
    object_from_body = RigidTransform.identity()
    try:
        if tracked:
            found = [frame.pose for frame in track(sets, take.calibration)]
            kept = [k for k, pose in enumerate(found) if pose.is_measured]
            if not kept:
                return np.nan, np.nan, np.nan, 0.0, "not tracked"
            world_from_object = [pose for k in kept if (pose := found[k].world_from_object) is not None]
            object_from_body = world_from_object[0].inv() * poses[kept[0]]
            sets, poses = [sets[k] for k in kept], RigidTransform.concatenate(world_from_object)
        carved = carve_object(take.calibration, [FrameSet.of(s.images, s.time) for s in sets], poses)
    except ValueError as error:
        return np.nan, np.nan, np.nan, time.perf_counter() - begin, str(error)
    seconds = time.perf_counter() - begin
    errors = measure_surface(parts, object_from_body.inv().apply(carved.mesh.vertices))
    percent = 100 * errors / np.ptp(corners, axis=0).max()
    median, mean, high = np.median(np.abs(percent)), percent.mean(), np.percentile(np.abs(percent), 95)
    unknown, n_contradicting = float(np.nanmedian(carved.unknown_outline)), int(carved.contradicting.sum())
    remark = f"agreement {np.nanmedian(carved.agreement):.3f}, unknown {unknown:.2f}, contradicting {n_contradicting}"
    return float(median), float(mean), float(high), seconds, remark


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--frames", type=int, default=31)
    parser.add_argument("--kinds", nargs="*", choices=KINDS, default=KINDS)
    parser.add_argument("--tracked", action="store_true")
    arguments = parser.parse_args()
    warn_without_photographs()
    print("| kind | median error, % of the size: worst seed, median seed | mean | 95 % | s |\n|---|---|---|---|---|")
    for kind in arguments.kinds:
        rows, failures = [], []
        for seed in range(arguments.first, arguments.first + arguments.seeds):
            *numbers, remark = evaluate(kind, seed, arguments.frames, arguments.tracked)
            rows.append(numbers)
            failures.append(f"  {kind}, seed {seed}: {numbers[0]:.2f} %, {remark}")
        table = np.array(rows)
        worst = "failed" if np.isnan(table[:, 0]).any() else f"{table[:, 0].max():.2f}"
        print(
            f"| {kind} | {worst}, {np.nanmedian(table[:, 0]):.2f} | {np.nanmax(table[:, 1]):.2f} | "
            f"{np.nanmax(table[:, 2]):.1f} | {np.nanmedian(table[:, 3]):.0f} |"
        )
        print("\n".join(failures), flush=True)


if __name__ == "__main__":
    main()
