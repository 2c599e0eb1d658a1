"""Accepting a frame: its pose becomes a fact, and all that it teaches is learnt."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.features.sift import Features
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.matches import STILL_PX
from sylpose.relative_pose.fit import MIN_MATCHES
from sylpose.relative_pose.observability import observed
from sylpose.results import FramePose, FrameStatus, Observable, Status
from sylpose.tracking.context import Region, Team
from sylpose.tracking.frame import Frame, Pair, SolvedFrame, Sought, learn_only, sought_in, triangulate
from sylpose.tracking.initialization import FirstMotion, agree, first_motion
from sylpose.tracking.joint_state import Joint, covariance_with_references
from sylpose.tracking.keyframes import viewpoints
from sylpose.tracking.klt_frontend import Anchor
from sylpose.tracking.observations import usual_age
from sylpose.tracking.pose_search import Found, on_the_move
from sylpose.tracking.reobserved import SeenAgain
from sylpose.tracking.reports import placed, total_ages
from sylpose.tracking.tracked_frame import Sightings, TrackedFrame, shown, sightings, unsolved_frame
from sylpose.tracking.window import at_least, is_due, refined

__all__ = ["accept_first", "accepted", "first_points", "not_found", "silenced", "told_by_matches", "triangulated"]

# One camera sees a turn and its mirror image alike, with hollow for round: an object in a box is taken to be round, and its
# middle to be nearer than its centre by this share of its radius (choice).
BULGE = 0.5
# A camera of whose matches no more than this share agrees was rejected as a whole, where of another's this share does
# (choice).
REJECTED, HEARD = 0.2, 0.5
# A camera that is doubted by this factor teaches nothing in that frame (choice).
SILENT = 30.0
# The error of a turn while all depths are guesses, as a share of it (choice).
MIRRORED = 0.5
# So many points show where an object's surface is (choice).
MIN_POINTS = 20


def accept_first(
    team: Team,
    joint: Joint,
    frames: FrameSet,
    frame: Frame,
    surroundings: Sequence[Features],
    center: FloatArray,
    regions: Sequence[Region],
) -> tuple[Joint, TrackedFrame]:
    """The frame whose pose defines the object's frame.

    Args:
        surroundings: by camera, each its own: the features around the object.
        center: (3,) of the object, world.
    """
    crew, parts, model = team.crew, team.parts, joint.object
    pose = RigidTransform.from_translation(center)
    sees = np.array(crew.ask(lambda c: len(frame.cameras[c].features) > 0, False))
    first = SolvedFrame(frame.number, frame.time, frame.late, pose, np.zeros((6, 6)), viewpoints(team.rig, pose), sees)
    bulge = BULGE if model.bounded and len(team.rig) == 1 else 0.0

    def learn(c: int) -> None:
        part, current = parts[c], frame.cameras[c]
        part.begin(frame.number, current, surroundings[c], (frames.images[c], frames.masks[c]))
        part.learn(current, part.camera, pose, SeenAgain.none(), model.points, model.radius, bulge)

    crew.each(learn)
    joint = joint.begun(first)
    if team.follows:
        crew.each(lambda c: parts[c].anchor_at(frame.number, frames.images[c], None))
        joint = replace(joint, anchor=Anchor(first))
    n = len(team.rig)
    nothing = np.zeros(n, np.int64), np.full(n, np.nan)
    result = FramePose(frames.index, frames.time, FrameStatus.FIRST, pose, first.covariance, *nothing)
    seen = crew.each(lambda c: sightings([], frame.cameras[c]))
    return joint, TrackedFrame(result, frames, (None,) * n, tuple(regions), model.radius, tuple(seen), frame.late)


def accepted(team: Team, joint: Joint, frames: FrameSet, found: Found) -> tuple[Joint, TrackedFrame]:
    """A frame is solved."""
    crew, parts, base, solution = team.crew, team.parts, joint.base, found.solution
    # A camera that was rejected as a whole would teach landmarks that agree with what it sees, and be believed again.
    doubt = _doubt(found)
    on_it = np.array([a.tried_moved for a in found.agreed]) >= MIN_MATCHES  # else it may see something else
    # Nor do frames teach in which all may be background still: as the object creeps, its landmarks would go half of the way.
    proven = joint.proven_by(found.agreed)
    silent = silenced(doubt, on_it) | (not proven)
    cameras = crew.each(lambda c: parts[c].blind() if silent[c] else found.frame.cameras[c])
    frame = replace(found.frame, cameras=cameras)
    known, radius = joint.known, joint.object.radius
    pose = found.motion * base.world_from_object
    stood = solution.status is Status.NO_MOTION  # the pose is the base's, and so is its error
    covariance = base.covariance if proven else joint.keyframes[0].covariance
    if not stood:
        alike = _goes_on(joint, found) if solution.biased else 0.0
        covariance = covariance_with_references(solution.information, pose, found.agreed, known, radius, alike)
        if joint.refined is not None and not joint.missed:
            covariance = at_least(covariance, joint.refined)
    if not proven:
        covariance = covariance + _unnoticed(team, pose, radius)
    if joint.object.guessed:
        # With all depths guessed, the mirror image of a turn explains it nearly as well.
        turn = (pose.rotation * joint.keyframes[0].world_from_object.rotation.inv()).magnitude()
        covariance = covariance + np.diag(np.repeat([(MIRRORED * turn) ** 2, 0.0], 3))
    solved = SolvedFrame(
        frame.number,
        frame.time,
        frame.late,
        pose,
        covariance,
        viewpoints(team.rig, pose),
        np.array([a.sees for a in found.agreed]) & ~silent,
        usual_age(total_ages([a.ages for a in found.agreed])),
    )

    def seen_again(c: int) -> SeenAgain:
        if found.first is not None:
            parts[c].table.learn(found.first[c])
        if silent[c]:
            return SeenAgain.none()
        if found.anew:
            parts[c].learn_background(found.pairs[c], frame.cameras[c], pose, known, radius)
        parts[c].learn_noise(found.agreed[c].residual_px)
        return SeenAgain.of(found.pairs[c], solution.agreement[c], frame.cameras[c].still_px, radius)

    seen = crew.each(seen_again)
    model = joint.object
    if not model.bounded:
        for surface in crew.ask(lambda c: placed(seen[c].surface, radius), np.empty((0, 3))):
            model = model.with_points(surface, team.seed)
    status = FrameStatus.RELOCALISED if joint.missed else FrameStatus.TRACKED
    after = replace(joint, object=model).accepted(solved, found.motion, anew=found.anew, agreed=found.agreed)
    # Where it was found again next to nothing is known of what else is seen: the next frame asks the keyframes too.
    begins = found.anew and team.follows and status is FrameStatus.TRACKED
    if begins:
        # Right after the first frame, what is new in the boxes is not followed: nobody knows yet what it is.
        after_first = base.number == joint.keyframes[0].number
        after = replace(after, anchor=Anchor(solved, few=joint.object.bounded and after_first))
    kept = set(after.known)

    def learn(c: int) -> tuple[tuple[FloatArray, FloatArray] | None, Sightings, Sought]:
        part, current = parts[c], frame.cameras[c]
        followed = None if found.followed is None else found.followed[c]
        part.learn(current, found.rig.cameras[c], pose, seen[c], model.points, radius)
        if followed is not None and not found.anew:
            # Until the object has moved, what does not agree may be the object, and the rest background.
            judged = after.proven and not silent[c]
            weights = [w for w, _ in solution.agreement[c]]
            part.go_on(followed, found.pairs[c] if judged else [], weights if judged else [])
        part.keep(frame.number, current, kept, (frames.images[c], frames.masks[c]))
        if begins:
            part.anchor_at(frame.number, frames.images[c], None if silent[c] else followed)
        before = None if followed is None else followed.before
        sought = sought_in(found.frame.cameras[c].features, found.pairs[c], [w for w, _ in solution.agreement[c]])
        return shown(seen[c].inliers, current, base.number, before), sightings(seen[c].inliers, current), sought

    learnt = crew.each(learn, long=found.anew)
    if team.refines and is_due(after):
        after = refined(team, after)
    last = after.with_length(after.base)
    observable = Observable.NO_LENGTH if after.length_sd else Observable.ALL
    result = FramePose(
        frames.index,
        frames.time,
        status,
        last.world_from_object,
        last.covariance,
        np.array([a.features for a in found.agreed], np.int64),
        np.array([a.residual_px for a in found.agreed]),
        Observable.NO_SCALE if len(team.rig) == 1 else observable,
        doubt,
        solution.faults,
        np.array([a.tried_features for a in found.agreed], np.int64),
    )
    matches, seen_now = crew.each(lambda c: learnt[c][0]), crew.each(lambda c: learnt[c][1])
    sought = crew.each(lambda c: learnt[c][2])
    return replace(after, last=last), TrackedFrame(
        result.judged(),
        frames,
        tuple(matches),
        tuple(found.regions),
        model.radius,
        tuple(seen_now),
        frame.late,
        sought=tuple(sought),
    )


def silenced(doubt: FloatArray, on_it: BoolArray) -> BoolArray:
    """(C,) the cameras that teach nothing in a frame.

    Where most are doubted nobody knows which are wrong: none is silent, or the one left would go on by what it sees alone,
    agree with itself, and be sure of it.

    Args:
        doubt: (C,) as in `FramePose`; on_it: (C,) which cameras have matches enough to be doubted.
    """
    doubted = on_it & (doubt > SILENT)
    most = 2 * np.count_nonzero(doubted) > np.count_nonzero(on_it)
    return np.zeros_like(doubted) if most else doubted


def _unnoticed(team: Team, pose: RigidTransform, radius: float) -> FloatArray:
    """(6, 6) of (w, d): by how much an object may have moved of which all that is known is that nothing moved, since most of
    what is seen may be background."""
    away = np.array([camera.camera_from_world.apply(pose.translation)[2] / camera.focal for camera in team.rig])
    shift = STILL_PX * float(np.median(np.abs(away)))
    return np.diag(np.repeat([(shift / radius) ** 2, shift**2], 3))


def _goes_on(joint: Joint, found: Found) -> float:
    """The cosine of the angle between the axes of the turn so far and of the one that was found; 0 where it turns back.

    What a surface does to a turn is in proportion to it: as long as the object turns on, errors add up.
    """
    so_far = (joint.base.world_from_object.rotation * joint.keyframes[0].world_from_object.rotation.inv()).as_rotvec()
    step = found.motion.rotation.as_rotvec()
    lengths = float(np.linalg.norm(so_far) * np.linalg.norm(step))
    return max(0.0, float(so_far @ step) / lengths) if lengths > 0 else 0.0


def _doubt(found: Found) -> FloatArray:
    """(C,) as in `FramePose`: the solution's doubt, where there is anything of the camera to be doubted."""
    shares = np.array([a.matches / max(a.tried, 1) for a in found.agreed])
    asked = np.array([a.tried for a in found.agreed]) >= MIN_MATCHES
    rejected = asked & (shares < REJECTED) & (shares.max() > HEARD)
    return np.where(rejected, np.inf, np.where(asked, found.solution.doubt, np.nan))


