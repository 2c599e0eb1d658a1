"""Alignment of a known mesh with the outlines of its silhouettes in all cameras, and the pose's covariance.

At a pose the mesh's rim is the outline that each camera would show. Along it the signed distance to the observed outline is
a measurement. Neighbors along an outline have similar errors: the covariance is multiplied by the correlation length of the
residuals. The errors' common part in a camera, an outline too far outside or inside, is an unknown with a prior. Errors of
the calibration are in the covariance as far as the cameras disagree. Compare M. Stoiber and others, "SRT3D: a sparse
region-based 3D object tracking approach for the real world", 2022: color statistics on both sides of the outline, without a
background.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import BoolArray, FloatArray, FloatImage, IntArray
from sylpose.geometry.matrices import enlarge_covariance
from sylpose.geometry.robust_loss import biquartic_losses, biquartic_weights, robust_sigma
from sylpose.mesh import Mesh
from sylpose.relative_pose.camera_evidence import FOCAL_ERROR_SD, ROTATION_ERROR_SD
from sylpose.rig import Camera
from sylpose.silhouettes.background import OUTLINE_PX, Silhouette
from sylpose.silhouettes.rendering import zoom_camera
from sylpose.silhouettes.rim import Rim, find_rim
from sylpose.silhouettes.visual_hull import SUBPIXELS, measure_outline_distances

# Least standard deviation of an outline, pixels (derived: the subdivision of pixels for distances, uniformly distributed).
MIN_SIGMA = 12.0**-0.5 / SUBPIXELS
# Residuals beyond so many standard deviations have no weight (derived: 95 % efficiency at 4.7 for similar functions).
CUTOFF = 5.0
# Standard deviation of the common error of all outlines in a camera, pixels (measured: blur and the threshold between object
# and background move the outlines of rendered bodies by 0.1 to 0.3 pixels).
OFFSET_SD = 0.3
# Steps at most; a pose has converged where the squared step is less than this part of its variance (choice: a fifth of the
# standard deviation).
MAX_STEPS, STEP_TOLERANCE = 12, 0.04
# Standard deviation of a step's prior, in radii of the object: less than a turn onto another side (choice).
MAX_STEP = 0.3
# Rotation of the drawings for derivatives, radians (choice: ten degrees, more than the facets of round meshes), and standard
# deviation of their outlines, pixels (derived: facets of a circle of 100 pixels at most half of that rotation wide).
DIFFERENCE, DRAWING_SD = np.deg2rad(10.0), 0.2
# Standard deviation of a rotation of which nothing is known, radians (derived: uniform up to half a turn).
ANY_ANGLE_SD = np.pi / 3**0.5
# Segments of each part of an outline that count as independent (choice: several for each unknown, each longer than errors),
# and sectors of each image (measured: mugs in rendered rooms. Differences to poses whose losses are higher by 400 exceed
# 3.7 standard deviations by 1.1 to 1.9 with 16, by 0 to 0.5 with 8; with 32 those to poses that look the same reach 3.5.)
SEGMENTS, SECTORS = 8, 16
# Points of an outline that determine a pose at least (derived: three for each unknown).
MIN_POINTS = 18
# Unknowns of a camera's own pose (derived), and rounds of its weights (choice: as many again change nothing).
N_OWN, OWN_ROUNDS = 6, 4
# Way from a pixel along the mesh's image to the rim, pixels (derived: more than a pixel's diagonal).
MAX_WAY = 1.5


@dataclass(frozen=True, eq=False)
class Outline:
    """Outlines of what is before the background of a camera.

    Attributes:
        camera: the camera.
        distance: (h, w) signed distance to them, pixels, positive inside.
        is_known: (h, w) whether the background around the pixel is known, so that an outline there is an edge of a body.
        pixels: (n, 2) pixels along them, as integers u, v.
    """

    camera: Camera
    distance: FloatImage
    is_known: BoolArray
    pixels: IntArray

    def reduce(self, step: int) -> Outline:
        """Return the outlines in an image that is smaller by a whole factor."""
        if step == 1:
            return self
        width, height = (side // step for side in self.camera.size)
        camera = zoom_camera(self.camera, (np.zeros(2, int), step * np.array([width, height])), 1 / step)
        parts = [np.asarray(of[: height * step, : width * step], np.float32) for of in (self.distance, self.is_known)]
        distance, known = (cv2.resize(of, (width, height), interpolation=cv2.INTER_AREA) for of in parts)
        pixels = np.unique(self.pixels // step, axis=0)
        pixels = pixels[(pixels < [width, height]).all(axis=1)]
        return Outline(camera, np.asarray(distance / step, np.float32), np.asarray(known > 1 - 0.5 / step**2), pixels)

    @classmethod
    def of(cls, camera: Camera, silhouette: Silhouette) -> Outline:
        """Return the outlines of a camera's silhouette."""
        around = np.ones((2 * OUTLINE_PX + 1,) * 2, np.uint8)
        unknown = cv2.dilate((silhouette.log_odds == 0).astype(np.uint8), around)
        is_known = np.asarray(unknown == 0)
        pixels = np.concatenate([np.empty((0, 2), int), *_trace_outlines(silhouette.share > 0.5)])
        pixels = pixels[is_known[pixels[:, 1], pixels[:, 0]]]
        return cls(camera, measure_outline_distances(silhouette), is_known, pixels)


