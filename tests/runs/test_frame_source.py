"""Frame sources of a node: live frames are numbered by the clock, recorded ones by the file."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import numpy as np
import pytest

from sylpose.io.capture.frame_assembly import Grab
from sylpose.io.capture.sources import open_source
from sylpose.network.codec import (
    FRAME_PENDING,
    NO_FRAME,
    FrameAnnouncement,
    choose_frame,
    find_common_newcomers,
)
from sylpose.runs.frame_source import LiveSource, RecordedSource
from sylpose.simulate import make_demo_scene, write_sequence
from sylpose.simulate.rigs import ring

RIG = ring(3)
SIZE = RIG.cameras[1].size
RATE = 20.0


class Device:
    """Simulated device that delivers a frame on each call of `give`."""

    def __init__(self) -> None:
        self.go, self.requested, self.failure = threading.Semaphore(0), threading.Semaphore(0), ""
        self.n_given = 0
        self.size = SIZE

    def give(self) -> None:
        """Deliver a frame and wait until the reader requests the next one."""
        assert self.requested.acquire(timeout=60)
        self.go.release()
        assert self.requested.acquire(timeout=60)
        self.requested.release()

    def read(self) -> Grab | None:
        self.requested.release()
        self.go.acquire()
        if self.failure == "ends":
            return None
        if self.failure:
            raise OSError(self.failure)
        self.n_given += 1
        return Grab(self.size, lambda: np.full((*SIZE[::-1], 3), self.n_given, np.uint8))

    def close(self) -> None:
        self.failure = "ends"
        self.go.release()


@pytest.fixture
def device() -> Device:
    return Device()


@pytest.fixture
def live(device: Device) -> LiveSource:
    return LiveSource(1, RIG.cameras[1], 0, RATE, lambda *_: device)


def test_live_frames_are_numbered_by_the_clock(live: LiveSource, device: Device) -> None:
    before = time.time()
    device.give()
    number, stamp = live.newest(0)
    assert stamp is not None
    assert before <= stamp <= time.time()
    assert number == round(stamp * RATE)
    # The next frame is due one period later and is not available yet.
    assert live.newest(number + 1) == (FRAME_PENDING, None)
    time.sleep(1.5 / RATE)
    device.give()
    later, _ = live.newest(number + 1)
    assert later > number
    # Both frames are kept until all nodes agree on the next one.
    times = (stamp + 0.001, live.time_of(number), None)
    frames = live.frame_set(number, times)
    assert frames.index == number
    assert frames.times == times
    assert frames.time == pytest.approx(stamp + 0.0005, abs=1e-6)
    assert frames.images[0] is None
    assert frames.images[1] is not None
    assert frames.images[1][0, 0, 0] == 1
    missed = live.frame_set(number - 7, (None, None, None))
    assert missed.images == (None, None, None)
    assert missed.time == pytest.approx((number - 7) / RATE)
    live.close()
    assert live.newest(later + 1) == (NO_FRAME, None)


@pytest.mark.parametrize("how", ["broke", "size"])
def test_failing_live_camera_reports_the_reason(live: LiveSource, device: Device, how: str) -> None:
    if how == "broke":
        device.failure = "the cable is out"
    else:
        device.size = (8, 6)
    device.go.release()
    deadline = time.monotonic() + 60
    with pytest.raises(ValueError, match="0: the cable is out" if how == "broke" else "0: images of 8x6"):  # noqa: PT012
        while time.monotonic() < deadline:
            live.newest(0)
            time.sleep(0.01)


def test_recording_is_played_completely_at_its_speed(tmp_path: Path) -> None:
    truth = write_sequence(tmp_path, make_demo_scene(frames=6, angle_deg=5, n_cameras=2, seed=0))
    from sylpose.io import calibration

    rig = calibration.load(tmp_path / "calibration.toml")
    source = open_source(tmp_path / "cam_1.mp4", rig.cameras[1])
    shots, begun = RecordedSource(1, source, speed=1.0), time.monotonic()
    taken = []
    for number in range(6):
        assert shots.newest(number) == (number, number / 30)
        frames = shots.frame_set(number, (number / 30, number / 30))
        taken.append(time.monotonic() - begun)
        assert (frames.index, frames.time) == (number, number / 30)
        assert frames.images[0] is None
        assert frames.images[1] is not None
    assert shots.newest(6) == (NO_FRAME, None)
    assert taken[-1] > 5 / 30
    assert len(truth.world_from_object) == 6
    shots.close()
    with pytest.raises(FileNotFoundError, match="no such file or folder"):
        open_source(tmp_path / "cam_7.mp4", rig.cameras[1])


def roll(newest: int, *newcomers: int) -> FrameAnnouncement:
    return FrameAnnouncement(newest, 0.0, newcomers, False, True)


def test_next_frame_is_available_at_half_of_the_cameras() -> None:
    assert choose_frame([roll(7), roll(7), roll(7)], 7) == 7
    assert choose_frame([roll(7), roll(8), roll(8)], 7) == 8
    assert choose_frame([roll(7), roll(7), roll(8), roll(NO_FRAME)], 7) == 7
    assert choose_frame([roll(FRAME_PENDING), roll(8), roll(NO_FRAME)], 7) == 8
    assert choose_frame([roll(FRAME_PENDING), roll(NO_FRAME)], 7) == FRAME_PENDING
    assert choose_frame([roll(NO_FRAME), roll(NO_FRAME)], 7) == NO_FRAME


def test_only_newcomers_known_to_all_members_join() -> None:
    assert find_common_newcomers([roll(0, 3, 5), roll(0, 5, 6)]) == {5}
    assert find_common_newcomers([roll(0, 3), roll(0)]) == set()
