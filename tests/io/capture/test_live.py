"""Live sessions: streams assembled into frame sets, and folders that grow while they are read."""

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

from sylpose.frames import FrameSet
from sylpose.io import calibration
from sylpose.io.capture.frame_assembly import DropCounter, FrameAssembler, Grab, StreamClock, TimedFrame
from sylpose.io.capture.growing import DONE_FILE
from sylpose.io.capture.live import LiveSession, is_live, open_live
from sylpose.io.capture.streams import Device
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


def painted_numbers(frames: FrameSet) -> list[int | None]:
    """Return the number painted into each camera's image."""
    return [None if image is None else round(float(image.mean()) / 5) for image in frames.images]


# --- assembly of frame sets ------------------------------------------------------------------------------------------


class AssemblerBench:
    """An assembler of cameras whose frames are added manually, at any times."""

    def __init__(self, n: int = 2, **limits: float) -> None:
        names = [f"cam_{c}" for c in range(n)]
        self.tally = DropCounter(dict.fromkeys(names, 0), dict.fromkeys(names, 0))
        self.assembler = FrameAssembler(self.tally, **limits)

    def add(self, c: int, taken: float, arrival: float | None = None, pts: float | None = None) -> None:
        self.assembler.add(c, Grab(SIZE, lambda: paint(0), pts), taken if arrival is None else arrival)

    def pick(self, now: float) -> list[float | None] | None:
        shots = self.assembler.next_set(now)
        return None if shots is None else [None if shot is None else round(shot.time, 4) for shot in shots]


def test_nearest_frames_form_a_set_when_complete() -> None:
    bench = AssemblerBench(3)
    bench.add(0, 1.0)
    bench.add(2, 1.01)
    assert bench.pick(1.02) is None
    bench.add(1, 1.005)
    assert bench.pick(1.02) == [1.0, 1.005, 1.01]
    assert bench.pick(1.02) is None
    assert not any(bench.tally.dropped.values())


def test_delayed_camera_is_omitted_after_max_delay() -> None:
    bench = AssemblerBench(2, max_delay=0.1)
    bench.add(0, 1.0)
    assert bench.pick(1.099) is None
    assert bench.pick(1.101) == [1.0, None]
    assert bench.tally.missed == {"cam_0": 0, "cam_1": 1}


def test_dead_camera_is_not_awaited_until_its_next_frame() -> None:
    bench = AssemblerBench(2, max_delay=0.1)
    waits = []
    for k in range(10):
        bench.add(0, k * STEP)
        if bench.pick(k * STEP) is None:
            waits.append(k)
            while bench.pick(k * STEP + 0.1) is not None:
                pass
    assert len(waits) == 3  # afterwards immediately
    bench.add(1, 10 * STEP)
    assert bench.pick(10 * STEP + 0.001) is None  # waits for cam_0
    bench.add(0, 10 * STEP + 0.002)
    assert bench.pick(10 * STEP + 0.002) == [round(10 * STEP + 0.002, 4), round(10 * STEP, 4)]
    bench.add(0, 11 * STEP)
    assert bench.pick(11 * STEP) is None  # waits for cam_1 again


def test_ended_camera_is_not_awaited() -> None:
    bench = AssemblerBench(2)
    bench.assembler.mark_unavailable(1)
    bench.add(0, 1.0)
    assert bench.pick(1.0) == [1.0, None]


def test_slow_reader_gets_recent_frames() -> None:
    bench = AssemblerBench(2, max_delay=0.2)
    ages, given_sets, k = [], 0, 0
    for now in np.arange(0.5, 10, 0.5):  # reads two sets per second at 30 Hz
        while k * STEP <= now:
            bench.add(0, k * STEP)
            bench.add(1, k * STEP + 0.002)
            k += 1
        picked = bench.pick(float(now))
        assert picked is not None
        assert None not in picked  # dropped together, although one of them was just in time
        assert picked[0] is not None
        ages.append(now - picked[0])
        given_sets += 1
    assert max(ages) <= 0.2 + 2 * STEP
    waiting = k - given_sets - bench.tally.dropped["cam_0"]
    assert 0 < waiting <= 8
    assert bench.tally.dropped["cam_0"] > 200


