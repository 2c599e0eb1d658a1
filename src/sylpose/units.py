"""Units of length: conversion, and parsing of lengths such as `40mm`."""

from __future__ import annotations

import re

from sylpose.input_limits import to_one_line

METERS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "um": 1e-6, "in": 0.0254, "ft": 0.3048}
# With one camera lengths are relative to the object's distance in the first frame (docs/conventions.md).
INITIAL_DISTANCES = "first distances"
# Smallest and largest length accepted (choice).
MIN_LENGTH, MAX_LENGTH = 1e-9, 1e9


class MissingUnitError(ValueError):
    """Error for a length with a unit, with a calibration without one."""


def parse_length_with_unit(text: str, name: str) -> tuple[float, str]:
    """Parse a length such as `0.04` or `40mm` into its value and unit, "" without one.

    Raises:
        ValueError: naming the argument: not a positive number, or an unknown unit.
    """
    match = re.fullmatch(r"\s*+([0-9.eE+-]++)\s*+([A-Za-z]*+)\s*+", text)
    try:
        value = float(match[1]) if match else 0.0
    except ValueError:
        value = 0.0
    if match is None or not MIN_LENGTH <= value <= MAX_LENGTH:
        raise ValueError(f"{name} must be a positive length such as 0.04 or 40mm, got {to_one_line(text, 80)!a}")
    if match[2] and match[2] not in METERS:
        raise ValueError(f"{name}: {to_one_line(match[2], 80)!a} is not a unit of length ({', '.join(METERS)})")
    return value, match[2]


def parse_length(text: str, name: str, unit: str) -> float:
    """Parse a length and convert it to `unit`; a length without a unit is in `unit`.

    Args:
        text: for example `0.04` or `40mm`.
        name: of the argument, for messages.
        unit: length unit of the calibration.

    Raises:
        MissingUnitError: the length has a unit, but `unit` is not a known one.
        ValueError: as `parse_length_with_unit`.
    """
    value, own_unit = parse_length_with_unit(text, name)
    if not own_unit:
        return value
    if unit not in METERS:
        raise MissingUnitError(
            f"{name} is in {own_unit}, but the calibration has no unit: give the length in calibration units, "
            "without a unit"
        )
    return value * METERS[own_unit] / METERS[unit]
