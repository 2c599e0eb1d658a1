"""Wrong and extreme arguments of every public function: an error that names the argument, or a valid result.

A table of valid calls; each argument in turn is replaced by values that it may be mistaken for (`mutations`). A public
function that is not in the table fails the first test.
"""

from __future__ import annotations

import enum
import inspect
import re
import warnings
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

import sylpose
from sylpose import results, rig, simulate, view
from sylpose.bundle_adjustment.calibration_refinement import MovedCamera, default_calibration_prior
from sylpose.results import FramePose, RotationEstimate
from sylpose.smoothing import Track, smooth_tracks
from sylpose.status import FrameStatus, Status
from sylpose.sylvester import camera_faults, one_camera, translation
from sylpose.units import INITIAL_DISTANCES
from tests.mutations import copy_arrays, is_unchanged, mutations

# Largest number of mutations per argument; slow functions have fewer, chosen by the seed.
MAX_MUTATIONS, SEED = 60, 0
# As many in the quick suite.
QUICK_MUTATIONS = 12
# In addition to `sylpose.__all__`.
MORE: tuple[Any, ...] = (
    camera_faults.diagnose_cameras,
    camera_faults.find_faulty_cameras,
    translation.solve_translation_from_means,
    translation.refine_translation,
    one_camera.solve_unconstrained,
    results.pan_tilt_roll,
    rig.make_look_at_camera,
    smooth_tracks,
    rig.intersect_rays,
    view.resolve_viewpoint,
    *(getattr(simulate, name) for name in simulate.__all__ if inspect.isfunction(getattr(simulate, name))),
)
# Functions that are not called here, with the reason.
NOT_CALLED = {
    "open_session": "reads files: test_fuzz_readers.py, calibration/, capture/",
    "open_live": "the same",
    "calibrate_session": "the same: rig_calibration/test_calibrate_command.py",
    "self_calibrate": "tracks a recording: commands/test_self_calibration.py",
    "calibrate_from_boards": "takes seconds: rig_calibration/test_from_boards.py",
    "track_session": "the same; its options: commands/",
    "load_object": "reads a file: commands/test_object_files.py",
    "save_object": "writes it: the same",
    "load_calibration": "reads a file: io/test_rig_files.py",
    "load_trajectory": "the same: report/test_files.py",
    "save_trajectory": "writes it: the same",
    "smooth": "takes what the tracker yields: tests/test_smoothing.py",
    "Session.frames": "the same",
    "Session.frames_at": "the same: io/capture/test_random_access.py",
    "Session.select_cameras": "the same",
    "Session.select_object": "the same",
    "Session.with_boxes": "the same",
    "Session.with_rig": "the same",
    "Session.without_static_masks": "no arguments",
    "Session.with_world": "the same",
    "load_world": "reads a file: io/calibration/test_world.py",
    "LiveSession.frames": "the same",
    "plot_trajectory": "draws, which takes a second: test_display.py",
    "to_dataframe": "needs pandas: io/exports/test_exports.py",
    "LiveSession.select_object": "the same",
    "LiveSession.with_boxes": "the same",
    "LiveSession.with_rig": "the same",
    "LiveSession.with_world": "the same",
    "LiveSession.stop": "no arguments",
    "Mesh.largest_part": "no arguments: test_mesh.py",
    "Trajectory.differentiate": "no arguments: test_kinematics.py",
    "Source.frame_number": "looked up in a table of a folder's files",
    "make_demo_scene": "the demo's, writes a recording",
    "compute_demo_truth": "the same",
    "render_frames": "images of seconds each: simulate/",
    "write_sequence": "the same",
    "chamfered_box": "the same",
}


class Call(NamedTuple):
    """A valid call.

    Attributes:
        max_mutations: number of mutations per argument.
        nan: whether NaN is a valid result, or may be passed through from the input.
        message_pattern: regular expression for error messages that do not contain an argument's name.
    """

    function: Callable[..., Any]
    arguments: dict[str, Any]
    max_mutations: int = MAX_MUTATIONS
    nan: bool = False
    message_pattern: str = r"\bno camera has\b|\bno points\b"


