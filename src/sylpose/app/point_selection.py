"""Points of an object that somebody picks: by coordinates, by the nearest landmark, or by pixels in a frame of a run."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose import calibration
from sylpose.app.object_files import OBJECT, load_object
from sylpose.app.view import calibration_of, read_result
from sylpose.geometry.arrays import FloatArray
from sylpose.input_limits import one_line
from sylpose.results import FramePose, Trajectory
from sylpose.rig import Camera, Rig, nearest_point_to_rays
from sylpose.tracking.known_object import KnownObject

__all__ = ["KNOWN_DEPTH", "Picked", "Result", "known_well", "picked", "result_of"]

# Landmarks whose depth is known to this share of the object's radius are known well (choice).
KNOWN_DEPTH = 0.1
# Of a pixel that somebody clicks on (choice).
CLICK_PX = 1.5
# Rays that pass each other by more than so many times what clicks are off do not look at one point (choice).
MISSED = 5.0
# One pixel is where landmarks are that the camera saw from nearby, radians, around the object, and that are no further from
# its line of sight than this share of the object's radius; so many of them tell a slope (choice).
NEARBY, BESIDE, NEAREST, SLOPED = np.radians(25.0), 0.25, 20, 6
# By how much a surface may rise or fall beside a line of sight, at a slope that is not told; how uneven it is, as a share of
# the object's radius (choice).
SLOPE, RELIEF = 0.7, 0.01
# Of what is not known at all, radians and lengths (choice).
MOST_SD = 1e3
SAID = '"X,Y,Z", "near X,Y,Z" or "@FRAME CAMERA=U,V CAMERA=U,V"'


@dataclass(frozen=True, eq=False)
class Picked:
    """A point of the object.

    Attributes:
        place: (3,) object's frame; covariance: (3, 3), but for what it shares with other points: the error of the pose that
            the object had in a frame of a run.
        frame: its number, -1 without one; pose_sd: (6,) standard deviations of (w, d) then; by_pose: (3, 6) what they do to
            the place.
    """

    place: FloatArray
    covariance: FloatArray
    frame: int = -1
    pose_sd: FloatArray = field(default_factory=lambda: np.zeros(6))
    by_pose: FloatArray = field(default_factory=lambda: np.zeros((3, 6)))

    @property
    def certain(self) -> bool:
        """Whether it is where it is by definition."""
        return not self.covariance.any() and not self.by_pose.any()

    def drawn(self, rng: np.random.Generator, poses: dict[int, FloatArray]) -> FloatArray:
        """(3,) where it may be as well.

        Args:
            poses: by frame the errors (6,) of its pose, in standard deviations, of this draw: filled in.
        """
        own = rng.multivariate_normal(self.place, self.covariance, method="eigh")
        if self.frame < 0:
            return own
        off = poses.setdefault(self.frame, rng.normal(size=6))
        return np.asarray(own + self.by_pose @ (self.pose_sd * off))


@dataclass(frozen=True, eq=False)
class Result:
    """What a run has found of the object.

    Attributes:
        path: its folder.
        trajectory: told in a frame of the object of its own.
        frame_from_its: from that to the frame that points are picked in.
        rig: that the run has used.
    """

    path: Path
    trajectory: Trajectory
    frame_from_its: RigidTransform
    rig: Rig

    def pose(self, index: int) -> FramePose:
        """Of a frame, by its number in the session.

        Raises:
            ValueError: there is none, or nothing was measured in it.
        """
        found = next((pose for pose in self.trajectory if pose.index == index), None)
        if found is None or not found.measured:
            why = "there is no such frame" if found is None else found.reason or found.status.value
            raise ValueError(f"{self.path}: the object's pose in frame {index} is not known ({why})")
        return found.of_frame(self.frame_from_its)


def result_of(path: Path, known: KnownObject) -> Result:
    """What a run has found of a known object.

    Raises:
        FileNotFoundError, ValueError: naming what is missing; a run of another object.
    """
    trajectory, its = read_result(path), load_object(path / OBJECT)
    if its.mark != known.mark:
        raise ValueError(f"{path}: the run has seen another object, or has learnt it anew")
    if its.unit != known.unit:
        raise ValueError(
            f"{path}: its lengths are in {its.unit or 'no unit'}, those of the object in {known.unit or 'none'}"
        )
    between = known.frame.from_learnt * its.frame.from_learnt.inv()
    return Result(path, trajectory, between, calibration.load(calibration_of(path, None)))


def known_well(known: KnownObject) -> FloatArray:
    """(n, 3) places of the landmarks that are known well, object's frame."""
    return np.asarray(known.places[known.depth_sd < KNOWN_DEPTH * known.radius])


