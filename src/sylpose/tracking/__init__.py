"""Frame-by-frame tracking of a rigid object's pose.

Each camera processes its own images; all cameras combine a few numbers from each into one pose. Entry point: `tracker`.
"""
