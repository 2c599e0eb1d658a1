"""Rounds and bytes of the distributed estimators for various cameras, networks and disturbances.

    python benchmarks/consensus.py [--seeds 5] [--shared ../shared]

A scene is an ellipsoid of 0.15 m at 1.5 m that rotates by 5 degrees, with 60 matches per camera and 0.5 px of noise.
"Rounds to 1e-8" is the number of rounds after which every camera stays within 1e-8 rad of the centralized solution.
"Rounds" is the number until all cameras have detected convergence. Real recordings, if present, give SIFT matches between
adjacent frames within each camera, restricted to inliers of `estimate_motion`. Times are those of all cameras in one
process and one thread; divide them by the number of cameras for the time of one. Prints Markdown tables.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.depth_plane import match_recording
from benchmarks.sensors import CASES, simulate_scene
from sylpose import open_session
from sylpose.geometry.arrays import FloatArray
from sylpose.moments import PairMoments
from sylpose.packets import NO_FAULTS, Inbox, NetworkFaults, Packet, run_network
from sylpose.rig import Rig
from sylpose.simulate import arc, dome, ellipsoid, random_motion, ring, simulate_matches
from sylpose.status import Status
from sylpose.sylvester.camera_faults import solve_robust
from sylpose.sylvester.centralized import CentralizedSolution, solve_centralized
from sylpose.sylvester.distributed import refine as consensus
from sylpose.sylvester.distributed.refine import RefineState, start_refine, step_refine
from sylpose.sylvester.distributed.solvers import DistributedSolution, solve_exchange, solve_gossip, solve_refine

Problem = tuple[FloatArray, list[PairMoments], CentralizedSolution]

# The faults of `benchmarks.sensors` that run here.
SELECTED_FAULTS = {("turned", 20), ("turned", 90), ("mirrored", 0), ("frozen", 0), ("junk", 0)}
CAMERA_COUNTS = (3, 4, 6, 8, 12, 16, 32)


def make_zigzag_ring(n: int) -> Rig:
    """Return a ring of cameras, alternately above and below the object."""
    return ring(n, height=[0.4 * (-1) ** k for k in range(n)])


def make_zigzag_arc(n: int) -> Rig:
    """Return an arc of 60 degrees, alternately above and below the object."""
    return arc(n, 60 / (n - 1), height=[0.3 * (-1) ** k for k in range(n)])


def make_level_arc(n: int) -> Rig:
    """Return a level arc of 40 degrees."""
    return arc(n, 40 / (n - 1))


RIGS = {
    "ring": make_zigzag_ring,
    "dome": dome,
    "level ring": ring,
    "arc of 60°": make_zigzag_arc,
    "level arc of 40°": make_level_arc,
}


def simulate_problems(rig: Rig, seeds: int) -> Iterator[Problem]:
    """Yield seeded problems of a rig: camera rotations, moments and the centralized solution."""
    body = ellipsoid((0.15, 0.12, 0.1))
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        pair = simulate_matches(rig, body, random_motion(5.0, 0.02, rng), rng=rng)
        Q = np.array([c.rotation for c in rig])
        moments = [PairMoments.from_matches(m.x, m.y) for m in pair.matches]
        yield Q, moments, solve_centralized(Q, moments)


def count_rounds(problem: Problem, tolerance: float = 1e-8, bound: int = 2000) -> int:
    """Count rounds of `refine` until all cameras stay within `tolerance` of the centralized solution, at most `bound`."""
    Q, moments, reference = problem
    last_outside = 0

    def recorded_step(state: RefineState, inbox: Inbox) -> tuple[RefineState, list[Packet]]:
        nonlocal last_outside
        new, packets = step_refine(state, inbox)
        if not np.linalg.norm(new.rotation - reference.rotation) <= tolerance * np.sqrt(2):
            last_outside = max(last_outside, new.round)
        return new, packets

    n = len(Q)
    starts = [partial(start_refine, c, Q, moments[c]) for c in range(n)]
    run_network(starts, recorded_step, NO_FAULTS, bound)
    return min(last_outside + 1, bound)


def format_spread(values: Sequence[float]) -> str:
    """Format the median and the maximum."""
    return f"{np.median(values):.0f} (max. {max(values):.0f})"


def largest_angle(found: DistributedSolution, reference: CentralizedSolution, cameras: Sequence[int]) -> float:
    """Return the largest angle between the solutions of these cameras and the centralized one."""
    return float(np.linalg.norm(found.rotations[list(cameras)] - reference.rotation, axis=(1, 2)).max() / np.sqrt(2))


def print_by_rig(seeds: int) -> None:
    """Print the rounds and bytes of refine on several rigs."""
    print(
        "## Refine: rigs\n\nLocal: converged to a local minimum; the centralized solution is then never certified either.\n"
    )
    print("| rig | cameras | certified | rounds to 1e-8 | rounds | bytes per camera | local |")
    print("|---|---|---|---|---|---|---|")
    for name, make in RIGS.items():
        for n in CAMERA_COUNTS:
            certified, rounds_to_tolerance, rounds, sent, n_local = 0, [], [], [], 0
            for problem in simulate_problems(make(n), seeds):
                found = solve_refine(*problem[:2])
                is_global = largest_angle(found, problem[2], range(n)) < 1e-7
                certified += problem[2].certified
                n_local += not is_global
                rounds.append(found.rounds)
                sent.append(int(found.sent.max()))
                if is_global:
                    rounds_to_tolerance.append(count_rounds(problem, bound=300))
            tolerance_text = format_spread(rounds_to_tolerance) if rounds_to_tolerance else "-"
            print(
                f"| {name} | {n} | {certified}/{seeds} | {tolerance_text} | "
                f"{format_spread(rounds)} | {format_spread(sent)} | {n_local}/{seeds} |"
            )


def print_by_penalty(seeds: int) -> None:
    """Print the rounds of refine by penalty and relaxation, with and without extrapolation and saddle escape."""
    print(
        "\n## Refine: penalty, relaxation, Anderson acceleration and saddle escape\n\n"
        "Rounds to 1e-8, 4 cameras, at most 2000.\n"
    )
    choices = [(0.05, 1.0), (0.1, 1.0), (0.2, 1.0), (0.05, 1.6), (0.1, 1.6), (0.2, 1.6)]
    print("| rig | acceleration, escape | " + " | ".join(f"ρ {p}, α {a}" for p, a in choices) + " |")
    print("|---|---|" + "---|" * len(choices))
    names = "PENALTY", "RELAXATION", "MAX_HISTORY", "MAX_RESTARTS", "MAX_EXPECTED_STEPS"
    defaults = [getattr(consensus, name) for name in names]
    for name, make in RIGS.items():
        for is_accelerated in (False, True):
            cells = []
            for penalty, relaxation in choices:
                settings = penalty, relaxation, *(defaults[2:4] if is_accelerated else (0, 0)), 2000
                for key, value in zip(names, settings, strict=True):
                    setattr(consensus, key, value)
                cells.append(format_spread([count_rounds(p) for p in simulate_problems(make(4), min(seeds, 2))]))
            print(f"| {name} | {'yes' if is_accelerated else 'no'} | " + " | ".join(cells) + " |")
    for key, value in zip(names, defaults, strict=True):
        setattr(consensus, key, value)


def print_by_loss(seeds: int) -> None:
    """Print the rounds of refine under message loss, on all rigs."""
    losses = (0.0, 0.1, 0.3)
    print(
        "\n## Refine: message loss, by rig\n\n"
        "Rounds until convergence; runs in which all cameras converge to the same rotation as without loss.\n"
    )
    print("| rig | cameras | " + " | ".join(f"loss {p:.0%}" for p in losses) + " |\n|---|---|---|---|---|")
    for name, make in RIGS.items():
        for n in (4, 8, 16):
            cells = []
            for loss in losses:
                rounds, same = [], 0
                for seed, (Q, moments, _) in enumerate(simulate_problems(make(n), min(seeds, 3))):
                    found = solve_refine(Q, moments, network_faults=NetworkFaults(loss=loss, seed=seed))
                    same += bool(
                        found.converged.all() and (found.rotations == solve_refine(Q, moments).rotations).all()
                    )
                    rounds.append(found.rounds)
                cells.append(f"{format_spread(rounds)}, {same}/{len(rounds)}")
            print(f"| {name} | {n} | " + " | ".join(cells) + " |")


def print_by_recording(shared: Path) -> None:
    """Print the results of refine on adjacent frames of real recordings."""
    print("\n## Refine: real recordings, adjacent frames\n")
    print(
        "OK: within 1e-8 rad of the centralized solution at every camera; robust: within 1e-8 rad of `solve_robust` instead."
    )
    print("If the centralized solution is not certified: in one of its minima, in the best of them.\n")
    print(
        "| recording | cameras | pairs | certified: OK, robust | rounds "
        "| not certified: in a minimum, in the best, robust | rounds |"
    )
    print("|---|---|---|---|---|---|---|")
    for name in ("temple", "board4"):
        folder = shared / "data" / name
        if not folder.exists():
            continue
        pairs = match_recording(open_session(folder), folder / "groundtruth.tum", 1)
        for chosen in ("0123", "012", "123", "013", "023"):
            indices = [int(c) for c in chosen]
            total, n_ok, n_in_minimum, n_in_best, n_robust = 0, 0, 0, 0, [0, 0]
            rounds: dict[bool, list[int]] = {True: [], False: []}
            for rig, matches, _ in pairs:
                Q = np.array([rig.cameras[c].rotation for c in indices])
                moments = [PairMoments.from_matches(matches[c].x, matches[c].y) for c in indices]
                if sum(len(m.x) for m in (matches[c] for c in indices)) < 8:
                    continue
                reference, found = solve_centralized(Q, moments), solve_refine(Q, moments)
                total += 1
                rounds[reference.certified].append(found.rounds)
                robust = solve_robust(Q, moments).rotation
                is_robust_solution = bool(np.linalg.norm(found.rotations - robust, axis=(1, 2)).max() < 1e-8)
                if reference.certified:
                    same = largest_angle(found, reference, range(len(indices))) < 1e-8
                    n_ok += same
                    n_robust[0] += is_robust_solution and not same
                elif found.converged.all():
                    errors = np.linalg.norm(reference.candidates - found.rotation, axis=(1, 2)) / np.sqrt(2)
                    n_in_minimum += bool(errors.min() < 1e-7)
                    n_in_best += bool(errors[0] < 1e-7)
                    n_robust[1] += is_robust_solution and bool(errors.min() >= 1e-7)
            certified_rounds, other_rounds = rounds[True], rounds[False]
            print(
                f"| {name} | {', '.join(chosen)} | {total} | {len(certified_rounds)}: {n_ok}, {n_robust[0]} "
                f"| {format_spread(certified_rounds) if certified_rounds else '-'} "
                f"| {len(other_rounds)}: {n_in_minimum}, {n_in_best}, {n_robust[1]} "
                f"| {format_spread(other_rounds) if other_rounds else '-'} |"
            )


def print_by_disturbance(seeds: int) -> None:
    """Print the results of all schemes under loss, delay and camera failures."""
    n = 8
    disturbances: dict[str, NetworkFaults] = {
        "none": NO_FAULTS,
        **{f"loss {p} %": NetworkFaults(loss=p / 100) for p in (1, 5, 10, 20, 30)},
        **{f"delay up to {d}": NetworkFaults(delay=d) for d in (1, 2, 4)},
        "loss 20 %, delay up to 2": NetworkFaults(loss=0.2, delay=2),
        "one fails in round 5": NetworkFaults(dies={3: 5}),
        "one joins in round 5": NetworkFaults(joins={3: 5}),
    }
    print(f"\n## Disturbances: dome of {n}, gossip on a ring\n")
    print("Error: largest angle (rad) to the centralized solution of the cameras used.\n")
    print(
        "| disturbance | exchange: ok, error | refine: ok, error, rounds | gossip: ok, error, rounds |\n|---|---|---|---|"
    )
    for name, disturbance in disturbances.items():
        cells: list[str] = []
        for solve in (solve_exchange, solve_refine, solve_gossip):
            ok, worst, rounds = 0, 0.0, []
            for seed, (Q, moments, _) in enumerate(simulate_problems(dome(n), seeds)):
                found = solve(Q, moments, network_faults=replace(disturbance, seed=seed))
                ok += found.status is Status.OK
                rounds.append(found.rounds)
                if found.status is Status.OK:
                    used = list(found.used)
                    reference = solve_centralized(Q[used], [moments[c] for c in used])
                    compared = [c for c in range(n) if c not in disturbance.dies]
                    worst = max(worst, largest_angle(found, reference, compared))
            cell = f"{ok}/{seeds}, {worst:.0e}" if ok else f"0/{seeds}"
            cells.append(cell if not cells else f"{cell}, {format_spread(rounds)}")
        print(f"| {name} | " + " | ".join(cells) + " |")


def print_by_faulty_camera(seeds: int) -> None:
    """Print the results of all schemes with one faulty camera, compared with the robust estimator."""
    print("\n## Faulty cameras: 8 around an ellipsoid or a box that rotates by 10 degrees, gossip on a ring\n")
    print(
        "Same: faulty cameras and status equal those of `solve_robust`. Difference: largest angle between its solution and"
    )
    print("that of any camera, including the faulty one.\n")
    print("| fault | scheme | same | detected | difference, rad | rounds | bytes per camera |")
    print("|---|---|---|---|---|---|---|")
    for case in (None, *(c for c in CASES if (c.name, c.size) in SELECTED_FAULTS)):
        label = "none" if case is None else f"{case.name} {case.size:.0f}°" if case.kind == "calibration" else case.name
        for name, solve in (("exchange", solve_exchange), ("refine", solve_refine), ("gossip", solve_gossip)):
            same, n_detected, max_difference, rounds, sent = 0, 0, 0.0, [], []
            for seed in range(4 * seeds):
                s = simulate_scene(8, 10.0, seed, case)
                expected, found = solve_robust(s.rotations, s.moments), solve(s.rotations, s.moments)
                expected_faults = {c for c, fault in enumerate(expected.faults) if fault is not None}
                same += set(found.faults) == expected_faults and found.status is expected.status
                n_detected += bool(expected_faults) and set(found.faults) == set(s.faulty)
                max_difference = max(
                    max_difference, float(np.linalg.norm(found.rotations - expected.rotation, axis=(1, 2)).max())
                )
                rounds.append(found.rounds)
                sent.append(int(found.sent.max()))
            cells = (
                f"{same}/{4 * seeds} | {n_detected} | "
                f"{max_difference / np.sqrt(2):.0e} | {format_spread(rounds)} | {format_spread(sent)}"
            )
            print(f"| {label} | {name} | {cells} |", flush=True)


def print_moment_exchanges(seeds: int) -> None:
    """Print how often refining cameras send their moments although none is faulty."""
    print("\n## Refine: moments sent without a faulty camera\n")
    print(
        "| cameras | rotation, deg | exchanges | same result | difference, rad | rounds | bytes per camera |\n"
        "|---|---|---|---|---|---|---|"
    )
    for n in (3, 4, 8):
        for rotation_deg in (1.0, 3.0, 5.0, 10.0, 20.0):
            n_exchanges, same, max_difference, rounds, sent = 0, 0, 0.0, [], []
            for seed in range(20 * seeds):
                s = simulate_scene(n, rotation_deg, seed, None)
                starts = [partial(start_refine, c, s.rotations, s.moments[c]) for c in range(n)]
                n_exchanges += any(
                    x is not None and x.is_exchanging for x in run_network(starts, step_refine, NO_FAULTS, 500).states
                )
                expected, found = solve_robust(s.rotations, s.moments), solve_refine(s.rotations, s.moments)
                same += found.status is expected.status and not found.faults and not any(expected.faults)
                max_difference = max(
                    max_difference, float(np.linalg.norm(found.rotations - expected.rotation, axis=(1, 2)).max())
                )
                rounds.append(found.rounds)
                sent.append(int(found.sent.max()))
            cells = (
                f"{n_exchanges} of {20 * seeds} | {same} | "
                f"{max_difference / np.sqrt(2):.0e} | {format_spread(rounds)} | {format_spread(sent)}"
            )
            print(f"| {n} | {rotation_deg:g} | {cells} |", flush=True)


def make_graphs(n: int) -> dict[str, list[tuple[int, int]]]:
    """Return the communication graphs of `n` cameras by name; the grid is as square as possible."""
    width = max(w for w in range(1, n + 1) if n % w == 0 and w * w <= n)
    return {
        "line": [(c, c + 1) for c in range(n - 1)],
        "ring": [(c, (c + 1) % n) for c in range(n)],
        f"grid {width}x{n // width}": [(c, c + 1) for c in range(n) if c % width < width - 1]
        + [(c, c + width) for c in range(n - width)],
        "star": [(0, c) for c in range(1, n)],
        "complete": [(a, b) for a in range(n) for b in range(a)],
    }


def print_by_graph(seeds: int) -> None:
    """Print the results of gossip on several graphs."""
    print("\n## Gossip: graphs\n\n| graph | cameras | loss | ok | error | rounds | bytes of the busiest camera |")
    print("|---|---|---|---|---|---|---|")
    for n in (4, 16, 32):
        for name, pairs in make_graphs(n).items():
            for loss in (0.0, 0.3) if n == 16 else (0.0,):
                ok, worst, rounds, sent = 0, 0.0, [], []
                for seed, (Q, moments, reference) in enumerate(simulate_problems(dome(n), min(seeds, 3))):
                    found = solve_gossip(Q, moments, graph=pairs, network_faults=NetworkFaults(loss=loss, seed=seed))
                    ok += found.status is Status.OK
                    worst = max(worst, largest_angle(found, reference, range(n)))
                    rounds.append(found.rounds)
                    sent.append(int(found.sent.max()))
                total = f"{ok}/{len(rounds)}"
                print(
                    f"| {name} | {n} | {loss:.0%} | {total} | {worst:.0e} | {format_spread(rounds)} | {max(sent):,} |"
                )


def print_by_scheme() -> None:
    """Print the bytes and times of all schemes."""
    print("\n## Bytes and time: dome, undisturbed, gossip on a ring\n")
    print("| cameras | scheme | rounds | bytes sent per camera | ms, all cameras | ms per camera and round |")
    print("|---|---|---|---|---|---|")
    for n in (4, 16, 32):
        problem = next(simulate_problems(dome(n), 1))
        for name, solve in (("exchange", solve_exchange), ("refine", solve_refine), ("gossip", solve_gossip)):
            solve(*problem[:2])
            begin = time.perf_counter()
            found = solve(*problem[:2])
            ms = 1e3 * (time.perf_counter() - begin)
            print(f"| {n} | {name} | {found.rounds} | {found.sent.max():,} | {ms:.1f} | {ms / n / found.rounds:.2f} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--only-bad", action="store_true", help="run only faulty cameras")
    parser.add_argument("--shared", type=Path, default=Path(__file__).parents[2] / "shared")
    options = parser.parse_args()
    seeds = options.seeds
    print("# Consensus: rounds, bytes, disturbances\n")
    if options.only_bad:
        print_moment_exchanges(seeds)
        print_by_faulty_camera(seeds)
        return
    print_by_rig(seeds)
    print_by_penalty(seeds)
    print_by_loss(seeds)
    print_by_recording(options.shared)
    print_by_disturbance(seeds)
    print_moment_exchanges(seeds)
    print_by_faulty_camera(seeds)
    print_by_graph(seeds)
    print_by_scheme()


if __name__ == "__main__":
    main()
