"""Points picked on an object, and definitions of the object's frame by them.

A point is given by coordinates, by the nearest landmark, or by pixels in a frame of a run. A definition returns the
transform to the new frame and its standard deviations.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.absolute_pose.object_axes import (
    axes_from_extent,
    axes_from_plane,
    axes_from_points,
    estimate_axes_sd,
    fit_plane,
    fit_plane_to_points,
)
from sylpose.absolute_pose.pose import make_frame_pose
from sylpose.boards.board_pose import find_board
from sylpose.boards.specification import parse_board
from sylpose.display import format_length
from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.robust_loss import chi_squared_bound
from sylpose.input_limits import to_one_line
from sylpose.io import calibration
from sylpose.io.capture import open_session
from sylpose.io.object_files import OBJECT_FILE, load_object
from sylpose.landmarks.landmark_filter import KNOWN_DEPTH_RATIO
from sylpose.results import FramePose, Trajectory
from sylpose.rig import Camera, Rig, intersect_rays
from sylpose.runs.view import find_calibration, load_trajectory
from sylpose.status import Status
from sylpose.sync.offsets import apply_offsets, find_offsets
from sylpose.tracking.known_object import KnownObject
from sylpose.units import INITIAL_DISTANCES

# Standard deviation of a clicked pixel (choice).
CLICK_SD_PX = 1.5
# Rays that miss each other by more than this many click sds do not see the same point (choice).
MAX_RAY_MISS = 5.0
# The depth of a single pixel is that of landmarks that the camera saw from within this angle, radians, and that are at
# most this share of the object's radius away from the ray; how many are used, and how many determine a slope (choice).
MAX_VIEW_ANGLE, MAX_RAY_DISTANCE, MAX_NEIGHBORS, MIN_NEIGHBORS_FOR_SLOPE = np.radians(25.0), 0.25, 20, 6
# Slope sd of a surface whose slope is unknown; roughness as a share of the object's radius (choice).
SLOPE_SD, ROUGHNESS = 0.7, 0.01
# Standard deviation of unobservable components, radians and lengths (choice).
UNBOUNDED_SD = 1e3
POINT_SYNTAX = '"X,Y,Z", "near X,Y,Z" or "@FRAME CAMERA=U,V CAMERA=U,V"'


@dataclass(frozen=True, eq=False)
class PickedPoint:
    """A picked point of the object.

    Attributes:
        position: (3,) position in the object's frame.
        covariance: (3, 3), without the error of the object's pose, which points of one frame share.
        frame: number of the frame in which it was picked, -1 without one.
        pose_sd: (6,) standard deviations of (w, d) of the object's pose in that frame.
        pose_jacobian: (3, 6) derivative of the position by the pose.
    """

    position: FloatArray
    covariance: FloatArray
    frame: int = -1
    pose_sd: FloatArray = field(default_factory=lambda: np.zeros(6))
    pose_jacobian: FloatArray = field(default_factory=lambda: np.zeros((3, 6)))

    @property
    def is_exact(self) -> bool:
        """Return whether the position is exact by definition."""
        return not self.covariance.any() and not self.pose_jacobian.any()

    def sample(self, rng: np.random.Generator, pose_errors: dict[int, FloatArray]) -> FloatArray:
        """Draw a position (3,) from the point's distribution.

        Args:
            rng: random generator.
            pose_errors: the errors (6,) of the pose by frame in this draw, in standard deviations; new frames are
                added.
        """
        position = rng.multivariate_normal(self.position, self.covariance, method="eigh")
        if self.frame < 0:
            return position
        pose_error = pose_errors.setdefault(self.frame, rng.normal(size=6))
        return np.asarray(position + self.pose_jacobian @ (self.pose_sd * pose_error))


@dataclass(frozen=True, eq=False)
class ObjectRun:
    """Result of a run of the object.

    Attributes:
        path: the run's folder.
        trajectory: expressed in the object frame of the run.
        frame_from_run: transform from that frame to the frame in which points are picked.
        rig: the rig that the run used.
    """

    path: Path
    trajectory: Trajectory
    frame_from_run: RigidTransform
    rig: Rig

    def pose(self, index: int) -> FramePose:
        """Return the pose in a frame, given by its number in the session.

        Raises:
            ValueError: no such frame, or no measured pose in it.
        """
        found = next((pose for pose in self.trajectory if pose.index == index), None)
        if found is None or not found.is_measured:
            why = "there is no such frame" if found is None else found.reason or found.status.value
            raise ValueError(f"{self.path}: the object's pose in frame {index} is unknown ({why})")
        return found.in_object_frame(self.frame_from_run)


def read_object_run(path: Path, known: KnownObject) -> ObjectRun:
    """Read the result of a run of a known object.

    Raises:
        FileNotFoundError, ValueError: naming the missing file; a run of another object.
    """
    trajectory, run_object = load_trajectory(path), load_object(path / OBJECT_FILE)
    if run_object.fingerprint != known.fingerprint:
        raise ValueError(f"{path}: the run has another object, or learned this one again")
    if run_object.unit != known.unit:
        raise ValueError(
            f"{path}: its lengths are in {run_object.unit or 'no unit'}, those of the object in {known.unit or 'none'}"
        )
    frame_from_run = known.frame.from_learned * run_object.frame.from_learned.inv()
    return ObjectRun(path, trajectory, frame_from_run, calibration.load(find_calibration(path, None)))


def precise_landmarks(known: KnownObject) -> FloatArray:
    """Return the positions (n, 3) of the landmarks with a small depth sd, in the object's frame."""
    return np.asarray(known.positions[known.depth_sd < KNOWN_DEPTH_RATIO * known.radius])


