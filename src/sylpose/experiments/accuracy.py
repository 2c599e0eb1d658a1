"""Accuracy studies: noise, rotation angle, number of points and cameras, depth plane, rotation constraint."""

from __future__ import annotations

import numpy as np

from sylpose.experiments.estimators import (
    estimate_centralized,
    estimate_depth_plane,
    estimate_one_camera,
    estimate_one_unconstrained,
    estimate_unconstrained,
)
from sylpose.experiments.figures import IDENTITY_ERROR
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
from sylpose.experiments.study import Levels, Study, compare
from sylpose.experiments.table import Cell, Table
from sylpose.simulate import dome

__all__ = ["STUDIES"]

ONE_CAMERA, ALL_CAMERAS, DEPTH_PLANE = "one camera, better mirror image", "all cameras", "all cameras, depth plane"
ESTIMATORS = {ONE_CAMERA: estimate_one_camera, ALL_CAMERAS: estimate_centralized, DEPTH_PLANE: estimate_depth_plane}


def median_error(table: Table, scene: Scene, method: str = ALL_CAMERAS, **level: Cell) -> float:
    """Return the median error at a level, degrees."""
    return table.value("median_deg", scene=scene.name, method=method, **level)


# --- Image noise ------------------------------------------------------------------------------------------------------


def simulate_noise(scene: Scene, noise: float, rng: np.random.Generator) -> Problem:
    return simulate(scene, rng, around_rig(4), noise_px=noise)


def summarize_noise(table: Table) -> list[str]:
    exact, rough, worst = (median_error(table, BALANCED, noise_px=n) for n in (0.0, 0.5, 5.0))
    real, plane = (median_error(table, PRACTICE, method, noise_px=0.5) for method in (ALL_CAMERAS, DEPTH_PLANE))
    return [
        f"All cameras, depth exactly uncorrelated: {exact:.1g}° without noise, {rough:.2g}° at 0.5 px, "
        f"{worst:.2g}° at 5 px.",
        f"In perspective, on the visible surface: {median_error(table, PRACTICE, noise_px=0.0):.2g}° even without "
        f"noise, {real:.2g}° at 0.5 px; with a depth plane {plane:.2g}°.",
    ]


NOISE = Study(
    "noise",
    "How does the error grow with the noise of the image points?",
    *compare(
        Levels("noise_px", "noise (px)", (0.0, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0), simulate_noise),
        (BALANCED, SURFACE, PRACTICE),
        ESTIMATORS,
        "Image noise: 4 cameras, 60 matches each, rotation by 5°",
    ),
    summarize_noise,
)

# --- Rotation angle, and depth plane ----------------------------------------------------------------------------------


def simulate_rotation(scene: Scene, turn: float, rng: np.random.Generator) -> Problem:
    return simulate(scene, rng, around_rig(4), angle_deg=turn)


TURN_LABEL = "rotation angle (degrees)"


def summarize_rotation(table: Table) -> list[str]:
    sentences = []
    for scene in (BALANCED, PRACTICE):
        errors = ", ".join(f"{median_error(table, scene, turn_deg=t):.2g}° at {t:g}°" for t in (0.5, 5.0, 40.0))
        sentences.append(f"All cameras, {scene.name}: {errors} of rotation.")
    single = median_error(table, BALANCED, ONE_CAMERA, turn_deg=0.5)
    return [
        *sentences,
        f"One camera measures a rotation by 0.5° with an error of {single:.2g}°, if its model is exact.",
    ]


ROTATION = Study(
    "turn",
    "How does the error depend on the rotation angle?",
    *compare(
        Levels("turn_deg", TURN_LABEL, (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 40.0), simulate_rotation),
        (BALANCED, SURFACE, PRACTICE),
        ESTIMATORS,
        "Rotation angle: 4 cameras, 60 matches each, noise of 0.5 px",
        IDENTITY_ERROR,
    ),
    summarize_rotation,
)


