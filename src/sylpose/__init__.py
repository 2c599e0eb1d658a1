"""sylpose: measure how a rigid object moves in 3D from the videos of several calibrated cameras.

    from sylpose import open_session, track

    session = open_session("recording")
    for frame in track(session.frames(), session.rig, session.boxes):
        print(frame.pose.time, frame.pose.status.text, frame.pose.world_from_object)

The root modules define the data: rigs of cameras, frame sets, matches, pair moments, results. Each folder is one
operation on them. `sylvester` implements Chen and Schonfeld: a rotation from orthographic second moments by Sylvester's
equation, with one camera, all cameras, or `distributed` among them. `relative_pose` estimates the motion between two
frames in perspective, with six unknowns and outliers. `absolute_pose` estimates the pose of an object with known
points. `features` detects and tracks image points. `landmarks` estimates their positions on the object from frame to
frame. `tracking` combines these frame by frame; `smoothing` refines all frames together afterwards. None of these reads
or writes files: `calibration`, `capture` and `report` do. `simulate` makes scenes with ground truth, `experiments`
repeats the paper's, `commands` has one file for each command. docs/map.md has the whole tree.

`__init__.pyi` lists the public names, also for type checkers. They are imported on first use, so that `import sylpose`
itself is fast.
"""

import ast
from importlib import import_module
from pathlib import Path
from typing import Any

__version__ = "0.2.0"

_STUB = ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
_HOME_OF = {name.name: node.module for node in _STUB.body if isinstance(node, ast.ImportFrom) for name in node.names}
__all__ = sorted(_HOME_OF)


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'sylpose' has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_HOME_OF[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
