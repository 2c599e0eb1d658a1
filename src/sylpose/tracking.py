"""The tracker: the object's pose in every frame, each frame against several earlier ones."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.alignment import Sights, align
from sylpose.capture import Box, FrameSet
from sylpose.epipolar import TermData
from sylpose.features import Features, detect, seen_before
from sylpose.landmarks import Landmarks, learn_landmarks
from sylpose.motion import MIN_MATCHES, Fit, fit_terms, no_fit, object_place
from sylpose.reference import Pair, Reference, learn, match_pair, still, triangulate
from sylpose.region import polygon_mask, region_polygon, volume_from_boxes
from sylpose.results import FramePose, Status
from sylpose.rig import Camera, Rig

__all__ = ["TrackedFrame", "Tracker", "track"]

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
Regions = Sequence[FloatArray | None]

# Each frame is solved against the frames this many back: near ones match well, far ones stop the drift
# (docs/method.md, "Drift").
LAGS = (1, 3, 8, 16)
# How each frame's pose is found; the first is the default (docs/methods.md).
METHODS = ("landmarks", "epipolar", "sylvester")
# Without boxes nothing is known of the object until it moves: so many frames wait for that, with their images.
PATIENCE = 10
# Margin of the object's region, as a share of its size in the image; it grows while the object is lost.
REGION_GROWTH = 0.15
# Object points kept to follow the object's region.
MAX_VOLUME_POINTS = 1500


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
    """The object's pose in every frame, as the frames come: see `Tracker` for the arguments."""
    with Tracker(rig, boxes, method=method, workers=workers, seed=seed) as tracker:
        for frame_set in frames:
            yield from tracker.step(frame_set)
        yield from tracker.flush()


