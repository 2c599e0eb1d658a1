"""Distributed estimator "exchange": each node broadcasts its 45 moments and solves with all it has received.

The step is a pure function (state, inbox) -> (state, packets). If every message arrives, all nodes have the same result
to the bit: the centralized estimate of the cameras that are not at fault (`sylvester.camera_faults`), and the faults. A
node whose message is missing is left out of the sum. Moments that no image can have are rejected.

Source: that 45 numbers suffice is ours (`sylpose.moments`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import check_rotations
from sylpose.moments import PairMoments
from sylpose.sylvester.distributed.fault_decision import NO_ESTIMATE, NodeEstimate, decode_moments, solve_with_faults
from sylpose.sylvester.distributed.messages import Inbox, Message, Packet, decode_inbox, encode, select_newest

__all__ = ["ExchangeState", "start_exchange", "step_exchange"]


@dataclass(frozen=True, eq=False)
class ExchangeState:
    """State of one node of `exchange`. Each node has the rotations of all cameras and its own moments only.

    Attributes:
        camera: number of this node.
        rotations: (C, 3, 3) Q of camera_from_world.
        aim: as in `solve_centralized`.
        rounds: number of times the moments are sent.
        received: camera -> moments received, including this node's.
        refused: camera -> reason why its first malformed message was rejected.
        round: number of steps so far.
        estimate: the result, once `done`.
        done: nothing more will be sent.
    """

    camera: int
    rotations: FloatArray
    aim: bool
    rounds: int
    received: dict[int, PairMoments]
    refused: dict[int, str] = field(default_factory=dict)
    round: int = 0
    estimate: NodeEstimate = NO_ESTIMATE
    done: bool = False


def start_exchange(
    camera: int, rotations: ArrayLike, moments: PairMoments, *, aim: bool = True, rounds: int = 1
) -> tuple[ExchangeState, list[Packet]]:
    """Create a node and its first message.

    Args:
        camera: index of this node in `rotations`.
        rotations: (C, 3, 3) Q of camera_from_world of all cameras.
        moments: pair moments of this node.
        aim: as in `solve_centralized`. If True, moments of points more than 89 degrees off the axis are rejected.
        rounds: number of times the moments are sent: more than 1 if messages may be lost or delayed.
    """
    Q = np.array(rotations, dtype=float)
    s = ExchangeState(camera, check_rotations(Q, len(Q)), aim, rounds, {camera: moments})
    return s, _moments_packets(s)


def step_exchange(state: ExchangeState, inbox: Inbox) -> tuple[ExchangeState, list[Packet]]:
    """Process the messages received; send the moments again, or solve after the last round."""
    s = state
    messages, refused = decode_inbox([(c, data) for c, data in inbox if c != s.camera], (45,), s.refused)
    received = dict(s.received)
    for c, message in select_newest(messages, {}).items():
        try:
            if not 0 <= c < len(s.rotations):
                raise ValueError("no camera of the rig")
            received[c] = decode_moments(message.values, s.aim)
        except ValueError as error:
            refused.setdefault(c, str(error))
    s = replace(s, received=received, refused=refused, round=s.round + 1)
    if s.round < s.rounds:
        return s, _moments_packets(s)
    estimate = solve_with_faults({c: (s.rotations[c], m) for c, m in received.items()}, aim=s.aim)
    return replace(s, estimate=estimate, done=True), []


def _moments_packets(s: ExchangeState) -> list[Packet]:
    others = tuple(c for c in range(len(s.rotations)) if c != s.camera)
    values = np.frombuffer(s.received[s.camera].to_bytes(), "<f8")
    return [Packet(others, encode(s.camera, Message(s.round, True, True, values)))] if others else []
