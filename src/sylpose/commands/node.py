"""`sylpose node` and `sylpose nodes`: a camera node of a network, and a list of the nodes."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console

from sylpose import __version__
from sylpose.commands.frame_source import LiveSource, RecordedSource
from sylpose.frames import Box
from sylpose.input_limits import to_one_line
from sylpose.io import calibration as calibrations
from sylpose.io.capture.boxes import load_boxes
from sylpose.io.capture.sources import open_source
from sylpose.network.membership import Membership, Request, Response
from sylpose.network.node import Node, track_by_node
from sylpose.network.rounds import Timeouts
from sylpose.network.runner import TICK_SECONDS, NodeRunner
from sylpose.network.wire_format import MAX_CAMERAS
from sylpose.network.zenoh_transport import LinkSettings, NodeAddress, ZenohTransport, compute_rig_digest, watch_network
from sylpose.report.files import TrajectoryWriter
from sylpose.report.json_lines import format_pose_line
from sylpose.results import FramePose
from sylpose.rig import Rig
from sylpose.runs import console_output
from sylpose.tracking.tracked_frame import TrackedFrame

__all__ = ["NodeOptions", "catch_interrupts", "run_node_command", "run_nodes_command"]

# Seconds between two status lines of a node (choice).
REPORT_INTERVAL = 1.0
# Apparent clock offsets above this, in seconds, exceed the delay of a local network (choice).
MAX_CLOCK_OFFSET = 0.2


@dataclass(frozen=True)
class NodeOptions:
    """Options of a node: see `sylpose node --help`."""

    camera: str
    calibration: Path
    source: str
    boxes: Path | None
    out: Path | None
    network: str
    links: LinkSettings
    rate: float | None
    speed: float
    wait: float
    patience: float
    method: str
    features: str
    mode: str
    seed: int


@dataclass
class _NodeProgress:
    """Progress of a node, for its status lines."""

    frames: int = 0
    poses: int = 0
    last: FramePose | None = None
    latency: float = 0.0
    members: tuple[int, ...] = ()


def run_node_command(options: NodeOptions) -> bool:
    """Run one camera's node in a network until its source ends or it is interrupted.

    Returns:
        whether any pose was measured.

    Raises:
        ValueError, OSError: the calibration lacks the camera, the source cannot be read, or the name is in use.
        KeyboardInterrupt: stopped by a signal, after all files are complete.
    """
    rig = calibrations.load(options.calibration)
    c = _camera_index(rig, options.camera, options.calibration)
    boxes = _read_boxes(options.boxes, rig)
    source = _open_source(options, rig, c)
    console = console_output.make_console()
    place = NodeAddress(
        options.camera, compute_rig_digest(rig, _format_shared_options(options, boxes)), options.network
    )
    progress = _NodeProgress()
    present = Membership(
        c,
        len(rig),
        incarnation=time.time_ns() & 0xFFFFFFFF,
        wait=round(options.wait / TICK_SECONDS),
        timeouts=Timeouts(round(1.0 / TICK_SECONDS), round(options.patience / TICK_SECONDS)),
    )
    folder = options.out if options.out is not None else Path(f"sylpose_{options.camera}")
    refused: dict[int, str] = {}

    def work(request: Callable[[Request, int], Response]) -> None:
        node = Node(c, len(rig), request, options.mode)
        node.refused = refused
        for tracked in _track_timed(node, rig, source, boxes, options, progress):
            progress.members, progress.last = node.members, tracked.pose
            progress.frames += 1
            progress.poses += tracked.pose.is_measured
            writer.write(tracked.pose)
            members = [rig.names[i] for i in node.members]
            by_name = _refusals_by_name(rig, refused, runner, wire)
            wire.publish_pose(
                format_pose_line(
                    tracked.pose, rig.names, rig.unit, node=options.camera, took_part=members, refused=by_name
                )
            )

    runner = NodeRunner(present, work, lambda packets: wire.send(packets))
    # Connect before opening the files: those of a running node of the same name must not be overwritten.
    wire = ZenohTransport(place, rig.names, options.links, runner.receive, on_disconnect=runner.report_lost)
    try:
        with (
            TrajectoryWriter(folder, rig.names, rig.unit, stem=options.camera) as writer,
            catch_interrupts() as stopped,
        ):
            reporter = _StatusReporter(console, options, rig, progress, wire, refused, runner)
            console.print(reporter.describe_address(), soft_wrap=True)
            runner.run(reporter.tick, stopped)
    finally:
        wire.close()
        with suppress(ValueError):  # its thread may still be reading
            source.close()
    console_output.print_files(console, "Files", [writer.tum_path, writer.csv_path])
    if stopped():
        raise KeyboardInterrupt(f"{options.camera}: stopped")
    return progress.poses > 0


def _format_shared_options(options: NodeOptions, boxes: dict[str, Box] | None) -> str:
    """Return a text of the options that must be the same at all nodes."""
    return repr(
        (
            __version__,
            options.method,
            options.features,
            options.mode,
            options.seed,
            options.rate,
            sorted((boxes or {}).items()),
        )
    )


def _camera_index(rig: Rig, camera: str, calibration: Path) -> int:
    if camera not in rig.names:
        raise ValueError(f"{calibration}: no camera {camera!r} in it ({', '.join(rig.names)})")
    return rig.names.index(camera)


def _read_boxes(path: Path | None, rig: Rig) -> dict[str, Box] | None:
    if path is None:
        return None
    by_object = load_boxes(path, rig)
    if len(by_object) > 1:
        raise ValueError(f"{path}: boxes of {len(by_object)} objects; nodes track only one")
    return next(iter(by_object.values()), None)


def _open_source(options: NodeOptions, rig: Rig, c: int) -> RecordedSource | LiveSource:
    """Open the source: an existing file or folder, else a device or a URL."""
    source, path = options.source, Path(options.source)
    if path.is_dir() or (path.is_file() and not path.is_char_device()):
        return RecordedSource(c, open_source(path, rig.cameras[c]), options.rate, options.speed)
    device: int | str | None = int(source) if source.isdigit() else source if "://" in source else None
    if device is None and not path.exists():
        raise ValueError(f"--source {source}: no such file or folder, and not a camera number or URL")
    if options.rate is None:
        raise ValueError("--rate HZ is needed with a camera or a stream: all nodes number frames by it")
    return LiveSource(c, rig.cameras[c], source if device is None else device, options.rate)


def _track_timed(
    node: Node,
    rig: Rig,
    source: RecordedSource | LiveSource,
    boxes: dict[str, Box] | None,
    options: NodeOptions,
    progress: _NodeProgress,
) -> Iterator[TrackedFrame]:
    """Yield the tracked frames, and record each one's latency since its images were available."""
    timed_source = _TimedSource(source)
    tracked = track_by_node(
        node,
        rig,
        timed_source,
        boxes,
        must_join=True,
        method=options.method,
        features=options.features,
        seed=options.seed,
    )
    for frame in tracked:
        progress.latency = time.monotonic() - timed_source.arrival_time
        yield frame


