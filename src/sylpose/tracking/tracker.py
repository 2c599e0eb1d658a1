"""The tracker: the object's pose in every frame, each frame against several earlier ones."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.features.sift import MAX_FEATURES, Features, detect, seen_before
from sylpose.frames import Box, FrameSet
from sylpose.methods import FEATURES, METHODS, features_of
from sylpose.numerics.arrays import BoolArray, FloatArray
from sylpose.numerics.matrices import covariance_of
from sylpose.results import Status
from sylpose.rig import Rig
from sylpose.tracking.anchor import ANCHOR_SHARE, Anchor, Followed, begin_anchor, follow, with_new
from sylpose.tracking.frame import Pair, Reference, inliers_of, learn_background, match_pair, triangulate
from sylpose.tracking.frame_solvers import SOLVERS, usual_age
from sylpose.tracking.keyframes import add_keyframe, references_of, viewpoints
from sylpose.tracking.object_model import ObjectModel
from sylpose.tracking.region import polygon_mask
from sylpose.tracking.relocalise import relocalise
from sylpose.tracking.start import displacement, first_motion, is_ambiguous
from sylpose.tracking.tracked_frame import Sightings, TrackedFrame, solved_frame, unsolved_frame
from sylpose.tracking.velocity import Velocity
from sylpose.two_frames.fit import MIN_MATCHES, Fit
from sylpose.two_frames.motion import motion_about, observed
from sylpose.two_frames.terms import object_place

__all__ = ["Sightings", "TrackedFrame", "Tracker", "track"]

Regions = Sequence[FloatArray | None]

# Without boxes nothing is known of the object until it moves: so many frames wait for that, with their images.
PATIENCE = 10
# What moves by this much in the middle, pixels, is told from what does not; a smaller motion has to wait for a larger one.
FIRST_PX = 8.0
AMBIGUOUS = (
    "Without boxes, what moves most is tracked; something else moved nearly as much. Boxes or masks of the object would "
    "tell which of the two it is."
)
# Margin of the object's region, as a share of its size in the image; it grows while the object is lost, up to a bound.
REGION_GROWTH, MAX_GROWTH = 0.15, 1.0
# Features per camera while the object may be anywhere in the image.
START_FEATURES = 4000
# Features per camera that are detected where features are followed.
KLT_FEATURES = 400
# With a turn less certain than this (radians), an object that was missed is not taken as found, for so many frames at most.
AGAIN_SD, WAIT_FOR_MORE = 0.005, 2
# A pose found again must be the one that relocalisation found: within this turn (radians) and share of the radius.
AGAIN_TURN, AGAIN_SHIFT = 0.17, 0.3
# Times that a frame is solved where its cameras' instants differ, each time with the speed that the one before found.
SPEED_ROUNDS = 2
# An object that is not found is taken to go on as it did: for so many frames, and until its turn (radians) or its place
# (object's radii) is less certain than this.
MAX_COASTING, COASTING_TURN, COASTING_SHIFT = 15, 0.35, 1.0


def track(
    frames: Iterable[FrameSet],
    rig: Rig,
    boxes: Mapping[str, Box] | None = None,
    *,
    method: str = METHODS[0],
    features: str = FEATURES[0],
    offsets: Mapping[str, float] | None = None,
    workers: int | None = None,
    seed: int = 0,
) -> Iterator[TrackedFrame]:
    """The object's pose in every frame, as the frames come.

    Args:
        frames: of the recording, in order: `session.frames()`.
        rig, boxes, method, features, offsets, workers, seed: see `Tracker`.

    Yields:
        One `TrackedFrame` per frame. Without boxes the first ones are held back until the object has moved.

    Raises:
        ValueError: an unknown method; boxes of cameras that the rig does not have, or that do not meet in space.
    """
    with Tracker(rig, boxes, method=method, features=features, offsets=offsets, workers=workers, seed=seed) as tracker:
        for frame_set in frames:
            yield from tracker.step(frame_set)
        yield from tracker.flush()


class Tracker:
    """Follows one rigid object, frame by frame: a context manager around its worker threads.

    Args:
        rig: C cameras. With one camera the object is put at distance 1 of it, and every frame's status says that the
            scale is not observable.
        boxes: where the object is in the first frame, per camera that sees it, pixels; None: the object is what moves
            against the standing background.
        method: "landmarks" (places of the features on the object grow certain over time: drifts least), "epipolar"
            (epipolar geometry against several references), one of the paper's estimators frame to frame (as in
            `estimate_motion`), or "known-depth" (Sylvester's equation for landmarks whose depth is known by now).
        features: "sift" (SIFT in every frame, as in the paper), "klt" (followed from image to image, SIFT only where that
            does not suffice: several times faster, and more precise; not for the paper's estimators, which want the
            matches with the frame before) or "auto": "klt" for the method "landmarks", else "sift".
        offsets: by camera, seconds by which its images are later than its time stamps say.
        workers: threads for detection and matching; None: one per core, at most one per camera.
        seed: of the outlier rejection. The same input and seed give the same output, whatever the number of threads.

    Raises:
        ValueError: as `track`.
    """

    def __init__(
        self,
        rig: Rig,
        boxes: Mapping[str, Box] | None = None,
        *,
        method: str = METHODS[0],
        features: str = FEATURES[0],
        offsets: Mapping[str, float] | None = None,
        workers: int | None = None,
        seed: int = 0,
    ) -> None:
        follows = features_of(method, features) == "klt"
        for name in offsets or {}:
            if name not in rig.names:
                raise ValueError(f"offsets: no camera {name!r} in the rig ({', '.join(rig.names)})")
        self.rig = rig
        self._solve = SOLVERS[method]
        self._seed = seed
        self._offsets = dict(offsets or {})
        self._follows = follows
        self._anchor: Anchor | None = None  # whose features are followed
        self._keyframes: list[Reference] = []
        self._last: Reference  # the last solved frame, from the first one on
        self._waiting: list[tuple[Reference, FrameSet]] = []
        self._velocity = Velocity()
        self._missed = 0  # frames since the last solved one
        self._seen_again = 0  # frames in which it was seen, but not well enough, after it was missed
        self._lost = False  # whether nothing is known any more of where it is
        self._object = ObjectModel(rig, boxes, seed)
        self._surroundings = [Features.none()] * len(rig)  # the first frame's features outside the object's region
        self._workers = workers or min(len(rig), os.cpu_count() or 1)
        self._pool = ThreadPoolExecutor(self._workers)

    def __enter__(self) -> Tracker:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the worker threads."""
        self._pool.shutdown()

    def __getstate__(self) -> dict[str, object]:
        """All that the next frames depend on, for a checkpoint; the threads are begun anew."""
        return {name: value for name, value in self.__dict__.items() if name != "_pool"}

    def __setstate__(self, state: dict[str, object]) -> None:
        self.__dict__.update(state)
        self._pool = ThreadPoolExecutor(self._workers)

    def step(self, frames: FrameSet) -> list[TrackedFrame]:
        """Take in the next frame.

        Returns:
            The frames that are now decided, in order: usually this one; none while the object has not moved yet and no
            boxes tell where it is, then those that waited for it and this one.
        """
        if self._keyframes:
            return [self._next(frames)]
        if self._object.center is not None:
            regions = self._object.regions(
                self.rig, RigidTransform.from_translation(self._object.center), REGION_GROWTH
            )
            inside = self._masks(regions)
            features = self._detect(frames, inside)
            if sum(map(len, features)) < MIN_MATCHES:
                return [unsolved_frame(frames, Status.TOO_FEW_MATCHES, regions, self._object.radius)]
            surroundings = self._detect(frames, [~mask for mask in inside])
            return [self._first(frames, features, surroundings, self._object.center, regions)]
        features = self._detect(frames, self._everywhere(), START_FEATURES)
        if not self._waiting and sum(map(len, features)) < MIN_MATCHES:
            return [unsolved_frame(frames, Status.TOO_FEW_MATCHES)]  # later ones need something to be compared with
        return self._await_motion(self._reference(frames, features), frames)

    def flush(self) -> list[TrackedFrame]:
        """The frames still undecided at the recording's end: the object never moved."""
        waiting, self._waiting = self._waiting, []
        return [unsolved_frame(frames, Status.NO_MOTION) for _, frames in waiting]

    def _detect(
        self, frames: FrameSet, where: Sequence[BoolArray], max_features: int = MAX_FEATURES
    ) -> tuple[Features, ...]:
        """The features of all cameras, inside their areas (h, w) and the object's masks."""

        def run(c: int) -> Features:
            image, mask = frames.images[c], frames.masks[c]
            if image is None:
                return Features.none()
            return detect(image, self.rig.cameras[c], where[c] if mask is None else where[c] & mask, max_features)

        return tuple(self._pool.map(run, range(len(self.rig))))

    def _masks(self, regions: Regions) -> list[BoolArray]:
        return [polygon_mask(region, camera.size) for camera, region in zip(self.rig, regions, strict=True)]

    def _everywhere(self) -> list[BoolArray]:
        return [np.ones(camera.size[::-1], bool) for camera in self.rig]

    def _split(self, features: Sequence[Features], regions: Regions) -> tuple[list[Features], list[Features]]:
        """The features inside the regions and those outside."""
        masks = zip(features, self._masks(regions), strict=True)
        inside = [mask[tuple(np.round(f.pixels).astype(np.int64).T[::-1])] for f, mask in masks]
        pairs = list(zip(features, inside, strict=True))
        return [f.subset(mask) for f, mask in pairs], [f.subset(~mask) for f, mask in pairs]

    def _reference(self, frames: FrameSet, features: Sequence[Features]) -> Reference:
        """A frame to be solved; what the first frame has at the same place around the object is background."""
        known = self._known_background(features)
        own = [frames.time if time is None else time for time in frames.times]
        offsets = [self._offsets.get(name, 0.0) for name in self.rig.names]
        late = np.array(own) - frames.time + offsets
        return Reference(frames.index, frames.time, tuple(features), known, late=late)

    def _known_background(self, features: Sequence[Features]) -> tuple[BoolArray, ...]:
        return tuple(map(seen_before, features, self._surroundings))

    # --- the start ---------------------------------------------------------------------------------------------------

    def _first(
        self,
        frames: FrameSet,
        features: Sequence[Features],
        surroundings: Sequence[Features],
        center: FloatArray,
        regions: Regions,
    ) -> TrackedFrame:
        """The frame whose pose defines the object's frame. The features around the object are remembered: what is later
        seen at the same place is background."""
        first = self._reference(frames, features)
        self._surroundings = list(surroundings)
        first.world_from_object = RigidTransform.from_translation(center)
        first.viewpoints = viewpoints(self.rig, first.world_from_object)
        # One camera sees a turn and its mirror image alike, with hollow for round: an object is taken to be round.
        self._object.learn(first, [], self.rig, bulge=0.5 if self._object.bounded and len(self.rig) == 1 else 0.0)
        self._last = first
        self._keyframes.append(first)
        if self._follows:
            self._anchor = begin_anchor(first, frames.images, None)
        return solved_frame(first, frames, Status.FIRST, regions, self._object.radius)

    def _await_motion(self, current: Reference, frames: FrameSet) -> list[TrackedFrame]:
        """Without boxes: compare with the oldest waiting frame until something moves; that is the object."""
        if self._waiting:
            first, _ = self._waiting[0]
            fit, center, inliers = first_motion(self.rig, self._match_first(first, current), first, self._rng())
            if fit.status is Status.OK and (displacement(inliers) > FIRST_PX or len(self._waiting) == PATIENCE):
                return self._begin(current, frames, inliers, motion_about(center, fit))
        self._waiting.append((current, frames))
        if len(self._waiting) <= PATIENCE:
            return []
        _, oldest = self._waiting.pop(0)
        return [unsolved_frame(oldest, Status.NO_MOTION)]

    def _match_first(self, first: Reference, current: Reference) -> list[Pair]:
        pairs = self._pool.map(lambda c: match_pair(first, current, c), range(len(self.rig)))
        return [pair for pair in pairs if len(pair)]

    def _begin(
        self, current: Reference, frames: FrameSet, inliers: Sequence[Pair], motion: RigidTransform
    ) -> list[TrackedFrame]:
        """The first motion tells where the object is; then the frames that waited for it are solved in order."""
        (first, first_frames), *others = self._waiting
        self._object.center, self._object.radius = object_place([pair.term(self.rig, first) for pair in inliers])
        first.world_from_object = RigidTransform.from_translation(self._object.center)
        current.world_from_object = motion * first.world_from_object
        self._object.add_points(np.concatenate([triangulate(pair, self.rig, current) for pair in inliers]))
        self._waiting = []
        regions = self._object.regions(self.rig, first.world_from_object, REGION_GROWTH)
        features, surroundings = self._split(first.features, regions)
        decided = [self._first(first_frames, features, surroundings, self._object.center, regions)]
        for waited, its in [*others, (current, frames)]:
            # They were searched everywhere: what was at rest with the object would seem to belong to it.
            pose = current.world_from_object if waited is current else self._predict(its.time)
            regions = self._object.regions(self.rig, pose, REGION_GROWTH)
            features, _ = self._split(waited.features, regions)
            again = self._reference(its, features)
            found = self._solve_from(again, pose)
            decided.append(
                self._missing(its, pose, regions) if found is None else self._accept(again, its, regions, found)
            )
        if not any(frame.pose.measured for frame in decided[1:]):
            # What moved was no rigid body, or not for long: wait for another motion.
            self._keyframes, self._anchor = [], None
            self._object, self._velocity = ObjectModel(self.rig, None, self._seed), Velocity()
            self._missed, self._lost, self._seen_again = 0, False, 0
            self._surroundings = [Features.none()] * len(self.rig)
            self._waiting = [*others, (current, frames)]
            return [unsolved_frame(first_frames, Status.NOT_CONSISTENT)]
        if is_ambiguous(self.rig, self._match_first(first, current), first, inliers, self._rng()):
            decided[0] = replace(decided[0], note=AMBIGUOUS)
        return decided

    # --- every other frame -------------------------------------------------------------------------------------------

    def _next(self, frames: FrameSet) -> TrackedFrame:
        """Where it should be; else anywhere; else it is taken to go on as it did, for a while."""
        ahead = self._predict(frames.time)
        regions: Regions = [None] * len(self.rig)
        if not self._lost:
            regions = self._object.regions(self.rig, ahead, min(REGION_GROWTH * (1 + self._missed), MAX_GROWTH))
            followed = self._follow(frames, ahead)
            if followed is not None and followed.anchor.suffices(followed, ahead, regions):
                current = self._reference(frames, followed.features)
                found = self._solve_from(current, ahead, followed, anew=False)
                if found is not None and found.inliers > ANCHOR_SHARE * len(followed):
                    return self._accept(current, frames, regions, found, followed, anew=False)
            detected = self._detect(frames, self._masks(regions), KLT_FEATURES if self._follows else MAX_FEATURES)
            if followed is not None:
                detected = with_new(followed, detected, self._known_background(detected))
            current = self._reference(frames, detected)
            found = self._solve_from(current, ahead, followed)
            if found is not None and not self._missed:
                return self._accept(current, frames, regions, found, followed)
            if found is not None:
                again = self._found_again(frames, detected, found.motion * self._last.world_from_object)
                if again is not None:
                    return again
        current = self._reference(frames, self._detect(frames, self._everywhere()))
        pose = relocalise(self.rig, self._keyframes, current, self._last, self._object.radius, self._missed, self._pool)
        again = None if pose is None else self._found_again(frames, current.features, pose)
        return self._missing(frames, ahead, regions) if again is None else again

    def _found_again(self, frames: FrameSet, features: Sequence[Features], pose: RigidTransform) -> TrackedFrame | None:
        """The frame solved from a pose after a wide search; only what may be on the object is learnt and followed."""
        regions = self._object.regions(self.rig, pose, REGION_GROWTH)
        inside, _ = self._split(features, regions)
        current = self._reference(frames, inside)
        found = self._solve_from(current, pose)
        if found is None:
            return None
        # Solvers that start elsewhere may end elsewhere.
        away = found.motion * self._last.world_from_object * pose.inv()
        far = np.linalg.norm(away.apply(pose.translation) - pose.translation) > AGAIN_SHIFT * self._object.radius
        if far or away.rotation.magnitude() > AGAIN_TURN:
            return None
        # While only a corner of it is back, the next frame will show more, and what is learnt now would stay wrong.
        uncertain = bool(np.sqrt(np.diag(covariance_of(found.fit.information))[:3].max()) > AGAIN_SD)
        if self._missed and uncertain and self._seen_again < WAIT_FOR_MORE:
            self._seen_again += 1
            return None
        return self._accept(current, frames, regions, found)

    def _follow(self, frames: FrameSet, ahead: RigidTransform) -> Followed | None:
        """The anchor's features in the next images; None without an anchor, or after a frame without the object."""
        if self._anchor is None or self._missed:
            return None
        last = self._last.world_from_object
        return follow(self._anchor, self.rig, last, ahead, frames.images, frames.masks, self._object.radius, self._pool)

    def _predict(self, time: float) -> RigidTransform:
        """The pose that constant velocity gives; the last pose once the object is lost."""
        last = self._last.world_from_object
        return last if self._lost else self._velocity.motion(time - self._last.time) * last

    def _solve_from(
        self, current: Reference, guess: RigidTransform, followed: Followed | None = None, *, anew: bool = True
    ) -> _Found | None:
        """The frame's pose, from a guess; None if it cannot be found from there.

        Args:
            followed: the first features of each camera, if they were followed from the anchor.
            anew: whether it has others, to be matched by their looks.
        """
        base = self._last
        pairs = [] if followed is None else followed.pairs()
        if anew:
            pairs += self._match(current, guess, with_last=followed is None)
        if self._object.guessed:
            self._learn_depth(self._keyframes[0], current, pairs)
        center, elapsed = base.world_from_object.translation, current.time - base.time
        speed = self._velocity.motion(elapsed)
        for _ in range(SPEED_ROUNDS):
            rig = self._velocity.rig_seen_at_once(self.rig, current.late, center, speed, elapsed)
            motion = guess * base.world_from_object.inv()
            hypothesis = (motion.rotation.as_matrix(), motion.apply(center) - center)
            fit = self._solve(rig, pairs, current, base, self._object.radius, hypothesis, self._rng())
            if not fit.status.has_pose or (fit.status is Status.NO_MOTION and self._missed):
                return None
            if not self._lost and fit.status is not Status.NO_MOTION:
                fit = self._velocity.added_to(fit, center, elapsed)
            speed = motion = motion_about(center, fit)
            guess = motion * base.world_from_object
            if not current.late.any():
                break
            # The cameras' instants were accounted for with the speed of the frame before; now this frame's is known, and
            # after the first motion also the first frame's.
            if len(self._keyframes) == 1 and base is self._keyframes[0]:
                its_rig = self._velocity.rig_seen_at_once(self.rig, base.late, center, speed, elapsed)
                self._object.learn(base, [], its_rig)
        return _Found(rig, pairs, fit, motion)

    def _accept(
        self,
        current: Reference,
        frames: FrameSet,
        regions: Regions,
        found: _Found,
        followed: Followed | None = None,
        *,
        anew: bool = True,
    ) -> TrackedFrame:
        """Take a frame as solved, and learn from it what the next ones need. See `_solve_from`."""
        base, fit, pairs = self._last, found.fit, found.pairs
        current.world_from_object = found.motion * base.world_from_object
        current.viewpoints = viewpoints(self.rig, current.world_from_object)
        stood = fit.status is Status.NO_MOTION  # the pose is the base's, and so is its error
        current.covariance = base.covariance if stood else self._covariance(fit, pairs, current)
        if anew:
            learn_background(pairs, self.rig, current, self._object.radius)
        inliers = inliers_of(pairs, fit.weights)
        ages = [pair.reference.landmarks[pair.camera].seen[pair.indices[:, 0]] for pair in inliers]
        current.age = usual_age(np.concatenate(ages))
        self._object.learn(current, inliers, found.rig)
        if self._missed:
            self._velocity.forget(stands=self._lost)
        if not self._lost:
            self._velocity.learn(found.motion, base.world_from_object.translation, current.time - base.time)
        status = Status.RELOCALISED if self._missed else Status.TRACKED
        self._missed, self._lost, self._seen_again = 0, False, 0
        self._last = current
        if anew:
            add_keyframe(self._keyframes, current)
            # Where it was found again next to nothing is known of what else is seen: the next frame asks the keyframes too.
            begins = self._follows and status is Status.TRACKED
            self._anchor = begin_anchor(current, frames.images, followed) if begins else None
        elif followed is not None:
            followed.anchor.go_on(followed, pairs, fit.weights)
        before = None if followed is None else followed.before
        return solved_frame(current, frames, status, regions, self._object.radius, pairs, fit, base, before)

    def _missing(self, frames: FrameSet, ahead: RigidTransform, regions: Regions) -> TrackedFrame:
        """A frame in which the object was not found: it is taken to have gone on as before, until that says nothing."""
        self._missed += 1
        elapsed = frames.time - self._last.time
        covariance = self._last.covariance + self._velocity.spread(elapsed, self._missed)
        sd = np.sqrt(np.diag(covariance))
        certain = sd[:3].max() < COASTING_TURN and sd[3:].max() < COASTING_SHIFT * self._object.radius
        self._lost = self._lost or self._missed > MAX_COASTING or not certain
        if self._lost:
            return unsolved_frame(frames, Status.LOST, regions, self._object.radius)
        return unsolved_frame(frames, Status.COASTING, regions, self._object.radius, ahead, covariance)

    def _match(self, current: Reference, guess: RigidTransform, *, with_last: bool = True) -> list[Pair]:
        """Matches with the last solved frame and with keyframes that show the object from about the same side."""
        here = viewpoints(self.rig, guess)

        def run(c: int) -> list[Pair]:
            references = [self._last] if with_last else []
            references += references_of(self._keyframes, c, here[c], self._last if with_last else None)
            # In order: each reference passes on what it knows of the background, and the next one uses it.
            return [match_pair(reference, current, c) for reference in references]

        of_cameras = self._pool.map(run, range(len(self.rig)))
        return [pair for of_camera in of_cameras for pair in of_camera if len(pair)]

    def _rng(self) -> np.random.Generator:
        """The same outlier rejection for the same frame, whatever came before."""
        return np.random.default_rng(self._seed)

    def _learn_depth(self, first: Reference, current: Reference, pairs: Sequence[Pair]) -> None:
        """What the boxes allow is much deeper than the object. Epipolar geometry needs no depth: once it finds a motion,
        that tells where the surface is, and the landmarks are learnt anew."""
        fit, center, inliers = first_motion(self.rig, pairs, first, self._rng())
        enough = (Status.OK,) if len(self.rig) > 1 else (Status.OK, Status.SCALE_NOT_OBSERVABLE)
        if observed(fit, self._object.radius).status not in enough:
            return
        current.world_from_object = motion_about(center, fit) * first.world_from_object
        points = np.concatenate([triangulate(pair, self.rig, current) for pair in inliers])
        if len(points) < 20:
            return
        _, self._object.radius = object_place([pair.term(self.rig, first) for pair in inliers])
        self._object.learn_anew((*self._keyframes, self._last), self.rig, points)

    def _covariance(self, fit: Fit, pairs: Sequence[Pair], current: Reference) -> FloatArray:
        """The fit's covariance plus the references' own.

        The references' errors come from common ancestors, so they are taken as fully correlated: then the covariance of
        their weighted mean is at most the weighted mean of their covariances. The weights are their shares of inliers.
        """
        total = max(sum(float(w.sum()) for w in fit.weights), 1e-12)
        inherited = np.zeros((6, 6))
        for pair, w in zip(pairs, fit.weights, strict=True):
            # An error of the reference's pose, in world axes, turns with the object.
            turn = (current.world_from_object.rotation * pair.reference.world_from_object.rotation.inv()).as_matrix()
            both = np.kron(np.eye(2), turn)
            inherited += float(w.sum()) / total * (both @ pair.reference.covariance @ both.T)
        # What cannot be observed is bounded: no motion by half a turn or by the object's size is matched.
        bound = np.repeat([np.pi**-2, self._object.radius**-2], 3)
        return covariance_of(fit.information + np.diag(bound)) + inherited


@dataclass(frozen=True, eq=False)
class _Found:
    """A frame's motion since the last one, the matches it was found from, and the rig as it stood for this frame."""

    rig: Rig
    pairs: list[Pair]
    fit: Fit
    motion: RigidTransform

    @property
    def inliers(self) -> int:
        """Number of matches that agree."""
        return sum(int((w > 0).sum()) for w in self.fit.weights)
