"""How exact the estimates are: against noise, turn, numbers of points and cameras, with a depth plane, constrained."""

from __future__ import annotations

from functools import partial

import numpy as np

from sylpose.experiments.estimators import (
    centralized,
    depth_plane,
    one_camera,
    unconstrained_centralized,
    unconstrained_one_camera,
)
from sylpose.experiments.figures import THE_TURN, draw_lines
from sylpose.experiments.scenes import (
    BALANCED,
    BODIES,
    CLOUD,
    PRACTICE,
    STRETCHED,
    SURFACE,
    Problem,
    Scene,
    around,
    at_right_angles,
    simulate,
)
from sylpose.experiments.study import Study, compare
from sylpose.experiments.table import Cell, Table
from sylpose.simulate import dome

__all__ = ["STUDIES"]

ONE, ALL, PLANE = "one camera, better mirror image", "all cameras", "all cameras, depth plane"
ESTIMATORS = {ONE: one_camera, ALL: centralized, PLANE: depth_plane}


def median(table: Table, scene: Scene, method: str, **level: Cell) -> float:
    """The median error at a level, degrees."""
    return table.value("median_deg", scene=scene.name, method=method, **level)


# --- Image noise ------------------------------------------------------------------------------------------------------


def run_noise(seed: int, trials: int) -> Table:
    def make(scene: Scene, noise: float, rng: np.random.Generator) -> Problem:
        return simulate(scene, rng, around(4), noise_px=noise)

    levels = (0.0, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
    return compare(
        "noise_px", {s.name: partial(make, s) for s in (BALANCED, SURFACE, PRACTICE)}, levels, ESTIMATORS, seed, trials
    )


def noise_findings(table: Table) -> list[str]:
    exact, rough, worst = (median(table, BALANCED, ALL, noise_px=n) for n in (0.0, 0.5, 5.0))
    real, plane = (median(table, PRACTICE, method, noise_px=0.5) for method in (ALL, PLANE))
    return [
        f"All cameras, depth exactly uncorrelated: {exact:.1g}° without noise, {rough:.2g}° at 0.5 px, "
        f"{worst:.2g}° at 5 px.",
        f"In perspective, on the visible surface: {median(table, PRACTICE, ALL, noise_px=0.0):.2g}° even without noise, "
        f"{real:.2g}° at 0.5 px; with a depth plane {plane:.2g}°.",
    ]


NOISE = Study(
    name="noise",
    question="How does the error grow with the noise of the image points?",
    run=run_noise,
    draw=partial(
        draw_lines, title="Image noise: 4 cameras, 60 matches each, a turn of 5°", x="noise_px", x_label="noise (px)"
    ),
    findings=noise_findings,
    trials=40,
    quick_trials=4,
)

# --- Turn angle -------------------------------------------------------------------------------------------------------


def run_turn(seed: int, trials: int) -> Table:
    def make(scene: Scene, turn: float, rng: np.random.Generator) -> Problem:
        return simulate(scene, rng, around(4), turn_deg=turn)

    levels = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 40.0)
    return compare(
        "turn_deg", {s.name: partial(make, s) for s in (BALANCED, SURFACE, PRACTICE)}, levels, ESTIMATORS, seed, trials
    )


def turn_findings(table: Table) -> list[str]:
    said = []
    for scene in (BALANCED, PRACTICE):
        errors = ", ".join(f"{median(table, scene, ALL, turn_deg=t):.2g}° at {t:g}°" for t in (0.5, 5.0, 40.0))
        said.append(f"All cameras, {scene.name}: {errors} of turn.")
    single = median(table, BALANCED, ONE, turn_deg=0.5)
    return [*said, f"One camera sees a turn of 0.5° to within {single:.2g}° only, where its model holds."]


TURN = Study(
    name="turn",
    question="How does the error depend on how far the object turned?",
    run=run_turn,
    draw=partial(
        draw_lines,
        title="Turn angle: 4 cameras, 60 matches each, noise of 0.5 px",
        x="turn_deg",
        x_label="turn (degrees)",
        reference=THE_TURN,
    ),
    findings=turn_findings,
    trials=40,
    quick_trials=4,
)

# --- Number of points -------------------------------------------------------------------------------------------------


def run_points(seed: int, trials: int) -> Table:
    def make(scene: Scene, n: float, rng: np.random.Generator) -> Problem:
        return simulate(scene, rng, around(4), matches=round(n))

    levels = (6, 10, 20, 40, 80, 160, 320)
    return compare(
        "matches", {s.name: partial(make, s) for s in (BALANCED, CLOUD, PRACTICE)}, levels, ESTIMATORS, seed, trials
    )


def points_findings(table: Table) -> list[str]:
    return [
        f"All cameras, {scene.name}: {median(table, scene, ALL, matches=10):.2g}° with 10 matches per camera, "
        f"{median(table, scene, ALL, matches=320):.2g}° with 320."
        for scene in (BALANCED, CLOUD, PRACTICE)
    ]


POINTS = Study(
    name="points",
    question="How does the error fall with the number of points?",
    run=run_points,
    draw=partial(
        draw_lines,
        title="Number of points: 4 cameras, noise of 0.5 px, a turn of 5°",
        x="matches",
        x_label="matches per camera",
    ),
    findings=points_findings,
    trials=40,
    quick_trials=4,
)

