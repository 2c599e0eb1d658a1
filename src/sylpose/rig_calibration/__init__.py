"""Calibration of a rig: intrinsics and extrinsics of all cameras, from a board or from any moving object."""
