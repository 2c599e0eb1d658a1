"""Formats of pictures and the name of the page, known without loading what draws them."""

__all__ = ["FORMATS", "PAGE"]

# By the ends of their files' names.
FORMATS = ("png", "svg", "pdf")
PAGE = "report.html"
