"""How many rounds and bytes the distributed estimators take, on what cameras, networks and disturbances; as Markdown.

    python benchmarks/consensus.py [--seeds 5] [--shared ../shared]

A scene is an ellipsoid of 0.15 m at 1.5 m that turns by 5 degrees, 60 matches per camera with 0.5 px of noise. "Rounds to
1e-8" are those after which every camera stays within 1e-8 rad of the centralised answer; "rounds" those after which all
know that and are done. Real recordings, where they are there: SIFT matches between adjacent frames within each camera,
inliers of `estimate_motion`. Times are of all cameras in one process, one thread: divide by the cameras for one's own share.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import get_args

import numpy as np

from benchmarks.depth_plane import recorded
from benchmarks.sensors import CASES, scene
from sylpose import open_session
from sylpose.geometry.arrays import FloatArray
from sylpose.moments import PairMoments
from sylpose.results import Status
from sylpose.rig import Rig
from sylpose.simulate import arc, box, dome, ellipsoid, random_motion, ring, simulate_matches
from sylpose.sylvester.camera_faults import solve_robust
from sylpose.sylvester.centralized import CentralizedSolution, solve_centralized
from sylpose.sylvester.distributed import anderson_acceleration, saddle_escape
from sylpose.sylvester.distributed import refine as consensus
from sylpose.sylvester.distributed.fault_injection import Nonsense
from sylpose.sylvester.distributed.messages import Inbox, Packet
from sylpose.sylvester.distributed.refine import RefineState, refine_start, refine_step
from sylpose.sylvester.distributed.simulation import (
    UNDISTURBED,
    Agreement,
    Disturbances,
    run,
    solve_exchange,
    solve_gossip,
    solve_refine,
)

Problem = tuple[FloatArray, list[PairMoments], CentralizedSolution]

# Faults of `benchmarks.sensors`.
BAD = {("turned", 20), ("turned", 90), ("mirrored", 0), ("frozen", 0), ("junk", 0)}
COUNTS = (3, 4, 6, 8, 12, 16, 32)


def tilted(n: int) -> Rig:
    """Cameras around the object, alternately above and below it."""
    return ring(n, height=[0.4 * (-1) ** k for k in range(n)])


def slanted(n: int) -> Rig:
    """An arc of 60 degrees, alternately above and below the object."""
    return arc(n, 60 / (n - 1), height=[0.3 * (-1) ** k for k in range(n)])


def narrow(n: int) -> Rig:
    """A level arc of 40 degrees."""
    return arc(n, 40 / (n - 1))


RIGS = {"ring": tilted, "dome": dome, "level ring": ring, "arc of 60°": slanted, "level arc of 40°": narrow}


def problems(rig: Rig, seeds: int) -> Iterator[Problem]:
    """What it sees of the scene, and the centralised answer."""
    body = ellipsoid((0.15, 0.12, 0.1))
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        pair = simulate_matches(rig, body, random_motion(5.0, 0.02, rng), rng=rng)
        Q = np.array([c.rotation for c in rig])
        moments = [PairMoments.from_matches(m.x, m.y) for m in pair.matches]
        yield Q, moments, solve_centralized(Q, moments)


def rounds_to(problem: Problem, tolerance: float = 1e-8, bound: int = 2000) -> int:
    """Rounds of `refine` until every camera stays this near to the centralised answer; the bound if that never is."""
    Q, moments, reference = problem
    last = 0

    def watched(state: RefineState, inbox: Inbox) -> tuple[RefineState, list[Packet]]:
        nonlocal last
        new, packets = refine_step(state, inbox)
        if new.rotation is None or np.linalg.norm(new.rotation - reference.rotation) > tolerance * np.sqrt(2):
            last = max(last, new.round)
        return new, packets

    n = len(Q)
    starts = [partial(refine_start, c, range(n), Q[c], moments[c], bound=bound) for c in range(n)]
    run(starts, watched, UNDISTURBED, bound)
    return min(last + 1, bound)


def spread(values: Sequence[float]) -> str:
    """Median and largest."""
    return f"{np.median(values):.0f} (max. {max(values):.0f})"


def error(found: Agreement, reference: CentralizedSolution, among: Sequence[int]) -> float:
    """Largest angle of these cameras' answers to the centralised one."""
    return float(np.linalg.norm(found.rotations[list(among)] - reference.rotation, axis=(1, 2)).max() / np.sqrt(2))


