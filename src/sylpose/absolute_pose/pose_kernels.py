"""Compiled loops of `estimate_pose`: robust scores, the search for a start, and the fit.

All of them take the same `Views`: n matches sorted by camera. A pose is R (3, 3) and g (3,): a model point X, relative to
the model's centre, lies at R X + g.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.absolute_pose.p3p import three_rays
from sylpose.absolute_pose.pose_noise import (
    CUTOFF,
    GAIN,
    MEDIAN_SQUARE,
    Noise,
    measure_noise,
    median_square,
    set_noise,
    weigh,
)
from sylpose.absolute_pose.pose_views import Views
from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import cholesky_solve, kernel, leaf, turn_by
from sylpose.geometry.robust_loss import BIQUARTIC_BOUND, biquartic, biquartic_loss

__all__ = ["by_chance", "drawn_good", "fit", "information", "minimize", "score", "search"]


# Rounds of re-weighting at the median's noise level (choice).
MEDIAN_ROUNDS = 3


class Room(NamedTuple):
    """For one camera at a time: turn (3, 3) and shift (3,) from the model to it, and a match's two rows (2, 6)."""

    turn: FloatArray
    shift: FloatArray
    row: FloatArray


@kernel
def _make_room() -> Room:
    """Empty."""
    return Room(np.empty((3, 3)), np.empty(3), np.empty((2, 6)))


@leaf
def _camera_from_model(
    views: Views, c: int, rotation: FloatArray, place: FloatArray, turn: FloatArray, shift: FloatArray
) -> None:
    """turn (3, 3) and shift (3,) become those from the model to camera c."""
    q = views.turns[c]
    for i in range(3):
        shift[i] = views.shifts[c, i] + q[i, 0] * place[0] + q[i, 1] * place[1] + q[i, 2] * place[2]
        for j in range(3):
            turn[i, j] = q[i, 0] * rotation[0, j] + q[i, 1] * rotation[1, j] + q[i, 2] * rotation[2, j]


@leaf
def _seen(views: Views, k: int, turn: FloatArray, shift: FloatArray) -> tuple[float, float, float, float, float]:
    """Match k in its camera: depth, normalised image (2), reprojection error in pixels (2); for positive depths only."""
    x, y, z = views.points[k, 0], views.points[k, 1], views.points[k, 2]
    depth = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z + shift[2]
    nearness = 1.0 / depth
    u = (turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z + shift[0]) * nearness
    v = (turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z + shift[1]) * nearness
    du, dv = u - views.images[k, 0], v - views.images[k, 1]
    by = views.to_pixels
    return depth, u, v, by[k, 0] * du + by[k, 1] * dv, by[k, 2] * du + by[k, 3] * dv


@leaf
def _squares(views: Views, rotation: FloatArray, place: FloatArray, out: FloatArray, room: Room) -> None:
    """out (n,): squared reprojection errors, pixels; infinite behind a camera."""
    turn, shift, _ = room
    for c in range(len(views.turns)):
        _camera_from_model(views, c, rotation, place, turn, shift)
        for k in range(views.start[c], views.start[c + 1]):
            depth, _, _, r0, r1 = _seen(views, k, turn, shift)
            out[k] = r0 * r0 + r1 * r1 if depth > 0.0 else np.inf


@kernel
def drawn_good(views: Views, rotation: FloatArray, place: FloatArray, top: float) -> float:
    """The share of `search`'s samples whose three matches are all within sqrt(top) pixels of a pose."""
    squares = np.empty(len(views.points))
    _squares(views, rotation, place, squares, _make_room())
    n_cameras, good, by_camera = len(views.turns), 0, 0.0
    for c in range(n_cameras):
        first, end, of_camera = views.start[c], views.start[c + 1], 0
        for k in range(first, end):
            of_camera += squares[k] < top
        good += of_camera
        by_camera += of_camera / (end - first)
    return 0.5 * ((good / len(squares)) ** 3 + (by_camera / n_cameras) ** 3)


