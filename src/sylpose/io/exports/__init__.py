"""Export of trajectories to other programs: `formats` lists the formats, `poses` has common code.

Frames without a measured pose are gaps, in whatever form the format supports; no exporter invents a pose.
"""
