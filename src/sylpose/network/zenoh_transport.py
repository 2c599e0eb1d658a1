"""A real network, by Zenoh: nodes find each other, hear each other's messages, and know who is there.

A key says who speaks: sylpose/1/NETWORK/RIG/NAME/..., RIG being a digest of the calibration, so that nodes of another rig do
not mix in and can be named. With keys (`network.keys`) links are mutual TLS, and a node may speak under its own name alone.
"""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np

from sylpose.network.keys import LISTENER, access_rules, tls_settings
from sylpose.network.wire_format import HELLO, LARGEST_WORD, WELCOME, kind_of
from sylpose.rig import Rig
from sylpose.sylvester.distributed.messages import Packet

__all__ = ["LOOPBACK", "Links", "Place", "Wire", "digest_of", "line_of", "watch_network"]

# Version of what nodes say to each other (choice).
VERSION = 1
LOOPBACK = "127.0.0.1:0"  # this machine only, at any port (choice)
# Names that may be part of a key.
NAME = re.compile(r"[A-Za-z0-9_.\-]{1,64}")
# Milliseconds after which a link without a sign of life is closed; seconds to wait for anybody who is there already, and
# from the first one on for others (choice).
LEASE_MS, FIRST_LOOK, NEXT_LOOK = 1000, 1.0, 0.3
# Threads of Zenoh that receive. One that closes a link to a machine that was unplugged stands still until the system gives
# up what it has not sent, for ten seconds; with the two that are Zenoh's own choice, two such links silence all others
# (choice: so many may die at once).
THREADS = 32
# Names that are remembered as refused (choice).
MOST_REFUSED = 64
# Bytes of a line for whoever listens: a thousand cameras' names in it (choice).
LONGEST_LINE = 1 << 18


def digest_of(rig: Rig, options: str = "") -> str:
    """Of a calibration, and of what else all nodes have to have alike."""
    said = blake2b(digest_size=8)
    for camera in rig:
        said.update(f"{camera.name} {camera.size} {camera.lens}".encode())
        for part in (camera.matrix, camera.distortion, camera.camera_from_world.as_matrix()):
            said.update(np.round(np.asarray(part, "<f8"), 9).tobytes())
    said.update(f"{rig.unit} {options}".encode())
    return said.hexdigest()


def check_name(what: str, said: str) -> None:
    """Of what is part of a key.

    Raises:
        ValueError: it cannot be.
    """
    if not NAME.fullmatch(said):
        raise ValueError(f"{what} {said!r}: a name of letters, digits, '_', '.' and '-' is expected")


@dataclass(frozen=True)
class Place:
    """A node's name, its rig's digest, and the network that both are in."""

    name: str
    rig: str
    network: str

    def __post_init__(self) -> None:
        check_name("node", self.name)
        check_name("network", self.network)

    def key(self, *rest: str, name: str | None = None, rig: str | None = None) -> str:
        """Of what is said under a name."""
        return "/".join(("sylpose", str(VERSION), self.network, rig or self.rig, name or self.name, *rest))


@dataclass(frozen=True)
class Links:
    """How a node finds others.

    Attributes:
        listen, connect: endpoints, host:port.
        keys: folder of this node's keys (`network.keys`), None for open links; names: who may speak, with keys.
        multicast: whether it looks for others on the network that it listens to.
    """

    listen: str = LOOPBACK
    connect: tuple[str, ...] = ()
    keys: Path | None = None
    multicast: bool = True
    names: tuple[str, ...] = ()


