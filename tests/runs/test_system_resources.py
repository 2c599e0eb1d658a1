"""Resources of the process: the allocator is asked for nothing that it does not have."""

from __future__ import annotations

import ctypes

import pytest

from sylpose.runs.system_resources import MIN_RETURNED_BYTES, MMAP_THRESHOLD, return_large_arrays


class Glibc:
    """An allocator that records what is set."""

    def __init__(self) -> None:
        self.calls = list[tuple[int, int]]()

    def mallopt(self, code: int, value: int) -> int:
        self.calls.append((code, value))
        return 1


def test_large_arrays_are_returned_unless_the_user_has_set_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    glibc = Glibc()
    monkeypatch.setattr(ctypes, "CDLL", lambda _: glibc)
    monkeypatch.delenv("MALLOC_MMAP_THRESHOLD_", raising=False)
    return_large_arrays()
    monkeypatch.setenv("MALLOC_MMAP_THRESHOLD_", "65536")
    return_large_arrays()
    assert glibc.calls == [(MMAP_THRESHOLD, MIN_RETURNED_BYTES)]


@pytest.mark.parametrize("library", [object(), TypeError("Windows"), OSError("static")])
def test_other_allocators_are_left_as_they_are(monkeypatch: pytest.MonkeyPatch, library: object) -> None:
    def load(_: None) -> object:
        if isinstance(library, Exception):
            raise library
        return library

    monkeypatch.setattr(ctypes, "CDLL", load)
    monkeypatch.delenv("MALLOC_MMAP_THRESHOLD_", raising=False)
    return_large_arrays()
