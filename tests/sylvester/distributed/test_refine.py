"""One camera's step of the distributed estimators: messages, evidence, the equation it solves, what it refuses."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import upper_of
from sylpose.moments import PairMoments
from sylpose.sylvester.centralized import solve_centralized
from sylpose.sylvester.distributed.evidence import evidence_of, packed, unpacked
from sylpose.sylvester.distributed.evidence_exchange import SHOW
from sylpose.sylvester.distributed.exchange import exchange_start, exchange_step
from sylpose.sylvester.distributed.gossip import gossip_start, gossip_step
from sylpose.sylvester.distributed.lockstep import PATIENCE
from sylpose.sylvester.distributed.messages import Message, decode, encode, newest, read
from sylpose.sylvester.distributed.refine import PENALTY, RELAXATION, RefineState, refine_start, refine_step
from sylpose.sylvester.equation import solve_generalized_sylvester
from sylpose.sylvester.one_camera import solve_one_camera
from sylpose.sylvester.orthographic import quadratic_of, views_of
from sylpose.sylvester.so3 import Quadratic
from tests.scenes import angle
from tests.sylvester.test_centralized import moments_of, noisy_problem, quick, seeds


def problem(seed: int, n: int = 4) -> tuple[FloatArray, list[PairMoments]]:
    cameras, matches, _ = noisy_problem(seed, n)
    return cameras, moments_of(matches)


# --- Messages ---------------------------------------------------------------------------------------------------------


@given(st.integers(0, 65535), st.integers(0, 2**32 - 1), st.booleans(), st.booleans(), seeds)
@quick
def test_messages_come_out_as_they_went_in(sender: int, number: int, clean: bool, final: bool, seed: int) -> None:
    message = Message(number, clean, final, np.random.default_rng(seed).normal(size=9))
    out = decode(encode(sender, message), sender, (9, 18))
    assert out[:3] == message[:3]
    np.testing.assert_array_equal(out.values, message.values)


def test_a_message_is_its_values_and_eight_bytes() -> None:
    cameras, moments = problem(0)
    pairs = [(0, 1), (1, 2), (2, 3)]
    refine = refine_start(0, range(4), cameras[0], moments[0])[1]
    assert [(p.to, len(p.data)) for p in refine] == [((1, 2, 3), 8 + 72)]
    exchange = exchange_start(1, cameras, moments[1])[1]
    assert [(p.to, len(p.data)) for p in exchange] == [((0, 2, 3), 8 + 360)]
    gossip = gossip_start(1, 4, pairs, cameras[1], moments[1])[1]
    assert [(p.to, len(p.data)) for p in gossip] == [((0,), 8 + 448), ((2,), 8 + 448)]


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "0 bytes are no message"),
        (encode(3, Message(0, True, True, np.ones(9)))[:-5], "75 bytes instead of 80 or 152"),
        (encode(3, Message(0, True, True, np.ones(9))) + b"more", "84 bytes instead of 80 or 152"),
        (encode(3, Message(0, True, True, np.ones(10))), "88 bytes instead of 80 or 152"),
        (encode(4, Message(0, True, True, np.ones(9))), "header is not this camera's"),
        (encode(3, Message(0, True, True, np.full(9, np.nan))), "not finite, or beyond"),
        (encode(3, Message(0, True, True, np.full(9, -np.inf))), "not finite, or beyond"),
        (encode(3, Message(0, True, True, np.full(9, 1e200))), "not finite, or beyond"),
    ],
)
def test_nonsense_is_refused_with_its_reason_and_sender(data: bytes, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        decode(data, 3, (9, 18))
    good = encode(2, Message(7, True, True, np.ones(9)))
    news, refused = read([(3, data), (2, good)], (9, 18), {})
    assert list(news) == [(2, 7)]
    assert list(refused) == [3]
    assert refused[3]


def test_only_the_newest_message_is_read() -> None:
    inbox = [(1, encode(1, Message(k, True, False, np.full(9, k)))) for k in (4, 6, 5)]
    messages, _ = read(inbox, (9,), {})
    assert newest(messages, {})[1].round == 6
    assert newest(messages, {1: 5})[1].round == 6
    assert newest(messages, {1: 6}) == {}


# --- Evidence ---------------------------------------------------------------------------------------------------------


@given(seeds, st.integers(1, 6), st.booleans())
@quick
def test_evidence_adds_up_to_the_centralised_cost(seed: int, n: int, aim: bool) -> None:
    cameras, moments = problem(seed, max(n, 3))
    q = quadratic_of(views_of(cameras[:n], moments[:n], aim=aim))
    parts = [evidence_of(c, m, aim=aim) for c, m in zip(cameras[:n], moments[:n], strict=True)]
    total = sum(parts, start=Quadratic.zero())
    for name in ("H", "h", "constant", "weight"):
        np.testing.assert_allclose(getattr(total, name), getattr(q, name), rtol=1e-12, atol=1e-12 * float(q.scale))
    for name in ("H", "h", "constant", "weight"):
        np.testing.assert_array_equal(getattr(unpacked(packed(q)), name), getattr(q, name))


def test_a_camera_without_spread_has_no_evidence() -> None:
    eye = np.eye(3)
    for moments in (PairMoments.zero(), PairMoments.from_matches(np.ones((5, 2)), np.ones((5, 2)))):
        e = evidence_of(eye, moments)
        assert not e.H.any()
        assert e.weight == 0
    with pytest.raises(ValueError, match="not a rotation matrix"):
        evidence_of(2 * eye, PairMoments.zero())


# --- Refine -----------------------------------------------------------------------------------------------------------


@given(seeds)
@quick
def test_a_step_solves_sylvesters_equation(seed: int) -> None:
    """A R B + p R = C + p (Z - U), against the equation's own solver; V = p (R + U) before and after."""
    cameras, moments = problem(seed, 3)
    started = [refine_start(c, range(3), cameras[c], moments[c], aim=False) for c in range(3)]
    V = [s.link.sent.values.reshape(3, 3) for s, _ in started]
    after, _ = refine_step(started[0][0], [(c, started[c][1][0].data) for c in (1, 2)])
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
def test_it_starts_at_the_mean_of_a_cameras_two_mirrored_solutions(seed: int) -> None:
    cameras, moments = problem(seed, 3)
    alone = solve_centralized(cameras[:1], moments[:1], aim=False)
    state, _ = refine_start(0, range(3), cameras[0], moments[0], aim=False)
    mirror = cameras[0].T @ np.diag([1.0, 1, -1]) @ cameras[0]
    both = [alone.rotation, mirror @ alone.rotation @ mirror]
    q = quadratic_of(views_of(cameras[:1], moments[:1], aim=False))
    assert q.cost(both[1]) == pytest.approx(q.cost(both[0]), rel=1e-9, abs=1e-12 * float(q.scale))
    start = state.link.sent.values.reshape(3, 3) / state.penalty
    np.testing.assert_allclose(start, np.mean(both, axis=0), atol=1e-6)
    own = solve_one_camera(cameras[0], moments[0], aim=False).rotations
    np.testing.assert_allclose(start, own.mean(axis=0), atol=1e-14)


