"""Bundle adjustment problem: unknowns, robust cost, linear system, and the uncertainty of the solution."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from sylpose.bundle_adjustment import kernels
from sylpose.bundle_adjustment.camera_parameters import CameraParameters
from sylpose.bundle_adjustment.covariance_inflation import (
    add_second_order_terms,
    compute_variance_inflation,
    shrink_depth_noise,
)
from sylpose.bundle_adjustment.kernels import (
    DEPTH,
    ROTATION,
    TIME_OFFSET,
    TRANSLATION,
    Linearization,
    SortedObservations,
    Views,
)
from sylpose.bundle_adjustment.reduced_system import (
    CalibrationEstimate,
    ReducedSystem,
    Solver,
    System,
    back_substitute,
    eliminate_landmarks,
    estimate_calibration,
)
from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.normal_equations import is_length_observable
from sylpose.geometry.robust_loss import biquartic_losses, biquartic_noise_response, biquartic_weights, robust_sigma
from sylpose.status import Status

# Cutoff of the biquartic weights: nearly 1 up to two sigma, 0 beyond five (choice).
CUTOFF_SIGMAS = 5.0
# Reduction of the weighted mean square of Gaussian noise by these weights (derived).
SHRINKAGE = biquartic_noise_response(CUTOFF_SIGMAS).shrinkage
# Lower limits of the noise, pixels: for outlier rejection (measured: docs/history/benchmarks.md, "Noise of the
# refinement"); and for the covariance of poses, below which errors
# of pixel positions and of lenses would dominate (choice).
MIN_SIGMA_PX, MIN_REPORTED_SIGMA_PX = 0.1, 0.02
# Degrees of freedom from which a camera's noise estimate weighs as much as that of all cameras together, and a landmark's
# as much as its camera's (choice).
PRIOR_DEGREES_OF_FREEDOM = 20.0
# Standard deviation of a landmark's depth from its viewer's surface, in radii of the object, which stabilizes landmarks
# with little parallax; smaller where the surfaces' depths are fixed, so that many landmarks together constrain them;
# and of its lateral position, large enough to be uninformative (choice).
DEPTH_SD_RADII, FIXED_DEPTH_SD_RADII, LATERAL_SD_RADII = 3.0, 0.3, 300.0
# Observations used for a median, about (choice).
MEDIAN_SAMPLES = 2000
# Poses that determine a polynomial of the fourth degree (derived).
STENCIL_SIZE = 5


@dataclass(frozen=True, eq=False)
class State:
    """Unknowns of the problem.

    Attributes:
        rotations, translations: (N, 3, 3), (N, 3) world_from_object.
        points: (m, 3) landmarks.
        z: (k,) of the shared parameters.
        pose_derivatives: (N, 2, 6) first and second time derivatives of the poses; they follow from neighboring poses
            and are constant during a step.
    """

    rotations: FloatArray
    translations: FloatArray
    points: FloatArray
    z: FloatArray
    pose_derivatives: FloatArray


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of the search.

    Attributes:
        weights: (n,) final robust weights, which do not contain the variances.
        sigma: (C,) noise of each camera, pixels.
        leverage: (n,) of the landmarks.
        variance_ratio: (n,) variance of each observation relative to those of its camera.
    """

    state: State
    status: Status
    iterations: int
    weights: FloatArray
    sigma: FloatArray
    leverage: FloatArray
    variance_ratio: FloatArray


@dataclass(frozen=True, eq=False)
class FitSummary:
    """Uncertainty of the solution.

    Attributes:
        sigma_px: (C,) noise of each camera, pixels, of one coordinate; in a result NaN for a camera without
            observations.
        covariance: (N, 6, 6) of (w, d), docs/conventions.md, relative to the fixed frames, where it is zero.
        parameter_covariance: (k, k) of the per-camera parameters z.
        variance_inflation: (N,) variance inflation relative to independent noise of sigma_px, at least 1: errors are
            correlated along tracks, and by calibration errors (`covariance_inflation`).
        scale_sd: relative standard deviation of the path's length: of a common factor of all translations of the
            object's origin, which a motion without rotation does not determine. inf without any translation.
        scale_variance_ratio: in [0, 1], its fraction of the variance of all translations.
        rests_on_prior: (N,) frames in which only the prior on the surfaces' depths determines the translation's length.
        calibration_scale: estimated size of calibration errors relative to their prior; 1 without one.
        calibration_change: (N, 6) of (w, d), the posterior mean of what calibration errors that are not estimated change;
            the covariance is about the poses changed by it.
        surface_covariance: (N, 3, 3) covariance of the mean position of the observed surface relative to the object's
            origin (`add_second_order_terms`).
    """

    sigma_px: FloatArray
    covariance: FloatArray
    parameter_covariance: FloatArray
    variance_inflation: FloatArray
    scale_sd: float
    scale_variance_ratio: float
    rests_on_prior: BoolArray
    calibration_scale: float
    calibration_change: FloatArray
    surface_covariance: FloatArray


