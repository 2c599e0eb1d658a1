"""`sylpose node` and `sylpose nodes`: one camera on one machine among others, a view of what they find, and who is there."""

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
from sylpose import calibration as calibrations
from sylpose.app import console_output
from sylpose.app.frame_source import Live, Played
from sylpose.capture.boxes import load_boxes
from sylpose.capture.sources import source_of
from sylpose.frames import Box
from sylpose.input_limits import one_line
from sylpose.network.membership import Answer, Ask, Present
from sylpose.network.node import Node, track_by_node
from sylpose.network.rounds import Patience
from sylpose.network.runner import TICK, Runner
from sylpose.network.wire_format import MOST_CAMERAS
from sylpose.network.zenoh_transport import Links, Place, Wire, digest_of, watch_network
from sylpose.report.files import TrajectoryWriter
from sylpose.report.json_lines import pose_line
from sylpose.results import FramePose
from sylpose.rig import Rig
from sylpose.tracking.tracked_frame import TrackedFrame

__all__ = ["Asked", "interrupted", "node_aloud", "nodes_aloud"]

# Seconds between two lines of how a node is (choice).
SAYS_EVERY = 1.0
# Of a clock that is off by more than a share of a second, as heard (choice: no local network is as slow).
CLOCK_OFF = 0.2


@dataclass(frozen=True)
class Asked:
    """What a node is asked for: see `sylpose node --help`."""

    camera: str
    calibration: Path
    source: str
    boxes: Path | None
    out: Path | None
    network: str
    links: Links
    rate: float | None
    speed: float
    wait: float
    patience: float
    method: str
    features: str
    mode: str
    seed: int


@dataclass
class _Told:
    """What a node has said so far: for its lines of state."""

    frames: int = 0
    poses: int = 0
    last: FramePose | None = None
    took: float = 0.0
    members: tuple[int, ...] = ()


def node_aloud(asked: Asked) -> bool:
    """One camera takes part in a network until its source ends, or it is interrupted.

    Returns:
        whether it found any pose.

    Raises:
        ValueError, OSError: a calibration without that camera, a source that cannot be read, a name that is taken.
    """
    rig = calibrations.load(asked.calibration)
    c = _number(rig, asked.camera, asked.calibration)
    boxes = _boxes(asked.boxes, rig)
    shots = _shots(asked, rig, c)
    console = console_output.make_console()
    place = Place(asked.camera, digest_of(rig, _alike(asked, boxes)), asked.network)
    told = _Told()
    present = Present(
        c,
        len(rig),
        incarnation=time.time_ns() & 0xFFFFFFFF,
        wait=round(asked.wait / TICK),
        patience=Patience(round(1.0 / TICK), round(asked.patience / TICK)),
    )
    folder = asked.out if asked.out is not None else Path(f"sylpose_{asked.camera}")
    refused: dict[int, str] = {}

    def work(ask: Callable[[Ask, int], Answer]) -> None:
        node = Node(c, len(rig), ask, asked.mode)
        node.refused = refused
        for tracked in _timed(node, rig, shots, boxes, asked, told):
            told.members, told.last = node.members, tracked.pose
            told.frames += 1
            told.poses += tracked.pose.measured
            writer.write(tracked.pose)
            members = [rig.names[i] for i in node.members]
            by_name = _named(rig, refused, runner, wire)
            wire.say_pose(
                pose_line(tracked.pose, rig.names, rig.unit, node=asked.camera, took_part=members, refused=by_name)
            )

    runner = Runner(present, work, lambda packets: wire.send(packets))
    # Before the files: those of a node of that name which is running stay as they are.
    wire = Wire(place, rig.names, asked.links, runner.heard, gone=runner.gone)
    try:
        with TrajectoryWriter(folder, rig.names, rig.unit, stem=asked.camera) as writer, interrupted() as stopped:
            says = _Says(console, asked, rig, told, wire, refused, runner)
            console.print(says.first(), soft_wrap=True)
            runner.run(says.tick, stopped)
    finally:
        wire.close()
        with suppress(ValueError):  # its thread may be reading still
            shots.close()
    console_output.print_files(console, "Files", [writer.tum_path, writer.csv_path])
    if stopped():
        raise KeyboardInterrupt(f"{asked.camera}: stopped")
    return told.poses > 0


