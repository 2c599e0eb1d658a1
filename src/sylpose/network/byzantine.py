"""Who lies, by what listeners tell each other of what they heard.

Words are not signed. Where one listener alone heard something else of a camera than the others, it was told that or makes
it up: of the two one lies. The camera has to go first, and the listener where it says the same of another one, however much
later: then the first may come back. Where several heard different things, that camera lies.

What each says that it heard all others pass on, and what most of them were told counts: of one liar among four or more all
others come to the same verdict.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from itertools import chain, permutations
from typing import NamedTuple, TypeAlias

from sylpose.network.wire_format import BITS, bits_of, of_bits

__all__ = ["NOBODY_LIES", "Blame", "Rows", "claim", "liars", "verdict"]

# Camera -> what it says that it heard of each.
Rows: TypeAlias = Mapping[int, Mapping[int, bytes]]
# So many others have to have heard a camera for one of them to be in doubt rather than it (derived).
LISTENERS = 3
# A camera and the digest of what it told (derived).
_HEARD = struct.Struct("<H8s")


class Blame(NamedTuple):
    """alone: who lies; pairs: of each of these one does."""

    alone: frozenset[int]
    pairs: frozenset[frozenset[int]]

    def bars(self, camera: int, members: frozenset[int]) -> bool:
        """Whether a camera may not be with these."""
        return camera in self.alone or any(camera in pair and pair & members - {camera} for pair in self.pairs)

    @property
    def suspects(self) -> frozenset[int]:
        """Who may lie."""
        return self.alone.union(*self.pairs)

    def sentences(self, names: Sequence[str] | None = None) -> dict[int, str]:
        """Camera -> what is said of it; names: of all cameras."""
        called = (lambda c: f"camera {c}") if names is None else names.__getitem__
        said = {c: f"it or {called(o)} lies of what it told" for pair in self.pairs for c, o in permutations(pair)}
        return {**said, **dict.fromkeys(self.alone, "it told others something else")}


NOBODY_LIES = Blame(frozenset(), frozenset())


def _most_said(said: Collection[bytes]) -> tuple[bytes, int]:
    """What most say, and how many; of several the same one everywhere."""
    return max(Counter(said).items(), key=lambda one: one[::-1], default=(b"", 0))


def liars(
    rows: Rows, accused: Mapping[int, frozenset[int]], blame: Blame = NOBODY_LIES
) -> tuple[frozenset[int], Blame]:
    """Who has to go after a dispute, and what is known of who lies by then: the same for all that got the same rows.

    Args:
        rows: of those that are left.
        accused: in whose next words these saw that not all have heard the same.
        blame: from disputes before.
    """
    alone, pairs, first = set[int](), set[frozenset[int]](), set[int]()
    for camera in {*rows, *chain(*rows.values())}:
        # What a camera says of itself is no evidence.
        heard = {c: row.get(camera, b"") for c, row in rows.items() if c != camera}
        most, _ = _most_said(heard.values())
        odd = [c for c, data in heard.items() if data != most]
        known = blame.suspects & heard.keys()
        if len(odd) == 1 and len(heard) >= LISTENERS:
            pairs.add(frozenset({camera, odd[0]}))
            first.add(camera)
        elif len(odd) == len(known) == 1 and camera not in blame.suspects:
            # Of two listeners the one that has accused another before.
            pairs.add(frozenset({camera, *known}))
        elif odd:
            alone.add(camera)
    if not alone and not pairs:
        # All have heard the same, but somebody's next word said something else.
        for camera in rows:
            by = [c for c, others in accused.items() if camera in others and c != camera]
            if len(by) > 1:
                alone.add(camera)
            elif by:
                pairs.add(frozenset({camera, by[0]}))
                first.add(camera)
    # Who lies may accuse anybody.
    alone |= blame.alone
    every = {pair for pair in pairs | blame.pairs if not pair & alone}
    while every:
        camera, count = max(Counter(chain(*every)).items(), key=lambda one: (one[1], -one[0]))
        if count < 2:
            break
        alone.add(camera)
        every = {pair for pair in every if camera not in pair}
    out = alone | {camera for camera in first if any(camera in pair for pair in every)}
    return frozenset(out & rows.keys()), Blame(frozenset(alone), frozenset(every))


def claim(odd: frozenset[int], row: Mapping[int, bytes]) -> bytes:
    """What a camera says in a dispute: whose next words are odd, and digests of what it heard of each."""
    return bits_of(odd) + b"".join(_HEARD.pack(c, row[c]) for c in sorted(row))


def verdict(
    cameras: Collection[int], received: Mapping[int, Mapping[int, bytes]], blame: Blame
) -> tuple[frozenset[int], Blame]:
    """As `liars`, of claims that were passed on.

    Args:
        cameras: that took part.
        received: by camera, what it says that it received of each other one, as its claim.
    """
    rows, accused, unclear = dict[int, Mapping[int, bytes]](), dict[int, frozenset[int]](), set[int]()
    for camera in sorted(cameras):
        others = [claims.get(camera, b"") for c, claims in received.items() if c != camera and c not in blame.suspects]
        said, count = _most_said(others)
        odd, heard = said[:BITS], said[BITS:]
        if 2 * count > len(others) and odd and len(heard) % _HEARD.size == 0:
            rows[camera], accused[camera] = dict(_HEARD.iter_unpack(heard)), of_bits(odd)
        elif b"" not in others:  # who has not heard it has given it up
            unclear.add(camera)
    out, blame = liars(rows, accused, Blame(blame.alone | unclear, blame.pairs))
    return out | unclear, blame
