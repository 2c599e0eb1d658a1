"""What a bad camera does to the paper's estimate, and how well it is found: Monte Carlo over rigs, faults and turns.

    python benchmarks/sensors.py [--scenes 100] [--rigs 4 8 16] [--turns 5 15] [--clean | --boards | --motion]

Cameras stand around an ellipsoid or a box (alternately above and below it, 60 matches each, 0.5 px of noise) that turns
about any axis; one or more of them are at fault. Errors of the rotation in degrees: with all cameras, with the bad ones
left out by hand, and by `solve_robust`, medians / 90th percentiles; ratio of robust to by hand, of both. "found": faults
named; "kind": of those, of the right kind; "unsure": scenes in which the cameras are said to disagree without a name;
"false": good cameras named, of all good ones. `--clean`: no faults, more rigs and turns. `--boards`: flat boards, facing the
cameras or seen obliquely, that turn or stand still: without faults, by the angle from which the board is seen, and with one,
`--first` is the first seed. `--motion`: `estimate_motion`, with
cameras whose calibration is turned about any axis, then without faults but with many outliers.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple, get_args

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.moments import PairMoments
from sylpose.relative_pose.motion import estimate_motion
from sylpose.rig import Rig
from sylpose.simulate import (
    OutlierKind,
    SimulatedPair,
    arc,
    box,
    dome,
    ellipsoid,
    plane,
    random_motion,
    ring,
    simulate_matches,
)
from sylpose.simulate.bodies import Body
from sylpose.sylvester.camera_faults import FaultKind, solve_robust
from sylpose.sylvester.centralized import solve_centralized


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


# Focal length of all cameras, pixels, and the angles by which cameras before boards are counted, degrees.
FOCAL, ANGLES = 1000.0, (0, 60, 80, 85, 90)


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
    bad = tuple(rng.choice(n, n_bad, replace=False).tolist()) if case else ()
    return with_faults(rig, pair, bad, case, rng)


def with_faults(
    rig: Rig, pair: SimulatedPair, bad: tuple[int, ...], case: Case | None, rng: np.random.Generator
) -> Scene:
    """What cameras see, some of them at fault."""
    rotations = np.array([camera.rotation for camera in rig])
    points = [(m.x, m.y) for m in pair.matches]
    for c in bad:
        assert case is not None
        x, y = points[c]
        rotations[c], x, y = spoiled(rotations[c], x, y, case, rng)
        points[c] = x, y
    moments = [PairMoments.from_matches(x, y) for x, y in points]
    return Scene(rotations, moments, bad, pair.motion.rotation.as_matrix())


def spoiled(
    rotation: FloatArray, x: FloatArray, y: FloatArray, case: Case, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A camera's rotation and matches, as a fault makes them."""
    if case.name == "turned":
        axis = rng.standard_normal(3)
        turn = Rotation.from_rotvec(np.deg2rad(case.size) * axis / np.linalg.norm(axis))
        return turn.as_matrix() @ rotation, x, y
    if case.name == "mirrored":
        return rotation, x * [-1, 1], y * [-1, 1]
    if case.name == "backwards":
        return rotation, y, x
    if case.name == "frozen":
        return rotation, x, x + case.size / FOCAL * rng.standard_normal(x.shape)
    if case.name == "junk":
        anywhere = [rng.uniform(p.min(axis=0), p.max(axis=0), p.shape) for p in (x, y)]
        return rotation, anywhere[0], anywhere[1]
    raise ValueError(f"unknown fault {case.name!r}")


class BoardScene(NamedTuple):
    """A scene, what was drawn for it, by name, and the angle between each camera's view and the board's normal, degrees."""

    scene: Scene
    drawn: dict[str, str | float]
    angles: FloatArray


