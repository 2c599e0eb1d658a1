"""Result of a node and its computation from the moments of all cameras, with fault detection.

It depends only on the received moments, so that all nodes with the same moments have the same result to the bit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.moments import PairMoments
from sylpose.sylvester.affine_consensus import MIN_MATCHES
from sylpose.sylvester.camera_faults import solve_robust

__all__ = ["NO_ESTIMATE", "NodeEstimate", "decode_moments", "solve_with_faults"]

# Maximum factor of a camera's number of matches over the median, or over a small number: 10 to 1000 is usual
# (choice: three times the resulting factor; docs/history/benchmarks.md#distributed).
MAX_COUNT_RATIO, FEW_MATCHES = 300.0, 20.0


@dataclass(frozen=True, eq=False)
class NodeEstimate:
    """Result of one node.

    Attributes:
        rotation, information: (3, 3) as in `CentralizedSolution`; None without a result.
        converged: the scheme has converged, and to the result of all others as far as this node can determine.
        consistent: the set of faulty cameras is certain (`Diagnosis`).
        weights: camera -> its weight in the result, more than 0.
        faults: camera -> its fault, as a sentence.
    """

    rotation: FloatArray | None = None
    information: FloatArray | None = None
    converged: bool = False
    consistent: bool = True
    weights: Mapping[int, float] = field(default_factory=dict)
    faults: Mapping[int, str] = field(default_factory=dict)

    @property
    def used(self) -> tuple[int, ...]:
        """Cameras that contribute to the result."""
        return tuple(sorted(self.weights))


NO_ESTIMATE = NodeEstimate()


def solve_with_faults(evidence: Mapping[int, tuple[FloatArray, PairMoments]], *, aim: bool) -> NodeEstimate:
    """Solve with fault detection (`solve_robust`), without cameras that claim an implausible number of matches.

    Args:
        evidence: camera -> Q (3, 3) of camera_from_world and moments.
        aim: as in `solve_centralized`.
    """
    counts = {c: m.count for c, (_, m) in evidence.items()}
    median_count = float(np.median([n for n in counts.values() if n >= MIN_MATCHES] or [0.0]))
    implausible = {
        c: f"camera {c}: it claims {n:.0f} matches"
        for c, n in counts.items()
        if n > MAX_COUNT_RATIO * max(median_count, FEW_MATCHES)
    }
    cameras = sorted(evidence.keys() - implausible.keys())
    Q = np.array([evidence[c][0] for c in cameras]).reshape(-1, 3, 3)
    try:
        s = solve_robust(Q, [evidence[c][1] for c in cameras], names=[str(c) for c in cameras], aim=aim)
    except ValueError:  # no camera has any spread
        return NodeEstimate(faults=implausible)
    faults = implausible | {c: fault.text for c, fault in zip(cameras, s.faults, strict=True) if fault is not None}
    weights = {c: float(w) for c, w in zip(cameras, s.weights, strict=True) if w > 0}
    if s.solution is None:
        return NodeEstimate(consistent=False, faults=faults)
    converged = s.solution.converged
    return NodeEstimate(
        s.rotation, s.information, converged, s.diagnosis.consistent, weights, dict(sorted(faults.items()))
    )


def decode_moments(values: FloatArray, aim: bool) -> PairMoments:
    """Decode 45 numbers as moments and check that an image can have them.

    Raises:
        ValueError: no image can have such moments.
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
