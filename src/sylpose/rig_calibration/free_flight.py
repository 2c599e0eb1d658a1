"""Scale and vertical from throws: in free flight the center of mass moves with the acceleration of gravity.

The center of mass is an unknown fixed point c of the object: R(t) c + x(t) = p + v t + g t²/2 for the poses (R, x) of a
flight. This is linear in c, p, v and g. The length of g, 9.81 m/s², sets the scale, its direction is the vertical. The
times enter by their square. Air drag is ignored.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform
from scipy.special import comb

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.robust_loss import chi_squared_bound
from sylpose.rig_calibration.result import CalibrationRefusedError

# Acceleration of gravity, m/s², and its relative standard deviation over the earth (choice: 9.78 to 9.83).
GRAVITY, GRAVITY_SD = 9.81, 0.002
# A flight has so many frames (choice: twice the unknowns), and lasts at most so many seconds (choice: three meters up).
MIN_FRAMES, MAX_SECONDS = 8, 1.6
# Windows have at most so many steps (choice: single frames up to 30 fps).
MAX_STEPS = 50
# Residuals of a flight relative to those of the smoothest parts of the path (choice: a factor of two).
MAX_NOISE_RATIO = 2.0
# Quantile of the residuals of short windows that is their noise (choice: some part of the path is smooth).
NOISE_QUANTILE = 0.25
# The acceleration of a flight is known to this relative standard deviation (choice: swings of the hand rarely agree by it).
MAX_RELATIVE_SD = 0.1
# Odds that flights have one gravity, against swings of the hand that agree by chance (choice: hands have waved to and fro
# many times before one pair does).
MIN_LOG_ODDS = np.log(100.0)
# Errors that the poses of a flight have in common, as share of gravity: differences below it are none (choice: ten times
# those of a rendered recording, 0.1 to 0.3 %).
SYSTEMATIC = 0.02


@dataclass(frozen=True, eq=False)
class FreeFlight:
    """Gravity in the axes and lengths of a path.

    Attributes:
        gravity: (3,) its acceleration, lengths per second squared.
        center: (3,) center of mass, object's frame.
        joint_covariance: (6, 6) of both, the center first.
        flights: numbers of the first and last pose of each flight.
        noise: standard deviation of the positions, each coordinate.
    """

    gravity: FloatArray
    center: FloatArray
    joint_covariance: FloatArray
    flights: tuple[tuple[int, int], ...]
    noise: float

    @property
    def covariance(self) -> FloatArray:
        """(3, 3) covariance of gravity."""
        return self.joint_covariance[3:, 3:]

    @property
    def scale(self) -> float:
        """Meters per unit of length."""
        return GRAVITY / float(np.linalg.norm(self.gravity))

    @property
    def scale_sd(self) -> float:
        """Relative standard deviation of the scale."""
        down = self.gravity / np.linalg.norm(self.gravity)
        own = float(down @ self.covariance @ down) / float(self.gravity @ self.gravity)
        return float(np.hypot(np.sqrt(own), GRAVITY_SD))

    @property
    def up(self) -> FloatArray:
        """(3,) unit vector upwards."""
        return np.asarray(-self.gravity / np.linalg.norm(self.gravity))

    @property
    def up_sd(self) -> float:
        """Standard deviation of the vertical's direction, radians: of both angles together."""
        across = np.eye(3) - np.outer(self.up, self.up)
        return float(np.sqrt(np.trace(across @ self.covariance @ across)) / np.linalg.norm(self.gravity))


def find_free_flight(times: FloatArray, world_from_object: RigidTransform) -> FreeFlight:
    """Find the throws in a path, and gravity in its axes and lengths.

    Args:
        times: (N,) seconds, true ones, increasing.
        world_from_object: N poses.

    Raises:
        CalibrationRefusedError: fewer than two flights with the same gravity, or no more alike than swings of the hand are
            by chance; flights with two different gravities.
    """
    times = np.asarray(times, float)
    windows, limit = _find_smooth_windows(times, world_from_object)
    fits = dict[tuple[int, int], FreeFlight]()
    for window in sorted(windows, key=lambda window: window[0] - window[1]):
        if not any(window[0] <= last and first <= window[1] for first, last in fits):
            fit = _fit([window], times, world_from_object)
            if _is_flight(fit, limit, times, world_from_object):
                fits[window] = fit
    groups = sorted(_find_agreeing(fits), reverse=True)
    log_odds, agreeing = groups[0] if groups else (-np.inf, [*fits][:1])
    if log_odds < MIN_LOG_ODDS:
        needed = f"{np.exp(MIN_LOG_ODDS):.0f}"
        swings = f", as swings of the hand may have (odds {np.exp(log_odds):.2g}, needs {needed})" if groups else ""
        raise CalibrationRefusedError(
            f"throw: {len(agreeing)} free flights with one gravity{swings}; needs 2: throw the object up twice "
            "or more, so that it rotates, flies for half a second and stays in view of all cameras"
        )
    if any(other_log_odds >= MIN_LOG_ODDS and not {*group} & {*agreeing} for other_log_odds, group in groups):
        raise CalibrationRefusedError(
            "throw: flights with two different gravities, needs one: swings of the hand may look alike; leave them out by "
            "--start and --stop"
        )
    whole = _fit(agreeing, times, world_from_object)
    return _inflate_by_scatter(whole, [fits[window] for window in agreeing])