@cache
def calls() -> dict[str, Call]:
    """Return the valid calls by name."""
    three = simulate.ring(3)
    body = simulate.ellipsoid(n=400)
    motion = simulate.random_motion(8.0, 0.02, np.random.default_rng(1), axis=[0.3, 1.0, 0.2])
    pair = simulate.simulate_matches(three, body, motion, rng=np.random.default_rng(0), per_camera=25)
    matches = list(pair.matches)
    Q = np.array([camera.rotation for camera in three])
    o = np.array([camera.center for camera in three])
    moments = [sylpose.PairMoments.from_matches(m.x, m.y) for m in matches]
    R, center = motion.rotation.as_matrix(), np.array([0.01, 0.02, 0.03])
    camera = three.cameras[0]
    points = body.points[:12].copy()
    pixels = camera.project(points)
    found = sylpose.estimate_motion(three, matches)
    turned = sylpose.solve_centralized(Q, moments)
    seen = [body.points[:9].copy() for _ in three]
    pose = FramePose(0, 0.5, FrameStatus.TRACKED, motion, 0.01 * np.eye(6), np.ones(3, np.int64), np.ones(3))
    path = sylpose.Trajectory([pose, pose], three.names, "m")
    eye, square = np.eye(3), np.array([[2.0, 1.0, 0.0], [0.0, 3.0, 1.0], [1.0, 0.0, 4.0]])
    of_rig = {"rotations": Q, "moments": moments, "aim": True}
    graph = [(0, 1), (1, 2)]
    frames = [sylpose.FrameSet(k, k / 30, (None,), (np.full((48, 64, 3), 9 * k, np.uint8),), (None,)) for k in range(2)]
    small = simulate.ring(1, size=(64, 48), focal=60.0)
    facing = simulate.ring(3, size=(64, 48), focal=60.0)
    disc = np.hypot(*(np.indices((48, 64)) - np.array([24, 32]).reshape(2, 1, 1))) < 9
    masked = [sylpose.FrameSet.of([np.full((48, 64, 3), 90, np.uint8)] * 3, k / 30, [disc] * 3) for k in range(2)]
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    seeded = np.random.default_rng
    wide = {"radius": 1.5, "focal": 1000.0, "size": (640, 480), "target": np.zeros(3), "distortion": np.zeros(5)}
    return {
        "estimate_motion": Call(
            sylpose.estimate_motion,
            {
                "rig": three,
                "matches": matches,
                "method": "epipolar",
                "initial": motion,
                "center": center,
                "radius": 0.15,
                "seed": 0,
            },
            40,
        ),
        "estimate_motions": Call(
            sylpose.estimate_motions,
            {"rig": three, "pairs": [matches], "method": "epipolar", "seed": 0, "threads": 1},
            30,
            message_pattern=r"\bmatches\b",
        ),
        "estimate_pose": Call(
            sylpose.estimate_pose,
            {
                "rig": three,
                "points": seen,
                "pixels": [c.project(p) for c, p in zip(three, seen, strict=True)],
                "max_error_px": 5.0,
                "seed": 0,
            },
            40,
        ),
        "solve_centralized": Call(sylpose.solve_centralized, of_rig),
        "solve_centralized_batch": Call(
            sylpose.solve_centralized_batch,
            {"rotations": Q, "moments": np.array([[m.matrix for m in moments]] * 2), "aim": True},
            nan=True,
        ),
        "solve_robust": Call(sylpose.solve_robust, {**of_rig, "names": ["a", "b", "c"]}),
        "diagnose_cameras": Call(camera_faults.diagnose_cameras, {**of_rig, "names": ["a", "b", "c"]}),
        "find_faulty_cameras": Call(
            camera_faults.find_faulty_cameras, {**of_rig, "rotation": R, "at_fault": [1], "names": ["a", "b", "c"]}
        ),
        "solve_depth_plane": Call(sylpose.solve_depth_plane, {**of_rig, "noise": np.full(3, 1e-3)}, 25),
        "solve_exchange": Call(
            sylpose.solve_exchange, {**of_rig, "max_rounds": 30, "network_faults": sylpose.NetworkFaults()}, 15
        ),
        "solve_refine": Call(
            sylpose.solve_refine, {**of_rig, "max_rounds": 60, "network_faults": sylpose.NetworkFaults()}, 10
        ),
        "solve_gossip": Call(
            sylpose.solve_gossip,
            {**of_rig, "graph": graph, "max_rounds": 40, "network_faults": sylpose.NetworkFaults()},
            10,
        ),
        "RunOptions": Call(
            sylpose.RunOptions,
            {
                "method": "epipolar",
                "features": "sift",
                "start": 1,
                "stop": 9,
                "every": 2,
                "overlay": False,
                "smooth": True,
                "plot_format": "svg",
                "angles": "XYZ",
                "seed": 3,
                "tracking": sylpose.TrackingOptions(),
                "workers": 2,
                "resume": False,
                "calibration_covariance": 1e-6 * np.eye(20),
                "checkpoint_seconds": 2.0,
            },
        ),
        "TrackingOptions": Call(
            sylpose.TrackingOptions,
            {"max_f_ratio": 20.0, "max_rival_ratio": 0.2, "min_keyframe_rotation": 0.1, "max_keyframes": 50},
        ),
        "NetworkFaults": Call(
            sylpose.NetworkFaults,
            {
                "loss": 0.1,
                "delay": 1,
                "dies": {0: 3},
                "joins": {1: 2},
                "returns": {0: 5},
                "partition": (0, 0, frozenset()),
                "seed": 0,
            },
            message_pattern="cameras .* must be after the failure",
        ),
        "solve_one_camera": Call(sylpose.solve_one_camera, {"rotation": Q[0], "moments": moments[0], "aim": True}),
        "solve_unconstrained": Call(
            one_camera.solve_unconstrained, {"rotation": Q[0], "moments": moments[0], "aim": True}
        ),
        "OneCameraSolution.select_nearest": Call(
            sylpose.solve_one_camera(Q[0], moments[0]).select_nearest, {"guess": R}
        ),
        "solve_2d3d": Call(
            sylpose.solve_2d3d,
            {
                "rotations": Q,
                "points": seen,
                "images": [(p @ q.T)[:, :2] for p, q in zip(seen, Q, strict=True)],
                "centers": o,
                "weights": [np.ones(9)] * 3,
            },
        ),
        "solve_3d3d": Call(
            sylpose.solve_3d3d, {"x": points, "y": np.asarray(motion.apply(points)), "weights": np.ones(12)}
        ),
        "solve_sylvester": Call(
            sylpose.solve_sylvester,
            {"A": square, "B": eye, "C": square, "method": "kronecker", "rcond": 1e-12},
            message_pattern=r"A N \+ N B = C"
            r"|do not broadcast|the solution",
        ),
        "solve_generalized_sylvester": Call(
            sylpose.solve_generalized_sylvester,
            {"As": [square, eye], "Bs": [eye, square], "C": square, "method": "bartels-stewart", "rcond": 1e-12},
            message_pattern=r"A_k X B_k = C|do not broadcast|the solution",
        ),
        "solve_translation_from_means": Call(
            translation.solve_translation_from_means,
            {
                "rotations": Q,
                "centers": o,
                "moments": moments,
                "rotation": R,
                "center": center,
                "rotation_variance": 0.0,
            },
            message_pattern="no camera has matches|the object's center",
        ),
        "refine_translation": Call(
            translation.refine_translation,
            {
                "rotations": Q,
                "centers": o,
                "moments": moments,
                "rotation": R,
                "center": center,
                "initial": np.zeros(3),
                "prior": eye,
            },
            40,
            message_pattern="no camera has matches|the object's center",
        ),
        "Matches": Call(sylpose.Matches, {"x": matches[0].x, "y": matches[0].y}, message_pattern="matches need"),
        "Matches.empty": Call(sylpose.Matches.empty, {}),
        "Matches.from_pixels": Call(
            sylpose.Matches.from_pixels,
            {"camera": camera, "pixels_i": pixels, "pixels_j": pixels + 1.0},
            message_pattern="matches",
        ),
        "PairMoments": Call(sylpose.PairMoments, {"matrix": moments[0].matrix}),
        "PairMoments.zero": Call(sylpose.PairMoments.zero, {}),
        "PairMoments.from_matches": Call(
            sylpose.PairMoments.from_matches,
            {"x": matches[0].x, "y": matches[0].y, "weights": np.ones(len(matches[0]))},
        ),
        "PairMoments.scale_weights": Call(moments[0].scale_weights, {"weight": 2.0}),
        "PairMoments.to_bytes": Call(moments[0].to_bytes, {}),
        "PairMoments.from_bytes": Call(sylpose.PairMoments.from_bytes, {"data": moments[0].to_bytes()}),
        "PairMoments.transform": Call(moments[0].transform, {"transformation": eye}),
        "Camera": Call(
            sylpose.Camera,
            {
                "name": "a",
                "size": (64, 48),
                "matrix": camera.matrix,
                "distortion": np.zeros(5),
                "camera_from_world": motion,
                "lens": "opencv",
                "error_px": 0.3,
            },
        ),
        "Camera.normalize": Call(camera.normalize, {"pixels": pixels}, nan=True),
        "Camera.normalize_to_grid": Call(camera.normalize_to_grid, {"pixels": pixels}, nan=True),
        "Camera.denormalize": Call(camera.denormalize, {"normalized": matches[0].x}, nan=True),
        "Camera.project": Call(camera.project, {"points": points}, nan=True),
        "Camera.rays": Call(camera.rays, {"pixels": pixels}, nan=True),
        "Rig": Call(sylpose.Rig, {"cameras": list(three), "unit": "m"}),
        "Rig.in_unit": Call(three.in_unit, {"unit": "mm"}, message_pattern="unit"),
        "Rig.in_world": Call(three.in_world, {"new_from_world": RigidTransform.identity()}),
        "Rig.subset": Call(three.subset, {"names": ["cam_0", "cam_2"]}, message_pattern="no camera"),
        "World": Call(
            sylpose.World,
            {"world_from_calibration": motion, "description": "", "unit": "m", "scale": 1.0, "world_unit": "mm"},
        ),
        "world_with_up": Call(
            sylpose.world_with_up, {"up": np.array([0.0, -1.0, 0.1]), "origin": center, "unit": "m", "description": ""}
        ),
        "Board": Call(
            sylpose.Board,
            {
                "kind": "chessboard",
                "text": "",
                "size": (2, 2),
                "points": points[:4],
                "symmetries": (np.arange(4),),
                "dictionary": "4X4_50",
                "first_id": 0,
                "marker_ratio": 0.5,
                "border": 1,
                "is_upside_down": False,
                "diameter": 0.0,
            },
        ),
        "parse_board": Call(
            sylpose.parse_board, {"text": "chessboard:9x6,square=1", "unit": "m"}, message_pattern="is no board|square"
        ),
        "find_board": Call(
            sylpose.find_board,
            {
                "rig": small,
                "images": [frames[0].images[0]],
                "board": sylpose.parse_board("apriltag:36h11,id=0,size=1"),
                "seed": 0,
            },
            message_pattern="image must be",
        ),
        "Trajectory": Call(sylpose.Trajectory, {"frames": [pose, pose], "camera_names": ["a", "b"], "unit": "m"}),
        "FramePose.mark_uncertain": Call(pose.mark_uncertain, {}),
        "FramePose.in_object_frame": Call(pose.in_object_frame, {"new_from_object": RigidTransform.identity()}),
        "KnownObject.to_frame": Call(
            sylpose.KnownObject(three, 0.1, "a", points, (), {}).to_frame,
            {"new_from_object": RigidTransform.identity(), "sd": np.ones(6), "description": "by hand"},
        ),
        "KnownObject.scaled": Call(
            sylpose.KnownObject(sylpose.Rig([camera], INITIAL_DISTANCES), 0.1, "a", points, (), {}).scaled,
            {"factor": 2.0, "unit": "m", "sd": 0.1},
        ),
        "FrameSet.for_object": Call(frames[0].for_object, {"name": "a"}),
        "Box": Call(sylpose.Box, {"x": 1.0, "y": 2.0, "width": 3.0, "height": 4.0}),
        "view_of_motion": Call(
            view.view_of_motion, {"motion": found, "camera": camera, "rig": three}, message_pattern="camera"
        ),
        "view_of_rotation": Call(view.view_of_rotation, {"estimate": turned, "camera": "cam_1", "rig": three}),
        "view_of_pose": Call(view.view_of_pose, {"pose": pose, "camera": motion, "rig": three}),
        "trajectory_view": Call(view.trajectory_view, {"trajectory": path, "camera": "cam_1", "rig": three}),
        "resolve_viewpoint": Call(view.resolve_viewpoint, {"camera": "cam_1", "rig": three}),
        "pan_tilt_roll": Call(results.pan_tilt_roll, {"rotation": Rotation.identity()}),
        "intersect_rays": Call(
            rig.intersect_rays,
            {"centers": o, "directions": np.array([c.direction for c in three]), "near": center},
        ),
        "make_look_at_camera": Call(
            rig.make_look_at_camera,
            {
                "name": "a",
                "center": np.array([0.0, 0.0, -1.0]),
                "target": center,
                "focal": 900.0,
                "size": (640, 480),
                "distortion": np.zeros(5),
            },
            message_pattern="camera a: its center|camera's name",
        ),
        "FrameSet.of": Call(
            sylpose.FrameSet.of,
            {"images": [frames[0].images[0]], "time": 0.5, "masks": [np.ones((48, 64), bool)]},
        ),
        "track": Call(
            lambda **given: list(sylpose.track(**given)),
            {
                "frames": frames,
                "rig": small,
                "boxes": {"cam_0": sylpose.Box(4, 4, 40, 30)},
                "method": "landmarks",
                "features": "auto",
                "offsets": {"cam_0": 0.0},
                "workers": 1,
                "seed": 0,
                "options": sylpose.TrackingOptions(),
            },
            20,
        ),
        "smooth_tracks": Call(
            smooth_tracks,
            {
                "frames": [Track(pose, (), np.zeros(3), 0.1)],
                "rig": three,
                "offsets_sd": 0.01,
                "calibration_prior": default_calibration_prior(three),
                "recalibrate": False,
                "moved_cameras": [MovedCamera(0, 3, 0.1)],
            },
        ),
        "ring": Call(simulate.ring, {"n": 3, **wide, "height": 0.1}, message_pattern="camera"),
        "arc": Call(
            simulate.arc,
            {"n": 3, "spacing_deg": 20.0, **wide, "height": np.zeros(3), "first_deg": 0.0},
            message_pattern="camera",
        ),
        "dome": Call(simulate.dome, {"n": 3, **wide, "lowest_deg": 10.0}, message_pattern="camera"),
        "carve_object": Call(
            sylpose.carve_object,
            {"rig": facing, "frames": masked, "world_from_object": RigidTransform.identity(2)},
            8,
            message_pattern=r"\bsilhouettes\b",
        ),
        "Mesh": Call(
            sylpose.Mesh,
            {"vertices": corners, "faces": np.array([[0, 1, 2]]), "colors": np.zeros((3, 3), np.uint8)},
        ),
        "ellipsoid": Call(simulate.ellipsoid, {"semi_axes": np.array([0.1, 0.2, 0.3]), "n": 50, "seed": 0}),
        "box": Call(simulate.box, {"sides": np.array([0.1, 0.2, 0.3]), "n": 50, "seed": 0}),
        "cloud": Call(simulate.cloud, {"semi_axes": np.array([0.1, 0.2, 0.3]), "n": 50, "seed": 0}),
        "plane": Call(simulate.plane, {"sides": np.array([0.1, 0.2]), "n": 50, "seed": 0, "two_sided": True}),
        "random_motion": Call(
            lambda **given: simulate.random_motion(**given, rng=seeded(0)),
            {"angle_deg": 5.0, "distance": 0.1, "axis": np.array([1.0, 0.0, 0.0]), "center": np.zeros(3)},
        ),
        "simulate_matches": Call(
            lambda **given: simulate.simulate_matches(**given, rng=seeded(0)),
            {
                "rig": three,
                "body": body,
                "motion": motion,
                "per_camera": 20,
                "noise_px": 0.5,
                "outliers": 0.1,
                "outlier_kind": "uniform",
                "occlusion": 0.1,
                "junk": ["cam_1"],
                "start": motion,
                "orthographic": False,
            },
            40,
            message_pattern="no camera",
        ),
    }


