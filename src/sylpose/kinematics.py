"""Velocities and accelerations of a trajectory, with standard deviations: a Kalman smoother of continuous time.

A derivative of the position, and one of the rotation, is modeled as white noise of density q: the third, fourth or
fifth. The measured poses have white noise, or noise whose correlation decays exponentially. All are estimated by
restricted maximum likelihood, so a common error of all poses, such as that of the calibration, does not count. The
posterior mean for the m-th derivative is a smoothing spline of degree 2 m - 1 (G. Wahba, "Improper priors, spline
smoothing", JRSS B 1978; H. Woltring's GCVSPL in biomechanics). For a steady rate 1/T and noise of variance r, its gain
is 1 / (1 + (f / f_c)^2m) without phase, with (2 pi f_c)^2m = q / (r T): a Butterworth filter of order m, forwards and
backwards. For noise of covariance C it is the inverse of I + (f / f_c)^2m C / r, with r = tr C / 3: noisy axes are
smoothed more. For correlated noise (f / f_c)^2m gets the factor (1 - ρ²) / (1 - 2 ρ cos(2 pi f T) + ρ²). The results
are means over m, weighted by the likelihood (Akaike weights: K. Burnham, D. Anderson, "Model selection and multimodel
inference", 2002).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import factorial
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.display import format_length
from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.matrices import kron, transpose

# Fewer poses hardly determine nine unknowns and two variances (choice).
MIN_POSES = 12
# Parts of a recording that are so many steps apart are independent; a gap's states would be rounding (choice).
MAX_GAP = 100.0
# Derivatives m that are modeled as white noise: the acceleration's derivative is the first one that leaves it finite,
# and splines of degree nine fit sums of sines (choice).
ORDERS = (3, 4, 5)
# Variance of the first state, relative to the noise; the prior's mean follows the estimate (choice: half of the digits).
DIFFUSE = 1e8
# Values of log10(q T^2m / r) per pass, and their limits: half gain at rate / 628 (divided by m, choice), and at 1.7 times
# the Nyquist rate for m = 3 (choice).
N_RATIOS, MIN_LOG_RATIO, MAX_LOG_RATIO = 19, -4.0, 4.4
# Rounds of linearization and of the noise's covariance; each reduces the change to a few percent (choice).
N_ROUNDS = 4
# Twice the number of parameters of an estimated shape of the noise beyond a stated one (derived: Akaike's criterion).
SHAPE_PENALTY = 10.0
# Smallest standard deviation of the noise, relative to the path, and along an axis, to that of the others: rounding in
# files of 12 digits (choice).
MIN_RELATIVE_NOISE, MIN_AXIS_NOISE = 1e-12, 1e-2
# Correlations of the noise that are tried, and the white part of its variance then, against rounding (choice).
CORRELATIONS, WHITE_PART = (0.3, 0.5, 0.65, 0.8, 0.9), 1e-6
FACTORIALS = np.array([factorial(k) for k in range(max(ORDERS) + 1)], float)


@dataclass(frozen=True, eq=False)
class Derivatives:
    """First and second derivative of the position or of the rotation, per unit of time.

    Attributes:
        velocity: (N, 3) world axes; NaN rows in frames without a measured pose.
        acceleration: (N, 3) likewise.
        covariance: (N, 6, 6) of (velocity, acceleration), likewise.
        noise_sd: standard deviation of the poses' independent noise, rms over axes and frames.
        half_gain: frequency f_c of the smoother with the largest weight, at which its gain is 1/2 for white noise.
        order: its m.
        correlation: of the noise of two poses at the median step; 0 for white noise.
        uses_stated_shape: whether the noise is proportional to the poses' covariances. Otherwise the covariance of the
            noise was estimated, inversely proportional to the number of observations.
    """

    velocity: FloatArray
    acceleration: FloatArray
    covariance: FloatArray
    noise_sd: float
    half_gain: float
    order: int
    correlation: float
    uses_stated_shape: bool

    @property
    def velocity_sd(self) -> FloatArray:
        """(N, 3) standard deviations of the velocity."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2)[:, :3]))

    @property
    def acceleration_sd(self) -> FloatArray:
        """(N, 3) standard deviations of the acceleration."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2)[:, 3:]))


@dataclass(frozen=True, eq=False)
class Kinematics:
    """Velocities and accelerations in every frame of a trajectory, in world axes.

    Attributes:
        linear: of the origin of the object's frame, units per second.
        angular: angular velocity and acceleration, radians per second.
    """

    linear: Derivatives
    angular: Derivatives


def estimate_kinematics(
    times: FloatArray, poses: RigidTransform, covariance: FloatArray, observations: FloatArray | None = None
) -> Kinematics:
    """Estimate velocities and accelerations from n poses, with their covariance.

    Parts between long gaps are independent, and NaN if they are short. The noise and the filter are those of the longest.

    Args:
        times: (n,) increasing, not necessarily regular.
        poses: n poses world_from_object.
        covariance: (n, 6, 6) of the poses. Only its shape and its change over time are used, and only if the poses'
            noise agrees with it better than with a constant covariance; its scale is estimated.
        observations: (n,) numbers of observations of each pose, 0 for an ordinary one; None for equal ones.

    Raises:
        ValueError: fewer than `MIN_POSES` poses without long gaps between them; times that do not increase.
    """
    times, covariance = np.asarray(times, float), np.asarray(covariance, float)
    if len(times) < MIN_POSES:
        raise ValueError(f"velocities need at least {MIN_POSES} measured poses, got {len(times)}")
    if not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        raise ValueError("velocities need times that increase, but two frames have the same or a decreasing time")
    counts = np.ones(len(times)) if observations is None else np.asarray(observations, float)
    # The first frame, which defines the object's frame, has no matches.
    typical = float(np.median(counts[counts > 0])) if (counts > 0).any() else 1.0
    variances = typical / np.where(counts > 0, counts, typical)
    steps = np.diff(times)
    parts = np.split(np.arange(len(times)), np.flatnonzero(steps > MAX_GAP * np.median(steps)) + 1)
    parts = [part for part in parts if len(part) >= MIN_POSES]
    if not parts:
        raise ValueError(f"velocities need at least {MIN_POSES} measured poses without a long gap between them")
    has_result = np.zeros(len(times), bool)
    has_result[np.concatenate(parts)] = True
    found = []
    for k in parts:
        positions = poses[k].translation
        linear = _differentiate(times[k], positions - positions[0], covariance[k, 3:, 3:], variances[k])
        found.append(
            Kinematics(linear, _differentiate(times[k], poses[k].rotation, covariance[k, :3, :3], variances[k]))
        )
    joined = Kinematics(_join([part.linear for part in found]), _join([part.angular for part in found]))
    return fill_frames(joined, has_result)


def _join(parts: Sequence[Derivatives]) -> Derivatives:
    """Join the derivatives of consecutive parts of a recording; noise and filter are those of the longest."""
    return replace(
        max(parts, key=lambda part: len(part.velocity)),
        velocity=np.concatenate([part.velocity for part in parts]),
        acceleration=np.concatenate([part.acceleration for part in parts]),
        covariance=np.concatenate([part.covariance for part in parts]),
    )


def fill_frames(kinematics: Kinematics, has_pose: BoolArray) -> Kinematics:
    """Return kinematics of all frames, NaN in those without a pose; `has_pose` (N,) marks the others."""

    def fill(values: FloatArray) -> FloatArray:
        filled = np.full((len(has_pose), *values.shape[1:]), np.nan)
        filled[has_pose] = values
        return filled

    linear, angular = (
        replace(d, velocity=fill(d.velocity), acceleration=fill(d.acceleration), covariance=fill(d.covariance))
        for d in (kinematics.linear, kinematics.angular)
    )
    return Kinematics(linear, angular)


def describe_filter(kinematics: Kinematics, unit: str = "") -> str:
    """Return one sentence on the filter and the noise; `unit` is that of lengths."""
    parts = []
    for name, d, noise in (
        ("position", kinematics.linear, format_length(kinematics.linear.noise_sd, unit)),
        ("rotation", kinematics.angular, f"{np.degrees(kinematics.angular.noise_sd):.2g}°"),
    ):
        correlation = f", correlation {d.correlation:g} from frame to frame" if d.correlation else ""
        parts.append(
            f"{name}: gain 1/(1+(f/{d.half_gain:.3g})^{2 * d.order}), f in Hz, noise {noise} (1 sd){correlation}"
        )
    return f"velocities are those of a smoothing spline without phase; {'; '.join(parts)}"


def _differentiate(
    times: FloatArray, measured: FloatArray | Rotation, stated: FloatArray, variances: FloatArray
) -> Derivatives:
    """Estimate the derivatives of n positions or rotations, with noise of stated or of estimated shape."""
    unit = float(np.median(np.diff(times)))
    start = _initialize_states(measured, np.diff(times) / unit)
    steps = _subtract(measured[1:], measured[:-1])
    smallest = (MIN_RELATIVE_NOISE * max(float(np.abs(steps).sum()), 1e-30)) ** 2

    def shape_noise(moments: FloatArray) -> FloatArray:
        mean = moments.mean(axis=0)
        floor = smallest + MIN_AXIS_NOISE**2 * np.trace(mean) / 3.0
        return np.asarray(variances[:, None, None] * (mean + floor * np.eye(3)))

    third = np.diff(steps, 2, axis=0)
    # The variance of a third difference of independent values is 20 times theirs (derived).
    noise = shape_noise(third[:, :, None] * third[:, None] / 20.0)
    states, fit = start, _fit(start, noise)
    for _ in range(N_ROUNDS - 1):
        states = states.move(fit.means)
        # EM: the residuals' covariance plus that of the smoothed values.
        residuals = _subtract(measured, states.values)
        moments = residuals[:, :, None] * residuals[:, None] + fit.covariances[:, :3, :3]
        noise = shape_noise(moments / variances[:, None, None])
        fit = _fit(states, noise, fit.log_ratio)
    is_stated, states = False, states.move(fit.means)
    if (repaired := _repair_covariance(stated)) is not None:
        other = _fit(states, repaired, fit.log_ratio)
        if is_stated := other.deviance < fit.deviance + SHAPE_PENALTY:
            noise, fit, states = repaired, other, states.move(other.means)
    ratio = fit.log_ratio / ORDERS[0]
    fits = [_refine(states.extend(order), noise, ratio * order, 0.0) for order in ORDERS]
    middle = CORRELATIONS[len(CORRELATIONS) // 2]
    probes = [_fit(at, noise, white.log_ratio, 3.0, middle) for white, at in fits]
    probe = min(range(len(ORDERS)), key=lambda k: probes[k].deviance)
    if probes[probe].deviance < min(white.deviance for white, _ in fits):
        at, ratio = fits[probe][1], probes[probe].log_ratio
        tried = [_refine(at, noise, ratio, correlation) for correlation in CORRELATIONS]
        best = min((fit for fit, _ in tried), key=lambda fit: fit.deviance)
        ratio = best.log_ratio / at.order
        others = [states for k, (_, states) in enumerate(fits) if k != probe]
        tried += [_refine(states, noise, ratio * states.order, best.correlation) for states in others]
        fits += tried
    return _average(fits, unit, is_stated)


def _refine(states: _States, noise: FloatArray, log_ratio: float, correlation: float) -> tuple[_Fit, _States]:
    """Fit twice, the second time linearized at the result; return the fit and its states."""
    first = _fit(states, noise, log_ratio, 3.0, correlation)
    states = states.move(first.means)
    second = _fit(states, noise, first.log_ratio, 0.5, correlation)
    return second, states.move(second.means)


def _average(fits: Sequence[tuple[_Fit, _States]], unit: float, is_stated: bool) -> Derivatives:
    """Average the results of several orders by Akaike weights; `unit` is the unit of time."""
    deviances = np.array([fit.deviance for fit, _ in fits])
    weights = np.exp(0.5 * (deviances.min() - deviances))
    weights /= weights.sum()
    powers = np.repeat([unit, unit**2], 3)
    values = np.array([states.derivatives[:, :2].reshape(-1, 6) for _, states in fits]) / powers
    mean = np.einsum("m,mni->ni", weights, values)
    covariance = np.zeros((len(mean), 6, 6))
    for weight, (fit, _), value in zip(weights, fits, values, strict=True):
        difference = value - mean
        within = fit.covariances[:, 3:9, 3:9] / np.outer(powers, powers)
        covariance += weight * (within + difference[:, :, None] * difference[:, None])
    best, states = fits[int(np.argmin(deviances))]
    order = states.order
    half_gain = float(10.0 ** (best.log_ratio / (2.0 * order)) / (2.0 * np.pi * unit))
    found = mean[:, :3], mean[:, 3:], covariance, best.noise_sd
    return Derivatives(*found, half_gain, order, best.correlation, is_stated)


def _repair_covariance(stated: FloatArray) -> FloatArray | None:
    """Replace covariances (n, 3, 3) that are zero or not finite by the median one; None if most are."""
    traces = np.trace(stated, axis1=1, axis2=2)
    is_valid = np.asarray(np.isfinite(stated).all(axis=(1, 2)))
    is_valid[is_valid] = np.linalg.eigvalsh(stated[is_valid])[:, 0] > 1e-9 * traces[is_valid]
    if 2 * is_valid.sum() <= len(stated):
        return None
    middle = np.flatnonzero(is_valid)[np.argsort(traces[is_valid])[is_valid.sum() // 2]]
    return np.where(is_valid[:, None, None], stated, stated[middle])


@dataclass(frozen=True, eq=False)
class _States:
    """States to linearize at: values and derivatives, in steps of the median time.

    Attributes:
        measured: (n, 3) positions or n rotations.
        values: likewise.
        derivatives: (n, m - 1, 3) velocity, acceleration and so on; the m-th one is white noise.
        steps: (n - 1,) times between them.
    """

    measured: FloatArray | Rotation
    values: FloatArray | Rotation
    derivatives: FloatArray
    steps: FloatArray

    @property
    def order(self) -> int:
        """The number m of values and derivatives."""
        return int(self.derivatives.shape[1]) + 1

    def move(self, means: FloatArray) -> _States:
        """Return the states moved by means (n, 3 m) of their errors."""
        v = self.values
        values = Rotation.from_rotvec(means[:, :3]) * v if isinstance(v, Rotation) else v + means[:, :3]
        return replace(self, values=values, derivatives=self.derivatives + means[:, 3:].reshape(self.derivatives.shape))

    def extend(self, order: int) -> _States:
        """Return the states of a higher order m, the additional derivatives zero."""
        more = np.zeros((len(self.derivatives), order - 1 - self.derivatives.shape[1], 3))
        return replace(self, derivatives=np.concatenate([self.derivatives, more], axis=1))

    def linearize(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return how errors propagate, e_k+1 = F_k e_k + offset_k, and their noise Q / q.

        For rotations exp(e) R: exp(φ) maps the error, and its left Jacobian the errors of the derivatives.

        Returns:
            (n - 1, 3 m, 3 m), (n - 1, 3 m) and (n - 1, 3 m, 3 m).
        """
        h, order = self.steps[:, None, None], self.order
        rows, columns = np.indices((order, order))
        taylor = np.where(columns >= rows, h ** np.maximum(columns - rows, 0) / FACTORIALS[np.abs(columns - rows)], 0.0)
        rest = order - 1 - np.arange(order)
        noise = h ** (np.add.outer(rest, rest) + 1.0) / np.outer(FACTORIALS[rest], FACTORIALS[rest])
        noise = noise / (np.add.outer(rest, rest) + 1.0)
        predicted = taylor[:, 1:, 1:] @ self.derivatives[:-1]
        moved = (taylor[:, :1, 1:] @ self.derivatives[:-1])[:, 0]
        transition = kron(taylor, np.eye(3))
        if isinstance(self.values, Rotation):
            # Magnus series, second order.
            moved = moved + self.steps[:, None] ** 3 / 12.0 * np.cross(
                self.derivatives[:-1, 1], self.derivatives[:-1, 0]
            )
            rotation = Rotation.from_rotvec(moved)
            transition[:, :3, 3:] = _left_jacobian(moved) @ transition[:, :3, 3:]
            transition[:, :3, :3] = rotation.as_matrix()
            difference = _subtract(rotation * self.values[:-1], self.values[1:])
        else:
            difference = self.values[:-1] + moved - self.values[1:]
        offset = np.hstack([difference, (predicted - self.derivatives[1:]).reshape(len(h), -1)])
        return transition, offset, kron(noise, np.eye(3))


