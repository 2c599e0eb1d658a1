"""The paper's cameras among themselves: each has its own matches, a few numbers are exchanged."""
