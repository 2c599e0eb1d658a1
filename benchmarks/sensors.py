"""Detection of faulty cameras in the paper's estimate: Monte Carlo over rigs, faults and rotations.

    python benchmarks/sensors.py [--scenes 100] [--rigs 4 8 16] [--turns 5 15] [--clean | --boards | --motion]

The cameras surround an ellipsoid or a box that rotates about a random axis, alternately above and below it, with 60 matches
each and 0.5 px of noise. One or more cameras are faulty. The table gives rotation errors in degrees, median / 90th
percentile: with all cameras, with the faulty ones excluded by hand (the oracle), and by `solve_robust`; and the ratio of
robust to oracle.

- detected: share of the faults that are reported; right kind: share of these with the right kind.
- inconsistent: share of the scenes whose cameras are reported as inconsistent.
- false alarms: share of the good cameras that are reported.

Options: `--clean` has no faults, but more rigs and rotations. `--boards` has flat boards, facing the cameras or oblique,
static or rotating: first without faults, by viewing angle, then with one fault; `--first` is the first seed. `--motion` runs
`estimate_motion`: one camera's calibration is rotated about a random axis; then no faults, but many outliers.
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
    """Fault and its size: rotation of a calibration in degrees, or noise of a frozen camera in pixels; else unused."""

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


# Focal length of all cameras, pixels, and the bins of the viewing angles of boards, degrees.
FOCAL_PX, ANGLE_BINS_DEG = 1000.0, (0, 60, 80, 85, 90)


class Scene(NamedTuple):
    """Camera rotations (C, 3, 3), moments, indices of the faulty cameras, and the true rotation (3, 3)."""

    rotations: FloatArray
    moments: list[PairMoments]
    faulty: tuple[int, ...]
    truth: FloatArray


def simulate_scene(
    n: int, turn_deg: float, seed: int, case: Case | None, n_faulty: int = 1, body: Body | None = None
) -> Scene:
    """Simulate a rig of `n` cameras, of which `n_faulty` random ones are faulty."""
    rng = np.random.default_rng([seed, n, round(10 * turn_deg)])
    rig = ring(n, height=[0.4 * (-1) ** k for k in range(n)])
    shape = (ellipsoid((0.15, 0.12, 0.1)), box())[seed % 2] if body is None else body
    motion = random_motion(turn_deg, 0.03, rng)
    pair = simulate_matches(rig, shape, motion, rng=rng)
    faulty = tuple(rng.choice(n, n_faulty, replace=False).tolist()) if case else ()
    return apply_faults(rig, pair, faulty, case, rng)


def apply_faults(
    rig: Rig, pair: SimulatedPair, faulty: tuple[int, ...], case: Case | None, rng: np.random.Generator
) -> Scene:
    """Apply a fault to some cameras and compute the moments of all."""
    rotations = np.array([camera.rotation for camera in rig])
    points = [(m.x, m.y) for m in pair.matches]
    for c in faulty:
        assert case is not None
        x, y = points[c]
        rotations[c], x, y = apply_fault(rotations[c], x, y, case, rng)
        points[c] = x, y
    moments = [PairMoments.from_matches(x, y) for x, y in points]
    return Scene(rotations, moments, faulty, pair.motion.rotation.as_matrix())


def apply_fault(
    rotation: FloatArray, x: FloatArray, y: FloatArray, case: Case, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Apply a fault to a camera's rotation and matches."""
    if case.name == "turned":
        axis = rng.standard_normal(3)
        error_rotation = Rotation.from_rotvec(np.deg2rad(case.size) * axis / np.linalg.norm(axis))
        return error_rotation.as_matrix() @ rotation, x, y
    if case.name == "mirrored":
        return rotation, x * [-1, 1], y * [-1, 1]
    if case.name == "backwards":
        return rotation, y, x
    if case.name == "frozen":
        return rotation, x, x + case.size / FOCAL_PX * rng.standard_normal(x.shape)
    if case.name == "junk":
        random_points = [rng.uniform(p.min(axis=0), p.max(axis=0), p.shape) for p in (x, y)]
        return rotation, random_points[0], random_points[1]
    raise ValueError(f"unknown fault {case.name!r}")


