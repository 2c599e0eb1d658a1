"""Tracking of rendered, seeded variations of kinds of scenes that were not used for tuning.

    python benchmarks/kinds.py [KIND ...] [--group background] [--seeds 0:10] [--features klt sift auto] [--smooth]
                               [--each] [--frames] [--json FILE]

Each variation is tracked in this process from the rendered images. Errors are those of the motion since the first frame
with a pose: rotation in degrees, and translation of the object's center in object radii.

- *Wrong and sure*: frames with the status tracked or relocalized whose error exceeds 3 degrees or a third of the radius,
  and five of its standard deviations.
- *NEES*: squared error of all six unknowns in units of its covariance, mean 6 for a consistent covariance.
- *Missed*: frames without a measured pose that could have been solved (`benchmarks/kinds_solvable.py`).
- *Inaccurate*: frames with a measured pose whose rotation error exceeds 2 degrees.

Prints one row per kind, or per variation with --each, and each frame with --frames. The kinds are defined in
`benchmarks/kinds_scenes.py`, `benchmarks/kinds_fallback_search.py` and `benchmarks/kinds_feature_poor.py`. Without KIND,
all kinds run except those of the group "large".

Seeds 0 to 24, 30 to 61, 70 to 75 and 80 to 83 were looked at while developing, some of their kinds only.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from benchmarks.kinds_fallback_search import FALLBACK_SEARCH, LARGE
from benchmarks.kinds_feature_poor import FEATURE_POOR
from benchmarks.kinds_scenes import GROUPS as SCENES
from benchmarks.kinds_scenes import Kind, Variation
from benchmarks.kinds_solvable import find_solvable_frames
from sylpose import FramePose, FrameStatus, track
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import FloatArray
from sylpose.smoothing import Track, smooth_tracks

GROUPS = {**SCENES, "thorough": FALLBACK_SEARCH, "starving": FEATURE_POOR, "large": LARGE}
KINDS: dict[str, Kind] = {name: kind for group in GROUPS.values() for name, kind in group.items()}

# Limits of wrong and sure results: degrees, radii, standard deviations (the project's promise).
WRONG_DEG, WRONG_RADII, SURE_SDS = 3.0, 1.0 / 3.0, 5.0
# Rotation error of an inaccurate frame.
INACCURATE_DEG = 2.0
LOCALIZED = (FrameStatus.TRACKED, FrameStatus.RELOCALIZED)


@dataclass(frozen=True)
class Result:
    """Tracking result of one variation.

    Attributes:
        kind, seed, features: identify the run.
        frames: number of frames.
        found: number of frames tracked or relocalized.
        first: number of the first frame with a pose; -1 without any.
        statuses: number of frames per status.
        degrees, radii: median and largest error of the frames found, degrees and object radii; NaN without any.
        nees: mean NEES of the frames found.
        largest: largest rotation error and translation error in standard deviations.
        sure: number of frames wrong and sure.
        off: number of frames found with a rotation error above 2 degrees.
        left: number of frames without a measured pose that could have been solved.
        length: ratio of the translation, projected on the true one, to the true one, in the frame where that is largest;
            NaN for less than half a radius.
        length_sds: error of that translation in standard deviations.
    """

    kind: str
    seed: int
    features: str
    frames: int
    found: int
    first: int
    statuses: dict[str, int]
    degrees: tuple[float, float]
    radii: tuple[float, float]
    nees: float
    largest: tuple[float, float]
    sure: int
    off: int
    left: int
    length: float
    length_sds: float


Run = tuple[Result, list[FramePose], FloatArray]


def track_variation(kind: str, seed: int, features: str, *, smoothed: bool = False) -> list[Run]:
    """Track a variation and compare it with the truth.

    Returns:
        One entry for the live poses and, if `smoothed`, one for the smoothed poses. Each has the result, the poses and
        the errors (n, 4) of each frame: degrees, radii, and standard deviations of rotation and translation, NaN without
        a pose.
    """
    variation = KINDS[kind](np.random.default_rng([seed, *kind.encode()]))
    frames = list(variation.frames())
    tracked = list(track(frames, variation.scene.rig, variation.boxes, features=features, seed=seed))
    runs = [evaluate_poses(kind, seed, features, variation, frames, [frame.pose for frame in tracked])]
    if smoothed:
        poses = list(smooth_tracks([Track.from_tracked(frame) for frame in tracked], variation.scene.rig).poses)
        runs.append(evaluate_poses(kind, seed, f"{features}, smoothed", variation, frames, poses))
    return runs


def evaluate_poses(
    kind: str, seed: int, features: str, variation: Variation, frames: list[FrameSet], poses: list[FramePose]
) -> Run:
    """Compare the poses of a variation with the truth."""
    errors, nees = compute_errors(variation, poses)
    found = np.array([p.status in LOCALIZED for p in poses])
    is_wrong = (errors[:, 0] > WRONG_DEG) & (errors[:, 2] > SURE_SDS) | (errors[:, 1] > WRONG_RADII) & (
        errors[:, 3] > SURE_SDS
    )
    localized_errors = errors[found] if found.any() else np.full((1, 4), np.nan)
    length, sds = compute_length_ratio(variation, poses)
    first = next((k for k, p in enumerate(poses) if p.world_from_object is not None), -1)
    middle, worst = np.median(localized_errors, axis=0), localized_errors.max(axis=0)
    result = Result(
        kind,
        seed,
        features,
        len(poses),
        int(found.sum()),
        first,
        dict(Counter(p.status.value for p in poses)),
        (float(middle[0]), float(worst[0])),
        (float(middle[1]), float(worst[1])),
        float(np.mean(nees[found])) if found.any() else np.nan,
        (float(worst[2]), float(worst[3])),
        int((is_wrong & found).sum()),
        int((found & (errors[:, 0] > INACCURATE_DEG)).sum()),
        len(find_solvable_frames(variation, poses, frames)),
        length,
        sds,
    )
    return result, poses, errors


def compute_errors(variation: Variation, poses: list[FramePose]) -> tuple[FloatArray, FloatArray]:
    """Compute errors (n, 4) in degrees, radii and standard deviations of rotation and translation, and NEES (n,).

    Frames without a pose have NaN.
    """
    errors, nees = np.full((len(poses), 4), np.nan), np.full(len(poses), np.nan)
    truth, first = variation.scene.object_poses(), None
    for k, pose in enumerate(poses):
        if pose.world_from_object is None:
            continue
        if first is None:
            first = k, pose.world_from_object
        e = _error(truth, first, k, pose.world_from_object)
        covariance = pose.covariance + np.diag(np.repeat([1e-12, (1e-6 * variation.radius) ** 2], 3))
        rotation_nees, translation_nees = (
            float(e[s] @ np.linalg.solve(covariance[s, s], e[s])) for s in (slice(0, 3), slice(3, 6))
        )
        size = np.degrees(np.linalg.norm(e[:3])), np.linalg.norm(e[3:]) / variation.radius
        errors[k] = *size, np.sqrt(rotation_nees), np.sqrt(translation_nees)
        nees[k] = e @ np.linalg.solve(covariance, e)
    return errors, nees


def _error(truth: RigidTransform, first: tuple[int, RigidTransform], k: int, pose: RigidTransform) -> FloatArray:
    """Return the error (6,) of the motion since the first frame: rotation vector, and translation of the first center."""
    number, start = first
    true = truth[k] * truth[number].inv()
    motion = pose * start.inv()
    center = start.translation
    turn = (motion.rotation * true.rotation.inv()).as_rotvec()
    return np.concatenate([turn, motion.apply(center) - true.apply(center)])


def compute_length_ratio(variation: Variation, poses: list[FramePose]) -> tuple[float, float]:
    """Compute `Result.length` and `Result.length_sds`."""
    known = [k for k, p in enumerate(poses) if p.status in LOCALIZED or p.status is FrameStatus.FIRST]
    if len(known) < 2:
        return np.nan, np.nan
    truth, start = variation.scene.object_poses(), poses[known[0]].world_from_object
    assert start is not None
    centers = [truth[k] * truth[known[0]].inv() for k in known]
    moved = np.array([m.apply(start.translation) - start.translation for m in centers])
    farthest = int(np.argmax(np.linalg.norm(moved, axis=1)))
    true = float(np.linalg.norm(moved[farthest]))
    if true < 0.5 * variation.radius:
        return np.nan, np.nan
    pose, along = poses[known[farthest]], moved[farthest] / true
    assert pose.world_from_object is not None
    measured = float((pose.world_from_object.translation - start.translation) @ along)
    sd = float(np.sqrt(along @ pose.covariance[3:, 3:] @ along))
    return measured / true, (measured - true) / max(sd, 1e-12)


HEADER = (
    "| kind | features | runs | frames | localized | missed | inaccurate | wrong and sure | "
    "rotation error, deg: median, worst | translation error, radii: median, worst | NEES: median, worst run | "
    "worst error, sd: rotation, translation | translation ratio: least, most | its error, sd |\n" + "|---" * 14 + "|"
)


def format_row(results: list[Result]) -> str:
    """Format the table row of the runs of one kind."""
    one, lengths = results[0], np.array([r.length for r in results])
    name = one.kind if len(results) > 1 else f"{one.kind} {one.seed}"
    degrees, radii = (np.array([getattr(r, key) for r in results]) for key in ("degrees", "radii"))
    largest, nees = np.array([r.largest for r in results]), np.array([r.nees for r in results])
    frames, found, sure, off, left = (
        sum(getattr(r, key) for r in results) for key in ("frames", "found", "sure", "off", "left")
    )
    n_bad_runs = sum(r.sure > 0 for r in results)
    is_finite = np.isfinite(lengths)
    sds = np.array([r.length_sds for r in results])[is_finite]
    cells = [
        name,
        one.features,
        f"{len(results)}",
        f"{frames}",
        f"{100 * found / frames:.0f} %",
        f"{left}",
        f"{off}",
        f"{sure} in {n_bad_runs}" if sure else "0",
        f"{_finite_median(degrees[:, 0]):.2f}, {_finite_max(degrees[:, 1]):.2f}",
        f"{_finite_median(radii[:, 0]):.3f}, {_finite_max(radii[:, 1]):.3f}",
        f"{_finite_median(nees):.1f}, {_finite_max(nees):.0f}",
        f"{_finite_max(largest[:, 0]):.1f}, {_finite_max(largest[:, 1]):.1f}",
        f"{lengths[is_finite].min():.3f}, {lengths[is_finite].max():.3f}" if is_finite.any() else "",
        f"{np.abs(sds).max():.1f}" if is_finite.any() else "",
    ]
    return "| " + " | ".join(cells) + " |"


def _finite_median(values: FloatArray) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else np.nan


def _finite_max(values: FloatArray) -> float:
    return float(np.nanmax(values)) if np.isfinite(values).any() else np.nan


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=", ".join(KINDS))
    parser.add_argument("--group", choices=list(GROUPS), action="append", default=[])
    parser.add_argument("--seeds", default="0:5", help="first:end")
    parser.add_argument("--features", nargs="+", default=["auto"], choices=["auto", "klt", "sift"])
    parser.add_argument("--smooth", action="store_true", help="score the smoothed poses too")
    parser.add_argument("--each", action="store_true", help="print a row for each variation")
    parser.add_argument("--frames", action="store_true", help="print a line for each frame")
    parser.add_argument("--json", type=Path, metavar="FILE")
    arguments = parser.parse_args()
    names = arguments.kinds + [name for group in arguments.group for name in GROUPS[group]]
    unknown = [name for name in names if name not in KINDS]
    if unknown:
        parser.error(f"unknown kind: {', '.join(unknown)}; known are {', '.join(KINDS)}")
    first, _, end = arguments.seeds.partition(":")
    seeds = range(int(first), int(end or int(first) + 1))
    print(HEADER)
    all_results = []
    for name in names or [name for name in KINDS if name not in LARGE]:
        for features in arguments.features:
            results: dict[str, list[Result]] = {}
            for seed in seeds:
                for result, poses, errors in track_variation(name, seed, features, smoothed=arguments.smooth):
                    results.setdefault(result.features, []).append(result)
                    if arguments.each:
                        print(format_row([result]), result.statuses, flush=True)
                    if arguments.frames:
                        for pose, e in zip(poses, errors, strict=True):
                            print(pose.index, pose.status.value, np.round(e, 3), pose.inliers, flush=True)
            for kind_results in results.values():
                all_results += kind_results
                if len(kind_results) > 1 or not arguments.each:
                    print(format_row(kind_results), flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(result) for result in all_results], indent=1) + "\n")


if __name__ == "__main__":
    main()
