"""Text representations of results and cameras: `repr`, `print` and notebook tables.

The types derive from `Printable` and hold only data; `summarize` knows them by the names of their classes, because their
modules import this one.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from html import escape
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import invert_information
from sylpose.input_limits import MAX_SENTENCE_LENGTH, to_one_line
from sylpose.status import Observability, Status

# Significant digits of a value and of a standard deviation (choice).
VALUE_DIGITS, SD_DIGITS = 3, 2
# Rows printed at most; the rest is counted (choice).
MAX_ROWS = 12
# A rotation by less than this is zero, radians (choice: rounding).
ZERO_ANGLE = 1e-9


class Summary(NamedTuple):
    """Summary of an object, from which its text representations are made.

    Attributes:
        brief: a few words, for `repr`.
        rows: labels and their texts.
        sentence: first line of `print` and notebook tables; "" for `brief`.
    """

    brief: str
    rows: Sequence[tuple[str, str]] = ()
    sentence: str = ""


class Printable:
    """Base class of objects with text representations made by `summarize`.

    Dataclasses need `repr=False`.
    """

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {to_one_line(summarize(self).brief, MAX_SENTENCE_LENGTH)}>"

    def __str__(self) -> str:
        brief, rows, sentence = summarize(self)
        width = max((len(label) for label, _ in rows), default=0)
        lines = [f"  {to_one_line(label):{width}}  {to_one_line(text, MAX_SENTENCE_LENGTH)}" for label, text in rows]
        return "\n".join([f"{type(self).__name__}: {to_one_line(sentence or brief, MAX_SENTENCE_LENGTH)}", *lines])

    def _repr_html_(self) -> str:
        brief, rows, sentence = summarize(self)
        left = "style='text-align: left'"
        body = "".join(
            f"<tr><th {left}>{_escape_html(label)}</th><td {left}>{_escape_html(text)}</td></tr>"
            for label, text in rows
        )
        return (
            f"<div><b>{_escape_html(type(self).__name__)}</b>: {_escape_html(sentence or brief)}"
            f"<table>{body}</table></div>"
        )


def _escape_html(text: str) -> str:
    """Escape text for HTML: names come from files and must not be interpreted as markup."""
    return escape(to_one_line(text, MAX_SENTENCE_LENGTH))


def truncate_rows(rows: Sequence[tuple[str, str]], noun: str = "camera") -> list[tuple[str, str]]:
    """Return the first rows, and one that counts the rest."""
    n_more = len(rows) - MAX_ROWS
    return [*rows[:MAX_ROWS], *([("", f"and {n_more} {noun}{'s' if n_more > 1 else ''} more")] if n_more > 0 else [])]


def format_length(value: float, unit: str) -> str:
    """Format a length to three digits, in millimeters below one meter."""
    scale, unit = _display_unit(value, unit)
    return f"{scale * value:.{_count_decimals(scale * value, VALUE_DIGITS)}f} {unit}"


def format_lengths(values: FloatArray, sigma: FloatArray, unit: str) -> str:
    """Format three lengths with their standard deviations."""
    scale, unit = _display_unit(_max_abs(values), unit)
    return f"{format_with_sd(scale * values, scale * sigma)} {unit}"


def _display_unit(size: float, unit: str) -> tuple[float, str]:
    return (1000.0, "mm") if unit == "m" and abs(size) < 1 else (1.0, unit or "units")


def format_with_sd(values: FloatArray, sigma: FloatArray) -> str:
    """Format numbers with their standard deviations, to the digits that these justify."""
    finite_sigma = sigma[np.isfinite(sigma) & (sigma > 0)]
    digits = (
        _count_decimals(finite_sigma.min(), SD_DIGITS)
        if len(finite_sigma)
        else _count_decimals(_max_abs(values), VALUE_DIGITS)
    )
    return f"{format_vector(values, digits)} ± {format_vector(sigma, digits)}"


def format_vector(values: FloatArray, digits: int = 2) -> str:
    """Format numbers in parentheses with a fixed number of decimals."""
    # Adding 0 turns -0 into 0.
    texts = (f"{round(v, digits) + 0.0:.{digits}f}" if math.isfinite(v) else "unknown" for v in values.tolist())
    return f"({', '.join(texts)})"


def format_position(position: FloatArray) -> str:
    """Format a position in the calibration's unit, to a thousandth of its largest coordinate."""
    return format_vector(position, _count_decimals(_max_abs(position), VALUE_DIGITS + 1))


