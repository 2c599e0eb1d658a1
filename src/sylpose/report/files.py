"""Trajectories as files: TUM text, CSV with uncertainty and per-camera counts, JSON lines, tables."""

from __future__ import annotations

import csv
import io
import json
import math
import shutil
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.atomic_io import GrowingFile, make_output_folder, partial_path, replace_atomically
from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.euler_angles import EulerAngles
from sylpose.geometry.validation import check_bool, check_type
from sylpose.input_limits import MAX_TABLE_BYTES, input_errors, read_text
from sylpose.kinematics import Kinematics
from sylpose.results import FramePose, Trajectory
from sylpose.status import FrameStatus, Observability

PAGE_FILE = "report.html"


POSE_COLUMNS = ("tx", "ty", "tz", "qx", "qy", "qz", "qw")
ANGLE_COLUMNS = ("pan_deg", "tilt_deg", "roll_deg")
SD_COLUMNS = ("rx_sd_deg", "ry_sd_deg", "rz_sd_deg", "tx_sd", "ty_sd", "tz_sd")
COLUMNS = ("index", "time", "status", "observability", "unit", *POSE_COLUMNS, *ANGLE_COLUMNS, *SD_COLUMNS)
# Per second and per second squared, in world axes; each with its standard deviation.
VELOCITY_COLUMNS = ("vx", "vy", "vz", "ax", "ay", "az")
ANGULAR_COLUMNS = ("wx_deg", "wy_deg", "wz_deg", "dwx_deg", "dwy_deg", "dwz_deg")
# Prefixes of the per-camera columns, followed by the camera's name.
CAMERA_COLUMNS = ("inliers", "residual_px", "variance_inflation", "matches")
LAST_COLUMNS = ("f_ratio", "faults", "reason")


def build_columns(trajectory: Trajectory, kinematics: Kinematics | None = None) -> dict[str, list[Any]]:
    """Build the columns of trajectory.csv (docs/formats.md), not rounded.

    Values are text, integers or floats; NaN where there is no value, infinity for an unbounded standard deviation.

    Args:
        trajectory: the poses of all frames.
        kinematics: their velocities and accelerations, for more columns.
    """
    names = trajectory.camera_names
    per_camera = [f"{what}_{name}" for what in CAMERA_COLUMNS for name in names]
    quaternion, rows = None, []
    for f in trajectory:
        pose, missing = np.full(7, np.nan), np.full(len(names), np.nan)
        if f.world_from_object is not None:
            quaternion = align_quaternion_sign(f.world_from_object.rotation.as_quat(), quaternion)
            pose = np.concatenate([f.position, quaternion])
        cells: list[Any] = [f.index, f.time, f.status.value, f.observability.value, trajectory.unit, *pose.tolist()]
        cells += [*np.degrees(f.pan_tilt_roll).tolist(), *np.degrees(f.sigma[:3]).tolist(), *f.sigma[3:].tolist()]
        for values in (f.inliers, f.residuals, f.variance_inflation, f.matches):
            cells += (values if len(values) else missing).tolist()
        rows.append([*cells, f.f_ratio, "; ".join(f.faults), f.reason])
    columns = [list(column) for column in zip(*rows, strict=True)] or [
        [] for _ in (*COLUMNS, *per_camera, *LAST_COLUMNS)
    ]
    table = dict(zip((*COLUMNS, *per_camera, *LAST_COLUMNS), columns, strict=True))
    return table if kinematics is None else table | build_velocity_columns(kinematics)


def build_velocity_columns(kinematics: Kinematics) -> dict[str, list[float]]:
    """Build the columns of velocities, accelerations and their standard deviations; angles in degrees."""
    table: dict[str, list[float]] = {}
    for d, names, factor in (
        (kinematics.linear, VELOCITY_COLUMNS, 1.0),
        (kinematics.angular, ANGULAR_COLUMNS, np.degrees(1.0)),
    ):
        values = factor * np.hstack([d.velocity, d.acceleration])
        sds = factor * np.hstack([d.velocity_sd, d.acceleration_sd])
        sd_names = [f"{n.removesuffix('_deg')}_sd{'_deg' * n.endswith('_deg')}" for n in names]
        table |= {name: column.tolist() for name, column in zip(names, values.T, strict=True)}
        table |= {name: column.tolist() for name, column in zip(sd_names, sds.T, strict=True)}
    return table


