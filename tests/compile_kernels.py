"""Compile the kernels that the tests call, once and in parallel, before they start: `python -m tests.compile_kernels`.

Otherwise two test workers would compile the same kernels at the same time. Kernels that are missing here are compiled
when a test calls them.
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
from sylpose.geometry.arrays import FloatArray
from sylpose.matches import Matches
from sylpose.moments import PairMoments
from sylpose.rig import Camera
from sylpose.runs.precompile import PARTS
from sylpose.simulate import ring
from sylpose.sylvester.centralized import solve_centralized
from sylpose.sylvester.depth_plane import solve_depth_plane

RIG = ring(3, height=(0.4, -0.1, 0.2))
POINTS = np.random.default_rng(0).uniform(-0.1, 0.1, (40, 3))
TURN = Rotation.from_rotvec([0.05, -0.03, 0.08])


def make_observations(turn: Rotation) -> Iterator[tuple[Camera, FloatArray]]:
    """Return the cameras and their observations of the points (40, 2), rotated."""
    for camera in RIG:
        yield camera, camera.normalize(camera.project(turn.apply(POINTS)))


def paper() -> None:
    pairs = zip(make_observations(Rotation.identity()), make_observations(TURN), strict=True)
    moments = [PairMoments.from_matches(x, y) for (_, x), (_, y) in pairs]
    rotations = [camera.rotation for camera in RIG]
    solve_centralized(rotations, moments)
    solve_centralized(rotations[:1], moments[:1])
    solve_depth_plane(rotations, moments)


def two_bodies() -> None:
    both = [
        zip(make_observations(Rotation.identity()), make_observations(turn), strict=True)
        for turn in (TURN, TURN.inv() * TURN.inv())
    ]
    matches = [[Matches(x, y) for (_, x), (_, y) in pairs] for pairs in both]
    joined = [Matches(np.vstack([a.x, b.x[::2]]), np.vstack([a.y, b.y[::2]])) for a, b in zip(*matches, strict=True)]
    estimate_motion(RIG, joined)
    estimate_motion(RIG, [*matches[0][:2], matches[1][2]])


def run_timed(part: Callable[[], None]) -> str:
    start = time.process_time()
    part()
    return f"{part.__name__} {time.process_time() - start:.0f} s"


def main() -> None:
    # The longest first.
    parts, wholes = [*(part.compile for part in PARTS.values()), paper], [two_bodies]
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        done = [*pool.map(run_timed, parts)]
    print("compiled:", ", ".join([*done, *map(run_timed, wholes)]), file=sys.stderr)


if __name__ == "__main__":
    main()
