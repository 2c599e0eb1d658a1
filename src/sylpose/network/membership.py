"""Group membership of a node: its group, other nodes and newcomers; pure, (state, inbox) -> (state, packets).

A node without a group announces its presence to all. The members of a group receive that and admit it between two
frames. It receives the shared state and takes part from then on. A node that starts late, restarts or was excluded for
its inactivity needs nothing else. If two groups meet, the one that knows the object continues, or the larger one if
both do; the nodes of the other leave it to be admitted. Without any group, the node that has tracked most frames founds
one (the lowest number of several), once all cameras of the rig are present or after a waiting time.

The node's work submits a request (`Request`) and waits for the response (`Response`).
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeAlias

from sylpose.network.byzantine import NO_EVIDENCE, FaultEvidence
from sylpose.network.rounds import DEFAULT_TIMEOUTS, RoundState, Timeouts, begin_next_round, start_rounds, step_round
from sylpose.network.wire_format import (
    HEARTBEAT,
    HELLO,
    Hello,
    Welcome,
    compute_join_epoch,
    decode_hello,
    decode_welcome,
    encode_hello,
    encode_message,
    message_kind,
)
from sylpose.packets import Inbox, Packet

# Ticks between presence messages; and number of missed ones after which a node counts as absent (choice).
HELLO_INTERVAL, MAX_MISSED_HELLOS = 5, 3
# Number of presence messages of a member, with no other message in between, after which it is excluded (choice).
MAX_FOREIGN_HELLOS = 3


class ExchangeRequest(NamedTuple):
    """Request to exchange payloads.

    Attributes:
        payload: payload of this node.
        newcomers: cameras that join with this round.
        shared_state: shared state for the newcomers.
    """

    payload: bytes
    newcomers: frozenset[int] = frozenset()
    shared_state: bytes = b""


class JoinRequest(NamedTuple):
    """Request to leave the group, if any, and to be admitted to another one."""


class ExchangeResult(NamedTuple):
    """Response: the payloads of all members.

    Attributes:
        payloads: camera -> payload.
        newcomers: nodes that want to be admitted.
        is_outranked: there is a larger group.
        is_rollback: not all received the same, and all roll back to their last common state.
        is_excluded: this node is excluded.
    """

    payloads: Mapping[int, bytes]
    newcomers: frozenset[int]
    is_outranked: bool
    is_rollback: bool = False
    is_excluded: bool = False


class JoinResult(NamedTuple):
    """Response: the node is in a group.

    Attributes:
        shared_state: shared state received; None if it founded the group.
        newcomers: as in `ExchangeResult`.
    """

    shared_state: bytes | None
    newcomers: frozenset[int]


Request: TypeAlias = ExchangeRequest | JoinRequest
Response: TypeAlias = ExchangeResult | JoinResult


class OutsideNode(NamedTuple):
    """A node outside the group.

    Attributes:
        hello: its latest presence message.
        inactive_ticks: ticks since that message.
    """

    hello: Hello
    inactive_ticks: int


@dataclass(frozen=True, eq=False)
class Membership:
    """Membership state of one node.

    Attributes:
        camera: its number.
        cameras: number of cameras of the rig.
        incarnation: different for each start of the node.
        wait: ticks to wait for all cameras before a group is founded.
        timeouts: timeouts for other cameras.
        request: the pending request; None while the work is busy.
        round_state: state of the current round; None without a group.
        welcome: message of the group that admits this node.
        frames: number of frames tracked by its group; 0 if no member knows the object.
        outside: camera -> present node that is not a member.
        ticks: ticks since the start.
        waiting_since: tick at which it began to wait for a group.
        separate_until: tick until which it stays in its group although a larger one exists that has not admitted it.
        refused: camera -> reason why a message was rejected.
        evidence: evidence of faults from earlier groups.
    """

    camera: int
    cameras: int
    incarnation: int = 0
    wait: int = 0
    timeouts: Timeouts = DEFAULT_TIMEOUTS
    request: Request | None = None
    round_state: RoundState | None = None
    welcome: Welcome | None = None
    frames: int = 0
    outside: Mapping[int, OutsideNode] = field(default_factory=dict)
    ticks: int = 0
    waiting_since: int = 0
    separate_until: int = 0
    refused: Mapping[int, str] = field(default_factory=dict)
    evidence: FaultEvidence = NO_EVIDENCE

    @property
    def members(self) -> tuple[int, ...]:
        """Members of its group; empty without one."""
        s = self.round_state
        return () if s is None else tuple(sorted({*s.others, s.camera}))

    @property
    def all_refused(self) -> Mapping[int, str]:
        """Return `refused`, with the rejections by the current group and the faulty cameras."""
        refused = {} if self.round_state is None else self.round_state.refused
        return {**self.refused, **refused, **self.all_evidence.describe()}

    @property
    def all_evidence(self) -> FaultEvidence:
        """Return `evidence`, with the evidence of the current group."""
        return self.evidence if self.round_state is None else self.round_state.evidence


def submit_request(p: Membership, request: Request, frames: int) -> tuple[Membership, list[Packet]]:
    """Submit a request of the work; see `take_response`.

    Args:
        p: the current state.
        request: the request.
        frames: as in `Membership`.

    Returns:
        The state, and the packets to send.
    """
    p = replace(p, request=request, frames=frames)
    if isinstance(request, JoinRequest):
        p = replace(p, refused=p.all_refused, evidence=p.all_evidence, waiting_since=p.ticks)
        return replace(p, round_state=None, welcome=None), []
    if p.round_state is not None:
        round_state, packets = begin_next_round(p.round_state, request.payload, request.newcomers, request.shared_state)
    else:
        number, members = 0, frozenset({p.camera})
        epoch = zlib.crc32(f"{p.camera} {p.incarnation} {p.ticks}".encode())
        if p.welcome is not None:
            number, epoch, members, shared_state = p.welcome
            epoch = compute_join_epoch(epoch, shared_state)
        round_state, packets = start_rounds(
            p.camera, sorted(members), request.payload, number, epoch, timeouts=p.timeouts, evidence=p.evidence
        )
    return replace(p, round_state=round_state, welcome=None), packets


def take_response(p: Membership) -> tuple[Membership, Response | None]:
    """Return the response to the pending request, once available: all payloads, or a group."""
    if isinstance(p.request, ExchangeRequest) and p.round_state is not None and p.round_state.outcome is not None:
        blocked = {c for c in p.outside if p.all_evidence.excludes(c, frozenset(p.members))}
        others = {c: o for c, o in p.outside.items() if c not in p.members and c not in blocked}
        own_rank = p.frames > 0, len(p.members), -min(p.members)
        is_outranked = any((o.hello.frames > 0, o.hello.size, -c) > own_rank for c, o in others.items() if o.hello.size)
        outcome, is_rollback, is_excluded = p.round_state.outcome, p.round_state.is_rollback, p.round_state.is_excluded
        is_outranked = is_outranked and p.ticks >= p.separate_until
        result = ExchangeResult(outcome, _find_newcomers(p, others), is_outranked, is_rollback, is_excluded)
        return replace(p, request=None), result
    if isinstance(p.request, JoinRequest):
        if p.welcome is not None:
            return replace(p, request=None), JoinResult(p.welcome.shared_state, frozenset())
        has_waited = p.ticks - p.waiting_since > p.wait + p.timeouts.stalled
        is_ignored = has_waited and any(o.hello.size for o in p.outside.values())
        if is_ignored:
            # A member of that group does not receive this node's messages: better a group of its own, for as long
            # again.
            p = replace(p, separate_until=p.ticks + p.timeouts.stalled)
        if is_ignored or _is_founder(p):
            return replace(p, request=None), JoinResult(None, _find_newcomers(p, p.outside))
    return p, None


def _find_newcomers(p: Membership, others: Mapping[int, OutsideNode]) -> frozenset[int]:
    """Return the nodes that want to be admitted; of a suspected pair only one."""
    newcomers = frozenset[int]()
    for c in sorted(c for c, o in others.items() if not o.hello.size):
        if not p.all_evidence.excludes(c, newcomers | frozenset({p.camera, *p.members})):
            newcomers |= {c}
    return newcomers


def _is_founder(p: Membership) -> bool:
    """Return whether a node that waits for admission founds a group.

    It does if there is no group and it has tracked most frames among the waiting nodes, the lowest number of several.
    """
    waited = p.ticks >= p.wait or len(p.outside) + 1 == p.cameras
    first = all((p.frames, -p.camera) > (o.hello.frames, -c) for c, o in p.outside.items())
    return waited and first and not any(o.hello.size for o in p.outside.values())


def add_inactivity(round_state: RoundState, camera: int, ticks: int) -> RoundState:
    """Add inactive ticks to a camera, after it has announced elsewhere that it is no member."""
    ticks += round_state.inactive_ticks.get(camera, 0)
    return replace(round_state, inactive_ticks={**round_state.inactive_ticks, camera: ticks})


def step_membership(p: Membership, inbox: Inbox, *, tick: bool = True) -> tuple[Membership, list[Packet]]:
    """Process received messages; retransmit what others may have missed, and announce presence.

    Args:
        p: the current state.
        inbox: sender and bytes of the received messages.
        tick: whether a tick has elapsed.

    Returns:
        The state, and the packets to send.
    """
    out: list[Packet] = []
    round_messages: list[tuple[int, bytes]] = []
    outside, round_state = dict(p.outside), p.round_state
    if tick:
        p = replace(p, ticks=p.ticks + 1)
        present = {c: o for c, o in outside.items() if o.inactive_ticks < HELLO_INTERVAL * MAX_MISSED_HELLOS}
        outside = {c: OutsideNode(o.hello, o.inactive_ticks + 1) for c, o in present.items()}
    own_group = frozenset({p.camera, *p.members})
    for sender, data in inbox:
        if p.all_evidence.excludes(sender, own_group):
            continue
        if message_kind(data) != HELLO:
            round_messages.append((sender, data))
            continue
        hello = decode_hello(sender, data)
        if hello is None or not 0 <= sender < p.cameras or sender == p.camera or hello.size > p.cameras:
            p = replace(p, refused={sender: "its presence message has another sender", **p.refused})
            continue
        outside[sender] = OutsideNode(hello, 0)
        if round_state is not None and sender in round_state.others and sender not in round_state.newcomers:
            round_state = add_inactivity(round_state, sender, p.timeouts.inactive // MAX_FOREIGN_HELLOS + 1)
    if round_state is not None:
        round_state, out = step_round(round_state, round_messages, tick=tick)
    elif isinstance(p.request, JoinRequest) and p.welcome is None:
        welcomes = (decode_welcome(p.camera, p.cameras, sender, data) for sender, data in round_messages)
        p = replace(p, welcome=next((w for w in welcomes if w is not None), None))
    p = replace(p, round_state=round_state, outside=outside)
    if tick and round_state is None and p.welcome is not None:
        # It restores the shared state and has not sent anything yet.
        number, epoch, members, shared_state = p.welcome
        heartbeat = encode_message(HEARTBEAT, p.camera, number, compute_join_epoch(epoch, shared_state), b"")
        out.append(Packet(tuple(sorted(members - {p.camera})), heartbeat))
    others = tuple(c for c in range(p.cameras) if c != p.camera and c not in p.members)
    if tick and others and p.ticks % HELLO_INTERVAL == 0 and p.welcome is None:
        hello = Hello(len(p.members), p.frames)
        out.append(Packet(others, encode_hello(p.camera, 0 if round_state is None else round_state.epoch, hello)))
    return p, out
