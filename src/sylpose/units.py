"""Units of length that can be told in each other."""

__all__ = ["METRES"]

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "um": 1e-6, "in": 0.0254, "ft": 0.3048}
