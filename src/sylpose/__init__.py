"""sylpose: how a rigid object moves in 3D, from the videos of several calibrated cameras around it."""

__version__ = "0.1.0"
