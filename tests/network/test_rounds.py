"""Rounds end alike at all cameras that listen to each other, whatever is lost, late or dead."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sylpose.network.rounds import PATIENCE, Agreeing, agree_next, agree_start, agree_step
from sylpose.network.wire_format import DISPUTES, GIVES_UP, HEADER, RELAYS, TELLS, bits_of, kind_of
from sylpose.sylvester.distributed.messages import Packet

ROUNDS = 12


def word(camera: int, number: int) -> bytes:
    return f"{camera} in {number}".encode()


class Network:
    """Cameras that tell each other `ROUNDS` words, over links that lose and delay what is sent."""

    def __init__(self, n: int, seed: int, loss: float, delay: int, dies: Mapping[int, int]) -> None:
        self.n, self.loss, self.delay, self.dies = n, loss, delay, dies
        self.rng, self.now = np.random.default_rng(seed), 0
        self.under_way: dict[int, list[tuple[int, int, bytes]]] = {}
        self.states: list[Agreeing | None] = [None] * n
        self.outcomes: list[list[dict[int, bytes]]] = [[] for _ in range(n)]
        self.again = [0] * n

    def run(self, most: int = 5000) -> None:
        while self.now < most and not all(self.through(c) for c in range(self.n)):
            inboxes: list[list[tuple[int, bytes]]] = [[] for _ in range(self.n)]
            for to, sender, data in self.under_way.pop(self.now, []):
                inboxes[to].append((sender, data))
            for c in range(self.n):
                if self.now < self.dies.get(c, most):
                    self.step(c, inboxes[c])
            self.now += 1

    def through(self, c: int) -> bool:
        return c in self.dies or len(self.outcomes[c]) == ROUNDS

    def step(self, c: int, inbox: list[tuple[int, bytes]]) -> None:
        state = self.states[c]
        if state is not None and state.outcast and state.outcome is not None:
            return
        s, packets = agree_start(c, range(self.n), word(c, 0)) if state is None else agree_step(state, inbox)
        self.send(c, packets)
        while s.outcome is not None and len(self.outcomes[c]) < ROUNDS and not s.outcast:
            if s.again:
                # The last word of each counts for nothing: it is told once more.
                self.again[c] += 1
                self.outcomes[c] = self.outcomes[c][:-1]
            else:
                self.outcomes[c].append(dict(s.outcome))
            if len(self.outcomes[c]) < ROUNDS:
                s, packets = agree_next(s, word(c, len(self.outcomes[c])))
                self.send(c, packets)
        self.states[c] = s

    def send(self, c: int, packets: list[Packet]) -> None:
        for packet in packets:
            for to in packet.to:
                if self.rng.random() >= self.loss:
                    arrives = self.now + 1 + int(self.rng.integers(self.delay + 1))
                    self.under_way.setdefault(arrives, []).append((to, c, packet.data))


@st.composite
def networks(draw: st.DrawFn) -> Network:
    n = draw(st.integers(1, 7))
    dying = draw(st.lists(st.integers(0, n - 1), max_size=n - 1, unique=True))
    dies = {c: draw(st.integers(0, 60)) for c in dying}
    loss, delay = draw(st.sampled_from([0.0, 0.1, 0.3])), draw(st.integers(0, 3))
    return Network(n, draw(st.integers(0, 10**6)), loss, delay, dies)


@settings(max_examples=150)
@given(network=networks())
def test_all_that_live_hear_the_same(network: Network) -> None:
    network.run()
    live = [c for c in range(network.n) if c not in network.dies]
    first, *others = (network.outcomes[c] for c in live)
    assert len(first) == ROUNDS
    for other in others:
        assert other == first
    for number, outcome in enumerate(first):
        # Nothing is invented, and nobody that lives is left out.
        assert all(data == word(c, number) for c, data in outcome.items())
        assert set(live) <= outcome.keys()
    # Who has left stays away.
    for before, after in pairwise(first):
        assert after.keys() <= before.keys()


class WithLiar(Network):
    """One of them tells some listeners something else, or that it has heard something else, now and then."""

    def __init__(
        self, n: int, seed: int, loss: float, delay: int, liar: int, often: float, kinds: tuple[int, ...]
    ) -> None:
        super().__init__(n, seed, loss, delay, {})
        self.liar, self.often, self.kinds = liar, often, kinds
        self.false = 0.5

    def through(self, c: int) -> bool:
        return c == self.liar or self.outcast(c) or super().through(c)

    def outcast(self, c: int) -> bool:
        state = self.states[c]
        return state is not None and state.outcast

    def send(self, c: int, packets: list[Packet]) -> None:
        for packet in packets:
            for to in packet.to:
                data = packet.data
                if c == self.liar and kind_of(data) in self.kinds and self.rng.random() < self.often:
                    at = -1 if self.rng.random() < self.false else HEADER.size - 1
                    data = data[:at] + bytes([data[at] ^ 1]) + data[at:][1:]
                super().send(c, [Packet((to,), data)])


@settings(max_examples=150)
@given(data=st.data())
def test_a_liar_is_put_out_and_the_others_hear_the_same(data: st.DataObject) -> None:
    n = data.draw(st.integers(4, 7))
    liar, often = data.draw(st.integers(0, n - 1)), data.draw(st.sampled_from([0.02, 0.2, 1.0]))
    kinds = data.draw(st.sampled_from([(TELLS,), (TELLS, DISPUTES), (TELLS, DISPUTES, RELAYS)]))
    loss, delay = data.draw(st.sampled_from([(0.0, 0), (0.1, 1), (0.2, 3)]))
    network = WithLiar(n, data.draw(st.integers(0, 10**6)), loss, delay, liar, often, kinds)
    network.run()
    live = [c for c in range(n) if c != liar and not network.outcast(c)]
    assert len(live) >= n - 2
    states = [s for c in live if (s := network.states[c]) is not None]
    for s in states:
        assert s.blame.alone <= {liar}
        assert all(liar in pair for pair in s.blame.pairs)
    first, *others = (network.outcomes[c] for c in live)
    assert len(first) == ROUNDS
    for other in others:
        # Of the last round nobody has told yet that all have heard the same.
        assert other[:-1] == first[:-1]
    for number, outcome in enumerate(first[:-1]):
        assert all(told == word(c, number) for c, told in outcome.items() if c != liar)
        assert set(live) <= outcome.keys()


def test_two_faced_from_the_start_is_noticed_in_the_next_round() -> None:
    network = WithLiar(5, 1, 0.0, 0, 2, 0.5, (TELLS,))
    network.false = 1.0  # what it tells, and not what it has heard
    network.run()
    assert network.again == [1, 1, 0, 1, 1]
    # The round before is told again; that in which it is found out, two of the dispute and one to go back.
    assert network.now == ROUNDS + 1 + 5
    assert all(s is not None and s.blame.alone == {2} for c, s in enumerate(network.states) if c != 2)


def test_without_losses_a_round_is_a_step() -> None:
    network = Network(4, 0, 0.0, 0, {})
    network.run()
    assert network.now == ROUNDS + 1  # the first word is told in the first step
    sent = HEADER.size + len(word(0, 0))
    assert sent <= 20


def test_a_dead_camera_costs_one_wait() -> None:
    network = Network(4, 0, 0.0, 0, {2: 5})
    network.run()
    assert ROUNDS + PATIENCE.silent < network.now < ROUNDS + PATIENCE.silent + 10
    assert [sorted(outcome) for outcome in network.outcomes[0]] == [[0, 1, 2, 3]] * 5 + [[0, 1, 3]] * (ROUNDS - 5)


def told(state: Agreeing, sender: int, kind: int, content: bytes) -> Agreeing:
    return agree_step(state, [(sender, HEADER.pack(kind, sender, state.round, 0) + content)])[0]


def test_one_camera_alone_excludes_nobody() -> None:
    """It says that it gives up all others: the others hear each other and go on."""
    states = [agree_start(c, range(4), word(c, 0))[0] for c in range(3)]
    liar = bits_of(frozenset({0, 1, 2})) + bits_of(frozenset())
    for _ in range(PATIENCE.long - 1):
        states = [told(s, 3, GIVES_UP, liar) for s in states]
        assert not any(s.giving_up for s in states)
        states = [replace(s, silent={}) for s in states]
    after = [agree_step(s, [(c, HEADER.pack(0, c, 0, 0) + word(c, 0)) for c in range(4)])[0] for s in states]
    assert all(s.outcome == {c: word(c, 0) for c in range(4)} for s in after)


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "0 bytes are no message"),
        (b"1234567", "7 bytes are no message"),
        (HEADER.pack(0, 2, 0, 0), "the header is not this camera's"),
        (HEADER.pack(9, 1, 0, 0), "the header is not this camera's"),
        (HEADER.pack(1, 1, 0, 0) + b"x", "it does not say who leaves"),
        (HEADER.pack(1, 1, 0, 0) + bits_of(frozenset({1})) + bytes(128), "it gives itself up"),
        (HEADER.pack(1, 1, 0, 0) + bytes(128) + bits_of(frozenset({2})) + b"\xff\xff", "what it passes on is cut off"),
        (HEADER.pack(2, 1, 0, 0) + bytes(256) + b"x", "it passes on more than it announced"),
    ],
)
def test_nonsense_is_refused_and_named(data: bytes, why: str) -> None:
    state, _ = agree_start(0, range(3), b"own")
    after, packets = agree_step(state, [(1, data)])
    assert after.refused == {1: why}
    assert after.heard == {0: b"own"}
    assert packets == []
    # Who does not take part is not heard at all.
    assert agree_step(state, [(9, data)])[0].refused == {}


def test_who_is_far_ahead_has_gone_on_without_this_camera() -> None:
    """That is no word: it does not count as heard, nor is it refused, and it is given up in time, as it gave up this one."""
    state, _ = agree_start(0, range(2), b"own")
    for _ in range(PATIENCE.silent + 1):
        state, _ = agree_step(state, [(1, HEADER.pack(0, 1, 9, 0) + b"x")])
    assert state.refused == {}
    assert state.outcome == {0: b"own"}


@pytest.mark.parametrize("members", [[0, 1], [0, 1024, 2], [-1, 2]])
def test_cameras_that_cannot_be_are_refused(members: list[int]) -> None:
    with pytest.raises(ValueError, match="expected one of some of 0 to 1023"):
        agree_start(2, members, b"")


def test_a_camera_alone_is_through_at_once() -> None:
    state, packets = agree_start(3, [3], b"own")
    assert state.outcome == {3: b"own"}
    assert packets == []
    state, packets = agree_next(state, b"next")
    assert state.outcome == {3: b"next"}
    assert packets == []
