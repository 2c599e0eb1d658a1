"""What several files of these tests track."""

from __future__ import annotations

import pytest

from tests.clips import Clip, turning_clip


@pytest.fixture(scope="module")
def clip() -> Clip:
    """`turning_clip`, where a file has none of its own."""
    return turning_clip()