def parse_point(text: str, known: KnownObject, result: ObjectRun | None) -> PickedPoint:
    """Parse a point and locate it on the object.

    Args:
        text: "0.1,0,0.02" (in the object's frame), "near 0.1,0,0.02" (the nearest landmark) or
            "@42 cam_0=812,400 cam_2=310,95" (pixels of images as recorded).
        known: the object model.
        result: result of a run, required for pixels.

    Raises:
        ValueError: another form; pixels of unknown cameras, or without landmarks nearby.
    """
    parts = text.split()
    try:
        if len(parts) == 1 and not text.startswith("@"):
            return PickedPoint(np.array(_parse_numbers(parts[0], 3)), np.zeros((3, 3)))
        if len(parts) == 2 and parts[0] == "near":
            return _nearest_landmark(np.array(_parse_numbers(parts[1], 3)), known)
        if len(parts) > 1 and (frame := re.fullmatch(r"@(\d{1,12})", parts[0])):
            pairs = [word.rpartition("=") for word in parts[1:]]
            pixels = {name: np.array(_parse_numbers(cell, 2)) for name, separator, cell in pairs if separator}
            if len(pixels) == len(parts) - 1:
                assert result is not None
                return _locate_pixels(pixels, result, int(frame[1]), known)
        raise ValueError(f"a point is {POINT_SYNTAX}")
    except ValueError as error:
        raise ValueError(f'"{to_one_line(text, 100)}": {error}') from None


def _parse_numbers(word: str, n: int) -> list[float]:
    cells = word.split(",")
    try:
        values = [float(cell) for cell in cells]
    except ValueError:
        values = []
    if len(values) != n or not np.isfinite(values).all():
        raise ValueError(
            f"expected {n} numbers separated by commas, got {to_one_line(word, 60)}; a point is {POINT_SYNTAX}"
        )
    return values


def _nearest_landmark(position: FloatArray, known: KnownObject) -> PickedPoint:
    """Return the landmark nearest to a position, of those with a small depth sd."""
    precise = known.depth_sd < KNOWN_DEPTH_RATIO * known.radius
    if not precise.any():
        raise ValueError("no landmark of the object is precise enough")
    places = known.positions[precise]
    k = int(np.argmin(np.linalg.norm(places - position, axis=1)))
    information = np.concatenate([memory.landmarks.information for memory in known._cameras.values()])[precise][k]
    rotation = known.frame.from_learned.rotation.as_matrix()
    return PickedPoint(places[k], rotation @ np.linalg.inv(information) @ rotation.T)


