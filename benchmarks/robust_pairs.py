"""Reliability and covariance consistency of `estimate_motion` on hard scenes.

    python benchmarks/robust_pairs.py [--scenes 200] [--rows "slide*"] [--worst 3] [--cameras]

The scenes have flat objects and narrow baselines, second motions of 40 %, static backgrounds behind an object that hardly
moves, translations with hardly any rotation, and thin boxes. Each row gives:

- the number of scenes per status;
- *wrong and sure*: scenes with a rotation error above 3 degrees and five of its standard deviations, or with the status
  NO_MOTION and an information matrix that excludes the true motion. Statuses that mark the motion as a guess (AMBIGUOUS,
  MIXED, MOSTLY_STILL) do not count;
- NEES of scenes with status OK: mean (6 if consistent), mean without the largest 1 %, largest;
- NEES of other scenes, without the unobservable part and scaled to six degrees of freedom: mean, mean without the largest
  1 %, largest.

Only the reported solution counts, even if another one explains the matches equally well. With `--cameras`, one of four
cameras is faulty instead: calibrations rotated about a random axis, two exchanged videos, and rigs without a fault.
"""

from __future__ import annotations

import argparse
import fnmatch
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose import Matches, Motion, Rig, Status, estimate_motion
from sylpose.geometry.matrices import remove_direction
from sylpose.simulate import (
    Body,
    SimulatedPair,
    arc,
    box,
    dome,
    ellipsoid,
    plane,
    random_motion,
    ring,
    simulate_matches,
)

ELLIPSOID = ellipsoid((0.15, 0.12, 0.1))
BODIES = {"ellipsoid": ELLIPSOID, "box": box((0.25, 0.2, 0.15)), "board": plane()}
# A result that exceeds both is wrong and sure: degrees, standard deviations.
WRONG_DEG, WRONG_SIGMAS = 3.0, 5.0
# Statuses that mark the motion as a guess without a meaningful covariance.
GUESS_STATUSES = (Status.AMBIGUOUS, Status.MIXED, Status.MOSTLY_STATIC)


class Setting(NamedTuple):
    """Parameters of the scenes of one row.

    `image_motion_px`, if positive, is the median image motion of the object's points; `rotation_deg` and
    `translation_m` are scaled to it.
    """

    rig: Rig
    body: Body = ELLIPSOID
    rotation_deg: float = 5.0
    translation_m: float = 0.03
    outliers: float = 0.0
    outlier_kind: str = "uniform"
    image_motion_px: float = 0.0
    matches: int = 60
    noise_px: float = 0.5


def _make_zigzag_ring(n: int) -> Rig:
    return ring(n, height=[0.4 * (-1) ** k for k in range(n)])