def to_dataframe(trajectory: Trajectory, *, velocity: bool = False) -> Any:
    """Return the columns of trajectory.csv (docs/formats.md) as a `pandas.DataFrame`, not rounded; NaN for no value.

    Args:
        trajectory: the poses of all frames.
        velocity: add velocities and accelerations (`Trajectory.differentiate`).

    Raises:
        ModuleNotFoundError: pandas is not installed.
        ValueError: as `Trajectory.differentiate`.
    """
    try:
        import pandas
    except ModuleNotFoundError as error:
        message = "a DataFrame needs pandas: python3 -m pip install 'sylpose[export]'"
        raise ModuleNotFoundError(message, name=error.name) from None
    check_type(trajectory, Trajectory, "trajectory")
    kinematics = trajectory.differentiate() if check_bool(velocity, "velocity") else None
    return pandas.DataFrame(build_columns(trajectory, kinematics))


def align_quaternion_sign(quaternion: FloatArray, previous: FloatArray | None) -> FloatArray:
    """Choose the quaternion's sign nearer to the previous frame; for the first frame w >= 0."""
    reference = np.array([0.0, 0.0, 0.0, 1.0]) if previous is None else previous
    return -quaternion if quaternion @ reference < 0 else quaternion


_SD_TO_RADIANS = np.array([np.pi / 180] * 3 + [1.0] * 3)


@dataclass(frozen=True, eq=False)
class WriterState:
    """Position of a `TrajectoryWriter` in its files, for resuming.

    Attributes:
        tum_bytes, csv_bytes: lengths of its files.
        quaternion: (4,) the last one written, which determines the sign of the next; None before the first.
    """

    tum_bytes: int
    csv_bytes: int
    quaternion: FloatArray | None


