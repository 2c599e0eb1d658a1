"""What a bad camera does to the paper's estimate, and how well it is found: Monte Carlo over rigs, faults and turns.

    python benchmarks/sensors.py [--scenes 100] [--rigs 4 8 16] [--turns 5 15] [--clean | --motion]

Cameras stand around an ellipsoid or a box (alternately above and below it, 60 matches each, 0.5 px of noise) that turns
about any axis; one or more of them are at fault. Errors of the rotation in degrees: with all cameras, with the bad ones
left out by hand, and by `solve_robust`, medians / 90th percentiles; ratio of robust to by hand, of both. "found": faults
named; "kind": of those, of the right kind; "unsure": scenes in which the cameras are said to disagree without a name;
"false": good cameras named, of all good ones. `--clean`: no faults, more rigs and turns. `--motion`: `estimate_motion`, with
cameras whose calibration is turned about any axis, then without faults but with many outliers.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, get_args

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.moments import PairMoments
from sylpose.numerics.arrays import FloatArray
from sylpose.paper.bad_cameras import FaultKind, solve_robust
from sylpose.paper.centralized import solve_centralized
from sylpose.rig import Rig
from sylpose.simulate import OutlierKind, arc, box, dome, ellipsoid, random_motion, ring, simulate_matches
from sylpose.simulate.bodies import Body
from sylpose.two_frames.motion import estimate_motion


class Case(NamedTuple):
    """A fault and its size: degrees that a calibration is turned by, pixels of a frozen camera's noise; else unused."""

    name: str
    kind: FaultKind
    size: float = 0.0


CASES = (
    *(Case("turned", "calibration", size) for size in (5, 10, 20, 45, 90, 180)),
    Case("mirrored", "calibration"),
    Case("backwards", "calibration"),
    Case("frozen", "frozen", 0.0),
    Case("frozen", "frozen", 0.5),
    Case("junk", "junk"),
)


class Scene(NamedTuple):
    """Cameras (C, 3, 3) and their moments, some of them bad, and the true rotation (3, 3)."""

    rotations: FloatArray
    moments: list[PairMoments]
    bad: tuple[int, ...]
    truth: FloatArray


def scene(n: int, turn_deg: float, seed: int, case: Case | None, n_bad: int = 1, body: Body | None = None) -> Scene:
    """A rig of `n` cameras of which `n_bad`, drawn by the seed, are at fault."""
    rng = np.random.default_rng([seed, n, round(10 * turn_deg)])
    rig = ring(n, height=[0.4 * (-1) ** k for k in range(n)])
    shape = (ellipsoid((0.15, 0.12, 0.1)), box())[seed % 2] if body is None else body
    motion = random_motion(turn_deg, 0.03, rng)
    pair = simulate_matches(rig, shape, motion, rng=rng)
    rotations = np.array([camera.rotation for camera in rig])
    points = [(m.x, m.y) for m in pair.matches]
    bad = tuple(rng.choice(n, n_bad, replace=False).tolist()) if case else ()
    for c in bad:
        assert case is not None
        x, y = points[c]
        if case.name == "turned":
            axis = rng.standard_normal(3)
            turn = Rotation.from_rotvec(np.deg2rad(case.size) * axis / np.linalg.norm(axis))
            rotations[c] = turn.as_matrix() @ rotations[c]
        elif case.name == "mirrored":
            points[c] = x * [-1, 1], y * [-1, 1]
        elif case.name == "backwards":
            points[c] = y, x
        elif case.name == "frozen":
            points[c] = x, x + case.size / rig.cameras[c].focal * rng.standard_normal(x.shape)
        elif case.name == "junk":
            points[c] = (
                rng.uniform(x.min(axis=0), x.max(axis=0), x.shape),
                rng.uniform(y.min(axis=0), y.max(axis=0), y.shape),
            )
        else:
            raise ValueError(f"unknown fault {case.name!r}")
    moments = [PairMoments.from_matches(x, y) for x, y in points]
    return Scene(rotations, moments, bad, motion.rotation.as_matrix())


class Outcome(NamedTuple):
    """Errors (degrees) with all cameras, with the bad ones left out by hand and robust; faults found, those of the right
    kind, good cameras named; whether it was unsure."""

    all: float
    by_hand: float
    robust: float
    found: int
    right: int
    false: int
    unsure: bool


def outcome(s: Scene, kind: FaultKind | None = None) -> Outcome:
    """What becomes of a scene."""

    def error(rotation: FloatArray) -> float:
        return float(np.rad2deg(Rotation.from_matrix(rotation @ s.truth.T).magnitude()))

    good = [c for c in range(len(s.moments)) if c not in s.bad]
    robust = solve_robust(s.rotations, s.moments)
    named = {c: fault.kind for c, fault in enumerate(robust.faults) if fault is not None}
    return Outcome(
        error(solve_centralized(s.rotations, s.moments).rotation),
        error(solve_centralized(s.rotations[good], [s.moments[c] for c in good]).rotation),
        error(robust.solution.rotation) if robust.solution is not None else 180.0,
        sum(c in s.bad for c in named),
        sum(c in s.bad and k == kind for c, k in named.items()),
        sum(c in good for c in named),
        not robust.diagnosis.consistent,
    )


