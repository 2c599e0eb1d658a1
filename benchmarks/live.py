"""How close do poses as tracked come to smoothed ones, and how close could they? Rendered scenes, and the real recordings.

    python benchmarks/live.py [SCENE ...] [--recordings FOLDER] [--sets 14]

A pose as it is tracked knows the frames up to it only, a smoothed one those after it, too. In between is what all frames
up to one tell together of its pose: they are smoothed anew for it, as if the recording ended there. That is no way to
track, since its time grows with the square of the frames, but it is as good as tracking can be. Prints, for up to so many
frames of each scene, the medians of the errors of the motion since the first frame: live, refined with the past, and
smoothed; their ratios; and what share of the tracking's time its own refinement of recent frames takes. A scene is
KIND:SEED of `benchmarks/kinds.py`, loop:SEED (`benchmarks/loops.py`), demo:SEED, or the name of a recording in FOLDER.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np

from benchmarks.kinds import KINDS
from benchmarks.loops import Turn, rendered, turn_of
from sylpose import FramePose, open_session, track
from sylpose.geometry.arrays import FloatArray
from sylpose.report.files import read_tum
from sylpose.smoothing.trajectory import Track, smooth
from sylpose.tracking.window import refined

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


class Compared(NamedTuple):
    """Median errors of one scene, (2,) degrees and millimetres; share: of the tracker's time, its own refinement's."""

    live: FloatArray
    past: FloatArray
    smoothed: FloatArray
    share: float
    seconds: float


def scene_of(name: str, recordings: Path) -> Turn:
    """A scene by its name, with the object's true poses.

    Raises:
        KeyError: no such kind. OSError, ValueError: no such recording.
    """
    kind, _, seed = name.partition(":")
    if kind == "loop":
        return turn_of(int(seed))
    if kind == "demo":
        return rendered(frames=60, seed=int(seed))
    if seed:
        take = KINDS[kind](np.random.default_rng([int(seed), *kind.encode()]))
        return Turn(take.scene.rig, list(take.frames()), take.boxes or {}, take.scene.poses())
    session = open_session(recordings / name)
    return Turn(session.rig, list(session.frames()), session.boxes, read_tum(session.path / "groundtruth.tum")[1])


def compared(scene: Turn, sets: int) -> Compared:
    """Tracks a scene; up to so many of its frames are smoothed with the past alone."""
    spent = [0.0]

    def timed(*arguments: Any) -> Any:
        start = time.perf_counter()
        out = refined(*arguments)
        spent[0] += time.perf_counter() - start
        return out

    start = time.perf_counter()
    with patch("sylpose.tracking.map_update.refined", timed):
        tracks = [Track.of(frame) for frame in track(scene.frames, scene.rig, scene.boxes)]
    seconds = time.perf_counter() - start
    measured = [k for k, t in enumerate(tracks) if t.pose.measured]
    chosen = [measured[i] for i in np.unique(np.linspace(1, len(measured) - 1, sets).astype(int))]
    live = [t.pose for t in tracks]
    past = {k: smooth(tracks[: k + 1], scene.rig).poses[k] for k in chosen}
    smoothed = smooth(tracks, scene.rig).poses
    first = measured[0]
    errors = [
        np.median([error(scene, first, live[first], k, poses[k]) for k in chosen], axis=0)
        for poses in (live, past, smoothed)
    ]
    return Compared(errors[0], errors[1], errors[2], spent[0] / seconds, seconds)


def error(scene: Turn, first: int, start: FramePose, k: int, pose: FramePose) -> FloatArray:
    """(2,) degrees, and millimetres of the object's centre, by which the motion since the first frame is off."""
    off = difference(scene, first, start, k, pose)
    return np.array([np.degrees(np.linalg.norm(off[:3])), 1e3 * np.linalg.norm(off[3:])])


def difference(scene: Turn, first: int, start: FramePose, k: int, pose: FramePose) -> FloatArray:
    """(6,) (w, d) by which the motion since the first frame is off, d of the object's centre."""
    assert start.world_from_object is not None
    assert pose.world_from_object is not None
    true = scene.world_from_object[k] * scene.world_from_object[first].inv()
    motion, center = pose.world_from_object * start.world_from_object.inv(), start.world_from_object.translation
    turn = (motion.rotation * true.rotation.inv()).as_rotvec()
    return np.concatenate([turn, motion.apply(center) - true.apply(center)])


def line(name: str, c: Compared) -> str:
    """One line of the table."""
    errors = " | ".join(f"{deg:.3f}, {mm:.2f}" for deg, mm in (c.live, c.past, c.smoothed))
    ratios = " | ".join(f"{a[0] / b[0]:.2f}, {a[1] / b[1]:.2f}" for a, b in ((c.live, c.past), (c.past, c.smoothed)))
    return f"| {name} | {errors} | {ratios} | {100 * c.share:.0f} % of {c.seconds:.1f} s |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", default=SCENES)
    parser.add_argument("--recordings", type=Path, default=Path("../shared/data"))
    parser.add_argument("--sets", type=int, default=14)
    options = parser.parse_args()
    print("| scene | live: degrees, mm | with the past | smoothed | live : past | past : smoothed | refinement |")
    print("|---|---|---|---|---|---|---|")
    for name in options.scenes:
        print(line(name, compared(scene_of(name, options.recordings), options.sets)), flush=True)


if __name__ == "__main__":
    main()
