"""Validation of a session before it is tracked: facts, warnings and errors about its rig and boxes."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace

import numpy as np

from sylpose.display import format_length
from sylpose.frames import Box, FrameSet
from sylpose.geometry.arrays import FloatArray
from sylpose.io.calibration import format_name
from sylpose.io.calibration.unit_consistency import describe_unit_outlier
from sylpose.io.capture import Session
from sylpose.io.capture.live import LiveSession
from sylpose.io.capture.timeline import Timeline
from sylpose.report.drawing import View
from sylpose.report.rigview import describe_rig, find_axes_intersection
from sylpose.rig import Camera, Rig
from sylpose.runs.candidates import compare_session_cameras, find_session_candidates
from sylpose.runs.console_output import select_solved_frames
from sylpose.runs.options import RunOptions
from sylpose.runs.run_result import Run
from sylpose.status import DOUBTFUL, FrameStatus
from sylpose.tracking.joint_side.object_model import carve_box_volume

# Timestamps of one frame set that deviate more from their mean, frames, cause a warning (choice: cameras without a
# common trigger reach one frame in either direction).
MAX_TIMESTAMP_SPREAD = 2.0
# Cameras whose baseline is below this share of their distance to the object count as coincident (choice: parallax
# of a pixel at f = 1000 px).
MIN_BASELINE_RATIO = 1e-3
# Optical axes intersect if they miss each other by at most this share of the cameras' distance (choice: aimed by hand,
# a degree).
MAX_AXIS_MISS_RATIO = 0.02
# Frames are listed in messages up to this number (choice).
MAX_LISTED = 6
# Larger distances are unlikely to be in meters (choice).
MAX_PLAUSIBLE_METERS = 200.0


@dataclass(frozen=True, eq=False)
class ObjectLocation:
    """Expected location of the object.

    Attributes:
        center: (3,) in the world; None if unknown.
        radius: radius of the object in length units, or None.
        source: "the boxes" or "the optical axes".
        error: error message if the given boxes cannot belong to one object, else "".
    """

    center: FloatArray | None
    radius: float | None
    source: str
    error: str = ""


@dataclass(frozen=True, eq=False)
class Preview:
    """Preview of the tracked object.

    Attributes:
        views: of the object, or of each body that may be it; empty for a recording without frames.
        description: description.
        warnings: warnings.
        f_ratio: by which the cameras contradict each other in its motion; NaN if unknown.
    """

    views: Sequence[View]
    description: str
    warnings: tuple[str, ...] = ()
    f_ratio: float = np.nan


def find_tracking_target(session: Session, options: RunOptions | None = None) -> Preview:
    """Return the tracking target, as `track_session` does: the first object's boxes, or whatever moves without any."""
    options, name = options or RunOptions(), session.objects[0]
    boxes = session.select_object(name).boxes
    if not boxes:
        return preview_moving_object(session, options)
    views = [View("", first, box_outlines(session, boxes)) for first in _read_frame(session, options.start)]
    f_ratio = compare_session_cameras(session, name, options)
    return Preview(views, f"the object in the boxes of {', '.join(boxes)}", f_ratio=f_ratio)


def locate_object(session: Session | LiveSession) -> ObjectLocation:
    """Locate the object where the boxes of two or more cameras meet, else where the optical axes meet."""
    if len(session.boxes) < 2:
        return ObjectLocation(find_axes_intersection(session.rig), None, "the optical axes")
    try:
        center, points = carve_box_volume(session.rig, session.boxes)
    except ValueError as error:
        return ObjectLocation(find_axes_intersection(session.rig), None, "the optical axes", str(error))
    return ObjectLocation(center, float(np.quantile(np.linalg.norm(points - center, axis=1), 0.95)), "the boxes")