SETTINGS = {
    **{
        f"board, {n} cameras {apart} apart, turn {turn}": Setting(arc(n, apart), plane(), float(turn))
        for n in (2, 3)
        for apart in (10, 20)
        for turn in (3, 8)
    },
    "board, 4 cameras 10 apart, turn 5": Setting(arc(4, 10), plane()),
    **{
        f"board, 2 cameras 35 apart, 2 m, turn {turn}, outliers 10 %": Setting(
            arc(2, 35, 2.0), plane(), float(turn), 0.02, outliers=0.1, noise_px=0.15
        )
        for turn in (5, 15, 25)
    },
    **{
        f"{name}, {n} cameras {apart} apart": Setting(arc(n, apart), body)
        for n in (2, 3, 4)
        for apart in (1, 3, 6)
        for name, body in (("ellipsoid", ELLIPSOID), ("box", BODIES["box"]))
    },
    "ellipsoid, 3 cameras 3 apart, turn 1": Setting(arc(3, 3), rotation_deg=1.0, translation_m=0.006),
    "ellipsoid, 2 cameras 10 apart, 6 m, turn 5": Setting(arc(2, 10, 6.0, 4000.0)),
    "ellipsoid, 2 cameras 2 apart, 6 m, turn 5": Setting(arc(2, 2, 6.0, 4000.0)),
    "second motion 40 %, dome": Setting(dome(4), outliers=0.4, outlier_kind="second_motion"),
    "second motion 40 %, ring": Setting(ring(4), outliers=0.4, outlier_kind="second_motion"),
    "second motion 40 %, two cameras": Setting(arc(2, 60), outliers=0.4, outlier_kind="second_motion"),
    "second motion 40 %, turn 2": Setting(
        _make_zigzag_ring(4), rotation_deg=2.0, translation_m=0.01, outliers=0.4, outlier_kind="second_motion"
    ),
    "second motion 40 %, turn 10": Setting(
        _make_zigzag_ring(4), rotation_deg=10.0, outliers=0.4, outlier_kind="second_motion"
    ),
    "second motion 48 %": Setting(_make_zigzag_ring(4), rotation_deg=8.0, outliers=0.48, outlier_kind="second_motion"),
    "static 40 %, dome": Setting(dome(4), outliers=0.4, outlier_kind="static"),
    "static 40 %, ring": Setting(ring(4), outliers=0.4, outlier_kind="static"),
    "static 70 %": Setting(_make_zigzag_ring(4), outliers=0.7, outlier_kind="static"),
    **{
        f"static {share} %, moves {px} px": Setting(
            _make_zigzag_ring(4), outliers=share / 100, outlier_kind="static", image_motion_px=px
        )
        for share in (30, 60, 80)
        for px in (1, 2, 4)
    },
    **{
        f"static 60 %, moves {px} px, 3 cameras 20 apart": Setting(
            arc(3, 20), outliers=0.6, outlier_kind="static", image_motion_px=px
        )
        for px in (1, 2, 4)
    },
    "static 60 %, moves 2 px, 300 matches": Setting(
        _make_zigzag_ring(4), outliers=0.6, outlier_kind="static", image_motion_px=2, matches=300
    ),
    **{f"before nothing, moves {px} px": Setting(_make_zigzag_ring(4), image_motion_px=px) for px in (1, 2, 4)},
    "before nothing, moves 1 px, 3 cameras 20 apart": Setting(arc(3, 20), image_motion_px=1),
    **{
        f"stands still, {n} matches": Setting(_make_zigzag_ring(4), rotation_deg=0.0, translation_m=0.0, matches=n)
        for n in (20, 60, 300)
    },
    **{
        f"slide{where}, turn {turn}": Setting(rig, rotation_deg=turn, translation_m=0.03)
        for where, rig in (("", _make_zigzag_ring(4)), (" 3 cameras 20 apart", arc(3, 20)))
        for turn in (0.0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0)
    },
    **{
        f"slide of a board, turn {turn}": Setting(_make_zigzag_ring(4), plane(), turn, 0.03)
        for turn in (0.0, 0.1, 0.3, 0.5)
    },
    **{
        f"slide of a box, turn {turn}": Setting(_make_zigzag_ring(4), BODIES["box"], turn, 0.03)
        for turn in (0.0, 0.1, 0.3, 0.5)
    },
    "slide of 1 px": Setting(_make_zigzag_ring(4), rotation_deg=0.0, image_motion_px=1),
    "slide of 3 px": Setting(_make_zigzag_ring(4), rotation_deg=0.0, image_motion_px=3),
    "thin box, turn 10": Setting(_make_zigzag_ring(4), box((0.6, 0.01, 0.01)), 10.0, 0.02),
    "thin box, turn 4": Setting(_make_zigzag_ring(4), box((0.6, 0.01, 0.01)), 4.0, 0.02),
    "flat bar, turn 10": Setting(_make_zigzag_ring(4), box((0.6, 0.06, 0.002)), 10.0, 0.02),
}


def simulate_scene(setting: Setting, seed: int) -> tuple[SimulatedPair, Rig]:
    """Simulate one scene of a row."""
    rng = np.random.default_rng(seed)
    motion = random_motion(setting.rotation_deg, setting.translation_m, rng)
    start = RigidTransform.from_rotation(Rotation.random(rng=rng))
    if setting.image_motion_px:
        motion = _scale_to_image_motion(setting, motion, start)
    pair = simulate_matches(
        setting.rig,
        setting.body,
        motion,
        rng=rng,
        per_camera=setting.matches,
        noise_px=setting.noise_px,
        outliers=setting.outliers,
        outlier_kind=setting.outlier_kind,
        start=start,
    )
    return pair, setting.rig


