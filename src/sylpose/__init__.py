"""sylpose: how a rigid object moves in 3D, from the videos of several calibrated cameras around it.

    from sylpose import open_session, track

    session = open_session("recording")
    for frame in track(session.frames(), session.rig, session.boxes):
        print(frame.pose.time, frame.pose.status.text, frame.pose.world_from_object)

The names below are loaded when they are first used, so that `import sylpose` itself takes no time.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sylpose.app.run import Run, track_session
    from sylpose.capture import Box, FrameSet, Session, open_session
    from sylpose.depth_plane import solve_depth_plane
    from sylpose.equation import solve_generalized_sylvester, solve_sylvester
    from sylpose.features import Matches
    from sylpose.known_depth import solve_2d3d, solve_3d3d
    from sylpose.moments import PairMoments
    from sylpose.motion import estimate_motion, estimate_motions
    from sylpose.network import solve_exchange, solve_gossip, solve_refine
    from sylpose.one_camera import solve_one_camera
    from sylpose.pose import estimate_pose
    from sylpose.results import FramePose, Motion, Status, Trajectory
    from sylpose.rig import Camera, Rig
    from sylpose.sensors import solve_robust
    from sylpose.sylvester import solve_centralized, solve_centralized_batch
    from sylpose.tracking import TrackedFrame, track
    from sylpose.view import trajectory_view, view_of_motion

__version__ = "0.1.0"

__all__ = [
    "Box",
    "Camera",
    "FramePose",
    "FrameSet",
    "Matches",
    "Motion",
    "PairMoments",
    "Rig",
    "Run",
    "Session",
    "Status",
    "TrackedFrame",
    "Trajectory",
    "estimate_motion",
    "estimate_motions",
    "estimate_pose",
    "open_session",
    "solve_2d3d",
    "solve_3d3d",
    "solve_centralized",
    "solve_centralized_batch",
    "solve_depth_plane",
    "solve_exchange",
    "solve_generalized_sylvester",
    "solve_gossip",
    "solve_one_camera",
    "solve_refine",
    "solve_robust",
    "solve_sylvester",
    "track",
    "track_session",
    "trajectory_view",
    "view_of_motion",
]

_HOMES = {
    "sylpose.app.run": ("Run", "track_session"),
    "sylpose.capture": ("Box", "FrameSet", "Session", "open_session"),
    "sylpose.depth_plane": ("solve_depth_plane",),
    "sylpose.equation": ("solve_generalized_sylvester", "solve_sylvester"),
    "sylpose.features": ("Matches",),
    "sylpose.known_depth": ("solve_2d3d", "solve_3d3d"),
    "sylpose.moments": ("PairMoments",),
    "sylpose.motion": ("estimate_motion", "estimate_motions"),
    "sylpose.network": ("solve_exchange", "solve_gossip", "solve_refine"),
    "sylpose.one_camera": ("solve_one_camera",),
    "sylpose.pose": ("estimate_pose",),
    "sylpose.results": ("FramePose", "Motion", "Status", "Trajectory"),
    "sylpose.rig": ("Camera", "Rig"),
    "sylpose.sensors": ("solve_robust",),
    "sylpose.sylvester": ("solve_centralized", "solve_centralized_batch"),
    "sylpose.tracking": ("TrackedFrame", "track"),
    "sylpose.view": ("trajectory_view", "view_of_motion"),
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'sylpose' has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_HOME_OF[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
