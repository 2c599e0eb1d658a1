"""Units of length that can be told in each other, and lengths as they are typed."""

from __future__ import annotations

import re

from sylpose.input_limits import one_line

__all__ = ["FIRST_DISTANCES", "METRES", "NoUnit", "length_of", "measured"]

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "um": 1e-6, "in": 0.0254, "ft": 0.3048}
# With one camera lengths are relative to the object's distance in the first frame (docs/conventions.md).
FIRST_DISTANCES = "first distances"
# No length that is typed is smaller or larger (choice).
LEAST, LARGEST = 1e-9, 1e9


class NoUnit(ValueError):
    """A length with a unit, of a calibration without one."""


def measured(text: str, name: str) -> tuple[float, str]:
    """A length as it is typed, `0.04` or `40mm`, and its unit, "" without one.

    Raises:
        ValueError: naming it: no positive number, or a unit that is not known.
    """
    found = re.fullmatch(r"\s*([0-9.eE+-]+)\s*([A-Za-z]*)\s*", text)
    try:
        value = float(found[1]) if found else 0.0
    except ValueError:
        value = 0.0
    if found is None or not LEAST <= value <= LARGEST:
        raise ValueError(f"{name} must be a positive length such as 0.04 or 40mm, got {one_line(text, 80)!a}")
    if found[2] and found[2] not in METRES:
        raise ValueError(f"{name}: {one_line(found[2], 80)!a} is no unit of length ({', '.join(METRES)})")
    return value, found[2]


def length_of(text: str, name: str, unit: str) -> float:
    """A length as it is typed, in `unit`, which it is in if it does not say its own.

    Raises:
        NoUnit: `unit` is none of these, so that it cannot be told in that.
        ValueError: as `measured`.
    """
    value, its = measured(text, name)
    if not its:
        return value
    if unit not in METRES:
        raise NoUnit(
            f"{name} is in {its}, but the calibration does not say its own unit: give it in that, without a name"
        )
    return value * METRES[its] / METRES[unit]
