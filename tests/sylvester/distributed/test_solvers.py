"""Distributed estimators over a simulated network: the centralized result at every camera, and network faults."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass
from functools import partial
from itertools import islice
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sylpose import estimate_motion, open_session
from sylpose.features.sift import detect_features, match_features
from sylpose.geometry.arrays import FloatArray
from sylpose.matches import Matches
from sylpose.moments import PairMoments
from sylpose.packets import NO_FAULTS, Inbox, NetworkFaults, Packet, run_network
from sylpose.rig import Rig
from sylpose.simulate import Body, arc, box, dome, ellipsoid, random_motion, ring, simulate_matches
from sylpose.status import Status
from sylpose.sylvester.camera_faults import solve_robust
from sylpose.sylvester.centralized import CentralizedSolution, solve_centralized
from sylpose.sylvester.distributed.refine import RefineState, start_refine, step_refine
from sylpose.sylvester.distributed.solvers import DistributedSolution, solve_exchange, solve_gossip, solve_refine
from tests.paths import DATA
from tests.scenes import BODY, compute_angle, draw_rotations, make_zigzag_rig
from tests.sylvester.test_centralized import general_cameras, noisy_problem, pair_moments, seeds, simulate_orthographic

Problem = tuple[FloatArray, list[PairMoments]]
Solve = Callable[..., DistributedSolution]

SCHEMES: dict[str, Solve] = {"exchange": solve_exchange, "refine": solve_refine, "gossip": solve_gossip}
schemes = pytest.mark.parametrize("solve", SCHEMES.values(), ids=list(SCHEMES))


def simulate_problem(rig: Rig, seed: int = 0, turn: float = 5.0, body: Body = BODY) -> Problem:
    """Simulate a rotating body in perspective, with noise."""
    rng = np.random.default_rng(seed)
    pair = simulate_matches(rig, body, random_motion(turn, 0.02, rng), rng=rng)
    return np.array([c.rotation for c in rig]), [PairMoments.from_matches(m.x, m.y) for m in pair.matches]


def centralized_result(problem: Problem, cameras: Sequence[int]) -> CentralizedSolution:
    """Return the centralized result of some cameras."""
    return solve_centralized(problem[0][list(cameras)], [problem[1][c] for c in cameras])


def check_agreement(found: DistributedSolution, reference: CentralizedSolution, cameras: Sequence[int]) -> None:
    """Check that these cameras all have this result and report convergence."""
    assert found.status is reference.status
    assert reference.certified
    assert found.certified
    assert found.converged[list(cameras)].all()
    for c in cameras:
        assert compute_angle(found.rotations[c], reference.rotation) < 1e-8
    assert compute_angle(found.rotation, reference.rotation) < 1e-8
    assert found.spread < 1e-8


# --- Without faults --------------------------------------------------------------------------------------------------


@given(seeds, st.integers(3, 6))
@settings(max_examples=5, deadline=None)
@schemes
def test_every_camera_has_the_centralized_result(solve: Solve, seed: int, n: int) -> None:
    """Rotations of any size."""
    cameras, matches, _ = noisy_problem(seed, n)
    reference = solve_centralized(cameras, pair_moments(matches), aim=False)
    assume(reference.certified)
    found = solve(cameras, pair_moments(matches), aim=False)
    check_agreement(found, reference, range(n))
    assert found.used == tuple(range(n))
    np.testing.assert_allclose(found.information, reference.information, rtol=1e-5, atol=1e-5)


@schemes
@pytest.mark.parametrize(
    "rig", [make_zigzag_rig(4), dome(5), ring(8, height=0.5), arc(4, 30.0, height=[0.3, -0.3, 0.3, -0.3])]
)
def test_every_camera_has_the_centralized_result_in_perspective(solve: Solve, rig: Rig) -> None:
    problem = simulate_problem(rig)
    check_agreement(solve(*problem), centralized_result(problem, range(len(rig))), range(len(rig)))


@schemes
def test_status_equals_the_centralized_one(solve: Solve) -> None:
    found = set()
    for seed in range(6):
        rng = np.random.default_rng(seed)
        cameras, turn = draw_rotations(rng, 4), draw_rotations(rng, 1)[0]
        noise, n, even = [(0.6, 4, False), (0.02, 12, True)][seed % 2]
        moments = pair_moments(simulate_orthographic(rng, cameras, turn, noise, even, n))
        reference = solve_centralized(cameras, moments, aim=False)
        answer = solve(cameras, moments, aim=False)
        if compute_angle(answer.rotation, reference.rotation) < 1e-6:  # refine may find another minimum
            assert answer.status is reference.status
            found.add(answer.status)
    assert {Status.OK, Status.ROTATION_NOT_OBSERVABLE} <= found


@schemes
@pytest.mark.parametrize("n", [2, 5])
def test_parallel_cameras_agree_on_one_mirrored_rotation(solve: Solve, n: int) -> None:
    for seed in range(2):
        rng = np.random.default_rng(seed)
        cameras, turn = np.repeat(draw_rotations(rng, 1), n, axis=0), Rotation.from_rotvec(rng.normal(size=3) * 0.2)
        moments = pair_moments(simulate_orthographic(rng, cameras, turn.as_matrix(), noise=0.02))
        reference = solve_centralized(cameras, moments, aim=False)
        found = solve(cameras, moments, aim=False)
        assert found.status is reference.status is not Status.OK
        assert min(compute_angle(found.rotation, c) for c in reference.candidates) < 1e-6


@schemes
@pytest.mark.parametrize("unit", [1e-8, 1e4, 1e6])
def test_independent_of_the_unit_of_orthographic_points(solve: Solve, unit: float) -> None:
    cameras, matches, _ = noisy_problem(1, 4)
    moments = pair_moments([(unit * x, unit * y) for x, y in matches])
    check_agreement(solve(cameras, moments, aim=False), solve_centralized(cameras, moments, aim=False), range(4))


@pytest.mark.parametrize("solve", [solve_exchange, solve_gossip])
def test_exchange_is_bit_identical_to_centralized(solve: Solve) -> None:
    problem = simulate_problem(dome(5))
    found, reference = solve(*problem), centralized_result(problem, range(5))
    np.testing.assert_array_equal(found.rotations, np.broadcast_to(reference.rotation, (5, 3, 3)))
    np.testing.assert_array_equal(found.information, reference.information)


def test_exchange_sends_moments_once() -> None:
    """Two more headers confirm that all moments have arrived."""
    found = solve_exchange(*simulate_problem(dome(5)))
    assert found.rounds == 2
    assert (found.sent == 368 + 8 + 8).all()
    assert (found.received == 4 * (368 + 8)).all()


@pytest.mark.parametrize(
    "rig", [make_zigzag_rig(16), *(pytest.param(rig, marks=pytest.mark.slow) for rig in (dome(16), ring(16)))]
)
def test_sixteen_cameras_refine_in_at_most_a_hundred_rounds_of_72_bytes(rig: Rig) -> None:
    problem = simulate_problem(rig)
    found = solve_refine(*problem)
    check_agreement(found, centralized_result(problem, range(16)), range(16))
    assert found.rounds <= 100
    # 8 bytes of header per round. After convergence a report, 88 more bytes, then surface sums, 640 more. A restart from
    # a saddle costs another report and 40. If surfaces bias the rotation, moments follow instead: 368, and two headers.
    more = found.sent - 80 * (found.rounds + 1)
    assert {int(m) for m in more} <= {88 + 640, 2 * 88 + 40 + 640, 88 + 368 - 2 * 72 - 80}


def is_exchanging(problem: Problem, aim: bool = True) -> bool:
    """Return whether the nodes of `refine` send their moments."""
    cameras, moments = problem
    starts = [partial(start_refine, c, cameras, moments[c], aim=aim) for c in range(len(moments))]
    states = run_network(starts, step_refine, NO_FAULTS, 200).states
    assert all(state is not None and state.estimate is not None for state in states)
    return any(state is not None and state.is_exchanging for state in states)


def test_refine_sends_no_moments_where_the_model_holds() -> None:
    """Small rotations; or orthographic views of points whose depth is uncorrelated with the image."""
    for seed in range(4):
        assert not is_exchanging(simulate_problem((make_zigzag_rig(4), dome(5))[seed % 2], seed, turn=1.0))
        cameras, matches, _ = noisy_problem(seed, 4)
        assert not is_exchanging((cameras, pair_moments(matches)), aim=False)


def test_refine_sends_moments_where_a_surface_biases_it() -> None:
    """The result is that of all cameras nevertheless: none is at fault."""
    problem = simulate_problem(make_zigzag_rig(4), turn=10.0, body=box())
    assert is_exchanging(problem)
    found = solve_refine(*problem)
    assert found.used == (0, 1, 2, 3)
    assert not found.faults
    np.testing.assert_array_equal(found.rotation, solve_robust(*problem).rotation)


@given(seeds)
@settings(max_examples=10, deadline=None)
def test_refine_is_equivariant_and_independent_of_order(seed: int) -> None:
    cameras, matches, _ = noisy_problem(seed, 3)
    moments = pair_moments(matches)
    rng = np.random.default_rng(seed)
    new, order = draw_rotations(rng, 1)[0], rng.permutation(3)
    a = solve_refine(cameras, moments, aim=False)
    assume(a.status is Status.OK)
    turned = solve_refine(cameras @ new.T, moments, aim=False)
    assert compute_angle(turned.rotation, new @ a.rotation @ new.T) < 1e-8
    other = solve_refine(cameras[order], [moments[c] for c in order], aim=False)
    assert compute_angle(other.rotation, a.rotation) < 1e-8


@pytest.mark.parametrize("seed", range(3))
def test_narrow_arc_reaches_the_best_minimum(seed: int) -> None:
    """The start is near the saddle between two mirrored minima, where plain ADMM would stay."""
    problem = simulate_problem(arc(4, 10.0), seed)
    found, reference = solve_refine(*problem), centralized_result(problem, range(4))
    check_agreement(found, reference, range(4))
    assert found.status is Status.ROTATION_NOT_OBSERVABLE
    assert np.linalg.eigvalsh(found.information)[0] > 0


def test_equal_mirrored_minima_are_not_certified() -> None:
    """One camera's minima, with a second camera without matches."""
    cameras, moments = simulate_problem(make_zigzag_rig(2))
    problem = cameras, [moments[0], PairMoments.zero()]
    found, reference = solve_refine(*problem), centralized_result(problem, range(2))
    assert len(reference.candidates) > 1
    assert not reference.certified
    assert not found.certified
    assert min(compute_angle(found.rotation, other) for other in reference.candidates) < 1e-7