def _locate_pixels(pixels: Mapping[str, FloatArray], result: ObjectRun, index: int, known: KnownObject) -> PickedPoint:
    """Locate the point that cameras see at given pixels in a frame."""
    if unknown := [name for name in pixels if name not in result.rig.names]:
        raise ValueError(f"no camera {', '.join(unknown)} in {result.path} ({', '.join(result.rig.names)})")
    pose = result.pose(index)
    assert pose.world_from_object is not None
    object_from_world = pose.world_from_object.inv()
    cameras = [result.rig[name] for name in pixels]
    centers = np.array([object_from_world.apply(camera.center) for camera in cameras])
    rays = np.array(
        [object_from_world.rotation.apply(c.rays(at)[0]) for c, at in zip(cameras, pixels.values(), strict=True)]
    )
    if len(cameras) > 1:
        point = _triangulate(cameras, centers, rays)
    else:
        point = _intersect_surface(cameras[0], centers[0], rays[0], known)
    # An error of the pose moves the point on the object by -R' (d + w x r).
    x, y, z = pose.world_from_object.rotation.apply(point.position)
    jacobian = np.array([[0.0, z, -y, 1.0, 0.0, 0.0], [-z, 0.0, x, 0.0, 1.0, 0.0], [y, -x, 0.0, 0.0, 0.0, 1.0]])
    pose_jacobian = -object_from_world.rotation.as_matrix() @ jacobian
    return replace(point, frame=index, pose_sd=np.minimum(pose.sigma, UNBOUNDED_SD), pose_jacobian=pose_jacobian)


def _triangulate(cameras: list[Camera], centers: FloatArray, rays: FloatArray) -> PickedPoint:
    """Triangulate the point from the rays of several cameras."""
    position = intersect_rays(centers, rays)
    projectors, information, misses_px = np.eye(3) - rays[:, :, None] * rays[:, None, :], np.zeros((3, 3)), []
    for camera, center, projector in zip(cameras, centers, projectors, strict=True):
        distance = float(np.linalg.norm(position - center))
        information = information + projector * (camera.focal / (CLICK_SD_PX * distance)) ** 2
        misses_px.append(float(np.linalg.norm(projector @ (position - center))) / distance * camera.focal)
    if max(misses_px) > MAX_RAY_MISS * CLICK_SD_PX or not ((position - centers) * rays).sum(axis=1).min() > 0:
        camera_names = ", ".join(camera.name for camera in cameras)
        raise ValueError(f"the rays of {camera_names} miss each other by {max(misses_px):.0f} px: not the same point")
    if not np.linalg.cond(information) < 1e8:
        raise ValueError("the rays of the cameras coincide, so the point's depth is not observable")
    return PickedPoint(position, np.asarray(np.linalg.inv(information), float))


def _intersect_surface(camera: Camera, center: FloatArray, ray: FloatArray, known: KnownObject) -> PickedPoint:
    """Intersect a ray with the surface, fitted to the landmarks that the camera sees from this direction."""
    places, covariances = _visible_landmarks(camera, center, known)
    offsets = places - center
    depth = offsets @ ray
    lateral = offsets - depth[:, None] * ray
    lateral_distance = np.linalg.norm(lateral, axis=1)
    nearest = np.argsort(lateral_distance)[:MAX_NEIGHBORS]
    nearest = nearest[lateral_distance[nearest] < MAX_RAY_DISTANCE * known.radius]
    if not len(nearest):
        raise ValueError(f"no landmark of {camera.name} is near that ray; add the pixel of a second camera")
    depth, lateral_distance = depth[nearest], lateral_distance[nearest]
    # Landmarks off the ray may be nearer or further, depending on the surface's slope.
    sd = np.sqrt(
        np.einsum("i,nij,j->n", ray, covariances[nearest], ray)
        + (SLOPE_SD * lateral_distance) ** 2
        + (ROUGHNESS * known.radius) ** 2
    )
    middle = _weighted_median(depth, sd**-2)
    inliers = np.abs(depth - middle) < 3.0 * np.maximum(sd, np.median(np.abs(depth - middle)))  # excludes the back side
    depth, sd, across = depth[inliers], sd[inliers], (lateral[nearest] @ np.linalg.svd(ray[None])[2][1:].T)[inliers]
    columns = np.column_stack([np.ones(len(depth)), across])
    rank = np.linalg.matrix_rank(columns, ROUGHNESS * known.radius)
    if len(depth) < MIN_NEIGHBORS_FOR_SLOPE or rank < columns.shape[1]:
        columns = columns[:, :1]
    if columns.shape[1] > 1:  # the slope is estimated
        sd = np.sqrt(np.einsum("i,nij,j->n", ray, covariances[nearest][inliers], ray) + (ROUGHNESS * known.radius) ** 2)
    normal = (columns / sd[:, None]).T @ (columns / sd[:, None])
    found = np.linalg.solve(normal, (columns / sd[:, None]).T @ (depth / sd))
    chi2 = float(np.mean(((depth - columns @ found) / sd) ** 2)) * len(depth)
    reduced_chi2 = chi2 / max(len(depth) - columns.shape[1], 1)
    variance = float(np.linalg.inv(normal)[0, 0]) * max(reduced_chi2, 1.0)
    surface_depth = float(found[0])
    click = (CLICK_SD_PX * surface_depth / camera.focal) ** 2
    covariance = click * np.eye(3) + max(variance - click, 0.0) * np.outer(ray, ray)
    return PickedPoint(center + surface_depth * ray, covariance)


