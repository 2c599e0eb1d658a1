"""`estimate_motion`: how the object moved between two frames, from all cameras together."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.duplicates import distinct
from sylpose.geometry.matrices import covariance_of, forget
from sylpose.geometry.noise import NoisePx, NoiseUnits, noise_units
from sylpose.geometry.numba_linalg import kernel
from sylpose.geometry.validation import finite, items, kind_of, listed, number, one_of, whole
from sylpose.matches import Matches
from sylpose.methods import MOTION_METHODS as METHODS
from sylpose.relative_pose.fit import MIN_MATCHES, Fit, Solved, no_fit
from sylpose.relative_pose.leave_one_out import without_faults
from sylpose.relative_pose.observability import judged
from sylpose.relative_pose.robust_fit import Seeded
from sylpose.relative_pose.second_motion import larger_body
from sylpose.relative_pose.solver import fit_terms
from sylpose.relative_pose.sylvester_methods import ESTIMATORS, paper_fit
from sylpose.relative_pose.terms import TermData, join, object_place
from sylpose.results import Motion, Status
from sylpose.rig import Rig, single_pose

__all__ = [
    "METHODS",
    "estimate_motion",
    "estimate_motions",
    "motion_about",
]


def estimate_motion(
    rig: Rig,
    matches: Sequence[Matches],
    *,
    method: str = "epipolar",
    initial: RigidTransform | None = None,
    center: ArrayLike | None = None,
    radius: float | None = None,
    noise_px: NoisePx | None = None,
    seed: int = 0,
) -> Motion:
    """The object's motion between two frames from matches within each camera.

    Args:
        rig: C cameras.
        matches: C sets of matches, in the rig's order; `Matches.none()` for a camera that sees nothing. One that is given
            several times counts once.
        method: "epipolar" (perspective, six degrees of freedom, robust: docs/method.md, "Two frames") or one of the paper's
            estimators, from the pair moments of its inliers: "sylvester" (centralised), "depth-plane" (with a plane for
            the depth), "exchange", "refine", "gossip" (distributed), "one-camera" and "unconstrained" (of the camera that
            has the most matches).
        initial: a guess of the motion (while tracking, the last one), tried besides the built-in starts.
        center: (3,) where the object's centre is in frame i, world; None: the point nearest to the cameras' mean rays.
        radius: of the object, length units, about right (twice the median distance of its points from the centre); None:
            from the spread of the matches.
        noise_px: (C,) what is known of the keypoints' noise in each camera: the standard deviation of a coordinate, pixels;
            in the rig's order, or a number by each camera's name. The cameras count accordingly, what is far in pixels is so
            in proportion, and no less noise is believed; where the matches show more, more is. Infinite: the camera has no
            say. Of the paper's estimators it decides which matches are inliers, no more. None: the matches alone tell.
        seed: of the outlier rejection. Same input and seed, same result.

    Returns:
        `Motion`; look at its `status` first. One camera alone gives SCALE_NOT_OBSERVABLE: its translation is then in
        units of an object at distance 1, unless `center` says where the object is.

    Raises:
        ValueError: as many matches as cameras are needed; an unknown method; a center that is not finite or behind a camera
            that has matches; a radius that is not positive; noise
            of other cameras, or that none has.

    Source: Chen & Schonfeld 2010 for the paper's estimators; docs/method.md for the rest.
    """
    matches = listed(matches, Matches, "matches", len(kind_of(rig, Rig, "rig")))
    one_of(method, METHODS, "method")
    seed = whole(seed, "seed")
    if radius is not None:
        radius = number(radius, "radius", above=0.0)
    if initial is not None:
        single_pose(initial, "initial")
    if center is not None:
        center = finite(center, (3,), "center")
    units = NoiseUnits(np.ones(len(rig)), 0.0) if noise_px is None else noise_units(noise_px, rig.names)
    singles = [distinct(m.x, m.y) for m in matches]
    if any(single is not None for single in singles):
        once = [m if s is None else Matches(m.x[s.rows], m.y[s.rows]) for m, s in zip(matches, singles, strict=True)]
        options: dict[str, Any] = {"initial": initial, "center": center, "radius": radius, "noise_px": noise_px}
        found = estimate_motion(rig, once, method=method, seed=seed, **options)
        masks = zip(found.inliers, singles, strict=True)
        return replace(found, inliers=tuple(mask if s is None else mask[s.which] for mask, s in masks))
    data = [
        TermData(c, m.x, m.y, camera.rotation, camera.center, camera.focal * per_px)
        for c, (camera, m, per_px) in enumerate(zip(rig, matches, units.per_px.tolist(), strict=True))
        if len(m) and per_px > 0.0
    ]
    if sum(len(term) for term in data) < MIN_MATCHES:
        nowhere = np.full(3, np.nan)
        return _motion(rig, matches, data, no_fit(data, Status.TOO_FEW_MATCHES), nowhere, method, 1.0, units.per_px)
    given = None if center is None else _place(np.asarray(center), rig, data)
    rng = Seeded(seed)

    def solve(terms: Sequence[TermData], near: Solved | None = None) -> Solved:
        joined = join(terms)
        found_center, found_radius = object_place(terms, joined)
        g = found_center if given is None else given
        guess = [] if initial is None else [(initial.rotation.as_matrix(), initial.apply(g) - g)]
        if near is not None:
            turn = near.fit.rotation
            guess.append((turn, near.fit.shift + (turn - np.eye(3)) @ (g - near.center)))
        size = found_radius if radius is None else radius
        return Solved(fit_terms(terms, g, size, guess, rng, joined, units.least), g, size)

    solved, share = larger_body(data, solve(data), solve, units.least)
    if share == 0.0 and solved.fit.status is not Status.TOO_FEW_MATCHES:
        solved = without_faults(data, solved, rig.names, solve)
    fit, g, size = solved
    if method in ESTIMATORS and fit.status is Status.OK:
        fit = paper_fit(method, data, fit, g, rig.names)
    # One camera alone does not tell how far away the object is, unless somebody says so.
    unit = rig.unit if given is not None or len(data) > 1 else ""
    return _motion(rig, matches, data, fit, g, method, size, units.per_px, share, unit)


def estimate_motions(
    rig: Rig,
    pairs: Iterable[Sequence[Matches]],
    *,
    method: str = "epipolar",
    noise_px: NoisePx | None = None,
    seed: int = 0,
    threads: int = 1,
) -> list[Motion]:
    """The motions of many frame pairs of one rig.

    Args:
        rig: C cameras.
        pairs: for each frame pair its C sets of matches, as `estimate_motion` takes them.
        method, noise_px, seed: as in `estimate_motion`; every pair has the same.
        threads: the compiled part of the work, two thirds of it, runs beside that of other pairs.

    Returns:
        what `estimate_motion` returns for each, to the last bit, in order.

    Raises:
        ValueError: as `estimate_motion`; fewer than one thread.
    """
    whole(threads, "threads", least=1)
    sets = [
        listed(one, Matches, f"pairs[{k}]", len(kind_of(rig, Rig, "rig")))
        for k, one in enumerate(items(pairs, "pairs"))
    ]

    def one(matches: Sequence[Matches]) -> Motion:
        return estimate_motion(rig, matches, method=method, noise_px=noise_px, seed=seed)

    if threads == 1:
        return [one(matches) for matches in sets]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(one, sets))


def motion_about(center: FloatArray, rotation: FloatArray, shift: FloatArray) -> RigidTransform:
    """X -> R (X - g) + g + d as a transform; g (3,), R (3, 3), d (3,)."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, center + shift - rotation @ center
    # A rotation to rounding, as solvers keep it: to make it one again takes twice as long as all else here.
    return RigidTransform(matrix, normalize=False)