@pytest.mark.parametrize("seed", range(6))
def test_refine_escapes_the_saddle(seed: int) -> None:
    """As on real recordings: an arc, a flat body, unequal numbers of matches.

    ADMM starts near a saddle between two mirrored minima, far from both and hardly higher.
    """
    rng = np.random.default_rng(seed)
    rig = arc(4, 38.0)
    pair = simulate_matches(rig, ellipsoid((0.15, 0.15, 0.05)), random_motion(10.0, 0.02, rng), rng=rng)
    counts = (60, 20, 40, 10)
    moments = [PairMoments.from_matches(m.x[:n], m.y[:n]) for m, n in zip(pair.matches, counts, strict=True)]
    problem = np.array([c.rotation for c in rig]), moments
    reference, found = centralized_result(problem, range(4)), solve_refine(*problem)
    assert found.converged.all()
    assert found.rounds <= 100
    assert compute_angle(found.rotation, reference.rotation) < 1e-8
    assert found.certified == reference.certified
    assert found.status is reference.status


SHARED = DATA / "temple"


@pytest.mark.skipif(not SHARED.exists(), reason="the recordings are not here")
def test_refine_has_the_centralized_result_on_a_recording() -> None:
    session, before, n_certified = open_session(SHARED), None, 0
    for frames in islice(session.frames(), 4):
        now = [detect_features(i, c) for i, c in zip(frames.images, session.rig, strict=True) if i is not None]
        if before is not None:
            pairs = [match_features(a, b) for a, b in zip(before, now, strict=True)]
            matches = [
                Matches(a.normalized[p[:, 0]], b.normalized[p[:, 1]])
                for a, b, p in zip(before, now, pairs, strict=True)
            ]
            good = estimate_motion(session.rig, matches).inliers
            moments = [PairMoments.from_matches(m.x[i], m.y[i]) for m, i in zip(matches, good, strict=True)]
            problem = np.array([c.rotation for c in session.rig]), moments
            reference, found = centralized_result(problem, range(4)), solve_refine(*problem)
            # Only an observable rotation is the same from any start.
            is_certified = reference.certified and reference.status is Status.OK
            n_certified += is_certified
            assert found.converged.all()
            assert found.rounds <= 100
            if is_certified:
                check_agreement(found, reference, range(4))
        before = now
    assert n_certified > 0