def _weighted_median(values: FloatArray, weights: FloatArray) -> float:
    order = np.argsort(values)
    half = np.cumsum(weights[order]) >= 0.5 * weights.sum()
    return float(values[order][np.argmax(half)])


def _visible_landmarks(
    camera: Camera, center_in_object: FloatArray, known: KnownObject
) -> tuple[FloatArray, FloatArray]:
    """Return positions (n, 3) and covariances (n, 3, 3) of the camera's precise landmarks seen from this direction."""
    memory = known._cameras.get(camera.name)
    if memory is None:
        raise ValueError(f"{camera.name} has no landmarks of the object; add the pixel of a second camera")
    from_learned, center = known.frame.from_learned, known.rig[camera.name].center
    origin, rotation = from_learned.translation, from_learned.rotation.as_matrix()
    viewpoints = [from_learned.apply(k.world_from_object.inv().apply(center)) - origin for k in known._keyframes]
    views = np.array(viewpoints) / np.linalg.norm(viewpoints, axis=1, keepdims=True)
    view = (center_in_object - origin) / np.linalg.norm(center_in_object - origin)
    near = np.flatnonzero(views @ view > np.cos(MAX_VIEW_ANGLE)).tolist()
    landmarks = memory.landmarks.subset(np.isin(memory.landmarks.id, [n for k in near for n in memory.landmark_ids[k]]))
    landmarks = landmarks.subset(landmarks.depth_sd < KNOWN_DEPTH_RATIO * known.radius)
    covariances = rotation @ np.linalg.inv(landmarks.information) @ rotation.T
    return from_learned.apply(landmarks.mean).reshape(-1, 3), covariances


LARGEST = "largest"
# Landmarks within this share of the object's radius from a picked point belong to its plane (choice).
PLANE_RADIUS_RATIO = 0.3
# Monte Carlo draws for the uncertainty of a distance (choice).
N_DRAWS = 200
# Number of frames that are searched, evenly spread over those with a known object pose (choice).
MAX_FRAMES = 24
# Share of the frames' variance that is common to all of them: the calibration's errors (choice).
COMMON_VARIANCE = 0.5
ROUNDS = 5
# A board with a larger standard deviation, degrees, is rejected (choice).
MAX_ROTATION_SD = 10.0


class NewFrame(NamedTuple):
    """A new object frame: the transform to it, its standard deviations (6,), and a description."""

    new_from_object: RigidTransform
    sd: FloatArray
    description: str


class PointParser:
    """Parser of picked points; the result to which pixels refer is read when the first pixel point needs it."""

    def __init__(self, known: KnownObject, source: Path, result: Path | None) -> None:
        self.known, self._source, self._path = known, source, result
        self._result: ObjectRun | None = None

    @property
    def result(self) -> ObjectRun:
        """Return the result of a run of the object: the one given, or the folder of the object file."""
        if self._result is None:
            self._result = read_object_run(self._source.parent if self._path is None else self._path, self.known)
        return self._result

    def __call__(self, option: str, text: str) -> PickedPoint:
        result = self.result if text.lstrip().startswith("@") else None
        with _prefix_errors(option):
            return parse_point(text.strip(), self.known, result)


