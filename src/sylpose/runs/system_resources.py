"""Cores and memory available to this process."""

from __future__ import annotations

import os
from contextlib import suppress


def available_cores() -> int:
    """Return the number of cores that this process may use; SLURM and containers may limit them."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def available_memory() -> int | None:
    """Return the memory in bytes, limited by a SLURM job or a container; None if unknown."""
    sizes = []
    with suppress(ValueError, OSError, AttributeError):
        sizes.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    for file in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        with suppress(ValueError, OSError), open(file, encoding="ascii") as limit:
            sizes.append(int(limit.read()))
    with suppress(ValueError):
        sizes.append(int(os.environ.get("SLURM_MEM_PER_NODE", "")) << 20)
    return min(sizes, default=None)
