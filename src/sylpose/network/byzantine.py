"""Detection of Byzantine cameras from exchanged digests of received payloads.

Messages are not signed. If a single receiver reports another payload of a camera than the others, either that camera
sent it another one or the receiver is faulty. The camera is excluded first. The receiver is excluded if it accuses
another camera, however much later; then the first may return. If several receivers report different payloads, the
camera is faulty.

Every claim is relayed by all others, and the majority of the relayed copies counts: with one faulty camera among four
or more, all others reach the same decision.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from itertools import chain, permutations
from typing import NamedTuple, TypeAlias

from sylpose.network.wire_format import MASK_BYTES, decode_cameras, encode_cameras

# Camera -> digest that it reports for each camera.
ReceivedDigests: TypeAlias = Mapping[int, Mapping[int, bytes]]
# Least number of receivers of a camera for a single dissenting receiver to be a suspect as well (derived).
MIN_RECEIVERS = 3
# A camera and the digest of its payload (derived).
_RECEIVED = struct.Struct("<H8s")


class FaultEvidence(NamedTuple):
    """Evidence of faults.

    Attributes:
        faulty: faulty cameras.
        suspect_pairs: pairs of cameras of which one is faulty.
    """

    faulty: frozenset[int]
    suspect_pairs: frozenset[frozenset[int]]

    def excludes(self, camera: int, members: frozenset[int]) -> bool:
        """Return whether a camera must not be in a group with `members`."""
        return camera in self.faulty or any(camera in pair and pair & members - {camera} for pair in self.suspect_pairs)

    @property
    def suspects(self) -> frozenset[int]:
        """Cameras that may be faulty."""
        return self.faulty.union(*self.suspect_pairs)

    def describe(self, names: Sequence[str] | None = None) -> dict[int, str]:
        """Return a message by suspected camera; `names` are those of all cameras."""
        name_of = (lambda c: f"camera {c}") if names is None else names.__getitem__
        ordered = (two for pair in self.suspect_pairs for two in permutations(pair))
        messages = {c: f"it or {name_of(other)} reports false messages" for c, other in ordered}
        return {**messages, **dict.fromkeys(self.faulty, "it sent different messages to different cameras")}


NO_EVIDENCE = FaultEvidence(frozenset(), frozenset())


def _majority(values: Collection[bytes]) -> tuple[bytes, int]:
    """Return the most frequent value and its count; ties are resolved identically at all cameras."""
    return max(Counter(values).items(), key=lambda one: one[::-1], default=(b"", 0))


def find_faulty_cameras(
    rows: ReceivedDigests, accused: Mapping[int, frozenset[int]], evidence: FaultEvidence = NO_EVIDENCE
) -> tuple[frozenset[int], FaultEvidence]:
    """Determine the cameras to exclude after a dispute, the same at all cameras with the same reports.

    Args:
        rows: reports of the remaining cameras.
        accused: camera -> cameras whose next messages had another history.
        evidence: evidence from earlier disputes.

    Returns:
        The cameras to exclude, and the updated evidence.
    """
    faulty, pairs, first_excluded = set[int](), set[frozenset[int]](), set[int]()
    for camera in {*rows, *chain(*rows.values())}:
        # A camera's report of its own payload is no evidence.
        digests = {c: row.get(camera, b"") for c, row in rows.items() if c != camera}
        majority_digest, _ = _majority(digests.values())
        dissenting = [c for c, data in digests.items() if data != majority_digest]
        known = evidence.suspects & digests.keys()
        if len(dissenting) == 1 and len(digests) >= MIN_RECEIVERS:
            pairs.add(frozenset({camera, dissenting[0]}))
            first_excluded.add(camera)
        elif len(dissenting) == len(known) == 1 and camera not in evidence.suspects:
            # Of two receivers, the one that has accused another camera before.
            pairs.add(frozenset({camera, *known}))
        elif dissenting:
            faulty.add(camera)
    if not faulty and not pairs:
        # All received the same, but a camera's next message had another history.
        for camera in rows:
            by = [c for c, others in accused.items() if camera in others and c != camera]
            if len(by) > 1:
                faulty.add(camera)
            elif by:
                pairs.add(frozenset({camera, by[0]}))
                first_excluded.add(camera)
    # A faulty camera may accuse any camera.
    faulty |= evidence.faulty
    all_pairs = {pair for pair in pairs | evidence.suspect_pairs if not pair & faulty}
    while all_pairs:
        camera, count = max(Counter(chain(*all_pairs)).items(), key=lambda one: (one[1], -one[0]))
        if count < 2:
            break
        faulty.add(camera)
        all_pairs = {pair for pair in all_pairs if camera not in pair}
    excluded = faulty | {camera for camera in first_excluded if any(camera in pair for pair in all_pairs)}
    return frozenset(excluded & rows.keys()), FaultEvidence(frozenset(faulty), frozenset(all_pairs))


def encode_claim(accused: frozenset[int], digests: Mapping[int, bytes]) -> bytes:
    """Encode a camera's claim: cameras with conflicting next messages, and digests of what it received from each."""
    return encode_cameras(accused) + b"".join(_RECEIVED.pack(c, digests[c]) for c in sorted(digests))


def judge_claims(
    cameras: Collection[int], received: Mapping[int, Mapping[int, bytes]], evidence: FaultEvidence
) -> tuple[frozenset[int], FaultEvidence]:
    """Apply `find_faulty_cameras` to relayed claims.

    Args:
        cameras: members of the disputed round.
        received: camera -> the claims that it received, by camera.
        evidence: evidence from earlier disputes.

    Returns:
        The cameras to exclude, and the updated evidence.
    """
    rows, accused, unclear = dict[int, Mapping[int, bytes]](), dict[int, frozenset[int]](), set[int]()
    for camera in sorted(cameras):
        others = [
            claims.get(camera, b"") for c, claims in received.items() if c != camera and c not in evidence.suspects
        ]
        majority_claim, count = _majority(others)
        accused_bits, digest_bytes = majority_claim[:MASK_BYTES], majority_claim[MASK_BYTES:]
        if 2 * count > len(others) and accused_bits and len(digest_bytes) % _RECEIVED.size == 0:
            rows[camera], accused[camera] = dict(_RECEIVED.iter_unpack(digest_bytes)), decode_cameras(accused_bits)
        elif b"" not in others:  # a camera without its claim has excluded it
            unclear.add(camera)
    excluded, evidence = find_faulty_cameras(
        rows, accused, FaultEvidence(evidence.faulty | unclear, evidence.suspect_pairs)
    )
    return excluded | unclear, evidence
