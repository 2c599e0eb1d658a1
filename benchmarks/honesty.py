"""Does OK mean OK? `estimate_motion` and `estimate_pose` on nearly seventy kinds of problems, most of them nasty.

    python benchmarks/honesty.py [--scenes 200] [--first 0] [--kinds "two cameras*"] [--worst 3] [--seed 17]

*Wrong and sure* is an answer with the status OK whose turn is off by more than 3 degrees, or whose displacement by as much
as 3 degrees move the object's surface, and whose squared error in units of its own covariance has less than one chance in a
million (38, six degrees of freedom). Lengths are the calibration's: where that is wrong the turn alone is judged. Of each
kind: the share of OK, how many of these were wrong and sure, the other statuses, and of the worst ones their seeds
(`--kinds NAME --seed N` repeats one alone). Of kinds marked with * everything is as usual: they must be OK. Kinds marked
with - are not counted: a wrong calibration of one of two cameras, of which the matches need not tell anything.

The exit code is 1 where more than 1 in 1,000 of all answers are wrong and sure, or more than 1 in 200 of a kind (and more
than one), or where less than 97 % of the usual ones are OK. The kinds: benchmarks/honesty_kinds.py.
"""

from __future__ import annotations

import argparse
import fnmatch
import sys
import time
from collections import Counter
from typing import NamedTuple

import numpy as np

from benchmarks.honesty_kinds import MOTIONS, POSES, Problem, make_problem
from sylpose import Motion, Status, estimate_motion, estimate_pose
from sylpose.geometry.robust_loss import chi_squared_bound

__all__ = ["Outcome", "judge", "outcomes"]

# Beyond both an answer is wrong and sure of it: degrees, and the square of the error in its own standard deviations.
WRONG_DEG, WRONG_SQUARE = 3.0, chi_squared_bound(6, 1e-6)
# What is asked for: shares of wrong and sure ones, over all and of a kind, and of OK where all is as usual.
MOST, MOST_OF_A_KIND, LEAST_OK = 1 / 1000, 1 / 200, 0.97


class Outcome(NamedTuple):
    """What came of a scene: the error in degrees, of the displacement in radii of the object, its square in its own standard
    deviations (NaN where it is not OK), and whether it is wrong and sure."""

    status: Status
    degrees: float
    radii: float
    square: float
    wrong: bool


def solve(problem: Problem) -> Motion:
    """What the estimator says."""
    if problem.matches:
        return estimate_motion(problem.rig, problem.matches)
    return estimate_pose(problem.rig, problem.points, problem.pixels)


def judge(problem: Problem, found: Motion) -> Outcome:
    """An answer beside the truth, the nearest where there are several."""
    best = Outcome(found.status, np.nan, np.nan, np.inf, False)
    if found.status is not Status.OK or found.motion is None:
        return best._replace(square=np.nan)
    for truth in problem.truths:
        turn = (truth.rotation * found.motion.rotation.inv()).as_rotvec()
        off = truth.apply(found.center) - found.motion.apply(found.center)
        error = np.concatenate([turn, off])
        degrees, radii = float(np.rad2deg(np.linalg.norm(turn))), float(np.linalg.norm(off)) / problem.radius
        square = float(error @ found.information @ error)
        if not square >= best.square:
            far = degrees > WRONG_DEG or (problem.calibrated and float(np.rad2deg(radii)) > WRONG_DEG)
            best = Outcome(found.status, degrees, radii, square, far and square > WRONG_SQUARE)
    return best


def outcomes(name: str, seeds: range) -> list[Outcome]:
    """Of scenes of a kind."""
    problems = [make_problem(name, seed) for seed in seeds]
    return [judge(problem, solve(problem)) for problem in problems]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=200, help="of each kind")
    parser.add_argument("--first", type=int, default=0, help="the first one's seed")
    parser.add_argument("--kinds", default="*")
    parser.add_argument("--worst", type=int, default=3, help="so many wrong ones of each kind are shown")
    parser.add_argument("--seed", type=int, help="this scene alone, with all that is said of it")
    options = parser.parse_args()
    kinds = {name: kind for name, kind in (MOTIONS | POSES).items() if fnmatch.fnmatch(name, options.kinds)}
    if options.seed is not None:
        for name in kinds:
            problem = make_problem(name, options.seed)
            said = solve(problem)
            given = [len(part) for part in problem.matches or problem.points]
            print(name, judge(problem, said), f"{said.n_inliers} of {given}", *said.faults, sep="\n  ")
        return 0
    print("| kind | OK | wrong and sure | other statuses | worst |\n|---|---|---|---|---|")
    scenes = all_wrong = usual = usual_ok = 0
    shares: dict[str, float] = {}
    begun = time.perf_counter()
    for name, kind in kinds.items():
        seeds = range(options.first, options.first + options.scenes)
        found = outcomes(name, seeds)
        ok = sum(o.status is Status.OK for o in found)
        wrong = [(o, seed) for o, seed in zip(found, seeds, strict=True) if o.wrong]
        others = Counter(o.status.name for o in found if o.status is not Status.OK).most_common()
        worst = sorted(wrong, key=lambda one: -max(one[0].degrees, float(np.rad2deg(one[0].radii))))[: options.worst]
        shown = "; ".join(f"{s}: {o.degrees:.1f}°, {100 * o.radii:.0f} %, {o.square:.0f}" for o, s in worst)
        told = ", ".join(f"{status} {n}" for status, n in others)
        star = "*" if kind.regular else "-" if kind.untold else ""
        print(f"| {name}{star} | {ok / len(found):.1%} | {len(wrong)} of {len(found)} | {told} | {shown} |", flush=True)
        if kind.untold:
            continue
        scenes, all_wrong = scenes + len(found), all_wrong + len(wrong)
        shares[name] = len(wrong) / len(found) if len(wrong) > 1 else 0.0
        usual, usual_ok = usual + kind.regular * len(found), usual_ok + kind.regular * ok
    of_usual = usual_ok / usual if usual else 1.0
    kind_of_most = max(shares, key=lambda name: shares[name], default="none")
    worst_kind = f"worst kind: {kind_of_most} ({shares.get(kind_of_most, 0.0):.1%})"
    if not any(shares.values()):
        worst_kind = "more than one in no kind"
    print(
        f"\n{all_wrong} of {scenes} wrong and sure ({1000 * all_wrong / max(scenes, 1):.2f} in 1,000); "
        f"{worst_kind}; {of_usual:.1%} of the usual ones OK; "
        f"{time.perf_counter() - begun:.0f} s"
    )
    return int(all_wrong > MOST * scenes or shares.get(kind_of_most, 0.0) > MOST_OF_A_KIND or of_usual < LEAST_OK)


if __name__ == "__main__":
    sys.exit(main())
