"""The poses drawn into the videos: all cameras tiled, with matches and the object's axes, as a video."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import av
import cv2
import numpy as np
from av.codec.codec import UnknownCodecError
from av.video.reformatter import Colorspace

from sylpose.atomic_io import writing
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.report.camera_consistency import DOUBTED, noisy
from sylpose.report.drawing import (
    DARK,
    GREY,
    WHITE,
    draw_axes,
    draw_crosses,
    draw_dots,
    draw_matches,
    in_colour,
    pen,
    polyline,
    write,
)
from sylpose.results import FramePose, FrameStatus, Observable
from sylpose.rig import Camera, Rig

__all__ = ["OverlayWriter", "Shown", "object_color"]

Color = tuple[int, int, int]
Matches = tuple[FloatArray, FloatArray]
LookedAt = tuple[FloatArray, FloatArray]

# In the order of preference; the last is in every build of FFmpeg. None delays frames: no B-frames, no look-ahead.
ENCODERS: tuple[tuple[str, dict[str, str]], ...] = (
    ("libx264", {"preset": "veryfast", "tune": "zerolatency", "crf": "21"}),
    ("libopenh264", {"allow_skip_frames": "0"}),
    ("mpeg4", {"qscale": "3"}),
)

# BGR, as OpenCV draws: trails, dots and region of a single object; of several each has one colour for all of them.
TRAIL, DOT, REGION = (0, 190, 255), (60, 240, 255), (235, 206, 135)
OBJECT_COLORS: tuple[Color, ...] = (
    (60, 240, 255),
    (235, 206, 135),
    (203, 140, 255),
    (120, 235, 150),
    (80, 165, 255),
    (255, 150, 180),
)
FEATURE, REJECTED = (190, 180, 175), (110, 110, 255)
GOOD, WARN, BAD = (120, 220, 120), (60, 190, 255), (90, 90, 255)

GAP = 4  # pixels between tiles
MIN_TILE = 480  # pixels: smaller images are enlarged to this width, so that text and lines stay readable


@dataclass(frozen=True, eq=False)
class Shown:
    """What is drawn of one object in one frame.

    Attributes:
        name: said where it is not empty, for one of several objects.
        pose: of this frame.
        matches: per camera the inliers' pixels (n, 2) in the frame before and (n, 2) in this one, or None.
        axis_length: of the object's axes, in the calibration's unit.
        regions: per camera the corners (n, 2) of the object's region in pixels, or None; empty for no regions.
        color: BGR of its name, matches and region, to tell it from other objects; None for the usual ones.
        looked_at: per camera, pixels: (n, 2) the features that were looked at, (m, 2) those whose matches were rejected;
            empty where that is not drawn.
    """

    name: str
    pose: FramePose
    matches: Sequence[Matches | None]
    axis_length: float
    regions: Sequence[FloatArray | None] = ()
    color: Color | None = None
    looked_at: Sequence[LookedAt] = ()


class OverlayWriter:
    """Writes a video of all cameras side by side with the matches, the object's axes and the status drawn in.

    A context manager. The file is a fragmented mp4: when the process is killed, it plays up to the last second or so.

    Args:
        path: of the .mp4; replaced when it is there.
        rig: whose cameras are tiled, in its order.
        rate: frames per second.
        max_width: pixels, of the whole picture.
        note: a few words in its head about all frames.

    Raises:
        ValueError: a rate or width that is not positive.
        OSError: naming the file, when it cannot be written.
    """

    def __init__(self, path: Path | str, rig: Rig, rate: float, max_width: int = 1920, note: str = "") -> None:
        if not (np.isfinite(rate) and rate > 0):
            raise ValueError(f"the overlay's rate must be a positive number of frames per second, got {rate}")
        if max_width < 64:
            raise ValueError(f"the overlay's width must be at least 64 pixels, got {max_width}")
        self.path = Path(path)
        self.rig = rig
        self._note = note
        self._layout = _layout(rig, max_width)
        self._count = 0
        self._failed: OSError | None = None
        # FFmpeg writes the header late; opening the file here says at once when it cannot be written.
        with writing(self.path):
            self._file = self.path.open("wb", buffering=0)
        try:
            self._open(Fraction(rate).limit_denominator(1001))
        except BaseException:
            self._file.close()
            raise

    def _open(self, rate: Fraction) -> None:
        name, options = _encoder()
        container = av.open(
            self._file,
            "w",
            format="mp4",
            options={"movflags": "frag_keyframe+empty_moov+default_base_moof", "flush_packets": "1"},
        )
        # Any: PyAV's stubs overload add_stream by literal codec names.
        stream: Any = container.add_stream(name, rate=rate, options=options)
        stream.width, stream.height = self._layout.size
        stream.pix_fmt = "yuv420p"
        # A fragment ends where the next key frame begins: one a second is what a kill can lose.
        stream.codec_context.gop_size = max(1, round(rate))
        stream.codec_context.max_b_frames = 0
        # What players assume for HD when nothing is said; said, colours are the same in all of them.
        stream.codec_context.colorspace = int(Colorspace.ITU709)
        stream.codec_context.color_range = 1
        self._container, self._stream = container, stream

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Finishes the video; twice does no harm."""
        if self._file.closed:
            return
        try:
            if self._failed is not None:  # said by then
                with suppress(Exception):
                    self._container.close()
                return
            with writing(self.path):
                if self._count:
                    self._container.mux(self._stream.encode(None))
                self._container.close()
        finally:
            self._file.close()

    def write(
        self,
        images: Sequence[Image | None],
        pose: FramePose,
        matches: Sequence[Matches | None],
        axis_length: float,
        regions: Sequence[FloatArray | None] = (),
    ) -> None:
        """Draws and appends one frame.

        Args:
            images: per camera (height, width, 3) BGR or (height, width) grey as recorded, or None where there is none.
            pose: of this frame.
            matches: per camera the inliers' pixels (n, 2) in the frame before and (n, 2) in this one, or None.
            axis_length: of the object's axes, in the calibration's unit.
            regions: per camera the corners (n, 2) of the object's region in pixels, or None; empty for no regions.

        Raises:
            ValueError: not one image, match or region per camera, or an image of another size than its camera's.
            OSError: naming the file, when it cannot be written.
        """
        self.write_objects(images, [Shown("", pose, matches, axis_length, regions)])

    def write_objects(self, images: Sequence[Image | None], objects: Sequence[Shown]) -> None:
        """As `write`, with any number of objects in one picture."""
        if self._failed is not None:  # FFmpeg would go on with a file whose header is not there, and crash
            raise self._failed
        frame = av.VideoFrame.from_ndarray(self.draw_objects(images, objects), format="bgr24")
        frame = frame.reformat(format="yuv420p", dst_colorspace=Colorspace.ITU709)
        frame.pts = self._count
        frame.time_base = 1 / self._stream.codec_context.framerate
        self._count += 1
        try:
            with writing(self.path):
                self._container.mux(self._stream.encode(frame))
        except OSError as error:
            self._failed = error
            raise

    def draw(
        self,
        images: Sequence[Image | None],
        pose: FramePose,
        matches: Sequence[Matches | None],
        axis_length: float,
        regions: Sequence[FloatArray | None] = (),
    ) -> Image:
        """The picture that `write` appends: (height, width, 3) BGR."""
        return self.draw_objects(images, [Shown("", pose, matches, axis_length, regions)])

    def draw_objects(self, images: Sequence[Image | None], objects: Sequence[Shown]) -> Image:
        """The picture that `write_objects` appends: (height, width, 3) BGR."""
        n = len(self.rig)
        self._check("images", images)
        for shown in objects:
            self._check("matches", shown.matches)
            self._check("regions", shown.regions or [None] * n)
            self._check("looked_at", shown.looked_at or [None] * n)
        layout = self._layout
        picture = np.full((layout.size[1], layout.size[0], 3), DARK, np.uint8)
        _draw_bar(picture[: layout.bar], objects, self.rig.unit, self._note)
        for i, camera in enumerate(self.rig):
            x, y = layout.corners[i]
            tile = picture[y : y + layout.tile[1], x : x + layout.tile[0]]
            inner = _place(tile, camera, images[i])
            if images[i] is not None:
                for shown in objects:
                    _draw_object(inner, camera, i, shown, layout.text)
            _draw_caption(tile, camera.name, [shown.pose for shown in objects], i, images[i] is not None, layout.text)
        return picture

    def _check(self, name: str, given: Sequence[object]) -> None:
        if len(given) != len(self.rig):
            raise ValueError(f"the overlay needs {len(self.rig)} {name}, one per camera, got {len(given)}")


