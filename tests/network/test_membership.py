"""Who is there: groups are founded, joined and left; nobody from outside can stop one."""

from __future__ import annotations

from dataclasses import replace

import pytest

from sylpose.network.membership import Enter, Entered, Heard, Present, Tell, answer, asked, present_step
from sylpose.network.rounds import PATIENCE, agree_next, agree_start
from sylpose.network.wire_format import (
    FAR,
    HEADER,
    HELLO,
    WELCOME,
    WORKS,
    Hello,
    Welcome,
    bits_of,
    entered,
    kind_of,
    read_welcome,
    said_hello,
    welcomed,
)


def alone(camera: int = 0, cameras: int = 3, wait: int = 5) -> Present:
    return asked(Present(camera, cameras, wait=wait), Enter(), 0)[0]


def stepped(p: Present, ticks: int, inbox: list[tuple[int, bytes]]) -> Present:
    for _ in range(ticks):
        p, _ = present_step(p, inbox)
    return p


def test_the_first_of_those_that_wait_founds_a_group() -> None:
    hello = [(1, said_hello(1, 0, Hello(0, 0)))]
    assert answer(stepped(alone(), 4, hello))[1] is None  # not all are there yet
    assert answer(stepped(alone(), 5, hello))[1] == Entered(None, frozenset({1}))
    # All are: nobody has to wait.
    both = [*hello, (2, said_hello(2, 0, Hello(0, 0)))]
    assert answer(stepped(alone(), 1, both))[1] == Entered(None, frozenset({1, 2}))
    # Another one goes before; or has tracked more.
    assert answer(stepped(alone(2), 9, hello))[1] is None
    assert answer(stepped(alone(), 9, [(1, said_hello(1, 0, Hello(0, 7)))]))[1] is None


def test_who_is_not_taken_in_goes_on_apart_for_a_while() -> None:
    """One of the members may not hear it."""
    group = [(1, said_hello(1, 3, Hello(2, 50)))]
    p = stepped(alone(), 20, group)
    assert answer(p)[1] is None
    p, entered = answer(stepped(p, PATIENCE.long, group))
    assert entered == Entered(None, frozenset())
    p, _ = asked(p, Tell(b"x"), 1)
    p, heard = answer(p)
    assert isinstance(heard, Heard)
    assert not heard.outdone
    p = stepped(asked(p, Tell(b"x"), 1)[0], PATIENCE.long, group)
    heard = answer(p)[1]
    assert isinstance(heard, Heard)
    assert heard.outdone


@pytest.mark.parametrize(
    ("mine", "others", "outdone"),
    [
        (9, Hello(2, 50), True),  # the larger one goes on,
        (9, Hello(2, 0), False),  # unless nobody in it knows the object,
        (0, Hello(1, 3), True),
        (0, Hello(2, 0), True),  # or in none of them does anybody.
        (9, Hello(1, 50), False),  # Of two alike it is the one with the first camera.
    ],
)
def test_who_knows_the_object_counts_for_more_than_who_are_many(mine: int, others: Hello, outdone: bool) -> None:
    p, _ = answer(stepped(alone(wait=0), 1, []))
    p, _ = asked(p, Tell(b"x"), mine)
    heard = answer(stepped(p, 1, [(1, said_hello(1, 3, others))]))[1]
    assert isinstance(heard, Heard)
    assert heard.outdone == outdone


def test_a_node_that_was_welcomed_says_that_it_is_at_work() -> None:
    """Until it has learnt what it was told: else it would be given up as silent."""
    welcome = welcomed(1, Welcome(17, 5, frozenset({0, 1, 2}), b"all"))
    p, found = answer(stepped(alone(), 1, [(1, welcome)]))
    assert found == Entered(b"all", frozenset())
    _, packets = present_step(p, [])
    assert [(packet.to, kind_of(packet.data)) for packet in packets] == [((1, 2), WORKS)]
    agreeing = asked(p, Tell(b"x"), 3)[0].agreeing
    assert agreeing is not None
    assert (agreeing.round, agreeing.epoch, agreeing.members) == (17, entered(5, b"all"), (0, 1, 2))


@pytest.mark.parametrize(
    "welcome",
    [
        Welcome(1, 2, frozenset({0, 1, 900}), b""),  # of a camera that the rig has not
        Welcome(1, 2, frozenset({0, 2}), b""),  # of who is none of them
        Welcome(1, 2, frozenset({1, 2}), b""),  # somebody else's
        Welcome(FAR, 2, frozenset({0, 1}), b""),
    ],
)
def test_welcomes_that_cannot_be_are_none(welcome: Welcome) -> None:
    assert read_welcome(0, 3, 1, welcomed(1, welcome)) is None
    assert read_welcome(0, 3, 1, welcomed(1, welcome)[:40]) is None


def test_hellos_that_cannot_be_are_refused() -> None:
    p = stepped(alone(), 1, [(1, said_hello(1, 0, Hello(65535, 0))), (2, HEADER.pack(HELLO, 1, 0, 0) + bytes(6))])
    assert set(p.refused) == {1, 2}
    assert not p.outside


def test_parts_of_a_group_that_fell_apart_make_different_epochs() -> None:
    epochs = set()
    for members in ([0, 1], [2, 3]):
        state, _ = agree_start(members[0], members, b"", epoch=9)
        state = replace(state, outcome=dict.fromkeys(members, b""))
        epochs.add(agree_next(state, b"", frozenset({4}))[0].epoch)
    assert len(epochs) == 2
    assert kind_of(HEADER.pack(WELCOME, 1023, FAR - 1, 7) + bits_of(frozenset())) == WELCOME
