"""`sylpose node` and `sylpose nodes`: a camera of a network, a view of it without images, and a list of the nodes."""

from __future__ import annotations

import json
import math
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sylpose.commands.app import (
    ADVANCED,
    INPUT,
    LIVE,
    OBJECT,
    OUTPUT,
    CommandOptions,
    command,
    exit_with_failures,
    option,
)
from sylpose.commands.options import MethodOptions, Seed
from sylpose.input_limits import print_message
from sylpose.methods import MODES

if TYPE_CHECKING:
    from scipy.spatial.transform import RigidTransform

    from sylpose.frames import Box
    from sylpose.network.membership import Membership
    from sylpose.network.runner import NodeRunner
    from sylpose.network.zenoh_transport import LinkSettings, ZenohTransport
    from sylpose.results import FramePose
    from sylpose.rig import Rig


# Seconds between two status lines of a node (choice).
REPORT_INTERVAL = 1.0
# Apparent clock offsets above this, in seconds, exceed the delay of a local network (choice).
MAX_CLOCK_OFFSET = 0.2
# Longest text of another node that is printed, in characters (choice).
MAX_TEXT_LENGTH = 40
# A view: seconds without a pose after which tracking is considered ended, and largest wait for the first pose (choice).
END_TIMEOUT, START_TIMEOUT = 5.0, 60.0
# Seconds without a packet after which a camera counts as disconnected, and more for more patience (choice).
MIN_INACTIVE = 1.0
# Numbers of a node's state that `sylpose nodes` prints, with their format.
_COLUMNS = (("rate", ".1f"), ("latency_ms", ".0f"), ("bytes_per_frame", ".0f"), ("rounds_per_frame", ".1f"))
_HEADER = ("node", "state", "with", "frames", "per s", "ms", "bytes/frame", "rounds/frame", "clock ms")


@dataclass(frozen=True, kw_only=True)
class NetworkOptions(CommandOptions):
    """A network of nodes, and how to connect to it.

    Attributes:
        network: Join the nodes with the same name and rig.
        listen: Accept connections at this address; default: from this machine only.
        connect: Connect to this node first. Repeatable.
        keys: Use the node's keys from sylpose network init.
    """

    network: Annotated[str, option("--network NAME", LIVE)] = "sylpose"
    listen: Annotated[str, option("--listen HOST:PORT", LIVE)] = "127.0.0.1:0"
    connect: Annotated[tuple[str, ...], option("--connect HOST:PORT", LIVE)] = ()
    keys: Annotated[Path | None, option("--keys DIR", LIVE)] = None

    def links(self, **more: Any) -> LinkSettings:
        """Return how to connect; check that the extra is installed."""
        require_zenoh()
        from sylpose.network.zenoh_transport import LinkSettings

        return LinkSettings(self.listen, self.connect, self.keys, **more)


