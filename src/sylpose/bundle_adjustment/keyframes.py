"""Bundle adjustment of a long trajectory by key frames, in time proportional to its length.

Key frames are refined jointly. The frames between them are refined in segments, with the poses of the nearest key frames
fixed. Neighboring frames observe nearly the same from nearly the same side, and a tracked patch has nearly the same error in
them: they add next to nothing to the key frames. That is tested: where the errors of successive key frames are independent,
all frames are refined jointly.

Source: G. Klein, D. Murray, "Parallel tracking and mapping for small AR workspaces", 2007 (key frames).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.bundle_adjustment.bundle import (
    BundleOptions,
    BundleResult,
    Observations,
    bundle_adjust,
    resolve_fixed_frames,
)
from sylpose.bundle_adjustment.scale_prior import bundle_adjust_with_scale, recover
from sylpose.geometry.arrays import BoolArray, IntArray
from sylpose.geometry.matrices import enlarge_covariance
from sylpose.rig import Rig
from sylpose.status import Status

# Shorter recordings are refined as a whole (choice: a second or two).
MIN_FRAMES = 100
# A frame becomes a key frame if the object has rotated by this since the last one, radians; if this share of its
# observations is of landmarks that the last one does not observe; or if the last one is so many frames ago
# (choice: docs/history/benchmarks.md, "Key frames", half and twice).
MIN_ROTATION, MIN_NEW_RATIO, MAX_STEP = np.radians(4.0), 0.2, 8
# With more key frames than this these limits are doubled (choice: their system is dense if the object shows the same sides
# again and again; a factorization takes 1.5 s at so many).
MAX_KEYFRAMES = 600
# Correlation of the errors of successive key frames with which they have at most 1.1 times the standard deviation of all
# frames (derived: 8 (1 + r^8) (1 - r) < 1.1^2 (1 - r^8) (1 + r) with errors that are correlated by r from frame to frame).
MIN_CORRELATION = 0.2
# Frames of a segment between key frames, at most, and number of the nearest key frames, with fixed poses (choice:
# docs/history/benchmarks.md, "Key frames", half and twice).
SEGMENT_FRAMES = 32


def select_keyframes(observations: Observations, world_from_object: RigidTransform, fixed: BoolArray) -> BoolArray:
    """Select the key frames (N,) of a trajectory; all of a short one.

    Args:
        observations: in the frames.
        world_from_object: N poses.
        fixed: (N,) frames with fixed poses, which are key frames.
    """
    n, factor = len(fixed), 1
    if n < MIN_FRAMES:
        return np.ones_like(fixed)
    order = np.argsort(observations.frame, kind="stable")
    landmarks = np.split(observations.landmark[order], np.cumsum(np.bincount(observations.frame, minlength=n))[:-1])
    while True:
        is_key = _select_keyframes(landmarks, world_from_object.rotation, fixed, factor)
        if is_key.sum() <= MAX_KEYFRAMES or factor * MAX_STEP > n:
            return is_key
        factor *= 2


def _select_keyframes(landmarks: list[IntArray], rotations: Rotation, fixed: BoolArray, factor: int) -> BoolArray:
    """Select key frames (N,) from the landmarks that each frame observes, with limits enlarged by a factor."""
    is_key, last = fixed.copy(), 0
    is_key[[0, -1]] = True
    min_rotation, min_new_ratio = factor * MIN_ROTATION, min(factor * MIN_NEW_RATIO, 1.0)
    for k in range(1, len(fixed)):
        is_new = ~np.isin(landmarks[k], landmarks[last])
        is_key[k] |= k - last >= factor * MAX_STEP or (rotations[k] * rotations[last].inv()).magnitude() >= min_rotation
        is_key[k] |= not len(is_new) or bool(is_new.mean() >= min_new_ratio)
        last = k if is_key[k] else last
    return is_key


def bundle_adjust_by_keyframes(
    rig: Rig,
    observations: Observations,
    world_from_object: RigidTransform,
    radius: float,
    options: BundleOptions,
) -> BundleResult:
    """Run `bundle_adjust_with_scale` on key frames, then refine the frames between them.

    Args:
        rig, observations, world_from_object, radius: as of `bundle_adjust`.
        options: without time offsets, to be estimated or known, and without calibration errors to be estimated.

    Returns:
        the refined trajectory. Landmarks, noise, path and calibration are those of the key frames. The covariance of a
        frame between them is at least its own with the key frames fixed, and that of the nearest key frame.
    """
    fixed = resolve_fixed_frames(options.fixed, len(world_from_object))
    is_key = select_keyframes(observations, world_from_object, fixed)
    if is_key.all():
        return bundle_adjust_with_scale(rig, observations, world_from_object, radius, options)
    own = observations.select_frames(is_key)
    key_options = _select_options(options, is_key, fixed)
    result = bundle_adjust_with_scale(rig, own, world_from_object[is_key], radius, key_options)
    out = _spread_result(result, world_from_object, observations, is_key)
    if correlate_errors(own, result) < MIN_CORRELATION:
        all_options = replace(options, landmarks=result.landmarks)
        return bundle_adjust_with_scale(rig, observations, out.world_from_object, radius, all_options)
    segments = list[_Segment]()
    for segment in _make_segments(observations, is_key, result.connected) if result.status is Status.OK else ():
        part = _refine_segment(rig, observations, out, radius, options, segment)
        if part.status is Status.NOT_CONVERGED:
            out = replace(out, status=part.status)
            break
        segments.append(segment._replace(result=part))
    return _merge_segments(out, observations, segments)


def correlate_errors(observations: Observations, result: BundleResult) -> float:
    """Return the correlation of the errors of a landmark's observations in successive frames; 0 without any.

    It is the share of their variance that is common to both frames: at most that share is common to more of them.
    """
    earlier, later = observations.pair_successive()
    is_inlier = np.minimum(result.weights[earlier], result.weights[later]) > 0
    first, second = result.residuals[earlier[is_inlier]], result.residuals[later[is_inlier]]
    return float((first * second).sum() / max(np.sqrt((first**2).sum() * (second**2).sum()), 1e-300))


def _select_options(options: BundleOptions, is_used: BoolArray, fixed: BoolArray) -> BundleOptions:
    """Return the options for some frames (N,), with these fixed (N,)."""
    times = None if options.times is None else np.asarray(options.times)[is_used]
    return replace(options, fixed=fixed[is_used], times=times)


class _Segment(NamedTuple):
    """Frames between key frames, with the key frames that are fixed in their refinement.

    Attributes:
        frames: (f,) both, ascending; those with observations.
        is_free: (f,) which are not fixed.
        rows: (n,) their observations of the landmarks that frames between key frames observe.
        result: of these frames and observations, with these landmarks renumbered; None before.
    """

    frames: IntArray
    is_free: BoolArray
    rows: IntArray
    result: BundleResult | None = None


def _make_segments(observations: Observations, is_key: BoolArray, connected: BoolArray) -> Iterator[_Segment]:
    """Make segments of the frames between key frames (N,), each with the nearest connected key frames (K,)."""
    order, n = np.argsort(observations.frame, kind="stable"), len(is_key)
    rows_by_frame = np.split(order, np.searchsorted(observations.frame[order], np.arange(1, n)))
    keys = np.flatnonzero(is_key)[connected]
    for own in _split_frames(is_key):
        middle = own.mean()
        last = int(np.searchsorted(keys, middle))
        near = keys[max(last - SEGMENT_FRAMES, 0) : last + SEGMENT_FRAMES]
        near = near[np.argsort(np.abs(near - middle), kind="stable")[:SEGMENT_FRAMES]]
        seen = observations.landmark[np.concatenate([rows_by_frame[k] for k in own])]
        rows = np.sort(np.concatenate([rows_by_frame[k] for k in (*own, *near)]))
        rows = rows[np.isin(observations.landmark[rows], seen)]
        frames = np.unique(observations.frame[rows])
        is_free = ~is_key[frames]
        if 0 < is_free.sum() < len(frames):
            yield _Segment(frames, is_free, rows)


def _split_frames(is_key: BoolArray) -> list[IntArray]:
    """Return the frames between key frames, in order, in segments that end at key frames."""
    runs = np.split(np.arange(len(is_key)), np.flatnonzero(is_key))
    segments = list[IntArray]()
    for run in runs:
        frames = run[~is_key[run]]
        if segments and len(segments[-1]) + len(frames) <= SEGMENT_FRAMES:
            segments[-1] = np.concatenate([segments[-1], frames])
        elif len(frames):
            segments.append(frames)
    return segments


def _spread_result(
    result: BundleResult, world_from_object: RigidTransform, observations: Observations, is_key: BoolArray
) -> BundleResult:
    """Return the key frames' result for all frames (N,); the others move along with the nearest one, unconnected."""
    used, keys = is_key[observations.frame], np.flatnonzero(is_key)
    numbers = np.arange(len(is_key))
    index = np.searchsorted(keys[:-1] + keys[1:], 2 * numbers)
    weights, residuals = np.zeros(len(observations)), np.zeros((len(observations), 2))
    weights[used], residuals[used] = result.weights, result.residuals
    correction = result.world_from_object * world_from_object[keys].inv()
    known, change = keys[result.connected], np.zeros((len(is_key), 6))
    if len(known):
        columns = result.calibration_change[result.connected].T
        change = np.column_stack([np.interp(numbers, known, column) for column in columns])
    return replace(
        result,
        world_from_object=correction[index] * world_from_object,
        covariance=result.covariance[index],
        connected=result.connected[index] & is_key,
        weights=weights,
        residuals=residuals,
        variance_inflation=result.variance_inflation[index],
        calibration_change=change,
        rests_on_prior=result.rests_on_prior[index],
        surface_covariance=result.surface_covariance[index],
    )


