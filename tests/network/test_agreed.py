"""Rounds end alike at all cameras that listen to each other, whatever is lost, late or dead."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sylpose.network.agreed import PATIENCE, Agreeing, agree_next, agree_start, agree_step
from sylpose.network.words import GIVES_UP, HEADER, bits_of
from sylpose.paper.distributed.messages import Packet

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
        s, packets = agree_start(c, range(self.n), word(c, 0)) if state is None else agree_step(state, inbox)
        self.send(c, packets)
        while s.outcome is not None and len(self.outcomes[c]) < ROUNDS:
            self.outcomes[c].append(dict(s.outcome))
            if len(self.outcomes[c]) < ROUNDS:
                s, packets = agree_next(s, word(c, s.round + 1))
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
        (HEADER.pack(7, 1, 0, 0), "the header is not this camera's"),
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