def board_scene(seed: int, case: Case | None = None, n: int | None = None) -> BoardScene:
    """A board of 0.3 by 0.2 before cameras around it or on one side of it; cameras, turn, noise and matches are drawn."""
    rng = np.random.default_rng([seed, 2])
    around, oblique = rng.random(2) < 0.5
    drawn_n, turn = int(rng.choice([3, 4, 5, 8, 16])), float(rng.choice([0, 1, 5, 10, 15, 30]))
    noise, matches = float(rng.choice([0.2, 0.5, 1.0])), int(rng.choice([20, 60, 300]))
    shifted = turn > 0 or rng.random() < 0.5
    if case is not None:
        turn, noise, matches, shifted = 10.0, 0.5, 60, True
    n = drawn_n if n is None else n
    heights = [0.4 * (-1) ** k for k in range(n)]
    rig = ring(n, focal=FOCAL, height=heights) if around else arc(n, 60.0 / (n - 1), focal=FOCAL, height=heights)
    tilt, about = np.deg2rad(rng.uniform(60, 80) if oblique else rng.uniform(0, 30)), rng.uniform(0, 2 * np.pi)
    pose = Rotation.from_rotvec(tilt * np.array([np.cos(about), np.sin(about), 0.0]))
    pose = pose * Rotation.from_rotvec([0, 0, rng.uniform(0, 2 * np.pi)])
    motion = random_motion(turn, 0.03 * shifted, rng)
    start = RigidTransform.from_rotation(pose)
    pair = simulate_matches(rig, plane((0.3, 0.2)), motion, rng=rng, per_camera=matches, noise_px=noise, start=start)
    views = np.array([camera.direction for camera in rig])
    angles = np.rad2deg(np.arccos(np.abs(views @ pose.apply([0.0, 0.0, 1.0]))))
    bad = () if case is None else (int(rng.integers(n)),)
    drawn: dict[str, str | float] = {
        "cameras": n,
        "turn °": turn if shifted else "none, nor a shift",
        "noise px": noise,
        "matches": matches,
        "rig": "around" if around else "on one side",
        "board": "oblique" if oblique else "facing",
    }
    return BoardScene(with_faults(rig, pair, bad, case, rng), drawn, angles)


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


def board_table(scenes: int, first: int) -> None:
    """False alarms before boards without a fault, by all that was drawn."""
    rows = []
    for seed in range(first, first + scenes):
        made = board_scene(seed)
        found = solve_robust(made.scene.rotations, made.scene.moments)
        named = np.array([fault is not None for fault in found.faults])
        rows.append((made.drawn, made.angles, named, not found.diagnosis.consistent))
    bins = list(pairwise(ANGLES))
    print(f"| boards | cameras | named | {' | '.join(f'at {a} to {b}°' for a, b in bins)} | unsure |")
    print("|---|---|---|" + "---|" * len(bins) + "---|")
    groups = [("all", rows)]
    for name in rows[0][0]:
        for value in sorted({r[0][name] for r in rows}, key=lambda v: (isinstance(v, str), v)):
            groups.append((f"{name}: {value}", [r for r in rows if r[0][name] == value]))
    for title, some in groups:
        angles, named = (np.concatenate([r[k] for r in some]) for k in (1, 2))
        shares = [named[(angles >= a) & (angles < b)] for a, b in bins]
        cells = [f"{share.mean():.2%}" if len(share) else "-" for share in (named, *shares)]
        print(f"| {title} | {len(named)} | {' | '.join(cells)} | {np.mean([r[3] for r in some]):.1%} |")


def board_fault_table(scenes: int, first: int, rigs: Sequence[int]) -> None:
    """Boards with one camera at fault."""
    print("| cameras | fault of one, turn 10° | found | kind | unsure | false | ratio of errors, median |")
    print("|---|---|---|---|---|---|---|")
    for n in rigs:
        for case in CASES:
            some = [outcome(board_scene(seed, case, n).scene, case.kind) for seed in range(first, first + scenes)]
            right, false = sum(o.right for o in some), sum(o.false for o in some)
            found, errors = sum(o.found for o in some), np.median([(o.by_hand, o.robust) for o in some], axis=0)
            print(
                f"| {n} | {case.name} {case.size:g} | {found / len(some):.0%} | "
                f"{f'{right / found:.0%}' if found else '-'} | {np.mean([o.unsure for o in some]):.0%} | "
                f"{false / ((n - 1) * len(some)):.2%} | {errors[1] / errors[0]:.2f} |",
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
    parser.add_argument("--boards", action="store_true")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--motion", action="store_true")
    options = parser.parse_args()
    if options.motion:
        motion_tables(options.scenes)
    elif options.boards:
        board_table(options.scenes, options.first)
        print()
        board_fault_table(options.scenes // 10, options.first, options.rigs)
    elif options.clean:
        clean_table(options.scenes)
    else:
        table(options.rigs, options.turns, options.scenes)


if __name__ == "__main__":
    main()
