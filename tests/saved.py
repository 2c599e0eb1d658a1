"""Results of `sylpose track` that the tests read, committed in `saved_results`; `python -m tests.saved` recomputes them.

They answer questions about text, files and objects without a run of half a minute. tests/test_saved.py checks that they
have the present format, and that a new run yields them.
"""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

from sylpose.io.capture import open_session
from sylpose.io.object_files import CLOUD_FILE, OBJECT_FILE
from sylpose.runs.options import RunOptions
from sylpose.runs.run import track_session
from sylpose.runs.run_metadata import SETTINGS, USED_CALIBRATION
from sylpose.simulate import make_demo_scene, write_sequence
from tests.recordings import FIRST, mapping_path, write_box_recording

SAVED = Path(__file__).parent / "saved_results"
# The recording of a box that `tests.recordings` maps first; the first frames of the demo's block.
BOX_RESULT, TURN_RESULT = SAVED / "box", SAVED / "turn"
TRAJECTORIES = ("trajectory.csv", "trajectory.tum")
FILES = {BOX_RESULT: (*TRAJECTORIES, SETTINGS, USED_CALIBRATION, OBJECT_FILE, CLOUD_FILE), TURN_RESULT: TRAJECTORIES}
# Number of frames of the `recording` fixture.
FRAMES = 12


def write_turn_recording(folder: Path, frames: int = FRAMES) -> Path:
    """Render three videos of 12 frames, 320x240: a quarter of a 60 degree rotation; or of fewer."""
    scene = make_demo_scene(frames=4 * FRAMES, angle_deg=60.0, size=(320, 240), n_cameras=3)
    write_sequence(folder, replace(scene, frames=frames), boxes=True)
    return folder


def compute_result(result: Path, folder: Path) -> Path:
    """Render and track the recording of a saved result in a folder, and return the new result."""
    if result == BOX_RESULT:
        write_box_recording(folder, mapping_path, FIRST)
    else:
        write_turn_recording(folder)
    track_session(open_session(folder), options=RunOptions(overlay=False))
    return folder / "sylpose"


def copy_result(result: Path, folder: Path) -> Path:
    """Copy the files of a saved result into a folder, which is created."""
    return Path(shutil.copytree(result, folder))


def main() -> None:
    for result, names in FILES.items():
        with tempfile.TemporaryDirectory() as folder:
            new = compute_result(result, Path(folder))
            result.mkdir(parents=True, exist_ok=True)
            for name in names:
                shutil.copyfile(new / name, result / name)
            if SETTINGS in names:
                text = (new / SETTINGS).read_text(encoding="utf-8")
                (result / SETTINGS).write_text(text.replace(folder, "recording"), encoding="utf-8")


if __name__ == "__main__":
    main()