class Tracker:
    """Follows one rigid object, frame by frame.

    Args:
        rig: C cameras.
        boxes: where the object is in the first frame, per camera that sees it, pixels; None: the object is what moves
            against the standing background.
        method: "landmarks" (places of the features on the object grow certain over time: drifts least), or one of
            `estimate_motion`'s two-frame estimators, "epipolar" (against several references) and "sylvester".
        workers: threads for detection and matching; None: one per core, at most one per camera.
        seed: of the outlier rejection.
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
        self.rig = rig
        self.method = method
        self._seed = seed
        self._pool = ThreadPoolExecutor(workers or min(len(rig), os.cpu_count() or 1))
        self._solved: deque[Reference] = deque(maxlen=max(LAGS) + 1)
        self._waiting: list[tuple[Reference, FrameSet]] = []
        self._velocity = RigidTransform.identity()  # the last motion, per frame number
        self._lost = 0  # frames since the last solved one
        self._points = np.empty((0, 3))  # object's frame: the cloud whose image is the object's region
        self._radius = np.nan
        self._center: FloatArray | None = None  # of the object in the first frame, world
        self._surroundings = [Features.none()] * len(rig)  # the first frame's features outside the object's region
        self._bounded = bool(boxes)  # boxes bound the object; without them its region grows with what is found on it
        if boxes:
            self._center, points = volume_from_boxes(rig, boxes)
            self._points = points - self._center
            self._radius = float(np.quantile(np.linalg.norm(self._points, axis=1), 0.95))

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
        predicted = self._predict(frames.index)
        regions = self._regions(predicted)
        images = zip(self.rig, frames.images, frames.masks, regions, strict=True)
        features = tuple(self._pool.map(lambda job: self._detect(*job), images))
        current = Reference.new(frames.index, features)
        current.background = tuple(seen_before(f, s) for f, s in zip(features, self._surroundings, strict=True))
        if self._solved:
            return [self._follow(current, frames, regions)]
        if self._center is not None:
            return [self._first(current, frames, regions)]
        return self._await_motion(current, frames)

    def flush(self) -> list[TrackedFrame]:
        """The frames still undecided at the recording's end: the object never moved."""
        waiting, self._waiting = self._waiting, []
        return [self._unsolved(frames, Status.NO_MOTION) for _, frames in waiting]

    def _split_first(self, first: Reference) -> Reference:
        """Parts the first frame's features into the object's and the surroundings', which stay where they are."""
        inside = []
        for c, (camera, features) in enumerate(zip(self.rig, first.features, strict=True)):
            region = region_polygon(camera, self._points + self._center, growth=REGION_GROWTH)
            mask = np.zeros(len(features), bool)
            if region is not None and len(features):
                place = np.round(features.pixels).astype(np.int64)
                mask = polygon_mask(region, camera.size)[place[:, 1], place[:, 0]]
            self._surroundings[c] = features.subset(~mask)
            inside.append(features.subset(mask))
        return Reference.new(first.index, tuple(inside))

    def _detect(
        self, camera: Camera, image: NDArray[np.uint8] | None, mask: BoolArray | None, region: FloatArray | None
    ) -> Features:
        if image is None:
            return Features.none()
        if self._center is None or not self._solved:
            return detect(image, camera, mask)
        if region is None:
            return Features.none()
        inside = polygon_mask(region, camera.size)
        return detect(image, camera, inside if mask is None else inside & mask)

    def _predict(self, index: int) -> RigidTransform | None:
        """The pose that constant velocity gives; the last pose once the object has been lost."""
        if not self._solved:
            return None
        last = self._solved[-1]
        if self._lost:
            return last.world_from_object
        return _power(self._velocity, index - last.index) * last.world_from_object

    def _regions(self, predicted: RigidTransform | None) -> list[FloatArray | None]:
        """Where to look in each camera: the image of the object's points at the predicted pose, with a margin."""
        if self._center is None:
            return [None] * len(self.rig)
        points = self._points + self._center if predicted is None else predicted.apply(self._points)
        return [region_polygon(camera, points, growth=REGION_GROWTH * (1 + self._lost)) for camera in self.rig]

    # --- the start ---------------------------------------------------------------------------------------------------

    def _first(self, current: Reference, frames: FrameSet, regions: Regions) -> TrackedFrame:
        """The frame whose pose is the definition of the object's frame."""
        assert self._center is not None
        current = self._split_first(current)
        current.world_from_object = RigidTransform.from_translation(self._center)
        self._learn_landmarks(current, [], [])
        self._solved.append(current)
        return self._result(current, frames, Status.FIRST, regions)

    def _await_motion(self, current: Reference, frames: FrameSet) -> list[TrackedFrame]:
        """Without boxes: compare with the oldest waiting frame until something moves; that is the object."""
        if self._waiting:
            first, first_frames = self._waiting[0]
            pairs = [pair.subset(~still(pair)) for pair in self._match([first], current)]
            pairs = [pair for pair in pairs if len(pair.indices)]
            if pairs:
                data = [pair.term(self.rig, None) for pair in pairs]
                place = object_place(data)[0]
                fit = fit_terms(data, *object_place(data), [], self._rng())
                if fit.status is Status.OK:
                    self._center, self._radius = object_place([p.term(self.rig, None) for p in inliers_of(pairs, fit)])
                    self._points = self._first_points(first, current, inliers_of(pairs, fit), place, fit)
                    nobody = [None] * len(self.rig)
                    decided = [self._first(first, first_frames, nobody)]
                    for waited, waited_frames in [*self._waiting[1:], (current, frames)]:
                        decided.append(self._follow(waited, waited_frames, nobody))
                    self._waiting = []
                    return decided
        self._waiting.append((current, frames))
        if len(self._waiting) <= PATIENCE:
            return []
        _, oldest = self._waiting.pop(0)
        return [self._unsolved(oldest, Status.NO_MOTION)]

    def _first_points(
        self, first: Reference, current: Reference, pairs: Sequence[Pair], place: FloatArray, fit: Fit
    ) -> FloatArray:
        """Triangulates the first motion's inliers: the object's points, in its frame."""
        assert self._center is not None
        first.world_from_object = RigidTransform.from_translation(self._center)
        current.world_from_object = motion_about(place, fit) * first.world_from_object
        points = np.concatenate([triangulate(pair, self.rig, current) for pair in pairs])
        return points[np.linalg.norm(points, axis=1) < 2.0 * self._radius]

    # --- every other frame -------------------------------------------------------------------------------------------

    def _follow(self, current: Reference, frames: FrameSet, regions: Regions) -> TrackedFrame:
        """Solve the frame against its references, and learn from it what the next one needs."""
        last = len(self._solved)
        references = [self._solved[i] for i in sorted({max(last - lag, 0) for lag in LAGS}, reverse=True)]
        base = references[0]
        pairs = self._match(references, current)
        if not pairs:
            return self._lose(frames, Status.TOO_FEW_MATCHES, regions)
        data = [pair.term(self.rig, base) for pair in pairs]
        predicted = self._predict(frames.index)
        assert predicted is not None
        center = base.world_from_object.translation
        guess = predicted * base.world_from_object.inv()
        guesses = [(guess.rotation.as_matrix(), guess.apply(center) - center)]
        if self.method == "landmarks":
            fit = self._align(pairs, data, current, base, guesses[0])
        else:
            fit = fit_terms(data, center, self._radius, guesses, self._rng())
        if not fit.status.has_pose:
            return self._lose(frames, fit.status, regions)
        motion = motion_about(center, fit)
        current.world_from_object = motion * base.world_from_object
        current.covariance = self._covariance(fit, pairs, references, current)
        learn(pairs, self.rig, current, self._radius)
        self._learn_landmarks(current, pairs, fit.weights)
        self._velocity = _power(motion, 1.0 / max(current.index - base.index, 1))
        self._lost = 0
        self._solved.append(current)
        return self._result(current, frames, fit.status, regions, pairs, fit)

    def _lose(self, frames: FrameSet, status: Status, regions: Regions) -> TrackedFrame:
        self._lost += 1
        return self._unsolved(frames, status, regions)

    def _match(self, references: Sequence[Reference], current: Reference) -> list[Pair]:
        jobs = [(reference, camera) for reference in references for camera in range(len(self.rig))]
        pairs = self._pool.map(lambda job: match_pair(job[0], current, job[1]), jobs)
        return [pair for pair in pairs if len(pair.indices)]

    def _rng(self) -> np.random.Generator:
        """The same outlier rejection for the same frame, whatever came before: runs can be compared and resumed."""
        return np.random.default_rng(self._seed)

    def _covariance(
        self, fit: Fit, pairs: Sequence[Pair], references: Sequence[Reference], current: Reference
    ) -> FloatArray:
        """The fit's covariance plus the references' own.

        The references' errors come from common ancestors, so they are taken as fully correlated: then the covariance of
        their weighted mean is at most the weighted mean of their covariances. The weights are their shares of inliers.
        """
        own = np.linalg.pinv(fit.information_with_prior, hermitian=True)
        count = {id(reference): 0.0 for reference in references}
        for pair, w in zip(pairs, fit.weights, strict=True):
            count[id(pair.reference)] += float(w.sum())
        total = max(sum(count.values()), 1e-12)
        inherited = np.zeros((6, 6))
        for reference in references:
            turn = (current.world_from_object.rotation * reference.world_from_object.rotation.inv()).as_matrix()
            both = np.kron(np.eye(2), turn)
            inherited += count[id(reference)] / total * (both @ reference.covariance @ both.T)
        return np.asarray(own + inherited)

    def _align(
        self,
        pairs: Sequence[Pair],
        data: Sequence[TermData],
        current: Reference,
        base: Reference,
        guess: tuple[FloatArray, FloatArray],
    ) -> Fit:
        """The pose from landmarks: each feature's best known one, whichever reference it comes from."""
        center = base.world_from_object.translation
        turn = base.world_from_object.rotation
        sights = []
        for c, camera in enumerate(self.rig):
            mine = [pair for pair in pairs if pair.camera == c]
            known = Landmarks.concatenate([pair.reference.landmarks[c].subset(pair.indices[:, 0]) for pair in mine])
            index = np.concatenate([np.empty(0, np.int64), *(pair.indices[:, 1] for pair in mine)])
            error = turn.apply(known.depth_error).reshape(-1, 3)
            points = turn.apply(known.mean).reshape(-1, 3)
            # What has moved along for long deserves more trust than what has just come into view (a hand, say).
            trust = np.minimum(known.seen / np.quantile(known.seen, 0.75), 1.0) ** 2 if len(known) else np.empty(0)
            away = np.sign(np.einsum("ni,ni->n", error, points + center - camera.center))
            sights.append(
                Sights(
                    points,
                    error * away[:, None],
                    current.features[c].normalized[index],
                    index,
                    trust,
                    camera.rotation,
                    camera.center - center,
                    camera.focal,
                )
            )
        if sum(len(s.points) for s in sights) < MIN_MATCHES:
            return no_fit(data, Status.TOO_FEW_MATCHES)
        aligned = align(sights, *guess)
        if aligned.cost > 0.6:
            other = fit_terms(data, center, self._radius, [guess], self._rng())
            if other.status is Status.OK:
                again = align(sights, other.rotation, other.shift, 4.0)
                if again.cost < aligned.cost:
                    aligned = again
        weights, residuals = [], []
        position = [0] * len(self.rig)
        for pair in pairs:
            start, stop = position[pair.camera], position[pair.camera] + len(pair)
            weights.append(aligned.weights[pair.camera][start:stop])
            residuals.append(aligned.residuals[pair.camera][start:stop])
            position[pair.camera] = stop
        status = Status.OK if aligned.converged else Status.NOT_CONVERGED
        if sum(int((w > 0).sum()) for w in aligned.weights) < MIN_MATCHES:
            status = Status.NOT_CONSISTENT
        return Fit(
            status,
            aligned.rotation,
            aligned.shift,
            tuple(weights),
            tuple(residuals),
            np.array([]),
            aligned.information,
            aligned.information,
            aligned.iterations,
        )

    def _learn_landmarks(self, current: Reference, pairs: Sequence[Pair], weights: Sequence[FloatArray]) -> None:
        inliers = [pair.subset(w > 0) for pair, w in zip(pairs, weights, strict=True)]
        landmarks = []
        for c, camera in enumerate(self.rig):
            index, known = best_landmarks(inliers, c)
            sd = np.sqrt(np.linalg.eigvalsh(known.information)[:, 0].clip(1e-30) ** -1.0)
            good = known.mean[(sd < 0.1 * self._radius) & (np.linalg.norm(known.mean, axis=1) < 2.0 * self._radius)]
            cloud = good if len(good) >= 20 else self._points
            landmarks.append(
                learn_landmarks(
                    current.features[c], camera, current.world_from_object, known, index, cloud, self._radius
                )
            )
            if not self._bounded:
                self._points = np.concatenate([self._points, good])
        if len(self._points) > MAX_VOLUME_POINTS:
            self._points = self._points[self._rng().choice(len(self._points), MAX_VOLUME_POINTS, replace=False)]
        current.landmarks = tuple(landmarks)

    # --- results -----------------------------------------------------------------------------------------------------

    def _result(
        self,
        current: Reference,
        frames: FrameSet,
        status: Status,
        regions: Regions,
        pairs: Sequence[Pair] = (),
        fit: Fit | None = None,
    ) -> TrackedFrame:
        n = len(self.rig)
        counts, squares = np.zeros(n, np.int64), np.zeros(n)
        shown: list[tuple[FloatArray, FloatArray] | None] = [None] * n
        if fit is not None:
            for pair, w, r in zip(pairs, fit.weights, fit.residuals, strict=True):
                counts[pair.camera] += int((w > 0).sum())
                squares[pair.camera] += float((r[w > 0] ** 2).sum())
                if pair.reference is self._solved[-2]:
                    shown[pair.camera] = (pair.pixels_i[w > 0], pair.pixels_j[w > 0])
        residuals = np.sqrt(np.divide(squares, counts, out=np.full(n, np.nan), where=counts > 0))
        pose = FramePose(
            frames.index, frames.time, status, current.world_from_object, current.covariance, counts, residuals
        )
        return TrackedFrame(pose, frames, tuple(shown), tuple(regions), self._radius)

    def _unsolved(self, frames: FrameSet, status: Status, regions: Regions | None = None) -> TrackedFrame:
        n = len(self.rig)
        pose = FramePose(
            frames.index, frames.time, status, None, np.full((6, 6), np.nan), np.zeros(n, np.int64), np.full(n, np.nan)
        )
        return TrackedFrame(pose, frames, (None,) * n, tuple(regions or [None] * n), self._radius)