def _initialize_states(measured: FloatArray | Rotation, steps: FloatArray) -> _States:
    """Return the measured values with two derivatives by finite differences, of very short steps too small ones."""
    slopes = _subtract(measured[1:], measured[:-1]) / np.maximum(steps, 0.5)[:, None]
    velocity = np.vstack([slopes[:1], 0.5 * (slopes[1:] + slopes[:-1]), slopes[-1:]])
    return _States(measured, measured, np.stack([velocity, np.gradient(velocity, axis=0)], axis=1), steps)


def _subtract(a: Any, b: Any) -> FloatArray:
    """Return (n, 3) differences of positions, or rotation vectors from b to a."""
    if isinstance(a, Rotation) and isinstance(b, Rotation):
        return np.asarray((a * b.inv()).as_rotvec())
    difference: FloatArray = a - b
    return difference


def _left_jacobian(rotvecs: FloatArray) -> FloatArray:
    """Return (n, 3, 3) left Jacobians of exp at rotation vectors: exp(v + dv) = exp(J dv) exp(v)."""
    x = transpose(np.cross(rotvecs[:, None], np.eye(3)))
    angle = np.maximum(np.linalg.norm(rotvecs, axis=1), 1e-4)[:, None, None]
    first, second = (1.0 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    return np.asarray(np.eye(3) + first * x + second * (x @ x))


@dataclass(frozen=True, eq=False)
class _Fit:
    """Smoothed errors of states and the variances that fit them.

    Attributes:
        log_ratio: log10 of q T^2m / r.
        correlation: of the noise.
        deviance: Akaike's criterion, minus twice the log-likelihood plus twice the number of parameters.
        noise_sd: standard deviation of the noise.
        means: (n, 3 m).
        covariances: (n, 3 m, 3 m).
    """

    log_ratio: float
    correlation: float
    deviance: float
    noise_sd: float
    means: FloatArray
    covariances: FloatArray


def _fit(
    states: _States, noise: FloatArray, log_ratio: float | None = None, width: float = 1.0, correlation: float = 0.0
) -> _Fit:
    """Estimate q and the scale of the noise (n, 3, 3), and smooth.

    Args:
        states: to linearize at; of measured values, if no `log_ratio` is given.
        noise: shape of the noise.
        log_ratio: an earlier estimate; None for any.
        width: its largest change.
        correlation: of the noise.
    """
    model = _build_model(states, noise, correlation)
    innovations = _subtract(states.measured, states.values)
    n, size = len(innovations), 3 * states.order
    scale = float(np.trace(noise, axis1=1, axis2=2).mean()) / 3.0
    derivative = np.repeat(np.arange(size // 3), 3)

    def start(log_ratios: FloatArray) -> FloatArray:
        # Smoothed derivatives have variances in powers of the cutoff; with larger ones rounding would exceed them.
        cutoff = 10.0 ** (np.minimum(log_ratios[:, None], 0.0) * 3.0 / size)
        powers = np.ones((len(cutoff), size)) if log_ratio is None else cutoff ** (2.0 * derivative)
        return np.hstack([DIFFUSE * scale * powers, np.ones((len(cutoff), model.offset.shape[1] - size))])

    low, high = MIN_LOG_RATIO * size / 3.0, MAX_LOG_RATIO
    if log_ratio is not None:
        low, high = max(low, log_ratio - width), min(high, log_ratio + width)
    while True:
        grid = np.linspace(low, high, N_RATIOS)
        variances = start(grid)
        k = int(np.argmin(_filter(model, innovations, scale * 10.0**grid, variances, size)[0]))
        low, high = grid[max(k - 1, 0)], grid[min(k + 1, N_RATIOS - 1)]
        if high - low < 1.0:
            break
    best = grid[k : k + 1]
    (deviance,), (variance,), filtered = _filter(model, innovations, scale * 10.0**best, variances[k : k + 1], size)
    means, covariances = _smooth(model.transition, *filtered)
    means, covariances = means[:, :size], covariances[:, :size, :size]
    # The likelihood is the restricted one less the determinant of the start's information (D. Harville, 1977).
    deviance += size * np.log(variance) + 3 * n * np.log(1.0 - size / (3 * n)) + np.linalg.slogdet(covariances[0])[1]
    noise_sd = float(np.sqrt(variance * scale))
    deviance += 2.0 * (size + (correlation > 0))
    return _Fit(float(best[0]), correlation, float(deviance), noise_sd, means, variance * covariances)


class _Model(NamedTuple):
    """Linear model of errors e and, if it is correlated, of the noise u of unit variance.

    Attributes:
        transition: (n - 1, D, D) F.
        offset: (n - 1, D) of F e.
        density_noise: (n - 1, D, D) process noise per density q.
        fixed_noise: (n - 1, D, D) process noise of u.
        observation: (n, 3, D) H.
        noise: (n, 3, 3) white noise of the measured values.
    """

    transition: FloatArray
    offset: FloatArray
    density_noise: FloatArray
    fixed_noise: FloatArray
    observation: FloatArray
    noise: FloatArray


def _build_model(states: _States, noise: FloatArray, correlation: float) -> _Model:
    """Linearize at states; noise of correlation ρ is ρ u_k + sqrt(1 - ρ²) times white noise, to the power of steps."""
    transition, offset, density_noise = states.linearize()
    n, size = len(noise), offset.shape[1]
    observation = np.tile(np.eye(3, size), (n, 1, 1))
    if not correlation:
        return _Model(transition, offset, density_noise, np.zeros((n - 1, size, size)), observation, noise)
    values, vectors = np.linalg.eigh(noise)
    roots = vectors * np.sqrt(values)[:, None] @ transpose(vectors)
    kept = correlation**states.steps
    padding = ((0, 0), (0, 3), (0, 3))
    transition, density_noise = np.pad(transition, padding), np.pad(density_noise, padding)
    fixed_noise = np.zeros_like(transition)
    transition[:, size:, size:] = kept[:, None, None] * np.eye(3)
    fixed_noise[:, size:, size:] = (1.0 - kept**2)[:, None, None] * np.eye(3)
    observation = np.concatenate([observation, roots], axis=2)
    return _Model(
        transition, np.pad(offset, ((0, 0), (0, 3))), density_noise, fixed_noise, observation, WHITE_PART * noise
    )


Filtered = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


def _filter(
    model: _Model, measured: FloatArray, densities: FloatArray, start: FloatArray, n_diffuse: int
) -> tuple[FloatArray, FloatArray, Filtered]:
    """Run Kalman filters of errors measured as (n, 3), one per density q of B, with variances `start` (B, D).

    The first `n_diffuse` of these are diffuse.

    Returns:
        (B,) deviances of the restricted likelihood; (B,) factors of the variances; means and covariances of the first
        one, filtered and predicted.
    """
    n, (b, size) = len(measured), start.shape
    mean, covariance = np.zeros((b, size)), start[:, :, None] * np.eye(size)
    filtered = np.empty((n, size)), np.empty((n, size, size)), np.empty((n, size)), np.empty((n, size, size))
    residuals, spreads = np.empty((n, b, 3)), np.empty((n, b, 3, 3))
    for k in range(n):
        if k:
            transition = model.transition[k - 1]
            mean = mean @ transition.T + model.offset[k - 1]
            covariance = transition @ covariance @ transition.T + model.fixed_noise[k - 1]
            covariance = covariance + densities[:, None, None] * model.density_noise[k - 1]
        filtered[2][k], filtered[3][k] = mean[0], covariance[0]
        observed = model.observation[k] @ covariance
        residuals[k] = measured[k] - mean @ model.observation[k].T
        spreads[k] = observed @ model.observation[k].T + model.noise[k]
        gain = transpose(observed) @ np.linalg.inv(spreads[k])
        mean = mean + (gain @ residuals[k][:, :, None])[:, :, 0]
        covariance = covariance - gain @ observed
        covariance = 0.5 * (covariance + transpose(covariance))
        filtered[0][k], filtered[1][k] = mean[0], covariance[0]
    squares = np.einsum("kbi,kbi->b", residuals, np.linalg.solve(spreads, residuals[..., None])[..., 0])
    degrees = 3 * n - n_diffuse
    variances = np.maximum(squares / degrees, np.finfo(float).tiny)
    deviances = degrees * np.log(variances) + np.linalg.slogdet(spreads)[1].sum(axis=0) - np.log(start).sum(axis=1)
    return deviances, variances, filtered


def _smooth(
    transition: FloatArray, means: FloatArray, covariances: FloatArray, predicted: FloatArray, spreads: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Smooth filtered means and covariances backwards (H. Rauch, F. Tung, C. Striebel, 1965)."""
    means, covariances = means.copy(), covariances.copy()
    for k in range(len(means) - 2, -1, -1):
        sd = np.sqrt(np.diag(spreads[k + 1]))
        cross = covariances[k] @ transition[k].T / sd
        gain = np.linalg.solve(spreads[k + 1] / np.outer(sd, sd), cross.T).T / sd
        means[k] += gain @ (means[k + 1] - predicted[k + 1])
        covariances[k] += gain @ (covariances[k + 1] - spreads[k + 1]) @ gain.T
    return means, covariances
