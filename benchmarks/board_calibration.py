"""Calibration from a board against OpenCV's: errors of simulated rigs with known truth, and honesty of the covariances.

    python benchmarks/board_calibration.py [--seeds 100:108] [--cameras 3] [--frames 40] [--json FILE]

Each rig is an arc of cameras with lens distortion, 25 degrees apart, 1 m from a ChArUco board of 24 corners that is drawn in
random poses; all methods get the same corners. Kinds:

- *noise*: independent noise of 0.2 px.
- *outliers*: in addition, 2 % of the corners are displaced by some 30 px.
- *blur*: all corners of a view share a displacement of 0.3 px, besides noise of 0.1 px.
- *few*: independent noise, 12 frames.

Methods: *sylpose*; *stereo*: cv2.calibrateCamera for each camera, then cv2.stereoCalibrate of each camera with the first,
with these lenses or refining them; *multiview*: cv2.calibrateMultiview, where this OpenCV has it, with the views that have
all corners (with others most runs end beyond 15 px).

Errors are those of cameras 1 and up relative to camera 0: rotation in degrees, center in millimeters; focal length of all
cameras in percent; medians over cameras and seeds, and the largest. *Ratio* is the error (rms over all) relative to
sylpose's, as the geometric mean of rotation, center and focal length. *NEES*: squared error of the pose over its covariance,
per unknown: 1 is honest. *Failed*: runs without a result, or with a rotation 5 degrees and more off.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.boards.detection import Detection
from sylpose.boards.specification import Board, parse_board
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Camera, Rig, make_look_at_camera
from sylpose.rig_calibration.from_boards import calibrate_from_boards
from sylpose.rig_calibration.result import CalibrationRefusedError

SIZE = (1280, 720)
BOARD = "charuco:5x7,square=40mm,marker=30mm,dict=4X4_50"
KINDS = ("noise", "outliers", "blur", "few")
# A calibration that is off by more has failed, degrees (choice).
MAX_ROTATION_DEG = 5.0
_cv2: Any = cv2


@dataclass(frozen=True, eq=False)
class Found:
    """Rig in the frame of its first camera, and the covariances of its poses if known."""

    rig: Rig
    covariance: FloatArray | None = None


def draw_scene(kind: str, seed: int, n_cameras: int, n_frames: int) -> tuple[Rig, Board, list[list[Detection]]]:
    """Draw a rig in the frame of its first camera, and detections of a board by frame and camera."""
    rng, board = np.random.default_rng(seed), parse_board(BOARD, "m")
    cameras, middle = [], board.points.mean(axis=0)
    for c in range(n_cameras):
        angle = np.radians(25.0 * (c - (n_cameras - 1) / 2))
        center = np.array([np.sin(angle), rng.normal(0, 0.05), -np.cos(angle)])
        lens = np.array([-0.25, 0.08, 0.001, -0.0008, 0.01]) * rng.uniform(0.5, 1.2)
        camera = make_look_at_camera(f"cam_{c}", center, np.zeros(3), rng.uniform(750, 950), SIZE, lens)
        matrix = camera.matrix + np.array(
            [[0, 0, rng.normal(0, 8)], [0, rng.normal(0, 2), rng.normal(0, 8)], [0, 0, 0]]
        )
        cameras.append(replace(camera, matrix=matrix))
    rig, detections = Rig(cameras, "m"), []
    for _ in range(12 if kind == "few" else n_frames):
        axis = rng.normal(size=3) * [1, 1, 0.5]
        tilt = Rotation.from_rotvec(axis / np.linalg.norm(axis) * np.radians(rng.uniform(0, 45)))
        rotation = tilt * Rotation.from_rotvec([np.pi, 0, 0])
        place = rng.uniform([-0.35, -0.25, -0.3], [0.35, 0.25, 0.3]) - rotation.apply(middle)
        pose = RigidTransform.from_components(place, rotation)
        detections.append([_detect(camera, board, pose, kind, rng) for camera in rig])
    return rig.in_world(rig[0].camera_from_world), board, detections


def _detect(camera: Camera, board: Board, pose: RigidTransform, kind: str, rng: np.random.Generator) -> Detection:
    points = pose.apply(board.points).reshape(-1, 3)
    pixels = camera.project(points)
    sight = camera.center - points.mean(axis=0)
    if pose.rotation.apply([0, 0, 1]) @ sight < 0.2 * np.linalg.norm(sight):
        return Detection()
    pixels = pixels + rng.normal(0, 0.1 if kind == "blur" else 0.2, pixels.shape)
    if kind == "blur":
        pixels = pixels + rng.normal(0, 0.3, 2)
    if kind == "outliers":
        pixels = pixels + (rng.random(len(pixels)) < 0.02)[:, None] * rng.normal(0, 30, pixels.shape)
    inside = (np.isfinite(pixels) & (pixels > 0) & (pixels < SIZE)).all(axis=1)
    return Detection(np.flatnonzero(inside), pixels[inside]) if inside.sum() >= 6 else Detection()


def run_sylpose(rig: Rig, board: Board, detections: list[list[Detection]]) -> Found:
    """Calibrate with `calibrate_from_boards`."""
    found = calibrate_from_boards(rig, board, detections)
    return Found(found.rig, found.extrinsics_covariance)


def run_stereo_chain(rig: Rig, board: Board, detections: list[list[Detection]], flags: int) -> Found:
    """Calibrate each camera, then each with the first, by OpenCV."""
    lenses = []
    for c in range(len(rig)):
        views = [row[c] for row in detections if len(row[c].indices)]
        points = [board.points[its.indices].astype(np.float32) for its in views]
        pixels = [its.pixels.astype(np.float32) for its in views]
        lenses.append(_cv2.calibrateCamera(points, pixels, SIZE, None, None)[1:3])
    poses = [RigidTransform.identity()]
    for c in range(1, len(rig)):
        points = []
        sides: tuple[list[FloatArray], list[FloatArray]] = ([], [])
        for row in detections:
            common, i, j = np.intersect1d(row[0].indices, row[c].indices, return_indices=True)
            if len(common) >= 6:
                points.append(board.points[common].astype(np.float32))
                sides[0].append(row[0].pixels[i].astype(np.float32))
                sides[1].append(row[c].pixels[j].astype(np.float32))
        arguments = (points, *sides, *lenses[0], *lenses[c], SIZE)
        rotation, translation = _cv2.stereoCalibrate(*arguments, flags=flags)[5:7]
        poses.append(RigidTransform.from_components(translation.ravel(), Rotation.from_matrix(rotation)))
    return Found(_make_rig(rig, lenses, poses))


def run_multiview(rig: Rig, board: Board, detections: list[list[Detection]]) -> Found:
    """Calibrate all cameras by OpenCV's calibrateMultiview."""
    n, n_frames = len(rig), len(detections)
    mask = np.array([[len(row[c].indices) == len(board.points) for row in detections] for c in range(n)], np.uint8)
    pixels = []
    for c in range(n):
        views = []
        for row in detections:
            where = np.full((len(board.points), 2), -1.0, np.float32)
            where[row[c].indices] = row[c].pixels
            views.append(where)
        pixels.append(views)
    points = [board.points.astype(np.float32)] * n_frames
    sizes = [SIZE] * n
    out = _cv2.calibrateMultiview(points, pixels, sizes, mask, np.zeros(n, np.uint8), None, None, None, None)
    _, matrices, distortions, rotations, translations = out
    poses = [
        RigidTransform.from_components(
            np.ravel(t), Rotation.from_rotvec(np.ravel(r)) if np.size(r) == 3 else Rotation.from_matrix(np.asarray(r))
        )
        for r, t in zip(rotations, translations, strict=True)
    ]
    poses = [pose * poses[0].inv() for pose in poses]
    return Found(_make_rig(rig, list(zip(matrices, distortions, strict=True)), poses))


