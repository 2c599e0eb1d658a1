"""The start without boxes: what moves against the standing background is the object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.relative_pose.fit import MIN_MATCHES, Fit, no_fit
from sylpose.relative_pose.motion import motion_about
from sylpose.relative_pose.observability import observed
from sylpose.relative_pose.solver import fit_terms
from sylpose.relative_pose.terms import TermData, object_place
from sylpose.results import FrameStatus, Status
from sylpose.rig import Rig
from sylpose.tracking.camera import still_of
from sylpose.tracking.camera_executor import Crew
from sylpose.tracking.frame import Pair, inliers_of, still
from sylpose.tracking.frame_solvers import dealt, gathered
from sylpose.tracking.reports import Moved

__all__ = ["FirstMotion", "agree", "first_motion", "is_ambiguous", "jitter_of"]

# Another motion with this share of the object's inliers might be the object as well (choice).
RIVAL_SHARE = 0.5
# What may be keypoints that stand still is displaced by less than this, pixels; their noise is measured by these, if more
# than this share of them is displaced by less than half of it (choice).
MAYBE_STILL_PX, STILL_SHARE = 4.0, 0.65
# Rayleigh's distribution has its median at so many standard deviations (derived).
RAYLEIGH_MEDIAN = float(np.sqrt(2.0 * np.log(2.0)))
# A camera sees a motion when so many matches agree with it that are displaced, in the middle, by this much, pixels, and by
# so many times the noise of what stands still (choice).
SIGNIFICANT, SIGNIFICANT_PX, SIGNIFICANT_SIGMAS = 6, 3.5, 7.0
# A rigid motion must be likelier than displacements in random directions by this much per unknown, logarithm (choice:
# Akaike's criterion asks for 1, Bayes' for half the logarithm of the number of matches).
LIKELIER = 5.0
# Unknowns of a motion, and of each camera's surface (derived).
OF_MOTION, OF_SURFACE = 6, 6
# From one frame to the next, a motion since the first frame changes its turn by no more than this share of it, or by this
# much, radians (choice).
SAME_SHARE, SAME_TURN = 0.6, np.radians(0.75)
# This share of all matches goes astray, and does not mean that anything moved (choice).
STRAY_SHARE = 0.05
# Of what moves, residuals are no larger than this share of the displacements (choice).
JUNK = 0.35
# Noise of keypoints at least, pixels (choice).
LEAST_PX = 0.15


@dataclass(frozen=True, eq=False)
class FirstMotion:
    """The motion since a frame in which nothing but the object is going to move.

    Attributes:
        fit: of what moves.
        center: (3,) that it is about.
        radius: of its inliers about the middle of them, `middle` (3,); NaN without any.
        count: number of inliers.
        shift_px: by how much they are displaced, in the middle; NaN without any.
        cameras: how many see it: so many matches that are displaced by so much.
        certain: whether it is more than the noise of what stands still.
        whole: whether all of it is seen, the size of the turn and the length of the way too.
        nothing: what is to be said where that is not the object's motion: nothing was matched, nothing moved, or no rigid
            body.
        inliers: by camera, each its own.
    """

    fit: Fit
    center: FloatArray
    middle: FloatArray
    radius: float
    count: int
    shift_px: float
    cameras: int
    certain: bool
    whole: bool
    nothing: FrameStatus
    inliers: Sequence[Sequence[Pair]]

    @property
    def motion(self) -> RigidTransform:
        """Of the object since the frame."""
        return motion_about(self.center, self.fit.rotation, self.fit.shift)


def agree(one: RigidTransform | None, next_one: RigidTransform | None) -> bool:
    """Whether two frames' motions since the same frame, in this order, may be of one body that goes on.

    Few cameras and a flat object leave a second motion that explains the matches as well; it is another one in each frame.
    """
    if one is None or next_one is None:
        return False
    turn = max(one.rotation.magnitude(), next_one.rotation.magnitude())
    return bool((next_one.rotation * one.rotation.inv()).magnitude() <= max(SAME_SHARE * turn, SAME_TURN))


def jitter_of(pair: Pair) -> float:
    """By how much keypoints that stand still scatter in each direction, pixels; the least where next to none do."""
    shift = np.linalg.norm(pair.pixels_i - pair.pixels_j, axis=1)
    near = shift[shift < MAYBE_STILL_PX]
    # What moves slowly is found at all these distances alike.
    slow = np.count_nonzero(near < MAYBE_STILL_PX / 2) <= STILL_SHARE * len(near)
    return LEAST_PX if slow else max(float(np.median(near)) / RAYLEIGH_MEDIAN, LEAST_PX)


def first_motion(
    crew: Crew, rig: Rig, pairs: Sequence[Sequence[Pair]], first: int, rng: np.random.Generator
) -> FirstMotion:
    """The motion since the frame with the number `first`, from what moves of the matches with it.

    Args:
        pairs: by camera, each its own.
    """
    matches = sum(crew.ask(lambda c: sum(len(pair) for pair in pairs[c] if pair.reference == first), 0))
    own = crew.each(lambda c: [pair for pair in pairs[c] if pair.reference == first])
    jitter = crew.each(lambda c: [jitter_of(pair) for pair in own[c]])

    def moving_of(c: int) -> list[Pair]:
        return [pair.subset(~still(pair, still_of(px))) for pair, px in zip(own[c], jitter[c], strict=True)]

    moving = crew.each(moving_of)

    def moved(c: int) -> list[Moved]:
        return [
            Moved(
                pair.term(c, rig.cameras[c]),
                np.linalg.norm(pair.pixels_i - pair.pixels_j, axis=1),
                px,
                len(everything) - len(pair),
            )
            for pair, everything, px in zip(moving[c], own[c], jitter[c], strict=True)
            if len(pair)
        ]

    records: list[list[Moved]] = crew.ask(moved, [])
    terms = [[record.term for record in of_camera] for of_camera in records]
    data, nowhere = gathered(terms), np.full(3, np.nan)
    nothing = FrameStatus.TOO_FEW_MATCHES if matches < MIN_MATCHES else FrameStatus.NO_MOTION
    if sum(map(len, data)) > max(MIN_MATCHES, STRAY_SHARE * matches):
        nothing = FrameStatus.NOT_CONSISTENT
    if not data:
        fit = no_fit(data, Status.TOO_FEW_MATCHES)
        return FirstMotion(fit, nowhere, nowhere, np.nan, 0, np.nan, 0, False, False, nothing, crew.each(lambda _: []))
    center, radius = object_place(data)
    fit = fit_terms(data, center, radius, [], rng)
    told = [record for of_camera in records for record in of_camera]
    clear = ~_junk(fit, told)
    if 2 <= clear.sum() < len(clear):
        # What agrees in the other cameras is what jitters most of all that stands still.
        some = [term for term, mine in zip(data, clear, strict=True) if mine]
        center, radius = object_place(some)
        fit = _of_all(fit_terms(some, center, radius, [], rng), data, clear)
    seeing, likelier = _significance(fit, told)
    agreement = dealt(fit, terms)
    good = [
        (term.subset(w > 0), record.shift_px[w > 0]) for term, record, w in zip(data, told, fit.weights, strict=True)
    ]
    good = [(term, shift) for term, shift in good if len(term)]
    middle, size = object_place([term for term, _ in good]) if good else (nowhere, np.nan)
    displacement = np.concatenate([np.empty(0), *(shift for _, shift in good)])
    cameras = int(seeing.sum())
    return FirstMotion(
        fit,
        center,
        middle,
        size,
        len(displacement),
        float(np.median(displacement)) if len(displacement) else np.nan,
        cameras,
        likelier and cameras >= min(2, len(rig)),
        fit.status is Status.OK and observed(fit, size).status is Status.OK,
        nothing,
        crew.each(lambda c: inliers_of([pair for pair in moving[c] if len(pair)], [w for w, _ in agreement[c]])),
    )


def _junk(fit: Fit, told: Sequence[Moved]) -> BoolArray:
    """(T,) the cameras in which a fit leaves much of the displacements of its inliers unexplained."""
    junk = np.zeros(len(told), bool)
    for t, (record, w, across) in enumerate(zip(told, fit.weights, fit.residuals, strict=True)):
        good = w > 0
        if good.any():
            rms = float(np.sqrt(np.mean(across[good] ** 2)))
            junk[t] = rms > JUNK * float(np.median(record.shift_px[good]))
    return junk


def _of_all(fit: Fit, data: Sequence[TermData], chosen: BoolArray) -> Fit:
    """A fit to the chosen terms (T,) as one to all of them, of which the others have no inliers."""
    weights, residuals = iter(fit.weights), iter(fit.residuals)
    nothing = [np.zeros(len(term)) for term in data]
    return fit.with_matches(
        [next(weights) if mine else none for none, mine in zip(nothing, chosen, strict=True)],
        [next(residuals) if mine else none for none, mine in zip(nothing, chosen, strict=True)],
    )


def _significance(fit: Fit, told: Sequence[Moved]) -> tuple[BoolArray, bool]:
    """(T,) which cameras see a motion beyond the noise of keypoints that stand still, and whether it is likelier than that
    the matches are displaced as they are in directions of their own.

    A displacement by d in any direction has the share 1 / (π √(d² - r²)) of a component r; a rigid motion, which says where
    the match's epipolar line is, has Gauss's of a residual r.
    """
    likelier, seeing = 0.0, np.zeros(len(told), bool)
    for t, (record, w, across) in enumerate(zip(told, fit.weights, fit.residuals, strict=True)):
        good = w > 0
        if not good.any():
            continue
        r, shift = np.abs(across[good]), record.shift_px[good]
        sigma = max(LEAST_PX, record.jitter_px, float(np.sqrt(np.mean(r**2))))
        by_chance = 1.0 / (np.pi * np.sqrt(np.maximum(shift**2 - r**2, sigma**2)))
        motion = np.exp(-0.5 * (r / sigma) ** 2) / (np.sqrt(2.0 * np.pi) * sigma)
        gain = float(np.log(motion / by_chance).sum()) - LIKELIER * OF_SURFACE
        far = float(np.median(shift)) > max(SIGNIFICANT_PX, SIGNIFICANT_SIGMAS * record.jitter_px)
        seeing[t] = good.sum() >= SIGNIFICANT and far and gain > 0
        likelier += gain
    return seeing, likelier > LIKELIER * OF_MOTION


def is_ambiguous(
    crew: Crew,
    rig: Rig,
    pairs: Sequence[Sequence[Pair]],
    first: int,
    found: FirstMotion,
    rng: np.random.Generator,
) -> bool:
    """Whether something else than the object moved as a rigid body too, and nearly as much of it was seen.

    Args:
        pairs: by camera, each its own: all matches since the frame with the number `first`.
        found: what is taken for the object's motion.
    """

    def others_of(c: int) -> list[Pair]:
        taken = np.concatenate([np.empty(0, np.int64), *(pair.indices[:, 0] for pair in found.inliers[c])])
        return [pair.subset(~np.isin(pair.indices[:, 0], taken)) for pair in pairs[c]]

    other = first_motion(crew, rig, crew.each(others_of), first, rng)
    return other.fit.status is Status.OK and other.certain and other.count > RIVAL_SHARE * found.count