def not_found(
    team: Team, joint: Joint, frames: FrameSet, ahead: RigidTransform, regions: Sequence[Region]
) -> tuple[Joint, TrackedFrame]:
    """A frame in which the object was not found: it is taken to have gone on as before, until that says nothing. Where all
    that agrees with a pose stands still and never moved, nothing is said of it.

    Args:
        ahead: world_from_object as predicted.
        regions: where it was looked for.
    """
    only_still = joint.only_still
    joint, covariance = joint.without(frames.time)
    sought, radius = team.crew.each(lambda c: team.parts[c].sought), joint.object.radius
    if only_still:
        return joint, unsolved_frame(team, frames, FrameStatus.ONLY_STILL, sought, regions, radius)
    if joint.lost:
        return joint, unsolved_frame(team, frames, FrameStatus.LOST, sought, regions, radius)
    return joint, unsolved_frame(team, frames, FrameStatus.COASTING, sought, regions, radius, ahead, covariance)


def told_by_matches(
    team: Team, joint: Joint, frame: Frame, pairs: Sequence[Sequence[Pair]], guess: RigidTransform
) -> tuple[Joint, RigidTransform | None, RigidTransform, Sequence[Sequence[Pair]]]:
    """While nothing but boxes tells where the object's surface is, or nothing how it moves, a frame's matches may.

    Args:
        frame: that is not solved yet; pairs: by camera, each its own: its matches.
        guess: of its pose, world_from_object.

    Returns:
        what is known by then; the pose that the matches tell, or None; that or else the guess; by camera, each its own, the
        matches that are left: with frames that are still known, and of what is not background.
    """
    if not joint.object.guessed and joint.velocity.frames:
        return joint, None, guess, pairs
    guessed = joint.object.guessed
    joint, found = _with_surface(team, joint, frame, pairs)

    def on_it(c: int) -> list[Pair]:
        known = [pair for pair in pairs[c] if pair.reference in joint.known]
        return [pair.subset(~frame.cameras[c].background[pair.indices[:, 1]]) for pair in known]

    if found is None:
        return joint, None, guess, team.crew.each(on_it)
    seen = found.motion * joint.keyframes[0].world_from_object
    told_now = guessed and not joint.object.guessed
    if joint.velocity.frames and not told_now:
        return joint, seen, seen, team.crew.each(on_it)
    # The first motion that tells of the surface: what does not take part in it is background, however much of the boxes it
    # fills. Some of what stands still would agree with a motion that is hardly another one, as points at which the object
    # hardly moves, so only what is seen to move tells more of it; other methods need every match.
    if not team.refines:
        return joint, seen, seen, on_the_move(team, joint, frame, team.crew.each(on_it), seen)
    if joint.object.bounded:
        # Of what is new in the boxes nobody knows whether it is the object: the next frames tell.
        team.crew.each(lambda c: learn_only(found.inliers[c], frame.cameras[c]))
    return joint, seen, seen, found.inliers


