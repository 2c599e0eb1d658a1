"""Scenes that are hard for `estimate_motion`: is it ever wrong and sure of it, and do its covariances hold?

    python benchmarks/robust_pairs.py [--scenes 200] [--rows "slide*"] [--worst 3] [--cameras]

Flat objects and cameras close together, second motions of 40 %, standing backgrounds behind an object that hardly moves,
slides with a turn of next to nothing, thin boxes. Of each row:

- how many scenes had which status;
- *wrong and sure*: those whose turn is off by more than 3 degrees and more than five of its standard deviations, or that say
  NO_MOTION with an information that excludes the object's motion. Statuses that say that the motion is a guess (AMBIGUOUS,
  MIXED, MOSTLY_STILL) are not sure;
- NEES where the status is OK: mean (6 is right), mean without the worst hundredth, largest;
- NEES where a part is not seen, that part left out, scaled to six degrees of freedom: mean, largest.

What is asked of a pose is asked of the answer that is given, whatever explains the matches as well. `--cameras`: instead,
cameras at fault among four: calibrations turned about any axis, two videos exchanged, and rigs without a fault.
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
from sylpose.geometry.matrices import forget
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
# Degrees and standard deviations beyond which an answer is wrong and sure of it.
WRONG_DEG, WRONG_SIGMAS = 3.0, 5.0
# Statuses whose motion is a guess, with a covariance that means nothing.
SAYS_SO = (Status.AMBIGUOUS, Status.MIXED, Status.MOSTLY_STILL)


class Setting(NamedTuple):
    """What the scenes of one row are like; `moves_px`: the median displacement of the object's points, in place of `shift`
    and `turn`, whose ratio is kept."""

    rig: Rig
    body: Body = ELLIPSOID
    turn: float = 5.0
    shift: float = 0.03
    outliers: float = 0.0
    kind: str = "uniform"
    moves_px: float = 0.0
    matches: int = 60
    noise_px: float = 0.5


def _zigzag(n: int) -> Rig:
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
    "ellipsoid, 3 cameras 3 apart, turn 1": Setting(arc(3, 3), turn=1.0, shift=0.006),
    "ellipsoid, 2 cameras 10 apart, 6 m, turn 5": Setting(arc(2, 10, 6.0, 4000.0)),
    "ellipsoid, 2 cameras 2 apart, 6 m, turn 5": Setting(arc(2, 2, 6.0, 4000.0)),
    "second motion 40 %, dome": Setting(dome(4), outliers=0.4, kind="second_motion"),
    "second motion 40 %, ring": Setting(ring(4), outliers=0.4, kind="second_motion"),
    "second motion 40 %, two cameras": Setting(arc(2, 60), outliers=0.4, kind="second_motion"),
    "second motion 40 %, turn 2": Setting(_zigzag(4), turn=2.0, shift=0.01, outliers=0.4, kind="second_motion"),
    "second motion 40 %, turn 10": Setting(_zigzag(4), turn=10.0, outliers=0.4, kind="second_motion"),
    "second motion 48 %": Setting(_zigzag(4), turn=8.0, outliers=0.48, kind="second_motion"),
    "static 40 %, dome": Setting(dome(4), outliers=0.4, kind="static"),
    "static 40 %, ring": Setting(ring(4), outliers=0.4, kind="static"),
    "static 70 %": Setting(_zigzag(4), outliers=0.7, kind="static"),
    **{
        f"static {share} %, moves {px} px": Setting(_zigzag(4), outliers=share / 100, kind="static", moves_px=px)
        for share in (30, 60, 80)
        for px in (1, 2, 4)
    },
    **{
        f"static 60 %, moves {px} px, 3 cameras 20 apart": Setting(arc(3, 20), outliers=0.6, kind="static", moves_px=px)
        for px in (1, 2, 4)
    },
    "static 60 %, moves 2 px, 300 matches": Setting(_zigzag(4), outliers=0.6, kind="static", moves_px=2, matches=300),
    **{f"before nothing, moves {px} px": Setting(_zigzag(4), moves_px=px) for px in (1, 2, 4)},
    "before nothing, moves 1 px, 3 cameras 20 apart": Setting(arc(3, 20), moves_px=1),
    **{f"stands still, {n} matches": Setting(_zigzag(4), turn=0.0, shift=0.0, matches=n) for n in (20, 60, 300)},
    **{
        f"slide{where}, turn {turn}": Setting(rig, turn=turn, shift=0.03)
        for where, rig in (("", _zigzag(4)), (" 3 cameras 20 apart", arc(3, 20)))
        for turn in (0.0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0)
    },
    **{f"slide of a board, turn {turn}": Setting(_zigzag(4), plane(), turn, 0.03) for turn in (0.0, 0.1, 0.3, 0.5)},
    **{f"slide of a box, turn {turn}": Setting(_zigzag(4), BODIES["box"], turn, 0.03) for turn in (0.0, 0.1, 0.3, 0.5)},
    "slide of 1 px": Setting(_zigzag(4), turn=0.0, moves_px=1),
    "slide of 3 px": Setting(_zigzag(4), turn=0.0, moves_px=3),
    "thin box, turn 10": Setting(_zigzag(4), box((0.6, 0.01, 0.01)), 10.0, 0.02),
    "thin box, turn 4": Setting(_zigzag(4), box((0.6, 0.01, 0.01)), 4.0, 0.02),
    "flat bar, turn 10": Setting(_zigzag(4), box((0.6, 0.06, 0.002)), 10.0, 0.02),
}


def scene(setting: Setting, seed: int) -> tuple[SimulatedPair, Rig]:
    """One scene of a row."""
    rng = np.random.default_rng(seed)
    motion = random_motion(setting.turn, setting.shift, rng)
    start = RigidTransform.from_rotation(Rotation.random(rng=rng))
    if setting.moves_px:
        motion = _of_px(setting, motion, start)
    pair = simulate_matches(
        setting.rig,
        setting.body,
        motion,
        rng=rng,
        per_camera=setting.matches,
        noise_px=setting.noise_px,
        outliers=setting.outliers,
        outlier_kind=setting.kind,  # type: ignore[arg-type]
        start=start,
    )
    return pair, setting.rig


def _of_px(setting: Setting, motion: RigidTransform, start: RigidTransform) -> RigidTransform:
    """A part of a motion that moves the body's points by so many pixels, in the median."""
    points = start.apply(np.array(setting.body.points))
    part, turn = 1.0, motion.rotation.as_rotvec()
    for _ in range(3):
        moved = RigidTransform.from_components(part * motion.translation, Rotation.from_rotvec(part * turn))
        far = [np.linalg.norm(c.project(moved.apply(points)) - c.project(points), axis=1) for c in setting.rig]
        part *= setting.moves_px / float(np.median(np.concatenate(far)))
    return RigidTransform.from_components(part * motion.translation, Rotation.from_rotvec(part * turn))