def test_a_camera_without_a_solution_of_its_own_adds_nothing() -> None:
    """Its matches are all at one point, spread by a little more and a little less than rounding."""
    cameras, _ = problem(3, 3)
    for spread in (0.0, 1e-8, 2e-7):
        x = 1.0 + spread * np.array([[1.0, 0], [0, 1], [-1, 0], [0, -1]])
        state, _ = refine_start(0, range(3), cameras[0], PairMoments.from_matches(x, x), aim=False)
        assert (state.penalty > 0) == bool(state.link.sent.values.any()) == bool(state.evidence.weight)
        assert np.isfinite(state.link.sent.values).all()


def test_a_step_is_a_pure_function() -> None:
    cameras, moments = problem(1)
    started = [refine_start(c, range(4), cameras[c], moments[c]) for c in range(4)]
    state, inbox = started[0][0], [(c, started[c][1][0].data) for c in (1, 2, 3)]
    before = pickle.dumps(state)
    first, second = refine_step(state, inbox), refine_step(state, inbox)
    assert pickle.dumps(state) == before
    assert first[1] == second[1]
    assert pickle.dumps(first[0]) == pickle.dumps(second[0])


def converged_by_hand(cameras: FloatArray, moments: list[PairMoments], n_rounds: int = 60) -> list[RefineState]:
    """All cameras' steps without `sylpose.sylvester.distributed.simulation`."""
    n = len(cameras)
    pairs = [refine_start(c, range(n), cameras[c], moments[c], aim=False) for c in range(n)]
    states, out = [s for s, _ in pairs], [p for _, p in pairs]
    for _ in range(n_rounds):
        pairs = [refine_step(states[c], [(k, out[k][0].data) for k in range(n) if k != c]) for c in range(n)]
        states, out = [s for s, _ in pairs], [p for _, p in pairs]
        if all(s.done for s in states):
            break
    return states


