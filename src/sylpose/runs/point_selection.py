"""Points picked on an object: by coordinates, by the nearest landmark, or by pixels in a frame of a run."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import FloatArray
from sylpose.input_limits import to_one_line
from sylpose.io import calibration
from sylpose.io.object_files import OBJECT_FILE, load_object
from sylpose.results import FramePose, Trajectory
from sylpose.rig import Camera, Rig, intersect_rays
from sylpose.runs.view import find_calibration, read_result
from sylpose.tracking.known_object import KnownObject

# Landmarks whose depth sd is below this share of the object's radius are precise (choice).
MAX_DEPTH_SD_RATIO = 0.1
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
    trajectory, run_object = read_result(path), load_object(path / OBJECT_FILE)
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
    return np.asarray(known.positions[known.depth_sd < MAX_DEPTH_SD_RATIO * known.radius])


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
    precise = known.depth_sd < MAX_DEPTH_SD_RATIO * known.radius
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
    landmarks = landmarks.subset(landmarks.depth_sd < MAX_DEPTH_SD_RATIO * known.radius)
    covariances = rotation @ np.linalg.inv(landmarks.information) @ rotation.T
    return from_learned.apply(landmarks.mean).reshape(-1, 3), covariances