class Outcome(NamedTuple):
    """What came of a scene: NEES in units of six degrees of freedom, NaN without a pose."""

    status: Status
    nees: float
    degrees: float
    wrong: bool


def outcome(found: Motion, truth: RigidTransform) -> Outcome:
    """Of one scene."""
    if found.motion is None or found.status in SAYS_SO or len(found.unseen) == 6:
        return Outcome(found.status, np.nan, np.nan, False)
    turn = (truth.rotation * found.motion.rotation.inv()).as_rotvec()
    error = np.concatenate([turn, truth.apply(found.center) - found.motion.apply(found.center)])
    information = found.information
    for row in found.unseen:
        information = forget(information, row)
    squares = float(error @ information @ error) * 6.0 / (6 - len(found.unseen))
    # The turn's own information, the displacement eliminated.
    there = information[:3, :3] - information[:3, 3:] @ np.linalg.pinv(information[3:, 3:]) @ information[3:, :3]
    degrees = float(np.rad2deg(np.linalg.norm(turn)))
    wrong = degrees > WRONG_DEG and float(turn @ there @ turn) > WRONG_SIGMAS**2
    if found.status is Status.NO_MOTION:
        wrong = squares > 6.0 * WRONG_SIGMAS
    return Outcome(found.status, squares, degrees, wrong)


def study(setting: Setting, scenes: int, worst: int) -> str:
    """One line of the table."""
    outcomes = []
    for seed in range(scenes):
        pair, rig = scene(setting, seed)
        outcomes.append(outcome(estimate_motion(rig, pair.matches), pair.motion))
    counts = Counter(o.status.name for o in outcomes)
    said = ", ".join(f"{name} {n}" for name, n in counts.most_common())
    cells = [said, str(sum(o.wrong for o in outcomes))]
    for ok in (True, False):
        values = np.sort([o.nees for o in outcomes if (o.status is Status.OK) == ok and np.isfinite(o.nees)])
        if len(values):
            trimmed = values[: max(1, int(0.99 * len(values)))].mean()
            cells.append(f"{values.mean():.1f}, {trimmed:.1f}, {values[-1]:.0f}")
        else:
            cells.append("-")
    for seed in np.argsort([-o.nees if np.isfinite(o.nees) else 0.0 for o in outcomes])[:worst]:
        o = outcomes[seed]
        cells.append(f"\n    seed {seed}: {o.status.name}, {o.degrees:.2f} degrees, NEES {o.nees:.0f}")
    return " | ".join(cells)


# --- cameras at fault among four --------------------------------------------------------------------------------------


