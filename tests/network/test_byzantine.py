"""Who tells listeners different things is found by what these tell each other; and nobody else has to go alone."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sylpose.network.byzantine import NOBODY_LIES, Blame, liars

TRUE = b"true"


@st.composite
def disputes(draw: st.DrawFn) -> tuple[int, dict[int, dict[int, bytes]], dict[int, frozenset[int]]]:
    """One camera tells each listener what it likes, and tells of the others what it likes."""
    n = draw(st.integers(4, 7))
    liar = draw(st.integers(0, n - 1))
    told = st.sampled_from([TRUE, b"a", b"b"])
    rows = {c: dict.fromkeys(range(n), TRUE) for c in range(n)}
    for c in range(n):
        rows[c][liar] = draw(told)
        rows[liar][c] = draw(told)
    same = all(rows[c] == rows[0] for c in range(n) if c != liar)
    everyone = frozenset(range(n))
    # Of an honest one's next word only those say that something is wrong who heard something else, or the liar.
    accused = {c: frozenset({liar} & everyone if same else everyone - {c}) for c in range(n) if c != liar}
    accused[liar] = draw(st.frozensets(st.sampled_from(sorted(everyone - {liar}))))
    return liar, rows, accused


@given(dispute=disputes())
def test_the_liar_goes_or_whom_it_accuses(
    dispute: tuple[int, dict[int, dict[int, bytes]], dict[int, frozenset[int]]],
) -> None:
    liar, rows, accused = dispute
    out, blame = liars(rows, accused)
    assert blame.alone <= {liar}
    assert all(liar in pair for pair in blame.pairs)
    assert 1 <= len(out) <= 2
    if liar not in out:  # it accuses the one that goes
        assert blame.pairs == {out | {liar}}
    # What is left has heard the same of those that are left.
    left = sorted(rows.keys() - out)
    assert all(len({rows[c][k] for c in left if c != k}) == 1 for k in left)
    # In whatever order it is told.
    assert liars(dict(sorted(rows.items(), reverse=True)), accused) == (out, blame)


def rows_of(n: int, **odd: bytes) -> dict[int, dict[int, bytes]]:
    """All heard the same, but for `c3_of_1`: what camera 3 heard of camera 1."""
    rows = {c: dict.fromkeys(range(n), TRUE) for c in range(n)}
    for name, data in odd.items():
        by, of = name[1:].split("_of_")
        rows[int(by)][int(of)] = data
    return rows


def test_one_against_one_is_undecided_until_there_is_another() -> None:
    nobody = dict.fromkeys(range(5), frozenset[int]())
    out, blame = liars(rows_of(5, c3_of_1=b"x"), nobody)
    assert out == {1}
    assert blame == Blame(frozenset(), frozenset({frozenset({1, 3})}))
    assert blame.bars(1, frozenset({0, 2, 3}))
    assert not blame.bars(1, frozenset({0, 1, 2}))
    assert blame.sentences() == {1: "it or camera 3 lies of what it told", 3: "it or camera 1 lies of what it told"}
    # The accuser accuses another one.
    rest = {c: row for c, row in rows_of(5, c3_of_4=b"x").items() if c != 1}
    out, blame = liars(rest, nobody, blame)
    assert out == {3}
    assert blame == Blame(frozenset({3}), frozenset())
    assert not blame.bars(1, frozenset({0, 2, 4}))
    assert blame.sentences() == {3: "it told others something else"}
    assert Blame(frozenset(), frozenset({frozenset({0, 1})})).sentences(["a", "b"]) == {
        0: "it or b lies of what it told",
        1: "it or a lies of what it told",
    }


@pytest.mark.parametrize(("accused", "out"), [({0: {2}, 1: {2}}, {2}), ({0: {2}}, {2}), ({}, set()), ({2: {2}}, set())])
def test_who_heard_the_same_and_says_otherwise(accused: dict[int, set[int]], out: set[int]) -> None:
    said = {c: frozenset(accused.get(c, ())) for c in range(4)}
    assert liars(rows_of(4), said)[0] == out


def test_of_three_the_one_who_told_is_believed_less() -> None:
    """Two listeners cannot tell which of the three lies."""
    assert liars(rows_of(3, c2_of_0=b"x"), dict.fromkeys(range(3), frozenset[int]()))[0] == {0}
    assert liars(rows_of(2), {0: frozenset({1}), 1: frozenset({0})}, NOBODY_LIES)[0] == {0, 1}
