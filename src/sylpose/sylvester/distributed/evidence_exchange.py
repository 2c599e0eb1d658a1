"""Who doubts calls for the evidence: every camera shows its moments, says what it was shown by each, then what follows.

Three messages of each, in step (`keeping_step`): the moments and the camera's rotation; a digest of what was shown by
each camera; the rotation that follows (`verdict`). From the digests all see who showed one thing to one and another to
another. Two cameras that both keep to the truth never contradict each other, so whoever contradicts most is left out, then
who contradicts most of the others; of two that only contradict each other both, since nobody can tell which one is wrong.
A camera whose answer is not that of more than two thirds does not call it one: with fewer than a third of liars, two such
majorities share a camera that tells the truth.

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
from sylpose.geometry.matrices import checked_rotations
from sylpose.moments import PairMoments
from sylpose.sylvester.distributed.fault_decision import Verdict, plausible, verdict
from sylpose.sylvester.distributed.lockstep import Link, said
from sylpose.sylvester.distributed.messages import Message

__all__ = [
    "AGREED",
    "SHOW",
    "agreeing",
    "answered",
    "concluded",
    "contradictions",
    "opened",
    "shown_by",
    "shown_values",
]

# Number of the first of the three messages, above all that refinement comes to (choice).
SHOW = 1 << 31
# Largest difference of two cameras' rotations that are the same, of their matrices (choice: well above rounding and what
# is left when messages have settled).
AGREED = 1e-8
# Bytes of a digest: a float64 holds them as a whole number (derived).
DIGEST = 6


def shown_by(link: Link, rotation: ArrayLike, moments: PairMoments) -> Link:
    """Shows one's moments."""
    return said(link, Message(SHOW, True, False, shown_values(rotation, moments)))


def answered(link: Link, aim: bool) -> tuple[Link, dict[int, FloatArray]]:
    """When all have shown theirs: what was shown (54,), one's own included, and the digests of it."""
    shown, refused = {link.camera: link.sent.values}, {}
    for c, message in link.there().items():
        try:
            opened(message.values, aim)
            shown[c] = message.values
        except ValueError as error:
            refused[c] = str(error)
    digests = [_digest(shown[c]) if c in shown else 0.0 for c in sorted({link.camera, *link.others})]
    return said(link.refusing(refused), Message(SHOW + 1, True, False, np.array(digests))), shown


def concluded(link: Link, shown: Mapping[int, FloatArray], aim: bool) -> tuple[Link, Verdict]:
    """When all have said what they were shown: what follows from what nobody contradicts."""
    everyone = sorted({link.camera, *link.others})
    rows = {c: dict(zip(everyone, m.values, strict=True)) for c, m in link.there().items()}
    rows[link.camera] = dict(zip(everyone, link.sent.values, strict=True))
    named = contradictions(rows)
    good = [row for c, row in rows.items() if c not in named]
    kept = {c: v for c, v in shown.items() if c not in named and all(row[c] == rows[link.camera][c] for row in good)}
    found = verdict({c: opened(v, aim) for c, v in kept.items()}, aim=aim)
    Z = np.zeros((3, 3)) if found.rotation is None else found.rotation
    # What this camera itself is said to have done is no reason for it to listen no more.
    link = link.refusing({c: why for c, why in named.items() if c != link.camera})
    return said(link, Message(SHOW + 2, True, True, Z.ravel())), replace(found, converged=False)


def agreeing(link: Link, found: Verdict) -> Verdict:
    """When all have said what follows: whether more than two thirds of them say the same."""
    said_by = [m.values for m in link.there().values()]
    same = 1 + sum(bool(np.linalg.norm(v - link.sent.values) < AGREED) for v in said_by)
    return replace(found, converged=found.rotation is not None and 3 * same > 2 * (1 + len(said_by)))


def contradictions(rows: Mapping[int, Mapping[int, float]]) -> dict[int, str]:
    """Whom to leave out, and why.

    Args:
        rows: camera -> digest of what each camera has shown it, 0 for none; of what it has shown itself.
    """
    pairs = {frozenset((a, b)) for a in rows for b in rows if rows[a][b] != rows[b][b]}
    named = {}
    while pairs:
        count = Counter(c for pair in pairs for c in pair)
        most = max(count.values())
        for c in sorted(c for c in count if count[c] == most):
            against = ", ".join(str(k) for k in sorted({k for pair in pairs if c in pair for k in pair} - {c}))
            tie = "; which one is wrong cannot be told" if most == 1 else ""
            named[c] = (
                f"it has shown another something else than it says, or says so of others (cameras {against}){tie}"
            )
        pairs = {pair for pair in pairs if not pair & named.keys()}
    return named


def shown_values(rotation: ArrayLike, moments: PairMoments) -> FloatArray:
    """(54,) what a camera shows: moments and Q of its camera_from_world."""
    return np.concatenate([np.frombuffer(moments.to_bytes(), "<f8"), np.ravel(rotation)])


def opened(values: FloatArray, aim: bool) -> tuple[FloatArray, PairMoments]:
    """The inverse of `shown_values`.

    Raises:
        ValueError: no rotation, or moments that no image has.
    """
    return checked_rotations(values[45:].reshape(1, 3, 3), 1)[0], plausible(values[:45], aim)


def _digest(values: FloatArray) -> float:
    return float(int.from_bytes(hashlib.blake2b(values.astype("<f8").tobytes(), digest_size=DIGEST).digest(), "little"))