def _alike(asked: Asked, boxes: dict[str, Box] | None) -> str:
    """What all nodes have to be asked for alike."""
    return repr(
        (__version__, asked.method, asked.features, asked.mode, asked.seed, asked.rate, sorted((boxes or {}).items()))
    )


def _number(rig: Rig, camera: str, calibration: Path) -> int:
    if camera not in rig.names:
        raise ValueError(f"{calibration}: no camera {camera!r} in it ({', '.join(rig.names)})")
    return rig.names.index(camera)


def _boxes(path: Path | None, rig: Rig) -> dict[str, Box] | None:
    if path is None:
        return None
    by_object = load_boxes(path, rig)
    if len(by_object) > 1:
        raise ValueError(f"{path}: boxes of {len(by_object)} objects; nodes track one")
    return next(iter(by_object.values()), None)


def _shots(asked: Asked, rig: Rig, c: int) -> Played | Live:
    """The source: a file or folder that is there, else a device or a URL."""
    source, path = asked.source, Path(asked.source)
    if path.is_dir() or (path.is_file() and not path.is_char_device()):
        return Played(c, source_of(path, rig.cameras[c]), asked.rate, asked.speed)
    device: int | str | None = int(source) if source.isdigit() else source if "://" in source else None
    if device is None and not path.exists():
        raise ValueError(f"--source {source}: no such file or folder, and no number of a camera or URL")
    if asked.rate is None:
        raise ValueError("--rate HZ is needed with a camera or a stream: all nodes number frames by it")
    return Live(c, rig.cameras[c], source if device is None else device, asked.rate)


def _timed(
    node: Node, rig: Rig, shots: Played | Live, boxes: dict[str, Box] | None, asked: Asked, told: _Told
) -> Iterator[TrackedFrame]:
    """The frames; how long each took since its images were there."""
    timed = _Timed(shots)
    tracked = track_by_node(
        node, rig, timed, boxes, enters=True, method=asked.method, features=asked.features, seed=asked.seed
    )
    for frame in tracked:
        told.took = time.monotonic() - timed.since
        yield frame


class _Timed:
    """Shots that know since when the last frame has been there."""

    def __init__(self, shots: Played | Live) -> None:
        self._shots, self.since = shots, 0.0
        self.time_of, self.frame_set = shots.time_of, shots.frame_set

    def newest(self, wanted: int) -> tuple[int, float | None]:
        """See `Shots`."""
        found = self._shots.newest(wanted)
        self.since = time.monotonic()
        return found


def _named(rig: Rig, refused: dict[int, str], runner: Runner, wire: Wire) -> dict[str, str]:
    """Who was refused, and why."""
    by_number = {**runner.present.all_refused, **refused, **runner.present.all_blame.sentences(rig.names)}
    return {**{rig.names[c]: why for c, why in by_number.items() if c < len(rig)}, **wire.refused}


