"""The poses drawn into the videos: all cameras tiled, with matches and the object's axes, as a video."""

from __future__ import annotations

from collections.abc import Sequence
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
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from sylpose.report.files import writing
from sylpose.results import FramePose, Status
from sylpose.rig import Camera, Rig

__all__ = ["OverlayWriter"]

FloatArray = NDArray[np.float64]
Image = NDArray[np.uint8]
Color = tuple[int, int, int]
Matches = tuple[FloatArray, FloatArray]

# In the order of preference; the last is in every build of FFmpeg. None delays frames: no B-frames, no look-ahead.
ENCODERS: tuple[tuple[str, dict[str, str]], ...] = (
    ("libx264", {"preset": "veryfast", "tune": "zerolatency", "crf": "21"}),
    ("libopenh264", {"allow_skip_frames": "0"}),
    ("mpeg4", {"qscale": "3"}),
)

# BGR, as OpenCV draws.
WHITE, GREY, DARK = (245, 245, 245), (150, 150, 150), (28, 26, 24)
AXIS_COLORS: tuple[Color, ...] = ((70, 70, 255), (80, 220, 60), (255, 140, 50))
TRAIL, DOT, REGION = (0, 190, 255), (60, 240, 255), (235, 206, 135)
GOOD, WARN, BAD = (120, 220, 120), (60, 190, 255), (90, 90, 255)

GAP = 4  # pixels between tiles
MIN_TILE = 480  # pixels: smaller images are enlarged to this width, so that text and lines stay readable
SHIFT = 4  # OpenCV's fractional bits: lines are drawn to a sixteenth of a pixel


