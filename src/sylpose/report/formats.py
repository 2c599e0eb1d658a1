"""Formats of pictures, known without loading what draws them."""

__all__ = ["FORMATS"]

# By the ends of their files' names.
FORMATS = ("png", "svg", "pdf")
