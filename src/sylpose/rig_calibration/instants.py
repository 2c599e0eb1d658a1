"""Instants at which cameras took their images, where those of a frame are not simultaneous.

Images are moved to the mean instant of their frame along the motion: by time stamps, with each camera's own track; and
where stamps are inexact, as those of webcams, by instants that the joint refinement estimates. The error of a stamp is
a constant of its camera plus a random number for each image, whose variances follow from the residuals by expectation
maximization.

Source: N. Laird, J. Ware, "Random-effects models for longitudinal data", 1982.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.bundle_adjustment.bundle import Observations
from sylpose.bundle_adjustment.problem import differentiate_quartic
from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.matrices import transpose
from sylpose.rig import Camera
from sylpose.rig_calibration.camera_tracks import RefinedTrack
from sylpose.rig_calibration.motion_bundle import JointBundle

# Iterations of expectation maximization (choice: variances near zero converge slowly, but matter little).
MAX_ITERATIONS = 50


def collect_instants(tracks: Sequence[RefinedTrack], frames: IntArray) -> FloatArray:
    """Return (N, C) seconds, when each camera took each frame; NaN where it did not track."""
    instants = np.full((len(frames), len(tracks)), np.nan)
    for c, its in enumerate(tracks):
        instants[np.searchsorted(frames, its.track.frames), c] = its.times
    return instants


def synchronize_tracks(tracks: Sequence[RefinedTrack]) -> list[RefinedTrack]:
    """Move tracks to the mean instants of their frames, each by its own motion."""
    frames = np.unique(np.concatenate([its.track.frames for its in tracks]))
    common = np.nanmean(collect_instants(tracks, frames), axis=1)
    return [_synchronize_track(its, common[np.searchsorted(frames, its.track.frames)]) for its in tracks]


def _synchronize_track(its: RefinedTrack, times: FloatArray) -> RefinedTrack:
    shift, observations = times - its.times, its.observations
    if not shift.any():
        return its
    moved = _move_poses(its.track.camera_from_object, its.times, shift)
    before, after = (
        _project(poses, observations.frame, its.landmarks[observations.landmark])
        for poses in (its.track.camera_from_object, moved)
    )
    track = replace(its.track, camera_from_object=moved)
    return replace(its, track=track, times=times, observations=_move_images(observations, after - before))


def move_to_frames(
    tracks: Sequence[RefinedTrack],
    cameras: Sequence[Camera],
    frames: IntArray,
    times: FloatArray,
    instants: FloatArray,
    joint: JointBundle,
) -> list[RefinedTrack]:
    """Move the images of tracks to the instants of N frames by the motion of a joint refinement.

    Args:
        tracks: C tracks as observed.
        cameras: their cameras, by which the images are normalized; the joint refinement may have corrected the lenses.
        frames, times: (N,) frame numbers, and their instants, seconds.
        instants: (N, C) when the images were taken; NaN where there is none.
        joint: refinement of these tracks; its landmarks are numbered through the tracks.
    """
    moved, first = list[RefinedTrack](), 0
    for c, its in enumerate(tracks):
        observations, rows = its.observations, np.searchsorted(frames, its.track.frames)
        poses = joint.rig[c].camera_from_world * joint.reference_from_object
        taken = _move_poses(poses, times, np.nan_to_num(instants[:, c] - times))
        points, frame = joint.landmarks[first + observations.landmark], rows[observations.frame]
        at, before = (
            cameras[c].normalize(joint.rig[c].denormalize(_project(its, frame, points))) for its in (poses, taken)
        )
        moved.append(replace(its, times=times[rows], observations=_move_images(observations, at - before)))
        first += len(its.landmarks)
    return moved


def estimate_delays(joint: JointBundle, times: FloatArray) -> FloatArray:
    """Estimate by how much later than assumed each image was taken, from the residuals of a joint refinement.

    The residuals of frame i in camera c are e = J (δ_i + τ_ci V_i) + noise: δ_i corrects the object's pose, V_i is its
    twist, and τ_ci is normally distributed with a mean and variance of its camera.

    Args:
        joint: refinement with images moved to the frames' instants.
        times: (N,) these instants.

    Returns:
        (N, C) delays τ, seconds; their camera's mean where there is no image.
    """
    twists = differentiate_quartic(*_split(joint.reference_from_object), times)[:, 0]
    information, gradient = _sum_views(joint)
    is_seen = information.any(axis=(2, 3))
    total = np.linalg.pinv(information.sum(axis=1), hermitian=True)
    through = np.einsum("ncij,nj->nci", information, twists)
    own = np.einsum("nci,ni->nc", through, twists)
    cross = np.einsum("nci,nij,ndj->ncd", through, total, through, optimize=True)
    right = np.einsum("nci,ni->nc", gradient, twists)
    right -= np.einsum("nci,nij,nj->nc", through, total, gradient.sum(axis=1))
    counts, n_cameras = np.maximum(is_seen.sum(axis=0), 1), own.shape[1]
    delays, means = right / np.maximum(own, 1e-300), np.zeros(n_cameras)
    # A start from frames by their information: without motion there is none.
    variances = (own * delays**2).sum(axis=0) / np.maximum(own.sum(axis=0), 1e-300)
    for _ in range(MAX_ITERATIONS):
        precisions = 1.0 / np.maximum(variances, 1e-300)
        matrix = (own + precisions)[:, :, None] * np.eye(n_cameras) - cross
        covariance = np.linalg.inv(matrix)
        delays = np.einsum("ncd,nd->nc", covariance, right + means * precisions)
        means = (delays * is_seen).sum(axis=0) / counts
        squares = (delays - means) ** 2 + np.einsum("ncc->nc", covariance)
        variances = (squares * is_seen).sum(axis=0) / counts
    return np.asarray(delays)


def _sum_views(joint: JointBundle) -> tuple[FloatArray, FloatArray]:
    """Return (N, C, 6, 6) information of each view on its frame's pose (w, d), and (N, C, 6) its gradient."""
    observations, rig, poses = joint.observations, joint.rig, joint.reference_from_object
    frame, camera = observations.frame, observations.camera
    rotations, translations = _split(poses)
    arms = np.einsum("nij,nj->ni", rotations[frame], joint.landmarks[observations.landmark])
    to_camera = np.array([c.rotation for c in rig])[camera]
    centers = np.array([c.center for c in rig])[camera]
    points = np.einsum("nij,nj->ni", to_camera, arms + translations[frame] - centers)
    image = points[:, :2] / points[:, 2:]
    by_point = np.concatenate([np.tile(np.eye(2), (len(image), 1, 1)), -image[:, :, None]], axis=2)
    by_world = by_point / points[:, 2, None, None] @ to_camera
    jacobian = np.concatenate([np.cross(arms[:, None], by_world), by_world], axis=2)
    focal = np.array([c.focal for c in rig])
    weights = joint.weights * (focal / joint.sigma_px)[camera] ** 2
    shape = (len(poses), len(rig))
    information, gradient = np.zeros((*shape, 6, 6)), np.zeros((*shape, 6))
    weighted = transpose(jacobian) * weights[:, None, None]
    np.add.at(information, (frame, camera), weighted @ jacobian)
    np.add.at(gradient, (frame, camera), (weighted @ (observations.image - image)[..., None])[..., 0])
    return information, gradient


def _split(poses: RigidTransform) -> tuple[FloatArray, FloatArray]:
    return poses.rotation.as_matrix(), poses.translation


def _move_poses(poses: RigidTransform, times: FloatArray, shift: FloatArray) -> RigidTransform:
    """Return poses (N) at times (N,) moved by shifts (N,) of time along their motion."""
    first, second = differentiate_quartic(*_split(poses), times).transpose(1, 0, 2)
    change = shift[:, None] * first + 0.5 * shift[:, None] ** 2 * second
    rotation = Rotation.from_rotvec(change[:, :3]) * poses.rotation
    return RigidTransform.from_components(poses.translation + change[:, 3:], rotation)


def _project(poses: RigidTransform, frame: IntArray, points: FloatArray) -> FloatArray:
    """Return normalized images (n, 2) of points (n, 3) of the object, each in one of N poses camera_from_object."""
    rotations, translations = _split(poses)
    camera = np.einsum("nij,nj->ni", rotations[frame], points) + translations[frame]
    return np.asarray(camera[:, :2] / camera[:, 2:])


def _move_images(observations: Observations, shift: FloatArray) -> Observations:
    return replace(observations, image=observations.image + shift)