def collect_facts(session: Session, locations: Mapping[str, ObjectLocation]) -> list[tuple[str, str]]:
    """Return label and text of each fact about the session, apart from the camera table.

    Args:
        session: the recording.
        locations: expected location by object name.
    """
    rig, unit = session.rig, session.rig.unit or "unspecified"

    def label(name: str) -> str:
        return "" if len(session.objects) == 1 else f", {name}"

    calibration = session.calibration
    inside = calibration.parent.resolve() == session.path.resolve()
    name = calibration.name if inside else str(calibration)
    entries = [("Calibration", f"{name}, {format_name(calibration)}, length unit {unit}")]
    kinds = {"video": "videos", "images": "folders of images", "pages": "page stacks"}
    if session.world is not None:
        entries.append(("World", session.world.description or "from a file"))
    entries.append(("Recorded", " and ".join(sorted({kinds[source.kind] for source in session.sources}))))
    turned = [source.camera for source in session.sources if source.orientation > 1]
    if turned:
        entries.append(("Turned", f"as the files specify (display matrix or EXIF): {', '.join(turned)}"))
    if session.timeline.origin:
        times = f"{session.timeline.origin}, {session.timeline.times[-1] - session.timeline.times[0]:.2f} s"
    elif session.rate:
        times = f"from the frame rate, {session.n_frames / session.rate:.2f} s"
    else:
        times = "none: frame numbers serve as times"
    entries.append(("Time", times))
    clocks = describe_clocks(session.timeline, rig.names)
    entries += [("Clocks" if k == 0 else "", text) for k, text in enumerate(clocks)]
    for name in session.objects:
        boxes = session.select_object(name).boxes.items()
        text = ", ".join(f"{camera} {box.width:.0f}x{box.height:.0f}" for camera, box in boxes)
        entries.append((f"Boxes{label(name)}", text or "none: whatever moves is tracked"))
    entries.append(("Masks", "none" if session.masks is None else str(session.masks)))
    return entries + [(f"Object{label(name)}", _describe_location(rig, where)) for name, where in locations.items()]


def describe_clocks(timeline: Timeline, names: Sequence[str]) -> list[str]:
    """Describe the time stamps of each camera: rate, lost frames, and deviation from even intervals."""
    texts = []
    for name, column in zip(names, timeline.stamps.T, strict=True):
        intervals = np.diff(column[np.isfinite(column)])
        if not len(intervals):
            continue
        usual = float(np.median(intervals))
        n_steps = np.rint(intervals / usual)
        jitter = 1e3 * float(np.std(intervals - n_steps * usual))
        n_lost = int(np.maximum(n_steps - 1, 0).sum())
        lost = f"{n_lost} lost, the longest gap {intervals.max():.3g} s" if n_lost else "none lost"
        texts.append(f"{name} {1 / usual:.4g} frames per second, {lost}, jitter {jitter:.1f} ms")
    return texts


def _describe_location(rig: Rig, location: ObjectLocation) -> str:
    if location.center is None:
        return "unknown"
    # Round to a thousandth of the distance.
    resolution = 1e-3 * float(np.mean([np.linalg.norm(location.center - c.center) for c in rig]))
    center = np.where(np.abs(location.center) < resolution, 0.0, location.center)
    coordinates = ", ".join(f"{value:.3g}" for value in center)
    text = f"where {location.source} meet, ({coordinates})"
    if location.source == "the optical axes":
        text += f", to within {format_length(max(_max_axis_distance(rig, location.center), resolution), rig.unit)}"
    elif location.radius:
        text += f", radius up to {format_length(location.radius, rig.unit)}"
    return text


def check_session(session: Session | LiveSession, start: int = 0) -> list[str]:
    """Return warnings about a session to be tracked from frame `start` on, without reading its images."""
    return list_warnings(session, {name: locate_object(session.select_object(name)) for name in session.objects}, start)