def _make_rig(rig: Rig, lenses: list[tuple[FloatArray, FloatArray]], poses: list[RigidTransform]) -> Rig:
    return Rig(
        [
            replace(camera, matrix=np.asarray(matrix), distortion=np.ravel(k)[:5], camera_from_world=pose)
            for camera, (matrix, k), pose in zip(rig, lenses, poses, strict=True)
        ],
        rig.unit,
    )


METHODS: dict[str, Callable[[Rig, Board, list[list[Detection]]], Found]] = {
    "sylpose": run_sylpose,
    "stereo, lenses fixed": partial(run_stereo_chain, flags=cv2.CALIB_FIX_INTRINSIC),
    "stereo, lenses refined": partial(run_stereo_chain, flags=cv2.CALIB_USE_INTRINSIC_GUESS),
}
if hasattr(cv2, "calibrateMultiview"):
    METHODS["multiview"] = run_multiview


def measure(found: Found, truth: Rig) -> dict[str, list[float]]:
    """Return errors of poses (cameras 1 and up) and focal lengths, and NEES if a covariance is known."""
    rotation, center, nees = [], [], []
    for c, (a, b) in enumerate(zip(found.rig, truth, strict=True)):
        if c:
            error = a.camera_from_world.rotation * b.camera_from_world.rotation.inv()
            d = a.camera_from_world.translation - b.camera_from_world.translation
            rotation.append(float(np.degrees(error.magnitude())))
            center.append(1e3 * float(np.linalg.norm(a.center - b.center)))
            if found.covariance is not None:
                e = np.concatenate([error.as_rotvec(), d])
                nees.append(float(e @ np.linalg.solve(found.covariance[c], e) / 6))
    focal = [100 * abs(a.focal / b.focal - 1) for a, b in zip(found.rig, truth, strict=True)]
    return {"rotation": rotation, "center": center, "focal": focal, "nees": nees}


