"""A camera that sends different messages is identified from the receivers' reports; no other is excluded alone."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sylpose.network.byzantine import NO_EVIDENCE, FaultEvidence, find_faulty_cameras

TRUE = b"true"


@st.composite
def disputes(draw: st.DrawFn) -> tuple[int, dict[int, dict[int, bytes]], dict[int, frozenset[int]]]:
    """One camera sends any message to each receiver, and reports anything about the others."""
    n = draw(st.integers(4, 7))
    liar = draw(st.integers(0, n - 1))
    reported = st.sampled_from([TRUE, b"a", b"b"])
    rows = {c: dict.fromkeys(range(n), TRUE) for c in range(n)}
    for c in range(n):
        rows[c][liar] = draw(reported)
        rows[liar][c] = draw(reported)
    correct = [c for c in range(n) if c != liar]
    same = all(rows[c] == rows[correct[0]] for c in correct)
    everyone = frozenset(range(n))
    # Only the faulty camera, or receivers of another message, accuse a correct camera's next message.
    accused = {c: frozenset({liar} & everyone if same else everyone - {c}) for c in range(n) if c != liar}
    accused[liar] = draw(st.frozensets(st.sampled_from(sorted(everyone - {liar}))))
    return liar, rows, accused


@given(dispute=disputes())
def test_faulty_camera_or_accused_is_excluded(
    dispute: tuple[int, dict[int, dict[int, bytes]], dict[int, frozenset[int]]],
) -> None:
    liar, rows, accused = dispute
    out, blame = find_faulty_cameras(rows, accused)
    assert blame.faulty <= {liar}
    assert all(liar in pair for pair in blame.suspect_pairs)
    assert 1 <= len(out) <= 2
    if liar not in out:  # it accuses the excluded one
        assert blame.suspect_pairs == {out | {liar}}
    # The remaining cameras received the same from each other.
    left = sorted(rows.keys() - out)
    assert all(len({rows[c][k] for c in left if c != k}) == 1 for k in left)
    # The order of the reports does not matter.
    assert find_faulty_cameras(dict(sorted(rows.items(), reverse=True)), accused) == (out, blame)


def rows_of(n: int, **odd: bytes) -> dict[int, dict[int, bytes]]:
    """Reports in which all received the same, except `c3_of_1`: what camera 3 received from camera 1."""
    rows = {c: dict.fromkeys(range(n), TRUE) for c in range(n)}
    for name, data in odd.items():
        by, of = name[1:].split("_of_")
        rows[int(by)][int(of)] = data
    return rows


def test_single_accusation_is_undecided_until_second() -> None:
    nobody = dict.fromkeys(range(5), frozenset[int]())
    out, blame = find_faulty_cameras(rows_of(5, c3_of_1=b"x"), nobody)
    assert out == {1}
    assert blame == FaultEvidence(frozenset(), frozenset({frozenset({1, 3})}))
    assert blame.excludes(1, frozenset({0, 2, 3}))
    assert not blame.excludes(1, frozenset({0, 1, 2}))
    assert blame.describe() == {1: "it or camera 3 reports false messages", 3: "it or camera 1 reports false messages"}
    # The accuser accuses another camera.
    rest = {c: row for c, row in rows_of(5, c3_of_4=b"x").items() if c != 1}
    out, blame = find_faulty_cameras(rest, nobody, blame)
    assert out == {3}
    assert blame == FaultEvidence(frozenset({3}), frozenset())
    assert not blame.excludes(1, frozenset({0, 2, 4}))
    assert blame.describe() == {3: "it sent different messages to different cameras"}
    assert FaultEvidence(frozenset(), frozenset({frozenset({0, 1})})).describe(["a", "b"]) == {
        0: "it or b reports false messages",
        1: "it or a reports false messages",
    }


@pytest.mark.parametrize(("accused", "out"), [({0: {2}, 1: {2}}, {2}), ({0: {2}}, {2}), ({}, set()), ({2: {2}}, set())])
def test_false_accusations(accused: dict[int, set[int]], out: set[int]) -> None:
    message = {c: frozenset(accused.get(c, ())) for c in range(4)}
    assert find_faulty_cameras(rows_of(4), message)[0] == out


def test_with_three_cameras_sender_is_excluded() -> None:
    """Two receivers cannot determine which of the three is faulty."""
    assert find_faulty_cameras(rows_of(3, c2_of_0=b"x"), dict.fromkeys(range(3), frozenset[int]()))[0] == {0}
    assert find_faulty_cameras(rows_of(2), {0: frozenset({1}), 1: frozenset({0})}, NO_EVIDENCE)[0] == {0, 1}
