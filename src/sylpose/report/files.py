"""Trajectories as files: TUM text, and a CSV with uncertainty, status and per-camera counts."""

from __future__ import annotations

import csv
import io
import math
import os
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.atomic_io import beside, output_folder, replacing, writing
from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.euler_angles import Angles
from sylpose.input_limits import MAX_TABLE, text_of, told
from sylpose.report.tables import COLUMNS, PER_CAMERA, POSE_COLUMNS, SD_COLUMNS, continued
from sylpose.results import FramePose, FrameStatus, Observable, Trajectory

__all__ = ["TrajectoryWriter", "WriterState", "read_trajectory", "read_tum", "write_trajectory", "write_tum"]


_SD_TO_RADIANS = np.array([np.pi / 180] * 3 + [1.0] * 3)


@dataclass(frozen=True, eq=False)
class WriterState:
    """How far a `TrajectoryWriter` has come.

    Attributes:
        tum_bytes, csv_bytes: lengths of its files.
        quaternion: (4,) the last one that was written, which the next one's sign depends on; None before the first.
    """

    tum_bytes: int
    csv_bytes: int
    quaternion: FloatArray | None


class TrajectoryWriter:
    """Writes `trajectory.tum` and `trajectory.csv` frame by frame; what was written survives a crash.

    A context manager. Files of these names in `out_dir` are replaced (`write_trajectory` leaves them until the new ones are
    whole). Each line goes to the operating system whole and at
    once. The quaternion's sign is the one nearer to the frame before. A frame that was written before takes the place of
    what was written then, and of all that came after it: frames are told in order, once.

    `trajectory.tum` has the frames in which the object was found: `time tx ty tz qx qy qz qw`, world_from_object.
    `trajectory.csv` has all frames: also status, the calibration's length unit, pan, tilt, roll in degrees, the standard
    deviations (rotation about the world's x, y, z in degrees, then position), per camera `inliers_NAME`,
    `residual_px_NAME`, `variance_inflation_NAME` and `matches_NAME`, faults of cameras, and why a frame has no pose.
    A cell is empty
    where there is no value; for a standard
    deviation that means unbounded.

    Args:
        out_dir: made when it is not there.
        camera_names: (C,) names for the per-camera columns, in the order of `FramePose.inliers`.
        unit: the calibration's length unit, or "".
        stem: another name for the files.
        world: what the poses are told in, if not in the world.
        angles: three more, in columns of their own, in degrees.
        resume: of an earlier writer of the same files, to go on from there. What was written since is written over, as it
            should be by the same bytes, and is not cut before `cut_rest`: a run that fails once more leaves no less.

    Raises:
        OSError: naming the file or folder that cannot be written.
        ValueError: naming a file that is missing or too short to be gone on with.
    """

    def __init__(
        self,
        out_dir: Path | str,
        camera_names: Sequence[str],
        unit: str = "",
        *,
        stem: str = "trajectory",
        world: str = "world",
        angles: Angles | None = None,
        resume: WriterState | None = None,
    ) -> None:
        folder = output_folder(out_dir)
        self.camera_names = tuple(camera_names)
        self.unit, self._angles = unit, angles
        self.tum_path = folder / f"{stem}.tum"
        self.csv_path = folder / f"{stem}.csv"
        self._quaternion = None if resume is None else resume.quaternion
        self._last = -1  # the number of the last frame
        per_camera = [f"{what}_{n}" for what in PER_CAMERA for n in camera_names]
        own = [] if angles is None else [f"{name}_deg" for name in angles.names]
        self._tum = _open(self.tum_path, None if resume is None else resume.tum_bytes)
        try:
            self._csv = _open(self.csv_path, None if resume is None else resume.csv_bytes)
            if resume is None or not resume.csv_bytes:
                self._put(self._tum, self.tum_path, _tum_header(unit, world))
                self._put(self._csv, self.csv_path, _csv_line([*COLUMNS, *own, *per_camera, "faults", "reason"]))
        except (OSError, ValueError):
            self.close()
            raise

    def state(self) -> WriterState:
        """What it takes to go on from here; all that was written is then on the disk."""
        for file, path in ((self._tum, self.tum_path), (self._csv, self.csv_path)):
            with writing(path):
                os.fsync(file.fileno())
        return WriterState(self._tum.tell(), self._csv.tell(), self._quaternion)

    def written(self) -> Trajectory:
        """The frames up to here, as they were rounded in the file."""
        length = self._csv.tell()
        return _trajectory_in(self.csv_path.read_bytes()[:length].decode())

    def cut_rest(self) -> None:
        """Nothing follows in the files on what was written."""
        for file, path in ((self._tum, self.tum_path), (self._csv, self.csv_path)):
            with writing(path):
                file.truncate(file.tell())

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Closes both files; twice does no harm."""
        self._tum.close()
        if hasattr(self, "_csv"):
            self._csv.close()

    def write(self, pose: FramePose) -> None:
        """Appends one frame to both files.

        Raises:
            ValueError: counts or residuals that do not fit the cameras.
            OSError: naming the file that cannot be written (a full disk).
        """
        n = len(self.camera_names)
        if len(pose.inliers) != n or len(pose.residuals) != n:
            raise ValueError(
                f"frame {pose.index}: {len(pose.inliers)} inlier counts and {len(pose.residuals)} residuals for {n} cameras"
            )
        if pose.index <= self._last:
            self._cut(pose)
        self._last = pose.index
        quaternion = np.full(4, np.nan)
        if pose.world_from_object is not None:
            quaternion = continued(pose.world_from_object.rotation.as_quat(), self._quaternion)
            self._quaternion = quaternion
        doubt = pose.doubt if len(pose.doubt) else np.full(n, np.nan)
        cells = [str(pose.index), _exact(pose.time), pose.status.value, pose.observable.value, self.unit]
        cells += [_cell(v, 12) for v in (*pose.position, *quaternion)]
        cells += [_cell(v, 9) for v in np.degrees(pose.pan_tilt_roll)]
        cells += [_cell(v, 6) for v in pose.sigma / _SD_TO_RADIANS]
        if self._angles is not None:
            its = pose.world_from_object
            cells += [""] * 3 if its is None else [_cell(v, 9) for v in np.degrees(self._angles.of(its.rotation))]
        cells += [str(int(count)) for count in pose.inliers] + [_cell(v, 6) for v in pose.residuals]
        cells += ["inf" if np.isinf(v) else _cell(v, 4) for v in doubt]
        cells += [str(int(count)) for count in pose.matches] if len(pose.matches) else [""] * n
        cells += ["; ".join(pose.faults), pose.reason]
        # The richer file first: with an interrupt in between, the frame is in the file that has everything.
        self._put(self._csv, self.csv_path, _csv_line(cells))
        if pose.measured:
            self._put(self._tum, self.tum_path, _tum_line(pose.time, pose.position, quaternion))

    def _cut(self, pose: FramePose) -> None:
        """Both files before a frame that is there already. What was found of it is in them alone: nothing is kept of all
        frames of a day, for what hardly ever happens."""
        csv_lines = self.csv_path.read_bytes().splitlines(keepends=True)
        tum_lines = self.tum_path.read_bytes().splitlines(keepends=True)
        csv_kept = [line for k, line in enumerate(csv_lines) if k == 0 or int(line.split(b",", 1)[0]) < pose.index]
        tum_kept = [line for line in tum_lines if line.startswith(b"#") or float(line.split()[0]) < pose.time]
        for file, path, kept in ((self._csv, self.csv_path, csv_kept), (self._tum, self.tum_path, tum_kept)):
            length = sum(map(len, kept))
            with writing(path):
                file.truncate(length)
                file.seek(length)

    @staticmethod
    def _put(file: io.FileIO, path: Path, line: str) -> None:
        data = line.encode()
        with writing(path):
            while data:
                data = data[file.write(data) :]


def _open(path: Path, length: int | None) -> io.FileIO:
    """A file to write to: a new one, or after its first `length` bytes; of one that was begun there may be nothing yet."""
    # Without a buffer of its own, a line is with the operating system as soon as `write` returns.
    if length is None or (length == 0 and not path.exists()):
        with writing(path):
            return path.open("wb", buffering=0)
    if not path.is_file() or path.stat().st_size < length:
        raise ValueError(f"{path}: is not as the interrupted run left it, which cannot be gone on with")
    with writing(path):
        file = path.open("r+b", buffering=0)
        file.seek(length)
    return file


def read_trajectory(path: Path | str) -> Trajectory:
    """Reads a `trajectory.csv` of `TrajectoryWriter`; of the covariances only the diagonal is there.

    Raises:
        FileNotFoundError: no such file.
        ValueError: naming the file and the line, for missing columns or cells that are not what they should be.
    """
    text = text_of(Path(path), MAX_TABLE)
    with told(path):
        return _trajectory_in(text)


def _trajectory_in(text: str) -> Trajectory:
    rows = csv.reader(io.StringIO(text, newline=""))
    header = next(rows, [])
    known = set(header)
    missing = [name for name in COLUMNS if name not in known and name != "observability"]
    names = [name.removeprefix("inliers_") for name in header if name.startswith("inliers_")]
    missing += [f"residual_px_{name}" for name in names if f"residual_px_{name}" not in known]
    if missing:
        raise ValueError(f"not a trajectory of sylpose, columns missing: {', '.join(missing)}")
    frames, unit = [], ""
    for row in rows:
        if not row:
            continue
        try:
            if len(row) != len(header):
                raise ValueError(f"{len(header)} columns are expected, got {len(row)}")
            cells = dict(zip(header, row, strict=True))
            frames.append(_frame(cells, names))
        except (ValueError, OverflowError) as error:
            raise ValueError(f"line {rows.line_num}: {error}") from None
        unit = cells["unit"]
    return Trajectory(frames, names, unit)


def _frame(cells: dict[str, str], names: Sequence[str]) -> FramePose:
    def numbers(columns: Sequence[str], empty: float) -> FloatArray:
        return np.array([float(cells[c]) if cells[c] else empty for c in columns])

    pose = numbers(POSE_COLUMNS, np.nan)
    world_from_object = None
    if not np.isnan(pose).all():
        world_from_object = _transforms(pose[None])[0]
    sigma = numbers(SD_COLUMNS, np.inf) * _SD_TO_RADIANS
    # Up to 0.1.0 what can be observed stood in the place of the status.
    status_only = cells["status"] != Observable.NO_SCALE.value
    status = FrameStatus(cells["status"]) if status_only else FrameStatus.TRACKED
    return FramePose(
        index=int(cells["index"]),
        time=float(cells["time"]),
        status=status,
        world_from_object=world_from_object,
        covariance=np.diag(sigma**2),
        inliers=np.array([int(cells[f"inliers_{name}"]) for name in names], dtype=np.int64),
        residuals=numbers([f"residual_px_{name}" for name in names], np.nan),
        observable=Observable(cells.get("observability", Observable.ALL.value)) if status_only else Observable.NO_SCALE,
        doubt=numbers(
            [f"variance_inflation_{name}" for name in names if f"variance_inflation_{name}" in cells], np.nan
        ),
        faults=tuple(cells["faults"].split("; ")) if cells.get("faults") else (),
        matches=np.array([int(cell) for name in names if (cell := cells.get(f"matches_{name}"))], dtype=np.int64),
        reason=cells.get("reason", ""),
    )


def write_trajectory(
    folder: Path | str,
    trajectory: Trajectory,
    *,
    stem: str = "trajectory",
    world: str = "world",
    angles: Angles | None = None,
) -> list[Path]:
    """Writes `STEM.tum` and `STEM.csv`, as a `TrajectoryWriter` does, each whole before it takes an older one's place.

    Returns:
        these files.

    Raises:
        OSError: naming the file or folder that cannot be written.
    """
    paths = [output_folder(folder) / f"{stem}{suffix}" for suffix in (".tum", ".csv")]
    with ExitStack() as whole:
        for path in paths:
            whole.enter_context(replacing(path))
        part = beside(paths[0]).stem
        names, unit = trajectory.camera_names, trajectory.unit
        with TrajectoryWriter(folder, names, unit, stem=part, world=world, angles=angles) as writer:
            for pose in trajectory:
                writer.write(pose)
    return paths


def write_tum(path: Path | str, times: ArrayLike, world_from_object: RigidTransform, unit: str = "") -> None:
    """Writes poses as TUM text, `time tx ty tz qx qy qz qw`, quaternions continuous in sign.

    Args:
        path: replaced when it is there.
        times: (n,) seconds.
        world_from_object: n transforms.
        unit: of the positions, for the comment in the first line.

    Raises:
        ValueError: not as many times as poses.
        OSError: naming the file, when it cannot be written.
    """
    times = np.asarray(times, dtype=float)
    positions = world_from_object.translation.reshape(-1, 3)
    quaternions = world_from_object.rotation.as_quat().reshape(-1, 4)
    if times.shape != (len(positions),):
        raise ValueError(f"times have the shape {times.shape} for {len(positions)} poses")
    lines = [_tum_header(unit)]
    quaternion: FloatArray | None = None
    for time, position, q in zip(times, positions, quaternions, strict=True):
        quaternion = continued(q, quaternion)
        lines.append(_tum_line(time, position, quaternion))
    with replacing(path) as part:
        part.write_text("".join(lines), encoding="utf-8")


def read_tum(path: Path | str) -> tuple[FloatArray, RigidTransform]:
    """Reads TUM text: (n,) times and n transforms; n may be 0. Lines that start with # are comments.

    Raises:
        FileNotFoundError: no such file.
        ValueError: naming the file and the line, when it does not have 8 finite numbers.
    """
    rows = []
    for number, line in enumerate(text_of(Path(path), MAX_TABLE).splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        with told(path):
            try:
                row = np.array([float(word) for word in line.split()])
                if row.shape != (8,) or not np.isfinite(row[0]):
                    raise ValueError(f"expected 'time tx ty tz qx qy qz qw', got {row.size} numbers")
                _transforms(row[None, 1:])
            except ValueError as error:
                raise ValueError(f"line {number}: {error}") from None
        rows.append(row)
    table = np.array(rows).reshape(-1, 8)
    return table[:, 0], _transforms(table[:, 1:])


def _transforms(rows: FloatArray) -> RigidTransform:
    """(n, 7) of position and quaternion -> n transforms."""
    if not np.isfinite(rows).all() or (np.abs(np.linalg.norm(rows[:, 3:], axis=1) - 1) > 1e-3).any():
        raise ValueError("a pose needs a finite position and a unit quaternion")
    return RigidTransform.from_components(rows[:, :3], Rotation.from_quat(rows[:, 3:]))


def _tum_header(unit: str, world: str = "world") -> str:
    return f"# time tx ty tz qx qy qz qw : {world}_from_object, positions in {unit or 'units of the calibration'}\n"


def _tum_line(time: float, position: FloatArray, quaternion: FloatArray) -> str:
    return " ".join([_exact(time), *(_cell(v, 12) for v in (*position, *quaternion))]) + "\n"


def _csv_line(cells: Sequence[str]) -> str:
    line = io.StringIO()
    csv.writer(line, lineterminator="\n").writerow(cells)
    return line.getvalue()


def _exact(value: float) -> str:
    """All digits, without an exponent: times may be seconds since 1970 to the microsecond."""
    return np.format_float_positional(float(value), trim="-")


def _cell(value: float, digits: int) -> str:
    # Adding 0 turns -0 into 0.
    return f"{float(value) + 0.0:.{digits}g}" if math.isfinite(value) else ""