@dataclass(frozen=True, eq=False)
class Problem:
    """Constant data of the problem.

    Attributes:
        observations: n observations of m landmarks.
        repeat_mask: (n,) 1, or 0 for landmarks observed once.
        pattern: (F, F) covisibility of the moving frames, lower triangle.
        start_rotations, start_translations: (N, 3, 3), (N, 3) poses at which the prior is centered.
        prior: (N, 6, 6) information of (w, d) on them.
        radius: of the object, for the landmarks' prior.
        times: (N,) of the frames.
        time_shifts: (N, C) from there to each camera's timestamp.
        has_time_shifts: whether any of these is nonzero or unknown.
        camera_parameters: prior of the per-camera parameters; fixed depths also constrain the landmarks more closely.
        rotations, centers, focals: (C, 3, 3), (C, 3), (C,) of the cameras.
    """

    observations: SortedObservations
    repeat_mask: FloatArray
    pattern: csr_array
    start_rotations: FloatArray
    start_translations: FloatArray
    prior: FloatArray
    radius: float
    times: FloatArray
    time_shifts: FloatArray
    has_time_shifts: bool
    camera_parameters: CameraParameters
    rotations: FloatArray
    centers: FloatArray
    focals: FloatArray

    @property
    def first_fixed_frame(self) -> int:
        """The first frame whose pose is fixed."""
        return int(np.flatnonzero(self.observations.free_index < 0)[0])

    @property
    def landmark_prior(self) -> FloatArray:
        """(2,) prior information, 1/length², on a landmark's depth and on its lateral position."""
        depths_fixed = bool(self.camera_parameters.fixed[self.camera_parameters.depth_mask].any())
        sd_radii = np.array([FIXED_DEPTH_SD_RADII if depths_fixed else DEPTH_SD_RADII, LATERAL_SD_RADII])
        return sd_radii**-2.0 / self.radius**2

    def view_frames(self, state: State) -> Views:
        """Return the frames as observed by each camera at its own timestamp."""
        n, c = self.time_shifts.shape
        shared = self.camera_parameters.evaluate(state.z)
        rotations, centers, rotvec_jacobians = self.rotations, self.centers, np.zeros((c, 3, 3))
        if shared.shape[1] > ROTATION:
            rotation = shared[:, ROTATION:TRANSLATION]
            rotations = Rotation.from_rotvec(rotation).as_matrix() @ rotations
            centers = centers + shared[:, TRANSLATION : TRANSLATION + 3]
            rotvec_jacobians = np.asarray(np.linalg.inv(_inverse_left_jacobian(rotation)), float)
        camera_rotations = np.broadcast_to(rotations, (n, c, 3, 3))
        translations = state.translations[:, None] - centers
        velocity = np.zeros((n, c, 6))
        if self.has_time_shifts:
            s = (self.time_shifts + shared[:, TIME_OFFSET])[..., None]
            first, second = state.pose_derivatives[:, None, 0], state.pose_derivatives[:, None, 1]
            pose_change, velocity = s * first + 0.5 * s**2 * second, first + s * second
            rotation = Rotation.from_rotvec(pose_change[..., :3].reshape(-1, 3)).as_matrix().reshape(n, c, 3, 3)
            camera_rotations, translations = camera_rotations @ rotation, translations + pose_change[..., 3:]
        translations, angular_velocity, linear_velocity = (
            np.einsum("cij,ncj->nci", rotations, v) for v in (translations, velocity[..., :3], velocity[..., 3:])
        )
        frames = state.rotations, np.ascontiguousarray(camera_rotations), translations
        return Views(*frames, angular_velocity, linear_velocity, rotations, rotvec_jacobians, self.focals, shared)

    def linearize(self, state: State, weights: FloatArray) -> Linearization:
        """Return the observations linearized at a state; weights (n,) are in 1/pixels²."""
        return Linearization(self.observations, self.view_frames(state), state.points, weights, self.landmark_prior)

    def compute_residuals(self, state: State) -> FloatArray:
        """Return (n, 2) residuals, pixels."""
        out = np.empty((len(self.observations.frame), 2))
        kernels.compute_residuals(self.observations, self.view_frames(state), state.points, out)
        return out

    def triangulate(self, state: State) -> FloatArray:
        """Return (m, 3) points nearest to their rays and, weakly, to the object's center, at the state's poses."""
        out = np.empty_like(state.points)
        kernels.triangulate_rays(self.observations, self.view_frames(state), float(self.landmark_prior[0]), out)
        return out

    def reset_stray_landmarks(self, state: State, e: FloatArray, sigma: FloatArray) -> State:
        """Triangulate landmarks again that fewer than two observations support, at the current poses."""
        if len(e) == 0:
            return state
        support = np.add.reduceat((self.compute_weights(e, sigma) > 0).astype(float), self.observations.start[:-1])
        is_stray = (support < 2) & (self.repeat_mask[self.observations.start[:-1]] > 0)
        if not is_stray.any():
            return state
        points = np.where(is_stray[:, None], self.triangulate(state), state.points)
        return replace(state, points=points)

    def compute_weights(self, e: FloatArray, sigma: FloatArray) -> FloatArray:
        """Return (n,) robust weights of residuals (n, 2)."""
        square, cutoff = np.einsum("ni,ni->n", e, e), (CUTOFF_SIGMAS * sigma[self.observations.camera]) ** 2
        return self.repeat_mask * np.where(square < kernels.BEHIND_PX**2, biquartic_weights(square / cutoff), 0.0)

    def compute_cost(
        self, e: FloatArray, variances: FloatArray, state: State, fixed_weights: FloatArray | None
    ) -> float:
        """Return half the sum of squares in standard deviations, plus the same of the priors.

        Args:
            variances: (n,) of the residuals (n, 2), pixels².
            fixed_weights: (n,) fixed weights; None for the robust cost, which saturates for outliers.
        """
        q = np.einsum("ni,ni->n", e, e) / (CUTOFF_SIGMAS**2 * variances)
        if fixed_weights is None:
            total = 0.5 * CUTOFF_SIGMAS**2 * float(self.repeat_mask @ biquartic_losses(q))
        else:
            total = 0.5 * CUTOFF_SIGMAS**2 * float(fixed_weights @ q)
        change = self._pose_change(state)
        total += 0.5 * float(np.einsum("ni,nij,nj->", change, self.prior, change))
        observations, heights = self.observations, self.camera_parameters.evaluate(state.z)[:, DEPTH:ROTATION]
        # Landmarks whose observations have no weight are not moved and contribute no cost.
        weighted = self.repeat_mask * (q < 1.0) if fixed_weights is None else fixed_weights
        used = np.add.reduceat(weighted, observations.start[:-1]) > 0 if len(weighted) else np.zeros(0, bool)
        depths = np.einsum("mi,mi->m", observations.depth_direction, state.points)
        depths = depths - np.einsum("mi,mi->m", observations.depth_basis, heights[observations.first_viewer])
        total += 0.5 * float(self.landmark_prior @ [(depths[used] ** 2).sum(), (state.points[used] ** 2).sum()])
        return total + 0.5 * float(state.z @ state.z)

    def estimate_noise(self, e: FloatArray, leverage: FloatArray) -> FloatArray:
        """Return (C,) noise of each camera, pixels: from the weighted squares of the inliers, selected by the median.

        Residuals are smaller than the noise because the unknowns are fitted to them. A camera with few observations is
        assigned the noise of all cameras together.
        """
        n, camera, used = len(self.focals), self.observations.camera, self.repeat_mask > 0
        freedom = self._compute_freedom(self.repeat_mask, leverage)
        coordinates = e / np.sqrt(np.maximum(freedom, 0.2) / 2.0)[:, None]
        pooled = robust_sigma(_subsample(coordinates[used]), MIN_SIGMA_PX)
        camera_sigmas = [
            robust_sigma(_subsample(x), MIN_SIGMA_PX) if len(x) > PRIOR_DEGREES_OF_FREEDOM else pooled
            for x in (coordinates[used & (camera == c)] for c in range(n))
        ]
        weights = self.compute_weights(e, np.array(camera_sigmas))
        return np.maximum(self.estimate_weighted_noise(e, weights, leverage), MIN_SIGMA_PX)

    def _compute_freedom(self, weights: FloatArray, leverage: FloatArray) -> FloatArray:
        """Return (n,) degrees of freedom of each observation's two coordinates."""
        n_pose_unknowns = 6.0 * self.pattern.shape[0]
        return np.asarray(2.0 - leverage - min(n_pose_unknowns / max(float(weights.sum()), 1.0), 0.5))

    def estimate_weighted_noise(
        self, e: FloatArray, weights: FloatArray, leverage: FloatArray, variance_ratio: FloatArray | float = 1.0
    ) -> FloatArray:
        """Return (C,) noise of each camera, pixels, from residuals, their weights and relative variances."""
        n, camera = len(self.focals), self.observations.camera
        observation_freedom = self._compute_freedom(weights, leverage)
        relative = np.einsum("ni,ni->n", e, e) / variance_ratio
        squares = np.bincount(camera, weights * relative / SHRINKAGE, minlength=n)
        freedom = np.bincount(camera, weights * np.maximum(observation_freedom, 0.0), minlength=n)
        pooled = squares.sum() / max(freedom.sum(), 1e-9)
        variance = (squares + PRIOR_DEGREES_OF_FREEDOM * pooled) / (freedom + PRIOR_DEGREES_OF_FREEDOM)
        return np.asarray(np.sqrt(np.maximum(variance, MIN_REPORTED_SIGMA_PX**2)))

    def estimate_variance_ratio(self, e: FloatArray, weights: FloatArray, leverage: FloatArray) -> FloatArray:
        """Return (n,) variance of each landmark's observations relative to those of its camera, shrunk to 1.

        Some patches are registered less well than others.

        Args:
            e: (n, 2) residuals of the fit with equal variances, pixels.
            weights, leverage: (n,) as in `Fit`.
        """
        start = self.observations.start
        sigma = self.estimate_weighted_noise(e, weights, leverage)
        relative = np.einsum("ni,ni->n", e, e) / sigma[self.observations.camera] ** 2
        squares = np.add.reduceat(weights * relative / SHRINKAGE, start[:-1])
        freedom = np.add.reduceat(weights * np.maximum(self._compute_freedom(weights, leverage), 0.0), start[:-1])
        ratio = (squares + PRIOR_DEGREES_OF_FREEDOM) / (freedom + PRIOR_DEGREES_OF_FREEDOM)
        return np.repeat(ratio, np.diff(start))

    def summarize(self, fit: Fit, connected: BoolArray) -> FitSummary:
        """Compute the uncertainty of the solution; `connected` (N,) are the frames connected to a fixed one."""
        state, e = fit.state, self.compute_residuals(fit.state)
        sigma = self.estimate_weighted_noise(e, fit.weights, fit.leverage, fit.variance_ratio)
        scaled = fit.weights / (sigma[self.observations.camera] ** 2 * fit.variance_ratio)
        moving = self.observations.free_index >= 0
        at = self.linearize(state, scaled)
        # Noise in the landmarks' depths would otherwise appear as information on rotations.
        system = self.build_system(state, at._replace(points=shrink_depth_noise(at)))
        solver = system.factorize()
        frame_covariance = solver.frames.inverse_blocks()
        # The observations determine calibration errors in part, even if they are not estimated.
        is_calibration = self.camera_parameters.is_calibration
        solver = solver.with_fixed(solver.fixed & ~is_calibration)
        rows = solver.gain.reshape(len(frame_covariance), 6, -1)
        pose_covariance = solver.parameter_covariance(include_fixed=False)
        noise = frame_covariance + rows @ pose_covariance @ rows.transpose(0, 2, 1)
        excess = np.ones(len(moving))
        excess[moving] = compute_variance_inflation(at, system, solver, noise)
        shared_excess, scale, held_change = float(np.median(excess[moving])), 1.0, np.zeros(len(is_calibration))
        change = np.zeros((len(moving), 6))
        if is_calibration.any():
            estimate = self._estimate_calibration(state, at, shared_excess)
            scale, shared_excess, held_change, change[moving] = estimate
            is_held = is_calibration & self.camera_parameters.fixed
            solver = solver.rescale(np.where(is_held, scale / self.camera_parameters.scale, 1.0))
            rows = solver.gain.reshape(rows.shape)
        # Inflates the information of the observations, not that of the prior.
        information = (np.linalg.inv(frame_covariance) - self.prior[moving]) / excess[moving, None, None]
        frame_covariance = np.asarray(np.linalg.inv(information + self.prior[moving]), float)
        shared_covariance, covariance = solver.parameter_covariance(shared_excess), np.zeros((len(moving), 6, 6))
        covariance[moving] = frame_covariance + rows @ shared_covariance @ rows.transpose(0, 2, 1)
        covariance = 0.5 * (covariance + covariance.transpose(0, 2, 1))
        # The second moment: that of the errors' estimate is not applied to the shared parameters.
        shared = self._parameter_covariance(solver, shared_excess) + np.outer(held_change, held_change)
        surface_covariance = self._surface_covariance(state, scaled, shared)
        covariance = add_second_order_terms(covariance, surface_covariance)
        path = self._scale_uncertainty(state, solver, shared_excess, covariance, connected)
        unaided = solver.parameter_covariance(shared_excess, prior=self._weaken_depth_prior(state))
        displacements, rests_on_prior = self._displacements(state), connected & moving
        rests_on_prior[moving] &= is_length_observable(displacements[moving], covariance[moving])
        rests_on_prior[moving] &= ~is_length_observable(
            displacements[moving], frame_covariance + rows @ unaided @ rows.transpose(0, 2, 1)
        )
        return FitSummary(sigma, covariance, shared, excess, *path, rests_on_prior, scale, change, surface_covariance)

    def _displacements(self, state: State) -> FloatArray:
        """Return (N, 3) translations of the object's origin since the first fixed frame."""
        return np.asarray(state.translations - state.translations[self.first_fixed_frame])

    def _weaken_depth_prior(self, state: State) -> FloatArray:
        """Return (k,) prior information of z if the surfaces' depths are as uncertain as the cameras' distances."""
        spread = self.camera_parameters.basis[:, DEPTH][:, self.camera_parameters.depth_mask]
        distances = self.centers - state.translations[self.first_fixed_frame]
        ratio = float((spread**2).sum() / (distances**2).sum())
        return np.where(self.camera_parameters.depth_mask, ratio, 1.0)

    def _surface_covariance(self, state: State, weights: FloatArray, shared: FloatArray) -> FloatArray:
        """Return (N, 3, 3) covariance of the mean position of the observed surface relative to the object's origin.

        Args:
            weights: (n,) of the observations.
            shared: (k, k) covariance of z.
        """
        camera_weights = np.bincount(self.observations.camera, weights, minlength=len(self.focals))
        directions = self.centers - state.translations[:, None]
        lengths = np.linalg.norm(directions, axis=2, keepdims=True)
        directions *= (camera_weights / max(camera_weights.sum(), 1e-300))[:, None] / lengths
        spread = self.camera_parameters.basis[:, DEPTH]
        depths = spread @ shared @ spread.T
        return np.asarray(np.einsum("kci,cd,kdj->kij", directions, depths, directions, optimize=True))

    def _estimate_calibration(self, state: State, at: Linearization, excess: float) -> CalibrationEstimate:
        """Return `estimate_calibration` for the landmarks at the minimum of the cost."""
        system = self.build_system(state, at)
        solver = system.factorize()
        solver = solver.with_fixed(solver.fixed & ~self.camera_parameters.is_calibration)
        return estimate_calibration(solver, system, excess)

    def fix_depths(self) -> Problem:
        """Return the problem with the surfaces' depths fixed at their prior mean."""
        parameters = self.camera_parameters
        return replace(self, camera_parameters=replace(parameters, fixed=parameters.fixed | parameters.depth_mask))

    def _scale_uncertainty(
        self, state: State, solver: Solver, excess: float, covariance: FloatArray, connected: BoolArray
    ) -> tuple[float, float]:
        """Return the path length's relative standard deviation and its fraction of the translations' variance."""
        moving = self.observations.free_index >= 0
        path = np.where(connected[:, None], self._displacements(state), 0.0)[moving]
        square = float((path**2).sum())
        if not square > 0.0:
            return np.inf, 0.0
        variance = solver.pattern_variance(np.hstack([np.zeros_like(path), path]), excess) / square
        total = float(np.trace(covariance[connected & moving][:, 3:, 3:], axis1=1, axis2=2).sum())
        return float(np.sqrt(variance / square)), float(min(variance / total, 1.0))

    def _parameter_covariance(self, solver: Solver, excess: float) -> FloatArray:
        """Return (k, k) covariance of z, with the spurious information on time offsets removed.

        Speeds are differences of estimated poses, and their noise resembles a nonuniform motion. A frame's six unknowns
        have the inverse of its cameras' information as covariance. So, whatever the noise, each of C cameras seems to
        gain 6 / C (1 - 1 / C) times the variance of its speed, in units of the variance of its poses.
        """
        n = self.camera_parameters.n_offsets
        out = solver.parameter_covariance(excess)
        if n:
            noise, share = compute_velocity_variance(self.times), 1.0 / (n + 1)
            variance = float((self.camera_parameters.basis[:, TIME_OFFSET, :n] ** 2).sum()) / n
            spurious = 1.0 + 6.0 * share * (1.0 - share) * float(noise.sum()) * variance
            information = np.linalg.inv(solver.parameter_covariance()[:n, :n]) - spurious * np.eye(n)
            values, vectors = np.linalg.eigh(information)
            offset_covariance = vectors @ np.diag(1.0 / (np.maximum(values / excess, 0.0) + 1.0)) @ vectors.T
            # Conservative: the other parameters keep their covariance.
            out[:n, n:] = out[n:, :n] = 0.0
            out[:n, :n] = offset_covariance
        return out

    def build_system(self, state: State, at: Linearization) -> System:
        """Return the reduced system at a state."""
        f, (c, s) = self.pattern.shape[0], at.views.parameters.shape
        shapes = ((self.pattern.nnz, 6, 6), (f, 6), (f, 6, c, s), (c, s, c, s), (c, s), (len(self.observations.frame),))
        indptr, columns = (a.astype(np.int64) for a in (self.pattern.indptr, self.pattern.indices))
        out = ReducedSystem(indptr, columns, *(np.zeros(shape) for shape in shapes))
        eliminate_landmarks(at, out)
        moving = self.observations.free_index >= 0
        change = self._pose_change(state)[moving]
        slope = np.zeros((f, 6, 6))
        slope[:, :3, :3], slope[:, 3:, 3:] = _inverse_left_jacobian(change[:, :3]), np.eye(3)
        weighted_slope = slope.transpose(0, 2, 1) @ self.prior[moving]
        out.blocks[indptr[1:] - 1] += weighted_slope @ slope
        out.gradient[:] += np.einsum("nij,nj->ni", weighted_slope, change)
        return System(out, self.observations.free_index, self.camera_parameters, state.z)

    def apply_step(self, state: State, at: Linearization, step: FloatArray, z: FloatArray) -> State:
        """Return the state after a step of the frames and of z, with the corresponding step of the landmarks."""
        points = np.empty_like(state.points)
        back_substitute(at, step, self.camera_parameters.basis @ z, points)
        rotations = Rotation.from_rotvec(step[:, :3]).as_matrix() @ state.rotations
        return State(rotations, state.translations + step[:, 3:], points, state.z + z, state.pose_derivatives)

    def update_derivatives(self, state: State) -> State:
        """Return the state with the time derivatives of its poses updated."""
        if not self.has_time_shifts:
            return state
        differentiate = differentiate_quartic if self.camera_parameters.n_offsets else differentiate_quadratic
        return replace(state, pose_derivatives=differentiate(state.rotations, state.translations, self.times))

    def _pose_change(self, state: State) -> FloatArray:
        """Return (N, 6) change of (w, d) since the start."""
        rotation = _rotvecs(state.rotations @ self.start_rotations.transpose(0, 2, 1))
        return np.hstack([rotation, state.translations - self.start_translations])