@given(drift=st.floats(-0.02, 0.02), jitter=st.floats(0, 0.2), seed=st.integers(0, 99))
def test_drifting_cameras_stay_ordered_and_losses_are_counted(drift: float, jitter: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    bench = AssemblerBench(2)
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


def test_repeated_frame_counts_once() -> None:
    bench = AssemblerBench(2)
    for k in range(5):
        for c in range(2):
            bench.add(c, k * STEP, pts=k * STEP)
            bench.add(c, k * STEP, k * STEP + 0.001, pts=k * STEP)
        assert bench.pick(k * STEP + 0.002) == [round(k * STEP, 4)] * 2
        assert bench.pick(k * STEP + 0.002) is None
    assert not any(bench.tally.dropped.values())


def test_stream_clock_removes_jitter() -> None:
    rng = np.random.default_rng(3)
    clock = StreamClock()
    pts = 100.0 + STEP * np.arange(100)
    arrivals = STEP * np.arange(100) + 0.05 + 0.02 * rng.random(100)
    times = [clock.to_host_time(p, a) for p, a in zip(pts, arrivals, strict=True)]
    steps = np.diff(np.array(times, float))
    assert (steps > 0).all()
    assert np.abs(steps[50:] - STEP).max() < 0.001
    assert clock.interval == pytest.approx(STEP)
    assert clock.to_host_time(0.0, 20.0) == 20.0  # a clock that was reset


def test_counts_are_reported_at_intervals_and_at_end() -> None:
    now = [0.0]
    tally = DropCounter({"a": 0, "b": 0}, {"a": 0, "b": 0}, clock=lambda: now[0])
    assert tally.report_if_due() is None
    assert tally.final_report() is None
    message = 0
    for second in range(3600):
        now[0] = float(second)
        tally.dropped["a"] += 1
        message += tally.report_if_due() is not None
    assert 10 < message < 25
    tally.missed["b"] = 3
    total = tally.final_report()
    assert total is not None
    assert "3600 of a" in total
    assert "3 without b" in total


# --- cameras ---------------------------------------------------------------------------------------------------------


class FakeCamera:
    """A camera that delivers a number of frames at its rate, then ends or breaks."""

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


def make_live_session(folder: Path, devices: dict[int, list[Device]], **more: float) -> LiveSession:
    """A session of cameras 0 and 1, which open the given devices in turn, then fail."""

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
def short_retry_delays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sylpose.io.capture.streams.RETRY_DELAYS", (0.01, 0.02))


@pytest.mark.usefixtures("short_retry_delays")
def test_cameras_are_read_to_end_and_closed(folder: Path) -> None:
    fakes = [FakeCamera(40), FakeCamera(40)]
    session = make_live_session(folder, {0: [fakes[0]], 1: [fakes[1]]})
    assert is_live(folder)
    assert (session.path, session.n_frames, session.rate, session.boxes) == (folder, None, None, {})
    problems: list[str] = []
    sets = list(session.frames(on_problem=problems.append))
    assert [s.index for s in sets] == list(range(len(sets)))
    assert len(sets) > 25
    assert sum(None not in painted_numbers(s) for s in sets) > 20
    assert sets[0].time == 0
    assert (np.diff([s.time for s in sets]) > 0).all()
    assert all(fake.closed for fake in fakes)
    assert sum("ended" in p for p in problems) == 2
    assert sum("unplugged" in p and "any more" in p for p in problems) == 2


@pytest.mark.usefixtures("short_retry_delays")
def test_failed_camera_is_reopened(folder: Path) -> None:
    session = make_live_session(folder, {0: [FakeCamera(100)], 1: [FakeCamera(20, "cable"), FakeCamera(60)]})
    problems: list[str] = []
    sets = list(session.frames(on_problem=problems.append))
    both = [None not in painted_numbers(s) for s in sets]
    assert sum(both[:25]) > 10
    assert sum(both[30:70]) > 20
    assert any("cam_1" in p and "cable" in p and "reconnecting" in p for p in problems)
    assert "cam_1: reconnected." in problems


@pytest.mark.usefixtures("short_retry_delays")
def test_error_without_any_camera_names_reasons(folder: Path) -> None:
    problems: list[str] = []
    with pytest.raises(OSError, match=r"no camera delivers any frame: .*cam_0.*unplugged") as caught:
        list(make_live_session(folder, {0: [], 1: []}).frames(on_problem=problems.append))
    assert [sum(c in p and "reconnecting" in p for p in problems) for c in ("cam_0", "cam_1")] == [1, 1]
    # The content of the error has not been reported before.
    assert not any("any more" in p for p in problems)
    assert str(caught.value).count("this camera is not used any more") == 2


def test_open_failure_is_reported_immediately(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is reported before retries and before all cameras have failed."""
    monkeypatch.setattr("sylpose.io.capture.streams.RETRY_DELAYS", (60.0,))
    session, message = make_live_session(folder, {0: [], 1: []}), list[float]()
    begin = time.monotonic()

    def received(_: str) -> None:
        message.append(time.monotonic() - begin)
        if len(message) == 2:
            session.stop()

    assert list(session.frames(on_problem=received)) == []
    assert len(message) == 2
    assert max(message) < 60.0


@pytest.mark.usefixtures("short_retry_delays")
def test_camera_lost_before_first_frame_is_reported(folder: Path) -> None:
    problems: list[str] = []
    assert len(list(make_live_session(folder, {0: [FakeCamera(40)], 1: []}).frames(on_problem=problems.append))) > 10
    assert sum("cam_1" in p and "any more" in p for p in problems) == 1


def test_frames_of_other_size_raise(folder: Path) -> None:
    session = make_live_session(folder, {0: [FakeCamera(500)], 1: [FakeCamera(500, size=(320, 240))]})
    with pytest.raises(ValueError, match="cam_1: frames of 320x240, but this camera is calibrated at 160x48"):
        list(session.frames(on_problem=lambda _: None))


def test_slow_reader_gets_report_of_dropped_frames(folder: Path) -> None:
    session = make_live_session(folder, {0: [FakeCamera(1000)], 1: [FakeCamera(1000)]}, max_delay=0.05)
    problems: list[str] = []
    for _ in session.frames(stop=8, on_problem=problems.append):
        time.sleep(0.15)
    assert min(session.dropped.values()) > 20
    assert problems[-1].startswith("Left out in total")
    assert f"{session.dropped['cam_0']} of cam_0" in problems[-1]


def test_start_stop_every_and_stop_request(folder: Path) -> None:
    session = make_live_session(folder, {0: [FakeCamera(1000)] * 2, 1: [FakeCamera(1000)] * 2})
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


def test_interrupt_closes_cameras(folder: Path) -> None:
    fakes = [FakeCamera(1000), FakeCamera(1000)]
    frames = make_live_session(folder, {0: [fakes[0]], 1: [fakes[1]]}).frames(on_problem=lambda _: None)
    next(frames)
    with pytest.raises(KeyboardInterrupt):
        frames.throw(KeyboardInterrupt())
    assert all(fake.closed for fake in fakes)


def test_live_masks_and_boxes(folder: Path) -> None:
    (folder / "masks").mkdir()
    mask = np.zeros(SIZE[::-1], np.uint8)
    mask[:10] = 255
    cv2.imwrite(str(folder / "masks" / "cam_1.png"), mask)
    (folder / "boxes.toml").write_text("cam_0 = [1, 2, 30, 40]\n")
    session = make_live_session(folder, {0: [FakeCamera(1000)], 1: [FakeCamera(1000)]})
    assert session.boxes["cam_0"].width == 30
    first = next(session.frames(on_problem=lambda _: None))
    assert first.masks[0] is None
    assert first.masks[1] is not None
    assert first.masks[1].sum() == 10 * SIZE[0]


# --- network streams -------------------------------------------------------------------------------------------------


class Server:
    """MPEG-TS over TCP on this computer: one client at a time receives a number of frames, then the connection ends."""

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
        except (OSError, av.error.FFmpegError):  # the client has disconnected
            pass

    def close(self) -> None:
        self._socket.close()


def stream_session(folder: Path, *ports: int, scheme: str = "tcp") -> LiveSession:
    sources = "".join(f'cam_{c} = "{scheme}://127.0.0.1:{port}"\n' for c, port in enumerate(ports))
    (folder / "live.toml").write_text(f"max_delay = 0.15\n[sources]\n{sources}")
    return open_live(folder / "live.toml")


@pytest.mark.usefixtures("short_retry_delays")
def test_streams_are_decoded_and_paired(folder: Path) -> None:
    servers = [Server([120]), Server([120])]
    session = stream_session(folder, *(server.port for server in servers))
    problems: list[str] = []
    sets = list(session.frames(on_problem=problems.append))
    pairs = [painted_numbers(s) for s in sets if None not in painted_numbers(s)]
    assert len(pairs) > 20
    numbers = [k for pair in pairs for k in pair[:1] if k is not None]
    assert len(set(numbers)) > 15
    stamps = np.diff([t for s in sets if (t := s.times[0]) is not None])
    assert (stamps > 0).all()
    assert sum("the stream has ended" in p for p in problems) == 2
    assert not any("127.0.0.1" in p for p in problems)  # URLs may contain passwords


@pytest.mark.usefixtures("short_retry_delays")
def test_inactive_stream_does_not_block_others(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sylpose.io.capture.streams.TIMEOUT", 1.5)
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
def test_growing_folder_is_read_while_it_grows(folder: Path, lossless: bool) -> None:
    ahead = threading.Semaphore(3)  # largest lead of the recorder, in images

    def job() -> None:
        time.sleep(0.05)
        for k in range(25):
            if not ahead.acquire(timeout=60):
                break
            write(folder, "cam_0", k)
            write(folder, "cam_1", k)
        (folder / DONE_FILE).touch()

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
    assert [painted_numbers(s) for s in sets] == [[k, k] for k in range(25)]
    assert sets[10].time == pytest.approx(0.2)
    assert sets[10].interval == pytest.approx(0.02)
    assert not any(session.dropped.values())
    assert not any(session.missed.values())


def test_partially_written_files_are_awaited(folder: Path) -> None:
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
        (folder / DONE_FILE).touch()

    thread = record(job)
    sets = list(follow(folder, idle=60, max_delay=30).frames(on_problem=pytest.fail))
    thread.join()
    assert [painted_numbers(s) for s in sets] == [[k, k] for k in range(6)]


def test_delayed_and_broken_files_are_counted_and_reported(folder: Path) -> None:
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
    assert [painted_numbers(s) for s in sets] == [[0, 0], [1, 1], [2, None], [3, 3], [4, None], [5, 5]]
    assert session.missed == {"cam_0": 0, "cam_1": 2}
    assert any("0004.png" in p for p in problems)
    assert "2 without cam_1" in problems[-1]


def test_slow_reader_skips_backlog(folder: Path) -> None:
    def grow(n: int, of: int = 0) -> None:  # recorder at 20 images per second
        for k in range(of, n):
            for camera in ("cam_0", "cam_1"):
                write(folder, camera, k, written=1000 + 0.05 * k)

    grow(20)
    session = follow(folder, max_delay=0.2)
    problems: list[str] = []
    frames = session.frames(on_problem=problems.append)
    first = next(frames)
    assert 19 - first.index <= 5  # within max_delay and a frame of the newest
    assert "existed already" in problems[0]
    assert not any(session.dropped.values())
    grow(60, of=20)
    rest = [s.index for s in frames]
    assert rest[0] >= 59 - 5
    assert rest == list(range(rest[0], 60))
    assert session.dropped == dict.fromkeys(("cam_0", "cam_1"), rest[0] - first.index - 1)


def test_lossless_yields_all_frames_in_order(folder: Path) -> None:
    for k in range(20):
        for camera in ("cam_0", "cam_1"):
            write(folder, camera, k, written=1000 + k)
    session = follow(folder, lossless=True)
    assert [s.index for s in session.frames(on_problem=pytest.fail)] == list(range(20))
    assert [s.index for s in session.frames(4, 13, 4, pytest.fail)] == [4, 8, 12]


def test_dead_camera_is_awaited_only_a_few_times(folder: Path) -> None:
    for k in range(40):
        write(folder, "cam_0", k, written=1000.0)
        if k < 10:
            write(folder, "cam_1", k, written=1000.0)
    begin = time.monotonic()
    sets = list(follow(folder, max_delay=0.5).frames(on_problem=lambda _: None))
    assert time.monotonic() - begin < 0.8 * 30 * 0.5  # the time of waiting for nearly all
    assert [painted_numbers(s)[1] for s in sets] == [*range(10), *[None] * 30]


def test_out_of_order_files_are_sorted(folder: Path) -> None:
    def job() -> None:
        for k in (0, 1, 3, 2, 4, 6, 5, 7):
            for camera in ("cam_0", "cam_1"):
                write(folder, camera, k, name="shot_{}_c1.png")
            time.sleep(0.03)

    thread = record(job)
    sets = list(follow(folder, idle=3, max_delay=3).frames(on_problem=pytest.fail))
    thread.join()
    assert [painted_numbers(s)[0] for s in sets] == list(range(8))


def test_gap_is_detected_in_any_listing_order(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With 0, 1 and 3, listed as 3, 1, 0, image 2 is missing and arrives later."""
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


def test_empty_growing_folder_raises(folder: Path) -> None:
    with pytest.raises(OSError, match=r"got any image within 0.3 s"):
        list(follow(folder).frames(on_problem=pytest.fail))


def test_images_without_numbers_raise(folder: Path) -> None:
    write(folder, "cam_0", 0, name="first.png")
    write(folder, "cam_0", 1, name="second.png")
    with pytest.raises(ValueError, match="frame numbers in their names"):
        list(follow(folder).frames(on_problem=pytest.fail))


# --- invalid settings ------------------------------------------------------------------------------------------------

SOURCES = "[sources]\ncam_0 = 0\ncam_1 = 1\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[sources]\ncam_0 = 0\n", r"live\.toml: \[sources\] has no entry for camera cam_1"),
        (SOURCES + "cam_9 = 1\n", r"live\.toml: \[sources\]: cam_9 is not a camera of the calibration"),
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
def test_invalid_settings_raise_one_sentence(folder: Path, text: str, words: str) -> None:
    (folder / "live.toml").write_text(text)
    with pytest.raises(ValueError, match=words) as error:
        open_live(folder)
    assert "\n" not in str(error.value)


def test_missing_files_are_named(folder: Path) -> None:
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


def test_assembler_returns_shots() -> None:
    bench = AssemblerBench(1)
    bench.add(0, 1.0)
    shots = bench.assembler.next_set(1.0)
    assert shots is not None
    assert isinstance(shots[0], TimedFrame)
    assert shots[0].pixels().shape == (SIZE[1], SIZE[0], 3)
