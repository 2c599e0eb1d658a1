"""Trajectories as files of other programs: a module for each, `formats` the table of them, `poses` what all have in common.

Frames without a measured pose are gaps, whatever a format has for one; none of them invents a pose.
"""