def _find_smooth_windows(times: FloatArray, poses: RigidTransform) -> tuple[list[tuple[int, int]], float]:
    """Find the windows in which one acceleration may explain the path.

    Windows begin and end at every k-th pose, such that the longest has at most `MAX_STEPS` steps. Their triangular factors
    grow together by one step at a time, so the time is proportional to the number of poses.

    Returns:
        numbers of the first and last pose of each; the largest noise that a flight may have.
    """
    n, R, x = len(times), poses.rotation.as_matrix(), poses.translation
    longest = int((np.searchsorted(times, times + MAX_SECONDS) - np.arange(n)).max(initial=0))
    step = max(-(-longest // MAX_STEPS), 1)
    first = np.arange(0, n, step)
    factors = np.zeros((len(first), 0, 13))
    # By length in steps, and start.
    noises, sds = np.full((2, max(-(-longest // step), MIN_FRAMES), len(first)), np.inf)
    for k in range(0, longest, step):
        added = np.minimum(first[:, None] + np.arange(max(k - step + 1, 0), k + 1), n - 1)
        t = (times[added] - times[first, None])[..., None, None]
        eye = np.broadcast_to(np.eye(3), (*added.shape, 3, 3))
        path = (x[added] - x[first, None])[..., None]
        rows = np.concatenate([eye, t * eye, -R[added], t**2 / 2.0 * eye, path], axis=3).reshape(len(first), -1, 13)
        factors = np.asarray(np.linalg.qr(np.concatenate([factors, rows], axis=1), mode="r"))
        if k >= (MIN_FRAMES - 1) * step:
            ends = (first + k < n) & (times[added[:, -1]] < times[first] + MAX_SECONDS)
            noises[k // step, ends], sds[k // step, ends] = _read_factors(factors[ends], 3 * (k + 1) - 12)
    shortest = noises[MIN_FRAMES - 1]
    if not np.isfinite(shortest).any():
        return [], 0.0
    limit = MAX_NOISE_RATIO * float(np.quantile(shortest[np.isfinite(shortest)], NOISE_QUANTILE))
    found, is_smooth = list[tuple[int, int]](), np.ones(len(first), bool)
    for k in range(MIN_FRAMES - 1, len(noises)):
        # Parts of a flight have no more than its noise, but for chance.
        is_smooth &= np.roll(shortest, MIN_FRAMES - 1 - k) < MAX_NOISE_RATIO * limit
        starts = np.flatnonzero(is_smooth & (noises[k] <= limit) & (sds[k] < MAX_RELATIVE_SD))
        found += [(i * step, (i + k) * step) for i in starts.tolist()]
    return found, limit


def _read_factors(factors: FloatArray, freedom: int) -> tuple[FloatArray, FloatArray]:
    """Return (n,) noise and relative standard deviation of g.

    Args:
        factors: (n, 13, 13) triangular factors of the equations of p, v, c, g and their right-hand side.
        freedom: number of equations without that of unknowns.
    """
    noise = np.abs(factors[:, 12, 12]) / np.sqrt(freedom)
    u, values, v = np.linalg.svd(factors[:, 9:12, 9:12])
    values = np.maximum(values, 1e-300)
    gravity = np.einsum("nji,nj,nkj,nk->ni", v, 1.0 / values, u, factors[:, 9:12, 12])
    return noise, noise / values[:, -1] / np.maximum(np.linalg.norm(gravity, axis=1), 1e-300)


def _fit(
    windows: Sequence[tuple[int, int]], times: FloatArray, poses: RigidTransform, *, has_jerk: bool = False
) -> FreeFlight:
    """Fit gravity and the center of mass to flights; with `has_jerk`, the result is a change of gravity in their place."""
    n = len(windows)
    rows, right = [], []
    for k, (first, last) in enumerate(windows):
        t = times[first : last + 1] - times[[first, last]].mean()
        R = poses[first : last + 1].rotation.as_matrix()
        A = np.zeros((len(t), 3, 6 * n + 9))
        eye = np.eye(3)
        A[:, :, 6 * k : 6 * k + 3] = eye
        A[:, :, 6 * k + 3 : 6 * k + 6] = t[:, None, None] * eye
        A[:, :, -3:] = t[:, None, None] ** 2 / 2.0 * eye
        A[:, :, -6:-3] = -R
        A[:, :, -9:-6] = t[:, None, None] ** 3 / 6.0 * eye if has_jerk else 0.0
        rows.append(A.reshape(-1, 6 * n + 9))
        right.append(poses[first : last + 1].translation.ravel())
    A, b = np.concatenate(rows), np.concatenate(right)
    used = np.r_[: 6 * n, np.arange(6 * n if has_jerk else 6 * n + 3, 6 * n + 9)]
    solution, _, rank, _ = np.linalg.lstsq(A[:, used], b)
    residuals = (b - A[:, used] @ solution).reshape(-1, 3)
    freedom = max(len(b) - int(rank), 1)
    # Errors of successive poses are correlated; of their sum only so much is independent.
    product, square = float((residuals[1:] * residuals[:-1]).sum()), float((residuals**2).sum())
    correlation = float(np.clip(product / max(square, 1e-300), 0.0, 0.9))
    variance = square / freedom
    covariance = variance * (1.0 + correlation) / (1.0 - correlation) * np.linalg.pinv(A[:, used].T @ A[:, used])
    # The unknowns of a jerk come before those of the center and gravity.
    own = 6 * n + np.arange(6) if not has_jerk else 6 * n + np.array([3, 4, 5, 0, 1, 2])
    joint = covariance[np.ix_(own, own)]
    return FreeFlight(solution[own[3:]], solution[own[:3]], joint, tuple(windows), float(np.sqrt(variance)))


def _is_flight(fit: FreeFlight, limit: float, times: FloatArray, poses: RigidTransform) -> bool:
    """Return whether the acceleration in a window is known, not significantly different at its ends, and explains it."""
    sd = float(np.sqrt(np.linalg.eigvalsh(fit.covariance)[-1]))
    if not (fit.noise <= limit and sd < MAX_RELATIVE_SD * float(np.linalg.norm(fit.gravity))):
        return False
    jerk = _fit(fit.flights, times, poses, has_jerk=True)
    # The change from the middle of the flight to its ends.
    half = 0.5 * float(np.ptp(times[[*fit.flights[0]]]))
    floor = (SYSTEMATIC * np.linalg.norm(fit.gravity) / half) ** 2 * np.eye(3)
    return _measure_square(jerk.gravity, jerk.covariance + floor) < chi_squared_bound(3)


def _measure_square(difference: FloatArray, covariance: FloatArray) -> float:
    """Return the squared length of a difference in its standard deviations."""
    return float(difference @ np.linalg.pinv(covariance) @ difference)


def _find_agreeing(
    fits: Mapping[tuple[int, int], FreeFlight],
) -> Iterator[tuple[float, list[tuple[int, int]]]]:
    """Yield the flights with the same gravity as each one, and the log odds that this is not by chance.

    The likelihood of differences with their covariance is compared with that of accelerations by hand, which are anywhere
    in a ball that contains all, and divided by the number of groups of this size.
    """
    radius = max((float(np.linalg.norm(fit.gravity)) for fit in fits.values()), default=0.0)
    # Of a normal density of unit covariance, times the volume of the ball.
    log_scale = float(np.log(4.0 / 3.0 * np.pi * radius**3) - 1.5 * np.log(2.0 * np.pi)) if fits else 0.0
    for window, own in fits.items():
        floor = (SYSTEMATIC * np.linalg.norm(own.gravity)) ** 2 * np.eye(3)
        group, log_odds = [window], 0.0
        for other, fit in fits.items():
            total = own.covariance + fit.covariance + floor
            square = _measure_square(own.gravity - fit.gravity, total)
            if other != window and square < chi_squared_bound(3):
                group.append(other)
                log_odds += log_scale - 0.5 * float(np.linalg.slogdet(total)[1]) - 0.5 * square
        if len(group) > 1:
            yield log_odds - float(np.log(comb(len(fits), len(group)))), sorted(group)


def _inflate_by_scatter(whole: FreeFlight, flights: Sequence[FreeFlight]) -> FreeFlight:
    """Return the fit to all flights, its covariance times the square of how much they differ (Birge ratio)."""
    squares = [_measure_square(its.gravity - whole.gravity, its.covariance) for its in flights]
    ratio = max(sum(squares) / (3.0 * (len(flights) - 1)), 1.0)
    return replace(whole, joint_covariance=ratio * whole.joint_covariance)