def _refine_segment(
    rig: Rig,
    observations: Observations,
    result: BundleResult,
    radius: float,
    options: BundleOptions,
    segment: _Segment,
) -> BundleResult:
    """Refine the free frames of a segment of a result, whose other poses are fixed."""
    frames, rows = segment.frames, segment.rows
    seen, landmark = np.unique(observations.landmark[rows], return_inverse=True)
    frame = np.searchsorted(frames, observations.frame[rows])
    own = Observations(frame, observations.camera[rows], landmark, observations.image[rows])
    own_options = replace(
        options,
        fixed=~segment.is_free,
        times=None if options.times is None else np.asarray(options.times)[frames],
        landmarks=result.landmarks[seen],
        calibration_prior=None,
        on_iteration=None,
    )
    start = result.world_from_object[frames]
    part = bundle_adjust(rig, own, start, radius, own_options)
    return recover(rig, own, start, part, radius, own_options)


def _merge_segments(result: BundleResult, observations: Observations, segments: Sequence[_Segment]) -> BundleResult:
    """Return a result with refined segments.

    These have all of their free frames' observations, and those in key frames of landmarks that no other key frame
    observes.
    """
    rotations, translations = result.world_from_object.rotation.as_matrix(), result.world_from_object.translation
    covariance, connected = result.covariance.copy(), result.connected.copy()
    weights, residuals, iterations = result.weights.copy(), result.residuals.copy(), result.iterations
    for frames, is_free, rows, part in segments:
        assert part is not None
        frame = np.searchsorted(frames, observations.frame[rows])
        where = np.flatnonzero(is_free & part.connected)
        own = frames[where]
        rotations[own] = part.world_from_object.rotation.as_matrix()[where]
        translations[own], connected[own] = part.world_from_object.translation[where], True
        for k, i in zip(own.tolist(), where.tolist(), strict=True):
            covariance[k] = enlarge_covariance(part.covariance[i], covariance[k])
        is_new = part.weights > weights[rows]
        weights[rows[is_new]] = part.weights[is_new]
        is_new |= is_free[frame]
        residuals[rows[is_new]] = part.residuals[is_new]
        iterations += part.iterations
    return replace(
        result,
        world_from_object=RigidTransform.from_components(translations, Rotation.from_matrix(rotations)),
        covariance=covariance,
        connected=connected,
        weights=weights,
        residuals=residuals,
        iterations=iterations,
    )