@dataclass
class Wire:
    """A node's links. Messages come in at `heard`, called from other threads, with the number of who says it.

    Args:
        gone: called in the same way when a node's link has ended: it has died, or cannot be reached.

    Raises:
        ValueError: endpoints that cannot be; a name that is taken; keys that are none.
    """

    place: Place
    names: Sequence[str]
    links: Links
    heard: Callable[[int, bytes], None]
    refused: dict[str, str] = field(default_factory=dict)
    gone: Callable[[int], None] = lambda _: None

    def __post_init__(self) -> None:
        import zenoh

        self._ended = zenoh.SampleKind.DELETE
        for name in self.names:
            check_name("camera", name)
        self.session = open_session(self.links, self.place.name)
        taken = self._token(self.place.name)
        if taken:
            self.session.close()
            raise ValueError(f"{self.place.name}: another node of that name is in network {self.place.network} already")
        fast: dict[str, Any] = {
            "congestion_control": zenoh.CongestionControl.DROP,
            "priority": zenoh.Priority.REAL_TIME,
            "express": True,
        }
        key = self.place.key
        self._all = self.session.declare_publisher(key("all"), **fast)
        self._to = {
            c: self.session.declare_publisher(
                key("to", name), **{**fast, "congestion_control": zenoh.CongestionControl.BLOCK}
            )
            for c, name in enumerate(self.names)
        }
        self._poses = self.session.declare_publisher(key("pose"))
        self._states = self.session.declare_publisher(key("state"))
        for rest in (("all",), ("to", self.place.name)):
            self.session.declare_subscriber(key(*rest, name="*"), self._hear, allowed_origin=zenoh.Locality.REMOTE)
        everybody = key("alive", name="*", rig="*")
        self.session.liveliness().declare_subscriber(everybody, self._noticed, history=True)
        self._alive = self.session.liveliness().declare_token(key("alive"))

    def _token(self, name: str) -> bool:
        """Whether a node of that name is there."""
        until, met = time.monotonic() + FIRST_LOOK, False
        while time.monotonic() < until:
            replies = self.session.liveliness().get(self.place.key("alive", name=name), timeout=0.3)
            if any(reply.ok is not None for reply in replies):
                return True
            if not met and self.session.info.peers_zid():
                met, until = True, min(until, time.monotonic() + NEXT_LOOK)
            time.sleep(0.05)
        return False

    def _noticed(self, sample: Any) -> None:
        *_, rig, name, _ = str(sample.key_expr).split("/")
        if sample.kind == self._ended:
            if rig == self.place.rig and name in self.names:
                self.gone(self.names.index(name))
        elif rig != self.place.rig:
            here = f"its calibration or its options are others than this node's ({rig[:8]} and {self.place.rig[:8]})"
            self._refuse(name, here)

    def _refuse(self, name: str, why: str) -> None:
        if len(self.refused) < MOST_REFUSED:
            self.refused.setdefault(name, why)

    def _hear(self, sample: Any) -> None:
        name = str(sample.key_expr).split("/")[4]
        if name not in self.names:
            self._refuse(name, "it is no camera of the calibration")
            return
        payload = sample.payload
        if len(payload) > LARGEST_WORD:
            self._refuse(name, f"a message of {len(payload)} bytes")
            return
        self.heard(self.names.index(name), payload.to_bytes())

    def send(self, packets: Sequence[Packet]) -> int:
        """Returns the number of bytes."""
        sent = 0
        for to, data in packets:
            if len(to) > 1 and kind_of(data) not in (HELLO, WELCOME):
                self._all.put(data)
                sent += len(data)
                continue
            for c in to:
                self._to[c].put(data)
                sent += len(data)
        return sent

    def say_pose(self, line: str) -> None:
        """One line of JSON for whoever listens."""
        self._poses.put(line)

    def say_state(self, line: str) -> None:
        """The same, of how the node is."""
        self._states.put(line)

    def close(self) -> None:
        """Leave the network."""
        self.session.close()


def open_session(links: Links, name: str) -> Any:
    """A session of Zenoh.

    Raises:
        ValueError: an endpoint that cannot be listened or connected to; keys that are missing.
    """
    import zenoh

    # Read with the first session of a process.
    os.environ.setdefault("ZENOH_RUNTIME", f"(rx: (worker_threads: {THREADS}))")
    zenoh.init_log_from_env_or("off")
    config = zenoh.Config()
    protocol = "tcp" if links.keys is None else "tls"
    settings: dict[str, Any] = {
        "mode": "peer",
        "listen/endpoints": [f"{protocol}/{links.listen}"],
        "connect/endpoints": [f"{protocol}/{endpoint}" for endpoint in links.connect],
        "scouting/multicast/enabled": links.multicast,
        "scouting/gossip/enabled": True,
        "transport/link/tx/lease": LEASE_MS,
        "transport/link/rx/max_message_size": LARGEST_WORD + 1024,
        "transport/shared_memory/enabled": False,
        "transport/link/protocols": [protocol],
    }
    if links.multicast:
        settings["scouting/multicast/interface"] = _interface(links.listen.rpartition(":")[0])
    if links.keys is not None:
        settings["transport/link/tls"] = tls_settings(links.keys, name)
        if links.names:  # who only listens is told nothing that it would have to refuse
            settings["access_control"] = access_rules(links.names)
    try:
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
        return zenoh.open(config)
    except zenoh.ZError as error:
        why = str(error).split(" at ")[0]
        raise ValueError(
            f"{name}: cannot listen at {links.listen}"
            + (f" or connect to {', '.join(links.connect)}" if links.connect else "")
            + f" ({why}); look at the address, the port, the keys and the clock"
        ) from None


def _interface(host: str) -> str:
    """Where to look for others: on the address that is listened at."""
    return "auto" if host in ("0.0.0.0", "[::]", "localhost") else host


def line_of(said: bytes) -> str | None:
    """What somebody told whoever listens; None where it is no text, or too long."""
    if len(said) > LONGEST_LINE:
        return None
    try:
        return said.decode()
    except UnicodeDecodeError:
        return None


def watch_network(
    links: Links, network: str, on_state: Callable[[str, str, str], None], on_pose: Callable[[str, str], None]
) -> Any:
    """Listens to a network without taking part.

    Args:
        on_state: called with rig, name and the line; on_pose: with name and the line.

    Returns:
        the session, to be closed.
    """
    check_name("network", network)
    session = open_session(links, LISTENER)

    def heard(sample: Any) -> None:
        _, _, _, rig, name, what = str(sample.key_expr).split("/")
        line = line_of(sample.payload.to_bytes()) if len(sample.payload) <= LONGEST_LINE else None
        if line is None or not NAME.fullmatch(name) or not NAME.fullmatch(rig):
            return
        if what == "state":
            on_state(rig, name, line)
        else:
            on_pose(name, line)

    for what in ("state", "pose"):
        session.declare_subscriber(f"sylpose/{VERSION}/{network}/*/*/{what}", heard)
    return session
