"""Selection among several alignments of the same matches, and the uncertainty due to equally good ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.rigid import rotvec
from sylpose.landmarks.alignment import AlignmentResult

__all__ = ["select_hypothesis", "subtract_uncertainty"]

# Poses whose mean robust costs differ by less explain the matches equally well (choice).
MAX_COST_DIFFERENCE = 0.01
# Squared distance, in standard deviations, below which poses are the same: the first is used (choice).
SAME_POSE_DISTANCE = 1.0


def select_hypothesis(
    hypotheses: Sequence[AlignmentResult], rotation: FloatArray, translation: FloatArray
) -> tuple[int, FloatArray]:
    """Select the alignment that explains the matches best.

    Of equally good distinct ones, the one nearest to a prediction is selected.

    Args:
        hypotheses: of the same matches, from different starts.
        rotation, translation: (3, 3) and (3,), the predicted pose.

    Returns:
        its index; (6,) (w, d) from it to the farthest equally good one: an uncertainty in addition to its covariance.
    """
    lowest = min(range(len(hypotheses)), key=lambda k: hypotheses[k].reference_cost)
    equivalent = [
        k
        for k, one in enumerate(hypotheses)
        if one.reference_cost < hypotheses[lowest].reference_cost + MAX_COST_DIFFERENCE and one.converged
    ]
    # Distances use one common information matrix, so that an uncertain pose does not appear nearer.
    scale = hypotheses[lowest].information
    best = equivalent[0] if equivalent else lowest
    for k in equivalent:
        distance = _squared_distance(
            _pose_difference(hypotheses[best], hypotheses[k].rotation, hypotheses[k].translation), scale
        )
        is_nearer = _squared_distance(
            _pose_difference(hypotheses[k], rotation, translation), scale
        ) < _squared_distance(_pose_difference(hypotheses[best], rotation, translation), scale)
        best = k if is_nearer and distance > SAME_POSE_DISTANCE else best
    differences = [
        _pose_difference(hypotheses[best], hypotheses[k].rotation, hypotheses[k].translation) for k in equivalent
    ]
    difference = max(differences, key=lambda difference: _squared_distance(difference, scale), default=np.zeros(6))
    return best, difference if _squared_distance(difference, scale) > SAME_POSE_DISTANCE else np.zeros(6)


def subtract_uncertainty(information: FloatArray, difference: FloatArray) -> FloatArray:
    """Return (6, 6) information of (w, d) reduced by a possible difference (6,).

    It is the inverse of the covariance plus difference difference'.
    """
    projection = information @ difference
    return np.asarray(information - np.outer(projection, projection) / (1.0 + difference @ projection))


def _pose_difference(hypothesis: AlignmentResult, rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """Return the (6,) difference (w, d) from an alignment to a pose."""
    return np.concatenate([rotvec(rotation @ hypothesis.rotation.T), translation - hypothesis.translation])


def _squared_distance(difference: FloatArray, information: FloatArray) -> float:
    return float(difference @ information @ difference)
