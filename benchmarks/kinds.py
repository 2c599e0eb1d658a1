"""Kinds of scenes that nobody tuned to: rendered, seeded, dozens of variations of each. What counts is the worst of them.

    python benchmarks/kinds.py [KIND ...] [--group background] [--seeds 0:10] [--features klt sift auto] [--smooth]
                               [--each] [--frames] [--json FILE]

A variation is tracked in this process from the images as rendered; errors are of the motion since the first frame with a
pose, against the truth: degrees, and the displacement of the object's centre in its radii. A frame is *wrong and sure* when
its status says that its pose was found, it is more than 3 degrees off (or a third of the radius) and the error is more than
five standard deviations of its own covariance. NEES: normalised squared error of all six unknowns, 6 in the mean for a
covariance that is right. Frames *left* have no measured pose though they could have been solved
(`benchmarks/kinds_solvable.py`); frames *off* have one that is more than 2 degrees off. Prints one line per kind, or per
variation with --each, and the frames of each with --frames. The kinds are in `benchmarks/kinds_scenes.py`,
`benchmarks/kinds_fallback_search.py` and `benchmarks/kinds_feature_poor.py`; those of the group "large" are not
among "all", which is
what runs without a name.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from benchmarks.kinds_fallback_search import LARGE, THOROUGH
from benchmarks.kinds_feature_poor import STARVING
from benchmarks.kinds_scenes import GROUPS as SCENES
from benchmarks.kinds_scenes import Kind, Take
from benchmarks.kinds_solvable import unsolved_but_solvable
from sylpose import FramePose, FrameStatus, track
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import FloatArray
from sylpose.smoothing.trajectory import Track, smooth

GROUPS = {**SCENES, "thorough": THOROUGH, "starving": STARVING, "large": LARGE}
KINDS: dict[str, Kind] = {name: kind for group in GROUPS.values() for name, kind in group.items()}

# What is wrong, and sure of it (the project's promise).
WRONG_DEG, WRONG_RADII, SURE = 3.0, 1.0 / 3.0, 5.0
# What is off.
OFF_DEG = 2.0
FOUND = (FrameStatus.TRACKED, FrameStatus.RELOCALISED)


@dataclass(frozen=True)
class Result:
    """One variation, tracked.

    Attributes:
        kind, seed, features: which.
        frames: how many; found: with a pose that was found in them; first: number of the first with any pose, -1 without.
        statuses: how many frames have each.
        degrees, radii: median and largest error of the frames found, in degrees and in the object's radii; NaN without any.
        nees: mean over them; largest: the square root of the largest, of the turn alone and of the displacement alone.
        sure: number of frames wrong and sure of it; off: and of those found that are more than 2 degrees off; left: and of
            those without a measured pose that could have been solved.
        length: displacement along the true one over the true one, in the frame where that is largest; NaN where it hardly
            moves.
        length_sds: by how many standard deviations that is off.
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


def run(kind: str, seed: int, features: str, *, smoothed: bool = False) -> list[Run]:
    """A variation tracked and compared with the truth.

    Returns:
        as the frames came, and if asked for `smoothed`: the result; the poses; (n, 4) of each frame: degrees, radii and
        standard deviations off in turn and displacement, NaN without a pose.
    """
    take = KINDS[kind](np.random.default_rng([seed, *kind.encode()]))
    frames = list(take.frames())
    tracked = list(track(frames, take.scene.rig, take.boxes, features=features, seed=seed))
    runs = [judged(kind, seed, features, take, frames, [frame.pose for frame in tracked])]
    if smoothed:
        poses = list(smooth([Track.of(frame) for frame in tracked], take.scene.rig).poses)
        runs.append(judged(kind, seed, f"{features}, smoothed", take, frames, poses))
    return runs


def judged(kind: str, seed: int, how: str, take: Take, frames: list[FrameSet], poses: list[FramePose]) -> Run:
    """The poses of a variation compared with the truth."""
    errors, nees = compared(take, poses)
    found = np.array([p.status in FOUND for p in poses])
    wrong = (errors[:, 0] > WRONG_DEG) & (errors[:, 2] > SURE) | (errors[:, 1] > WRONG_RADII) & (errors[:, 3] > SURE)
    some = errors[found] if found.any() else np.full((1, 4), np.nan)
    length, sds = length_of(take, poses)
    first = next((k for k, p in enumerate(poses) if p.world_from_object is not None), -1)
    middle, worst = np.median(some, axis=0), some.max(axis=0)
    result = Result(
        kind,
        seed,
        how,
        len(poses),
        int(found.sum()),
        first,
        dict(Counter(p.status.value for p in poses)),
        (float(middle[0]), float(worst[0])),
        (float(middle[1]), float(worst[1])),
        float(np.mean(nees[found])) if found.any() else np.nan,
        (float(worst[2]), float(worst[3])),
        int((wrong & found).sum()),
        int((found & (errors[:, 0] > OFF_DEG)).sum()),
        len(unsolved_but_solvable(take, poses, frames)),
        length,
        sds,
    )
    return result, poses, errors


def compared(take: Take, poses: list[FramePose]) -> tuple[FloatArray, FloatArray]:
    """(n, 4) degrees, radii, and standard deviations of turn and displacement; (n,) NEES. NaN without a pose."""
    errors, nees = np.full((len(poses), 4), np.nan), np.full(len(poses), np.nan)
    truth, first = take.scene.poses(), None
    for k, pose in enumerate(poses):
        if pose.world_from_object is None:
            continue
        if first is None:
            first = k, pose.world_from_object
        e = _error(truth, first, k, pose.world_from_object)
        covariance = pose.covariance + np.diag(np.repeat([1e-12, (1e-6 * take.radius) ** 2], 3))
        turn, place = (float(e[s] @ np.linalg.solve(covariance[s, s], e[s])) for s in (slice(0, 3), slice(3, 6)))
        size = np.degrees(np.linalg.norm(e[:3])), np.linalg.norm(e[3:]) / take.radius
        errors[k] = *size, np.sqrt(turn), np.sqrt(place)
        nees[k] = e @ np.linalg.solve(covariance, e)
    return errors, nees


