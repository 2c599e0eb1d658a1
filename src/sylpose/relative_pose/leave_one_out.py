"""Cameras at fault, found by leaving them out: a wrong calibration, junk matches, a frozen image.

Under weak perspective the inliers of one camera lie near a hyperplane of (x, y), whatever its calibration (`seeds`). How
much worse the common motion fits them than their own hyperplane does (`_strain`) therefore tells, at any level of noise,
that a camera disagrees with the rest. It pulls the motion towards itself, so that others look wrong as well; where one is
strained the fit is made again without each of them, and each camera is fitted alone. The one that is left out is the one
whose own motion and that of the others are together clearly the likeliest. Two exchanged videos are found by exchanging
them back (`exchanged`). What of a camera's matches agrees with the others' motion as noise allows is heard again, if that is
not little: then only some of its matches are of something else.

Source: the leave-one-out test is Chow's (Econometrica 28, 1960); its use here is ours (docs/method.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.epipolar import essential, sampson
from sylpose.matches import STILL_PX
from sylpose.moments import PairMoments
from sylpose.relative_pose.camera_inconsistency import ENOUGH, REJECTED, UNKNOWNS, by_chance, strain, too_much
from sylpose.relative_pose.coverage import another_looks_elsewhere
from sylpose.relative_pose.fit import Fit, Solve, Solved
from sylpose.relative_pose.irls import SIGMA_FLOOR_PX
from sylpose.relative_pose.solver import FAR_PX
from sylpose.relative_pose.terms import TermData
from sylpose.results import Status
from sylpose.sylvester.camera_faults import suspect_cameras

__all__ = ["exchanged", "solved_part", "without_faults"]


# So many cameras are left out at most, and so many of the most strained, those that were rejected first, in turn (choice).
MOST, TRIED = 8, 8
# A camera is left out where its own motion and that of the others are so much likelier than a common one: six unknowns
# (measured: ibid.; without a fault among those asked 23 at most).
WON = 25.0
# Who it is is clear where leaving out any other is less likely by this; with three cameras, two of which always nearly
# agree, by this (choice).
CLEARLY, CLEAR = 8.0, 60.0
# Of more cameras than this the likeliest is left out, though another may be nearly as likely, and may be next (choice).
FEW = 4
# Pairs of cameras whose videos may be exchanged back, at most; the share of inliers that this must lead to, and by how much
# others must be strained more (choice).
PAIRS, EXPLAINED, RATHER = 15, 0.85, 4.0
# Exchanged videos strain all cameras together by more than this, or have one rejected (measured: ibid., 57 and more).
TORN = 45.0
# Where cameras were left out the others are strained by no more, or the reason is another (chi-squared of four: 1 in 60).
AT_EASE = 12.0
# A share of a camera's own inliers between these is neither junk nor a wrong calibration: it sees two motions (choice).
MIXED = (0.35, 0.6)
# Where the others agree in less of their matches, two motions are about as large: nobody is to blame (choice).
MAJORITY = 0.66
# What agrees of a camera that was left out is not heard where it is strained by more (chi-squared of four: 1 in 2000).
LEFT = 20.0
# A camera's noise is as usual while its variance exceeds that of the others by no more standard deviations (choice).
NOISIER = 3.5
# Matches within the first distance of their epipolar lines, in standard deviations, are more than those between it and the
# second where only noise put them there; less than such a share of a camera's matches is nothing (choice).
NEAR, FAR, SHARE = 1.5, 4.5, 0.3
# A camera that was rejected (`REJECTED`) is named where so large a share of its matches are inliers of a motion of its own
# (choice).
OWN = 0.6
EXCHANGED = "its matches are those of camera {}: the two were exchanged"


def without_faults(data: Sequence[TermData], solved: Solved, names: Sequence[str], solve: Solve) -> Solved:
    """The solution without the cameras at fault, of which each is named in `Fit.faults`.

    With two cameras it is not known which is wrong; with three only where one is by far the likeliest. At most every other
    camera is left out, and no more than eight. Where no camera is strained this takes some ten microseconds per camera.

    Args:
        data: the terms of the fit, one per camera, all in one reference frame.
        solved: the solution of all of them, with a pose or NOT_CONVERGED.
        names: of the rig's cameras.
        solve: solves a part of the terms.
    """
    heard = [np.ones(len(term), dtype=bool) for term in data]
    out: list[int] = []
    first = solved
    asked: set[int] = set()
    if solved.fit.at_ease or not _disagree(data, solved.fit):
        return solved
    junk = solved.fit.status.has_pose and _only_junk(data, solved.fit, solve)
    back = None if junk else exchanged(data, solved, names, solve)
    if back is not None:
        return back
    if junk:
        out = np.flatnonzero(_rejected(data, solved.fit)).tolist()
        solved = solved_part(data, [m & (i not in out) for i, m in enumerate(heard)], solve) or solved
    unclear = None
    for _ in range(0 if junk else min((len(data) - 1) // 2, MOST)):
        found, unclear = _worst(data, heard, solved, solve)
        if found is None or found[0] in asked:
            break
        k, solved = found
        asked.add(k)
        heard[k] = _agreeing(data[k], solved)
        again = solved_part(data, heard, solve) if heard[k].any() else None
        strain = np.inf if again is None else float(_strains(data, again.fit)[k])
        if again is not None and not (strain > LEFT and _noisy(again.fit, k)) and (again.fit.weights[k] > 0).any():
            solved = again
        else:
            heard[k][:] = False
            out.append(k)
    if out and not junk and _strains(data, solved.fit).max() > AT_EASE + by_chance(len(data)):
        # Leaving out does not explain it: all are heard.
        solved, out = first, []
    if not solved.fit.status.has_pose:
        return solved
    if unclear is not None and not out:
        # Nobody may be at fault, but the search: it has not met what the others say.
        again = solve(data, unclear)
        return solved._replace(fit=replace(solved.fit, mixed=True)) if _disagree(data, again.fit) else again
    rejected = _rejected(data, solved.fit)
    rejected[out] = True
    agree, could = sum(int((w > 0).sum()) for w in solved.fit.weights), np.array([len(term) for term in data])
    if not rejected.any() or agree < MAJORITY * could[~rejected].sum():
        return solved
    for k in np.flatnonzero(rejected).tolist():
        alone = solve([data[k]]).fit
        rejected[k] = not _sees_two(alone)
        # It sees a motion, and not that of the others.
        if rejected[k] and k not in out and (alone.weights[0] > 0).sum() > OWN * len(data[k]):
            out.append(k)
    return solved._replace(fit=replace(solved.fit, faults=_named(data, solved.fit, rejected, out, names)))


def exchanged(data: Sequence[TermData], solved: Solved, names: Sequence[str], solve: Solve) -> Solved | None:
    """The solution with the matches of two cameras exchanged back, where these, and no other two, explain all of them.

    What two exchanged cameras say is consistent: around an object they are each other's image in a turn by half of a circle.
    So leaving out tells nothing of four cameras, two of which were exchanged.
    """
    pairs = [(a, b) for a in range(len(data)) for b in range(a)]
    if not len(data) > 3 or len(pairs) > PAIRS:
        return None
    if np.maximum(_strains(data, solved.fit), 0.0).sum() < TORN and not _rejected(data, solved.fit).any():
        return None
    costs: list[float] = []
    likely: list[tuple[float, str]] = []
    best: Solved | None = None
    for a, b in pairs:
        mixed = list(data)
        mixed[a] = replace(data[a], x=data[b].x, y=data[b].y, focal=data[b].focal)
        mixed[b] = replace(data[b], x=data[a].x, y=data[a].y, focal=data[a].focal)
        again = solve(mixed)
        if not again.fit.status.has_pose or again.fit.status is Status.NO_MOTION:
            continue
        weights, residuals = list(again.fit.weights), list(again.fit.residuals)
        inliers = [np.count_nonzero(w) for w in weights]
        strains = _strains(mixed, again.fit)
        if min(n - EXPLAINED * len(term) for n, term in zip(inliers, mixed, strict=True)) < 0:
            continue
        costs.append(float(np.maximum(strains, 0.0).sum()))
        if strains.max() <= AT_EASE and costs[-1] == min(costs):
            weights[a], weights[b], residuals[a], residuals[b] = weights[b], weights[a], residuals[b], residuals[a]
            texts = tuple(
                f"camera {names[data[i].camera]}: {EXCHANGED.format(names[data[k].camera])}"
                for i, k in ((b, a), (a, b))
            )
            fit = replace(again.fit.with_matches(weights, residuals), faults=texts)
            best = again._replace(fit=fit)
        if strains.max() <= AT_EASE:
            likely.append((costs[-1], f"cameras {names[data[b].camera]} and {names[data[a].camera]}"))
    if best is None:
        return None
    if len(costs) > 1 and sorted(costs)[1] - min(costs) < RATHER:
        # In a rig with a symmetry one exchange is as good as another.
        pairs_said = " or of ".join(text for cost, text in sorted(likely) if cost < min(costs) + RATHER)
        return solved._replace(
            fit=replace(solved.fit, mixed=True, faults=(f"the videos of {pairs_said} were exchanged",))
        )
    return best


def _disagree(data: Sequence[TermData], fit: Fit) -> bool:
    """Whether the cameras do, or there is no answer. What moves by little before a background accuses nobody."""
    if not fit.status.has_pose:
        return True
    if fit.standing > 0.0:
        far = np.concatenate([_far(term)[w > 0] for term, w in zip(data, fit.weights, strict=True)])
        if not float(np.median(far)) > FAR_PX:
            return False
    return _are_strained(data, fit) or bool(_rejected(data, fit).any())


def _are_strained(data: Sequence[TermData], fit: Fit) -> bool:
    """Whether a camera is, or all are together."""
    return bool(too_much(_strains(data, fit)))


def _only_junk(data: Sequence[TermData], fit: Fit, solve: Solve) -> bool:
    """Whether all that is wrong is cameras that were rejected and see no motion by themselves either."""
    if _are_strained(data, fit):
        return False
    gone = _rejected(data, fit)
    alone = [solve([data[k]]).fit.status for k in np.flatnonzero(gone).tolist()]
    return not any(status.has_pose and status is not Status.NO_MOTION for status in alone)


def _rejected(data: Sequence[TermData], fit: Fit) -> BoolArray:
    """(T,) cameras hardly any of whose matches are inliers."""
    inliers, matches = (np.array(n) for n in ([np.count_nonzero(w) for w in fit.weights], [len(t) for t in data]))
    return np.asarray((matches >= ENOUGH) & (inliers <= REJECTED * matches))


def _worst(
    data: Sequence[TermData], heard: Sequence[BoolArray], solved: Solved, solve: Solve
) -> tuple[tuple[int, Solved] | None, Solved | None]:
    """The term that would rather have a motion of its own, if it is clear which, and the solution without it; else, where
    one would, the likeliest solution without one. Judged by likelihoods: of all others together and of the one alone,
    beside that of all together.
    """
    cameras = sum(bool(mask.any()) for mask in heard)
    if cameras < 3 or not _disagree(data, solved.fit):
        return None, None
    # A camera may keep the solver from settling at all: any of them.
    posed = solved.fit.status.has_pose
    strains = _strains(data, solved.fit) if posed else np.full(len(data), np.inf)
    gone = _rejected(data, solved.fit)
    order = np.where(gone, np.inf, strains)
    costs, rests = dict[int, float](), dict[int, Solved]()
    for k in np.argsort(-order, kind="stable")[:TRIED].tolist():
        if not heard[k].any():
            continue
        rest = solved_part(data, [mask & (i != k) for i, mask in enumerate(heard)], solve)
        if rest is not None:
            costs[k], rests[k] = rest.fit.cost + solve([data[k].subset(heard[k])]).fit.cost, rest
    if not rests or not np.isfinite(min(costs.values())):
        return None, None
    best, *others = sorted(rests, key=lambda k: costs[k])
    # Where all that is left is strained, the model is not quite right, and a difference means the less.
    left = _strains(data, rests[best].fit)
    usual = max(1.0, float(np.maximum(left, 0.0).sum()) / (UNKNOWNS * (cameras - 1)))
    gain = solved.fit.cost - costs[best] if posed else np.inf
    if not (_still(data, best) or gain > WON * usual):
        return None, None
    margin = (CLEARLY if cameras > 3 else CLEAR) * usual
    clear = _still(data, best) or cameras > FEW or all(costs[k] - costs[best] > margin for k in others)
    told = {i: t.subset(mask) for i, (t, mask) in enumerate(zip(data, heard, strict=True)) if mask.any()}
    if clear and not another_looks_elsewhere(list(told.values()), told[best]):
        return (best, rests[best]), None
    return None, rests[best] if left.max() <= AT_EASE + by_chance(cameras) else None


def _far(term: TermData) -> FloatArray:
    """(n,) how far its matches move, pixels."""
    return np.asarray(term.focal * np.linalg.norm(term.y - term.x, axis=1))


def _still(data: Sequence[TermData], k: int) -> bool:
    """Whether nothing moves in a camera while all others see motion."""
    far = [float(np.median(_far(term))) for term in data]
    return far[k] <= STILL_PX and min(far[:k] + far[k + 1 :], default=0.0) > FAR_PX


def solved_part(data: Sequence[TermData], heard: Sequence[BoolArray], solve: Solve) -> Solved | None:
    """The solution of what is heard, spoken of as one of all terms; None without a pose."""
    some = [i for i, mask in enumerate(heard) if mask.any()]
    part = solve([data[i].subset(heard[i]) for i in some])
    if not part.fit.status.has_pose:
        return None
    weights, residuals = [np.zeros(len(term)) for term in data], [_across(term, part) for term in data]
    for i, w, r in zip(some, part.fit.weights, part.fit.residuals, strict=True):
        weights[i][heard[i]], residuals[i][heard[i]] = w, r
    return part._replace(fit=part.fit.with_matches(weights, residuals))


def _strains(data: Sequence[TermData], fit: Fit) -> FloatArray:
    """(T,) `strain` of the terms' inliers."""
    parts = zip(data, fit.weights, fit.residuals, strict=True)
    return np.array([strain(term.x, term.y, w, r, term.focal) for term, w, r in parts])