def table(rigs: Sequence[int], turns: Sequence[float], scenes: int) -> None:
    """One row per rig, turn, fault and number of bad cameras."""
    print(
        "| cameras | turn ° | fault | bad | all | by hand | robust | ratio 50 % / 90 % | found | kind | unsure | false |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|---|")
    for n in rigs:
        for turn in turns:
            for case in CASES:
                for n_bad in (1,) if n < 8 else (1, n // 4):
                    row = [outcome(scene(n, turn, seed, case, n_bad), case.kind) for seed in range(scenes)]
                    errors = np.array([o[:3] for o in row])
                    half, most = np.median(errors, axis=0), np.quantile(errors, 0.9, axis=0)
                    found = sum(o.found for o in row)
                    cells = [
                        *(f"{a:.2f} / {b:.2f}" for a, b in zip(half, most, strict=True)),
                        f"{half[2] / half[1]:.2f} / {most[2] / most[1]:.2f}",
                        f"{found / (n_bad * scenes):.0%}",
                        f"{sum(o.right for o in row) / found:.0%}" if found else "-",
                        f"{np.mean([o.unsure for o in row]):.0%}",
                        f"{sum(o.false for o in row) / ((n - n_bad) * scenes):.2%}",
                    ]
                    name = f"{case.name} {case.size:g}" if case.size else case.name
                    print(f"| {n} | {turn:g} | {name} | {n_bad} | {' | '.join(cells)} |", flush=True)


def clean_table(scenes: int) -> None:
    """False alarms without any fault."""
    print("| body | cameras | turn ° | false alarms, of all cameras | unsure | plain / robust error, median |")
    print("|---|---|---|---|---|---|")
    for name, body in (("ellipsoid", ellipsoid((0.15, 0.12, 0.1))), ("box", box())):
        for n in (3, 4, 8, 16):
            for turn in (1, 5, 10, 15, 30):
                row = [outcome(scene(n, turn, seed, None, body=body)) for seed in range(scenes)]
                errors = np.median([(o.all, o.robust) for o in row], axis=0)
                false = sum(o.false for o in row) / (n * scenes)
                unsure = np.mean([o.unsure for o in row])
                print(
                    f"| {name} | {n} | {turn} | {false:.2%} | {unsure:.1%} | {errors[0]:.2f} / {errors[1]:.2f} |",
                    flush=True,
                )


def motion_tables(scenes: int) -> None:
    """`estimate_motion`: 6 cameras, one of them calibrated wrongly; then rigs without faults, with outliers."""
    body = ellipsoid((0.15, 0.12, 0.1))
    print("| calibration off by ° | error / by hand: median, 90 %, worst | named | others named |")
    print("|---|---|---|---|")
    for off in (0, 3, 5, 10, 20, 45):
        ratios, named, others = [], 0, 0
        for seed in range(scenes):
            rig, rng = ring(6, height=[0.4 * (-1) ** k for k in range(6)]), np.random.default_rng(seed)
            pair = simulate_matches(rig, body, random_motion(10.0, 0.02, rng), rng=rng)
            axis = rng.standard_normal(3)
            wrong = Rotation.from_rotvec(np.deg2rad(off) * axis / np.linalg.norm(axis))
            bad = replace(
                rig["cam_2"],
                camera_from_world=RigidTransform.from_rotation(wrong) * rig["cam_2"].camera_from_world,
            )
            found = estimate_motion(Rig([bad if c.name == "cam_2" else c for c in rig], rig.unit), pair.matches)
            others_of = [name for name in rig.names if name != "cam_2"]
            kept = [m for m, name in zip(pair.matches, rig.names, strict=True) if name != "cam_2"]
            by_hand = estimate_motion(rig.subset(others_of), kept)
            errors = [
                180.0 if m.motion is None else np.rad2deg((m.motion.rotation * pair.motion.rotation.inv()).magnitude())
                for m in (found, by_hand)
            ]
            ratios.append(errors[0] / errors[1])
            named += any("cam_2" in text for text in found.faults)
            others += any("cam_2" not in text for text in found.faults)
        median, most, worst = np.quantile(ratios, [0.5, 0.9, 1.0])
        print(
            f"| {off} | {median:.2f}, {most:.2f}, {worst:.2f} | {named} of {scenes} | {others} of {scenes} |",
            flush=True,
        )
    print()
    print("| cameras | outliers | motions in which a good camera is named |")
    print("|---|---|---|")
    for n in (3, 4, 8):
        for kind in get_args(OutlierKind):
            alarms, total = 0, 0
            for seed in range(scenes):
                for share in (0.3, 0.5):
                    for rig in (ring(n, height=[0.4 * (-1) ** k for k in range(n)]), arc(n, 20.0), dome(n)):
                        rng = np.random.default_rng([seed, n, total])
                        motion = random_motion((2.0, 10.0)[seed % 2], 0.02, rng)
                        seen = (body, box())[seed // 2 % 2]
                        pair = simulate_matches(rig, seen, motion, rng=rng, outliers=share, outlier_kind=kind)
                        alarms += bool(estimate_motion(rig, pair.matches).faults)
                        total += 1
            print(f"| {n} | {kind}, 30 and 50 % | {alarms} of {total} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=100)
    parser.add_argument("--rigs", type=int, nargs="+", default=[4, 8, 16])
    parser.add_argument("--turns", type=float, nargs="+", default=[5, 15])
    parser.add_argument("--clean", action="store_true")
    parser.add_argument("--motion", action="store_true")
    options = parser.parse_args()
    if options.motion:
        motion_tables(options.scenes)
    elif options.clean:
        clean_table(options.scenes)
    else:
        table(options.rigs, options.turns, options.scenes)


if __name__ == "__main__":
    main()
