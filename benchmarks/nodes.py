"""Distributed tracking over a simulated network: agreement with one process, and network traffic.

    python benchmarks/nodes.py [SCENE ...] [--recordings FOLDER] [--loss 0 0.1] [--mode exact compact]

A scene is KIND:SEED of `benchmarks/kinds.py`, demo:SEED, loop:SEED, or the name of a recording in FOLDER. It runs in each
mode and with each share of lost messages. The columns are:

- RMS errors of the motion since the first frame, relative to one process (rotation, translation);
- frames with a measured pose, by nodes and by one process;
- frames whose status differs from one process, and the largest pose differences (radians, object radii);
- whether the results of all cameras are identical to the bit;
- mean rounds per frame, mean bytes per camera and frame, and median bytes of a round, headers included;
- network steps per frame, which equal the rounds without losses, and bytes sent per camera and frame with retransmissions.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.live import compute_error_norms, load_scene
from benchmarks.loops import RenderedSequence
from sylpose.geometry.arrays import FloatArray
from sylpose.methods import MODES
from sylpose.network.simulation import SimulationResult, track_by_nodes
from sylpose.network.wire_format import HEADER
from sylpose.packets import NetworkFaults
from sylpose.tracking.context import TrackedFrame
from sylpose.tracking.tracker import track

SCENES = ("demo:0", "temple", "board4", "person-behind:0", "jumps-15:0", "nudged:1", "stands-fast:2")


class RunDifference(NamedTuple):
    """Difference of two runs: frames whose status differs, and largest pose differences in radians and object radii."""

    n_statuses: int
    rotation: float
    translation: float


def compare_runs(found: Sequence[TrackedFrame], expected: Sequence[TrackedFrame]) -> RunDifference:
    statuses, rotation, translation = abs(len(found) - len(expected)), 0.0, 0.0
    for a, b in zip(found, expected, strict=False):
        statuses += a.pose.status is not b.pose.status
        if a.pose.world_from_object is not None and b.pose.world_from_object is not None:
            one, other = a.pose.world_from_object, b.pose.world_from_object
            rotation = max(rotation, float((one.rotation * other.rotation.inv()).magnitude()))
            translation = max(translation, float(np.linalg.norm(one.translation - other.translation)) / b.radius)
    return RunDifference(statuses, rotation, translation)


def has_identical_results(outcome: SimulationResult, cameras: Sequence[int]) -> bool:
    """Return whether the results of some cameras are identical for every frame, to the bit."""
    first, *others = (outcome.frames[c] for c in cameras)
    return all(len(other) == len(first) and compare_runs(other, first) == (0, 0.0, 0.0) for other in others)


def compute_rms(scene: RenderedSequence, found: Sequence[TrackedFrame]) -> FloatArray:
    """Return the RMS errors (2,) of the motion since the first frame."""
    first = next(k for k, f in enumerate(found) if f.pose.world_from_object is not None)
    solved = [k for k, f in enumerate(found) if k > first and f.pose.world_from_object is not None]
    errors = [compute_error_norms(scene, first, found[first].pose, k, found[k].pose) for k in solved]
    return np.asarray(np.sqrt(np.mean(np.square(errors), axis=0)))


def count_measured(found: Sequence[TrackedFrame]) -> int:
    return sum(f.pose.is_measured for f in found)


def format_row(
    name: str, scene: RenderedSequence, expected: Sequence[TrackedFrame], mode: str, network_faults: NetworkFaults
) -> str:
    outcome = track_by_nodes(scene.frames, scene.rig, scene.boxes, network_faults=network_faults, mode=mode)
    ratio = compute_rms(scene, outcome.frames[0]) / compute_rms(scene, expected)
    run_difference, cameras, n = compare_runs(outcome.frames[0], expected), range(len(scene.rig)), len(scene.frames)
    message_bytes = [np.array(outcome.payload_sizes[c]) + HEADER.size for c in cameras]
    cells = [
        name,
        f"{len(scene.rig)}, {n}",
        mode,
        f"{network_faults.loss:.0%}",
        f"{ratio[0]:.2f}, {ratio[1]:.2f}",
        f"{count_measured(outcome.frames[0])}, {count_measured(expected)}",
        f"{run_difference.n_statuses}; {run_difference.rotation:.1e}, {run_difference.translation:.1e}",
        "yes" if has_identical_results(outcome, cameras) else "no",
        f"{np.mean([len(t) for t in message_bytes]) / n:.1f}",
        f"{np.mean([t.sum() for t in message_bytes]) / n / 1e3:.1f} kB",
        f"{np.median(np.concatenate(message_bytes)):.0f}",
        f"{outcome.steps / n:.1f}",
        f"{outcome.sent.mean() / n / 1e3:.1f} kB",
    ]
    return "| " + " | ".join(cells) + " |"


TABLE_HEADER = (
    "| scene | cameras, frames | mode | loss | relative RMS errors | frames measured | differences: status; rad, radii "
    "| identical results | rounds per frame | payload per frame | bytes per round | steps per frame | sent per frame |\n"
    + "|---" * 13
    + "|"
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", default=SCENES)
    parser.add_argument("--recordings", type=Path, default=Path("../shared/data"))
    parser.add_argument("--mode", nargs="+", default=MODES, choices=MODES)
    parser.add_argument("--loss", type=float, nargs="+", default=[0.0, 0.1])
    arguments = parser.parse_args()
    print(TABLE_HEADER, flush=True)
    for name in arguments.scenes:
        scene = load_scene(name, arguments.recordings)
        expected = list(track(scene.frames, scene.rig, scene.boxes))
        for mode in arguments.mode:
            for loss in arguments.loss:
                print(format_row(name, scene, expected, mode, NetworkFaults(loss=loss, seed=1)), flush=True)


if __name__ == "__main__":
    main()