@pytest.mark.parametrize("rig", [ring(4), arc(4, 40 / 3)])
@pytest.mark.parametrize("loss", [0.1, 0.3])
def test_loss_costs_rounds_only_for_slow_admm(rig: Rig, loss: float) -> None:
    problem = simulate_problem(rig)
    found, without = solve_refine(*problem, network_faults=NetworkFaults(loss=loss)), solve_refine(*problem)
    assert found.converged.all()
    np.testing.assert_array_equal(found.rotations, without.rotations)


@schemes
def test_camera_without_matches_has_the_common_result(solve: Solve) -> None:
    cameras, moments = simulate_problem(make_zigzag_rig(4))
    moments[2] = PairMoments.zero()
    check_agreement(solve(cameras, moments), centralized_result((cameras, moments), [0, 1, 3]), range(4))


GRAPHS = {
    "line": [(c, c + 1) for c in range(8)],
    "ring": [(c, (c + 1) % 9) for c in range(9)],
    "star": [(0, c) for c in range(1, 9)],
    "grid": [(c, c + 1) for c in range(9) if c % 3 < 2] + [(c, c + 3) for c in range(6)],
    "complete": [(a, b) for a in range(9) for b in range(a)],
}


@pytest.mark.parametrize("graph", GRAPHS.values(), ids=list(GRAPHS))
@pytest.mark.parametrize("loss", [pytest.param(0.0, marks=pytest.mark.slow), 0.3])
def test_gossip_on_any_graph(graph: list[tuple[int, int]], loss: float) -> None:
    problem = simulate_problem(dome(9))
    found = solve_gossip(*problem, graph=graph, network_faults=NetworkFaults(loss=loss))
    check_agreement(found, centralized_result(problem, range(9)), range(9))
    assert found.rounds < 100


