"""Simulated network: loss, delay, failing, late and separated nodes, and reproducibility."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import pytest

from sylpose.packets import NO_FAULTS, Inbox, NetworkFaults, Packet, run_network


class Counter(NamedTuple):
    """Node that sends 10 bytes to all others in each round, and stores the senders of what it receives."""

    camera: int
    steps: int
    senders: tuple[tuple[int, ...], ...]
    done: bool


def packets_to_others(c: int) -> list[Packet]:
    return [Packet(tuple(k for k in range(3) if k != c), bytes([c] * 10))]


def start(c: int) -> tuple[Counter, list[Packet]]:
    return Counter(c, 0, (), False), packets_to_others(c)


def step(state: Counter, inbox: Inbox) -> tuple[Counter, list[Packet]]:
    assert all(data == bytes([sender] * 10) for sender, data in inbox)
    senders = (*state.senders, tuple(sender for sender, _ in inbox))
    return Counter(state.camera, state.steps + 1, senders, state.steps == 39), packets_to_others(state.camera)


STARTS = [partial(start, c) for c in range(3)]


def test_without_faults_packets_arrive_in_the_next_round() -> None:
    run = run_network(STARTS, step, NO_FAULTS, 100)
    assert run.rounds == 40
    assert run.is_alive == [True] * 3
    for c, state in enumerate(run.states):
        assert state is not None
        assert state.senders == (tuple(k for k in range(3) if k != c),) * 40
    assert (run.sent == 41 * 10).all()  # once for both receivers
    assert (run.received == 40 * 20).all()


def test_packets_are_received_or_lost() -> None:
    runs = [run_network(STARTS, step, NetworkFaults(loss=0.25, seed=seed), 100) for seed in (7, 7, 8)]
    assert runs[0].received.sum() / (2 * runs[0].sent.sum()) == pytest.approx(0.75, abs=0.1)
    assert runs[0].states == runs[1].states != runs[2].states


def test_delayed_packets_arrive_later() -> None:
    run = run_network(STARTS, step, NetworkFaults(delay=3), 100)
    for state in run.states:
        assert state is not None
        assert {len(senders) for senders in state.senders} > {2}
        assert sum(map(len, state.senders)) == pytest.approx(2 * 40, abs=2 * 3)


def test_nodes_that_are_down_late_or_separated_receive_nothing() -> None:
    run = run_network(STARTS, step, NetworkFaults(dies={0: 5}, joins={1: 8}), 100)
    assert run.is_alive == [False, True, True]
    dead, late, other = run.states
    assert dead is not None
    assert dead.steps == 4
    assert late is not None
    assert other is not None
    assert other.senders[:10] == ((0,),) * 5 + ((),) * 3 + ((1,),) * 2
    assert run.rounds == 48
    run = run_network(STARTS, step, NetworkFaults(partition=(0, 10, frozenset({2}))), 100)
    assert run.states[2] is not None
    assert run.states[2].senders[:11] == ((),) * 10 + ((0, 1),)


def test_restarted_node_starts_anew() -> None:
    run = run_network(STARTS, step, NetworkFaults(dies={0: 5}, returns={0: 20}), 100)
    assert run.is_alive == [True] * 3
    assert run.states[0] is not None
    assert run.states[0].steps == 40
    assert run.rounds == 60


def test_rounds_are_bounded() -> None:
    assert run_network(STARTS, step, NO_FAULTS, 9).rounds == 9


def test_modified_packets_are_counted_per_receiver() -> None:
    def modify(data: bytes, to: int) -> bytes:
        return data + bytes(to)

    def count(state: Counter, inbox: Inbox) -> tuple[Counter, list[Packet]]:
        assert [len(data) for sender, data in inbox if sender == 1] in ([], [10 + state.camera])
        return state._replace(steps=state.steps + 1, done=state.steps == 4), packets_to_others(state.camera)

    run = run_network(STARTS, count, NO_FAULTS, 100, {1: modify})
    assert run.sent.tolist() == [60, 6 * (10 + 12), 60]


def test_invalid_network_faults_raise() -> None:
    with pytest.raises(ValueError, match=r"loss must be in \[0, 1\)"):
        NetworkFaults(loss=1.0)
    with pytest.raises(ValueError, match="delay: -1 is not a whole number"):
        NetworkFaults(delay=-1)
    with pytest.raises(ValueError, match=r"cameras \[2\]: the restart in `returns` must be after the failure"):
        NetworkFaults(dies={2: 5}, returns={2: 5})
    assert NetworkFaults(dies={1: 2}, joins={3: 4}, partition=(0, 1, frozenset({5}))).cameras == {1, 3, 5}
