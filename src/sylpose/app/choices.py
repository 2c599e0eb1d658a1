"""The names that options take. Apart from the code that they choose between, so that `sylpose --help` need not load it."""

from __future__ import annotations

__all__ = ["FEATURES", "METHODS"]

# In each the first is the default; sylpose.tracking says what the others do.
METHODS = ("landmarks", "epipolar", "sylvester")
FEATURES = ("auto", "sift", "klt")
