"""Options that several commands share, as annotations and as records to inherit from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from sylpose.commands.app import ADVANCED, INPUT, LIVE, OBJECT, OUTPUT, CommandOptions, option
from sylpose.methods import FEATURES, METHODS, resolve_features
from sylpose.report import PICTURE_FORMATS
from sylpose.units import METERS

if TYPE_CHECKING:
    from sylpose.io.calibration.lenses import Fov, LensFile
    from sylpose.io.capture import Session
    from sylpose.io.capture.session import SessionBase
    from sylpose.runs.world import WorldSpec


SessionT = TypeVar("SessionT", bound="SessionBase")

# Their help is in the docstring of `CommandOptions`.
BoxesFile = Annotated[Path | None, option("--boxes FILE", OBJECT)]
FrameOffset = Annotated[tuple[str, ...], option("--frame-offset CAM=N", INPUT)]
EulerAxes = Annotated[str | None, option("--euler AXES", OUTPUT)]
Unit = Annotated[str | None, option(f"--unit {'|'.join(METERS)}", OUTPUT)]
World = Annotated[str | None, option("--world WORLD", OUTPUT)]
OutFolder = Annotated[Path | None, option("--out DIR", OUTPUT)]
StopFrame = Annotated[int | None, option("--stop N", INPUT)]
Overlay = Annotated[bool, option("--overlay/--no-overlay", OUTPUT)]
Smooth = Annotated[bool | None, option("--smooth/--no-smooth", ADVANCED)]
RefineCalibration = Annotated[bool, option("--refine-calibration", ADVANCED)]
Seed = Annotated[int, option("--seed N", ADVANCED)]
PlotFormat = Annotated[str, option(f"--format {'|'.join(PICTURE_FORMATS)}", OUTPUT, choices=PICTURE_FORMATS)]
ResultPath = Annotated[Path, typer.Argument(metavar="RESULT")]


@dataclass(frozen=True, kw_only=True)
class SourceOptions(CommandOptions):
    """Videos of the cameras.

    Attributes:
        video: Assign a video or image folder to a camera if its name does not match. Repeatable.
        exclude_camera: Leave out a camera, for example one without a video. Repeatable.
        rate: Set the frame rate of image folders, for times in seconds.
        take: Open this take of a folder with several.
    """

    video: Annotated[tuple[str, ...], option("--video NAME=FILE", INPUT)] = ()
    exclude_camera: Annotated[tuple[str, ...], option("--exclude-camera CAM", INPUT)] = ()
    rate: Annotated[float | None, option("--rate HZ", INPUT)] = None
    take: Annotated[str, option("--take NAME", INPUT)] = ""


@dataclass(frozen=True, kw_only=True)
class CameraOptions(SourceOptions):
    """Calibration and videos of the cameras.

    Attributes:
        calibration: Read the calibration from this file or folder; by default searched in SESSION.
        as_coded: Do not turn frames as their files specify, if the calibration fits both; default: as the cameras agree.
    """

    calibration: Annotated[Path | None, option("--calibration PATH", INPUT)] = None
    as_coded: Annotated[bool, option("--as-coded", INPUT)] = False

    def open_recording(
        self,
        path: Path,
        frame_offset: Sequence[str] = (),
        lenses: Sequence[LensFile] = (),
        fov: Fov | None = None,
        **files: Path | None,
    ) -> Session:
        """Open the recording in a folder.

        Args:
            path: the folder.
            frame_offset: values of `--frame-offset`.
            lenses, fov: in place of the calibration, as for `open_session`.
            files: boxes and masks, as for `open_session`.

        Raises:
            ValueError, OSError: as `open_session`; options of another form.
        """
        from sylpose.io.capture import open_session

        session = open_session(
            path,
            calibration=self.calibration,
            cameras=parse_video_option(self.video),
            offsets=parse_frame_offsets(frame_offset),
            rate=self.rate,
            without=self.exclude_camera,
            as_coded=self.as_coded,
            take=self.take,
            lenses=lenses,
            fov=fov,
            **files,
        )
        if self.as_coded or lenses or fov is not None or not session.has_ambiguous_orientation:
            return session
        from sylpose.runs.rig_evidence import resolve_orientation

        return resolve_orientation(session)


@dataclass(frozen=True, kw_only=True)
class RecordingOptions(CameraOptions):
    """A recording and its calibration, videos and masks.

    Attributes:
        session: Folder with one video (cam_0.mp4) or one folder of images per camera.
        masks: Read the object's masks; default: SESSION/masks if present.
    """

    session: Annotated[Path, typer.Argument(metavar="SESSION")]
    masks: Annotated[Path | None, option("--masks DIR", OBJECT)] = None

    def open(
        self,
        boxes: Path | None = None,
        frame_offset: Sequence[str] = (),
        lenses: Sequence[LensFile] = (),
        fov: Fov | None = None,
    ) -> Session:
        """Open the recording, as `open_recording` does."""
        return self.open_recording(self.session, frame_offset, lenses, fov, boxes=boxes, masks=self.masks)


@dataclass(frozen=True, kw_only=True)
class WorldOptions(CommandOptions):
    """World frame and length unit of the results.

    Attributes:
        world_frame: Detect the world board in this frame of the recording or of --world-from; default: the first frame.
        world_from: Detect the world board in these images or videos instead of the session's.
    """

    unit: Unit = None
    world: World = None
    world_frame: Annotated[int | None, option("--world-frame N", OUTPUT, min=0)] = None
    world_from: Annotated[Path | None, option("--world-from DIR", OUTPUT)] = None

    def __post_init__(self) -> None:
        """Check that options of the world come with a world."""
        super().__post_init__()
        if self.world is None and (self.world_frame is not None or self.world_from is not None):
            raise ValueError("--world-frame and --world-from require --world")

    @property
    def world_spec(self) -> WorldSpec | None:
        """Return the specification of the world; None for the calibration's."""
        from sylpose.runs.world import WorldSpec

        return None if self.world is None else WorldSpec(self.world, self.world_frame, self.world_from)

    def apply_to(self, session: SessionT) -> SessionT:
        """Return the session in the requested world and unit.

        Raises:
            ValueError, OSError: as `apply_world_and_unit`.
        """
        from sylpose.runs.world import apply_world_and_unit

        return apply_world_and_unit(session, self.world_spec, self.unit)


