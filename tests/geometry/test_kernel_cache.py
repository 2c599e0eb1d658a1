"""A cached kernel is compiled again when anything that it was compiled with changes."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import pytest

from sylpose.geometry.kernel_cache import PORTABLE_CPU

ROOT = Path(__file__).parents[2] / "src"
CALLER = """
from sylpose.geometry.numba_linalg import kernel
from apart.called import times
from apart.numbers import FACTOR

@kernel
def answer(x: float) -> float:
    return times(x) + FACTOR
"""
CALLED = """
from sylpose.geometry.numba_linalg import leaf
{comment}
@leaf
def times(x: float) -> float:
    return {by} * x
"""
RUN_CODE = "from apart.caller import answer; print(answer(2.0), len(answer.stats.cache_hits))"
# Prefixes of a process's code: the folder next to the sources is read-only, even for root; no folder is writable.
READ_ONLY = "from sylpose.geometry import kernel_cache as c; able = c.is_writable; \
c.is_writable = lambda folder: folder.name != '__pycache__' and able(folder); "
NOWHERE = "from sylpose.geometry import kernel_cache as c; c.is_writable = lambda folder: False; "
FULL = (
    "import numba.core.caching as n; n.IndexDataCacheFile._open_for_write = lambda *_: open('/no/such/folder', 'wb'); "
)
COMPILING = "sylpose compiles its kernels for up to two minutes"


def run_process(
    folder: Path,
    by: float = 3.0,
    factor: float = 1.0,
    comment: str = "",
    before: str = "",
    settings: Mapping[str, str] = MappingProxyType({}),
) -> tuple[str, str, list[str]]:
    """Return a separate process's result, its number of cache hits, and the lines that it logged."""
    package = folder / "apart"
    package.mkdir(exist_ok=True)
    (package / "__init__.py").touch()
    (package / "caller.py").write_text(CALLER)
    (package / "called.py").write_text(CALLED.format(by=by, comment=comment))
    (package / "numbers.py").write_text(f"FACTOR = {factor}\n")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)]), "PYTHONDONTWRITEBYTECODE": "1"}
    environment |= {"XDG_CACHE_HOME": str(folder / "caches"), "LOCALAPPDATA": str(folder / "caches")}
    environment.pop("NUMBA_CACHE_DIR", None)
    environment |= settings
    command = [sys.executable, "-c", before + RUN_CODE]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    value, hits = done.stdout.split()
    return value, hits, done.stderr.splitlines()


def test_dependencies_are_part_of_the_key(tmp_path: Path) -> None:
    value, hits, (text,) = run_process(tmp_path)
    assert (value, hits) == ("7.0", "0")
    assert text.startswith(f"{COMPILING} after an installation or an update; cached in ")
    assert run_process(tmp_path) == ("7.0", "1", []), "a cached kernel is loaded without a message"
    assert run_process(tmp_path, 4.0)[:2] == ("9.0", "0"), "the called kernel has changed"
    assert run_process(tmp_path, 4.0, 2.0)[:2] == ("10.0", "0"), "a constant of another file has changed"
    assert run_process(tmp_path, 4.0, 2.0, "# comment")[:2] == ("10.0", "1"), "comments are not part of the key"


def test_without_writable_folder_every_process_compiles(tmp_path: Path) -> None:
    value, hits, (text,) = run_process(tmp_path, before=NOWHERE)
    assert (value, hits) == ("7.0", "0")
    assert text.startswith(
        f"{COMPILING} at every start, as no folder is writable for their cache: set NUMBA_CACHE_DIR="
    )
    assert not list(tmp_path.rglob("*.nb?"))


def test_read_only_cache_is_loaded(tmp_path: Path) -> None:
    assert run_process(tmp_path)[:2] == ("7.0", "0")
    for before in (READ_ONLY, NOWHERE):
        assert run_process(tmp_path, before=before) == ("7.0", "1", [])
    # Missing kernels are stored in the user's cache and found there.
    value, hits, (text,) = run_process(tmp_path, 4.0, before=READ_ONLY)
    assert (value, hits) == ("9.0", "0")
    assert text.endswith(f"cached in {tmp_path / 'caches' / 'sylpose'}")
    assert run_process(tmp_path, 4.0, before=READ_ONLY) == ("9.0", "1", [])


def test_code_that_is_not_optimized_is_not_cached(tmp_path: Path) -> None:
    """Numba refuses to cache most of it; the optimized code of other processes is loaded."""
    unoptimized = {"NUMBA_OPT": "0"}
    value, hits, (text,) = run_process(tmp_path, settings=unoptimized)
    assert (value, hits) == ("7.0", "0")
    assert text == f"{COMPILING} at every start, as NUMBA_OPT=0 is set: unset it"
    assert not list(tmp_path.rglob("*.nb?"))
    assert run_process(tmp_path)[:2] == ("7.0", "0")
    assert run_process(tmp_path, settings=unoptimized) == ("7.0", "1", [])


@pytest.mark.slow
def test_truncated_files_are_replaced(tmp_path: Path) -> None:
    run_process(tmp_path)
    for kind, length in ((".nbi", 0), (".nbc", 30)):
        (kept,) = tmp_path.rglob(f"caller.answer*{kind}")
        kept.write_bytes(kept.read_bytes()[:length])
        assert run_process(tmp_path)[:2] == ("7.0", "0")
    assert run_process(tmp_path) == ("7.0", "1", [])


def test_full_disk_does_not_prevent_results(tmp_path: Path) -> None:
    value, hits, (_, text) = run_process(tmp_path, before=FULL)
    assert (value, hits) == ("7.0", "0")
    assert "cannot be cached in" in text
    assert "no such file or directory" in text


def test_kernels_of_a_wheel_are_loaded(tmp_path: Path) -> None:
    portable = {"NUMBA_CPU_NAME": PORTABLE_CPU, "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": str(tmp_path / "made")}
    assert run_process(tmp_path, settings=portable)[:2] == ("7.0", "0")
    (made,) = (tmp_path / "made").glob("apart_*")
    made.rename(tmp_path / "shipped")
    as_package = (
        "from pathlib import Path; from sylpose.geometry import kernel_cache as c; "
        f"c.PACKAGE = Path({str(tmp_path / 'apart')!r}); c.SHIPPED_FOLDER = Path({str(tmp_path / 'shipped')!r}); "
    )
    assert run_process(tmp_path, before=as_package) == ("7.0", "1", [])
    assert not list(tmp_path.glob("apart/__pycache__/*.nb?"))
    # Other sources are compiled, for the very processor; then their code is preferred.
    for hits in "01":
        assert run_process(tmp_path, 4.0, before=as_package)[:2] == ("9.0", hits)
    # The wheel's folder is only read.
    assert {file.suffix for file in (tmp_path / "shipped").iterdir()} == {".nbi", ".nbc"}
    assert run_process(tmp_path, before=as_package)[:2] == ("7.0", "1")
