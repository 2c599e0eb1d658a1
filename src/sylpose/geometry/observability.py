"""What of an estimate cannot be seen: the directions whose standard deviation exceeds a limit.

Who asks with which limit, and why: docs/conventions.md, "Limits".
"""

from __future__ import annotations

import numpy as np

from sylpose.geometry.arrays import FloatArray

__all__ = ["LEAST_TURN", "UNSEEN_SHARE", "UNSEEN_TURN", "about_a_turn", "unseen_directions"]

# A turn less certain than this, in radians, is not seen where there is nothing that it could be compared with (choice).
UNSEEN_TURN = 0.25
# A motion, a turn or a distance less certain than this share of itself is not seen: even its sign is in doubt (choice).
UNSEEN_SHARE = 0.5
# A turn that is known to this, in radians, is seen, however small it is: a degree (choice).
LEAST_TURN = float(np.deg2rad(1.0))


def unseen_directions(information: FloatArray, limits: FloatArray | float, *, flat: float = 0.0) -> FloatArray:
    """The directions whose standard deviation exceeds the limits.

    Args:
        information: (..., n, n) of n unknowns; of several, all with the first one's eigenvalues (mirrored solutions).
        limits: (n,) in the unknowns' units, or one for all.
        flat: what is known less well than by this share of what is known best is not seen either: rounding.

    Returns:
        (..., k, n) orthonormal rows in units of the limits: times `limits`, they are in the unknowns' units.
    """
    in_limits = information * (limits * limits if isinstance(limits, float) else np.outer(limits, limits))
    if information.ndim == 2:
        # As a rule all is seen: then no eigenvectors are needed. (A Cholesky factor would be faster still, and is there as
        # well where rounding of what is seen best covers that something is not seen at all.)
        values = np.linalg.eigvalsh(in_limits)
        if values[0] >= max(1.0, flat * values[-1]):
            return np.empty((0, len(in_limits)))
    values, vectors = np.linalg.eigh(in_limits)
    first = values.reshape(-1, values.shape[-1])[0]
    k = int(np.searchsorted(first, max(1.0, flat * first[-1])))
    return vectors[..., :k].swapaxes(-1, -2)


def about_a_turn(directions: FloatArray) -> bool:
    """Whether directions (k, 6) of (w, d), rows as of `unseen_directions`, hold one that is a turn for the larger part."""
    return bool(np.linalg.norm(directions[:, :3], 2) ** 2 > 0.5)