def _scale_to_image_motion(setting: Setting, motion: RigidTransform, start: RigidTransform) -> RigidTransform:
    """Scale a motion so that the median image motion of the body's points is `image_motion_px`."""
    points = start.apply(np.array(setting.body.points))
    scale, rotation_vector = 1.0, motion.rotation.as_rotvec()
    for _ in range(3):
        moved = RigidTransform.from_components(
            scale * motion.translation, Rotation.from_rotvec(scale * rotation_vector)
        )
        image_motions = [
            np.linalg.norm(c.project(moved.apply(points)) - c.project(points), axis=1) for c in setting.rig
        ]
        scale *= setting.image_motion_px / float(np.median(np.concatenate(image_motions)))
    return RigidTransform.from_components(scale * motion.translation, Rotation.from_rotvec(scale * rotation_vector))


class Outcome(NamedTuple):
    """Evaluation of one scene; NEES is scaled to six degrees of freedom, NaN without a pose."""

    status: Status
    nees: float
    degrees: float
    is_wrong_and_sure: bool


def evaluate_result(found: Motion, truth: RigidTransform) -> Outcome:
    """Compare a result with the truth."""
    if found.motion is None or found.status in GUESS_STATUSES or len(found.unobservable) == 6:
        return Outcome(found.status, np.nan, np.nan, False)
    rotation_error = (truth.rotation * found.motion.rotation.inv()).as_rotvec()
    error = np.concatenate([rotation_error, truth.apply(found.center) - found.motion.apply(found.center)])
    information = found.information
    for row in found.unobservable:
        information = remove_direction(information, row)
    nees = float(error @ information @ error) * 6.0 / (6 - len(found.unobservable))
    # Marginal information of the rotation: the translation is eliminated.
    rotation_information = (
        information[:3, :3] - information[:3, 3:] @ np.linalg.pinv(information[3:, 3:]) @ information[3:, :3]
    )
    degrees = float(np.rad2deg(np.linalg.norm(rotation_error)))
    is_wrong_and_sure = (
        degrees > WRONG_DEG and float(rotation_error @ rotation_information @ rotation_error) > WRONG_SIGMAS**2
    )
    if found.status is Status.NO_MOTION:
        is_wrong_and_sure = nees > 6.0 * WRONG_SIGMAS
    return Outcome(found.status, nees, degrees, is_wrong_and_sure)


def evaluate_setting(setting: Setting, scenes: int, n_worst: int) -> str:
    """Solve the scenes of a setting and format their table row."""
    outcomes = []
    for seed in range(scenes):
        pair, rig = simulate_scene(setting, seed)
        outcomes.append(evaluate_result(estimate_motion(rig, pair.matches), pair.motion))
    counts = Counter(o.status.name for o in outcomes)
    status_text = ", ".join(f"{name} {n}" for name, n in counts.most_common())
    cells = [status_text, str(sum(o.is_wrong_and_sure for o in outcomes))]
    for ok in (True, False):
        values = np.sort([o.nees for o in outcomes if (o.status is Status.OK) == ok and np.isfinite(o.nees)])
        if len(values):
            trimmed = values[: max(1, int(0.99 * len(values)))].mean()
            cells.append(f"{values.mean():.1f}, {trimmed:.1f}, {values[-1]:.0f}")
        else:
            cells.append("-")
    for seed in np.argsort([-o.nees if np.isfinite(o.nees) else 0.0 for o in outcomes])[:n_worst]:
        o = outcomes[seed]
        cells.append(f"\n    seed {seed}: {o.status.name}, {o.degrees:.2f} degrees, NEES {o.nees:.0f}")
    return " | ".join(cells)


# --- faulty cameras among four ----------------------------------------------------------------------------------------


