"""The names that options take. Apart from the code that they choose between, so that `sylpose --help` need not load it."""

from __future__ import annotations

__all__ = ["FEATURES", "METHODS", "MOTION_METHODS", "PAPER_METHODS"]

# The paper's estimators of a rotation from pair moments (`paper`, `two_frames.paper_methods`).
PAPER_METHODS = ("sylvester", "depth-plane", "exchange", "refine", "gossip", "one-camera", "unconstrained")

# In each the first is the default. Of the tracker: how each frame's pose is found, and where a frame's features come from.
METHODS = ("landmarks", "epipolar", *PAPER_METHODS, "known-depth")
FEATURES = ("auto", "sift", "klt")
# Of `estimate_motion`: between two frames nothing is known of the landmarks yet.
MOTION_METHODS = ("epipolar", *PAPER_METHODS)
