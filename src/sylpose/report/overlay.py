"""Overlay video: all cameras tiled, with matches and the object's axes drawn in."""

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

from sylpose.atomic_io import output_errors
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.report.camera_consistency import MIN_INFLATION, find_noisy_cameras
from sylpose.report.drawing import (
    DARK,
    GRAY,
    WHITE,
    Color,
    Matches,
    draw_axes,
    draw_crosses,
    draw_matches,
    draw_polyline,
    draw_text,
    stroke_width,
    to_bgr,
)
from sylpose.results import FramePose
from sylpose.rig import Camera, Rig
from sylpose.status import FrameStatus, Observability

CandidatePixels = tuple[FloatArray, FloatArray]
NO_PIXELS = np.empty((0, 2))

# In order of preference; every build of FFmpeg has the last. None delays frames: no B-frames, no look-ahead. "ultrafast"
# takes 0.4 times as long as "veryfast" at its quality 21, for files 1.6 times as large (measured: overlay of the demo).
ENCODERS: tuple[tuple[str, dict[str, str]], ...] = (
    ("libx264", {"preset": "ultrafast", "tune": "zerolatency", "crf": "25"}),
    ("libopenh264", {"allow_skip_frames": "0"}),
    ("mpeg4", {"qscale": "3"}),
)

# Colors in BGR, OpenCV's order: trails, dots and region of a single object. Each of several objects has one color.
TRAIL_COLOR, DOT_COLOR, REGION_COLOR = (0, 190, 255), (60, 240, 255), (235, 206, 135)
OBJECT_COLORS: tuple[Color, ...] = (
    (60, 240, 255),
    (235, 206, 135),
    (203, 140, 255),
    (120, 235, 150),
    (80, 165, 255),
    (255, 150, 180),
)
FEATURE_COLOR, REJECTED_COLOR = (190, 180, 175), (110, 110, 255)
GOOD_COLOR, WARN_COLOR, BAD_COLOR = (120, 220, 120), (60, 190, 255), (90, 90, 255)

TILE_GAP = 4  # pixels between tiles
MIN_TILE_WIDTH = 480  # pixels: smaller images are enlarged to this width to keep text and lines readable


@dataclass(frozen=True, eq=False)
class OverlayObject:
    """Overlay of one object in one frame.

    Attributes:
        name: label of one of several objects; "" for none.
        pose: pose of this frame.
        matches: per camera the inliers' pixels (n, 2) in the previous frame and (n, 2) in this one, or None.
        axis_length: length of the object's axes, in the calibration's unit.
        regions: per camera the corners (n, 2) of the object's region in pixels, or None; empty for no regions.
        color: BGR of its name, matches and region, to distinguish several objects; None for the default colors.
        candidates: per camera, pixels: (n, 2) of the considered features, (m, 2) of rejected matches; empty to omit
            them.
    """

    name: str
    pose: FramePose
    matches: Sequence[Matches | None]
    axis_length: float
    regions: Sequence[FloatArray | None] = ()
    color: Color | None = None
    candidates: Sequence[CandidatePixels] = ()