@dataclass(frozen=True, eq=False)
class Contour:
    """A mesh's drawn outline in one camera, with its distances to the observed one.

    Attributes:
        rim: the mesh's rim.
        points: (n, 3) of the rim next to the pixels, in the world.
        pixels: (n, 2) along the mesh's image, in order along each part of the outline.
        normals: (n, 2) outward unit normals.
        residuals: (n,) how far outside the observed outline is, pixels; NaN where it is not known.
        part: (n,) number of the part of the outline.
    """

    rim: Rim
    points: FloatArray
    pixels: FloatArray
    normals: FloatArray
    residuals: FloatArray
    part: IntArray


@dataclass(frozen=True, eq=False)
class Alignment:
    """Pose of a mesh that agrees best with the outlines near a start.

    Attributes:
        world_from_object: the pose.
        covariance: (6, 6) of (w, d), docs/conventions.md; along rotations that no outline shows that of any angle.
        sigma: robust standard deviation of the residuals, pixels.
        correlation: number of neighboring residuals that count as one.
        inliers: (C,) number of points of the outline that agree; `points`: (C,) of all.
        points: (C,) number of points of the outline whose distance is known.
        residuals: (C,) rms residual of the inliers, pixels; NaN without.
        has_converged: whether the last step was short.
        excess: (C,) by which the pose explains each camera's outline worse than a pose of its own, beyond what errors of
            calibrations explain: at most about six without a contradiction; NaN without evidence.
        is_unique: whether a search has shown that no other pose agrees as well; False if there was none.
    """

    world_from_object: RigidTransform
    covariance: FloatArray
    sigma: float
    correlation: float
    inliers: IntArray
    points: IntArray
    residuals: FloatArray
    has_converged: bool
    excess: FloatArray
    is_unique: bool = False


def _trace_outlines(mask: BoolArray) -> list[IntArray]:
    """Return the outermost pixels (n, 2), u and v, of each part of a mask, in order; not those at the image's border."""
    traced, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    last = np.array(mask.shape[::-1]) - 1
    parts = [np.asarray(part[:, 0], int) for part in traced]
    return [part[((part > 0) & (part < last)).all(axis=1)] for part in parts]


def measure_contour(mesh: Mesh, outline: Outline, world_from_object: RigidTransform) -> Contour | None:
    """Measure the distances of a mesh's outline in a camera to the observed one; None if it is not in view."""
    camera, rim = outline.camera, find_rim(mesh, outline.camera, world_from_object)
    if rim is None or not len(rim.points):
        return None
    parts = _trace_outlines(rim.mask)
    pixels = np.concatenate([np.empty((0, 2), int), *parts]) + rim.corner
    at_border = ((pixels == 0) | (pixels == np.array(camera.size) - 1)).any(axis=1)
    nearest = rim.find_nearest(pixels)
    away, normals = pixels - rim.pixels[nearest], rim.normals[nearest]
    observed = outline.distance[pixels[:, 1], pixels[:, 0]].astype(float)
    # The point of the observed outline that the distance is of.
    slope = _sample_gradient(outline.distance, pixels)
    foot = np.rint(pixels - observed[:, None] * slope).astype(int)
    foot = np.clip(foot, 0, np.array(camera.size) - 1)
    is_known = outline.is_known[foot[:, 1], foot[:, 0]] & ~at_border & (np.linalg.norm(away, axis=1) < MAX_WAY)
    residuals = np.where(is_known, observed + (away * normals).sum(axis=1), np.nan)
    number = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    return Contour(rim, rim.points[nearest], pixels.astype(float), normals, residuals, number)