def by_rig(seeds: int) -> None:
    """Refine on several rigs: with and without extrapolation."""
    print("## Refine: rigs\n\nLocal: ended in a minimum that is not the best one; the centralised answer is then never")
    print("certified either.\n\n| cameras | number | certified | rounds to 1e-8 | rounds | bytes per camera | local |")
    print("|---|---|---|---|---|---|---|")
    for name, make in RIGS.items():
        for n in COUNTS:
            certified, to, rounds, sent, local = 0, [], [], [], 0
            for problem in problems(make(n), seeds):
                found = solve_refine(*problem[:2])
                best = error(found, problem[2], range(n)) < 1e-7
                certified += problem[2].certified
                local += not best
                rounds.append(found.rounds)
                sent.append(int(found.sent.max()))
                if best:
                    to.append(rounds_to(problem, bound=300))
            near = spread(to) if to else "-"
            print(
                f"| {name} | {n} | {certified}/{seeds} | {near} | {spread(rounds)} | {spread(sent)} | {local}/{seeds} |"
            )


def by_penalty(seeds: int) -> None:
    """Refine without extrapolation and leaps, and with them, by penalty and relaxation."""
    print(
        "\n## Refine: penalty, relaxation, extrapolation and leaps\n\nRounds to 1e-8, 4 cameras; 2000 is the bound.\n"
    )
    choices = [(0.05, 1.0), (0.1, 1.0), (0.2, 1.0), (0.05, 1.6), (0.1, 1.6), (0.2, 1.6)]
    print("| cameras | extrapolation, leaps | " + " | ".join(f"ρ {p}, {a}" for p, a in choices) + " |")
    print("|---|---|" + "---|" * len(choices))
    defaults = consensus.PENALTY, consensus.RELAXATION, anderson_acceleration.MEMORY, saddle_escape.LEAPS
    for name, make in RIGS.items():
        for memory in (0, defaults[2]):
            cells = []
            for penalty, relaxation in choices:
                consensus.PENALTY, consensus.RELAXATION, anderson_acceleration.MEMORY = penalty, relaxation, memory
                saddle_escape.LEAPS = defaults[3] if memory else 0
                cells.append(spread([rounds_to(p) for p in problems(make(4), min(seeds, 2))]))
            print(f"| {name} | {'yes' if memory else 'no'} | " + " | ".join(cells) + " |")
    consensus.PENALTY, consensus.RELAXATION, anderson_acceleration.MEMORY, saddle_escape.LEAPS = defaults


def by_loss(seeds: int) -> None:
    """Refine where messages get lost, on all rigs."""
    losses = (0.0, 0.1, 0.3)
    print(
        "\n## Refine: loss, by rig\n\nRounds until done; converged at all cameras, to the same rotation as without loss.\n"
    )
    print("| cameras | number | " + " | ".join(f"loss {p:.0%}" for p in losses) + " |\n|---|---|---|---|---|")
    for name, make in RIGS.items():
        for n in (4, 8, 16):
            cells = []
            for loss in losses:
                rounds, same = [], 0
                for seed, (Q, moments, _) in enumerate(problems(make(n), min(seeds, 3))):
                    found = solve_refine(Q, moments, disturbances=Disturbances(loss=loss, seed=seed))
                    same += bool(
                        found.converged.all() and (found.rotations == solve_refine(Q, moments).rotations).all()
                    )
                    rounds.append(found.rounds)
                cells.append(f"{spread(rounds)}, {same}/{len(rounds)}")
            print(f"| {name} | {n} | " + " | ".join(cells) + " |")


