"""What a run leaves behind: trajectory files, plots, overlay videos and the picture of the rig.

`files` writes and reads trajectories, `plots` draws one, `overlay` draws the poses into the videos, `rigview` shows the
rig from above. Nothing is imported here: reading a trajectory does not load matplotlib or PyAV.
"""
