"""`sylpose network demo`: the recording is played as slowly as the computer needs."""

from __future__ import annotations

import subprocess
import time

import pytest

from sylpose.commands import network
from sylpose.commands.network import RATE, DemoOptions


@pytest.mark.parametrize(("start_seconds", "speed"), [(1.0, 0.1), (20.0, 39.0 / RATE / 241.0)])
def test_restarted_node_has_time_to_rejoin(monkeypatch: pytest.MonkeyPatch, start_seconds: float, speed: float) -> None:
    clock = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])

    def start(*_: object, **__: object) -> None:
        clock[0] += start_seconds

    monkeypatch.setattr(subprocess, "run", start)
    assert network._choose_speed(DemoOptions(frames=60)) == pytest.approx(speed)
    assert network._choose_speed(DemoOptions(frames=60, speed=0.0)) == 0.0
