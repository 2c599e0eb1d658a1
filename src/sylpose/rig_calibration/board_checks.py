"""Checks of a calibration from boards: covariance, cross-validation by halves of the frames, coverage, delays.

Cross-validation and projection errors follow mrcal (D. Kogan, https://mrcal.secretsauce.net): a calibration whose halves
differ by more than their covariances has errors that its residuals do not show.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import invert_information
from sylpose.geometry.robust_loss import chi_squared_bound
from sylpose.rig_calibration.board_bundle import (
    N_CAMERA,
    N_LENS,
    Freedom,
    Linearization,
    NormalEquations,
    Optimum,
    Unknowns,
    Views,
    linearize,
    optimize,
    project,
    solve_scaled,
    whiten_shifts,
)
from sylpose.rig_calibration.result import Coverage, HalvesTest, measure_cells

# Fewest frames of a half that is calibrated on its own (choice).
MIN_HALF_FRAMES = 6


def compute_covariance(views: Views, optimum: Optimum, freedom: Freedom) -> FloatArray:
    """Return the covariance (C 19, C 19) of the cameras' unknowns, 0 for those that are not free.

    The inverse of the normal equations is multiplied, for each lens and each pose, by the scatter of the frames'
    contributions relative to independent errors of all corners: at least 1, at most the coordinates of a view, which may
    all have one error in common (`bundle_adjustment/covariance_inflation.py` has the derivation and its sources).
    """
    n_frames, free = len(optimum.at.board_rotation), freedom.free
    chosen = np.flatnonzero(free)
    used = views.seen & (optimum.weights > 0)
    weights = optimum.weights / optimum.sigma[views.camera][:, None] ** 2
    # A shift counts as an unknown in so far as the corners determine it.
    precision = weights.sum(axis=1) * optimum.shift_sd**2
    n_rows, n_unknowns = (
        2 * int(used.sum()),
        len(chosen) + 6 * n_frames + 2.0 * float((precision / (1 + precision)).sum()),
    )
    lin = whiten_shifts(linearize(views, optimum.at), weights, optimum.shift_sd)
    equations = NormalEquations.build(views, lin, weights, optimum.at, freedom)
    matrix, _, through, _ = equations.eliminate_boards()
    covariance = invert_information(matrix[np.ix_(chosen, chosen)])
    if not np.isfinite(covariance).all():
        # A combination of unknowns is not observable, and all others may depend on it.
        return np.where(np.outer(free, free), np.inf, 0.0)
    gradient, information = _split_by_frame(views, lin, weights, equations, through)
    parts = gradient.reshape(n_frames, -1)[:, chosen] @ covariance
    information = information.reshape(n_frames, free.size, free.size)[:, chosen][:, :, chosen]
    explained = covariance @ information @ covariance
    limit = 2.0 * float(used.sum(axis=1).mean())
    # The median of the residuals does not contain what the unknowns absorb.
    scale, minimum = np.ones(len(chosen)), n_rows / max(n_rows - n_unknowns, 1)
    # Lens and pose of a camera suffer differently from errors that the corners of a view have in common.
    block_of = 2 * (chosen // N_CAMERA) + (chosen % N_CAMERA >= N_LENS)
    for block in (np.flatnonzero(block_of == b) for b in np.unique(block_of)):
        inverse = solve_scaled(covariance[np.ix_(block, block)], np.eye(len(block)))
        scatter = float(np.einsum("fi,ij,fj->", parts[:, block], inverse, parts[:, block]))
        own = explained[:, block][:, :, block] @ inverse
        expected = len(block) - float(np.einsum("fij,fji->", own, own))
        scale[block] = np.sqrt(np.clip(scatter / expected if expected > 1.0 else limit, minimum, max(limit, minimum)))
    out = np.zeros((free.size, free.size))
    out[np.ix_(chosen, chosen)] = covariance * np.outer(scale, scale)
    return out


def _split_by_frame(
    views: Views, lin: Linearization, weights: FloatArray, equations: NormalEquations, through: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the gradient (F, C, 19) and information (F, C, 19, C, 19) of each frame, its board eliminated."""
    gradient = -np.einsum("cfij,fj->fci", through, equations.board_gradient)
    information = -np.einsum("cfik,dfjk->fcidj", through, equations.coupling)
    weighted = lin.camera_jacobian * np.repeat(weights, 2, axis=1)[..., None]
    own = np.einsum("vij,vi->vj", weighted, lin.residuals.reshape(len(weights), -1))
    blocks = weighted.transpose(0, 2, 1) @ lin.camera_jacobian
    for v, (f, c) in enumerate(zip(views.frame, views.camera, strict=True)):
        gradient[f, c] += own[v]
        information[f, c, :, c] += blocks[v]
    return gradient, np.asarray(information)


