"""One rotation at every camera, in one round: each broadcasts its 45 moments and solves with all that it has heard.

One camera's step, a pure function (state, inbox) -> (state, packets). Where every message arrives, every camera has the
centralised answer to the bit; a camera that is not heard leaves the sum. Moments that no image could have are refused;
of others nobody can tell here whether they are true.

Source: that 45 numbers suffice is ours (`sylpose.moments`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from sylpose.moments import PairMoments
from sylpose.numerics.arrays import FloatArray
from sylpose.numerics.matrices import checked_rotations
from sylpose.paper.centralized import solve_centralized
from sylpose.paper.distributed.messages import Inbox, Message, Packet, encode, newest, read

__all__ = ["ExchangeState", "exchange_start", "exchange_step"]


@dataclass(frozen=True, eq=False)
class ExchangeState:
    """One camera of `exchange`. Every camera knows the rotations of all, the calibration, and its own moments only.

    Attributes:
        heard: the moments of each camera that was heard, this one's included.
        rotation, information: (3, 3) as in `CentralizedSolution`, of the cameras in `used`; None until `done`, and where
            nothing that was heard tells a rotation.
        converged: as in `CentralizedSolution`.
        refused: camera -> why its first nonsense message was not read.
        round: steps made.
    """

    camera: int
    rotations: FloatArray
    aim: bool
    rounds: int
    heard: dict[int, PairMoments]
    refused: dict[int, str] = field(default_factory=dict)
    round: int = 0
    rotation: FloatArray | None = None
    information: FloatArray | None = None
    converged: bool = False
    done: bool = False

    @property
    def used(self) -> tuple[int, ...]:
        """The cameras that the answer is from."""
        return tuple(sorted(self.heard))


def exchange_start(
    camera: int, rotations: ArrayLike, moments: PairMoments, *, aim: bool = True, rounds: int = 1
) -> tuple[ExchangeState, list[Packet]]:
    """A camera and its first message.

    Args:
        camera: which of `rotations` it is.
        rotations: (C, 3, 3) Q of camera_from_world of all.
        moments: its own.
        aim: as in `solve_centralized`. If so, moments of points more than 89 degrees off the axis are refused.
        rounds: how often it sends its moments: 1, or more where messages get lost or are late.
    """
    Q = np.array(rotations, dtype=float)
    s = ExchangeState(camera, checked_rotations(Q, len(Q)), aim, rounds, {camera: moments})
    return s, _moments_packets(s)


def exchange_step(state: ExchangeState, inbox: Inbox) -> tuple[ExchangeState, list[Packet]]:
    """Hear the others; send one's moments again, or solve when all rounds are over."""
    s = state
    messages, refused = read([(c, data) for c, data in inbox if c != s.camera], (45,), s.refused)
    heard = dict(s.heard)
    for c, message in newest(messages, {}).items():
        try:
            if not 0 <= c < len(s.rotations):
                raise ValueError("no camera of the rig")
            heard[c] = _plausible_moments(message.values, s.aim)
        except ValueError as error:
            refused.setdefault(c, str(error))
    s = replace(s, heard=heard, refused=refused, round=s.round + 1)
    if s.round < s.rounds:
        return s, _moments_packets(s)
    try:
        solution = solve_centralized(s.rotations[list(s.used)], [heard[c] for c in s.used], aim=s.aim)
    except ValueError:  # nothing that was heard has any spread
        return replace(s, done=True), []
    return replace(
        s,
        rotation=solution.rotation,
        information=solution.information,
        converged=solution.converged,
        done=True,
    ), []


def _moments_packets(s: ExchangeState) -> list[Packet]:
    others = tuple(c for c in range(len(s.rotations)) if c != s.camera)
    values = np.frombuffer(s.heard[s.camera].to_bytes(), "<f8")
    return [Packet(others, encode(s.camera, Message(s.round, True, True, values)))] if others else []


def _plausible_moments(values: FloatArray, aim: bool) -> PairMoments:
    moments = PairMoments.from_bytes(values.astype("<f8").tobytes())
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
