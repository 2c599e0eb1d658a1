"""What a tree of cameras would carry, and everybody to everybody: messages counted, not sent. See `benchmarks/network.py`.

A round of the alignment: each camera has 30 numbers, all want their sum. In the tree each adds what its children say to its
own, in the order of their numbers, and tells its parent; the root tells its children the sum, and these theirs. The sum is
computed once, at each node of the tree, and passed on as it is: so all have the same to the bit, whatever the order of
arrival. Another tree has another sum, in its last bits.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.network.wire_format import HEADER

__all__ = ["HEAD", "Carried", "everybody", "table", "tree"]

NUMBERS = 30  # that a camera tells in a round (derived: 21 of the information, 6 of the gradient, 3 more)
WORD = HEADER.size + 8 * NUMBERS + 1  # bytes, as a round of the alignment is measured to have
HEAD = (
    "| cameras | way | most that a node sends, kB | hears, kB | messages heard | one after another "
    "| all links, MB |\n" + "|---" * 7 + "|"
)


class Carried(NamedTuple):
    """In one round. sent, heard: (C,) bytes of each node; messages: (C,) that it hears; hops: one after another.
    sums: (C, 30) what each node has in the end."""

    sent: FloatArray
    heard: FloatArray
    messages: FloatArray
    hops: int
    sums: FloatArray


def everybody(told: FloatArray) -> Carried:
    """Each tells all others, who add in the order of the cameras."""
    n = len(told)
    each = np.full(n, (n - 1.0) * WORD)
    total = np.zeros(told.shape[1])
    for numbers in told:
        total = total + numbers
    return Carried(each, each, np.full(n, n - 1.0), 1, np.tile(total, (n, 1)))


def tree(told: FloatArray, fan: int, order: IntArray) -> Carried:
    """Camera c > 0 tells camera (c - 1) // fan.

    Args:
        order: (C,) in which words arrive: what comes of it must not depend on that.
    """
    n = len(told)
    parent = (np.arange(n) - 1) // fan
    sent, heard, messages, depth = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n, int)
    inbox: list[dict[int, FloatArray]] = [{} for _ in range(n)]
    for c in range(1, n):
        depth[c] = depth[parent[c]] + 1
    partial = told.copy()
    for level in range(int(depth.max()), 0, -1):
        below = np.flatnonzero(depth == level)
        for c in below[np.argsort(order[below])]:
            for child in sorted(inbox[c]):
                partial[c] = partial[c] + inbox[c][child]
            inbox[parent[c]][c] = partial[c]
            sent[c] += WORD
            heard[parent[c]] += WORD
            messages[parent[c]] += 1
    for child in sorted(inbox[0]):
        partial[0] = partial[0] + inbox[0][child]
    sums = np.empty_like(told)
    sums[0] = partial[0]
    for c in range(1, n):  # parents have smaller numbers
        sums[c] = sums[parent[c]]
        sent[parent[c]] += WORD
        heard[c] += WORD
        messages[c] += 1
    return Carried(sent, heard, messages, 2 * int(depth.max()), sums)


def table(cameras: int, fans: tuple[int, ...] = (2, 4, 10, 32), seed: int = 0) -> str:
    """Of a round of so many cameras."""
    rng = np.random.default_rng(seed)
    told = rng.standard_normal((cameras, NUMBERS)) * 10.0 ** rng.uniform(-6, 6, (cameras, NUMBERS))
    ways = [("everybody to everybody", everybody(told))]
    for fan in fans:
        one, other = (tree(told, fan, rng.permutation(cameras)) for _ in range(2))
        assert np.array_equal(one.sums, other.sums)
        assert all(np.array_equal(row, one.sums[0]) for row in one.sums)
        np.testing.assert_allclose(one.sums[0], ways[0][1].sums[0], rtol=1e-9)
        ways.append((f"tree, {fan} children", one))
    return "\n".join(
        f"| {cameras:,} | {name} | {way.sent.max() / 1e3:.1f} | {way.heard.max() / 1e3:.1f} | {way.messages.max():.0f} "
        f"| {way.hops} | {way.sent.sum() / 1e6:.2f} |"
        for name, way in ways
    )