def format_rotation(rotation: Rotation, covariance: FloatArray | None = None) -> str:
    """Format a rotation as angle and axis, with standard deviations if a covariance is given.

    Args:
        rotation: the rotation.
        covariance: (3, 3) about the x, y and z axes, rad²; None to omit standard deviations.
    """
    w = rotation.as_rotvec()
    angle = float(np.linalg.norm(w))
    sigma = np.empty(0) if covariance is None else np.degrees(np.sqrt(np.maximum(np.diag(covariance), 0.0)))
    finite_sigma = sigma[np.isfinite(sigma) & (sigma > 0)]
    digits = (
        _count_decimals(finite_sigma.min(), SD_DIGITS)
        if len(finite_sigma)
        else _count_decimals(np.degrees(angle), VALUE_DIGITS)
    )
    text = f"{np.degrees(angle):.{digits}f}°"
    text += f" about {format_vector(w / angle)}" if angle > ZERO_ANGLE else ""
    return text if covariance is None else f"{text}, ± {format_vector(sigma, digits)}° about x, y, z"


def format_inliers(inliers: int, matches: int, residual: float) -> str:
    """Format one camera's number of inliers and its residual in pixels."""
    return f"{inliers} of {matches} matches" + (f", residual {residual:.2f} px" if math.isfinite(residual) else "")


def format_optimality(certified: bool, candidates: int = 1) -> tuple[str, str]:
    """Return the row (label, text) on global optimality and the number of other minima."""
    others = f", one of {candidates} minima" if candidates > 1 else ""
    return "optimum", ("proved to be the global one" if certified else f"not proved to be the global one{others}")


def _max_abs(values: FloatArray) -> float:
    return float(np.abs(values[np.isfinite(values)]).max(initial=0.0))


def _count_decimals(size: float, digits: int) -> int:
    """Return the decimals that give a number of this size so many significant digits."""
    return min(max(digits - 1 - math.floor(math.log10(abs(size))), 0), 9) if size and math.isfinite(size) else 0


def summarize(thing: Any) -> Summary:
    """Summarize an object by the function of the nearest of its classes."""
    summary: Summary = _find_by_class(_SUMMARIES, thing)(thing)
    return summary


def _find_by_class(table: Mapping[str, Any], thing: object) -> Any:
    return next(table[cls.__name__] for cls in type(thing).__mro__ if cls.__name__ in table)


def _summarize_motion(m: Any) -> Summary:
    """Summarize a `Motion`; that of `estimate_pose` has a position instead of a translation."""
    names = m.camera_names or [f"camera {c}" for c in range(len(m.inliers))]
    numbers = zip(m.n_inliers, m.inliers, m.residuals, strict=True)
    cameras = zip(names, [format_inliers(n, len(mask), residual) for n, mask, residual in numbers], strict=True)
    rows = [*truncate_rows(list(cameras)), *_fault_rows(m.faults)]
    if m.motion is None:
        return Summary(m.status.value, rows, _status_sentence(m))
    is_pose, center = m.method == "pose", m.motion.apply(m.center)
    translation = center if is_pose else center - m.center
    sigma = np.sqrt(np.maximum(np.diag(m.covariance), 0.0))
    first = [
        ("rotation", format_rotation(m.rotation, m.covariance[:3, :3])),
        ("center at" if is_pose else "translation", format_lengths(translation, sigma[3:], m.unit)),
    ]
    if m.alternative is not None:
        first.append(("alternative", format_rotation(m.alternative.rotation)))
    if len(m.unobservable):
        first.append(("unobservable", f"{len(m.unobservable)} of the six directions of (w, d)"))
    variance = translation @ m.covariance[3:, 3:] @ translation
    text = f"moved {format_length(float(np.linalg.norm(translation)), m.unit)}"
    if is_pose:
        text = f"at {format_position(translation)}"
    elif not np.isfinite(variance) or m.status is Status.SCALE_NOT_OBSERVABLE:
        text = "translation not observable"
    text += f", {m.n_inliers.sum()} inliers in {len(m.inliers)} cameras"
    return Summary(f"{_rotation_brief(m, m.rotation)}, {text}", [*first, *rows], _status_sentence(m))


