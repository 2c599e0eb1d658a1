"""A real Ray cluster of two nodes on this computer, one of which is killed during the work."""

from __future__ import annotations

import time
from collections.abc import Iterator
from concurrent.futures import Future
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from sylpose.archive.contract import Summary
from sylpose.archive.recordings import Recording
from sylpose.archive.run import RayWorkers, describe_death, process_all
from sylpose.io.stores import open_store
from tests.archive.archive_worker import count_work, make_recordings, make_settings
from tests.paths import REPOSITORY

if find_spec("ray") is None:
    pytest.skip("without the extra `cluster`", allow_module_level=True)
GB = 1 << 30


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """A head without cores, and two nodes with one core each."""
    # Importing it takes seconds.
    import ray
    from ray.cluster_utils import Cluster

    patch = pytest.MonkeyPatch()
    # The nodes are local processes; they import this checkout instead of an installed package.
    patch.setenv("PYTHONPATH", f"{REPOSITORY / 'src'}:{REPOSITORY}")
    patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    node = {"memory": GB, "object_store_memory": 100 << 20}
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False, **node})
    try:
        for _ in range(2):
            made.add_node(num_cpus=1, **node)
        yield made
    finally:
        ray.shutdown()
        made.shutdown()
        patch.undo()


def test_unusable_cluster_raises_one_sentence(cluster: Any, tmp_path: Path) -> None:
    import ray

    out = open_store(tmp_path / "out")
    with pytest.raises(ValueError, match=r"no computer in the cluster has 1 cores and 64.0 GB of memory"):
        RayWorkers(make_settings(out), cluster.address, memory=64 * GB)
    assert not ray.is_initialized()
    with pytest.raises(ValueError, match="other processes cannot see it"):
        RayWorkers(make_settings(open_store("memory://x")), cluster.address)


@pytest.mark.slow
def test_killed_node_only_delays(cluster: Any, tmp_path: Path) -> None:
    """It is killed during a recording that takes a minute, which the other node then finishes immediately."""
    folder, out = tmp_path / "in", open_store(tmp_path / "out")
    orders = {"a": "sleep-once 600", "b": "work", "c": "die", "d": "wrong", "e": "die-once", "f": "work"}
    recordings = make_recordings(folder, **orders)
    found: dict[str, Summary] = {}
    killed: list[Any] = []

    def take(recording: Recording, summary: Summary) -> None:
        assert recording.name not in found
        found[recording.name] = summary

    def look(*_: int) -> None:
        parent = folder / "a" / "sylpose" / "parent"
        if not killed and count_work(folder, "a") and len(found) > 1:
            killed.extend(node for node in nodes if raylet_of(node) == int(parent.read_text()))
            cluster.remove_node(killed[0], allow_graceful=False)

    nodes = list(cluster.worker_nodes)
    deaths: list[str] = []
    settings = make_settings(out, scratch=str(tmp_path / "scratch"))
    with RayWorkers(settings, cluster.address, memory=GB // 2) as workers:
        assert workers._count_slots() == 2
        submit = workers.submit

        def noted(recording: Recording) -> Future[Summary]:
            future = submit(recording)
            future.add_done_callback(
                lambda done: deaths.append(describe_death(error)) if (error := done.exception()) else None
            )
            return future

        workers.submit = noted  # type: ignore[method-assign]
        process_all(recordings, settings, workers, take, look)
        deadline = time.monotonic() + 60
        while workers._count_slots() > 1 and time.monotonic() < deadline:  # Ray may notice later
            time.sleep(0.1)
        assert workers._count_slots() == 1
    assert len(killed) == 1
    assert {name: summary.status for name, summary in found.items()} == {
        "a": "done",
        "b": "done",
        "c": "crashed",
        "d": "wrong input",
        "e": "done",
        "f": "done",
    }
    assert found["c"].error == "the worker died (WorkerCrashedError), 3 times"
    assert deaths.count("the computer was lost") == 1
    assert [count_work(folder, name) for name in "abcdef"] == [2, 1, 3, 1, 2, 1]
    assert out.read("a/threads") == b"1 1"
    assert {file.name for file in out.files()} == {
        *(f"{name}/{file}" for name in "abef" for file in ("done.json", "mug/trajectory.csv", "threads")),
        "c/failed.json",
        "d/failed.json",
    }


def raylet_of(node: Any) -> int:
    return int(node.all_processes["raylet"][0].process.pid)