@contextmanager
def _prefix_errors(option: str) -> Iterator[None]:
    """Prefix the message of a ValueError with the option's name."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{option} {error}") from None


def frame_from_points(points: PointParser, *texts: str) -> NewFrame:
    """Define the frame by the origin, a point on +X and a point in the XY plane."""
    origin, x, xy = (points(option, word) for option, word in zip(("--origin", "--x", "--xy"), texts, strict=True))

    def solve_frame(draw: Callable[[PickedPoint], FloatArray]) -> RigidTransform:
        return axes_from_points(draw(origin), draw(x), draw(xy))

    frame = solve_frame(lambda p: p.position)
    return NewFrame(frame, estimate_axes_sd(frame, lambda rng: solve_frame(make_joint_sampler(rng))), "three points")


def make_joint_sampler(rng: np.random.Generator) -> Callable[[PickedPoint], FloatArray]:
    """Return a function that draws the positions of picked points from their joint distribution."""
    poses = dict[int, FloatArray]()
    return lambda point: point.sample(rng, poses)


def frame_from_plane(points: PointParser, plane: Sequence[str], origin: str | None, x: str | None) -> NewFrame:
    """Define the frame by the largest plane, or by the plane at picked points."""
    known = points.known
    points_on_plane, description = precise_landmarks(known), "largest plane"
    if list(plane) != [LARGEST]:
        picked_points = np.array([points("--plane", word).position for word in plane])
        distances = np.linalg.norm(points_on_plane[:, None] - picked_points, axis=2).min(axis=1)
        points_on_plane = points_on_plane[distances < PLANE_RADIUS_RATIO * known.radius]
        description = f"plane at {len(picked_points)} picked point{'s' if len(picked_points) > 1 else ''}"
    rng, middle = np.random.default_rng(0), known.frame.from_learned.translation
    with _prefix_errors("--plane:"):
        normal, center, inliers = fit_plane(points_on_plane, known.radius, middle, rng)
    origin_point = None if origin is None else points("--origin", origin)
    x_point = None if x is None else points("--x", x)
    points_on_plane = points_on_plane[inliers]

    def solve_frame(
        normal: FloatArray, center: FloatArray, draw: Callable[[PickedPoint], FloatArray]
    ) -> RigidTransform:
        drawn = (None if point is None else draw(point) for point in (origin_point, x_point))
        return axes_from_plane(normal, center, *drawn)

    def sample_frame(rng: np.random.Generator) -> RigidTransform:
        resampled = points_on_plane[rng.integers(0, len(points_on_plane), len(points_on_plane))]
        return solve_frame(*fit_plane_to_points(resampled, normal), make_joint_sampler(rng))

    frame = solve_frame(normal, center, lambda p: p.position)
    description += f", {len(points_on_plane)} landmarks"
    return NewFrame(frame, estimate_axes_sd(frame, sample_frame), description)


def frame_from_extent(known: KnownObject) -> NewFrame:
    """Define the frame by the principal directions of the landmarks."""
    positions = precise_landmarks(known)
    with _prefix_errors("--extent:"):
        frame = axes_from_extent(positions)
    n = len(positions)
    sd = estimate_axes_sd(frame, lambda rng: axes_from_extent(positions[rng.integers(0, n, n)]))
    return NewFrame(frame, sd, f"extent of {n} landmarks")


def move_frame(points: PointParser, origin: str | None, turn: str | None) -> NewFrame:
    """Move and rotate the present frame; its uncertainty and that of a picked origin are propagated."""
    origin_point = PickedPoint(np.zeros(3), np.zeros((3, 3))) if origin is None else points("--origin", origin)
    angles = np.zeros(3)
    if turn is not None:
        try:
            angles = np.array([float(cell) for cell in turn.split(",")])
        except ValueError:
            angles = np.empty(0)
        if angles.shape != (3,) or not np.isfinite(angles).all():
            raise ValueError(f"--turn: expected three angles in degrees, separated by commas, got {turn!r}")
    axes, sd = Rotation.from_euler("xyz", angles, degrees=True), points.known.frame.sd
    frame = RigidTransform.from_components(origin_point.position, axes).inv()

    def sample_frame(rng: np.random.Generator) -> RigidTransform:
        off = rng.normal(size=6) * sd
        there = RigidTransform.from_components(make_joint_sampler(rng)(origin_point), axes).inv()
        return there * RigidTransform.from_components(off[3:], Rotation.from_rotvec(off[:3]))

    exact = origin_point.is_exact and not sd.any()
    description = " and ".join(w for w, given in (("origin moved", origin), ("axes rotated", turn)) if given)
    if previous := points.known.frame.description:
        description = f"{previous}, {description}"[-200:]
    return NewFrame(frame, np.zeros(6) if exact else estimate_axes_sd(frame, sample_frame), description)


def measure_distance(a: PickedPoint, b: PickedPoint) -> tuple[float, float]:
    """Return the distance of two picked points, and its relative standard deviation.

    Raises:
        ValueError: the points coincide.
    """
    distance = float(np.linalg.norm(b.position - a.position))
    if not distance > 0:
        raise ValueError("--between: the two points coincide")
    samplers = map(make_joint_sampler, [np.random.default_rng(0)] * N_DRAWS)
    return distance, float(np.std([np.linalg.norm(draw(b) - draw(a)) for draw in samplers])) / distance


def change_object_frame(pose: FramePose, new_from_object: RigidTransform) -> FramePose:
    """Re-express a pose with known standard deviations but unknown correlations in another object frame.

    The resulting standard deviations of the position are upper bounds for any correlation of rotation and position
    errors.
    """
    changed = pose.in_object_frame(new_from_object)
    if pose.world_from_object is None or changed.world_from_object is None:
        return pose
    x, y, z = np.abs(changed.world_from_object.translation - pose.world_from_object.translation)
    lever = np.array([[0.0, z, y], [z, 0.0, x], [y, x, 0.0]])
    lever_sd = np.where(lever > 0.0, lever * np.where(lever > 0.0, pose.sigma[:3], 0.0), 0.0).sum(axis=1)
    sd = np.concatenate([pose.sigma[:3], pose.sigma[3:] + lever_sd])
    return replace(changed, covariance=np.diag(sd**2))


def describe_object(known: KnownObject) -> list[tuple[str, str]]:
    """Return the labeled facts that are printed about an object."""
    precise, unit, object_frame = precise_landmarks(known), known.unit, known.frame
    bound = format_length(KNOWN_DEPTH_RATIO * known.radius, unit)
    rotations = Rotation.concatenate([k.world_from_object.rotation for k in known._keyframes])
    angle = np.degrees((rotations * rotations[0].inv()).magnitude().max())
    counts = f"{len(known.positions)} landmarks, {len(precise)} of them with a depth sd below {bound}"
    facts = [
        ("Object", f"{known.fingerprint}, {counts}"),
        ("Keyframes", f"{len(known._keyframes)}, rotated by up to {angle:.0f}°"),
        ("Radius", format_length(known.radius, unit)),
    ]
    if len(precise):
        sizes = " x ".join(format_length(float(s), unit) for s in np.ptp(precise, axis=0))
        facts.append(("Extent", f"{sizes} along its axes"))
    if unit == INITIAL_DISTANCES:
        text = "the first distance from the only camera of its run; set another with sylpose object scale"
    else:
        text = unit or "that of the calibration, which does not state it"
        text += f", all lengths to {100 * known.scale_sd:.2g} %" if known.scale_sd else ""
    facts += [("Unit", text), ("Frame", object_frame.description or "that of the recording of its run")]
    if object_frame.sd.any():
        facts.append(("", format_frame_sd(object_frame.sd, unit)))
    offset, rotation = object_frame.from_learned.translation, object_frame.from_learned.rotation.magnitude()
    if offset.any() or rotation:
        distance = format_length(float(np.linalg.norm(offset)), unit)
        facts.append(("", f"origin {distance} from that of its run, axes rotated by {np.degrees(rotation):.1f}°"))
    return facts


def format_frame_sd(sd: FloatArray, unit: str) -> str:
    """Format the standard deviations of a frame for printing."""
    axes = ", ".join(f"{np.degrees(s):.2f}°" for s in sd[:3])
    return f"origin to {format_length(float(np.linalg.norm(sd[3:])), unit)}, axes to {axes} about x, y, z (one sd)"


def estimate_board_frame(result: ObjectRun, recording: Path, text: str) -> NewFrame:
    """Detect a board in a recording and estimate its frame on the object.

    Args:
        result: result of a run on that recording.
        recording: folder of the recording.
        text: specification of the board, see `boards.specification.parse_board`.

    Returns:
        The transform from the object's frame to the board's, with its standard deviations.

    Raises:
        FileNotFoundError, ValueError: no recording, or other cameras; no board, or one with a rotational symmetry; a
            board that is not detected, or that does not move with the object.
    """
    if result.trajectory.unit == INITIAL_DISTANCES:
        raise ValueError(
            "--board: the object was learned with one camera and has no size: set it with sylpose object scale first"
        )
    board = parse_board(text, result.rig.unit)
    if len(board.symmetries) > 1:
        raise ValueError(
            f"--board {text}: it is symmetric under a rotation, so its axes are ambiguous; use a marker or a ChArUco "
            "board"
        )
    session = open_session(recording).with_rig(result.rig)
    offsets = find_offsets(session)
    session = apply_offsets(session, offsets)
    known = [pose.index for pose in result.trajectory if pose.is_measured and pose.index < session.n_frames]
    if not known:
        raise ValueError(f"{result.path}: no frame of {recording} has a known object pose")
    chosen = [known[k] for k in np.unique(np.linspace(0, len(known) - 1, MAX_FRAMES).round().astype(int))]
    poses, covariances, n_detected = list[RigidTransform](), list[FloatArray](), 0
    for index in chosen:
        detection = find_board(result.rig, next(session.frames(index, index + 1)).images, board)
        n_detected += bool(detection.cameras)
        if detection.motion.status is Status.OK:
            board_pose = make_frame_pose(detection.motion, index, 0.0, detection.motion.n_inliers)
            object_pose = result.pose(index)
            assert board_pose.world_from_object is not None
            assert object_pose.world_from_object is not None
            object_from_board = object_pose.world_from_object.inv() * board_pose.world_from_object
            covariance = board_pose.covariance + object_pose.in_object_frame(object_from_board.inv()).covariance
            rotation = block_diag(*[board_pose.world_from_object.rotation.as_matrix().T] * 2)
            poses.append(object_from_board)
            covariances.append(rotation @ covariance @ rotation.T)
    if not poses:
        reason = f"it was detected in {n_detected or 'none'}" + (", but no pose could be solved" if n_detected else "")
        raise ValueError(f"--board {text}: of {len(chosen)} frames of {recording} {reason}")
    object_from_board, sd, n_agreeing = _average_poses(poses, np.array(covariances))
    if 2 * n_agreeing <= len(poses) or np.rad2deg(sd[:3].max()) > MAX_ROTATION_SD:
        raise ValueError(
            f"--board {text}: its position on the object differs in {len(poses)} frames: not attached, or hardly "
            "visible"
        )
    return NewFrame(object_from_board.inv(), sd, f"{text} on it, detected in {n_agreeing} frames")


def _average_poses(poses: list[RigidTransform], covariances: FloatArray) -> tuple[RigidTransform, FloatArray, int]:
    """Average `object_from_board` over frames with a robust, information-weighted fit.

    Args:
        poses: n transforms object_from_board.
        covariances: (n, 6, 6) covariances of (w, d), in the board's axes.

    Returns:
        The average, its standard deviations (6,), and the number of frames that agree with it.
    """
    information = np.asarray(np.linalg.inv(covariances), float)
    mean = min(
        poses, key=lambda pose: float(np.median(_squared_mahalanobis(_pose_differences(pose, poses), information)))
    )
    for _ in range(ROUNDS):
        differences = _pose_differences(mean, poses)
        squared_distances = _squared_mahalanobis(differences, information)
        # They scatter by more than their covariances if the errors in common differ between frames.
        inflation = max(float(np.median(squared_distances)) / 6.0, 1.0)
        inliers = squared_distances <= chi_squared_bound(6) * inflation
        information_sum = information[inliers].sum(axis=0)
        step = np.linalg.solve(information_sum, np.einsum("nij,nj->i", information[inliers], differences[inliers]))
        mean = mean * RigidTransform.from_components(step[3:], Rotation.from_rotvec(step[:3]))
    n = int(inliers.sum())
    covariance = n * max(float(squared_distances[inliers].mean()) / 6.0, 1.0) * np.linalg.inv(information_sum)
    return mean, np.sqrt(np.diag(covariance) * (COMMON_VARIANCE + (1.0 - COMMON_VARIANCE) / n)), n


def _pose_differences(reference: RigidTransform, poses: list[RigidTransform]) -> FloatArray:
    """Return the differences (w, d), (n, 6), from one pose to each of the others, in its axes."""
    relative = [reference.inv() * pose for pose in poses]
    return np.array([np.concatenate([b.rotation.as_rotvec(), b.translation]) for b in relative])


def _squared_mahalanobis(differences: FloatArray, information: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("ni,nij,nj->n", differences, information, differences))
