"""Extrinsics of rigs that calibrate themselves from a tumbling object: rendered, seeded recordings with known truth.

    python benchmarks/self_calibration.py [--kinds KIND ...] [--seeds N] [--first N] [--keep FOLDER]

Prints for each recording the errors of the worst camera in degrees and in percent of the distance to the object (after
fitting the scale), its stated standard deviations, the largest error of any component in standard deviations, and what
was left out or refused; then for each kind the share of accepted recordings, of cameras within three standard deviations,
and the mean of squared errors over variances; and at last what matters over all: accepted rigs beyond a degree, sound
recordings that were refused, motions that were accepted though they do not determine
the rig. Kinds `small/...` have small images and few frames.
"""

from __future__ import annotations

import argparse
import pickle
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.self_calibration_scenes import KINDS, Kind, list_kinds, make_scene, track_scene
from sylpose.rig import Camera, Rig
from sylpose.rig_calibration.camera_tracks import RefinedTrack
from sylpose.rig_calibration.from_motion import MotionCalibration, calibrate_from_motion
from sylpose.rig_calibration.relative_motions import MotionRefusedError
from sylpose.runs.precompile import compile_all

__all__ = ["KINDS", "Kind", "make_scene"]

# Rotation errors beyond which an accepted rig is wrong, degrees; standard deviations within which errors must be.
WRONG_DEG, SOUND_SDS = 1.0, 3.0


@dataclass(frozen=True, eq=False)
class Outcome:
    """Outcome of one recording.

    Attributes:
        name, kind: of the recording's kind.
        refusal: the test that failed, with its value; "" if the rig was accepted.
        errors: (C - 1, 6) as of `measure_errors`.
        remark: noise of the cameras together, those left out, what was estimated.
    """

    name: str
    kind: Kind
    refusal: str
    errors: np.ndarray
    remark: str

    @property
    def is_wrong(self) -> bool:
        """Whether the rig was accepted with errors beyond a degree."""
        return not self.refusal and bool(self.errors[:, 0].max() > WRONG_DEG)

    @property
    def contradicts(self) -> bool:
        """Whether acceptance contradicts the kind's expectation."""
        return self.kind.expected != "either" and bool(self.refusal) != (self.kind.expected == "refused")


Tracked = tuple[Rig, list[Camera], list[RefinedTrack | None], float]


def load_tracks(name: str, kind: Kind, seed: int, folder: Path | None) -> Tracked:
    """Return `track_scene`, kept in a folder as pickle files for later runs."""
    if folder is None:
        return track_scene(kind, seed)
    file = folder / f"{name.replace('/', '_')}_{seed}.pkl"
    if not file.exists():
        folder.mkdir(parents=True, exist_ok=True)
        file.write_bytes(pickle.dumps(track_scene(kind, seed)))
    kept: Tracked = pickle.loads(file.read_bytes())
    return kept


def measure_errors(found: MotionCalibration, truth: Rig, distance: float) -> np.ndarray:
    """Return (C - 1, 6) errors of all cameras but the first.

    Degrees and their standard deviation, percent and theirs, the worst component in standard deviations, mean square.
    """
    rig, first = found.calibration.rig, truth[found.calibration.rig[0].name].camera_from_world
    true_poses = [truth[camera.name].camera_from_world * first.inv() for camera in rig]
    expected, centers = np.array([p.inv().translation for p in true_poses]), np.array([c.center for c in rig])
    scale = (expected * centers).sum() / (centers**2).sum()
    rows = []
    for c in range(1, len(rig)):
        covariance, R = found.calibration.extrinsics_covariance[c], rig[c].rotation
        w = (true_poses[c].rotation * rig[c].camera_from_world.rotation.inv()).as_rotvec()
        d = true_poses[c].translation / scale - rig[c].camera_from_world.translation
        # Rotations and translations of camera_from_world go together; of its center, only places count.
        J = np.hstack([-R.T @ np.cross(np.eye(3), rig[c].camera_from_world.translation), -R.T])
        place, place_covariance = expected[c] / scale - centers[c], J @ covariance @ J.T
        z = np.abs(np.concatenate([w, d])) / np.sqrt(np.diag(covariance))
        sds = np.sqrt(np.trace(covariance[:3, :3])), np.sqrt(np.trace(place_covariance))
        share = 100.0 * scale / distance
        rotation = np.degrees(np.linalg.norm(w)), np.degrees(sds[0])
        rows.append([*rotation, share * np.linalg.norm(place), share * sds[1], z.max(), (z**2).mean()])
    return np.array(rows)


