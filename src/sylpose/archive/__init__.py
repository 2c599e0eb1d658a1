"""Archives: batch tracking of thousands of recordings, on one computer, a SLURM array or a Ray cluster.

`contract.py` defines the work on one recording; the drivers in `run.py` only call it for all.
See docs/archive.md.
"""
