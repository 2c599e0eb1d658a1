"""The window: the most telling solved frames, refined together while tracking goes on.

A frame's pose is found against earlier ones, whose errors it takes over. Every now and then the keyframes and the last
frames are refined jointly (`bundle_adjustment.bundle`), with the landmarks that several of them see: what they got
wrong at first,
a length that only a later turn tells, and the drift up to a side that is seen again, go out of all of them. What is later
found against them is as good.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.bundle_adjustment.bundle import Bundled, Observations
from sylpose.bundle_adjustment.scale_prior import SMALL_TURN, bundle_sized, length_is_open
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.future import Later
from sylpose.geometry.rigid import turn_between
from sylpose.results import UNCERTAIN_TURN, Status
from sylpose.rig import Rig
from sylpose.tracking.context import Team
from sylpose.tracking.frame import SolvedFrame
from sylpose.tracking.joint_state import Joint, Refinement
from sylpose.tracking.keyframes import inherited, nearest_views, viewpoints
from sylpose.tracking.reports import Seen, placed
from sylpose.tracking.wide_baseline_init import another_path

__all__ = ["at_least", "bundled_together", "finished", "is_due", "refined"]

# Frames that are refined together at most, the first one and the last among them (choice).
MOST = 32
# Landmarks of one camera that are used at most, those seen most often first (choice).
LANDMARKS = 150
# So many that have moved are enough to do without those that never did (choice).
MANY = 20
# After the first frames, once the object has turned by this since (radians), or moved by this share of its radius: what it
# shows of itself before that is little news; but no more often than one of `OFTEN` frames, and one of `SELDOM` (choice).
NEWS_TURN, NEWS_SHIFT, OFTEN, SELDOM = np.radians(10.0), 0.3, 4, 12
# Of fewer frames nothing is told. Of fewer than this the depths are not known well enough to be refined with the
# poses (choice).
FEWEST, LEAST = 2, 9
# Where the object took so many frames to show that, the refinement is ready so many frames later (choice).
UNHURRIED, LATER = 8, 5
# A pose is refined by less than this turn (radians) and share of the object's radius (choice).
MAX_TURN, MAX_SHIFT = 0.1, 0.3
# Rounds of the solver: it starts near the answer (choice).
ROUNDS = 12
# Landmarks have smaller numbers (derived).
LANDMARK_NUMBERS = 2**32


def is_due(joint: Joint) -> bool:
    """Whether the frame just solved is to be refined with the others: the first ones are, then those that show enough that
    is new."""
    last, before = joint.base, joint.together
    if joint.pending is not None:
        return False
    if before is None or last.number - joint.keyframes[0].number <= LEAST:
        return True
    off, since = _moved(before, last.world_from_object), last.number - before.number
    new = np.linalg.norm(off[:3]) > NEWS_TURN or np.linalg.norm(off[3:]) > NEWS_SHIFT * joint.object.radius
    return since >= SELDOM or (since >= OFTEN and bool(new))


def refined(team: Team, joint: Joint) -> Joint:
    """With the poses of the keyframes and of the last frames refined together; each camera places its landmarks anew. As
    long as there are few frames, and where the refinement goes astray, it only tells how well the path's length and the
    last frame's pose are known.

    Where nothing presses, as the object shows little that is new, that is begun here, and `finished` some frames later.
    """
    frames = _chosen(joint)
    if len(frames) < FEWEST:
        return joint
    numbers = [frame.number for frame in frames]
    presses = joint.together is None or joint.base.number - joint.together.number < UNHURRIED
    before = joint.told or (Seen.none(),) * len(team.rig)
    new = team.crew.ask(lambda c: _news(team, joint, c, numbers, before[c]), Seen.none())
    told = [seen.among(after) for seen, after in zip(before, new, strict=True)]
    joint = replace(joint, told=tuple(seen.of(sorted(joint.known)) for seen in told), together=joint.base)
    used = [seen.of(numbers, after.known) for seen, after in zip(told, new, strict=True)]
    names = np.repeat(np.arange(len(new)), [len(seen.known) for seen in new])
    if not len(names):
        return joint
    found = Later(bundled_together, *_what(team, frames, used, new), joint.object.radius)
    pending = Refinement(joint.base.number, tuple(frames), names, tuple(seen.known for seen in new), found)
    joint = replace(joint, pending=pending)
    return _applied(team, joint, pending) if presses else joint


def finished(team: Team, joint: Joint, number: int) -> Joint:
    """With what comes of a refinement that was begun, once it is to be there in the frame with this number."""
    pending = joint.pending
    return joint if pending is None or number < pending.number + LATER else _applied(team, joint, pending)


def _applied(team: Team, joint: Joint, pending: Refinement) -> Joint:
    """With what comes of a refinement; frames that were solved since then go along with the last one that it has."""
    joint, frames = replace(joint, pending=None), pending.frames
    bundled = _with_inherited(pending.found.value(), frames)
    if bundled.status is Status.TOO_FEW_MATCHES:
        return joint
    joint = replace(joint, length_sd=bundled.length_sd if length_is_open(bundled) else 0.0)
    at = [frame.number for frame in frames].index(pending.number)  # of frames that waited, it is not the last one
    last, refined_to = frames[at], bundled.world_from_object[at]
    off = _moved(last, refined_to)
    near = np.linalg.norm(off[:3]) < MAX_TURN and np.linalg.norm(off[3:]) < MAX_SHIFT * joint.object.radius
    settled = len(frames) >= LEAST and bundled.status is Status.OK and near
    if settled and _tells_surface(bundled, pending.names):
        joint = replace(joint, object=replace(joint.object, guessed=False))
    now = joint.known
    # What is seen in boxes may be the mirror image of a turn, and settle there as well.
    if not settled or joint.object.guessed:
        unknown = np.sqrt(np.diag(bundled.covariance[at])[:3].max()) > UNCERTAIN_TURN
        if not bundled.tied[at] or unknown:  # it has no opinion
            return joint
        # Two ways of using the same matches: a pose is no better known than they agree on it.
        doubted = at_least(last.covariance, bundled.covariance[at]) + np.outer(off, off)
        known = {last.number: replace(now[last.number], covariance=doubted)} if last.number in now else {}
        return replace(joint.moved(known), refined=doubted)
    poses = {
        frame.number: (bundled.world_from_object[k], bundled.covariance[k])
        for k, frame in enumerate(frames)
        if bundled.tied[k] and frame.number in now and not frame.stays
    }
    if bundled.tied[at]:
        along = refined_to * last.world_from_object.inv()
        poses |= {k: (along * f.world_from_object, f.covariance) for k, f in now.items() if k > frames[-1].number}
    moved = {
        k: replace(now[k], world_from_object=pose, covariance=covariance, viewpoints=viewpoints(team.rig, pose))
        for k, (pose, covariance) in poses.items()
    }

    def learn(c: int) -> None:
        mine = pending.names == c
        if mine.any():
            team.parts[c].table.place(pending.known[c], bundled.landmarks[mine])

    team.crew.each(learn, long=True)
    return replace(joint.moved(moved), refined=bundled.covariance[at] if bundled.tied[at] else None)


def _with_inherited(bundled: Bundled, frames: Sequence[SolvedFrame]) -> Bundled:
    """With what the frames that stay are off."""
    stays, own = np.array([frame.stays for frame in frames]), np.array([frame.covariance for frame in frames])
    if not stays.any():
        return bundled
    return replace(bundled, covariance=bundled.covariance + inherited(bundled.world_from_object, own, stays))


def _tells_surface(bundled: Bundled, names: IntArray) -> bool:
    """Whether more than boxes tells where the object's surface is: after a turn that more than two cameras agree on. Two may
    agree on its mirror image, with hollow for round.

    Args:
        names: (m,) whose landmarks they are.
    """
    poses = bundled.world_from_object
    turned = (poses.rotation * poses.rotation[0].inv()).magnitude().max()
    return bool(turned > SMALL_TURN) and len(np.unique(names)) > 2 and not length_is_open(bundled)


def _moved(last: SolvedFrame, after: RigidTransform) -> FloatArray:
    """(6,) (w, d) by what a frame's pose is refined."""
    before = last.world_from_object
    return np.concatenate([turn_between(before, after), after.translation - before.translation])


