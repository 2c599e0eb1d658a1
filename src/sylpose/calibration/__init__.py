"""Calibrations: from the files that people have to a `Rig`, and back.

    rig = calibration.load("session/calibration.toml")
    calibration.save(rig, "session/calibration.yml")

| format | module | what it looks like |
|---|---|---|
| sylpose TOML | `native` | `format = "sylpose-calibration-1"`, `[cameras.NAME]` |
| Anipose TOML | `anipose` | `[cam_0]`, `[cam_1]`, ..., `[metadata]` |
| Caliscope TOML | `caliscope` | `[cameras.0]`, `[cameras.1]`, ... |
| OpenCV FileStorage YAML, JSON, XML | `filestorage` | a node per camera, or a sequence `cameras` |

All of them hold poses `camera_from_world` (docs/conventions.md).
"""

from sylpose.calibration.files import find, format_of, load, save

__all__ = ["find", "format_of", "load", "save"]
