"""Files: calibrations, recordings, exports, object and point files (docs/formats.md)."""
