"""Image features: detection and matching (`sift`) and tracking (`klt`)."""
