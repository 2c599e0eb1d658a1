"""Time offsets: speed correlation, retimed sessions, and rendered recordings from end to end."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.rendered_recordings import Recording, write_recording
from sylpose.commands.main import main
from sylpose.geometry.arrays import FloatArray
from sylpose.io.capture import Session, open_session
from sylpose.results import FramePose
from sylpose.simulate import Actor, Scene, arc, chamfered_box
from sylpose.smoothing import SmoothedTrajectory, Track, smooth_tracks
from sylpose.status import FrameStatus, Status
from sylpose.sync import estimation
from sylpose.sync.estimation import OffsetPrecision, TimeOffsets, sync_session, write_offsets
from sylpose.sync.offsets import apply_offsets, load_offsets
from sylpose.sync.speed_correlation import (
    SpeedSignal,
    compute_image_speed,
    estimate_coarse_offsets,
    split_offsets,
    to_small_gray,
)
from sylpose.tracking.camera_side.frame import LandmarkObservations
from sylpose.tracking.tracker import track

RATE = 30.0
CAMERAS = ("cam_0", "cam_1", "cam_2")
# Delays of the cameras of the rendered recording, frames.
LATE = np.array([3.4, -1.0, 0.0])
FRAMES = 48


# --- speeds ------------------------------------------------------------------------------------------------------------


def make_aperiodic_speed(seed: int) -> Callable[[FloatArray], FloatArray]:
    """A speed over time (frames), pixels per frame, that never repeats itself."""
    rng = np.random.default_rng(seed)
    periods, phases = rng.uniform(9, 70, 12), rng.uniform(0, 2 * np.pi, 12)
    return lambda t: np.asarray(2.0 * np.exp(0.3 * np.sin(2 * np.pi * t[:, None] / periods + phases).sum(axis=1)))


def make_speed_signals(
    late: ArrayLike, n: int = 200, noise: float = 0.05, scales: ArrayLike = 1.0, seed: int = 0
) -> tuple[list[SpeedSignal], np.random.Generator]:
    """Speed signals of cameras with given delays in frames, each at its own scale."""
    rng, speed, k = np.random.default_rng(seed), make_aperiodic_speed(seed), np.arange(n) + 0.5
    lags = np.asarray(late, dtype=float)
    shown = []
    for lag, scale in zip(lags, np.broadcast_to(np.asarray(scales, dtype=float), lags.shape), strict=True):
        seen = scale * speed(k + lag) * np.exp(noise * rng.standard_normal(n))
        shown.append(SpeedSignal(np.asarray(k / RATE, dtype=float), np.asarray(seen, dtype=float)))
    return shown, rng


@pytest.mark.parametrize("late", [[0.0, 0.0], [3.4, -1.0, 0.0], [0.25, -40.0, 11.6, 3.0]])
@pytest.mark.parametrize("noise", [0.02, 0.2])
def test_lags_are_found_to_subframe_precision(late: list[float], noise: float) -> None:
    shown, _ = make_speed_signals(late, noise=noise, scales=np.linspace(0.5, 3.0, len(late)))
    found = estimate_coarse_offsets(shown, RATE, 3.0)
    assert found.is_determined.all()
    error = found.offsets * RATE - (np.array(late) - np.mean(late))
    assert np.abs(error).max() < 0.3
    assert found.offsets.mean() == pytest.approx(0.0, abs=1e-12)
    assert (np.abs(error) < 4 * found.sd * RATE + 1e-9).all()


def test_uncorrelated_camera_is_rejected() -> None:
    shown, _ = make_speed_signals([2.0, -2.0, 5.0])
    other, _ = make_speed_signals([0.0], seed=5)
    found = estimate_coarse_offsets([*shown[:2], other[0], shown[2]], RATE, 3.0)
    assert found.is_determined.tolist() == [True, True, False, True]
    assert found.offsets[2] == 0.0
    assert found.sd[2] == np.inf
    assert found.offsets[[0, 1, 3]] * RATE == pytest.approx(np.array([2.0, -2.0, 5.0]) - 5 / 3, abs=0.2)


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_constant_speed_is_inconclusive(noise: float) -> None:
    rng, times = np.random.default_rng(0), np.arange(200) / RATE
    found = estimate_coarse_offsets(
        [SpeedSignal(times, np.exp(noise * rng.standard_normal(200))) for _ in range(3)], RATE, 3.0
    )
    assert not found.is_determined.any()
    assert not found.offsets.any()


def test_periodic_speed_is_inconclusive() -> None:
    times = np.arange(300) / RATE
    found = estimate_coarse_offsets(
        [SpeedSignal(times, 2 + np.sin(2 * np.pi * (times * RATE + o) / 30)) for o in (0, 4)], RATE, 3.0
    )
    assert not found.is_determined.any()


def test_lags_beyond_maximum_are_not_found() -> None:
    assert not estimate_coarse_offsets(make_speed_signals([0.0, 40.0])[0], RATE, 1.0).is_determined.any()


def test_dropped_frames_and_different_clocks() -> None:
    shown, rng = make_speed_signals([1.0, -1.0, 0.0], n=300)
    gappy = []
    for pulse in shown:
        kept = rng.random(300) > 0.1
        kept[100:120] = False
        gappy.append(SpeedSignal(pulse.times[kept] + 0.2, pulse.speeds[kept]))
    found = estimate_coarse_offsets(gappy, RATE, 3.0)
    assert found.is_determined.all()
    assert found.offsets * RATE == pytest.approx([1.0, -1.0, 0.0], abs=0.3)


def test_cameras_without_images_are_inconclusive() -> None:
    nothing = SpeedSignal(np.empty(0), np.empty(0))
    assert not estimate_coarse_offsets([nothing, nothing], RATE, 3.0).is_determined.any()
    assert estimate_coarse_offsets([*make_speed_signals([0.0, 2.0])[0], nothing], RATE, 3.0).is_determined.tolist() == [
        True,
        True,
        False,
    ]


@pytest.mark.parametrize(
    ("rate", "max_lag", "name"), [(0.0, 1.0, "rate"), (30.0, -1.0, "max_lag"), (np.nan, 1.0, "rate")]
)
def test_invalid_rates_and_lags_are_rejected(rate: float, max_lag: float, name: str) -> None:
    with pytest.raises(ValueError, match=f"{name} must be positive"):
        estimate_coarse_offsets([], rate, max_lag)


def test_image_speed() -> None:
    rng = np.random.default_rng(0)
    texture = np.kron(rng.integers(0, 255, (30, 40)), np.ones((8, 8))).astype(np.uint8)
    back = np.full((240, 320, 3), 90, np.uint8)

    def picture(x: float) -> NDArray[np.uint8]:
        image = back.copy()
        image[60:180, 100 + round(x) : 220 + round(x)] = texture[:120, :120, None]
        return image

    def speed(a: float, b: float) -> float:
        return compute_image_speed(to_small_gray(picture(a)), to_small_gray(picture(b)))

    assert speed(0, 0) == 0.0
    assert speed(0, 3) == pytest.approx(3.0, abs=0.1)
    assert speed(5, 0) == pytest.approx(5.0, abs=0.1)
    assert to_small_gray(np.zeros((480, 640, 3), np.uint8)).shape == (240, 320)


# --- whole frames and the rest -----------------------------------------------------------------------------------------


@given(st.lists(st.floats(-200, 200), min_size=1, max_size=8))
def test_split_offsets(late: list[float]) -> None:
    frames, rest = split_offsets(np.array(late) / RATE, RATE)
    assert frames.max() == 0
    assert rest.mean() == pytest.approx(0.0, abs=1e-9)
    assert np.ptp(frames / RATE + rest - np.array(late) / RATE) < 1e-9
    assert np.ptp(rest) * RATE <= 1.0 + 1e-6


def test_small_offsets_need_no_whole_frames() -> None:
    assert split_offsets([0.012, -0.015, 0.0], RATE)[0].tolist() == [0, 0, 0]
    frames, rest = split_offsets(np.array([3.4, -1.0, 0.1]) / RATE, RATE)
    assert frames.tolist() == [0, -4, -3]
    assert rest * RATE == pytest.approx(np.array([3.4, 3.0, 3.1]) - 9.5 / 3)


# --- recordings --------------------------------------------------------------------------------------------------------


def uneven_motion(frame: float) -> RigidTransform:
    """A rotation and a path at varying speed."""
    s = frame + 2.1 * np.sin(frame / 3.1) + 2.5 * np.sin(frame / 5.3 + 1)
    turn = Rotation.from_rotvec(0.03 * s * np.array([0.3, 0.9, 0.3]))
    return RigidTransform.from_components([0.05 * np.sin(s / 9), 0.02 * np.cos(s / 7), 0.03 * np.sin(s / 11)], turn)


def screw_motion(frame: float) -> RigidTransform:
    """A uniform rotation with a uniform translation along its axis."""
    return RigidTransform.from_components([0.002 * frame - 0.05, 0, 0], Rotation.from_rotvec([0.03 * frame, 0, 0]))


def record_videos(
    folder: Path,
    path: Callable[[float], RigidTransform],
    late: FloatArray,
    frames: int,
    drifts: tuple[float, ...] = (),
) -> Path:
    rig = arc(len(late), 40, 1.5, 350, (320, 240), height=0.4)
    scene = Scene(rig, (Actor(chamfered_box([0.3, 0.22, 0.26], 300), path),), frames, 5)
    write_recording(Recording(scene, time_offsets=tuple(late / RATE), drifts=drifts), folder)
    return folder


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_videos(tmp_path_factory.mktemp("late"), uneven_motion, LATE, FRAMES)


def add_timestamps(recording: Path, folder: Path, late: FloatArray) -> Path:
    """The recording with timestamps of cameras delayed by given numbers of frames."""
    folder.mkdir()
    for file in recording.iterdir():
        if file.is_file():
            (folder / file.name).symlink_to(file)
    with (folder / "timestamps.csv").open("w", newline="") as out:
        table = csv.writer(out)
        table.writerow(["frame", *CAMERAS])
        table.writerows([k, *((k + late) / RATE).tolist()] for k in range(FRAMES))
    return folder


def test_offsets_end_to_end(
    recording: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    times_tracked = count_tracking(monkeypatch, track)
    found = run_command(monkeypatch, recording, code=0)
    assert found.tracked == FRAMES
    assert len(times_tracked) == 1
    true = LATE - LATE.mean()
    assert found.precision == (OffsetPrecision.FINE,) * 3
    assert not found.problems
    assert found.offsets * RATE == pytest.approx(true, abs=0.04)
    assert (np.abs(found.offsets - true / RATE) < 3 * found.sd).all()
    assert (found.sd * RATE < 0.06).all()
    assert found.coarse.offsets * RATE == pytest.approx(true, abs=0.5)
    assert (found.after < 1.05 * found.before).all()
    out = capsys.readouterr().out
    assert "cam_0" in out
    assert str(recording / "offsets.toml") in out
    written = load_offsets(recording / "offsets.toml", CAMERAS)
    assert [written[name] for name in CAMERAS] == pytest.approx(found.offsets.tolist(), abs=1e-6)


def run_command(monkeypatch: pytest.MonkeyPatch, recording: Path, code: int) -> TimeOffsets:
    """Run `sylpose sync` and return its estimate."""
    found: list[TimeOffsets] = []

    def estimate(*args: Any, **options: Any) -> TimeOffsets:
        found.append(sync_session(*args, **options))
        return found[-1]

    monkeypatch.setattr(estimation, "sync_session", estimate)
    assert main(["sync", str(recording)]) == code
    return found[0]


def count_tracking(monkeypatch: pytest.MonkeyPatch, tracking: Callable[..., object]) -> list[int]:
    """Return a list that grows by one each time the object is tracked."""
    times: list[int] = []

    def tracked(*args: object, **kwargs: object) -> object:
        times.append(len(times))
        return tracking(*args, **kwargs)

    monkeypatch.setattr(estimation, "track", tracked)
    return times


@pytest.mark.parametrize(
    ("changes", "times", "settles"),
    [
        ([0.45, 0.0], 1, True),
        ([0.4, 0.01, 0.0], 1, True),
        ([0.9, 0.01, 0.0], 2, True),
        ([0.4, 0.4, 0.001, 0.0], 2, True),
        ([0.9, 0.9, 0.9, 0.9], 4, False),
    ],
)
def test_retracking_if_frame_offsets_change(
    recording: Path, monkeypatch: pytest.MonkeyPatch, changes: list[float], times: int, settles: bool
) -> None:
    rest, sd = iter(changes), np.full(3, 0.002 / RATE)

    def smoothed(*_: object, offsets_sd: float | None = None) -> SmoothedTrajectory:
        change = 0.0 if offsets_sd is None else next(rest)
        return SmoothedTrajectory((), Status.OK, change / RATE * np.array([1.0, -1.0, 0.0]), sd, np.ones(3), 3)

    times_tracked = count_tracking(monkeypatch, lambda *_, **__: iter(()))
    monkeypatch.setattr(estimation, "smooth_tracks", smoothed)
    monkeypatch.setattr(estimation, "_image_speeds", lambda *_: np.full(3, 300.0))
    found = sync_session(open_session(recording))
    assert len(times_tracked) == times
    assert found.precision == (OffsetPrecision.FINE,) * 3
    assert found.problems == (() if settles else ("The offsets still change after 4 rounds.",))
    apart = found.offsets - np.array([1.0, -1.0, 0.0]) * sum(changes) / RATE
    assert apart * RATE == pytest.approx(np.round(apart * RATE - apart[2] * RATE) + apart[2] * RATE, abs=1e-6)
    # A hundredth of a pixel of the tracked features' errors correlates with the motion.
    assert found.sd == pytest.approx(np.hypot(sd, estimation.ERROR_ALONG_MOTION_PX / 300.0))


def test_speed_of_tracked_object() -> None:
    rig = arc(2, 40, 1.5, 350, (320, 240))

    def seen(time: float, x: Sequence[float]) -> Track:
        # The first camera observes landmark 7, and another one in each frame; the second camera nothing.
        places = np.column_stack([x, np.zeros(2)]) / 350.0
        own = LandmarkObservations(np.array([7, round(100 * time)]), places, np.zeros((2, 3)), np.ones(2, bool))
        none = LandmarkObservations(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 3)), np.zeros(0, bool))
        pose = FramePose(
            0, time, FrameStatus.TOO_FEW_MATCHES, None, np.zeros((6, 6)), np.zeros(2, np.int64), np.zeros(2)
        )
        return Track(pose, (own, none), np.zeros(2), 0.1)

    # 3 pixels in a tenth of a second, then 8 in two tenths.
    found = estimation._image_speeds([seen(0.1, [1, 50]), seen(0.2, [4, 90]), seen(0.4, [12, 0])], rig)
    assert found[0] == pytest.approx(np.sqrt((30**2 + 40**2) / 3), rel=1e-6)
    assert found[1] < 1e-5


def test_uniform_motion_is_inconclusive(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(estimation, "MAX_ROUNDS", 1)
    record_videos(tmp_path / "screw", screw_motion, np.array([0.0, 0.4, -0.3]), 25)
    found = run_command(monkeypatch, tmp_path / "screw", code=1)
    assert found.precision == (OffsetPrecision.UNOBSERVABLE,) * 3
    assert not found.offsets.any()
    assert np.isinf(found.sd).all()
    assert not (tmp_path / "screw" / "offsets.toml").exists()
    assert "the object's speed must change" in capsys.readouterr().out


def test_clocks_that_drift_apart_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    frames, drift = 96, 0.01
    record_videos(tmp_path / "drift", uneven_motion, np.zeros(3), frames, (0.0, drift, 0.0))
    found = run_command(monkeypatch, tmp_path / "drift", code=0)
    true = drift * (frames - 1) / RATE * np.array([-1.0, 2.0, -1.0]) / 3.0
    assert found.drifts == pytest.approx(true, rel=0.25)
    out = " ".join(capsys.readouterr().out.split())
    assert f"cam_1 by {1e3 * found.drifts[1]:+.1f} ms" in out
    assert "timestamps.csv" in out


@pytest.mark.parametrize("drift", [0.0, 0.003])
def test_drifts_are_significant(monkeypatch: pytest.MonkeyPatch, drift: float) -> None:
    """Scatter of the parts' offsets beyond their standard deviations is no drift."""
    rng, sd, n_drifts = np.random.default_rng(0), 0.002, 0
    rig = arc(3, 40, 1.5, 350, (320, 240))

    def smoothed(part: Sequence[Track], *_: object, **__: object) -> SmoothedTrajectory:
        middle = np.mean([track.pose.time for track in part])
        values = drift * middle * np.array([1.0, -1.0, 0.0]) + 3.0 * sd * rng.standard_normal(3)
        values -= values.mean()
        return SmoothedTrajectory((), Status.OK, values, np.full(3, sd), np.ones(3), 3)

    monkeypatch.setattr(estimation, "smooth_tracks", smoothed)
    nothing = np.zeros((6, 6)), np.zeros(3, np.int64), np.zeros(3)
    tracks = [
        Track(FramePose(k, float(k), FrameStatus.TRACKED, RigidTransform.identity(), *nothing), (), np.zeros(3), 0.1)
        for k in range(96)
    ]
    for _ in range(50):
        scatter, drifts = estimation._compare_parts(tracks, rig, 1.0)
        assert scatter > 1.0
        n_drifts += bool(drifts.any())
        if drifts.any():
            assert drifts == pytest.approx(95 * drift * np.array([1.0, -1.0, 0.0]), abs=0.06)
    assert n_drifts == 0 if not drift else n_drifts > 45


