"""Accuracy studies: noise, rotation angle, number of points and cameras, depth plane, rotation constraint."""

from __future__ import annotations

from functools import partial

import numpy as np

from sylpose.experiments.estimators import (
    estimate_centralized,
    estimate_depth_plane,
    estimate_one_camera,
    estimate_one_unconstrained,
    estimate_unconstrained,
)
from sylpose.experiments.figures import IDENTITY_ERROR, draw_lines
from sylpose.experiments.scenes import (
    BALANCED,
    BODIES,
    CLOUD,
    PRACTICE,
    STRETCHED,
    SURFACE,
    Problem,
    Scene,
    around_rig,
    right_angle_rig,
    simulate,
)
from sylpose.experiments.study import Study, run_comparison
from sylpose.experiments.table import Cell, Table
from sylpose.simulate import dome

__all__ = ["STUDIES"]

ONE_CAMERA, ALL_CAMERAS, DEPTH_PLANE = "one camera, better mirror image", "all cameras", "all cameras, depth plane"
ESTIMATORS = {ONE_CAMERA: estimate_one_camera, ALL_CAMERAS: estimate_centralized, DEPTH_PLANE: estimate_depth_plane}


def median_error(table: Table, scene: Scene, method: str, **level: Cell) -> float:
    """Return the median error at a level, degrees."""
    return table.value("median_deg", scene=scene.name, method=method, **level)


# --- Image noise ------------------------------------------------------------------------------------------------------


def run_noise(seed: int, trials: int) -> Table:
    def make(scene: Scene, noise: float, rng: np.random.Generator) -> Problem:
        return simulate(scene, rng, around_rig(4), noise_px=noise)

    levels = (0.0, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
    return run_comparison(
        "noise_px", {s.name: partial(make, s) for s in (BALANCED, SURFACE, PRACTICE)}, levels, ESTIMATORS, seed, trials
    )


def summarize_noise(table: Table) -> list[str]:
    exact, rough, worst = (median_error(table, BALANCED, ALL_CAMERAS, noise_px=n) for n in (0.0, 0.5, 5.0))
    real, plane = (median_error(table, PRACTICE, method, noise_px=0.5) for method in (ALL_CAMERAS, DEPTH_PLANE))
    return [
        f"All cameras, depth exactly uncorrelated: {exact:.1g}° without noise, {rough:.2g}° at 0.5 px, "
        f"{worst:.2g}° at 5 px.",
        "In perspective, on the visible surface: "
        f"{median_error(table, PRACTICE, ALL_CAMERAS, noise_px=0.0):.2g}° even without noise, "
        f"{real:.2g}° at 0.5 px; with a depth plane {plane:.2g}°.",
    ]


NOISE = Study(
    name="noise",
    question="How does the error grow with the noise of the image points?",
    run=run_noise,
    draw=partial(
        draw_lines, title="Image noise: 4 cameras, 60 matches each, rotation by 5°", x="noise_px", x_label="noise (px)"
    ),
    summarize=summarize_noise,
    trials=40,
    quick_trials=4,
)

# --- Rotation angle ---------------------------------------------------------------------------------------------------


def run_rotation(seed: int, trials: int) -> Table:
    def make(scene: Scene, turn: float, rng: np.random.Generator) -> Problem:
        return simulate(scene, rng, around_rig(4), angle_deg=turn)

    levels = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 40.0)
    return run_comparison(
        "turn_deg", {s.name: partial(make, s) for s in (BALANCED, SURFACE, PRACTICE)}, levels, ESTIMATORS, seed, trials
    )


def summarize_rotation(table: Table) -> list[str]:
    sentences = []
    for scene in (BALANCED, PRACTICE):
        errors = ", ".join(
            f"{median_error(table, scene, ALL_CAMERAS, turn_deg=t):.2g}° at {t:g}°" for t in (0.5, 5.0, 40.0)
        )
        sentences.append(f"All cameras, {scene.name}: {errors} of rotation.")
    single = median_error(table, BALANCED, ONE_CAMERA, turn_deg=0.5)
    return [
        *sentences,
        f"One camera measures a rotation by 0.5° with an error of {single:.2g}°, if its model is exact.",
    ]


ROTATION = Study(
    name="turn",
    question="How does the error depend on the rotation angle?",
    run=run_rotation,
    draw=partial(
        draw_lines,
        title="Rotation angle: 4 cameras, 60 matches each, noise of 0.5 px",
        x="turn_deg",
        x_label="rotation angle (degrees)",
        reference=IDENTITY_ERROR,
    ),
    summarize=summarize_rotation,
    trials=40,
    quick_trials=4,
)

# --- Number of points -------------------------------------------------------------------------------------------------


def run_points(seed: int, trials: int) -> Table:
    def make(scene: Scene, n: float, rng: np.random.Generator) -> Problem:
        return simulate(scene, rng, around_rig(4), matches=round(n))

    levels = (6, 10, 20, 40, 80, 160, 320)
    return run_comparison(
        "matches", {s.name: partial(make, s) for s in (BALANCED, CLOUD, PRACTICE)}, levels, ESTIMATORS, seed, trials
    )


def summarize_points(table: Table) -> list[str]:
    return [
        f"All cameras, {scene.name}: {median_error(table, scene, ALL_CAMERAS, matches=10):.2g}° with 10 matches per camera, "
        f"{median_error(table, scene, ALL_CAMERAS, matches=320):.2g}° with 320."
        for scene in (BALANCED, CLOUD, PRACTICE)
    ]


