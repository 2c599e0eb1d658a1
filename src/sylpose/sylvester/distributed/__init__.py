"""The paper's cameras among themselves: each has its own matches, a few numbers are exchanged.

Each scheme (`exchange`, `refine`, `gossip`) is one camera's step, (state, inbox) -> (state, packets), with nothing shared;
`simulated` runs all cameras in one process, over a network that may fail.
"""
