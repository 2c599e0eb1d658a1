"""Live sessions: cameras and streams put together into frame sets, and folders that grow while they are read."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import cast

import av
import av.error
import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from sylpose import calibration
from sylpose.capture.frame_assembly import Assembler, Grab, Shot, StreamClock, Tally
from sylpose.capture.growing import DONE
from sylpose.capture.live import LiveSession, is_live, open_live
from sylpose.capture.streams import Device
from sylpose.frames import FrameSet
from sylpose.rig import Camera, Rig

SIZE = (160, 48)
STEP = 1 / 30


def rig(n: int = 2) -> Rig:
    matrix = np.array([[100.0, 0, 80], [0, 100, 24], [0, 0, 1]])
    cameras = (
        Camera(f"cam_{c}", SIZE, matrix, np.zeros(5), RigidTransform.from_translation([c, 0, 1])) for c in range(n)
    )
    return Rig(tuple(cameras))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    calibration.save(rig(), tmp_path / "calibration.toml")
    return tmp_path


@pytest.fixture(autouse=True)
def no_thread_left() -> Iterator[None]:
    yield
    left = [t.name for t in threading.enumerate() if t.name.startswith("sylpose-")]
    assert not left


def paint(frame: int) -> NDArray[np.uint8]:
    return np.full((SIZE[1], SIZE[0], 3), 5 * (frame % 50), np.uint8)


def shown(frames: FrameSet) -> list[int | None]:
    """The number painted into each camera's image."""
    return [None if image is None else round(float(image.mean()) / 5) for image in frames.images]


# --- sets out of frames ----------------------------------------------------------------------------------------------


class Bench:
    """An assembler of cameras that are asked for by hand, at any times."""

    def __init__(self, n: int = 2, **limits: float) -> None:
        names = [f"cam_{c}" for c in range(n)]
        self.tally = Tally(dict.fromkeys(names, 0), dict.fromkeys(names, 0))
        self.assembler = Assembler(self.tally, **limits)

    def add(self, c: int, taken: float, arrival: float | None = None, pts: float | None = None) -> None:
        self.assembler.add(c, Grab(SIZE, lambda: paint(0), pts), taken if arrival is None else arrival)

    def pick(self, now: float) -> list[float | None] | None:
        shots = self.assembler.pick(now)
        return None if shots is None else [None if shot is None else round(shot.time, 4) for shot in shots]


def test_frames_nearest_in_time_make_a_set_as_soon_as_all_cameras_have_one() -> None:
    bench = Bench(3)
    bench.add(0, 1.0)
    bench.add(2, 1.01)
    assert bench.pick(1.02) is None
    bench.add(1, 1.005)
    assert bench.pick(1.02) == [1.0, 1.005, 1.01]
    assert bench.pick(1.02) is None
    assert not any(bench.tally.dropped.values())


def test_a_late_camera_is_left_out_after_max_delay() -> None:
    bench = Bench(2, max_delay=0.1)
    bench.add(0, 1.0)
    assert bench.pick(1.099) is None
    assert bench.pick(1.101) == [1.0, None]
    assert bench.tally.missed == {"cam_0": 0, "cam_1": 1}


def test_a_dead_camera_is_not_waited_for_and_is_back_with_its_first_frame() -> None:
    bench = Bench(2, max_delay=0.1)
    waits = []
    for k in range(10):
        bench.add(0, k * STEP)
        if bench.pick(k * STEP) is None:
            waits.append(k)
            while bench.pick(k * STEP + 0.1) is not None:
                pass
    assert len(waits) == 3  # then it is given at once
    bench.add(1, 10 * STEP)
    assert bench.pick(10 * STEP + 0.001) is None  # waits for cam_0
    bench.add(0, 10 * STEP + 0.002)
    assert bench.pick(10 * STEP + 0.002) == [round(10 * STEP + 0.002, 4), round(10 * STEP, 4)]
    bench.add(0, 11 * STEP)
    assert bench.pick(11 * STEP) is None  # waits for cam_1 again


