"""Accuracy of live poses compared with smoothed ones, on rendered scenes and real recordings.

    python benchmarks/live.py [SCENE ...] [--recordings FOLDER] [--sets 14]

A live pose uses only the frames up to its own; a smoothed pose uses later frames too. The limit of live tracking is a
smoother that runs on all frames up to the current one. Its time grows with the square of the number of frames, so it only
serves as a reference, on up to --sets frames of each scene. Prints the median errors of the motion since the first frame
(live, smoothed with past frames only, smoothed), their ratios, and the share of the tracking time that the refinement of
recent frames takes. A scene is KIND:SEED of `benchmarks/kinds.py`, loop:SEED (`benchmarks/loops.py`), demo:SEED, or the
name of a recording in FOLDER.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np

from benchmarks.kinds import KINDS
from benchmarks.loops import RenderedSequence, render_demo, render_sequence
from sylpose import FramePose, open_session, track
from sylpose.geometry.arrays import FloatArray
from sylpose.report.files import read_tum
from sylpose.smoothing import Track, smooth_tracks
from sylpose.tracking.window import refine_window

SCENES = (
    *(f"loop:{seed}" for seed in range(6)),
    "demo:0",
    "demo:1",
    *(
        f"{kind}:{seed}"
        for kind in ("stands-fast", "creeps", "rod", "plain", "jumps-15", "jumps-25")
        for seed in range(2)
    ),
    "temple",
    "board4",
)


class LiveComparison(NamedTuple):
    """Median errors (2,) of one scene, degrees and millimeters, and the refinement's share of the tracking time."""

    live: FloatArray
    past_only: FloatArray
    smoothed: FloatArray
    refinement_share: float
    seconds: float


def load_scene(name: str, recordings: Path) -> RenderedSequence:
    """Load or render a scene by its name, with the object's true poses.

    Raises:
        KeyError: the kind is unknown.
        OSError, ValueError: the recording cannot be read.
    """
    kind, _, seed = name.partition(":")
    if kind == "loop":
        return render_sequence(int(seed))
    if kind == "demo":
        return render_demo(frames=60, seed=int(seed))
    if seed:
        variation = KINDS[kind](np.random.default_rng([int(seed), *kind.encode()]))
        return RenderedSequence(
            variation.scene.rig, list(variation.frames()), variation.boxes or {}, variation.scene.object_poses()
        )
    session = open_session(recordings / name)
    return RenderedSequence(
        session.rig, list(session.frames()), session.boxes, read_tum(session.path / "groundtruth.tum")[1]
    )


def compare_live(scene: RenderedSequence, n_frames: int) -> LiveComparison:
    """Track a scene; smooth up to `n_frames` of its frames with past frames only."""
    refinement_seconds = [0.0]

    def timed_refinement(*arguments: Any) -> Any:
        start = time.perf_counter()
        out = refine_window(*arguments)
        refinement_seconds[0] += time.perf_counter() - start
        return out

    start = time.perf_counter()
    with patch("sylpose.tracking.map_update.refine_window", timed_refinement):
        tracks = [Track.from_tracked(frame) for frame in track(scene.frames, scene.rig, scene.boxes)]
    seconds = time.perf_counter() - start
    measured = [k for k, t in enumerate(tracks) if t.pose.is_measured]
    chosen = [measured[i] for i in np.unique(np.linspace(1, len(measured) - 1, n_frames).astype(int))]
    live = [t.pose for t in tracks]
    past = {k: smooth_tracks(tracks[: k + 1], scene.rig).poses[k] for k in chosen}
    smoothed = smooth_tracks(tracks, scene.rig).poses
    first = measured[0]
    errors = [
        np.median([compute_error_norms(scene, first, live[first], k, poses[k]) for k in chosen], axis=0)
        for poses in (live, past, smoothed)
    ]
    return LiveComparison(errors[0], errors[1], errors[2], refinement_seconds[0] / seconds, seconds)


def compute_error_norms(scene: RenderedSequence, first: int, start: FramePose, k: int, pose: FramePose) -> FloatArray:
    """Return the error (2,) of the motion since the first frame: degrees, and millimeters of the object's center."""
    error_vector = compute_error_vector(scene, first, start, k, pose)
    return np.array([np.degrees(np.linalg.norm(error_vector[:3])), 1e3 * np.linalg.norm(error_vector[3:])])


def compute_error_vector(scene: RenderedSequence, first: int, start: FramePose, k: int, pose: FramePose) -> FloatArray:
    """Return the error (6,) of the motion since the first frame: rotation vector, translation of the object's center."""
    assert start.world_from_object is not None
    assert pose.world_from_object is not None
    true = scene.world_from_object[k] * scene.world_from_object[first].inv()
    motion, center = pose.world_from_object * start.world_from_object.inv(), start.world_from_object.translation
    rotation_error = (motion.rotation * true.rotation.inv()).as_rotvec()
    return np.concatenate([rotation_error, motion.apply(center) - true.apply(center)])


def format_row(name: str, comparison: LiveComparison) -> str:
    """Format one row of the table."""
    errors = " | ".join(
        f"{deg:.3f}, {mm:.2f}" for deg, mm in (comparison.live, comparison.past_only, comparison.smoothed)
    )
    ratios = " | ".join(
        f"{a[0] / b[0]:.2f}, {a[1] / b[1]:.2f}"
        for a, b in ((comparison.live, comparison.past_only), (comparison.past_only, comparison.smoothed))
    )
    return f"| {name} | {errors} | {ratios} | {100 * comparison.refinement_share:.0f} % of {comparison.seconds:.1f} s |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", default=SCENES)
    parser.add_argument("--recordings", type=Path, default=Path("../shared/data"))
    parser.add_argument("--sets", type=int, default=14)
    options = parser.parse_args()
    print(
        "| scene | live: deg, mm | smoothed with past frames only | smoothed | live / past only | past only / smoothed "
        "| refinement time |"
    )
    print("|---|---|---|---|---|---|---|")
    for name in options.scenes:
        print(format_row(name, compare_live(load_scene(name, options.recordings), options.sets)), flush=True)


if __name__ == "__main__":
    main()