def list_warnings(session: Session | LiveSession, locations: Mapping[str, ObjectLocation], start: int = 0) -> list[str]:
    """Return problems that do not prevent tracking from frame `start` on.

    Args:
        session: the recording or live session.
        locations: expected location by object name.
        start: first frame to be tracked.
    """
    by_object = {}
    for name, location in locations.items():
        boxes_found = _check_boxes(session.select_object(name), location, start)
        by_object[name] = [*check_rig_geometry(session.rig, location), *boxes_found]
    # A problem of the rig occurs for every object: report it once.
    first, *others = by_object.values()
    common = [message for message in first if all(message in found for found in others)]
    own = [f"{name}: {message}" for name, found in by_object.items() for message in found if message not in common]
    return [*find_session_warnings(session, start), *common, *own]


def list_errors(locations: Mapping[str, ObjectLocation]) -> list[str]:
    """Return the errors that prevent objects from being tracked."""
    errors = {name: location.error for name, location in locations.items() if location.error}
    return list(errors.values()) if len(locations) == 1 else [f"{name}: {error}" for name, error in errors.items()]


def check_rig_geometry(rig: Rig, location: ObjectLocation) -> list[str]:
    """Return warnings about the cameras' positions and viewing directions."""
    if len(rig) == 1:
        return [
            "Only one camera: unless the object's size is known (--object FILE or --mesh), translations are in units of its "
            "first distance."
        ]
    found = []
    rows = describe_rig(rig, location.center)
    spread = max(max(row.angles) for row in rows)
    if location.center is None:
        if spread > 5.0:
            message = "The cameras diverge: their optical axes pass no common point in front of them."
            inverse = Rig([replace(camera, camera_from_world=camera.camera_from_world.inv()) for camera in rig])
            if find_axes_intersection(inverse) is not None:
                message += " With inverted poses they would meet: the calibration probably contains world_from_camera."
            found.append(message)
    else:
        if outside := [camera.name for camera in rig if not _is_in_image(camera, location.center)]:
            point = f"the point where the {location.source.split()[-1]} meet"
            look = "it looks" if len(outside) == 1 else "they look"
            found.append(f"{', '.join(outside)}: {point} is not in the image; {look} elsewhere.")
    reach = max(max(row.baselines) for row in rows)
    if location.center is not None:
        reach = float(np.median([row.distance for row in rows]))
    close = np.array([row.baselines for row in rows]) <= MIN_BASELINE_RATIO * reach
    pairs = [f"{rows[i].name} and {rows[j].name}" for i, j in np.argwhere(np.tril(close, -1))]
    if pairs:
        found.append(
            f"At the same position: {', '.join(pairs[:5])}{', ...' if len(pairs) > 5 else ''}. Without a baseline the "
            "object's distance is not observable."
        )
    if unit_outlier := describe_unit_outlier(rig):
        found.append(unit_outlier)
    elif reach > MAX_PLAUSIBLE_METERS and rig.unit in ("", "m"):
        found.append(
            f"Distances of {reach:.0f} {'m' if rig.unit else 'units'}: the calibration is probably in millimeters; "
            "all results use its unit."
        )
    return found


def _max_axis_distance(rig: Rig, point: FloatArray) -> float:
    """Return the largest distance of a point from the cameras' optical axes."""
    return max(float(np.linalg.norm(np.cross(point - camera.center, camera.direction))) for camera in rig)


def describe_axis_miss(rig: Rig) -> str:
    """Describe by how far the optical axes miss each other; return "" if they meet.

    A large distance is no error by itself: cameras need not be aimed at one point.
    """
    point = find_axes_intersection(rig)
    if point is None:
        return ""
    miss = _max_axis_distance(rig, point)
    ratio = miss / float(np.median([np.linalg.norm(point - camera.center) for camera in rig]))
    if ratio <= MAX_AXIS_MISS_RATIO:
        return ""
    return (
        f"The optical axes miss each other by {format_length(miss, rig.unit)}, {100 * ratio:.0f} % of the cameras' "
        "distance: normal for cameras not aimed at one point; otherwise the calibration is off."
    )


