"""Distributed rotation estimators: each camera node has its own matches and exchanges a few numbers with the others.

Each scheme (`exchange`, `refine`, `gossip`) is a pure step function of one node, (state, inbox) -> (state, packets).
`simulation` runs all nodes in one process, over a network with faults.
"""
