"""Rendered recordings with several objects, time offsets, missing frames and repeats, for benchmarks and tests."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull

from sylpose.atomic_io import replace_atomically
from sylpose.geometry.arrays import BoolArray, FloatArray, Image
from sylpose.simulate import Actor, Scene, compute_demo_truth, render_frames
from sylpose.simulate.recordings import (
    FRAME_RATE,
    create_session_folder,
    object_suffixes,
    write_boxes,
    write_ground_truth,
    write_videos,
)
from sylpose.simulate.render import Path as Motion

__all__ = ["Recording", "compute_visible_shares", "write_recording"]


@dataclass(frozen=True, eq=False)
class Recording:
    """Recording to be rendered and written.

    Attributes:
        scene: the scene; its first actors are the objects.
        objects: names of the objects; a single one is called "object".
        boxes: whether to write the objects' boxes in the first frame.
        recorded: (frames, C) which frames the cameras recorded; None: all. If given, timestamps are written.
        time_offsets: (C,) delay of each camera's exposure, seconds; None: all synchronized.
        drifts: (C,) increase of each delay, seconds per second, with `time_offsets`.
        with_timestamps: whether the timestamps include the delay.
        repeats: number of times the scene's frames are repeated.
        quality: x264's "crf": smaller is better.
    """

    scene: Scene
    objects: tuple[str, ...] = ("object",)
    boxes: bool = True
    recorded: BoolArray | None = None
    time_offsets: tuple[float, ...] | None = None
    drifts: tuple[float, ...] = ()
    with_timestamps: bool = False
    repeats: int = 1
    quality: int = 14

    @property
    def frames(self) -> int:
        """Number of frames, repeats included."""
        return self.scene.frames * self.repeats


def write_recording(recording: Recording, out_dir: str | Path) -> None:
    """Render a recording and write it as a session with ground truth, at 30 frames per second.

    Session files: one video per camera, `calibration.toml`, `boxes.toml` (a table per object if there are several) and,
    if frames are missing or `with_timestamps` is set, `timestamps.csv`.

    Ground truth: `groundtruth.tum` (world_from_object at the nominal times) and `dataset.toml` (the first object's
    center in the first frame) as in `write_sequence`, `vertices.txt` (the body's corners in the object's frame),
    `visible.csv` (`compute_visible_shares`), and `true_offsets.toml` (the time offsets). With several objects the
    per-object files have `_OBJECT` in their names.

    Args:
        recording: the recording.
        out_dir: output folder, created if missing.

    Raises:
        OSError: a folder or file cannot be written.
        ValueError: images have an odd width or height, which videos do not support.
    """
    scene, rig = recording.scene, recording.scene.rig
    out = create_session_folder(out_dir, rig)
    truths = {
        name: compute_demo_truth(replace(scene, actors=scene.actors[k:])) for k, name in enumerate(recording.objects)
    }
    write_ground_truth(
        out, {name: truth.world_from_object for name, truth in truths.items()}, repeats=recording.repeats
    )
    write_boxes(out, {name: truth.boxes for name, truth in truths.items()} if recording.boxes else {})
    for k, (truth, suffix) in enumerate(zip(truths.values(), object_suffixes(recording.objects), strict=True)):
        with replace_atomically(out / f"vertices{suffix}.txt") as part:
            np.savetxt(part, truth.vertices, fmt="%.9g", header="corners, object's frame")
        _write_table(out / f"visible{suffix}.csv", rig.names, compute_visible_shares(scene, k), "{:.3f}")
    if recording.time_offsets is not None:
        offsets = [f"{name} = {offset}" for name, offset in zip(rig.names, recording.time_offsets, strict=True)]
        with replace_atomically(out / "true_offsets.toml") as part:
            part.write_text("\n".join(offsets) + "\n")
    if recording.with_timestamps or recording.recorded is not None:
        stamps = np.tile(np.arange(scene.frames)[:, None] / FRAME_RATE, (1, len(rig)))
        if recording.with_timestamps and recording.time_offsets is not None:
            stamps = stamps + np.asarray(recording.time_offsets)
        if recording.recorded is not None:
            stamps[~recording.recorded] = np.nan
        _write_table(out / "timestamps.csv", rig.names, stamps, "{:.6f}")
    write_videos(
        out, rig, _recorded_images(recording), scene.frames, quality=recording.quality, repeats=recording.repeats
    )


def compute_visible_shares(scene: Scene, index: int = 0) -> FloatArray:
    """Compute the share (frames, C) of an actor's corners inside each camera's image and not behind another actor."""
    shares = np.zeros((scene.frames, len(scene.rig)))
    other_actors = [actor for i, actor in enumerate(scene.actors) if i != index]
    for frame in range(scene.frames):
        pose = scene.actors[index].path(float(frame))
        corners = pose.apply(scene.actors[index].body.vertices)
        posed = [(other.body, other.path(float(frame))) for other in other_actors]
        for c, camera in enumerate(scene.rig):
            pixels = camera.project(corners)
            is_visible = ((pixels > -0.5) & (pixels < np.array(camera.size) - 0.5)).all(axis=1)  # false for NaN, too
            distance = np.linalg.norm(pose.translation - camera.center)
            for body, other in posed:
                if np.linalg.norm(other.translation - camera.center) < distance:
                    outline = camera.project(other.apply(body.vertices))
                    if np.isfinite(outline).all():
                        hull = ConvexHull(outline)
                        half_planes = pixels @ hull.equations[:, :2].T + hull.equations[:, 2] < 0
                        is_visible &= ~half_planes.all(axis=1)
            shares[frame, c] = is_visible.mean()
    return shares


def _write_table(path: Path, names: Sequence[str], values: FloatArray, style: str) -> None:
    with replace_atomically(path) as part, part.open("w", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["frame", *names])
        for k, row in enumerate(values):
            table.writerow([k, *("" if np.isnan(v) else style.format(v) for v in row)])


def _recorded_images(recording: Recording) -> Iterator[list[Image | None]]:
    """Yield the cameras' images per frame, each at its own time; None if a camera recorded none."""
    for k, images in enumerate(_render_with_offsets(recording)):
        recorded = [True] * len(images) if recording.recorded is None else recording.recorded[k]
        yield [image if is_recorded else None for image, is_recorded in zip(images, recorded, strict=True)]


def _render_with_offsets(recording: Recording) -> Iterator[tuple[Image, ...]]:
    scene = recording.scene
    if recording.time_offsets is None:
        yield from render_frames(scene)
        return
    per_camera = []
    for k, (name, skew) in enumerate(zip(scene.rig.names, recording.time_offsets, strict=True)):
        drift = recording.drifts[k] if recording.drifts else 0.0
        actors = tuple(Actor(actor.body, _delay_path(actor.path, skew * FRAME_RATE, drift)) for actor in scene.actors)
        # A different seed for each camera: the background depends on the seed and the index, which is 0 for all.
        per_camera.append(
            render_frames(replace(scene, rig=scene.rig.subset([name]), actors=actors, seed=100 * scene.seed + k))
        )
    for images in zip(*per_camera, strict=True):
        yield tuple(image for (image,) in images)


def _delay_path(path: Motion, frames: float, drift: float) -> Motion:
    """Return the path as observed with a delay of this many frames, and so many more per frame."""
    return lambda frame: path((1.0 + drift) * frame + frames)