POINTS = Study(
    name="points",
    question="How does the error fall with the number of points?",
    run=run_points,
    draw=partial(
        draw_lines,
        title="Number of points: 4 cameras, noise of 0.5 px, rotation by 5°",
        x="matches",
        x_label="matches per camera",
    ),
    summarize=summarize_points,
    trials=40,
    quick_trials=4,
)

# --- Number of cameras ------------------------------------------------------------------------------------------------


def run_cameras(seed: int, trials: int) -> Table:
    def make(scene: Scene, n: float, rng: np.random.Generator) -> Problem:
        return simulate(scene, rng, dome(round(n)))

    levels = (2, 3, 4, 6, 8, 16, 32)
    return run_comparison(
        "cameras", {s.name: partial(make, s) for s in (BALANCED, CLOUD, PRACTICE)}, levels, ESTIMATORS, seed, trials
    )


def summarize_cameras(table: Table) -> list[str]:
    sentences = [
        f"All cameras, {scene.name}: {median_error(table, scene, ALL_CAMERAS, cameras=2):.2g}° with 2 cameras, "
        f"{median_error(table, scene, ALL_CAMERAS, cameras=4):.2g}° with 4, "
        f"{median_error(table, scene, ALL_CAMERAS, cameras=32):.2g}° with 32."
        for scene in (BALANCED, PRACTICE)
    ]
    certified = ", ".join(
        f"{100 * table.value('certified', scene=PRACTICE.name, method=ALL_CAMERAS, cameras=n):.0f} % with {n}"
        for n in (2, 3, 4)
    )
    return [*sentences, f"Certified as the global optimum, perspective: {certified} cameras."]


CAMERAS = Study(
    name="cameras",
    question="How much does each additional camera improve the result?",
    run=run_cameras,
    draw=partial(
        draw_lines,
        title="Number of cameras, on a dome: 60 matches each, noise of 0.5 px, rotation by 5°",
        x="cameras",
        x_label="cameras",
    ),
    summarize=summarize_cameras,
    trials=40,
    quick_trials=4,
)

# --- Depth plane ------------------------------------------------------------------------------------------------------


def run_depth(seed: int, trials: int) -> Table:
    def make(scene: Scene, turn: float, rng: np.random.Generator) -> Problem:
        return simulate(scene, rng, around_rig(4), angle_deg=turn)

    levels = (0.5, 1.0, 2.0, 5.0, 10.0, 15.0, 20.0)
    return run_comparison("turn_deg", {s.name: partial(make, s) for s in BODIES}, levels, ESTIMATORS, seed, trials)


def summarize_depth(table: Table) -> list[str]:
    return [
        f"{scene.name.capitalize()}, rotation by 5°: "
        f"{median_error(table, scene, ALL_CAMERAS, turn_deg=5.0):.2g}° without and "
        f"{median_error(table, scene, DEPTH_PLANE, turn_deg=5.0):.2g}° with a depth plane per camera."
        for scene in BODIES
    ]


DEPTH = Study(
    name="depth_plane",
    question="How much does a local depth plane per camera improve the result, in perspective?",
    run=run_depth,
    draw=partial(
        draw_lines,
        title="With and without a depth plane: perspective, 4 cameras, 60 matches each, noise of 0.5 px",
        x="turn_deg",
        x_label="rotation angle (degrees)",
        reference=IDENTITY_ERROR,
    ),
    summarize=summarize_depth,
    trials=40,
    quick_trials=4,
)

# --- Constraint -------------------------------------------------------------------------------------------------------

CONSTRAINT_ESTIMATORS = {
    "one camera, unconstrained, then adjusted": estimate_one_unconstrained,
    "one camera, pseudo-orthogonal": estimate_one_camera,
    "all cameras, unconstrained, then adjusted": estimate_unconstrained,
    "all cameras, a rotation": estimate_centralized,
}
# Degrees: large enough for one camera to observe all axes (choice).
CONSTRAINT_ANGLE_DEG = 20.0


def run_constraint(seed: int, trials: int) -> Table:
    def make(scene: Scene, noise: float, rng: np.random.Generator) -> Problem:
        rig = right_angle_rig()
        return simulate(scene, rng, rig, angle_deg=CONSTRAINT_ANGLE_DEG, noise_px=noise, matches=20, aligned=True)

    scenes = {s.name: partial(make, s) for s in (BALANCED, STRETCHED, PRACTICE)}
    return run_comparison("noise_px", scenes, (0.1, 0.2, 0.5, 1.0, 2.0, 5.0), CONSTRAINT_ESTIMATORS, seed, trials)


def summarize_constraint(table: Table) -> list[str]:
    sentences = []
    for scene in (BALANCED, STRETCHED, PRACTICE):
        one_adjusted, one, all_adjusted, all_ = (
            median_error(table, scene, m, noise_px=1.0) for m in CONSTRAINT_ESTIMATORS
        )
        sentences.append(
            f"Projected against constrained, noise of 1 px, {scene.name}: {one_adjusted:.3g}° against {one:.3g}° "
            f"with one camera, {all_adjusted:.3g}° against {all_:.3g}° with all three."
        )
    return sentences


CONSTRAINT = Study(
    name="constraint",
    question="Is the constrained estimate better than a projection afterwards?",
    run=run_constraint,
    draw=partial(
        draw_lines,
        title=f"Constrained or projected: 3 orthogonal cameras, 20 matches each, rotation by {CONSTRAINT_ANGLE_DEG:g}°",
        x="noise_px",
        x_label="noise (px)",
    ),
    summarize=summarize_constraint,
    trials=100,
    quick_trials=10,
)

STUDIES = (NOISE, ROTATION, POINTS, CAMERAS, DEPTH, CONSTRAINT)
