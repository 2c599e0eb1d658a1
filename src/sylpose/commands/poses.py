"""`sylpose pose`: solve the pose of an object with known points or markers in each frame separately."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, closing
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sylpose import __version__
from sylpose.absolute_pose.pose import estimate_pose
from sylpose.absolute_pose.pose_frame import make_frame_pose
from sylpose.boards.detection import detect_markers
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.input_limits import MAX_TABLE_BYTES, input_errors
from sylpose.io import calibration
from sylpose.io.capture import Session
from sylpose.io.pixel_files import load_image_points
from sylpose.io.point_files import MarkerLayout, PointModel, load_points
from sylpose.report.files import TrajectoryWriter
from sylpose.report.formats import PICTURE_FORMATS
from sylpose.report.plots import plot_trajectory
from sylpose.report.scene import Thumbnails
from sylpose.results import FramePose, Trajectory
from sylpose.rig import Camera, Rig
from sylpose.runs import console_output
from sylpose.runs.page import write_report_page
from sylpose.runs.results_folder import ResultsFolder, lock_folder
from sylpose.runs.run import Run
from sylpose.runs.run_metadata import (
    SETTINGS,
    file_checksum,
    read_settings,
    settings_table,
    write_run_metadata,
    write_table_run_metadata,
)
from sylpose.runs.session_options import check_output_folder, open_recording, parse_video_option
from sylpose.runs.session_warnings import find_session_warnings
from sylpose.runs.thumbnails import ThumbnailAlbum
from sylpose.sync.offsets import apply_offsets, find_offsets

__all__ = ["MAX_ERROR_PX", "run_pose_command"]

# Points with a larger residual are outliers for any noise: five times two and a half pixels (choice).
MAX_ERROR_PX = 12.0
# Number of unmatched names that a message lists (choice).
MAX_LISTED_NAMES = 5


class FrameCorrespondences(NamedTuple):
    """Correspondences of one frame: by camera, object points (n, 3) and their pixels (n, 2)."""

    number: int
    time: float
    points: list[FloatArray]
    pixels: list[FloatArray]


def run_pose_command(
    model: Path,
    inputs: Sequence[Path],
    out: Path,
    *,
    calibration_file: Path | None = None,
    cameras: Sequence[str] | None = None,
    without: Sequence[str] | None = None,
    unit: str | None = None,
    is_in: str | None = None,
    rate: float | None = None,
    likelihood: float,
    max_error_px: float = MAX_ERROR_PX,
    start: int = 0,
    stop: int | None = None,
    every: int = 1,
    plot_format: str = "png",
    seed: int = 0,
) -> Run:
    """Solve the pose in each frame, write the trajectory and its report, and print a summary.

    Args:
        model: points or markers (`load_points`).
        inputs: tables of image points (`load_image_points`), or the folder of one recording, for markers.
        out: folder for the files.
        calibration_file: a calibration; None for that of the recording.
        cameras: NAME=FILE, for files whose names do not match a camera.
        without: cameras of a recording that are excluded.
        unit: length unit of the results.
        is_in: length unit of the model if its file has none.
        rate: frames per second if neither the tables nor the recording have times.
        likelihood: table points with a lower likelihood are ignored.
        max_error_px: see `estimate_pose`.
        start, stop, every: frames of a recording.
        plot_format: suffix of the report plot.
        seed: random seed of the robust estimation.

    Returns:
        The trajectory and the files written.

    Raises:
        FileNotFoundError, ValueError, OSError: files; a model without matching points or markers; numbers out of range.
    """
    if plot_format not in PICTURE_FORMATS:
        raise ValueError(f"--format must be one of {', '.join(PICTURE_FORMATS)}, got {plot_format!r}")
    if not (np.isfinite(max_error_px) and max_error_px > 0):
        raise ValueError(f"--max-error must be a number of pixels, got {max_error_px}")
    known, started, console = load_points(model), time.monotonic(), console_output.make_console()
    if (out / SETTINGS).exists() and "model" not in settings_table(read_settings(out), "options"):
        raise ValueError(f"{out}: contains the results of a run; choose another folder with --out DIR")
    warnings, album = list[str](), None
    frames: Iterable[FrameCorrespondences]
    options: dict[str, object] = {"model": str(model.resolve()), "model_checksum": file_checksum(model), "is_in": is_in}
    options |= {"max_error_px": max_error_px, "seed": seed}
    if len(inputs) == 1 and inputs[0].is_dir():
        session = open_recording(inputs[0], calibration_file, None, None, None, cameras, rate, unit, without=without)
        check_output_folder(session, out)
        offsets = find_offsets(session)
        session = apply_offsets(session, [offsets.get(name, 0.0) for name in session.rig.names])
        rig, source, album = session.rig, inputs[0], ThumbnailAlbum(len(session.rig))
        layout = _require_markers(known, model, rig, is_in)
        warnings += find_session_warnings(session)
        if layout.inward_markers:
            marker_ids = ", ".join(map(str, layout.inward_markers))
            warnings.append(
                f"marker {marker_ids} faces inwards: check that its corners are clockwise as printed, or x right and y "
                "up"
            )
        frames = _detect_in_recording(session, layout, start, stop, every, album)
        options |= {"start": start, "stop": stop, "every": every, "offsets": dict(offsets) or None}
        metadata_writer = partial(write_run_metadata, out, session, options, warnings)
    else:
        if without:
            raise ValueError("--exclude-camera: only for recordings; with tables, omit those of the camera")
        if calibration_file is None:
            raise ValueError("--calibration FILE is required for tables of pixels")
        rig, source = calibration.load(calibration_file), calibration_file if not inputs else inputs[0]
        rig = rig if unit is None else rig.in_unit(unit)
        known = _convert_unit(known, model, rig, is_in)
        if not known.points:
            raise ValueError(f"{model}: it has markers, which require a recording, and no named points")
        tables = [*inputs, *map(Path, (parse_video_option(cameras) or {}).values())]
        frames = _read_tables(known, inputs, rig, cameras, rate, likelihood, warnings)
        options |= {"rate": rate, "likelihood": likelihood}
        metadata_writer = partial(write_table_run_metadata, out, tables, calibration_file, rig, options, warnings)
    console_output.print_warnings(console, warnings)
    poses, results = list[FramePose](), ResultsFolder(out)
    with ExitStack() as stack:
        stack.enter_context(lock_folder(out))
        results.move_earlier_results()
        stack.push(lambda error, *_: results.restore_earlier_results() if error is not None and not poses else None)
        files = metadata_writer()
        with console.status("Solving poses ..."), TrajectoryWriter(out, rig.names, rig.unit) as writer:
            for frame in frames:
                found = estimate_pose(rig, frame.points, frame.pixels, max_error_px=max_error_px, seed=seed)
                poses.append(
                    make_frame_pose(found, frame.number, frame.time, np.array([len(p) for p in frame.pixels], np.int64))
                )
                writer.write(poses[-1])
        if faults := Counter(fault for pose in poses for fault in pose.faults):
            fault, count = faults.most_common(1)[0]
            warnings = [f"in {count} of {len(poses)} frames {fault}", *warnings]
            console_output.print_warnings(console, warnings[:1])
        trajectory, solved_time = Trajectory(poses, rig.names, rig.unit), time.monotonic()
        files = [writer.tum_path, writer.csv_path, *files]
        if poses:
            note = f"{source.resolve().name}, by {model.name}, sylpose {__version__}"
            plot_trajectory(trajectory, out / f"report.{plot_format}", note=note, input_warnings=warnings)
            files.insert(2, out / f"report.{plot_format}")
            if writer.csv_path.stat().st_size <= MAX_TABLE_BYTES:
                files.insert(3, write_report_page(out, Thumbnails() if album is None else album.stills()))
        results.end()
    seconds = {"looking": solved_time - started, "plots": time.monotonic() - solved_time}
    run = Run({"object": trajectory}, tuple(files), (), seconds)
    console_output.print_summary(console, run, len(poses))
    return run


def _convert_unit(known: PointModel, model: Path, rig: Rig, is_in: str | None) -> PointModel:
    with input_errors(model):
        return known.in_unit(rig.unit, is_in)


def _require_markers(known: PointModel, model: Path, rig: Rig, is_in: str | None) -> MarkerLayout:
    layout = _convert_unit(known, model, rig, is_in).markers
    if layout is None:
        raise ValueError(f"{model}: it has no markers to detect in a recording; its points require tables of pixels")
    return layout


def _detect_in_recording(
    session: Session, layout: MarkerLayout, start: int, stop: int | None, every: int, album: ThumbnailAlbum
) -> Iterator[FrameCorrespondences]:
    with closing(
        session.frames(start, stop, every, lambda sentence: console_output.print_to_stderr(sentence))
    ) as frames:
        for frame_set in frames:
            album.put(frame_set)
            detections = [
                _detect_markers(image, camera, layout)
                for image, camera in zip(frame_set.images, session.rig, strict=True)
            ]
            yield FrameCorrespondences(
                frame_set.index,
                frame_set.time,
                [points for points, _ in detections],
                [pixels for _, pixels in detections],
            )


def _detect_markers(image: Image | None, camera: Camera, layout: MarkerLayout) -> tuple[FloatArray, FloatArray]:
    """Detect the object's markers in an image; return their corners (n, 3) and pixels (n, 2)."""
    if image is None:
        return np.empty((0, 3)), np.empty((0, 2))
    numbers, pixels, _ = detect_markers(image, camera, layout.marker, layout.corners)
    points = np.array([layout.corners[number] for number in numbers.tolist()])
    return points.reshape(-1, 3), pixels.reshape(-1, 2)


