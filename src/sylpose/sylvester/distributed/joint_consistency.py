"""Joint consistency search: a rotation that is consistent with the matches of all cameras, during the refinement.

The common rotation ignores depth; on an oblique surface its bias can exceed what good cameras' matches allow.
Consistency is therefore scored with a depth plane per camera (`sylvester.affine_consensus`). The best rotation is found
by Gauss-Newton: each node sends its normal equations at one rotation; all nodes sum them and make the same step. The
search starts from the nearly constant common rotation, usually without additional rounds, and again from the identity
if a camera disagrees with the result. If all cameras have full weight at one of the two results, no evidence is
requested, as `solve_robust` would not reject a camera either.

A camera with static matches is ignored if two others move, as in `diagnose_cameras`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import pack_upper, unpack_symmetric
from sylpose.sylvester.affine_consensus import AffineFits, apply_step, build_normal_equations
from sylpose.sylvester.camera_faults import FULL_WEIGHT_SCORE, max_fault_score

__all__ = ["NO_SEARCH", "VOTE_SIZE", "SearchState", "compute_vote", "start_search", "step_search"]

# Number of values of a vote: normal equations, score, and 1 if the matches move, -1 if static, 0 without a score
# (derived).
VOTE_SIZE = 6 + 3 + 1 + 1
MOVING, STATIC = 1.0, -1.0
# Step, radians, below which no score changes by more than a hundredth; maximum number of steps, as in
# `affine_consensus` (choice).
STEP_TOLERANCE, STEPS = 1e-4, 12


class SearchState(NamedTuple):
    """State of the search, identical at every node.

    Attributes:
        rotation: (3, 3) at which the next votes are computed, or the result.
        steps: number of steps from this start; negative before the start.
        is_second: this is the second search, from the identity.
        worst: the largest score of any camera at `rotation`, once `is_over`.
        is_over: the search has ended.
    """

    rotation: FloatArray
    steps: int = 0
    is_second: bool = False
    worst: float = np.inf
    is_over: bool = False

    @property
    def has_started(self) -> bool:
        """Return whether the search has started."""
        return self.steps >= 0


# No search (derived).
NO_SEARCH = SearchState(np.eye(3), -1)


def start_search(rotation: FloatArray) -> SearchState:
    """Start the search from the common rotation (3, 3)."""
    return SearchState(rotation)


def compute_vote(fits: AffineFits, is_static: bool, rotation: FloatArray) -> FloatArray:
    """Compute the vote (11,) of one camera at a rotation (3, 3); zeros without a score."""
    if len(fits.camera) == 0:
        return np.zeros(VOTE_SIZE)
    (information,), (gradient,) = build_normal_equations(fits, rotation[None], np.ones((1, 1), dtype=bool))
    score_and_motion = [max_fault_score(fits, rotation), STATIC if is_static else MOVING]
    return np.concatenate([pack_upper(information), gradient, score_and_motion])


def step_search(search: SearchState, votes: Mapping[int, FloatArray]) -> SearchState:
    """Make one step, given the votes (11,) of all nodes at `search.rotation`."""
    moving = [v for v in votes.values() if v[10] == MOVING]
    voting = moving if len(moving) > 1 else list(votes.values())
    total = np.sum([v[:9] for v in voting], axis=0)
    (rotation,), (length,) = apply_step(search.rotation[None], unpack_symmetric(total[:6])[None], total[None, 6:])
    if length > STEP_TOLERANCE and search.steps < STEPS:
        return search._replace(rotation=rotation, steps=search.steps + 1)
    worst = max(float(v[9]) for v in votes.values())
    if worst > FULL_WEIGHT_SCORE and not search.is_second:
        return SearchState(np.eye(3), is_second=True)
    return search._replace(worst=worst, is_over=True)
