"""The window: the most telling solved frames, refined together while tracking goes on.

A frame's pose is found against earlier ones, whose errors it takes over. Every now and then the keyframes and the last
frames are refined jointly (`adjustment.bundle`), with the landmarks that several of them see: what they got wrong at first,
a length that only a later turn tells, and the drift up to a side that is seen again, go out of all of them. What is later
found against them is as good.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.adjustment.bundle import Bundled, Observations
from sylpose.adjustment.sized import SMALL_TURN, bundle_sized, length_is_open
from sylpose.numerics.arrays import FloatArray, IntArray
from sylpose.results import UNCERTAIN_TURN, Status
from sylpose.tracking.far_frames import another_path
from sylpose.tracking.frame import SolvedFrame
from sylpose.tracking.joint import Joint
from sylpose.tracking.keyframes import viewpoints
from sylpose.tracking.records import Seen, placed
from sylpose.tracking.team import Team

__all__ = ["at_least", "is_due", "refined"]

# Frames that are refined together at most, the first one and the last among them (choice).
MOST = 32
# Landmarks of one camera that are used at most, those seen most often first (choice).
LANDMARKS = 150
# So many that have moved are enough to do without those that never did (choice).
MANY = 20
# After the first frames, one of so many (choice: refined at every keyframe too, poses are hardly better).
OFTEN = 4
# Of fewer frames nothing is told. Of fewer than this the depths are not known well enough to be refined with the
# poses (choice).
FEWEST, LEAST = 2, 9
# A pose is refined by less than this turn (radians) and share of the object's radius (choice).
MAX_TURN, MAX_SHIFT = 0.1, 0.3
# Rounds of the solver: it starts near the answer (choice).
ROUNDS = 12
# Landmarks have smaller numbers (derived).
LANDMARK_NUMBERS = 2**32


def is_due(joint: Joint) -> bool:
    """Whether the frame just solved is to be refined with the others: the first ones are, then every `OFTEN`th."""
    since = joint.base.number - joint.keyframes[0].number
    return since <= LEAST or since % OFTEN == 0


def refined(team: Team, joint: Joint) -> Joint:
    """With the poses of the keyframes and of the last frames refined together; each camera places its landmarks anew. As
    long as there are few frames, and where the refinement goes astray, it only tells how well the path's length and the
    last frame's pose are known."""
    frames = _chosen(joint)
    if len(frames) < FEWEST:
        return joint
    numbers = [frame.number for frame in frames]
    before = joint.told or (Seen.none(),) * len(team.rig)
    new = team.crew.ask(lambda c: _news(team, joint, c, numbers, before[c]), Seen.none())
    told = [seen.among(after) for seen, after in zip(before, new, strict=True)]
    joint = replace(joint, told=tuple(seen.of(sorted(joint.known)) for seen in told))
    used = [seen.of(numbers, after.known) for seen, after in zip(told, new, strict=True)]
    found = _bundled(team, joint, frames, used, new)
    if found is None:
        return joint
    bundled, names = found
    joint = replace(joint, length_sd=bundled.length_sd if length_is_open(bundled) else 0.0)
    last, at = joint.base, numbers.index(joint.base.number)  # of frames that waited, it is not the last one
    off = _moved(last, bundled.world_from_object[at])
    near = np.linalg.norm(off[:3]) < MAX_TURN and np.linalg.norm(off[3:]) < MAX_SHIFT * joint.object.radius
    settled = len(frames) >= LEAST and bundled.status is Status.OK and near
    if settled and _tells_surface(bundled, names):
        joint = replace(joint, object=replace(joint.object, guessed=False))
    # What is seen in boxes may be the mirror image of a turn, and settle there as well.
    if not settled or joint.object.guessed:
        unknown = np.sqrt(np.diag(bundled.covariance[at])[:3].max()) > UNCERTAIN_TURN
        if not bundled.tied[at] or unknown:  # it has no opinion
            return joint
        # Two ways of using the same matches: a pose is no better known than they agree on it.
        doubted = replace(last, covariance=at_least(last.covariance, bundled.covariance[at]) + np.outer(off, off))
        return replace(joint.moved({last.number: doubted}), refined=doubted.covariance)
    poses = dict(zip(numbers, bundled.world_from_object, strict=True))
    moved = {
        frame.number: replace(
            frame,
            world_from_object=poses[frame.number],
            covariance=bundled.covariance[k],
            viewpoints=viewpoints(team.rig, poses[frame.number]),
        )
        for k, frame in enumerate(frames)
        if bundled.tied[k]
    }

    def learn(c: int) -> None:
        mine = names == c
        if mine.any():
            team.parts[c].table.place(new[c].known, bundled.landmarks[mine])

    team.crew.each(learn)
    return replace(joint.moved(moved), refined=bundled.covariance[at] if bundled.tied[at] else None)


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
    turn = (after.rotation * before.rotation.inv()).as_rotvec()
    return np.concatenate([turn, after.translation - before.translation])


def at_least(a: FloatArray, b: FloatArray) -> FloatArray:
    """A covariance (6, 6) that is larger than b wherever a is not."""
    root = np.linalg.cholesky(a)
    inverse = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(inverse @ b @ inverse.T)
    out = root @ vectors @ np.diag(np.maximum(values, 1.0)) @ vectors.T @ root.T
    return np.asarray(0.5 * (out + out.T))


def _chosen(joint: Joint) -> list[SolvedFrame]:
    """In order of time: the first keyframe, the frame just solved, the recent ones, and of the others some that are evenly
    spread."""
    every = {frame.number: frame for frame in (*joint.keyframes, *joint.recent, joint.base)}
    frames = [every[number] for number in sorted(every)]
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


def _bundled(
    team: Team, joint: Joint, frames: Sequence[SolvedFrame], told: Sequence[Seen], new: Sequence[Seen]
) -> tuple[Bundled, IntArray] | None:
    """The frames refined together, and (m,) whose landmarks they are; None where that says nothing.

    Args:
        told: by camera, what is used; new: which landmarks, and where they are.
    """
    cameras = np.repeat(np.arange(len(told)), [len(seen.frame) for seen in told])
    names = np.repeat(np.arange(len(told)), [len(seen.known) for seen in new])
    starts = np.cumsum([0, *(len(seen.known) for seen in new)])
    landmark = [starts[c] + np.searchsorted(new[c].known, seen.landmark) for c, seen in enumerate(told)]
    if not len(names):
        return None
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
    bundled = bundle_sized(
        team.rig,
        observations,
        poses,
        joint.object.radius,
        other=another_path(team.rig, observations, poses, joint.object.radius),
        landmarks=np.concatenate([seen.place for seen in new]),
        times=times,
        max_rounds=ROUNDS,
    )
    return None if bundled.status is Status.TOO_FEW_MATCHES else (bundled, names)