@contextmanager
def interrupted() -> Iterator[Callable[[], bool]]:
    """Ctrl-C and a polite kill end a node between two steps."""
    asked: list[int] = []
    before = {s: signal.signal(s, lambda number, _: asked.append(number)) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(asked)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class _Says:
    """What a node says of itself: a line a second on the terminal, and one of JSON to the network."""

    def __init__(
        self,
        console: Console,
        asked: Asked,
        rig: Rig,
        told: _Told,
        wire: Wire,
        refused: dict[int, str],
        runner: Runner,
    ) -> None:
        self._console, self._asked, self._rig, self._told = console, asked, rig, told
        self._wire, self._refused, self._runner = wire, refused, runner
        self._due = time.monotonic()
        self._before = (0, 0, 0, self._due)
        self._said: dict[str, str] = {}

    def first(self) -> str:
        """How this node can be reached, and by whom."""
        asked = self._asked
        reach = f"{asked.camera} in network {asked.network}, rig {self._wire.place.rig[:8]}, listens at {asked.links.listen}"
        if asked.links.keys is not None:
            return f"{reach}, to those with keys of {asked.links.keys}"
        local = asked.links.listen.startswith(("127.", "localhost"))
        return f"{reach}: this machine only" if local else f"{reach}: OPEN to everybody who can reach it, without keys"

    def tick(self, p: Present) -> None:
        """Called every tick."""
        now = time.monotonic()
        if now < self._due:
            return
        self._due = now + SAYS_EVERY
        refused = _named(self._rig, self._refused, self._runner, self._wire)
        for name, why in refused.items():
            if self._said.get(name) != why:
                self._said[name] = why
                console_output.say(f"{self._asked.camera}: {name} is refused: {why}")
        state = self._state(p, now)
        self._wire.say_state(json.dumps({**state, "refused": refused}))
        self._console.print(self._line(state), soft_wrap=True)

    def _state(self, p: Present, now: float) -> dict[str, object]:
        told, (frames, sent, rounds, since) = self._told, self._before
        number, done = p.frames, told.frames - frames
        elapsed = max(now - since, 1e-9)
        self._before = (told.frames, self._runner.bytes_sent, self._runner.rounds, now)
        return {
            "node": self._asked.camera,
            "clock": time.time(),
            "pid": os.getpid(),
            "state": "waits for a group" if not p.members else "tracks" if number else "begins",
            "members": [self._rig.names[c] for c in p.members],
            "frames": number,
            "rate": done / elapsed,
            "latency_ms": 1e3 * told.took,
            "bytes_per_frame": (self._runner.bytes_sent - sent) / done if done else 0.0,
            "rounds_per_frame": (self._runner.rounds - rounds) / done if done else 0.0,
            "status": "" if told.last is None else told.last.status.value,
        }

    def _line(self, state: dict[str, object]) -> str:
        pose, members = self._told.last, ", ".join(map(str, state["members"]))  # type: ignore[call-overload]
        if not members:
            return f"{self._asked.camera}: waits for others"
        if pose is None:
            return f"{self._asked.camera}: with {members}; no frame yet"
        where = ""
        if pose.world_from_object is not None:
            x, y, z = pose.position
            turn, shift = np.degrees(pose.sigma[:3].max()), pose.sigma[3:].max()
            where = f" at {x:.4g} {y:.4g} {z:.4g} {self._rig.unit}, ±{shift:.2g}, ±{turn:.2g}°"
        return (
            f"{self._asked.camera}: frame {pose.index} {pose.status.value}{where}; with {members}; "
            f"{state['rate']:.1f} per second, {state['latency_ms']:.0f} ms"
        )


def nodes_aloud(network: str, links: Links, seconds: float) -> bool:
    """Who is in a network, as a table.

    Returns:
        whether anybody is.
    """
    found: dict[tuple[str, str], tuple[dict[str, object], float]] = {}

    def on_state(rig: str, name: str, line: str) -> None:
        with suppress(ValueError, TypeError, KeyError, OverflowError, RecursionError):
            state = json.loads(line)
            numbers = [float(state[key]) for key in ("clock", "frames", *(key for key, _ in _COLUMNS))]
            if np.isfinite(numbers).all() and len(found) < MOST_CAMERAS:
                found[rig, name] = state, time.time() - numbers[0]

    session = watch_network(links, network, on_state, lambda *_: None)
    time.sleep(seconds)
    session.close()
    rigs = {rig for rig, _ in found}
    rows = []
    for (rig, name), (s, apart) in sorted(found.items(), key=lambda item: item[0]):
        members = s.get("members")
        rows.append(
            [
                name if len(rigs) == 1 else f"{name} ({rig[:8]})",
                one_line(str(s.get("state", "")), SHOWN),
                one_line(" ".join(map(str, members)), 4 * SHOWN) if isinstance(members, list) else "",
                f"{float(str(s.get('frames', 0))):.0f}",
                *(f"{float(str(s.get(key, 0.0))):{form}}" for key, form in _COLUMNS),
                f"{1e3 * apart:.0f}" if abs(apart) < CLOCK_OFF else f"{apart:+.1f} s",
            ]
        )
    console = console_output.make_console()
    head = ["node", "state", "with", "frames", "per s", "ms", "bytes/frame", "rounds/frame", "clock ms"]
    console_output.print_table(console, head, rows) if rows else console.print(f"nobody is in network {network}")
    if len(rigs) > 1:
        console_output.say(
            f"there are {len(rigs)} different calibrations or options in network {network}: such nodes do not talk"
        )
    return bool(rows)


# Characters of a word of a stranger's that is shown (choice).
SHOWN = 40
_COLUMNS = (("rate", ".1f"), ("latency_ms", ".0f"), ("bytes_per_frame", ".0f"), ("rounds_per_frame", ".1f"))
