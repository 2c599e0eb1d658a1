"""Calibration targets: what users call them (`specification`), found in one image (`detection`), and where they are, by all
cameras together (`location`)."""