def _read_tables(
    known: PointModel,
    files: Sequence[Path],
    rig: Rig,
    cameras: Sequence[str] | None,
    rate: float | None,
    likelihood: float,
    warnings: list[str],
) -> list[FrameCorrespondences]:
    tables = load_image_points(files, rig.names, parse_video_option(cameras), likelihood)
    if rate is not None and not (np.isfinite(rate) and rate > 0):
        raise ValueError(f"--rate must be a number of frames per second, got {rate}")
    if rate is not None and tables.times:
        raise ValueError("--rate: the tables have times")
    if not any(name in known.points for name in tables.names):
        raise ValueError(
            f"none of the tables' points ({_list_names(tables.names)}) is a point of the object "
            f"({_list_names([*known.points])})"
        )
    if unknown := [name for name in tables.names if name not in known.points]:
        count_text = f"{len(unknown)} points of the tables are" if len(unknown) > 1 else "1 point of the tables is"
        warnings.append(f"{count_text} not in the object model: {_list_names(unknown)}")
    out = []
    for frame in tables.frames:
        points, pixels = [], []
        for name in rig.names:
            pixel_by_name = {n: at for n, at in tables.pixels.get((frame, name), {}).items() if n in known.points}
            points.append(np.array([known.points[n] for n in pixel_by_name]).reshape(-1, 3))
            pixels.append(np.array([*pixel_by_name.values()]).reshape(-1, 2))
        out.append(
            FrameCorrespondences(frame, tables.times.get(frame, frame / rate if rate else float(frame)), points, pixels)
        )
    if any(b.time <= a.time for a, b in pairwise(out)):
        raise ValueError(f"{files[0] if files else cameras}: times do not increase from frame to frame")
    return out


def _list_names(names: Sequence[str]) -> str:
    return ", ".join(names[:MAX_LISTED_NAMES]) + (", ..." if len(names) > MAX_LISTED_NAMES else "")
