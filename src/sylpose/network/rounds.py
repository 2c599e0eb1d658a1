"""Reliable all-to-all broadcast in synchronous rounds: one camera's side, pure, (state, inbox) -> (state, packets).

In each round every camera sends one payload to all others, and the round ends when it has received all of theirs. No
camera can be more than one round ahead, since that requires this camera's payload; a camera one round behind is sent it
again. Loss and delay thus cost time but do not change results.

A camera without messages for too long is excluded, consistently at all others. Each camera that misses it announces so,
with the payload it received from it in this round, until all remaining cameras exclude the same set. A payload that any
of them received counts for all, otherwise for none; later the excluded cameras take no part. A camera's exclusions only
grow, and a camera that has ended a round reports its result instead of accepting another one. So no two connected
cameras end a round differently. One camera alone cannot exclude a camera that the others receive.

Cameras may join between two rounds: all members begin the next round with the same newcomers, which receive the shared
state.

The epoch of a round is a digest of all earlier payloads and their senders, so a message is only valid in its own
history. A camera that sends different payloads to different receivers is therefore detected by the next message of any
of them. Then all exchange digests of what they received (`network.byzantine`). The faulty cameras are removed from
the group, and the others begin an empty round, after which they roll back to their last common state.

Source: view synchrony, K. Birman, T. Joseph, "Exploiting virtual synchrony in distributed systems" (1987); the exchange
of received values, L. Lamport, R. Shostak, M. Pease, "The Byzantine generals problem" (1982), section 3, here with
digests and only after a conflict.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

from sylpose.network.byzantine import NO_EVIDENCE, FaultEvidence, encode_claim, judge_claims
from sylpose.network.wire_format import (
    DATA,
    DISPUTE,
    EXCLUSION,
    HEARTBEAT,
    MAX_CAMERAS,
    RELAY,
    ROUND_END,
    RoundMessage,
    Welcome,
    compute_join_epoch,
    compute_next_epoch,
    decode_message,
    digest,
    encode_message,
    encode_relay,
    encode_welcome,
)
from sylpose.packets import Inbox, Packet

# Ticks between retransmissions or heartbeats; and number of these intervals between retransmissions of a welcome, which
# is long (choice).
RETRANSMIT_INTERVAL, WELCOME_INTERVALS = 2, 5


class Timeouts(NamedTuple):
    """Timeouts in ticks.

    Attributes:
        inactive: ticks without any message of a camera until it is excluded.
        stalled: ticks of a round until a camera is excluded that has not sent its payload or does not agree on the
            exclusions.
    """

    inactive: int
    stalled: int


DEFAULT_TIMEOUTS = Timeouts(30, 120)  # (choice)
# Fields that `step_round` copies before it modifies them.
MODIFIED_FIELDS = (
    *("received", "early", "conflicting_messages", "claims", "relays"),
    *("inactive_ticks", "exclusion_messages", "end_messages", "refused"),
)
# Welcome of a round without newcomers.
EMPTY_WELCOME = Welcome(0, 0, frozenset(), b"")


@dataclass(eq=False)
class RoundState:
    """State of one camera in a round; callers replace it instead of modifying it.

    Attributes:
        camera: number of this camera.
        members: the members of the group, including this one.
        round: number of the round, from 0.
        epoch: digest of the history, including the newcomers of this round.
        payload: payload of this camera in this round.
        received: camera -> payload received in this round.
        timeouts: timeouts for the other cameras.
        welcome: the message for newcomers.
        newcomers: cameras that joined with this round and have not sent anything yet.
        early: camera one round ahead -> epoch and payload of the next round.
        previous: camera -> payload of the previous round.
        previous_leaving: cameras that left with the previous round.
        previous_epoch: epoch of the previous round.
        conflicting: cameras whose messages have another history.
        conflicting_messages: camera -> epoch and payload of such a message.
        claims: in a dispute about the history, camera -> digests of what it received.
        relays: camera -> the claims that it received.
        evidence: cameras and pairs of cameras known to be faulty.
        is_rollback: this is the round after which all roll back.
        is_excluded: this camera itself was excluded as faulty.
        inactive_ticks: camera -> ticks since its last message.
        elapsed_ticks: ticks of this round.
        excluding: cameras that this one excludes.
        exclusion_messages: camera -> its exclusion message, with the payloads it received from the excluded ones.
        end_messages: camera -> its end-of-round message, with the same content.
        is_end_adopted: the end of the round was adopted from other cameras.
        outcome: camera -> payload, once the round is over; cameras excluded without a payload are missing.
        refused: camera -> reason why its first invalid message was rejected.
    """

    camera: int
    members: tuple[int, ...]
    round: int
    epoch: int
    payload: bytes
    received: dict[int, bytes]
    timeouts: Timeouts = DEFAULT_TIMEOUTS
    welcome: Welcome = EMPTY_WELCOME
    newcomers: frozenset[int] = frozenset()
    early: dict[int, tuple[int, bytes]] = field(default_factory=dict)
    previous: Mapping[int, bytes] = field(default_factory=dict)
    previous_leaving: frozenset[int] = frozenset()
    previous_epoch: int = 0
    conflicting: frozenset[int] = frozenset()
    conflicting_messages: dict[int, tuple[int, bytes]] = field(default_factory=dict)
    claims: dict[int, bytes] = field(default_factory=dict)
    relays: dict[int, Mapping[int, bytes]] = field(default_factory=dict)
    evidence: FaultEvidence = NO_EVIDENCE
    is_rollback: bool = False
    is_excluded: bool = False
    inactive_ticks: dict[int, int] = field(default_factory=dict)
    elapsed_ticks: int = 0
    excluding: frozenset[int] = frozenset()
    exclusion_messages: dict[int, RoundMessage] = field(default_factory=dict)
    end_messages: dict[int, RoundMessage] = field(default_factory=dict)
    is_end_adopted: bool = False
    outcome: Mapping[int, bytes] | None = None
    refused: dict[int, str] = field(default_factory=dict)

    @property
    def others(self) -> tuple[int, ...]:
        """The members except this one and those that it excludes."""
        return tuple(c for c in self.members if c != self.camera and c not in self.excluding)


def start_rounds(
    camera: int,
    members: Sequence[int],
    payload: bytes,
    number: int = 0,
    epoch: int = 0,
    *,
    timeouts: Timeouts = DEFAULT_TIMEOUTS,
    evidence: FaultEvidence = NO_EVIDENCE,
) -> tuple[RoundState, list[Packet]]:
    """Start the first round of a camera.

    Args:
        camera: number of this camera.
        members: numbers of all cameras in the group.
        payload: payload of this camera.
        number, epoch: of the round, for a camera that joins a group.
        timeouts: timeouts for the other cameras.
        evidence: fault evidence from earlier groups.

    Returns:
        The state, and the packets to send.

    Raises:
        ValueError: camera numbers outside 0 to 1,023, or this camera is not a member.
    """
    if camera not in members or min(members) < 0 or max(members) >= MAX_CAMERAS:
        raise ValueError(
            f"camera {camera} of {list(members)}: it must be a member, and numbers must be 0 to {MAX_CAMERAS - 1}"
        )
    s = RoundState(camera, tuple(sorted(members)), number, epoch, payload, {camera: payload}, timeouts)
    s.evidence, s.previous_epoch = evidence, epoch
    _set_outcome(s)
    return s, _make_packets(s.others, _encode_payload(s))


def begin_next_round(
    state: RoundState, payload: bytes, newcomers: frozenset[int] = frozenset(), welcome: bytes = b""
) -> tuple[RoundState, list[Packet]]:
    """Begin the next round, once the current one has an outcome.

    Args:
        state: the state with an outcome.
        payload: payload of this camera.
        newcomers: cameras that join with the round, the same at all members.
        welcome: shared state for the newcomers.

    Returns:
        The state, and the packets to send.
    """
    assert state.outcome is not None
    number, newcomers = state.round + 1, newcomers - {*state.others, state.camera}
    members = tuple(sorted({*state.others, state.camera, *newcomers}))
    epoch = base_epoch = compute_next_epoch(state.epoch, number, members, newcomers, state.outcome)
    if newcomers:
        epoch = compute_join_epoch(base_epoch, welcome)
    early = {c: data for c, (of, data) in state.early.items() if c in members and of == epoch}
    conflicting = {c for c, (of, _) in state.early.items() if c in members and of != epoch}
    received = {state.camera: payload, **early}
    s = RoundState(state.camera, members, number, epoch, payload, received, state.timeouts)
    s.welcome, s.newcomers = Welcome(number, base_epoch, frozenset(members), welcome), newcomers
    s.previous, s.previous_leaving, s.previous_epoch = state.outcome, state.excluding, state.epoch
    s.conflicting, s.evidence, s.refused = frozenset(conflicting), state.evidence, state.refused
    s.inactive_ticks = {c: n for c, n in state.inactive_ticks.items() if c in members}
    packets = _make_packets(tuple(c for c in s.others if c not in newcomers), _encode_payload(s))
    packets += _make_packets(tuple(sorted(newcomers)), _encode_welcome(s))
    packets += _join_dispute(s)
    _set_outcome(s)
    return s, packets


def step_round(state: RoundState, inbox: Inbox, *, tick: bool = True) -> tuple[RoundState, list[Packet]]:
    """Process received messages; retransmit what others may have missed, and announce exclusions.

    Args:
        state: the current state.
        inbox: sender and bytes of the received messages.
        tick: whether a tick has elapsed.

    Returns:
        The state, and the packets to send.
    """
    copies: dict[str, Any] = {name: dict(getattr(state, name)) for name in MODIFIED_FIELDS}
    s, out = replace(state, **copies), list[Packet]()
    if tick:
        s.inactive_ticks = {c: s.inactive_ticks.get(c, 0) + 1 for c in s.others}
        s.elapsed_ticks += 1
    others = set(s.others)
    for sender, data in inbox:
        if sender in others:
            out += _process_message(s, sender, data)
    _adopt_end(s)
    out += _join_dispute(s)
    _exclude_inactive(s)
    out += _exclude_faulty(s)
    _set_outcome(s)
    return s, out + (_retransmit(s) if tick and not s.is_excluded else [])


def _process_message(s: RoundState, sender: int, data: bytes) -> list[Packet]:
    """Store a message of another camera; return the answers."""
    try:
        msg = decode_message(sender, data, s.round)
    except ValueError as error:
        s.refused.setdefault(sender, str(error))
        return []
    is_ahead = msg.round == s.round + 1 and msg.kind == DATA
    if msg.round == s.round and sender in s.previous:
        if msg.kind in (DISPUTE, RELAY) and (s.outcome is None or s.is_rollback):
            s.inactive_ticks[sender] = 0
            if msg.kind == DISPUTE:
                s.claims.setdefault(sender, msg.payloads[sender])
            else:
                s.relays.setdefault(sender, msg.payloads)
            # It missed this camera's message; an answer needs no reply.
            return _dispute_packets(s, (sender,)) if s.is_rollback and msg.epoch else []
        if msg.kind == DATA and msg.epoch != s.epoch:
            s.conflicting |= {sender}
            s.conflicting_messages[sender] = msg.epoch, msg.payloads[sender]
    if (msg.epoch not in (s.epoch, s.previous_epoch) and not is_ahead) or msg.round > s.round + 1:
        # It is in another group, or has continued without this camera, which it excluded: no valid message.
        return []
    s.inactive_ticks[sender] = 0
    if msg.kind == HEARTBEAT:
        return []
    if is_ahead:
        s.early[sender] = msg.epoch, msg.payloads[sender]
    elif msg.round == s.round and msg.epoch == s.epoch:
        s.newcomers -= {sender}
        if s.outcome is not None:  # it missed a message of this camera or of another one
            return _make_packets((sender,), _answer_finished_round(s, msg, s.outcome))
        if msg.kind == DATA:
            s.received.setdefault(sender, msg.payloads[sender])
        else:
            (s.end_messages if msg.kind == ROUND_END else s.exclusion_messages)[sender] = msg
    elif msg.round == s.round - 1 and msg.epoch == s.previous_epoch and s.camera in s.previous:
        return _make_packets((sender,), _answer_finished_round(s, msg, s.previous))
    return []


def _retransmit(s: RoundState) -> list[Packet]:
    """Return retransmissions of what others may have missed."""
    if s.outcome is not None:
        heartbeat = encode_message(HEARTBEAT, s.camera, s.round, s.epoch, b"")
        return _make_packets(s.others, heartbeat) if s.elapsed_ticks % RETRANSMIT_INTERVAL == 0 else []
    out: list[Packet] = []
    if s.claims and not s.is_rollback:
        out += _dispute_packets(s, s.others)
    if s.excluding and not s.is_end_adopted:
        exclusion = encode_relay(EXCLUSION, s.camera, s.round, s.epoch, s.excluding, frozenset(), s.received)
        out += _make_packets(s.others, exclusion)
    if s.elapsed_ticks % RETRANSMIT_INTERVAL == 0:
        out += _make_packets(tuple(c for c in s.others if c not in s.newcomers), _encode_payload(s))
    if s.elapsed_ticks % (RETRANSMIT_INTERVAL * WELCOME_INTERVALS) == 0:
        out += _make_packets(tuple(sorted(s.newcomers & {*s.others})), _encode_welcome(s))
    return out


def _answer_finished_round(s: RoundState, msg: RoundMessage, outcome: Mapping[int, bytes]) -> bytes:
    """Return the answer to a message of a finished round."""
    if msg.kind == DATA:
        return encode_message(DATA, s.camera, msg.round, msg.epoch, outcome[s.camera])
    leaving = s.excluding if msg.round == s.round else s.previous_leaving
    return encode_relay(ROUND_END, s.camera, msg.round, msg.epoch, leaving, msg.leaving, outcome)


def _adopt_end(s: RoundState) -> None:
    """Adopt the end of the round from another camera.

    Only if it concerns just the cameras missed here, or if most others report it.
    """
    if s.outcome is not None or s.is_end_adopted:
        return
    missed = {c for c in s.members if c not in s.received} | s.excluding
    for msg in s.end_messages.values():
        n_equal = sum(msg.leaving == other.leaving for other in s.end_messages.values())
        if msg.leaving <= missed or (2 * n_equal > len(s.others) and s.camera not in msg.leaving):
            s.received = {**{c: data for c, data in msg.payloads.items() if c in missed}, **s.received}
            s.excluding, s.is_end_adopted = msg.leaving, True
            return


def _exclude_inactive(s: RoundState) -> None:
    """Exclude the awaited cameras that exceed a timeout."""
    if s.outcome is not None or s.is_end_adopted or s.is_excluded:
        return
    missed = {c for c in s.others if c not in s.received or (s.excluding and not _has_same_exclusions(s, c))}
    missed |= {c for c in s.others if s.claims and not s.is_rollback and not (c in s.claims and c in s.relays)}
    inactive, stalled = s.timeouts
    more = {c for c in missed if s.inactive_ticks.get(c, 0) > inactive or s.elapsed_ticks > stalled} - s.excluding
    if more:  # the others have the same time again to agree
        s.excluding, s.elapsed_ticks = s.excluding | more, 0


def _has_same_exclusions(s: RoundState, camera: int) -> bool:
    return camera in s.exclusion_messages and s.exclusion_messages[camera].leaving == s.excluding


def _set_outcome(s: RoundState) -> None:
    """Set the outcome once all remaining cameras have sent their payloads and exclude the same set."""
    if s.is_excluded:  # keeps answering cameras that missed its messages
        if s.elapsed_ticks > s.timeouts.inactive:
            s.outcome, s.members = {}, (s.camera,)
        return
    is_agreed = s.is_end_adopted or not s.excluding or all(_has_same_exclusions(s, c) for c in s.others)
    if s.outcome is not None or not is_agreed or any(c not in s.received for c in s.others):
        return
    if s.claims and not s.is_rollback and not s.is_end_adopted:  # its claim is needed: wait for the dispute to end
        return
    # Of excluded cameras, any payload received by a member counts; later ones are ignored.
    relayed = [s.exclusion_messages[c].payloads for c in s.others if c in s.exclusion_messages and not s.is_end_adopted]
    payloads = {c: data for of in relayed for c, data in of.items() if c in s.excluding} | s.received
    s.outcome = {c: payloads[c] for c in s.members if c in payloads}


def _join_dispute(s: RoundState) -> list[Packet]:
    """Take part in a dispute, if there is one: send own claims, then the claims received from the others."""
    if s.is_rollback or s.outcome is not None or s.is_end_adopted or not (s.conflicting or s.claims):
        return []
    n_known = len(s.claims) + len(s.relays)
    if s.camera not in s.claims:
        s.claims[s.camera] = encode_claim(s.conflicting, {c: digest(data) for c, data in s.previous.items()})
    if s.camera not in s.relays and all(c in s.claims for c in s.others):
        s.relays[s.camera] = dict(s.claims)
    return _dispute_packets(s, s.others) if len(s.claims) + len(s.relays) > n_known else []


def _exclude_faulty(s: RoundState) -> list[Packet]:
    """Exclude the faulty cameras once all remaining claims are known; the others roll back one round later."""
    is_settled = s.is_rollback or s.outcome is not None or s.is_end_adopted
    if is_settled or any(c not in s.relays for c in (s.camera, *s.others)):
        return []
    excluded, s.evidence = judge_claims(s.previous.keys(), s.relays, s.evidence)
    # Including cameras that this one has excluded meanwhile: not all members may have done so.
    remaining = tuple(sorted((set(s.members) & s.previous.keys()) - excluded))
    s.is_rollback, s.is_excluded, s.elapsed_ticks = True, s.camera in excluded, 0
    s.conflicting = s.newcomers = frozenset()
    if s.is_excluded:
        return []
    s.members, s.epoch = remaining, compute_next_epoch(s.previous_epoch, s.round, remaining, frozenset(), {})
    of_epoch = {c: data for c, (of, data) in s.conflicting_messages.items() if c in remaining and of == s.epoch}
    s.payload, s.received, s.excluding = b"", {s.camera: b"", **of_epoch}, frozenset()
    s.early, s.exclusion_messages, s.end_messages, s.inactive_ticks = {}, {}, {}, {}
    return _make_packets(s.others, _encode_payload(s))


def _dispute_packets(s: RoundState, to: tuple[int, ...]) -> list[Packet]:
    """Return the dispute messages of this camera, without epoch if the dispute is over for it (an answer)."""
    header = s.camera, s.round, 0 if s.is_rollback else s.epoch
    out = _make_packets(to, encode_message(DISPUTE, *header, s.claims[s.camera])) if s.camera in s.claims else []
    if s.camera in s.relays:
        relays = s.relays[s.camera]
        out += _make_packets(to, encode_relay(RELAY, *header, frozenset(), frozenset(relays), relays))
    return out


def _make_packets(to: tuple[int, ...], data: bytes) -> list[Packet]:
    return [Packet(to, data)] if to else []


def _encode_payload(s: RoundState) -> bytes:
    return encode_message(DATA, s.camera, s.round, s.epoch, s.payload)


def _encode_welcome(s: RoundState) -> bytes:
    return encode_welcome(s.camera, s.welcome)
