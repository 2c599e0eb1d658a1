"""BLAS has one thread while anything computes with small matrices, and as many as before afterwards."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from threading import Event
from typing import Any

import numpy as np
import pytest
import scipy.linalg  # noqa: F401 loads its library
from threadpoolctl import ThreadpoolController, threadpool_limits

from sylpose.bundle_adjustment import bundle
from sylpose.geometry.blas_threads import limit_blas_threads
from sylpose.runs.precompile import compile_bundle_adjustment


def count_threads() -> set[int]:
    return {library["num_threads"] for library in ThreadpoolController().info() if library["user_api"] == "blas"}


def test_one_thread_until_the_outer_limit_ends() -> None:
    with threadpool_limits(limits=2, user_api="blas"):
        before = count_threads()
        with limit_blas_threads():
            assert count_threads() == {1}
            with limit_blas_threads():
                assert np.linalg.norm(np.eye(3) @ np.eye(3)) == pytest.approx(np.sqrt(3.0))
            assert count_threads() == {1}
        assert count_threads() == before
        with pytest.raises(ValueError, match="wrong"), limit_blas_threads():
            raise ValueError("wrong")
        assert count_threads() == before


def test_limits_of_threads_that_overlap() -> None:
    """The one that began first ends first."""
    has_begun, may_end = Event(), Event()

    def limit_first() -> None:
        with limit_blas_threads():
            has_begun.set()
            assert may_end.wait(30.0)

    before = count_threads()
    with ThreadPoolExecutor(1) as pool:
        for _ in range(2):
            has_begun.clear()
            may_end.clear()
            first = pool.submit(limit_first)
            assert has_begun.wait(30.0)
            with limit_blas_threads():
                may_end.set()
                first.result()
                assert count_threads() == {1}
            assert count_threads() == before


def test_refinement_has_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    counts, minimize = list[set[int]](), bundle.minimize

    def count(*arguments: Any, **named: Any) -> Any:
        counts.append(count_threads())
        return minimize(*arguments, **named)

    monkeypatch.setattr(bundle, "minimize", count)
    before = count_threads()
    compile_bundle_adjustment()
    assert counts
    assert all(own == {1} for own in counts)
    assert count_threads() == before
