"""Accuracy studies: noise, angle, points, cameras, depth plane, constraint, layout, occlusion, faulty cameras."""

from __future__ import annotations

from copy import deepcopy
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.experiments.problems import (
    BALANCED,
    BODIES,
    CLOUD,
    PRACTICE,
    STRETCHED,
    SURFACE,
    Estimator,
    Problem,
    Scene,
    around_rig,
    detected_faults,
    estimate_centralized,
    estimate_depth_plane,
    estimate_one_camera,
    estimate_one_unconstrained,
    estimate_robust,
    estimate_unconstrained,
    estimate_without_faulty,
    right_angle_rig,
    simulate,
)
from sylpose.experiments.study import (
    ERROR_COLUMNS,
    IDENTITY_ERROR,
    Cell,
    Levels,
    Lines,
    Study,
    Table,
    compare,
    draw_bars,
    score_estimator,
    simulate_trials,
)
from sylpose.simulate import arc, dome, ring

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


NOISE = compare(
    "noise",
    "How does the error grow with the noise of the image points?",
    "Image noise: 4 cameras, 60 matches each, rotation by 5°",
    Levels("noise_px", "noise (px)", (0.0, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0), simulate_noise),
    (BALANCED, SURFACE, PRACTICE),
    ESTIMATORS,
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
    one = median_error(table, BALANCED, ONE_CAMERA, turn_deg=0.5)
    return [*sentences, f"One camera measures a rotation by 0.5° with an error of {one:.2g}°, if its model is exact."]


ROTATION = compare(
    "turn",
    "How does the error depend on the rotation angle?",
    "Rotation angle: 4 cameras, 60 matches each, noise of 0.5 px",
    Levels("turn_deg", TURN_LABEL, (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 40.0), simulate_rotation),
    (BALANCED, SURFACE, PRACTICE),
    ESTIMATORS,
    summarize_rotation,
    reference=IDENTITY_ERROR,
)


def summarize_depth(table: Table) -> list[str]:
    return [
        f"{scene.name.capitalize()}, rotation by 5°: {median_error(table, scene, turn_deg=5.0):.2g}° without and "
        f"{median_error(table, scene, DEPTH_PLANE, turn_deg=5.0):.2g}° with a depth plane per camera."
        for scene in BODIES
    ]


DEPTH = compare(
    "depth_plane",
    "How much does a local depth plane per camera improve the result, in perspective?",
    "With and without a depth plane: perspective, 4 cameras, 60 matches each, noise of 0.5 px",
    Levels("turn_deg", TURN_LABEL, (0.5, 1.0, 2.0, 5.0, 10.0, 15.0, 20.0), simulate_rotation),
    BODIES,
    ESTIMATORS,
    summarize_depth,
    reference=IDENTITY_ERROR,
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


POINTS = compare(
    "points",
    "How does the error fall with the number of points?",
    "Number of points: 4 cameras, noise of 0.5 px, rotation by 5°",
    Levels("matches", "matches per camera", (6, 10, 20, 40, 80, 160, 320), simulate_points),
    (BALANCED, CLOUD, PRACTICE),
    ESTIMATORS,
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


CAMERAS = compare(
    "cameras",
    "How much does each additional camera improve the result?",
    "Number of cameras, on a dome: 60 matches each, noise of 0.5 px, rotation by 5°",
    Levels("cameras", "cameras", (2, 3, 4, 6, 8, 16, 32), simulate_cameras),
    (BALANCED, CLOUD, PRACTICE),
    ESTIMATORS,
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


CONSTRAINT = compare(
    "constraint",
    "Is the constrained estimate better than a projection afterwards?",
    f"Constrained or projected: 3 orthogonal cameras, 20 matches each, rotation by {CONSTRAINT_ANGLE_DEG:g}°",
    Levels("noise_px", "noise (px)", (0.1, 0.2, 0.5, 1.0, 2.0, 5.0), simulate_constraint),
    (BALANCED, STRETCHED, PRACTICE),
    CONSTRAINT_ESTIMATORS,
    summarize_constraint,
    trials=100,
    quick_trials=10,
)

# --- Camera layout ----------------------------------------------------------------------------------------------------

# Rigs, and the rotation axis (None: any).
LAYOUTS = {
    "4 around, alternately above and below": (around_rig(4), None),
    "4 on a dome": (dome(4), None),
    "4 around, in one plane": (ring(4), None),
    "4 in one plane, rotation about its normal": (ring(4), (0.0, -1.0, 0.0)),
    "4 above and below, same rotation": (around_rig(4), (0.0, -1.0, 0.0)),
    "4 close together, 10° apart": (arc(4, 10, height=[0.2, -0.2, 0.2, -0.2]), None),
    "2, 90° apart": (arc(2, 90), None),
    "2, 15° apart": (arc(2, 15), None),
}
PANELS: dict[str, tuple[Scene, Estimator]] = {
    "Orthographic, depth exactly uncorrelated": (BALANCED, estimate_centralized),
    "Perspective, visible surface": (PRACTICE, estimate_centralized),
    "Perspective, visible surface, depth plane": (PRACTICE, estimate_depth_plane),
}


def run_layout(seed: int, trials: int) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for name, (rig, axis) in LAYOUTS.items():
        for panel, (scene, estimate) in PANELS.items():
            problems = simulate_trials(partial(simulate, scene, rig=rig, axis=axis), seed, trials)
            rows.append((panel, name, *score_estimator(estimate, problems)))
    return Table(("scene", "method", *ERROR_COLUMNS), tuple(rows))


def summarize_layout(table: Table) -> list[str]:
    good, flat = (list(LAYOUTS)[k] for k in (0, 3))
    sentences = []
    balanced, _, plane = PANELS
    for panel in (balanced, plane):
        around_error, planar_error = (table.value("median_deg", scene=panel, method=name) for name in (good, flat))
        sentences.append(
            f"{panel}, rotation by 5°: {around_error:.2g}° with 4 cameras above and below; {planar_error:.2g}° with 4 "
            f"in one plane and rotation about its normal."
        )
    return sentences


LAYOUT = Study(
    "layout",
    "How does the error depend on the camera layout?",
    run_layout,
    partial(draw_bars, title="Camera layout: rotation by 5°, noise of 0.5 px, 60 matches each"),
    summarize_layout,
    quick_trials=3,
)

# --- Occlusion --------------------------------------------------------------------------------------------------------

# Number of cameras, and of occluded ones among them (choice).
N_CAMERAS, N_OCCLUDED = 8, 4
OCCLUSION = {
    "an occluded camera alone": lambda problem: estimate_one_camera(problem.subset(problem.faulty)),
    "all 8 cameras": estimate_centralized,
    "all 8 cameras, depth plane": estimate_depth_plane,
    "the 4 others only": estimate_without_faulty,
}


def simulate_occlusion(scene: Scene, percent: float, rng: np.random.Generator) -> Problem:
    again, rig = deepcopy(rng), around_rig(N_CAMERAS)
    clear, hidden = simulate(scene, rng, rig), simulate(scene, again, rig, occlusion=percent / 100)
    return clear.with_faulty(range(N_OCCLUDED), hidden)


def summarize_occlusion(table: Table) -> list[str]:
    sentences = []
    for scene in (CLOUD, PRACTICE):
        errors = ", ".join(
            f"{table.value('median_deg', scene=scene.name, method='all 8 cameras', hidden_percent=p):.2g}° with {p} %"
            for p in (0, 50, 90, 100)
        )
        sentences.append(f"All 8 cameras, {scene.name}: {errors} of the features occluded in 4 of them.")
    return sentences


HIDDEN_LABEL = "share of occluded features (%)"
OCCLUSION_STUDY = compare(
    "occlusion",
    "What is the effect of occlusion in some cameras, up to all features?",
    "Occlusion in 4 of 8 cameras: rotation by 5°, noise of 0.5 px",
    Levels("hidden_percent", HIDDEN_LABEL, (0, 25, 50, 75, 90, 100), simulate_occlusion, is_log=False),
    (CLOUD, PRACTICE),
    OCCLUSION,
    summarize_occlusion,
)

# --- Faulty cameras ---------------------------------------------------------------------------------------------------

FAULT_KINDS = ("junk matches", "calibration wrong by 20°", "frozen")
# Degrees: the effect of a wrong calibration grows with the rotation (choice).
SENSOR_ANGLE_DEG = 10.0
SENSORS: dict[str, Estimator] = {
    "all cameras": estimate_centralized,
    "bad ones detected": estimate_robust,
    "bad ones excluded by hand": estimate_without_faulty,
}


def simulate_faulty(kind: str, n: float, rng: np.random.Generator) -> Problem:
    """Simulate eight cameras in perspective, `n` of them faulty."""
    same_rng = deepcopy(rng)
    rig, bad = around_rig(N_CAMERAS), range(round(n))
    good = simulate(PRACTICE, rng, rig, angle_deg=SENSOR_ANGLE_DEG)
    if kind == FAULT_KINDS[1]:
        axes = rng.standard_normal((N_CAMERAS, 3))
        wrong = Rotation.from_rotvec(np.deg2rad(20) * axes / np.linalg.norm(axes, axis=1, keepdims=True))
        return good.with_faulty(bad, good._replace(rotations=wrong.as_matrix() @ good.rotations))
    junk = bad if kind == FAULT_KINDS[0] else ()
    other = simulate(PRACTICE, same_rng, rig, angle_deg=SENSOR_ANGLE_DEG, static=kind == "frozen", junk=junk)
    return good.with_faulty(bad, other)


def run_sensors(seed: int, trials: int) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for kind in FAULT_KINDS:
        for n in (0, 1, 2, 3):
            problems = simulate_trials(partial(simulate_faulty, kind, n), seed, trials)
            detected = [detected_faults(problem) for problem in problems]
            right = [len(names & set(p.faulty)) for names, p in zip(detected, problems, strict=True)]
            wrong = [len(names - set(p.faulty)) for names, p in zip(detected, problems, strict=True)]
            rates = float(np.mean(right)) / n if n else None, float(np.mean(wrong)) / (N_CAMERAS - n)
            for method, estimate in SENSORS.items():
                named = rates if estimate is estimate_robust else (None, None)
                rows.append((kind, method, n, *score_estimator(estimate, problems), *named))
    return Table(("scene", "method", "bad", *ERROR_COLUMNS, "bad_named", "good_named"), tuple(rows))


def summarize_sensors(table: Table) -> list[str]:
    sentences = []
    for kind in FAULT_KINDS:
        errors = [table.value("median_deg", scene=kind, method=method, bad=2) for method in SENSORS]
        share = table.value("bad_named", scene=kind, method="bad ones detected", bad=2)
        sentences.append(
            f"2 of 8 cameras, {kind}: {errors[0]:.2g}° with all, {errors[1]:.2g}° with bad ones detected, "
            f"{errors[2]:.2g}° with bad ones excluded by hand; {100 * share:.0f} % of them are detected."
        )
    false = table.filter_rows(method="bad ones detected").column_values("good_named")
    return [*sentences, f"Good cameras reported as bad: {100 * false.mean():.1f} %."]


SENSORS_TITLE = f"Faulty cameras among 8: perspective, rotation by {SENSOR_ANGLE_DEG:g}°, noise of 0.5 px"
SENSORS_STUDY = Study(
    "sensors",
    "What is the effect of faulty cameras?",
    run_sensors,
    Lines(SENSORS_TITLE, "bad", "bad cameras of 8", log_x=False).draw,
    summarize_sensors,
)

STUDIES = (NOISE, ROTATION, POINTS, CAMERAS, DEPTH, CONSTRAINT, LAYOUT, OCCLUSION_STUDY, SENSORS_STUDY)
