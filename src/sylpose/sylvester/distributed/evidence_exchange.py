"""Byzantine evidence exchange on request: all nodes send their moments, digests of those received, and their result.

Each node sends three messages in lockstep (`lockstep`): its moments and camera rotation; digests of the evidence
received from each node; the resulting rotation (`fault_decision`). The digests reveal nodes that sent different
evidence to different receivers. Two correct nodes never contradict each other, so the node with the most contradictions
is excluded, then the next one; of two that only contradict each other both are excluded. A result counts only if more
than two thirds of the nodes have it: with fewer than a third of faulty nodes, two such majorities share a correct one.

Source: L. Lamport, R. Shostak, M. Pease, "The Byzantine generals problem" (1982), for the bound; the rest is ours.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import check_rotations
from sylpose.moments import PairMoments
from sylpose.sylvester.distributed.fault_decision import NodeEstimate, decode_moments, solve_with_faults
from sylpose.sylvester.distributed.lockstep import Link, set_message
from sylpose.sylvester.distributed.messages import Message

__all__ = [
    "AGREEMENT_TOLERANCE",
    "EVIDENCE_MESSAGE",
    "check_majority",
    "find_contradictions",
    "pack_camera_evidence",
    "send_digests",
    "send_evidence",
    "solve_uncontradicted",
    "unpack_camera_evidence",
]

# Number of the first of the three messages, above all those of the refinement (choice).
EVIDENCE_MESSAGE = 1 << 31
# Largest difference of the matrices of equal rotations (choice: well above rounding and the residual change of
# converged messages).
AGREEMENT_TOLERANCE = 1e-8
# Bytes of a digest: as an integer it is exact in a float64 (derived).
DIGEST = 6


def send_evidence(link: Link, rotation: ArrayLike, moments: PairMoments) -> Link:
    """Send this node's moments."""
    return set_message(link, Message(EVIDENCE_MESSAGE, True, False, pack_camera_evidence(rotation, moments)))


def send_digests(link: Link, aim: bool) -> tuple[Link, dict[int, FloatArray]]:
    """Collect the evidence (54,) of all nodes, including this one's, and send its digests."""
    shown, refused = {link.camera: link.sent.values}, {}
    for c, message in link.available().items():
        try:
            unpack_camera_evidence(message.values, aim)
            shown[c] = message.values
        except ValueError as error:
            refused[c] = str(error)
    digests = [_digest(shown[c]) if c in shown else 0.0 for c in sorted({link.camera, *link.others})]
    return set_message(link.reject(refused), Message(EVIDENCE_MESSAGE + 1, True, False, np.array(digests))), shown


def solve_uncontradicted(link: Link, evidence: Mapping[int, FloatArray], aim: bool) -> tuple[Link, NodeEstimate]:
    """Solve with the evidence that no digest contradicts, and send the result."""
    everyone = sorted({link.camera, *link.others})
    rows = {c: dict(zip(everyone, m.values, strict=True)) for c, m in link.available().items()}
    rows[link.camera] = dict(zip(everyone, link.sent.values, strict=True))
    named = find_contradictions(rows)
    good = [row for c, row in rows.items() if c not in named]
    kept = {c: v for c, v in evidence.items() if c not in named and all(row[c] == rows[link.camera][c] for row in good)}
    found = solve_with_faults({c: unpack_camera_evidence(v, aim) for c, v in kept.items()}, aim=aim)
    Z = np.zeros((3, 3)) if found.rotation is None else found.rotation
    # Accusations of this node itself do not make it reject its own messages.
    link = link.reject({c: why for c, why in named.items() if c != link.camera})
    return set_message(link, Message(EVIDENCE_MESSAGE + 2, True, True, Z.ravel())), replace(found, converged=False)


def check_majority(link: Link, found: NodeEstimate) -> NodeEstimate:
    """Mark the result as converged if more than two thirds of the nodes have the same one."""
    others = [m.values for m in link.available().values()]
    same = 1 + sum(bool(np.linalg.norm(v - link.sent.values) < AGREEMENT_TOLERANCE) for v in others)
    return replace(found, converged=found.rotation is not None and 3 * same > 2 * (1 + len(others)))


def find_contradictions(rows: Mapping[int, Mapping[int, float]]) -> dict[int, str]:
    """Return the nodes to exclude, with reasons.

    Args:
        rows: camera -> digests of the evidence received from each camera, 0 for none; for itself, of its own evidence.
    """
    pairs = {frozenset((a, b)) for a in rows for b in rows if rows[a][b] != rows[b][b]}
    named = {}
    while pairs:
        count = Counter(c for pair in pairs for c in pair)
        most = max(count.values())
        for c in sorted(c for c in count if count[c] == most):
            against = ", ".join(str(k) for k in sorted({k for pair in pairs if c in pair for k in pair} - {c}))
            tie = "; which one is wrong is undecidable" if most == 1 else ""
            named[c] = f"its evidence or its digests contradict those of other cameras (cameras {against}){tie}"
        pairs = {pair for pair in pairs if not pair & named.keys()}
    return named


def pack_camera_evidence(rotation: ArrayLike, moments: PairMoments) -> FloatArray:
    """Pack the evidence (54,) of a camera: moments and Q of camera_from_world."""
    return np.concatenate([np.frombuffer(moments.to_bytes(), "<f8"), np.ravel(rotation)])


def unpack_camera_evidence(values: FloatArray, aim: bool) -> tuple[FloatArray, PairMoments]:
    """Unpack the values of `pack_camera_evidence`.

    Raises:
        ValueError: not a rotation, or moments that no image can have.
    """
    return check_rotations(values[45:].reshape(1, 3, 3), 1)[0], decode_moments(values[:45], aim)


def _digest(values: FloatArray) -> float:
    return float(int.from_bytes(hashlib.blake2b(values.astype("<f8").tobytes(), digest_size=DIGEST).digest(), "little"))