class _TimedSource:
    """Frame source that records when the latest frame became available."""

    def __init__(self, source: RecordedSource | LiveSource) -> None:
        self._source, self.arrival_time = source, 0.0
        self.time_of, self.frame_set = source.time_of, source.frame_set

    def newest(self, wanted: int) -> tuple[int, float | None]:
        """See `CameraFrames`."""
        found = self._source.newest(wanted)
        self.arrival_time = time.monotonic()
        return found


def _refusals_by_name(rig: Rig, refused: dict[int, str], runner: NodeRunner, wire: ZenohTransport) -> dict[str, str]:
    """Return the reason of each refused node by its name."""
    by_number = {**runner.membership.all_refused, **refused, **runner.membership.all_evidence.describe(rig.names)}
    return {**{rig.names[c]: why for c, why in by_number.items() if c < len(rig)}, **wire.refused}


@contextmanager
def catch_interrupts() -> Iterator[Callable[[], bool]]:
    """Let SIGINT and SIGTERM end a node between two steps; yield a function that returns whether one arrived."""
    signals: list[int] = []
    handlers = {s: signal.signal(s, lambda number, _: signals.append(number)) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(signals)
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


class _StatusReporter:
    """Reporter of a node's state: a line per second on the terminal, and one of JSON to the network."""

    def __init__(
        self,
        console: Console,
        options: NodeOptions,
        rig: Rig,
        progress: _NodeProgress,
        wire: ZenohTransport,
        refused: dict[int, str],
        runner: NodeRunner,
    ) -> None:
        self._console, self._options, self._rig, self._progress = console, options, rig, progress
        self._wire, self._refused, self._runner = wire, refused, runner
        self._next_report = time.monotonic()
        self._previous = (0, 0, 0, self._next_report)
        self._reported: dict[str, str] = {}

    def describe_address(self) -> str:
        """Describe the address at which this node listens and who can connect."""
        options = self._options
        text = f"{options.camera} in network {options.network}, rig {self._wire.address.rig[:8]}"
        text += f", listens at {options.links.listen}"
        if options.links.keys is not None:
            return f"{text}, to nodes with keys of {options.links.keys}"
        local = options.links.listen.startswith(("127.", "localhost"))
        return f"{text}: this machine only" if local else f"{text}: OPEN to everyone who can reach it, without keys"

    def tick(self, present: Membership) -> None:
        """Report the node's state if the next report is due; called every tick."""
        now = time.monotonic()
        if now < self._next_report:
            return
        self._next_report = now + REPORT_INTERVAL
        refused = _refusals_by_name(self._rig, self._refused, self._runner, self._wire)
        for name, reason in refused.items():
            if self._reported.get(name) != reason:
                self._reported[name] = reason
                console_output.print_to_stderr(f"{self._options.camera}: {name} is refused: {reason}")
        state = self._build_state(present, now)
        self._wire.publish_state(json.dumps({**state, "refused": refused}))
        self._console.print(self._format_line(state), soft_wrap=True)

    def _build_state(self, present: Membership, now: float) -> dict[str, object]:
        progress, (frames, sent, rounds, since) = self._progress, self._previous
        number, n_done = present.frames, progress.frames - frames
        elapsed = max(now - since, 1e-9)
        self._previous = (progress.frames, self._runner.bytes_sent, self._runner.rounds, now)
        return {
            "node": self._options.camera,
            "clock": time.time(),
            "pid": os.getpid(),
            "state": "waiting" if not present.members else "tracking" if number else "starting",
            "members": [self._rig.names[c] for c in present.members],
            "frames": number,
            "rate": n_done / elapsed,
            "latency_ms": 1e3 * progress.latency,
            "bytes_per_frame": (self._runner.bytes_sent - sent) / n_done if n_done else 0.0,
            "rounds_per_frame": (self._runner.rounds - rounds) / n_done if n_done else 0.0,
            "status": "" if progress.last is None else progress.last.status.value,
        }

    def _format_line(self, state: dict[str, object]) -> str:
        pose, members = self._progress.last, ", ".join(map(str, state["members"]))  # type: ignore[call-overload]
        if not members:
            return f"{self._options.camera}: waiting for other nodes"
        if pose is None:
            return f"{self._options.camera}: with {members}; no frame yet"
        where = ""
        if pose.world_from_object is not None:
            x, y, z = pose.position
            rotation_sd, position_sd = np.degrees(pose.sigma[:3].max()), pose.sigma[3:].max()
            where = f" at {x:.4g} {y:.4g} {z:.4g} {self._rig.unit}, ±{position_sd:.2g}, ±{rotation_sd:.2g}°"
        return (
            f"{self._options.camera}: frame {pose.index} {pose.status.value}{where}; with {members}; "
            f"{state['rate']:.1f} per second, {state['latency_ms']:.0f} ms"
        )


def run_nodes_command(network: str, links: LinkSettings, seconds: float) -> bool:
    """Print the nodes of a network as a table.

    Args:
        network: name of the network.
        links: how to connect.
        seconds: time to listen for nodes.

    Returns:
        whether any node was found.
    """
    found: dict[tuple[str, str], tuple[dict[str, object], float]] = {}

    def on_state(rig: str, name: str, line: str) -> None:
        with suppress(ValueError, TypeError, KeyError, OverflowError, RecursionError):
            state = json.loads(line)
            numbers = [float(state[key]) for key in ("clock", "frames", *(key for key, _ in _COLUMNS))]
            if np.isfinite(numbers).all() and len(found) < MAX_CAMERAS:
                found[rig, name] = state, time.time() - numbers[0]

    session = watch_network(links, network, on_state, lambda *_: None)
    time.sleep(seconds)
    session.close()
    rigs = {rig for rig, _ in found}
    rows = []
    for (rig, name), (node_state, clock_offset) in sorted(found.items(), key=lambda item: item[0]):
        members = node_state.get("members")
        rows.append(
            [
                name if len(rigs) == 1 else f"{name} ({rig[:8]})",
                to_one_line(str(node_state.get("state", "")), MAX_TEXT_LENGTH),
                to_one_line(" ".join(map(str, members)), 4 * MAX_TEXT_LENGTH) if isinstance(members, list) else "",
                f"{float(str(node_state.get('frames', 0))):.0f}",
                *(f"{float(str(node_state.get(key, 0.0))):{form}}" for key, form in _COLUMNS),
                f"{1e3 * clock_offset:.0f}" if abs(clock_offset) < MAX_CLOCK_OFFSET else f"{clock_offset:+.1f} s",
            ]
        )
    console = console_output.make_console()
    header = ["node", "state", "with", "frames", "per s", "ms", "bytes/frame", "rounds/frame", "clock ms"]
    console_output.print_table(console, header, rows) if rows else console.print(f"no nodes in network {network}")
    if len(rigs) > 1:
        console_output.print_to_stderr(
            f"{len(rigs)} different calibrations or options in network {network}: such nodes do not communicate"
        )
    return bool(rows)


# Longest text of another node that is printed, in characters (choice).
MAX_TEXT_LENGTH = 40
_COLUMNS = (("rate", ".1f"), ("latency_ms", ".0f"), ("bytes_per_frame", ".0f"), ("rounds_per_frame", ".1f"))
