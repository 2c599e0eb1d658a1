"""Calibration targets: text descriptions (`specification`), detection in one image (`detection`), and pose from all
cameras (`board_pose`).
"""