def at_least(a: FloatArray, b: FloatArray) -> FloatArray:
    """A covariance (6, 6) that is larger than b wherever a is not."""
    root = np.linalg.cholesky(a)
    inverse = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(inverse @ b @ inverse.T)
    out = root @ vectors @ np.diag(np.maximum(values, 1.0)) @ vectors.T @ root.T
    return np.asarray(0.5 * (out + out.T))


def _chosen(joint: Joint) -> list[SolvedFrame]:
    """In order of time: the first keyframe, the frame just solved, the recent ones, and of the others some that are evenly
    spread; of those that stay the ones in which a camera looked from nearby."""
    known = [frame for frame in joint.keyframes if frame.stays]
    every = {frame.number: frame for frame in (*joint.keyframes, *joint.recent, joint.base) if not frame.stays}
    frames = [every[number] for number in sorted(every)]
    if known:
        views = joint.base.viewpoints
        near = [nearest_views(known, c, view, MOST // (2 * len(views)) + 1) for c, view in enumerate(views)]
        stay = {frame.number: frame for its in near for frame in its}
        return [*(stay[number] for number in sorted(stay)), *frames[-MOST // 2 :]]
    if len(frames) <= MOST:
        return frames
    recent = frames[-MOST // 2 :]
    older = frames[: -MOST // 2]
    spread = np.unique(np.linspace(0, len(older) - 1, MOST - len(recent)).astype(int))
    chosen = {frame.number: frame for frame in (*(older[k] for k in spread), *recent, joint.base)}
    return [chosen[number] for number in sorted(chosen)]


def _news(team: Team, joint: Joint, c: int, numbers: Sequence[int], before: Seen) -> Seen:
    """Which landmarks a camera wants used of what it saw in frames with these numbers, and what of that it has not told
    before."""
    part = team.parts[c]
    frames = [part.frames[number] for number in numbers]
    frame = np.repeat(np.asarray(numbers, np.int64), [len(frame.numbers) for frame in frames])
    landmark = np.concatenate([np.empty(0, np.int64), *(frame.numbers for frame in frames)])
    image = np.concatenate([np.empty((0, 2)), *(frame.features.normalized for frame in frames)])
    # A landmark that two features of a frame were taken for says nothing there.
    sight, first, count = np.unique(_sights(frame, landmark), return_index=True, return_counts=True)
    sight, first = sight[count == 1], first[count == 1]
    known, inverse, sights = np.unique(landmark[first], return_inverse=True, return_counts=True)
    # Once the object has moved, what never did may be background, which a path with less of a turn explains as well.
    moved = part.table.of(known).moved
    trusted = moved if np.count_nonzero(moved) >= MANY else np.ones(len(known), bool)
    # Of one that was taken for others since, or they for it, not all that was told is so any more.
    old = before.of(numbers)
    wrong = old.landmark[~np.isin(_sights(old.frame, old.landmark), sight)]
    good = np.flatnonzero((sights > 1) & trusted & ~np.isin(known, wrong))
    good = np.sort(good[np.argsort(-sights[good], kind="stable")[:LANDMARKS]])
    untold = first[np.isin(inverse, good) & ~np.isin(sight, _sights(old.frame, old.landmark))]
    # Where to start from need not be known well.
    place = placed(part.table.of(known[good]).mean, joint.object.radius)
    return Seen(frame[untold], landmark[untold], image[untold], known[good], place)


def _sights(frame: IntArray, landmark: IntArray) -> IntArray:
    """(n,) a number for each, of frames (n,) and landmarks (n,)."""
    return frame * LANDMARK_NUMBERS + landmark


def _what(
    team: Team, frames: Sequence[SolvedFrame], told: Sequence[Seen], new: Sequence[Seen]
) -> tuple[Rig, Observations, RigidTransform, FloatArray, FloatArray, BoolArray | None]:
    """What is refined: the rig, the observations, the poses, where the landmarks are, when each camera took each frame, and
    which frames stay, None for the first.

    Args:
        told: by camera, what is used; new: which landmarks, and where they are.
    """
    cameras = np.repeat(np.arange(len(told)), [len(seen.frame) for seen in told])
    starts = np.cumsum([0, *(len(seen.known) for seen in new)])
    landmark = [starts[c] + np.searchsorted(new[c].known, seen.landmark) for c, seen in enumerate(told)]
    observations = Observations(
        np.searchsorted([frame.number for frame in frames], np.concatenate([seen.frame for seen in told])),
        cameras,
        np.concatenate(landmark).astype(np.int64),
        np.concatenate([seen.image for seen in told]),
    )
    poses = RigidTransform.concatenate([frame.world_from_object for frame in frames])
    times = np.array([frame.time + frame.late for frame in frames])
    if (np.diff(times.mean(axis=1)) <= 0).any():  # by what cameras say of their clocks: that cannot be
        times = np.array([frame.time for frame in frames])
    stays = np.array([frame.stays for frame in frames])
    places = np.concatenate([seen.place for seen in new])
    return team.rig, observations, poses, places, times, stays if stays.any() else None


def bundled_together(
    rig: Rig,
    observations: Observations,
    poses: RigidTransform,
    landmarks: FloatArray,
    times: FloatArray,
    stays: BoolArray | None,
    radius: float,
) -> Bundled:
    """The frames refined together; see `_what`."""
    return bundle_sized(
        rig,
        observations,
        poses,
        radius,
        # Those that stay are of no path, and tell where the surface is.
        other=another_path(rig, observations, poses, radius) if stays is None else None,
        fixed=stays,
        landmarks=landmarks,
        times=times,
        max_rounds=ROUNDS,
        roughly=True,
    )