class TrajectoryWriter:
    """Crash-safe writer of `trajectory.tum` and `trajectory.csv`, frame by frame.

    A context manager. Existing files of these names in `out_dir` are replaced; `write_trajectory` keeps them until the
    new ones are complete. Each line is passed to the operating system at once and complete. The quaternion takes the
    sign nearer to the previous frame. Writing an earlier frame again removes it and all later frames from the files,
    so that frames are ordered and unique.

    `trajectory.tum` has the frames in which the object was found: `time tx ty tz qx qy qz qw`, world_from_object.
    `trajectory.csv` has all frames. It adds status, the calibration's length unit, pan, tilt and roll in degrees, and
    standard deviations (rotation about the world's x, y, z in degrees, then position). Per-camera columns are
    `inliers_NAME`, `residual_px_NAME`, `variance_inflation_NAME` and `matches_NAME`; camera faults and the reason for a
    missing pose follow. An empty cell means no value, or an unbounded standard deviation.

    Args:
        out_dir: created if missing.
        camera_names: (C,) names for the per-camera columns, in the order of `FramePose.inliers`.
        unit: the calibration's length unit, or "".
        stem: stem of the file names.
        world: name of the poses' reference frame.
        angles: three additional angles in their own columns, in degrees.
        resume: state of an earlier writer of the same files, to continue from. Later content is overwritten, normally
            by the same bytes, and only cut by `truncate`: a run that fails again loses nothing.

    Raises:
        OSError: a file or folder cannot be written; the message names it.
        ValueError: naming a file that is missing or too short to resume.
    """

    def __init__(
        self,
        out_dir: Path | str,
        camera_names: Sequence[str],
        unit: str = "",
        *,
        stem: str = "trajectory",
        world: str = "world",
        angles: EulerAngles | None = None,
        resume: WriterState | None = None,
    ) -> None:
        folder = make_output_folder(out_dir)
        self.camera_names = tuple(camera_names)
        self.unit, self._angles = unit, angles
        self.tum_path = folder / f"{stem}.tum"
        self.csv_path = folder / f"{stem}.csv"
        self._quaternion = None if resume is None else resume.quaternion
        self._last_index = -1  # the number of the last frame
        per_camera = [f"{what}_{n}" for what in CAMERA_COLUMNS for n in camera_names]
        angle_columns = [] if angles is None else [f"{name}_deg" for name in angles.names]
        self._tum = GrowingFile(self.tum_path, None if resume is None else resume.tum_bytes)
        try:
            self._csv = GrowingFile(self.csv_path, None if resume is None else resume.csv_bytes)
            if resume is None or not resume.csv_bytes:
                self._tum.write(_format_tum_header(unit, world).encode())
                header = [*COLUMNS, *angle_columns, *per_camera, *LAST_COLUMNS]
                self._csv.write(_format_csv_line(header).encode())
        except (OSError, ValueError):
            self.close()
            raise

    def state(self) -> WriterState:
        """Flush both files to disk and return the state to resume from."""
        return WriterState(self._tum.flush(), self._csv.flush(), self._quaternion)

    def read_back(self) -> Trajectory:
        """Read the frames written so far, rounded as in the file."""
        return _parse_trajectory(self._csv.read(0, self._csv.length).decode())

    def truncate(self) -> None:
        """Truncate both files after the last written line."""
        self._tum.truncate(self._tum.length)
        self._csv.truncate(self._csv.length)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close both files; may be called twice."""
        self._tum.close()
        if hasattr(self, "_csv"):
            self._csv.close()

    def write(self, pose: FramePose) -> None:
        """Append one frame to both files.

        Raises:
            ValueError: counts or residuals that do not fit the cameras.
            OSError: the file cannot be written (a full disk); the message names it.
        """
        n = len(self.camera_names)
        if len(pose.inliers) != n or len(pose.residuals) != n:
            raise ValueError(
                f"frame {pose.index}: {len(pose.inliers)} inlier counts and {len(pose.residuals)} residuals for {n} "
                "cameras"
            )
        if pose.index <= self._last_index:
            self._rewind(pose)
        self._last_index = pose.index
        quaternion = np.full(4, np.nan)
        if pose.world_from_object is not None:
            quaternion = align_quaternion_sign(pose.world_from_object.rotation.as_quat(), self._quaternion)
            self._quaternion = quaternion
        inflation = pose.variance_inflation if len(pose.variance_inflation) else np.full(n, np.nan)
        cells = [str(pose.index), _format_exact(pose.time), pose.status.value, pose.observability.value, self.unit]
        cells += [_format_cell(v, 12) for v in (*pose.position, *quaternion)]
        cells += [_format_cell(v, 9) for v in np.degrees(pose.pan_tilt_roll)]
        cells += [_format_cell(v, 6) for v in pose.sigma / _SD_TO_RADIANS]
        if self._angles is not None:
            transform, angles = pose.world_from_object, np.full(3, np.nan)
            if transform is not None:
                angles = self._angles.from_rotation(transform.rotation)
            cells += [_format_cell(v, 9) for v in np.degrees(angles)]
        cells += [str(int(count)) for count in pose.inliers] + [_format_cell(v, 6) for v in pose.residuals]
        cells += ["inf" if np.isinf(v) else _format_cell(v, 4) for v in inflation]
        cells += [str(int(count)) for count in pose.matches] if len(pose.matches) else [""] * n
        cells += [_format_cell(pose.f_ratio, 4), "; ".join(pose.faults), pose.reason]
        # Write the CSV first: after an interrupt in between, the frame is in the file that has every column.
        self._csv.write(_format_csv_line(cells).encode())
        if pose.is_measured:
            self._tum.write(_format_tum_line(pose.time, pose.position, quaternion).encode())

    def _rewind(self, pose: FramePose) -> None:
        """Truncate both files before a frame that is already in them.

        Frame offsets are found by parsing the files: this is rare, and an index of all frames of a day would cost
        memory.
        """
        csv_lines = self.csv_path.read_bytes().splitlines(keepends=True)
        tum_lines = self.tum_path.read_bytes().splitlines(keepends=True)
        kept_csv = [line for k, line in enumerate(csv_lines) if k == 0 or int(line.split(b",", 1)[0]) < pose.index]
        kept_tum = [line for line in tum_lines if line.startswith(b"#") or float(line.split()[0]) < pose.time]
        self._csv.truncate(sum(map(len, kept_csv)))
        self._tum.truncate(sum(map(len, kept_tum)))


def read_trajectory(path: Path | str) -> Trajectory:
    """Read a `trajectory.csv` of `TrajectoryWriter`; covariances have only their diagonal.

    Raises:
        FileNotFoundError: no such file.
        ValueError: naming the file and the line, for missing columns or invalid cells.
    """
    text = read_text(Path(path), MAX_TABLE_BYTES)
    with input_errors(path):
        return _parse_trajectory(text)


def _parse_trajectory(text: str) -> Trajectory:
    rows = csv.reader(io.StringIO(text, newline=""))
    header = next(rows, [])
    columns = set(header)
    missing = [name for name in COLUMNS if name not in columns and name != "observability"]
    names = [name.removeprefix("inliers_") for name in header if name.startswith("inliers_")]
    missing += [f"residual_px_{name}" for name in names if f"residual_px_{name}" not in columns]
    if missing:
        raise ValueError(f"not a sylpose trajectory, columns missing: {', '.join(missing)}")
    frames, unit = [], ""
    for row in rows:
        if not row:
            continue
        try:
            if len(row) != len(header):
                raise ValueError(f"{len(header)} columns are expected, got {len(row)}")
            cells = dict(zip(header, row, strict=True))
            frames.append(_parse_frame(cells, names))
        except (ValueError, OverflowError) as error:
            raise ValueError(f"line {rows.line_num}: {error}") from None
        unit = cells["unit"]
    return Trajectory(frames, names, unit)


def _parse_frame(cells: dict[str, str], names: Sequence[str]) -> FramePose:
    def numbers(columns: Sequence[str], empty: float) -> FloatArray:
        return np.array([float(cells[c]) if cells[c] else empty for c in columns])

    pose = numbers(POSE_COLUMNS, np.nan)
    world_from_object = None
    if not np.isnan(pose).all():
        world_from_object = _to_transforms(pose[None])[0]
    sigma = numbers(SD_COLUMNS, np.inf) * _SD_TO_RADIANS
    # Version 0.1.0 and earlier wrote the observability in the status column.
    status_only = cells["status"] != Observability.NO_SCALE.value
    status = FrameStatus(cells["status"]) if status_only else FrameStatus.TRACKED
    return FramePose(
        index=int(cells["index"]),
        time=float(cells["time"]),
        status=status,
        world_from_object=world_from_object,
        covariance=np.diag(sigma**2),
        inliers=np.array([int(cells[f"inliers_{name}"]) for name in names], dtype=np.int64),
        residuals=numbers([f"residual_px_{name}" for name in names], np.nan),
        observability=Observability(cells.get("observability", Observability.ALL.value))
        if status_only
        else Observability.NO_SCALE,
        variance_inflation=numbers(
            [f"variance_inflation_{name}" for name in names if f"variance_inflation_{name}" in cells], np.nan
        ),
        faults=tuple(cells["faults"].split("; ")) if cells.get("faults") else (),
        matches=np.array([int(cell) for name in names if (cell := cells.get(f"matches_{name}"))], dtype=np.int64),
        reason=cells.get("reason", ""),
        f_ratio=float(cells.get("f_ratio") or "nan"),
    )


def write_trajectory(
    folder: Path | str,
    trajectory: Trajectory,
    *,
    stem: str = "trajectory",
    world: str = "world",
    angles: EulerAngles | None = None,
) -> list[Path]:
    """Write `STEM.tum` and `STEM.csv` like `TrajectoryWriter`, replacing older files only when complete.

    Returns:
        paths of these files.

    Raises:
        OSError: a file or folder cannot be written; the message names it.
    """
    paths = [make_output_folder(folder) / f"{stem}{suffix}" for suffix in (".tum", ".csv")]
    with ExitStack() as stack:
        for path in paths:
            stack.enter_context(replace_atomically(path))
        part = partial_path(paths[0]).stem
        names, unit = trajectory.camera_names, trajectory.unit
        with TrajectoryWriter(folder, names, unit, stem=part, world=world, angles=angles) as writer:
            for pose in trajectory:
                writer.write(pose)
    return paths


def save_trajectory(trajectory: Trajectory, path: Path | str) -> None:
    """Save a trajectory as a table (.csv, all frames) or as TUM text (.tum, measured frames).

    The formats are those of `trajectory.csv` and `trajectory.tum`; `load_trajectory` reads the table.

    Args:
        trajectory: the trajectory.
        path: replaced if it exists.

    Raises:
        TypeError, ValueError: naming the argument: no trajectory, or another ending of the file's name.
        OSError: the file cannot be written; the message names it.
    """
    check_type(trajectory, Trajectory, "trajectory")
    path = Path(path)
    if path.suffix.lower() not in (".csv", ".tum"):
        raise ValueError(f"path: {path} must end in .csv or .tum; `sylpose export` writes other formats")
    with TemporaryDirectory() as folder, replace_atomically(path) as part:
        tum, table = write_trajectory(folder, trajectory)
        shutil.copyfile(tum if path.suffix.lower() == tum.suffix else table, part)


def write_tum(path: Path | str, times: ArrayLike, world_from_object: RigidTransform, unit: str = "") -> None:
    """Write poses as TUM text, `time tx ty tz qx qy qz qw`, with quaternions continuous in sign.

    Args:
        path: replaced if it exists.
        times: (n,) seconds.
        world_from_object: n transforms.
        unit: unit of the positions, for the comment in the first line.

    Raises:
        ValueError: the numbers of times and poses differ.
        OSError: the file cannot be written; the message names it.
    """
    times = np.asarray(times, dtype=float)
    positions = world_from_object.translation.reshape(-1, 3)
    quaternions = world_from_object.rotation.as_quat().reshape(-1, 4)
    if times.shape != (len(positions),):
        raise ValueError(f"times have the shape {times.shape} for {len(positions)} poses")
    lines = [_format_tum_header(unit)]
    quaternion: FloatArray | None = None
    for time, position, q in zip(times, positions, quaternions, strict=True):
        quaternion = align_quaternion_sign(q, quaternion)
        lines.append(_format_tum_line(time, position, quaternion))
    with replace_atomically(path) as part:
        part.write_text("".join(lines), encoding="utf-8")


def read_tum(path: Path | str) -> tuple[FloatArray, RigidTransform]:
    """Read TUM text; lines that start with # are comments.

    Returns:
        (n,) times and n transforms; n may be 0.

    Raises:
        FileNotFoundError: no such file.
        ValueError: naming the file and the line, if it does not have 8 finite numbers.
    """
    rows = []
    for number, line in enumerate(read_text(Path(path), MAX_TABLE_BYTES).splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        with input_errors(path):
            try:
                row = np.array([float(word) for word in line.split()])
                if row.shape != (8,) or not np.isfinite(row[0]):
                    raise ValueError(f"expected 'time tx ty tz qx qy qz qw', got {row.size} numbers")
                _to_transforms(row[None, 1:])
            except ValueError as error:
                raise ValueError(f"line {number}: {error}") from None
        rows.append(row)
    table = np.array(rows).reshape(-1, 8)
    return table[:, 0], _to_transforms(table[:, 1:])


def _to_transforms(rows: FloatArray) -> RigidTransform:
    """Convert rows (n, 7) of position and quaternion to n transforms."""
    if not np.isfinite(rows).all() or (np.abs(np.linalg.norm(rows[:, 3:], axis=1) - 1) > 1e-3).any():
        raise ValueError("a pose needs a finite position and a unit quaternion")
    return RigidTransform.from_components(rows[:, :3], Rotation.from_quat(rows[:, 3:]))


def _format_tum_header(unit: str, world: str = "world") -> str:
    return f"# time tx ty tz qx qy qz qw : {world}_from_object, positions in {unit or 'units of the calibration'}\n"


def _format_tum_line(time: float, position: FloatArray, quaternion: FloatArray) -> str:
    return " ".join([_format_exact(time), *(_format_cell(v, 12) for v in (*position, *quaternion))]) + "\n"


def _format_csv_line(cells: Sequence[str]) -> str:
    line = io.StringIO()
    csv.writer(line, lineterminator="\n").writerow(cells)
    return line.getvalue()


def _format_exact(value: float) -> str:
    """Format a number with all digits and no exponent, such as microseconds since 1970."""
    return np.format_float_positional(float(value), trim="-")


def _format_cell(value: float, digits: int) -> str:
    # Adding 0 converts -0 to 0.
    return f"{float(value) + 0.0:.{digits}g}" if math.isfinite(value) else ""


def format_pose_line(pose: FramePose, camera_names: Sequence[str], unit: str, **extra_fields: object) -> str:
    """Format a frame as one line of JSON without line end: see docs/formats.md, "Lines of JSON".

    Args:
        pose: the frame's pose.
        camera_names: (C,) in the order of `FramePose.inliers`.
        unit: unit of lengths, or "".
        extra_fields: fields that come first.
    """
    transform = pose.world_from_object
    fields = {
        **extra_fields,
        "frame": pose.index,
        "time": pose.time,
        "status": pose.status.value,
        "observability": pose.observability.value,
        "position": None if transform is None else pose.position.tolist(),
        "quaternion": None if transform is None else transform.rotation.as_quat().tolist(),
        "sigma_deg": [_number_or_none(np.degrees(s)) for s in pose.sigma[:3]],
        "sigma_position": [_number_or_none(s) for s in pose.sigma[3:]],
        "unit": unit,
        "inliers": _map_by_camera(camera_names, pose.inliers),
        "matches": _map_by_camera(camera_names, pose.matches),
        "faults": list(pose.faults),
        "reason": pose.reason,
    }
    return json.dumps(fields)


def _map_by_camera(names: Sequence[str], counts: IntArray) -> dict[str, int]:
    """Map camera names to counts; empty if the counts are unknown."""
    return {name: int(n) for name, n in zip(names, counts, strict=True)} if len(counts) else {}


def _number_or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