def of_four(seed: int) -> tuple[Rig, SimulatedPair]:
    """Four cameras around a body, or above it, that turns by 3 to 10 degrees."""
    rng = np.random.default_rng([seed, 4])
    rig = (_zigzag(4), dome(4))[seed // 3 % 2]
    body = list(BODIES.values())[seed % 3]
    while True:
        motion = random_motion(rng.uniform(3.0, 10.0), 0.02, rng)
        pair = simulate_matches(
            rig, body, motion, rng=rng, start=RigidTransform.from_rotation(Rotation.random(rng=rng))
        )
        # Of a camera that sees a board edge-on nothing is known, and nothing said.
        if min(len(m) for m in pair.matches) >= 30:
            return rig, pair


def turned(rig: Rig, degrees: float, seed: int) -> tuple[Rig, str]:
    """The rig with one camera's calibration turned about any axis, and its name."""
    rng = np.random.default_rng([seed, 5])
    axis, bad = rng.standard_normal(3), rig.cameras[seed % len(rig)]
    turn = RigidTransform.from_rotation(Rotation.from_rotvec(np.deg2rad(degrees) * axis / np.linalg.norm(axis)))
    wrong = replace(bad, camera_from_world=turn * bad.camera_from_world)
    return Rig([wrong if c is bad else c for c in rig], rig.unit), bad.name


def exchanged(rig: Rig, matches: tuple[Matches, ...], seed: int) -> tuple[list[Matches], set[str]]:
    """The matches with those of two cameras exchanged, and their names."""
    a, b = np.random.default_rng([seed, 6]).choice(len(rig), 2, replace=False).tolist()
    mixed = list(matches)
    mixed[a], mixed[b] = matches[b], matches[a]
    return mixed, {rig.names[a], rig.names[b]}


def cameras_table(scenes: int, by_body: bool) -> None:
    """Who is named, of cameras at fault among four."""
    print("| fault | exactly those named | a good one named | said that they disagree | error, ° (median, 90 %) |")
    print("|---|---|---|---|---|")

    def line(name: str, make: Callable[[int], tuple[Rig, list[Matches], set[str], RigidTransform]], n: int) -> None:
        right, false, said, errors = [], [], [], []
        for seed in range(n):
            rig, matches, bad, truth = make(seed)
            found = estimate_motion(rig, matches)
            named = {text.split(":")[0].removeprefix("camera ") for text in found.faults if text.startswith("camera ")}
            right.append(named == bad)
            false.append(bool(named - bad))
            said.append(found.status is not Status.OK)
            errors.append(180.0)
            if found.motion is not None:
                errors[-1] = float(np.rad2deg((found.motion.rotation * truth.rotation.inv()).magnitude()))
        cells = [f"{sum(v)} of {n}" for v in (right, false, said)]
        print(f"| {name} | {' | '.join(cells)} | {np.median(errors):.2f}, {np.quantile(errors, 0.9):.2f} |", flush=True)
        if by_body:
            print("  missed:", [(s, list(BODIES)[s % 3]) for s in range(n) if not right[s]], flush=True)
            print("  good one named:", [s for s in range(n) if false[s]], flush=True)

    def off(degrees: float) -> Callable[[int], tuple[Rig, list[Matches], set[str], RigidTransform]]:
        def make(seed: int) -> tuple[Rig, list[Matches], set[str], RigidTransform]:
            rig, pair = of_four(seed)
            told, bad = turned(rig, degrees, seed)
            return told, list(pair.matches), {bad}, pair.motion

        return make

    def two(seed: int) -> tuple[Rig, list[Matches], set[str], RigidTransform]:
        rig, pair = of_four(seed)
        return rig, *exchanged(rig, pair.matches, seed), pair.motion

    def none(seed: int) -> tuple[Rig, list[Matches], set[str], RigidTransform]:
        rig, pair = of_four(seed)
        return rig, list(pair.matches), set(), pair.motion

    for degrees in (10.0, 20.0, 30.0, 45.0):
        line(f"calibration off by {degrees:g}°", off(degrees), scenes)
    line("two videos exchanged", two, scenes)
    line("none", none, 5 * scenes)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--scenes", type=int, default=200, help="per row; --cameras: 60, and five times as many without"
    )
    parser.add_argument("--rows", default="*")
    parser.add_argument("--worst", type=int, default=0, help="so many of the worst scenes of each row, too")
    parser.add_argument("--cameras", action="store_true")
    options = parser.parse_args()
    if options.cameras:
        cameras_table(min(options.scenes, 60), options.worst > 0)
        return
    print(
        "| scenes | status | wrong and sure | NEES: mean, trimmed, largest | of what is seen |\n|---|---|---|---|---|"
    )
    for name, setting in SETTINGS.items():
        if fnmatch.fnmatchcase(name, options.rows):
            print(f"| {name} | {study(setting, options.scenes, options.worst)} |", flush=True)


if __name__ == "__main__":
    main()
