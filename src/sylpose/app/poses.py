"""`sylpose pose`: where an object of known points or markers is, in each frame by itself."""

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

from sylpose import __version__, calibration
from sylpose.absolute_pose.pose import estimate_pose
from sylpose.absolute_pose.pose_frame import frame_pose
from sylpose.app import console_output
from sylpose.app.page import make_page
from sylpose.app.pixel_files import load_pixels
from sylpose.app.point_files import Layout, PointModel, load_points
from sylpose.app.results_folder import ResultsFolder, alone_in
from sylpose.app.run import Run
from sylpose.app.run_metadata import SETTINGS, checksum, settings_of, table, write_record, write_record_of_tables
from sylpose.app.session_options import camera_files, check_out, open_recorded
from sylpose.app.session_warnings import notes
from sylpose.app.thumbnails import Album
from sylpose.boards.detection import markers_in
from sylpose.capture import Session
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.input_limits import MAX_TABLE, told
from sylpose.report.files import TrajectoryWriter
from sylpose.report.formats import FORMATS
from sylpose.report.plots import plot_trajectory
from sylpose.report.scene import Stills
from sylpose.results import FramePose, Trajectory
from sylpose.rig import Camera, Rig
from sylpose.sync.offsets import find_offsets, retimed

__all__ = ["MAX_ERROR_PX", "pose_aloud"]

# Points further off are wrong, whatever the noise: five times two pixels and a half (choice).
MAX_ERROR_PX = 12.0
# Names that are said of those that are not in the other file (choice).
SAID = 5


class Seen(NamedTuple):
    """A frame: its number and time, and by camera the points (n, 3), object's frame, and the pixels (n, 2) they are at."""

    number: int
    time: float
    points: list[FloatArray]
    pixels: list[FloatArray]


