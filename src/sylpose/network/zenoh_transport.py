"""Zenoh transport: discovery, messages and liveliness of nodes on a real network.

Key expressions identify the sender: sylpose/2/NETWORK/RIG/NAME/..., where RIG is a digest of the calibration, so that
nodes of another rig are ignored but can be reported. With keys (`network.keys`), links use mutual TLS, and a node may
only send under its own name.
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

from sylpose.network.keys import OBSERVER, build_access_rules, build_tls_settings
from sylpose.network.wire_format import HELLO, MAX_MESSAGE_BYTES, WELCOME, message_kind
from sylpose.packets import Packet
from sylpose.rig import Rig

# Version of the protocol (choice).
PROTOCOL_VERSION = 4
LOOPBACK = "127.0.0.1:0"  # this machine only, at any port (choice)
# Names that are valid in a key expression.
NAME_PATTERN = re.compile(r"[A-Za-z0-9_.\-]{1,64}")
# Milliseconds after which an inactive link is closed; seconds to wait for any existing node, and for further ones after
# the first (choice).
LEASE_MS, FIRST_DISCOVERY_S, NEXT_DISCOVERY_S = 1000, 1.0, 0.3
# Receive threads of Zenoh. A thread that closes a link to an unplugged machine blocks for ten seconds, until the system
# discards unsent data; with Zenoh's default of two, two such links block all others (choice: so many may fail
# simultaneously).
RECEIVE_THREADS = 32
# Largest number of stored rejections (choice).
MAX_REFUSED = 64
# Largest line for observers, bytes: it contains a thousand cameras' names (choice).
MAX_LINE_BYTES = 1 << 18


def compute_rig_digest(rig: Rig, options: str = "") -> str:
    """Return a digest of a calibration and of the options that all nodes must share."""
    hasher = blake2b(digest_size=8)
    for camera in rig:
        hasher.update(f"{camera.name} {camera.size} {camera.lens}".encode())
        for part in (camera.matrix, camera.distortion, camera.camera_from_world.as_matrix()):
            hasher.update(np.round(np.asarray(part, "<f8"), 9).tobytes())
    hasher.update(f"{rig.unit} {options}".encode())
    return hasher.hexdigest()


def check_name(label: str, name: str) -> None:
    """Check a name that is part of a key expression.

    Raises:
        ValueError: invalid characters or length.
    """
    if not NAME_PATTERN.fullmatch(name):
        raise ValueError(f"{label} {name!r}: a name of letters, digits, '_', '.' and '-' is expected")


@dataclass(frozen=True)
class NodeAddress:
    """Address of a node: its name, the digest of its rig, and the network."""

    name: str
    rig: str
    network: str

    def __post_init__(self) -> None:
        check_name("node", self.name)
        check_name("network", self.network)

    def key(self, *rest: str, name: str | None = None, rig: str | None = None) -> str:
        """Return the key expression for messages under a name, by default this node's."""
        return "/".join(("sylpose", str(PROTOCOL_VERSION), self.network, rig or self.rig, name or self.name, *rest))


@dataclass(frozen=True)
class LinkSettings:
    """How a node connects to others.

    Attributes:
        listen, connect: endpoints, host:port.
        keys: folder of this node's keys (`network.keys`), None for unencrypted links.
        multicast: whether to discover other nodes on the listening network.
        names: cameras that may send, with keys.
    """

    listen: str = LOOPBACK
    connect: tuple[str, ...] = ()
    keys: Path | None = None
    multicast: bool = True
    names: tuple[str, ...] = ()


