"""By how much cameras' clocks differ: found from the motion they record (`pulses`), kept in offsets.toml (`offsets`)."""
