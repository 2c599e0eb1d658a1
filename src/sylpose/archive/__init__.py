"""Archives: thousands of recordings tracked by one contract, on one computer, a SLURM array or a Ray cluster.

`contract.py` says what is done with one recording; those who call it for all (`processes.py`, `ray_cluster.py`) add nothing
to that. docs/archive.md tells the rest.
"""
