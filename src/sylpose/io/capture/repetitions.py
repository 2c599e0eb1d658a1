"""Pictures that a camera repeats while others show something new: frozen, covered, or converted to a constant rate."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from sylpose.geometry.arrays import Image

# A picture repeats the last one if it changes by less than this share of the change in the median other camera (choice:
# repetitions that were compressed change by 0.005 to 0.013, the noise of a camera that sees no motion by 0.2 and more).
MAX_CHANGE_RATIO = 0.05


class RepetitionFilter:
    """Removes repeated pictures from the frame sets of a recording.

    They show an earlier moment than those of the other cameras. Where nothing changes in any camera, all are kept.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self._last: list[Image | None] = [None] * len(names)
        self._is_reported = [False] * len(names)

    def remove(self, number: int, images: Sequence[Image | None]) -> tuple[list[Image | None], list[str]]:
        """Remove the pictures that repeat the last ones.

        Args:
            number: of the frame set, for messages.
            images: per camera (h, w, 3); None without a frame.

        Returns:
            The images, None for repetitions; a message for each camera's first one.
        """
        changes = np.array([self._measure_change(c, image) for c, image in enumerate(images)])
        kept, messages = list(images), list[str]()
        for c, name in enumerate(self._names):
            others = np.delete(changes, c)
            others = others[~np.isnan(others)]
            if not len(others) or not changes[c] < MAX_CHANGE_RATIO * np.median(others):
                continue
            kept[c] = None
            if not self._is_reported[c]:
                self._is_reported[c] = True
                text = "shows the same picture as before while other cameras show a new one"
                messages.append(f"{name}: frame {number} {text}; such frames of it are not used.")
        return kept, messages

    def _measure_change(self, c: int, image: Image | None) -> float:
        """Return the mean difference of an image from the camera's last one, gray levels; NaN without either."""
        if image is None:
            return np.nan
        # A quarter of the pixels shows it as well.
        last, sample = self._last[c], np.ascontiguousarray(image[::2, ::2, image.shape[2] // 2])
        self._last[c] = sample
        return np.nan if last is None else float(cv2.norm(sample, last, cv2.NORM_L1)) / last.size
