"""What the estimates withstand: where the cameras stand, hidden features, bad sensors."""

from __future__ import annotations

from copy import deepcopy
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.experiments.estimators import Estimator, centralized, depth_plane, named, one_camera, only_good, robust
from sylpose.experiments.figures import draw_bars, draw_lines
from sylpose.experiments.scenes import BALANCED, CLOUD, PRACTICE, Problem, Scene, around, simulate
from sylpose.experiments.study import Study, compare, score
from sylpose.experiments.table import ERROR_COLUMNS, Cell, Table
from sylpose.simulate import arc, dome, ring

__all__ = ["STUDIES"]

# --- Where the cameras stand ------------------------------------------------------------------------------------------

# Rigs, and the axis of the turn (None: any).
LAYOUTS = {
    "4 around, alternately above and below": (around(4), None),
    "4 on a dome": (dome(4), None),
    "4 around, in one plane": (ring(4), None),
    "4 in one plane, turn about its normal": (ring(4), (0.0, -1.0, 0.0)),
    "4 above and below, the same turn": (around(4), (0.0, -1.0, 0.0)),
    "4 close together, 10° apart": (arc(4, 10, height=[0.2, -0.2, 0.2, -0.2]), None),
    "2, 90° apart": (arc(2, 90), None),
    "2, 15° apart": (arc(2, 15), None),
}
BALANCED_PANEL, PLAIN_PANEL, PLANE_PANEL = (
    "Orthographic, depth exactly uncorrelated",
    "Perspective, visible surface",
    "Perspective, visible surface, depth plane",
)


def run_layout(seed: int, trials: int) -> Table:
    panels: dict[str, tuple[Scene, Estimator]] = {
        BALANCED_PANEL: (BALANCED, centralized),
        PLAIN_PANEL: (PRACTICE, centralized),
        PLANE_PANEL: (PRACTICE, depth_plane),
    }
    rows: list[tuple[Cell, ...]] = []
    for name, (rig, axis) in LAYOUTS.items():
        drawn = {
            scene: [simulate(scene, np.random.default_rng([seed, k]), rig, axis=axis) for k in range(trials)]
            for scene in (BALANCED, PRACTICE)
        }
        rows += [(panel, name, *score(estimate, drawn[scene])) for panel, (scene, estimate) in panels.items()]
    return Table(("scene", "method", *ERROR_COLUMNS), tuple(rows))


def layout_findings(table: Table) -> list[str]:
    good, flat = (list(LAYOUTS)[k] for k in (0, 3))
    said = []
    for panel in (BALANCED_PANEL, PLANE_PANEL):
        all_round, in_plane = (table.value("median_deg", scene=panel, method=name) for name in (good, flat))
        said.append(
            f"{panel}, a turn of 5°: {all_round:.2g}° with 4 cameras above and below; in one plane, and a turn about its "
            f"normal, {in_plane:.2g}°."
        )
    return said


LAYOUT = Study(
    name="layout",
    question="Where must the cameras stand?",
    run=run_layout,
    draw=partial(draw_bars, title="Where the cameras stand: a turn of 5°, noise of 0.5 px, 60 matches each"),
    findings=layout_findings,
    trials=40,
    quick_trials=3,
)

# --- Occlusion --------------------------------------------------------------------------------------------------------

# Of how many cameras how many are occluded (choice).
CAMERAS, OCCLUDED = 8, 4
OCCLUSION = {
    "an occluded camera alone": lambda problem: one_camera(problem.only(problem.bad)),
    "all 8 cameras": centralized,
    "all 8 cameras, depth plane": depth_plane,
    "the 4 others only": only_good,
}


def run_occlusion(seed: int, trials: int) -> Table:
    def make(scene: Scene, percent: float, rng: np.random.Generator) -> Problem:
        again = deepcopy(rng)
        rig = around(CAMERAS)
        clear, hidden = simulate(scene, rng, rig), simulate(scene, again, rig, hidden=percent / 100)
        return clear.spoilt(range(OCCLUDED), hidden)

    scenes = {s.name: partial(make, s) for s in (CLOUD, PRACTICE)}
    return compare("hidden_percent", scenes, (0, 25, 50, 75, 90, 100), OCCLUSION, seed, trials)


