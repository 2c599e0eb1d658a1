"""Nodes of which one lies: are the others harmed?

    python benchmarks/byzantine.py [--seeds 0 1 2 3 4] [--mode exact compact] [--loss 0]

A box turns by 25 degrees before four cameras in 8 frames (320x240); of camera 1's words comes what
`network/fault_injection.py` makes
of them. By kind of lie, over all seeds: the errors of the others, turn and displacement, root mean squares as shares of
those of one process that never had that camera, median and worst; frames that they lost; scenes in which all others say the
same of every frame, to the bit; in which the liar is no member in the end; what they say of it; steps of the network per
frame.
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import replace
from typing import get_args

import numpy as np

from benchmarks.nodes import agree
from sylpose.geometry.arrays import FloatArray
from sylpose.methods import MODES
from sylpose.network.fault_injection import Lie
from sylpose.network.simulation import track_by_nodes
from sylpose.results import FrameStatus
from sylpose.simulate import demo_scene
from sylpose.sylvester.distributed.simulation import Disturbances
from sylpose.tracking.tracked_frame import TrackedFrame
from sylpose.tracking.tracker import track
from tests.clips import SIZE, Clip, errors

LIAR, CAMERAS, FRAMES = 1, 4, 8
HEAD = (
    "| lie | mode | errors: median; worst | lost | all alike | put out | what is said of it | steps per frame |\n"
    + "|---" * 8
    + "|"
)


def rms(found: list[TrackedFrame], clip: Clip) -> FloatArray:
    return np.asarray(np.sqrt(np.nanmean(errors(found, clip.truth) ** 2, axis=0)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=range(5))
    parser.add_argument("--mode", nargs="+", default=MODES, choices=MODES)
    parser.add_argument("--lies", nargs="+", default=get_args(Lie), choices=get_args(Lie))
    parser.add_argument("--loss", type=float, default=0.0)
    asked = parser.parse_args()
    clips, without = [], []
    for seed in asked.seeds:
        clip = Clip.render(demo_scene(frames=FRAMES, turn_deg=25, size=SIZE, n_cameras=CAMERAS, seed=seed))
        rest = [
            replace(f, images=tuple(None if c == LIAR else i for c, i in enumerate(f.images))) for f in clip.frames()
        ]
        clips.append(clip)
        without.append(rms(list(track(rest, clip.rig, clip.boxes)), clip))
    print(HEAD, flush=True)
    for lie in asked.lies:
        for mode in asked.mode:
            ratios, lost, alike, out, steps, said = [], 0, 0, 0, 0, Counter[str]()
            for seed, clip, was in zip(asked.seeds, clips, without, strict=True):
                disturbances = Disturbances(loss=asked.loss, seed=seed)
                outcome = track_by_nodes(
                    clip.frames(), clip.rig, clip.boxes, lies={LIAR: lie}, mode=mode, disturbances=disturbances
                )
                good = [c for c in range(CAMERAS) if c != LIAR]
                first = outcome.frames[good[0]]
                ratios.append(rms(first[:FRAMES], clip) / was)
                lost += sum(f.pose.status is FrameStatus.LOST for f in first)
                alike += agree(outcome, good)
                out += all(LIAR not in outcome.members[c] for c in good)
                said[outcome.refused[good[0]].get(LIAR, "nothing")] += 1
                steps += outcome.steps
            median, worst = np.median(ratios, axis=0), np.max(ratios, axis=0)
            n = len(clips)
            cells = [
                lie,
                mode,
                f"{median[0]:.2f}, {median[1]:.2f}; {worst[0]:.2f}, {worst[1]:.2f}",
                f"{lost} of {n * FRAMES}",
                f"{alike} of {n}",
                f"{out} of {n}",
                said.most_common(1)[0][0],
                f"{steps / (n * FRAMES):.0f}",
            ]
            print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
