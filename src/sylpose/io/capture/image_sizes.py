"""Description of images whose size is not that of their calibration."""

from __future__ import annotations

# Rows or columns that encoders cut off or add to reach a multiple of 2, 8 or 16.
MAX_PADDING = 15


def describe_size_mismatch(size: tuple[int, int], calibrated: tuple[int, int]) -> str:
    """Describe how images of another size relate to those that a camera was calibrated with.

    Args:
        size, calibrated: (width, height) in pixels, which differ.

    Returns:
        clause that names a rotation by 90 degrees, a common factor of both sides, to within rounding, or rows and columns
        that an encoder cut off or added.
    """
    difference = size[0] - calibrated[0], size[1] - calibrated[1]
    if max(map(abs, difference)) <= MAX_PADDING and max(calibrated) > 4 * MAX_PADDING:
        columns, rows = (f"{abs(n)} {'fewer' if n < 0 else 'more'}" for n in difference)
        return (
            f"{columns} columns and {rows} rows: an encoder cuts off or adds some at the right and below; calibrate with "
            "such videos, or enter their size in the calibration"
        )
    turned = (calibrated[1], calibrated[0])
    if size == turned:
        return "they are turned by 90 degrees; turn them back, or calibrate with turned images"
    for base, turn in ((calibrated, ""), (turned, "turned by 90 degrees and ")):
        factor = size[0] / base[0]
        # Programs round the shorter side to a whole or an even number.
        if abs(size[1] - factor * base[1]) <= max(1.0, factor):
            return (
                f"they are {turn}scaled by {factor:.6g}; use images of the original size, or calibrate with scaled ones"
            )
    return "they are neither scaled nor turned by 90 degrees: probably cropped, or of another camera"
