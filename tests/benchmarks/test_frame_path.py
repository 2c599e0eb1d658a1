"""An ordinary frame can be followed from the image to the pose: few files, and no call upwards."""

from __future__ import annotations

from benchmarks.frame_path import choose_median, compute_floors, record_paths

# Largest number of files, with those of `geometry` and the root, and of returns to a higher floor.
MAX_FILES, MAX_RETURNS = 20, 30


def test_floors_follow_the_imports() -> None:
    floors = compute_floors()
    assert floors["geometry.arrays"] == 0
    assert floors["tracking.tracker"] > floors["tracking.state_machine"] > floors["tracking.pose_search"]
    assert floors["tracking.pose_search"] > floors["tracking.context"] > floors["tracking.camera_side.camera"]


def test_ordinary_frame_reads_top_down() -> None:
    paths = [path for path in record_paths(30) if path.is_ordinary]
    assert paths
    path = choose_median(paths)
    assert path.calls[0].name == "TrackerBase.step"
    assert not path.upwards
    assert 10 < path.files <= MAX_FILES
    assert 0 < path.returns <= MAX_RETURNS
