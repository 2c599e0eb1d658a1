"""Viewers on the 3D page: a finished result with playback, also stand-alone, and a running tracker.

The page of a running tracker (`sylpose track --show`) takes over each frame without making it wait.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Self

import numpy as np

from sylpose.browser.scene_page import LAYERS, MAX_PATH_SEGMENTS, ScenePage, escape_markdown
from sylpose.browser.server import THEME, serve_viewer
from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.io.capture.random_access import RandomAccessReader
from sylpose.report.scene import Scene, build_scene
from sylpose.results import Trajectory
from sylpose.rig import Rig
from sylpose.status import FrameStatus
from sylpose.tracking.context import TrackedFrame

# Frame rate of images without times, and updates per second during playback (choice).
DEFAULT_FRAME_RATE, UPDATE_RATE = 10.0, 25.0
SPEEDS = {"1/8": 0.125, "1/4": 0.25, "1/2": 0.5, "1": 1.0, "2": 2.0, "4": 4.0}
WHOLE_SCENE = "all of it"
# Largest number of frames of a stand-alone page, and of frames with images (choice: about 6 MB with four cameras).
MAX_FRAMES, MAX_IMAGES = 1500, 60
# Seconds between two updates of the page (choice: slows the tracker down by a tenth at most).
UPDATE_INTERVAL = 0.2


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
        # Images that were hidden may be of another frame.
        cameras = next(iter(scenes.values())).cameras
        add_controls(self.page, [*scenes], cameras, lambda: self._request(self.current, loaded=-1))
        self.slider.on_update(lambda _: self.show(int(self.slider.value)))
        self.button.on_click(lambda _: self.play(self._playback_start is None))
        self._speed.on_update(lambda _: self.play(self._playback_start is not None))
        loops = self._run_image_loader, self._run_playback
        self._threads = [threading.Thread(target=loop, daemon=True) for loop in loops]
        self.show(0)

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._request(self._requested)
        for thread in self._threads:
            thread.join()

    def show(self, k: int) -> None:
        """Show the k-th frame."""
        k = min(max(k, 0), len(self.index) - 1)
        with self._lock:
            self.current = k
            index = int(self.index[k])
            time_of = f", {self._seconds[k]:.3f} s" if self._seconds is not None else ""
            texts = show_frame(self.page, self._scenes, index)
            headline = f"Frame {index}{time_of}, {k + 1} of {len(self.index)}"
            self.description.content = "\n\n".join([headline, *texts])
        self._request(k)

    def _request(self, k: int, loaded: int | None = None) -> None:
        """Request the images of a frame; `loaded` replaces the number of the frame whose images are shown."""
        with self._request_changed:
            self._requested, self._loaded = k, self._loaded if loaded is None else loaded
            self._request_changed.notify_all()

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
        page.add(name, scene.unit)
        page.set_size(name, scene.axis_length, float(np.quantile(sizes, 0.9)) if len(sizes) else np.nan)
        page.set_points(name, scene.points, scene.point_colors)
        page.set_path(name, scene.world_from_object[:, :3, 3], scene.status)
    return page


def collect_frames(scenes: Mapping[str, Scene]) -> tuple[IntArray, FloatArray]:
    """Return the frame numbers (n,) of all objects, and their times (n,)."""
    index, first = np.unique(np.concatenate([scene.index for scene in scenes.values()]), return_index=True)
    return index, np.concatenate([scene.times for scene in scenes.values()])[first]


def show_frame(page: ScenePage, scenes: Mapping[str, Scene], index: int) -> list[str]:
    """Set the poses of all objects to those of a frame, and return their descriptions as Markdown."""
    texts = []
    with page.server.atomic():
        for name, scene in scenes.items():
            k = int(np.searchsorted(scene.index, index))
            if k == len(scene.index) or scene.index[k] != index:
                page.set_pose(name, None, None)
                continue
            pose = scene.world_from_object[k], scene.covariance[k]
            page.set_pose(name, *pose)
            texts.append(page.describe_pose(name, name, FrameStatus(scene.status[k]), scene.reason[k], *pose))
    return texts


def add_controls(
    page: ScenePage, objects: Sequence[str], cameras: Sequence[str], on_change: Callable[[], None]
) -> None:
    """Add the choice of viewpoints, separately for each client, and the switches of the layers.

    `on_change` is called after a change of the layers.
    """
    gui, closeups = page.server.gui, {f"{name or 'the object'}, close up": name for name in objects}
    views = gui.add_dropdown("See", (WHOLE_SCENE, *closeups, *cameras), initial_value=WHOLE_SCENE)

    def on_select(event: Any) -> None:
        if event.client is not None:
            camera = cameras.index(views.value) if views.value in cameras else None
            page.set_view(event.client, camera, closeups.get(views.value))

    views.on_update(on_select)
    with gui.add_folder("Layers"):
        for layer in LAYERS:
            box = gui.add_checkbox(layer, initial_value=True)

            def toggle(_: Any, layer: str = layer, box: Any = box) -> None:
                page.visible[layer] = box.value
                page.refresh()
                on_change()

            box.on_update(toggle)
        dark = gui.add_checkbox("Dark", initial_value=False)

        def darken(_: Any) -> None:
            gui.configure_theme(dark_mode=dark.value, **THEME)
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
            show_frame(page, scenes, int(index[k]))
            if stills is not None and step % image_step == 0:
                page.set_images(stills.read_frame_set(int(index[k])))
        return str(serializer.as_html())


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
        rig: the cameras.
        units: length unit of the poses of each object, by name.
        title: title of the page.

    Attributes:
        error: error message if the page stopped before the run ended, else "".
    """

    def __init__(self, server: Any, rig: Rig, units: Mapping[str, str], title: str) -> None:
        scene = build_scene(Trajectory([], rig.names, rig.unit), rig)
        self.page, self.error, self._server, self._scene = ScenePage(server, scene, rig), "", server, scene
        self._labels = {name: name if len(units) > 1 else "" for name in units}
        self._paths = {name: ObjectPath() for name in units}
        self._latest: dict[str, TrackedFrame] = {}
        self._lock, self._updated, self._ended = threading.Lock(), threading.Event(), threading.Event()
        for name, unit in units.items():
            self.page.add(name, unit)
        server.gui.add_markdown(f"**{escape_markdown(title)}**")
        self.status_text = server.gui.add_markdown("Nothing is tracked yet.")
        add_controls(self.page, [*units], rig.names, self._updated.set)
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
