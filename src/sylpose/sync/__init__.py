"""Time offsets between cameras: their estimation (`speed_correlation`) and the file offsets.toml (`offsets`)."""
