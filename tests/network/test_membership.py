"""Membership: groups are founded, joined and left; no outside node can block one."""

from __future__ import annotations

from dataclasses import replace

import pytest

from sylpose.network.membership import (
    ExchangeRequest,
    ExchangeResult,
    JoinRequest,
    JoinResult,
    Membership,
    step_membership,
    submit_request,
    take_response,
)
from sylpose.network.rounds import DEFAULT_TIMEOUTS, begin_next_round, start_rounds
from sylpose.network.wire_format import (
    HEADER,
    HEARTBEAT,
    HELLO,
    MAX_ROUND,
    WELCOME,
    Hello,
    Welcome,
    compute_join_epoch,
    decode_welcome,
    encode_cameras,
    encode_hello,
    encode_welcome,
    message_kind,
)


def waiting_node(camera: int = 0, cameras: int = 3, wait: int = 5) -> Membership:
    return submit_request(Membership(camera, cameras, wait=wait), JoinRequest(), 0)[0]


def run_steps(p: Membership, ticks: int, inbox: list[tuple[int, bytes]]) -> Membership:
    for _ in range(ticks):
        p, _ = step_membership(p, inbox)
    return p


def test_first_waiting_node_founds_group() -> None:
    hello = [(1, encode_hello(1, 0, Hello(0, 0)))]
    assert take_response(run_steps(waiting_node(), 4, hello))[1] is None  # not all are present yet
    assert take_response(run_steps(waiting_node(), 5, hello))[1] == JoinResult(None, frozenset({1}))
    # All are present: no waiting time.
    both = [*hello, (2, encode_hello(2, 0, Hello(0, 0)))]
    assert take_response(run_steps(waiting_node(), 1, both))[1] == JoinResult(None, frozenset({1, 2}))
    # Another one has the lower number, or has tracked more.
    assert take_response(run_steps(waiting_node(2), 9, hello))[1] is None
    assert take_response(run_steps(waiting_node(), 9, [(1, encode_hello(1, 0, Hello(0, 7)))]))[1] is None


def test_rejected_node_forms_separate_group() -> None:
    """One of the members may not receive its messages."""
    group = [(1, encode_hello(1, 3, Hello(2, 50)))]
    p = run_steps(waiting_node(), 20, group)
    assert take_response(p)[1] is None
    p, entered = take_response(run_steps(p, DEFAULT_TIMEOUTS.stalled, group))
    assert entered == JoinResult(None, frozenset())
    p, _ = submit_request(p, ExchangeRequest(b"x"), 1)
    p, received = take_response(p)
    assert isinstance(received, ExchangeResult)
    assert not received.is_outranked
    p = run_steps(submit_request(p, ExchangeRequest(b"x"), 1)[0], DEFAULT_TIMEOUTS.stalled, group)
    received = take_response(p)[1]
    assert isinstance(received, ExchangeResult)
    assert received.is_outranked


@pytest.mark.parametrize(
    ("mine", "others", "outdone"),
    [
        (9, Hello(2, 50), True),  # the larger group continues,
        (9, Hello(2, 0), False),  # unless none of its members knows the object,
        (0, Hello(1, 3), True),
        (0, Hello(2, 0), True),  # also if no member of either knows it.
        (9, Hello(1, 50), False),  # Of equal groups, the one with the lowest camera number.
    ],
)
def test_knowing_object_outranks_group_size(mine: int, others: Hello, outdone: bool) -> None:
    p, _ = take_response(run_steps(waiting_node(wait=0), 1, []))
    p, _ = submit_request(p, ExchangeRequest(b"x"), mine)
    received = take_response(run_steps(p, 1, [(1, encode_hello(1, 3, others))]))[1]
    assert isinstance(received, ExchangeResult)
    assert received.is_outranked == outdone


def test_joining_node_sends_heartbeats() -> None:
    """It sends heartbeats until it has restored the shared state; otherwise it would be excluded as inactive."""
    welcome = encode_welcome(1, Welcome(17, 5, frozenset({0, 1, 2}), b"all"))
    p, found = take_response(run_steps(waiting_node(), 1, [(1, welcome)]))
    assert found == JoinResult(b"all", frozenset())
    _, packets = step_membership(p, [])
    assert [(packet.to, message_kind(packet.data)) for packet in packets] == [((1, 2), HEARTBEAT)]
    agreeing = submit_request(p, ExchangeRequest(b"x"), 3)[0].round_state
    assert agreeing is not None
    assert (agreeing.round, agreeing.epoch, agreeing.members) == (17, compute_join_epoch(5, b"all"), (0, 1, 2))


@pytest.mark.parametrize(
    "welcome",
    [
        Welcome(1, 2, frozenset({0, 1, 900}), b""),  # with a camera outside the rig
        Welcome(1, 2, frozenset({0, 2}), b""),  # from a sender that is not a member
        Welcome(1, 2, frozenset({1, 2}), b""),  # for another newcomer
        Welcome(MAX_ROUND, 2, frozenset({0, 1}), b""),
    ],
)
def test_invalid_welcomes_are_ignored(welcome: Welcome) -> None:
    assert decode_welcome(0, 3, 1, encode_welcome(1, welcome)) is None
    assert decode_welcome(0, 3, 1, encode_welcome(1, welcome)[:40]) is None


def test_invalid_hellos_are_rejected() -> None:
    p = run_steps(
        waiting_node(), 1, [(1, encode_hello(1, 0, Hello(65535, 0))), (2, HEADER.pack(HELLO, 1, 0, 0) + bytes(6))]
    )
    assert set(p.refused) == {1, 2}
    assert not p.outside


def test_partitioned_groups_have_different_epochs() -> None:
    epochs = set()
    for members in ([0, 1], [2, 3]):
        state, _ = start_rounds(members[0], members, b"", epoch=9)
        state = replace(state, outcome=dict.fromkeys(members, b""))
        epochs.add(begin_next_round(state, b"", frozenset({4}))[0].epoch)
    assert len(epochs) == 2
    assert message_kind(HEADER.pack(WELCOME, 1023, MAX_ROUND - 1, 7) + encode_cameras(frozenset())) == WELCOME
