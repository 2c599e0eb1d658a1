"""Rendered scenes written as sessions with ground truth, and the demo scene."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.atomic_io import format_boxes_toml, replace_atomically
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.rig import Rig, intersect_rays
from sylpose.simulate.render import Actor, Scene, chamfered_box, render_frames
from sylpose.simulate.rigs import arc

FRAME_RATE = 30

Box = tuple[int, int, int, int]


def create_session_folder(path: str | Path, rig: Rig) -> Path:
    """Create a session folder (if missing) and write the rig's `calibration.toml`.

    Raises:
        OSError: a folder or file cannot be written.
        ValueError: images have an odd width or height, which videos do not support.
    """
    from sylpose.io import calibration

    for camera in rig:
        if camera.size[0] % 2 or camera.size[1] % 2:
            raise ValueError(f"camera {camera.name}: videos need an even width and height, got {camera.size}")
    folder = Path(path)
    folder.mkdir(parents=True, exist_ok=True)
    calibration.save(rig, folder / "calibration.toml")
    return folder


def write_ground_truth(folder: Path, poses: Mapping[str, RigidTransform], *, repeats: int = 1) -> None:
    """Write the ground truth of the objects.

    Files: `groundtruth.tum` per object (`time tx ty tz qx qy qz qw`, world_from_object, seconds), and `dataset.toml`
    (the first object's center in the first frame).

    Args:
        folder: output folder.
        poses: (n,) world_from_object by object name; with several objects the file names contain the object's name.
        repeats: number of times the poses are repeated.
    """
    names = [f"groundtruth{suffix}.tum" for suffix in object_suffixes(list(poses))]
    for name, object_poses in zip(names, poses.values(), strict=True):
        rows = np.column_stack([object_poses.translation, object_poses.rotation.as_quat(canonical=True)])
        table = np.column_stack([np.arange(repeats * len(rows)) / FRAME_RATE, np.tile(rows, (repeats, 1))])
        with replace_atomically(folder / name) as part:
            np.savetxt(part, table, fmt="%.9g", header="time tx ty tz qx qy qz qw : world_from_object")
    center = ", ".join(f"{v:.9g}" for v in next(iter(poses.values())).translation[0])
    with replace_atomically(folder / "dataset.toml") as part:
        part.write_text(f'calibration = "calibration.toml"\ngroundtruth = "{names[0]}"\ncenter_world = [{center}]\n')


def object_suffixes(objects: Sequence[str]) -> list[str]:
    """Return the file name suffix of each object: `_NAME`, or empty for a single object."""
    return [f"_{name}" for name in objects] if len(objects) > 1 else [""]


def write_boxes(folder: Path, boxes: Mapping[str, Mapping[str, Box]]) -> None:
    """Write `boxes.toml`, the objects' boxes in the first frame per camera; with several objects a table each.

    Without objects an existing file is removed, so that it is not used for this session.
    """
    if boxes:
        named = boxes if len(boxes) > 1 else {"": next(iter(boxes.values()))}
        with replace_atomically(folder / "boxes.toml") as part:
            part.write_text(format_boxes_toml(named), encoding="utf-8")
    else:
        (folder / "boxes.toml").unlink(missing_ok=True)


def write_videos(
    folder: Path,
    rig: Rig,
    images: Iterable[Sequence[Image | None]],
    frames: int,
    *,
    quality: int = 14,
    repeats: int = 1,
) -> None:
    """Write one video per camera (`cam_0.mp4`, ...), at 30 frames per second.

    Args:
        folder: output folder.
        rig: the cameras.
        images: per frame, BGR (h, w, 3) per camera; None is skipped, so that the video has one frame less.
        frames: number of frames.
        quality: x264's "crf". The compression noise of 14 is well below the camera's own.
        repeats: number of times the frames are repeated, as the same packets and so with identical pictures.
    """
    codec, options = "mpeg4", {"qscale": "2"}
    if "libx264" in av.codecs_available:
        # One key frame at the start and no references to later frames: such a video can be appended to itself.
        key = {"bf": "0", "g": str(frames)} if repeats > 1 else {}
        # The same images are the same bytes: with several threads they are not, and x264's "macroblock tree" reads memory
        # that it has not written.
        same = {"threads": "1", "mbtree": "0"}
        codec, options = "libx264", {"crf": str(quality), "preset": "veryfast", **same, **key}
    with ExitStack() as stack:
        parts = [stack.enter_context(replace_atomically(folder / f"{camera.name}.mp4")) for camera in rig]
        files = [stack.enter_context(av.open(str(part), "w")) for part in parts]
        streams: list[Any] = []  # PyAV's types do not distinguish video streams from others
        for file, camera in zip(files, rig, strict=True):
            stream: Any = file.add_stream(codec, rate=FRAME_RATE, options=options)
            stream.width, stream.height = camera.size
            stream.pix_fmt = "yuv420p"
            stream.time_base = Fraction(1, FRAME_RATE)
            streams.append(stream)
        packets: list[list[Any]] = [[] for _ in streams]  # of the first round, if there are several

        def mux_packets(c: int, made: Sequence[Any]) -> None:
            for packet in made:
                if repeats > 1:
                    packets[c].append(_delay_packet(packet, 0))  # muxing changes a packet
                files[c].mux(packet)

        for frame_images in images:
            for c, (stream, image) in enumerate(zip(streams, frame_images, strict=True)):
                if image is not None:
                    mux_packets(c, stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        for c, stream in enumerate(streams):
            mux_packets(c, stream.encode())
            for k in range(1, repeats):
                for packet in packets[c]:
                    files[c].mux(_delay_packet(packet, k * frames))


def _delay_packet(packet: Any, frames: int) -> Any:
    """Return a copy of the packet, delayed by a number of frames."""
    copy: Any = av.Packet(bytes(packet))
    copy.stream, copy.time_base, copy.is_keyframe = packet.stream, packet.time_base, packet.is_keyframe
    delay = round(frames / FRAME_RATE / packet.time_base)
    copy.pts, copy.dts, copy.duration = packet.pts + delay, packet.dts + delay, packet.duration
    return copy


# The block's longest side, as a share of the image's shorter side.
OBJECT_SHARE = 0.45
# Lens distortion, assigned to the cameras cyclically: mild barrel distortion, as of webcams.
LENS_DISTORTIONS = (
    (-0.11, 0.03, 0.0004, -0.0003, 0),
    (-0.08, 0.01, -0.0005, 0.0002, 0),
    (-0.13, 0.04, 0.0002, 0.0006, 0),
)


@dataclass(frozen=True, eq=False)
class DemoTruth:
    """Ground truth of a rendered sequence.

    Attributes:
        rig: the cameras.
        times: (n,) seconds.
        world_from_object: (n,) poses; the object's frame has the world's axes in the first frame and its origin at the
            body's center.
        vertices: (v, 3) the body's corners in the object's frame.
        boxes: the object's box in the first frame per camera: x, y, width, height in pixels; only for cameras in which
            it is visible.
    """

    rig: Rig
    times: FloatArray
    world_from_object: RigidTransform
    vertices: FloatArray
    boxes: dict[str, tuple[int, int, int, int]]


def make_demo_scene(
    *,
    rig: Rig | None = None,
    frames: int = 60,
    angle_deg: float = 90.0,
    seed: int = 0,
    size: tuple[int, int] = (640, 480),
    n_cameras: int = 4,
    other_actors: Sequence[Actor] = (),
    noise: float = 1.5,
    exposure: float = 0.0,
) -> Scene:
    """Build the demo scene: a textured block that rotates about a tilted axis, wobbles and drifts by about its size.

    Args:
        rig: None: an arc of `n_cameras` over 120 degrees at alternating heights, with lens distortion and images of
            `size`. The cameras of any other rig should look at one point; the block is placed there, as large as fits
            the images.
        frames: number of frames, at 30 per second.
        angle_deg: total rotation angle, degrees.
        seed: seed of textures, background and noise.
        size: (width, height) of the images, pixels.
        n_cameras: number of cameras of the default rig.
        other_actors: bodies that move differently: distractors, occluders.
        noise, exposure: as in `Scene`.

    Returns:
        The scene; its first actor is the block.

    Raises:
        ValueError: there are no frames, the size is under 64 pixels, or the rig does not look at one point.
    """
    if frames < 1:
        raise ValueError(f"a sequence needs at least one frame, got {frames}")
    rig = _make_demo_rig(n_cameras, size) if rig is None else rig
    rng = np.random.default_rng(seed)
    target = intersect_rays([c.center for c in rig], [c.direction for c in rig])
    if len(rig) == 1:  # a single axis has no nearest point: use one unit of length in front of the camera
        target = rig.cameras[0].center + rig.cameras[0].direction
    depths = np.array([camera.camera_from_world.apply(target)[2] for camera in rig])
    if (depths <= 0).any():
        raise ValueError(f"camera {rig.names[int(np.argmin(depths))]} does not look at the point the others look at")
    pixels_per_unit = np.array([camera.focal for camera in rig]) / depths
    span = OBJECT_SHARE * float(np.min([min(camera.size) for camera in rig] / pixels_per_unit))
    body = chamfered_box(span * np.array([1.0, 0.74, 0.86]), 1.25 * float(pixels_per_unit.max()), seed=seed)
    axis = Rotation.from_rotvec(rng.normal(0, 0.1, 3)).apply([0.25, 0.9, 0.35])
    axis = axis / np.linalg.norm(axis)
    drift = span * Rotation.from_rotvec(rng.normal(0, 0.1, 3)).as_matrix()

    def path(frame: float) -> RigidTransform:
        s = frame / max(frames - 1, 1)
        wave, arch = np.sin(2 * np.pi * s), np.sin(np.pi * s)
        # The wobble is zero at both ends: the total rotation angle is exactly `angle_deg`.
        wobble = Rotation.from_rotvec(np.deg2rad(6) * np.array([wave, 0.3 * arch, -arch]))
        turn = Rotation.from_rotvec(np.deg2rad(angle_deg) * (s - 0.06 * wave) * axis)
        return RigidTransform.from_components(
            target + drift @ np.array([0.7 * s - 0.35, 0.16 * wave, 0.45 * arch - 0.2]), wobble * turn
        )

    return Scene(rig, (Actor(body, path), *other_actors), frames, seed, noise, exposure)


def compute_demo_truth(scene: Scene) -> DemoTruth:
    """Compute the ground truth of a scene at 30 frames per second."""
    poses = scene.object_poses()
    first = poses[0]
    # A path may start with any rotation; the object's frame has the world's axes in the first frame.
    vertices = first.rotation.apply(scene.actors[0].body.vertices)
    world_from_object = poses * RigidTransform.from_rotation(first.rotation.inv())
    boxes = {}
    for camera in scene.rig:
        corners = camera.project(world_from_object[0].apply(vertices))
        low = np.maximum(np.floor(corners.min(axis=0)), 0)
        high = np.minimum(np.ceil(corners.max(axis=0)) + 1, camera.size)
        if (high > low).all():  # false for NaN, too
            boxes[camera.name] = (int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1]))
    return DemoTruth(scene.rig, np.arange(scene.frames) / FRAME_RATE, world_from_object, vertices, boxes)


def write_sequence(out_dir: str | Path, scene: Scene, *, boxes: bool = False) -> DemoTruth:
    """Render a scene and write it as a session with ground truth.

    Files: one video per camera (`cam_0.mp4`, ...), `calibration.toml`, `groundtruth.tum` (`time tx ty tz qx qy qz qw`,
    world_from_object, seconds) and `dataset.toml` (the object's center in the first frame).

    Args:
        out_dir: output folder, created if missing; files of these names in it are replaced.
        scene: the scene; its first actor is the object.
        boxes: also write `boxes.toml`, the object's boxes in the first frame.

    Returns:
        The ground truth.

    Raises:
        OSError: a folder or file cannot be written.
        ValueError: images have an odd width or height, which videos do not support.
    """
    out = create_session_folder(out_dir, scene.rig)
    truth = compute_demo_truth(scene)
    write_ground_truth(out, {"object": truth.world_from_object})
    write_boxes(out, {"object": truth.boxes} if boxes else {})
    write_videos(out, scene.rig, render_frames(scene), scene.frames)
    return truth


def _make_demo_rig(n: int, size: tuple[int, int]) -> Rig:
    """Build a rig of cameras 1.2 m around the world's origin, alternately above and below it."""
    if n < 1 or min(size) < 64:
        raise ValueError(f"the demo needs at least one camera and images of 64 pixels or more, got {n} and {size}")
    heights = np.where(np.arange(n) % 2, -0.15, 0.45)
    rig = arc(n, min(40.0, 360.0 / n), 1.2, 1.3 * max(size), size, height=heights)
    lenses = [np.array(LENS_DISTORTIONS[i % len(LENS_DISTORTIONS)], dtype=float) for i in range(n)]
    cameras = [
        type(c)(c.name, c.size, c.matrix, lens, c.camera_from_world) for c, lens in zip(rig, lenses, strict=True)
    ]
    return Rig(cameras, rig.unit)