class OverlayWriter:
    """Writes a video of all cameras side by side with the matches, the object's axes and the status drawn in.

    A context manager. The file is a fragmented mp4: when the process is killed, it plays up to the last second or so.

    Args:
        path: of the .mp4; replaced when it is there.
        rig: whose cameras are tiled, in its order.
        rate: frames per second.
        max_width: pixels, of the whole picture.

    Raises:
        ValueError: a rate or width that is not positive.
        OSError: naming the file, when it cannot be written.
    """

    def __init__(self, path: Path | str, rig: Rig, rate: float, max_width: int = 1920) -> None:
        if not (np.isfinite(rate) and rate > 0):
            raise ValueError(f"the overlay's rate must be a positive number of frames per second, got {rate}")
        if max_width < 64:
            raise ValueError(f"the overlay's width must be at least 64 pixels, got {max_width}")
        self.path = Path(path)
        self.rig = rig
        self._layout = _layout(rig, max_width)
        self._count = 0
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
        with writing(self.path):
            try:
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
        picture = self.draw(images, pose, matches, axis_length, regions)
        frame = av.VideoFrame.from_ndarray(picture, format="bgr24")
        frame = frame.reformat(format="yuv420p", dst_colorspace=Colorspace.ITU709)
        frame.pts = self._count
        frame.time_base = 1 / self._stream.codec_context.framerate
        self._count += 1
        with writing(self.path):
            self._container.mux(self._stream.encode(frame))

    def draw(
        self,
        images: Sequence[Image | None],
        pose: FramePose,
        matches: Sequence[Matches | None],
        axis_length: float,
        regions: Sequence[FloatArray | None] = (),
    ) -> Image:
        """The picture that `write` appends: (height, width, 3) BGR."""
        n = len(self.rig)
        regions = regions or [None] * n
        for name, given in (("images", images), ("matches", matches), ("regions", regions)):
            if len(given) != n:
                raise ValueError(f"the overlay needs {n} {name}, one per camera, got {len(given)}")
        layout = self._layout
        picture = np.full((layout.size[1], layout.size[0], 3), DARK, np.uint8)
        _draw_bar(picture[: layout.bar], pose, axis_length, self.rig.unit)
        for i, camera in enumerate(self.rig):
            x, y = layout.corners[i]
            tile = picture[y : y + layout.tile[1], x : x + layout.tile[0]]
            image, pair, region = images[i], matches[i], regions[i]
            inner = _place(tile, camera, image)
            if image is not None:
                scale = inner.shape[1] / camera.size[0]
                pen = max(2, round(layout.text * 2.2))
                if region is not None and len(region):
                    _polyline(inner, (region + 0.5) * scale - 0.5, REGION, 1, closed=True)
                if pair is not None:
                    _draw_matches(inner, pair, scale, layout.text)
                if pose.world_from_object is not None:
                    _draw_axes(inner, camera, pose.world_from_object, axis_length, scale, pen, layout.text)
            _draw_caption(tile, camera.name, pose, i, image is not None, layout.text)
        return picture


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
    colored = image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    inner[:] = cv2.resize(colored, (w, h), interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    return inner


def _draw_matches(tile: Image, pair: Matches, scale: float, text: float) -> None:
    """Trails from the frame before, blended so that what is under many of them is still seen."""
    before, now = ((np.asarray(p, dtype=float).reshape(-1, 2) + 0.5) * scale - 0.5 for p in pair)
    if not len(now):
        return
    layer = tile.copy()
    trails = [np.round(np.stack([b, a]) * 2**SHIFT).astype(np.int32) for b, a in zip(before, now, strict=True)]
    cv2.polylines(layer, trails, False, TRAIL, 1, cv2.LINE_AA, SHIFT)
    radius = round(max(1.8, 2.6 * text) * 2**SHIFT)
    for point in np.round(now * 2**SHIFT).astype(int):
        cv2.circle(layer, (int(point[0]), int(point[1])), radius, DOT, -1, cv2.LINE_AA, SHIFT)
    cv2.addWeighted(layer, 0.75, tile, 0.25, 0, dst=tile)


def _draw_axes(
    tile: Image, camera: Camera, world_from_object: RigidTransform, length: float, scale: float, pen: int, text: float
) -> None:
    """The object's axes, the farthest first; through the lens, so they may be curved."""
    origin = world_from_object.translation
    directions = world_from_object.rotation.as_matrix().T
    depths = np.linalg.norm(origin + length * directions - camera.center, axis=1)
    steps = np.linspace(0, 1, 13)[:, None]
    for k in np.argsort(-depths):
        pixels = _project(camera, origin + steps * length * directions[k])
        # A line that leaves the lens's field of view ends there.
        hidden = np.flatnonzero(np.isnan(pixels[:, 0]))
        line = (pixels[: hidden[0] if hidden.size else None] + 0.5) * scale - 0.5
        if len(line) < 2:
            continue
        _polyline(tile, line, DARK, pen + 2)
        _polyline(tile, line, AXIS_COLORS[k], pen)
        outward = line[-1] - line[0]
        reach = np.linalg.norm(outward)
        tip = line[-1] + outward / max(float(reach), 1e-9) * 14 * text
        if len(line) == len(steps):
            _text(tile, "xyz"[k], tip, 0.8 * text, AXIS_COLORS[k], centered=True)


def _project(camera: Camera, points: FloatArray) -> FloatArray:
    """World points (n, 3) -> pixels (n, 2); NaN behind the camera, and where the lens model does not hold.

    Far outside of the image a polynomial lens model folds back into it; such a pixel's ray is not the point's.
    """
    pixels = camera.project(points)
    seen = np.asarray(np.isfinite(pixels).all(axis=1))
    toward = points[seen] - camera.center
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    seen[seen] = (camera.rays(pixels[seen]) * toward).sum(axis=1) > np.cos(1e-2)
    pixels[~seen] = np.nan
    return pixels


def _draw_caption(tile: Image, name: str, pose: FramePose, i: int, has_image: bool, text: float) -> None:
    """Camera name, inliers and residual on a dark ground in the corner; "no frame" in the middle of an empty tile."""
    count, residual = int(pose.inliers[i]), float(pose.residuals[i])
    details = f"{count} inlier{'' if count == 1 else 's'}"
    if count and np.isfinite(residual):
        details += f"  {residual:.2f} px"
    if pose.status is Status.FIRST:
        details = ""
    if not has_image:
        details = ""
        _text(tile, "no frame", (tile.shape[1] / 2, tile.shape[0] / 2), 1.2 * text, GREY, centered=True)
    size, margin = 0.78 * text, round(10 * text) + 2
    (name_width, height), _ = cv2.getTextSize(name, cv2.FONT_HERSHEY_SIMPLEX, size, _pen(size))
    details_width = cv2.getTextSize(details, cv2.FONT_HERSHEY_SIMPLEX, size, _pen(size))[0][0] if details else -margin
    ground = tile[: height + 2 * margin, : name_width + details_width + 3 * margin]
    cv2.addWeighted(ground, 0.3, np.full_like(ground, DARK), 0.7, 0, dst=ground)
    _text(tile, name, (margin, margin + height), size, WHITE)
    _text(tile, details, (2 * margin + name_width, margin + height), size, GOOD if count else GREY)


def _draw_bar(bar: Image, pose: FramePose, axis_length: float, unit: str) -> None:
    """Frame, time and status on the left, angles and position on the right."""
    height = bar.shape[0]
    size = height / 62
    y = height * 0.68
    color = GOOD if pose.status in (Status.OK, Status.FIRST) else WARN if pose.status.has_pose else BAD
    x = height * 0.3
    for words, ink in (
        (f"frame {pose.index}", WHITE),
        (f"{pose.time:.2f} s" if pose.time != pose.index else "", WHITE),
        (pose.status.value, color),
    ):
        if words:
            x += _text(bar, words, (x, y), size, ink) + height * 0.5
    texts = [pose.status.text]
    if pose.world_from_object is not None:
        pan, tilt, roll = np.degrees(pose.pan_tilt_roll)
        angles = f"pan {pan:+.1f}  tilt {tilt:+.1f}  roll {roll:+.1f} deg"
        # To a hundredth or so of the object's size.
        digits = int(np.clip(2 - np.floor(np.log10(max(axis_length, 1e-9))), 0, 6))
        place = "  ".join(f"{name} {value:+.{digits}f}" for name, value in zip("xyz", pose.position, strict=True))
        texts = [f"{angles}    {place} {unit}".strip(), angles]
    # The longest text that there is room for.
    for words in texts:
        (width, _), _ = cv2.getTextSize(words, cv2.FONT_HERSHEY_SIMPLEX, size, _pen(size))
        right = bar.shape[1] - height * 0.3 - width
        if right > x:
            _text(bar, words, (right, y), size, WHITE)
            break


def _pen(size: float) -> int:
    return max(1, round(1.3 * size))


def _text(
    picture: Image, words: str, at: Sequence[float] | FloatArray, size: float, color: Color, centered: bool = False
) -> int:
    """Draws from the base line's left end, or centred; returns the width in pixels."""
    (width, height), _ = cv2.getTextSize(words, cv2.FONT_HERSHEY_SIMPLEX, size, _pen(size))
    if not np.isfinite(at).all() or max(abs(at[0]), abs(at[1])) > 1e5:
        return int(width)
    x, y = (at[0] - width / 2, at[1] + height / 2) if centered else (at[0], at[1])
    place = (round(x), round(y))
    if centered:
        # An outline. Not a thicker pen: in OpenCV 5 that makes the letters wider.
        for dx, dy in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
            beside = (place[0] + dx, place[1] + dy)
            cv2.putText(picture, words, beside, cv2.FONT_HERSHEY_SIMPLEX, size, DARK, _pen(size), cv2.LINE_AA)
    cv2.putText(picture, words, place, cv2.FONT_HERSHEY_SIMPLEX, size, color, _pen(size), cv2.LINE_AA)
    return int(width)


def _polyline(picture: Image, line: FloatArray, color: Color, width: int, closed: bool = False) -> None:
    # Beyond this OpenCV's fixed-point numbers overflow; a point so far outside says nothing to the eye.
    inside = line[np.isfinite(line).all(axis=1) & (np.abs(line) < 1e5).all(axis=1)]
    if len(inside) > 1:
        points = np.round(inside * 2**SHIFT).astype(np.int32)
        cv2.polylines(picture, [points], closed, color, width, cv2.LINE_AA, SHIFT)
