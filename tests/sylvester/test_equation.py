"""Sylvester's equation and its generalized form: exactness, agreement, equivariance, detection of singular ones."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import linalg
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import kron
from sylpose.sylvester import equation
from sylpose.sylvester.equation import Method, SingularSylvesterError, solve_generalized_sylvester, solve_sylvester

seeds = st.integers(0, 2**32 - 1)
sizes = st.integers(1, 5)
batches = st.sampled_from([(), (3,), (2, 3), (0,)])
methods: list[Method] = ["kronecker", "bartels-stewart"]
each_method = pytest.mark.parametrize("method", methods)
quick = settings(max_examples=12, deadline=None)


def random_matrix(rng: np.random.Generator, *values: complex, condition: float = 10.0) -> FloatArray:
    """Return a matrix with these eigenvalues (one per complex pair), non-normal by `condition`."""
    blocks = [[[v.real, v.imag], [-v.imag, v.real]] if v.imag else [[v.real]] for v in map(complex, values)]
    d = linalg.block_diag(*blocks)
    u, v = (linalg.qr(rng.normal(size=d.shape))[0] for _ in range(2))
    basis = u @ np.diag(np.geomspace(1, condition, len(d))) @ v
    return np.asarray(basis @ d @ np.linalg.inv(basis))


# --- Solutions --------------------------------------------------------------------------------------------------------


@given(seeds, sizes, sizes, batches)
@quick
def test_two_sided_equation_solves_and_equals_scipy(seed: int, m: int, n: int, batch: tuple[int, ...]) -> None:
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(*batch, m, m)) + 6 * np.eye(m)
    b, c = rng.normal(size=(n, n)) + 6 * np.eye(n), rng.normal(size=(*batch, m, n))
    for method in methods:
        solution = solve_sylvester(a, b, c, method)
        assert solution.shape == c.shape
        np.testing.assert_allclose(a @ solution + solution @ b, c, atol=1e-12)
        for i in np.ndindex(*batch):
            np.testing.assert_allclose(solution[i], linalg.solve_sylvester(a[i], b, c[i]), atol=1e-12)


@given(seeds, sizes, sizes, st.integers(1, 4), batches)
@quick
def test_generalized_equation_solves(seed: int, m: int, n: int, terms: int, batch: tuple[int, ...]) -> None:
    rng = np.random.default_rng(seed)
    # Positive definite terms: the sum of their Kronecker products is regular.
    half_a, half_b = rng.normal(size=(terms, *batch, m, m)), rng.normal(size=(terms, n, n))
    a = half_a @ np.swapaxes(half_a, -1, -2) + 0.1 * np.eye(m)
    b = half_b @ np.swapaxes(half_b, -1, -2) + 0.1 * np.eye(n)
    x = rng.normal(size=(*batch, m, n))
    c = sum((a[k] @ x @ b[k] for k in range(terms)), start=np.zeros(()))
    for method in methods[: 2 if terms <= 2 else 1]:
        np.testing.assert_allclose(solve_generalized_sylvester(list(a), list(b), c, method), x, atol=1e-8)


@given(seeds, sizes, sizes)
@quick
def test_the_two_sided_equation_is_a_generalized_one(seed: int, m: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    a, b, c = rng.normal(size=(m, m)) + 6 * np.eye(m), rng.normal(size=(n, n)) + 6 * np.eye(n), rng.normal(size=(m, n))
    for method in methods:
        general = solve_generalized_sylvester([a, np.eye(m)], [np.eye(n), b], c, method)
        np.testing.assert_allclose(general, solve_sylvester(a, b, c), atol=1e-12)


@pytest.mark.parametrize("method", methods)
def test_regular_equation_of_singular_matrices(method: Method) -> None:
    """All four matrices are singular: a reduction to a two-sided equation does not exist."""
    rng = np.random.default_rng(0)
    u, v, p, q = (random_matrix(rng, 1, 2, 3) for _ in range(4))
    a = [u @ np.diag([1.0, 0, 2]) @ v, u @ np.diag([0.0, 1, 3]) @ v]
    b = [p @ np.diag([1.0, 2, 0]) @ q, p @ np.diag([0.5, 0, 1]) @ q]
    x = rng.normal(size=(3, 3))
    with pytest.raises(SingularSylvesterError, match="rank 7 for 9 unknowns"):
        solve_generalized_sylvester(a, b, x, method)  # e2 (0 : 1) corresponds to (1 : 0), e1 (1 : 0) to (0 : 1)
    b[0] = p @ np.diag([1.0, 2, 1]) @ q
    b[1] = p @ np.diag([0.5, 1, 0.0]) @ q
    a[1] = u @ np.diag([0.0, 1, 0]) @ v
    with pytest.raises(SingularSylvesterError, match="rank 8 for 9 unknowns"):
        solve_generalized_sylvester(a, b, x, method)
    a[1] = u @ np.diag([0.0, 1, 3]) @ v
    b[1] = p @ np.diag([0.5, 1, 0.1]) @ q
    c = sum((s @ x @ t for s, t in zip(a, b, strict=True)), start=np.zeros(()))
    np.testing.assert_allclose(solve_generalized_sylvester(a, b, c, method), x, atol=1e-9)


@each_method
def test_complex_eigenvalues_are_solved(method: Method) -> None:
    rng = np.random.default_rng(1)
    a, b = random_matrix(rng, 1 + 2j, 3, 0.5 + 1e-3j), random_matrix(rng, 2 + 1j, -0.1 + 7j)
    x = rng.normal(size=(5, 4))
    np.testing.assert_allclose(solve_sylvester(a, b, a @ x + x @ b, method), x, atol=1e-11)


@given(seeds)
@quick
def test_solution_follows_a_change_of_basis_and_the_transpose(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b, c = random_matrix(rng, 1, 2 + 1j), random_matrix(rng, 0.5, 4), rng.normal(size=(3, 2))
    u, v = random_matrix(rng, 1, 2, 3), random_matrix(rng, 1, -2)
    for method in methods:
        n = solve_sylvester(a, b, c, method)
        there = solve_sylvester(u @ a @ np.linalg.inv(u), v @ b @ np.linalg.inv(v), u @ c @ np.linalg.inv(v), method)
        np.testing.assert_allclose(there, u @ n @ np.linalg.inv(v), rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(solve_sylvester(b.T, a.T, c.T, method), n.T, atol=1e-10)


@given(seeds, st.sampled_from([1e-300, 1e-200, 1.0, 1e200, 1e300]), st.sampled_from([1e-200, 1.0, 1e200]))
@quick
def test_invariant_to_scale(seed: int, scale: float, of_c: float) -> None:
    rng = np.random.default_rng(seed)
    a, b, c = rng.normal(size=(3, 3)) + 6 * np.eye(3), rng.normal(size=(2, 2)) + 6 * np.eye(2), rng.normal(size=(3, 2))
    singular = np.diag([1.0, 2, 3]), np.diag([-2.0, 5])
    for method in methods:
        expected = solve_sylvester(a, b, c, method)
        np.testing.assert_allclose(solve_sylvester(scale * a, scale * b, scale * c, method), expected, rtol=1e-9)
        np.testing.assert_allclose(solve_sylvester(a, b, of_c * c, method) / of_c, expected, rtol=1e-9)
        general = solve_generalized_sylvester(
            [scale * a, np.eye(3)], [np.eye(2) / scale, b], c, method
        )  # a balanced sum of unbalanced terms
        np.testing.assert_allclose(general, expected, rtol=1e-9)
        with pytest.raises(SingularSylvesterError, match="eigenvalues collide"):
            solve_sylvester(scale * singular[0], scale * singular[1], c, method)


@given(seeds)
@quick
def test_perturbation_of_the_solution(seed: int) -> None:
    """A dN + dN B = dC - dA N - N dB, and |dN| <= |right side| / σ."""
    rng = np.random.default_rng(seed)
    a, b, c = random_matrix(rng, 1, 2 + 1j), random_matrix(rng, 0.5, 4), rng.normal(size=(3, 2))
    da, db, dc = (rng.normal(size=x.shape) for x in (a, b, c))
    sigma = np.linalg.svd(kron(a, np.eye(2)) + kron(np.eye(3), b.T), compute_uv=False)[-1]
    step = 1e-6
    for method in methods:
        n = solve_sylvester(a, b, c, method)
        right = dc - da @ n - n @ db
        moved = [solve_sylvester(a + h * da, b + h * db, c + h * dc, method) for h in (step, -step)]
        derivative = (moved[0] - moved[1]) / (2 * step)
        expected = solve_sylvester(a, b, right, method)
        np.testing.assert_allclose(derivative, expected, atol=1e-5 * max(1.0, np.abs(expected).max()))
        assert np.linalg.norm(expected) <= (1 + 1e-9) * np.linalg.norm(right) / sigma


def test_leading_axes_broadcast() -> None:
    rng = np.random.default_rng(2)
    a = rng.normal(size=(4, 1, 3, 3)) + 6 * np.eye(3)
    b, c = rng.normal(size=(5, 2, 2)) + 6 * np.eye(2), rng.normal(size=(2, 1, 1, 3, 2))
    for method in methods:
        solution = solve_sylvester(a, b, c, method)
        assert solution.shape == (2, 4, 5, 3, 2)
        np.testing.assert_allclose(a @ solution + solution @ b, np.broadcast_to(c, solution.shape), atol=1e-12)


def test_large_equations_never_form_the_kronecker_product(monkeypatch: pytest.MonkeyPatch) -> None:
    def forbidden(*_: object) -> None:
        raise AssertionError("a Kronecker product was formed")

    monkeypatch.setattr(equation, "kron", forbidden)
    rng = np.random.default_rng(3)
    n = 120
    a, b, x = (rng.normal(size=(n, n)) / np.sqrt(n) + s * np.eye(n) for s in (3, 3, 0))
    np.testing.assert_allclose(solve_sylvester(a, b, a @ x + x @ b), x, atol=1e-11)
    c = a @ x @ b + b @ x @ a
    np.testing.assert_allclose(solve_generalized_sylvester([a, b], [b, a], c), x, atol=1e-10)
    with pytest.raises(SingularSylvesterError, match="eigenvalues collide"):
        solve_sylvester(a, -a, c)
    with pytest.raises(SingularSylvesterError, match="eigenvalues collide"):
        solve_generalized_sylvester([a, b], [b, -a], c)


# --- Singular equations -----------------------------------------------------------------------------------------------


@each_method
@pytest.mark.parametrize("seed", range(5))
def test_shared_eigenvalue_is_reported(seed: int, method: Method) -> None:
    rng = np.random.default_rng(seed)
    a, b = random_matrix(rng, 1.0, 2.5, 4.0), random_matrix(rng, -2.5, 7.0)
    number = r"2\.(50*\d?|49999\d+)"
    with pytest.raises(SingularSylvesterError, match=rf"eigenvalues collide, {number} of A with {number} of -B$"):
        solve_sylvester(a, b, np.ones((3, 2)), method)


@each_method
def test_shared_complex_pair_is_reported(method: Method) -> None:
    a = np.array([[1.0, -2], [2, 1]])
    with pytest.raises(
        SingularSylvesterError, match=r"collide, 1\+2j of A with 1\+2j of -B; 1-2j of A with 1-2j of -B$"
    ):
        solve_sylvester(a, -a.T, np.ones((2, 2)), method)


@each_method
def test_scalar_equations(method: Method) -> None:
    assert solve_sylvester([[2.0]], [[1.0]], [[6.0]], method) == 2.0
    for a, b in ((2.0, -2.0), (0.0, 0.0), (1.0, -1.0 - 1e-13)):
        with pytest.raises(SingularSylvesterError, match="of A with"):
            solve_sylvester([[a]], [[b]], [[6.0]], method)


@given(seeds, st.floats(3, 15.5))
@quick
def test_singularity_threshold_of_both_methods(seed: int, digits: float) -> None:
    rng = np.random.default_rng(seed)
    u, v = (Rotation.random(rng=rng).as_matrix() for _ in range(2))
    gap = 10.0**-digits
    a, b = u @ np.diag([1.0, 2, 3]) @ u.T, v @ np.diag([-2 - gap, 5.0, 7]) @ v.T
    x = rng.normal(size=(3, 3))
    c = a @ x + x @ b
    for method in methods:
        # For normal matrices σ is the gap; the size is about 10.
        if gap > 1e-10:
            np.testing.assert_allclose(solve_sylvester(a, b, c, method), x, atol=1e-13 / gap)
        if gap < 1e-12:
            with pytest.raises(SingularSylvesterError, match="eigenvalues collide, 2 of A with 2"):
                solve_sylvester(a, b, c, method)
        if gap > 1e-13:
            solve_sylvester(a, b, c, method, rcond=0.01 * gap)
        with pytest.raises(SingularSylvesterError):
            solve_sylvester(a, b, c, method, rcond=2 * gap + 1e-15)


@each_method
@pytest.mark.parametrize("size", [2, 3, 5])
def test_shared_eigenvalue_of_jordan_blocks_raises(size: int, method: Method) -> None:
    """The computed eigenvalues differ by up to 1e-3; a test of the gaps alone would accept them as regular."""
    rng = np.random.default_rng(size)
    u, v = (random_matrix(rng, *range(1, size + 1)) for _ in range(2))
    jordan = 2 * np.eye(size) + np.eye(size, k=1)
    a, b = u @ jordan @ np.linalg.inv(u), -v @ jordan @ np.linalg.inv(v)
    with pytest.raises(SingularSylvesterError, match=r"(collide,|closest eigenvalues) .* of A with .* of -B"):
        solve_sylvester(a, b, np.ones((size, size)), method)


@each_method
def test_singular_despite_separated_eigenvalues(method: Method) -> None:
    """Non-normal matrices: eigenvalues 1, 2 and -1.5, -1.2, but |A N + N B| = 1e-26 |A| |N| for some N."""
    a, b = np.array([[1, 1e10], [0, 2]]), np.array([[-1.5, 1e6], [0, -1.2]])
    with pytest.raises(SingularSylvesterError, match=r"far from normal, closest eigenvalues 1 of A with 1\.2 of -B"):
        solve_sylvester(a, b, np.ones((2, 2)), method)


@given(seeds, st.integers(1, 12), st.integers(1, 12), st.sampled_from([1.0, 1e3, 1e6]))
@quick
def test_bartels_stewart_estimates_the_smallest_singular_value(seed: int, m: int, n: int, far: float) -> None:
    """Equations are regular or singular as the exact smallest singular value requires, up to a factor of ten."""
    rng = np.random.default_rng(seed)
    a, b = (np.triu(rng.normal(size=(k, k))) * far ** rng.uniform(size=(k, k)) for k in (m, n))
    system = np.kron(a, np.eye(n)) + np.kron(np.eye(m), b.T)
    expected = np.linalg.svd(system, compute_uv=False)
    if expected[-1] < 1e-12 * expected[0]:
        return
    size = sum(np.sqrt(np.linalg.norm(x, 1) * np.linalg.norm(x, np.inf)) for x in (a, b))
    c = rng.normal(size=(m, n))
    below, above = 0.99 * expected[-1] / size, 10.5 * expected[-1] / size

    def plain(rcond: float) -> FloatArray:
        return solve_sylvester(a, b, c, "bartels-stewart", rcond)

    def of_two_terms(rcond: float) -> FloatArray:
        return solve_generalized_sylvester([a, np.eye(m)], [np.eye(n), b], c, "bartels-stewart", rcond)

    for solve in (plain, of_two_terms):
        assert np.isfinite(solve(below)).all()
        if above < 1:
            with pytest.raises(SingularSylvesterError):
                solve(above)


@each_method
def test_singular_batch_index_is_reported(method: Method) -> None:
    a = np.array([np.diag([1.0, 2.0]), np.diag([1.0, 3.0])])
    b, c = np.diag([-3.0, 5.0]), np.ones((2, 2))
    end = "eigenvalues collide, 3 of A with 3 of -B$"
    with pytest.raises(SingularSylvesterError, match=rf"at index 1 of the batch is singular.*; {end}"):
        solve_sylvester(a, b, c, method)
    with pytest.raises(SingularSylvesterError, match=rf"at index 0, 1 of the batch is singular.*; {end}"):
        solve_sylvester(a, b, np.ones((4, 2, 2, 2)), method)
    with pytest.raises(SingularSylvesterError, match=rf"C is singular.*; {end}"):
        solve_sylvester(a[1], b, c, method)


def test_number_of_collisions_is_reported() -> None:
    with pytest.raises(SingularSylvesterError, match=r"; 897 more$"):
        solve_sylvester(np.eye(30), -np.eye(30), np.ones((30, 30)))


@each_method
def test_rank_and_null_vector_are_reported(method: Method) -> None:
    a = np.diag([1.0, 1.0, 0.0])  # one camera does not observe its axis
    with pytest.raises(SingularSylvesterError, match="rank 4 for 9 unknowns and the null vector X ="):
        solve_generalized_sylvester([a], [a], np.ones((3, 3)), method)
    with pytest.raises(
        SingularSylvesterError, match=r"rank 3 for 4 unknowns and the null vector X = \[\[0., 1.\], \[0., 0.\]\];"
    ):
        solve_generalized_sylvester([np.eye(2), np.diag([0.0, 1])], [np.diag([1.0, 0]), np.eye(2)], np.eye(2))
    assert issubclass(SingularSylvesterError, ValueError)


@each_method
def test_colliding_pencil_eigenvalues_are_reported(method: Method) -> None:
    rng = np.random.default_rng(4)
    u, v = random_matrix(rng, 1, 2, 3), random_matrix(rng, 1, 2)
    a = [u @ np.diag([1.0, 2, 3]), u]
    c = np.ones((3, 2))
    with pytest.raises(SingularSylvesterError, match=r"collide, 3 of A_1 - λ A_2 with 3 of B_2 \+ λ B_1$"):
        solve_generalized_sylvester(a, [v, np.diag([-3.0, 4]) @ v], c, method)
    # In other units the eigenvalues scale accordingly.
    with pytest.raises(SingularSylvesterError, match=r"collide, 3e-200 of A_1 - λ A_2 with 3e-200 of"):
        solve_generalized_sylvester([a[0], 1e200 * a[1]], [1e200 * v, np.diag([-3.0, 4]) @ v], c, method)
    # Infinite if A_2 and B_1 are singular; any number if A_1 and A_2 are singular with a common null vector.
    with pytest.raises(SingularSylvesterError, match="collide, inf of A_1 - λ A_2 with inf of B_2"):
        solve_generalized_sylvester([np.eye(3), np.diag([1.0, 1, 0])], [np.diag([0.0, 1]), np.eye(2)], c, method)
    both = np.diag([1.0, 2, 0])
    with pytest.raises(SingularSylvesterError, match="any number of A_1 - λ A_2 with"):
        solve_generalized_sylvester([both, both @ both], [np.eye(2), np.diag([1.0, 4])], c, method)


@each_method
def test_cancelling_terms_are_singular(method: Method) -> None:
    """A remainder of 1e-14 of the data is rounding, even if it is well-conditioned by itself."""
    a = np.eye(2)
    with pytest.raises(SingularSylvesterError, match="rank 0 for 4"):
        solve_generalized_sylvester([a, -(1 + 1e-14) * a], [a, a], a, method)


# --- Bad input --------------------------------------------------------------------------------------------------------


def test_invalid_equations_raise() -> None:
    eye = np.eye(2)
    with pytest.raises(ValueError, match="A must be square"):
        solve_sylvester(np.ones((2, 3)), eye, eye)
    with pytest.raises(ValueError, match="B must be a finite matrix"):
        solve_sylvester(eye, eye * np.nan, eye)
    with pytest.raises(ValueError, match=r"A must be a finite matrix .* got shape \(0, 0\)"):
        solve_sylvester(np.empty((0, 0)), eye, np.empty((0, 2)))
    with pytest.raises(ValueError, match="C must be 2x2"):
        solve_sylvester(eye, eye, np.ones((3, 2)))
    with pytest.raises(ValueError, match=r"do not broadcast: \(3,\), \(\), \(2,\)"):
        solve_sylvester(np.ones((3, 2, 2)), eye, np.ones((2, 2, 2)))
    with pytest.raises(ValueError, match='method must be "kronecker" or "bartels-stewart", got \'lu\''):
        solve_sylvester(eye, eye, eye, method="lu")  # type: ignore[arg-type]
    for rcond in (0.0, 1.0, -1e-9, np.nan):
        with pytest.raises(ValueError, match="rcond"):
            solve_sylvester(eye, eye, eye, rcond=rcond)
    for k, name in enumerate("ABC"):
        a, b, c = (eye * (1j if k == i else 1) for i in range(3))
        with pytest.raises(ValueError, match=f"{name} must be real"):
            solve_sylvester(a, b, c)
    with pytest.raises(ValueError, match=r"Bs\[1\] must be real"):
        solve_generalized_sylvester([eye, eye], [eye, 1j * eye], eye)
    with pytest.raises(ValueError, match="same length"):
        solve_generalized_sylvester([eye], [], eye)
    with pytest.raises(ValueError, match="same size"):
        solve_generalized_sylvester([eye, np.eye(3)], [eye, eye], eye)


def test_unsuitable_method_raises() -> None:
    with pytest.raises(ValueError, match="80x80 unknowns are too many for the Kronecker product"):
        solve_sylvester(np.eye(80), np.eye(80), np.eye(80), "kronecker")
    with pytest.raises(ValueError, match="at most two terms, got 3"):
        solve_generalized_sylvester([np.eye(2)] * 3, [np.eye(2)] * 3, np.eye(2), "bartels-stewart")


@each_method
def test_overflowing_solution_raises(method: Method) -> None:
    with pytest.raises(ValueError, match="exceeds the range of floating point numbers"):
        solve_sylvester([[1e-200]], [[1e-200]], [[1e200]], method)


@pytest.mark.parametrize("method", ["kronecker", "bartels-stewart"])
@pytest.mark.parametrize("right", [0.0, 1.0])
def test_the_zero_operator_is_singular(method: Method, right: float) -> None:
    zero, one, c = np.zeros((2, 2)), np.eye(2), right * np.eye(2)
    with pytest.raises(SingularSylvesterError, match="is singular"):
        solve_sylvester(zero, zero, c, method=method)
    for a, b in (([zero], [zero]), ([zero, zero], [zero, one]), ([zero, one], [one, zero]), ([zero], [one])):
        with pytest.raises(SingularSylvesterError, match="is singular"):
            solve_generalized_sylvester(a, b, c, method=method)
    with pytest.raises(SingularSylvesterError, match="at index 1 of the batch"):
        solve_generalized_sylvester([np.stack([one, zero])], [one], c, method=method)