class BoardScene(NamedTuple):
    """Scene, its drawn parameters by name, and the angle between each camera's view and the board's normal, degrees."""

    scene: Scene
    drawn: dict[str, str | float]
    angles: FloatArray


def simulate_board_scene(seed: int, case: Case | None = None, n: int | None = None) -> BoardScene:
    """Simulate a board of 0.3 by 0.2 with random cameras (around it or on one side), rotation, noise and matches."""
    rng = np.random.default_rng([seed, 2])
    is_around, is_oblique = rng.random(2) < 0.5
    drawn_n, rotation_deg = int(rng.choice([3, 4, 5, 8, 16])), float(rng.choice([0, 1, 5, 10, 15, 30]))
    noise, matches = float(rng.choice([0.2, 0.5, 1.0])), int(rng.choice([20, 60, 300]))
    is_moving = rotation_deg > 0 or rng.random() < 0.5
    if case is not None:
        rotation_deg, noise, matches, is_moving = 10.0, 0.5, 60, True
    n = drawn_n if n is None else n
    heights = [0.4 * (-1) ** k for k in range(n)]
    rig = (
        ring(n, focal=FOCAL_PX, height=heights) if is_around else arc(n, 60.0 / (n - 1), focal=FOCAL_PX, height=heights)
    )
    tilt, azimuth = np.deg2rad(rng.uniform(60, 80) if is_oblique else rng.uniform(0, 30)), rng.uniform(0, 2 * np.pi)
    pose = Rotation.from_rotvec(tilt * np.array([np.cos(azimuth), np.sin(azimuth), 0.0]))
    pose = pose * Rotation.from_rotvec([0, 0, rng.uniform(0, 2 * np.pi)])
    motion = random_motion(rotation_deg, 0.03 * is_moving, rng)
    start = RigidTransform.from_rotation(pose)
    pair = simulate_matches(rig, plane((0.3, 0.2)), motion, rng=rng, per_camera=matches, noise_px=noise, start=start)
    views = np.array([camera.direction for camera in rig])
    angles = np.rad2deg(np.arccos(np.abs(views @ pose.apply([0.0, 0.0, 1.0]))))
    faulty = () if case is None else (int(rng.integers(n)),)
    drawn: dict[str, str | float] = {
        "cameras": n,
        "rotation °": rotation_deg if is_moving else "static",
        "noise px": noise,
        "matches": matches,
        "rig": "around" if is_around else "on one side",
        "board": "oblique" if is_oblique else "facing",
    }
    return BoardScene(apply_faults(rig, pair, faulty, case, rng), drawn, angles)


class Outcome(NamedTuple):
    """Rotation errors (degrees) and counts of one scene.

    Attributes:
        all_cameras, oracle, robust: error with all cameras, without the faulty ones, and of `solve_robust`.
        n_detected, n_right_kind, n_false_alarms: numbers of faults detected, of these with the right kind,
            and of good cameras reported.
        is_inconsistent: the cameras are reported as inconsistent.
    """

    all_cameras: float
    oracle: float
    robust: float
    n_detected: int
    n_right_kind: int
    n_false_alarms: int
    is_inconsistent: bool


def evaluate_scene(s: Scene, kind: FaultKind | None = None) -> Outcome:
    """Solve a scene by all methods and compare the results with the truth."""

    def error(rotation: FloatArray) -> float:
        return float(np.rad2deg(Rotation.from_matrix(rotation @ s.truth.T).magnitude()))

    good = [c for c in range(len(s.moments)) if c not in s.faulty]
    robust = solve_robust(s.rotations, s.moments)
    named = {c: fault.kind for c, fault in enumerate(robust.faults) if fault is not None}
    return Outcome(
        error(solve_centralized(s.rotations, s.moments).rotation),
        error(solve_centralized(s.rotations[good], [s.moments[c] for c in good]).rotation),
        error(robust.solution.rotation) if robust.solution is not None else 180.0,
        sum(c in s.faulty for c in named),
        sum(c in s.faulty and k == kind for c, k in named.items()),
        sum(c in good for c in named),
        not robust.diagnosis.consistent,
    )


