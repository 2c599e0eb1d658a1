"""The tracker by cameras as nodes, over a simulated network: is it the same, and what does it cost?

    python benchmarks/nodes.py [SCENE ...] [--recordings FOLDER] [--loss 0 0.1] [--mode exact compact]

A scene is KIND:SEED of `benchmarks/kinds.py`, demo:SEED, loop:SEED, or the name of a recording in FOLDER; in each mode, with
each share of messages lost. Columns: the root mean squared errors of the motion since the first frame, against the truth, as
shares of those of one process, turn and displacement; of how many frames the pose is measured, here and there; frames whose
status differs from that of one process, and how far poses are from its, at most (radians, shares of the object's radius);
whether all cameras agree to the bit; rounds per frame, mean; bytes that a camera tells per frame, mean, and those of the
median round, headers included; steps of the network per frame, which are rounds where nothing is lost; bytes that a camera
sends per frame, repetitions included.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.live import error, scene_of
from benchmarks.loops import Turn
from sylpose.geometry.arrays import FloatArray
from sylpose.methods import MODES
from sylpose.network.simulation import Outcome, track_by_nodes
from sylpose.network.wire_format import HEADER
from sylpose.sylvester.distributed.simulation import Disturbances
from sylpose.tracking.tracked_frame import TrackedFrame
from sylpose.tracking.tracker import track

SCENES = ("demo:0", "temple", "board4", "person-behind:0", "jumps-15:0", "nudged:1", "stands-fast:2")


class Difference(NamedTuple):
    """Of two runs: frames whose status differs, and by how much poses do, at most, radians and shares of the radius."""

    statuses: int
    turn: float
    shift: float


def difference(found: Sequence[TrackedFrame], wanted: Sequence[TrackedFrame]) -> Difference:
    statuses, turn, shift = abs(len(found) - len(wanted)), 0.0, 0.0
    for a, b in zip(found, wanted, strict=False):
        statuses += a.pose.status is not b.pose.status
        if a.pose.world_from_object is not None and b.pose.world_from_object is not None:
            one, other = a.pose.world_from_object, b.pose.world_from_object
            turn = max(turn, float((one.rotation * other.rotation.inv()).magnitude()))
            shift = max(shift, float(np.linalg.norm(one.translation - other.translation)) / b.radius)
    return Difference(statuses, turn, shift)


def agree(outcome: Outcome, cameras: Sequence[int]) -> bool:
    """Whether some cameras say the same of every frame, to the bit."""
    first, *others = (outcome.frames[c] for c in cameras)
    return all(len(other) == len(first) and difference(other, first) == (0, 0.0, 0.0) for other in others)


def rms(scene: Turn, found: Sequence[TrackedFrame]) -> FloatArray:
    """(2,) root mean squared errors of the motion since the first frame."""
    first = next(k for k, f in enumerate(found) if f.pose.world_from_object is not None)
    solved = [k for k, f in enumerate(found) if k > first and f.pose.world_from_object is not None]
    errors = [error(scene, first, found[first].pose, k, found[k].pose) for k in solved]
    return np.asarray(np.sqrt(np.mean(np.square(errors), axis=0)))


def measured(found: Sequence[TrackedFrame]) -> int:
    return sum(f.pose.measured for f in found)


def line(name: str, scene: Turn, expected: Sequence[TrackedFrame], mode: str, disturbances: Disturbances) -> str:
    outcome = track_by_nodes(scene.frames, scene.rig, scene.boxes, disturbances=disturbances, mode=mode)
    ratio = rms(scene, outcome.frames[0]) / rms(scene, expected)
    apart, live, n = difference(outcome.frames[0], expected), range(len(scene.rig)), len(scene.frames)
    told = [np.array(outcome.told[c]) + HEADER.size for c in live]
    cells = [
        name,
        f"{len(scene.rig)}, {n}",
        mode,
        f"{disturbances.loss:.0%}",
        f"{ratio[0]:.2f}, {ratio[1]:.2f}",
        f"{measured(outcome.frames[0])}, {measured(expected)}",
        f"{apart.statuses}; {apart.turn:.1e}, {apart.shift:.1e}",
        "yes" if agree(outcome, live) else "no",
        f"{np.mean([len(t) for t in told]) / n:.1f}",
        f"{np.mean([t.sum() for t in told]) / n / 1e3:.1f} kB",
        f"{np.median(np.concatenate(told)):.0f}",
        f"{outcome.steps / n:.1f}",
        f"{outcome.sent.mean() / n / 1e3:.1f} kB",
    ]
    return "| " + " | ".join(cells) + " |"


HEAD = (
    "| scene | cameras, frames | mode | lost | errors | measured | statuses that differ; poses, rad, radii | all alike "
    "| rounds per frame | told per frame | bytes of a round | steps per frame | sent per frame |\n" + "|---" * 13 + "|"
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", default=SCENES)
    parser.add_argument("--recordings", type=Path, default=Path("../shared/data"))
    parser.add_argument("--mode", nargs="+", default=MODES, choices=MODES)
    parser.add_argument("--loss", type=float, nargs="+", default=[0.0, 0.1])
    asked = parser.parse_args()
    print(HEAD, flush=True)
    for name in asked.scenes:
        scene = scene_of(name, asked.recordings)
        expected = list(track(scene.frames, scene.rig, scene.boxes))
        for mode in asked.mode:
            for loss in asked.loss:
                print(line(name, scene, expected, mode, Disturbances(loss=loss, seed=1)), flush=True)


if __name__ == "__main__":
    main()
