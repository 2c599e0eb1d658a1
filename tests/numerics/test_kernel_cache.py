"""A kernel that is kept on disk is compiled anew once anything that it was compiled with has changed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2] / "src"
CALLER = """
from sylpose.numerics.compiled import kernel
from apart.called import times
from apart.numbers import FACTOR

@kernel
def answer(x: float) -> float:
    return times(x) + FACTOR
"""
CALLED = """
from sylpose.numerics.compiled import leaf
{comment}
@leaf
def times(x: float) -> float:
    return {by} * x
"""
ASKED = "from apart.caller import answer; print(answer(2.0), len(answer.stats.cache_hits))"


def answered(folder: Path, by: float, factor: float, comment: str = "", nowhere: Path | None = None) -> list[str]:
    """What a process of its own answers, and how often it found the kernel on disk."""
    package = folder / "apart"
    package.mkdir(exist_ok=True)
    (package / "__init__.py").touch()
    (package / "caller.py").write_text(CALLER)
    (package / "called.py").write_text(CALLED.format(by=by, comment=comment))
    (package / "numbers.py").write_text(f"FACTOR = {factor}\n")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)]), "PYTHONDONTWRITEBYTECODE": "1"}
    if nowhere is not None:
        environment |= {"XDG_CACHE_HOME": str(nowhere), "LOCALAPPDATA": str(nowhere), "HOME": str(nowhere)}
    command = [sys.executable, "-c", ASKED]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    return [*done.stdout.split(), done.stderr]


def test_what_a_kernel_calls_or_refers_to_is_part_of_it(tmp_path: Path) -> None:
    assert answered(tmp_path, 3.0, 1.0)[:2] == ["7.0", "0"]
    assert answered(tmp_path, 3.0, 1.0)[:2] == ["7.0", "1"]
    assert answered(tmp_path, 4.0, 1.0)[:2] == ["9.0", "0"], "the kernel that it calls has changed"
    assert answered(tmp_path, 4.0, 2.0)[:2] == ["10.0", "0"], "a number of another file has changed"
    assert answered(tmp_path, 4.0, 2.0, "# said")[:2] == ["10.0", "1"], "what is said of it is not part of it"


def test_where_nothing_can_be_written_every_process_compiles_and_says_so(tmp_path: Path) -> None:
    (tmp_path / "apart").mkdir()
    # Nobody, not even root, makes a folder of a file.
    (tmp_path / "apart" / "__pycache__").touch()
    for _ in range(2):
        value, hits, *said = answered(tmp_path, 3.0, 1.0, nowhere=tmp_path / "apart" / "__pycache__")
        assert (value, hits) == ("7.0", "0")
        assert " ".join(said).count("compiled code cannot be kept") == 1
