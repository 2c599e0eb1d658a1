"""One recording from start to files: options, run, outputs, checkpoints, metadata and progress."""
