"""Effect of one Byzantine node on the others.

    python benchmarks/byzantine.py [--seeds 0 1 2 3 4] [--mode exact compact] [--loss 0]

A box rotates by 25 degrees in front of four cameras in 8 frames (320x240). `tests/network/byzantine_faults.py` alters the
messages of camera 1. The table gives for each kind of fault, over all seeds:

- the RMS errors of the other nodes (rotation, translation), relative to one process without that camera: median; worst;
- the frames that the others lost;
- the scenes in which all others report identical results, to the bit, and in which they excluded the Byzantine node;
- the most frequent reason of the exclusion, and the network steps per frame.
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import replace
from typing import get_args

import numpy as np

from benchmarks.nodes import has_identical_results
from sylpose.geometry.arrays import FloatArray
from sylpose.methods import MODES
from sylpose.network.simulation import track_by_nodes
from sylpose.packets import NetworkFaults
from sylpose.simulate import make_demo_scene
from sylpose.status import FrameStatus
from sylpose.tracking.context import TrackedFrame
from sylpose.tracking.tracker import track
from tests.clips import SIZE, Clip, compute_pose_errors
from tests.network.byzantine_faults import FaultKind, make_fault

BYZANTINE, CAMERAS, FRAMES = 1, 4, 8
TABLE_HEADER = (
    "| fault | mode | relative RMS error: median; worst | lost frames | identical results | excluded | reason "
    "| steps per frame |\n" + "|---" * 8 + "|"
)


def compute_rms(found: list[TrackedFrame], clip: Clip) -> FloatArray:
    return np.asarray(np.sqrt(np.nanmean(compute_pose_errors(found, clip.truth) ** 2, axis=0)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=range(5))
    parser.add_argument("--mode", nargs="+", default=MODES, choices=MODES)
    parser.add_argument("--lies", nargs="+", default=get_args(FaultKind), choices=get_args(FaultKind))
    parser.add_argument("--loss", type=float, default=0.0)
    arguments = parser.parse_args()
    clips, reference_rms = [], []
    for seed in arguments.seeds:
        clip = Clip.render(make_demo_scene(frames=FRAMES, angle_deg=25, size=SIZE, n_cameras=CAMERAS, seed=seed))
        other_frames = [
            replace(f, images=tuple(None if c == BYZANTINE else i for c, i in enumerate(f.images)))
            for f in clip.frames()
        ]
        clips.append(clip)
        reference_rms.append(compute_rms(list(track(other_frames, clip.rig, clip.boxes)), clip))
    print(TABLE_HEADER, flush=True)
    for fault in arguments.lies:
        for mode in arguments.mode:
            ratios, n_lost, n_identical, n_excluded, steps, reasons = [], 0, 0, 0, 0, Counter[str]()
            for seed, clip, reference in zip(arguments.seeds, clips, reference_rms, strict=True):
                network_faults = NetworkFaults(loss=arguments.loss, seed=seed)
                outcome = track_by_nodes(
                    clip.frames(),
                    clip.rig,
                    clip.boxes,
                    faults={BYZANTINE: make_fault(fault, BYZANTINE, CAMERAS, seed)},
                    mode=mode,
                    network_faults=network_faults,
                )
                good = [c for c in range(CAMERAS) if c != BYZANTINE]
                first = outcome.frames[good[0]]
                ratios.append(compute_rms(first[:FRAMES], clip) / reference)
                n_lost += sum(f.pose.status is FrameStatus.LOST for f in first)
                n_identical += has_identical_results(outcome, good)
                n_excluded += all(BYZANTINE not in outcome.members[c] for c in good)
                reasons[outcome.refused[good[0]].get(BYZANTINE, "nothing")] += 1
                steps += outcome.steps
            median, worst = np.median(ratios, axis=0), np.max(ratios, axis=0)
            n = len(clips)
            cells = [
                fault,
                mode,
                f"{median[0]:.2f}, {median[1]:.2f}; {worst[0]:.2f}, {worst[1]:.2f}",
                f"{n_lost} of {n * FRAMES}",
                f"{n_identical} of {n}",
                f"{n_excluded} of {n}",
                reasons.most_common(1)[0][0],
                f"{steps / (n * FRAMES):.0f}",
            ]
            print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
