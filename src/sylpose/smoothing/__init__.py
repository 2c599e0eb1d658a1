"""All frames at once, afterwards: a tracked trajectory's poses and landmarks refined together (`trajectory`)."""
