"""Units of length that can be told in each other."""

__all__ = ["FIRST_DISTANCES", "METRES"]

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "um": 1e-6, "in": 0.0254, "ft": 0.3048}
# With one camera lengths are relative to the object's distance in the first frame (docs/conventions.md).
FIRST_DISTANCES = "first distances"
