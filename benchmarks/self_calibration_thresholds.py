"""Thresholds of the calibration from motion at half and twice, on tracks kept by `benchmarks/self_calibration.py`.

    python benchmarks/self_calibration.py --small --seeds 2 --keep FOLDER
    python benchmarks/self_calibration_thresholds.py FOLDER [--joint]

Prints, for the extrinsics before the joint refinement: recordings that are accepted, of those that determine the rig and
of those that do not, cameras left out of the former, and those started more than 5 degrees off, from which the joint
refinement may not recover. With --joint, for the joint refinement of some kinds: recordings that are accepted, cameras in
them, those beyond three standard deviations, and the mean error in degrees; and for simulated throws and
waving hands of `tests/rig_calibration/test_free_flight.py`: recordings in which flights are found, of those with and
without throws, and the rms error of the scale in percent.
"""

from __future__ import annotations

import argparse
import pickle
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from types import ModuleType

import numpy as np
from scipy.spatial.transform import RigidTransform

from benchmarks.self_calibration import SOUND_SDS, Tracked, measure_errors
from benchmarks.self_calibration_scenes import SMALL_KINDS
from sylpose.geometry.arrays import FloatArray
from sylpose.rig_calibration import free_flight, from_motion, instants, motion_bundle, relative_motions
from sylpose.rig_calibration.from_motion import calibrate_from_motion
from sylpose.rig_calibration.instants import synchronize_tracks
from sylpose.rig_calibration.relative_motions import MotionRefusedError, solve_relative_extrinsics
from sylpose.rig_calibration.result import CalibrationRefusedError
from tests.rig_calibration.test_free_flight import UNIT, throw, wave

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
# Of the joint refinement, with its kinds; and of throws.
JOINT = {
    from_motion: (
        "CLEAR_NOISE_RATIO",
        "MAX_NOISE_RATIO",
        "MIN_INLIER_RATIO",
        "MAX_INSTANT_ROUNDS",
        "NOISE_TOLERANCE",
        "MAX_ROTATION_SD",
        "MAX_PLACE_SD",
    ),
    instants: ("MAX_ITERATIONS",),
    motion_bundle: ("ROTATION_SD", "PLACE_SD", "MAX_ITERATIONS"),
}
JOINT_KINDS = ("wrong", "hardly-seen", "webcams", "blurred")
FLIGHT = (
    "MAX_SECONDS",
    "MAX_STEPS",
    "MAX_NOISE_RATIO",
    "NOISE_QUANTILE",
    "MAX_RELATIVE_SD",
    "SYSTEMATIC",
    "MIN_LOG_ODDS",
)
FAR_DEG = 5.0


def count(recordings: list[tuple[str, Tracked]]) -> list[float]:
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


def count_joint(recordings: list[tuple[str, Tracked]]) -> list[float]:
    """Count accepted recordings, their cameras but the first, and those beyond three sds; return the mean degrees, too."""
    errors = []
    for _, (truth, cameras, tracks, distance) in recordings:
        with suppress(MotionRefusedError):
            errors.append(measure_errors(calibrate_from_motion(cameras, tracks), truth, distance))
    whole = np.concatenate([np.zeros((0, 6)), *errors])
    degrees = float(whole[:, 0].mean()) if len(whole) else np.nan
    return [len(errors), len(whole), int((whole[:, 4] > SOUND_SDS).sum()), degrees]


def count_throws(paths: list[tuple[int, FloatArray, RigidTransform]]) -> list[float]:
    """Count paths with and without throws in which flights are found; return the rms error of the scale, percent, too."""
    found, void, errors = 0, 0, [0.0]
    for n_throws, times, poses in paths:
        with suppress(CalibrationRefusedError):
            scale = free_flight.find_free_flight(times, poses).scale
            found, void = found + (n_throws > 1), void + (n_throws < 2)
            errors.append(100.0 * (scale / UNIT - 1.0))
    return [found, void, float(np.sqrt(np.mean(np.square(errors))))]


def vary(module: ModuleType, names: Sequence[str], measure: Callable[[], list[float]]) -> None:
    """Print a measure with each constant of a module at half and twice."""
    base = measure()
    print(f"{'as they are':28}" + "".join(f"{number:8.3g}" for number in base), flush=True)
    for name in names:
        value = getattr(module, name)
        for label, factor in (("half", 0.5), ("twice", 2.0)):
            setattr(module, name, type(value)(factor * value))
            numbers = measure()
            text = "the same" if numbers == base else "".join(f"{number:8.3g}" for number in numbers)
            print(f"{name + ', ' + label:28}{text}", flush=True)
        setattr(module, name, value)


def load(folder: Path, names: Iterable[str], seeds: int) -> list[tuple[str, Tracked]]:
    """Return recordings with what is expected of them."""
    recordings: list[tuple[str, Tracked]] = []
    for name in names:
        for seed in range(seeds):
            kept: Tracked = pickle.loads((folder / f"small_{name}_{seed}.pkl").read_bytes())
            recordings.append((SMALL_KINDS[name].expected, kept))
    return recordings


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--joint", action="store_true", help="the joint refinement and throws")
    args = parser.parse_args()
    if not args.joint:
        print("threshold                   accepted  void ones  left out  far off")
        whole = load(args.folder, SMALL_KINDS, args.seeds)
        vary(relative_motions, NAMES, lambda: count(whole))
        return
    print("threshold                    found    void  percent")
    paths = [(n, *throw(n, 1.5e-3, seed)) for n in (0, 1, 2, 3, 8) for seed in range(5 * args.seeds)]
    paths += [(0, *wave(seed)) for seed in range(20 * args.seeds)]
    vary(free_flight, FLIGHT, lambda: count_throws(paths))
    print("threshold                 accepted cameras  beyond degrees")
    recordings = load(args.folder, JOINT_KINDS, args.seeds)
    for module, names in JOINT.items():
        vary(module, names, lambda: count_joint(recordings))


if __name__ == "__main__":
    main()
