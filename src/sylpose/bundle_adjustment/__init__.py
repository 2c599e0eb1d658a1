"""Bundle adjustment: joint refinement of all frames' poses, landmarks and per-camera parameters (`bundle`)."""
