"""Trajectory files, plots, overlay videos and rig pictures."""

from __future__ import annotations

import csv
import errno
import shutil
import tomllib
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import av
import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.atomic_io import make_output_folder, output_errors
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.geometry.euler_angles import parse_euler_angles
from sylpose.report import drawing, overlay, plots
from sylpose.report.files import TrajectoryWriter, read_trajectory, read_tum, write_trajectory, write_tum
from sylpose.report.overlay import OverlayObject, OverlayWriter
from sylpose.report.plots import draw_trajectory_figure, save_trajectory_plot, summarize_trajectory
from sylpose.report.rigview import compute_view_axes, describe_rig, find_axes_intersection, plot_rig
from sylpose.results import FramePose, Trajectory
from sylpose.rig import Camera, Rig
from sylpose.status import FrameStatus, Observability
from tests.paths import DATA

TEMPLE = DATA / "temple"
NAMES = ("left", "right, upper")


def frame_pose(
    index: int,
    pose: RigidTransform | None,
    status: FrameStatus = FrameStatus.TRACKED,
    sigma: float = 0.01,
    cameras: int = 2,
    time: float | None = None,
) -> FramePose:
    counts = np.full(cameras, 40 + index if pose is not None else 0, dtype=np.int64)
    return FramePose(
        index=index,
        time=index / 7 if time is None else time,
        status=status,
        world_from_object=pose,
        covariance=np.diag(np.full(6, sigma**2 if pose is not None else np.inf)),
        inliers=counts,
        residuals=np.full(cameras, 0.5 if pose is not None else np.nan),
    )


def make_rotating_trajectory(n: int, degrees: float, axis: str = "y", cameras: int = 2) -> Trajectory:
    """Make a trajectory that rotates by `degrees` per frame; frame 2 has no pose, frame 3 no known translation."""
    frames = [frame_pose(0, RigidTransform.from_translation([0, 0, 2.0]), FrameStatus.FIRST, sigma=0, cameras=cameras)]
    for i in range(1, n):
        pose = RigidTransform.from_components(
            [0.01 * i, 0, 2], Rotation.from_rotvec(np.radians(degrees) * i * np.eye(3)["xyz".index(axis)])
        )
        frame = frame_pose(i, pose, cameras=cameras)
        if i == 2:
            frame = frame_pose(i, None, FrameStatus.TOO_FEW_MATCHES, cameras=cameras)
        if i == 3:
            frame = replace(frame, observability=Observability.NO_SCALE)
            frame.covariance[range(3, 6), range(3, 6)] = np.inf
        frames.append(frame)
    return Trajectory(frames, [f"cam_{i}" for i in range(cameras)], "m")


def make_camera_looking_at(
    name: str, place: FloatArray, at: FloatArray, size: tuple[int, int] = (320, 240), roll: float = 0
) -> Camera:
    """Place a camera at `place` looking at `at`, with the world's z up in its image; `roll` rotates it about its axis."""
    z = (at - place) / np.linalg.norm(at - place)
    x = np.cross(z, [0, 0, 1.0])
    x /= np.linalg.norm(x)
    rotation = Rotation.from_rotvec([0, 0, roll]) * Rotation.from_matrix(np.array([x, np.cross(z, x), z]))
    matrix = np.array([[300, 0, (size[0] - 1) / 2], [0, 300, (size[1] - 1) / 2], [0, 0, 1]])
    pose = RigidTransform.from_components(-rotation.apply(place), rotation)
    return Camera(name, size, matrix, np.zeros(5), pose)


def ring(n: int, height: float, sizes: tuple[tuple[int, int], ...] = ((320, 240),)) -> Rig:
    angles = 2 * np.pi * np.arange(n) / n
    places = np.column_stack([2 * np.cos(angles), 2 * np.sin(angles), np.full(n, height)])
    return Rig(
        [make_camera_looking_at(f"cam_{i}", p, np.zeros(3), sizes[i % len(sizes)]) for i, p in enumerate(places)], "m"
    )


def move_rig(rig: Rig, world_from_new: RigidTransform) -> Rig:
    """Return the same rig in other world coordinates."""
    return Rig(
        [
            Camera(c.name, c.size, c.matrix, c.distortion, c.camera_from_world * world_from_new, c.lens)
            for c in rig.cameras
        ],
        rig.unit,
    )


# Files


