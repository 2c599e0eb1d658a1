"""Picture formats and page file name, importable without the drawing libraries."""

__all__ = ["PAGE_FILE", "PICTURE_FORMATS"]

# By file name suffix.
PICTURE_FORMATS = ("png", "svg", "pdf")
PAGE_FILE = "report.html"
