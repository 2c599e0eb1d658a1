"""Calibration of a rig from a board: detections in all cameras and frames to lenses, extrinsics and their covariance.

Each camera is calibrated on its own, the cameras are linked by the board's poses in common frames, and all is refined
together. The covariance is that of the bundle adjustment times the scatter of the frames (`bundle_adjustment/
covariance_inflation.py`): corners of a view share errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.boards.board_pose import compute_centroids, make_circle
from sylpose.boards.detection import Detection
from sylpose.boards.specification import Board
from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.normal_equations import UNOBSERVABLE_RATIO
from sylpose.geometry.validation import check_integer, check_sequence, check_type
from sylpose.rig import Camera, Rig
from sylpose.rig_calibration.board_bundle import (
    DELAY,
    N_CAMERA,
    N_LENS,
    POSE,
    Freedom,
    Optimum,
    Unknowns,
    Views,
    optimize,
    project,
)
from sylpose.rig_calibration.board_checks import (
    compare_halves,
    compute_covariance,
    inflate_by_halves,
    measure_coverage,
)
from sylpose.rig_calibration.board_start import (
    SIGNIFICANT,
    CameraPoses,
    calibrate_camera,
    find_symmetries,
    link_cameras,
    place_boards,
)
from sylpose.rig_calibration.board_views import choose_frames, collect_views
from sylpose.rig_calibration.result import CalibrationRefusedError, Coverage, HalvesTest, RigCalibration

# Views of each camera that are used (choice: more add little, docs/calibrating.md).
MAX_VIEWS = 50
# Fewest views of a camera (derived: two determine a focal length, one more checks it).
MIN_VIEWS = 3
# Largest relative standard deviation of a focal length (choice: a lens that is less known is better
# calibrated again).
MAX_FOCAL_SD = 0.05
# A view with fewer inliers contradicts the others (choice).
MIN_INLIERS = 0.5
# Images that the board covered less are reported (choice).
MIN_COVERAGE = 0.5
DISTORTION_NAMES = {4: "k1", 5: "k2", 6: "p1", 7: "p2", 8: "k3"}


@dataclass(frozen=True, eq=False)
class BoardCalibration(RigCalibration):
    """Calibration of a rig of C cameras from views of a board.

    Attributes:
        coverage: where each camera saw the board.
        halves: cross-validation by halves of the frames; None if they are too few.
        delay, delay_sd: (C,) frames by which a camera's images were taken after the first camera's, and their
            standard deviations; 0 for the first.
    """

    coverage: tuple[Coverage, ...] = ()
    halves: HalvesTest | None = None
    delay: FloatArray = field(default_factory=lambda: np.zeros(0))
    delay_sd: FloatArray = field(default_factory=lambda: np.zeros(0))


def calibrate_from_boards(
    rig: Rig, board: Board, detections: Sequence[Sequence[Detection]], *, max_views: int = MAX_VIEWS
) -> BoardCalibration:
    """Calibrate a rig from a board that its cameras detected in several frames.

    Args:
        rig: C cameras, of which names, image sizes and unit are used.
        board: the board, its points in the rig's unit.
        detections: by frame, by camera; empty where a camera did not detect the board.
        max_views: views of each camera that are used, those that differ most.

    Returns:
        The calibrated rig with its covariance.

    Raises:
        TypeError, ValueError: other types, or not C detections per frame.
        CalibrationRefusedError: the views do not determine a calibration; the message names the cameras.
    """
    check_type(rig, Rig, "rig")
    check_type(board, Board, "board")
    check_integer(max_views, "max_views", minimum=MIN_VIEWS)
    rows = [check_sequence(row, "detections", len(rig), "cameras") for row in check_sequence(detections, "detections")]
    for row in rows:
        for its in row:
            check_type(its, Detection, "detections")
    views = collect_views(board, rows)
    views = views.select(choose_frames(views, len(rig), max_views))
    _check_counts(views, rig.names)
    frames, numbers = np.unique(views.frame, return_inverse=True)
    views = replace(views, frame=numbers.astype(np.int64))
    symmetries = find_symmetries(board.points, board.symmetries)
    lenses, poses = [], []
    for c, camera in enumerate(rig):
        own = views.select(views.camera == c)
        alone = replace(own, camera=np.zeros_like(own.camera), frame=np.arange(len(own.frame)))
        fit, lens = calibrate_camera(alone, camera.size)
        lens.free[:, POSE] = c > 0
        lens.free[:, DELAY] = c > 0 and own.speeds.any()
        lenses.append(lens)
        poses.append(CameraPoses(own, fit, symmetries))
    linked, groups = link_cameras(poses)
    _check_links(groups, rig.names)
    extrinsics = np.array(linked)
    boards, ways = place_boards(poses, extrinsics, len(frames))
    views = _apply_symmetries(views, board, ways)
    start = Unknowns(
        np.array([its.lens for its in poses]),
        extrinsics[:, :3, :3],
        extrinsics[:, :3, 3],
        np.zeros(len(rig)),
        boards[:, :3, :3],
        boards[:, :3, 3],
    )
    freedom = Freedom(*(np.concatenate([getattr(its, name) for its in lenses]) for name in ("free", "mean", "prior")))
    relative = np.array([its.sigma for its in poses])
    optimum = optimize(views, start, freedom, relative=relative, with_shifts=True)
    if board.diameter:
        views = _center_circles(views, optimum.at, board.diameter)
        optimum = optimize(views, optimum.at, freedom, relative=relative, with_shifts=True)
    covariance = compute_covariance(views, optimum, freedom)
    _check_focal(optimum, covariance, rig.names)
    halves = compare_halves(views, optimum, freedom)
    covariance = inflate_by_halves(covariance, halves)
    _check_focal(optimum, covariance, rig.names)
    return _make_result(rig, _Fit(views, optimum, freedom, covariance, halves))


@dataclass(frozen=True, eq=False)
class _Fit:
    """Fit of all cameras."""

    views: Views
    optimum: Optimum
    freedom: Freedom
    covariance: FloatArray
    halves: HalvesTest | None


def _check_counts(views: Views, names: Sequence[str]) -> None:
    counts = dict(zip(names, np.bincount(views.camera, minlength=len(names)).tolist(), strict=True))
    if few := {name: n for name, n in counts.items() if n < MIN_VIEWS}:
        texts = [f"{name} sees the board in {f'{n} views that differ' if n else 'no frame'}" for name, n in few.items()]
        raise CalibrationRefusedError(
            f"{'; '.join(texts)}; {MIN_VIEWS} views are required: show it the board, or leave the camera out "
            f"(--exclude-camera {next(iter(few))})"
        )


def _check_links(groups: Sequence[Sequence[int]], names: Sequence[str]) -> None:
    if len(groups) > 1:
        texts = [", ".join(names[c] for c in group) for group in groups]
        raise CalibrationRefusedError(
            f"no frame has the board in a camera of {' and one of '.join(texts)}: hold it where both see it, or calibrate "
            "them separately (--exclude-camera)"
        )


def _apply_symmetries(views: Views, board: Board, ways: dict[tuple[int, int], int]) -> Views:
    """Number the corners of each view by the orientation of the board that all views of its frame have in common."""
    pixels, seen = views.pixels.copy(), views.seen.copy()
    for v, (c, f) in enumerate(zip(views.camera.tolist(), views.frame.tolist(), strict=True)):
        way = board.symmetries[ways[c, f]]
        pixels[v, way], seen[v, way] = views.pixels[v], views.seen[v]
    return replace(views, pixels=pixels, seen=seen)


def _center_circles(views: Views, at: Unknowns, diameter: float) -> Views:
    """Replace the centroids of circles' images by the images of their centers: the nearer half looks larger."""
    circle = [project(replace(views, points=views.points + arm), at) for arm in make_circle(diameter)]
    offsets = compute_centroids(np.stack(circle, axis=2), project(views, at))
    return replace(views, pixels=views.pixels - np.where(np.isfinite(offsets), offsets, 0.0))


