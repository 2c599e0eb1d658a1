"""Silhouettes of the object before the static background, and its shape from them."""
