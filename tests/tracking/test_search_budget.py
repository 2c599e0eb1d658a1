"""A lost object costs bounded work per frame, is found soon after its return, and delays live poses little."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sylpose.features.sift import detect_features, match_features
from sylpose.status import FrameStatus
from sylpose.tracking import relocalization
from sylpose.tracking.camera_side import camera as camera_module
from sylpose.tracking.options import TrackingOptions
from sylpose.tracking.relocalization import N_KEYFRAMES
from sylpose.tracking.search_clock import MAX_DRIFT, MAX_LATE_INTERVALS, SearchClock
from sylpose.tracking.tracker import Tracker, track
from tests.clips import compute_pose_errors, hidden_clip, statuses

INTERVAL = 1.0 / 30.0


@pytest.fixture
def work(monkeypatch: pytest.MonkeyPatch) -> dict[str, list[int]]:
    """Pixels of each detection, and features of each matched keyframe, in the order of the calls."""
    done: dict[str, list[int]] = {"pixels": [], "keyframes": []}

    def spy_detect(*args: Any, max_pixels: int | None = None, **kwargs: Any) -> Any:
        area = int(np.count_nonzero(args[2]))
        done["pixels"].append(area if max_pixels is None else min(area, max_pixels))
        return detect_features(*args, max_pixels=max_pixels, **kwargs)

    def spy_match(*args: Any) -> Any:
        done["keyframes"].append(len(args[0]))
        return match_features(*args)

    monkeypatch.setattr(camera_module, "detect_features", spy_detect)
    monkeypatch.setattr(relocalization, "match_features", spy_match)
    return done


def test_work_of_lost_frames_is_bounded(work: dict[str, list[int]]) -> None:
    clip = hidden_clip()
    frames, n = clip.frames(), len(clip.rig)
    # The object stays hidden.
    frames = [*frames[:8], *[frames[8]] * 22]
    with Tracker(clip.rig, clip.boxes) as tracker:
        pixels, keyframes, found = [], [], []
        for frame in frames:
            for counts in work.values():
                counts.clear()
            found += tracker.step(frame)
            pixels.append(list(work["pixels"]))
            keyframes.append(len(work["keyframes"]))
    assert set(statuses(found)[8:]) <= {FrameStatus.COASTING, FrameStatus.LOST, FrameStatus.BACKGROUND_ONLY}
    assert all(len(one) <= n and sum(one) <= n * TrackingOptions.likely_search_pixels for one in pixels[8:])
    assert np.median([sum(one) for one in pixels[8:]]) <= n * TrackingOptions.search_pixels
    assert max(keyframes[8:]) <= n * 2 * N_KEYFRAMES
    assert sum(map(len, pixels[9:])) > 0


def test_object_is_found_within_few_frames() -> None:
    clip = hidden_clip()
    found = list(track(clip.frames(), clip.rig, clip.boxes))
    assert not any(frame.pose.is_measured for frame in found[7:10])
    first = next(k for k, frame in enumerate(found) if k >= 10 and frame.pose.is_measured)
    assert first <= 12
    assert statuses(found)[first] is FrameStatus.RELOCALIZED
    assert compute_pose_errors(found, clip.truth)[first - 1 :, 0].max() < 1.0


def run_live(seconds: float, frames: int = 200, other: float = 0.002) -> tuple[list[float], list[float]]:
    """Return the lateness (frames,) and searched shares of frames that take `seconds` for a full search."""
    now, late, shares = 0.0, [], []
    clock = SearchClock(lambda: now)
    for k in range(frames):
        arrival = 100.0 + k * INTERVAL
        now = max(now, arrival)
        clock.begin_frame(arrival - 100.0, INTERVAL)
        now += other
        share = clock.share("region")
        if share:
            with clock.measure("region", share):
                now += share * seconds
        late.append(now - arrival)
        shares.append(share)
    return late, shares


@pytest.mark.parametrize("seconds", [0.005, 0.03, 0.06, 0.1, 0.2])
def test_search_makes_live_poses_at_most_two_frames_late(seconds: float) -> None:
    late, shares = run_live(seconds)
    begin = 6  # until the duration is known
    drift = MAX_DRIFT * len(late) * INTERVAL
    assert max(late[begin:]) <= MAX_LATE_INTERVALS * INTERVAL + 0.002 + drift
    assert np.mean([share > 0 for share in shares[begin:]]) > 0.2


@pytest.mark.parametrize(("seconds", "is_searched"), [(0.02, True), (0.2, False)])
def test_search_that_cannot_be_shortened(seconds: float, is_searched: bool) -> None:
    """It is tried although its duration is unknown, and again if it fits."""
    now, count = 0.0, 0
    clock = SearchClock(lambda: now)
    for k in range(40):
        now = max(now, k * INTERVAL)
        clock.begin_frame(k * INTERVAL, INTERVAL)
        if clock.share("all features", 1.0):
            with clock.measure("all features", 1.0):
                now += seconds
            count += 1
    if is_searched:
        assert count > 30
    else:
        assert 1 <= count < 4


def test_search_is_tried_again_after_a_busy_time() -> None:
    """A duration measured while the machine was busy does not end the search."""
    now = 0.0
    clock = SearchClock(lambda: now)
    for k in range(400):
        now = max(now, k * INTERVAL)
        clock.begin_frame(k * INTERVAL, INTERVAL)
        share = clock.share("region")
        if share:
            with clock.measure("region", share):
                now += 1.5 if k < 10 else 0.01
    assert share == 1.0


@pytest.mark.parametrize(("seconds", "is_searched"), [(0.0, True), (10.0, False)])
def test_tracker_skips_search_without_time(
    seconds: float, is_searched: bool, work: dict[str, list[int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only lost frames are affected, and the object is found once there is time."""
    clip, now, number = hidden_clip(), 0.0, 0
    clock = SearchClock(lambda: now)
    spied: Callable[..., Any] = vars(camera_module)["detect_features"]

    def take_time(*args: Any, **kwargs: Any) -> Any:
        nonlocal now
        now += seconds if number == 8 else 0.0
        return spied(*args, **kwargs)

    monkeypatch.setattr(camera_module, "detect_features", take_time)
    counts = []
    with Tracker(clip.rig, clip.boxes, search_clock=clock) as tracker:
        for k, frame in enumerate(clip.frames()):
            number = k
            now = max(now, frame.time)
            work["pixels"].clear()
            tracker.step(replace(frame, interval=INTERVAL))
            counts.append(len(work["pixels"]))
    assert (counts[9] > 0) == is_searched
    assert counts[8] > 0