def _sample_gradient(distance: FloatImage, pixels: IntArray) -> FloatArray:
    """Return the gradient (n, 2) of an image at pixels (n, 2) by central differences."""
    u, v = pixels.T
    height, width = distance.shape
    left, right = np.maximum(u - 1, 0), np.minimum(u + 1, width - 1)
    up, down = np.maximum(v - 1, 0), np.minimum(v + 1, height - 1)
    du = (distance[v, right] - distance[v, left]) / np.maximum(right - left, 1)
    dv = (distance[down, u] - distance[up, u]) / np.maximum(down - up, 1)
    return np.stack([du, dv], axis=1).astype(float)


def differentiate_contour(contour: Contour, camera: Camera, center: FloatArray) -> FloatArray:
    """Return the derivative (n, 6) of a drawn outline's way outwards, pixels, by (w, d) about a center (3,)."""
    points, step = contour.points, 1e-4 * float(np.linalg.norm(center - camera.center))
    by_point = np.empty((len(points), 3))
    for axis, shift in enumerate(step * np.eye(3)):
        moved = camera.project(points + shift) - camera.project(points - shift)
        by_point[:, axis] = (moved * contour.normals).sum(axis=1) / (2 * step)
    return np.hstack([np.cross(points - center, by_point), by_point])


def move(pose: RigidTransform, center: FloatArray, step: FloatArray) -> RigidTransform:
    """Return a pose after a rotation w about a center (3,) and a translation d, step (6,)."""
    rotation = Rotation.from_rotvec(step[:3])
    about = RigidTransform.from_components(center + step[3:] - rotation.apply(center), rotation)
    return about * pose


def align_contours(
    mesh: Mesh, outlines: Sequence[Outline], start: RigidTransform, max_steps: int = MAX_STEPS
) -> Alignment | None:
    """Align a mesh with outlines by Gauss-Newton steps with robust weights.

    Args:
        mesh: with its origin in its middle, about which the pose's rotation is.
        outlines: of all cameras with an image.
        start: world_from_object near the pose.
        max_steps: number of steps at most.

    Returns:
        The pose; None if too little of its outline can be compared.
    """
    pose, has_converged = descend(mesh, outlines, start, max_steps)
    fit = None if pose is None else _fit_contours(mesh, outlines, pose)
    if pose is None or fit is None:
        return None
    pairs = zip(fit.contours, fit.outlines, strict=True)
    jacobians = [differentiate_contour(contour, outline.camera, pose.translation) for contour, outline in pairs]
    adjusted, with_errors = _compare_cameras(fit, jacobians, pose.translation)
    covariance = enlarge_covariance(_estimate_covariance(mesh, fit, pose, jacobians), with_errors)
    excess = np.full(len(outlines), np.nan)
    excess[fit.cameras] = adjusted
    inliers, points, rms = np.zeros(len(outlines), int), np.zeros(len(outlines), int), np.full(len(outlines), np.nan)
    for c, r, w in zip(fit.cameras, fit.residuals, fit.weights, strict=True):
        inliers[c], points[c] = (w > 0).sum(), np.isfinite(r).sum()
        rms[c] = np.sqrt(np.mean(np.square(r[w > 0]))) if inliers[c] else np.nan
    return Alignment(pose, covariance, fit.sigma, fit.correlation, inliers, points, rms, has_converged, excess)


def descend(
    mesh: Mesh, outlines: Sequence[Outline], start: RigidTransform, max_steps: int = MAX_STEPS
) -> tuple[RigidTransform | None, bool]:
    """Return the pose of `align_contours`, None if too little can be compared, and whether it has converged."""
    pose, radius = start, float(np.linalg.norm(mesh.vertices, axis=1).max())
    for _ in range(max_steps):
        fit = _fit_contours(mesh, outlines, pose)
        if fit is None:
            return None, False
        jacobians = [
            differentiate_contour(contour, outline.camera, pose.translation)
            for contour, outline in zip(fit.contours, fit.outlines, strict=True)
        ]
        information, gradient = _make_normal_equations(fit, jacobians)
        damping = np.diag((np.repeat([1.0, radius], 3) * MAX_STEP) ** -2)
        step = np.asarray(np.linalg.solve(information + damping, gradient), float)
        pose = move(pose, pose.translation, step)
        if gradient @ step < STEP_TOLERANCE:
            return pose, True
    return pose, False


