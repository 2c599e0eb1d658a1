"""Images of another size than their calibration: rotation by 90 degrees and scale are named."""

from __future__ import annotations

import pytest

from sylpose.io.capture.image_sizes import describe_size_mismatch


@pytest.mark.parametrize(
    ("size", "calibrated", "text"),
    [
        ((1080, 1920), (1920, 1080), "turned by 90 degrees; turn them back"),
        ((960, 540), (1920, 1080), "are scaled by 0.5;"),
        ((3840, 2160), (1920, 1080), "are scaled by 2;"),
        ((1280, 720), (1920, 1080), "are scaled by 0.666667;"),
        ((853, 480), (1920, 1080), "are scaled by 0.444271;"),
        ((854, 480), (1920, 1080), "are scaled by 0.444792;"),
        ((540, 960), (1920, 1080), "turned by 90 degrees and scaled by 0.5;"),
        ((1440, 1080), (1920, 1080), "neither scaled nor turned"),
        ((1920, 1088), (1920, 1080), "0 more columns and 8 more rows: an encoder"),
        ((638, 478), (639, 479), "1 fewer columns and 1 fewer rows: an encoder"),
        ((960, 960), (480, 480), "are scaled by 2;"),
    ],
)
def test_mismatch_is_described(size: tuple[int, int], calibrated: tuple[int, int], text: str) -> None:
    assert text in describe_size_mismatch(size, calibrated)
