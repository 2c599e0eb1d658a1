"""What follows from everybody's moments: the rotation of the cameras that can be relied upon, and what is wrong with the
others. A function of what was heard alone, so that all who heard the same say the same, to the bit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.moments import PairMoments
from sylpose.sylvester.affine_consensus import MIN_MATCHES
from sylpose.sylvester.camera_faults import solve_robust

__all__ = ["UNKNOWN", "Verdict", "plausible", "verdict"]

# A camera has at most so many times the matches of the one in the middle, or of one that has few: 10 to 1000 is usual
# (choice: three times what that makes; docs/benchmarks.md#distributed).
HEAVY, FEW_MATCHES = 300.0, 20.0


@dataclass(frozen=True, eq=False)
class Verdict:
    """What a camera has come to.

    Attributes:
        rotation, information: (3, 3) as in `CentralizedSolution`; None where there is none.
        converged: it is an answer of this scheme, and that of all others as far as this camera can know.
        consistent: it is known which cameras are at fault (`Diagnosis`).
        weights: camera -> its weight in the answer, more than 0.
        faults: camera -> what is wrong with it, as a sentence.
    """

    rotation: FloatArray | None = None
    information: FloatArray | None = None
    converged: bool = False
    consistent: bool = True
    weights: Mapping[int, float] = field(default_factory=dict)
    faults: Mapping[int, str] = field(default_factory=dict)

    @property
    def used(self) -> tuple[int, ...]:
        """The cameras that the answer is from."""
        return tuple(sorted(self.weights))


UNKNOWN = Verdict()


def verdict(seen: Mapping[int, tuple[FloatArray, PairMoments]], *, aim: bool) -> Verdict:
    """Of cameras by number, Q (3, 3) of camera_from_world and moments each: `solve_robust` of those whose number of
    matches a camera can have."""
    counts = {c: m.count for c, (_, m) in seen.items()}
    usual = float(np.median([n for n in counts.values() if n >= MIN_MATCHES] or [0.0]))
    heavy = {
        c: f"camera {c}: it claims {n:.0f} matches" for c, n in counts.items() if n > HEAVY * max(usual, FEW_MATCHES)
    }
    of = sorted(seen.keys() - heavy.keys())
    Q = np.array([seen[c][0] for c in of]).reshape(-1, 3, 3)
    try:
        s = solve_robust(Q, [seen[c][1] for c in of], names=[str(c) for c in of], aim=aim)
    except ValueError:  # no camera has any spread
        return Verdict(faults=heavy)
    faults = heavy | {c: fault.text for c, fault in zip(of, s.faults, strict=True) if fault is not None}
    weights = {c: float(w) for c, w in zip(of, s.weights, strict=True) if w > 0}
    if s.solution is None:
        return Verdict(consistent=False, faults=faults)
    converged = s.solution.converged
    return Verdict(s.rotation, s.information, converged, s.diagnosis.consistent, weights, dict(sorted(faults.items())))


def plausible(values: FloatArray, aim: bool) -> PairMoments:
    """The moments that 45 numbers are.

    Raises:
        ValueError: why no image has such moments.
    """
    try:
        moments = PairMoments.from_bytes(values.astype("<f8").tobytes())
    except ValueError as error:
        raise ValueError(f"moments that no image has ({error})") from None
    count = moments.matrix[8, 8]
    if not 0 <= count < 1e15:
        raise ValueError("moments that no image has: their number of matches")
    # Within 89 degrees of the axis |x| < 100; an x, y pair adds at most 1e8 to the largest entry. Orthographic points
    # have any unit.
    if aim and np.abs(moments.matrix).max() > 1e8 * count:
        raise ValueError("moments that no image has: points more than 89 degrees off the camera's axis")
    if count > 0 and np.linalg.eigvalsh(moments.matrix / count)[0] < -1e-9 * np.trace(moments.matrix) / count:
        raise ValueError("moments that no matches have: not positive semidefinite")
    return moments
