"""Step functions of the distributed estimators: messages, evidence, the ADMM equation, rejected input."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sylpose.geometry.arrays import FloatArray
from sylpose.moments import PairMoments
from sylpose.packets import Packet
from sylpose.sylvester.centralized import solve_centralized
from sylpose.sylvester.distributed.exchange import (
    MAX_MISSED_ROUNDS,
    Kind,
    Message,
    decode_inbox,
    encode,
    start_exchange,
    step_exchange,
)
from sylpose.sylvester.distributed.refine import (
    PENALTY,
    RELAXATION,
    RefineState,
    start_refine,
    step_refine,
)
from sylpose.sylvester.equation import solve_generalized_sylvester
from sylpose.sylvester.one_camera import solve_one_camera
from sylpose.sylvester.orthographic import build_cost, compute_views
from tests.scenes import compute_angle
from tests.sylvester.test_centralized import noisy_problem, pair_moments, quick, seeds


def problem(seed: int, n: int = 4) -> tuple[FloatArray, list[PairMoments]]:
    cameras, matches, _ = noisy_problem(seed, n)
    return cameras, pair_moments(matches)


# --- Messages ---------------------------------------------------------------------------------------------------------


@given(st.sampled_from(Kind), st.booleans(), st.integers(0, 65535), st.integers(0, 2**32 - 1), seeds)
@quick
def test_messages_round_trip(kind: Kind, final: bool, camera: int, number: int, seed: int) -> None:
    message = Message(kind, final, camera, number, np.random.default_rng(seed).normal(size=9))
    ((sender, out),) = decode_inbox([(7, encode(message))], kind)
    assert sender == 7
    assert out[:4] == message[:4]
    np.testing.assert_array_equal(out.values, message.values)
    assert list(decode_inbox([(7, encode(message))], Kind(1 - kind))) == []


def test_message_size() -> None:
    cameras, moments = problem(0)
    refine = start_refine(0, cameras, moments[0])[1]
    assert [(p.to, len(p.data)) for p in refine] == [((1, 2, 3), 8 + 72)]
    exchange = start_exchange(1, cameras, moments[1])[1]
    assert [(p.to, len(p.data)) for p in exchange] == [((0, 2, 3), 8 + 360)]
    gossip = start_exchange(1, cameras, moments[1], graph=[(0, 1), (1, 2), (2, 3)])[1]
    assert [(p.to, len(p.data)) for p in gossip] == [((0, 2), 8 + 360)]


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"short",
        encode(Message(Kind.MOMENTS, True, 1, 0, np.ones(45)))[:-5],
        encode(Message(Kind.MOMENTS, True, 1, 0, np.ones(45))) + b"more",
        encode(Message(Kind.MOMENTS, True, 1, 0, np.full(45, np.nan))),
        encode(Message(Kind.MOMENTS, True, 1, 0, np.full(45, -np.inf))),
    ],
)
def test_damaged_packets_count_as_lost(data: bytes) -> None:
    good = Message(Kind.MOMENTS, True, 2, 7, np.ones(45))
    assert [(c, message.number) for c, message in decode_inbox([(1, data), (2, encode(good))], Kind.MOMENTS)] == [
        (2, 7)
    ]
    cameras, moments = problem(0)
    exchange, refine = start_exchange(0, cameras, moments[0])[0], start_refine(0, cameras, moments[0])[0]
    assert pickle.dumps(step_exchange(exchange, [(1, data)])) == pickle.dumps(step_exchange(exchange, []))
    assert pickle.dumps(step_refine(refine, [(1, data)])) == pickle.dumps(step_refine(refine, []))


@pytest.mark.parametrize("values", [np.ones(44), np.ones(46), -np.ones(45), np.full(45, 1e200)])
def test_malformed_moments_are_ignored(values: FloatArray) -> None:
    cameras, moments = problem(0)
    state, _ = start_exchange(0, cameras, moments[0])
    state, _ = step_exchange(state, [(1, encode(Message(Kind.MOMENTS, False, 1, 0, values)))])
    assert list(state.moments) == [0]


def test_unknown_cameras_are_ignored() -> None:
    cameras, moments = problem(0)
    state, _ = start_exchange(0, cameras, moments[0])
    state, _ = step_exchange(
        state, [(1, start_exchange(3, cameras, moments[3])[1][0].data), (1, b"\1\0\7\0" + bytes(364))]
    )
    assert list(state.moments) == [0, 3]


# --- Refine -----------------------------------------------------------------------------------------------------------


@given(seeds)
@quick
def test_a_step_solves_sylvesters_equation(seed: int) -> None:
    """A R B + p R = C + p (Z - U), compared with the equation solver; V = p (R + U) before and after."""
    cameras, moments = problem(seed, 3)
    started = [start_refine(c, cameras, moments[c], aim=False) for c in range(3)]
    V = [s.sent.values.reshape(3, 3) for s, _ in started]
    after, _ = step_refine(started[0][0], [(c, started[c][1][0].data) for c in (1, 2)])
    U, _, Wt = np.linalg.svd(sum(V))
    Z = U @ np.diag([1, 1, np.linalg.det(U @ Wt)]) @ Wt
    np.testing.assert_allclose(after.rotation, Z, atol=1e-12)
    PQ = cameras[0][:2]
    A, B, C = PQ.T @ PQ, PQ.T @ moments[0].s_xx @ PQ, PQ.T @ moments[0].s_yx @ PQ
    p = PENALTY * np.trace(A) * np.trace(B)
    dual = V[0] / p - Z
    R = solve_generalized_sylvester([A, p * np.eye(3)], [B, np.eye(3)], C + p * (Z - dual))
    np.testing.assert_allclose(
        after.sent.values.reshape(3, 3), V[0] + RELAXATION * p * (R - Z), atol=1e-10 * np.abs(V[0]).max()
    )


@given(seeds)
@quick
def test_starts_at_the_mean_of_the_mirrored_solutions(seed: int) -> None:
    cameras, moments = problem(seed, 3)
    alone = solve_centralized(cameras[:1], moments[:1], aim=False)
    state, _ = start_refine(0, cameras, moments[0], aim=False)
    mirror = cameras[0].T @ np.diag([1.0, 1, -1]) @ cameras[0]
    both = [alone.rotation, mirror @ alone.rotation @ mirror]
    q = build_cost(compute_views(cameras[:1], moments[:1], aim=False))
    assert q.cost(both[1]) == pytest.approx(q.cost(both[0]), rel=1e-9, abs=1e-12 * float(q.scale))
    start = state.sent.values.reshape(3, 3) / state.terms.penalty
    np.testing.assert_allclose(start, np.mean(both, axis=0), atol=1e-6)
    own = solve_one_camera(cameras[0], moments[0], aim=False).rotations
    np.testing.assert_allclose(start, own.mean(axis=0), atol=1e-14)


def test_camera_without_solution_contributes_nothing() -> None:
    """All matches are at one point, with a spread slightly above and slightly below rounding."""
    cameras, _ = problem(3, 3)
    for spread in (0.0, 1e-8, 2e-7):
        x = 1.0 + spread * np.array([[1.0, 0], [0, 1], [-1, 0], [0, -1]])
        state, _ = start_refine(0, cameras, PairMoments.from_matches(x, x), aim=False)
        assert (state.terms.penalty > 0) == bool(state.sent.values.any()) == bool(state.terms.cost.weight)
        assert np.isfinite(state.sent.values).all()


def test_a_step_is_a_pure_function() -> None:
    cameras, moments = problem(1)
    started = [start_refine(c, cameras, moments[c]) for c in range(4)]
    state, inbox = started[0][0], [(c, started[c][1][0].data) for c in (1, 2, 3)]
    before = pickle.dumps(state)
    first, second = step_refine(state, inbox), step_refine(state, inbox)
    assert pickle.dumps(state) == before
    assert first[1] == second[1]
    assert pickle.dumps(first[0]) == pickle.dumps(second[0])


def run_without_simulation(cameras: FloatArray, moments: list[PairMoments], n_rounds: int = 60) -> list[RefineState]:
    """Run the steps of all cameras without `run_network`."""
    n = len(cameras)
    pairs = [start_refine(c, cameras, moments[c], aim=False) for c in range(n)]
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
        assert state.estimate is not None
        assert list(state.estimate.weights) == [0, 1, 2, 3, 4]
        assert compute_angle(state.rotation, reference.rotation) < 1e-8
        np.testing.assert_allclose(state.estimate.information, reference.information, rtol=1e-6, atol=1e-6)


def test_waits_for_all_and_repeats_messages() -> None:
    cameras, moments = problem(3, 3)
    started = [start_refine(c, cameras, moments[c], aim=False) for c in range(3)]
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
    started = [start_refine(c, cameras, moments[c]) for c in range(3)]
    inbox = [(c, started[c][1][0].data) for c in (1, 2)]
    state, _ = step_refine(started[0][0], inbox)
    again = step_refine(state, inbox)[0]
    nothing = step_refine(state, [])[0]
    np.testing.assert_array_equal(again.sent.values, nothing.sent.values)
    foreign = (7, encode(Message(Kind.REFINEMENT, False, 1, 1, np.eye(3).ravel())))
    odd = (2, encode(Message(Kind.REFINEMENT, False, 2, 1, np.ones(10))))
    np.testing.assert_array_equal(step_refine(state, [foreign, odd])[0].sent.values, nothing.sent.values)


def test_unresponsive_camera_is_dropped() -> None:
    cameras, moments = problem(4, 3)
    started = [start_refine(c, cameras, moments[c]) for c in range(3)]
    state, _ = step_refine(started[0][0], [(c, started[c][1][0].data) for c in (1, 2)])
    for _ in range(MAX_MISSED_ROUNDS):
        state, _ = step_refine(state, [])
    assert not state.is_exchanging
    state, packets = step_refine(state, [])
    assert state.is_exchanging
    assert [(p.to, len(p.data)) for p in packets] == [((1, 2), 8 + 360)]
    while not state.done:
        state, _ = step_refine(state, [])
    assert state.estimate is not None
    assert list(state.estimate.weights) == [0]
    assert state.round <= 2 * MAX_MISSED_ROUNDS + 6


def test_a_node_that_is_asked_for_its_moments_sends_them() -> None:
    cameras, moments = problem(5, 4)
    state, _ = start_refine(0, cameras, moments[0])
    state, packets = step_refine(state, start_inbox(start_exchange(2, cameras, moments[2])[1], 2))
    assert state.is_exchanging
    assert len(packets[0].data) == 8 + 360


# --- Exchange ---------------------------------------------------------------------------------------------------------


def start_inbox(packets: list[Packet], sender: int) -> list[tuple[int, bytes]]:
    return [(sender, packet.data) for packet in packets]


def test_each_node_sends_its_own_moments_first_and_passes_on_what_neighbors_lack() -> None:
    """A line 0 - 1 - 2 - 3: node 1 passes the moments of node 0 on to node 2."""
    cameras, moments = problem(6)
    graph = [(0, 1), (1, 2), (2, 3)]
    state, packets = start_exchange(1, cameras, moments[1], graph=graph)
    (own,) = decode_inbox(start_inbox(packets, 1), Kind.MOMENTS)
    assert own[1].camera == 1
    first = start_exchange(0, cameras, moments[0], graph=graph)[1]
    state, packets = step_exchange(state, start_inbox(first, 0))
    (passed,) = decode_inbox(start_inbox(packets, 1), Kind.MOMENTS)
    assert passed[1].camera == 0
    assert packets[0].data[8:] == first[0].data[8:]
    assert not passed[1].is_final


def test_repeats_moments_until_the_neighbors_have_all() -> None:
    cameras, moments = problem(6, 3)
    state, first = start_exchange(0, cameras, moments[0])
    inbox = [(c, start_exchange(c, cameras, moments[c])[1][0].data) for c in (1, 2)]
    state, packets = step_exchange(state, inbox)
    assert state.estimate is not None
    assert len(packets[0].data) == 8  # all should have arrived: only that this node has all
    state, packets = step_exchange(state, inbox)  # they lack something
    assert packets[0].data[8:] == first[0].data[8:]
    final = [(c, encode(Message(Kind.MOMENTS, True, c, 2, np.zeros(0)))) for c in (1, 2)]
    state, packets = step_exchange(state, final)
    assert state.done
    assert [len(p.data) for p in packets] == [8]


def test_camera_that_never_sends_is_left_out() -> None:
    cameras, moments = problem(6, 3)
    state, _ = start_exchange(0, cameras, moments[0])
    other = start_exchange(1, cameras, moments[1])[1][0].data
    for _ in range(MAX_MISSED_ROUNDS + 3 + 2):
        assert state.estimate is None
        state, _ = step_exchange(state, [(1, other)])
    assert state.estimate is not None
    assert list(state.estimate.weights) == [0, 1]


def test_disconnected_graph_raises() -> None:
    cameras, _ = problem(0)
    with pytest.raises(ValueError, match="not connected: cameras 2, 3 cannot reach camera 0"):
        start_exchange(0, cameras, PairMoments.zero(), graph=[(0, 1), (2, 3)])
    for pair in ((0, 0), (0, 4), (-1, 2)):
        with pytest.raises(
            ValueError, match=f"connects camera {pair[0]} to {pair[1]}: expected two different ones of 0 to 3"
        ):
            start_exchange(0, cameras, PairMoments.zero(), graph=[(0, 1), pair])


def test_no_matches_give_no_result() -> None:
    zero = PairMoments.zero()
    exchange = step_exchange(start_exchange(0, np.eye(3)[None], zero)[0], [])[0]
    refine = step_refine(start_refine(0, np.eye(3)[None], zero)[0], [])[0]
    for state in (exchange, refine):
        assert state.done
        assert state.estimate is None
