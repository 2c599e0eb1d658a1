"""Step functions of the distributed estimators: messages, evidence, the ADMM equation, rejected input."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import pack_upper
from sylpose.moments import PairMoments
from sylpose.sylvester.centralized import solve_centralized
from sylpose.sylvester.distributed.evidence import compute_evidence, pack_evidence, unpack_evidence
from sylpose.sylvester.distributed.evidence_exchange import EVIDENCE_MESSAGE
from sylpose.sylvester.distributed.exchange import start_exchange, step_exchange
from sylpose.sylvester.distributed.gossip import start_gossip, step_gossip
from sylpose.sylvester.distributed.lockstep import MAX_MISSED_ROUNDS
from sylpose.sylvester.distributed.messages import Message, decode, decode_inbox, encode, select_newest
from sylpose.sylvester.distributed.refine import PENALTY, RELAXATION, RefineState, start_refine, step_refine
from sylpose.sylvester.equation import solve_generalized_sylvester
from sylpose.sylvester.one_camera import solve_one_camera
from sylpose.sylvester.orthographic import build_cost, compute_views
from sylpose.sylvester.so3 import QuadraticCost
from tests.scenes import compute_angle
from tests.sylvester.test_centralized import noisy_problem, pair_moments, quick, seeds


def problem(seed: int, n: int = 4) -> tuple[FloatArray, list[PairMoments]]:
    cameras, matches, _ = noisy_problem(seed, n)
    return cameras, pair_moments(matches)


# --- Messages ---------------------------------------------------------------------------------------------------------


@given(st.integers(0, 65535), st.integers(0, 2**32 - 1), st.booleans(), st.booleans(), seeds)
@quick
def test_messages_round_trip(sender: int, number: int, clean: bool, final: bool, seed: int) -> None:
    message = Message(number, clean, final, np.random.default_rng(seed).normal(size=9))
    out = decode(encode(sender, message), sender, (9, 18))
    assert out[:3] == message[:3]
    np.testing.assert_array_equal(out.values, message.values)


def test_message_size() -> None:
    cameras, moments = problem(0)
    pairs = [(0, 1), (1, 2), (2, 3)]
    refine = start_refine(0, range(4), cameras[0], moments[0])[1]
    assert [(p.to, len(p.data)) for p in refine] == [((1, 2, 3), 8 + 72)]
    exchange = start_exchange(1, cameras, moments[1])[1]
    assert [(p.to, len(p.data)) for p in exchange] == [((0, 2, 3), 8 + 360)]
    gossip = start_gossip(1, 4, pairs, cameras[1], moments[1])[1]
    assert [(p.to, len(p.data)) for p in gossip] == [((0,), 8 + 448), ((2,), 8 + 448)]


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "0 bytes are too short for a message"),
        (encode(3, Message(0, True, True, np.ones(9)))[:-5], "75 bytes instead of 80 or 152"),
        (encode(3, Message(0, True, True, np.ones(9))) + b"more", "84 bytes instead of 80 or 152"),
        (encode(3, Message(0, True, True, np.ones(10))), "88 bytes instead of 80 or 152"),
        (encode(4, Message(0, True, True, np.ones(9))), "header is not that of this camera"),
        (encode(3, Message(0, True, True, np.full(9, np.nan))), "not finite, or beyond"),
        (encode(3, Message(0, True, True, np.full(9, -np.inf))), "not finite, or beyond"),
        (encode(3, Message(0, True, True, np.full(9, 1e200))), "not finite, or beyond"),
    ],
)
def test_malformed_message_is_rejected_with_reason(data: bytes, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        decode(data, 3, (9, 18))
    good = encode(2, Message(7, True, True, np.ones(9)))
    news, refused = decode_inbox([(3, data), (2, good)], (9, 18), {})
    assert list(news) == [(2, 7)]
    assert list(refused) == [3]
    assert refused[3]


def test_only_the_newest_message_is_used() -> None:
    inbox = [(1, encode(1, Message(k, True, False, np.full(9, k)))) for k in (4, 6, 5)]
    messages, _ = decode_inbox(inbox, (9,), {})
    assert select_newest(messages, {})[1].round == 6
    assert select_newest(messages, {1: 5})[1].round == 6
    assert select_newest(messages, {1: 6}) == {}


# --- Evidence ---------------------------------------------------------------------------------------------------------


@given(seeds, st.integers(1, 6), st.booleans())
@quick
def test_sum_of_evidence_is_the_centralized_cost(seed: int, n: int, aim: bool) -> None:
    cameras, moments = problem(seed, max(n, 3))
    q = build_cost(compute_views(cameras[:n], moments[:n], aim=aim))
    parts = [compute_evidence(c, m, aim=aim) for c, m in zip(cameras[:n], moments[:n], strict=True)]
    total = sum(parts, start=QuadraticCost.zero())
    for name in ("H", "h", "constant", "weight"):
        np.testing.assert_allclose(getattr(total, name), getattr(q, name), rtol=1e-12, atol=1e-12 * float(q.scale))
    for name in ("H", "h", "constant", "weight"):
        np.testing.assert_array_equal(getattr(unpack_evidence(pack_evidence(q)), name), getattr(q, name))


def test_camera_without_spread_has_zero_evidence() -> None:
    eye = np.eye(3)
    for moments in (PairMoments.zero(), PairMoments.from_matches(np.ones((5, 2)), np.ones((5, 2)))):
        e = compute_evidence(eye, moments)
        assert not e.H.any()
        assert e.weight == 0
    with pytest.raises(ValueError, match="not a rotation matrix"):
        compute_evidence(2 * eye, PairMoments.zero())


# --- Refine -----------------------------------------------------------------------------------------------------------


@given(seeds)
@quick
def test_a_step_solves_sylvesters_equation(seed: int) -> None:
    """A R B + p R = C + p (Z - U), compared with the equation solver; V = p (R + U) before and after."""
    cameras, moments = problem(seed, 3)
    started = [start_refine(c, range(3), cameras[c], moments[c], aim=False) for c in range(3)]
    V = [s.link.sent.values.reshape(3, 3) for s, _ in started]
    after, _ = step_refine(started[0][0], [(c, started[c][1][0].data) for c in (1, 2)])
    U, _, Wt = np.linalg.svd(sum(V))
    Z = U @ np.diag([1, 1, np.linalg.det(U @ Wt)]) @ Wt
    assert after.rotation is not None
    np.testing.assert_allclose(after.rotation, Z, atol=1e-12)
    PQ = cameras[0][:2]
    A, B, C = PQ.T @ PQ, PQ.T @ moments[0].s_xx @ PQ, PQ.T @ moments[0].s_yx @ PQ
    p = PENALTY * np.trace(A) * np.trace(B)
    dual = V[0] / p - Z
    R = solve_generalized_sylvester([A, p * np.eye(3)], [B, np.eye(3)], C + p * (Z - dual))
    np.testing.assert_allclose(
        after.link.sent.values.reshape(3, 3), V[0] + RELAXATION * p * (R - Z), atol=1e-10 * np.abs(V[0]).max()
    )


@given(seeds)
@quick
def test_starts_at_the_mean_of_the_mirrored_solutions(seed: int) -> None:
    cameras, moments = problem(seed, 3)
    alone = solve_centralized(cameras[:1], moments[:1], aim=False)
    state, _ = start_refine(0, range(3), cameras[0], moments[0], aim=False)
    mirror = cameras[0].T @ np.diag([1.0, 1, -1]) @ cameras[0]
    both = [alone.rotation, mirror @ alone.rotation @ mirror]
    q = build_cost(compute_views(cameras[:1], moments[:1], aim=False))
    assert q.cost(both[1]) == pytest.approx(q.cost(both[0]), rel=1e-9, abs=1e-12 * float(q.scale))
    start = state.link.sent.values.reshape(3, 3) / state.penalty
    np.testing.assert_allclose(start, np.mean(both, axis=0), atol=1e-6)
    own = solve_one_camera(cameras[0], moments[0], aim=False).rotations
    np.testing.assert_allclose(start, own.mean(axis=0), atol=1e-14)


def test_camera_without_solution_contributes_nothing() -> None:
    """All matches are at one point, with a spread slightly above and slightly below rounding."""
    cameras, _ = problem(3, 3)
    for spread in (0.0, 1e-8, 2e-7):
        x = 1.0 + spread * np.array([[1.0, 0], [0, 1], [-1, 0], [0, -1]])
        state, _ = start_refine(0, range(3), cameras[0], PairMoments.from_matches(x, x), aim=False)
        assert (state.penalty > 0) == bool(state.link.sent.values.any()) == bool(state.evidence.weight)
        assert np.isfinite(state.link.sent.values).all()


def test_a_step_is_a_pure_function() -> None:
    cameras, moments = problem(1)
    started = [start_refine(c, range(4), cameras[c], moments[c]) for c in range(4)]
    state, inbox = started[0][0], [(c, started[c][1][0].data) for c in (1, 2, 3)]
    before = pickle.dumps(state)
    first, second = step_refine(state, inbox), step_refine(state, inbox)
    assert pickle.dumps(state) == before
    assert first[1] == second[1]
    assert pickle.dumps(first[0]) == pickle.dumps(second[0])


def run_without_simulation(cameras: FloatArray, moments: list[PairMoments], n_rounds: int = 60) -> list[RefineState]:
    """Run the steps of all cameras without `sylpose.sylvester.distributed.simulation`."""
    n = len(cameras)
    pairs = [start_refine(c, range(n), cameras[c], moments[c], aim=False) for c in range(n)]
    states, out = [s for s, _ in pairs], [p for _, p in pairs]
    for _ in range(n_rounds):
        pairs = [step_refine(states[c], [(k, out[k][0].data) for k in range(n) if k != c]) for c in range(n)]
        states, out = [s for s, _ in pairs], [p for _, p in pairs]
        if all(s.done for s in states):
            break
    return states


def test_every_camera_has_the_common_result_and_covariance() -> None:
    cameras, moments = problem(2, 5)
    reference = solve_centralized(cameras, moments, aim=False)
    for state in run_without_simulation(cameras, moments):
        assert state.done
        assert state.estimate.converged
        assert state.estimate.used == (0, 1, 2, 3, 4)
        assert state.rotation is not None
        assert compute_angle(state.rotation, reference.rotation) < 1e-8
        assert state.estimate.information is not None
        np.testing.assert_allclose(state.estimate.information, reference.information, rtol=1e-6, atol=1e-6)


def test_waits_for_all_and_repeats_messages() -> None:
    cameras, moments = problem(3, 3)
    started = [start_refine(c, range(3), cameras[c], moments[c], aim=False) for c in range(3)]
    zero, one = [s for s, _ in started[:2]]
    data = [out[0].data for _, out in started]
    waiting, packets = step_refine(zero, [(1, data[1])])  # camera 2 is not received
    assert [p.to for p in packets] == [(1, 2)]
    assert packets[0].data == data[0]
    ahead, first = step_refine(one, [(0, data[0]), (2, data[2])])
    waiting, _ = step_refine(waiting, [(1, first[0].data)])  # too early: kept
    _, packets = step_refine(waiting, [(2, data[2])])
    _, expected = step_refine(zero, [(1, data[1]), (2, data[2])])
    assert packets == expected
    _, packets = step_refine(ahead, [(0, expected[0].data)])  # camera 2 may lack the previous message
    assert [(p.to, p.data) for p in packets] == [((0, 2), first[0].data), ((2,), data[1])]


def test_delayed_reordered_and_foreign_messages_have_no_effect() -> None:
    cameras, moments = problem(3, 3)
    started = [start_refine(c, range(3), cameras[c], moments[c]) for c in range(3)]
    inbox = [(c, started[c][1][0].data) for c in (1, 2)]
    state, _ = step_refine(started[0][0], inbox)
    again = step_refine(state, inbox)[0]
    nothing = step_refine(state, [])[0]
    np.testing.assert_array_equal(again.link.sent.values, nothing.link.sent.values)
    foreign = (7, encode(7, Message(1, True, False, np.eye(3).ravel())))
    own = (0, encode(0, Message(1, True, False, np.eye(3).ravel())))
    np.testing.assert_array_equal(step_refine(state, [foreign, own])[0].link.sent.values, nothing.link.sent.values)


def test_unresponsive_camera_is_dropped() -> None:
    cameras, moments = problem(4, 3)
    started = [start_refine(c, range(3), cameras[c], moments[c], max_rounds=120) for c in range(3)]
    state, _ = step_refine(started[0][0], [(c, started[c][1][0].data) for c in (1, 2)])
    for _ in range(MAX_MISSED_ROUNDS):
        state, _ = step_refine(state, [])
    assert state.received_evidence == {}
    state, _ = step_refine(state, [])
    assert state.link.number == EVIDENCE_MESSAGE
    while not state.done:
        state, _ = step_refine(state, [])
    assert state.estimate.used == (0,)
    assert state.round <= MAX_MISSED_ROUNDS + 6


def test_implausibly_large_message_is_rejected() -> None:
    cameras, moments = problem(5, 4)
    started = [start_refine(c, range(4), cameras[c], moments[c], aim=False) for c in range(4)]
    inbox = [(c, started[c][1][0].data) for c in (1, 2)]
    huge = (3, encode(3, Message(0, True, False, 1e6 * started[3][0].link.sent.values)))
    state, _ = step_refine(started[0][0], [*inbox, huge])
    assert state.refused == {3: "values that no camera can have"}
    assert tuple(state.members) == (0, 1, 2)


# --- Exchange ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["negative", "indefinite", "wide", "heavy"])
def test_implausible_moments_are_rejected(kind: str) -> None:
    cameras, moments = problem(6, 3)
    matrix = moments[1].matrix.copy()
    if kind == "negative":
        matrix *= -1
    elif kind == "indefinite":
        matrix[0, 0] -= 2 * matrix[0, 0]
    elif kind == "wide":
        matrix[0, 0] = 1e9 * matrix[8, 8]
    else:
        matrix *= 1e16
    state, _ = start_exchange(0, cameras, moments[0])
    bad = encode(1, Message(0, True, True, pack_upper(matrix)))
    good = start_exchange(2, cameras, moments[2])[1][0].data
    state, _ = step_exchange(state, [(1, bad), (2, good)])
    assert state.done
    assert state.estimate.used == (0, 2)
    assert list(state.refused) == [1]
    assert "moments that no" in state.refused[1]


# --- Gossip -----------------------------------------------------------------------------------------------------------


@given(seeds)
@quick
def test_gossip_converges_to_the_mean_from_any_start(seed: int) -> None:
    """The initial edge values, as left by lost messages, do not matter."""
    rng = np.random.default_rng(seed)
    cameras, moments = problem(seed, 3)
    graph = [(0, 1), (1, 2)]
    started = [start_gossip(c, 3, graph, cameras[c], moments[c], aim=False) for c in range(3)]
    states, out = [s for s, _ in started], [p for _, p in started]
    mean = np.asarray(np.mean([s.own_values for s in states], axis=0))
    junk = float(np.linalg.norm(mean)) * rng.normal(size=137)
    first = {c: {p.to[0]: p.data for p in out[c]} for c in range(3)}
    first[0][1] = encode(0, Message(0, True, False, junk))  # first message that camera 1 receives from camera 0
    for _ in range(60):
        pairs = [step_gossip(states[c], [(k, first[k][c]) for k in range(3) if c in first[k]]) for c in range(3)]
        states = [s for s, _ in pairs]
        first = {c: {p.to[0]: p.data for p in packets} for c, (_, packets) in enumerate(pairs)}
    assert np.abs(states[0].own_values[56:]).max() > 0
    mean[56:] = np.mean(
        [s.own_values[56:] for s in states], axis=0
    )  # surface sums are sent once the rotation is available
    for state in states:
        np.testing.assert_allclose(state.mean, mean, atol=1e-9 * float(np.linalg.norm(mean)))


def test_disconnected_graph_raises() -> None:
    with pytest.raises(ValueError, match="not connected: cameras 2, 3 cannot reach camera 0"):
        start_gossip(0, 4, [(0, 1), (2, 3)], np.eye(3), PairMoments.zero())
    for pair in ((0, 0), (0, 4), (-1, 2)):
        with pytest.raises(
            ValueError, match=f"connects camera {pair[0]} to {pair[1]}: expected two different ones of 0 to 3"
        ):
            start_gossip(0, 4, [(0, 1), pair], np.eye(3), PairMoments.zero())


def test_no_matches_is_not_converged() -> None:
    zero = PairMoments.zero()
    exchange = step_exchange(start_exchange(0, np.eye(3)[None], zero)[0], [])[0]
    refine, _ = start_refine(0, [0], np.eye(3), zero, max_rounds=30)
    gossip, _ = start_gossip(0, 1, [], np.eye(3), zero, max_rounds=30)
    for _ in range(30):
        refine, gossip = step_refine(refine, [])[0], step_gossip(gossip, [])[0]
    for state in (exchange, refine, gossip):
        assert state.done
        assert not state.estimate.converged
        assert state.estimate.rotation is None