def by_camera(offsets: FloatArray) -> dict[str, float]:
    return {f"cam_{c}": float(offset) for c, offset in enumerate(offsets)}


def shown_frames(session: Session, camera: int) -> list[int]:
    return [int(k) for k in session.timeline.frames[:, camera]]


def test_retimed_session(recording: Path) -> None:
    session = open_session(recording)
    moved = apply_offsets(session, by_camera(LATE / RATE))
    # cam_1 and cam_2 start 4 and 3 frames before cam_0.
    assert [shown_frames(moved, c)[0] for c in range(3)] == [0, 4, 3]
    assert shown_frames(moved, 0) == list(range(FRAMES))
    assert shown_frames(moved, 1)[-5:] == [FRAMES - 1, -1, -1, -1, -1]
    late = moved.timeline.stamps - moved.timeline.times[:, None]
    assert late[0] * RATE == pytest.approx(np.array([3.4, 3.0, 3.0]) - 9.4 / 3)
    assert np.isnan(late[-1, 1])
    assert any("cam_1 4" in warning for warning in moved.warnings)
    assert apply_offsets(session, {"cam_1": 0}) is session


def test_timestamps_are_retimed(recording: Path, tmp_path: Path) -> None:
    session = open_session(add_timestamps(recording, tmp_path / "stamped", np.array([0.0, 0.2, 0.0])))
    moved = apply_offsets(session, by_camera(np.array([3.4, -1.2, 0.0]) / RATE))
    k = moved.timeline.frames
    shown = np.where(k >= 0, (k + LATE) / RATE, np.nan)
    assert moved.timeline.stamps == pytest.approx(shown, abs=1e-6, nan_ok=True)
    assert moved.timeline.times == pytest.approx(np.nanmean(shown, axis=1), abs=1e-6)
    assert np.ptp(moved.timeline.stamps[0]) * RATE < 0.5