def picked(text: str, known: KnownObject, result: Result | None) -> Picked:
    """What "0.1,0,0.02" (in the object's frame), "near 0.1,0,0.02" (the nearest landmark) or "@42 cam_0=812,400
    cam_2=310,95" (pixels of images as recorded) mean.

    Args:
        result: of a run, for pixels.

    Raises:
        ValueError: anything else; pixels of cameras that it has not, or where nothing is known.
    """
    words = text.split()
    try:
        if len(words) == 1 and not text.startswith("@"):
            return Picked(np.array(_numbers(words[0], 3)), np.zeros((3, 3)))
        if len(words) == 2 and words[0] == "near":
            return _nearest(np.array(_numbers(words[1], 3)), known)
        if len(words) > 1 and (frame := re.fullmatch(r"@(\d{1,12})", words[0])):
            pairs = [word.rpartition("=") for word in words[1:]]
            pixels = {name: np.array(_numbers(cell, 2)) for name, found, cell in pairs if found}
            if len(pixels) == len(words) - 1:
                assert result is not None
                return _seen(pixels, result, int(frame[1]), known)
        raise ValueError(f"a point is {SAID}")
    except ValueError as error:
        raise ValueError(f'"{one_line(text, 100)}": {error}') from None


def _numbers(word: str, n: int) -> list[float]:
    cells = word.split(",")
    try:
        values = [float(cell) for cell in cells]
    except ValueError:
        values = []
    if len(values) != n or not np.isfinite(values).all():
        raise ValueError(
            f"{n} numbers with commas between them are expected, got {one_line(word, 60)}; a point is {SAID}"
        )
    return values


def _nearest(place: FloatArray, known: KnownObject) -> Picked:
    """The landmark nearest to a place, of those that are known well."""
    good = known.depth_sd < KNOWN_DEPTH * known.radius
    if not good.any():
        raise ValueError("no landmark of it is known well")
    places = known.places[good]
    k = int(np.argmin(np.linalg.norm(places - place, axis=1)))
    information = np.concatenate([memory.landmarks.information for memory in known._cameras.values()])[good][k]
    turn = known.frame.from_learnt.rotation.as_matrix()
    return Picked(places[k], turn @ np.linalg.inv(information) @ turn.T)


def _seen(pixels: Mapping[str, FloatArray], result: Result, index: int, known: KnownObject) -> Picked:
    """The point that cameras see at some pixels in a frame."""
    if unknown := [name for name in pixels if name not in result.rig.names]:
        raise ValueError(f"no camera {', '.join(unknown)} in {result.path} ({', '.join(result.rig.names)})")
    pose = result.pose(index)
    assert pose.world_from_object is not None
    object_from_world = pose.world_from_object.inv()
    cameras = [result.rig[name] for name in pixels]
    eyes = np.array([object_from_world.apply(camera.center) for camera in cameras])
    rays = np.array(
        [object_from_world.rotation.apply(c.rays(at)[0]) for c, at in zip(cameras, pixels.values(), strict=True)]
    )
    found = _met(cameras, eyes, rays) if len(cameras) > 1 else _on_surface(cameras[0], eyes[0], rays[0], known)
    # Where the object is not quite where the pose says, the point is another one of it: at -R' (d + w x r).
    x, y, z = pose.world_from_object.rotation.apply(found.place)
    moved = np.array([[0.0, z, -y, 1.0, 0.0, 0.0], [-z, 0.0, x, 0.0, 1.0, 0.0], [y, -x, 0.0, 0.0, 0.0, 1.0]])
    by_pose = -object_from_world.rotation.as_matrix() @ moved
    return replace(found, frame=index, pose_sd=np.minimum(pose.sigma, MOST_SD), by_pose=by_pose)


