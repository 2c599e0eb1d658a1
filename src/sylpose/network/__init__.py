"""Cameras as nodes that track one object together, each by its own images: agreed rounds of messages, and who takes part.

Source: C. Chen, D. Schonfeld, "Pose estimation from multiple cameras based on Sylvester's equation" (2010), for the scheme.
"""