@dataclass(frozen=True, kw_only=True)
class NodeOptions(MethodOptions, NetworkOptions):
    """Options of `sylpose node`.

    Attributes:
        camera: The camera's name in the calibration.
        calibration: Read the calibration of the whole rig, identical on all nodes.
        source: Read the images from a camera (by number), a video, a stream or a folder.
        boxes: Read the object's boxes in the first frame, identical on all nodes.
        view: Run a node without images that writes the others' poses in this camera's frame.
        out: Write the results here; default: ./sylpose_CAMERA.
        multicast: Discover other nodes on the network of --listen.
        rate: Set the frame rate, identical on all nodes.
        speed: Set the playback speed of a recording: 2 is twice as fast, 0 as fast as possible.
        wait: Wait for the other cameras before starting without them.
        patience: Wait for a connected camera that makes no progress; a tenth of it, at least 1 s, for a silent one.
        mode: Get the same result as one process (exact), or nearly the same in fewer rounds (compact).
    """

    camera: Annotated[str | None, typer.Argument(metavar="CAMERA")] = None
    calibration: Annotated[Path | None, option("--calibration FILE", INPUT)] = None
    source: Annotated[str | None, option("--source DEVICE|FILE|URL|FOLDER", INPUT)] = None
    boxes: Annotated[Path | None, option("--boxes FILE", OBJECT)] = None
    view: Annotated[str | None, option("--view CAMERA", OUTPUT)] = None
    out: Annotated[Path | None, option("--out DIR", OUTPUT)] = None
    multicast: Annotated[bool, option("--multicast/--no-multicast", LIVE)] = True
    rate: Annotated[float | None, option("--rate HZ", INPUT, min=0.001)] = None
    speed: Annotated[float, option("--speed X", INPUT, min=0)] = 1.0
    wait: Annotated[float, option("--wait SEC", LIVE, min=0)] = 10.0
    patience: Annotated[float, option("--patience SEC", LIVE, min=0.1)] = 10.0
    mode: Annotated[str, option(f"--mode {'|'.join(MODES)}", ADVANCED, choices=MODES)] = MODES[0]
    seed: Seed = 0

    def __post_init__(self) -> None:
        """Check that the node has a camera with images, or is a view without them."""
        super().__post_init__()
        if self.calibration is None:
            raise ValueError("--calibration FILE is required: the rig's, identical on all nodes")
        if self.view is not None and (self.camera is not None or self.source is not None):
            raise ValueError("--view runs a node without a camera: give no CAMERA and no --source with it")
        if self.view is None and (self.camera is None or self.source is None):
            raise ValueError("a node requires a camera and its images: give CAMERA and --source (or --view CAMERA)")


@command("Run one camera as a node of a network.")
def node(options: NodeOptions) -> None:
    """Run one camera of a rig as a node that estimates the pose jointly with the other cameras.

    A node reads only its own images. All nodes get the same poses, equal to those of one computer with all images;
    nodes may join late or rejoin. Writes CAMERA.tum and CAMERA.csv into OUT and publishes each pose (docs/network.md).

    Examples:
        sylpose node cam_0 --calibration rig.toml --source recording/cam_0.mp4 --boxes recording/boxes.toml
        sylpose node cam_2 --calibration rig.toml --source 0 --rate 30 --listen 192.168.1.12:7447 --keys keys
        sylpose node --view top --calibration virtual.toml
    """
    if options.view is not None:
        _view_network(options, options.view)
    else:
        _run_node(options, options.camera or "", options.source or "")


