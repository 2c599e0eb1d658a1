"""Distributed tracking: one node per camera, synchronous message rounds, and group membership.

Source: C. Chen, D. Schonfeld, "Pose estimation from multiple cameras based on Sylvester's equation" (2010), for the
scheme.
"""