def test_every_camera_knows_by_itself_that_all_agree_and_how_well() -> None:
    cameras, moments = problem(2, 5)
    reference = solve_centralized(cameras, moments, aim=False)
    for state in converged_by_hand(cameras, moments):
        assert state.done
        assert state.verdict.converged
        assert state.verdict.used == (0, 1, 2, 3, 4)
        assert state.rotation is not None
        assert angle(state.rotation, reference.rotation) < 1e-8
        assert state.verdict.information is not None
        np.testing.assert_allclose(state.verdict.information, reference.information, rtol=1e-6, atol=1e-6)


def test_it_waits_for_all_and_repeats_what_they_may_lack() -> None:
    cameras, moments = problem(3, 3)
    started = [refine_start(c, range(3), cameras[c], moments[c], aim=False) for c in range(3)]
    zero, one = [s for s, _ in started[:2]]
    data = [out[0].data for _, out in started]
    waiting, packets = refine_step(zero, [(1, data[1])])  # camera 2 is not heard
    assert [p.to for p in packets] == [(1, 2)]
    assert packets[0].data == data[0]
    ahead, first = refine_step(one, [(0, data[0]), (2, data[2])])
    waiting, _ = refine_step(waiting, [(1, first[0].data)])  # too early: kept
    _, packets = refine_step(waiting, [(2, data[2])])
    _, expected = refine_step(zero, [(1, data[1]), (2, data[2])])
    assert packets == expected
    _, packets = refine_step(ahead, [(0, expected[0].data)])  # camera 2 may lack what came before
    assert [(p.to, p.data) for p in packets] == [((0, 2), first[0].data), ((2,), data[1])]


def test_late_overtaken_and_foreign_messages_change_nothing() -> None:
    cameras, moments = problem(3, 3)
    started = [refine_start(c, range(3), cameras[c], moments[c]) for c in range(3)]
    inbox = [(c, started[c][1][0].data) for c in (1, 2)]
    state, _ = refine_step(started[0][0], inbox)
    again = refine_step(state, inbox)[0]
    nothing = refine_step(state, [])[0]
    np.testing.assert_array_equal(again.link.sent.values, nothing.link.sent.values)
    foreign = (7, encode(7, Message(1, True, False, np.eye(3).ravel())))
    own = (0, encode(0, Message(1, True, False, np.eye(3).ravel())))
    np.testing.assert_array_equal(refine_step(state, [foreign, own])[0].link.sent.values, nothing.link.sent.values)


def test_a_silent_camera_is_dropped_and_one_alone_comes_to_an_end() -> None:
    cameras, moments = problem(4, 3)
    started = [refine_start(c, range(3), cameras[c], moments[c], bound=120) for c in range(3)]
    state, _ = refine_step(started[0][0], [(c, started[c][1][0].data) for c in (1, 2)])
    for _ in range(PATIENCE):
        state, _ = refine_step(state, [])
    assert state.shown == {}
    state, _ = refine_step(state, [])
    assert state.link.number == SHOW
    while not state.done:
        state, _ = refine_step(state, [])
    assert state.verdict.used == (0,)
    assert state.round <= PATIENCE + 6


