"""Absolute pose of an object with known points: `pose.estimate_pose`, solvePnP for many cameras."""