def occlusion_findings(table: Table) -> list[str]:
    said = []
    for scene in (CLOUD, PRACTICE):
        errors = ", ".join(
            f"{table.value('median_deg', scene=scene.name, method='all 8 cameras', hidden_percent=p):.2g}° with {p} %"
            for p in (0, 50, 90, 100)
        )
        said.append(f"All 8 cameras, {scene.name}: {errors} of the features hidden in 4 of them.")
    return said


OCCLUSION_STUDY = Study(
    name="occlusion",
    question="What if something in front of some cameras hides features, up to all of them?",
    run=run_occlusion,
    draw=partial(
        draw_lines,
        title="Occlusion in 4 of 8 cameras: a turn of 5°, noise of 0.5 px",
        x="hidden_percent",
        x_label="share of the features that are hidden (%)",
        log_x=False,
    ),
    findings=occlusion_findings,
    trials=40,
    quick_trials=4,
)

# --- Bad sensors ------------------------------------------------------------------------------------------------------

KINDS = ("junk matches", "calibration wrong by 20°", "frozen")
# Degrees: a wrong calibration shows with the turn (choice).
SENSOR_TURN = 10.0
SENSORS: dict[str, Estimator] = {
    "all cameras": centralized,
    "bad ones recognised": robust,
    "bad ones left out by hand": only_good,
}


def with_bad(kind: str, n: float, rng: np.random.Generator) -> Problem:
    """Eight cameras in perspective, `n` of them bad."""
    again = deepcopy(rng)
    rig, bad = around(CAMERAS), range(round(n))
    good = simulate(PRACTICE, rng, rig, turn_deg=SENSOR_TURN)
    if kind == KINDS[1]:
        axes = rng.standard_normal((CAMERAS, 3))
        wrong = Rotation.from_rotvec(np.deg2rad(20) * axes / np.linalg.norm(axes, axis=1, keepdims=True))
        return good.spoilt(bad, good._replace(rotations=wrong.as_matrix() @ good.rotations))
    other = simulate(
        PRACTICE, again, rig, turn_deg=SENSOR_TURN, still=kind == "frozen", junk=bad if kind == KINDS[0] else ()
    )
    return good.spoilt(bad, other)


def run_sensors(seed: int, trials: int) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for kind in KINDS:
        for n in (0, 1, 2, 3):
            drawn = [with_bad(kind, n, np.random.default_rng([seed, k])) for k in range(trials)]
            found = [named(problem) for problem in drawn]
            share = np.mean([len(names & set(p.bad)) for names, p in zip(found, drawn, strict=True)]) / n if n else None
            false = np.mean([len(names - set(p.bad)) for names, p in zip(found, drawn, strict=True)]) / (CAMERAS - n)
            for method, estimate in SENSORS.items():
                naming = (share, float(false)) if estimate is robust else (None, None)
                rows.append((kind, method, n, *score(estimate, drawn), *naming))
    return Table(("scene", "method", "bad", *ERROR_COLUMNS, "bad_named", "good_named"), tuple(rows))


def sensors_findings(table: Table) -> list[str]:
    said = []
    for kind in KINDS:
        errors = [table.value("median_deg", scene=kind, method=method, bad=2) for method in SENSORS]
        share = table.value("bad_named", scene=kind, method="bad ones recognised", bad=2)
        said.append(
            f"2 of 8 cameras, {kind}: {errors[0]:.2g}° with all, {errors[1]:.2g}° with bad ones recognised, "
            f"{errors[2]:.2g}° with these left out by hand; {100 * share:.0f} % of them are named."
        )
    false = table.where(method="bad ones recognised").numbers("good_named")
    return [*said, f"Good cameras named: {100 * false.mean():.1f} %."]


SENSORS_STUDY = Study(
    name="sensors",
    question="What if some cameras are wrong?",
    run=run_sensors,
    draw=partial(
        draw_lines,
        title=f"Bad sensors among 8 cameras: perspective, a turn of {SENSOR_TURN:g}°, noise of 0.5 px",
        x="bad",
        x_label="bad cameras of 8",
        log_x=False,
    ),
    findings=sensors_findings,
    trials=40,
    quick_trials=4,
)

STUDIES = (LAYOUT, OCCLUSION_STUDY, SENSORS_STUDY)