def test_one_huge_message_among_many_is_refused() -> None:
    cameras, moments = problem(5, 4)
    started = [refine_start(c, range(4), cameras[c], moments[c], aim=False) for c in range(4)]
    inbox = [(c, started[c][1][0].data) for c in (1, 2)]
    huge = (3, encode(3, Message(0, True, False, 1e6 * started[3][0].link.sent.values)))
    state, _ = refine_step(started[0][0], [*inbox, huge])
    assert state.refused == {3: "values that no camera has"}
    assert tuple(state.members) == (0, 1, 2)


# --- Exchange ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["negative", "indefinite", "wide", "heavy"])
def test_moments_that_no_image_has_are_refused(kind: str) -> None:
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
    state, _ = exchange_start(0, cameras, moments[0])
    bad = encode(1, Message(0, True, True, upper_of(matrix)))
    good = exchange_start(2, cameras, moments[2])[1][0].data
    state, _ = exchange_step(state, [(1, bad), (2, good)])
    assert state.done
    assert state.verdict.used == (0, 2)
    assert list(state.refused) == [1]
    assert "moments that no" in state.refused[1]


# --- Gossip -----------------------------------------------------------------------------------------------------------


@given(seeds)
@quick
def test_gossip_ends_at_the_mean_from_any_start(seed: int) -> None:
    """What an edge holds to begin with, lost messages' traces say, does not matter."""
    rng = np.random.default_rng(seed)
    cameras, moments = problem(seed, 3)
    graph = [(0, 1), (1, 2)]
    started = [gossip_start(c, 3, graph, cameras[c], moments[c], aim=False) for c in range(3)]
    states, out = [s for s, _ in started], [p for _, p in started]
    mean = np.asarray(np.mean([s.own for s in states], axis=0))
    junk = float(np.linalg.norm(mean)) * rng.normal(size=137)
    first = {c: {p.to[0]: p.data for p in out[c]} for c in range(3)}
    first[0][1] = encode(0, Message(0, True, False, junk))  # what camera 1 hears first of camera 0
    for _ in range(60):
        pairs = [gossip_step(states[c], [(k, first[k][c]) for k in range(3) if c in first[k]]) for c in range(3)]
        states = [s for s, _ in pairs]
        first = {c: {p.to[0]: p.data for p in packets} for c, (_, packets) in enumerate(pairs)}
    assert np.abs(states[0].own[56:]).max() > 0
    mean[56:] = np.mean([s.own[56:] for s in states], axis=0)  # what surfaces may have done is told once that is known
    for state in states:
        np.testing.assert_allclose(state.mean, mean, atol=1e-9 * float(np.linalg.norm(mean)))


def test_a_graph_that_is_not_connected_is_refused_and_the_cut_off_named() -> None:
    with pytest.raises(ValueError, match="not connected: cameras 2, 3 cannot reach camera 0"):
        gossip_start(0, 4, [(0, 1), (2, 3)], np.eye(3), PairMoments.zero())
    for pair in ((0, 0), (0, 4), (-1, 2)):
        with pytest.raises(
            ValueError, match=f"joins camera {pair[0]} to {pair[1]}: expected two different ones of 0 to 3"
        ):
            gossip_start(0, 4, [(0, 1), pair], np.eye(3), PairMoments.zero())


def test_unseen_by_all_is_not_converged() -> None:
    zero = PairMoments.zero()
    exchange = exchange_step(exchange_start(0, np.eye(3)[None], zero)[0], [])[0]
    refine, _ = refine_start(0, [0], np.eye(3), zero, bound=30)
    gossip, _ = gossip_start(0, 1, [], np.eye(3), zero, bound=30)
    for _ in range(30):
        refine, gossip = refine_step(refine, [])[0], gossip_step(gossip, [])[0]
    for state in (exchange, refine, gossip):
        assert state.done
        assert not state.verdict.converged
        assert state.verdict.rotation is None