def summarize_depth(table: Table) -> list[str]:
    return [
        f"{scene.name.capitalize()}, rotation by 5°: {median_error(table, scene, turn_deg=5.0):.2g}° without and "
        f"{median_error(table, scene, DEPTH_PLANE, turn_deg=5.0):.2g}° with a depth plane per camera."
        for scene in BODIES
    ]


DEPTH = Study(
    "depth_plane",
    "How much does a local depth plane per camera improve the result, in perspective?",
    *compare(
        Levels("turn_deg", TURN_LABEL, (0.5, 1.0, 2.0, 5.0, 10.0, 15.0, 20.0), simulate_rotation),
        BODIES,
        ESTIMATORS,
        "With and without a depth plane: perspective, 4 cameras, 60 matches each, noise of 0.5 px",
        IDENTITY_ERROR,
    ),
    summarize_depth,
)

# --- Number of points -------------------------------------------------------------------------------------------------


def simulate_points(scene: Scene, n: float, rng: np.random.Generator) -> Problem:
    return simulate(scene, rng, around_rig(4), matches=round(n))


def summarize_points(table: Table) -> list[str]:
    return [
        f"All cameras, {scene.name}: {median_error(table, scene, matches=10):.2g}° with 10 matches per camera, "
        f"{median_error(table, scene, matches=320):.2g}° with 320."
        for scene in (BALANCED, CLOUD, PRACTICE)
    ]


POINTS = Study(
    "points",
    "How does the error fall with the number of points?",
    *compare(
        Levels("matches", "matches per camera", (6, 10, 20, 40, 80, 160, 320), simulate_points),
        (BALANCED, CLOUD, PRACTICE),
        ESTIMATORS,
        "Number of points: 4 cameras, noise of 0.5 px, rotation by 5°",
    ),
    summarize_points,
)

# --- Number of cameras ------------------------------------------------------------------------------------------------


def simulate_cameras(scene: Scene, n: float, rng: np.random.Generator) -> Problem:
    return simulate(scene, rng, dome(round(n)))


def summarize_cameras(table: Table) -> list[str]:
    sentences = []
    for scene in (BALANCED, PRACTICE):
        two, four, many = (median_error(table, scene, cameras=n) for n in (2, 4, 32))
        sentences.append(
            f"All cameras, {scene.name}: {two:.2g}° with 2 cameras, {four:.2g}° with 4, {many:.2g}° with 32."
        )
    certified = ", ".join(
        f"{100 * table.value('certified', scene=PRACTICE.name, method=ALL_CAMERAS, cameras=n):.0f} % with {n}"
        for n in (2, 3, 4)
    )
    return [*sentences, f"Certified as the global optimum, perspective: {certified} cameras."]


CAMERAS = Study(
    "cameras",
    "How much does each additional camera improve the result?",
    *compare(
        Levels("cameras", "cameras", (2, 3, 4, 6, 8, 16, 32), simulate_cameras),
        (BALANCED, CLOUD, PRACTICE),
        ESTIMATORS,
        "Number of cameras, on a dome: 60 matches each, noise of 0.5 px, rotation by 5°",
    ),
    summarize_cameras,
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


def simulate_constraint(scene: Scene, noise: float, rng: np.random.Generator) -> Problem:
    rig = right_angle_rig()
    return simulate(scene, rng, rig, angle_deg=CONSTRAINT_ANGLE_DEG, noise_px=noise, matches=20, aligned=True)


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
    "constraint",
    "Is the constrained estimate better than a projection afterwards?",
    *compare(
        Levels("noise_px", "noise (px)", (0.1, 0.2, 0.5, 1.0, 2.0, 5.0), simulate_constraint),
        (BALANCED, STRETCHED, PRACTICE),
        CONSTRAINT_ESTIMATORS,
        f"Constrained or projected: 3 orthogonal cameras, 20 matches each, rotation by {CONSTRAINT_ANGLE_DEG:g}°",
    ),
    summarize_constraint,
    trials=100,
    quick_trials=10,
)

STUDIES = (NOISE, ROTATION, POINTS, CAMERAS, DEPTH, CONSTRAINT)