def compare_halves(views: Views, optimum: Optimum, freedom: Freedom) -> HalvesTest | None:
    """Calibrate from each half of the frames and compare; None if they determine too little."""
    n_cameras, at = len(optimum.at.lens), optimum.at
    halves, sides = [], [views.frame % 2 == k for k in (0, 1)]
    for half in sides:
        if np.bincount(views.camera[half], minlength=n_cameras).min() < MIN_HALF_FRAMES:
            return None
        own, boards = views.select(half), np.unique(views.frame[half])
        own = replace(own, frame=np.searchsorted(boards, own.frame))
        start = replace(at, board_rotation=at.board_rotation[boards], board_translation=at.board_translation[boards])
        found = optimize(own, start, freedom, relative=optimum.sigma, with_shifts=True)
        covariance = compute_covariance(own, found, freedom)
        if not np.isfinite(covariance).all():
            return None
        halves.append((found.at, covariance))
    (a, a_covariance), (b, b_covariance) = halves
    w = Rotation.from_matrix(a.rotation @ b.rotation.transpose(0, 2, 1)).as_rotvec()
    difference = np.hstack([a.lens - b.lens, w, a.translation - b.translation, (a.delay - b.delay)[:, None]])
    ratio, is_significant = np.ones(n_cameras), np.zeros(n_cameras, bool)
    for c in range(n_cameras):
        block = np.flatnonzero(freedom.free[c])
        rows = c * N_CAMERA + block
        total = (a_covariance + b_covariance)[np.ix_(rows, rows)]
        square = float(difference[c, block] @ solve_scaled(total, difference[c, block]))
        ratio[c], is_significant[c] = square / len(block), square > chi_squared_bound(len(block))
    position = np.linalg.norm(_centers(a) - _centers(b), axis=1)
    pixels = _compare_projections(views, optimum, a, b)
    return HalvesTest(np.linalg.norm(w, axis=1), position, pixels, ratio, is_significant)


def _centers(at: Unknowns) -> FloatArray:
    return np.asarray(-np.einsum("cji,cj->ci", at.rotation, at.translation))


def _compare_projections(views: Views, optimum: Optimum, a: Unknowns, b: Unknowns) -> FloatArray:
    """Return (C,) rms differences of projections of the boards where they were seen, with the cameras of a and b."""
    found = np.zeros(len(a.lens))
    boards = optimum.at.board_rotation, optimum.at.board_translation
    pixels = [
        project(views, replace(its, board_rotation=boards[0], board_translation=boards[1], delay=0.0 * its.delay))
        for its in (a, b)
    ]
    is_seen = views.seen & np.isfinite(pixels[0]).all(axis=2) & np.isfinite(pixels[1]).all(axis=2)
    squares = np.where(is_seen[..., None], pixels[0], 0.0) - np.where(is_seen[..., None], pixels[1], 0.0)
    squares = (squares**2).sum(axis=2)
    for c in range(len(found)):
        own = views.camera == c
        found[c] = float(np.sqrt(squares[own][is_seen[own]].mean()))
    return found


def inflate_by_halves(covariance: FloatArray, halves: HalvesTest | None) -> FloatArray:
    """Multiply the covariance (C 19, C 19) of cameras whose halves differ significantly by the ratio."""
    if halves is None:
        return covariance
    scale = np.repeat(np.sqrt(np.where(halves.is_significant, np.maximum(halves.ratio, 1.0), 1.0)), N_CAMERA)
    return np.asarray(covariance * np.outer(scale, scale))


def measure_coverage(views: Views, optimum: Optimum, size: tuple[int, int], camera: int) -> Coverage:
    """Measure the coverage of a camera's image of a size (width, height)."""
    own = views.camera == camera
    used = (optimum.weights > 0)[own] & views.seen[own]
    counts, rms = measure_cells(views.pixels[own][used], (optimum.residuals[own][used] ** 2).sum(axis=1), size)
    at, frames = optimum.at, views.frame[own]
    rotation = at.rotation[camera] @ at.board_rotation[frames]
    middle = views.points.mean(axis=0)
    places = at.board_rotation[frames] @ middle + at.board_translation[frames]
    sight = places @ at.rotation[camera].T + at.translation[camera]
    cosine = np.abs((rotation[:, :, 2] * sight).sum(axis=1)) / np.linalg.norm(sight, axis=1)
    return Coverage(counts, rms, float(np.arccos(cosine.min(initial=1.0))))
