"""Rounds end identically at all connected cameras under loss, delay and crashes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sylpose.network.rounds import DEFAULT_TIMEOUTS, RoundState, begin_next_round, start_rounds, step_round
from sylpose.network.wire_format import DATA, DISPUTE, EXCLUSION, HEADER, RELAY, encode_cameras, message_kind
from sylpose.packets import Packet

ROUNDS = 12


def make_payload(camera: int, number: int) -> bytes:
    return f"{camera} in {number}".encode()


class LossyNetwork:
    """Cameras that exchange payloads in `ROUNDS` rounds over lossy, delayed links."""

    def __init__(self, n: int, seed: int, loss: float, delay: int, dies: Mapping[int, int]) -> None:
        self.n, self.loss, self.delay, self.dies = n, loss, delay, dies
        self.rng, self.now = np.random.default_rng(seed), 0
        self.in_transit: dict[int, list[tuple[int, int, bytes]]] = {}
        self.states: list[RoundState | None] = [None] * n
        self.outcomes: list[list[dict[int, bytes]]] = [[] for _ in range(n)]
        self.again = [0] * n

    def run(self, most: int = 5000) -> None:
        while self.now < most and not all(self.is_finished(c) for c in range(self.n)):
            inboxes: list[list[tuple[int, bytes]]] = [[] for _ in range(self.n)]
            for to, sender, data in self.in_transit.pop(self.now, []):
                inboxes[to].append((sender, data))
            for c in range(self.n):
                if self.now < self.dies.get(c, most):
                    self.step(c, inboxes[c])
            self.now += 1

    def is_finished(self, c: int) -> bool:
        return c in self.dies or len(self.outcomes[c]) == ROUNDS

    def step(self, c: int, inbox: list[tuple[int, bytes]]) -> None:
        state = self.states[c]
        if state is not None and state.is_excluded and state.outcome is not None:
            return
        s, packets = start_rounds(c, range(self.n), make_payload(c, 0)) if state is None else step_round(state, inbox)
        self.send(c, packets)
        while s.outcome is not None and len(self.outcomes[c]) < ROUNDS and not s.is_excluded:
            if s.is_rollback:
                # The last payload of each is void and sent again.
                self.again[c] += 1
                self.outcomes[c] = self.outcomes[c][:-1]
            else:
                self.outcomes[c].append(dict(s.outcome))
            if len(self.outcomes[c]) < ROUNDS:
                s, packets = begin_next_round(s, make_payload(c, len(self.outcomes[c])))
                self.send(c, packets)
        self.states[c] = s

    def send(self, c: int, packets: list[Packet]) -> None:
        for packet in packets:
            for to in packet.to:
                if self.rng.random() >= self.loss:
                    arrives = self.now + 1 + int(self.rng.integers(self.delay + 1))
                    self.in_transit.setdefault(arrives, []).append((to, c, packet.data))


@st.composite
def networks(draw: st.DrawFn) -> LossyNetwork:
    n = draw(st.integers(1, 7))
    dying = draw(st.lists(st.integers(0, n - 1), max_size=n - 1, unique=True))
    dies = {c: draw(st.integers(0, 60)) for c in dying}
    loss, delay = draw(st.sampled_from([0.0, 0.1, 0.3])), draw(st.integers(0, 3))
    return LossyNetwork(n, draw(st.integers(0, 10**6)), loss, delay, dies)


@settings(max_examples=60)
@given(network=networks())
def test_live_cameras_receive_the_same(network: LossyNetwork) -> None:
    network.run()
    live = [c for c in range(network.n) if c not in network.dies]
    first, *others = (network.outcomes[c] for c in live)
    assert len(first) == ROUNDS
    for other in others:
        assert other == first
    for number, outcome in enumerate(first):
        # No payload is invented, and no live camera is missing.
        assert all(data == make_payload(c, number) for c, data in outcome.items())
        assert set(live) <= outcome.keys()
    # Excluded cameras do not return.
    for before, after in pairwise(first):
        assert after.keys() <= before.keys()


class NetworkWithFault(LossyNetwork):
    """A network with one camera that occasionally sends other payloads, or false reports, to some receivers."""

    def __init__(
        self, n: int, seed: int, loss: float, delay: int, liar: int, often: float, kinds: tuple[int, ...]
    ) -> None:
        super().__init__(n, seed, loss, delay, {})
        self.faulty, self.often, self.kinds = liar, often, kinds
        self.false = 0.5

    def is_finished(self, c: int) -> bool:
        return c == self.faulty or self.is_excluded(c) or super().is_finished(c)

    def is_excluded(self, c: int) -> bool:
        state = self.states[c]
        return state is not None and state.is_excluded

    def send(self, c: int, packets: list[Packet]) -> None:
        for packet in packets:
            for to in packet.to:
                data = packet.data
                if c == self.faulty and message_kind(data) in self.kinds and self.rng.random() < self.often:
                    at = -1 if self.rng.random() < self.false else HEADER.size - 1
                    data = data[:at] + bytes([data[at] ^ 1]) + data[at:][1:]
                super().send(c, [Packet((to,), data)])


@settings(max_examples=60)
@given(data=st.data())
def test_faulty_camera_is_excluded_and_others_agree(data: st.DataObject) -> None:
    n = data.draw(st.integers(4, 7))
    liar, often = data.draw(st.integers(0, n - 1)), data.draw(st.sampled_from([0.02, 0.2, 1.0]))
    kinds = data.draw(st.sampled_from([(DATA,), (DATA, DISPUTE), (DATA, DISPUTE, RELAY)]))
    loss, delay = data.draw(st.sampled_from([(0.0, 0), (0.1, 1), (0.2, 3)]))
    network = NetworkWithFault(n, data.draw(st.integers(0, 10**6)), loss, delay, liar, often, kinds)
    network.run()
    live = [c for c in range(n) if c != liar and not network.is_excluded(c)]
    assert len(live) >= n - 2
    states = [s for c in live if (s := network.states[c]) is not None]
    for s in states:
        assert s.evidence.faulty <= {liar}
        assert all(liar in pair for pair in s.evidence.suspect_pairs)
    first, *others = (network.outcomes[c] for c in live)
    assert len(first) == ROUNDS
    for other in others:
        # The last round has not been confirmed yet.
        assert other[:-1] == first[:-1]
    for number, outcome in enumerate(first[:-1]):
        assert all(reported == make_payload(c, number) for c, reported in outcome.items() if c != liar)
        assert set(live) <= outcome.keys()


def test_two_faced_camera_is_detected_in_next_round() -> None:
    network = NetworkWithFault(5, 1, 0.0, 0, 2, 0.5, (DATA,))
    network.false = 1.0  # its payload, not its reports
    network.run()
    assert network.again == [1, 1, 0, 1, 1]
    # The previous round is repeated; one round for detection, two for the dispute, one for the rollback.
    assert network.now == ROUNDS + 1 + 5
    assert all(s is not None and s.evidence.faulty == {2} for c, s in enumerate(network.states) if c != 2)


def test_lossless_round_takes_one_step() -> None:
    network = LossyNetwork(4, 0, 0.0, 0, {})
    network.run()
    assert network.now == ROUNDS + 1  # the first payload is sent in the first step
    sent = HEADER.size + len(make_payload(0, 0))
    assert sent <= 20


def test_dead_camera_costs_one_timeout() -> None:
    network = LossyNetwork(4, 0, 0.0, 0, {2: 5})
    network.run()
    assert ROUNDS + DEFAULT_TIMEOUTS.inactive < network.now < ROUNDS + DEFAULT_TIMEOUTS.inactive + 10
    assert [sorted(outcome) for outcome in network.outcomes[0]] == [[0, 1, 2, 3]] * 5 + [[0, 1, 3]] * (ROUNDS - 5)


def receive(state: RoundState, sender: int, kind: int, content: bytes) -> RoundState:
    return step_round(state, [(sender, HEADER.pack(kind, sender, state.round, 0) + content)])[0]


def test_single_camera_cannot_exclude_others() -> None:
    """It announces that it excludes all others; these receive each other and continue."""
    states = [start_rounds(c, range(4), make_payload(c, 0))[0] for c in range(3)]
    liar = encode_cameras(frozenset({0, 1, 2})) + encode_cameras(frozenset())
    for _ in range(DEFAULT_TIMEOUTS.stalled - 1):
        states = [receive(s, 3, EXCLUSION, liar) for s in states]
        assert not any(s.excluding for s in states)
        states = [replace(s, inactive_ticks={}) for s in states]
    after = [step_round(s, [(c, HEADER.pack(0, c, 0, 0) + make_payload(c, 0)) for c in range(4)])[0] for s in states]
    assert all(s.outcome == {c: make_payload(c, 0) for c in range(4)} for s in after)


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "0 bytes are not a message"),
        (b"1234567", "7 bytes are not a message"),
        (HEADER.pack(0, 2, 0, 0), "the header is not this camera's"),
        (HEADER.pack(9, 1, 0, 0), "the header is not this camera's"),
        (HEADER.pack(1, 1, 0, 0) + b"x", "it lacks the leaving cameras"),
        (HEADER.pack(1, 1, 0, 0) + encode_cameras(frozenset({1})) + bytes(128), "it excludes itself"),
        (
            HEADER.pack(1, 1, 0, 0) + bytes(128) + encode_cameras(frozenset({2})) + b"\xff\xff",
            "the relayed data is truncated",
        ),
        (HEADER.pack(2, 1, 0, 0) + bytes(256) + b"x", "it contains more data than announced"),
    ],
)
def test_invalid_messages_are_rejected_with_reason(data: bytes, why: str) -> None:
    state, _ = start_rounds(0, range(3), b"own")
    after, packets = step_round(state, [(1, data)])
    assert after.refused == {1: why}
    assert after.received == {0: b"own"}
    assert packets == []
    # Messages of non-members are ignored.
    assert step_round(state, [(9, data)])[0].refused == {}


def test_camera_far_ahead_is_excluded() -> None:
    """Its messages are neither accepted nor rejected, and it is excluded in time, as it has excluded this camera."""
    state, _ = start_rounds(0, range(2), b"own")
    for _ in range(DEFAULT_TIMEOUTS.inactive + 1):
        state, _ = step_round(state, [(1, HEADER.pack(0, 1, 9, 0) + b"x")])
    assert state.refused == {}
    assert state.outcome == {0: b"own"}


@pytest.mark.parametrize("members", [[0, 1], [0, 1024, 2], [-1, 2]])
def test_invalid_camera_numbers_are_rejected(members: list[int]) -> None:
    with pytest.raises(ValueError, match="it must be a member, and numbers must be 0 to 1023"):
        start_rounds(2, members, b"")


def test_single_camera_ends_round_immediately() -> None:
    state, packets = start_rounds(3, [3], b"own")
    assert state.outcome == {3: b"own"}
    assert packets == []
    state, packets = begin_next_round(state, b"next")
    assert state.outcome == {3: b"next"}
    assert packets == []