def print_fault_table(rigs: Sequence[int], turns: Sequence[float], scenes: int) -> None:
    """Print one row per rig, rotation, fault and number of faulty cameras."""
    print(
        "| cameras | rotation, deg | fault | faulty cameras | error, all cameras | error, oracle | error, robust "
        "| robust / oracle, 50 % / 90 % | detected | right kind | inconsistent | false alarms |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|---|")
    for n in rigs:
        for turn in turns:
            for case in CASES:
                for n_bad in (1,) if n < 8 else (1, n // 4):
                    row = [
                        evaluate_scene(simulate_scene(n, turn, seed, case, n_bad), case.kind) for seed in range(scenes)
                    ]
                    errors = np.array([o[:3] for o in row])
                    half, most = np.median(errors, axis=0), np.quantile(errors, 0.9, axis=0)
                    found = sum(o.n_detected for o in row)
                    cells = [
                        *(f"{a:.2f} / {b:.2f}" for a, b in zip(half, most, strict=True)),
                        f"{half[2] / half[1]:.2f} / {most[2] / most[1]:.2f}",
                        f"{found / (n_bad * scenes):.0%}",
                        f"{sum(o.n_right_kind for o in row) / found:.0%}" if found else "-",
                        f"{np.mean([o.is_inconsistent for o in row]):.0%}",
                        f"{sum(o.n_false_alarms for o in row) / ((n - n_bad) * scenes):.2%}",
                    ]
                    name = f"{case.name} {case.size:g}" if case.size else case.name
                    print(f"| {n} | {turn:g} | {name} | {n_bad} | {' | '.join(cells)} |", flush=True)


def print_clean_table(scenes: int) -> None:
    """Print the false alarms without any fault."""
    print(
        "| body | cameras | rotation, deg | false alarms, share of the cameras | inconsistent "
        "| error, all cameras / robust, median |"
    )
    print("|---|---|---|---|---|---|")
    for name, body in (("ellipsoid", ellipsoid((0.15, 0.12, 0.1))), ("box", box())):
        for n in (3, 4, 8, 16):
            for turn in (1, 5, 10, 15, 30):
                row = [evaluate_scene(simulate_scene(n, turn, seed, None, body=body)) for seed in range(scenes)]
                errors = np.median([(o.all_cameras, o.robust) for o in row], axis=0)
                false = sum(o.n_false_alarms for o in row) / (n * scenes)
                unsure = np.mean([o.is_inconsistent for o in row])
                print(
                    f"| {name} | {n} | {turn} | {false:.2%} | {unsure:.1%} | {errors[0]:.2f} / {errors[1]:.2f} |",
                    flush=True,
                )


def print_board_table(scenes: int, first: int) -> None:
    """Print the false alarms for boards without faults, by each drawn parameter."""
    rows = []
    for seed in range(first, first + scenes):
        refine_simulated = simulate_board_scene(seed)
        found = solve_robust(refine_simulated.scene.rotations, refine_simulated.scene.moments)
        named = np.array([fault is not None for fault in found.faults])
        rows.append((refine_simulated.drawn, refine_simulated.angles, named, not found.diagnosis.consistent))
    bins = list(pairwise(ANGLE_BINS_DEG))
    print(f"| boards | cameras | false alarms | {' | '.join(f'at {a} to {b}°' for a, b in bins)} | inconsistent |")
    print("|---|---|---|" + "---|" * len(bins) + "---|")
    groups = [("all", rows)]
    for name in rows[0][0]:
        for value in sorted({r[0][name] for r in rows}, key=lambda v: (isinstance(v, str), v)):
            groups.append((f"{name}: {value}", [r for r in rows if r[0][name] == value]))
    for title, group_rows in groups:
        angles, named = (np.concatenate([r[k] for r in group_rows]) for k in (1, 2))
        shares = [named[(angles >= a) & (angles < b)] for a, b in bins]
        cells = [f"{share.mean():.2%}" if len(share) else "-" for share in (named, *shares)]
        print(f"| {title} | {len(named)} | {' | '.join(cells)} | {np.mean([r[3] for r in group_rows]):.1%} |")


def print_board_faults(scenes: int, first: int, rigs: Sequence[int]) -> None:
    """Print the detection of one faulty camera that sees a board."""
    print(
        "| cameras | fault of one, rotation 10° | detected | right kind | inconsistent | false alarms "
        "| robust / oracle, median |"
    )
    print("|---|---|---|---|---|---|---|")
    for n in rigs:
        for case in CASES:
            evaluated = [
                evaluate_scene(simulate_board_scene(seed, case, n).scene, case.kind)
                for seed in range(first, first + scenes)
            ]
            right, false = sum(o.n_right_kind for o in evaluated), sum(o.n_false_alarms for o in evaluated)
            found, errors = (
                sum(o.n_detected for o in evaluated),
                np.median([(o.oracle, o.robust) for o in evaluated], axis=0),
            )
            print(
                f"| {n} | {case.name} {case.size:g} | {found / len(evaluated):.0%} | "
                f"{f'{right / found:.0%}' if found else '-'} | {np.mean([o.is_inconsistent for o in evaluated]):.0%} | "
                f"{false / ((n - 1) * len(evaluated)):.2%} | {errors[1] / errors[0]:.2f} |",
                flush=True,
            )


def print_motion_tables(scenes: int) -> None:
    """Print results of `estimate_motion` for six cameras, one miscalibrated; then for rigs with outliers only."""
    body = ellipsoid((0.15, 0.12, 0.1))
    print("| calibration error, deg | error / oracle error: median, 90 %, max | detected | false alarms |")
    print("|---|---|---|---|")
    for error_deg in (0, 3, 5, 10, 20, 45):
        ratios, named, false_alarms = [], 0, 0
        for seed in range(scenes):
            rig, rng = ring(6, height=[0.4 * (-1) ** k for k in range(6)]), np.random.default_rng(seed)
            pair = simulate_matches(rig, body, random_motion(10.0, 0.02, rng), rng=rng)
            axis = rng.standard_normal(3)
            wrong = Rotation.from_rotvec(np.deg2rad(error_deg) * axis / np.linalg.norm(axis))
            bad = replace(
                rig["cam_2"],
                camera_from_world=RigidTransform.from_rotation(wrong) * rig["cam_2"].camera_from_world,
            )
            found = estimate_motion(Rig([bad if c.name == "cam_2" else c for c in rig], rig.unit), pair.matches)
            good_names = [name for name in rig.names if name != "cam_2"]
            kept = [m for m, name in zip(pair.matches, rig.names, strict=True) if name != "cam_2"]
            oracle = estimate_motion(rig.subset(good_names), kept)
            errors = [
                180.0 if m.motion is None else np.rad2deg((m.motion.rotation * pair.motion.rotation.inv()).magnitude())
                for m in (found, oracle)
            ]
            ratios.append(errors[0] / errors[1])
            named += any("cam_2" in text for text in found.faults)
            false_alarms += any("cam_2" not in text for text in found.faults)
        median, most, worst = np.quantile(ratios, [0.5, 0.9, 1.0])
        print(
            f"| {error_deg} | {median:.2f}, {most:.2f}, {worst:.2f} | {named} of {scenes} | {false_alarms} of {scenes} |",
            flush=True,
        )
    print()
    print("| cameras | outliers | motions with a false alarm |")
    print("|---|---|---|")
    for n in (3, 4, 8):
        for kind in get_args(OutlierKind):
            alarms, total = 0, 0
            for seed in range(scenes):
                for share in (0.3, 0.5):
                    for rig in (ring(n, height=[0.4 * (-1) ** k for k in range(n)]), arc(n, 20.0), dome(n)):
                        rng = np.random.default_rng([seed, n, total])
                        motion = random_motion((2.0, 10.0)[seed % 2], 0.02, rng)
                        shape = (body, box())[seed // 2 % 2]
                        pair = simulate_matches(rig, shape, motion, rng=rng, outliers=share, outlier_kind=kind)
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
        print_motion_tables(options.scenes)
    elif options.boards:
        print_board_table(options.scenes, options.first)
        print()
        print_board_faults(options.scenes // 10, options.first, options.rigs)
    elif options.clean:
        print_clean_table(options.scenes)
    else:
        print_fault_table(options.rigs, options.turns, options.scenes)


if __name__ == "__main__":
    main()
