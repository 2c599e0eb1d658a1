"""Nodes on a real network on this machine: processes and sessions, keys, crashes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from sylpose.commands.main import main
from sylpose.commands.network import build_node_command
from sylpose.io import calibration
from sylpose.io.capture import open_session
from sylpose.network.keys import make_keys
from sylpose.network.membership import ExchangeRequest, Membership, Request, Response
from sylpose.network.node import Node, track_by_node
from sylpose.network.rounds import Timeouts
from sylpose.network.runner import NodeRunner
from sylpose.network.simulation import FrameBuffer, RecordedCamera
from sylpose.network.wire_format import Welcome
from sylpose.network.zenoh_transport import (
    LOOPBACK,
    LinkSettings,
    NodeAddress,
    ZenohTransport,
    compute_rig_digest,
    watch_network,
)
from sylpose.packets import Packet
from sylpose.report.files import read_trajectory
from sylpose.simulate import make_demo_scene, write_sequence
from sylpose.simulate.recordings import DemoTruth
from sylpose.tracking.context import TrackedFrame
from sylpose.tracking.tracker import track
from tests.clips import SIZE, Clip, compute_pose_errors
from tests.network.test_simulation import FRAMES, clip  # noqa: F401

pytest.importorskip("zenoh")

NAMES = ("cam_0", "cam_1")
DEADLINE = 90.0  # seconds, on a busy machine
SMALL = (240, 180)


@pytest.fixture
def network() -> str:
    return f"test-{os.getpid()}-{time.monotonic_ns()}"


# --- processes --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, DemoTruth]:
    folder = tmp_path_factory.mktemp("recording")
    return folder, write_sequence(folder, make_demo_scene(frames=4, angle_deg=8, n_cameras=2, seed=5, size=SIZE))


def test_processes_reproduce_single_process_trajectory(
    recording: tuple[Path, DemoTruth], network: str, tmp_path: Path
) -> None:
    """With keys; a third node, with keys of another authority, is not admitted."""
    folder, _ = recording
    file = folder / "calibration.toml"
    for keys in ("keys", "others"):
        make_keys(tmp_path / keys, NAMES)
    links = ["--network", network, "--speed", "0"]
    poses: list[str] = []
    listener = LinkSettings(LOOPBACK, keys=tmp_path / "keys")
    session = watch_network(listener, network, lambda *_: None, lambda _, line: poses.append(line))

    def node(name: str, keys: str, *more: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "sylpose", "node", name, "--calibration", str(file), *links]
        command += ["--source", str(folder / f"{name}.mp4"), "--keys", str(tmp_path / keys), *more]
        command += ["--out", str(tmp_path / name / keys)]
        return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)

    nodes = [node(name, "keys", "--wait", "60") for name in NAMES]
    foreign = node("cam_1", "others", "--wait", "0")
    try:
        message = [process.communicate(timeout=DEADLINE)[0] for process in (*nodes, foreign)]
    finally:
        for process in (*nodes, foreign):
            process.kill()
    session.close()
    assert [process.returncode for process in nodes] == [0, 0], message
    session_there = open_session(folder)
    expected = list(track(session_there.frames(), session_there.rig, lookahead=0))
    for name in NAMES:
        found = read_trajectory(tmp_path / name / "keys" / f"{name}.csv")
        assert [p.status for p in found] == [f.pose.status for f in expected]
        for mine, its in zip(found, expected, strict=True):
            if its.pose.world_from_object is not None:
                assert mine.world_from_object is not None
                np.testing.assert_allclose(
                    mine.world_from_object.as_matrix(), its.pose.world_from_object.as_matrix(), atol=1e-7
                )
    # Observers receive it as well: a line for each frame of each node.
    lines = [json.loads(line) for line in poses]
    assert {line["node"] for line in lines} == set(NAMES)
    last = [line for line in lines if line["frame"] == 3]
    assert last
    assert all(line["took_part"] == list(NAMES) and line["status"] == "tracked" for line in last)
    pose = expected[-1].pose.world_from_object
    assert pose is not None
    np.testing.assert_allclose(last[0]["position"], pose.translation, atol=1e-7)
    # The third node remained alone.
    assert "with cam_1;" in message[-1]
    assert "cam_0" not in message[-1]


@pytest.mark.slow
def test_eight_processes_agree_with_one(network: str, tmp_path: Path) -> None:
    """Small images, so that two cores suffice."""
    folder, names = tmp_path / "recording", [f"cam_{c}" for c in range(8)]
    write_sequence(folder, make_demo_scene(frames=6, angle_deg=15, n_cameras=8, seed=7, size=SMALL))
    poses: list[str] = []
    session = watch_network(LinkSettings(), network, lambda *_: None, lambda _, line: poses.append(line))
    nodes = []
    for name in names:
        nodes.append(subprocess.Popen(build_node_command(name, folder, tmp_path / name, network, 0.0, DEADLINE)))
    try:
        assert [node.wait(DEADLINE) for node in nodes] == [0] * 8
    finally:
        for node in nodes:
            node.kill()
    session.close()
    lines = [json.loads(line) for line in poses]
    there = open_session(folder)
    expected = list(track(there.frames(), there.rig))
    assert sum(f.pose.world_from_object is not None for f in expected) >= 5
    for frame in expected:
        pose = frame.pose.world_from_object
        of_frame = [line for line in lines if line["frame"] == frame.pose.index]
        assert [line["node"] for line in sorted(of_frame, key=lambda line: str(line["node"]))] == names
        message = [(line["status"], line["position"], line["quaternion"]) for line in of_frame]
        assert message == [message[0]] * 8
        assert message[0][0] == frame.pose.status.value
        assert all(line["took_part"] == names for line in of_frame)
        if pose is None:
            assert message[0][1] is None
            continue
        # To the precision of JSON; matrix products may round differently if the memory layout differs.
        np.testing.assert_allclose(message[0][1], pose.translation, rtol=0, atol=1e-12)
        np.testing.assert_allclose(message[0][2], pose.rotation.as_quat(), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (["cam_9", "--source", "cam_0.mp4"], "no camera 'cam_9' in it (cam_0, cam_1)"),
        (
            ["cam_0", "--source", "nothing.mp4"],
            "--source nothing.mp4: no such file or folder, and not a camera number",
        ),
        (["cam_0", "--source", "0"], "--rate HZ is needed with a camera or a stream"),
        (["cam_0"], "a node requires a camera and its images: give CAMERA and --source"),
        (["cam_0", "--source", "{folder}/cam_0.mp4", "--keys", "no_keys"], "no_keys/ca.pem: no such file"),
        (["cam_0", "--source", "{folder}/cam_0.mp4", "--network", "a/b"], "network 'a/b': a name of letters"),
        (["cam_0", "--source", "{folder}/cam_0.mp4", "--listen", "1.2.3.4:1"], "cannot listen at 1.2.3.4:1"),
        (["--view", "cam_0", "--source", "x"], "--view runs a node without a camera"),
    ],
)
def test_invalid_nodes_get_reason(
    recording: tuple[Path, DemoTruth],
    options: list[str],
    why: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    folder, _ = recording
    monkeypatch.chdir(tmp_path)
    given = [option.format(folder=folder) for option in options]
    assert main(["node", *given, "--calibration", str(folder / "calibration.toml")]) == 2
    assert why in capsys.readouterr().err


# --- sessions ---------------------------------------------------------------------------------------------------------


class RunningNodes:
    """Nodes in threads of this process, each with its own session."""

    def __init__(self, of: Clip, network: str) -> None:
        self.clip, self.network = of, network
        self.found: dict[int, list[TrackedFrame]] = {}
        self.refused: dict[int, dict[str, str]] = {}
        self._stops: dict[int, threading.Event] = {}
        self._thread_pool: list[threading.Thread] = []
        self.errors: list[BaseException] = []

    def start(self, c: int, pause: float = 0.0) -> None:
        """Start a node on the clip, with a pause after each frame."""
        stop = self._stops[c] = threading.Event()
        self.found[c] = []
        thread = threading.Thread(target=self._run, args=(c, stop, pause), daemon=True)
        self._thread_pool.append(thread)
        thread.start()

    def _run(self, c: int, stop: threading.Event, pause: float) -> None:
        rig, found = self.clip.rig, self.found[c]

        def work(ask: Callable[[Request, int], Response]) -> None:
            shots = RecordedCamera(c, FrameBuffer(self.clip.frames()))
            for frame in track_by_node(Node(c, len(rig), ask), rig, shots, self.clip.boxes, must_join=True):
                found.append(frame)
                time.sleep(pause)

        def send(packets: list[Packet]) -> int:
            return 0 if stop.is_set() else wire.send(packets)

        try:
            present = Membership(c, len(rig), time.time_ns() % 2**32, 500, Timeouts(50, 1500))
            runner = NodeRunner(present, work, send)  # type: ignore[arg-type]
            place = NodeAddress(rig.names[c], compute_rig_digest(rig), self.network)
            wire = ZenohTransport(place, rig.names, LinkSettings(), runner.receive, on_disconnect=runner.report_lost)
            self.refused[c] = wire.refused
            try:
                runner.run(lambda _: None, stop.is_set)
            finally:
                wire.close()
        except BaseException as error:
            self.errors.append(error)

    def kill(self, c: int) -> None:
        """Stop a node without further messages."""
        self._stops[c].set()

    def wait(self, until: Callable[[], bool]) -> None:
        """Wait until a condition holds."""
        end = time.monotonic() + DEADLINE
        while not until():
            assert not self.errors, self.errors
            assert time.monotonic() < end, "timed out"
            time.sleep(0.01)

    def join(self) -> None:
        """Wait until all nodes have finished."""
        for thread in self._thread_pool:
            thread.join(DEADLINE)
            assert not thread.is_alive()
        assert not self.errors, self.errors


@pytest.fixture
def sessions(clip: Clip, network: str) -> Iterator[RunningNodes]:  # noqa: F811
    running = RunningNodes(clip, network)
    yield running
    for c in list(running.found):
        running.kill(c)


def test_killed_node_rejoins(sessions: RunningNodes) -> None:
    for c in range(3):
        sessions.start(c, pause=0.4)
    sessions.wait(lambda: len(sessions.found[1]) >= 2)
    sessions.kill(1)
    before = sessions.found[1]
    sessions.wait(lambda: len(sessions.found[0]) >= 3 and len(sessions.found[0]) > len(before))
    sessions.start(1, pause=0.4)
    sessions.join()
    again = sessions.found[1]
    assert again, "it did not come back"
    for c in (0, 2):
        assert len(sessions.found[c]) == FRAMES
        assert compute_pose_errors(sessions.found[c], sessions.clip.truth)[:, 0].max() < 1.2
    # Its results equal the others', before and after.
    others = {f.pose.index: f.pose for f in sessions.found[0]}
    for frame in (*before[:-1], *again):
        mine, its = frame.pose.world_from_object, others[frame.pose.index].world_from_object
        assert mine is not None
        assert its is not None
        np.testing.assert_array_equal(mine.as_matrix(), its.as_matrix())


def test_duplicate_names_and_other_calibrations_are_rejected(sessions: RunningNodes, tmp_path: Path) -> None:
    sessions.start(0)
    sessions.wait(lambda: 0 in sessions.refused)
    rig = sessions.clip.rig
    with pytest.raises(ValueError, match=r"cam_0: another node in network .* already has this name"):
        ZenohTransport(
            NodeAddress("cam_0", compute_rig_digest(rig), sessions.network), rig.names, LinkSettings(), lambda *_: None
        )
    calibration.save(rig, tmp_path / "rig.toml")
    assert compute_rig_digest(calibration.load(tmp_path / "rig.toml")) == compute_rig_digest(rig)
    other = ZenohTransport(
        NodeAddress("cam_1", "0123456789abcdef", sessions.network), rig.names, LinkSettings(), lambda *_: None
    )
    sessions.wait(lambda: "cam_1" in sessions.refused[0])
    assert "its calibration or its options differ" in sessions.refused[0]["cam_1"]
    sessions.wait(lambda: "cam_0" in other.refused)
    other.close()


def test_lost_node_is_detected_immediately(clip: Clip, network: str) -> None:  # noqa: F811
    """By the closed link, without waiting for the inactivity timeout."""
    names, gone = clip.rig.names, list[int]()
    ends = threading.Event()

    def on_gone(camera: int) -> None:
        gone.append(camera)
        ends.set()

    rig = compute_rig_digest(clip.rig)
    here = ZenohTransport(
        NodeAddress(names[0], rig, network), names, LinkSettings(), lambda *_: None, on_disconnect=on_gone
    )
    there = ZenohTransport(NodeAddress(names[2], rig, network), names, LinkSettings(), lambda *_: None)
    other = ZenohTransport(NodeAddress(names[1], "0123456789abcdef", network), names, LinkSettings(), lambda *_: None)
    # Its presence was observed, so its end must be.
    end = time.monotonic() + DEADLINE
    while names[1] not in here.refused:
        assert time.monotonic() < end
        time.sleep(0.01)
    other.close()
    there.close()
    assert ends.wait(DEADLINE)
    here.close()
    assert gone == [2]


def test_lost_node_is_not_awaited() -> None:
    """It counts as inactive; a message that arrives nevertheless is accepted."""

    def work(ask: Callable[[Request, int], Response]) -> None:
        ask(ExchangeRequest(b"mine"), 0)

    patience = Timeouts(50, 1500)
    group = Welcome(0, 0, frozenset({0, 1}), b"")
    runner = NodeRunner(Membership(0, 2, timeouts=patience, welcome=group), work, lambda _: 0)
    begun, ended = time.monotonic(), list[float]()

    def on_tick(present: Membership) -> None:
        if present.ticks == 3:
            runner.report_lost(1)
        if present.members == (0,) and not ended:
            ended.append(float(present.ticks))

    runner.run(on_tick, lambda: bool(ended) or time.monotonic() - begun > DEADLINE)
    assert ended
    assert 3 < ended[0] < 3 + patience.inactive / 2
