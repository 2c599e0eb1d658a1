"""Solvers of the two-frame benchmark, each in a separate process that is killed if it hangs."""

from __future__ import annotations

import itertools
import multiprocessing
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from benchmarks.peers import (
    from_colmap_pose,
    from_poselib_result,
    pinhole_parameters,
    to_poselib_matches,
    to_poselib_rig,
)
from benchmarks.two_frames_scenes import Scene

__all__ = ["LOADERS", "Answer", "Worker", "make_option_sets"]

Options = dict[str, Any]
# Converts a scene to the solver's own types (not timed) and returns the call to time.
Prepare = Callable[[Scene, Options], Callable[[], RigidTransform | None]]

# Set before a child process starts, so that its libraries read them.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
# A first call may compile.
START_LIMIT_S = 300.0


@dataclass(frozen=True, eq=False)
class Answer:
    """Result of one call.

    Attributes:
        pose: the pose, or None.
        seconds: processor time, which does not contain other load of the machine.
        failure: reason for a missing pose: "no pose", "hang", "crash" or an exception.
    """

    pose: RigidTransform | None
    seconds: float
    failure: str = ""


class Worker:
    """Child process that solves scenes one by one; a context manager.

    A call that exceeds its time limit kills the process, and the next call starts a new one.
    """

    def __init__(self, load: Callable[[], Prepare], limit_s: float, warm_up: Scene | None = None) -> None:
        """
        Args:
            load: function of a module that imports the solver in the child.
            limit_s: time limit per call, seconds.
            warm_up: scene that each new process solves first, not counted.
        """
        self._load, self._limit_s, self._warm_up = load, limit_s, warm_up
        self._process: multiprocessing.process.BaseProcess | None = None
        self._connection: Connection | None = None

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def is_alive(self) -> bool:
        """Return whether the process is running."""
        return self._process is not None and self._process.is_alive()

    def start(self) -> tuple[float, float]:
        """Start a new process; return the seconds of the solver's import and of its first call.

        Raises:
            RuntimeError: the process ended, or did not answer.
        """
        self.close()
        os.environ.update(ONE_THREAD)
        context = multiprocessing.get_context("spawn")
        self._connection, there = context.Pipe()
        self._process = context.Process(target=_serve, args=(there, self._load), daemon=True)
        self._process.start()
        there.close()
        loaded = self._receive(START_LIMIT_S)
        if loaded.failure:
            raise RuntimeError(f"the solver of {self._load.__name__} does not start: {loaded.failure}")
        if self._warm_up is None:
            return loaded.seconds, 0.0
        self._connection.send((self._warm_up, {}))
        return loaded.seconds, self._receive(START_LIMIT_S).seconds

    def solve(self, scene: Scene, options: Options) -> Answer:
        """Solve one scene."""
        if not self.is_alive:
            self.start()
        assert self._connection is not None
        self._connection.send((scene, options))
        return self._receive(self._limit_s)

    def close(self) -> None:
        """Kill the process."""
        if self._process is not None:
            self._process.kill()
            self._process.join()
        if self._connection is not None:
            self._connection.close()
        self._process = self._connection = None

    def _receive(self, limit_s: float) -> Answer:
        assert self._connection is not None
        why = "hang"
        try:
            if self._connection.poll(limit_s):
                answer: Answer = self._connection.recv()
                return answer
        except EOFError:
            why = "crash"
        self.close()
        return Answer(None, limit_s, why)


def _serve(connection: Connection, load: Callable[[], Prepare]) -> None:
    """Run the child's loop."""
    start = time.perf_counter()
    try:
        prepare = load()
    except ImportError as error:
        connection.send(Answer(None, 0.0, str(error)))
        return
    connection.send(Answer(None, time.perf_counter() - start))
    while True:
        try:
            scene, options = connection.recv()
        except EOFError:
            return
        start = time.process_time()
        try:
            call = prepare(scene, options)
            start = time.process_time()
            pose = call()
            answer = Answer(pose, time.process_time() - start, "" if pose is not None else "no pose")
        except Exception as error:  # a solver that raises has failed on this scene; the table shows the exception
            answer = Answer(None, time.process_time() - start, f"{type(error).__name__}: {error}")
        connection.send(answer)