def _error(truth: RigidTransform, first: tuple[int, RigidTransform], k: int, pose: RigidTransform) -> FloatArray:
    """(6,) (w, d) of the motion since the first frame against the true one; d where the centre was taken to be."""
    number, start = first
    true = truth[k] * truth[number].inv()
    motion = pose * start.inv()
    center = start.translation
    turn = (motion.rotation * true.rotation.inv()).as_rotvec()
    return np.concatenate([turn, motion.apply(center) - true.apply(center)])


def length_of(take: Take, poses: list[FramePose]) -> tuple[float, float]:
    """See `Result.length` and `length_sds`."""
    known = [k for k, p in enumerate(poses) if p.status in FOUND or p.status is FrameStatus.FIRST]
    if len(known) < 2:
        return np.nan, np.nan
    truth, start = take.scene.poses(), poses[known[0]].world_from_object
    assert start is not None
    centers = [truth[k] * truth[known[0]].inv() for k in known]
    moved = np.array([m.apply(start.translation) - start.translation for m in centers])
    far = int(np.argmax(np.linalg.norm(moved, axis=1)))
    true = float(np.linalg.norm(moved[far]))
    if true < 0.5 * take.radius:
        return np.nan, np.nan
    pose, along = poses[known[far]], moved[far] / true
    assert pose.world_from_object is not None
    got = float((pose.world_from_object.translation - start.translation) @ along)
    sd = float(np.sqrt(along @ pose.covariance[3:, 3:] @ along))
    return got / true, (got - true) / max(sd, 1e-12)


HEADER = (
    "| kind | features | runs | frames | found | left | off | wrong and sure | degrees: median, worst | "
    "radii: median, worst | NEES: median, worst run | off by (sd): turn, place | "
    "length: least, most | by (sd) |\n" + "|---" * 14 + "|"
)


def line(results: list[Result]) -> str:
    """One line of the table, of runs of one kind."""
    one, lengths = results[0], np.array([r.length for r in results])
    name = one.kind if len(results) > 1 else f"{one.kind} {one.seed}"
    degrees, radii = (np.array([getattr(r, key) for r in results]) for key in ("degrees", "radii"))
    largest, nees = np.array([r.largest for r in results]), np.array([r.nees for r in results])
    frames, found, sure, off, left = (
        sum(getattr(r, key) for r in results) for key in ("frames", "found", "sure", "off", "left")
    )
    bad = sum(r.sure > 0 for r in results)
    told = np.isfinite(lengths)
    sds = np.array([r.length_sds for r in results])[told]
    cells = [
        name,
        one.features,
        f"{len(results)}",
        f"{frames}",
        f"{100 * found / frames:.0f} %",
        f"{left}",
        f"{off}",
        f"{sure} in {bad}" if sure else "0",
        f"{_median(degrees[:, 0]):.2f}, {_most(degrees[:, 1]):.2f}",
        f"{_median(radii[:, 0]):.3f}, {_most(radii[:, 1]):.3f}",
        f"{_median(nees):.1f}, {_most(nees):.0f}",
        f"{_most(largest[:, 0]):.1f}, {_most(largest[:, 1]):.1f}",
        f"{lengths[told].min():.3f}, {lengths[told].max():.3f}" if told.any() else "",
        f"{np.abs(sds).max():.1f}" if told.any() else "",
    ]
    return "| " + " | ".join(cells) + " |"


def _median(values: FloatArray) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else np.nan


def _most(values: FloatArray) -> float:
    return float(np.nanmax(values)) if np.isfinite(values).any() else np.nan


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=", ".join(KINDS))
    parser.add_argument("--group", choices=list(GROUPS), action="append", default=[])
    parser.add_argument("--seeds", default="0:5", help="first:end")
    parser.add_argument("--features", nargs="+", default=["auto"], choices=["auto", "klt", "sift"])
    parser.add_argument("--smooth", action="store_true", help="the poses refined together, too")
    parser.add_argument("--each", action="store_true", help="a line for each variation")
    parser.add_argument("--frames", action="store_true", help="a line for each frame")
    parser.add_argument("--json", type=Path, metavar="FILE")
    asked = parser.parse_args()
    names = asked.kinds + [name for group in asked.group for name in GROUPS[group]]
    unknown = [name for name in names if name not in KINDS]
    if unknown:
        parser.error(f"no such kind: {', '.join(unknown)}; there are {', '.join(KINDS)}")
    first, _, end = asked.seeds.partition(":")
    seeds = range(int(first), int(end or int(first) + 1))
    print(HEADER)
    everything = []
    for name in names or [name for name in KINDS if name not in LARGE]:
        for features in asked.features:
            results: dict[str, list[Result]] = {}
            for seed in seeds:
                for result, poses, errors in run(name, seed, features, smoothed=asked.smooth):
                    results.setdefault(result.features, []).append(result)
                    if asked.each:
                        print(line([result]), result.statuses, flush=True)
                    if asked.frames:
                        for pose, e in zip(poses, errors, strict=True):
                            print(pose.index, pose.status.value, np.round(e, 3), pose.inliers, flush=True)
            for of_all in results.values():
                everything += of_all
                if len(of_all) > 1 or not asked.each:
                    print(line(of_all), flush=True)
    if asked.json:
        asked.json.write_text(json.dumps([asdict(result) for result in everything], indent=1) + "\n")


if __name__ == "__main__":
    main()
