"""`sylpose pose`: solve the pose of an object with known points or markers in each frame separately."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sylpose.commands.app import ADVANCED, INPUT, OUTPUT, command, exit_with_failures, option
from sylpose.commands.options import CameraOptions, PlotFormat, Seed, StepOptions, Unit, parse_video_option
from sylpose.units import METERS

if TYPE_CHECKING:
    from sylpose.io.point_files import PointModel
    from sylpose.results import Trajectory
    from sylpose.rig import Rig
    from sylpose.runs.correspondences import FrameCorrespondences
    from sylpose.runs.page import ThumbnailAlbum
    from sylpose.runs.run_result import Run


@dataclass(frozen=True, kw_only=True)
class PoseOptions(StepOptions, CameraOptions):
    """Options of `sylpose pose`.

    Attributes:
        model: Object points (.csv: name,x,y,z; .toml; .ply, .obj) or markers (.toml).
        observations: Recording, for markers; or tables of image points: camera,frame,name,u,v, or DeepLabCut's.
        out: Write the results here.
        is_in: Set the length unit of MODEL if the file has none.
        likelihood: Ignore table points with a lower likelihood.
        max_error_px: Reject points with larger residuals: five times the largest expected noise.
    """

    model: Annotated[Path, typer.Argument(metavar="MODEL")]
    observations: Annotated[tuple[Path, ...], typer.Argument(metavar="OBSERVATIONS...", show_default=False)] = ()
    out: Annotated[Path, option("--out DIR", OUTPUT)] = Path("sylpose_pose")
    unit: Unit = None
    is_in: Annotated[str | None, option(f"--is-in {'|'.join(METERS)}", INPUT)] = None
    likelihood: Annotated[float, option("--likelihood P", ADVANCED, min=0, max=1)] = 0.6
    # Points with a larger residual are outliers for any noise: five times two and a half pixels (choice).
    max_error_px: Annotated[float, option("--max-error PX", ADVANCED)] = 12.0
    plot_format: PlotFormat = "png"
    seed: Seed = 0

    def __post_init__(self) -> None:
        """Check the largest residual."""
        super().__post_init__()
        if not (math.isfinite(self.max_error_px) and self.max_error_px > 0):
            raise ValueError(f"--max-error must be a number of pixels, got {self.max_error_px}")


@command("Solve poses from known object points or markers.")
def pose(options: PoseOptions) -> None:
    """Solve the pose of an object with known points, robustly, in each frame separately (multi-camera PnP).

    The points are those of a CAD model or a marker layout, in the object's frame. Their image positions come from
    tables (manual or network annotation), or markers on the object (AprilTags, ArUco) are detected in a recording.
    Writes trajectory.tum, trajectory.csv (status, uncertainty, inliers and residuals per camera), report.png,
    report.html and the settings of the run (settings.toml).

    Examples:
        sylpose pose cube.toml recording --out cube
        sylpose pose skull.csv pixels.csv --calibration rig.toml --rate 100 --out skull
        sylpose pose skull.csv cam_0DLC.csv cam_1DLC.csv --calibration rig.toml --is-in mm
    """
    from sylpose.runs.console_output import select_solved_frames

    trajectory = solve_poses(options).trajectory
    if not select_solved_frames(trajectory):
        statuses = [frame.status for frame in trajectory]
        why = f" {max(statuses, key=statuses.count).text}" if statuses else ""
        exit_with_failures([f"the object was not found in any frame.{why}"])


def solve_poses(options: PoseOptions) -> Run:
    """Solve the pose in each frame, write the trajectory and its report, and print a summary.

    Raises:
        FileNotFoundError, ValueError, OSError: files; a model without matching points or markers; numbers out of range.
    """
    import numpy as np

    from sylpose.absolute_pose.pose import estimate_pose, make_frame_pose
    from sylpose.io.point_files import load_points
    from sylpose.report.files import TrajectoryWriter
    from sylpose.results import FramePose, Trajectory
    from sylpose.runs import console_output
    from sylpose.runs.results_folder import ResultsFolder, lock_folder
    from sylpose.runs.run_metadata import SETTINGS, read_settings, settings_table
    from sylpose.runs.run_result import Run, StageTimer

    out, clock, console = options.out, StageTimer(), console_output.make_console()
    poses, results = list[FramePose](), ResultsFolder(out)
    with ExitStack() as stack:
        with clock.measure("looking"):
            model = load_points(options.model)
            if (out / SETTINGS).exists() and "model" not in settings_table(read_settings(out), "options"):
                raise ValueError(f"{out}: contains the results of a run; choose another folder with --out DIR")
            is_recording = len(options.observations) == 1 and options.observations[0].is_dir()
            found = _open_recording(options, model) if is_recording else _open_tables(options, model)
            rig, warnings = found.rig, found.warnings
            console_output.print_warnings(console, warnings)
            stack.enter_context(lock_folder(out))
            results.move_earlier_results()
            stack.push(lambda error, *_: results.restore_earlier_results() if error is not None and not poses else None)
            files = found.write_metadata()
            with console.status("Solving poses ..."), TrajectoryWriter(out, rig.names, rig.unit) as writer:
                for frame in found.frames:
                    solved = estimate_pose(
                        rig, frame.points, frame.pixels, max_error_px=options.max_error_px, seed=options.seed
                    )
                    counts = np.array([len(p) for p in frame.pixels], np.int64)
                    poses.append(make_frame_pose(solved, frame.number, frame.time, counts))
                    writer.write(poses[-1])
            if faults := Counter(fault for pose in poses for fault in pose.faults):
                fault, count = faults.most_common(1)[0]
                warnings = [f"in {count} of {len(poses)} frames {fault}", *warnings]
                console_output.print_warnings(console, warnings[:1])
        trajectory = Trajectory(poses, rig.names, rig.unit)
        with clock.measure("plots"):
            reports = _write_reports(options, found, trajectory, warnings) if poses else []
        files = [writer.tum_path, writer.csv_path, *reports, *files]
        results.end()
    run = Run({"object": trajectory}, tuple(files), (), clock.seconds)
    console_output.print_summary(console, run, len(poses))
    console_output.print_page_hint(console, run.files)
    return run


@dataclass(frozen=True)
class _PoseInput:
    """Correspondences to solve.

    Attributes:
        rig: the cameras.
        source: file or folder that the report names.
        frames: correspondences by frame.
        warnings: warnings about them.
        write_metadata: writes the settings of the run and returns the files.
        album: images for the report page; None without.
    """

    rig: Rig
    source: Path
    frames: Iterable[FrameCorrespondences]
    warnings: list[str]
    write_metadata: Callable[[], list[Path]]
    album: ThumbnailAlbum | None = field(default=None)


def _common_settings(options: PoseOptions) -> dict[str, object]:
    from sylpose.runs.run_metadata import file_checksum

    chosen = {name: getattr(options, name) for name in ("is_in", "max_error_px", "seed")}
    return {"model": str(options.model.resolve()), "model_checksum": file_checksum(options.model), **chosen}


def _open_recording(options: PoseOptions, model: PointModel) -> _PoseInput:
    """Open a recording in which markers are detected."""
    from sylpose.runs.check import find_session_warnings
    from sylpose.runs.correspondences import detect_in_recording, find_markers
    from sylpose.runs.page import ThumbnailAlbum
    from sylpose.runs.results_folder import check_output_folder
    from sylpose.runs.run_metadata import write_run_metadata
    from sylpose.runs.world import apply_world_and_unit
    from sylpose.sync.offsets import apply_offsets, find_offsets

    (path,) = options.observations
    session = apply_world_and_unit(options.open_recording(path), None, options.unit)
    check_output_folder(session, options.out)
    offsets = find_offsets(session)
    session = apply_offsets(session, offsets)
    layout = find_markers(model, options.model, session.rig, options.is_in)
    warnings = find_session_warnings(session)
    if layout.inward_markers:
        ids = ", ".join(map(str, layout.inward_markers))
        warnings.append(
            f"marker {ids} faces inwards: check that its corners are clockwise as printed, or x right and y up"
        )
    album, span = ThumbnailAlbum(len(session.rig)), (options.start, options.stop, options.every)
    frames = detect_in_recording(session, layout, span, album)
    settings = _common_settings(options) | dict(zip(("start", "stop", "every"), span, strict=True))
    settings["offsets"] = dict(offsets) or None
    metadata_writer = partial(write_run_metadata, options.out, session, settings, warnings)
    return _PoseInput(session.rig, path, frames, warnings, metadata_writer, album)


def _open_tables(options: PoseOptions, model: PointModel) -> _PoseInput:
    """Read tables of image points."""
    from sylpose.io import calibration
    from sylpose.runs.correspondences import find_points, read_tables
    from sylpose.runs.run_metadata import write_table_run_metadata

    if options.exclude_camera:
        raise ValueError("--exclude-camera: only for recordings; with tables, omit those of the camera")
    if options.calibration is None:
        raise ValueError("--calibration FILE is required for tables of pixels")
    rig = calibration.load(options.calibration)
    rig = rig if options.unit is None else rig.in_unit(options.unit)
    model = find_points(model, options.model, rig, options.is_in)
    file_by_camera = parse_video_option(options.video)
    frames, warnings = read_tables(model, options.observations, rig, file_by_camera, options.rate, options.likelihood)
    tables = [*options.observations, *map(Path, (file_by_camera or {}).values())]
    settings = _common_settings(options) | {"rate": options.rate, "likelihood": options.likelihood}
    metadata_writer = partial(
        write_table_run_metadata, options.out, tables, options.calibration, rig, settings, warnings
    )
    source = options.observations[0] if options.observations else options.calibration
    return _PoseInput(rig, source, frames, warnings, metadata_writer)


def _write_reports(options: PoseOptions, found: _PoseInput, trajectory: Trajectory, warnings: list[str]) -> list[Path]:
    """Write the plot and the page of the trajectory."""
    from sylpose import __version__
    from sylpose.input_limits import MAX_TABLE_BYTES
    from sylpose.report.plots import save_trajectory_plot
    from sylpose.report.scene import Thumbnails
    from sylpose.runs.page import write_report_page

    plot = options.out / f"report.{options.plot_format}"
    note = f"{found.source.resolve().name}, by {options.model.name}, sylpose {__version__}"
    save_trajectory_plot(trajectory, plot, note=note, input_warnings=warnings)
    if (options.out / "trajectory.csv").stat().st_size > MAX_TABLE_BYTES:
        return [plot]
    return [plot, write_report_page(options.out, Thumbnails() if found.album is None else found.album.stills())]
