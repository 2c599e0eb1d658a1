"""Traffic of a tree topology compared with all-to-all, for `benchmarks/network.py`: messages are counted, not sent.

In a round of the alignment each camera has 30 numbers, and all need their sum. In the tree, each node adds the sums of its
children to its own numbers, in the order of their indices, and sends the result to its parent. The root sends the total to
its children, and these to theirs. Each sum is computed once, so all nodes have the same total to the bit, for any order of
arrival. The totals of different trees differ in their last bits.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.network.wire_format import HEADER

__all__ = ["TABLE_HEADER", "Traffic", "compute_all_to_all", "compute_tree", "format_rows"]

N_VALUES = 30  # values per camera and round (derived: 21 of the information, 6 of the gradient, 3 more)
MESSAGE_BYTES = HEADER.size + 8 * N_VALUES + 1  # bytes per message, as measured for a round of the alignment
TABLE_HEADER = (
    "| cameras | topology | sent by a node, max kB | received, max kB | messages received, max | sequential hops "
    "| all links, MB |\n" + "|---" * 7 + "|"
)


class Traffic(NamedTuple):
    """Traffic of one round.

    Attributes:
        sent, received: (C,) bytes that each node sends and receives.
        n_received: (C,) number of messages that each node receives.
        n_hops: number of sequential transmissions.
        sums: (C, 30) final values of each node.
    """

    sent: FloatArray
    received: FloatArray
    n_received: FloatArray
    n_hops: int
    sums: FloatArray


def compute_all_to_all(values: FloatArray) -> Traffic:
    """Compute the traffic of all-to-all: each node sends to all others and adds in the order of the cameras."""
    n = len(values)
    each = np.full(n, (n - 1.0) * MESSAGE_BYTES)
    total = np.zeros(values.shape[1])
    for numbers in values:
        total = total + numbers
    return Traffic(each, each, np.full(n, n - 1.0), 1, np.tile(total, (n, 1)))


def compute_tree(values: FloatArray, n_children: int, order: IntArray) -> Traffic:
    """Compute the traffic of a tree in which camera c > 0 sends to camera (c - 1) // fan.

    Args:
        values: (C, 30) values of the cameras.
        n_children: number of children per node.
        order: (C,) order of arrival, on which the sums must not depend.
    """
    n = len(values)
    parent = (np.arange(n) - 1) // n_children
    sent, received, messages, depth = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n, int)
    inbox: list[dict[int, FloatArray]] = [{} for _ in range(n)]
    for c in range(1, n):
        depth[c] = depth[parent[c]] + 1
    partial = values.copy()
    for level in range(int(depth.max()), 0, -1):
        nodes = np.flatnonzero(depth == level)
        for c in nodes[np.argsort(order[nodes])]:
            for child in sorted(inbox[c]):
                partial[c] = partial[c] + inbox[c][child]
            inbox[parent[c]][c] = partial[c]
            sent[c] += MESSAGE_BYTES
            received[parent[c]] += MESSAGE_BYTES
            messages[parent[c]] += 1
    for child in sorted(inbox[0]):
        partial[0] = partial[0] + inbox[0][child]
    sums = np.empty_like(values)
    sums[0] = partial[0]
    for c in range(1, n):  # parents have smaller numbers
        sums[c] = sums[parent[c]]
        sent[parent[c]] += MESSAGE_BYTES
        received[c] += MESSAGE_BYTES
        messages[c] += 1
    return Traffic(sent, received, messages, 2 * int(depth.max()), sums)


def format_rows(cameras: int, child_counts: tuple[int, ...] = (2, 4, 10, 32), seed: int = 0) -> str:
    """Return the table rows of a round of `cameras` cameras."""
    rng = np.random.default_rng(seed)
    values = rng.standard_normal((cameras, N_VALUES)) * 10.0 ** rng.uniform(-6, 6, (cameras, N_VALUES))
    topologies = [("all-to-all", compute_all_to_all(values))]
    for fan in child_counts:
        one, other = (compute_tree(values, fan, rng.permutation(cameras)) for _ in range(2))
        assert np.array_equal(one.sums, other.sums)
        assert all(np.array_equal(row, one.sums[0]) for row in one.sums)
        np.testing.assert_allclose(one.sums[0], topologies[0][1].sums[0], rtol=1e-9)
        topologies.append((f"tree, {fan} children", one))
    return "\n".join(
        f"| {cameras:,} | {name} | {traffic.sent.max() / 1e3:.1f} | {traffic.received.max() / 1e3:.1f} | "
        f"{traffic.n_received.max():.0f} "
        f"| {traffic.n_hops} | {traffic.sent.sum() / 1e6:.2f} |"
        for name, traffic in topologies
    )
