"""Flooding of the evidence on a sparse network: each node forwards what it has received until all nodes have it.

A message contains one camera's moments and rotation, the least often forwarded one, and the sender's result. On a line
of n nodes this takes about 2 n rounds, in a complete graph two. Lost messages cost rounds; a camera whose evidence
never arrives is left out after many rounds without news.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.moments import PairMoments
from sylpose.sylvester.distributed.evidence_exchange import (
    AGREEMENT_TOLERANCE,
    pack_camera_evidence,
    unpack_camera_evidence,
)
from sylpose.sylvester.distributed.fault_decision import NO_ESTIMATE, NodeEstimate, solve_with_faults
from sylpose.sylvester.distributed.lockstep import MAX_MISSED_ROUNDS
from sylpose.sylvester.distributed.messages import Message, Packet, encode

__all__ = ["FLOODING_SIZE", "FloodingState", "make_packets", "process_messages", "start_flooding"]

# Number of values of a message: the camera, its evidence, the sender's result (derived).
FLOODING_SIZE = 1 + 54 + 9


@dataclass(frozen=True, eq=False)
class FloodingState:
    """Flooding state of one node.

    Attributes:
        evidence: camera -> (54,) evidence received. times: camera -> number of times it was forwarded.
        results: neighbor -> (9,) its result, once it has all evidence.
        missed_rounds: neighbor -> rounds since its last message.
        quiet_rounds: rounds since the last new evidence.
        rounds_converged: rounds since all neighbors have this node's result.
        estimate: result from all evidence, once complete.
    """

    camera: int
    neighbors: tuple[int, ...]
    n_cameras: int
    aim: bool
    evidence: dict[int, FloatArray]
    n_forwarded: dict[int, int] = field(default_factory=dict)
    results: dict[int, FloatArray] = field(default_factory=dict)
    missed_rounds: dict[int, int] = field(default_factory=dict)
    refused: dict[int, str] = field(default_factory=dict)
    quiet_rounds: int = 0
    rounds_converged: int = 0
    estimate: NodeEstimate = NO_ESTIMATE

    @property
    def is_complete(self) -> bool:
        """Return whether all evidence has arrived, or no more is expected."""
        return len(self.evidence) == self.n_cameras or self.quiet_rounds > MAX_MISSED_ROUNDS + self.n_cameras


def start_flooding(
    camera: int, neighbors: tuple[int, ...], n_cameras: int, rotation: FloatArray, moments: PairMoments, aim: bool
) -> FloodingState:
    """Start flooding with this node's own evidence."""
    return FloodingState(camera, neighbors, n_cameras, aim, {camera: pack_camera_evidence(rotation, moments)})


def process_messages(
    p: FloodingState, messages: Mapping[tuple[int, int], Message], active: Collection[int]
) -> FloodingState:
    """Process the neighbors' messages of `FLOODING_SIZE` values, by (sender, round).

    `active` are the neighbors with any message.
    """
    shown, answers, refused = dict(p.evidence), dict(p.results), dict(p.refused)
    for (sender, _), message in sorted(messages.items(), key=lambda item: item[0]):
        of, values = int(message.values[0]), message.values[1:55]
        if message.final:
            answers[sender] = message.values[55:]
        try:
            if not 0 <= of < p.n_cameras:
                raise ValueError(f"moments of camera {of}, of {p.n_cameras}")
            unpack_camera_evidence(values, p.aim)
            shown.setdefault(of, values)
        except ValueError as error:
            refused.setdefault(sender, str(error))
    missed_rounds = {c: 0 if c in active else p.missed_rounds.get(c, 0) + 1 for c in p.neighbors}
    still = 0 if len(shown) > len(p.evidence) else p.quiet_rounds + 1
    p = replace(p, evidence=shown, results=answers, refused=refused, missed_rounds=missed_rounds, quiet_rounds=still)
    if not p.is_complete:
        return replace(p, estimate=NO_ESTIMATE, rounds_converged=0)
    if still == 0 or p.estimate is NO_ESTIMATE:
        p = replace(
            p,
            estimate=solve_with_faults(
                {c: unpack_camera_evidence(v, p.aim) for c, v in sorted(shown.items())}, aim=p.aim
            ),
        )
    agree = all(
        c in answers and np.linalg.norm(answers[c] - rotation_values(p)) < AGREEMENT_TOLERANCE
        for c in p.neighbors
        if missed_rounds[c] <= MAX_MISSED_ROUNDS
    )
    converged = agree and p.estimate.rotation is not None
    return replace(
        p,
        estimate=replace(p.estimate, converged=converged),
        rounds_converged=p.rounds_converged + 1 if converged else 0,
    )


def make_packets(p: FloodingState, number: int, clean: bool) -> tuple[FloodingState, list[Packet]]:
    """Return the next message, the same for all neighbors."""
    c = min(p.evidence, key=lambda c: (p.n_forwarded.get(c, 0), c != p.camera, c))
    message = Message(number, clean, p.is_complete, np.concatenate([[c], p.evidence[c], rotation_values(p)]))
    packets = [Packet(p.neighbors, encode(p.camera, message))] if p.neighbors else []
    return replace(p, n_forwarded={**p.n_forwarded, c: p.n_forwarded.get(c, 0) + 1}), packets


def rotation_values(p: FloodingState) -> FloatArray:
    """Return this node's rotation (9,); zeros without one."""
    return np.zeros(9) if p.estimate.rotation is None else p.estimate.rotation.ravel()
