"""Calibration refined with the trajectory: detection of moved cameras, descriptions of the changes, and files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.bundle_adjustment.calibration_refinement import CalibrationCorrection, MovedCamera
from sylpose.geometry.arrays import FloatArray
from sylpose.io.calibration import save
from sylpose.report.camera_consistency import find_disagreements
from sylpose.results import Trajectory
from sylpose.rig import Camera, Rig
from sylpose.tracking.joint_side.joint_state import Nudge

# Files of the refined calibration: cameras as they stood at the start and at the end of the recording.
REFINED, REFINED_END = "calibration.refined.toml", "calibration.refined.end.toml"
# Changes below this many standard deviations are not significant (choice: one in some hundred).
MIN_SIGNIFICANCE = 3.0
# A parameter whose posterior sd exceeds this share of its prior sd counts as not observable (choice).
MAX_SD_RATIO = 0.7
# A camera that disagrees within this many frames of the start has a wrong calibration; it was not moved (choice).
N_INITIAL_FRAMES = 5


def find_moved_cameras(trajectory: Trajectory, nudges: Sequence[Nudge]) -> list[MovedCamera]:
    """Return the cameras that start to disagree with the others in the course of a recording.

    Cameras whose motion was already corrected (`nudges`) are excluded: they were also displaced and may disagree.
    The result is empty if too few undisturbed cameras would remain.

    Args:
        trajectory: the tracked trajectory.
        nudges: camera motions corrected during tracking.

    Returns:
        each camera once, with the first frame in which it disagrees.
    """
    names, positions = trajectory.camera_names, {frame.index: k for k, frame in enumerate(trajectory)}
    found, corrected = dict[int, int](), {names[nudge.camera] for nudge in nudges}
    for disagreement in find_disagreements(trajectory):
        if positions[disagreement.first] >= N_INITIAL_FRAMES and disagreement.camera not in corrected:
            found.setdefault(names.index(disagreement.camera), disagreement.first)
    if len(found) + len(corrected) >= len(names) - 1:
        return []
    return [MovedCamera(*disagreement) for disagreement in found.items()]


def describe_changes(correction: CalibrationCorrection, rig: Rig, moved: Sequence[MovedCamera]) -> list[str]:
    """Describe the corrections: a sentence per camera, then one per moved camera.

    Args:
        correction: the refined calibration; each moved camera is an additional camera of it.
        rig: the original rig.
        moved: the moved cameras.

    Returns:
        sentences with each significant change, its uncertainty and the parameters that are not observable.
    """
    sentences = [_describe_change(camera, correction, c, rig.unit) for c, camera in enumerate(rig)]
    return sentences + [_describe_move(rig, correction, len(rig) + i, m) for i, m in enumerate(moved)]


def _describe_move(rig: Rig, correction: CalibrationCorrection, c: int, moved: MovedCamera) -> str:
    values, sd, prior_sd = correction.values[c], correction.sd[c], correction.prior_sd[c]
    rotation = (Rotation.from_rotvec(moved.rotation) * Rotation.from_rotvec(values[:3])).as_rotvec()
    angle, deviation = np.rad2deg(_length_and_sd(rotation, sd[:3]))
    text = f"{rig.names[moved.camera]} was moved at frame {moved.frame}: rotated by {angle:.2f}° ± {deviation:.2f}°"
    if (sd[3:6] > MAX_SD_RATIO * prior_sd[3:6]).all():
        return f"{text}; not observable in this recording: position."
    translation, deviation = _length_and_sd(values[3:6], sd[3:6])
    return f"{text}, translated by {translation:.2g} ± {deviation:.1g} {rig.unit or 'units'}."


def _length_and_sd(vector: FloatArray, sd: FloatArray) -> tuple[float, float]:
    """Return the length of a vector (3,) with standard deviations (3,), and the length's standard deviation."""
    length = float(np.linalg.norm(vector))
    direction = vector / length if length else np.full(3, 3**-0.5)
    return length, float(np.linalg.norm(direction * sd))


def _describe_change(camera: Camera, correction: CalibrationCorrection, c: int, unit: str) -> str:
    values, sd, prior_sd = correction.values[c], correction.sd[c], correction.prior_sd[c]
    rotation, translation = np.rad2deg(np.linalg.norm(values[:3])), float(np.linalg.norm(values[3:6]))
    parts = (
        ("rotation", slice(0, 3), f"rotated by {rotation:.2f}°"),
        ("position", slice(3, 6), f"translated by {translation:.2g} {unit or 'units'}"),
        ("focal length", slice(6, 7), f"focal length {100 * values[6]:+.2f} %"),
        ("principal point", slice(7, 9), f"principal point {np.linalg.norm(values[7:9]):.1f} px"),
        ("distortion", slice(9, 10), f"distortion {values[9]:+.3f}"),
    )
    significant, unobservable = [], []
    for name, which, text in parts:
        observable = sd[which] < MAX_SD_RATIO * prior_sd[which]
        significance = float(np.max(np.abs(values[which]) / np.maximum(sd[which], 1e-300), initial=0.0))
        if observable.any() and significance > MIN_SIGNIFICANCE:
            significant.append(f"{text} ({significance:.0f} standard deviations)")
        elif not observable.any():
            unobservable.append(name)
    sentence = f"{camera.name}: {', '.join(significant) if significant else 'no significant change'}"
    return sentence + (f"; not observable in this recording: {', '.join(unobservable)}" if unobservable else "") + "."


def compute_final_rig(correction: CalibrationCorrection, names: Sequence[str], moved: Sequence[MovedCamera]) -> Rig:
    """Return the corrected rig after all camera motions.

    Includes the rotations by which images were compensated (`MovedCamera.rotation`) during tracking.
    """
    cameras, rotations = list(correction.rig)[: len(names)], [Rotation.identity()] * len(names)
    for m, camera in zip(moved, list(correction.rig)[len(names) :], strict=True):
        rotations[m.camera] = rotations[m.camera] * Rotation.from_rotvec(m.rotation)
        pose = RigidTransform.from_rotation(rotations[m.camera]) * camera.camera_from_world
        cameras[m.camera] = replace(camera, name=names[m.camera], camera_from_world=pose)
    return Rig(cameras, correction.rig.unit)


def write_refined(
    folder: Path, correction: CalibrationCorrection, names: Sequence[str], moved: Sequence[MovedCamera]
) -> list[Path]:
    """Write the corrected rig at the start and, if cameras were moved, at the end; return the files.

    Raises:
        OSError: a file cannot be written.
    """
    rigs = {REFINED: correction.rig.subset(names)}
    if moved:
        rigs[REFINED_END] = compute_final_rig(correction, names, moved)
    for name, rig in rigs.items():
        save(rig, folder / name)
    return [folder / name for name in rigs]
