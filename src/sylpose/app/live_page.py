"""`sylpose track --show`: the page of a run that goes on. The tracker leaves each frame there and does not wait for it."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from types import TracebackType
from typing import Any, Self

import numpy as np

from sylpose.app.result_player import add_layers, add_views, said_of
from sylpose.app.scene_page import MOST_PIECES, ScenePage, plain
from sylpose.geometry.arrays import FloatArray
from sylpose.report.scene import scene_of
from sylpose.results import Trajectory
from sylpose.rig import Rig
from sylpose.tracking.tracked_frame import TrackedFrame

__all__ = ["LivePage", "Way"]

# Seconds between two looks at what is there (choice: what the tracker would do meanwhile takes a tenth longer at most).
PAUSE = 0.2


class Way:
    """Where an object was, in bounded memory: of too many frames every second is left out, gaps stay.

    Attributes:
        places: (3,) each; NaN without a pose.
        statuses: of the same frames.
    """

    def __init__(self, most: int = MOST_PIECES) -> None:
        self.places: list[FloatArray] = []
        self.statuses: list[str] = []
        self._most, self._every, self._left = most, 1, 0
        self._lost = False

    def add(self, place: FloatArray, status: str) -> None:
        """One frame more."""
        self._lost |= not np.isfinite(place).all()
        self._left += 1
        if self._left < self._every:
            return
        self.places.append(np.full(3, np.nan) if self._lost else np.array(place))
        self.statuses.append(status)
        self._left, self._lost = 0, False
        if len(self.places) >= self._most:
            pairs = zip(self.places[::2], self.places[1::2], strict=False)
            self.places = [b if np.isfinite(a).all() else a for a, b in pairs]
            self.statuses = self.statuses[1::2]
            self._every *= 2


class LivePage:
    """The page of a run; a context manager within which it is alive, with a thread beside the tracker's.

    Args:
        server: of viser.
        rig: in the unit of the poses.
        objects: their names.
        title: what is tracked.

    Attributes:
        failed: a sentence, if the page has come to its end before the run.
    """

    def __init__(self, server: Any, rig: Rig, objects: Sequence[str], title: str) -> None:
        scene = scene_of(Trajectory([], rig.names, rig.unit), rig)
        self.page, self.failed = ScenePage(server, scene, rig), ""
        self._server, self._scene = server, scene
        self._names = {name: name if len(objects) > 1 else "" for name in objects}
        self._ways = {name: Way() for name in objects}
        self._latest: dict[str, TrackedFrame] = {}
        self._lock, self._news, self._ended = threading.Lock(), threading.Event(), threading.Event()
        for name in objects:
            self.page.add(name)
        server.gui.add_markdown(f"**{plain(title)}**")
        self.words = server.gui.add_markdown("Nothing is tracked yet.")
        add_views(server, self.page, objects, rig.names)
        add_layers(server, self.page, self._news.set)
        self._thread = threading.Thread(target=self._run, name="sylpose-show", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._ended.set()
        self._news.set()
        self._thread.join()

    def put(self, name: str, tracked: TrackedFrame) -> None:
        """One object in one frame. What was not drawn by then is left out, but for the path."""
        with self._lock:
            self._latest[name] = tracked
            self._ways[name].add(tracked.pose.position, tracked.pose.status.value)
        self._news.set()

    def say(self, words: str) -> None:
        """What the run does now."""
        self.words.content = plain(words)

    def _run(self) -> None:
        while not self._ended.is_set():
            self._news.wait()
            self._news.clear()
            try:
                self._draw()
            except Exception as error:  # whatever it is, the run goes on
                self.failed = f"the page shows nothing more ({type(error).__name__}: {error})"
                return
            self._ended.wait(PAUSE)

    def _draw(self) -> None:
        with self._lock:
            latest, self._latest = self._latest, {}
            ways = {name: (np.array(way.places), list(way.statuses)) for name, way in self._ways.items() if way.places}
        if not latest:
            return
        said = []
        newest = max(latest.values(), key=lambda tracked: tracked.pose.index)
        with self._server.atomic():
            for name, tracked in latest.items():
                said.append(self._object(name, tracked))
            for name, (places, statuses) in ways.items():
                self.page.path(name, places, statuses)
        self.page.images(newest.frames.images)
        self.words.content = "\n\n".join([f"Frame {newest.pose.index}, {newest.pose.time:.3f}", *said])

    def _object(self, name: str, tracked: TrackedFrame) -> str:
        """Draws it, and says what is known of it."""
        pose = tracked.pose
        matrix = np.full((4, 4), np.nan) if pose.world_from_object is None else pose.world_from_object.as_matrix()
        radius = tracked.radius if tracked.radius > 0 else self._scene.axis_length
        self.page.sized(name, radius, float(pose.sigma[3:].max()))
        self.page.pose(name, matrix, pose.covariance)
        seen = [sights.place for sights in tracked.sightings]
        colors = np.repeat(self._scene.colors[: len(seen)], [len(places) for places in seen], axis=0)
        if seen:
            points = np.concatenate(seen)
            # What is not known to be on it, or hardly where, is left out.
            near = np.linalg.norm(points, axis=1) < 2.0 * radius
            self.page.points(name, points[near], colors[near])
        return said_of(
            self._names[name],
            self._scene.unit,
            pose.status,
            pose.reason,
            matrix,
            pose.covariance,
            self.page.larger(name),
        )
