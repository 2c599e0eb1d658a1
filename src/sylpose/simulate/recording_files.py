"""What rendered sequences are written as: a session's files, and the truth beside them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.atomic_io import boxes_toml, replacing
from sylpose.geometry.arrays import Image
from sylpose.rig import Rig

__all__ = ["FRAME_RATE", "session_folder", "suffixes", "write_boxes", "write_truth", "write_videos"]

FRAME_RATE = 30

Box = tuple[int, int, int, int]


def session_folder(path: str | Path, rig: Rig) -> Path:
    """A folder with the rig's `calibration.toml` in it; made when absent.

    Raises:
        OSError: a folder or file that cannot be written.
        ValueError: images of odd width or height, which videos cannot hold.
    """
    from sylpose import calibration

    for camera in rig:
        if camera.size[0] % 2 or camera.size[1] % 2:
            raise ValueError(f"camera {camera.name}: videos need an even width and height, got {camera.size}")
    folder = Path(path)
    folder.mkdir(parents=True, exist_ok=True)
    calibration.save(rig, folder / "calibration.toml")
    return folder


def write_truth(folder: Path, poses: Mapping[str, RigidTransform], *, repeats: int = 1) -> None:
    """`groundtruth.tum` (`time tx ty tz qx qy qz qw`, world_from_object, seconds) of each object, and `dataset.toml` (the
    first object's centre in the first frame).

    Args:
        poses: by object, (n,) world_from_object; with several objects each one's file has its name in it.
        repeats: how often the poses follow one another.
    """
    names = [f"groundtruth{suffix}.tum" for suffix in suffixes(list(poses))]
    for name, its in zip(names, poses.values(), strict=True):
        rows = np.column_stack([its.translation, its.rotation.as_quat(canonical=True)])
        table = np.column_stack([np.arange(repeats * len(rows)) / FRAME_RATE, np.tile(rows, (repeats, 1))])
        with replacing(folder / name) as part:
            np.savetxt(part, table, fmt="%.9g", header="time tx ty tz qx qy qz qw : world_from_object")
    center = ", ".join(f"{v:.9g}" for v in next(iter(poses.values())).translation[0])
    with replacing(folder / "dataset.toml") as part:
        part.write_text(f'calibration = "calibration.toml"\ngroundtruth = "{names[0]}"\ncenter_world = [{center}]\n')


def suffixes(objects: Sequence[str]) -> list[str]:
    """What the objects' own files have at the end of their names: nothing where there is one object alone."""
    return [f"_{name}" for name in objects] if len(objects) > 1 else [""]


def write_boxes(folder: Path, boxes: Mapping[str, Mapping[str, Box]]) -> None:
    """`boxes.toml`, the objects' boxes in the first frame, by object and camera; with several objects a table each.

    Without any object there is none, nor is an earlier one left, which would be taken for this session's.
    """
    if boxes:
        named = boxes if len(boxes) > 1 else {"": next(iter(boxes.values()))}
        with replacing(folder / "boxes.toml") as part:
            part.write_text(boxes_toml(named), encoding="utf-8")
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
    """One video per camera (`cam_0.mp4`, ...), at 30 frames per second.

    Args:
        images: frame by frame, BGR (h, w, 3) per camera; None is not written, so that the video has a frame less.
        frames: how many there are.
        quality: x264's "crf". 14 compresses so little that its noise stays well under the camera's own.
        repeats: how often the frames follow one another: as the same packets, so as the same pictures.
    """
    codec, options = "mpeg4", {"qscale": "2"}
    if "libx264" in av.codecs_available:
        # One key frame at the start and no frames that refer to later ones: such a video can follow itself.
        key = {"bf": "0", "g": str(frames)} if repeats > 1 else {}
        # One thread, as the result depends on their number.
        codec, options = "libx264", {"crf": str(quality), "preset": "veryfast", "threads": "1", **key}
    with ExitStack() as whole:
        parts = [whole.enter_context(replacing(folder / f"{camera.name}.mp4")) for camera in rig]
        files = [whole.enter_context(av.open(str(part), "w")) for part in parts]
        streams: list[Any] = []  # PyAV's types do not tell a stream of video from others
        for file, camera in zip(files, rig, strict=True):
            stream: Any = file.add_stream(codec, rate=FRAME_RATE, options=options)
            stream.width, stream.height = camera.size
            stream.pix_fmt = "yuv420p"
            stream.time_base = Fraction(1, FRAME_RATE)
            streams.append(stream)
        packets: list[list[Any]] = [[] for _ in streams]  # of one round, where there are several

        def put(c: int, made: Sequence[Any]) -> None:
            for packet in made:
                if repeats > 1:
                    packets[c].append(_later(packet, 0))  # muxing changes a packet
                files[c].mux(packet)

        for shown in images:
            for c, (stream, image) in enumerate(zip(streams, shown, strict=True)):
                if image is not None:
                    put(c, stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        for c, stream in enumerate(streams):
            put(c, stream.encode())
            for k in range(1, repeats):
                for packet in packets[c]:
                    files[c].mux(_later(packet, k * frames))


def _later(packet: Any, frames: int) -> Any:
    """The same packet again, so many frames later."""
    again: Any = av.Packet(bytes(packet))
    again.stream, again.time_base, again.is_keyframe = packet.stream, packet.time_base, packet.is_keyframe
    delay = round(frames / FRAME_RATE / packet.time_base)
    again.pts, again.dts, again.duration = packet.pts + delay, packet.dts + delay, packet.duration
    return again