def measure_losses(
    mesh: Mesh,
    outlines: Sequence[Outline],
    pose: RigidTransform,
    alignment_noise: tuple[float, float],
    center: FloatArray,
) -> FloatArray:
    """Return the robust negative log-likelihood of a pose, by sectors of the images about a center.

    Both drawn and observed outlines count, so that neither a part of the mesh nor one of the silhouette may remain without
    the other; what other bodies add is the same for all poses.

    Args:
        mesh, outlines, pose: what is compared.
        alignment_noise: sigma and correlation, as of `Alignment`.
        center: (3,) the same for all poses that are compared.

    Returns:
        (C, SECTORS) up to the same constants for all poses; inf without the mesh in any image.
    """
    sigma, correlation = alignment_noise
    losses, is_seen = np.zeros((len(outlines), SECTORS)), False
    for of_camera, outline in zip(losses, outlines, strict=True):
        contour = measure_contour(mesh, outline, pose)
        pixels, squares = outline.pixels.astype(float), np.full(len(outline.pixels), np.inf)
        if contour is not None:
            is_seen, is_known = True, np.isfinite(contour.residuals)
            pixels = np.concatenate([contour.pixels[is_known], pixels])
            u, v = outline.pixels.T
            unexplained = outline.distance[v, u] - contour.rim.measure_distances(outline.pixels.astype(float))
            distances = np.concatenate([contour.residuals[is_known], unexplained])
            squares = np.square((distances - _find_offset(contour.residuals)) / (CUTOFF * sigma))
        x, y = (pixels - np.nan_to_num(outline.camera.project(center)[0])).T
        sector = np.floor((np.arctan2(y, x) / (2 * np.pi) + 0.5) * SECTORS).astype(int) % SECTORS
        # Each error counts on both sides.
        of_camera += np.bincount(sector, biquartic_losses(squares), SECTORS) / 2
    return 0.5 * CUTOFF**2 * losses / correlation if is_seen else np.full_like(losses, np.inf)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Contours of a pose in the cameras that show it, with their robust weights.

    Attributes:
        cameras: numbers of the cameras.
        outlines, contours: theirs.
        residuals: per camera (n,) without the common error, pixels; NaN where nothing is known.
        weights: per camera (n,), 0 for outliers and unknown ones.
        sigma, correlation: as of `Alignment`.
    """

    cameras: list[int]
    outlines: list[Outline]
    contours: list[Contour]
    residuals: list[FloatArray]
    weights: list[FloatArray]
    sigma: float
    correlation: float

    @property
    def variance(self) -> float:
        """Variance of a residual as if its neighbors were independent, pixels^2; unknowns make residuals smaller."""
        effective = sum(float((weight > 0).sum()) for weight in self.weights) / self.correlation
        return self.sigma**2 * self.correlation * effective / max(effective - 6 - len(self.cameras), 1.0)


def _fit_contours(mesh: Mesh, outlines: Sequence[Outline], pose: RigidTransform) -> _Fit | None:
    """Measure the contours of a pose and their noise; None with fewer points than unknowns."""
    found = [(c, outline, measure_contour(mesh, outline, pose)) for c, outline in enumerate(outlines)]
    kept = [(c, outline, contour) for c, outline, contour in found if contour is not None]
    residuals = [contour.residuals - _find_offset(contour.residuals) for _, _, contour in kept]
    known = np.concatenate([np.empty(0), *(r[np.isfinite(r)] for r in residuals)])
    if len(known) < MIN_POINTS:
        return None
    sigma = robust_sigma(known, MIN_SIGMA)
    weights = [biquartic_weights(np.square(r / (CUTOFF * sigma))) * np.isfinite(r) for r in residuals]
    cameras, of_cameras, contours = (list(part) for part in zip(*kept, strict=True))
    correlation = measure_correlation(contours, residuals, weights)
    return _Fit(cameras, of_cameras, contours, residuals, weights, sigma, correlation)


def _find_offset(residuals: FloatArray) -> float:
    """Return the common error of a camera's residuals, at most twice its standard deviation."""
    known = residuals[np.isfinite(residuals)]
    return float(np.clip(np.median(known), -2 * OFFSET_SD, 2 * OFFSET_SD)) if len(known) else 0.0