# --- With faults -----------------------------------------------------------------------------------------------------


@schemes
@pytest.mark.parametrize(
    "network_faults",
    [
        *(
            pytest.param(f, marks=pytest.mark.slow)
            for f in (NetworkFaults(loss=0.3, seed=1), NetworkFaults(delay=3, seed=2))
        ),
        NetworkFaults(0.15, 2, seed=3),
    ],
)
def test_loss_and_delay_cost_rounds_only(solve: Solve, network_faults: NetworkFaults) -> None:
    problem = simulate_problem(make_zigzag_rig(5))
    without = solve(*problem)
    found = solve(*problem, network_faults=network_faults)
    check_agreement(found, centralized_result(problem, range(5)), range(5))
    assert found.rounds >= without.rounds


@schemes
def test_camera_that_fails_before_its_first_message_is_left_out(solve: Solve) -> None:
    problem, rest = simulate_problem(make_zigzag_rig(5)), [0, 1, 2, 4]
    found = (
        solve(*problem, graph=GRAPHS["complete"][:10], network_faults=NetworkFaults(dies={3: 0}))
        if solve is solve_gossip
        else solve(*problem, network_faults=NetworkFaults(dies={3: 0}))
    )
    check_agreement(found, centralized_result(problem, rest), rest)
    assert found.used == tuple(rest)
    assert np.isnan(found.rotations[3]).all()
    assert found.sent[3] == 0


def test_camera_that_fails_while_refining_is_left_out() -> None:
    problem, rest = simulate_problem(make_zigzag_rig(5)), [0, 1, 2, 4]
    for died in (1, 3, 10):
        found = solve_refine(*problem, network_faults=NetworkFaults(dies={3: died}))
        check_agreement(found, centralized_result(problem, rest), rest)