# --- Number of cameras ------------------------------------------------------------------------------------------------


def run_cameras(seed: int, trials: int) -> Table:
    def make(scene: Scene, n: float, rng: np.random.Generator) -> Problem:
        return simulate(scene, rng, dome(round(n)))

    levels = (2, 3, 4, 6, 8, 16, 32)
    return compare(
        "cameras", {s.name: partial(make, s) for s in (BALANCED, CLOUD, PRACTICE)}, levels, ESTIMATORS, seed, trials
    )


def cameras_findings(table: Table) -> list[str]:
    said = [
        f"All cameras, {scene.name}: {median(table, scene, ALL, cameras=2):.2g}° with 2 cameras, "
        f"{median(table, scene, ALL, cameras=4):.2g}° with 4, {median(table, scene, ALL, cameras=32):.2g}° with 32."
        for scene in (BALANCED, PRACTICE)
    ]
    proved = ", ".join(
        f"{100 * table.value('certified', scene=PRACTICE.name, method=ALL, cameras=n):.0f} % with {n}"
        for n in (2, 3, 4)
    )
    return [*said, f"Proved the global optimum, perspective: {proved} cameras."]


CAMERAS = Study(
    name="cameras",
    question="What does a further camera bring?",
    run=run_cameras,
    draw=partial(
        draw_lines,
        title="Number of cameras, on a dome: 60 matches each, noise of 0.5 px, a turn of 5°",
        x="cameras",
        x_label="cameras",
    ),
    findings=cameras_findings,
    trials=40,
    quick_trials=4,
)

# --- Depth plane ------------------------------------------------------------------------------------------------------


def run_depth(seed: int, trials: int) -> Table:
    def make(scene: Scene, turn: float, rng: np.random.Generator) -> Problem:
        return simulate(scene, rng, around(4), turn_deg=turn)

    levels = (0.5, 1.0, 2.0, 5.0, 10.0, 15.0, 20.0)
    return compare("turn_deg", {s.name: partial(make, s) for s in BODIES}, levels, ESTIMATORS, seed, trials)


def depth_findings(table: Table) -> list[str]:
    return [
        f"{scene.name.capitalize()}, 5° of turn: {median(table, scene, ALL, turn_deg=5.0):.2g}° without and "
        f"{median(table, scene, PLANE, turn_deg=5.0):.2g}° with a depth plane per camera."
        for scene in BODIES
    ]


DEPTH = Study(
    name="depth_plane",
    question="What does a plane for the depth of what each camera sees bring, in perspective?",
    run=run_depth,
    draw=partial(
        draw_lines,
        title="With and without a depth plane: perspective, 4 cameras, 60 matches each, noise of 0.5 px",
        x="turn_deg",
        x_label="turn (degrees)",
        reference=THE_TURN,
    ),
    findings=depth_findings,
    trials=40,
    quick_trials=4,
)

# --- Constraint -------------------------------------------------------------------------------------------------------

CONSTRAINED = {
    "one camera, unconstrained, then adjusted": unconstrained_one_camera,
    "one camera, pseudo-orthogonal": one_camera,
    "all cameras, unconstrained, then adjusted": unconstrained_centralized,
    "all cameras, a rotation": centralized,
}
# Degrees: so much that one camera sees something of all axes (choice).
CONSTRAINED_TURN = 20.0


def run_constraint(seed: int, trials: int) -> Table:
    def make(scene: Scene, noise: float, rng: np.random.Generator) -> Problem:
        rig = at_right_angles()
        return simulate(scene, rng, rig, turn_deg=CONSTRAINED_TURN, noise_px=noise, matches=20, aligned=True)

    scenes = {s.name: partial(make, s) for s in (BALANCED, STRETCHED, PRACTICE)}
    return compare("noise_px", scenes, (0.1, 0.2, 0.5, 1.0, 2.0, 5.0), CONSTRAINED, seed, trials)


def constraint_findings(table: Table) -> list[str]:
    said = []
    for scene in (BALANCED, STRETCHED, PRACTICE):
        one_adjusted, one, all_adjusted, all_ = (median(table, scene, m, noise_px=1.0) for m in CONSTRAINED)
        said.append(
            f"Adjusted afterwards against constrained, noise of 1 px, {scene.name}: {one_adjusted:.3g}° against {one:.3g}° "
            f"with one camera, {all_adjusted:.3g}° against {all_:.3g}° with all three."
        )
    return said


CONSTRAINT = Study(
    name="constraint",
    question="Is the constraint better than an adjustment afterwards?",
    run=run_constraint,
    draw=partial(
        draw_lines,
        title=f"Constrained or adjusted: 3 cameras at right angles, 20 matches each, {CONSTRAINED_TURN:g}° of turn",
        x="noise_px",
        x_label="noise (px)",
    ),
    findings=constraint_findings,
    trials=100,
    quick_trials=10,
)

STUDIES = (NOISE, TURN, POINTS, CAMERAS, DEPTH, CONSTRAINT)