class OverlayWriter:
    """Writer of a video of all cameras side by side, with matches, object axes and status drawn in.

    A context manager. The file is a fragmented mp4: if the process is killed, it plays up to about the last second.

    Args:
        path: path of the .mp4; replaced if it exists.
        rig: whose cameras are tiled, in its order.
        rate: frames per second.
        max_width: pixels, of the whole picture.
        note: short text in the title bar of all frames.

    Raises:
        ValueError: a rate or width that is not positive.
        OSError: the file cannot be written; the message names it.
    """

    def __init__(self, path: Path | str, rig: Rig, rate: float, max_width: int = 1920, note: str = "") -> None:
        if not (np.isfinite(rate) and rate > 0):
            raise ValueError(f"the overlay's rate must be a positive number of frames per second, got {rate}")
        if max_width < 64:
            raise ValueError(f"the overlay's width must be at least 64 pixels, got {max_width}")
        self.path = Path(path)
        self.rig = rig
        self._note = note
        self._layout = _compute_layout(rig, max_width)
        self._blank = np.full((*self._layout.size[::-1], 3), DARK, np.uint8)
        self._count = 0
        self._write_error: OSError | None = None
        # FFmpeg writes the header late; opening the file here reports a write error at once.
        with output_errors(self.path):
            self._file = self.path.open("wb", buffering=0)
        try:
            self._open(Fraction(rate).limit_denominator(1001))
        except BaseException:
            self._file.close()
            raise

    def _open(self, rate: Fraction) -> None:
        name, options = _choose_encoder()
        fragmented = {"movflags": "frag_keyframe+empty_moov+default_base_moof", "flush_packets": "1"}
        container = av.open(self._file, "w", format="mp4", options=fragmented)
        # Any: PyAV's stubs overload add_stream by literal codec names.
        stream: Any = container.add_stream(name, rate=rate, options=options)
        stream.width, stream.height = self._layout.size
        stream.pix_fmt = "yuv420p"
        # A fragment ends at the next key frame: one second is the most that a kill can lose.
        stream.codec_context.gop_size = max(1, round(rate))
        stream.codec_context.max_b_frames = 0
        # That of OpenCV's conversion, which is faster than FFmpeg's; stated, since players assume another for HD.
        stream.codec_context.colorspace = int(Colorspace.SMPTE170M)
        stream.codec_context.color_range = 1
        self._container, self._stream = container, stream

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Finish the video; may be called twice."""
        if self._file.closed:
            return
        try:
            if self._write_error is not None:  # reported by then
                with suppress(Exception):
                    self._container.close()
                return
            with output_errors(self.path):
                if self._count:
                    self._container.mux(self._stream.encode(None))
                self._container.close()
        finally:
            self._file.close()

    def write(self, images: Sequence[Image | None], objects: Sequence[OverlayObject]) -> None:
        """Draw and append one frame.

        Args:
            images: per camera (height, width, 3) BGR or (height, width) gray as recorded, or None if missing.
            objects: any number of objects.

        Raises:
            ValueError: not one image, match or region per camera, or an image of another size than its camera's.
            OSError: the file cannot be written; the message names it.
        """
        if self._write_error is not None:  # FFmpeg would continue with a file that has no header, and crash
            raise self._write_error
        planes = np.asarray(cv2.cvtColor(self.draw(images, objects), cv2.COLOR_BGR2YUV_I420), np.uint8)
        frame = av.VideoFrame.from_ndarray(planes, format="yuv420p")
        frame.pts = self._count
        frame.time_base = 1 / self._stream.codec_context.framerate
        self._count += 1
        try:
            with output_errors(self.path):
                self._container.mux(self._stream.encode(frame))
        except OSError as error:
            self._write_error = error
            raise

    def draw(self, images: Sequence[Image | None], objects: Sequence[OverlayObject]) -> Image:
        """Return the picture that `write` appends: (height, width, 3) BGR."""
        n = len(self.rig)
        self._check_count("images", images)
        for item in objects:
            self._check_count("matches", item.matches)
            self._check_count("regions", item.regions or [None] * n)
            self._check_count("candidates", item.candidates or [None] * n)
        layout = self._layout
        picture = self._blank.copy()
        _draw_bar(picture[: layout.bar], objects, self.rig.unit, self._note)
        for i, camera in enumerate(self.rig):
            x, y = layout.corners[i]
            tile = picture[y : y + layout.tile[1], x : x + layout.tile[0]]
            inner = _place_image(tile, camera, images[i])
            if images[i] is not None:
                for item in objects:
                    _draw_object(inner, camera, i, item, layout.text_scale)
            poses = [item.pose for item in objects]
            _draw_caption(tile, camera.name, poses, i, images[i] is not None, layout.text_scale)
        return picture

    def _check_count(self, name: str, values: Sequence[object]) -> None:
        if len(values) != len(self.rig):
            raise ValueError(f"the overlay needs {len(self.rig)} {name}, one per camera, got {len(values)}")


def object_color(k: int) -> Color:
    """Return the color of the k-th of several objects; colors repeat after six."""
    return OBJECT_COLORS[k % len(OBJECT_COLORS)]


@dataclass(frozen=True)
class _Layout:
    """Pixel layout of the picture: its size, tile corners (top left), tile size and bar height."""

    size: tuple[int, int]
    corners: tuple[tuple[int, int], ...]
    tile: tuple[int, int]
    bar: int
    text_scale: float


def _compute_layout(rig: Rig, max_width: int) -> _Layout:
    """Compute the grid with the largest tiles on a 16:9 screen."""
    width, height = max(c.size[0] for c in rig), max(c.size[1] for c in rig)
    n = len(rig)
    columns = max(range(1, n + 1), key=lambda c: min(16 / (c * width), 9 / (-(-n // c) * height)))
    rows = -(-n // columns)
    tile_width = min(max(width, MIN_TILE_WIDTH), (max_width - (columns - 1) * TILE_GAP) // columns)
    tile = (tile_width, max(1, round(tile_width * height / width)))
    text = float(np.clip(min(tile[0] / 1000, tile[1] / 560), 0.5, 1.6))
    bar = int(np.clip((columns * (tile[0] + TILE_GAP)) / 44, 22, 64))
    corners = tuple(
        ((i % columns) * (tile[0] + TILE_GAP), bar + (i // columns) * (tile[1] + TILE_GAP)) for i in range(n)
    )
    size = (columns * (tile[0] + TILE_GAP) - TILE_GAP, bar + rows * (tile[1] + TILE_GAP) - TILE_GAP)
    # yuv420p needs even sizes.
    return _Layout((size[0] + size[0] % 2, size[1] + size[1] % 2), corners, tile, bar, text)


def _choose_encoder() -> tuple[str, dict[str, str]]:
    for name, options in ENCODERS:
        try:
            av.codec.Codec(name, "w")
        except UnknownCodecError:
            continue
        return name, options
    raise OSError(f"this build of PyAV has none of the video encoders {', '.join(name for name, _ in ENCODERS)}")


def _place_image(tile: Image, camera: Camera, image: Image | None) -> Image:
    """Center the image in its tile, as large as it fits, and return that part of the tile."""
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
    cv2.resize(to_bgr(image), (w, h), dst=inner, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    return inner


def _draw_object(tile: Image, camera: Camera, i: int, item: OverlayObject, text_scale: float) -> None:
    """Draw one object in camera i."""
    scale, color = tile.shape[1] / camera.size[0], item.color
    region, pair, pose = (item.regions or [None] * (i + 1))[i], item.matches[i], item.pose
    if region is not None and len(region):
        draw_polyline(tile, (region + 0.5) * scale - 0.5, color or REGION_COLOR, 1, closed=True)
    features = NO_PIXELS
    if item.candidates:
        features, rejected = item.candidates[i]
        draw_crosses(tile, rejected, scale, text_scale, REJECTED_COLOR)
    colors = color or TRAIL_COLOR, color or DOT_COLOR, FEATURE_COLOR
    draw_matches(tile, pair or (NO_PIXELS, NO_PIXELS), features, scale, text_scale, colors)
    if pose.world_from_object is not None:
        draw_axes(tile, camera, pose.world_from_object, item.axis_length, scale, text_scale, faint=not pose.is_measured)
        if item.name:
            at = (camera.project(pose.position)[0] + 0.5) * scale - 0.5 + [0, 16 * text_scale]
            draw_text(tile, item.name, at, 0.7 * text_scale, color or WHITE, centered=True)


def _draw_caption(
    tile: Image, name: str, poses: Sequence[FramePose], i: int, has_image: bool, text_scale: float
) -> None:
    """Draw camera name, inliers and residual in the corner, or "no frame" in an empty tile."""
    count = sum(int(pose.inliers[i]) for pose in poses)
    matched = sum(int(pose.matches[i]) for pose in poses if len(pose.matches))
    details = f"{count} of {matched} matches" if matched else f"{count} inlier{'' if count == 1 else 's'}"
    if count and len(poses) == 1 and np.isfinite(poses[0].residuals[i]):
        details += f"  {float(poses[0].residuals[i]):.2f} px"
    color = GOOD_COLOR if count else GRAY
    if len(poses) == 1 and len(poses[0].variance_inflation) and poses[0].variance_inflation[i] > MIN_INFLATION:
        details, color = f"{details}  disagrees", WARN_COLOR
    elif len(poses) == 1 and find_noisy_cameras(poses[0].residuals)[i]:
        details, color = f"{details}  noisy", WARN_COLOR
    if all(pose.status is FrameStatus.FIRST for pose in poses) or not has_image:
        details = ""
    if not has_image:
        draw_text(tile, "no frame", (tile.shape[1] / 2, tile.shape[0] / 2), 1.2 * text_scale, GRAY, centered=True)
    size, margin = 0.78 * text_scale, round(10 * text_scale) + 2
    (name_width, height), _ = cv2.getTextSize(name, cv2.FONT_HERSHEY_SIMPLEX, size, stroke_width(size))
    details_width = (
        cv2.getTextSize(details, cv2.FONT_HERSHEY_SIMPLEX, size, stroke_width(size))[0][0] if details else -margin
    )
    ground = tile[: height + 2 * margin, : name_width + details_width + 3 * margin]
    cv2.addWeighted(ground, 0.3, np.full_like(ground, DARK), 0.7, 0, dst=ground)
    draw_text(tile, name, (margin, margin + height), size, WHITE)
    draw_text(tile, details, (2 * margin + name_width, margin + height), size, color)


def _draw_bar(bar: Image, objects: Sequence[OverlayObject], unit: str, note: str) -> None:
    """Draw the title bar: frame, time, status and note; for a single object also angles and position."""
    height = bar.shape[0]
    size = height / 62
    y = height * 0.68
    pose = objects[0].pose
    words: list[tuple[str, Color, float]] = [(f"frame {pose.index}", WHITE, 0.5)]
    if pose.time != pose.index:
        words.append((f"{pose.time:.2f} s", WHITE, 0.5))
    for item in objects:
        if item.name:
            words.append((item.name, item.color or WHITE, 0.25))
        words.append((item.pose.status.value, _status_color(item.pose), 0.5))
        if item.pose.observability is not Observability.ALL:
            words.append((item.pose.observability.value, WARN_COLOR, 0.5))
    if note:
        words.append((note, GRAY, 0.5))
    x = height * 0.3
    for text, color, gap in words:
        x += draw_text(bar, text, (x, y), size, color) + height * gap
    if any(item.name for item in objects):
        return
    texts = [f"{pose.reason[:1].upper()}{pose.reason[1:]}.", pose.reason] if pose.reason else [pose.status.text]
    if pose.world_from_object is not None and not pose.reason:
        pan, tilt, roll = np.degrees(pose.pan_tilt_roll)
        angles = f"pan {pan:+.1f}  tilt {tilt:+.1f}  roll {roll:+.1f} deg"
        # Resolution of about a hundredth of the object's size.
        digits = int(np.clip(2 - np.floor(np.log10(max(objects[0].axis_length, 1e-9))), 0, 6))
        place = "  ".join(f"{name} {value:+.{digits}f}" for name, value in zip("xyz", pose.position, strict=True))
        texts = [f"{angles}    {place} {unit}".strip(), angles]
    # Draw the longest text that fits.
    for text in texts:
        (width, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, stroke_width(size))
        right = bar.shape[1] - height * 0.3 - width
        if right > x:
            draw_text(bar, text, (right, y), size, WHITE)
            break


def _status_color(pose: FramePose) -> Color:
    if not pose.status.has_pose:
        return BAD_COLOR
    return GOOD_COLOR if pose.is_measured and pose.observability is Observability.ALL else WARN_COLOR