def _is_in_image(camera: Camera, point: FloatArray) -> bool:
    pixel = camera.project(point)[0]
    return bool(np.isfinite(pixel).all() and (pixel >= 0).all() and (pixel <= np.array(camera.size) - 1).all())


def _check_boxes(session: Session | LiveSession, location: ObjectLocation, start: int) -> list[str]:
    boxes, found = session.boxes, []
    if len(boxes) == 1 and len(session.rig) > 1:
        found.append(
            f"Only one camera has a box ({next(iter(boxes))}): the object's distance is unknown; give a box in each "
            "camera that sees it."
        )
    if location.source == "the boxes" and location.center is not None:
        for name, box in boxes.items():
            offset = session.rig[name].project(location.center)[0] - [box.x + box.width / 2, box.y + box.height / 2]
            if not (np.abs(offset) <= [box.width / 2, box.height / 2]).all():
                found.append(
                    f"The box of {name} does not fit the others: they meet {np.linalg.norm(offset):.0f} px from its "
                    "center."
                )
    if isinstance(session, LiveSession):
        return found
    first = session.timeline.frames[min(start, session.n_frames - 1)]
    without_image = [name for name, frame in zip(session.rig.names, first, strict=True) if name in boxes and frame < 0]
    if without_image:
        found.append(f"{', '.join(without_image)}: no image in the first frame, for which there is a box.")
    return found


def preview_moving_object(session: Session, options: RunOptions | None = None) -> Preview:
    """Find the bodies that move in a recording, as `track_session` does, and draw those that may be the object."""
    options, names = options or RunOptions(), session.rig.names
    candidates = find_session_candidates(session, options)
    if not candidates:
        description = (
            "Without boxes, the moving object is tracked, but no rigid body was found to move. Select the object with "
            f"boxes: {boxes_hint(session)}."
        )
        views = [View("", first, (None,) * len(names)) for first in _read_frame(session, options.start)]
        return Preview(views, "nothing yet", (description,))
    is_ambiguous = candidates[0].is_ambiguous(options.tracking)
    views, lines = list[View](), list[str]()
    for number, candidate in enumerate(candidates if is_ambiguous else candidates[:1], start=1):
        label = f"{number}" if is_ambiguous else ""
        for frames in _read_frame(session, candidate.first):
            views.append(View(label, frames, candidate.outlines, candidate.features))
        columns = zip(names, map(len, candidate.features), candidate.displacements_px.tolist(), strict=True)
        counts = ", ".join(f"{name} {n} features, {px:.0f} px" for name, n, px in columns if n)
        lines.append(f"from frame {candidate.first} to {candidate.last}: {counts}")
    if not is_ambiguous:
        return Preview(views, f"what moves {lines[0]}", f_ratio=candidates[0].f_ratio)
    description = "\n".join(f"body {number}, which moves {line}" for number, line in enumerate(lines, start=1))
    warning = (
        f"{FrameStatus.AMBIGUOUS.text} Select it with `--object N`, N the number in the picture, or with boxes: "
        f"{boxes_hint(session)}."
    )
    return Preview(views, description, (warning,), candidates[0].f_ratio)


def box_outlines(session: Session, boxes: Mapping[str, Box]) -> tuple[FloatArray | None, ...]:
    """Return the corners (4, 2) of each camera's box, or None without one."""

    def corners(box: Box) -> FloatArray:
        right, bottom = box.x + box.width - 1, box.y + box.height - 1
        return np.array([[box.x, box.y], [right, box.y], [right, bottom], [box.x, bottom]], float)

    return tuple(corners(boxes[name]) if name in boxes else None for name in session.rig.names)