def _motion(
    rig: Rig,
    matches: Sequence[Matches],
    data: Sequence[TermData],
    fit: Fit,
    center: FloatArray,
    method: str,
    radius: float,
    per_px: FloatArray,
    second: float = 0.0,
    unit: str = "",
) -> Motion:
    """The public result of a fit, with what cannot be observed said."""
    inliers = [np.zeros(len(m), bool) for m in matches]
    residuals = np.full(len(rig), np.nan)
    for term, w, r in zip(data, fit.weights, fit.residuals, strict=True):
        residuals[term.camera] = _rms(w, r, inliers[term.camera]) / float(per_px[term.camera])
    fit, open_ = judged(fit, radius)
    guess = fit.status.has_pose or len(open_) > 0
    if fit.status.has_pose and fit.status is not Status.NO_MOTION and (fit.mixed or fit.other is not None):
        fit, open_ = replace(fit, status=Status.MIXED if fit.mixed else Status.AMBIGUOUS), np.empty((0, 6))
    information = fit.information_without_depth if len(open_) else fit.information
    if fit.status is Status.SCALE_NOT_OBSERVABLE:
        for row in open_:
            # What is in a length that is not observable is not known at all, whatever the linearised model says.
            information = forget(information, row)
    return Motion(
        status=fit.status,
        motion=motion_about(center, fit.rotation, fit.shift) if guess else None,
        center=center,
        information=information,
        covariance=covariance_of(information),
        unseen=open_,
        inliers=tuple(inliers),
        residuals=residuals,
        method=method,
        iterations=fit.iterations,
        faults=fit.faults,
        rival=motion_about(center, *fit.other) if fit.status is Status.AMBIGUOUS and fit.other is not None else None,
        second=second,
        standing=fit.standing,
        camera_names=rig.names,
        unit=unit,
    )


@kernel
def _rms(weights: FloatArray, residuals: FloatArray, agree: BoolArray) -> float:
    """Of the residuals of the inliers, NaN without any; agree (n,) becomes which they are."""
    count, squares = 0, 0.0
    for i in range(len(weights)):
        agree[i] = weights[i] > 0.0
        if agree[i]:
            count += 1
            squares += residuals[i] * residuals[i]
    return float(np.sqrt(squares / count)) if count > 0 else np.nan


def _place(g: FloatArray, rig: Rig, data: Sequence[TermData]) -> FloatArray:
    """The given centre (3,), once it makes sense."""
    for term in data:
        if term.rotation[2] @ (g - term.center) <= 0:
            raise ValueError(f"center: {g.tolist()} is behind camera {rig.names[term.camera]}, which has matches")
    return g