def by_recording(shared: Path) -> None:
    """Refine on real recordings, adjacent frames."""
    print("\n## Refine: real recordings, adjacent frames\n")
    print(
        "OK: within 1e-8 rad of the centralised answer at every camera; doubted: not so, but of that of `solve_robust`."
    )
    print("Where the centralised one is not certified: in one of its minima, in the best of them.\n")
    print(
        "| recording | cameras | pairs | certified: OK, doubted | rounds | others: in a minimum, best, doubted | rounds |"
    )
    print("|---|---|---|---|---|---|---|")
    for name in ("temple", "board4"):
        folder = shared / "data" / name
        if not folder.exists():
            continue
        pairs = recorded(open_session(folder), folder / "groundtruth.tum", 1)
        for chosen in ("0123", "012", "123", "013", "023"):
            of = [int(c) for c in chosen]
            total, good, minimum, best, doubted = 0, 0, 0, 0, [0, 0]
            rounds: dict[bool, list[int]] = {True: [], False: []}
            for rig, matches, _ in pairs:
                Q = np.array([rig.cameras[c].rotation for c in of])
                moments = [PairMoments.from_matches(matches[c].x, matches[c].y) for c in of]
                if sum(len(m.x) for m in (matches[c] for c in of)) < 8:
                    continue
                reference, found = solve_centralized(Q, moments), solve_refine(Q, moments)
                total += 1
                rounds[reference.certified].append(found.rounds)
                robust = solve_robust(Q, moments).rotation
                as_robust = bool(np.linalg.norm(found.rotations - robust, axis=(1, 2)).max() < 1e-8)
                if reference.certified:
                    same = error(found, reference, range(len(of))) < 1e-8
                    good += same
                    doubted[0] += as_robust and not same
                elif found.converged.all():
                    errors = np.linalg.norm(reference.candidates - found.rotation, axis=(1, 2)) / np.sqrt(2)
                    minimum += bool(errors.min() < 1e-7)
                    best += bool(errors[0] < 1e-7)
                    doubted[1] += as_robust and bool(errors.min() >= 1e-7)
            proved, open_ = rounds[True], rounds[False]
            print(
                f"| {name} | {', '.join(chosen)} | {total} | {len(proved)}: {good}, {doubted[0]} "
                f"| {spread(proved) if proved else '-'} "
                f"| {len(open_)}: {minimum}, {best}, {doubted[1]} | {spread(open_) if open_ else '-'} |"
            )


def by_fault(seeds: int) -> None:
    """All schemes with loss, delay and broken cameras."""
    n = 8
    pairs = [(a, b) for a in range(n) for b in range(a)]
    disturbances: dict[str, Disturbances] = {
        "none": UNDISTURBED,
        **{f"loss {p} %": Disturbances(loss=p / 100) for p in (1, 5, 10, 20, 30)},
        **{f"delay up to {d}": Disturbances(delay=d) for d in (1, 2, 4)},
        "loss 20 %, delay up to 2": Disturbances(loss=0.2, delay=2),
        "one dies in round 5": Disturbances(dies={3: 5}),
        "one joins in round 5": Disturbances(joins={3: 5}),
        **{f"one sends {kind}": Disturbances(nonsense={3: kind}) for kind in get_args(Nonsense)},
    }
    print(f"\n## Disturbances: dome of {n}, all within reach of each other\n")
    print(
        "Error: largest angle (rad) to the centralised answer of the cameras in the result. Exchange: sent 16 times.\n"
    )
    print("| fault | exchange: ok, error | refine: ok, error, rounds | gossip: ok, error, rounds |\n|---|---|---|---|")
    for name, disturbance in disturbances.items():
        cells: list[str] = []
        for solve in (partial(solve_exchange, rounds=16), solve_refine, partial(solve_gossip, graph=pairs)):
            ok, worst, rounds = 0, 0.0, []
            for seed, (Q, moments, _) in enumerate(problems(dome(n), seeds)):
                found = solve(Q, moments, disturbances=replace(disturbance, seed=seed))
                ok += found.status is Status.OK
                rounds.append(found.rounds)
                if found.status is Status.OK:
                    used = list(found.used)
                    reference = solve_centralized(Q[used], [moments[c] for c in used])
                    judged = [c for c in range(n) if c not in found.refused and c not in disturbance.dies]
                    worst = max(worst, error(found, reference, judged))
            cell = f"{ok}/{seeds}, {worst:.0e}" if ok else f"0/{seeds}"
            cells.append(cell if not cells else f"{cell}, {spread(rounds)}")
        print(f"| {name} | " + " | ".join(cells) + " |")


