"""Trust: which frames are wrong and sure, and do stated bounds hold, on kinds of takes that no rule was made for.

    python benchmarks/trust.py [KIND ...] [--group GROUP] [--seeds 0:3] [--jobs N] [--each] [--list] [--json FILE]
                               [--film FILE]

Each take is rendered, tracked in memory and refined as `sylpose track` does it. Both results are scored against the true
motion since the first frame with a pose in which the object can be seen: rotation in degrees, and translation of the
object's center in object radii.

- *Localized*: frames with the status tracked or relocalized.
- *Wrong and sure*: localized frames whose error exceeds 3 degrees or a third of the radius, and five of its standard
  deviations; as tracked, and as refined (trajectory.csv). "In" is the number of runs that have such frames.
- *In the bounds*: share of the localized frames whose stated 95 % ellipsoid contains the truth: of rotation, of translation.
- *Filled in*: number of frames whose pose no match determines, with the status coasting or interpolated, and the same share.
- A take may have several truths, such as two equal objects without boxes. A run is scored against the one that it agrees
  with best as a whole.
- An error ends a run at its frame; runs with errors are listed at the end.

Prints one row per kind, or per run with --each, a row of all, and the worst runs. --film writes the first, middle and last
images of each take as a picture instead. The kinds are in `benchmarks/trust_kinds.py`.

Seeds 0 to 13, 23, 30 to 34, 36 to 94, 98, 101 and 110 to 125 were looked at while developing, some of them in few kinds.
docs/history/benchmarks.md states which figures are of a first look. New figures are of other seeds, looked at once.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from benchmarks.kinds import LOCALIZED, SURE_SDS, WRONG_DEG, WRONG_RADII
from benchmarks.trust_kinds import GROUPS, KINDS
from benchmarks.trust_takes import Take, warn_without_photographs
from sylpose import FramePose, track
from sylpose.bundle_adjustment.calibration_refinement import default_calibration_prior
from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.robust_loss import chi_squared_bound
from sylpose.smoothing import Track, smooth_tracks
from sylpose.status import PREDICTED, Status

# Squared error of three unknowns in standard deviations that 95 % stay below.
BOUND_95 = chi_squared_bound(3, 0.05)
N_WORST = 15


@dataclass(frozen=True)
class Score:
    """Poses of a run, compared with the truth.

    Attributes:
        localized: number of frames tracked or relocalized.
        sure: number of them that are wrong and sure.
        sure_frames: their numbers.
        wrong: number of localized frames that are wrong, sure or not.
        degrees, radii: median and largest error of the localized frames; NaN without any.
        sds: largest error in standard deviations: of rotation, of translation.
        n_bounded: number of localized frames apart from the reference.
        in_bounds: number of these whose 95 % bound contains the truth: of rotation, of translation.
        n_filled, filled_in_bounds: the same two of coasting and interpolated frames.
        filled_sds: their largest error in standard deviations; NaN without any.
        truth: number of the truth that the run agrees with best.
        statuses: number of frames by status.
    """

    localized: int
    sure: int
    sure_frames: tuple[int, ...]
    wrong: int
    degrees: tuple[float, float]
    radii: tuple[float, float]
    sds: tuple[float, float]
    n_bounded: int
    in_bounds: tuple[int, int]
    n_filled: int
    filled_in_bounds: tuple[int, int]
    filled_sds: tuple[float, float]
    truth: int
    statuses: dict[str, int]


@dataclass(frozen=True)
class Run:
    """One take, tracked and refined.

    Attributes:
        kind, group, seed: identify it.
        cameras, frames: numbers of them.
        first: first frame in which the object can be seen.
        boxes: whether boxes were given.
        tracked, refined: scores.
        refinement: status of the refinement.
        refusal: type and message of the error that ended tracking, or "".
        seconds: duration of tracking and refinement.
    """

    kind: str
    group: str
    seed: int
    cameras: int
    frames: int
    first: int
    boxes: bool
    tracked: Score
    refined: Score
    refinement: str
    refusal: str
    seconds: float


def draw(kind: str, seed: int) -> Take:
    """Draw the take of a kind and seed."""
    return KINDS[kind](np.random.default_rng([seed, *kind.encode()]))


def run_take(kind: str, seed: int) -> Run:
    """Track a take, refine it, and score both results."""
    cv2.setNumThreads(1)
    take = draw(kind, seed)
    rig, frames, begin = take.calibration, list(take.frames()), time.perf_counter()
    tracks, tracked, refined, refinement, refusal = [], [], None, Status.TOO_FEW_MATCHES, ""
    try:
        for frame in track(frames, rig, take.boxes, seed=seed, workers=1):
            tracked.append(frame.pose)
            tracks.append(Track.from_tracked(frame))
        if tracks:
            result = smooth_tracks(tracks, rig, calibration_prior=default_calibration_prior(rig))
            refined, refinement = list(result.poses), result.status
    except Exception as error:  # a crash ends a take, not the benchmark
        refusal = f"{type(error).__name__}: {error}"
    group = next(name for name, kinds in GROUPS.items() if kind in kinds)
    return Run(
        kind,
        group,
        seed,
        len(rig),
        len(frames),
        take.first,
        take.boxes is not None,
        score_poses(take, tracked),
        score_poses(take, tracked if refined is None else refined),
        refinement.value,
        refusal,
        time.perf_counter() - begin,
    )


def score_poses(take: Take, poses: Sequence[FramePose]) -> Score:
    """Score the poses of a run against the truth that they agree with best as a whole."""
    scores = [_score_against(take, poses, truth, i) for i, truth in enumerate(take.true_poses())]
    return min(scores, key=lambda score: (score.sure, score.wrong, score.degrees[0]))


def _score_against(take: Take, poses: Sequence[FramePose], truth: RigidTransform, number: int) -> Score:
    errors, reference = compute_errors(take, poses, truth)
    is_known = np.isfinite(errors[:, 0])
    found = np.array([pose.status in LOCALIZED for pose in poses], dtype=bool) & is_known
    is_wrong = (errors[:, 0] > WRONG_DEG) | (errors[:, 1] > WRONG_RADII)
    is_sure = (errors[:, 0] > WRONG_DEG) & (errors[:, 2] > SURE_SDS) | (errors[:, 1] > WRONG_RADII) & (
        errors[:, 3] > SURE_SDS
    )
    of_found = errors[found] if found.any() else np.full((1, 4), np.nan)
    is_later = np.arange(len(poses)) != reference
    is_bounded = found & is_later
    is_filled = np.array([pose.status in PREDICTED for pose in poses], dtype=bool) & is_known & is_later
    median, largest = np.median(of_found, axis=0), of_found.max(axis=0)
    largest_filled = errors[is_filled, 2:].max(axis=0) if is_filled.any() else np.full(2, np.nan)
    inside = errors[:, 2:] ** 2 <= BOUND_95
    return Score(
        int(found.sum()),
        int((is_sure & found).sum()),
        tuple(map(int, np.flatnonzero(is_sure & found))),
        int((is_wrong & found).sum()),
        (float(median[0]), float(largest[0])),
        (float(median[1]), float(largest[1])),
        (float(largest[2]), float(largest[3])),
        *_count_inside(inside[is_bounded]),
        *_count_inside(inside[is_filled]),
        (float(largest_filled[0]), float(largest_filled[1])),
        number,
        dict(Counter(pose.status.value for pose in poses)),
    )


def _count_inside(inside: BoolArray) -> tuple[int, tuple[int, int]]:
    """Return the number of frames (n, 2), and those in the bounds of rotation and of translation."""
    rotations, translations = inside.sum(axis=0)
    return len(inside), (int(rotations), int(translations))


def compute_errors(take: Take, poses: Sequence[FramePose], truth: RigidTransform) -> tuple[FloatArray, int]:
    """Compute the errors (n, 4) of the motion since a reference frame, and the number of that frame.

    It is the first one with a pose in which the object can be seen. Columns are degrees, radii, and standard deviations of
    rotation and translation. Frames without a pose have NaN.
    """
    errors = np.full((len(poses), 4), np.nan)
    known = [k for k, pose in enumerate(poses) if pose.world_from_object is not None]
    if not known:
        return errors, -1
    reference = next((k for k in known if k >= take.first), known[0])
    start = poses[reference].world_from_object
    assert start is not None
    center, floor = start.translation, np.diag(np.repeat([1e-12, (1e-6 * take.radius) ** 2], 3))
    for k in known:
        pose = poses[k].world_from_object
        assert pose is not None
        true, motion = truth[k] * truth[reference].inv(), pose * start.inv()
        turn = (motion.rotation * true.rotation.inv()).as_rotvec()
        shift = motion.apply(center) - true.apply(center)
        # Covariances are of the motion since the first frame with a pose.
        covariance = floor + poses[k].covariance
        if reference != known[0]:
            covariance = covariance + poses[reference].covariance
        sds = [
            float(np.sqrt(max(e @ np.linalg.solve(covariance[part, part], e), 0.0)))
            for e, part in ((turn, slice(0, 3)), (shift, slice(3, 6)))
        ]
        errors[k] = np.degrees(np.linalg.norm(turn)), np.linalg.norm(shift) / take.radius, *sds
    return errors, reference


HEADER = (
    "| kind | runs | frames | localized, % | wrong and sure: tracked | refined | error, deg: median, worst; tracked "
    "| refined | error, radii: tracked | refined | in the bounds, %: tracked | refined | filled in, their bounds: tracked "
    "| refined |\n" + "|---" * 14 + "|"
)


def format_row(name: str, runs: Sequence[Run]) -> str:
    """Format the table row of some runs."""
    frames = sum(run.frames for run in runs)
    tracked, refined = [run.tracked for run in runs], [run.refined for run in runs]
    cells = [
        name,
        f"{len(runs)}",
        f"{frames}",
        " / ".join(f"{100 * sum(s.localized for s in scores) / frames:.0f}" for scores in (tracked, refined)),
        _format_sure(tracked),
        _format_sure(refined),
        *(_format_errors([s.degrees for s in scores], 2) for scores in (tracked, refined)),
        *(_format_errors([s.radii for s in scores], 3) for scores in (tracked, refined)),
        *(_format_bounds([(s.n_bounded, s.in_bounds) for s in scores]) for scores in (tracked, refined)),
        *(_format_filled(scores) for scores in (tracked, refined)),
    ]
    return "| " + " | ".join(cells) + " |"


def _format_sure(scores: Sequence[Score]) -> str:
    sure, n_runs = sum(s.sure for s in scores), sum(s.sure > 0 for s in scores)
    return f"{sure} in {n_runs}" if sure else "0"


def _format_errors(errors: Sequence[tuple[float, float]], digits: int) -> str:
    finite = np.array([e for e in errors if np.isfinite(e).all()])
    return f"{np.median(finite[:, 0]):.{digits}f}, {finite[:, 1].max():.{digits}f}" if len(finite) else "-"


def _format_bounds(counts: Sequence[tuple[int, tuple[int, int]]]) -> str:
    total = sum(n for n, _ in counts)
    return ", ".join(f"{100 * sum(inside[i] for _, inside in counts) / total:.0f}" for i in range(2)) if total else "-"


def _format_filled(scores: Sequence[Score]) -> str:
    total, bounds = sum(s.n_filled for s in scores), _format_bounds([(s.n_filled, s.filled_in_bounds) for s in scores])
    return f"{total}: {bounds}" if total else "-"


def format_worst(runs: Sequence[Run]) -> list[str]:
    """Format a line for each of the runs with most frames wrong and sure."""
    worst = sorted(runs, key=lambda run: -max(run.tracked.sure, run.refined.sure))[:N_WORST]
    return [
        f"{run.kind} {run.seed}: {run.cameras} cameras, {'boxes' if run.boxes else 'no boxes'}, "
        f"{run.tracked.sure} and {run.refined.sure} of {run.frames} frames, "
        f"{run.refined.degrees[1]:.1f} deg, {run.refined.radii[1]:.2f} radii, refinement: {run.refinement}"
        for run in worst
        if run.tracked.sure or run.refined.sure
    ]


def write_film(path: Path, kinds: Sequence[str], seeds: Sequence[int]) -> None:
    """Write the first, middle and last images of up to three cameras of each take, one row per take."""
    rows = []
    for kind in kinds:
        for seed in seeds:
            take = draw(kind, seed)
            images_at = [[image for image in frame.images if image is not None] for frame in take.frames()]
            images = [
                cv2.resize(images_at[k][c], (240, 180), interpolation=cv2.INTER_AREA)
                for c in range(min(3, len(take.scene.rig)))
                for k in (0, len(images_at) // 2, len(images_at) - 1)
            ]
            images += [np.zeros_like(images[0])] * (9 - len(images))
            row = np.hstack(images)
            cv2.putText(row, f"{kind} {seed}", (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 255, 255), 1, cv2.LINE_AA)
            rows.append(row)
    cv2.imwrite(str(path), np.vstack(rows))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", metavar="KIND")
    parser.add_argument("--group", choices=list(GROUPS), action="append", default=[])
    parser.add_argument("--seeds", default="0:3", help="first:end")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes")
    parser.add_argument("--each", action="store_true", help="print a row for each run")
    parser.add_argument("--list", action="store_true", help="print the kinds and stop")
    parser.add_argument("--json", type=Path, metavar="FILE")
    parser.add_argument("--film", type=Path, metavar="FILE", help="write pictures of the takes and stop")
    arguments = parser.parse_args()
    names = arguments.kinds + [name for group in arguments.group for name in GROUPS[group]] or list(KINDS)
    unknown = [name for name in names if name not in KINDS]
    if unknown:
        parser.error(f"unknown kind: {', '.join(unknown)}; known are {', '.join(KINDS)}")
    first, _, end = arguments.seeds.partition(":")
    seeds = range(int(first), int(end or int(first) + 1))
    if arguments.list:
        for group, kinds in GROUPS.items():
            print(f"{group}: {', '.join(kinds)}")
        return
    warn_without_photographs()
    if arguments.film:
        write_film(arguments.film, names, seeds)
    else:
        report(names, seeds, arguments.jobs, each=arguments.each, file=arguments.json)


def report(names: Sequence[str], seeds: Sequence[int], jobs: int, *, each: bool, file: Path | None) -> None:
    """Run the takes in parallel processes, print the table, and write the results to a file."""
    print(HEADER, flush=True)
    runs: list[Run] = []
    with ProcessPoolExecutor(jobs) as pool:
        pending = {name: [pool.submit(run_take, name, seed) for seed in seeds] for name in names}
        for name, futures in pending.items():
            done = [future.result() for future in futures]
            runs += done
            for run in done if each else ():
                print(format_row(f"{name} {run.seed}", [run]), run.tracked.statuses, run.refusal, flush=True)
            print(format_row(name, done), flush=True)
            if file is not None:
                file.write_text(json.dumps([asdict(run) for run in runs], indent=1) + "\n")
    print(format_row("all", runs))
    print("\nMost frames wrong and sure, as tracked and as refined:")
    print("\n".join(format_worst(runs)) or "none")
    print("\n".join(f"{run.kind} {run.seed}: {run.refusal}" for run in runs if run.refusal))


if __name__ == "__main__":
    main()
