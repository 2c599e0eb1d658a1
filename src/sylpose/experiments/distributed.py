"""Single cameras, all in one place, and distributed over the cameras: the same answer, and after how many rounds."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from sylpose.experiments.estimators import (
    Estimator,
    angle_deg,
    centralized,
    depth_plane,
    mean_of_single,
    one_camera,
    other_mirror,
)
from sylpose.experiments.figures import draw_bars, draw_lines
from sylpose.experiments.scenes import BALANCED, PRACTICE, Problem, around, simulate
from sylpose.experiments.study import Study, score
from sylpose.experiments.table import ERROR_COLUMNS, Cell, Table, error_columns, quartiles
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Rig
from sylpose.simulate import arc
from sylpose.sylvester.distributed.messages import Inbox, Packet
from sylpose.sylvester.distributed.refine import RefineState, refine_start, refine_step
from sylpose.sylvester.distributed.simulation import (
    Agreement,
    Disturbances,
    run,
    solve_exchange,
    solve_gossip,
    solve_refine,
)

__all__ = ["STUDIES"]


# --- Schemes ----------------------------------------------------------------------------------------------------------

ALONE: dict[str, Estimator] = {
    "one camera, better mirror image": one_camera,
    "one camera, other mirror image": other_mirror,
    "mean of the cameras' own": mean_of_single,
}
TOGETHER: dict[str, Estimator] = {"all cameras, centralised": centralized, "all cameras, depth plane": depth_plane}
DISTRIBUTED: dict[str, Callable[..., Agreement]] = {
    "distributed, moments exchanged": solve_exchange,
    "distributed, refined": solve_refine,
    "distributed, gossip between neighbours": solve_gossip,
}
# Cameras of the comparison (choice).
CAMERAS = 6


def run_schemes(seed: int, trials: int) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for scene in (BALANCED, PRACTICE):
        drawn = [simulate(scene, np.random.default_rng([seed, k]), around(CAMERAS)) for k in range(trials)]
        for method, estimate in (ALONE | TOGETHER).items():
            rows.append((scene.name, method, *score(estimate, drawn), None, None, None))
        for method, solve in DISTRIBUTED.items():
            solutions = [solve(p.rotations, p.moments, aim=p.aim) for p in drawn]
            # Each trial counts by the camera that is farthest from the truth.
            errors = [max(angle_deg(R, p.truth) for R in s.rotations) for s, p in zip(solutions, drawn, strict=True)]
            apart = max(
                angle_deg(R, centralized(p).rotations[0])
                for s, p in zip(solutions, drawn, strict=True)
                for R in s.rotations
            )
            rounds = float(np.median([s.rounds for s in solutions]))
            sent = float(np.median([s.sent.sum() for s in solutions])) / CAMERAS
            cells = error_columns(errors, [None] * trials)
            rows.append((scene.name, method, *cells, float(np.deg2rad(apart)), rounds, sent))
    extra = ("from_centralized_rad", "rounds", "bytes_per_camera")
    return Table(("scene", "method", *ERROR_COLUMNS, *extra), tuple(rows))


def schemes_findings(table: Table) -> list[str]:
    said = []
    for scene in (BALANCED, PRACTICE):
        single, _, mean, together, _ = (
            table.value("median_deg", scene=scene.name, method=method) for method in (ALONE | TOGETHER)
        )
        said.append(
            f"{CAMERAS} cameras, {scene.name}: one camera {single:.2g}°, mean of the cameras' own {mean:.2g}°, "
            f"all together {together:.2g}°."
        )
    apart = max(table.where(method=method).numbers("from_centralized_rad").max() for method in DISTRIBUTED)
    return [*said, f"Distributed and centralised answers are {apart:.1g} rad apart at most, at every camera."]


SCHEMES_STUDY = Study(
    name="schemes",
    question="Are all cameras together better than one, and is distributed the same as centralised?",
    run=run_schemes,
    draw=partial(
        draw_bars, title=f"Single, centralised, distributed: {CAMERAS} cameras, a turn of 5°, noise of 0.5 px"
    ),
    findings=schemes_findings,
    trials=60,
    quick_trials=4,
)

# --- Rounds -----------------------------------------------------------------------------------------------------------

# To this many radians from the centralised answer it counts as the same (choice). Rounds that are shown, and numbers of
# cameras (choice).
SAME = 1e-8
ROUNDS = 80
NUMBERS = (3, 4, 8, 16)


def _narrow(n: int) -> Rig:
    """Cameras 10 degrees apart, alternately a little above and below."""
    return arc(n, 10, height=[0.2 * (-1) ** k for k in range(n)])


# Cameras, and the share of the messages that get lost.
RIGS: dict[str, tuple[Callable[[int], Rig], float]] = {
    "around the object": (around, 0.0),
    "10° apart": (_narrow, 0.0),
    "around, 10 % of the messages lost": (around, 0.1),
}


def distances(problem: Problem, loss: float) -> FloatArray:
    """(ROUNDS,) radians from the centralised answer after each round, of the camera that is farthest from it."""
    everyone, answer = range(len(problem.moments)), centralized(problem).rotations[0]
    out = np.zeros((ROUNDS, len(everyone)))

    def step(state: RefineState, inbox: Inbox) -> tuple[RefineState, list[Packet]]:
        state, packets = refine_step(state, inbox)
        # From here on; what this camera finds later replaces it.
        degrees = 180.0 if state.rotation is None else angle_deg(state.rotation, answer)
        out[state.round - 1 :, state.camera] = np.deg2rad(degrees)
        return state, packets

    starts = [
        partial(refine_start, c, everyone, problem.rotations[c], problem.moments[c], aim=problem.aim) for c in everyone
    ]
    run(starts, step, Disturbances(loss=loss), ROUNDS + 1)
    return np.asarray(np.maximum(out.max(axis=1), 1e-16))  # 0 has no place on a logarithmic axis


def run_rounds(seed: int, trials: int) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for name, (rig_of, loss) in RIGS.items():
        for n in NUMBERS:
            drawn = [simulate(PRACTICE, np.random.default_rng([seed, k]), rig_of(n)) for k in range(trials)]
            traces = np.array([distances(problem, loss) for problem in drawn])
            rows += [
                (name, f"{n} cameras", r + 1, trials, float((of_round < SAME).mean()), *quartiles(of_round))
                for r, of_round in enumerate(traces.T)
            ]
    columns = ("scene", "method", "round", "trials", "converged", "q25_rad", "median_rad", "q75_rad")
    return Table(columns, tuple(rows))


def rounds_findings(table: Table) -> list[str]:
    said = []
    for name in RIGS:
        needed = []
        for n in NUMBERS:
            rows = table.where(scene=name, method=f"{n} cameras")
            reached = rows.numbers("round")[rows.numbers("converged") == 1.0]
            needed.append(f"{int(reached[0])} with {n}" if len(reached) else f"more than {ROUNDS} with {n}")
        said.append(f"Rounds until all trials are within {SAME:g} rad, cameras {name}: {', '.join(needed)}.")
    return said


ROUNDS_STUDY = Study(
    name="rounds",
    question="After how many rounds is the distributed refinement at the centralised answer?",
    run=run_rounds,
    draw=partial(
        draw_lines,
        title="Distributed refinement: perspective, a turn of 5°, noise of 0.5 px; 72 bytes per camera and round",
        x="round",
        x_label="round",
        y="rad",
        y_label="farthest camera from the\ncentralised answer (rad)",
        log_x=False,
    ),
    findings=rounds_findings,
    trials=8,
    quick_trials=1,
)

STUDIES = (SCHEMES_STUDY, ROUNDS_STUDY)
