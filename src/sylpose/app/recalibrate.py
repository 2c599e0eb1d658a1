"""A calibration refined with the trajectory: which cameras to take for moved, what to say of the rest, and the file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sylpose.adjustment.calibration import Correction
from sylpose.calibration import save
from sylpose.report.disagreement import disagreements
from sylpose.report.files import writing
from sylpose.results import Trajectory
from sylpose.rig import Camera, Rig

__all__ = ["REFINED", "changes", "moved_cameras", "write_refined"]

# The refined calibration's file.
REFINED = "calibration.refined.toml"
# What moved by less than so many standard deviations has not been shown to move (choice: one in some hundred).
SHOWN = 3.0
# What is known no better than this share of what was believed before, this recording does not tell (choice).
UNTOLD = 0.7
# A camera that disagrees within so many frames of the first has a wrong calibration; it was not moved (choice).
SETTLING = 5


def moved_cameras(trajectory: Trajectory) -> dict[int, int]:
    """Cameras that were moved, and from which frame on, both by their place; each once, and not all of them.

    They are those that disagree with the others from some frame on.
    """
    names, place = trajectory.camera_names, {frame.index: k for k, frame in enumerate(trajectory)}
    found: dict[int, int] = {}
    for one in disagreements(trajectory):
        if place[one.first] >= SETTLING:
            found.setdefault(names.index(one.camera), place[one.first])
    return found if len(found) < len(names) - 1 else {}


def changes(correction: Correction, rig: Rig) -> list[str]:
    """A sentence for each camera of the correction: what is off, by how much, and what the recording does not tell."""
    return [_change(camera, correction, c, rig.unit) for c, camera in enumerate(correction.rig)]


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


def write_refined(folder: Path, correction: Correction, names: Sequence[str]) -> Path:
    """The corrected rig; of a camera that was moved, where it stood at first. Returns the file.

    Raises:
        OSError: that cannot be written.
    """
    path = folder / REFINED
    with writing(path):
        save(correction.rig.subset(names), path)
    return path