def run_recording(name: str, kind: Kind, tracked: Tracked) -> Outcome:
    """Calibrate from tracks and compare with the truth."""
    truth, cameras, tracks, distance = tracked
    try:
        found = calibrate_from_motion(cameras, tracks, kind.free)
    except MotionRefusedError as error:
        return Outcome(name, kind, f"{error.tests[-1].name}, {error.tests[-1].value}", np.zeros((0, 6)), "")
    noise = next(test.value.split()[0] for test in found.tests if test.name.startswith("noise"))
    estimated = ["instants" for warning in found.calibration.warnings if "instants" in warning]
    remark = "; ".join([f"noise {noise}", *found.left_out, *found.freed, *estimated])
    return Outcome(name, kind, "", measure_errors(found, truth, distance), remark)


def format_outcome(outcome: Outcome) -> str:
    """Format the worst camera, and what contradicts the expectation."""
    mark = "WRONG " if outcome.is_wrong else "UNEXPECTED " if outcome.contradicts else ""
    if outcome.refusal:
        return "      -      -         -      -        -  " + f"{mark}refused: {outcome.refusal}"
    worst = outcome.errors.max(axis=0)
    numbers = f"{worst[0]:7.3f}{worst[1]:7.3f}{worst[2]:10.3f}{worst[3]:7.3f}{worst[4]:9.1f}  "
    return numbers + mark + outcome.remark


def summarize(outcomes: list[Outcome]) -> str:
    """Summarize outcomes: acceptance, honesty, contradictions."""
    accepted = [outcome for outcome in outcomes if not outcome.refusal]
    parts = [f"{len(accepted)} of {len(outcomes)} accepted"]
    if accepted:
        z = np.concatenate([outcome.errors[:, 4] for outcome in accepted])
        parts.append(f"{np.mean(z < SOUND_SDS):.1%} of {len(z)} cameras within {SOUND_SDS:g} sd")
        squares = np.concatenate([outcome.errors[:, 5] for outcome in accepted])
        parts.append(f"squared errors over variances {squares.mean():.2f}")
    parts.append(f"{sum(outcome.is_wrong for outcome in outcomes)} beyond {WRONG_DEG:g} degree")
    sound = [outcome for outcome in outcomes if outcome.kind.expected == "accepted"]
    parts.append(f"{sum(bool(outcome.refusal) for outcome in sound)} of {len(sound)} sound ones refused")
    void = [outcome for outcome in outcomes if outcome.kind.expected == "refused"]
    parts.append(f"{sum(not outcome.refusal for outcome in void)} of {len(void)} undetermined ones accepted")
    return ", ".join(parts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="+", choices=[*list_kinds(())], default=[*KINDS])
    parser.add_argument("--small", action="store_true", help="all kinds of small images")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="keep tracks in this folder and use those that are there")
    args = parser.parse_args()
    kinds = list_kinds([name for name in list_kinds(()) if name.startswith("small/")] if args.small else args.kinds)
    compile_all()
    width = max(len(name) for name in kinds) + 4
    print(f"{'recording':{width}}degrees     sd   percent     sd  worst z  remarks")
    outcomes: list[Outcome] = []
    for name, kind in kinds.items():
        began = time.perf_counter()
        for seed in range(args.first, args.first + args.seeds):
            outcomes.append(run_recording(name, kind, load_tracks(name, kind, seed, args.keep)))
            print(f"{name + ':' + str(seed):{width}}{format_outcome(outcomes[-1])}", flush=True)
        seconds = (time.perf_counter() - began) / args.seeds
        print(f"{name}: {summarize(outcomes[-args.seeds :])}; {seconds:.1f} s each", flush=True)
    print(f"all: {summarize(outcomes)}")


if __name__ == "__main__":
    main()
