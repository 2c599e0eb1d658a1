"""Controls of a result's 3D page: frame slider, playback, frame information and layers; also as a stand-alone page."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Self

import numpy as np

from sylpose.browser.scene_page import LAYERS, ScenePage, escape_markdown
from sylpose.browser.server import THEME, serve_viewer
from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.io.capture.random_access import RandomAccessReader
from sylpose.report.scene import Scene
from sylpose.results import FrameStatus
from sylpose.rig import Rig

__all__ = ["ResultPlayer", "add_layer_controls", "add_view_control", "render_standalone_page"]

# Frame rate of images without times, and updates per second during playback (choice).
DEFAULT_FRAME_RATE, UPDATE_RATE = 10.0, 25.0
SPEEDS = {"1/8": 0.125, "1/4": 0.25, "1/2": 0.5, "1": 1.0, "2": 2.0, "4": 4.0}
WHOLE_SCENE = "all of it"
# Largest number of frames of a stand-alone page, and of frames with images (choice: about 6 MB with four cameras).
MAX_FRAMES, MAX_IMAGES = 1500, 60


class ResultPlayer:
    """Interactive page of a result; a context manager that runs its threads.

    Args:
        server: a viser server.
        scenes: scenes by object.
        rig: the cameras.
        stills: the recording's images, or None; only those shown are read, by a separate thread.
        title: title of the page.
    """

    def __init__(
        self, server: Any, scenes: Mapping[str, Scene], rig: Rig, stills: RandomAccessReader | None, title: str
    ) -> None:
        self._scenes, self._stills, self._gui = dict(scenes), stills, server.gui
        self.page = create_static_scene(server, scenes, rig)
        self.index, seconds = collect_frames(scenes)
        self._seconds = None if np.array_equal(seconds, self.index) else seconds
        self.times = self.index / DEFAULT_FRAME_RATE if self._seconds is None else seconds
        self.current = 0
        self._lock, self._ended = threading.Lock(), threading.Event()
        self._requested, self._loaded, self._request_changed = -1, -1, threading.Condition()
        self._playback_start: tuple[float, float] | None = None  # start of playback: clock time and recording time
        gui = server.gui
        gui.add_markdown(f"**{escape_markdown(title)}**")
        self.slider = gui.add_slider("Frame", min=0, max=max(len(self.index) - 1, 1), step=1, initial_value=0)
        self.button = gui.add_button("Play", icon="player-play")
        self._speed = gui.add_dropdown("Speed", tuple(SPEEDS), initial_value="1")
        self.description = gui.add_markdown("")
        add_view_control(server, self.page, [*scenes], next(iter(scenes.values())).cameras)
        add_layer_controls(server, self.page, self._reload_images)
        self.slider.on_update(lambda _: self.show(int(self.slider.value)))
        self.button.on_click(lambda _: self.play(self._playback_start is None))
        self._speed.on_update(lambda _: self.play(self._playback_start is not None))
        self._threads = [
            threading.Thread(target=target, daemon=True) for target in (self._run_image_loader, self._run_playback)
        ]
        self.show(0)

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        with self._request_changed:
            self._request_changed.notify_all()
        for thread in self._threads:
            thread.join()

    def show(self, k: int) -> None:
        """Show the k-th frame."""
        k = min(max(k, 0), len(self.index) - 1)
        with self._lock:
            self.current = k
            set_frame(self.page, self._scenes, int(self.index[k]))
            self.description.content = self._describe_frame(k)
        with self._request_changed:
            self._requested = k
            self._request_changed.notify_all()

    def _describe_frame(self, k: int) -> str:
        """Describe the k-th frame as Markdown."""
        index = int(self.index[k])
        time_of = f", {self._seconds[k]:.3f} s" if self._seconds is not None else ""
        parts = [f"Frame {index}{time_of}, {k + 1} of {len(self.index)}"]
        for name, scene in self._scenes.items():
            if (row := find_row(scene, index)) is not None:
                pose, covariance = scene.world_from_object[row], scene.covariance[row]
                status, reason = FrameStatus(scene.status[row]), scene.reason[row]
                parts.append(self.page.describe_pose(name, name, status, reason, pose, covariance))
        return "\n\n".join(parts)

    def play(self, playing: bool) -> None:
        """Start playback from the current frame (at the end, from the first), or stop it."""
        if playing and self.current == len(self.index) - 1:
            self.slider.value = 0
        self._playback_start = (time.monotonic(), float(self.times[self.current])) if playing else None
        self.button.label = "Pause" if playing else "Play"
        self.button.icon = "player-pause" if playing else "player-play"

    def _run_playback(self) -> None:
        while not self._ended.wait(1.0 / UPDATE_RATE):
            start = self._playback_start
            if start is None:
                continue
            now = start[1] + (time.monotonic() - start[0]) * SPEEDS[self._speed.value]
            k = int(np.searchsorted(self.times, now, side="right")) - 1
            if k != self.current:
                self.slider.value = max(k, 0)
            if k == len(self.index) - 1:
                self.play(False)

    def _reload_images(self) -> None:
        """Reload the images after a layer change: hidden images may be of another frame."""
        with self._request_changed:
            self._loaded = -1
            self._request_changed.notify_all()

    def _run_image_loader(self) -> None:
        """Read the images of the current frame; frames are skipped if reading is slower than playback."""
        while self._stills is not None and not self._ended.is_set():
            with self._request_changed:
                self._request_changed.wait_for(lambda: self._ended.is_set() or self._requested != self._loaded)
                k = self._loaded = self._requested
            if not self._ended.is_set() and self.page.visible["Images"]:
                self.page.set_images(self._stills.read_frame_set(int(self.index[k])))


def create_static_scene(server: Any, scenes: Mapping[str, Scene], rig: Rig) -> ScenePage:
    """Create the page with all static parts of the scene."""
    page = ScenePage(server, next(iter(scenes.values())), rig)
    for name, scene in scenes.items():
        variances = np.diagonal(scene.covariance[:, 3:, 3:], axis1=1, axis2=2)
        sizes = np.sqrt(variances[scene.measured].max(axis=1, initial=0.0))
        sizes = sizes[np.isfinite(sizes) & (sizes > 0)]
        page.add(name)
        page.set_size(name, scene.axis_length, float(np.quantile(sizes, 0.9)) if len(sizes) else np.nan)
        page.set_points(name, scene.points, scene.point_colors)
        page.set_path(name, scene.world_from_object[:, :3, 3], scene.status)
    return page


def collect_frames(scenes: Mapping[str, Scene]) -> tuple[IntArray, FloatArray]:
    """Return the frame numbers (n,) of all objects, and their times (n,)."""
    time_by_frame = {
        int(k): float(t) for scene in scenes.values() for k, t in zip(scene.index, scene.times, strict=True)
    }
    index = np.array(sorted(time_by_frame), np.int64)
    return index, np.array([time_by_frame[k] for k in index.tolist()])


def find_row(scene: Scene, index: int) -> int | None:
    """Return the row of a frame in an object's scene, or None."""
    k = int(np.searchsorted(scene.index, index))
    return k if k < len(scene.index) and scene.index[k] == index else None


