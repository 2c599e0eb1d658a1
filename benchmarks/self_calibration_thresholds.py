"""Thresholds of `rig_calibration/relative_motions.py` at half and twice, on tracks kept by `benchmarks/self_calibration.py`.

    python benchmarks/self_calibration.py --small --seeds 2 --keep FOLDER
    python benchmarks/self_calibration_thresholds.py FOLDER

Prints, for the extrinsics before the joint refinement: recordings that are accepted, of those that determine the rig and
of those that do not, cameras left out of the former, and those started more than 5 degrees off, from which the joint
refinement may not recover.
"""

from __future__ import annotations

import argparse
import pickle
from pathlib import Path

import numpy as np

from benchmarks.self_calibration import Tracked
from benchmarks.self_calibration_scenes import SMALL_KINDS
from sylpose.rig_calibration import relative_motions
from sylpose.rig_calibration.instants import synchronize_tracks
from sylpose.rig_calibration.relative_motions import MotionRefusedError, solve_relative_extrinsics

NAMES = (
    "MIN_AXIS_SPREAD",
    "RELATIVE_ANGLE_TOLERANCE",
    "ANGLE_SDS",
    "MIN_AGREEING",
    "MIN_COMMON_FRAMES",
    "MIN_ROTATION_SDS",
    "MIN_PAIRS",
    "MAX_CLOSURE",
    "MAX_REVERSAL_RATIO",
    "MAX_SCALE_SD",
    "MAX_SHIFT",
    "MAX_SHIFT_RATIO",
)
FAR_DEG = 5.0


def count(recordings: list[tuple[str, Tracked]]) -> list[int]:
    """Count sound and void recordings accepted, cameras left out of the former, and cameras started far off."""
    sound, void, left_out, far = 0, 0, 0, 0
    for expected, (truth, cameras, tracks, _) in recordings:
        given = [(camera.name, its) for camera, its in zip(cameras, tracks, strict=True) if its is not None]
        try:
            own = [its.track for its in synchronize_tracks([its for _, its in given])]
            # Passed as an argument, whose default does not follow the module's constant.
            found = solve_relative_extrinsics(own, min_agreeing=relative_motions.MIN_AGREEING)
        except MotionRefusedError:
            continue
        sound, void = sound + (expected != "refused"), void + (expected == "refused")
        left_out += len(found.left_out) if expected != "refused" else 0
        poses = [truth[given[c][0]].camera_from_world for c in found.cameras]
        errors = [
            (X.rotation * (pose * poses[0].inv()).rotation.inv()).magnitude()
            for X, pose in zip(found.camera_from_reference, poses, strict=True)
        ]
        far += int((np.degrees(errors) > FAR_DEG).sum())
    return [sound, void, left_out, far]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=int, default=2)
    args = parser.parse_args()
    recordings: list[tuple[str, Tracked]] = []
    for name, kind in SMALL_KINDS.items():
        for seed in range(args.seeds):
            kept: Tracked = pickle.loads((args.folder / f"small_{name}_{seed}.pkl").read_bytes())
            recordings.append((kind.expected, kept))
    print("threshold                   accepted  void ones  left out  far off")
    base = count(recordings)
    print(f"{'as they are':28}" + "".join(f"{number:8d}" for number in base), flush=True)
    for name in NAMES:
        value = getattr(relative_motions, name)
        for label, factor in (("half", 0.5), ("twice", 2.0)):
            setattr(relative_motions, name, type(value)(factor * value))
            numbers = count(recordings)
            text = "the same" if numbers == base else "".join(f"{number:8d}" for number in numbers)
            print(f"{name + ', ' + label:28}{text}", flush=True)
        setattr(relative_motions, name, value)


if __name__ == "__main__":
    main()
