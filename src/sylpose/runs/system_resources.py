"""Cores and memory available to this process, and their division among worker processes."""

from __future__ import annotations

import ctypes
import os
from contextlib import suppress

# Least memory of one recording, bytes (choice: several times the figure in docs/benchmarks.md), and largest share of
# the computer's memory for all (choice).
MIN_MEMORY, MAX_MEMORY_RATIO = 2 << 30, 0.9

# Arrays of at least so many bytes are returned to the system when they are freed: the gray image of 8 megapixels (measured:
# four cameras of 3264x2448 need 2.7 GB otherwise, with this 1.9 GB for 7 % more processor time; with half and twice of it
# 1.8 and 2.1 GB for 13 and 7 %). Code of mallopt's limit in glibc.
MIN_RETURNED_BYTES, MMAP_THRESHOLD = 8 << 20, -3


def return_large_arrays() -> None:
    """Make the allocator of glibc return large arrays to the system when they are freed; others do so.

    It keeps arrays of up to 32 MB in pools, one per thread, in which images of 24 MB leave gaps. A limit that the user has
    set in the environment is kept.
    """
    with suppress(OSError, TypeError, AttributeError):  # no glibc
        is_set = "glibc.malloc.mmap_threshold" in os.environ.get("GLIBC_TUNABLES", "")
        if not is_set and "MALLOC_MMAP_THRESHOLD_" not in os.environ:
            ctypes.CDLL(None).mallopt(MMAP_THRESHOLD, MIN_RETURNED_BYTES)


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


def memory_share(processes: int) -> int | None:
    """Return the bytes for each of several processes; None if unknown."""
    total = available_memory()
    return None if total is None else int(MAX_MEMORY_RATIO * total) // processes


def choose_default_jobs(threads: int) -> int:
    """Return the number of processes that cores and memory allow."""
    memory = memory_share(1)
    by_memory = available_cores() if memory is None else memory // MIN_MEMORY
    return max(1, min(available_cores() // threads, by_memory))


def thread_limits(threads: int) -> dict[str, str]:
    """Return environment variables that limit the threads of libraries."""
    names = ("OMP", "OPENBLAS", "MKL", "NUMBA", "VECLIB_MAXIMUM")
    return {**{f"{name}_NUM_THREADS": str(threads) for name in names}, "OPENCV_FOR_THREADS_NUM": str(threads)}
