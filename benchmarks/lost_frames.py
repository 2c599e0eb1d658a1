"""Cost of frames in which the object is lost, as a multiple of tracked frames of the same run, and how soon it is found.

    python benchmarks/lost_frames.py [SCENE ...] [--cameras 2 4] [--sizes 640x480 1280x720] [--seeds 0:1] [--each]
                                     [--rate FRAMES_PER_SECOND]

A rendered block rotates by a degree per frame and is lost for 32 frames:

- *gone*: it vanishes from all images, and comes back as it was moved on.
- *leaves*: it leaves all views sideways, and comes back by the same way.
- *hidden*: a board stands before it in every camera.
- *returns*: it vanishes, and comes back elsewhere, with the view of an earlier frame.

Each frame set is processed in one thread, whose processor time counts; refinements in the background do not. A *tracked*
frame is one with the status tracked after the first twelve; the median of all of them is the unit. Columns are the cost of
frames without a measured pose (median, 90th percentile, worst), the cost of the dearest frame with one, the number of
frames from the return to the first measured pose, and the worst rotation error of the frames measured after the return,
degrees.

With `--rate`, frame sets arrive at that rate, as from live cameras, and those that the tracker has no time for are dropped,
except for the newest one. The costs are then the lateness of poses, from the arrival of the images to the end of their step,
with all threads. Their unit is the frame interval. *Start* are the first twelve frames.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import replace
from typing import NamedTuple
from unittest.mock import patch

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose import FrameSet
from sylpose.frames import Box
from sylpose.geometry.arrays import FloatArray
from sylpose.simulate import Actor, Scene, compute_demo_truth, make_demo_scene, render_frames
from sylpose.simulate.render import Path
from sylpose.status import FrameStatus
from sylpose.tracking.context import LocalExecutor
from sylpose.tracking.search_clock import SearchClock
from sylpose.tracking.tracker import Tracker

N_FRAMES, N_WARM_UP, LOST, RETURN = 84, 12, 32, 64
AWAY = RigidTransform.from_translation([0.0, 50.0, 0.0])
Change = Callable[[Scene], Scene]


def _with_path(scene: Scene, path: Path, others: Iterable[Actor] = ()) -> Scene:
    return replace(scene, actors=(Actor(scene.actors[0].body, path), *others))


def vanish(scene: Scene) -> Scene:
    """Remove the object for a while; it moves on meanwhile."""
    path = scene.actors[0].path
    return _with_path(scene, lambda frame: AWAY if LOST <= frame < RETURN else path(frame))


def leave(scene: Scene) -> Scene:
    """Move the object out of all views within some frames, and back."""
    path, middle = scene.actors[0].path, 0.5 * (LOST + RETURN - 1)

    def detour(frame: float) -> RigidTransform:
        # It is out of view at a distance of about four of its sizes.
        share = np.clip((0.5 * (RETURN - LOST) + 6 - abs(frame - middle)) / 10.0, 0.0, 1.0)
        return RigidTransform.from_translation([0.0, 2.5 * share**2, 0.0]) * path(frame)

    return _with_path(scene, detour)


def hide(scene: Scene) -> Scene:
    """Put a board before the object in every camera, for a while."""
    path, body = scene.actors[0].path, scene.actors[0].body
    target = path(0.5 * N_FRAMES).translation
    boards = []
    for camera in scene.rig:
        # Another block, enlarged, halfway to the camera.
        place = RigidTransform.from_translation(0.55 * target + 0.45 * camera.center)
        other = replace(
            body, vertices=0.75 * body.vertices, textures=tuple(texture[::-1, ::-1].copy() for texture in body.textures)
        )
        boards.append(Actor(other, lambda frame, place=place: place if LOST <= frame < RETURN else AWAY))  # type: ignore[misc]
    return replace(scene, actors=(*scene.actors, *boards))


def come_back_elsewhere(scene: Scene) -> Scene:
    """Remove the object for a while; it returns elsewhere with the views of earlier frames."""
    path = scene.actors[0].path

    def jump(frame: float) -> RigidTransform:
        if frame < LOST:
            return path(frame)
        earlier = path(frame - RETURN + 4)
        return (
            AWAY
            if frame < RETURN
            else RigidTransform.from_translation(path(frame).translation - earlier.translation) * earlier
        )

    return _with_path(scene, jump)


SCENES: dict[str, Change] = {"gone": vanish, "leaves": leave, "hidden": hide, "returns": come_back_elsewhere}


HEADER = (
    "| scene | cameras | size | seed | tracked, ms | start: median, worst | lost: median, 90 %, worst | found: worst "
    "| found after | degrees | dropped |\n" + "|---" * 11 + "|"
)


class Costs(NamedTuple):
    """Costs of one run, in tracked frames, or its lateness, in frame intervals.

    Attributes:
        start: (n,) of the first frames.
        lost: (n,) of the frames without a measured pose while the object is away.
        found: of the dearest frame with a measured pose after the warm-up.
        delay: number of frames from the return to the first measured pose.
        degrees: largest rotation error after that; NaN without any.
        tracked_ms: of a tracked frame, milliseconds.
        dropped: number of frames that the tracker had no time for.
        statuses: of all frames.
    """

    start: FloatArray
    lost: FloatArray
    found: float
    delay: int
    degrees: float
    tracked_ms: float
    dropped: int
    statuses: tuple[str, ...]


def play_live(sets: Sequence[FrameSet], rate: float) -> Iterator[tuple[FrameSet, float]]:
    """Yield frame sets and their arrival times, at a rate; of those that arrive meanwhile only the newest one."""
    begin, k = time.perf_counter(), 0
    while k < len(sets):
        time.sleep(max(begin + k / rate - time.perf_counter(), 0.0))
        k = min(max(k, int(rate * (time.perf_counter() - begin))), len(sets) - 1)
        yield sets[k], begin + k / rate
        k += 1


def measure_costs(name: str, cameras: int, size: tuple[int, int], seed: int, rate: float = 0.0) -> Costs:
    """Track a scene in one thread and measure each frame's processor time; with a rate its lateness, with all threads."""
    demo = make_demo_scene(frames=N_FRAMES, angle_deg=1.0 * N_FRAMES, size=size, n_cameras=cameras, seed=seed)
    scene = SCENES[name](demo)
    truth, none = compute_demo_truth(scene), (None,) * cameras
    boxes = {camera: Box(*box) for camera, box in truth.boxes.items()}
    run_here = lambda _, function, *arguments: list(map(function, *arguments))  # noqa: E731
    here = nullcontext() if rate else patch.object(LocalExecutor, "run", run_here)
    seconds, poses, interval = [], [], 1.0 / (rate or 30.0)
    with here, Tracker(scene.rig, boxes, seed=seed, search_clock=SearchClock() if rate else None) as tracker:
        rendered = enumerate(render_frames(scene))
        sets = (FrameSet(k, k * interval, none, its, none, interval=interval) for k, its in rendered)
        for frames, arrival in play_live([*sets], rate) if rate else ((own, 0.0) for own in sets):
            start = time.thread_time()
            poses += [frame.pose for frame in tracker.step(frames)]
            seconds.append(time.perf_counter() - arrival if rate else time.thread_time() - start)
    costs, numbers = np.array(seconds), np.array([pose.index for pose in poses])
    is_measured = np.array([pose.is_measured for pose in poses])
    is_tracked = np.array([pose.status is FrameStatus.TRACKED for pose in poses]) & (numbers >= N_WARM_UP)
    tracked = float(np.median(costs[is_tracked]))
    unit = interval if rate else tracked
    after = np.flatnonzero(is_measured & (numbers >= RETURN))
    errors = [
        np.degrees((truth.world_from_object[numbers[k]].inv() * pose).rotation.magnitude())
        for k in after
        if (pose := poses[k].world_from_object) is not None
    ]
    return Costs(
        costs[numbers < N_WARM_UP] / unit,
        costs[~is_measured & (numbers >= N_WARM_UP)] / unit,
        float(costs[is_measured & (numbers >= N_WARM_UP)].max() / unit),
        int(numbers[after[0]] - RETURN) if len(after) else N_FRAMES - RETURN,
        float(max(errors, default=np.nan)),
        1e3 * tracked,
        N_FRAMES - len(poses),
        tuple(pose.status.value for pose in poses),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help=", ".join(SCENES))
    parser.add_argument("--cameras", type=int, nargs="+", default=[2, 4])
    parser.add_argument("--sizes", nargs="+", default=["640x480", "1280x720"])
    parser.add_argument("--seeds", default="0:1", help="first:end")
    parser.add_argument("--rate", type=float, default=0.0, help="frame sets per second, as from live cameras")
    parser.add_argument("--each", action="store_true", help="print the cost of each frame")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    first, _, end = options.seeds.partition(":")
    if options.rate:
        measure_costs("gone", 2, (320, 240), 0)  # loads what is compiled
    print(HEADER)
    for name in options.scenes or SCENES:
        for cameras in options.cameras:
            for size in options.sizes:
                for seed in range(int(first), int(end or int(first) + 1)):
                    width, height = map(int, size.split("x"))
                    costs = measure_costs(name, cameras, (width, height), seed, options.rate)
                    lost = costs.lost if len(costs.lost) else np.array([np.nan])
                    cells = f"{np.median(lost):.1f}, {np.quantile(lost, 0.9):.1f}, {lost.max():.1f} | {costs.found:.1f}"
                    print(
                        f"| {name} | {cameras} | {size} | {seed} | {costs.tracked_ms:.0f} | {np.median(costs.start):.1f}, "
                        f"{costs.start.max():.1f} | {cells} | {costs.delay} | {costs.degrees:.2f} | {costs.dropped} |",
                        flush=True,
                    )
                    if options.each:
                        print(costs.statuses, np.round(costs.lost, 1))


if __name__ == "__main__":
    main()