def public() -> set[str]:
    """Return the names of all functions, constructors that validate their arguments, and methods."""
    found = {function.__name__ for function in MORE}
    for name in sylpose.__all__:
        thing = getattr(sylpose, name)
        if not isinstance(thing, type):
            found.add(name)
            continue
        if issubclass(thing, (enum.Enum, Exception)) or getattr(thing, "_is_protocol", False):
            continue
        # Plain records are filled by functions; those that validate have a __post_init__ or a constructor.
        written = thing.__dict__.get("__init__")
        if "__post_init__" in vars(thing) or (written is not None and written.__code__.co_filename != "<string>"):
            found.add(name)
        for member, value in inspect.getmembers_static(thing):
            if not member.startswith("_") and inspect.isfunction(getattr(value, "__func__", value)):
                found.add(f"{name}.{member}")
    return found


def test_every_public_function_is_covered() -> None:
    missing = public() - set(calls()) - set(NOT_CALLED)
    assert not missing
    assert not (set(calls()) | set(NOT_CALLED)) - public()


def find_error_problem(call: Call, error: Exception) -> str | None:
    """Return what is wrong with an error, or None."""
    text = str(error)
    if type(error) not in (ValueError, TypeError, sylpose.SingularSylvesterError, KeyError):
        return f"{type(error).__name__}: {text[:200]}"
    # The message of a singular equation includes the unobservable directions.
    if not text.isprintable() or len(text) > (600 if isinstance(error, sylpose.SingularSylvesterError) else 300):
        return f"no short line: {text[:400]!r}"
    names = "|".join(rf"\b{re.escape(name)}\b" for name in call.arguments)
    if not re.search(f"{names}|{call.message_pattern}", text):
        return f"no argument's name: {type(error).__name__}: {text}"
    return None