def _met(cameras: list[Camera], eyes: FloatArray, rays: FloatArray) -> Picked:
    """Where rays meet."""
    place = nearest_point_to_rays(eyes, rays)
    across, information, missed = np.eye(3) - rays[:, :, None] * rays[:, None, :], np.zeros((3, 3)), []
    for camera, eye, other in zip(cameras, eyes, across, strict=True):
        away = float(np.linalg.norm(place - eye))
        information = information + other * (camera.focal / (CLICK_PX * away)) ** 2
        missed.append(float(np.linalg.norm(other @ (place - eye))) / away * camera.focal)
    if max(missed) > MISSED * CLICK_PX or not ((place - eyes) * rays).sum(axis=1).min() > 0:
        said = ", ".join(camera.name for camera in cameras)
        raise ValueError(f"the lines of sight of {said} pass each other by {max(missed):.0f} px: not the same point")
    if not np.linalg.cond(information) < 1e8:
        raise ValueError("the cameras look along the same line: where on it the point is cannot be told")
    return Picked(place, np.asarray(np.linalg.inv(information), float))


def _on_surface(camera: Camera, eye: FloatArray, ray: FloatArray, known: KnownObject) -> Picked:
    """Where a ray goes through what is known of the surface that the camera sees from there."""
    places, covariances = _facing(camera, eye, known)
    off = places - eye
    depth = off @ ray
    beside = off - depth[:, None] * ray
    far = np.linalg.norm(beside, axis=1)
    near = np.argsort(far)[:NEAREST]
    near = near[far[near] < BESIDE * known.radius]
    if not len(near):
        raise ValueError(
            f"no landmark of {camera.name} is near that line of sight; a second camera tells the point, too"
        )
    depth, far = depth[near], far[near]
    # What is a little to the side is a little nearer or further.
    sd = np.sqrt(
        np.einsum("i,nij,j->n", ray, covariances[near], ray) + (SLOPE * far) ** 2 + (RELIEF * known.radius) ** 2
    )
    middle = _weighted_median(depth, sd**-2)
    good = np.abs(depth - middle) < 3.0 * np.maximum(sd, np.median(np.abs(depth - middle)))  # not what is behind it
    depth, sd, across = depth[good], sd[good], (beside[near] @ np.linalg.svd(ray[None])[2][1:].T)[good]
    columns = np.column_stack([np.ones(len(depth)), across]) if len(depth) >= SLOPED else np.ones((len(depth), 1))
    if np.linalg.matrix_rank(columns, RELIEF * known.radius) < columns.shape[1]:
        columns = columns[:, :1]
    if columns.shape[1] > 1:  # then the slope is told
        sd = np.sqrt(np.einsum("i,nij,j->n", ray, covariances[near][good], ray) + (RELIEF * known.radius) ** 2)
    normal = (columns / sd[:, None]).T @ (columns / sd[:, None])
    found = np.linalg.solve(normal, (columns / sd[:, None]).T @ (depth / sd))
    square = float(np.mean(((depth - columns @ found) / sd) ** 2)) * len(depth) / max(len(depth) - columns.shape[1], 1)
    variance = float(np.linalg.inv(normal)[0, 0]) * max(square, 1.0)
    at = float(found[0])
    click = (CLICK_PX * at / camera.focal) ** 2
    return Picked(eye + at * ray, click * np.eye(3) + max(variance - click, 0.0) * np.outer(ray, ray))


def _weighted_median(values: FloatArray, weights: FloatArray) -> float:
    order = np.argsort(values)
    half = np.cumsum(weights[order]) >= 0.5 * weights.sum()
    return float(values[order][np.argmax(half)])


def _facing(camera: Camera, eye: FloatArray, known: KnownObject) -> tuple[FloatArray, FloatArray]:
    """Places (n, 3) and covariances (n, 3, 3) of the camera's landmarks, known well, that it saw from about there."""
    memory = known._cameras.get(camera.name)
    if memory is None:
        raise ValueError(
            f"{camera.name} has not seen the object when it was learnt; a second camera tells the point, too"
        )
    from_learnt, center = known.frame.from_learnt, known.rig[camera.name].center
    middle, turn = from_learnt.translation, from_learnt.rotation.as_matrix()
    there = [from_learnt.apply(k.world_from_object.inv().apply(center)) - middle for k in known._keyframes]
    views = np.array(there) / np.linalg.norm(there, axis=1, keepdims=True)
    here = (eye - middle) / np.linalg.norm(eye - middle)
    near = np.flatnonzero(views @ here > np.cos(NEARBY)).tolist()
    its = memory.landmarks.subset(np.isin(memory.landmarks.id, [n for k in near for n in memory.numbers[k]]))
    its = its.subset(its.depth_sd < KNOWN_DEPTH * known.radius)
    return from_learnt.apply(its.mean).reshape(-1, 3), turn @ np.linalg.inv(its.information) @ turn.T
