"""Writers of rendered sequences: a session's files and the ground truth."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.atomic_io import format_boxes_toml, replace_atomically
from sylpose.geometry.arrays import Image
from sylpose.rig import Rig

__all__ = [
    "FRAME_RATE",
    "create_session_folder",
    "object_suffixes",
    "write_boxes",
    "write_ground_truth",
    "write_videos",
]

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
        # One thread, as the result depends on the number of threads.
        codec, options = "libx264", {"crf": str(quality), "preset": "veryfast", "threads": "1", **key}
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
