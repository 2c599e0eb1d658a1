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

The names below are imported on first use, so that `import sylpose` itself is fast.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sylpose.absolute_pose.pose import estimate_pose
    from sylpose.boards.board_pose import BoardObservation, find_board
    from sylpose.boards.specification import Board, parse_board
    from sylpose.frames import Box, FrameSet
    from sylpose.io.calibration.world import World, load_world, world_with_up
    from sylpose.io.capture import Session, Source, Timeline, open_session
    from sylpose.io.capture.frame_assembly import Grab
    from sylpose.io.capture.live import LiveSession, open_live
    from sylpose.io.capture.streams import Device
    from sylpose.io.object_files import load_object, save_object
    from sylpose.matches import Matches
    from sylpose.moments import PairMoments
    from sylpose.packets import NetworkFaults
    from sylpose.relative_pose.motion import estimate_motion, estimate_motions
    from sylpose.report.files import to_dataframe
    from sylpose.report.plots import plot_trajectory
    from sylpose.results import FramePose, Motion, RotationEstimate, Trajectory
    from sylpose.rig import Camera, Rig
    from sylpose.runs.options import RunOptions
    from sylpose.runs.run import track_session
    from sylpose.runs.run_result import Run
    from sylpose.status import FrameStatus, Observability, Status
    from sylpose.sylvester.camera_faults import Diagnosis, Fault, RobustSolution, solve_robust
    from sylpose.sylvester.centralized import (
        CentralizedBatch,
        CentralizedSolution,
        solve_centralized,
        solve_centralized_batch,
    )
    from sylpose.sylvester.depth_plane import DepthPlaneSolution, solve_depth_plane
    from sylpose.sylvester.distributed.solvers import (
        DistributedSolution,
        solve_exchange,
        solve_gossip,
        solve_refine,
    )
    from sylpose.sylvester.equation import SingularSylvesterError, solve_generalized_sylvester, solve_sylvester
    from sylpose.sylvester.known_depth import KnownDepthSolution, solve_2d3d, solve_3d3d
    from sylpose.sylvester.one_camera import OneCameraSolution, solve_one_camera
    from sylpose.tracking.camera_side.frame import DetectedFeatures, LandmarkObservations
    from sylpose.tracking.context import TrackedFrame
    from sylpose.tracking.joint_side.joint_state import Nudge
    from sylpose.tracking.known_object import KnownObject, ObjectFrame
    from sylpose.tracking.tracker import track
    from sylpose.view import MotionView, RotationView, trajectory_view, view_of_motion, view_of_pose, view_of_rotation

__version__ = "0.2.0"

__all__ = [
    "Board",
    "BoardObservation",
    "Box",
    "Camera",
    "CentralizedBatch",
    "CentralizedSolution",
    "DepthPlaneSolution",
    "DetectedFeatures",
    "Device",
    "Diagnosis",
    "DistributedSolution",
    "Fault",
    "FramePose",
    "FrameSet",
    "FrameStatus",
    "Grab",
    "KnownDepthSolution",
    "KnownObject",
    "LandmarkObservations",
    "LiveSession",
    "Matches",
    "Motion",
    "MotionView",
    "NetworkFaults",
    "Nudge",
    "ObjectFrame",
    "Observability",
    "OneCameraSolution",
    "PairMoments",
    "Rig",
    "RobustSolution",
    "RotationEstimate",
    "RotationView",
    "Run",
    "RunOptions",
    "Session",
    "SingularSylvesterError",
    "Source",
    "Status",
    "Timeline",
    "TrackedFrame",
    "Trajectory",
    "World",
    "estimate_motion",
    "estimate_motions",
    "estimate_pose",
    "find_board",
    "load_object",
    "load_world",
    "open_live",
    "open_session",
    "parse_board",
    "plot_trajectory",
    "save_object",
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
    "to_dataframe",
    "track",
    "track_session",
    "trajectory_view",
    "view_of_motion",
    "view_of_pose",
    "view_of_rotation",
    "world_with_up",
]

_HOMES = {
    "sylpose.io.object_files": ("load_object", "save_object"),
    "sylpose.runs.options": ("RunOptions",),
    "sylpose.runs.run": ("track_session",),
    "sylpose.runs.run_result": ("Run",),
    "sylpose.boards.board_pose": ("BoardObservation", "find_board"),
    "sylpose.boards.specification": ("Board", "parse_board"),
    "sylpose.io.calibration.world": ("World", "load_world", "world_with_up"),
    "sylpose.io.capture": ("Session", "Source", "Timeline", "open_session"),
    "sylpose.io.capture.live": ("LiveSession", "open_live"),
    "sylpose.io.capture.frame_assembly": ("Grab",),
    "sylpose.io.capture.streams": ("Device",),
    "sylpose.frames": ("Box", "FrameSet"),
    "sylpose.absolute_pose.pose": ("estimate_pose",),
    "sylpose.matches": ("Matches",),
    "sylpose.moments": ("PairMoments",),
    "sylpose.packets": ("NetworkFaults",),
    "sylpose.sylvester.camera_faults": ("Diagnosis", "Fault", "RobustSolution", "solve_robust"),
    "sylpose.sylvester.centralized": (
        "CentralizedBatch",
        "CentralizedSolution",
        "solve_centralized",
        "solve_centralized_batch",
    ),
    "sylpose.sylvester.depth_plane": ("DepthPlaneSolution", "solve_depth_plane"),
    "sylpose.sylvester.distributed.solvers": (
        "DistributedSolution",
        "solve_exchange",
        "solve_gossip",
        "solve_refine",
    ),
    "sylpose.sylvester.equation": ("SingularSylvesterError", "solve_generalized_sylvester", "solve_sylvester"),
    "sylpose.sylvester.known_depth": ("KnownDepthSolution", "solve_2d3d", "solve_3d3d"),
    "sylpose.sylvester.one_camera": ("OneCameraSolution", "solve_one_camera"),
    "sylpose.report.files": ("to_dataframe",),
    "sylpose.report.plots": ("plot_trajectory",),
    "sylpose.results": ("FramePose", "Motion", "RotationEstimate", "Trajectory"),
    "sylpose.status": ("FrameStatus", "Observability", "Status"),
    "sylpose.rig": ("Camera", "Rig"),
    "sylpose.tracking.joint_side.joint_state": ("Nudge",),
    "sylpose.tracking.known_object": ("KnownObject", "ObjectFrame"),
    "sylpose.tracking.camera_side.frame": ("DetectedFeatures", "LandmarkObservations"),
    "sylpose.tracking.context": ("TrackedFrame",),
    "sylpose.tracking.tracker": ("track",),
    "sylpose.relative_pose.motion": ("estimate_motion", "estimate_motions"),
    "sylpose.view": (
        "MotionView",
        "RotationView",
        "trajectory_view",
        "view_of_motion",
        "view_of_pose",
        "view_of_rotation",
    ),
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'sylpose' has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_HOME_OF[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