def object_color(k: int) -> Color:
    """The colour of the k-th of several objects; they repeat after six."""
    return OBJECT_COLORS[k % len(OBJECT_COLORS)]


@dataclass(frozen=True)
class _Layout:
    """Pixels of the whole picture: its size, each tile's top left corner, the tiles' size, the bar's height."""

    size: tuple[int, int]
    corners: tuple[tuple[int, int], ...]
    tile: tuple[int, int]
    bar: int
    text: float


def _layout(rig: Rig, max_width: int) -> _Layout:
    """The grid whose tiles come out largest on a screen of 16:9."""
    width, height = max(c.size[0] for c in rig), max(c.size[1] for c in rig)
    n = len(rig)
    columns = max(range(1, n + 1), key=lambda c: min(16 / (c * width), 9 / (-(-n // c) * height)))
    rows = -(-n // columns)
    tile_width = min(max(width, MIN_TILE), (max_width - (columns - 1) * GAP) // columns)
    tile = (tile_width, max(1, round(tile_width * height / width)))
    text = float(np.clip(min(tile[0] / 1000, tile[1] / 560), 0.5, 1.6))
    bar = int(np.clip((columns * (tile[0] + GAP)) / 44, 22, 64))
    corners = tuple(((i % columns) * (tile[0] + GAP), bar + (i // columns) * (tile[1] + GAP)) for i in range(n))
    size = (columns * (tile[0] + GAP) - GAP, bar + rows * (tile[1] + GAP) - GAP)
    # yuv420p needs even sizes.
    return _Layout((size[0] + size[0] % 2, size[1] + size[1] % 2), corners, tile, bar, text)


def _encoder() -> tuple[str, dict[str, str]]:
    for name, options in ENCODERS:
        try:
            av.codec.Codec(name, "w")
        except UnknownCodecError:
            continue
        return name, options
    raise OSError(f"this build of PyAV has none of the video encoders {', '.join(name for name, _ in ENCODERS)}")


def _place(tile: Image, camera: Camera, image: Image | None) -> Image:
    """Puts the image into the middle of its tile, as large as it fits, and returns the part of the tile it takes."""
    width, height = camera.size
    scale = min(tile.shape[1] / width, tile.shape[0] / height)
    w, h = min(tile.shape[1], round(width * scale)), min(tile.shape[0], round(height * scale))
    x, y = (tile.shape[1] - w) // 2, (tile.shape[0] - h) // 2
    inner = tile[y : y + h, x : x + w]
    if image is None:
        inner[:] = (44, 40, 38)
        return inner
    if image.shape[:2] != (height, width):
        raise ValueError(
            f"camera {camera.name}: the image is {image.shape[1]}x{image.shape[0]}, its calibration {width}x{height}"
        )
    inner[:] = cv2.resize(in_colour(image), (w, h), interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    return inner


def _draw_object(tile: Image, camera: Camera, i: int, shown: Shown, text: float) -> None:
    """One object in camera i."""
    scale, color = tile.shape[1] / camera.size[0], shown.color
    region, pair, pose = (shown.regions or [None] * (i + 1))[i], shown.matches[i], shown.pose
    if region is not None and len(region):
        polyline(tile, (region + 0.5) * scale - 0.5, color or REGION, 1, closed=True)
    if shown.looked_at:
        features, rejected = shown.looked_at[i]
        draw_dots(tile, features, scale, text, FEATURE)
        draw_crosses(tile, rejected, scale, text, REJECTED)
    if pair is not None:
        draw_matches(tile, pair, scale, text, color or TRAIL, color or DOT)
    if pose.world_from_object is not None:
        draw_axes(tile, camera, pose.world_from_object, shown.axis_length, scale, text, faint=not pose.measured)
        if shown.name:
            at = (camera.project(pose.position)[0] + 0.5) * scale - 0.5 + [0, 16 * text]
            write(tile, shown.name, at, 0.7 * text, color or WHITE, centered=True)


def _draw_caption(tile: Image, name: str, poses: Sequence[FramePose], i: int, has_image: bool, text: float) -> None:
    """Camera name, inliers and residual on a dark ground in the corner; "no frame" in the middle of an empty tile."""
    count = sum(int(pose.inliers[i]) for pose in poses)
    tried = sum(int(pose.matches[i]) for pose in poses if len(pose.matches))
    details = f"{count} of {tried} matches" if tried else f"{count} inlier{'' if count == 1 else 's'}"
    if count and len(poses) == 1 and np.isfinite(poses[0].residuals[i]):
        details += f"  {float(poses[0].residuals[i]):.2f} px"
    color = GOOD if count else GREY
    if len(poses) == 1 and len(poses[0].doubt) and poses[0].doubt[i] > DOUBTED:
        details, color = f"{details}  doubted", WARN
    elif len(poses) == 1 and noisy(poses[0].residuals)[i]:
        details, color = f"{details}  noisy", WARN
    if all(pose.status is FrameStatus.FIRST for pose in poses):
        details = ""
    if not has_image:
        details = ""
        write(tile, "no frame", (tile.shape[1] / 2, tile.shape[0] / 2), 1.2 * text, GREY, centered=True)
    size, margin = 0.78 * text, round(10 * text) + 2
    (name_width, height), _ = cv2.getTextSize(name, cv2.FONT_HERSHEY_SIMPLEX, size, pen(size))
    details_width = cv2.getTextSize(details, cv2.FONT_HERSHEY_SIMPLEX, size, pen(size))[0][0] if details else -margin
    ground = tile[: height + 2 * margin, : name_width + details_width + 3 * margin]
    cv2.addWeighted(ground, 0.3, np.full_like(ground, DARK), 0.7, 0, dst=ground)
    write(tile, name, (margin, margin + height), size, WHITE)
    write(tile, details, (2 * margin + name_width, margin + height), size, color)


def _draw_bar(bar: Image, objects: Sequence[Shown], unit: str, note: str) -> None:
    """Frame, time, status and note on the left, angles and position on the right; of several objects their statuses."""
    height = bar.shape[0]
    size = height / 62
    y = height * 0.68
    pose = objects[0].pose
    words: list[tuple[str, Color, float]] = [(f"frame {pose.index}", WHITE, 0.5)]
    if pose.time != pose.index:
        words.append((f"{pose.time:.2f} s", WHITE, 0.5))
    for shown in objects:
        if shown.name:
            words.append((shown.name, shown.color or WHITE, 0.25))
        words.append((shown.pose.status.value, _status_color(shown.pose), 0.5))
        if shown.pose.observable is not Observable.ALL:
            words.append((shown.pose.observable.value, WARN, 0.5))
    if note:
        words.append((note, GREY, 0.5))
    x = height * 0.3
    for text, color, gap in words:
        x += write(bar, text, (x, y), size, color) + height * gap
    if any(shown.name for shown in objects):
        return
    texts = [f"{pose.reason[:1].upper()}{pose.reason[1:]}.", pose.reason] if pose.reason else [pose.status.text]
    if pose.world_from_object is not None and not pose.reason:
        pan, tilt, roll = np.degrees(pose.pan_tilt_roll)
        angles = f"pan {pan:+.1f}  tilt {tilt:+.1f}  roll {roll:+.1f} deg"
        # To a hundredth or so of the object's size.
        digits = int(np.clip(2 - np.floor(np.log10(max(objects[0].axis_length, 1e-9))), 0, 6))
        place = "  ".join(f"{name} {value:+.{digits}f}" for name, value in zip("xyz", pose.position, strict=True))
        texts = [f"{angles}    {place} {unit}".strip(), angles]
    # The longest text that there is room for.
    for text in texts:
        (width, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, pen(size))
        right = bar.shape[1] - height * 0.3 - width
        if right > x:
            write(bar, text, (right, y), size, WHITE)
            break


def _status_color(pose: FramePose) -> Color:
    if not pose.status.has_pose:
        return BAD
    return GOOD if pose.measured and pose.observable is Observable.ALL else WARN
