"""Distributed rotation estimators: each camera node has its own matches and exchanges a few numbers with the others.

The steps of a node in `exchange` and `refine` are pure functions, (state, inbox) -> (state, packets). `solvers` runs all
nodes in one process, over a network with faults (`packets`).
"""
