"""What the joint refinement minimises: its unknowns, its robust cost, and how a step changes them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from sylpose.bundle_adjustment.camera_parameters import Shared
from sylpose.bundle_adjustment.covariance_inflation import bent, excess_variance
from sylpose.bundle_adjustment.depth_noise import without_noise
from sylpose.bundle_adjustment.kernels import BEHIND_PX, DEPTH, OFFSET, SHIFT, TURN, Sightings, Views, residuals
from sylpose.bundle_adjustment.pose_derivatives import exact_motion, motion, speed_noise
from sylpose.bundle_adjustment.reduced_system import Solver, System, told_shares
from sylpose.bundle_adjustment.schur import Reduced, reduce, substitute
from sylpose.bundle_adjustment.triangulation import where_rays_meet
from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.robust_loss import biquartic_losses, biquartic_on_noise, biquartic_weights, robust_sigma
from sylpose.results import Status

__all__ = ["SIDE_RADII", "Fit", "Problem", "State", "Summary"]


# Cutoff of the biquartic weights: nearly 1 up to two sigma, 0 beyond five (choice).
CUTOFF = 5.0
# What the weighted mean square of Gaussian noise then lacks (derived).
SHRINKAGE = biquartic_on_noise(CUTOFF).shrinkage
# Noise is never believed to be less, pixels, when outliers are told from it (choice); and when it says how well poses are
# known: of less, errors of pixels' positions and of lenses would be more (choice).
SIGMA_FLOOR_PX, SIGMA_TOLD_PX = 0.1, 0.02
# Degrees of freedom from which a camera's own noise level counts as much as that of all cameras together (choice).
OWN_FREEDOM = 20.0
# Landmarks lie on their viewer's surface give or take so many of the object's radii, which keeps those with little
# parallax in place; less where the surfaces' depths are held, so that many together hold them too; and to the side of it
# as far as anything has ever been (choice).
DEPTH_RADII, HELD_RADII, SIDE_RADII = 3.0, 0.3, 300.0
# A median is taken of about so many observations (choice).
MEDIAN_OF = 2000


@dataclass(frozen=True, eq=False)
class State:
    """What is refined: turns (N, 3, 3), places (N, 3), points (m, 3), z (k,) of the shared unknowns; motion (N, 2, 6), the
    poses' first and second derivatives by time, follows from neighbouring poses and is held while a step is made."""

    turns: FloatArray
    places: FloatArray
    points: FloatArray
    z: FloatArray
    motion: FloatArray


@dataclass(frozen=True, eq=False)
class Fit:
    """Where the search settled, with the weights (n,), the noise (C,) and the leverage (n,) it ended with."""

    state: State
    status: Status
    rounds: int
    weights: FloatArray
    sigma: FloatArray
    leverage: FloatArray


@dataclass(frozen=True, eq=False)
class Summary:
    """sigma (C,) pixels, covariance (N, 6, 6), shared (k, k) of z, excess (N,), and how well the
    length of the path is known, `length_sd`, `length_share`, `doubt_shares` and `away` as in `Bundled`."""

    sigma: FloatArray
    covariance: FloatArray
    shared: FloatArray
    excess: FloatArray
    length_sd: float
    length_share: float
    doubt_shares: FloatArray
    away: FloatArray


