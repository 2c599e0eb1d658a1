"""Whether there is a rotation that suits the matches of all cameras: before anybody doubts, while refinement goes on.

The common rotation of refinement ignores depth and is off on a leaning surface, by so much that good cameras' matches do not
allow it. What they do allow is judged with the plane of each camera's depths (`sylvester.affine_consensus`), and the
rotation that
suits all best is found by Gauss-Newton: each tells its normal equations at one rotation, all sum them and take the same
step. It starts from the common rotation once that is nearly known, so that it costs no rounds, as a rule; where it ends at
what somebody's matches do not allow, it starts again from no turn. Nobody doubts where every camera is trusted in full at
one of the two: then `solve_robust` trusts all of them, too.

A camera that stands still is not heard where two others move, as in `diagnose`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import symmetric_of, upper_of
from sylpose.sylvester.affine_consensus import AffineFits, normal_equations, turned
from sylpose.sylvester.camera_faults import TRUSTED, doubt_of

__all__ = ["IDLE", "VOTE", "Search", "begun", "searched", "vote_of"]

# Numbers of one: normal equations, score, and whether the camera moves, stands still or is not judged, 0 (derived).
VOTE = 6 + 3 + 1 + 1
MOVES, STILL = 1.0, -1.0
# A step that turns by less, radians, changes no score by more than a hundredth; and steps at most, as in `affine_votes`
# (choice).
ENOUGH, STEPS = 1e-4, 12


class Search(NamedTuple):
    """Where the search for a rotation that suits all stands; the same at every camera.

    Attributes:
        rotation: (3, 3) at which votes are told next, or the one that was found.
        steps: so far from this start; less than 0 before there is one.
        again: from no turn.
        worst: the largest score of any camera at `rotation`, once it is `over`.
        over: nothing is sought any more.
    """

    rotation: FloatArray
    steps: int = 0
    again: bool = False
    worst: float = np.inf
    over: bool = False

    @property
    def begun(self) -> bool:
        """Whether votes are told, or were."""
        return self.steps >= 0


# No search (derived).
IDLE = Search(np.eye(3), -1)


def begun(rotation: FloatArray) -> Search:
    """From the common rotation (3, 3)."""
    return Search(rotation)


def vote_of(fits: AffineFits, still: bool, rotation: FloatArray) -> FloatArray:
    """(11,) what one camera tells at a rotation (3, 3); `still`: as `stand_still` says. Zeros if it cannot be judged."""
    if len(fits.camera) == 0:
        return np.zeros(VOTE)
    (information,), (gradient,) = normal_equations(fits, rotation[None], np.ones((1, 1), dtype=bool))
    told = [doubt_of(fits, rotation), STILL if still else MOVES]
    return np.concatenate([upper_of(information), gradient, told])


def searched(search: Search, votes: Mapping[int, FloatArray]) -> Search:
    """A step further, with everybody's votes (11,) at `search.rotation`."""
    moving = [v for v in votes.values() if v[10] == MOVES]
    heard = moving if len(moving) > 1 else list(votes.values())
    total = np.sum([v[:9] for v in heard], axis=0)
    (rotation,), (length,) = turned(search.rotation[None], symmetric_of(total[:6])[None], total[None, 6:])
    if length > ENOUGH and search.steps < STEPS:
        return search._replace(rotation=rotation, steps=search.steps + 1)
    worst = max(float(v[9]) for v in votes.values())
    if worst > TRUSTED and not search.again:
        return Search(np.eye(3), again=True)
    return search._replace(worst=worst, over=True)