@kernel
def by_chance(views: Views, place: FloatArray, weights: FloatArray, noise: Noise) -> tuple[int, float]:
    """Of the matches that agree with a pose, by their weights (n,): how many they are, and the sum of the logarithms of how
    likely random ones do: the share of the object's image that a circle of `CUTOFF` sigma covers."""
    square, agree, log_share = 0.0, 0, 0.0
    for k in range(len(views.points)):
        for i in range(3):
            square += views.points[k, i] ** 2
    radius = np.sqrt(square / len(views.points))
    for c in range(len(views.turns)):
        of_camera = 0
        for k in range(views.start[c], views.start[c + 1]):
            of_camera += weights[k] > 0.0
        q, by = views.turns[c, 2], views.to_pixels[views.start[c]]
        depth = max(q[0] * place[0] + q[1] * place[1] + q[2] * place[2] + views.shifts[c, 2], 1e-300)
        size = np.sqrt(abs(by[0] * by[3] - by[1] * by[2])) * radius / depth
        log_share += of_camera * np.log(min(max(CUTOFF**2 * noise.variances[c] / size**2, 1e-12), 1.0))
        agree += of_camera
    return agree, log_share


@kernel
def score(views: Views, rotation: FloatArray, place: FloatArray, top: float, bound: float) -> float:
    """Sum over the matches of the loss with the cutoff sqrt(top) pixels, each between 0 and 1; given up beyond `bound`."""
    return _score(views, rotation, place, top, bound, _make_room())


@leaf
def _score(views: Views, rotation: FloatArray, place: FloatArray, top: float, bound: float, room: Room) -> float:
    turn, shift, _ = room
    total = 0.0
    for c in range(len(views.turns)):
        _camera_from_model(views, c, rotation, place, turn, shift)
        for k in range(views.start[c], views.start[c + 1]):
            depth, _, _, r0, r1 = _seen(views, k, turn, shift)
            share = (r0 * r0 + r1 * r1) / top if depth > 0.0 else 2.0
            total += biquartic_loss(share) / BIQUARTIC_BOUND
        if total > bound:
            return total
    return total


@leaf
def _normal_equations(
    views: Views,
    rotation: FloatArray,
    place: FloatArray,
    noise: Noise,
    hessian: FloatArray,
    gradient: FloatArray,
    room: Room,
) -> float:
    """hessian (6, 6) and gradient (6,) by (w, d) of the re-weighted squares in units of their variance, and the loss."""
    for i in range(6):
        gradient[i] = 0.0
        for j in range(6):
            hessian[i, j] = 0.0
    turn, shift, row = room
    loss = 0.0
    for c in range(len(views.turns)):
        _camera_from_model(views, c, rotation, place, turn, shift)
        q = views.turns[c]
        variance, top = noise.variances[c], noise.tops[c]
        for k in range(views.start[c], views.start[c + 1]):
            depth, u, v, r0, r1 = _seen(views, k, turn, shift)
            share = (r0 * r0 + r1 * r1) / top if depth > 0.0 else 2.0
            loss += 0.5 * top / variance * biquartic_loss(share)
            if not share < 1.0:
                continue
            weight = biquartic(share) / variance
            # The point relative to the model's centre, turned into the world.
            x, y, z = views.points[k, 0], views.points[k, 1], views.points[k, 2]
            x0 = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z
            x1 = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z
            x2 = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z
            by = views.to_pixels
            nearness = 1.0 / depth
            for j in range(3):
                by_u, by_v = (q[0, j] - u * q[2, j]) * nearness, (q[1, j] - v * q[2, j]) * nearness
                row[0, 3 + j] = by[k, 0] * by_u + by[k, 1] * by_v
                row[1, 3 + j] = by[k, 2] * by_u + by[k, 3] * by_v
            for i in range(2):
                row[i, 0] = x1 * row[i, 5] - x2 * row[i, 4]
                row[i, 1] = x2 * row[i, 3] - x0 * row[i, 5]
                row[i, 2] = x0 * row[i, 4] - x1 * row[i, 3]
            for i in range(6):
                w0, w1 = weight * row[0, i], weight * row[1, i]
                gradient[i] += w0 * r0 + w1 * r1
                for j in range(i + 1):
                    hessian[i, j] += w0 * row[0, j] + w1 * row[1, j]
    for i in range(6):
        for j in range(i):
            hessian[j, i] = hessian[i, j]
    return loss


