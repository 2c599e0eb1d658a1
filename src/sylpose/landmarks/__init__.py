"""Landmarks on the object: their positions (`landmark_filter`), and the pose that aligns them (`alignment`)."""
