"""The tracker: the object's pose in every frame, each frame against several earlier ones."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from sylpose.capture import Box, FrameSet
from sylpose.features import MAX_FEATURES, Features, detect, seen_before
from sylpose.fit import MIN_MATCHES, Fit
from sylpose.landmarks import learn_landmarks
from sylpose.motion import covariance_of, motion_about, observed
from sylpose.reference import Pair, Reference, inliers_of, learn_background, match_pair, triangulate
from sylpose.region import polygon_mask, region_polygon, volume_from_boxes
from sylpose.results import FramePose, Status
from sylpose.rig import Rig
from sylpose.solvers import SOLVERS, best_landmarks, first_motion
from sylpose.terms import object_place

__all__ = ["METHODS", "TrackedFrame", "Tracker", "track"]

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
Regions = Sequence[FloatArray | None]

# How each frame's pose is found; the first is the default.
METHODS = tuple(SOLVERS)
# Each frame is solved against the frames this many back: near ones match well, far ones stop the drift
# (docs/method.md, "Drift").
LAGS = (1, 3, 8, 16)
# Without boxes nothing is known of the object until it moves: so many frames wait for that, with their images.
PATIENCE = 10
# Margin of the object's region, as a share of its size in the image; it grows while the object is lost, up to a bound.
REGION_GROWTH, MAX_GROWTH = 0.15, 1.0
# Features per camera while the object may be anywhere in the image.
START_FEATURES = 4000
# Object points kept to follow the object's region.
MAX_POINTS = 1500


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """A frame's pose and what it rests on.

    Attributes:
        pose: the result.
        frames: the images it was found in.
        matches: per camera (previous pixels (n, 2), current pixels (n, 2)) of the inliers against the last solved
            frame, or None.
        regions: per camera the outline (k, 2) that was searched, pixels; None for the whole image or none of it.
        radius: of the object, length units; NaN while unknown.
    """

    pose: FramePose
    frames: FrameSet
    matches: tuple[tuple[FloatArray, FloatArray] | None, ...]
    regions: tuple[FloatArray | None, ...]
    radius: float


def track(
    frames: Iterable[FrameSet],
    rig: Rig,
    boxes: Mapping[str, Box] | None = None,
    *,
    method: str = METHODS[0],
    workers: int | None = None,
    seed: int = 0,
) -> Iterator[TrackedFrame]:
    """The object's pose in every frame, as the frames come.

    Args:
        frames: of the recording, in order: `session.frames()`.
        rig, boxes, method, workers, seed: see `Tracker`.

    Yields:
        One `TrackedFrame` per frame. Without boxes the first ones are held back until the object has moved.

    Raises:
        ValueError: an unknown method; boxes of cameras that the rig does not have, or that do not meet in space.
    """
    with Tracker(rig, boxes, method=method, workers=workers, seed=seed) as tracker:
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
            (epipolar geometry against several references) or "sylvester" (the paper's estimator, frame to frame).
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
        workers: int | None = None,
        seed: int = 0,
    ) -> None:
        if method not in SOLVERS:
            raise ValueError(f"method: {method!r} is not one of {', '.join(METHODS)}")
        self.rig = rig
        self._solve = SOLVERS[method]
        self._seed = seed
        self._solved: deque[Reference] = deque(maxlen=max(LAGS) + 1)
        self._waiting: list[tuple[Reference, FrameSet]] = []
        self._velocity = RigidTransform.identity()  # the last motion, per frame number
        self._lost = 0  # frames since the last solved one
        self._surroundings = [Features.none()] * len(rig)  # the first frame's features outside the object's region
        self._points = np.empty((0, 3))  # object's frame: the cloud whose image is the object's region
        self._bounded = bool(boxes)  # boxes bound the object; without them its cloud grows with what is found on it
        self._guessed = bool(boxes)  # until the first motion they are all that is known of its depth
        self._center: FloatArray | None = None  # of the object in the first frame, world
        self._radius = np.nan
        if boxes:
            self._center, points = volume_from_boxes(rig, boxes)
            self._points = points - self._center
            self._radius = float(np.quantile(np.linalg.norm(self._points, axis=1), 0.95))
        self._pool = ThreadPoolExecutor(workers or min(len(rig), os.cpu_count() or 1))

    def __enter__(self) -> Tracker:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the worker threads."""
        self._pool.shutdown()

    def step(self, frames: FrameSet) -> list[TrackedFrame]:
        """Take in the next frame.

        Returns:
            The frames that are now decided, in order: usually this one; none while the object has not moved yet and no
            boxes tell where it is, then those that waited for it and this one.
        """
        if self._solved:
            regions = self._regions(self._predict(frames.index), min(REGION_GROWTH * (1 + self._lost), MAX_GROWTH))
            features = self._detect(frames, self._masks(regions))
            return [self._follow(self._reference(frames.index, features), frames, regions)]
        if self._center is not None:
            regions = self._regions(RigidTransform.from_translation(self._center), REGION_GROWTH)
            inside = self._masks(regions)
            features = self._detect(frames, inside)
            if sum(map(len, features)) < MIN_MATCHES:
                return [self._unsolved(frames, Status.TOO_FEW_MATCHES, regions)]
            surroundings = self._detect(frames, [~mask for mask in inside])
            return [self._first(frames, features, surroundings, self._center, regions)]
        whole = [np.ones(camera.size[::-1], bool) for camera in self.rig]
        features = self._detect(frames, whole, START_FEATURES)
        if not self._waiting and sum(map(len, features)) < MIN_MATCHES:
            return [self._unsolved(frames, Status.TOO_FEW_MATCHES)]  # later ones need something to be compared with
        nothing = tuple(np.zeros(len(f), bool) for f in features)
        return self._await_motion(Reference(frames.index, features, nothing), frames)

    def flush(self) -> list[TrackedFrame]:
        """The frames still undecided at the recording's end: the object never moved."""
        waiting, self._waiting = self._waiting, []
        return [self._unsolved(frames, Status.NO_MOTION) for _, frames in waiting]

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

    def _split(self, features: Sequence[Features], regions: Regions) -> tuple[list[Features], list[Features]]:
        """The features inside the regions and those outside."""
        masks = zip(features, self._masks(regions), strict=True)
        inside = [mask[tuple(np.round(f.pixels).astype(np.int64).T[::-1])] for f, mask in masks]
        pairs = list(zip(features, inside, strict=True))
        return [f.subset(mask) for f, mask in pairs], [f.subset(~mask) for f, mask in pairs]

    def _reference(self, index: int, features: Sequence[Features]) -> Reference:
        """A frame to be solved; what the first frame has at the same place around the object is background."""
        return Reference(index, tuple(features), tuple(map(seen_before, features, self._surroundings)))

    def _predict(self, index: int) -> RigidTransform:
        """The pose that constant velocity gives; the last pose once the object has been lost."""
        last = self._solved[-1]
        if self._lost:
            return last.world_from_object
        return _power(self._velocity, index - last.index) * last.world_from_object

    def _regions(self, world_from_object: RigidTransform, growth: float) -> list[FloatArray | None]:
        """Where to look in each camera: the image of the object's points at a pose, with a margin."""
        points = world_from_object.apply(self._points)
        return [region_polygon(camera, points, growth) for camera in self.rig]

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
        self._surroundings = list(surroundings)
        first = Reference.new(frames.index, tuple(features), RigidTransform.from_translation(center))
        # One camera sees a turn and its mirror image alike, with hollow for round: an object is taken to be round.
        self._learn(first, [], bulge=0.5 if self._bounded and len(self.rig) == 1 else 0.0)
        self._solved.append(first)
        return self._result(first, frames, Status.FIRST, regions)

    def _await_motion(self, current: Reference, frames: FrameSet) -> list[TrackedFrame]:
        """Without boxes: compare with the oldest waiting frame until something moves; that is the object."""
        if self._waiting:
            first, _ = self._waiting[0]
            fit, center, inliers = first_motion(self.rig, self._match([first], current), first, self._rng())
            if fit.status is Status.OK:
                return self._begin(current, frames, inliers, motion_about(center, fit))
        self._waiting.append((current, frames))
        if len(self._waiting) <= PATIENCE:
            return []
        _, oldest = self._waiting.pop(0)
        return [self._unsolved(oldest, Status.NO_MOTION)]

    def _begin(
        self, current: Reference, frames: FrameSet, inliers: Sequence[Pair], motion: RigidTransform
    ) -> list[TrackedFrame]:
        """The first motion tells where the object is; then the frames that waited for it are solved in order."""
        (first, first_frames), *others = self._waiting
        self._center, self._radius = object_place([pair.term(self.rig, first) for pair in inliers])
        first.world_from_object = RigidTransform.from_translation(self._center)
        current.world_from_object = motion * first.world_from_object
        self._add_points(np.concatenate([triangulate(pair, self.rig, current) for pair in inliers]))
        self._waiting = []
        regions = self._regions(first.world_from_object, REGION_GROWTH)
        features, surroundings = self._split(first.features, regions)
        decided = [self._first(first_frames, features, surroundings, self._center, regions)]
        for waited, its in [*others, (current, frames)]:
            # They were searched everywhere: what was at rest with the object would seem to belong to it.
            pose = current.world_from_object if waited is current else self._predict(waited.index)
            regions = self._regions(pose, REGION_GROWTH)
            features, _ = self._split(waited.features, regions)
            decided.append(self._follow(self._reference(waited.index, features), its, regions))
        return decided

    # --- every other frame -------------------------------------------------------------------------------------------

    def _follow(self, current: Reference, frames: FrameSet, regions: Regions) -> TrackedFrame:
        """Solve the frame against its references, and learn from it what the next one needs."""
        last = len(self._solved)
        references = [self._solved[i] for i in sorted({max(last - lag, 0) for lag in LAGS}, reverse=True)]
        base = references[0]
        pairs = self._match(references, current)
        if self._guessed:
            self._learn_depth(references[-1], current, pairs)
        center = base.world_from_object.translation
        guess = self._predict(current.index) * base.world_from_object.inv()
        hypothesis = (guess.rotation.as_matrix(), guess.apply(center) - center)
        fit = self._solve(self.rig, pairs, current, base, self._radius, hypothesis, self._rng())
        if not fit.status.has_pose:
            self._lost += 1
            return self._unsolved(frames, fit.status, regions)
        motion = motion_about(center, fit)
        current.world_from_object = motion * base.world_from_object
        stood = fit.status is Status.NO_MOTION  # the pose is the base's, and so is its error
        current.covariance = base.covariance if stood else self._covariance(fit, pairs, current)
        learn_background(pairs, self.rig, current, self._radius)
        self._learn(current, inliers_of(pairs, fit.weights))
        self._velocity = _power(motion, 1.0 / max(current.index - base.index, 1))
        self._lost = 0
        self._solved.append(current)
        return self._result(current, frames, fit.status, regions, pairs, fit, base)

    def _learn_depth(self, first: Reference, current: Reference, pairs: Sequence[Pair]) -> None:
        """What the boxes allow is much deeper than the object. Epipolar geometry needs no depth: once it finds a motion,
        that tells where the surface is, and the landmarks are learnt anew."""
        fit, center, inliers = first_motion(self.rig, pairs, first, self._rng())
        enough = (Status.OK,) if len(self.rig) > 1 else (Status.OK, Status.SCALE_NOT_OBSERVABLE)
        if observed(fit, self._radius).status not in enough:
            return
        current.world_from_object = motion_about(center, fit) * first.world_from_object
        points = np.concatenate([triangulate(pair, self.rig, current) for pair in inliers])
        if len(points) < 20:
            return
        self._guessed = False
        _, self._radius = object_place([pair.term(self.rig, first) for pair in inliers])
        for reference in self._solved:
            self._learn(reference, [], points)

    def _match(self, references: Sequence[Reference], current: Reference) -> list[Pair]:
        def run(c: int) -> list[Pair]:
            # In order: each reference passes on what it knows of the background, and the next one uses it.
            return [match_pair(reference, current, c) for reference in references]

        of_cameras = list(self._pool.map(run, range(len(self.rig))))
        return [pair for of_reference in zip(*of_cameras, strict=True) for pair in of_reference if len(pair)]

    def _rng(self) -> np.random.Generator:
        """The same outlier rejection for the same frame, whatever came before."""
        return np.random.default_rng(self._seed)

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
        bound = np.repeat([np.pi**-2, self._radius**-2], 3)
        return covariance_of(fit.information + np.diag(bound)) + inherited

    def _learn(
        self, current: Reference, inliers: Sequence[Pair], surface: FloatArray | None = None, bulge: float = 0.0
    ) -> None:
        """The landmarks of a solved frame, and what they add to the object's cloud of points."""
        landmarks = []
        for c, camera in enumerate(self.rig):
            index, known = best_landmarks(inliers, c)
            good = known.mean[known.depth_sd < 0.1 * self._radius]
            cloud = good if len(good) >= 20 else self._points if surface is None else surface
            features, pose = current.features[c], current.world_from_object
            landmarks.append(learn_landmarks(features, camera, pose, known, index, cloud, self._radius, bulge))
            if not self._bounded:
                self._add_points(good)
        current.landmarks = tuple(landmarks)

    def _add_points(self, points: FloatArray) -> None:
        points = np.concatenate([self._points, points[np.linalg.norm(points, axis=1) < 2.0 * self._radius]])
        if len(points) > MAX_POINTS:
            points = points[self._rng().choice(len(points), MAX_POINTS, replace=False)]
        self._points = points

    # --- results -----------------------------------------------------------------------------------------------------

    def _result(
        self,
        current: Reference,
        frames: FrameSet,
        status: Status,
        regions: Regions,
        pairs: Sequence[Pair] = (),
        fit: Fit | None = None,
        base: Reference | None = None,
    ) -> TrackedFrame:
        n = len(self.rig)
        used: list[set[int]] = [set() for _ in range(n)]
        squares: list[FloatArray] = [np.empty(0)] * n
        shown: list[tuple[FloatArray, FloatArray] | None] = [None] * n
        for pair, w, r in zip(pairs, fit.weights if fit else (), fit.residuals if fit else (), strict=True):
            used[pair.camera].update(pair.indices[w > 0, 1].tolist())
            squares[pair.camera] = np.append(squares[pair.camera], r[w > 0] ** 2)
            if pair.reference is base:
                shown[pair.camera] = (pair.pixels_i[w > 0], pair.pixels_j[w > 0])
        if len(self.rig) == 1 and status is not Status.FIRST:
            status = Status.SCALE_NOT_OBSERVABLE
        pose = FramePose(
            frames.index,
            frames.time,
            status,
            current.world_from_object,
            current.covariance,
            np.array([len(u) for u in used], np.int64),
            np.array([np.sqrt(s.mean()) if len(s) else np.nan for s in squares]),
        )
        return TrackedFrame(pose, frames, tuple(shown), tuple(regions), self._radius)

    def _unsolved(self, frames: FrameSet, status: Status, regions: Regions | None = None) -> TrackedFrame:
        n = len(self.rig)
        unknown = np.full((6, 6), np.nan)
        pose = FramePose(frames.index, frames.time, status, None, unknown, np.zeros(n, np.int64), np.full(n, np.nan))
        return TrackedFrame(pose, frames, (None,) * n, tuple(regions or [None] * n), self._radius)


def _power(motion: RigidTransform, exponent: float) -> RigidTransform:
    """The motion carried on for a fraction or a multiple of its time, along its screw."""
    return RigidTransform.from_exp_coords(exponent * motion.as_exp_coords())
