"""`sylpose track --show`: browser page of a running tracker, which hands over each frame without waiting."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Any, Self

import numpy as np

from sylpose.browser.result_player import add_controls
from sylpose.browser.scene_page import MAX_PATH_SEGMENTS, ScenePage, escape_markdown
from sylpose.geometry.arrays import FloatArray
from sylpose.report.scene import build_scene
from sylpose.results import Trajectory
from sylpose.rig import Rig
from sylpose.tracking.tracked_frame import TrackedFrame

__all__ = ["LivePage", "ObjectPath"]

# Seconds between two updates of the page (choice: slows the tracker down by a tenth at most).
UPDATE_INTERVAL = 0.2


class ObjectPath:
    """Path of an object in bounded memory: when full, every second point is dropped and gaps are kept.

    Attributes:
        positions: positions (3,); NaN without a pose.
        statuses: status values of the same frames.
    """

    def __init__(self, max_points: int = MAX_PATH_SEGMENTS) -> None:
        self.positions: list[FloatArray] = []
        self.statuses: list[str] = []
        self._max_points, self._stride, self._n_skipped = max_points, 1, 0
        self._has_gap = False

    def add(self, position: FloatArray, status: str) -> None:
        """Append the position and status of a frame."""
        self._has_gap |= not np.isfinite(position).all()
        self._n_skipped += 1
        if self._n_skipped < self._stride:
            return
        self.positions.append(np.full(3, np.nan) if self._has_gap else np.array(position))
        self.statuses.append(status)
        self._n_skipped, self._has_gap = 0, False
        if len(self.positions) >= self._max_points:
            pairs = zip(self.positions[::2], self.positions[1::2], strict=False)
            self.positions = [b if np.isfinite(a).all() else a for a, b in pairs]
            self.statuses = self.statuses[1::2]
            self._stride *= 2


class LivePage:
    """Page of a running tracker; a context manager that updates it in a thread of its own.

    Args:
        server: viser server.
        rig: the cameras, in the length unit of the poses.
        objects: names of the objects.
        title: title of the page.

    Attributes:
        error: error message if the page stopped before the run ended, else "".
    """

    def __init__(self, server: Any, rig: Rig, objects: Sequence[str], title: str) -> None:
        scene = build_scene(Trajectory([], rig.names, rig.unit), rig)
        self.page, self.error, self._server, self._scene = ScenePage(server, scene, rig), "", server, scene
        self._labels = {name: name if len(objects) > 1 else "" for name in objects}
        self._paths = {name: ObjectPath() for name in objects}
        self._latest: dict[str, TrackedFrame] = {}
        self._lock, self._updated, self._ended = threading.Lock(), threading.Event(), threading.Event()
        for name in objects:
            self.page.add(name)
        server.gui.add_markdown(f"**{escape_markdown(title)}**")
        self.status_text = server.gui.add_markdown("Nothing is tracked yet.")
        add_controls(self.page, objects, rig.names, self._updated.set)
        self._thread = threading.Thread(target=self._run, name="sylpose-show", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._updated.set()
        self._thread.join()

    def update(self, name: str, tracked: TrackedFrame) -> None:
        """Hand over an object's latest frame; frames not yet drawn are dropped except for their path points."""
        with self._lock:
            self._latest[name] = tracked
            self._paths[name].add(tracked.pose.position, tracked.pose.status.value)
        self._updated.set()

    def show_status(self, message: str) -> None:
        """Show a message about the state of the run."""
        self.status_text.content = escape_markdown(message)

    def _run(self) -> None:
        while not self._ended.is_set():
            self._updated.wait()
            self._updated.clear()
            try:
                self._draw()
            except Exception as error:  # an error of the page must not end the run
                self.error = f"the page stopped updating ({type(error).__name__}: {error})"
                return
            self._ended.wait(UPDATE_INTERVAL)

    def _draw(self) -> None:
        with self._lock:
            latest, self._latest = self._latest, {}
            paths = {name: (np.array(p.positions), list(p.statuses)) for name, p in self._paths.items() if p.positions}
        if not latest:
            return
        newest = max(latest.values(), key=lambda tracked: tracked.pose.index)
        with self._server.atomic():
            texts = [self._draw_object(name, tracked) for name, tracked in latest.items()]
            for name, (positions, statuses) in paths.items():
                self.page.set_path(name, positions, statuses)
        self.page.set_images(newest.frames.images)
        self.status_text.content = "\n\n".join([f"Frame {newest.pose.index}, {newest.pose.time:.3f}", *texts])

    def _draw_object(self, name: str, tracked: TrackedFrame) -> str:
        """Draw an object and return the text about it."""
        pose = tracked.pose
        matrix = np.full((4, 4), np.nan) if pose.world_from_object is None else pose.world_from_object.as_matrix()
        radius = tracked.radius if tracked.radius > 0 else self._scene.axis_length
        self.page.set_size(name, radius, float(pose.sigma[3:].max()))
        self.page.set_pose(name, matrix, pose.covariance)
        positions = [sightings.positions for sightings in tracked.observations]
        colors = np.repeat(self._scene.colors[: len(positions)], [len(p) for p in positions], axis=0)
        if positions:
            points = np.concatenate(positions)
            # Leave out distant points: they are not on the object, or their position is uncertain.
            near = np.linalg.norm(points, axis=1) < 2.0 * radius
            self.page.set_points(name, points[near], colors[near])
        return self.page.describe_pose(name, self._labels[name], pose.status, pose.reason, matrix, pose.covariance)
