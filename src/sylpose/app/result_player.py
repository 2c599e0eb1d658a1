"""What the page of a result has beside the scene: a slider over frames, what is said of them, layers; the same as a file."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from types import TracebackType
from typing import Any, Self

import numpy as np

from sylpose.app.console_output import length
from sylpose.app.scene_page import DEVIATIONS, LAYERS, NOTHING, ScenePage, plain, status_color
from sylpose.app.viewer_server import THEME, viewer_server
from sylpose.capture.random_access import SingleFrames
from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.report.scene import Scene
from sylpose.results import FrameStatus
from sylpose.rig import Rig

__all__ = ["Player", "add_layers", "add_views", "said_of", "saved_page"]

# Of images without times, frames per second; updates per second while it plays (choice).
RATE, UPDATES = 10.0, 25.0
SPEEDS = {"1/8": 0.125, "1/4": 0.25, "1/2": 0.5, "1": 1.0, "2": 2.0, "4": 4.0}
ALL = "all of it"
# Of a file: frames in all, and of these so many with images (choice: about 6 MB with four cameras).
MOST_FRAMES, MOST_IMAGES = 1500, 60


class Player:
    """The page of a result; a context manager within which it is alive.

    Args:
        server: of viser.
        scenes: by object.
        rig: their cameras.
        stills: the recording's images, if they are there; read by a thread beside this one, those alone that are looked at.
        title: what it is a result of.
    """

    def __init__(
        self, server: Any, scenes: Mapping[str, Scene], rig: Rig, stills: SingleFrames | None, title: str
    ) -> None:
        self._scenes, self._stills, self._gui = dict(scenes), stills, server.gui
        self.page = staged(server, scenes, rig)
        self.index, seconds = frames_of(scenes)
        self._seconds = None if np.array_equal(seconds, self.index) else seconds
        self.times = self.index / RATE if self._seconds is None else seconds
        self.shown = 0
        self._lock, self._ended = threading.Lock(), threading.Event()
        self._wanted, self._got, self._asked = -1, -1, threading.Condition()
        self._began: tuple[float, float] | None = None  # of playing: by the clock, and in the recording
        gui = server.gui
        gui.add_markdown(f"**{plain(title)}**")
        self.slider = gui.add_slider("Frame", min=0, max=max(len(self.index) - 1, 1), step=1, initial_value=0)
        self.button = gui.add_button("Play", icon="player-play")
        self._speed = gui.add_dropdown("Speed", tuple(SPEEDS), initial_value="1")
        self.words = gui.add_markdown("")
        add_views(server, self.page, [*scenes], next(iter(scenes.values())).cameras)
        add_layers(server, self.page, self._again)
        self.slider.on_update(lambda _: self.show(int(self.slider.value)))
        self.button.on_click(lambda _: self.play(self._began is None))
        self._speed.on_update(lambda _: self.play(self._began is not None))
        self._threads = [threading.Thread(target=target, daemon=True) for target in (self._feed, self._run)]
        self.show(0)

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._ended.set()
        with self._asked:
            self._asked.notify_all()
        for thread in self._threads:
            thread.join()

    def show(self, k: int) -> None:
        """The k-th frame."""
        k = min(max(k, 0), len(self.index) - 1)
        with self._lock:
            self.shown = k
            place(self.page, self._scenes, int(self.index[k]))
            self.words.content = self._words(k)
        with self._asked:
            self._wanted = k
            self._asked.notify_all()

    def _words(self, k: int) -> str:
        """What is said of the k-th frame, as Markdown."""
        index = int(self.index[k])
        time_of = f", {self._seconds[k]:.3f} s" if self._seconds is not None else ""
        parts = [f"Frame {index}{time_of}, {k + 1} of {len(self.index)}"]
        for name, scene in self._scenes.items():
            if (row := row_of(scene, index)) is not None:
                pose, covariance = scene.world_from_object[row], scene.covariance[row]
                status, reason = FrameStatus(scene.status[row]), scene.reason[row]
                parts.append(said_of(name, scene.unit, status, reason, pose, covariance, self.page.larger(name)))
        return "\n\n".join(parts)

    def play(self, playing: bool) -> None:
        """Goes on by itself, from the present frame or from the first; or stops."""
        if playing and self.shown == len(self.index) - 1:
            self.slider.value = 0
        self._began = (time.monotonic(), float(self.times[self.shown])) if playing else None
        self.button.label = "Pause" if playing else "Play"
        self.button.icon = "player-pause" if playing else "player-play"

    def _run(self) -> None:
        while not self._ended.wait(1.0 / UPDATES):
            began = self._began
            if began is None:
                continue
            now = began[1] + (time.monotonic() - began[0]) * SPEEDS[self._speed.value]
            k = int(np.searchsorted(self.times, now, side="right")) - 1
            if k != self.shown:
                self.slider.value = max(k, 0)
            if k == len(self.index) - 1:
                self.play(False)

    def _again(self) -> None:
        """Images that were not to be seen are those of another frame."""
        with self._asked:
            self._got = -1
            self._asked.notify_all()

    def _feed(self) -> None:
        """Images of the frame that is looked at now; those in between are left out where reading takes longer."""
        while self._stills is not None and not self._ended.is_set():
            with self._asked:
                self._asked.wait_for(lambda: self._ended.is_set() or self._wanted != self._got)
                k = self._got = self._wanted
            if not self._ended.is_set() and self.page.visible["Images"]:
                self.page.images(self._stills.at(int(self.index[k])))


def staged(server: Any, scenes: Mapping[str, Scene], rig: Rig) -> ScenePage:
    """The scene with all that does not move."""
    page = ScenePage(server, next(iter(scenes.values())), rig)
    for name, scene in scenes.items():
        variances = np.diagonal(scene.covariance[:, 3:, 3:], axis1=1, axis2=2)
        sizes = np.sqrt(variances[scene.measured].max(axis=1, initial=0.0))
        sizes = sizes[np.isfinite(sizes) & (sizes > 0)]
        page.add(name)
        page.sized(name, scene.axis_length, float(np.quantile(sizes, 0.9)) if len(sizes) else np.nan)
        page.points(name, scene.points, scene.point_colors)
        page.path(name, scene.world_from_object[:, :3, 3], scene.status)
    return page


def frames_of(scenes: Mapping[str, Scene]) -> tuple[IntArray, FloatArray]:
    """(n,) numbers of the frames of any object, and their times."""
    every = {int(k): float(t) for scene in scenes.values() for k, t in zip(scene.index, scene.times, strict=True)}
    index = np.array(sorted(every), np.int64)
    return index, np.array([every[k] for k in index.tolist()])


def row_of(scene: Scene, index: int) -> int | None:
    """The position of a frame among those of an object."""
    k = int(np.searchsorted(scene.index, index))
    return k if k < len(scene.index) and scene.index[k] == index else None


def place(page: ScenePage, scenes: Mapping[str, Scene], index: int) -> None:
    """Puts all objects where they were in a frame."""
    with page.server.atomic():
        for name, scene in scenes.items():
            k = row_of(scene, index)
            if k is None:
                page.pose(name, None, None)
            else:
                page.pose(name, scene.world_from_object[k], scene.covariance[k])


def said_of(
    name: str, unit: str, status: FrameStatus, reason: str, pose: FloatArray, covariance: FloatArray, larger: float
) -> str:
    """What is known of an object in a frame, as Markdown: its pose (4, 4), NaN without one; how many times as large as they
    are its standard deviations are drawn."""
    posed = bool(np.isfinite(pose).all())
    color = status_color(status.value) if posed else NOTHING
    lines = [
        f"<span style='color:rgb{color}'>⬤</span> **{plain(name)}{': ' if name else ''}{status.value}**",
        plain(reason or status.text),
    ]
    if posed:
        sigma = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
        lines.append(f"at {', '.join(f'{v:.4g}' for v in pose[:3, 3])} {plain(unit)}")
        if not np.isfinite(sigma).all():
            lines.append("how well its pose is known has no bound")
        elif sigma.any():
            turn, shift = np.degrees(np.linalg.norm(sigma[:3])), float(np.linalg.norm(sigma[3:]))
            lines.append(f"known to {turn:.2g}° and {length(shift, plain(unit))}")
            lines.append(f"(drawn {DEVIATIONS * larger:.0f} times as large)")
    return "  \n".join(lines)


def add_views(server: Any, page: ScenePage, objects: Sequence[str], cameras: Sequence[str]) -> None:
    """From where it is looked at: for each who does so by himself."""
    near = {f"{name or 'the object'}, from near": name for name in objects}
    views = server.gui.add_dropdown("See", (ALL, *near, *cameras), initial_value=ALL)

    def look(event: Any) -> None:
        if event.client is not None:
            camera = cameras.index(views.value) if views.value in cameras else None
            page.look(event.client, camera, near.get(views.value))

    views.on_update(look)


def add_layers(server: Any, page: ScenePage, changed: Callable[[], None]) -> None:
    """What is to be seen; `changed` is called after a change."""
    with server.gui.add_folder("Layers"):
        for layer in LAYERS:
            box = server.gui.add_checkbox(layer, initial_value=True)

            def toggle(_: Any, layer: str = layer, box: Any = box) -> None:
                page.visible[layer] = box.value
                page.refresh()
                changed()

            box.on_update(toggle)
        dark = server.gui.add_checkbox("Dark", initial_value=False)

        def darken(_: Any) -> None:
            server.gui.configure_theme(dark_mode=dark.value, **THEME)
            page.darken(dark.value)

        dark.on_update(darken)


def saved_page(scenes: Mapping[str, Scene], rig: Rig, stills: SingleFrames | None) -> str:
    """An HTML page that plays the scene by itself, without any server: at most `MOST_FRAMES` frames, `MOST_IMAGES` of them
    with images."""
    index, times = frames_of(scenes)
    times = times / RATE if np.array_equal(times, index) else times
    with viewer_server() as (server, _):
        page = staged(server, scenes, rig)
        serializer = server.get_scene_serializer()
        chosen = np.arange(0, len(index), max(1, -(-len(index) // MOST_FRAMES)))
        every = max(1, -(-len(chosen) // MOST_IMAGES))
        for step, k in enumerate(chosen.tolist()):
            if step:
                serializer.insert_sleep(max(float(times[k] - times[chosen[step - 1]]), 0.0))
            place(page, scenes, int(index[k]))
            if stills is not None and step % every == 0:
                page.images(stills.at(int(index[k])))
        return str(serializer.as_html())
