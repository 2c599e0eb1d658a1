"""Where an object of known points is: `pose.estimate_pose`, solvePnP for many cameras."""