def _agreeing(term: TermData, solved: Solved) -> BoolArray:
    """(n,) matches near their epipolar lines of a motion that was found without them; none where they are not as near as
    noise puts them: a bad calibration scatters them evenly."""
    inliers = [(w[w > 0], r[w > 0]) for w, r in zip(solved.fit.weights, solved.fit.residuals, strict=True)]
    mass = max(sum(float(w.sum()) for w, _ in inliers), 1e-300)
    sigma = max(float(np.sqrt(sum(float(w @ r**2) for w, r in inliers) / mass)), SIGMA_FLOOR_PX)
    off = np.abs(_across(term, solved)) / sigma
    moved = term.focal * np.linalg.norm(term.y - term.x, axis=1) > STILL_PX
    near, far = int((moved & (off < NEAR)).sum()), int((moved & (off >= NEAR) & (off < FAR)).sum())
    enough = near > far and near >= max(ENOUGH, SHARE * moved.sum())
    return moved & (off < FAR) if enough else np.zeros(len(term), dtype=bool)


def _noisy(fit: Fit, k: int) -> bool:
    """Whether a term's inliers are farther off than those of the others, by more than chance; True without inliers."""
    inliers = [(w[w > 0], r[w > 0]) for w, r in zip(fit.weights, fit.residuals, strict=True)]
    if len(inliers[k][0]) < ENOUGH:
        return True
    square = [float(w @ r**2) / float(w.sum()) for w, r in inliers if len(w) >= ENOUGH]
    mine = float(inliers[k][0] @ inliers[k][1] ** 2) / float(inliers[k][0].sum())
    return mine > (1.0 + NOISIER * float(np.sqrt(2.0 / len(inliers[k][0])))) * float(np.median(square))