def _run_node(options: NodeOptions, camera: str, source_name: str) -> None:
    """Run one camera's node until its source ends or it is interrupted.

    Raises:
        ValueError, OSError: the calibration lacks the camera, the source cannot be read, or the name is in use.
        KeyboardInterrupt: stopped by a signal, after all files are complete.
    """
    from sylpose import __version__
    from sylpose.io import calibration as calibrations
    from sylpose.network.membership import Membership, Request, Response
    from sylpose.network.node import Node, track_by_node
    from sylpose.network.rounds import Timeouts
    from sylpose.network.runner import TICK_SECONDS, NodeRunner
    from sylpose.network.zenoh_transport import NodeAddress, ZenohTransport, compute_rig_digest
    from sylpose.report.files import TrajectoryWriter, format_pose_line
    from sylpose.runs import console_output
    from sylpose.runs.frame_source import open_node_source

    calibration = options.calibration or Path()
    rig = calibrations.load(calibration)
    if camera not in rig.names:
        raise ValueError(f"{calibration}: no camera {camera!r} in it ({', '.join(rig.names)})")
    links, c = options.links(multicast=options.multicast, names=rig.names), rig.names.index(camera)
    boxes = _read_boxes(options.boxes, rig)
    source = open_node_source(source_name, c, rig.cameras[c], options.rate, options.speed)
    # Options that must be the same at all nodes.
    shared = (__version__, options.method, options.features, options.mode, options.seed, options.rate)
    digest = compute_rig_digest(rig, repr((*shared, sorted((boxes or {}).items()))))
    inactive = max(MIN_INACTIVE, options.patience / 10.0)
    timeouts = Timeouts(round(inactive / TICK_SECONDS), round(options.patience / TICK_SECONDS))
    wait = round(options.wait / TICK_SECONDS)
    present = Membership(c, len(rig), incarnation=time.time_ns() & 0xFFFFFFFF, wait=wait, timeouts=timeouts)

    def work(request: Callable[[Request, int], Response]) -> None:
        node = Node(c, len(rig), request, options.mode)
        node.refused = status.refused
        run = partial(track_by_node, method=options.method, features=options.features, seed=options.seed)
        for tracked in run(node, rig, source, boxes, must_join=True):
            pose = tracked.pose
            status.add(pose, time.monotonic() - source.arrival_time)
            writer.write(pose)
            members, refusals = [rig.names[i] for i in node.members], status.describe_refusals()
            wire.publish_pose(
                format_pose_line(pose, rig.names, rig.unit, node=camera, took_part=members, refused=refusals)
            )

    runner = NodeRunner(present, work, lambda packets: wire.send(packets))
    # Connect before opening the files: those of a running node of the same name must not be overwritten.
    address = NodeAddress(camera, digest, options.network)
    wire = ZenohTransport(address, rig.names, links, runner.receive, on_disconnect=runner.report_lost)
    status = _NodeStatus(camera, rig, wire, runner)
    folder = options.out if options.out is not None else Path(f"sylpose_{camera}")
    try:
        writing = TrajectoryWriter(folder, rig.names, rig.unit, stem=camera)
        with writing as writer, _catch_interrupts() as stopped:
            status.console.print(_describe_address(options, camera, digest), soft_wrap=True)
            runner.run(status.report, stopped)
    finally:
        wire.close()
        with suppress(ValueError):  # its thread may still be reading
            source.close()
    console_output.print_files(status.console, "Files", [writer.tum_path, writer.csv_path])
    if stopped():
        raise KeyboardInterrupt(f"{camera}: stopped")
    if not status.poses:
        exit_with_failures([f"{camera}: no pose was found"])


def _read_boxes(path: Path | None, rig: Rig) -> dict[str, Box] | None:
    from sylpose.io.capture.boxes import load_boxes

    if path is None:
        return None
    by_object = load_boxes(path, rig)
    if len(by_object) > 1:
        raise ValueError(f"{path}: boxes of {len(by_object)} objects; nodes track only one")
    return next(iter(by_object.values()), None)


def _describe_address(options: NodeOptions, camera: str, digest: str) -> str:
    """Describe the address at which a node listens and who can connect."""
    text = f"{camera} in network {options.network}, rig {digest[:8]}, listens at {options.listen}"
    if options.keys is not None:
        return f"{text}, to nodes with keys of {options.keys}"
    local = options.listen.startswith(("127.", "localhost"))
    return f"{text}: this machine only" if local else f"{text}: OPEN to everyone who can reach it, without keys"


