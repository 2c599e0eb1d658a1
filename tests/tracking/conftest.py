"""Fixtures shared by the tracking tests."""

from __future__ import annotations

import pytest

from tests.clips import Clip, turning_clip


@pytest.fixture(scope="module")
def clip() -> Clip:
    """Return `turning_clip`, for files without a clip fixture."""
    return turning_clip()