def _across(term: TermData, solved: Solved) -> FloatArray:
    """(n,) Sampson's distance from the epipolar lines, signed, pixels; 0 where there are none."""
    fit, center = solved.fit, solved.center
    tau = term.rotation @ (fit.rotation @ (term.center_x - center) - (term.center - center) + fit.shift)
    E = essential(term.rotation @ fit.rotation @ term.rotation_x.T, tau)
    x, y = (np.column_stack([points, np.ones(len(term))]) for points in (term.x, term.y))
    return np.asarray(term.focal * np.einsum("ni,ni->n", y, x @ E.T) / sampson(E, x, y))


def _sees_two(alone: Fit) -> bool:
    """Whether a camera's own fit explains about half of its matches."""
    inliers = int((alone.weights[0] > 0).sum())
    return MIXED[0] * len(alone.weights[0]) < inliers < MIXED[1] * len(alone.weights[0])


def _named(
    data: Sequence[TermData], fit: Fit, rejected: BoolArray, out: Sequence[int], names: Sequence[str]
) -> tuple[str, ...]:
    """A sentence for each term that is rejected; those that were not left out may have none."""
    labels = [names[term.camera] for term in data]
    moments = [
        PairMoments.from_matches(term.x, term.y, np.ones(len(term)) if reject else w)
        for term, reject, w in zip(data, rejected, fit.weights, strict=True)
    ]
    diagnosis = suspect_cameras(
        np.array([term.rotation for term in data]),
        moments,
        fit.rotation,
        at_fault=np.flatnonzero(rejected).tolist(),
        names=labels,
    )
    texts = {i: f.text for i, f in enumerate(diagnosis.faults) if rejected[i] and f is not None}
    said = sorted({*texts, *(k for k in out if rejected[k])})
    return tuple(texts.get(i, f"camera {labels[i]}: it disagrees with the others") for i in said)