def by_bad_camera(seeds: int) -> None:
    """All schemes with a camera that is at fault, beside the robust estimator."""
    print("\n## Bad cameras: 8 around an ellipsoid or a box that turns by 10 degrees, gossip on a ring\n")
    print(
        "Same: the cameras named and the status are those of `solve_robust`. Apart: largest angle of any camera's answer,"
    )
    print("the bad one's included, to its answer.\n")
    print("| fault | scheme | same | named | apart (rad) | rounds | bytes per camera |")
    print("|---|---|---|---|---|---|---|")
    for case in (None, *(c for c in CASES if (c.name, c.size) in BAD)):
        label = "none" if case is None else f"{case.name} {case.size:.0f}°" if case.kind == "calibration" else case.name
        for name, solve in (("exchange", solve_exchange), ("refine", solve_refine), ("gossip", solve_gossip)):
            same, named, apart, rounds, sent = 0, 0, 0.0, [], []
            for seed in range(4 * seeds):
                s = scene(8, 10.0, seed, case)
                expected, found = solve_robust(s.rotations, s.moments), solve(s.rotations, s.moments)
                of = {c for c, fault in enumerate(expected.faults) if fault is not None}
                same += set(found.faults) == of and found.status is expected.status
                named += bool(of) and set(found.faults) == set(s.bad)
                apart = max(apart, float(np.linalg.norm(found.rotations - expected.rotation, axis=(1, 2)).max()))
                rounds.append(found.rounds)
                sent.append(int(found.sent.max()))
            cells = f"{same}/{4 * seeds} | {named} | {apart / np.sqrt(2):.0e} | {spread(rounds)} | {spread(sent)}"
            print(f"| {label} | {name} | {cells} |", flush=True)


def by_turn(seeds: int) -> None:
    """How often cameras of which none is bad call for the evidence."""
    print("\n## Refine: calls for the evidence, no bad camera; rounds; bytes per camera\n")
    print("| cameras | turn ° | calls | alike | apart (rad) | rounds | bytes |\n|---|---|---|---|---|---|---|")
    for n in (3, 4, 8):
        for turn in (1.0, 3.0, 5.0, 10.0, 20.0):
            calls, same, apart, rounds, sent = 0, 0, 0.0, [], []
            for seed in range(20 * seeds):
                s = scene(n, turn, seed, None)
                starts = [partial(refine_start, c, range(n), s.rotations[c], s.moments[c]) for c in range(n)]
                calls += any(x is not None and x.shown for x in run(starts, refine_step, UNDISTURBED, 501).states)
                expected, found = solve_robust(s.rotations, s.moments), solve_refine(s.rotations, s.moments)
                same += found.status is expected.status and not found.faults and not any(expected.faults)
                apart = max(apart, float(np.linalg.norm(found.rotations - expected.rotation, axis=(1, 2)).max()))
                rounds.append(found.rounds)
                sent.append(int(found.sent.max()))
            cells = f"{calls} of {20 * seeds} | {same} | {apart / np.sqrt(2):.0e} | {spread(rounds)} | {spread(sent)}"
            print(f"| {n} | {turn:g} | {cells} |", flush=True)


def by_liar(seeds: int) -> None:
    """Refine with cameras that lie well-formedly."""
    print("\n## Refine: liars, on rings and domes around an ellipsoid or a box, turns of 2 to 12 degrees\n")
    print(
        "Named: the liars and nobody else. Error and spread: largest angles (rad) of the good cameras' answers to that of"
    )
    print(
        "`solve_robust` of the good cameras, and among themselves. Apart: good cameras that are sure of different things.\n"
    )
    print("| cameras, liars | kind | named | error | spread | apart | rounds | bytes per good camera |")
    print("|---|---|---|---|---|---|---|---|")
    for n, n_liars in ((4, 1), (5, 1), (8, 1), (7, 2), (8, 2)):
        for kind in ("false", "stubborn", "two-faced", "ahead", "jitter", "heavy"):
            named, apart, worst, wide, rounds, sent = 0, 0, 0.0, 0.0, [], []
            for seed in range(4 * seeds):
                rng = np.random.default_rng([seed, n])
                rig, body = (tilted, dome)[seed % 2](n), (ellipsoid((0.15, 0.12, 0.1)), box())[seed % 2]
                pair = simulate_matches(rig, body, random_motion(float(rng.uniform(2, 12)), 0.02, rng), rng=rng)
                Q = np.array([c.rotation for c in rig])
                moments = [PairMoments.from_matches(m.x, m.y) for m in pair.matches]
                liars = rng.choice(n, n_liars, replace=False).tolist()
                nonsense: dict[int, Nonsense] = dict.fromkeys(liars, kind)
                found = solve_refine(Q, moments, disturbances=Disturbances(nonsense=nonsense, seed=seed))
                good = [c for c in range(n) if c not in liars]
                reference = solve_robust(Q[good], [moments[c] for c in good])
                named += {*found.faults, *found.refused} == set(liars)
                R = found.rotations[good]
                sure = R[found.converged[good]]
                apart += len(sure) > 0 and bool(np.linalg.norm(sure - sure[0], axis=(1, 2)).max() > 1e-7)
                worst = max(worst, float(np.linalg.norm(R - reference.rotation, axis=(1, 2)).max()))
                wide = max(wide, float(np.linalg.norm(R - R[0], axis=(1, 2)).max()))
                rounds.append(found.rounds)
                sent.append(int(found.sent[good].max()))
            cells = f"{named}/{4 * seeds} | {worst:.0e} | {wide:.0e} | {apart} | {spread(rounds)} | {spread(sent)}"
            print(f"| {n}, {n_liars} | {kind} | {cells} |", flush=True)


