"""Where the tests find what is not theirs."""

from pathlib import Path

__all__ = ["DATA", "REPOSITORY"]

REPOSITORY = Path(__file__).parents[1]
# Real recordings, beside the project; tests that need them skip where they are absent.
DATA = REPOSITORY.parent / "shared" / "data"