def _subsample(values: FloatArray) -> FloatArray:
    """Subsample values evenly, enough for a median."""
    return values[:: max(1, len(values) // MEDIAN_SAMPLES)]


def _rotvecs(rotations: FloatArray) -> FloatArray:
    """Return the (n, 3) rotation vectors of rotation matrices (n, 3, 3), without SciPy's checks."""
    out = np.empty((len(rotations), 3))
    kernels.compute_rotvecs(rotations, out)
    return out


def _inverse_left_jacobian(w: FloatArray) -> FloatArray:
    """Return (n, 3, 3) derivatives of log(exp(v) exp(w)) by v at 0: the inverse left Jacobian of SO(3)."""
    angle = np.linalg.norm(w, axis=1)
    small = angle < 1e-4
    a = np.where(small, 1.0, angle)
    factor = np.where(small, 1.0 / 12.0, (1.0 - 0.5 * a / np.tan(0.5 * a)) / a**2)
    cross = np.cross(w[:, None, :], np.eye(3)).transpose(0, 2, 1)
    return np.asarray(np.eye(3) - 0.5 * cross + factor[:, None, None] * (cross @ cross))


# --- time derivatives of poses ----------------------------------------------------------------------------------------


def differentiate_quadratic(rotations: FloatArray, translations: FloatArray, times: FloatArray) -> FloatArray:
    """Differentiate poses by parabolas through three neighbors.

    Args:
        rotations: (N, 3, 3) rotations.
        translations: (N, 3) translations.
        times: (N,) increasing.

    Returns:
        (N, 2, 6) first and second time derivatives.
    """
    out = np.zeros((len(times), 2, 6))
    if len(times) < 2:
        return out
    gap = np.diff(times)[:, None]
    rotation_steps = _rotvecs(rotations[1:] @ rotations[:-1].transpose(0, 2, 1))
    velocity = np.hstack([rotation_steps, np.diff(translations, axis=0)]) / gap
    if len(times) == 2:
        out[:, 0] = velocity
        return out
    gap_before, gap_after = gap[:-1], gap[1:]
    out[1:-1, 0] = (gap_after * velocity[:-1] + gap_before * velocity[1:]) / (gap_before + gap_after)
    out[1:-1, 1] = 2.0 * (velocity[1:] - velocity[:-1]) / (gap_before + gap_after)
    out[0, 1], out[-1, 1] = out[1, 1], out[-2, 1]
    out[0, 0] = out[1, 0] - gap[0] * out[1, 1]
    out[-1, 0] = out[-2, 0] + gap[-1] * out[-2, 1]
    return out


def differentiate_quartic(rotations: FloatArray, translations: FloatArray, times: FloatArray) -> FloatArray:
    """Differentiate poses by polynomials of the fourth degree through five neighbors.

    Arguments and result are as of `differentiate_quadratic`, which also applies to the two frames at each end.

    Parabolas underestimate the speed of an oscillating motion by (2 pi / frames of a period)² / 6, and time offsets
    would be overestimated by the same factor.
    """
    out = differentiate_quadratic(rotations, translations, times)
    if len(times) < STENCIL_SIZE:
        return out
    stencil = np.arange(len(times) - STENCIL_SIZE + 1)[:, None] + np.arange(STENCIL_SIZE)
    middle = stencil[:, STENCIL_SIZE // 2]
    stencil_rotations, middle_inverse = rotations[stencil], rotations[middle].transpose(0, 2, 1)
    relative_rotations = (stencil_rotations @ middle_inverse[:, None]).reshape(-1, 3, 3)
    rotation_changes = _rotvecs(relative_rotations).reshape(*stencil.shape, 3)
    change = np.concatenate([rotation_changes, translations[stencil] - translations[middle, None]], axis=2)
    out[middle] = _stencil_weights(times)[:, 1:3] @ change
    return out


def compute_velocity_variance(times: FloatArray) -> FloatArray:
    """Return (N,) approximate variance of the speeds of `differentiate_quartic`.

    The poses are independent, with unit variance.
    """
    out = 0.5 / np.gradient(times) ** 2
    out[[0, -1]] *= 13.0  # one-sided differences of three poses at the ends
    if len(times) >= STENCIL_SIZE:
        out[STENCIL_SIZE // 2 : -(STENCIL_SIZE // 2)] = (_stencil_weights(times)[:, 1] ** 2).sum(axis=1)
    return np.asarray(out)


def _stencil_weights(times: FloatArray) -> FloatArray:
    """Return (N - 4, 5, 5) finite difference weights of five values at the middle one.

    Row k gives the k-th derivative of the polynomial through them.
    """
    stencil = np.arange(len(times) - STENCIL_SIZE + 1)[:, None] + np.arange(STENCIL_SIZE)
    time_differences = times[stencil] - times[stencil[:, STENCIL_SIZE // 2], None]
    scale = time_differences[:, -1:] - time_differences[:, :1]
    powers = (time_differences / scale)[..., None] ** np.arange(STENCIL_SIZE)
    factorials = np.array([1.0, 1.0, 2.0, 6.0, 24.0])
    return np.asarray(np.linalg.inv(powers) * (factorials / scale ** np.arange(STENCIL_SIZE))[..., None])
