"""How well features that have not moved are distinguished from moving ones: by their patches, or by displacement.

    python benchmarks/static_features.py [KIND ...] [--seed 54] [--gap 3]

The truth is that of the rendered scenes: a feature is of the background if the images are as they would be without any
moving body. Keypoints are detected in two frames and matched by their descriptors, as at the start of tracking.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.trust import draw
from benchmarks.trust_takes import warn_without_photographs
from sylpose.features.klt import to_gray
from sylpose.features.patches import MAX_VARIANCE_RATIO, RADIUS, ROUNDING_VARIANCE
from sylpose.features.sift import detect_features, match_features
from sylpose.geometry.arrays import BoolArray, FloatArray, Image

KINDS = ["free-motion", "slow-turn", "hand-board", "two-objects", "faint", "noisy-camera", "low-jpeg", "flicker"]
KINDS += ["exposure-wanders", "light-dims", "shadows", "net", "interlaced"]
# Displacements, pixels: classes of the table.
CLASSES = ((0.5, 1.0), (1.0, 2.0), (2.0, 4.0))
# A patch differs from the empty scene by less than this if it shows background, by more than the second value if it does
# not, mean gray levels beyond the noise.
SAME, OTHER = 1.0, 6.0


def compare_kind(kind: str, seed: int, gap: int) -> FloatArray:
    """Return the matches of a kind's two frames (n, 3 + sides): background?, body?, displacement, and variance ratios."""
    take, rows = draw(kind, seed), []
    empty = replace(take, scene=replace(take.scene, actors=()))
    films = [[frame.images for frame in islice(film.frames(), gap + 1)] for film in (take, empty)]
    for c, camera in enumerate(take.calibration):
        (a, b), (room_a, room_b) = ([film[k][c] for k in (0, gap)] for film in films)
        if a is None or b is None or room_a is None or room_b is None:
            continue
        before, after = detect_features(a, camera), detect_features(b, camera)
        i, j = match_features(before, after).T
        old, new = before.pixels[i], after.pixels[j]
        differences = np.stack([compare_with_room(a, room_a, old), compare_with_room(b, room_b, new)])
        displacement = np.abs(new - old).max(axis=1)
        ratios = [
            compute_ratios(to_gray(a), to_gray(b), old, new, radius) for radius in (RADIUS - 1, RADIUS, RADIUS + 1)
        ]
        is_room, is_body = (differences < SAME).all(axis=0), (differences > OTHER).all(axis=0)
        rows.append(np.column_stack([is_room, is_body, displacement, *ratios]))
    return np.concatenate(rows)


def compare_with_room(image: Image, room: Image, pixels: FloatArray) -> FloatArray:
    """Return by how much an image (h, w, 3) differs from the empty scene around pixels (n, 2), beyond the noise."""
    difference = np.abs(image.astype(float) - room).max(axis=2)
    smooth = cv2.blur(difference, (9, 9)) - 2.0 * float(np.median(difference))
    u, v = np.clip(np.round(pixels).astype(int), 0, np.array(image.shape[1::-1]) - 1).T
    return np.asarray(smooth[v, u])


def compute_ratios(a: Image, b: Image, old: FloatArray, new: FloatArray, radius: int) -> FloatArray:
    """Return the ratio of the variances at the old and at the new place (n,), as `features.patches`."""
    side = 2 * radius + 1

    def sample(image: Image, pixels: FloatArray) -> FloatArray:
        patches = [cv2.getRectSubPix(image, (side, side), tuple(map(float, at))) for at in pixels]
        return np.array(patches, dtype=float).reshape(-1, side, side)

    at_old, at_new = ((sample(b, pixels) - sample(a, old)).var(axis=(1, 2)) for pixels in (old, new))
    return np.asarray(at_old / (at_new + ROUNDING_VARIANCE))


def count_errors(is_static: BoolArray, table: FloatArray, selected: BoolArray) -> str:
    """Describe the errors of a decision: background that moves, and bodies that do not."""
    cells = []
    for of_class, decided in ((table[:, 0] > 0, ~is_static), (table[:, 1] > 0, is_static)):
        n = np.count_nonzero(of_class & selected)
        cells.append(f"{np.count_nonzero(of_class & selected & decided)} of {n}")
    return " | ".join(cells)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kinds", nargs="*", default=KINDS)
    parser.add_argument("--seed", type=int, default=54)
    parser.add_argument("--gap", type=int, default=3, help="frames between the two")
    arguments = parser.parse_args()
    warn_without_photographs()
    table = np.concatenate([compare_kind(kind, arguments.seed, arguments.gap) for kind in arguments.kinds])
    print("| displaced by, px | static if | background that moves | bodies that do not |\n|---|---|---|---|")
    for low, high in CLASSES:
        selected = (table[:, 2] >= low) & (table[:, 2] < high)
        rules = [("displaced by less than 1.5 px", table[:, 2] < 1.5)]
        for column, radius in ((3, RADIUS - 1), (4, RADIUS), (5, RADIUS + 1)):
            for factor in (0.5, 1.0, 2.0) if radius == RADIUS else (1.0,):
                limit = 1.0 + factor * (MAX_VARIANCE_RATIO - 1.0)
                rules.append((f"radius {radius} px, ratio up to {limit:.2f}", table[:, column] <= limit))
        for name, is_static in rules:
            print(f"| {low:g} to {high:g} | {name} | {count_errors(is_static, table, selected)} |")
    quantiles = np.quantile(table[table[:, 0] > 0, 2], [0.5, 0.9, 0.95, 0.98, 0.99])
    print("\ndisplacement of background features, px, quantiles 50, 90, 95, 98, 99 %:", quantiles.round(2))


if __name__ == "__main__":
    main()
