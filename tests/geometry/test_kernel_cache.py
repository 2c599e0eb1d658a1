"""A kernel that is kept on disk is compiled anew once anything that it was compiled with has changed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

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
ASKED = "from apart.caller import answer; print(answer(2.0), len(answer.stats.cache_hits))"
# What a process does before: files beside the sources cannot be written, though root would; and none at all can be.
READ_ONLY = "from sylpose.geometry import cache_folders as c; able = c.is_writable; \
c.is_writable = lambda folder: folder.name != '__pycache__' and able(folder); "
NOWHERE = "from sylpose.geometry import cache_folders as c; c.is_writable = lambda folder: False; "
FULL = (
    "import numba.core.caching as n; n.IndexDataCacheFile._open_for_write = lambda *_: open('/no/such/folder', 'wb'); "
)
UNDER_WAY = "sylpose compiles for this computer, for up to two minutes"


def answered(
    folder: Path, by: float = 3.0, factor: float = 1.0, comment: str = "", before: str = ""
) -> tuple[str, str, list[str]]:
    """What a process of its own answers, how often it found the kernel on disk, and the lines that it said."""
    package = folder / "apart"
    package.mkdir(exist_ok=True)
    (package / "__init__.py").touch()
    (package / "caller.py").write_text(CALLER)
    (package / "called.py").write_text(CALLED.format(by=by, comment=comment))
    (package / "numbers.py").write_text(f"FACTOR = {factor}\n")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)]), "PYTHONDONTWRITEBYTECODE": "1"}
    environment |= {"XDG_CACHE_HOME": str(folder / "caches"), "LOCALAPPDATA": str(folder / "caches")}
    environment.pop("NUMBA_CACHE_DIR", None)
    command = [sys.executable, "-c", before + ASKED]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    value, hits = done.stdout.split()
    return value, hits, done.stderr.splitlines()


def test_what_a_kernel_calls_or_refers_to_is_part_of_it(tmp_path: Path) -> None:
    value, hits, (said,) = answered(tmp_path)
    assert (value, hits) == ("7.0", "0")
    assert said.startswith(f"{UNDER_WAY} after an installation or an update; kept in ")
    assert answered(tmp_path) == ("7.0", "1", []), "what is there is not compiled, and nothing is said"
    assert answered(tmp_path, 4.0)[:2] == ("9.0", "0"), "the kernel that it calls has changed"
    assert answered(tmp_path, 4.0, 2.0)[:2] == ("10.0", "0"), "a number of another file has changed"
    assert answered(tmp_path, 4.0, 2.0, "# said")[:2] == ("10.0", "1"), "what is said of it is not part of it"


def test_where_nothing_can_be_written_every_process_compiles_and_says_so(tmp_path: Path) -> None:
    for _ in range(2):
        value, hits, (said,) = answered(tmp_path, before=NOWHERE)
        assert (value, hits) == ("7.0", "0")
        assert said.startswith(f"{UNDER_WAY} at every start; no folder can be written to keep it in, NUMBA_CACHE_DIR=")
    assert not list(tmp_path.rglob("*.nb?"))


def test_what_an_installation_has_that_cannot_be_written_is_loaded(tmp_path: Path) -> None:
    assert answered(tmp_path)[:2] == ("7.0", "0")
    for before in (READ_ONLY, NOWHERE):
        assert answered(tmp_path, before=before) == ("7.0", "1", [])
    # What is not there goes into the user's cache, and is found there.
    value, hits, (said,) = answered(tmp_path, 4.0, before=READ_ONLY)
    assert (value, hits) == ("9.0", "0")
    assert said.endswith(f"kept in {tmp_path / 'caches' / 'sylpose'}")
    assert answered(tmp_path, 4.0, before=READ_ONLY) == ("9.0", "1", [])


def test_files_that_end_in_the_middle_are_made_anew(tmp_path: Path) -> None:
    answered(tmp_path)
    for kind, length in ((".nbi", 0), (".nbc", 30)):
        (kept,) = tmp_path.rglob(f"caller.answer*{kind}")
        kept.write_bytes(kept.read_bytes()[:length])
        assert answered(tmp_path)[:2] == ("7.0", "0")
    assert answered(tmp_path) == ("7.0", "1", [])


def test_a_disk_that_is_full_costs_no_answer(tmp_path: Path) -> None:
    value, hits, (_, said) = answered(tmp_path, before=FULL)
    assert (value, hits) == ("7.0", "0")
    assert "cannot be kept in" in said
    assert "no such file or directory" in said