@pytest.mark.parametrize("solve", [solve_exchange, solve_gossip])
def test_camera_that_fails_after_it_has_sent_its_moments_is_used(solve: Solve) -> None:
    problem, rest = simulate_problem(make_zigzag_rig(5)), [0, 1, 2, 4]
    found = solve(*problem, network_faults=NetworkFaults(dies={3: 1}))
    check_agreement(found, centralized_result(problem, range(5)), rest)


def test_partitioned_network_does_not_converge() -> None:
    found = solve_gossip(
        *simulate_problem(make_zigzag_rig(5)), graph=GRAPHS["line"][:4], network_faults=NetworkFaults(dies={2: 1})
    )
    assert found.status is Status.NOT_CONVERGED
    assert found.spread > 1e-4


@given(st.data())
@settings(max_examples=8, deadline=None)
@schemes
def test_every_live_camera_has_the_centralized_result_with_any_faults(solve: Solve, data: st.DataObject) -> None:
    """Cameras that see nothing, start late, lose and delay messages, or die in the middle."""
    n = data.draw(st.integers(3, 6))
    cameras, moments = simulate_problem(make_zigzag_rig(n), data.draw(st.integers(0, 50)), turn=3.0)
    blind, late, dead = data.draw(st.permutations(range(n)))[:3]
    if data.draw(st.booleans()):
        moments[blind] = PairMoments.zero()
    network_faults = NetworkFaults(
        loss=data.draw(st.sampled_from([0.0, 0.1, 0.3])),
        delay=data.draw(st.integers(0, 3)),
        joins=data.draw(st.sampled_from([{}, {late: 3}, {late: 9}])),
        dies={dead: data.draw(st.integers(0, 40))} if n > 3 and data.draw(st.booleans()) else {},
        seed=data.draw(st.integers(0, 100)),
    )
    graph = {"graph": [(a, b) for a in range(n) for b in range(a)]} if solve is solve_gossip else {}
    found = solve(cameras, moments, network_faults=network_faults, **graph)
    live, used = [c for c in range(n) if c not in network_faults.dies], list(found.used)
    assert set(live) <= set(used)
    reference = solve_robust(cameras[used], [moments[c] for c in used])
    assume((reference.weights == 1).all())
    centralized = centralized_result((cameras, moments), used)
    assert found.status is centralized.status
    assert not found.faults
    assert found.converged[live].all()
    for c in live:
        assert compute_angle(found.rotations[c], centralized.rotation) < 1e-9
    np.testing.assert_allclose(found.information, centralized.information, rtol=1e-5, atol=1e-5)


@schemes
@pytest.mark.parametrize("loss", [0.0, 0.1])
def test_late_camera_is_used(solve: Solve, loss: float) -> None:
    problem = simulate_problem(make_zigzag_rig(5))
    check_agreement(
        solve(*problem, network_faults=NetworkFaults(loss=loss, joins={1: 6}, seed=4)),
        centralized_result(problem, range(5)),
        range(5),
    )


def test_late_camera_with_high_loss() -> None:
    cameras, matches, _ = noisy_problem(28, 5)
    moments = pair_moments(matches)
    found = solve_refine(cameras, moments, aim=False, network_faults=NetworkFaults(loss=0.35, joins={0: 13}, seed=28))
    check_agreement(found, solve_centralized(cameras, moments, aim=False), range(5))


# --- Faulty cameras --------------------------------------------------------------------------------------------------


def add_fault(problem: Problem, camera: int, kind: str, seed: int) -> Problem:
    """Add a faulty camera: junk matches, those of another body, a frozen image, or a calibration off by 90°."""
    Q, moments, rng = problem[0].copy(), list(problem[1]), np.random.default_rng(seed)
    x, y = 0.1 * rng.normal(size=(2, 60, 2))
    if kind == "junk":
        moments[camera] = PairMoments.from_matches(x, y)
    elif kind == "stranger":
        moments[camera] = simulate_problem(make_zigzag_rig(2), 100 + seed, turn=40.0)[1][1]
    elif kind == "frozen":
        moments[camera] = PairMoments.from_matches(x, x)
    else:
        axis = rng.normal(size=3)
        Q[camera] = Rotation.from_rotvec(axis / np.linalg.norm(axis) * np.pi / 2).as_matrix() @ Q[camera]
    return Q, moments