def set_frame(page: ScenePage, scenes: Mapping[str, Scene], index: int) -> None:
    """Set the poses of all objects to those of a frame."""
    with page.server.atomic():
        for name, scene in scenes.items():
            k = find_row(scene, index)
            page.set_pose(name, *((None, None) if k is None else (scene.world_from_object[k], scene.covariance[k])))


def add_view_control(server: Any, page: ScenePage, objects: Sequence[str], cameras: Sequence[str]) -> None:
    """Add the choice of viewpoints, separately for each client."""
    closeups = {f"{name or 'the object'}, close up": name for name in objects}
    views = server.gui.add_dropdown("See", (WHOLE_SCENE, *closeups, *cameras), initial_value=WHOLE_SCENE)

    def on_select(event: Any) -> None:
        if event.client is not None:
            camera = cameras.index(views.value) if views.value in cameras else None
            page.set_view(event.client, camera, closeups.get(views.value))

    views.on_update(on_select)


def add_layer_controls(server: Any, page: ScenePage, on_change: Callable[[], None]) -> None:
    """Add the switches of the layers; `on_change` is called after a change."""
    with server.gui.add_folder("Layers"):
        for layer in LAYERS:
            box = server.gui.add_checkbox(layer, initial_value=True)

            def toggle(_: Any, layer: str = layer, box: Any = box) -> None:
                page.visible[layer] = box.value
                page.refresh()
                on_change()

            box.on_update(toggle)
        dark = server.gui.add_checkbox("Dark", initial_value=False)

        def darken(_: Any) -> None:
            server.gui.configure_theme(dark_mode=dark.value, **THEME)
            page.set_dark(dark.value)

        dark.on_update(darken)


def render_standalone_page(scenes: Mapping[str, Scene], rig: Rig, stills: RandomAccessReader | None) -> str:
    """Return a stand-alone HTML page that plays the scene, with up to `MAX_FRAMES` frames and `MAX_IMAGES` images."""
    index, times = collect_frames(scenes)
    times = times / DEFAULT_FRAME_RATE if np.array_equal(times, index) else times
    with serve_viewer() as (server, _):
        page = create_static_scene(server, scenes, rig)
        serializer = server.get_scene_serializer()
        chosen = np.arange(0, len(index), max(1, -(-len(index) // MAX_FRAMES)))
        image_step = max(1, -(-len(chosen) // MAX_IMAGES))
        for step, k in enumerate(chosen.tolist()):
            if step:
                serializer.insert_sleep(max(float(times[k] - times[chosen[step - 1]]), 0.0))
            set_frame(page, scenes, int(index[k]))
            if stills is not None and step % image_step == 0:
                page.set_images(stills.read_frame_set(int(index[k])))
        return str(serializer.as_html())
