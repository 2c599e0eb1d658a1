"""Compiles what the tests will call, once and side by side, before they start: `python -m tests.compile_kernels`.

Two workers of the test run would else compile the same kernels at the same time. The parts share next to nothing, and the
longest comes first. What is left out here is compiled when a test calls it.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose import estimate_motion
from sylpose.adjustment.bundle import Observations, bundle
from sylpose.features import klt
from sylpose.known_model.pose import estimate_pose
from sylpose.landmarks.alignment import Sights, align
from sylpose.matches import Matches
from sylpose.moments import PairMoments
from sylpose.numerics.arrays import FloatArray
from sylpose.paper.centralized import solve_centralized
from sylpose.paper.depth_plane import solve_depth_plane
from sylpose.rig import Camera
from sylpose.simulate import ring
from sylpose.two_frames.solver import warm_up

RIG = ring(3, height=(0.4, -0.1, 0.2))
POINTS = np.random.default_rng(0).uniform(-0.1, 0.1, (40, 3))
TURN = Rotation.from_rotvec([0.05, -0.03, 0.08])


def seen(turn: Rotation) -> Iterator[tuple[Camera, FloatArray]]:
    """The cameras, and the points (40, 2) as they see them turned."""
    for camera in RIG:
        yield camera, camera.normalize(camera.project(turn.apply(POINTS)))


def landmarks() -> None:
    sights = [
        Sights(
            points=POINTS,
            depth_error=0.01 * (POINTS - camera.center),
            image=image,
            feature=np.arange(len(POINTS)),
            trust=np.ones(len(POINTS)),
            rotation=camera.rotation,
            center=camera.center,
            focal=camera.focal,
        )
        for camera, image in seen(TURN)
    ]
    align(sights, np.eye(3), np.zeros(3))


def paper() -> None:
    pairs = zip(seen(Rotation.identity()), seen(TURN), strict=True)
    moments = [PairMoments.from_matches(x, y) for (_, x), (_, y) in pairs]
    rotations = [camera.rotation for camera in RIG]
    solve_centralized(rotations, moments)
    solve_centralized(rotations[:1], moments[:1])
    solve_depth_plane(rotations, moments)


def known_model() -> None:
    estimate_pose(RIG, [POINTS] * len(RIG), [camera.project(TURN.apply(POINTS)) for camera in RIG])


def two_bodies() -> None:
    both = [zip(seen(Rotation.identity()), seen(turn), strict=True) for turn in (TURN, TURN.inv() * TURN.inv())]
    matches = [[Matches(x, y) for (_, x), (_, y) in pairs] for pairs in both]
    joined = [Matches(np.vstack([a.x, b.x[::2]]), np.vstack([a.y, b.y[::2]])) for a, b in zip(*matches, strict=True)]
    estimate_motion(RIG, joined)
    estimate_motion(RIG, [*matches[0][:2], matches[1][2]])


def smoothing() -> None:
    turns = [Rotation.from_rotvec(0.02 * k * TURN.as_rotvec()) for k in range(4)]
    n, cameras = len(POINTS), len(RIG)
    images = np.array([[image for _, image in seen(turn)] for turn in turns])
    frame, camera, landmark = (index.ravel() for index in np.indices((len(turns), cameras, n)))
    poses = RigidTransform.from_components(np.zeros((len(turns), 3)), Rotation.concatenate(turns))
    bundle(RIG, Observations(frame, camera, landmark + n * camera, images.reshape(-1, 2)), poses, 0.1, offsets_sd=0.1)


def following() -> None:
    image = np.random.default_rng(0).integers(0, 255, (120, 160), np.uint8)
    klt.advance(klt.begin(image, [[60.0, 60.0], [80.0, 50.0]]), image, image)


def the_rest() -> None:
    for part in (smoothing, landmarks, known_model, paper, following, two_bodies):
        part()


def timed(part: Callable[[], None]) -> str:
    start = time.process_time()
    part()
    return f"{part.__name__} {time.process_time() - start:.0f} s"


def main() -> None:
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        print("compiled:", ", ".join(pool.map(timed, (warm_up, the_rest))), file=sys.stderr)


if __name__ == "__main__":
    main()