def load_sylpose() -> Prepare:
    """Load sylpose, with its defaults."""
    import cv2

    from sylpose.absolute_pose.pose import estimate_pose
    from sylpose.matches import Matches
    from sylpose.relative_pose.motion import estimate_motion

    cv2.setNumThreads(1)

    def prepare(scene: Scene, _: Options) -> Callable[[], RigidTransform | None]:
        rig = scene.rig
        # Cached per rig, like the peers' camera poses below.
        for camera in rig:
            _made = (camera.rotation, camera.center, camera.focal)
        if scene.problem == "pose":
            return lambda: estimate_pose(rig, scene.before, scene.after).motion
        matches = [Matches.from_pixels(*views) for views in zip(rig, scene.before, scene.after, strict=True)]
        return lambda: estimate_motion(rig, matches).motion

    return prepare


def load_poselib() -> Prepare:
    """Load PoseLib; the options "ransac" and "bundle" are passed to its functions."""
    import poselib

    def prepare(scene: Scene, options: Options) -> Callable[[], RigidTransform | None]:
        cameras, poses = to_poselib_rig(scene.rig)
        ransac, bundle = options.get("ransac", {}), options.get("bundle", {})
        if scene.problem == "pose":

            def call() -> RigidTransform | None:
                return from_poselib_result(
                    poselib.estimate_generalized_absolute_pose(
                        scene.after, scene.before, poses, cameras, ransac, bundle
                    )
                )

            return call
        matches = to_poselib_matches(zip(scene.before, scene.after, strict=True))
        return lambda: from_poselib_result(
            poselib.estimate_generalized_relative_pose(matches, poses, cameras, poses, cameras, ransac, bundle)
        )

    return prepare


def load_pycolmap() -> Prepare:
    """Load COLMAP's solvers, the absolute pose with refinement; the option "max_error" is in pixels."""
    import pycolmap

    def prepare(scene: Scene, options: Options) -> Callable[[], RigidTransform | None]:
        cameras, poses = [], []
        for camera in scene.rig:
            width, height = camera.size
            cameras.append(
                pycolmap.Camera(model="PINHOLE", width=width, height=height, params=pinhole_parameters(camera))
            )
            poses.append(pycolmap.Rigid3d(camera.camera_from_world.as_matrix()[:3]))
        ransac = pycolmap.RANSACOptions()
        ransac.random_seed, ransac.num_threads = 0, 1
        ransac.max_error = options.get("max_error", ransac.max_error)
        index = np.repeat(np.arange(len(scene.rig)), [len(y) for y in scene.after]).tolist()
        before, after = np.concatenate(scene.before), np.concatenate(scene.after)

        def call() -> RigidTransform | None:
            if scene.problem == "pose":
                found = pycolmap.estimate_and_refine_generalized_absolute_pose(
                    after, before, index, poses, cameras, ransac
                )
                return None if found is None else from_colmap_pose(found["rig_from_world"])
            found = pycolmap.estimate_generalized_relative_pose(before, after, index, index, poses, cameras, ransac)
            return None if found is None else from_colmap_pose(found["rig2_from_rig1"])

        return call

    return prepare


LOADERS: dict[str, Callable[[], Prepare]] = {
    "sylpose": load_sylpose,
    "poselib": load_poselib,
    "pycolmap": load_pycolmap,
}


# PoseLib's default is at least 1,000 iterations, most of which are superfluous with few outliers. Its final refinement
# minimizes a Cauchy loss, which costs accuracy without outliers.
POSELIB_ITERATIONS = (50, 100, 200, 1000)
POSELIB_THRESHOLDS = (2.0, 4.0)
POSELIB_LOSSES = ("TRIVIAL", "HUBER", "CAUCHY", "TRUNCATED")


def make_option_sets(solver: str, problem: str, noise: float) -> dict[str, Options]:
    """Return the option sets to try for a solver, by label.

    PoseLib: its defaults, and every combination of least iterations, inlier threshold (in true standard deviations of the
    noise) and loss of the final refinement.

    Args:
        noise: standard deviation of the scenes' image noise, pixels.
    """
    if solver == "pycolmap":
        return {"default": {}, "4 sigma": {"max_error": 4 * noise}}
    if solver != "poselib":
        return {"": {}}
    error = "max_reproj_error" if problem == "pose" else "max_epipolar_error"
    grid = itertools.product(POSELIB_ITERATIONS, POSELIB_THRESHOLDS, POSELIB_LOSSES)
    return {
        "default": {},
        **{
            f"{least} iterations, {sigmas:g} sigma, {loss}": {
                "ransac": {error: sigmas * noise, "min_iterations": least},
                # A truncated loss rejects residuals beyond its scale; the other losses only flatten there.
                "bundle": {"loss_type": loss, "loss_scale": (sigmas if loss == "TRUNCATED" else 2) * noise},
            }
            for least, sigmas, loss in grid
        },
    }