@pytest.mark.parametrize(
    ("offsets", "said"),
    [
        ({"cam_1": 0.1, "cam_7": 0.2}, "no camera 'cam_7' in the rig .cam_0, cam_1, cam_2."),
        ({"cam_1": np.nan}, "offsets: cam_1: nan is not a finite number"),
        ({"cam_1": 1e6}, "offsets: cam_1: .* at most 86400"),
        ({"cam_2": 5.0}, "cam_0 ends before the last camera begins"),
    ],
)
def test_invalid_offsets_are_rejected(recording: Path, offsets: dict[str, float], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        apply_offsets(open_session(recording), offsets)


def test_unsynchronizable_recordings_are_rejected(recording: Path) -> None:
    session = open_session(recording)
    timeless = replace(session, timeline=replace(session.timeline, rate=None))
    with pytest.raises(ValueError, match=r"provide videos or timestamps\.csv"):
        sync_session(timeless)
    alone = replace(session, rig=session.rig.subset(["cam_0"]))
    with pytest.raises(ValueError, match="at least two cameras"):
        sync_session(alone)
    with pytest.raises(ValueError, match="start must be in"):
        sync_session(session, start=1000)
    with pytest.raises(ValueError, match="max_lag must be positive"):
        sync_session(session, max_lag=0.0, stop=3)


def test_interrupt_preserves_offsets(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(estimation, "estimate_coarse_offsets", interrupt)
    file = tmp_path / "offsets.toml"
    file.write_text("cam_0 = 0.25\n")
    assert main(["sync", str(recording), "--out", str(file), "--stop", "3"]) == 130
    assert capsys.readouterr().err.endswith(f"sylpose: interrupted; {file} is unchanged\n")
    assert file.read_text() == "cam_0 = 0.25\n"


def test_untrackable_recording_keeps_whole_frame_offsets(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(estimation, "track", lambda *_, **__: iter(()))
    found = sync_session(open_session(recording))
    assert found.precision == (OffsetPrecision.COARSE,) * 3
    assert found.offsets * RATE == pytest.approx(
        np.round(LATE - LATE.max()) - np.round(LATE - LATE.max()).mean(), abs=1.0
    )
    assert found.problems == ("The object could not be tracked, so its poses give no offsets.",)


def test_refinement_that_does_not_converge_gives_no_offsets(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    refine = smooth_tracks

    def fail(*arguments: Any, **options: Any) -> SmoothedTrajectory:
        return replace(refine(*arguments, **options), status=Status.NOT_CONVERGED)

    monkeypatch.setattr(estimation, "smooth_tracks", fail)
    monkeypatch.setattr(estimation, "MAX_TRACKED_FRAMES", 8)
    found = sync_session(open_session(recording))
    assert OffsetPrecision.FINE not in found.precision
    assert not np.isnan(found.offsets).any()


def test_names_are_quoted_if_necessary(recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(estimation, "track", lambda *_, **__: iter(()))
    found = replace(sync_session(open_session(recording), stop=3), cameras=("left", "up right", "ünder.2"))
    write_offsets(found, tmp_path / "o.toml")
    assert load_offsets(tmp_path / "o.toml", found.cameras) == dict.fromkeys(found.cameras, 0.0)
    with pytest.raises(OSError, match="cannot write"):
        write_offsets(found, tmp_path / "o.toml" / "o.toml")