@leaf
def _loss(views: Views, rotation: FloatArray, place: FloatArray, noise: Noise, room: Room) -> float:
    """The loss alone, as `_normal_equations` has it."""
    turn, shift, _ = room
    loss = 0.0
    for c in range(len(views.turns)):
        _camera_from_model(views, c, rotation, place, turn, shift)
        top = noise.tops[c]
        each = 0.5 * top / noise.variances[c]
        for k in range(views.start[c], views.start[c + 1]):
            depth, _, _, r0, r1 = _seen(views, k, turn, shift)
            loss += each * biquartic_loss((r0 * r0 + r1 * r1) / top if depth > 0.0 else 2.0)
    return loss


@leaf
def _copy_pose(rotation: FloatArray, place: FloatArray, to_rotation: FloatArray, to_place: FloatArray) -> None:
    for i in range(3):
        to_place[i] = place[i]
        for j in range(3):
            to_rotation[i, j] = rotation[i, j]


@kernel
def minimize(
    views: Views, rotation: FloatArray, place: FloatArray, noise: Noise, steps: int, damping: float
) -> tuple[float, float]:
    """Levenberg-Marquardt on the loss at a fixed noise level, in place.

    Returns:
        what the last step promised to lower the loss by, and the damping to go on with.
    """
    hessian, gradient = np.empty((6, 6)), np.empty(6)
    new_hessian, new_gradient = np.empty((6, 6)), np.empty(6)
    new_rotation, new_place = np.empty((3, 3)), np.empty(3)
    damped, step, room = np.empty((6, 6)), np.empty(6), _make_room()
    loss = _normal_equations(views, rotation, place, noise, hessian, gradient, room)
    promised = np.inf
    for step_ in range(steps):
        for i in range(6):
            for j in range(6):
                damped[i, j] = hessian[i, j]
            damped[i, i] *= 1.0 + damping
            step[i] = -gradient[i]
        if not cholesky_solve(damped, step):
            damping = max(10.0 * damping, 1e-8)
            promised = np.inf
            continue
        promised = 0.0
        for i in range(6):
            promised -= 0.5 * step[i] * gradient[i]
        turn_by(step[:3], rotation, new_rotation)
        for i in range(3):
            new_place[i] = place[i] + step[3 + i]
        if step_ + 1 < steps:
            new_loss = _normal_equations(views, new_rotation, new_place, noise, new_hessian, new_gradient, room)
        else:
            # No step follows that would need more.
            new_loss = _loss(views, new_rotation, new_place, noise, room)
        if new_loss <= loss:
            _copy_pose(new_rotation, new_place, rotation, place)
            hessian, new_hessian, gradient, new_gradient = new_hessian, hessian, new_gradient, gradient
            loss = new_loss
            damping = 0.1 * damping if damping > 1e-6 else 0.0
        else:
            damping = max(10.0 * damping, 1e-3)
    return promised, damping


