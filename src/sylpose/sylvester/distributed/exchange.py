"""One rotation at every camera, in one round: each broadcasts its 45 moments and solves with all that it has heard.

One camera's step, a pure function (state, inbox) -> (state, packets). Where every message arrives, every camera has the
same verdict to the bit: the centralised answer of the cameras that are not at fault (`sylvester.camera_faults`), and
which ones
are. A camera that is not heard leaves the sum. Moments that no image could have are refused.

Source: that 45 numbers suffice is ours (`sylpose.moments`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import checked_rotations
from sylpose.moments import PairMoments
from sylpose.sylvester.distributed.fault_decision import UNKNOWN, Verdict, plausible, verdict
from sylpose.sylvester.distributed.messages import Inbox, Message, Packet, encode, newest, read

__all__ = ["ExchangeState", "exchange_start", "exchange_step"]


@dataclass(frozen=True, eq=False)
class ExchangeState:
    """One camera of `exchange`. Every camera knows the rotations of all, the calibration, and its own moments only.

    Attributes:
        heard: the moments of each camera that was heard, this one's included.
        verdict: what it has come to, once it is `done`.
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
    verdict: Verdict = UNKNOWN
    done: bool = False


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
            heard[c] = plausible(message.values, s.aim)
        except ValueError as error:
            refused.setdefault(c, str(error))
    s = replace(s, heard=heard, refused=refused, round=s.round + 1)
    if s.round < s.rounds:
        return s, _moments_packets(s)
    found = verdict({c: (s.rotations[c], m) for c, m in heard.items()}, aim=s.aim)
    return replace(s, verdict=found, done=True), []


def _moments_packets(s: ExchangeState) -> list[Packet]:
    others = tuple(c for c in range(len(s.rotations)) if c != s.camera)
    values = np.frombuffer(s.heard[s.camera].to_bytes(), "<f8")
    return [Packet(others, encode(s.camera, Message(s.round, True, True, values)))] if others else []
