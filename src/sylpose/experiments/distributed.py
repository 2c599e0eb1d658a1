"""Studies of single-camera, centralized and distributed estimates: accuracy, agreement and number of rounds."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from sylpose.experiments.problems import (
    BALANCED,
    PRACTICE,
    Estimator,
    Problem,
    angle_deg,
    around_rig,
    estimate_centralized,
    estimate_depth_plane,
    estimate_mean_of_single,
    estimate_one_camera,
    estimate_other_mirror,
    simulate,
)
from sylpose.experiments.study import (
    ERROR_COLUMNS,
    Cell,
    Lines,
    Study,
    Table,
    compute_error_cells,
    compute_quartiles,
    draw_bars,
    score_estimator,
    simulate_trials,
)
from sylpose.geometry.arrays import FloatArray
from sylpose.packets import Inbox, NetworkFaults, Packet, run_network
from sylpose.rig import Rig
from sylpose.simulate import arc
from sylpose.sylvester.distributed.refine import RefineState, start_refine, step_refine
from sylpose.sylvester.distributed.solvers import DistributedSolution, solve_exchange, solve_gossip, solve_refine

# --- Schemes ----------------------------------------------------------------------------------------------------------

SINGLE_CAMERA: dict[str, Estimator] = {
    "one camera, better mirror image": estimate_one_camera,
    "one camera, other mirror image": estimate_other_mirror,
    "mean of the cameras' own": estimate_mean_of_single,
}
CENTRALIZED: dict[str, Estimator] = {
    "all cameras, centralized": estimate_centralized,
    "all cameras, depth plane": estimate_depth_plane,
}
DISTRIBUTED: dict[str, Callable[..., DistributedSolution]] = {
    "distributed, moments exchanged": solve_exchange,
    "distributed, refined": solve_refine,
    "distributed, gossip between neighbors": solve_gossip,
}
# Number of cameras in the comparison (choice).
CAMERAS = 6


def run_schemes(seed: int, trials: int) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for scene in (BALANCED, PRACTICE):
        problems = simulate_trials(partial(simulate, scene, rig=around_rig(CAMERAS)), seed, trials)
        for method, estimate in (SINGLE_CAMERA | CENTRALIZED).items():
            rows.append((scene.name, method, *score_estimator(estimate, problems), None, None, None))
        for method, solve in DISTRIBUTED.items():
            solutions = [solve(p.rotations, p.moments, aim=p.aim) for p in problems]
            # The error of a trial is that of the camera farthest from the truth.
            errors = [_max_angle_deg(s.rotations, p.truth) for s, p in zip(solutions, problems, strict=True)]
            reference = [estimate_centralized(p).rotations[0] for p in problems]
            max_distance = max(_max_angle_deg(s.rotations, R) for s, R in zip(solutions, reference, strict=True))
            rounds = float(np.median([s.rounds for s in solutions]))
            sent = float(np.median([s.sent.sum() for s in solutions])) / CAMERAS
            cells = compute_error_cells(errors, [None] * trials)
            rows.append((scene.name, method, *cells, float(np.deg2rad(max_distance)), rounds, sent))
    extra = ("from_centralized_rad", "rounds", "bytes_per_camera")
    return Table(("scene", "method", *ERROR_COLUMNS, *extra), tuple(rows))


def _max_angle_deg(rotations: FloatArray, reference: FloatArray) -> float:
    """Return the largest angle of rotations (C, 3, 3) to a reference (3, 3), degrees."""
    return max(angle_deg(R, reference) for R in rotations)


def summarize_schemes(table: Table) -> list[str]:
    sentences = []
    for scene in (BALANCED, PRACTICE):
        single, _, mean, together, _ = (
            table.value("median_deg", scene=scene.name, method=method) for method in (SINGLE_CAMERA | CENTRALIZED)
        )
        sentences.append(
            f"{CAMERAS} cameras, {scene.name}: one camera {single:.2g}°, mean of the cameras' own {mean:.2g}°, "
            f"all together {together:.2g}°."
        )
    max_distance = max(
        table.filter_rows(method=method).column_values("from_centralized_rad").max() for method in DISTRIBUTED
    )
    return [
        *sentences,
        f"Distributed and centralized results differ by at most {max_distance:.1g} rad, at every camera.",
    ]


SCHEMES_STUDY = Study(
    "schemes",
    "Are all cameras together better than one, and is the distributed result equal to the centralized one?",
    run_schemes,
    partial(draw_bars, title=f"Single, centralized, distributed: {CAMERAS} cameras, rotation by 5°, noise of 0.5 px"),
    summarize_schemes,
    trials=60,
)

# --- Rounds -----------------------------------------------------------------------------------------------------------

# Distance from the centralized result, radians, within which both count as equal (choice). Rounds shown, and numbers of
# cameras (choice).
CONVERGED_DISTANCE = 1e-8
SHOWN_ROUNDS = 80
CAMERA_COUNTS = (3, 4, 8, 16)


def _narrow_rig(n: int) -> Rig:
    """Build a rig of cameras 10 degrees apart, alternately slightly above and below."""
    return arc(n, 10, height=[0.2 * (-1) ** k for k in range(n)])


# Rigs, and the share of messages that are lost.
RIGS: dict[str, tuple[Callable[[int], Rig], float]] = {
    "around the object": (around_rig, 0.0),
    "10° apart": (_narrow_rig, 0.0),
    "around, 10 % of the messages lost": (around_rig, 0.1),
}


def distances_per_round(problem: Problem, loss: float) -> FloatArray:
    """Return the largest distance (SHOWN_ROUNDS,) of a camera from the centralized result after each round, radians."""
    cameras, reference = range(len(problem.moments)), estimate_centralized(problem).rotations[0]
    out = np.zeros((SHOWN_ROUNDS, len(cameras)))

    def step(state: RefineState, inbox: Inbox) -> tuple[RefineState, list[Packet]]:
        state, packets = step_refine(state, inbox)
        # Valid from this round on; later rounds overwrite it.
        degrees = angle_deg(state.rotation, reference) if np.isfinite(state.rotation).all() else 180.0
        out[state.round - 1 :, state.camera] = np.deg2rad(degrees)
        return state, packets

    starts = [partial(start_refine, c, problem.rotations, problem.moments[c], aim=problem.aim) for c in cameras]
    run_network(starts, step, NetworkFaults(loss=loss), SHOWN_ROUNDS)
    return np.asarray(np.maximum(out.max(axis=1), 1e-16))  # a logarithmic axis cannot show 0


def run_rounds(seed: int, trials: int) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for name, (rig_of, loss) in RIGS.items():
        for n in CAMERA_COUNTS:
            problems = simulate_trials(partial(simulate, PRACTICE, rig=rig_of(n)), seed, trials)
            traces = np.array([distances_per_round(problem, loss) for problem in problems])
            for r, distances in enumerate(traces.T):
                converged = float((distances < CONVERGED_DISTANCE).mean())
                rows.append((name, f"{n} cameras", r + 1, trials, converged, *compute_quartiles(distances)))
    columns = ("scene", "method", "round", "trials", "converged", "q25_rad", "median_rad", "q75_rad")
    return Table(columns, tuple(rows))


def summarize_rounds(table: Table) -> list[str]:
    sentences = []
    for name in RIGS:
        needed = []
        for n in CAMERA_COUNTS:
            rows = table.filter_rows(scene=name, method=f"{n} cameras")
            reached = rows.column_values("round")[rows.column_values("converged") == 1.0]
            needed.append(f"{int(reached[0])} with {n}" if len(reached) else f"more than {SHOWN_ROUNDS} with {n}")
        sentences.append(
            f"Rounds until all trials are within {CONVERGED_DISTANCE:g} rad, cameras {name}: {', '.join(needed)}."
        )
    return sentences


ROUNDS_FIGURE = Lines(
    "Distributed refinement: perspective, rotation by 5°, noise of 0.5 px; 72 bytes per camera and round",
    "round",
    "round",
    "rad",
    "largest distance from the\ncentralized result (rad)",
    log_x=False,
)
ROUNDS_STUDY = Study(
    "rounds",
    "After how many rounds does the distributed refinement reach the centralized result?",
    run_rounds,
    ROUNDS_FIGURE.draw,
    summarize_rounds,
    trials=8,
    quick_trials=1,
)

STUDIES = (SCHEMES_STUDY, ROUNDS_STUDY)
