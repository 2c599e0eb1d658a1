"""Robustness studies: camera layout, occlusion, faulty cameras."""

from __future__ import annotations

from copy import deepcopy
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.experiments.estimators import (
    Estimator,
    detected_faults,
    estimate_centralized,
    estimate_depth_plane,
    estimate_one_camera,
    estimate_robust,
    estimate_without_faulty,
)
from sylpose.experiments.figures import Lines, draw_bars
from sylpose.experiments.scenes import BALANCED, CLOUD, PRACTICE, Problem, Scene, around_rig, simulate
from sylpose.experiments.study import Levels, Study, compare, score_estimator, simulate_trials
from sylpose.experiments.table import ERROR_COLUMNS, Cell, Table
from sylpose.simulate import arc, dome, ring

__all__ = ["STUDIES"]

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
CAMERAS, OCCLUDED = 8, 4
OCCLUSION = {
    "an occluded camera alone": lambda problem: estimate_one_camera(problem.subset(problem.faulty)),
    "all 8 cameras": estimate_centralized,
    "all 8 cameras, depth plane": estimate_depth_plane,
    "the 4 others only": estimate_without_faulty,
}


def simulate_occlusion(scene: Scene, percent: float, rng: np.random.Generator) -> Problem:
    again, rig = deepcopy(rng), around_rig(CAMERAS)
    clear, hidden = simulate(scene, rng, rig), simulate(scene, again, rig, occlusion=percent / 100)
    return clear.with_faulty(range(OCCLUDED), hidden)


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
OCCLUSION_STUDY = Study(
    "occlusion",
    "What is the effect of occlusion in some cameras, up to all features?",
    *compare(
        Levels("hidden_percent", HIDDEN_LABEL, (0, 25, 50, 75, 90, 100), simulate_occlusion, is_log=False),
        (CLOUD, PRACTICE),
        OCCLUSION,
        "Occlusion in 4 of 8 cameras: rotation by 5°, noise of 0.5 px",
    ),
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
    rig, bad = around_rig(CAMERAS), range(round(n))
    good = simulate(PRACTICE, rng, rig, angle_deg=SENSOR_ANGLE_DEG)
    if kind == FAULT_KINDS[1]:
        axes = rng.standard_normal((CAMERAS, 3))
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
            rates = float(np.mean(right)) / n if n else None, float(np.mean(wrong)) / (CAMERAS - n)
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

STUDIES = (LAYOUT, OCCLUSION_STUDY, SENSORS_STUDY)
