"""Offline smoothing: joint refinement of a tracked trajectory's poses and landmarks (`trajectory`)."""