def find_session_warnings(session: Session | LiveSession, start: int = 0) -> list[str]:
    """Return warnings about a session that is tracked from frame `start` on, as sentences."""
    warnings = [*session.warnings]
    if isinstance(session, LiveSession):
        return warnings
    n, parts = session.n_frames, []
    for name, column in zip(session.rig.names, session.timeline.frames.T, strict=True):
        present = np.flatnonzero(column >= 0)
        if not len(present):
            parts.append(f"{name} has none of them")
        elif len(present) < n:
            missing = present[0] + np.flatnonzero(column[present[0] : present[-1] + 1] < 0)
            listed = ", ".join(map(str, missing[:MAX_LISTED])) + (", ..." if len(missing) > MAX_LISTED else "")
            gap_text = f" without {len(missing)} in between ({listed})" if len(missing) else ""
            parts.append(f"{name} has {present[0]} to {present[-1]}{gap_text}")
    if parts:
        warnings.append(f"Not every camera has all frames 0 to {n - 1}: {', '.join(parts)}.")
    deviations = session.timeline.stamps - session.timeline.times[:, None]
    if session.rate and np.nanmax(np.abs(deviations), initial=0.0) * session.rate > MAX_TIMESTAMP_SPREAD:
        worst = float(np.nanmax(np.abs(deviations)))
        warnings.append(
            f"The cameras' timestamps of one frame set are up to {worst:.3g} s from their mean, so frames of different "
            "times are combined. Check that the clocks are synchronized."
        )
    # All objects have boxes or none.
    if session.select_object(session.objects[0]).boxes and start > 0:
        warnings.append(f"The boxes are assumed to be of frame {start}, where tracking starts.")
    return warnings


def boxes_hint(session: Session | LiveSession) -> str:
    """Return the option or command that provides boxes for a session."""
    return "--boxes" if isinstance(session, LiveSession) else f"sylpose box {shlex.quote(str(session.path))} draws them"


def explain_failures(session: Session | LiveSession, run: Run) -> list[str]:
    """Explain for each object without a solved frame why there is none, one sentence per object."""
    reasons = []
    for name, trajectory in run.trajectories.items():
        if select_solved_frames(trajectory):
            continue
        prefix = f"{name}: " if len(run.trajectories) > 1 else ""
        failed = [frame for frame in trajectory if frame.world_from_object is None or frame.status in DOUBTFUL]
        statuses = [frame.status for frame in failed]
        if not len(trajectory):
            reasons.append(f"{prefix}no frame was tracked")
        elif not statuses:
            reasons.append(
                f"{prefix}no motion could be estimated: there is only the first frame, the reference of all poses"
            )
        else:
            # The others follow from these.
            causes = [s for s in (FrameStatus.AMBIGUOUS, FrameStatus.CONTRADICTED) if s in statuses]
            status = causes[0] if causes else max(statuses, key=statuses.count)
            sentence = f"{prefix}no frame could be solved. {status.text}"
            if status is FrameStatus.AMBIGUOUS:
                sentence += f" `sylpose check` draws them: select one with --object N or boxes ({boxes_hint(session)})."
            elif status is FrameStatus.CONTRADICTED:
                path = shlex.quote(str(session.path))
                remedy = (
                    "" if isinstance(session, LiveSession) else f" `sylpose check {path}` tries the usual mistakes."
                )
                sentence += (
                    " Check that the calibration belongs to these images: names of the cameras, its unit and axes, mirrored "
                    f"or turned images, time offsets.{remedy}"
                )
            elif not session.select_object(name).boxes and session.masks is None:
                sentence += (
                    f" Provide boxes of the object in the first frame ({boxes_hint(session)}) or masks (--masks) to "
                    "select it."
                )
            reasons.append(sentence)
    return reasons


def _read_frame(session: Session, number: int) -> Sequence[FrameSet]:
    """Read a frame set to be drawn; empty if there is none. Its problems are reported elsewhere."""
    with closing(session.frames(number, number + 1, on_problem=lambda _: None)) as reader:
        return [*reader]
