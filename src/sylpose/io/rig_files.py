"""Rigs of calibration files, for use from Python; the formats are in `io/calibration/`."""

from __future__ import annotations

from pathlib import Path

from sylpose.io import calibration
from sylpose.io.calibration.formats import find_folder_file
from sylpose.rig import Rig


def load_calibration(path: Path | str) -> Rig:
    """Load the cameras of a calibration in any of the supported formats.

    Args:
        path: a calibration file, the folder of a calibration with several files, or a recording's folder, in which the
            calibration is searched by its name.

    Raises:
        OSError: a file that is missing or cannot be read.
        ValueError: naming the file: no calibration, several, or an invalid one; image sizes that the calibration does not
            contain: then `open_session(path).rig` takes them from the videos.
    """
    path = Path(path)
    is_recording = path.is_dir() and find_folder_file(path) is None
    return calibration.load(calibration.find(path) if is_recording else path)