def find_result_problem(found: Any, nan: bool) -> str | None:
    """Return what is wrong with a result, or None."""
    if isinstance(found, (list, tuple)):
        return next((why for part in found if (why := find_result_problem(part, nan))), None)
    if isinstance(found, np.ndarray) and found.dtype.kind == "f" and not nan and not np.isfinite(found).all():
        return "numbers that are not finite"
    if isinstance(found, RigidTransform) and not np.isfinite(found.as_matrix()).all():
        return "a transform that is not finite"
    if isinstance(getattr(found, "status", None), Status) and found.status is Status.OK:
        for name in ("rotation", "rotations", "information", "center", "multiplier", "costs", "displacement"):
            value = getattr(found, name, None)
            value = value.as_matrix() if isinstance(value, Rotation) else value
            if value is not None and name != "rotations" and not np.isfinite(value).all():
                return f"OK with {name} that is not finite"
        if hasattr(found, "motion"):
            if found.motion is None:
                return "OK without a motion"
            return find_result_problem(found.motion, nan)
        if isinstance(found, RotationEstimate) and abs(np.linalg.det(found.rotation) - 1) > 1e-6:
            return "OK with no rotation"
    return None


def find_problems(name: str, most: int | None = None) -> list[str]:
    """Return the problems of a function, by argument and mutation."""
    call, out = calls()[name], []
    most = call.max_mutations if most is None else min(most, call.max_mutations)
    for argument, value in call.arguments.items():
        changes = list(mutations(value))
        rng = np.random.default_rng([SEED, *argument.encode()])
        if len(changes) > most:
            changes = [changes[k] for k in rng.permutation(len(changes))[:most]]
        for what, wrong in changes:
            given = {**call.arguments, argument: wrong}
            before = copy_arrays(given[argument])
            why = None
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("error")
                    why = find_result_problem(call.function(**given), call.nan)
            except (KeyboardInterrupt, MemoryError):
                raise
            except Exception as error:
                why = find_error_problem(call, error)
            if why is None and not is_unchanged(before, given[argument]):
                why = "the argument was changed"
            if why is not None:
                out.append(f"{name}({argument}: {what}): {why}")
    return out


# Not `calls()`, which computes results: modules are imported by every process.
CALLED = sorted(public() - set(NOT_CALLED))


@pytest.mark.parametrize("name", CALLED)
def test_valid_calls_succeed(name: str) -> None:
    call = calls()[name]
    assert find_result_problem(call.function(**call.arguments), call.nan) is None


@pytest.mark.parametrize("most", [QUICK_MUTATIONS, pytest.param(None, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", CALLED)
def test_wrong_arguments_are_rejected_by_name(name: str, most: int | None) -> None:
    assert not find_problems(name, most)
