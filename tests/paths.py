"""Paths of the data that the tests use."""

from pathlib import Path

__all__ = ["DATA", "REPOSITORY"]

REPOSITORY = Path(__file__).parents[1]
# Real recordings, next to the project; tests that need them skip if they are missing.
DATA = REPOSITORY.parent / "shared" / "data"
