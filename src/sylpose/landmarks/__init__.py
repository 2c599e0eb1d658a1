"""Where features are on the object, better from frame to frame."""