@schemes
@pytest.mark.parametrize("kind", ["junk", pytest.param("frozen", marks=pytest.mark.slow), "calibration"])
def test_faults_equal_those_of_the_robust_estimator(solve: Solve, kind: str) -> None:
    """Every camera, including the faulty but honest one, has its result."""
    named = 0
    for seed in range(2):
        problem = add_fault(simulate_problem(make_zigzag_rig(8), seed, turn=10.0), seed, kind, seed)
        expected, found = solve_robust(*problem), solve(*problem)
        assert set(found.faults) == {c for c, fault in enumerate(expected.faults) if fault is not None}
        assert found.status is expected.status
        named += set(found.faults) == {seed}
        for rotation in found.rotations:
            assert compute_angle(rotation, expected.rotation) < 1e-9
        for c, text in found.faults.items():
            assert text.startswith(f"camera {c}: ")
            assert kind in text
    assert named >= (1 if kind == "calibration" else 2)


@schemes
def test_two_cameras_that_disagree_are_not_called_consistent(solve: Solve) -> None:
    problem = add_fault(simulate_problem(make_zigzag_rig(2), 1, turn=20.0), 1, "stranger", 2)
    found = solve(*problem)
    assert solve_robust(*problem).status is Status.NOT_CONSISTENT
    assert found.status is Status.NOT_CONSISTENT
    assert not found.faults


@pytest.mark.parametrize("loss", [0.0, 0.3])
@pytest.mark.parametrize("graph", ["line", "star", "complete"])
def test_gossip_detects_a_faulty_camera_on_any_graph(graph: str, loss: float) -> None:
    problem = add_fault(simulate_problem(dome(9), 0, turn=10.0), 4, "junk", 0)
    found = solve_gossip(*problem, graph=GRAPHS[graph], network_faults=NetworkFaults(loss=loss, seed=1))
    check_agreement(found, centralized_result(problem, [c for c in range(9) if c != 4]), range(9))
    assert list(found.faults) == [4]


@pytest.mark.parametrize(
    "network_faults", [NetworkFaults(loss=0.3), NetworkFaults(delay=3), NetworkFaults(dies={2: 4})]
)
def test_faulty_camera_is_detected_with_loss_delay_and_failure(network_faults: NetworkFaults) -> None:
    problem = add_fault(simulate_problem(make_zigzag_rig(7), 0, turn=10.0), 5, "junk", 0)
    found = solve_refine(*problem, network_faults=network_faults)
    rest = [c for c in range(7) if c != 5 and c not in network_faults.dies]
    assert found.faults.keys() == {5}
    assert found.converged[rest].all()
    used = [c for c in found.used if c not in network_faults.dies]
    assert used == rest


@schemes
def test_all_junk_is_not_consistent(solve: Solve) -> None:
    rng = np.random.default_rng(0)
    cameras, _ = simulate_problem(make_zigzag_rig(4))
    moments = [PairMoments.from_matches(*(0.1 * rng.normal(size=(2, 60, 2)))) for _ in range(4)]
    expected, found = solve_robust(cameras, moments), solve(cameras, moments)
    assert found.status is expected.status
    assert set(found.faults) == {c for c, fault in enumerate(expected.faults) if fault is not None}


@pytest.mark.parametrize(("solve", "rounds"), [(solve_gossip, 1), (solve_refine, 8)])
def test_too_few_rounds_do_not_converge(solve: Solve, rounds: int) -> None:
    found = solve(*simulate_problem(make_zigzag_rig(6)), max_rounds=rounds)
    assert found.status is Status.NOT_CONVERGED
    assert found.rounds == rounds
    assert np.isnan(found.rotation).all()
    assert not found.information.any()


# --- Isolation of states ---------------------------------------------------------------------------------------------


