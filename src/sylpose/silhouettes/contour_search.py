"""Search for the pose of a known mesh by silhouettes alone: places from centroids, rotations from a cover of SO(3).

All rotations of the cover are drawn small and compared by area; the best are aligned with the outlines. Poses that agree
with the outlines as well are all returned: of a symmetric body there are several.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.robust_loss import chi_squared_bound
from sylpose.mesh import Mesh
from sylpose.rig import Camera, intersect_rays
from sylpose.silhouettes.contours import Alignment, Outline, align_contours, descend, measure_losses
from sylpose.silhouettes.rendering import draw_mask, zoom_camera

# Rotations of the cover: any rotation is within 22 degrees of one of them, half of all within 13 (measured).
N_ROTATIONS = 1000
# Diameter of the object in the small images, pixels, for areas and for the first alignment (choice).
COARSE_PX, MEDIUM_PX = 32, 80
# Poses that are aligned in small images in each round, with so many steps and this noise, and in the images (choice).
N_ALIGNED, COARSE_STEPS, COARSE_SIGMA, N_REFINED = 12, 8, 0.5, 6
# Rotations about each principal axis (derived: half of the cover's spacing).
N_TURNS = 36
# Rotations of the cover that are nearer than this to a better one are not aligned, radians (derived: the cover's spacing).
NEIGHBORS = np.deg2rad(20.0)
# Aligned poses with rotations nearer than this are one, radians (choice: more than errors in small images).
SAME_ROTATION = np.deg2rad(3.0)
# Share of the drawn outline that agrees at least (derived: the majority).
MIN_INLIER_RATIO = 0.5
# Poses whose log-likelihoods differ by less are equally likely (docs/conventions.md, "Limits"), and those whose sectors
# differ by chance with a larger probability (chi-squared: that of the other bounds).
MAX_LOG_ODDS, MAX_CHANCE = 12.0, 0.001
# Parts of a silhouette that may be the object, by area (choice: others are smaller).
MAX_PARTS = 3
# Area of a body relative to that of the ball about it, and its range, a factor of e^1.5 (derived: plates to balls).
TYPICAL_SHARE, SHARE_RANGE = 0.35, 1.5


class _Window(NamedTuple):
    """Part of a small image: its camera, the silhouette (h, w), and where the background is known (h, w)."""

    camera: Camera
    mask: BoolArray
    is_known: BoolArray


def search_contour_poses(mesh: Mesh, outlines: Sequence[Outline]) -> list[Alignment]:
    """Search for all poses of a mesh that agree with the outlines, best first.

    Args:
        mesh: with its origin in its middle.
        outlines: of all cameras with an image.

    Returns:
        The best pose, and those that agree with the outlines as well; none without an object. With more than one, which of
        them is the object's is not known. `is_unique` if all others that were tested are clearly worse.
    """
    radius = float(np.linalg.norm(mesh.vertices, axis=1).max())
    place = _find_place(outlines, radius)
    if place is None:
        return []
    coarse = _make_windows(outlines, place, radius, COARSE_PX)
    medium = _make_windows(outlines, place, radius, MEDIUM_PX)
    if not coarse:
        return []
    small = [outline.reduce(_step_to(outline.camera, place, radius, MEDIUM_PX)) for outline in outlines]

    def descend_all(starts: Sequence[RigidTransform]) -> list[RigidTransform]:
        return [pose for start in starts if (pose := descend(mesh, small, start, COARSE_STEPS)[0]) is not None]

    def sort(poses: Sequence[RigidTransform]) -> tuple[list[RigidTransform], FloatArray]:
        losses = np.array([measure_losses(mesh, small, pose, (COARSE_SIGMA, 1.0), place).ravel() for pose in poses])
        order = _separate(poses, np.argsort(losses.sum(axis=1)), SAME_ROTATION)
        return [poses[k] for k in order], losses[order]

    cover = cover_rotations(N_ROTATIONS)
    if not (starts := descend_all(_rank(mesh, coarse, cover, place, NEIGHBORS))):
        return []
    poses, losses = sort(starts)
    # What looks like the best pose may be the object's as well: first to find the best one, then to find all others.
    for _ in range(2):
        best = poses[0]
        turned = best.rotation * _turn_about_principal_axes(mesh)
        rotations = Rotation.concatenate([turned, _mirror(mesh, best, outlines), cover])
        alike = _rank(mesh, _draw_windows(mesh, coarse, best), rotations, best.translation, NEIGHBORS)
        agreeing = _rank(mesh, medium, turned, best.translation, NEIGHBORS / 2)
        poses, losses = sort([*poses, *descend_all([*alike, *agreeing])])
        if len(_separate([best, poses[0]], np.arange(2), SAME_ROTATION)) == 1:
            break
    likely = [pose for pose, loss in zip(poses, losses, strict=True) if not is_less_likely(loss, losses[0])]
    found = [align_contours(mesh, outlines, pose) for pose in likely[:N_REFINED]]
    supported = [a for a in found if a is not None and a.inliers.sum() >= MIN_INLIER_RATIO * a.points.sum()]
    kept = select_likely(mesh, outlines, supported)
    # Poses that were not compared in the images are no evidence that the other is the only one.
    is_unique = len(kept) == 1 and len(supported) == len(likely)
    return [replace(alignment, is_unique=is_unique) for alignment in kept]


def select_likely(mesh: Mesh, outlines: Sequence[Outline], found: Sequence[Alignment]) -> list[Alignment]:
    """Return the best of the poses, and those that are not clearly worse, best first, without duplicates."""
    if len(found) < 2:
        return list(found)
    sharpest = min(found, key=lambda alignment: alignment.sigma)
    noise, center = (sharpest.sigma, sharpest.correlation), sharpest.world_from_object.translation
    losses = [measure_losses(mesh, outlines, a.world_from_object, noise, center).ravel() for a in found]
    order = np.argsort([loss.sum() for loss in losses])
    kept = list[Alignment]()
    for k in order:
        if not is_less_likely(losses[k], losses[order[0]]) and not any(_is_same(other, found[k]) for other in kept):
            kept.append(found[k])
    return kept


def is_less_likely(losses: FloatArray, least: FloatArray) -> bool:
    """Return whether a pose is less likely than another by the losses (n,) of sectors that count as independent.

    The likelihood holds for noise. Errors of silhouettes are not noise: what one sector shows may be one. Of poses that are
    equally likely the differences are as often positive as negative, and their sum exceeds t times the root of the sum of
    their squares with a probability of exp(-t^2 / 2) at most.

    Source: B. Efron, "Student's t-test under symmetry conditions", 1969. Compare Q. Vuong, "Likelihood ratio tests for
    model selection and non-nested hypotheses", 1989.
    """
    difference = losses - least
    total = float(difference.sum())
    return total > MAX_LOG_ODDS and total**2 > -2 * np.log(MAX_CHANCE) * float(difference @ difference)


def _is_same(a: Alignment, b: Alignment) -> bool:
    """Return whether a pose is within the uncertainty of another (derived: chi-squared of six unknowns, 0.001)."""
    first, second = a.world_from_object, b.world_from_object
    w = (second.rotation * first.rotation.inv()).as_rotvec()
    error = np.concatenate([w, second.translation - first.translation])
    return bool(error @ np.linalg.solve(a.covariance + b.covariance, error) < chi_squared_bound(6))


def _separate(poses: Sequence[RigidTransform], order: IntArray, angle: float, most: int | None = None) -> list[int]:
    """Return the numbers of poses, in an order, without those whose rotation is nearer than an angle to an earlier one."""
    kept = list[int]()
    for k in order.tolist():
        if all((poses[k].rotation * poses[other].rotation.inv()).magnitude() > angle for other in kept):
            kept.append(k)
        if len(kept) == most:
            break
    return kept


def _find_principal_axes(mesh: Mesh) -> FloatArray:
    """Return the principal axes of inertia (3, 3) of a surface, as rows."""
    corners = mesh.vertices[mesh.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    # The midpoints of a triangle's edges have its second moments.
    points = np.concatenate([(corners[:, k] + corners[:, k - 1]) / 2 for k in range(3)])
    weights = np.tile(area, 3)
    centered = points - np.average(points, axis=0, weights=weights)
    return np.linalg.eigh((centered * weights[:, None]).T @ centered)[1].T


def _turn_about_principal_axes(mesh: Mesh) -> Rotation:
    """Return rotations of the mesh about its principal axes of inertia, also after half a turn about another."""
    axes = _find_principal_axes(mesh)
    angles = np.linspace(0, 2 * np.pi, N_TURNS, endpoint=False)
    spins = Rotation.from_rotvec((angles[:, None, None] * axes).reshape(-1, 3))
    flips = Rotation.from_rotvec(np.pi * axes)
    return Rotation.concatenate([spins, *(spins * flip for flip in flips)])


def _mirror(mesh: Mesh, pose: RigidTransform, outlines: Sequence[Outline]) -> Rotation:
    """Return rotations after which a body with a plane or center of symmetry looks alike from far away.

    They are its mirror images in the image plane of a camera, or of all cameras in the mean.
    """
    views = [outline.camera.direction for outline in outlines]
    mean = np.mean(views, axis=0)
    views.append(mean / max(float(np.linalg.norm(mean)), 1e-9))
    symmetries = [*(np.eye(3) - 2 * np.outer(axis, axis) for axis in _find_principal_axes(mesh)), -np.eye(3)]
    matrix = pose.rotation.as_matrix()
    return Rotation.from_matrix(
        [(np.eye(3) - 2 * np.outer(view, view)) @ matrix @ symmetry for view in views for symmetry in symmetries]
    )


def cover_rotations(n: int) -> Rotation:
    """Return n rotations that cover SO(3) evenly: super-Fibonacci spirals.

    Source: M. Alexa, "Super-Fibonacci spirals: fast, low-discrepancy sampling of SO(3)", 2022.
    """
    s = np.arange(n) + 0.5
    r, cr = np.sqrt(s / n), np.sqrt(1 - s / n)
    alpha, beta = 2 * np.pi * s / 2**0.5, 2 * np.pi * s / 1.533751168755204288118041
    return Rotation.from_quat(
        np.stack([r * np.sin(alpha), r * np.cos(alpha), cr * np.sin(beta), cr * np.cos(beta)], axis=1)
    )


def _find_place(outlines: Sequence[Outline], radius: float) -> FloatArray | None:
    """Return the place (3,) where most silhouettes have a part that may be the object; None without any.

    Places are where rays through the centroids of two cameras' parts meet; of one camera, where a part has a ball's size.
    """
    parts = [(outline.camera, *_find_parts(outline)) for outline in outlines]
    if len(parts) == 1:
        ((camera, centers, areas),) = parts
        distances = radius * camera.focal / np.sqrt(np.maximum(areas, 1) / np.pi)
        places = list(camera.center + distances[:, None] * camera.rays(centers)) if len(centers) else []
    else:
        places = [
            _meet([(camera, p), (other, q)])
            for (camera, centers, _), (other, others, _) in combinations(parts, 2)
            for p in centers
            for q in others
        ]
    best, least = None, float(len(parts))
    for place in places:
        nearest, cost = list[tuple[Camera, FloatArray]](), 0.0
        for camera, centers, areas in parts:
            depth = float(camera.camera_from_world.apply(place)[2])
            size = radius * camera.focal / depth  # pixels
            away = np.linalg.norm(centers - camera.project(place)[0], axis=1) / size if depth > 0 else np.empty(0)
            share = areas[: len(away)] / (np.pi * size**2)
            squares = away**2 + (np.log(np.maximum(share, 1e-9) / TYPICAL_SHARE) / SHARE_RANGE) ** 2
            k = int(np.argmin(squares)) if len(away) else -1
            cost += min(float(squares[k]), 1.0) if k >= 0 else 1.0
            if k >= 0 and squares[k] < 1:
                nearest.append((camera, centers[k]))
        if nearest and cost < least:
            best, least = (_meet(nearest) if len(nearest) > 1 else place), cost
    return best


def _meet(sights: Sequence[tuple[Camera, FloatArray]]) -> FloatArray:
    """Return the point nearest to the rays of pixels."""
    rays = np.concatenate([camera.rays(pixel[None]) for camera, pixel in sights])
    return intersect_rays(np.stack([camera.center for camera, _ in sights]), rays)


def _find_parts(outline: Outline) -> tuple[FloatArray, FloatArray]:
    """Return the centroids (n, 2) and areas (n,) of the largest parts of a silhouette."""
    is_shown = (outline.distance > 0) & outline.is_known
    _, _, statistics, centers = cv2.connectedComponentsWithStats(is_shown.astype(np.uint8))
    areas = statistics[1:, cv2.CC_STAT_AREA].astype(float)
    order = np.argsort(-areas)[:MAX_PARTS]
    return np.asarray(centers[1:][order], float), np.asarray(areas[order], float)


def _step_to(camera: Camera, place: FloatArray, radius: float, size: float) -> int:
    """Return the whole factor by which images are reduced to show the object with about this diameter, pixels."""
    depth = float(camera.camera_from_world.apply(place)[2])
    # A camera may be in it, or look away from it.
    return int(np.clip(2 * radius * camera.focal / max(depth, 1e-9) / size, 1, min(camera.size)))


def _make_windows(outlines: Sequence[Outline], place: FloatArray, radius: float, size: float) -> list[_Window]:
    """Return small images around a place of the cameras that see it."""
    windows = list[_Window]()
    for outline in outlines:
        small = outline.reduce(_step_to(outline.camera, place, radius, size))
        middle, depth = small.camera.project(place)[0], float(small.camera.camera_from_world.apply(place)[2])
        if not np.isfinite(middle).all():
            continue
        reach, sides = 2 * radius * small.camera.focal / depth, np.array(small.camera.size)
        first = np.clip(np.floor(middle - reach), 0, sides).astype(int)
        end = np.clip(np.ceil(middle + reach), 0, sides).astype(int)
        if (end > first).all():
            part = slice(first[1], end[1]), slice(first[0], end[0])
            is_known = small.is_known[part]
            windows.append(
                _Window(zoom_camera(small.camera, (first, end)), (small.distance[part] > 0) & is_known, is_known)
            )
    return windows


def _draw_windows(mesh: Mesh, windows: Sequence[_Window], pose: RigidTransform) -> list[_Window]:
    """Return the windows with the silhouettes of a mesh at a pose, known everywhere."""
    vertices = pose.apply(mesh.vertices)
    return [_Window(w.camera, draw_mask(mesh, w.camera, vertices), np.ones_like(w.is_known)) for w in windows]


def _rank(
    mesh: Mesh, windows: Sequence[_Window], rotations: Rotation, place: FloatArray, apart: float
) -> list[RigidTransform]:
    """Return the poses with the rotations whose areas agree best with the silhouettes, moved to agree in their centroids.

    Args:
        mesh: the body.
        windows: small images.
        rotations: (n,).
        place: (3,) first translation of all poses.
        apart: least angle between two of the poses.
    """
    matrices = rotations.as_matrix()
    drawn = [_draw_all(mesh, window, matrices, np.tile(place, (len(matrices), 1))) for window in windows]
    rows, values = list[FloatArray](), list[FloatArray]()
    for (camera, mask, _), masks in zip(windows, drawn, strict=True):
        depth = float(camera.camera_from_world.apply(place)[2])
        area, areas = max(float(mask.sum()), 1.0), np.maximum(masks.sum(axis=(1, 2)), 1.0)
        for axis in (0, 1):
            numbers = np.arange(mask.shape[1 - axis])
            shifts = mask.sum(axis=axis) @ numbers / area - masks.sum(axis=1 + axis) @ numbers / areas
            rows.append(camera.rotation[axis])
            values.append(shifts * depth / camera.focal)
        if len(windows) == 1:  # its distance is that of its area
            rows.append(camera.rotation[2])
            values.append(depth * (np.sqrt(areas / area) - 1))
    moves = np.linalg.lstsq(np.array(rows), np.array(values), rcond=None)[0].T
    places, score = place + moves, np.zeros(len(matrices))
    for window in windows:
        masks, mask = _draw_all(mesh, window, matrices, places), window.mask
        both = (masks & mask).sum(axis=(1, 2))
        score += both / np.maximum(masks.sum(axis=(1, 2)) + mask.sum() - both, 1.0)
    poses = [RigidTransform.from_components(*of_pose) for of_pose in zip(places, rotations, strict=True)]
    return [poses[k] for k in _separate(poses, np.argsort(score)[::-1], apart, N_ALIGNED)]


def _draw_all(mesh: Mesh, window: _Window, rotations: FloatArray, places: FloatArray) -> BoolArray:
    """Return the masks (n, h, w) of a mesh with rotations (n, 3, 3) at places (n, 3), where the background is known."""
    masks = np.zeros((len(rotations), *window.mask.shape), bool)
    for mask, rotation, place in zip(masks, rotations, places, strict=True):
        mask[:] = draw_mask(mesh, window.camera, mesh.vertices @ rotation.T + place) & window.is_known
    return masks
