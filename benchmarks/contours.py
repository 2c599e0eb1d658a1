"""Errors of poses from outlines of plain bodies with a known mesh, in the recordings of `benchmarks/silhouettes.py`.

    python benchmarks/contours.py [--seeds 3] [--first 0] [--kinds NAME ...] [--search | --follow] [--reduce 1]

Starts are off by 5 degrees and 5 % of the radius; with `--search` there is none. Squared errors relative to the covariance
have a mean of 6 if it is right. Started poses are sure if their standard deviations are below 20 degrees; searched ones if
they are unique, too. A pose is wrong and sure if its error exceeds 3 degrees and 5 standard deviations. A mug looks the
same after half a turn about its handle: none of its poses is unique. `--reduce` makes the images smaller by a factor.

With `--follow`, all frames are tracked as by `sylpose track --mesh`. A frame is sure if its status is a measured one. Bounds
are of one-sided 95 % confidence, for frames and for recordings (the frames of one are not independent).
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import beta

from benchmarks.kinds_scenes import draw_block, draw_rounded_body, texture_resolution
from benchmarks.silhouettes import convex, draw_irregular, draw_plain_take
from sylpose import Mesh
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Rig
from sylpose.silhouettes.background import estimate_background, find_silhouette, level_images
from sylpose.silhouettes.contour_search import search_contour_poses
from sylpose.silhouettes.contour_tracker import ContourTracker, SampledBackground
from sylpose.silhouettes.contours import Alignment, Outline, align_contours, move
from sylpose.silhouettes.rendering import reduce_image
from sylpose.simulate import TexturedBody

FRAMES, EVERY = 31, 8


def draw_cup(rng: np.random.Generator, rig: Rig, radius: float) -> TexturedBody:
    """Draw a body of revolution."""
    angles, (low, high) = 2 * np.pi * np.arange(48) / 48, rng.uniform(0.4, 0.7, 2)
    rings = [
        np.column_stack([r * np.cos(angles), r * np.sin(angles), np.full(48, z)]) for r, z in ((low, -0.7), (high, 0.7))
    ]
    return TexturedBody.from_hull(radius * np.concatenate(rings), texture_resolution(rig))


def draw_wedge(rng: np.random.Generator, rig: Rig, radius: float) -> TexturedBody:
    """Draw the hull of eight random points."""
    points = rng.uniform(-1, 1, (8, 3)) * [1, 0.7, 0.6]
    return TexturedBody.from_hull(radius * points / np.linalg.norm(points, axis=1).max(), texture_resolution(rig))


def draw_mug(rng: np.random.Generator, rig: Rig, radius: float) -> list[TexturedBody]:
    """Draw a cylinder with a handle of three bars."""
    angles = 2 * np.pi * np.arange(48) / 48
    rings = [np.column_stack([0.55 * np.cos(angles), 0.55 * np.sin(angles), np.full(48, z)]) for z in (-0.7, 0.7)]
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
    out = float(rng.uniform(0.8, 1.1))
    bars = [([out - 0.45, 0.12, 0.14], [0.25 + out / 2, 0, z]) for z in (-0.4, 0.4)] + [
        ([0.14, 0.12, 0.9], [out, 0, 0])
    ]
    parts = [np.concatenate(rings), *(corners * sides + center for sides, center in bars)]
    scale = radius / max(np.linalg.norm(part, axis=1).max() for part in parts)
    return [TexturedBody.from_hull(scale * part, texture_resolution(rig)) for part in parts]


KINDS = {
    "irregular": draw_irregular,
    "wedge": convex(draw_wedge),
    "rounded": convex(draw_rounded_body),
    "block": convex(draw_block),
    "cup": convex(draw_cup),
    "mug": draw_mug,
}


def make_mesh(parts: list[TexturedBody]) -> Mesh:
    """Return the surfaces of convex parts as one mesh."""
    vertices, faces, n = [part.vertices for part in parts], list[list[int]](), 0
    for part in parts:
        faces += [[n + f[0], n + f[k], n + f[k + 1]] for f in part.faces for k in range(1, len(f) - 1)]
        n += len(part.vertices)
    return Mesh(np.concatenate(vertices), np.array(faces))


def measure_error(found: Alignment, true: RigidTransform) -> tuple[FloatArray, float]:
    """Return the error (6,) of (w, d) and its square relative to the covariance."""
    pose = found.world_from_object
    rotation: Rotation = pose.rotation * true.rotation.inv()
    error = np.concatenate([rotation.as_rotvec(), pose.translation - true.translation])
    return error, float(error @ np.linalg.solve(found.covariance, error))


def is_wrong(found: Alignment, true: RigidTransform) -> bool:
    """Return whether a pose differs from the true one by more than 3 degrees and 5 standard deviations."""
    error, square = measure_error(found, true)
    return bool(np.degrees(np.linalg.norm(error[:3])) > 3 and square > 25)


def evaluate(kind: str, seed: int, search: bool, step: int) -> list[tuple[RigidTransform, list[Alignment], float]]:
    """Return the true pose, all poses found, and the distance from the cameras, of some frames."""
    rng = np.random.default_rng([list(KINDS).index(kind), seed])
    take = draw_plain_take(rng, KINDS[kind], FRAMES)
    rig, path = take.calibration, take.scene.actors[0].path
    mesh = make_mesh([actor.body for actor in take.scene.actors])
    middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    mesh = Mesh(mesh.vertices - middle, mesh.faces)
    radius = float(np.linalg.norm(mesh.vertices, axis=1).max())
    sets, outlines = list(take.frames()), list[list[Outline]]()
    for c, camera in enumerate(rig):
        images = level_images([image for s in sets if (image := s.images[c]) is not None])
        background = estimate_background(images)
        of_camera = [Outline.of(camera, find_silhouette(background, image)) for image in images[::EVERY]]
        outlines.append([outline.reduce(step) for outline in of_camera])
    rows = []
    for k, of_frame in enumerate(zip(*outlines, strict=True)):
        true = path(float(EVERY * k)) * RigidTransform.from_translation(middle)
        disturbance = rng.standard_normal(6) * np.repeat([np.radians(5.0), 0.05 * radius], 3) / 3**0.5
        aligned = None if search else align_contours(mesh, of_frame, move(true, true.translation, disturbance))
        found = search_contour_poses(mesh, of_frame) if search else [aligned] if aligned is not None else []
        distance = float(np.mean([np.linalg.norm(true.translation - camera.center) for camera in rig]))
        rows.append((true, found, distance))
    return rows


def follow(kind: str, seed: int) -> list[tuple[bool, float, float, float, float]]:
    """Track a recording; return per frame whether it is sure, degrees, % of the distance, squared error, seconds."""
    rng = np.random.default_rng([list(KINDS).index(kind), seed])
    take = draw_plain_take(rng, KINDS[kind], FRAMES)
    rig, path, sets = take.calibration, take.scene.actors[0].path, list(take.frames())
    images = [[reduce_image(image) for s in sets if (image := s.images[c]) is not None] for c in range(len(rig))]
    backgrounds = [SampledBackground(range(FRAMES), own) for own in images]
    tracker = ContourTracker(rig, make_mesh([actor.body for actor in take.scene.actors]), backgrounds)
    rows = []
    for k, frame_set in enumerate(sets):
        begin = time.process_time()
        (tracked,) = tracker.step(frame_set)
        seconds, pose, true = time.process_time() - begin, tracked.pose, path(float(k))
        if pose.world_from_object is None:
            rows.append((False, np.nan, np.nan, np.nan, seconds))
            continue
        turn = (pose.world_from_object.rotation * true.rotation.inv()).as_rotvec()
        error = np.concatenate([turn, pose.world_from_object.translation - true.translation])
        distance = float(np.mean([np.linalg.norm(true.translation - camera.center) for camera in rig]))
        size = float(np.degrees(np.linalg.norm(turn))), 100 * float(np.linalg.norm(error[3:])) / distance
        rows.append((pose.is_measured, *size, float(error @ np.linalg.solve(pose.covariance, error)), seconds))
    return rows


def bound_percentage(n: int, of: int) -> float:
    """Return the upper bound of a rate, percent, by C. Clopper and E. Pearson, 1934."""
    return 100 * float(beta.ppf(0.95, n + 1, of - n)) if n < of else 100.0


def print_followed(kind: str, seeds: range) -> None:
    """Print the row of a kind of bodies."""
    takes = [np.array(follow(kind, seed), float) for seed in seeds]
    values = np.concatenate(takes)
    is_sure, degrees, percent, square, seconds = values.T
    wrong = [(take[:, 0] > 0) & (take[:, 1] > 3) & (take[:, 3] > 25) for take in takes]
    n_wrong, n_bad = int(sum(of.sum() for of in wrong)), sum(bool(of.any()) for of in wrong)
    sure = is_sure > 0
    limits = [bound_percentage(n_wrong, int(sure.sum())), bound_percentage(n_bad, len(takes))]
    errors = "-, - | -, - | -"
    if sure.any():
        errors = (
            f"{np.median(degrees[sure]):.2f}, {degrees[sure].max():.2f} | {np.median(percent[sure]):.3f}, "
            f"{percent[sure].max():.3f} | {square[sure].mean():.1f}"
        )
    print(
        f"| {kind} | {sure.sum()} of {len(values)} | {errors} | {n_wrong}: at most {limits[0]:.1f} %, recordings "
        f"{n_bad} of {len(takes)}: at most {limits[1]:.0f} % | {np.median(seconds):.2f}, {seconds.max():.1f} |",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--kinds", nargs="*", choices=KINDS, default=list(KINDS))
    parser.add_argument("--search", action="store_true")
    parser.add_argument("--follow", action="store_true")
    parser.add_argument("--reduce", type=int, default=1)
    arguments = parser.parse_args()
    if arguments.follow:
        followed = "sure", "degrees: median, worst", "% of the distance", "squared error", "wrong and sure", "seconds"
        print("| body | " + " | ".join(followed) + " |\n" + 7 * "|---" + "|", flush=True)
        for kind in arguments.kinds:
            print_followed(kind, range(arguments.first, arguments.first + arguments.seeds))
        return
    names = "kind", "degrees", "% of the distance", "squared error", "largest sd, degrees", "found", "right among them"
    print("| " + " | ".join([*names, "sure", "wrong and sure"]) + " |\n" + 9 * "|---" + "|", flush=True)
    for kind in arguments.kinds:
        seeds = range(arguments.first, arguments.first + arguments.seeds)
        rows = [row for seed in seeds for row in evaluate(kind, seed, arguments.search, arguments.reduce)]
        table, n_right, n_sure, n_wrong = list[tuple[float, float, float, float]](), 0, 0, 0
        for true, found, distance in rows:
            if not found:
                continue
            error, square = measure_error(found[0], true)
            sd = float(np.degrees(np.sqrt(np.linalg.eigvalsh(found[0].covariance[:3, :3])[-1])))
            is_sure = sd < 20 and (found[0].is_unique or not arguments.search)
            n_right += not all(is_wrong(alignment, true) for alignment in found)
            n_sure += is_sure
            n_wrong += is_sure and is_wrong(found[0], true)
            percent = 100 * float(np.linalg.norm(error[3:])) / distance
            table.append((float(np.degrees(np.linalg.norm(error[:3]))), percent, square, sd))
        if not table:
            print(f"| {kind} | none found |", flush=True)
            continue
        values = np.array(table)
        (degrees, percent, square, sd), most = np.median(values, axis=0), values.max(axis=0)
        print(
            f"| {kind} | {degrees:.2f}, worst {most[0]:.2f} | {percent:.3f}, worst {most[1]:.3f} | mean "
            f"{values[:, 2].mean():.1f} | {sd:.2f} | {len(table)} of {len(rows)} | {n_right} | {n_sure} | {n_wrong} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