@dataclass(frozen=True, kw_only=True)
class RangeOptions(CommandOptions):
    """Frames to process.

    Attributes:
        start: Start at this frame.
    """

    start: Annotated[int, option("--start N", INPUT)] = 0
    stop: StopFrame = None


@dataclass(frozen=True, kw_only=True)
class StepOptions(RangeOptions):
    """Frames to process, with a step.

    Attributes:
        every: Use every N-th frame.
    """

    every: Annotated[int, option("--every N", INPUT)] = 1


@dataclass(frozen=True, kw_only=True)
class SeedOptions(CommandOptions):
    """Random seed."""

    seed: Seed = 0

    def __post_init__(self) -> None:
        """Check the seed."""
        super().__post_init__()
        if self.seed < 0:
            raise ValueError(f"--seed must not be negative, got {self.seed}")


@dataclass(frozen=True, kw_only=True)
class MethodOptions(CommandOptions):
    """Estimation method and features.

    Attributes:
        method: Select the estimation method; sylpose track --help lists them.
        features: Match SIFT in every frame, or track KLT between SIFT keyframes (faster, more precise); auto: KLT for
            landmarks, else SIFT.
    """

    method: Annotated[str, option("--method NAME", ADVANCED, choices=METHODS)] = METHODS[0]
    features: Annotated[str, option(f"--features {'|'.join(FEATURES)}", ADVANCED, choices=FEATURES)] = FEATURES[0]

    def __post_init__(self) -> None:
        """Check that the method can use the features."""
        super().__post_init__()
        resolve_features(self.method, self.features)


@dataclass(frozen=True, kw_only=True)
class PageOptions(CommandOptions):
    """Page in the browser.

    Attributes:
        port: Serve the page on this port; 0: any free port.
        browser: Open the page in the browser.
    """

    port: Annotated[int, option("--port N", LIVE, min=0, max=65535)] = 0
    browser: Annotated[bool, option("--browser/--no-browser", LIVE)] = True


@dataclass(frozen=True, kw_only=True)
class DisplayOptions(PageOptions):
    """Display of a run.

    Attributes:
        quiet: Print only warnings, on stderr.
        verbose: Print one line per frame.
        stream: Stream poses as JSON lines to stdout (-) or udp://HOST:PORT.
        show: Show the run in 3D on a page in the browser; see sylpose show.
    """

    quiet: Annotated[bool, option("--quiet -q", OUTPUT)] = False
    verbose: Annotated[bool, option("--verbose -v", OUTPUT)] = False
    stream: Annotated[str | None, option("--stream TO", LIVE)] = None
    show: Annotated[bool, option("--show", LIVE)] = False

    def __post_init__(self) -> None:
        """Check the options that exclude each other."""
        super().__post_init__()
        if self.quiet and self.verbose:
            raise ValueError("--quiet and --verbose exclude each other")


def parse_video_option(values: Sequence[str]) -> dict[str, str] | None:
    """Parse the values of `--video NAME=FILE` into files by name.

    Raises:
        ValueError: a value of another form, or a name given twice.
    """
    cameras: dict[str, str] = {}
    for text in values:
        name, _, file = text.partition("=")
        if not name or not file:
            raise ValueError(f"--video: expected NAME=FILE, such as cam_2=left.mp4, got {text!r}")
        if name in cameras:
            raise ValueError(f"--video: {name} is given twice")
        cameras[name] = file
    return cameras or None


def parse_frame_offsets(values: Sequence[str]) -> dict[str, int] | None:
    """Parse the values of `--frame-offset CAM=N` into offsets by camera.

    Raises:
        ValueError: a value of another form.
    """
    offsets = {}
    for text in values:
        camera, _, frames = text.rpartition("=")
        try:
            offsets[camera] = int(frames)
        except ValueError:
            camera = ""
        if not camera:
            raise ValueError(f"--frame-offset: expected CAMERA=FRAMES, such as cam_2=5, got {text!r}")
    return offsets or None