@contextmanager
def _catch_interrupts() -> Iterator[Callable[[], bool]]:
    """Let SIGINT and SIGTERM end a node between two steps; yield a function that returns whether one arrived."""
    signals: list[int] = []
    handlers = {s: signal.signal(s, lambda number, _: signals.append(number)) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(signals)
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


class _NodeStatus:
    """State of a node: a line per second on the terminal, and one of JSON to the network."""

    def __init__(self, camera: str, rig: Rig, wire: ZenohTransport, runner: NodeRunner) -> None:
        from sylpose.runs.console_output import make_console

        self.console, self.refused, self.poses = make_console(), dict[int, str](), 0
        self._camera, self._rig, self._wire, self._runner = camera, rig, wire, runner
        self._frames, self._latency = 0, 0.0
        self._last: FramePose | None = None
        self._next_report = time.monotonic()
        self._previous = (0, 0, 0, self._next_report)
        self._reported: dict[str, str] = {}

    def add(self, pose: FramePose, latency: float) -> None:
        """Count a frame, tracked `latency` seconds after its images were available."""
        self._frames, self.poses = self._frames + 1, self.poses + pose.is_measured
        self._last, self._latency = pose, latency

    def describe_refusals(self) -> dict[str, str]:
        """Return the reason of each refused node by its name."""
        names, membership = self._rig.names, self._runner.membership
        by_number = {**membership.all_refused, **self.refused, **membership.all_evidence.describe(names)}
        return {**{names[c]: why for c, why in by_number.items() if c < len(names)}, **self._wire.refused}

    def report(self, present: Membership) -> None:
        """Report the node's state if the next report is due; called every tick."""
        now = time.monotonic()
        if now < self._next_report:
            return
        self._next_report = now + REPORT_INTERVAL
        refused = self.describe_refusals()
        for name, reason in sorted(refused.items() - self._reported.items()):
            print_message(f"{self._camera}: {name} is refused: {reason}")
        self._reported |= refused
        members = [self._rig.names[c] for c in present.members]
        state = self._build_state(present.frames, members, now)
        self._wire.publish_state(json.dumps({**state, "refused": refused}))
        text, pose = f"{self._camera}: waiting for other nodes", self._last
        if members:
            text = f"{self._camera}: with {', '.join(members)}; no frame yet"
        if members and pose is not None:
            where, timing = "", f"{state['rate']:.1f} per second, {state['latency_ms']:.0f} ms"
            if pose.world_from_object is not None:
                x, y, z = pose.position
                rotation_sd, position_sd = math.degrees(pose.sigma[:3].max()), pose.sigma[3:].max()
                where = f" at {x:.4g} {y:.4g} {z:.4g} {self._rig.unit}, ±{position_sd:.2g}, ±{rotation_sd:.2g}°"
            text = f"{self._camera}: frame {pose.index} {pose.status.value}{where}; with {', '.join(members)}; {timing}"
        self.console.print(text, soft_wrap=True)

    def _build_state(self, number: int, members: list[str], now: float) -> dict[str, Any]:
        frames, sent, rounds, since = self._previous
        n_done, elapsed = self._frames - frames, max(now - since, 1e-9)
        self._previous = (self._frames, self._runner.bytes_sent, self._runner.rounds, now)
        return {
            "node": self._camera,
            "clock": time.time(),
            "pid": os.getpid(),
            "state": "waiting" if not members else "tracking" if number else "starting",
            "members": members,
            "frames": number,
            "rate": n_done / elapsed,
            "latency_ms": 1e3 * self._latency,
            "bytes_per_frame": (self._runner.bytes_sent - sent) / n_done if n_done else 0.0,
            "rounds_per_frame": (self._runner.rounds - rounds) / n_done if n_done else 0.0,
            "status": "" if self._last is None else self._last.status.value,
        }


def _view_network(options: NodeOptions, name: str) -> None:
    """Receive a network's poses and write them in a camera's frame (camera_from_object)."""
    from queue import Empty, SimpleQueue

    from scipy.spatial.transform import RigidTransform

    from sylpose.network.zenoh_transport import watch_network
    from sylpose.report.files import write_tum
    from sylpose.runs import console_output
    from sylpose.runs.view import load_camera

    links, camera = options.links(multicast=options.multicast), load_camera(name, options.calibration or Path())
    lines: SimpleQueue[str] = SimpleQueue()
    session = watch_network(links, options.network, lambda *_: None, lambda _, line: lines.put(line))
    seen: dict[int, tuple[float, RigidTransform]] = {}
    console, last_print, last_pose = console_output.make_console(), 0.0, time.monotonic()
    with _catch_interrupts() as stopped:
        while not stopped() and time.monotonic() - last_pose < (END_TIMEOUT if seen else START_TIMEOUT):
            try:
                found = _parse_pose(lines.get(timeout=0.2))
            except Empty:
                continue
            if found is None or found[0] in seen:  # every node sends the same pose of a frame
                continue
            last_pose = time.monotonic()
            frame, timestamp, pose = found
            seen[frame] = timestamp, camera.camera_from_world * pose
            if last_pose - last_print > 1.0:
                last_print = last_pose
                x, y, z = seen[frame][1].translation
                console.print(f"{name}: frame {frame} at {x:.4g} {y:.4g} {z:.4g} in camera axes", soft_wrap=True)
    session.close()
    if not seen:
        exit_with_failures([f"{name}: no node in network {options.network} published a pose"])
    frames = [seen[k] for k in sorted(seen)]
    folder = options.out if options.out is not None else Path(f"sylpose_{name}")
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"view_{name}.tum"
    write_tum(file, [t for t, _ in frames], RigidTransform.concatenate([pose for _, pose in frames]))
    console_output.print_files(console, "Files", [file])


def _parse_pose(line: str) -> tuple[int, float, RigidTransform] | None:
    """Parse frame number, time and pose from a line of JSON; return None if it has no valid pose."""
    import numpy as np
    from scipy.spatial.transform import RigidTransform, Rotation

    from sylpose.rig import MAX_LENGTH

    try:
        content = json.loads(line)
        quaternion, position = np.array(content["quaternion"], float), np.array(content["position"], float)
        if quaternion.shape != (4,) or position.shape != (3,):
            return None
        if not np.abs([*position, float(content["time"])]).max() <= MAX_LENGTH or not np.isfinite(quaternion).all():
            return None
        pose = RigidTransform.from_components(position, Rotation.from_quat(quaternion))
        return int(content["frame"]), float(content["time"]), pose
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError):
        return None


