"""`sylpose calibrate`: calibrate a rig from a recording."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sylpose.commands.app import INPUT, OUTPUT, command, exit_with_failures, option
from sylpose.commands.options import BoxesFile, FrameOffset, SourceOptions, parse_frame_offsets, parse_video_option
from sylpose.commands.self_calibration import SelfCalibrationOptions, calibrate_recording
from sylpose.input_limits import print_message

if TYPE_CHECKING:
    from sylpose.io.capture import Session


FILE = "calibration.toml"


@dataclass(frozen=True, kw_only=True)
class CalibrateOptions(SelfCalibrationOptions, SourceOptions):
    """Options of `sylpose calibrate`.

    Attributes:
        session: Folder with one video (cam_0.mp4) or one folder of images per camera.
        board: Calibrate from this board, such as charuco:5x7,square=40mm; of a ChArUco board, marker and dict are found if
            missing.
        every: Use every N-th frame, with a board.
        boxes: Without a board: read the object's boxes in the first frame from this file; default: boxes.toml in SESSION,
            else what moves.
        video: Assign a video or image folder to a camera, instead of all in SESSION. Repeatable.
        unit: Set the length unit of the calibration; default: that of the board or of the known length.
        out: Write the calibration here; default: SESSION/calibration.toml if that does not exist.
    """

    session: Annotated[Path, typer.Argument(metavar="SESSION")]
    boxes: BoxesFile = None
    frame_offset: FrameOffset = ()
    out: Annotated[Path | None, option("--out FILE", OUTPUT)] = None
    board: Annotated[str | None, option("--board BOARD", INPUT)] = None
    every: Annotated[int, option("--every N", INPUT, min=1)] = 1

    def __post_init__(self) -> None:
        """Check the options of both routes."""
        super().__post_init__()
        if self.board is not None:
            self.refuse_motion_options("not with --board, whose views give lenses and scale")
            if self.offsets is not None:
                raise ValueError("--offsets: not with --board; the delays of the cameras are estimated")
        elif not self.intrinsics and self.fov is None:
            raise ValueError(
                "--board: a description of the board is missing, or --intrinsics or --fov (degrees, or exif for "
                "photographs), to calibrate without a board"
            )
        elif self.every > 1:
            raise ValueError("--every: only with --board; tracking needs all frames")

    @property
    def file(self) -> Path:
        """Return the file to write; an existing one is replaced only if it was named."""
        if self.out is not None:
            return self.out
        if (file := self.session / FILE).exists():
            raise ValueError(f"{file} exists; name the file to write with --out FILE")
        return file

    def open_with_lenses(self) -> Session:
        """Open the recording with the intrinsics."""
        from sylpose.io.calibration.lenses import parse_fov, parse_lens_files
        from sylpose.io.capture import open_session

        lenses, fov = parse_lens_files(self.intrinsics), parse_fov(self.fov)
        return open_session(self.session, boxes=self.boxes, lenses=lenses, fov=fov, **self._sources)

    def open_uncalibrated(self) -> Session:
        """Open the recording without a calibration."""
        from sylpose.io.capture.session import open_uncalibrated

        return open_uncalibrated(self.session, **self._sources)

    @property
    def _sources(self) -> dict[str, Any]:
        return {
            "cameras": parse_video_option(self.video),
            "offsets": parse_frame_offsets(self.frame_offset),
            "rate": self.rate,
            "without": self.exclude_camera,
            "take": self.take,
        }


@command("Calibrate the cameras from a recording of a board or of any moving object.")
def calibrate(options: CalibrateOptions) -> None:
    """Calibrate all cameras from a recording in which a calibration board, or any rigid object, is carried about.

    Lenses, places and orientations of all cameras are estimated together, with standard deviations. Each camera must see
    the board, tilted in several directions, and share views of it with another one. Writes the calibration, and a
    page with coverage, residuals and cross-validation next to it. Exit code 1, and no file, if the views
    do not determine a calibration.

    Without a board, any rigid object that moves is enough: each camera tracks it alone, and its motion, which all cameras
    share, gives their poses. Rotate it about several axes and carry it about.

    Examples:
        sylpose calibrate recording --board charuco:5x7,square=40mm,marker=30mm,dict=4X4_50
        sylpose calibrate recording --board chessboard:9x6,square=25mm --every 3 --out rig.toml
        sylpose calibrate recording --intrinsics lenses.toml --distance cam_0:cam_1=1.52m --out rig.toml
    """
    from rich.progress import Progress

    from sylpose.atomic_io import make_output_folder
    from sylpose.boards.specification import parse_board
    from sylpose.rig_calibration.result import CalibrationRefusedError
    from sylpose.runs import calibrate as runs
    from sylpose.runs import calibration_page, console_output

    if options.board is None:
        _calibrate_without_board(options)
        return
    file, session = options.file, options.open_uncalibrated()
    text = runs.complete_board(session, options.board, options.start, options.stop)
    unit = runs.choose_unit(text, options.unit)
    board = parse_board(text, unit)
    make_output_folder(file.parent)
    console, stderr = console_output.make_console(), console_output.make_console(stderr=True)
    console.print(console_output.format_headline(session))
    if text != options.board:
        console.print(f"Board: {text}", highlight=False)
    problems = [*session.warnings]
    last = session.n_frames if options.stop is None else min(options.stop, session.n_frames)
    with Progress(console=stderr, transient=True, disable=not stderr.is_terminal) as bar:
        task = bar.add_task("Detecting the board", total=len(range(options.start, last, options.every)))
        try:
            calibration = runs.calibrate_session(
                session,
                board,
                unit=unit,
                start=options.start,
                stop=options.stop,
                every=options.every,
                on_problem=problems.append,
                on_frame=lambda: bar.advance(task),
            )
        except CalibrationRefusedError as error:
            console_output.print_warnings(console, problems)
            exit_with_failures([f"{error}; nothing was written"])
        except KeyboardInterrupt:
            raise KeyboardInterrupt(f"interrupted; {file} is unchanged") from None
    located = options.apply_to(session.with_rig(calibration.rig))
    calibration = replace(calibration, rig=located.rig)
    console.print()
    console_output.print_table(console, calibration_page.HEADER, calibration_page.build_camera_rows(calibration))
    console.print()
    notes = [note for note in located.warnings if note not in session.warnings]
    console_output.print_warnings(console, [*problems, *calibration.unobservable, *calibration.warnings, *notes])
    lost = runs.write_calibration(calibration, file)
    page = file.with_suffix(".html")
    title = session.path.resolve().name
    calibration_page.write_page(calibration_page.render_board_calibration(calibration, title, text), page)
    console_output.print_files(console, "Files", [file, page])
    if lost:
        print_message(f"{file}: {lost}")


def _calibrate_without_board(options: CalibrateOptions) -> None:
    """Calibrate all cameras from an object that moves in the recording, print and write the result."""
    from sylpose.atomic_io import make_output_folder
    from sylpose.runs import console_output
    from sylpose.runs.calibration_page import write_motion_calibration

    file, session, console = options.file, options.open_with_lenses(), console_output.make_console()
    make_output_folder(file.parent)
    _, found = calibrate_recording(session, options, console)
    files, lost = write_motion_calibration(found, file, session.path.resolve().name)
    console_output.print_files(console, "Files", files)
    if lost:
        print_message(f"{file}: {lost}")
