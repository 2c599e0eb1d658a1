"""Procedural, seeded, feature-rich images: faces of rendered bodies and background rooms."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from sylpose.geometry.arrays import FloatArray, FloatImage, Image

# Hues of OpenCV's HSV (0 to 179): alternately warm and cold colors, so that neighboring faces differ.
FACE_HUES = (12, 105, 24, 88, 172, 120, 5, 98, 18, 80, 160, 112)
LETTERS = "ABCDEFGHJKLMNPQRSTUVWXYZ23456789&%#?"
FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_TRIPLEX, cv2.FONT_HERSHEY_COMPLEX)
Color = tuple[float, ...]


def make_face_texture(width: int, height: int, outline: FloatArray, hue: int, rng: np.random.Generator) -> Image:
    """Draw a face texture (height, width, 3), BGR: marbled paint of one hue with non-repeating shapes and letters.

    A pale seam follows the outline (n, 2) of the face.
    """
    paint = np.array(_hsv_color(hue, 150, 205))
    marble = np.array(_hsv_color(hue + 14, 175, 135))
    share = np.clip(6 * (_smooth_noise(width, height, 48, 4, rng) - 0.5) + 0.5, 0, 1)[..., None]
    canvas = paint * (1 - share) + marble * share
    canvas *= 0.72 + 0.56 * _smooth_noise(width, height, 24, 4, rng)[..., None]
    image = np.ascontiguousarray(np.clip(canvas, 0, 255).astype(np.uint8))

    area = width * height
    for _ in range(area // 550):
        x, y, radius = rng.uniform(0, width), rng.uniform(0, height), rng.uniform(3, 13)
        color = _accent_color(hue, rng)
        if rng.random() < 0.4:
            _draw_disc(image, x, y, radius / 2, color, rng.choice([-1, 2]))
        else:
            _draw_polygon(image, x, y, radius, color, rng)
    for _ in range(max(area // 2600, 1)):
        text = "".join(rng.choice(list(LETTERS), rng.integers(1, 3)))
        place = int(rng.integers(-8, max(width - 12, 1))), int(rng.integers(12, height + 12))
        scale, thick = float(rng.uniform(0.5, 1.5)), int(rng.integers(1, 4))
        cv2.putText(image, text, place, int(rng.choice(FONTS)), scale, _accent_color(hue, rng), thick, cv2.LINE_AA)
    seam = [np.rint(outline * 16).astype(np.int32)]
    cv2.polylines(image, seam, True, _hsv_color(22, 40, 225), 3, cv2.LINE_AA, 4)
    # Speckle provides fine scales for SIFT; the blur avoids aliasing in the renderer.
    speckled = image + rng.normal(0, 9, (height, width, 1))
    return np.asarray(cv2.GaussianBlur(np.clip(speckled, 0, 255).astype(np.uint8), (0, 0), 0.7), dtype=np.uint8)


def make_room_image(width: int, height: int, rng: np.random.Generator) -> Image:
    """Draw a cluttered, slightly defocused room (height, width, 3), BGR: wall, pictures, shelves, floor."""
    floor = int(height * rng.uniform(0.76, 0.84))
    unit = height / 480  # everything below is drawn for a height of 480
    hue = int(rng.choice([15, 20, 95, 105, 110]))
    image = np.empty((height, width, 3), np.float64)
    image[:floor] = np.array(_hsv_color(hue, 30, 205))
    image[floor:] = np.array(_hsv_color(13, 95, 150))
    image[:floor] *= np.linspace(0.8, 1.1, floor)[:, None, None]
    planks = np.linspace(0.75, 1.15, height - floor)[:, None] * (
        0.9 + 0.2 * cv2.resize(_smooth_noise(16, height - floor, 6, 3, rng), (width, height - floor))
    )
    image[floor:] *= planks[..., None]
    canvas: Image = np.ascontiguousarray(np.clip(image, 0, 255).astype(np.uint8))

    cv2.rectangle(canvas, (0, floor - round(7 * unit)), (width, floor), _hsv_color(hue, 10, 240), -1)
    x = rng.uniform(-40, 20) * unit
    while x < width:
        if rng.random() < 0.6:
            span = rng.uniform(150, 230) * unit
            _draw_shelf(canvas, x, floor - round(7 * unit), span, unit, rng)
        else:
            span = rng.uniform(90, 150) * unit
            for _ in range(2):
                _draw_picture(canvas, x, rng.uniform(20, 250) * unit, span * rng.uniform(0.6, 0.95), unit, rng)
        x += span + rng.uniform(10, 35) * unit
    for _ in range(rng.integers(2, 5)):
        _draw_ball(
            canvas, rng.uniform(0, width), rng.uniform(floor + 15 * unit, height), rng.uniform(8, 18) * unit, rng
        )

    grain = 0.93 + 0.14 * _smooth_noise(width, height, 12, 3, rng)[..., None]
    u, v = np.meshgrid(np.linspace(-1, 1, width), np.linspace(-1, 1, height))
    vignette = (1 - 0.18 * (u**2 + v**2))[..., None]
    lit = np.clip(canvas * grain * vignette * 0.9, 0, 255).astype(np.uint8)
    return np.asarray(cv2.GaussianBlur(lit, (0, 0), 1.1 * unit), dtype=np.uint8)


def _draw_shelf(image: Image, x: float, bottom: int, span: float, unit: float, rng: np.random.Generator) -> None:
    """Draw a bookcase with its base at `bottom`; each board has books, boxes and gaps."""
    top = int(bottom - rng.uniform(230, 340) * unit)
    wood = _hsv_color(int(rng.integers(10, 18)), 110, int(rng.integers(110, 165)))
    cv2.rectangle(image, (int(x), top), (int(x + span), bottom), tuple(0.6 * c for c in wood), -1)
    board = bottom
    while board > top + 40 * unit:
        gap = min(rng.uniform(52, 78) * unit, board - top)
        at = x + 6 * unit
        while at < x + span - 12 * unit:
            width, tall = rng.uniform(6, 17) * unit, gap * rng.uniform(0.55, 0.85)
            kind = rng.random()
            if kind > 0.9:
                at += rng.uniform(8, 30) * unit
                continue
            if kind > 0.8:
                width, tall = rng.uniform(24, 42) * unit, gap * rng.uniform(0.3, 0.6)
            right = min(at + width, x + span - 6 * unit)
            color = _muted_color(rng)
            a, b = (int(at), int(board - tall)), (int(right) - 1, int(board))
            cv2.rectangle(image, a, b, color, -1)
            cv2.rectangle(image, a, b, tuple(0.6 * c for c in color), 1)
            for _ in range(rng.integers(0, 4)):
                y = int(board - tall * rng.uniform(0.15, 0.9))
                cv2.line(image, (a[0] + 2, y), (b[0] - 2, y), _muted_color(rng), int(rng.integers(1, 4)))
            at += width + unit
        cv2.rectangle(image, (int(x), int(board)), (int(x + span), int(board + 5 * unit)), wood, -1)
        board = int(board - gap)
    cv2.rectangle(image, (int(x), top), (int(x + span), bottom), wood, max(round(5 * unit), 1))


def _draw_picture(image: Image, x: float, y: float, span: float, unit: float, rng: np.random.Generator) -> None:
    """Draw a framed abstract picture with its top left corner at (x, y)."""
    high = span * rng.uniform(0.7, 1.3)
    rows, columns = image[int(y) : int(y + high), max(int(x), 0) : int(x + span)].shape[:2]
    if rows < 8 or columns < 8:
        return
    inner = np.full((rows, columns, 3), _muted_color(rng), np.uint8)
    for _ in range(14):
        place = rng.uniform(0, columns), rng.uniform(0, rows)
        if rng.random() < 0.5:
            _draw_disc(inner, *place, rng.uniform(4, 22) * unit, _muted_color(rng), rng.choice([-1, 2]))
        else:
            _draw_polygon(inner, *place, rng.uniform(8, 32) * unit, _muted_color(rng), rng)
    cv2.rectangle(
        inner, (0, 0), (columns - 1, rows - 1), _hsv_color(15, 80, int(rng.integers(40, 200))), round(8 * unit)
    )
    image[int(y) : int(y) + rows, max(int(x), 0) : max(int(x), 0) + columns] = inner


def _draw_ball(image: Image, x: float, y: float, radius: float, rng: np.random.Generator) -> None:
    """Draw a ball on the floor with its shadow and a highlight."""
    color = _hsv_color(int(rng.integers(0, 180)), 150, 190)
    cv2.ellipse(
        image, (int(x), int(y + 0.9 * radius)), (int(1.1 * radius), int(0.35 * radius)), 0, 0, 360, (40, 45, 50), -1
    )
    for k in range(5):
        bright = tuple(min(c * (0.62 + 0.12 * k), 255.0) for c in color)
        _draw_disc(image, x - 0.08 * k * radius, y - 0.1 * k * radius, radius * (1 - 0.19 * k), bright, -1)


def _smooth_noise(width: int, height: int, cell: int, octaves: int, rng: np.random.Generator) -> FloatImage:
    """Return smooth noise (height, width) from 0 to 1 with features of `cell` pixels, halved with each octave."""
    total = np.zeros((height, width), np.float32)
    for octave in range(octaves):
        step = max(cell >> octave, 1)
        grid = rng.random((height // step + 2, width // step + 2), dtype=np.float32)
        fine = cv2.resize(grid, (grid.shape[1] * step, grid.shape[0] * step), interpolation=cv2.INTER_CUBIC)
        total += fine[:height, :width] * 0.5 ** (octave + 1)
    return np.asarray(np.clip(total / (1 - 0.5**octaves), 0, 1), dtype=np.float32)


def _draw_polygon(image: Image, x: float, y: float, radius: float, color: Color, rng: np.random.Generator) -> None:
    angles = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 7)))
    corners = np.column_stack([x + radius * np.cos(angles), y + radius * np.sin(angles)])
    cv2.fillPoly(image, [np.rint(corners * 16).astype(np.int32)], color, cv2.LINE_AA, 4)


def _draw_disc(image: Image, x: float, y: float, radius: float, color: Color, thickness: Any) -> None:
    cv2.circle(image, (round(x * 16), round(y * 16)), round(radius * 16), color, int(thickness), cv2.LINE_AA, 4)


def _accent_color(hue: int, rng: np.random.Generator) -> Color:
    """Return a contrast color for paint of a hue: cream, near-black, a lighter or darker tone, or the opposite hue."""
    options = ((22, 30, 240), (hue, 130, 45), (hue + 6, 90, 245), (hue - 8, 200, 110), (hue + 90, 160, 190))
    return _hsv_color(*options[rng.choice(5, p=[0.3, 0.3, 0.15, 0.15, 0.1])])


def _muted_color(rng: np.random.Generator) -> Color:
    return _hsv_color(int(rng.integers(0, 180)), int(rng.integers(30, 125)), int(rng.integers(80, 225)))


def _hsv_color(hue: int, saturation: int, value: int) -> Color:
    """Convert OpenCV's HSV to BGR."""
    b, g, r = cv2.cvtColor(np.array([[[hue % 180, saturation, value]]], np.uint8), cv2.COLOR_HSV2BGR)[0, 0]
    return float(b), float(g), float(r)
