"""Time offsets: speeds that are to be aligned, sessions set right in time, and rendered recordings from end to end."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.app import sync as app_sync
from sylpose.app.sync import Known, sync_aloud, sync_session, write_offsets
from sylpose.capture import Session, open_session
from sylpose.geometry.arrays import FloatArray
from sylpose.results import FramePose, FrameStatus, Status
from sylpose.simulate import Actor, Recording, Scene, arc, chamfered_box, write_recording
from sylpose.smoothing.trajectory import Smoothed, Track
from sylpose.sync.offsets import load_offsets, retimed
from sylpose.sync.speed_correlation import Pulse, coarse_offsets, image_speed, small_grey, split_offsets
from sylpose.tracking.tracked_frame import Sightings
from sylpose.tracking.tracker import track

RATE = 30.0
CAMERAS = ("cam_0", "cam_1", "cam_2")
# Frames by which the cameras of the rendered recording are late.
LATE = np.array([3.4, -1.0, 0.0])
FRAMES = 48


# --- speeds ------------------------------------------------------------------------------------------------------------


def restless(seed: int) -> Callable[[FloatArray], FloatArray]:
    """A speed over time (frames) that never repeats itself: pixels per frame."""
    rng = np.random.default_rng(seed)
    periods, phases = rng.uniform(9, 70, 12), rng.uniform(0, 2 * np.pi, 12)
    return lambda t: np.asarray(2.0 * np.exp(0.3 * np.sin(2 * np.pi * t[:, None] / periods + phases).sum(axis=1)))


def pulses(
    late: ArrayLike, n: int = 200, noise: float = 0.05, scales: ArrayLike = 1.0, seed: int = 0
) -> tuple[list[Pulse], np.random.Generator]:
    """What cameras so many frames late see of a restless speed, each at its own scale."""
    rng, speed, k = np.random.default_rng(seed), restless(seed), np.arange(n) + 0.5
    lags = np.asarray(late, dtype=float)
    shown = []
    for lag, scale in zip(lags, np.broadcast_to(np.asarray(scales, dtype=float), lags.shape), strict=True):
        seen = scale * speed(k + lag) * np.exp(noise * rng.standard_normal(n))
        shown.append(Pulse(np.asarray(k / RATE, dtype=float), np.asarray(seen, dtype=float)))
    return shown, rng


@pytest.mark.parametrize("late", [[0.0, 0.0], [3.4, -1.0, 0.0], [0.25, -40.0, 11.6, 3.0]])
@pytest.mark.parametrize("noise", [0.02, 0.2])
def test_lags_are_found_to_a_part_of_a_frame(late: list[float], noise: float) -> None:
    shown, _ = pulses(late, noise=noise, scales=np.linspace(0.5, 3.0, len(late)))
    found = coarse_offsets(shown, RATE, 3.0)
    assert found.told.all()
    error = found.offsets * RATE - (np.array(late) - np.mean(late))
    assert np.abs(error).max() < 0.3
    assert found.offsets.mean() == pytest.approx(0.0, abs=1e-12)
    assert (np.abs(error) < 4 * found.sd * RATE + 1e-9).all()


def test_a_camera_that_sees_something_else_is_left_out() -> None:
    shown, _ = pulses([2.0, -2.0, 5.0])
    other, _ = pulses([0.0], seed=5)
    found = coarse_offsets([*shown[:2], other[0], shown[2]], RATE, 3.0)
    assert found.told.tolist() == [True, True, False, True]
    assert found.offsets[2] == 0.0
    assert found.sd[2] == np.inf
    assert found.offsets[[0, 1, 3]] * RATE == pytest.approx(np.array([2.0, -2.0, 5.0]) - 5 / 3, abs=0.2)


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_a_constant_speed_tells_nothing(noise: float) -> None:
    rng, times = np.random.default_rng(0), np.arange(200) / RATE
    found = coarse_offsets([Pulse(times, np.exp(noise * rng.standard_normal(200))) for _ in range(3)], RATE, 3.0)
    assert not found.told.any()
    assert not found.offsets.any()


def test_a_speed_that_repeats_itself_tells_nothing() -> None:
    times = np.arange(300) / RATE
    found = coarse_offsets([Pulse(times, 2 + np.sin(2 * np.pi * (times * RATE + o) / 30)) for o in (0, 4)], RATE, 3.0)
    assert not found.told.any()


def test_lags_beyond_the_longest_allowed_are_not_found() -> None:
    assert not coarse_offsets(pulses([0.0, 40.0])[0], RATE, 1.0).told.any()


def test_dropped_frames_and_other_clocks() -> None:
    shown, rng = pulses([1.0, -1.0, 0.0], n=300)
    gappy = []
    for pulse in shown:
        kept = rng.random(300) > 0.1
        kept[100:120] = False
        gappy.append(Pulse(pulse.times[kept] + 0.2, pulse.speeds[kept]))
    found = coarse_offsets(gappy, RATE, 3.0)
    assert found.told.all()
    assert found.offsets * RATE == pytest.approx([1.0, -1.0, 0.0], abs=0.3)


def test_cameras_without_pictures_tell_nothing() -> None:
    nothing = Pulse(np.empty(0), np.empty(0))
    assert not coarse_offsets([nothing, nothing], RATE, 3.0).told.any()
    assert coarse_offsets([*pulses([0.0, 2.0])[0], nothing], RATE, 3.0).told.tolist() == [True, True, False]


@pytest.mark.parametrize(
    ("rate", "max_lag", "name"), [(0.0, 1.0, "rate"), (30.0, -1.0, "max_lag"), (np.nan, 1.0, "rate")]
)
def test_impossible_rates_and_lags_are_refused(rate: float, max_lag: float, name: str) -> None:
    with pytest.raises(ValueError, match=f"{name} must be positive"):
        coarse_offsets([], rate, max_lag)


def test_the_speed_of_pictures() -> None:
    rng = np.random.default_rng(0)
    texture = np.kron(rng.integers(0, 255, (30, 40)), np.ones((8, 8))).astype(np.uint8)
    back = np.full((240, 320, 3), 90, np.uint8)

    def picture(x: float) -> NDArray[np.uint8]:
        image = back.copy()
        image[60:180, 100 + round(x) : 220 + round(x)] = texture[:120, :120, None]
        return image

    def speed(a: float, b: float) -> float:
        return image_speed(small_grey(picture(a)), small_grey(picture(b)))

    assert speed(0, 0) == 0.0
    assert speed(0, 3) == pytest.approx(3.0, abs=0.1)
    assert speed(5, 0) == pytest.approx(5.0, abs=0.1)
    assert small_grey(np.zeros((480, 640, 3), np.uint8)).shape == (240, 320)


# --- whole frames and the rest -----------------------------------------------------------------------------------------


@given(st.lists(st.floats(-200, 200), min_size=1, max_size=8))
def test_split_offsets(late: list[float]) -> None:
    frames, rest = split_offsets(np.array(late) / RATE, RATE)
    assert frames.max() == 0
    assert rest.mean() == pytest.approx(0.0, abs=1e-9)
    assert np.ptp(frames / RATE + rest - np.array(late) / RATE) < 1e-9
    assert np.ptp(rest) * RATE <= 1.0 + 1e-6


def test_cameras_that_are_little_apart_stay_in_their_frames() -> None:
    assert split_offsets([0.012, -0.015, 0.0], RATE)[0].tolist() == [0, 0, 0]
    frames, rest = split_offsets(np.array([3.4, -1.0, 0.1]) / RATE, RATE)
    assert frames.tolist() == [0, -4, -3]
    assert rest * RATE == pytest.approx(np.array([3.4, 3.0, 3.1]) - 9.5 / 3)


# --- recordings --------------------------------------------------------------------------------------------------------


def uneven(frame: float) -> RigidTransform:
    """A turn and a path at a speed that changes."""
    s = frame + 2.1 * np.sin(frame / 3.1) + 2.5 * np.sin(frame / 5.3 + 1)
    turn = Rotation.from_rotvec(0.03 * s * np.array([0.3, 0.9, 0.3]))
    return RigidTransform.from_components([0.05 * np.sin(s / 9), 0.02 * np.cos(s / 7), 0.03 * np.sin(s / 11)], turn)


def screw(frame: float) -> RigidTransform:
    """A steady turn and a steady shift along its axis."""
    return RigidTransform.from_components([0.002 * frame - 0.05, 0, 0], Rotation.from_rotvec([0.03 * frame, 0, 0]))


def record(folder: Path, path: Callable[[float], RigidTransform], late: FloatArray, frames: int) -> Path:
    rig = arc(len(late), 40, 1.5, 350, (320, 240), height=0.4)
    scene = Scene(rig, (Actor(chamfered_box([0.3, 0.22, 0.26], 300), path),), frames, 3)
    write_recording(Recording(scene, skew=tuple(late / RATE)), folder)
    return folder


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("late"), uneven, LATE, FRAMES)


def with_stamps(recording: Path, folder: Path, late: FloatArray) -> Path:
    """The recording with time stamps of cameras so many frames late."""
    folder.mkdir()
    for file in recording.iterdir():
        if file.is_file():
            (folder / file.name).symlink_to(file)
    with (folder / "timestamps.csv").open("w", newline="") as out:
        table = csv.writer(out)
        table.writerow(["frame", *CAMERAS])
        table.writerows([k, *((k + late) / RATE).tolist()] for k in range(FRAMES))
    return folder


def test_offsets_are_found_from_end_to_end(
    recording: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # Speeds are told apart in all frames; for the rest two parts do.
    monkeypatch.setattr(app_sync, "TRACKED", 24)
    times_tracked = counted(monkeypatch, track)
    found = sync_aloud(open_session(recording))
    assert found.tracked == 24
    assert len(times_tracked) == 1
    true = LATE - LATE.mean()
    assert found.known == (Known.FINE,) * 3
    assert not found.problems
    assert found.offsets * RATE == pytest.approx(true, abs=0.04)
    assert found.coarse.offsets * RATE == pytest.approx(true, abs=0.5)
    assert (found.after < 1.05 * found.before).all()
    out = capsys.readouterr().out
    assert "cam_0" in out
    assert str(recording / "offsets.toml") in out
    written = load_offsets(recording / "offsets.toml", CAMERAS)
    assert [written[name] for name in CAMERAS] == pytest.approx(found.offsets.tolist(), abs=1e-6)


def counted(monkeypatch: pytest.MonkeyPatch, tracking: Callable[..., object]) -> list[int]:
    """Grows by one each time that the object is tracked, which is done like this."""
    times: list[int] = []

    def tracked(*args: object, **kwargs: object) -> object:
        times.append(len(times))
        return tracking(*args, **kwargs)

    monkeypatch.setattr(app_sync, "track", tracked)
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
def test_it_is_tracked_again_where_other_frames_belong_together(
    recording: Path, monkeypatch: pytest.MonkeyPatch, changes: list[float], times: int, settles: bool
) -> None:
    rest, sd = iter(changes), np.full(3, 0.002 / RATE)

    def smoothed(*_: object, offsets_sd: float | None = None) -> Smoothed:
        change = 0.0 if offsets_sd is None else next(rest)
        return Smoothed((), Status.OK, change / RATE * np.array([1.0, -1.0, 0.0]), sd, np.ones(3), 3)

    times_tracked = counted(monkeypatch, lambda *_, **__: iter(()))
    monkeypatch.setattr(app_sync, "smooth", smoothed)
    monkeypatch.setattr(app_sync, "_speeds", lambda *_: np.full(3, 300.0))
    found = sync_session(open_session(recording))
    assert len(times_tracked) == times
    assert found.known == (Known.FINE,) * 3
    assert found.problems == (() if settles else ("The offsets still change after 4 rounds.",))
    apart = found.offsets - np.array([1.0, -1.0, 0.0]) * sum(changes) / RATE
    assert apart * RATE == pytest.approx(np.round(apart * RATE - apart[2] * RATE) + apart[2] * RATE, abs=1e-6)
    # Of followed features' errors a hundredth of a pixel goes along with the motion.
    assert found.sd == pytest.approx(np.hypot(sd, app_sync.ALONG_PX / 300.0))


def test_the_speed_of_what_is_tracked() -> None:
    rig = arc(2, 40, 1.5, 350, (320, 240))

    def seen(time: float, x: Sequence[float]) -> Track:
        # The first camera's landmark 7, and another one in each frame; the second camera sees nothing.
        places = np.column_stack([x, np.zeros(2)]) / 350.0
        own = Sightings(np.array([7, round(100 * time)]), places, np.zeros((2, 3)), np.ones(2, bool))
        none = Sightings(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 3)), np.zeros(0, bool))
        pose = FramePose(
            0, time, FrameStatus.TOO_FEW_MATCHES, None, np.zeros((6, 6)), np.zeros(2, np.int64), np.zeros(2)
        )
        return Track(pose, (own, none), np.zeros(2), 0.1)

    # By 3 pixels in a tenth of a second, then by 8 in two tenths.
    found = app_sync._speeds([seen(0.1, [1, 50]), seen(0.2, [4, 90]), seen(0.4, [12, 0])], rig)
    assert found[0] == pytest.approx(np.sqrt((30**2 + 40**2) / 3), rel=1e-6)
    assert found[1] < 1e-5


def test_a_steady_motion_shows_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(app_sync, "ROUNDS", 1)
    found = sync_aloud(open_session(record(tmp_path / "screw", screw, np.array([0.0, 0.4, -0.3]), 33)))
    assert found.known == (Known.NOT,) * 3
    assert not found.offsets.any()
    assert np.isinf(found.sd).all()
    assert not (tmp_path / "screw" / "offsets.toml").exists()
    assert "the object's speed has to change" in capsys.readouterr().out


def shows(session: Session, camera: int) -> list[int]:
    return [int(k) for k in session.timeline.frames[:, camera]]


def test_a_session_is_set_right_in_time(recording: Path) -> None:
    session = open_session(recording)
    moved = retimed(session, LATE / RATE)
    # cam_1 and cam_2 start 4 and 3 frames before cam_0.
    assert [shows(moved, c)[0] for c in range(3)] == [0, 4, 3]
    assert shows(moved, 0) == list(range(FRAMES))
    assert shows(moved, 1)[-5:] == [FRAMES - 1, -1, -1, -1, -1]
    late = moved.timeline.stamps - moved.timeline.times[:, None]
    assert late[0] * RATE == pytest.approx(np.array([3.4, 3.0, 3.0]) - 9.4 / 3)
    assert np.isnan(late[-1, 1])
    assert any("cam_1 4" in warning for warning in moved.warnings)
    assert retimed(session, [0, 0, 0]) is session


def test_time_stamps_are_kept_and_set_right(recording: Path, tmp_path: Path) -> None:
    session = open_session(with_stamps(recording, tmp_path / "stamped", np.array([0.0, 0.2, 0.0])))
    moved = retimed(session, np.array([3.4, -1.2, 0.0]) / RATE)
    k = moved.timeline.frames
    shown = np.where(k >= 0, (k + LATE) / RATE, np.nan)
    assert moved.timeline.stamps == pytest.approx(shown, abs=1e-6, nan_ok=True)
    assert moved.timeline.times == pytest.approx(np.nanmean(shown, axis=1), abs=1e-6)
    assert np.ptp(moved.timeline.stamps[0]) * RATE < 0.5


@pytest.mark.parametrize(
    ("offsets", "said"),
    [
        ([0.1, 0.2], "3 numbers are expected"),
        ([0.0, np.nan, 0.0], "3 numbers are expected"),
        ([0.0, 0.0, 5.0], "cam_0 ends before the last camera begins"),
    ],
)
def test_impossible_offsets_are_refused(recording: Path, offsets: list[float], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        retimed(open_session(recording), offsets)


def test_recordings_that_cannot_be_synchronised_are_refused(recording: Path) -> None:
    session = open_session(recording)
    timeless = replace(session, timeline=replace(session.timeline, rate=None))
    with pytest.raises(ValueError, match=r"videos or timestamps\.csv are expected"):
        sync_session(timeless)
    alone = replace(session, rig=session.rig.subset(["cam_0"]))
    with pytest.raises(ValueError, match="one camera alone"):
        sync_session(alone)
    with pytest.raises(ValueError, match="start must be in"):
        sync_session(session, start=1000)
    with pytest.raises(ValueError, match="max_lag must be positive"):
        sync_session(session, max_lag=0.0, stop=3)


def test_an_interrupt_leaves_the_offsets_as_they_were(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(app_sync, "coarse_offsets", interrupt)
    file = tmp_path / "offsets.toml"
    file.write_text("cam_0 = 0.25\n")
    with pytest.raises(KeyboardInterrupt, match="is as it was"):
        sync_aloud(open_session(recording), file, stop=3)
    assert file.read_text() == "cam_0 = 0.25\n"


def test_what_cannot_be_tracked_is_said_and_whole_frames_remain(
    recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(app_sync, "track", lambda *_, **__: iter(()))
    found = sync_session(open_session(recording))
    assert found.known == (Known.COARSE,) * 3
    assert found.offsets * RATE == pytest.approx(
        np.round(LATE - LATE.max()) - np.round(LATE - LATE.max()).mean(), abs=1.0
    )
    assert found.problems == ("The object could not be tracked: its poses tell nothing.",)


def test_names_that_need_quotes_are_written_so(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(app_sync, "track", lambda *_, **__: iter(()))
    found = replace(sync_session(open_session(recording), stop=3), cameras=("left", "up right", "ünder.2"))
    write_offsets(found, tmp_path / "o.toml")
    assert load_offsets(tmp_path / "o.toml", found.cameras) == dict.fromkeys(found.cameras, 0.0)
    with pytest.raises(OSError, match="cannot write"):
        write_offsets(found, tmp_path / "o.toml" / "o.toml")
