"""By how much cameras' clocks differ."""
