"""Compiles what the tests will call, once and side by side, before they start: `python -m tests.compile_kernels`.

Two workers of the test run would else compile the same kernels at the same time. What is left out here is compiled when a
test calls it.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
from scipy.spatial.transform import Rotation

from sylpose import estimate_motion
from sylpose.absolute_pose.pose import estimate_pose
from sylpose.app.precompile import PARTS
from sylpose.geometry.arrays import FloatArray
from sylpose.matches import Matches
from sylpose.moments import PairMoments
from sylpose.relative_pose.precompile import warm_up
from sylpose.rig import Camera
from sylpose.simulate import ring
from sylpose.sylvester.centralized import solve_centralized
from sylpose.sylvester.depth_plane import solve_depth_plane

RIG = ring(3, height=(0.4, -0.1, 0.2))
POINTS = np.random.default_rng(0).uniform(-0.1, 0.1, (40, 3))
TURN = Rotation.from_rotvec([0.05, -0.03, 0.08])


def seen(turn: Rotation) -> Iterator[tuple[Camera, FloatArray]]:
    """The cameras, and the points (40, 2) as they see them turned."""
    for camera in RIG:
        yield camera, camera.normalize(camera.project(turn.apply(POINTS)))


def paper() -> None:
    pairs = zip(seen(Rotation.identity()), seen(TURN), strict=True)
    moments = [PairMoments.from_matches(x, y) for (_, x), (_, y) in pairs]
    rotations = [camera.rotation for camera in RIG]
    solve_centralized(rotations, moments)
    solve_centralized(rotations[:1], moments[:1])
    solve_depth_plane(rotations, moments)


def absolute_pose() -> None:
    estimate_pose(RIG, [POINTS] * len(RIG), [camera.project(TURN.apply(POINTS)) for camera in RIG])


def two_bodies() -> None:
    both = [zip(seen(Rotation.identity()), seen(turn), strict=True) for turn in (TURN, TURN.inv() * TURN.inv())]
    matches = [[Matches(x, y) for (_, x), (_, y) in pairs] for pairs in both]
    joined = [Matches(np.vstack([a.x, b.x[::2]]), np.vstack([a.y, b.y[::2]])) for a, b in zip(*matches, strict=True)]
    estimate_motion(RIG, joined)
    estimate_motion(RIG, [*matches[0][:2], matches[1][2]])


def timed(part: Callable[[], None]) -> str:
    start = time.process_time()
    part()
    return f"{part.__name__} {time.process_time() - start:.0f} s"


def main() -> None:
    # The longest first; the last ones are made of what those before have compiled.
    parts, wholes = [*(part for _, part in PARTS.values()), paper, absolute_pose], [warm_up, two_bodies]
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        done = [*pool.map(timed, parts)]
    print("compiled:", ", ".join([*done, *map(timed, wholes)]), file=sys.stderr)


if __name__ == "__main__":
    main()
