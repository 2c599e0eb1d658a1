"""How an object moved between two frames: perspective, six unknowns, outliers."""
