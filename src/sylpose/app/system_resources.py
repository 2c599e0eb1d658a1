"""What this process may use of the computer that it runs on."""

from __future__ import annotations

import os
from contextlib import suppress

__all__ = ["cores", "memory_of_machine"]


def cores() -> int:
    """That this process may use: SLURM and containers give fewer than there are."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def memory_of_machine() -> int | None:
    """Bytes; what a SLURM job or a container may have where that is less; None where nobody says."""
    sizes = []
    with suppress(ValueError, OSError, AttributeError):
        sizes.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    for file in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        with suppress(ValueError, OSError), open(file, encoding="ascii") as limit:
            sizes.append(int(limit.read()))
    with suppress(ValueError):
        sizes.append(int(os.environ.get("SLURM_MEM_PER_NODE", "")) << 20)
    return min(sizes, default=None)
