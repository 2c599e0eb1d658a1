"""All frames at once, afterwards."""