def test_a_camera_whose_end_is_known_is_not_waited_for() -> None:
    bench = Bench(2)
    bench.assembler.gone(1)
    bench.add(0, 1.0)
    assert bench.pick(1.0) == [1.0, None]


def test_a_slow_reader_gets_frames_that_are_no_older_than_max_delay_and_a_frame() -> None:
    bench = Bench(2, max_delay=0.2)
    ages, given_sets, k = [], 0, 0
    for now in np.arange(0.5, 10, 0.5):  # reads two sets per second of thirty
        while k * STEP <= now:
            bench.add(0, k * STEP)
            bench.add(1, k * STEP + 0.002)
            k += 1
        picked = bench.pick(float(now))
        assert picked is not None
        assert None not in picked  # dropped together, though one of them was just in time
        assert picked[0] is not None
        ages.append(now - picked[0])
        given_sets += 1
    assert max(ages) <= 0.2 + 2 * STEP
    waiting = k - given_sets - bench.tally.dropped["cam_0"]
    assert 0 < waiting <= 8
    assert bench.tally.dropped["cam_0"] > 200


@given(drift=st.floats(-0.02, 0.02), jitter=st.floats(0, 0.2), seed=st.integers(0, 99))
def test_drifting_cameras_stay_together_in_order_and_nothing_is_lost_uncounted(
    drift: float, jitter: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    bench = Bench(2)
    n = 200
    times = [STEP * (1 + drift * c) * np.arange(n) + STEP * jitter * rng.random(n) for c in range(2)]
    events = sorted((float(t), c) for c in range(2) for t in times[c])
    sets: list[list[float | None]] = []
    for t, c in events:
        bench.add(c, t)
        while (picked := bench.pick(t)) is not None:
            sets.append(picked)
    while (picked := bench.pick(events[-1][0] + 0.2)) is not None:
        sets.append(picked)
    means = [np.mean([t for t in s if t is not None]) for s in sets]
    assert (np.diff(means) > 0).all()
    apart = [abs(a - b) for a, b in sets if a is not None and b is not None]
    assert max(apart) <= 0.55 * STEP * (1 + jitter)
    assert len(apart) >= 0.9 * n * (1 - abs(drift))
    for c, name in enumerate(("cam_0", "cam_1")):
        assert sum(s[c] is not None for s in sets) + bench.tally.dropped[name] == n


def test_a_frame_given_twice_is_one_frame() -> None:
    bench = Bench(2)
    for k in range(5):
        for c in range(2):
            bench.add(c, k * STEP, pts=k * STEP)
            bench.add(c, k * STEP, k * STEP + 0.001, pts=k * STEP)
        assert bench.pick(k * STEP + 0.002) == [round(k * STEP, 4)] * 2
        assert bench.pick(k * STEP + 0.002) is None
    assert not any(bench.tally.dropped.values())


def test_a_streams_own_clock_takes_the_jitter_out() -> None:
    rng = np.random.default_rng(3)
    clock = StreamClock()
    pts = 100.0 + STEP * np.arange(100)
    arrivals = STEP * np.arange(100) + 0.05 + 0.02 * rng.random(100)
    times = [clock.host_time(p, a) for p, a in zip(pts, arrivals, strict=True)]
    steps = np.diff(np.array(times, float))
    assert (steps > 0).all()
    assert np.abs(steps[50:] - STEP).max() < 0.001
    assert clock.interval == pytest.approx(STEP)
    assert clock.host_time(0.0, 20.0) == 20.0  # a clock that starts anew


def test_counts_are_said_now_and_then_and_at_the_end() -> None:
    now = [0.0]
    tally = Tally({"a": 0, "b": 0}, {"a": 0, "b": 0}, clock=lambda: now[0])
    assert tally.news() is None
    assert tally.total() is None
    said = 0
    for second in range(3600):
        now[0] = float(second)
        tally.dropped["a"] += 1
        said += tally.news() is not None
    assert 10 < said < 25
    tally.missed["b"] = 3
    total = tally.total()
    assert total is not None
    assert "3600 of a" in total
    assert "3 without b" in total


# --- cameras ---------------------------------------------------------------------------------------------------------


class Fake:
    """A camera that gives so many frames at its pace, then ends or breaks."""

    def __init__(self, frames: int, error: str | None = None, size: tuple[int, int] = SIZE) -> None:
        self._left, self._error, self._size, self._k = frames, error, size, 0
        self.closed = False

    def read(self) -> Grab | None:
        time.sleep(0.01)
        if self._k == self._left:
            if self._error is not None:
                raise OSError(self._error)
            return None
        self._k += 1
        k = self._k - 1
        return Grab(self._size, lambda: paint(k))

    def close(self) -> None:
        self.closed = True


def live(folder: Path, devices: dict[int, list[Device]], **more: float) -> LiveSession:
    """A session of cameras 0 and 1, which open as the devices in turn and then not at all."""

    def opener(source: int | str, size: tuple[int, int], rate: float | None) -> Device:
        assert size == SIZE
        assert rate is None
        if not devices[cast(int, source)]:
            raise OSError("unplugged")
        return devices[cast(int, source)].pop(0)

    settings = "".join(f"{key} = {value}\n" for key, value in more.items())
    (folder / "live.toml").write_text(f"{settings}[sources]\ncam_0 = 0\n1 = 1\n")
    return open_live(folder, opener=opener)


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sylpose.capture.live.PAUSES", (0.01, 0.02))


@pytest.mark.usefixtures("hasty")
def test_cameras_are_read_until_all_have_ended_and_are_closed(folder: Path) -> None:
    fakes = [Fake(40), Fake(40)]
    session = live(folder, {0: [fakes[0]], 1: [fakes[1]]})
    assert is_live(folder)
    assert (session.path, session.n_frames, session.rate, session.boxes) == (folder, None, None, {})
    problems: list[str] = []
    sets = list(session.frames(on_problem=problems.append))
    assert [s.index for s in sets] == list(range(len(sets)))
    assert len(sets) > 25
    assert sum(None not in shown(s) for s in sets) > 20
    assert sets[0].time == 0
    assert (np.diff([s.time for s in sets]) > 0).all()
    assert all(fake.closed for fake in fakes)
    assert sum("ended" in p for p in problems) == 2
    assert sum("unplugged" in p and "no more" in p for p in problems) == 2


@pytest.mark.usefixtures("hasty")
def test_a_camera_that_breaks_is_opened_again(folder: Path) -> None:
    session = live(folder, {0: [Fake(100)], 1: [Fake(20, "cable"), Fake(60)]})
    problems: list[str] = []
    sets = list(session.frames(on_problem=problems.append))
    both = [None not in shown(s) for s in sets]
    assert sum(both[:25]) > 10
    assert sum(both[30:70]) > 20
    assert any("cam_1" in p and "cable" in p and "tried again" in p for p in problems)
    assert "cam_1: it is back." in problems


@pytest.mark.usefixtures("hasty")
def test_no_camera_at_all_is_an_error_that_says_why(folder: Path) -> None:
    problems: list[str] = []
    with pytest.raises(OSError, match=r"no camera gives any frame: .*cam_0.*unplugged") as caught:
        list(live(folder, {0: [], 1: []}).frames(on_problem=problems.append))
    assert [sum(c in p and "tried again" in p for p in problems) for c in ("cam_0", "cam_1")] == [1, 1]
    # What is in the error has not been said before.
    assert not any("no more" in p for p in problems)
    assert str(caught.value).count("this camera gives no more") == 2


def test_that_a_camera_cannot_be_opened_is_said_at_once(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not when all have been given up, or tried again."""
    monkeypatch.setattr("sylpose.capture.live.PAUSES", (60.0,))
    session, said = live(folder, {0: [], 1: []}), list[float]()
    begin = time.monotonic()

    def heard(_: str) -> None:
        said.append(time.monotonic() - begin)
        if len(said) == 2:
            session.stop()

    assert list(session.frames(on_problem=heard)) == []
    assert len(said) == 2
    assert max(said) < 60.0


@pytest.mark.usefixtures("hasty")
def test_a_camera_that_was_given_up_before_the_first_frame_is_said(folder: Path) -> None:
    problems: list[str] = []
    assert len(list(live(folder, {0: [Fake(40)], 1: []}).frames(on_problem=problems.append))) > 10
    assert sum("cam_1" in p and "no more" in p for p in problems) == 1


def test_frames_of_another_size_are_an_error(folder: Path) -> None:
    session = live(folder, {0: [Fake(500)], 1: [Fake(500, size=(320, 240))]})
    with pytest.raises(ValueError, match="cam_1: frames of 320x240, but this camera is calibrated at 160x48"):
        list(session.frames(on_problem=lambda _: None))


def test_a_slow_reader_misses_frames_and_is_told(folder: Path) -> None:
    session = live(folder, {0: [Fake(1000)], 1: [Fake(1000)]}, max_delay=0.05)
    problems: list[str] = []
    for _ in session.frames(stop=8, on_problem=problems.append):
        time.sleep(0.15)
    assert min(session.dropped.values()) > 20
    assert problems[-1].startswith("Left out in all")
    assert f"{session.dropped['cam_0']} of cam_0" in problems[-1]


def test_start_stop_every_and_being_stopped(folder: Path) -> None:
    session = live(folder, {0: [Fake(1000)] * 2, 1: [Fake(1000)] * 2})
    assert [s.index for s in session.frames(2, 9, 3, lambda _: None)] == [2, 5, 8]
    given_sets = 0
    for _ in session.frames(on_problem=lambda _: None):
        given_sets += 1
        if given_sets == 5:
            threading.Thread(target=session.stop).start()
    assert 5 <= given_sets < 50
    for start, stop, every in ((-1, None, 1), (3, 3, 1), (0, None, 0)):
        with pytest.raises(ValueError, match="must be"):
            session.frames(start, stop, every)


def test_an_interrupt_closes_the_cameras(folder: Path) -> None:
    fakes = [Fake(1000), Fake(1000)]
    frames = live(folder, {0: [fakes[0]], 1: [fakes[1]]}).frames(on_problem=lambda _: None)
    next(frames)
    with pytest.raises(KeyboardInterrupt):
        frames.throw(KeyboardInterrupt())
    assert all(fake.closed for fake in fakes)


def test_masks_and_boxes_come_with_the_frames(folder: Path) -> None:
    (folder / "masks").mkdir()
    mask = np.zeros(SIZE[::-1], np.uint8)
    mask[:10] = 255
    cv2.imwrite(str(folder / "masks" / "cam_1.png"), mask)
    (folder / "boxes.toml").write_text("cam_0 = [1, 2, 30, 40]\n")
    session = live(folder, {0: [Fake(1000)], 1: [Fake(1000)]})
    assert session.boxes["cam_0"].width == 30
    first = next(session.frames(on_problem=lambda _: None))
    assert first.masks[0] is None
    assert first.masks[1] is not None
    assert first.masks[1].sum() == 10 * SIZE[0]


# --- network streams -------------------------------------------------------------------------------------------------


class Server:
    """MPEG-TS over TCP on this computer: one client at a time gets so many frames, then the connection ends."""

    def __init__(self, frames: Sequence[int]) -> None:
        self._socket = socket.create_server(("127.0.0.1", 0))
        self.port = self._socket.getsockname()[1]
        self._thread = threading.Thread(target=self._run, args=(frames,), daemon=True)
        self._thread.start()

    def _run(self, frames: Sequence[int]) -> None:
        for n in frames:
            try:
                connection, _ = self._socket.accept()
            except OSError:
                return
            with connection:
                self._serve(connection, n)
        self._socket.close()

    def _serve(self, connection: socket.socket, n: int) -> None:
        class Sink:
            def write(self, data: bytes) -> int:
                connection.sendall(data)
                return len(data)

        try:
            with av.open(Sink(), "w", format="mpegts", options={"flush_packets": "1"}) as container:
                stream = container.add_stream("mpeg2video", rate=30)
                stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
                stream.gop_size, stream.max_b_frames = 5, 0
                for k in range(n):
                    frame = av.VideoFrame.from_ndarray(paint(k), format="bgr24")
                    frame.pts = k
                    container.mux(stream.encode(frame))
                    time.sleep(1 / 60)
                container.mux(stream.encode(None))
        except (OSError, av.error.FFmpegError):  # the client has gone
            pass

    def close(self) -> None:
        self._socket.close()


def stream_session(folder: Path, *ports: int, scheme: str = "tcp") -> LiveSession:
    sources = "".join(f'cam_{c} = "{scheme}://127.0.0.1:{port}"\n' for c, port in enumerate(ports))
    (folder / "live.toml").write_text(f"max_delay = 0.15\n[sources]\n{sources}")
    return open_live(folder / "live.toml")


@pytest.mark.usefixtures("hasty")
def test_streams_are_decoded_paired_and_ended(folder: Path) -> None:
    servers = [Server([120]), Server([120])]
    session = stream_session(folder, *(server.port for server in servers))
    problems: list[str] = []
    sets = list(session.frames(on_problem=problems.append))
    pairs = [shown(s) for s in sets if None not in shown(s)]
    assert len(pairs) > 20
    numbers = [k for pair in pairs for k in pair[:1] if k is not None]
    assert len(set(numbers)) > 15
    stamps = np.diff([t for s in sets if (t := s.times[0]) is not None])
    assert (stamps > 0).all()
    assert sum("the stream has ended" in p for p in problems) == 2
    assert not any("127.0.0.1" in p for p in problems)  # URLs may hold passwords


@pytest.mark.usefixtures("hasty")
def test_a_silent_stream_does_not_hold_the_others_up(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sylpose.capture.streams.TIMEOUT", 1.5)
    server = Server([200])
    with socket.create_server(("127.0.0.1", 0)) as silent:
        session = stream_session(folder, server.port, silent.getsockname()[1])
        problems: list[str] = []
        begin = time.monotonic()
        sets = list(session.frames(stop=10, on_problem=problems.append))
        assert time.monotonic() - begin < 30
    server.close()
    assert len(sets) == 10
    assert all(s.images[1] is None and s.images[0] is not None for s in sets)


# --- growing folders -------------------------------------------------------------------------------------------------


def encoded(frame: int, suffix: str = ".png") -> bytes:
    noise = np.random.default_rng(frame).integers(0, 2, (SIZE[1], SIZE[0], 3), np.uint8)
    return bytes(cv2.imencode(suffix, paint(frame) + noise)[1])


def write(folder: Path, camera: str, number: int, written: float | None = None, name: str = "{:04d}.png") -> None:
    (folder / camera).mkdir(exist_ok=True)
    file = folder / camera / name.format(number)
    file.write_bytes(encoded(number))
    if written is not None:
        os.utime(file, (written, written))


def follow(
    folder: Path, idle: float = 0.3, max_delay: float | None = None, rate: float | None = None, lossless: bool = False
) -> LiveSession:
    return open_live(folder, follow=True, idle=idle, max_delay=max_delay, rate=rate, lossless=lossless)


def record(job: Callable[[], None]) -> threading.Thread:
    thread = threading.Thread(target=job)
    thread.start()
    return thread


@pytest.mark.parametrize("lossless", [False, True])
def test_a_growing_folder_is_given_as_it_grows(folder: Path, lossless: bool) -> None:
    ahead = threading.Semaphore(3)  # by so many images the recorder is, and waits for the reader

    def job() -> None:
        time.sleep(0.05)
        for k in range(25):
            if not ahead.acquire(timeout=60):
                break
            write(folder, "cam_0", k)
            write(folder, "cam_1", k)
        (folder / DONE).touch()

    thread = record(job)
    session = follow(folder, idle=60, rate=50, lossless=lossless)
    assert "cam_0, cam_1" in session.warnings[0]
    sets = []
    begin = time.monotonic()
    for frames in session.frames(on_problem=lambda _: None):
        sets.append(frames)
        ahead.release()
    thread.join()
    assert time.monotonic() - begin < 60  # DONE, not idle
    assert [s.index for s in sets] == list(range(25))
    assert [shown(s) for s in sets] == [[k, k] for k in range(25)]
    assert sets[10].time == pytest.approx(0.2)
    assert not any(session.dropped.values())
    assert not any(session.missed.values())


def test_half_written_files_are_waited_for(folder: Path) -> None:
    def job() -> None:
        for k in range(6):
            write(folder, "cam_0", k)
            (folder / "cam_1").mkdir(exist_ok=True)
            data = encoded(k)
            with (folder / "cam_1" / f"{k:04d}.png").open("wb") as file:
                for part in (data[:10], data[10:300], data[300:]):
                    file.write(part)
                    file.flush()
                    time.sleep(0.03)
        (folder / DONE).touch()

    thread = record(job)
    sets = list(follow(folder, idle=60, max_delay=30).frames(on_problem=pytest.fail))
    thread.join()
    assert [shown(s) for s in sets] == [[k, k] for k in range(6)]


def test_late_and_broken_files_are_left_out_counted_and_said(folder: Path) -> None:
    for k in range(6):
        write(folder, "cam_0", k)
        if k != 2:
            write(folder, "cam_1", k)
    (folder / "cam_1" / "0004.png").write_bytes(encoded(4)[:100])
    session = follow(folder, max_delay=0.1, lossless=True)
    problems: list[str] = []
    begin = time.monotonic()
    sets = list(session.frames(on_problem=problems.append))
    assert time.monotonic() - begin < 30
    assert [shown(s) for s in sets] == [[0, 0], [1, 1], [2, None], [3, 3], [4, None], [5, 5]]
    assert session.missed == {"cam_0": 0, "cam_1": 2}
    assert any("0004.png" in p for p in problems)
    assert "2 without cam_1" in problems[-1]


def test_a_slow_reader_skips_what_the_recorder_is_ahead_with(folder: Path) -> None:
    def grow(n: int, of: int = 0) -> None:  # the recorder's clock: 20 per second
        for k in range(of, n):
            for camera in ("cam_0", "cam_1"):
                write(folder, camera, k, written=1000 + 0.05 * k)

    grow(20)
    session = follow(folder, max_delay=0.2)
    problems: list[str] = []
    frames = session.frames(on_problem=problems.append)
    first = next(frames)
    assert 19 - first.index <= 5  # within max_delay and a frame of the newest
    assert "were there already" in problems[0]
    assert not any(session.dropped.values())
    grow(60, of=20)
    rest = [s.index for s in frames]
    assert rest[0] >= 59 - 5
    assert rest == list(range(rest[0], 60))
    assert session.dropped == dict.fromkeys(("cam_0", "cam_1"), rest[0] - first.index - 1)


def test_lossless_gives_everything_in_order(folder: Path) -> None:
    for k in range(20):
        for camera in ("cam_0", "cam_1"):
            write(folder, camera, k, written=1000 + k)
    session = follow(folder, lossless=True)
    assert [s.index for s in session.frames(on_problem=pytest.fail)] == list(range(20))
    assert [s.index for s in session.frames(4, 13, 4, pytest.fail)] == [4, 8, 12]


def test_a_camera_that_dies_is_waited_for_only_a_few_times(folder: Path) -> None:
    for k in range(40):
        write(folder, "cam_0", k, written=1000.0)
        if k < 10:
            write(folder, "cam_1", k, written=1000.0)
    begin = time.monotonic()
    sets = list(follow(folder, max_delay=0.5).frames(on_problem=lambda _: None))
    assert time.monotonic() - begin < 0.8 * 30 * 0.5  # as long as it would take to wait for nearly all
    assert [shown(s)[1] for s in sets] == [*range(10), *[None] * 30]


def test_files_that_come_out_of_order_are_put_in_order(folder: Path) -> None:
    def job() -> None:
        for k in (0, 1, 3, 2, 4, 6, 5, 7):
            for camera in ("cam_0", "cam_1"):
                write(folder, camera, k, name="shot_{}_c1.png")
            time.sleep(0.03)

    thread = record(job)
    sets = list(follow(folder, idle=3, max_delay=3).frames(on_problem=pytest.fail))
    thread.join()
    assert [shown(s)[0] for s in sets] == list(range(8))


def test_a_gap_is_seen_in_whatever_order_files_are_listed(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 0, 1 and 3, listed as 3, 1, 0, one is missing, and comes."""
    for k in (0, 1, 3):
        for camera in ("cam_0", "cam_1"):
            write(folder, camera, k)
    listed = os.scandir
    monkeypatch.setattr(os, "scandir", lambda path: iter(sorted(listed(path), key=lambda e: e.name, reverse=True)))
    sets = []
    for its in follow(folder, idle=3, max_delay=60).frames(on_problem=pytest.fail):
        sets.append(its.index)
        if its.index == 1:
            for camera in ("cam_0", "cam_1"):
                write(folder, camera, 2)
    assert sets == [0, 1, 2, 3]


def test_a_folder_that_stays_empty_ends_with_an_error(folder: Path) -> None:
    with pytest.raises(OSError, match=r"got any image within 0.3 s"):
        list(follow(folder).frames(on_problem=pytest.fail))


def test_images_without_numbers_are_an_error(folder: Path) -> None:
    write(folder, "cam_0", 0, name="first.png")
    write(folder, "cam_0", 1, name="second.png")
    with pytest.raises(ValueError, match="the frame's number in their names"):
        list(follow(folder).frames(on_problem=pytest.fail))


# --- what is wrong with the settings ---------------------------------------------------------------------------------

SOURCES = "[sources]\ncam_0 = 0\ncam_1 = 1\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[sources]\ncam_0 = 0\n", r"live\.toml: \[sources\] has none for camera cam_1"),
        (SOURCES + "cam_9 = 1\n", r"live\.toml: \[sources\]: cam_9 is no camera of the calibration"),
        ("colour = true\n" + SOURCES, r"live\.toml: .*colour"),
        ("[sources]\ncam_0 = 1.5\n", r"live\.toml: .*cam_0|live\.toml: .*sources"),
        ("[sources]\ncam_0 = -1\ncam_1 = 0\n", "the source of cam_0 must be a device number"),
        ('[sources]\ncam_0 = "video.mp4"\ncam_1 = 0\n', "the source of cam_0 must be .* 'video.mp4'"),
        ("max_delay = 0\n" + SOURCES, "max_delay must be a positive number, got 0"),
        ("tolerance = nan\n" + SOURCES, "tolerance must be a positive number"),
        ("[sources\n", r"live\.toml: a table \[sources\]"),
        ("rate = 30\n", r"live\.toml: .*sources"),
    ],
)
def test_wrong_settings_are_named_in_one_sentence(folder: Path, text: str, words: str) -> None:
    (folder / "live.toml").write_text(text)
    with pytest.raises(ValueError, match=words) as error:
        open_live(folder)
    assert "\n" not in str(error.value)


def test_files_that_are_not_there_are_named(folder: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"live\.toml: no such file"):
        open_live(folder)
    with pytest.raises(FileNotFoundError, match="nowhere: no such file or folder"):
        open_live(folder / "nowhere")
    (folder / "live.toml").write_text('calibration = "other.toml"\n' + SOURCES)
    with pytest.raises(OSError, match=r"other\.toml"):
        open_live(folder)
    (folder / "live.toml").write_text(SOURCES)
    with pytest.raises(ValueError, match="only a growing folder"):
        open_live(folder, lossless=True)
    with pytest.raises(ValueError, match="not a file"):
        open_live(folder / "live.toml", follow=True)
    (folder / "masks" / "cam_0").mkdir(parents=True)
    with pytest.raises(ValueError, match="one mask per camera"):
        open_live(folder)
    (folder / "calibration.toml").unlink()
    with pytest.raises(ValueError, match="no calibration"):
        open_live(folder)


def test_shots_are_what_assemblers_give() -> None:
    bench = Bench(1)
    bench.add(0, 1.0)
    shots = bench.assembler.pick(1.0)
    assert shots is not None
    assert isinstance(shots[0], Shot)
    assert shots[0].pixels().shape == (SIZE[1], SIZE[0], 3)
