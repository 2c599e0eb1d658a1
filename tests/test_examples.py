"""The examples run on a simulated recording and print the expected output."""

from __future__ import annotations

import runpy
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.report.files import format_pose_line
from sylpose.results import FramePose
from sylpose.status import FrameStatus
from tests.conftest import FRAMES
from tests.paths import REPOSITORY

EXAMPLES = REPOSITORY / "examples"


def run_example(
    name: str, args: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> list[str]:
    monkeypatch.setattr("sys.argv", [name, *args])
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    return capsys.readouterr().out.splitlines()


def test_track_videos(recording: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    lines = run_example("track_videos.py", [str(recording)], monkeypatch, capsys)
    assert len(lines) == FRAMES
    assert "pan 0.00°" in lines[0]
    assert lines[-1].startswith("  0.367 s")


def test_track_videos_requires_a_recording(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match=r"usage: python examples/track_videos\.py RECORDING"):
        run_example("track_videos.py", [], monkeypatch, capsys)


def test_own_arrays(recording: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    lines = run_example("own_arrays.py", [str(recording)], monkeypatch, capsys)
    assert lines.count("Motion: ok. The estimate converged and every requested quantity is observable.") == 3
    assert sum("360 bytes" in line for line in lines) == 3


def pose_lines() -> list[str]:
    """Return lines as `--stream` sends them: a pose, one with an unbounded depth, and a frame without."""
    rotation = Rotation.from_rotvec([0.1, -0.2, 0.3])
    pose = RigidTransform.from_components([1.0, 2.0, 3.0], rotation)
    covariance = np.diag(np.square([0.01, 0.02, 0.03, 0.1, 0.2, 0.3]))
    unbounded = covariance.copy()
    unbounded[5, 5] = np.inf
    frames = [
        FramePose(0, 0.0, FrameStatus.TRACKED, pose, covariance, np.array([9]), np.ones(1)),
        FramePose(1, 0.5, FrameStatus.TRACKED, pose, unbounded, np.array([9]), np.ones(1)),
        FramePose(2, 1.0, FrameStatus.LOST, None, np.full((6, 6), np.inf), np.array([0]), np.ones(1)),
    ]
    return [format_pose_line(frame, ["cam_0"], "m", object="mug") for frame in frames]


def test_lab_streaming_layer() -> None:
    """A stream that another program of the network receives."""
    pylsl = pytest.importorskip("pylsl")
    publish = runpy.run_path(str(EXAMPLES / "stream_lsl.py"))["publish"]
    received: list[tuple[list[float], float]] = []

    def send() -> Iterator[str]:
        lines = pose_lines()
        yield lines[0]  # opens the stream
        (info,) = pylsl.resolve_byprop("name", "mug", timeout=60.0)
        inlet = pylsl.StreamInlet(info)
        inlet.open_stream(timeout=60.0)
        yield from lines[1:]
        received.extend(inlet.pull_sample(timeout=60.0) for _ in lines[1:])

    publish(send())
    (first, time), (second, later) = received
    assert first[:3] == [1.0, 2.0, 3.0]
    np.testing.assert_allclose(first[3:7], Rotation.from_rotvec([0.1, -0.2, 0.3]).as_quat())
    np.testing.assert_allclose(first[7:], [*np.degrees([0.01, 0.02, 0.03]), 0.1, 0.2, np.inf])
    assert np.isnan(second).all()
    assert time <= later <= pylsl.local_clock()


class FakeNode:
    """What the example uses of `rclpy.node.Node`; messages have the fields of ROS 2."""

    published: ClassVar[dict[str, list[Any]]] = {}

    def __init__(self, name: str) -> None:
        pass

    def create_publisher(self, *kind_topic_depth: Any) -> Any:
        topic = kind_topic_depth[1]
        return SimpleNamespace(publish=self.published.setdefault(topic, []).append)

    def get_clock(self) -> Any:
        return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=lambda: 7))

    def destroy_node(self) -> None:
        pass


def test_ros2(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a stand-in for rclpy, which no package index has."""

    def vector(names: str) -> Any:
        return SimpleNamespace(**dict.fromkeys(names, 0.0))

    def pose_message() -> Any:
        pose = SimpleNamespace(position=vector("xyz"), orientation=vector("xyzw"))
        return SimpleNamespace(header=SimpleNamespace(), pose=SimpleNamespace(pose=pose, covariance=np.zeros(36)))

    def transform_message() -> Any:
        transform = SimpleNamespace(translation=vector("xyz"), rotation=vector("xyzw"))
        return SimpleNamespace(header=SimpleNamespace(), transform=transform)

    sent: list[Any] = []
    modules = {
        "rclpy": SimpleNamespace(init=lambda: None, shutdown=lambda: None),
        "rclpy.node": SimpleNamespace(Node=FakeNode),
        "geometry_msgs": SimpleNamespace(),
        "geometry_msgs.msg": SimpleNamespace(
            PoseWithCovarianceStamped=pose_message, TransformStamped=transform_message
        ),
        "tf2_ros": SimpleNamespace(TransformBroadcaster=lambda _: SimpleNamespace(sendTransform=sent.append)),
    }
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    runpy.run_path(str(EXAMPLES / "stream_ros2.py"))["publish"](pose_lines())
    first, second = FakeNode.published["mug/pose"]
    assert [sent[0].child_frame_id, sent[0].header.frame_id, len(sent)] == ["mug", "world", 2]
    assert vars(first.pose.pose.position) == vars(sent[0].transform.translation) == {"x": 1.0, "y": 2.0, "z": 3.0}
    covariance = np.reshape(first.pose.covariance, (6, 6))
    np.testing.assert_allclose(covariance, np.diag(np.square([0.1, 0.2, 0.3, 0.01, 0.02, 0.03])))
    assert second.pose.covariance[14] == 1e6
