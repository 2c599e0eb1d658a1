"""A calibration refined with the trajectory: which cameras to take for moved, what to say of all, and the files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.bundle_adjustment.calibration_refinement import Correction, Moved
from sylpose.calibration import save
from sylpose.geometry.arrays import FloatArray
from sylpose.report.camera_consistency import disagreements
from sylpose.results import Trajectory
from sylpose.rig import Camera, Rig
from sylpose.tracking.joint_state import Nudge

__all__ = ["REFINED", "REFINED_END", "at_the_end", "changes", "moved_cameras", "write_refined"]

# The refined calibration's files: as the cameras stood at first, and at the end.
REFINED, REFINED_END = "calibration.refined.toml", "calibration.refined.end.toml"
# What moved by less than so many standard deviations has not been shown to move (choice: one in some hundred).
SHOWN = 3.0
# What is known no better than this share of what was believed before, this recording does not tell (choice).
UNTOLD = 0.7
# A camera that disagrees within so many frames of the first has a wrong calibration; it was not moved (choice).
SETTLING = 5


def moved_cameras(trajectory: Trajectory, nudges: Sequence[Nudge]) -> list[Moved]:
    """Cameras that disagree with the others from some frame on, each once, and with those nudged not all of them.

    Without those that were nudged: as they are shifted with it, they may disagree, too.
    """
    names, place = trajectory.camera_names, {frame.index: k for k, frame in enumerate(trajectory)}
    found, known = dict[int, int](), {names[nudge.camera] for nudge in nudges}
    for one in disagreements(trajectory):
        if place[one.first] >= SETTLING and one.camera not in known:
            found.setdefault(names.index(one.camera), one.first)
    return [Moved(*one) for one in found.items()] if len(found) + len(known) < len(names) - 1 else []


def changes(correction: Correction, rig: Rig, moved: Sequence[Moved]) -> list[str]:
    """A sentence for each camera: what is off, by how much, and what the recording does not tell; and where each went that
    was moved, which is a camera more of the correction."""
    said = [_change(camera, correction, c, rig.unit) for c, camera in enumerate(rig)]
    return said + [_move(rig, correction, len(rig) + i, m) for i, m in enumerate(moved)]


def _move(rig: Rig, correction: Correction, c: int, moved: Moved) -> str:
    values, sd, believed = correction.values[c], correction.sd[c], correction.believed[c]
    turn = (Rotation.from_rotvec(moved.turn) * Rotation.from_rotvec(values[:3])).as_rotvec()
    angle, off = np.rad2deg(_length(turn, sd[:3]))
    said = f"{rig.names[moved.camera]} was moved at frame {moved.frame}: turned by {angle:.2f}° ± {off:.2f}°"
    if (sd[3:6] > UNTOLD * believed[3:6]).all():
        return f"{said}; not told by this recording: place."
    shift, off = _length(values[3:6], sd[3:6])
    return f"{said}, shifted by {shift:.2g} ± {off:.1g} {rig.unit or 'units'}."


def _length(vector: FloatArray, sd: FloatArray) -> tuple[float, float]:
    """Of a vector (3,) with standard deviations (3,), and its own standard deviation."""
    length = float(np.linalg.norm(vector))
    along = vector / length if length else np.full(3, 3**-0.5)
    return length, float(np.linalg.norm(along * sd))


def _change(camera: Camera, correction: Correction, c: int, unit: str) -> str:
    values, sd, believed = correction.values[c], correction.sd[c], correction.believed[c]
    turn, shift = np.rad2deg(np.linalg.norm(values[:3])), float(np.linalg.norm(values[3:6]))
    parts = (
        ("turn", slice(0, 3), f"turned by {turn:.2f}°"),
        ("place", slice(3, 6), f"shifted by {shift:.2g} {unit or 'units'}"),
        ("focal length", slice(6, 7), f"focal length {100 * values[6]:+.2f} %"),
        ("principal point", slice(7, 9), f"principal point {np.linalg.norm(values[7:9]):.1f} px"),
        ("distortion", slice(9, 10), f"distortion {values[9]:+.3f}"),
    )
    off, untold = [], []
    for name, which, said in parts:
        known = sd[which] < UNTOLD * believed[which]
        away = float(np.max(np.abs(values[which]) / np.maximum(sd[which], 1e-300), initial=0.0))
        if known.any() and away > SHOWN:
            off.append(f"{said} ({away:.0f} standard deviations)")
        elif not known.any():
            untold.append(name)
    sentence = f"{camera.name}: {', '.join(off) if off else 'nothing shown to be off'}"
    return sentence + (f"; not told by this recording: {', '.join(untold)}" if untold else "") + "."


def at_the_end(correction: Correction, names: Sequence[str], moved: Sequence[Moved]) -> Rig:
    """The corrected rig as it stood after all that was moved: with the turns that images were turned back by."""
    cameras, turns = list(correction.rig)[: len(names)], [Rotation.identity()] * len(names)
    for m, now in zip(moved, list(correction.rig)[len(names) :], strict=True):
        turns[m.camera] = turns[m.camera] * Rotation.from_rotvec(m.turn)
        pose = RigidTransform.from_rotation(turns[m.camera]) * now.camera_from_world
        cameras[m.camera] = replace(now, name=names[m.camera], camera_from_world=pose)
    return Rig(cameras, correction.rig.unit)


def write_refined(folder: Path, correction: Correction, names: Sequence[str], moved: Sequence[Moved]) -> list[Path]:
    """The corrected rig as it stood at first and, if cameras were moved, at the end. Returns the files.

    Raises:
        OSError: one that cannot be written.
    """
    rigs = {REFINED: correction.rig.subset(names)}
    if moved:
        rigs[REFINED_END] = at_the_end(correction, names, moved)
    for name, rig in rigs.items():
        save(rig, folder / name)
    return [folder / name for name in rigs]