def run_kind(kind: str, seeds: range, n_cameras: int, n_frames: int) -> list[dict[str, Any]]:
    """Run all methods on one kind of scene; return a row of figures per method."""
    errors: dict[str, dict[str, list[float]]] = {
        name: {key: [] for key in ("rotation", "center", "focal", "nees")} for name in METHODS
    }
    failed, seconds = dict.fromkeys(METHODS, 0), dict.fromkeys(METHODS, 0.0)
    for seed in seeds:
        truth, board, detections = draw_scene(kind, seed, n_cameras, n_frames)
        for name, method in METHODS.items():
            start = time.perf_counter()
            try:
                figures = measure(method(truth, board, detections), truth)
            except (CalibrationRefusedError, cv2.error, ValueError):
                failed[name] += 1
                continue
            seconds[name] += time.perf_counter() - start
            if max(figures["rotation"]) > MAX_ROTATION_DEG:
                failed[name] += 1
                continue
            for key, values in figures.items():
                errors[name][key] += values
    rows = []
    for name, its in errors.items():
        row: dict[str, Any] = {"kind": kind, "method": name, "failed": failed[name]}
        row["seconds"] = seconds[name] / max(len(seeds) - failed[name], 1)
        for key in ("rotation", "center", "focal"):
            column = np.array(its[key] or [np.nan])
            row[key], row[f"{key}_max"] = float(np.median(column)), float(column.max())
            row[f"{key}_rms"] = float(np.sqrt((column**2).mean()))
        row["nees"] = float(np.mean(its["nees"])) if its["nees"] else None
        rows.append(row)
    for row in rows:
        ratios = [row[f"{key}_rms"] / rows[0][f"{key}_rms"] for key in ("rotation", "center", "focal")]
        row["ratio"] = float(np.exp(np.mean(np.log(ratios))))
    return rows


def format_row(row: dict[str, Any]) -> str:
    """Format a row of the Markdown table."""
    cells = [row["kind"], row["method"]]
    cells += [f"{row[key]:.3g} / {row[f'{key}_max']:.3g}" for key in ("rotation", "center", "focal")]
    cells += [f"{row['ratio']:.2f}", "-" if row["nees"] is None else f"{row['nees']:.2f}"]
    cells += [str(row["failed"]), f"{row['seconds']:.1f}"]
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Run the benchmark and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="100:108")
    parser.add_argument("--cameras", type=int, default=3)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    first, last = map(int, options.seeds.split(":"))
    print("| kind | method | rotation, deg | center, mm | focal, % | ratio | NEES | failed | seconds |")
    print("|---|---|---|---|---|---|---|---|---|")
    rows = []
    for kind in KINDS:
        for row in run_kind(kind, range(first, last), options.cameras, options.frames):
            print(format_row(row), flush=True)
            rows.append(row)
    if options.json is not None:
        options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
