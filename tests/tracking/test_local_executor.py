"""`LocalExecutor`: calls of all cameras on a few threads, the calling one among them."""

from __future__ import annotations

import threading
import time
from contextlib import closing

import pytest

from sylpose.tracking.context import LocalExecutor


@pytest.mark.parametrize("workers", [1, 2, 4, 9])
@pytest.mark.parametrize("cameras", [1, 4, 7])
def test_results_are_in_the_order_of_the_cameras(cameras: int, workers: int) -> None:
    with closing(LocalExecutor(cameras, workers)) as executor:
        for _ in range(20):
            found = executor.run(lambda a, b: (a, b), range(cameras), range(10, 10 + cameras))
            assert found == [(c, 10 + c) for c in range(cameras)]


def test_no_more_threads_run_than_workers() -> None:
    seen = set()

    def call(camera: int) -> int:
        seen.add(threading.get_ident())
        time.sleep(0.002)
        return camera

    with closing(LocalExecutor(8, 3)) as executor:
        assert executor.run(call, range(8)) == list(range(8))
    assert threading.get_ident() in seen
    assert len(seen) <= 3


@pytest.mark.parametrize("workers", [1, 3])
@pytest.mark.parametrize("faulty", [(0,), (1,), (5,), (1, 2, 3)])
def test_the_first_error_arrives_after_all_threads_have_stopped(faulty: tuple[int, ...], workers: int) -> None:
    running, begun = set(), list[int]()

    def call(camera: int) -> int:
        running.add(camera)
        begun.append(camera)
        time.sleep(0.002)
        running.discard(camera)
        if camera in faulty:
            raise RuntimeError(f"camera {camera}")
        return camera

    with closing(LocalExecutor(12, workers)) as executor:
        for _ in range(10):
            begun.clear()
            with pytest.raises(RuntimeError, match=f"camera {faulty[0]}$"):
                executor.run(call, range(12))
            assert not running
            if workers == 1:  # no more calls begin after an error
                assert begun == list(range(faulty[0] + 1))
        faulty = ()  # the next calls are not affected
        assert executor.run(call, range(12)) == list(range(12))
