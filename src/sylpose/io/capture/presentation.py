"""Presentation time stamps of a video's frames, from its index or its packets, without decoding."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import av
import av.error
from av.container import InputContainer
from av.video.stream import VideoStream

# A file that ends earlier than its declared duration by more than this many seconds, and by more than so many frames,
# is cut off (choice: durations are rounded, and the last frame's is unknown).
MIN_CUT_S, MIN_CUT_FRAMES = 0.1, 2.5
# Frame rate assumed of a file that declares none, per second (choice).
ASSUMED_RATE = 25.0


@dataclass(frozen=True)
class Presentation:
    """Frames of a video.

    Attributes:
        n_frames: their number; of a file that is cut off, as declared if it declares one.
        pts: presentation time stamp of each, increasing, units of `time_base`; None if unknown or not usable.
        time_base: seconds.
        rate: average number of frames per second; None if unknown.
    """

    n_frames: int
    pts: tuple[int, ...] | None
    time_base: float
    rate: float | None


def read_presentation(path: Path, container: InputContainer, stream: VideoStream, warnings: list[str]) -> Presentation:
    """Read the time stamps of a video that was just opened.

    The index is enough where frames are stored in order; else, or if it is incomplete, all packets are read.

    Args:
        path: the video.
        container, stream: the opened file; its position changes.
        warnings: messages are appended.
    """
    rate = stream.average_rate or stream.guessed_rate
    rate_s, time_base = float(rate) if rate else None, float(stream.time_base or 1)
    n_declared, is_reordered = _count_declared(path, stream), bool(stream.codec_context.has_b_frames)
    if n_declared and not is_reordered and len(stream.index_entries) == stream.frames:
        stamps, cut = _read_index(container, stream), None
    else:
        stamps, cut = _read_packets(path, container, stream, rate_s)
        if cut is not None and not n_declared:
            warnings.append(cut)
    pts = [stamp for stamp in stamps if stamp is not None]
    if len(pts) < len(stamps) or not pts:
        return Presentation(n_declared or len(stamps), None, time_base, rate_s)
    if is_reordered:
        pts.sort()
    if any(a >= b for a, b in pairwise(pts)):
        warnings.append(f"{path.name}: its time stamps do not increase; its frames are numbered in order.")
        return Presentation(len(pts), None, time_base, rate_s)
    if cut is not None and rate_s:
        step = max(round(1 / (rate_s * time_base)), 1)
        pts += [pts[-1] + step * (k + 1) for k in range(n_declared - len(pts))]
    return Presentation(len(pts), tuple(pts), time_base, rate_s)


def _count_declared(path: Path, stream: VideoStream) -> int:
    """Return the number of frames that the container declares, minus those hidden by its edit list; 0 if unknown.

    Stream-copied cuts have edit lists.
    """
    entries = stream.index_entries
    hidden = sum(entry.is_discard for entry in entries) if len(entries) == stream.frames else 0
    # More frames than bytes: the header is damaged or malicious, so the frames are counted instead.
    return stream.frames - hidden if stream.frames < path.stat().st_size else 0


def _read_index(container: InputContainer, stream: VideoStream) -> list[int | None]:
    """Return the time stamps in an index of all frames, which are decoding times up to a constant; empty if unusable."""
    shown = [entry for entry in stream.index_entries if entry.size and not entry.is_discard]
    try:
        first = next((packet for packet in container.demux(stream) if packet.size and not packet.is_discard), None)
    except av.error.FFmpegError:
        return []
    if not shown or first is None or first.pts is None:
        return []
    return [entry.timestamp - shown[0].timestamp + first.pts for entry in shown]


def _read_packets(
    path: Path, container: InputContainer, stream: VideoStream, rate: float | None
) -> tuple[list[int | None], str | None]:
    """Read the time stamps of all packets that are shown.

    Returns:
        the time stamps in the order of the file; a message if the file is cut off.
    """
    stamps, end = list[int | None](), 0.0
    declared = float(stream.duration * stream.time_base) if stream.duration and stream.time_base else 0.0
    if not declared and len(container.streams) == 1 and container.duration:
        declared = container.duration / av.time_base
    try:
        for packet in container.demux(stream):
            if packet.size and not packet.is_discard:
                stamps.append(packet.pts)
                if packet.pts is not None:
                    end = max(end, float((packet.pts + (packet.duration or 0)) * packet.time_base))
    except av.error.FFmpegError as error:
        return stamps, f"{path.name} is cut off after {len(stamps)} frames ({error.strerror})."
    if end < declared - max(MIN_CUT_S, MIN_CUT_FRAMES / (rate or ASSUMED_RATE)):
        return stamps, f"{path.name} is cut off: {len(stamps)} frames, {end:.2f} s of the declared {declared:.2f} s."
    return stamps, None