def _summarize_rotation(estimate: Any) -> Summary:
    """Summarize a `RotationEstimate`, with the rows of its own class."""
    n_unobservable = len(estimate.unobservable)
    rows = [("unobservable", f"rotation about {n_unobservable} of three axes")] if n_unobservable else []
    rows += [("iterations", str(estimate.iterations)), *_find_by_class(_ROTATION_ROWS, estimate)(estimate)]
    if not np.isfinite(estimate.rotation).all():
        return Summary(estimate.status.value, rows, _status_sentence(estimate))
    rotation = Rotation.from_matrix(estimate.rotation)
    rows = [("rotation", format_rotation(rotation, estimate.covariance)), *rows]
    return Summary(_rotation_brief(estimate, rotation), rows, _status_sentence(estimate))


def _summarize_one_camera(solution: Any) -> Summary:
    if not np.isfinite(solution.rotations).all():
        return Summary(solution.status.value, sentence=_status_sentence(solution))
    first, second = (Rotation.from_matrix(R) for R in solution.rotations)
    sure, mirrored = (invert_information(information) for information in solution.information)
    rows = [("rotated", format_rotation(first, sure)), ("or, mirrored", format_rotation(second, mirrored))]
    brief = f"{_rotation_brief(solution, first)} or {format_rotation(second)}"
    return Summary(brief, rows, _status_sentence(solution))


def _summarize_frame(pose: Any) -> Summary:
    rows = [("reason", pose.reason)] if pose.reason else []
    if pose.world_from_object is not None:
        angles, sd = format_vector(np.degrees(pose.pan_tilt_roll)), format_vector(np.degrees(pose.sigma[:3]), 3)
        rows.append(("pan, tilt, roll", f"{angles}°, ± {sd}° about x, y, z"))
        rows.append(("position", format_with_sd(pose.position, pose.sigma[3:])))
    if pose.observability is not Observability.ALL:
        rows.append(("unobservable", pose.observability.text))
    n_matches = pose.matches if len(pose.matches) else pose.inliers
    for c, numbers in enumerate(zip(pose.inliers, n_matches, pose.residuals, strict=True)):
        rows.append((f"camera {c}", format_inliers(*numbers)))
    status = f"frame {pose.index}, time {pose.time:.3f}: {pose.status.value}"
    return Summary(status, [*rows, *_fault_rows(pose.faults)], f"{status}. {pose.status.text}")


def _summarize_trajectory(trajectory: Any) -> Summary:
    measured, mask, unit = [f for f in trajectory if f.is_measured], trajectory.measured_mask, trajectory.unit
    brief = f"{len(measured)} of {len(trajectory)} frames with a pose"
    counts = Counter(f.status.value for f in trajectory).most_common()
    rows = [("frames", ", ".join(f"{status} {count}" for status, count in counts))] if counts else []
    if measured:
        angles, positions = np.degrees(trajectory.rotation_angles[mask]), trajectory.positions[mask]
        distance = format_length(float(np.linalg.norm(positions[-1] - positions[0])), unit)
        path = format_length(float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()), unit)
        brief += f", rotated {angles[-1]:.1f}°, moved {distance}"
        rows += [
            ("time", f"{measured[0].time:.3f} to {measured[-1].time:.3f}"),
            ("rotation", f"{angles[-1]:.1f}° from the first to the last, {angles.max():.1f}° at most"),
            ("translation", f"{distance} from the first to the last, along a path of {path}"),
        ]
    cameras = []
    for c, name in enumerate(trajectory.camera_names):
        used = [(f.inliers[c], f.residuals[c]) for f in measured if f.inliers[c] > 0]
        medians = ", median {:.0f} inliers, residual {:.2f} px".format(*np.median(used, axis=0)) if used else ""
        cameras.append((name, f"used in {len(used)} frames{medians}"))
    return Summary(brief, [*rows, *truncate_rows(cameras)])


def _summarize_motion_view(view: Any) -> Summary:
    if view.motion is None:
        return Summary(view.status.value, sentence=_status_sentence(view))
    rows = [
        ("rotation", format_rotation(view.motion.rotation, view.covariance[:3, :3])),
        ("right, down, away", format_with_sd(view.center_translation, view.sigma[3:])),
    ]
    return Summary(_rotation_brief(view, view.motion.rotation), rows, _status_sentence(view))