def _check_focal(optimum: Optimum, covariance: FloatArray, names: Sequence[str]) -> None:
    sd = np.sqrt(np.diag(covariance).reshape(len(names), N_CAMERA))
    for c, name in enumerate(names):
        ratio = float((sd[c, :2] / optimum.at.lens[c, :2]).max())
        if not ratio <= MAX_FOCAL_SD:
            raise CalibrationRefusedError(
                f"{name}: its focal length is only known to {100 * ratio:.2g} %: show it the board tilted by 30 to 45 "
                "degrees in several directions, near and far"
            )


def _make_result(rig: Rig, fit: _Fit) -> BoardCalibration:
    """Return the result in the frame of the first camera."""
    views, optimum, covariance = fit.views, fit.optimum, fit.covariance
    at, cameras, coverage, statistics = optimum.at, [], [], []
    intrinsics, extrinsics = [], []
    for c, camera in enumerate(rig):
        own = views.camera == c
        inlier = optimum.weights[own] > 0
        lengths = np.linalg.norm(optimum.residuals[own], axis=2)[inlier]
        n = int((inlier.sum(axis=1) > MIN_INLIERS * views.seen[own].sum(axis=1)).sum())
        rms = float(np.sqrt((lengths**2).mean())) if len(lengths) else np.nan
        statistics.append((n, len(lengths), rms))
        lens, n_terms = at.lens[c], 8 if fit.freedom.free[c, 9:N_LENS].any() else 5
        matrix = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1]])
        pose = RigidTransform.from_components(at.translation[c], Rotation.from_matrix(at.rotation[c]))
        cameras.append(Camera(camera.name, camera.size, matrix, lens[4 : 4 + n_terms], pose, error_px=rms))
        block = covariance[c * N_CAMERA : (c + 1) * N_CAMERA, c * N_CAMERA : (c + 1) * N_CAMERA]
        intrinsics.append(block[: 4 + n_terms, : 4 + n_terms])
        extrinsics.append(block[POSE, POSE])
        coverage.append(measure_coverage(views, optimum, camera.size, c))
    views_used, points_used, errors = (np.array(its) for its in zip(*statistics, strict=True))
    delay_sd = np.sqrt(np.diag(covariance)[DELAY::N_CAMERA])
    return BoardCalibration(
        rig=Rig(cameras, rig.unit),
        extrinsics_covariance=np.array(extrinsics),
        intrinsics_covariance=tuple(intrinsics),
        n_views=views_used,
        n_points=points_used,
        rms_px=errors,
        unobservable=tuple(_describe_unobservable(fit, rig.names)),
        warnings=tuple(_describe_problems(fit, rig.names, views_used.tolist(), coverage)),
        coverage=tuple(coverage),
        halves=fit.halves,
        delay=at.delay,
        delay_sd=delay_sd,
    )


