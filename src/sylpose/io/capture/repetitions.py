"""Pictures that show nothing new: black ones, and those that a camera repeats while others do not.

A camera may be frozen or covered, or its video converted to a constant rate or padded to another one's length.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from sylpose.geometry.arrays import Image

# A picture repeats the last one if it changes by less than this share of the change in the median other camera (choice:
# repetitions that were compressed change by 0.005 to 0.013, the noise of a camera that sees no motion by 0.2 and more).
MAX_CHANGE_RATIO = 0.05
# A picture is black if at most this share of its pixels is brighter than this gray level (choice: noise of a sensor in the
# dark, and a few hot pixels), and some other camera's is not.
MAX_BRIGHT_SHARE, MAX_BLACK_LEVEL = 1e-3, 24


class RepetitionFilter:
    """Removes black and repeated pictures from the frame sets of a recording.

    Repeated ones show an earlier moment than those of the other cameras. Where nothing changes in any camera, all are kept.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self._last: list[Image | None] = [None] * len(names)
        self._reported = [set[str]() for _ in names]

    def remove(self, number: int, images: Sequence[Image | None]) -> tuple[list[Image | None], list[str]]:
        """Remove the pictures that are black or repeat the last ones.

        Args:
            number: of the frame set, for messages.
            images: per camera (h, w, 3); None without a frame.

        Returns:
            The images, None for removed ones; a message for each camera's first one of a kind.
        """
        last = [*self._last]
        changes = np.array([self._measure_change(c, image) for c, image in enumerate(images)])
        kept, messages = list(images), list[str]()
        shown = [c for c, image in enumerate(images) if image is not None]
        black = [c for c in shown if _is_black(self._last[c])]
        black = [] if len(black) == len(shown) else black
        for c in black:
            kept[c], changes[c], self._last[c] = None, np.nan, last[c]
            messages += self._report(c, "black", f"frame {number} is black; such frames of it are not used.")
        for c in range(len(self._names)):
            others = np.delete(changes, c)
            others = others[~np.isnan(others)]
            if not len(others) or not changes[c] < MAX_CHANGE_RATIO * np.median(others):
                continue
            kept[c] = None
            text = "shows the same picture as before while other cameras show a new one"
            messages += self._report(c, "repeated", f"frame {number} {text}; such frames of it are not used.")
        return kept, messages

    def _report(self, c: int, kind: str, text: str) -> list[str]:
        """Return the message on a camera's picture, if it is its first one of the kind."""
        if kind in self._reported[c]:
            return []
        self._reported[c].add(kind)
        return [f"{self._names[c]}: {text}"]

    def _measure_change(self, c: int, image: Image | None) -> float:
        """Return the mean difference of an image from the camera's last one, gray levels; NaN without either."""
        if image is None:
            return np.nan
        # A quarter of the pixels shows it as well.
        last, sample = self._last[c], np.ascontiguousarray(image[::2, ::2, image.shape[2] // 2])
        self._last[c] = sample
        return np.nan if last is None else float(cv2.norm(sample, last, cv2.NORM_L1)) / last.size


def _is_black(sample: Image | None) -> bool:
    if sample is None:
        return False
    bright = cv2.threshold(sample, MAX_BLACK_LEVEL, 1, cv2.THRESH_BINARY)[1]
    return cv2.countNonZero(bright) <= MAX_BRIGHT_SHARE * sample.size