def best_landmarks(pairs: Sequence[Pair], camera: int) -> tuple[NDArray[np.int64], Landmarks]:
    """For each feature of the current frame that is matched at all, the best known of the landmarks it is matched with.

    Returns:
        index (k,) into the current frame's features; their landmarks (k).
    """
    mine = [pair for pair in pairs if pair.camera == camera and len(pair)]
    if not mine:
        return np.empty(0, np.int64), Landmarks.none()
    known = Landmarks.concatenate([pair.reference.landmarks[camera].subset(pair.indices[:, 0]) for pair in mine])
    index = np.concatenate([pair.indices[:, 1] for pair in mine])
    weakest = np.linalg.eigvalsh(known.information)[:, 0]
    order = np.lexsort([-weakest, index])
    _, first = np.unique(index[order], return_index=True)
    pick = order[first]
    return index[pick], known.subset(pick)


def motion_about(center: FloatArray, fit: Fit) -> RigidTransform:
    """X -> R (X - g) + g + d as a transform."""
    rotation = Rotation.from_matrix(fit.rotation)
    return RigidTransform.from_components(center + fit.shift - rotation.apply(center), rotation)


def inliers_of(pairs: Sequence[Pair], fit: Fit) -> list[Pair]:
    """The pairs' inliers, pairs without any left out."""
    kept = [pair.subset(w > 0) for pair, w in zip(pairs, fit.weights, strict=True)]
    return [pair for pair in kept if len(pair.indices)]


def _power(motion: RigidTransform, exponent: float) -> RigidTransform:
    """The motion carried on for a fraction or a multiple of its time, along its screw."""
    return RigidTransform.from_exp_coords(exponent * motion.as_exp_coords())