def _describe_unobservable(fit: _Fit, names: Sequence[str]) -> list[str]:
    """Describe distortion coefficients of which the views determine little more than was known before."""
    sd, found = np.sqrt(np.diag(fit.covariance)).reshape(len(names), N_CAMERA), []
    for c, name in enumerate(names):
        prior = fit.freedom.prior[c]
        unknown = [its for k, its in DISTORTION_NAMES.items() if sd[c, k] ** 2 * prior[k] > UNOBSERVABLE_RATIO**2]
        if unknown:
            found.append(
                f"{name}: {', '.join(unknown)} {'is' if len(unknown) == 1 else 'are'} hardly determined by its views and "
                "therefore assumed small: show it the board at the borders and corners of its image."
            )
    return found


def _describe_problems(
    fit: _Fit, names: Sequence[str], n_views: Sequence[int], coverage: Sequence[Coverage]
) -> list[str]:
    """Describe what may be wrong with the calibration, each with a remedy."""
    found, views, at = [], fit.views, fit.optimum.at
    delay_sd = np.sqrt(np.diag(fit.covariance)[DELAY::N_CAMERA])
    for c, name in enumerate(names):
        own = views.camera == c
        speed = np.linalg.norm(views.speeds[own], axis=2)[views.seen[own]]
        effect = abs(at.delay[c]) * float(np.sqrt((speed**2).mean()))
        if abs(at.delay[c]) > SIGNIFICANT * delay_sd[c] and effect > fit.optimum.sigma[c]:
            order = "after" if at.delay[c] > 0 else "before"
            found.append(
                f"{name}: its images were taken {abs(at.delay[c]):.2f} ± {delay_sd[c]:.1g} frames {order} those of "
                f"{names[0]}; that is corrected here, but tracking needs synchronized cameras (sylpose sync)."
            )
        rejected = int(own.sum()) - n_views[c]
        if rejected > (1.0 - MIN_INLIERS) * int(own.sum()):
            found.append(
                f"{name}: {rejected} of its {int(own.sum())} views contradict the other cameras: it was moved, or its "
                "images are of other times."
            )
        if coverage[c].share < MIN_COVERAGE:
            found.append(
                f"{name}: the board covered only {100 * coverage[c].share:.0f} % of its image; the lens is extrapolated "
                "elsewhere: show it the board in all corners."
            )
    if fit.optimum.shift_sd > fit.optimum.sigma.max():
        found.append(
            f"All corners of a view share an error of {fit.optimum.shift_sd:.2g} px, and their noise is "
            f"{fit.optimum.sigma.max():.2g} px: images blur or are taken at different times; hold the board still in each "
            "place, or synchronize the cameras."
        )
    if fit.halves is None:
        found.append("The views are too few to compare two halves: record more, in other places and tilts.")
    elif fit.halves.is_significant.any():
        listed = ", ".join(name for name, wrong in zip(names, fit.halves.is_significant, strict=True) if wrong)
        found.append(
            f"{listed}: calibrations from two halves of the frames differ by more than their standard deviations, which "
            "were enlarged: the board is bent, the images are of different times, or the lens needs another model."
        )
    return found
