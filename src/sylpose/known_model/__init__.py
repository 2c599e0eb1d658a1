"""Where an object of known points is."""