@dataclass
class ZenohTransport:
    """Zenoh session of a node.

    Args:
        address: the node's address.
        names: names of the cameras.
        links: how to connect.
        on_message: called from other threads with the sender's number and each received message.
        refused: name -> reason of a rejection.
        on_disconnect: called from other threads when a node's link has ended: it crashed or is unreachable.

    Raises:
        ValueError: invalid endpoints, a name in use, or invalid keys.
    """

    address: NodeAddress
    names: Sequence[str]
    links: LinkSettings
    on_message: Callable[[int, bytes], None]
    refused: dict[str, str] = field(default_factory=dict)
    on_disconnect: Callable[[int], None] = lambda _: None

    def __post_init__(self) -> None:
        import zenoh

        self._delete_kind = zenoh.SampleKind.DELETE
        for name in self.names:
            check_name("camera", name)
        self.session = open_zenoh_session(self.links, self.address.name)
        if self._is_name_in_use(self.address.name):
            self.session.close()
            raise ValueError(
                f"{self.address.name}: another node in network {self.address.network} already has this name"
            )
        fast: dict[str, Any] = {"priority": zenoh.Priority.REAL_TIME, "express": True}
        drop, block = zenoh.CongestionControl.DROP, zenoh.CongestionControl.BLOCK
        key, declare = self.address.key, self.session.declare_publisher
        self._all = declare(key("all"), congestion_control=drop, **fast)
        self._to = [declare(key("to", name), congestion_control=block, **fast) for name in self.names]
        self._poses, self._states = declare(key("pose")), declare(key("state"))
        for rest in (("all",), ("to", self.address.name)):
            self.session.declare_subscriber(key(*rest, name="*"), self._on_sample, allowed_origin=zenoh.Locality.REMOTE)
        everybody = key("alive", name="*", rig="*")
        self.session.liveliness().declare_subscriber(everybody, self._on_liveliness, history=True)
        self._alive = self.session.liveliness().declare_token(key("alive"))

    def _is_name_in_use(self, name: str) -> bool:
        """Return whether a node of that name is present."""
        until, met = time.monotonic() + FIRST_DISCOVERY_S, False
        while time.monotonic() < until:
            replies = self.session.liveliness().get(self.address.key("alive", name=name), timeout=0.3)
            if any(reply.ok is not None for reply in replies):
                return True
            if not met and self.session.info.peers_zid():
                met, until = True, min(until, time.monotonic() + NEXT_DISCOVERY_S)
            time.sleep(0.05)
        return False

    def _on_liveliness(self, sample: Any) -> None:
        *_, rig, name, _ = str(sample.key_expr).split("/")
        if sample.kind == self._delete_kind:
            if rig == self.address.rig and name in self.names:
                self.on_disconnect(self.names.index(name))
        elif rig != self.address.rig:
            reason = f"its calibration or its options differ from this node's ({rig[:8]} and {self.address.rig[:8]})"
            self._add_refused(name, reason)

    def _add_refused(self, name: str, reason: str) -> None:
        if len(self.refused) < MAX_REFUSED:
            self.refused.setdefault(name, reason)

    def _on_sample(self, sample: Any) -> None:
        name = str(sample.key_expr).split("/")[4]
        if name not in self.names:
            self._add_refused(name, "it is not a camera of the calibration")
            return
        payload = sample.payload
        if len(payload) > MAX_MESSAGE_BYTES:
            self._add_refused(name, f"a message of {len(payload)} bytes")
            return
        self.on_message(self.names.index(name), payload.to_bytes())

    def send(self, packets: Sequence[Packet]) -> int:
        """Send packets; return the number of bytes."""
        sent = 0
        for to, data in packets:
            if len(to) > 1 and message_kind(data) not in (HELLO, WELCOME):
                self._all.put(data)
                sent += len(data)
                continue
            for c in to:
                self._to[c].put(data)
                sent += len(data)
        return sent

    def publish_pose(self, line: str) -> None:
        """Publish a pose as one line of JSON, for observers."""
        self._poses.put(line)

    def publish_state(self, line: str) -> None:
        """Publish the node's state as one line of JSON, for observers."""
        self._states.put(line)

    def close(self) -> None:
        """Leave the network."""
        self.session.close()


def open_zenoh_session(links: LinkSettings, name: str) -> Any:
    """Open a Zenoh session.

    Args:
        links: how to connect.
        name: name of the node or observer.

    Raises:
        ValueError: an unusable endpoint, or missing keys.
    """
    import zenoh

    # Zenoh reads this at the first session of a process.
    os.environ.setdefault("ZENOH_RUNTIME", f"(rx: (worker_threads: {RECEIVE_THREADS}))")
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
        "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES + 1024,
        "transport/shared_memory/enabled": False,
        "transport/link/protocols": [protocol],
    }
    if links.multicast:
        host = links.listen.rpartition(":")[0]  # discover nodes by the interface of the listening address
        settings["scouting/multicast/interface"] = "auto" if host in ("0.0.0.0", "[::]", "localhost") else host
    if links.keys is not None:
        settings["transport/link/tls"] = build_tls_settings(links.keys, name)
        if links.names:  # observers receive nothing that they would have to reject
            settings["access_control"] = build_access_rules(links.names)
    try:
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
        return zenoh.open(config)
    except zenoh.ZError as error:
        ends = f"listen at {links.listen}" + (f" or connect to {', '.join(links.connect)}" if links.connect else "")
        why = str(error).split(" at ")[0]
        raise ValueError(
            f"{name}: cannot {ends} ({why}); check the address, the port, the keys and the clock"
        ) from None


def decode_line(data: bytes) -> str | None:
    """Decode a published line; None if it is not text or too long."""
    if len(data) > MAX_LINE_BYTES:
        return None
    try:
        return data.decode()
    except UnicodeDecodeError:
        return None


def watch_network(
    links: LinkSettings, network: str, on_state: Callable[[str, str, str], None], on_pose: Callable[[str, str], None]
) -> Any:
    """Subscribe to a network's states and poses without taking part.

    Args:
        links: how to connect.
        network: name of the network.
        on_state: called with rig, name and line.
        on_pose: called with name and line.

    Returns:
        The session; the caller closes it.
    """
    check_name("network", network)
    session = open_zenoh_session(links, OBSERVER)

    def on_sample(sample: Any) -> None:
        _, _, _, rig, name, what = str(sample.key_expr).split("/")
        line = decode_line(sample.payload.to_bytes()) if len(sample.payload) <= MAX_LINE_BYTES else None
        if line is None or not NAME_PATTERN.fullmatch(name) or not NAME_PATTERN.fullmatch(rig):
            return
        if what == "state":
            on_state(rig, name, line)
        else:
            on_pose(name, line)

    for what in ("state", "pose"):
        session.declare_subscriber(f"sylpose/{PROTOCOL_VERSION}/{network}/*/*/{what}", on_sample)
    return session
