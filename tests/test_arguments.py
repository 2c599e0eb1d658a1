"""Wrong and extreme arguments of every public function: one sentence that names the argument, or an honest result.

A table of valid calls; each argument is replaced by what it may be mistaken for, in turn (`mutations`). A public function
that is not in the table fails the first test.
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
from sylpose.bundle_adjustment.calibration_refinement import Moved, usual_doubt
from sylpose.results import FramePose, FrameStatus, RotationEstimate, Status
from sylpose.smoothing.trajectory import Track, smooth
from sylpose.sylvester import camera_faults, one_camera, translation
from sylpose.units import FIRST_DISTANCES
from tests.mutations import copied, mutations, same

# By function, the most changes of each argument that are tried: what takes long is tried less often, by a seed.
MOST, SEED = 60, 0
# Besides `sylpose.__all__`.
MORE: tuple[Any, ...] = (
    camera_faults.diagnose,
    camera_faults.suspect_cameras,
    translation.translation_from_means,
    translation.translation_from_moments,
    one_camera.solve_unconstrained,
    results.pan_tilt_roll,
    rig.camera_at,
    smooth,
    rig.nearest_point_to_rays,
    view.camera_from_world_of,
    *(getattr(simulate, name) for name in simulate.__all__ if inspect.isfunction(getattr(simulate, name))),
)
# Why functions are not called here.
ELSEWHERE = {
    "open_session": "reads files: test_fuzz_readers.py, calibration/, capture/",
    "open_live": "the same",
    "track_session": "the same; its options: app/",
    "load_object": "reads a file: app/test_object_files.py",
    "save_object": "writes it: the same",
    "Session.frames": "the same",
    "Session.of": "the same",
    "Session.with_rig": "the same",
    "Session.told_in": "the same",
    "load_world": "reads a file: calibration/test_world.py",
    "LiveSession.frames": "the same",
    "Trajectory.plot": "draws, which takes a second: test_told.py",
    "Trajectory.to_dataframe": "takes nothing, and needs pandas: exports/test_exports.py",
    "LiveSession.of": "the same",
    "LiveSession.with_rig": "the same",
    "LiveSession.told_in": "the same",
    "LiveSession.stop": "no arguments",
    "Source.frame_number": "looked up in a table of a folder's files",
    "demo_scene": "the demo's, writes a recording",
    "demo_truth": "the same",
    "render_frames": "images of seconds each: simulate/",
    "render_sequence": "the same",
    "write_recording": "the same",
    "write_sequence": "the same",
    "visible_shares": "the same",
    "chamfered_box": "the same",
}


class Call(NamedTuple):
    """A valid call.

    Attributes:
        most: changes of each argument that are tried.
        nan: NaN is an answer of this function, or what it leaves of NaN that is given.
        said: what else a refusal may say instead of an argument's name.
    """

    function: Callable[..., Any]
    arguments: dict[str, Any]
    most: int = MOST
    nan: bool = False
    said: str = r"\bno camera has\b|\bno points\b"


@cache
def calls() -> dict[str, Call]:
    """By name."""
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
            said=r"\bmatches\b",
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
        "diagnose": Call(camera_faults.diagnose, {**of_rig, "names": ["a", "b", "c"]}),
        "suspect_cameras": Call(
            camera_faults.suspect_cameras, {**of_rig, "rotation": R, "at_fault": [1], "names": ["a", "b", "c"]}
        ),
        "solve_depth_plane": Call(sylpose.solve_depth_plane, {**of_rig, "noise": np.full(3, 1e-3)}, 50),
        "solve_exchange": Call(
            sylpose.solve_exchange, {**of_rig, "rounds": 1, "disturbances": sylpose.Disturbances()}, 30
        ),
        "solve_refine": Call(sylpose.solve_refine, {**of_rig, "bound": 60, "disturbances": sylpose.Disturbances()}, 10),
        "solve_gossip": Call(
            sylpose.solve_gossip, {**of_rig, "graph": graph, "bound": 40, "disturbances": sylpose.Disturbances()}, 10
        ),
        "Disturbances": Call(
            sylpose.Disturbances,
            {
                "loss": 0.1,
                "delay": 1,
                "dies": {0: 3},
                "joins": {1: 2},
                "returns": {0: 5},
                "apart": (0, 0, frozenset()),
                "nonsense": {0: "nan"},
                "seed": 0,
            },
            said="cameras .* return before",
        ),
        "solve_one_camera": Call(sylpose.solve_one_camera, {"rotation": Q[0], "moments": moments[0], "aim": True}),
        "solve_unconstrained": Call(
            one_camera.solve_unconstrained, {"rotation": Q[0], "moments": moments[0], "aim": True}
        ),
        "OneCameraSolution.nearest": Call(sylpose.solve_one_camera(Q[0], moments[0]).nearest, {"guess": R}),
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
            said=r"A N \+ N B = C"
            r"|do not broadcast|the solution",
        ),
        "solve_generalized_sylvester": Call(
            sylpose.solve_generalized_sylvester,
            {"As": [square, eye], "Bs": [eye, square], "C": square, "method": "bartels-stewart", "rcond": 1e-12},
            said=r"A_k X B_k = C|do not broadcast|the solution",
        ),
        "translation_from_means": Call(
            translation.translation_from_means,
            {"rotations": Q, "centers": o, "moments": moments, "rotation": R, "center": center, "off": 0.0},
            said="no camera has matches|the object's centre",
        ),
        "translation_from_moments": Call(
            translation.translation_from_moments,
            {
                "rotations": Q,
                "centers": o,
                "moments": moments,
                "rotation": R,
                "center": center,
                "start": np.zeros(3),
                "prior": eye,
            },
            40,
            said="no camera has matches|the object's centre",
        ),
        "Matches": Call(sylpose.Matches, {"x": matches[0].x, "y": matches[0].y}, said="matches need"),
        "Matches.none": Call(sylpose.Matches.none, {}),
        "Matches.from_pixels": Call(
            sylpose.Matches.from_pixels,
            {"camera": camera, "pixels_i": pixels, "pixels_j": pixels + 1.0},
            said="matches",
        ),
        "PairMoments": Call(sylpose.PairMoments, {"matrix": moments[0].matrix}),
        "PairMoments.zero": Call(sylpose.PairMoments.zero, {}),
        "PairMoments.from_matches": Call(
            sylpose.PairMoments.from_matches,
            {"x": matches[0].x, "y": matches[0].y, "weights": np.ones(len(matches[0]))},
        ),
        "PairMoments.weighted": Call(moments[0].weighted, {"weight": 2.0}),
        "PairMoments.to_bytes": Call(moments[0].to_bytes, {}),
        "PairMoments.from_bytes": Call(sylpose.PairMoments.from_bytes, {"data": moments[0].to_bytes()}),
        "PairMoments.transformed": Call(moments[0].transformed, {"to": eye}),
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
        "Rig.in_unit": Call(three.in_unit, {"unit": "mm"}, said="unit"),
        "Rig.in_world": Call(three.in_world, {"new_from_world": RigidTransform.identity()}),
        "Rig.subset": Call(three.subset, {"names": ["cam_0", "cam_2"]}, said="no camera"),
        "World": Call(
            sylpose.World,
            {"world_from_calibration": motion, "said": "", "unit": "m", "scale": 1.0, "world_unit": "mm"},
        ),
        "world_with_up": Call(
            sylpose.world_with_up, {"up": np.array([0.0, -1.0, 0.1]), "origin": center, "unit": "m", "said": ""}
        ),
        "Board": Call(
            sylpose.Board,
            {
                "kind": "chessboard",
                "text": "",
                "size": (2, 2),
                "points": points[:4],
                "alike": (np.arange(4),),
                "dictionary": "4X4_50",
                "first_id": 0,
                "marker_share": 0.5,
                "border": 1,
                "half_turned": False,
                "diameter": 0.0,
            },
        ),
        "parse_board": Call(
            sylpose.parse_board, {"text": "chessboard:9x6,square=1", "unit": "m"}, said="is no board|square"
        ),
        "find_board": Call(
            sylpose.find_board,
            {
                "rig": small,
                "images": [frames[0].images[0]],
                "board": sylpose.parse_board("apriltag:36h11,id=0,size=1"),
                "seed": 0,
            },
            said="image must be",
        ),
        "Trajectory": Call(sylpose.Trajectory, {"frames": [pose, pose], "camera_names": ["a", "b"], "unit": "m"}),
        "FramePose.judged": Call(pose.judged, {}),
        "FramePose.of_frame": Call(pose.of_frame, {"new_from_object": RigidTransform.identity()}),
        "KnownObject.in_frame": Call(
            sylpose.KnownObject(three, 0.1, "a", points, (), {}).in_frame,
            {"new_from_object": RigidTransform.identity(), "sd": np.ones(6), "said": "by hand"},
        ),
        "KnownObject.sized": Call(
            sylpose.KnownObject(sylpose.Rig([camera], FIRST_DISTANCES), 0.1, "a", points, (), {}).sized,
            {"factor": 2.0, "unit": "m", "sd": 0.1},
        ),
        "FrameSet.of": Call(frames[0].of, {"name": "a"}),
        "Box": Call(sylpose.Box, {"x": 1.0, "y": 2.0, "width": 3.0, "height": 4.0}),
        "view_of_motion": Call(view.view_of_motion, {"motion": found, "camera": camera, "rig": three}, said="camera"),
        "view_of_rotation": Call(view.view_of_rotation, {"estimate": turned, "camera": "cam_1", "rig": three}),
        "view_of_pose": Call(view.view_of_pose, {"pose": pose, "camera": motion, "rig": three}),
        "trajectory_view": Call(view.trajectory_view, {"trajectory": path, "camera": "cam_1", "rig": three}),
        "camera_from_world_of": Call(view.camera_from_world_of, {"camera": "cam_1", "rig": three}),
        "pan_tilt_roll": Call(results.pan_tilt_roll, {"rotation": Rotation.identity()}),
        "nearest_point_to_rays": Call(
            rig.nearest_point_to_rays,
            {"centers": o, "directions": np.array([c.direction for c in three]), "near": center},
        ),
        "camera_at": Call(
            rig.camera_at,
            {
                "name": "a",
                "center": np.array([0.0, 0.0, -1.0]),
                "target": center,
                "focal": 900.0,
                "size": (640, 480),
                "distortion": np.zeros(5),
            },
            said="camera a: it stands|camera's name",
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
            },
            20,
        ),
        "smooth": Call(
            smooth,
            {
                "frames": [Track(pose, (), np.zeros(3), 0.1)],
                "rig": three,
                "offsets_sd": 0.01,
                "doubt": usual_doubt(three),
                "recalibrate": False,
                "moved": [Moved(0, 3, 0.1)],
            },
        ),
        "ring": Call(simulate.ring, {"n": 3, **wide, "height": 0.1}, said="camera"),
        "arc": Call(
            simulate.arc, {"n": 3, "spacing_deg": 20.0, **wide, "height": np.zeros(3), "first": 0.0}, said="camera"
        ),
        "dome": Call(simulate.dome, {"n": 3, **wide, "lowest_deg": 10.0}, said="camera"),
        "ellipsoid": Call(simulate.ellipsoid, {"semi_axes": np.array([0.1, 0.2, 0.3]), "n": 50, "seed": 0}),
        "box": Call(simulate.box, {"sides": np.array([0.1, 0.2, 0.3]), "n": 50, "seed": 0}),
        "cloud": Call(simulate.cloud, {"semi_axes": np.array([0.1, 0.2, 0.3]), "n": 50, "seed": 0}),
        "plane": Call(simulate.plane, {"sides": np.array([0.1, 0.2]), "n": 50, "seed": 0, "two_sided": True}),
        "random_motion": Call(
            lambda **given: simulate.random_motion(**given, rng=seeded(0)),
            {"turn_deg": 5.0, "shift": 0.1, "axis": np.array([1.0, 0.0, 0.0]), "center": np.zeros(3)},
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
                "other_motion": motion,
                "occlusion": 0.1,
                "dead": ["cam_0"],
                "junk": ["cam_1"],
                "start": motion,
                "orthographic": False,
            },
            40,
            said="no camera",
        ),
    }


def public() -> set[str]:
    """All functions, constructors that look at what they are given, and methods."""
    found = {function.__name__ for function in MORE}
    for name in sylpose.__all__:
        thing = getattr(sylpose, name)
        if not isinstance(thing, type):
            found.add(name)
            continue
        if issubclass(thing, (enum.Enum, Exception)) or getattr(thing, "_is_protocol", False):
            continue
        # Records hold what functions put into them; those that check have a __post_init__, or a constructor of their own.
        written = thing.__dict__.get("__init__")
        if "__post_init__" in vars(thing) or (written is not None and written.__code__.co_filename != "<string>"):
            found.add(name)
        for member, value in inspect.getmembers_static(thing):
            if not member.startswith("_") and inspect.isfunction(getattr(value, "__func__", value)):
                found.add(f"{name}.{member}")
    return found


def test_every_public_function_is_called() -> None:
    missing = public() - set(calls()) - set(ELSEWHERE)
    assert not missing
    assert not (set(calls()) | set(ELSEWHERE)) - public()


def complaint(call: Call, error: Exception) -> str | None:
    """What is wrong with a refusal."""
    said = str(error)
    if type(error) not in (ValueError, TypeError, sylpose.SingularSylvesterError, KeyError):
        return f"{type(error).__name__}: {said[:200]}"
    # What a singular equation does not see is part of the sentence.
    if not said.isprintable() or len(said) > (600 if isinstance(error, sylpose.SingularSylvesterError) else 300):
        return f"no short line: {said[:400]!r}"
    names = "|".join(rf"\b{re.escape(name)}\b" for name in call.arguments)
    if not re.search(f"{names}|{call.said}", said):
        return f"no argument's name: {type(error).__name__}: {said}"
    return None


def dishonest(found: Any, nan: bool) -> str | None:
    """What is wrong with an answer."""
    if isinstance(found, (list, tuple)):
        return next((why for part in found if (why := dishonest(part, nan))), None)
    if isinstance(found, np.ndarray) and found.dtype.kind == "f" and not nan and not np.isfinite(found).all():
        return "numbers that are not finite"
    if isinstance(found, RigidTransform) and not np.isfinite(found.as_matrix()).all():
        return "a transform that is not finite"
    if isinstance(getattr(found, "status", None), Status) and found.status is Status.OK:
        for name in ("rotation", "rotations", "information", "center", "multiplier", "costs", "displacement"):
            value = getattr(found, name, None)
            if value is not None and name != "rotations" and not np.isfinite(value).all():
                return f"OK with {name} that is not finite"
        if hasattr(found, "motion"):
            if found.motion is None:
                return "OK without a motion"
            return dishonest(found.motion, nan)
        if isinstance(found, RotationEstimate) and abs(np.linalg.det(found.rotation) - 1) > 1e-6:
            return "OK with no rotation"
    return None


def verdicts(name: str, most: int | None = None) -> list[str]:
    """What is wrong with a function, by argument and change."""
    call, out = calls()[name], []
    for argument, value in call.arguments.items():
        changes = list(mutations(value))
        rng = np.random.default_rng([SEED, *argument.encode()])
        if len(changes) > (call.most if most is None else most):
            changes = [changes[k] for k in rng.permutation(len(changes))[: call.most if most is None else most]]
        for what, wrong in changes:
            given = {**call.arguments, argument: wrong}
            before = copied(given[argument])
            why = None
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("error")
                    why = dishonest(call.function(**given), call.nan)
            except (KeyboardInterrupt, MemoryError):
                raise
            except Exception as error:
                why = complaint(call, error)
            if why is None and not same(before, given[argument]):
                why = "the argument was changed"
            if why is not None:
                out.append(f"{name}({argument}: {what}): {why}")
    return out


@pytest.mark.parametrize("name", calls())
def test_valid_calls_are_answered(name: str) -> None:
    call = calls()[name]
    assert dishonest(call.function(**call.arguments), call.nan) is None


@pytest.mark.parametrize("name", calls())
def test_wrong_arguments_are_named_or_answered_honestly(name: str) -> None:
    assert not verdicts(name)