@dataclass(frozen=True, kw_only=True)
class NodesOptions(NetworkOptions):
    """Options of `sylpose nodes`.

    Attributes:
        seconds: Listen for this long.
    """

    seconds: Annotated[float, option("--seconds SEC", LIVE, min=0.1)] = 2.5


@command("List nodes and their status.")
def nodes(options: NodesOptions) -> None:
    """List the nodes of a network: status, peers, frames, latency, bytes and rounds per frame, clocks.

    Examples:
        sylpose nodes
        sylpose nodes --network lab --keys keys
    """
    links, network = options.links(), options.network
    from sylpose.input_limits import to_one_line
    from sylpose.network.wire_format import MAX_CAMERAS
    from sylpose.network.zenoh_transport import watch_network
    from sylpose.runs import console_output

    found: dict[tuple[str, str], tuple[dict[str, Any], float]] = {}

    def on_state(rig: str, name: str, line: str) -> None:
        with suppress(ValueError, TypeError, KeyError, OverflowError, RecursionError):
            state = json.loads(line)
            numbers = [float(state[key]) for key in ("clock", "frames", *(key for key, _ in _COLUMNS))]
            if all(map(math.isfinite, numbers)) and len(found) < MAX_CAMERAS:
                found[rig, name] = state, time.time() - numbers[0]

    session = watch_network(links, network, on_state, lambda *_: None)
    time.sleep(options.seconds)
    session.close()
    rigs, rows = {rig for rig, _ in found}, []
    for (rig, name), (state, offset) in sorted(found.items(), key=lambda item: item[0]):
        members = state.get("members")
        rows.append(
            [
                name if len(rigs) == 1 else f"{name} ({rig[:8]})",
                to_one_line(str(state.get("state", "")), MAX_TEXT_LENGTH),
                to_one_line(" ".join(map(str, members)), 4 * MAX_TEXT_LENGTH) if isinstance(members, list) else "",
                f"{float(state['frames']):.0f}",
                *(f"{float(state[key]):{form}}" for key, form in _COLUMNS),
                f"{1e3 * offset:.0f}" if abs(offset) < MAX_CLOCK_OFFSET else f"{offset:+.1f} s",
            ]
        )
    if not rows:
        exit_with_failures([f"network {network} has no nodes"])
    console_output.print_table(console_output.make_console(), _HEADER, rows)
    if len(rigs) > 1:
        differences = f"{len(rigs)} different calibrations or options in network {network}"
        print_message(f"{differences}: such nodes do not communicate")


def require_zenoh() -> None:
    """Check that the packages of the extra `network` are installed.

    Raises:
        ValueError: one is missing.
    """
    from importlib.util import find_spec

    if any(find_spec(name) is None for name in ("zenoh", "cryptography")):
        raise ValueError("nodes require the extra [network]: pip install 'sylpose[network]'")