def graphs(n: int) -> dict[str, list[tuple[int, int]]]:
    """By name; the grid is as square as can be."""
    width = max(w for w in range(1, n + 1) if n % w == 0 and w * w <= n)
    return {
        "line": [(c, c + 1) for c in range(n - 1)],
        "ring": [(c, (c + 1) % n) for c in range(n)],
        f"grid {width}x{n // width}": [(c, c + 1) for c in range(n) if c % width < width - 1]
        + [(c, c + width) for c in range(n - width)],
        "star": [(0, c) for c in range(1, n)],
        "complete": [(a, b) for a in range(n) for b in range(a)],
    }


def by_graph(seeds: int) -> None:
    """Gossip on several graphs."""
    print("\n## Gossip: graphs\n\n| graph | cameras | loss | ok | error | rounds | bytes of the busiest camera |")
    print("|---|---|---|---|---|---|---|")
    for n in (4, 16, 32):
        for name, pairs in graphs(n).items():
            for loss in (0.0, 0.3) if n == 16 else (0.0,):
                ok, worst, rounds, sent = 0, 0.0, [], []
                for seed, (Q, moments, reference) in enumerate(problems(dome(n), min(seeds, 3))):
                    found = solve_gossip(Q, moments, graph=pairs, disturbances=Disturbances(loss=loss, seed=seed))
                    ok += found.status is Status.OK
                    worst = max(worst, error(found, reference, range(n)))
                    rounds.append(found.rounds)
                    sent.append(int(found.sent.max()))
                total = f"{ok}/{len(rounds)}"
                print(f"| {name} | {n} | {loss:.0%} | {total} | {worst:.0e} | {spread(rounds)} | {max(sent):,} |")


def by_scheme() -> None:
    """Bytes and time side by side."""
    print("\n## Bytes and time: dome, undisturbed, gossip on a ring\n")
    print("| cameras | scheme | rounds | bytes sent per camera | ms, all cameras | ms per camera and round |")
    print("|---|---|---|---|---|---|")
    for n in (4, 16, 32):
        problem = next(problems(dome(n), 1))
        for name, solve in (("exchange", solve_exchange), ("refine", solve_refine), ("gossip", solve_gossip)):
            solve(*problem[:2])
            begin = time.perf_counter()
            found = solve(*problem[:2])
            ms = 1e3 * (time.perf_counter() - begin)
            print(f"| {n} | {name} | {found.rounds} | {found.sent.max():,} | {ms:.1f} | {ms / n / found.rounds:.2f} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--only-bad", action="store_true", help="bad cameras and liars alone")
    parser.add_argument("--shared", type=Path, default=Path(__file__).parents[2] / "shared")
    options = parser.parse_args()
    seeds = options.seeds
    print("# Consensus: rounds, bytes, disturbances\n")
    if options.only_bad:
        by_turn(seeds)
        by_bad_camera(seeds)
        by_liar(seeds)
        return
    by_rig(seeds)
    by_penalty(seeds)
    by_loss(seeds)
    by_recording(options.shared)
    by_fault(seeds)
    by_turn(seeds)
    by_bad_camera(seeds)
    by_liar(seeds)
    by_graph(seeds)
    by_scheme()


if __name__ == "__main__":
    main()
