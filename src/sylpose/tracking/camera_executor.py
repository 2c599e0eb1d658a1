"""Execution of per-camera work, in one process or distributed.

Lists described as "per camera, local" have one entry per camera. In a distributed run a process sees only the entry of
its own camera.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Protocol, TypeVar

from sylpose.geometry.arrays import FloatArray
from sylpose.landmarks.alignment import AlignmentResult, AlignmentStart, LandmarkMatches, align

__all__ = ["Alignment", "CameraExecutor", "LocalExecutor"]

T = TypeVar("T")

# A pose and, per camera, local: (weights, residuals) of its observations.
Alignment = tuple[AlignmentResult, list[tuple[FloatArray, FloatArray]]]


class CameraExecutor(Protocol):
    """Interface for running functions on all cameras, named by their index in the rig.

    Every participating camera runs the same program and calls these methods in the same order. So only results are
    sent, never requests.
    """

    def map_cameras(self, function: Callable[[int], T], *, is_slow: bool = False) -> list[T]:
        """Run a function for each camera and keep each result with its camera.

        Args:
            function: function of the camera's index; uses and changes only that camera's data.
            is_slow: whether it takes milliseconds: cameras in one process then run in parallel.

        Returns:
            per camera, local: the results. In a distributed run a result may be passed on to the same camera only.
        """

    def all_gather(self, function: Callable[[int], T], default: T) -> list[T]:
        """Run a function for each camera and share the results with all cameras.

        Args:
            function: function of the camera's index; returns `reports`, numbers or arrays.
            default: result of a camera without an image, also used in place of an excluded camera's result.

        Returns:
            per camera, in the rig's order: the results, identical on all cameras.
        """

    def align(self, observations: Sequence[LandmarkMatches], starts: Sequence[AlignmentStart]) -> list[Alignment]:
        """Estimate the pose that best fits all cameras' observations, from each start (`landmarks.alignment`).

        Args:
            observations: per camera, local: observations of landmarks.
            starts: initial poses.
        """


class LocalExecutor:
    """Executor for all cameras in one process, with worker threads."""

    def __init__(self, cameras: int, workers: int) -> None:
        self._cameras = range(cameras)
        self._pool = ThreadPoolExecutor(workers)

    def close(self) -> None:
        """Shut down the worker threads."""
        self._pool.shutdown()

    def map_cameras(self, function: Callable[[int], T], *, is_slow: bool = False) -> list[T]:
        """See `CameraExecutor`. Short tasks run in the calling thread, which costs less than handing them over."""
        return list(self._pool.map(function, self._cameras)) if is_slow else [function(c) for c in self._cameras]

    def all_gather(self, function: Callable[[int], T], default: T) -> list[T]:  # noqa: ARG002
        """See `CameraExecutor`."""
        return [function(c) for c in self._cameras]

    def align(self, observations: Sequence[LandmarkMatches], starts: Sequence[AlignmentStart]) -> list[Alignment]:
        """See `CameraExecutor`."""
        aligned = [align(observations, *start) for start in starts]
        return [(one, list(zip(one.weights, one.residuals, strict=True))) for one in aligned]
