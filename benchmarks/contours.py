"""Errors of poses from outlines of plain bodies with a known mesh, in the recordings of `benchmarks/silhouettes.py`.

    python benchmarks/contours.py [--seeds 3] [--kinds NAME ...] [--search]

Starts are off by 5 degrees and 5 % of the radius; with `--search` there is none. Squared errors relative to the covariance
have a mean of 6 if it is right. Started poses are sure if their standard deviations are below 20 degrees; searched ones if
they are unique, too. A pose is wrong and sure if its error exceeds 3 degrees and 5 standard deviations.
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.kinds_scenes import draw_block, draw_rounded_body, texture_resolution
from benchmarks.silhouettes import convex, draw_irregular, draw_plain_take
from sylpose import Mesh
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Rig
from sylpose.silhouettes.background import estimate_background, find_silhouette, level_images
from sylpose.silhouettes.contour_search import search_contour_poses
from sylpose.silhouettes.contours import Alignment, Outline, align_contours, move
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


KINDS = {
    "irregular": draw_irregular,
    "wedge": convex(draw_wedge),
    "rounded": convex(draw_rounded_body),
    "block": convex(draw_block),
    "cup": convex(draw_cup),
}


def make_mesh(parts: list[TexturedBody]) -> Mesh:
    """Return the surfaces of convex parts as one mesh."""
    vertices, faces, n = [part.vertices for part in parts], list[list[int]](), 0
    for part in parts:
        faces += [[n + f[0], n + f[k], n + f[k + 1]] for f in part.faces for k in range(1, len(f) - 1)]
        n += len(part.vertices)
    return Mesh(np.concatenate(vertices), np.array(faces))


def evaluate(kind: str, seed: int, search: bool) -> list[tuple[FloatArray, list[Alignment], float]]:
    """Return the error (6,) of the best pose, all poses, and the distance from the cameras, of some frames."""
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
        outlines.append([Outline.of(camera, find_silhouette(background, image)) for image in images[::EVERY]])
    rows = []
    for k, of_frame in enumerate(zip(*outlines, strict=True)):
        true = path(float(EVERY * k)) * RigidTransform.from_translation(middle)
        step = rng.standard_normal(6) * np.repeat([np.radians(5.0), 0.05 * radius], 3) / 3**0.5
        aligned = None if search else align_contours(mesh, of_frame, move(true, true.translation, step))
        found = search_contour_poses(mesh, of_frame) if search else [aligned] if aligned is not None else []
        error = np.full(6, np.nan)
        if found:
            best = found[0].world_from_object
            turn: Rotation = best.rotation * true.rotation.inv()
            error = np.concatenate([turn.as_rotvec(), best.translation - true.translation])
        distance = float(np.mean([np.linalg.norm(true.translation - camera.center) for camera in rig]))
        rows.append((error, found, distance))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--kinds", nargs="*", choices=KINDS, default=list(KINDS))
    parser.add_argument("--search", action="store_true")
    arguments = parser.parse_args()
    print("| kind | degrees | % of the distance | squared error | largest sd, degrees | sure | wrong and sure |")
    print("|---|---|---|---|---|---|---|")
    for kind in arguments.kinds:
        rows = [row for seed in range(arguments.seeds) for row in evaluate(kind, seed, arguments.search)]
        table, n_sure, n_wrong = list[tuple[float, float, float, float]](), 0, 0
        for error, found, distance in rows:
            if not found:
                continue
            angle, square = float(np.linalg.norm(error[:3])), float(error @ np.linalg.solve(found[0].covariance, error))
            sd = float(np.degrees(np.sqrt(np.linalg.eigvalsh(found[0].covariance[:3, :3])[-1])))
            is_sure = sd < 20 and (found[0].is_unique or not arguments.search)
            n_sure += is_sure
            n_wrong += is_sure and bool(np.degrees(angle) > 3 and square > 25)
            table.append((np.degrees(angle), 100 * float(np.linalg.norm(error[3:])) / distance, square, sd))
        values = np.array(table)
        (degrees, percent, square, sd), most = np.median(values, axis=0), values.max(axis=0)
        print(
            f"| {kind} | {degrees:.2f}, worst {most[0]:.2f} | {percent:.3f}, worst {most[1]:.3f} | mean "
            f"{values[:, 2].mean():.1f} | {sd:.2f} | {n_sure} of {len(rows)} | {n_wrong} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