def measure_correlation(
    contours: Sequence[Contour], residuals: Sequence[FloatArray], weights: Sequence[FloatArray]
) -> float:
    """Return how many neighboring residuals count as one: 1 + twice the sum of their autocorrelations up to its first zero.

    Source: C. Geyer, "Practical Markov chain Monte Carlo", 1992 (initial sequences).
    """
    longest = max(len(contour.residuals) for contour in contours)
    products, counts = np.zeros(longest), np.zeros(longest)
    for contour, residual, weight in zip(contours, residuals, weights, strict=True):
        scored = np.where(weight > 0, np.nan_to_num(residual) * weight, 0.0)
        for number in np.unique(contour.part):
            x, is_used = scored[contour.part == number], (weight[contour.part == number] > 0).astype(float)
            n = len(x)
            products[:n] += np.correlate(x, x, "full")[n - 1 :]
            counts[:n] += np.correlate(is_used, is_used, "full")[n - 1 :]
    covariance = products / np.maximum(counts, 1.0)
    relative = covariance[1 : longest // 4] / max(covariance[0], 1e-300)
    below = np.flatnonzero(relative <= 0)
    return float(1 + 2 * relative[: below[0] if len(below) else None].sum())


def _make_normal_equations(fit: _Fit, jacobians: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return the information (6, 6) and its gradient (6,) of all cameras, the common error of each eliminated."""
    information, gradient = np.zeros((6, 6)), np.zeros(6)
    for contour, weight, jacobian in zip(fit.contours, fit.weights, jacobians, strict=True):
        weighted = jacobian * weight[:, None]
        r = np.nan_to_num(contour.residuals)
        common = weighted.sum(axis=0) / (weight.sum() + fit.variance / OFFSET_SD**2)
        information += (weighted.T @ jacobian - np.outer(common, weighted.sum(axis=0))) / fit.variance
        gradient += (weighted.T @ r - common * (weight @ r)) / fit.variance
    return information, gradient


def _compare_cameras(fit: _Fit, jacobians: Sequence[FloatArray], center: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Compare the pose with the best one of each camera alone, in whose residuals its noise is measured.

    Returns:
        per camera the excess of the pose's squared residuals, if its calibration may be off as usual, NaN with fewer points
        than unknowns; (6, 6) covariance of the pose with errors of calibrations as large as the cameras' disagreement shows.

    Source: as `relative_pose.camera_evidence`; R. DerSimonian and N. Laird, "Meta-analysis in clinical trials", 1986.
    """
    adjusted, total, n = np.full(len(jacobians), np.nan), 0.0, 0
    informations, errors = list[FloatArray](), list[FloatArray]()
    for k, jacobian in enumerate(jacobians):
        contour, residual = fit.contours[k], np.nan_to_num(fit.residuals[k])
        is_known = np.isfinite(fit.residuals[k])
        if np.count_nonzero(is_known) < MIN_POINTS:
            continue
        ray = center - fit.outlines[k].camera.center
        distance = float(np.linalg.norm(ray))
        # A rotation of the camera moves the object across its ray, an error of the focal length along it.
        along = np.outer(ray, ray) / distance**2
        error = block_diag(np.eye(3) * ROTATION_ERROR_SD**2, (np.eye(3) - along) * (ROTATION_ERROR_SD * distance) ** 2)
        error[3:, 3:] += along * (FOCAL_ERROR_SD * distance) ** 2
        # Nothing is known of directions that this camera does not show.
        weak, own = np.diag(np.repeat([ANY_ANGLE_SD, distance], 3) ** -2.0), residual
        for _ in range(OWN_ROUNDS):  # what is an outlier for all cameras may agree with its own pose
            sigma = robust_sigma(own[is_known], MIN_SIGMA)
            weight = biquartic_weights(np.square(own / (CUTOFF * sigma))) * is_known
            hessian, gradient = jacobian.T @ (jacobian * weight[:, None]), jacobian.T @ (weight * residual)
            own = residual - jacobian @ np.linalg.solve(hessian + weak * MIN_SIGMA**2, gradient)
        if weight.sum() < MIN_POINTS:
            continue
        variance = max(float(weight @ own**2) / (weight.sum() - N_OWN), MIN_SIGMA**2)
        variance *= measure_correlation([contour], [own], [weight])
        information, score = hessian / variance + weak, gradient / variance
        excess = float(score @ np.linalg.solve(information, score))
        adjusted[k] = excess - score @ np.linalg.solve(information + np.linalg.inv(error), score)
        total, n = total + excess, n + 1
        informations.append(information)
        errors.append(error)
    if not informations:
        return adjusted, np.zeros((6, 6))
    both = list(zip(informations, errors, strict=True))
    joint = np.linalg.inv(sum(informations, np.zeros((6, 6))))
    expected = sum(float(np.trace(i @ e) - np.trace(joint @ i @ e @ i)) for i, e in both)
    scale = max(total - N_OWN * (n - 1), 0.0) / expected if n > 1 else 0.0
    widened = [np.linalg.inv(np.linalg.inv(i) + scale * e) for i, e in both]
    return adjusted, np.asarray(np.linalg.inv(sum(widened, np.zeros((6, 6)))), float)


def _estimate_covariance(mesh: Mesh, fit: _Fit, pose: RigidTransform, of_points: Sequence[FloatArray]) -> FloatArray:
    """Return the covariance (6, 6) of (w, d): the largest of three estimates in any direction.

    Derivatives are those of the points of the outline, and by drawings after larger rotations; the noise is the mean along
    all outlines, and that of each segment (cluster-robust). On round surfaces other points become the outline as the object
    rotates: no rotation about its axis changes the outline of a body of revolution, although its points move.
    """
    distance = float(np.mean([np.linalg.norm(pose.translation - o.camera.center) for o in fit.outlines]))
    prior = np.diag(np.repeat([ANY_ANGLE_SD, distance], 3) ** -2.0)
    pairs = list(zip(fit.contours, fit.outlines, strict=True))
    information, _ = _make_normal_equations(fit, of_points)
    covariance = np.asarray(np.linalg.inv(information + prior), float)
    # Larger rotations do not add up: they are about the axis that is least certain, and those across it.
    axes = np.linalg.eigh(covariance[:3, :3])[1]
    drawn = [
        np.hstack([differentiate_drawing(mesh, outline.camera, pose, contour, axes), jacobian[:, 3:]])
        for (contour, outline), jacobian in zip(pairs, of_points, strict=True)
    ]
    scores = [
        (jacobian * (weight * np.nan_to_num(residual))[:, None])[contour.part == number]
        for contour, residual, weight, jacobian in zip(fit.contours, fit.residuals, fit.weights, of_points, strict=True)
        for number in np.unique(contour.part)
    ]
    sums = np.array([piece.sum(axis=0) for score in scores for piece in np.array_split(score, SEGMENTS) if len(piece)])
    if len(sums) > 12:
        spread = covariance @ (sums.T @ sums) @ covariance / fit.variance**2 * len(sums) / (len(sums) - 6)
        covariance = enlarge_covariance(covariance, spread)
    information, _ = _make_normal_equations(fit, drawn)
    # Errors of the drawing look like information.
    known = sum(float(weight.sum()) for weight in fit.weights) / fit.variance * (DRAWING_SD / DIFFERENCE) ** 2
    information[:3, :3] -= known * np.eye(3)
    values, vectors = np.linalg.eigh(information / np.outer(prior_scale := np.sqrt(np.diag(prior)), prior_scale))
    inverse = vectors / (1 + np.maximum(values, 0)) @ vectors.T / np.outer(prior_scale, prior_scale)
    return enlarge_covariance(covariance, np.asarray(inverse, float))


def differentiate_drawing(
    mesh: Mesh, camera: Camera, pose: RigidTransform, contour: Contour, axes: FloatArray
) -> FloatArray:
    """Return the derivative (n, 3) of a drawn outline's way outwards by w, from drawings after rotations about axes.

    Args:
        mesh, camera, pose, contour: what is drawn.
        axes: (3, 3) orthonormal columns.
    """
    out = np.zeros((len(contour.points), 3))
    for k in range(3):
        for sign in (-1.0, 1.0):
            step = np.concatenate([sign * DIFFERENCE * axes[:, k], np.zeros(3)])
            rim = find_rim(mesh, camera, move(pose, pose.translation, step))
            if rim is not None and len(rim.points):
                out[:, k] += sign * rim.measure_distances(contour.pixels) / (2 * DIFFERENCE)
    return np.asarray(out @ axes.T)