def test_trajectory_round_trip(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    trajectory = make_rotating_trajectory(9, 33)
    frames = [frame_pose(8, RigidTransform.from_components(rng.normal(size=3), Rotation.random(rng=rng)), time=1.7e9)]
    with TrajectoryWriter(tmp_path / "deep" / "out", NAMES, "mm") as writer:
        for frame in (*trajectory.frames[:-1], *frames):
            writer.write(frame)
    back = read_trajectory(tmp_path / "deep" / "out" / "trajectory.csv")
    assert back.camera_names == NAMES
    assert back.unit == "mm"
    for a, b in zip((*trajectory.frames[:-1], *frames), back, strict=True):
        assert (a.index, a.time, a.status) == (b.index, b.time, b.status)
        assert (a.world_from_object is None) == (b.world_from_object is None)
        np.testing.assert_allclose(a.position, b.position, rtol=1e-11)
        np.testing.assert_allclose(a.pan_tilt_roll, b.pan_tilt_roll, atol=1e-9)
        np.testing.assert_allclose(a.sigma, b.sigma, rtol=1e-5)
        np.testing.assert_array_equal(a.inliers, b.inliers)
        np.testing.assert_allclose(a.residuals, b.residuals, rtol=1e-5)
    times, poses = read_tum(tmp_path / "deep" / "out" / "trajectory.tum")
    np.testing.assert_array_equal(times, back.times[back.measured_mask])
    np.testing.assert_allclose(poses.translation, back.positions[back.measured_mask])


def test_csv_has_empty_cells_instead_of_nan_and_inf(tmp_path: Path) -> None:
    with TrajectoryWriter(tmp_path, NAMES) as writer:
        for frame in make_rotating_trajectory(5, 10):
            writer.write(frame)
    with (tmp_path / "trajectory.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert not {cell.lower() for row in rows for cell in row.values()} & {"nan", "inf", "-inf", "-0", "none"}
    assert rows[2]["status"] == "too few matches"
    assert rows[2]["tx"] == rows[2]["qw"] == rows[2]["pan_deg"] == rows[2]["residual_px_right, upper"] == ""
    assert rows[2]["inliers_right, upper"] == "0"
    assert rows[3]["tx_sd"] == ""
    assert float(rows[1]["pan_deg"]) == pytest.approx(10)
    assert float(rows[1]["ry_sd_deg"]) == pytest.approx(np.degrees(0.01), rel=1e-5)
    assert float(rows[1]["ty_sd"]) == pytest.approx(0.01)


def test_every_line_is_on_disk_at_once(tmp_path: Path) -> None:
    with TrajectoryWriter(tmp_path, NAMES) as writer:
        for i, frame in enumerate(make_rotating_trajectory(5, 10)):
            writer.write(frame)
            assert len(read_trajectory(tmp_path / "trajectory.csv")) == i + 1
            assert (tmp_path / "trajectory.tum").read_text().endswith("\n")
    assert len(read_tum(tmp_path / "trajectory.tum")[0]) == 4


def test_rewritten_frame_replaces_later_frames(tmp_path: Path) -> None:
    """For a node that rejoins the others at an earlier frame."""
    first_pass, second_pass = make_rotating_trajectory(6, 10), make_rotating_trajectory(6, 20)
    with TrajectoryWriter(tmp_path / "both", NAMES) as writer:
        for frame in (*first_pass, *second_pass.frames[3:]):
            writer.write(frame)
    with TrajectoryWriter(tmp_path / "once", NAMES) as writer:
        for frame in (*first_pass.frames[:3], *second_pass.frames[3:]):
            writer.write(frame)
    for name in ("trajectory.csv", "trajectory.tum"):
        assert (tmp_path / "both" / name).read_bytes() == (tmp_path / "once" / name).read_bytes()


def test_exception_keeps_written_frames(tmp_path: Path) -> None:
    trajectory = make_rotating_trajectory(3, 10)

    def interrupted() -> None:
        with TrajectoryWriter(tmp_path, NAMES) as writer:
            writer.write(trajectory[0])
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert len(read_trajectory(tmp_path / "trajectory.csv")) == 1


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_quaternions_do_not_jump(tmp_path: Path, axis: str) -> None:
    trajectory = make_rotating_trajectory(60, 13, axis)
    with TrajectoryWriter(tmp_path, NAMES) as writer:
        for frame in trajectory:
            writer.write(frame)
    quaternions = np.loadtxt(tmp_path / "trajectory.tum")[:, 4:]
    assert quaternions[0, 3] > 0
    assert ((quaternions[1:] * quaternions[:-1]).sum(axis=1) > 0.9).all()


@settings(max_examples=25, deadline=None)
@given(n=st.integers(0, 5), seed=st.integers(0, 2**32 - 1), scale=st.sampled_from([1e-6, 1.0, 1e6]))
def test_tum_round_trip(tmp_path_factory: pytest.TempPathFactory, n: int, seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    poses = RigidTransform.from_components(scale * rng.normal(size=(n, 3)), Rotation.from_quat(rng.normal(size=(n, 4))))
    times = np.cumsum(rng.uniform(size=n)) + 1.7e9 * (seed % 2)
    path = tmp_path_factory.mktemp("tum") / "a.tum"
    write_tum(path, times, poses, "m")
    times_back, back = read_tum(path)
    np.testing.assert_array_equal(times_back, times)
    assert len(back) == n
    np.testing.assert_allclose(back.translation, poses.translation, rtol=1e-11)
    np.testing.assert_allclose((back.rotation * poses.rotation.inv()).magnitude(), np.zeros(n), atol=1e-10)


@pytest.mark.skipif(not TEMPLE.exists(), reason="../shared/data/temple is not there")
def test_a_real_tum_file() -> None:
    times, poses = read_tum(TEMPLE / "groundtruth.tum")
    np.testing.assert_array_equal(times, np.arange(7))
    assert np.degrees(poses.rotation[6].magnitude()) == pytest.approx(6 * 7.66, abs=0.1)


def test_unwritable_output_is_reported(tmp_path: Path) -> None:
    blocker = tmp_path / "file.txt"
    blocker.write_text("")
    with pytest.raises(OSError, match=r"file\.txt: it is a file, a folder was expected"):
        TrajectoryWriter(blocker, NAMES)
    with pytest.raises(OSError, match=r"cannot write .*file\.txt/out: not a directory"):
        make_output_folder(blocker / "out")
    message = r"^cannot write out: permission denied; choose another folder, for results with --out$"
    with pytest.raises(OSError, match=message), output_errors("out"):
        raise PermissionError(errno.EACCES, "Permission denied")
    (tmp_path / "taken" / "trajectory.csv").mkdir(parents=True)
    with pytest.raises(OSError, match=r"cannot write .*trajectory\.csv: is a directory"):
        TrajectoryWriter(tmp_path / "taken", NAMES)
    for write in (
        lambda path: save_trajectory_plot(make_rotating_trajectory(4, 5), path),
        lambda path: plot_rig(ring(3, 1), path),
        lambda path: OverlayWriter(path, ring(3, 1), 5),
        lambda path: write_tum(path, [0.0], RigidTransform.identity(1)),
    ):
        with pytest.raises(OSError, match=r"cannot write .*file\.txt"):
            write(blocker / "a.png")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_full_disk_is_reported(tmp_path: Path) -> None:
    (tmp_path / "trajectory.csv").symlink_to("/dev/full")
    with pytest.raises(OSError, match=r"cannot write .*trajectory\.csv: no space left on device"):
        TrajectoryWriter(tmp_path, NAMES)


def test_wrong_number_of_cameras_is_rejected(tmp_path: Path) -> None:
    with (
        TrajectoryWriter(tmp_path, NAMES) as writer,
        pytest.raises(ValueError, match="frame 0: 3 inlier counts and 3 residuals for 2 cameras"),
    ):
        writer.write(make_rotating_trajectory(3, 5, cameras=3)[0])


def test_invalid_trajectory_files_are_rejected(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match=r"t\.csv: not a sylpose trajectory, columns missing: index, time"):
        read_trajectory(path)
    path.write_text("")
    with pytest.raises(ValueError, match=r"t\.csv: not a sylpose trajectory"):
        read_trajectory(path)
    with TrajectoryWriter(tmp_path, NAMES) as writer:
        for frame in make_rotating_trajectory(4, 5):
            writer.write(frame)
    whole = (tmp_path / "trajectory.csv").read_text()
    for broken in (whole[:-30], whole.replace("too few matches", "too few stars"), whole.replace(",2,", ",two,")):
        path.write_text(broken)
        with pytest.raises(ValueError, match=r"t\.csv: line \d: "):
            read_trajectory(path)
    for line in ("1 2 3\n", "0 0 0 0 0 0 0 0\n", "0 0 0 nan 0 0 0 1\n", "0 a b c 0 0 0 1\n"):
        path.write_text(f"# comment\n\n0 0 0 0 0 0 0 1\n{line}")
        with pytest.raises(ValueError, match=r"t\.csv: line 4: "):
            read_tum(path)
    with pytest.raises(FileNotFoundError, match="nowhere"):
        read_trajectory(tmp_path / "nowhere.csv")
    with pytest.raises(ValueError, match="for 1 poses"):
        write_tum(path, [0.0, 1.0], RigidTransform.identity())


# Plots


@pytest.mark.parametrize("end", ["png", *(pytest.param(end, marks=pytest.mark.slow) for end in ("svg", "pdf"))])
def test_equal_reports_are_equal_files(tmp_path: Path, end: str) -> None:
    files = [tmp_path / f"{k}.{end}" for k in range(2)]
    for file in files:
        save_trajectory_plot(make_rotating_trajectory(6, 9), file, note="demo")
    assert files[0].read_bytes() == files[1].read_bytes()
    magic = {"png": b"\x89PNG", "svg": b"<?xml", "pdf": b"%PDF"}
    assert files[0].read_bytes().startswith(magic[end])


@pytest.mark.parametrize("n", [1, 6, *(pytest.param(n, marks=pytest.mark.slow) for n in (3, 120))])
def test_report_of_any_length(tmp_path: Path, n: int) -> None:
    save_trajectory_plot(make_rotating_trajectory(n, 9, cameras=3), tmp_path / "report.png")
    picture = cv2.imread(str(tmp_path / "report.png"))
    assert picture is not None
    assert min(picture.shape[:2]) > 800
    assert picture.std() > 10


def test_report_without_any_pose(tmp_path: Path) -> None:
    lost = Trajectory([frame_pose(i, None, FrameStatus.NO_MOTION) for i in range(4)], NAMES)
    save_trajectory_plot(lost, tmp_path / "report.png")
    assert summarize_trajectory(lost) == "0 of 4 frames with a pose"
    reasons = [f"cam_{k} is dark" for k in range(4)] * 2 + [f"frame_{k}" for k in range(6)]
    with_reasons = Trajectory(
        [replace(frame_pose(i, None, FrameStatus.LOST), reason=r) for i, r in enumerate(reasons)], NAMES
    )
    save_trajectory_plot(with_reasons, tmp_path / "why.svg", note="cup_$1, méthode <x>")
    figure_text = " ".join("".join(text.itertext()) for text in ElementTree.parse(tmp_path / "why.svg").iter())
    for words in (
        FrameStatus.LOST.text[:40],
        "2 frames: cam_3 is dark",
        "and 2 more reasons",
        "cup_$1, méthode <x>",
    ):
        assert words in figure_text, words
    with pytest.raises(ValueError, match="no frames"):
        save_trajectory_plot(Trajectory([], NAMES), tmp_path / "none.png")
    assert not (tmp_path / "none.png").exists()


def test_summary_text() -> None:
    assert summarize_trajectory(make_rotating_trajectory(6, 10)) == (
        "5 of 6 frames with a pose, rotated 50.0° from first to last frame, moved 50 mm, residual 0.50 px (median)"
    )
    assert "translation scale not observable" in summarize_trajectory(make_rotating_trajectory(4, 10))


def test_coasting_is_in_the_summary(tmp_path: Path) -> None:
    frames = list(make_rotating_trajectory(10, 10))
    frames[5:7] = [replace(frame, status=FrameStatus.COASTING) for frame in frames[4:6]]
    trajectory = Trajectory(frames, NAMES, "m")
    assert "coasting in 2" in summarize_trajectory(trajectory)
    save_trajectory_plot(trajectory, tmp_path / "report.png")
    assert cv2.imread(str(tmp_path / "report.png")) is not None


def test_frames_of_unknown_length_are_shaded(tmp_path: Path) -> None:
    plain = make_rotating_trajectory(10, 10)
    straight = [replace(f, observability=Observability.NO_TRANSLATION_SCALE) if 5 <= f.index < 8 else f for f in plain]
    panel = Figure().add_subplot()
    (_, _, entry) = plots._shade_frames([panel], Trajectory(straight, NAMES, "m"))
    assert entry.get_label() == "translation scale not observable"
    colors = [patch.get_facecolor()[:3] for patch in panel.patches]
    assert colors.count(to_rgb(plots.UNKNOWN_LENGTH_COLOR)) == 1
    (strip,) = [p for p in panel.patches if p.get_facecolor()[:3] == to_rgb(plots.UNKNOWN_LENGTH_COLOR)]
    low, high = strip.get_extents().transformed(panel.transData.inverted()).intervalx
    assert (low, high) == (pytest.approx(4.5 / 7), pytest.approx(7.5 / 7))
    assert len(plots._shade_frames([panel], plain)) == 2
    save_trajectory_plot(Trajectory(straight, NAMES, "m"), tmp_path / "report.png")
    assert (tmp_path / "report.png").stat().st_size > 10_000


@pytest.mark.parametrize(("axis", "column"), [("y", 0), ("x", 1), ("z", 2)])
def test_plotted_angles_match_csv_and_break_at_wraps(axis: str, column: int, tmp_path: Path) -> None:
    trajectory = make_rotating_trajectory(90, 7.3, axis)
    write_trajectory(tmp_path, trajectory)
    with (tmp_path / "trajectory.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["pan_deg"]]
    in_csv = np.array([[float(row[f"{name}_deg"]) for name in ("pan", "tilt", "roll")] for row in rows])
    figure = draw_trajectory_figure(trajectory)
    drawn = np.column_stack([line.get_ydata() for line in figure.axes[0].get_lines()[:3]]).astype(float)
    np.testing.assert_allclose(drawn[np.isfinite(drawn).all(axis=1)], in_csv, atol=1e-6)
    steps = np.abs(np.diff(drawn, axis=0))
    assert np.nanmax(steps) < plots.JUMP_DEG
    assert np.nanmax(np.abs(np.diff(in_csv[:, column]))) > (plots.JUMP_DEG if axis != "x" else 7.0)


def test_other_angles_have_columns_and_are_plotted(tmp_path: Path) -> None:
    trajectory = make_rotating_trajectory(30, 7.3, "z")
    about = parse_euler_angles("ZXZ")
    write_trajectory(tmp_path, trajectory, angles=about)
    with (tmp_path / "trajectory.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    for row, pose in zip(rows, trajectory, strict=True):
        own = [row["angle1_Z_deg"], row["angle2_X_deg"], row["angle3_Z_deg"]]
        if pose.world_from_object is None:
            assert own == ["", "", ""]
            continue
        turn = about.to_rotation(np.radians([float(cell) for cell in own])) * pose.world_from_object.rotation.inv()
        assert turn.magnitude() < 1e-7
    read = read_trajectory(tmp_path / "trajectory.csv")
    np.testing.assert_allclose(read.positions, trajectory.positions, atol=1e-9)
    assert [label for label, _ in plots.angle_labels(parse_euler_angles("XYZ"))] == [
        f"angle{k} (about {c})" for k, c in enumerate("xyz", 1)
    ]
    save_trajectory_plot(trajectory, tmp_path / "report.png", angles=about)
    assert (tmp_path / "report.png").stat().st_size > 10_000


def test_shading_extends_half_a_frame() -> None:
    times = np.array([0.0, 1.0, 2.0, 4.0, 5.0])
    strips = list(plots._compute_intervals(times, np.array([True, False, True, True, False])))
    assert strips == [(-0.5, 0.5), (1.5, 4.5)]


# Overlay


def overlay_frames(path: Path) -> list[Image]:
    with av.open(str(path)) as container:
        return [np.asarray(f.to_ndarray(format="bgr24")) for f in container.decode(video=0)]


def make_blank_images(rig: Rig, value: int = 90) -> list[Image | None]:
    return [np.full((c.size[1], c.size[0], 3), value, np.uint8) for c in rig]


CENTERED = frame_pose(4, RigidTransform.identity(), cameras=3)


def test_overlay_is_readable_while_written(tmp_path: Path) -> None:
    rig = ring(3, 1)
    matches = [(np.full((5, 2), 50.0), np.full((5, 2), 60.0))] * 3
    with OverlayWriter(tmp_path / "o.mp4", rig, 5) as writer:
        for k in range(23):
            writer.write(make_blank_images(rig, 5 * k), [OverlayObject("", CENTERED, matches, 0.3)])
        shutil.copy(tmp_path / "o.mp4", tmp_path / "copy.mp4")
    whole, part = overlay_frames(tmp_path / "o.mp4"), overlay_frames(tmp_path / "copy.mp4")
    assert len(whole) == 23
    # The last second may be missing, with the fragment that was still open.
    assert len(part) >= 15
    np.testing.assert_array_equal(part[14], whole[14])
    assert whole[0].shape[0] % 2 == whole[0].shape[1] % 2 == 0
    with av.open(str(tmp_path / "o.mp4")) as container:
        assert container.streams.video[0].average_rate == 5


@pytest.mark.parametrize("rate", [0.5, 29.97, 240.0])
@pytest.mark.parametrize("encoder", [name for name, _ in overlay.ENCODERS])
def test_overlay_of_mixed_sizes_with_each_encoder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rate: float, encoder: str
) -> None:
    try:
        av.codec.Codec(encoder, "w")
    except ValueError:
        pytest.skip(f"this PyAV has no {encoder}")
    monkeypatch.setattr(overlay, "ENCODERS", [e for e in overlay.ENCODERS if e[0] == encoder])
    rig = ring(5, 1, sizes=((321, 241), (200, 300), (640, 362)))
    pose = frame_pose(1, RigidTransform.identity(), cameras=5)
    images = make_blank_images(rig)
    images[1] = None
    images[2] = np.full((362, 640), 90, np.uint8)
    with OverlayWriter(tmp_path / "o.mp4", rig, rate, max_width=1001) as writer:
        for _ in range(3):
            writer.write(
                images, [OverlayObject("", pose, [None] * 5, 0.5, [np.array([[10.0, 10], [90, 10], [50, 80]])] * 5)]
            )
    frames = overlay_frames(tmp_path / "o.mp4")
    assert len(frames) == 3
    assert frames[0].shape[1] <= 1002


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_overlay_on_full_disk_raises_oserror(tmp_path: Path) -> None:
    """Also on repeated writes: FFmpeg crashes if frames follow a missing header."""
    (tmp_path / "o.mp4").symlink_to("/dev/full")
    rig = ring(3, 1)
    writer = OverlayWriter(tmp_path / "o.mp4", rig, 5)
    for _ in range(3):
        with pytest.raises(OSError, match=r"cannot write .*o\.mp4: no space left on device"):
            writer.write(
                make_blank_images(rig, 0),
                [OverlayObject("", frame_pose(0, RigidTransform.identity(), cameras=3), [None] * 3, 0.5)],
            )
    writer.close()
    writer.close()


def test_axes_are_drawn_at_their_projections(tmp_path: Path) -> None:
    """With one camera and an enlarged tile, each axis' color is at the projection of its midpoint, lens included."""
    camera = make_camera_looking_at("a", np.array([2.0, 1.0, 1.0]), np.zeros(3), (400, 300))
    camera = Camera("a", camera.size, camera.matrix, np.array([-0.3, 0.1, 0.01, 0, 0]), camera.camera_from_world)
    rig = Rig([camera])
    turn = Rotation.from_rotvec([0.3, -0.2, 0.4])
    pose = frame_pose(1, RigidTransform.from_components([0.1, 0.2, -0.1], turn), cameras=1)
    with OverlayWriter(tmp_path / "o.mp4", rig, 5) as writer:
        picture = writer.draw(make_blank_images(rig, 0), [OverlayObject("", pose, [None], 0.5)])
        bar = writer._layout.bar
    scale = picture.shape[1] / 400
    for axis, color in zip(np.eye(3), drawing.AXIS_COLORS, strict=True):
        pixel = camera.project(pose.position + turn.apply(0.25 * axis))[0]
        x, y = np.round((pixel + 0.5) * scale - 0.5).astype(int)
        np.testing.assert_array_equal(picture[bar + y, x], color)


def test_axes_are_not_drawn_where_the_lens_model_folds_back() -> None:
    camera = Camera(
        "a",
        (640, 480),
        np.array([[400, 0, 320], [0, 400, 240], [0, 0, 1.0]]),
        np.array([-0.3, 0, 0, 0]),
        RigidTransform.identity(),
    )
    points = np.array([[0.1, 0, 1], [1.7, 0, 1], [0, 0, -1]])
    assert np.isfinite(camera.project(points)[1]).all()  # inside the image, by the polynomial
    assert 0 < camera.project(points)[1, 0] < 640
    np.testing.assert_array_equal(np.isfinite(drawing.project_points(camera, points))[:, 0], [True, False, False])


def n_painted(picture: NDArray[np.uint8], color: tuple[int, int, int], near: int = 0) -> int:
    return int((np.abs(picture.astype(int) - color) <= near).all(axis=2).sum())


def test_coasting_axes_are_pale_and_dashed(tmp_path: Path) -> None:
    rig = ring(3, 1)
    with OverlayWriter(tmp_path / "o.mp4", rig, 5) as writer:
        measured = writer.draw(make_blank_images(rig), [OverlayObject("", CENTERED, [None] * 3, 0.3)])
        coasting = writer.draw(
            make_blank_images(rig), [OverlayObject("", replace(CENTERED, status=FrameStatus.COASTING), [None] * 3, 0.3)]
        )
    for color in drawing.AXIS_COLORS:
        assert n_painted(measured, color) > 50 > n_painted(coasting, color)
    assert not np.array_equal(
        coasting,
        writer.draw(make_blank_images(rig), [OverlayObject("", frame_pose(4, None, cameras=3), [None] * 3, 0.3)]),
    )


def test_noisy_camera_is_not_green(tmp_path: Path) -> None:
    rig = ring(3, 1)
    with OverlayWriter(tmp_path / "o.mp4", rig, 5) as writer:
        alike = writer.draw(
            make_blank_images(rig),
            [OverlayObject("", replace(CENTERED, residuals=np.array([0.3, 0.3, 0.3])), [None] * 3, 0.3)],
        )
        noisy = writer.draw(
            make_blank_images(rig),
            [OverlayObject("", replace(CENTERED, residuals=np.array([0.3, 3.0, 0.3])), [None] * 3, 0.3)],
        )
    # Letters are antialiased, by OpenCV 4 so much that hardly a pixel has their own color.
    assert n_painted(noisy, overlay.WARN_COLOR, 20) > n_painted(alike, overlay.WARN_COLOR, 20) + 30
    assert n_painted(noisy, overlay.GOOD_COLOR, 20) < n_painted(alike, overlay.GOOD_COLOR, 20) - 30


def test_features_and_rejected_matches_are_drawn_without_pose(tmp_path: Path) -> None:
    rig = ring(3, 1)
    looked_at = [(np.array([[20.0, 30], [40, 30]]), np.array([[60.0, 40]]))] * 3
    lost = replace(frame_pose(4, None, cameras=3), reason="4 of 300 features match what is known of the object")
    with OverlayWriter(tmp_path / "o.mp4", rig, 5) as writer:
        without = writer.draw(make_blank_images(rig), [OverlayObject("", lost, [None] * 3, 0.3)])
        drawn = writer.draw(make_blank_images(rig), [OverlayObject("", lost, [None] * 3, 0.3, candidates=looked_at)])
        with pytest.raises(ValueError, match="3 candidates"):
            writer.draw(make_blank_images(rig), [OverlayObject("", lost, [None] * 3, 0.3, candidates=looked_at[:1])])
    assert n_painted(drawn, overlay.REJECTED_COLOR) > n_painted(without, overlay.REJECTED_COLOR)
    changed = (drawn != without).any(axis=2).sum()
    assert 3 * 20 < changed < 3 * 600


def test_reason_for_missing_pose_is_in_the_files(tmp_path: Path) -> None:
    seen = replace(frame_pose(0, RigidTransform.identity(), cameras=2), matches=np.array([30, 40]))
    lost = replace(frame_pose(1, None, cameras=2), matches=np.array([3, 0]), reason='3 of 90 features, "known"; gone')
    with TrajectoryWriter(tmp_path, ("a", "b")) as writer:
        writer.write(seen)
        writer.write(lost)
        writer.write(frame_pose(2, None, cameras=2))
    back = read_trajectory(tmp_path / "trajectory.csv")
    assert [f.reason for f in back] == ["", lost.reason, ""]
    assert [list(f.matches) for f in back] == [[30, 40], [3, 0], []]


def test_overlay_note_is_in_the_title_bar(tmp_path: Path) -> None:
    rig, drawn = ring(3, 1), []
    for note in ("", "poses as tracked"):
        with OverlayWriter(tmp_path / "o.mp4", rig, 10.0, note=note) as writer:
            drawn.append(
                np.split(
                    writer.draw(make_blank_images(rig), [OverlayObject("", CENTERED, [None] * 3, 0.3)]),
                    [writer._layout.bar],
                )
            )
    (head, below), (noted, below_it) = drawn
    assert n_painted(noted, drawing.GRAY, 20) > n_painted(head, drawing.GRAY, 20) + 30
    np.testing.assert_array_equal(below, below_it)


def test_overlay_of_several_objects(tmp_path: Path) -> None:
    rig = ring(3, 1)
    region = [np.array([[10.0, 10], [90, 10], [50, 80]])] * 3
    lost = frame_pose(4, None, FrameStatus.LOST, cameras=3)
    mug = OverlayObject("mug", CENTERED, [None] * 3, 0.3, region, overlay.object_color(0))
    objects = [mug, OverlayObject("tray", lost, [None] * 3, np.nan, color=overlay.object_color(1))]
    with OverlayWriter(tmp_path / "o.mp4", rig, 5) as writer:
        picture = writer.draw(make_blank_images(rig), objects)
        writer.write(make_blank_images(rig), objects)
        with pytest.raises(ValueError, match="needs 3 matches"):
            writer.write(make_blank_images(rig), [replace(objects[0], matches=[])])
    assert n_painted(picture, overlay.OBJECT_COLORS[0], 60) > 50
    assert n_painted(picture, overlay.BAD_COLOR, 60) > 10
    assert len(overlay_frames(tmp_path / "o.mp4")) == 1


def test_pose_behind_camera_is_not_drawn(tmp_path: Path) -> None:
    rig = ring(3, 1)
    with OverlayWriter(tmp_path / "o.mp4", rig, 5) as writer:
        for place in (rig.cameras[0].center, 3 * rig.cameras[0].center, np.full(3, 1e12)):
            pose = frame_pose(1, RigidTransform.from_translation(place), cameras=3)
            writer.write(
                make_blank_images(rig), [OverlayObject("", pose, [(np.empty((0, 2)), np.empty((0, 2)))] * 3, 0.5)]
            )
        writer.write(
            make_blank_images(rig),
            [OverlayObject("", frame_pose(2, None, FrameStatus.NOT_CONSISTENT, cameras=3), [None] * 3, 0.5)],
        )
    assert len(overlay_frames(tmp_path / "o.mp4")) == 4


def test_empty_overlay_is_closed_without_error(tmp_path: Path) -> None:
    with OverlayWriter(tmp_path / "o.mp4", ring(2, 1), 5) as writer:
        pass
    writer.close()


def test_overlay_bad_input(tmp_path: Path) -> None:
    rig = ring(3, 1)
    for rate in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="rate must be a positive"):
            OverlayWriter(tmp_path / "o.mp4", rig, rate)
    with pytest.raises(ValueError, match="width must be"):
        OverlayWriter(tmp_path / "o.mp4", rig, 5, max_width=10)
    with OverlayWriter(tmp_path / "o.mp4", rig, 5) as writer:
        with pytest.raises(ValueError, match="needs 3 images, one per camera, got 2"):
            writer.write(make_blank_images(rig)[:2], [OverlayObject("", CENTERED, [None] * 3, 0.3)])
        with pytest.raises(ValueError, match="needs 3 matches"):
            writer.write(make_blank_images(rig), [OverlayObject("", CENTERED, [None] * 2, 0.3)])
        with pytest.raises(ValueError, match="camera cam_0: the image is 10x20, its calibration 320x240"):
            writer.write([np.zeros((20, 10, 3), np.uint8), None, None], [OverlayObject("", CENTERED, [None] * 3, 0.3)])


# The rig


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(3, 9), height=st.sampled_from([-1.5, 0.0, 0.8, 3.0]))
def test_view_axes_are_independent_of_the_world(seed: int, n: int, height: float) -> None:
    rng = np.random.default_rng(seed)
    transform = RigidTransform.from_components(rng.normal(size=3), Rotation.random(rng=rng))
    axes = compute_view_axes(move_rig(ring(n, height), transform)) @ transform.rotation.inv().as_matrix()
    np.testing.assert_allclose(axes[2], [0, 0, 1], atol=1e-6)
    # The first camera, at (2, 0), looks ahead; right-handed.
    np.testing.assert_allclose(axes[1], [-1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(np.cross(axes[0], axes[1]), axes[2], atol=1e-9)


def test_view_axes_with_few_or_rolled_cameras() -> None:
    ahead = np.array([0, 5.0, 0])
    pair = Rig(
        [make_camera_looking_at(n, np.array([x, 0, 0]), np.array([x, 5, 0])) for n, x in (("l", -0.1), ("r", 0.1))]
    )
    np.testing.assert_allclose(compute_view_axes(pair), np.eye(3), atol=1e-6)
    single = Rig([make_camera_looking_at("one", np.zeros(3), ahead)])
    np.testing.assert_allclose(compute_view_axes(single), np.eye(3), atol=1e-6)
    # Two of five cameras are rotated by 90 degrees, one is upside down.
    rolls = (0, np.pi / 2, 0, -np.pi / 2, np.pi)
    places = [np.array([2 * np.sin(a), -2 * np.cos(a), 0.7]) for a in np.radians([-70, -35, 0, 35, 70])]
    arc = Rig(
        [
            make_camera_looking_at(f"{i}", p, np.zeros(3), roll=r)
            for i, (p, r) in enumerate(zip(places, rolls, strict=True))
        ]
    )
    assert compute_view_axes(arc)[2] @ [0, 0, 1] > 0.99


def test_intersection_of_optical_axes() -> None:
    point = find_axes_intersection(ring(4, 1))
    assert point is not None
    np.testing.assert_allclose(point, 0, atol=1e-9)
    assert find_axes_intersection(Rig(ring(4, 1).cameras[:1])) is None
    away = Rig([make_camera_looking_at(f"{i}", p, 3 * p) for i, p in enumerate(np.eye(3) + 0.1)])
    assert find_axes_intersection(away) is None
    parallel = Rig([make_camera_looking_at(f"{x}", np.array([x, 0, 0]), np.array([x, 5, 0])) for x in (0.0, 0.3, 0.5)])
    assert find_axes_intersection(parallel) is None


def test_rig_description() -> None:
    rows = describe_rig(ring(4, 0))
    assert [row.name for row in rows] == ["cam_0", "cam_1", "cam_2", "cam_3"]
    np.testing.assert_allclose(rows[0].angles, [0, 90, 180, 90], atol=1e-6)
    np.testing.assert_allclose(rows[0].baselines, [0, 8**0.5, 4, 8**0.5])
    assert rows[0].distance == pytest.approx(2)
    assert rows[0].off_axis == pytest.approx(0, abs=1e-6)
    assert rows[0].field_of_view[0] == pytest.approx(2 * np.degrees(np.arctan(319 / 2 / 300)))
    assert describe_rig(ring(4, 0), [0, 0, 2.0])[0].off_axis == pytest.approx(45)
    alone = describe_rig(Rig(ring(4, 0).cameras[:1]))[0]
    assert np.isnan(alone.distance)
    assert np.isnan(alone.off_axis)


def test_pictures_of_rigs(tmp_path: Path) -> None:
    for i, (rig, center) in enumerate(
        (
            (ring(12, 1), None),
            (ring(5, 0), [0.1, 0, 0]),
            (Rig(ring(4, 1).cameras[:2]), None),
            (Rig(ring(2, 1).cameras[:1]), None),
        )
    ):
        plot_rig(rig, tmp_path / f"{i}.png", center, 0.2 if center else None)
        picture = cv2.imread(str(tmp_path / f"{i}.png"))
        assert picture is not None
        assert 400 < min(picture.shape[:2]) <= max(picture.shape[:2]) < 2000
    with pytest.raises(ValueError, match="center must be three finite numbers"):
        plot_rig(ring(3, 1), tmp_path / "a.png", [0, np.nan, 0])
    with pytest.raises(ValueError, match="radius must be a positive"):
        plot_rig(ring(3, 1), tmp_path / "a.png", None, -1.0)


@pytest.mark.skipif(not TEMPLE.exists(), reason="../shared/data/temple is not there")
def test_temple_rig_matches_its_documentation() -> None:
    """4 views 38 degrees apart, around a vertical axis that is the world's y."""
    tables = tomllib.loads((TEMPLE / "calibration.toml").read_text())
    cameras = [
        Camera(
            t["name"],
            tuple(t["size"]),
            np.array(t["matrix"]),
            np.array(t["distortions"]),
            RigidTransform.from_components(t["translation"], Rotation.from_rotvec(t["rotation"])),
        )
        for name, t in tables.items()
        if name != "metadata"
    ]
    rig = Rig(cameras, "m")
    rows = describe_rig(rig, [0.02775, 0.04181, -0.05467])
    assert [round(rows[i].angles[i + 1]) for i in range(3)] == [38, 38, 38]
    assert all(0.5 < row.distance < 0.6 and row.off_axis < 5 for row in rows)
    assert abs(compute_view_axes(rig)[2] @ [0, 1, 0]) > 0.99