@kernel
def fit(
    views: Views,
    rotation: FloatArray,
    place: FloatArray,
    top: float,
    rounds: int,
    steps: int,
    squares: FloatArray,
    weights: FloatArray,
    noise: Noise,
) -> tuple[int, float, bool]:
    """The robust fit from a start, in place: re-weighting at the noise level that the distances show.

    The median tells the noise at first, since it bears outliers and a start that is not exact; then the weighted mean
    square does, which is the better measure once outliers are out.

    Args:
        top: squared distances beyond it are outliers whatever the noise.
        rounds, steps: at most so many rounds of so many steps each (arguments, since Numba compiles a version of
            `minimize` for every constant).
        squares, weights: (n,) and noise, filled.

    Returns:
        rounds used, degrees of freedom, and whether it settled.
    """
    damping, freedom, promised, change, room = 1e-4, 1.0, np.inf, np.inf, _make_room()
    round_ = 0
    for round_ in range(rounds):
        _squares(views, rotation, place, squares, room)
        before = noise.variances[0]
        if round_ < MEDIAN_ROUNDS:
            median, count = median_square(squares, top)
            if count < 4:
                return round_, 1.0, False
            # Six unknowns have been fitted.
            variance = median / MEDIAN_SQUARE * count / max(count - 3.0, 1.0)
            for c in range(len(noise.tops)):
                set_noise(noise, c, variance, views.least, max(2.0 * count - 6.0, 1.0), top)
        else:
            weigh(squares, views.start, noise, weights)
            freedom = measure_noise(squares, views.start, weights, views.least, top, noise)
            change = abs(noise.variances[0] / before - 1.0)
        if round_ > MEDIAN_ROUNDS and promised < 1e-10 and change < 1e-4:
            break
        promised, damping = minimize(views, rotation, place, noise, steps, damping)
    weigh(squares, views.start, noise, weights)
    return round_, freedom, promised < 1e-4 and change < 0.1


@kernel
def information(views: Views, rotation: FloatArray, place: FloatArray, noise: Noise, out: FloatArray) -> None:
    """out (6, 6) becomes the information about (w, d): the inverse of the covariance that these weights have."""
    _normal_equations(views, rotation, place, noise, out, np.empty(6), _make_room())
    for i in range(6):
        for j in range(6):
            out[i, j] *= GAIN


@kernel
def search(
    views: Views,
    draws: FloatArray,
    top: float,
    steps: int,
    rotations: FloatArray,
    places: FloatArray,
    scores: FloatArray,
) -> None:
    """Random samples of three matches; each that is the best so far is improved on all matches and kept.

    Args:
        draws: (S, 6) uniform in [0, 1), what the samples are made of.
        top: squared distance beyond which a match is wrong, pixels squared.
        steps: that improve a pose.
        rotations: (K, 3, 3), places: (K, 3), scores: (K + 1,): the poses kept, best first, and the score of the best sample;
            infinite scores to begin with.
    """
    n, n_cameras, kept = len(views.points), len(views.turns), len(places)
    origins, rays, model = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    found_rotations, found_places, room = np.empty((8, 3, 3)), np.empty((8, 3)), _make_room()
    noise = Noise(np.full(n_cameras, top / (CUTOFF * CUTOFF)), np.full(n_cameras, top))
    for s in range(len(draws)):
        for i in range(3):
            k = int(draws[s, i] * n)
            if s % 2 == 1:  # every camera as often as another: one with many wrong matches must not be all there is
                c = int(draws[s, 3 + i] * n_cameras)
                k = views.start[c] + int(draws[s, i] * (views.start[c + 1] - views.start[c]))
            c = 0
            while k >= views.start[c + 1]:
                c += 1
            q, shift = views.turns[c], views.shifts[c]
            u, v = views.images[k, 0], views.images[k, 1]
            length = np.sqrt(u * u + v * v + 1.0)
            for j in range(3):
                origins[i, j] = -(q[0, j] * shift[0] + q[1, j] * shift[1] + q[2, j] * shift[2])
                rays[i, j] = (q[0, j] * u + q[1, j] * v + q[2, j]) / length
                model[i, j] = views.points[k, j]
        best = -1
        for h in range(three_rays(origins, rays, model, found_rotations, found_places)):
            value = _score(views, found_rotations[h], found_places[h], top, scores[kept], room)
            if value < scores[kept]:
                scores[kept], best = value, h
        if best < 0:
            continue
        rotation, place = found_rotations[best], found_places[best]
        minimize(views, rotation, place, noise, steps, 1e-3)
        value = _score(views, rotation, place, top, scores[kept - 1], room)
        if not value < scores[kept - 1]:
            continue
        at = kept - 1
        while at > 0 and value < scores[at - 1]:
            _copy_pose(rotations[at - 1], places[at - 1], rotations[at], places[at])
            scores[at] = scores[at - 1]
            at -= 1
        _copy_pose(rotation, place, rotations[at], places[at])
        scores[at] = value
