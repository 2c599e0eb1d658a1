"""Outputs of a run: trajectory files, plots, overlay videos and rig views.

`files` writes and reads trajectories, `plots` draws them, `overlay` draws poses into the videos, `rigview` shows the
rig from above. This package imports nothing itself: reading a trajectory loads neither matplotlib nor PyAV.
"""

__all__ = ["PICTURE_FORMATS"]

# File formats of plots, by file name suffix; here for the options of commands, which load nothing else.
PICTURE_FORMATS = ("png", "svg", "pdf")