def simulate_four_cameras(seed: int) -> tuple[Rig, SimulatedPair]:
    """Simulate four cameras around or above a body that rotates by 3 to 10 degrees."""
    rng = np.random.default_rng([seed, 4])
    rig = (_make_zigzag_ring(4), dome(4))[seed // 3 % 2]
    body = list(BODIES.values())[seed % 3]
    while True:
        motion = random_motion(rng.uniform(3.0, 10.0), 0.02, rng)
        pair = simulate_matches(
            rig, body, motion, rng=rng, start=RigidTransform.from_rotation(Rotation.random(rng=rng))
        )
        # A camera that sees a board edge-on has too few matches to be judged.
        if min(len(m) for m in pair.matches) >= 30:
            return rig, pair


def rotate_calibration(rig: Rig, degrees: float, seed: int) -> tuple[Rig, str]:
    """Rotate one camera's calibration about a random axis; return the rig and the camera's name."""
    rng = np.random.default_rng([seed, 5])
    axis, camera = rng.standard_normal(3), rig.cameras[seed % len(rig)]
    error_rotation = RigidTransform.from_rotation(
        Rotation.from_rotvec(np.deg2rad(degrees) * axis / np.linalg.norm(axis))
    )
    perturbed = replace(camera, camera_from_world=error_rotation * camera.camera_from_world)
    return Rig([perturbed if c is camera else c for c in rig], rig.unit), camera.name


def exchange_matches(rig: Rig, matches: tuple[Matches, ...], seed: int) -> tuple[list[Matches], set[str]]:
    """Exchange the matches of two cameras; return the matches and the cameras' names."""
    a, b = np.random.default_rng([seed, 6]).choice(len(rig), 2, replace=False).tolist()
    new_matches = list(matches)
    new_matches[a], new_matches[b] = matches[b], matches[a]
    return new_matches, {rig.names[a], rig.names[b]}


def print_cameras_table(scenes: int, lists_scenes: bool) -> None:
    """Print which cameras are reported if one or two of four are faulty."""
    print("| fault | exactly detected | false alarm | status not OK | rotation error, deg: median, 90 % |")
    print("|---|---|---|---|---|")

    def print_row(
        name: str, make: Callable[[int], tuple[Rig, list[Matches], set[str], RigidTransform]], n: int
    ) -> None:
        is_exact, is_false_alarm, is_not_ok, errors = [], [], [], []
        for seed in range(n):
            rig, matches, faulty, truth = make(seed)
            found = estimate_motion(rig, matches)
            named = {text.split(":")[0].removeprefix("camera ") for text in found.faults if text.startswith("camera ")}
            is_exact.append(named == faulty)
            is_false_alarm.append(bool(named - faulty))
            is_not_ok.append(found.status is not Status.OK)
            errors.append(180.0)
            if found.motion is not None:
                errors[-1] = float(np.rad2deg((found.motion.rotation * truth.rotation.inv()).magnitude()))
        cells = [f"{sum(v)} of {n}" for v in (is_exact, is_false_alarm, is_not_ok)]
        print(f"| {name} | {' | '.join(cells)} | {np.median(errors):.2f}, {np.quantile(errors, 0.9):.2f} |", flush=True)
        if lists_scenes:
            print("  missed:", [(s, list(BODIES)[s % 3]) for s in range(n) if not is_exact[s]], flush=True)
            print("  false alarms:", [s for s in range(n) if is_false_alarm[s]], flush=True)

    def rotated_calibration(degrees: float) -> Callable[[int], tuple[Rig, list[Matches], set[str], RigidTransform]]:
        def make(seed: int) -> tuple[Rig, list[Matches], set[str], RigidTransform]:
            rig, pair = simulate_four_cameras(seed)
            perturbed_rig, faulty = rotate_calibration(rig, degrees, seed)
            return perturbed_rig, list(pair.matches), {faulty}, pair.motion

        return make

    def exchanged_videos(seed: int) -> tuple[Rig, list[Matches], set[str], RigidTransform]:
        rig, pair = simulate_four_cameras(seed)
        return rig, *exchange_matches(rig, pair.matches, seed), pair.motion

    def no_fault(seed: int) -> tuple[Rig, list[Matches], set[str], RigidTransform]:
        rig, pair = simulate_four_cameras(seed)
        return rig, list(pair.matches), set(), pair.motion

    for degrees in (10.0, 20.0, 30.0, 45.0):
        print_row(f"calibration off by {degrees:g}°", rotated_calibration(degrees), scenes)
    print_row("two videos exchanged", exchanged_videos, scenes)
    print_row("none", no_fault, 5 * scenes)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--scenes", type=int, default=200, help="per row; --cameras: at most 60, five times as many without fault"
    )
    parser.add_argument("--rows", default="*")
    parser.add_argument("--worst", type=int, default=0, help="number of worst scenes to list per row")
    parser.add_argument("--cameras", action="store_true")
    options = parser.parse_args()
    if options.cameras:
        print_cameras_table(min(options.scenes, 60), options.worst > 0)
        return
    print(
        "| scenes | status | wrong and sure | NEES if OK: mean, trimmed, largest | NEES of the observable part if not OK |\n"
        "|---|---|---|---|---|"
    )
    for name, setting in SETTINGS.items():
        if fnmatch.fnmatchcase(name, options.rows):
            print(f"| {name} | {evaluate_setting(setting, options.scenes, options.worst)} |", flush=True)


if __name__ == "__main__":
    main()