@dataclass(frozen=True, eq=False)
class Problem:
    """What stays while the state is refined.

    Attributes:
        sightings: n observations of m landmarks; counted: (n,) 1, or 0 for landmarks seen once.
        pattern: (F, F) pattern of the frames that move, lower triangle.
        prior: (N, 6, 6) of (w, d), information about the poses start_turns (N, 3, 3), start_places (N, 3).
        radius: of the object, for the landmarks' prior.
        times: (N,) of the frames; shifts: (N, C) from there to each camera's instant; timed: whether any is not zero, or
            unknown.
        shared: what is believed of the unknowns that cameras have once for all frames; while their depths are held, so
            closely are the landmarks.
        rotations (C, 3, 3), centers (C, 3), focals (C,): of the cameras.
    """

    sightings: Sightings
    counted: FloatArray
    pattern: csr_array
    start_turns: FloatArray
    start_places: FloatArray
    prior: FloatArray
    radius: float
    times: FloatArray
    shifts: FloatArray
    timed: bool
    shared: Shared
    rotations: FloatArray
    centers: FloatArray
    focals: FloatArray

    @property
    def fixed(self) -> int:
        """The first frame that stays where it is."""
        return int(np.flatnonzero(self.sightings.free < 0)[0])

    @property
    def pull(self) -> FloatArray:
        """(2,) information, 1/length², that a landmark is on its viewer's surface, and that it is at the origin."""
        held = bool(self.shared.held[self.shared.depths].any())
        return np.array([HELD_RADII if held else DEPTH_RADII, SIDE_RADII]) ** -2.0 / self.radius**2

    def views(self, state: State) -> Views:
        """The frames as each camera sees them at its own instant."""
        n, c = self.shifts.shape
        shared = self.shared.of(state.z)
        rotations, centers, twists = self.rotations, self.centers, np.zeros((c, 3, 3))
        if shared.shape[1] > TURN:
            turn = shared[:, TURN:SHIFT]
            rotations = Rotation.from_rotvec(turn).as_matrix() @ rotations
            centers = centers + shared[:, SHIFT : SHIFT + 3]
            twists = np.asarray(np.linalg.inv(_log_slope(turn)), float)
        carried = np.broadcast_to(rotations, (n, c, 3, 3))
        place = state.places[:, None] - centers
        speed = np.zeros((n, c, 6))
        if self.timed:
            s = (self.shifts + shared[:, OFFSET])[..., None]
            first, second = state.motion[:, None, 0], state.motion[:, None, 1]
            moved, speed = s * first + 0.5 * s**2 * second, first + s * second
            turn = Rotation.from_rotvec(moved[..., :3].reshape(-1, 3)).as_matrix().reshape(n, c, 3, 3)
            carried, place = carried @ turn, place + moved[..., 3:]
        place, spin, drift = (np.einsum("cij,ncj->nci", rotations, v) for v in (place, speed[..., :3], speed[..., 3:]))
        carried = np.ascontiguousarray(carried)
        return Views(state.turns, carried, place, spin, drift, rotations, twists, self.focals, shared)

    def residuals(self, state: State) -> FloatArray:
        """(n, 2) pixels."""
        out = np.empty((len(self.sightings.frame), 2))
        residuals(self.sightings, self.views(state), state.points, out)
        return out

    def where_rays_meet(self, state: State) -> FloatArray:
        """(m, 3) the points nearest to their rays and, weakly, to the object's centre, at the state's poses."""
        out = np.empty_like(state.points)
        where_rays_meet(self.sightings, self.views(state), float(self.pull[0]), out)
        return out

    def with_strays_back(self, state: State, e: FloatArray, sigma: FloatArray) -> State:
        """Landmarks that fewer than two observations support start again where their rays meet, at the poses of now."""
        if len(e) == 0:
            return state
        support = np.add.reduceat((self.weights(e, sigma) > 0).astype(float), self.sightings.start[:-1])
        stray = (support < 2) & (self.counted[self.sightings.start[:-1]] > 0)
        if not stray.any():
            return state
        points = np.where(stray[:, None], self.where_rays_meet(state), state.points)
        return replace(state, points=points)

    def weights(self, e: FloatArray, sigma: FloatArray) -> FloatArray:
        """(n,) robust weights of residuals (n, 2)."""
        square, top = np.einsum("ni,ni->n", e, e), (CUTOFF * sigma[self.sightings.camera]) ** 2
        return self.counted * np.where(square < BEHIND_PX**2, biquartic_weights(square / top), 0.0)

    def cost(self, e: FloatArray, sigma: FloatArray, state: State, held: FloatArray | None) -> float:
        """Half the squares in standard deviations, with weights (n,) that are held, or else saturating for outliers; and
        the same of what is believed."""
        q = np.einsum("ni,ni->n", e, e) / (CUTOFF * sigma[self.sightings.camera]) ** 2
        if held is None:
            total = 0.5 * CUTOFF**2 * float(self.counted @ biquartic_losses(q))
        else:
            total = 0.5 * CUTOFF**2 * float(held @ q)
        change = self._change(state)
        total += 0.5 * float(np.einsum("ni,nij,nj->", change, self.prior, change))
        seen, heights = self.sightings, self.shared.of(state.z)[:, DEPTH:TURN]
        # Landmarks whose observations have no weight stay where they are, and say nothing.
        trusted = self.counted * (q < 1.0) if held is None else held
        used = np.add.reduceat(trusted, seen.start[:-1]) > 0 if len(trusted) else np.zeros(0, bool)
        above = np.einsum("mi,mi->m", seen.toward, state.points) - np.einsum(
            "mi,mi->m", seen.across, heights[seen.viewer]
        )
        total += 0.5 * float(self.pull @ [(above[used] ** 2).sum(), (state.points[used] ** 2).sum()])
        return total + 0.5 * float(state.z @ state.z)

    def noise(self, e: FloatArray, leverage: FloatArray) -> FloatArray:
        """(C,) noise of each camera, pixels: from the weighted squares of the bulk, which the median tells.

        Residuals are smaller than the noise by what the unknowns use up; a camera with few observations is taken to be
        like all together.
        """
        n, camera, used = len(self.focals), self.sightings.camera, self.counted > 0
        poses = 6.0 * self.pattern.shape[0]
        own = 2.0 - leverage - min(poses / max(float(self.counted.sum()), 1.0), 0.5)
        coordinates = e / np.sqrt(np.maximum(own, 0.2) / 2.0)[:, None]
        pooled = robust_sigma(_some(coordinates[used]), SIGMA_FLOOR_PX)
        of_camera = [coordinates[used & (camera == c)] for c in range(n)]
        bulk = [robust_sigma(_some(x), SIGMA_FLOOR_PX) if len(x) > OWN_FREEDOM else pooled for x in of_camera]
        return self.refined_noise(e, self.weights(e, np.array(bulk)), leverage)

    def refined_noise(
        self, e: FloatArray, weights: FloatArray, leverage: FloatArray, least: float = SIGMA_FLOOR_PX
    ) -> FloatArray:
        """(C,) noise of each camera, pixels, at least so many, from the residuals and their weights."""
        n, camera = len(self.focals), self.sightings.camera
        poses = 6.0 * self.pattern.shape[0]
        own = 2.0 - leverage - min(poses / max(float(weights.sum()), 1.0), 0.5)
        squares = np.bincount(camera, weights * np.einsum("ni,ni->n", e, e) / SHRINKAGE, minlength=n)
        freedom = np.bincount(camera, weights * np.maximum(own, 0.0), minlength=n)
        pooled = squares.sum() / max(freedom.sum(), 1e-9)
        variance = (squares + OWN_FREEDOM * pooled) / (freedom + OWN_FREEDOM)
        return np.asarray(np.sqrt(np.maximum(variance, least**2)))

    def summary(self, fit: Fit, tied: BoolArray) -> Summary:
        """What the search's end says, `tied` (N,) being the frames that anything is known of."""
        state, e = fit.state, self.residuals(fit.state)
        sigma = self.refined_noise(e, fit.weights, fit.leverage, SIGMA_TOLD_PX)
        views, moving = self.views(state), self.sightings.free >= 0
        scaled = fit.weights / sigma[self.sightings.camera] ** 2
        # Noise in the landmarks' relief would seem to tell turns.
        points = without_noise(self.sightings, views, state.points, scaled, self.pull)
        system = self.system(replace(state, points=points), views, scaled)
        solver = system.solver()
        own = solver.frames.inverse_blocks()
        # Groups that pull apart because the calibration is off are its uncertainty's, which is counted by itself.
        every = solver.with_held(solver.held & (self.shared.kind == 0))
        rows = solver.gain.reshape(len(own), 6, -1)
        noise = own + rows @ every.shared_covariance(considered=False) @ rows.transpose(0, 2, 1)
        excess = np.ones(len(moving))
        excess[moving] = excess_variance(self.sightings, views, state.points, scaled, self.pull, system, every, noise)
        usual = float(np.median(excess[moving]))
        shares = self._told_shares(state, views, scaled, usual)
        if self.shared.held[self.shared.kind > 0].any():
            solver = solver.scaled(shares[self.shared.kind])
            rows = solver.gain.reshape(rows.shape)
        # Of what the observations tell, not of what is believed.
        told = np.linalg.inv(own) - self.prior[moving]
        own = np.asarray(np.linalg.inv(told / excess[moving, None, None] + self.prior[moving]), float)
        covariance = np.zeros((len(moving), 6, 6))
        covariance[moving] = own + rows @ solver.shared_covariance(usual) @ rows.transpose(0, 2, 1)
        covariance = 0.5 * (covariance + covariance.transpose(0, 2, 1))
        shared = self._shared_covariance(solver, usual)
        away = self._away(state, scaled, shared)
        covariance = bent(covariance, away)
        length = self._length(state, solver, usual, covariance, tied)
        return Summary(sigma, covariance, shared, excess, *length, shares, away)

    def _away(self, state: State, weights: FloatArray, shared: FloatArray) -> FloatArray:
        """(N, 3, 3) covariance of where the surface is that cameras see, all its observations together, from the object's
        origin; weights (n,) of the observations, shared (k, k) covariance of z."""
        share = np.bincount(self.sightings.camera, weights, minlength=len(self.focals))
        toward = self.centers - state.places[:, None]
        toward *= (share / max(share.sum(), 1e-300))[:, None] / np.linalg.norm(toward, axis=2, keepdims=True)
        spread = self.shared.spread[:, DEPTH]
        return np.asarray(np.einsum("kci,cd,kdj->kij", toward, spread @ shared @ spread.T, toward, optimize=True))

    def _told_shares(self, state: State, views: Views, weights: FloatArray, excess: float) -> FloatArray:
        """See `told_shares`; of the landmarks as they are, where the cost has its minimum."""
        if not self.shared.kind.any():
            return np.ones(4)
        system = self.system(state, views, weights)
        solver = system.solver()
        return told_shares(solver.with_held(solver.held & (self.shared.kind == 0)), system, excess)

    def with_depths_held(self) -> Problem:
        """The same with surfaces that stay where they are believed to be."""
        return replace(self, shared=replace(self.shared, held=self.shared.held | self.shared.depths))

    def _length(
        self, state: State, solver: Solver, excess: float, covariance: FloatArray, tied: BoolArray
    ) -> tuple[float, float]:
        """Relative standard deviation of the path's length, and the share it has in the displacements' variance."""
        moving = self.sightings.free >= 0
        path = np.where(tied[:, None], state.places - state.places[self.fixed], 0.0)[moving]
        square = float((path**2).sum())
        if not square > 0.0:
            return np.inf, 0.0
        variance = solver.variance(np.hstack([np.zeros_like(path), path]), excess) / square
        total = float(np.trace(covariance[tied & moving][:, 3:, 3:], axis1=1, axis2=2).sum())
        return float(np.sqrt(variance / square)), float(min(variance / total, 1.0))

    def _shared_covariance(self, solver: Solver, excess: float) -> FloatArray:
        """(k, k) of z; of the time offsets without the information that is only noise.

        Speeds are differences of estimated poses, and their noise looks like a motion that is not uniform. A frame's six
        unknowns are its cameras' information's inverse: so, whatever the noise, each of C cameras seems to learn
        6 / C (1 - 1 / C) times the variance of its speed, in those of its poses.
        """
        n = self.shared.n_offsets
        out = solver.shared_covariance(excess)
        if n:
            noise, share = speed_noise(self.times), 1.0 / (n + 1)
            variance = float((self.shared.spread[:, OFFSET, :n] ** 2).sum()) / n
            seeming = 1.0 + 6.0 * share * (1.0 - share) * float(noise.sum()) * variance
            told = np.linalg.inv(solver.shared_covariance()[:n, :n]) - seeming * np.eye(n)
            values, vectors = np.linalg.eigh(told)
            small = vectors @ np.diag(1.0 / (np.maximum(values / excess, 0.0) + 1.0)) @ vectors.T
            # The rest is taken to know as much of them as before.
            out[:n, n:] = out[n:, :n] = 0.0
            out[:n, :n] = small
        return out

    def system(self, state: State, views: Views, weights: FloatArray, pull: FloatArray | None = None) -> System:
        """The reduced system at a state, weights in 1/pixels²."""
        f, (c, s) = self.pattern.shape[0], views.shared.shape
        shapes = ((self.pattern.nnz, 6, 6), (f, 6), (f, 6, c, s), (c, s, c, s), (c, s), (len(self.sightings.frame),))
        indptr, columns = (a.astype(np.int64) for a in (self.pattern.indptr, self.pattern.indices))
        out = Reduced(indptr, columns, *(np.zeros(shape) for shape in shapes))
        reduce(self.sightings, views, state.points, weights, self.pull if pull is None else pull, out)
        moving = self.sightings.free >= 0
        change = self._change(state)[moving]
        slope = np.zeros((f, 6, 6))
        slope[:, :3, :3], slope[:, 3:, 3:] = _log_slope(change[:, :3]), np.eye(3)
        pulled = slope.transpose(0, 2, 1) @ self.prior[moving]
        out.blocks[indptr[1:] - 1] += pulled @ slope
        out.gradient[:] += np.einsum("nij,nj->ni", pulled, change)
        return System(out, self.sightings.free, self.shared, state.z)

    def moved(self, state: State, views: Views, weights: FloatArray, step: FloatArray, z: FloatArray) -> State:
        """The state after a step of the frames and of z, and the landmarks' that belongs to it."""
        points = np.empty_like(state.points)
        substitute(self.sightings, views, state.points, weights, self.pull, step, self.shared.spread @ z, points)
        turns = Rotation.from_rotvec(step[:, :3]).as_matrix() @ state.turns
        return State(turns, state.places + step[:, 3:], points, state.z + z, state.motion)

    def with_motion(self, state: State) -> State:
        """The state with the derivatives by time of its own poses."""
        if not self.timed:
            return state
        of = exact_motion if self.shared.n_offsets else motion
        return replace(state, motion=of(state.turns, state.places, self.times))

    def _change(self, state: State) -> FloatArray:
        """(N, 6) of (w, d) since the start."""
        turn = Rotation.from_matrix(state.turns @ self.start_turns.transpose(0, 2, 1)).as_rotvec()
        return np.hstack([turn, state.places - self.start_places])


def _some(values: FloatArray) -> FloatArray:
    """Evenly some of the values: enough for a median."""
    return values[:: max(1, len(values) // MEDIAN_OF)]


def _log_slope(w: FloatArray) -> FloatArray:
    """(n, 3, 3) the derivative of log(exp(v) exp(w)) by v at 0: the inverse left Jacobian of SO(3)."""
    angle = np.linalg.norm(w, axis=1)
    small = angle < 1e-4
    a = np.where(small, 1.0, angle)
    factor = np.where(small, 1.0 / 12.0, (1.0 - 0.5 * a / np.tan(0.5 * a)) / a**2)
    cross = np.cross(w[:, None, :], np.eye(3)).transpose(0, 2, 1)
    return np.asarray(np.eye(3) - 0.5 * cross + factor[:, None, None] * (cross @ cross))
