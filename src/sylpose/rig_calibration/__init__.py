"""Calibration of a rig: intrinsics and extrinsics of all cameras from what they see together."""