def arrays(value: Any) -> list[FloatArray]:
    """Return all arrays in a state."""
    if isinstance(value, np.ndarray):
        return [value]
    if is_dataclass(value) and not isinstance(value, type):
        return [a for f in fields(value) for a in arrays(getattr(value, f.name))]
    if isinstance(value, dict):
        return [a for v in value.values() for a in arrays(v)]
    return [a for v in value for a in arrays(v)] if isinstance(value, tuple | list) else []


def refine_starts(problem: Problem) -> list[Callable[[], tuple[RefineState, list[Packet]]]]:
    cameras, moments = problem
    return [partial(start_refine, c, cameras, moments[c]) for c in range(len(cameras))]


def test_states_can_be_pickled() -> None:
    """Every state is pickled and unpickled between rounds, as if sent to another machine."""
    begin = refine_starts(simulate_problem(make_zigzag_rig(4)))

    def packed_step(state: RefineState, inbox: Inbox) -> tuple[RefineState, list[Packet]]:
        moved: RefineState = pickle.loads(pickle.dumps(state))
        return step_refine(moved, [(c, bytes(bytearray(data))) for c, data in inbox])

    network_faults = NetworkFaults(loss=0.05)
    here = run_network(begin, step_refine, network_faults, 300)
    there = run_network(begin, packed_step, network_faults, 300)
    assert here.rounds == there.rounds
    for a, b in zip(here.states, there.states, strict=True):
        for x, y in zip(arrays(a), arrays(b), strict=True):
            np.testing.assert_array_equal(x, y)


def test_states_of_different_cameras_share_no_memory() -> None:
    begin = refine_starts(simulate_problem(make_zigzag_rig(3)))
    states = run_network(begin, step_refine, NetworkFaults(loss=0.1), 300).states
    for a in range(3):
        for b in range(a):
            assert not any(np.shares_memory(x, y) for x in arrays(states[a]) for y in arrays(states[b]))


def test_the_same_seed_gives_the_same_run() -> None:
    problem = simulate_problem(make_zigzag_rig(4))
    a, b, c = (solve_refine(*problem, network_faults=NetworkFaults(0.2, 2, seed=s)) for s in (5, 5, 6))
    np.testing.assert_array_equal(a.rotations, b.rotations)
    np.testing.assert_array_equal(a.received, b.received)
    assert (a.received != c.received).any()


# --- Bad input --------------------------------------------------------------------------------------------------------


@schemes
def test_invalid_input_raises(solve: Solve) -> None:
    cameras, moments = simulate_problem(make_zigzag_rig(3))
    with pytest.raises(ValueError, match=r"rotations must be \(C, 3, 3\)"):
        solve(cameras[:2], moments)
    with pytest.raises(ValueError, match=r"rotations\[1\] is not a rotation"):
        solve([cameras[0], 2 * cameras[1], cameras[2]], moments)
    with pytest.raises(ValueError, match="no camera has matches"):
        solve(cameras, [PairMoments.zero()] * 3)
    with pytest.raises(ValueError, match=r"network_faults: no cameras \[3\]; there are cameras 0 to 2"):
        solve(cameras, moments, network_faults=NetworkFaults(dies={3: 1}))


def test_disconnected_graph_raises() -> None:
    with pytest.raises(ValueError, match="cameras 2 cannot reach camera 0"):
        solve_gossip(*simulate_problem(make_zigzag_rig(3)), graph=[(0, 1)])


def test_single_camera_keeps_its_solution() -> None:
    problem = simulate_problem(make_zigzag_rig(1))
    for solve in SCHEMES.values():
        found = solve(*problem)
        assert found.status in (Status.ROTATION_NOT_OBSERVABLE, Status.NOT_CONVERGED)
        assert not found.certified
    assert compute_angle(solve_exchange(*problem).rotation, centralized_result(problem, [0]).rotation) < 1e-12


@schemes
def test_exact_without_noise(solve: Solve) -> None:
    rng = np.random.default_rng(0)
    cameras, turn = general_cameras(rng, 5), draw_rotations(rng, 1)[0]
    found = solve(cameras, pair_moments(simulate_orthographic(rng, cameras, turn)), aim=False)
    assert found.status is Status.OK
    assert compute_angle(found.rotation, turn) < 1e-8