def _summarize_camera(camera: Any) -> Summary:
    image = f"{camera.size[0]} x {camera.size[1]} pixels, focal length {camera.focal:.0f}"
    lens = f"{camera.lens} {format_vector(camera.distortion, 4)}" if camera.distortion.any() else "no distortion"
    pose = f"at {format_position(camera.center)}, looking along {format_vector(camera.direction)}"
    return Summary(f"{camera.name}, {image}", [("image", image), ("lens", lens), ("pose", pose)])


def _summarize_rig(rig: Any) -> Summary:
    brief = f"{len(rig)} camera{'s' if len(rig) > 1 else ''}, lengths in {rig.unit or 'an unknown unit'}"
    return Summary(brief, truncate_rows([(c.name, "; ".join(text for _, text in summarize(c).rows)) for c in rig]))


def _summarize_matches(matches: Any) -> Summary:
    text = f"{len(matches)} points in two frames"
    if len(matches):
        moved = np.median(np.linalg.norm(matches.y - matches.x, axis=1))
        text += f", moved by {moved:.3g} of the focal length (median)"
    return Summary(text)


def _summarize_known_object(known: Any) -> Summary:
    numbers = f"{len(known.positions)} landmarks, {len(known._keyframes)} keyframes"
    cameras = [(name, f"{len(memory.landmarks.mean)} landmarks") for name, memory in known._cameras.items()]
    return Summary(f"radius {format_length(known.radius, known.unit)}, {numbers}", truncate_rows(cameras))


def _summarize_batch(batch: Any) -> Summary:
    return Summary(f"{len(batch)} problems, {int(batch.certified.sum())} of them certified as globally optimal")


def _distributed_rows(solution: Any) -> list[tuple[str, str]]:
    spread = f"within {np.degrees(solution.spread):.2g}° of each other"
    return [
        ("cameras", f"{int(solution.converged.sum())} of {len(solution.converged)} converged, {spread}"),
        ("sent", f"{int(solution.sent.sum())} bytes in total by all cameras"),
        format_optimality(solution.certified),
        *_fault_rows([text for _, text in sorted(solution.faults.items())]),
    ]


def _depth_plane_rows(solution: Any) -> list[tuple[str, str]]:
    return [("cameras", f"{int(np.isfinite(solution.sigma).sum())} of {len(solution.sigma)} with enough matches")]


def _known_depth_rows(solution: Any) -> list[tuple[str, str]]:
    translation = f"{format_vector(solution.center_translation, 4)} of the points' center"
    return [("translation", translation), *_optimality_rows(solution)]


def _optimality_rows(solution: Any) -> list[tuple[str, str]]:
    return [format_optimality(solution.certified, len(solution.candidates))]


def _fault_rows(faults: Iterable[str]) -> list[tuple[str, str]]:
    return [("at fault", fault) for fault in faults]


def _status_sentence(thing: Any) -> str:
    return f"{thing.status.value}. {thing.status.text}"


def _rotation_brief(thing: Any, rotation: Rotation) -> str:
    return f"{thing.status.value}, rotated {format_rotation(rotation)}"


# By class name.
_SUMMARIES: dict[str, Callable[[Any], Summary]] = {
    "Camera": _summarize_camera,
    "CentralizedBatch": _summarize_batch,
    "Diagnosis": lambda diagnosis: Summary(diagnosis.text),
    "FramePose": _summarize_frame,
    "KnownObject": _summarize_known_object,
    "Matches": _summarize_matches,
    "Motion": _summarize_motion,
    "MotionView": _summarize_motion_view,
    "OneCameraSolution": _summarize_one_camera,
    "Rig": _summarize_rig,
    "RotationEstimate": _summarize_rotation,
    "Trajectory": _summarize_trajectory,
}
# Further rows of the classes of rotation estimates.
_ROTATION_ROWS: dict[str, Callable[[Any], list[tuple[str, str]]]] = {
    "RotationEstimate": lambda _: [],
    "CentralizedSolution": _optimality_rows,
    "DepthPlaneSolution": _depth_plane_rows,
    "DistributedSolution": _distributed_rows,
    "KnownDepthSolution": _known_depth_rows,
    "RobustSolution": lambda solution: [("cameras", solution.diagnosis.text)],
}