def pose_aloud(
    model: Path,
    seen: Sequence[Path],
    out: Path,
    *,
    given: Path | None = None,
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
    """Finds the object in each frame, writes the trajectory and its report, and says what was found.

    Args:
        model: points or markers (`load_points`).
        seen: tables of pixels (`load_pixels`), or one recording's folder, for markers.
        out: folder for the files.
        given: a calibration; None for that of the recording.
        cameras: NAME=FILE, for files whose names do not tell the camera.
        without: cameras of a recording that are left out.
        unit: of all lengths in the results; is_in: of the model's, where it does not say it.
        rate: frames per second, where neither tables nor the recording have times.
        likelihood: points of tables that are less likely count as not seen.
        max_error_px: see `estimate_pose`.
        start, stop, every: frames of a recording.

    Raises:
        FileNotFoundError, ValueError, OSError: files; a model without what is to be seen; numbers out of range.
    """
    if plot_format not in FORMATS:
        raise ValueError(f"--format must be one of {', '.join(FORMATS)}, got {plot_format!r}")
    if not (np.isfinite(max_error_px) and max_error_px > 0):
        raise ValueError(f"--max-error must be a number of pixels, got {max_error_px}")
    known, begun, console = load_points(model), time.monotonic(), console_output.make_console()
    if (out / SETTINGS).exists() and "model" not in table(settings_of(out), "options"):
        raise ValueError(f"{out}: a run's results are there; another folder is expected: --out DIR")
    noticed, album = list[str](), None
    frames: Iterable[Seen]
    asked: dict[str, object] = {"model": str(model.resolve()), "model_checksum": checksum(model), "is_in": is_in}
    asked |= {"max_error_px": max_error_px, "seed": seed}
    if len(seen) == 1 and seen[0].is_dir():
        session = open_recorded(seen[0], given, None, None, None, cameras, rate, unit, without=without)
        check_out(session, out)
        offsets = find_offsets(session)
        session = retimed(session, [offsets.get(name, 0.0) for name in session.rig.names])
        rig, source, album = session.rig, seen[0], Album(len(session.rig))
        layout = _markers(known, model, rig, is_in)
        noticed += notes(session)
        if layout.inwards:
            said = ", ".join(map(str, layout.inwards))
            noticed.append(f"marker {said} looks inwards: are its corners clockwise, as printed? x right, y up?")
        frames = _in_recording(session, layout, start, stop, every, album)
        asked |= {"start": start, "stop": stop, "every": every, "offsets": dict(offsets) or None}
        record = partial(write_record, out, session, asked, noticed)
    else:
        if without:
            raise ValueError("--exclude-camera: is for recordings; of tables, leave those of the camera out")
        if given is None:
            raise ValueError("--calibration FILE: tables of pixels need one")
        rig, source = calibration.load(given), given if not seen else seen[0]
        rig = rig if unit is None else rig.in_unit(unit)
        known = _told_in(known, model, rig, is_in)
        if not known.points:
            raise ValueError(f"{model}: it has markers, which are looked for in a recording, and no points by name")
        tables = [*seen, *map(Path, (camera_files(cameras) or {}).values())]
        frames = _in_tables(known, seen, rig, cameras, rate, likelihood, noticed)
        asked |= {"rate": rate, "likelihood": likelihood}
        record = partial(write_record_of_tables, out, tables, given, rig, asked, noticed)
    console_output.print_warnings(console, noticed)
    poses, results = list[FramePose](), ResultsFolder(out)
    with ExitStack() as whole:
        whole.enter_context(alone_in(out))
        results.set_aside()
        whole.push(lambda error, *_: results.put_back() if error is not None and not poses else None)
        files = record()
        with console.status("Looking ..."), TrajectoryWriter(out, rig.names, rig.unit) as writer:
            for its in frames:
                found = estimate_pose(rig, its.points, its.pixels, max_error_px=max_error_px, seed=seed)
                poses.append(frame_pose(found, its.number, its.time, np.array([len(p) for p in its.pixels], np.int64)))
                writer.write(poses[-1])
        if faults := Counter(fault for pose in poses for fault in pose.faults):
            fault, count = faults.most_common(1)[0]
            noticed = [f"in {count} of {len(poses)} frames {fault}", *noticed]
            console_output.print_warnings(console, noticed[:1])
        trajectory, looked = Trajectory(poses, rig.names, rig.unit), time.monotonic()
        files = [writer.tum_path, writer.csv_path, *files]
        if poses:
            note = f"{source.resolve().name}, by {model.name}, sylpose {__version__}"
            plot_trajectory(trajectory, out / f"report.{plot_format}", note=note, noticed=noticed)
            files.insert(2, out / f"report.{plot_format}")
            if writer.csv_path.stat().st_size <= MAX_TABLE:
                files.insert(3, make_page(out, Stills() if album is None else album.stills()))
        results.end()
    seconds = {"looking": looked - begun, "plots": time.monotonic() - looked}
    run = Run({"object": trajectory}, tuple(files), (), seconds)
    console_output.print_summary(console, run, len(poses))
    return run


def _told_in(known: PointModel, model: Path, rig: Rig, is_in: str | None) -> PointModel:
    with told(model):
        return known.in_unit(rig.unit, is_in)


def _markers(known: PointModel, model: Path, rig: Rig, is_in: str | None) -> Layout:
    layout = _told_in(known, model, rig, is_in).markers
    if layout is None:
        raise ValueError(
            f"{model}: no markers in it that could be found in a recording; its points need tables of pixels"
        )
    return layout


def _in_recording(
    session: Session, layout: Layout, start: int, stop: int | None, every: int, album: Album
) -> Iterator[Seen]:
    with closing(session.frames(start, stop, every, lambda sentence: console_output.say(sentence))) as frames:
        for its in frames:
            album.put(its)
            both = [_seen_in(image, camera, layout) for image, camera in zip(its.images, session.rig, strict=True)]
            yield Seen(its.index, its.time, [points for points, _ in both], [pixels for _, pixels in both])


def _seen_in(image: Image | None, camera: Camera, layout: Layout) -> tuple[FloatArray, FloatArray]:
    """Corners (n, 3) of the markers on the object that an image shows, and where (n, 2)."""
    if image is None:
        return np.empty((0, 3)), np.empty((0, 2))
    numbers, pixels, _ = markers_in(image, camera, layout.marker, layout.corners)
    points = np.array([layout.corners[number] for number in numbers.tolist()])
    return points.reshape(-1, 3), pixels.reshape(-1, 2)


def _in_tables(
    known: PointModel,
    files: Sequence[Path],
    rig: Rig,
    cameras: Sequence[str] | None,
    rate: float | None,
    likelihood: float,
    noticed: list[str],
) -> list[Seen]:
    tables = load_pixels(files, rig.names, camera_files(cameras), likelihood)
    if rate is not None and not (np.isfinite(rate) and rate > 0):
        raise ValueError(f"--rate must be a number of frames per second, got {rate}")
    if rate is not None and tables.times:
        raise ValueError("--rate: the tables have times")
    if not any(name in known.points for name in tables.names):
        raise ValueError(
            f"none of the points that cameras see ({_some(tables.names)}) is one of the object ({_some([*known.points])})"
        )
    if strange := [name for name in tables.names if name not in known.points]:
        many = f"{len(strange)} points of the tables are" if len(strange) > 1 else "1 point of the tables is"
        noticed.append(f"{many} not known on the object: {_some(strange)}")
    out = []
    for frame in tables.frames:
        points, pixels = [], []
        for name in rig.names:
            its = {n: at for n, at in tables.seen.get((frame, name), {}).items() if n in known.points}
            points.append(np.array([known.points[n] for n in its]).reshape(-1, 3))
            pixels.append(np.array([*its.values()]).reshape(-1, 2))
        out.append(Seen(frame, tables.times.get(frame, frame / rate if rate else float(frame)), points, pixels))
    if any(b.time <= a.time for a, b in pairwise(out)):
        raise ValueError(f"{files[0] if files else cameras}: times that do not increase from frame to frame")
    return out


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:SAID]) + (", ..." if len(names) > SAID else "")
