"""Recordings of scenes written as sessions: several objects, cameras that are not quite synchronised or miss frames."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull

from sylpose.atomic_io import replacing
from sylpose.geometry.arrays import BoolArray, FloatArray, Image
from sylpose.simulate.demo import demo_truth
from sylpose.simulate.recording_files import (
    FRAME_RATE,
    session_folder,
    suffixes,
    write_boxes,
    write_truth,
    write_videos,
)
from sylpose.simulate.render import Actor, Scene, render_frames
from sylpose.simulate.render import Path as Motion

__all__ = ["Recording", "visible_shares", "write_recording"]


@dataclass(frozen=True, eq=False)
class Recording:
    """What is rendered and how it is written.

    Attributes:
        scene: its first actors are the objects.
        objects: their names; one alone is just called "object".
        boxes: whether the objects' boxes in the first frame are written.
        shown: (frames, C) which frames the cameras recorded; None: all. Time stamps are written where it is given.
        skew: (C,) seconds by which each camera is exposed late; None: all at once.
        stamped: whether time stamps tell the skew.
        repeats: how often the scene's frames follow one another.
        quality: x264's "crf": the smaller the better.
    """

    scene: Scene
    objects: tuple[str, ...] = ("object",)
    boxes: bool = True
    shown: BoolArray | None = None
    skew: tuple[float, ...] | None = None
    stamped: bool = False
    repeats: int = 1
    quality: int = 14

    @property
    def frames(self) -> int:
        """Number of instants, repeats included."""
        return self.scene.frames * self.repeats


def write_recording(recording: Recording, out_dir: str | Path) -> None:
    """Render a recording and write it as a session, at 30 frames per second: one video per camera, `calibration.toml`,
    `boxes.toml` (with a table per object where there are several) and, where the cameras' times matter, `timestamps.csv`.

    With it goes the truth: `groundtruth.tum` (world_from_object at the nominal times) and `dataset.toml` (the first
    object's centre in the first frame) as `write_sequence` writes them, `vertices.txt` (the body's corners in the object's
    frame), `visible.csv` (of `visible_shares`), each with `_OBJECT` in its name where there are several, and
    `true_offsets.toml` (the skew).

    Raises:
        OSError: a folder or file that cannot be written.
        ValueError: images of odd width or height, which videos cannot hold.
    """
    scene, rig = recording.scene, recording.scene.rig
    out = session_folder(out_dir, rig)
    truths = {name: demo_truth(replace(scene, actors=scene.actors[k:])) for k, name in enumerate(recording.objects)}
    write_truth(out, {name: truth.world_from_object for name, truth in truths.items()}, repeats=recording.repeats)
    write_boxes(out, {name: truth.boxes for name, truth in truths.items()} if recording.boxes else {})
    for k, (truth, suffix) in enumerate(zip(truths.values(), suffixes(recording.objects), strict=True)):
        with replacing(out / f"vertices{suffix}.txt") as part:
            np.savetxt(part, truth.vertices, fmt="%.9g", header="corners, object's frame")
        _write_table(out / f"visible{suffix}.csv", rig.names, visible_shares(scene, k), "{:.3f}")
    if recording.skew is not None:
        offsets = [f"{name} = {offset}" for name, offset in zip(rig.names, recording.skew, strict=True)]
        with replacing(out / "true_offsets.toml") as part:
            part.write_text("\n".join(offsets) + "\n")
    if recording.stamped or recording.shown is not None:
        stamps = np.tile(np.arange(scene.frames)[:, None] / FRAME_RATE, (1, len(rig)))
        if recording.stamped and recording.skew is not None:
            stamps = stamps + np.asarray(recording.skew)
        if recording.shown is not None:
            stamps[~recording.shown] = np.nan
        _write_table(out / "timestamps.csv", rig.names, stamps, "{:.6f}")
    write_videos(out, rig, _images(recording), scene.frames, quality=recording.quality, repeats=recording.repeats)


def visible_shares(scene: Scene, index: int = 0) -> FloatArray:
    """(frames, C) share of an actor's corners that are inside a camera's image and not behind another actor."""
    shares = np.zeros((scene.frames, len(scene.rig)))
    others = [actor for i, actor in enumerate(scene.actors) if i != index]
    for frame in range(scene.frames):
        pose = scene.actors[index].path(float(frame))
        corners = pose.apply(scene.actors[index].body.vertices)
        posed = [(other.body, other.path(float(frame))) for other in others]
        for c, camera in enumerate(scene.rig):
            pixels = camera.project(corners)
            inside = ((pixels > -0.5) & (pixels < np.array(camera.size) - 0.5)).all(axis=1)  # false for NaN, too
            distance = np.linalg.norm(pose.translation - camera.center)
            for body, other in posed:
                if np.linalg.norm(other.translation - camera.center) < distance:
                    outline = camera.project(other.apply(body.vertices))
                    if np.isfinite(outline).all():
                        hull = ConvexHull(outline)
                        behind = pixels @ hull.equations[:, :2].T + hull.equations[:, 2] < 0
                        inside &= ~behind.all(axis=1)
            shares[frame, c] = inside.mean()
    return shares


def _write_table(path: Path, names: Sequence[str], values: FloatArray, style: str) -> None:
    with replacing(path) as part, part.open("w", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["frame", *names])
        for k, row in enumerate(values):
            table.writerow([k, *("" if np.isnan(v) else style.format(v) for v in row)])


def _images(recording: Recording) -> Iterator[list[Image | None]]:
    """The cameras' images, frame by frame, each at its own time; None where a camera recorded none."""
    for k, images in enumerate(_rendered(recording)):
        shown = [True] * len(images) if recording.shown is None else recording.shown[k]
        yield [image if there else None for image, there in zip(images, shown, strict=True)]


def _rendered(recording: Recording) -> Iterator[tuple[Image, ...]]:
    scene = recording.scene
    if recording.skew is None:
        yield from render_frames(scene)
        return
    alone = []
    for k, (name, skew) in enumerate(zip(scene.rig.names, recording.skew, strict=True)):
        actors = tuple(Actor(actor.body, _shifted(actor.path, skew * FRAME_RATE)) for actor in scene.actors)
        # Another seed each: a rig's first camera has the first background of its scene.
        alone.append(
            render_frames(replace(scene, rig=scene.rig.subset([name]), actors=actors, seed=100 * scene.seed + k))
        )
    for images in zip(*alone, strict=True):
        yield tuple(image for (image,) in images)


def _shifted(path: Motion, frames: float) -> Motion:
    """The path as it is seen so many frames late."""
    return lambda frame: path(frame + frames)