def _with_surface(
    team: Team, joint: Joint, frame: Frame, pairs: Sequence[Sequence[Pair]]
) -> tuple[Joint, FirstMotion | None]:
    """What boxes allow is much deeper than the object. Epipolar geometry needs no depth: once it finds a motion since the
    first frame, that tells where the surface is, and the landmarks are learnt anew.

    Args:
        frame: that is not solved yet; what is found to be background is marked in it.
        pairs: by camera, each its own: its matches.

    Returns:
        what is known by then; the motion, if it was found. If more than boxes tells where the surface is, this is all that
        is done.
    """
    crew, first = team.crew, joint.keyframes[0]
    found = first_motion(crew, team.rig, pairs, first.number, team.rng())
    # Something else than the object may pass by behind it.
    far = np.linalg.norm(found.middle - first.world_from_object.translation) > joint.object.radius
    if not found.certain or found.fit.mixed or found.fit.other is not None or far:
        return joint, None
    before, now = first.world_from_object, found.motion * first.world_from_object

    def told_apart(c: int) -> None:
        """Boxes may have more background in them than object: what stands still as the rest moves."""
        known = {first.number: first}
        team.parts[c].learn_background(
            [pair for pair in pairs[c] if pair.reference == first.number], frame.cameras[c], now, known, found.radius
        )

    crew.each(told_apart)
    enough = (Status.OK,) if len(team.rig) > 1 else (Status.OK, Status.SCALE_NOT_OBSERVABLE)
    if observed(found.fit, joint.object.radius).status not in enough:
        return joint, None
    # With two cameras a flat object leaves a second motion, another one in each frame.
    if found.cameras == 2 and not agree(joint.first_motion, found.motion):
        return replace(joint, first_motion=found.motion), None
    if not joint.object.guessed:
        return joint, found
    points = np.concatenate(
        crew.ask(lambda c: placed(triangulated(team, c, found.inliers[c], before, now), found.radius), np.empty((0, 3)))
    )
    if len(points) < MIN_POINTS:
        return joint, found
    joint = joint.relearnt(found.radius)

    def learn(c: int) -> None:
        part, camera = team.parts[c], team.rig.cameras[c]
        part.table.learn(part.relearnt(first.number, camera, before, points, found.radius))

    crew.each(learn)
    return joint, found


def first_points(
    team: Team, c: int, inliers: Sequence[Pair], before: RigidTransform, now: RigidTransform
) -> FloatArray:
    """(m, 3) about where a camera's inliers are on the object. Where its motion tells next to nothing of their depth, they
    are taken to be as far away as its middle."""
    found = triangulated(team, c, inliers, before, now)
    count = sum(map(len, inliers))
    if 2 * len(found) > count or not count:
        return found
    camera = team.rig.cameras[c]
    depth = camera.camera_from_world.apply(before.translation)[2]
    rays = np.concatenate([np.column_stack([pair.normalized_i, np.ones(len(pair))]) for pair in inliers])
    return np.asarray(before.inv().apply(camera.camera_from_world.inv().apply(depth * rays)))


def triangulated(
    team: Team, c: int, inliers: Sequence[Pair], before: RigidTransform, now: RigidTransform
) -> FloatArray:
    """(m, 3) where a camera's inliers are on the object. See `frame.triangulate`."""
    points = [triangulate(pair, team.rig.cameras[c], before, now) for pair in inliers]
    return np.concatenate([np.empty((0, 3)), *points])
