"""The notebooks run, and reproduce their stored output."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pages.notebooks import NOTEBOOKS, as_markdown, read, run, source_of
from tests.paths import REPOSITORY

# Largest size of a notebook with its pictures, bytes.
MOST = 250_000


def text_of(outputs: list[dict[str, Any]]) -> str:
    """Return the text output, with runs of spaces collapsed."""
    text: list[str] = []
    for output in outputs:
        data = output.get("data", {"text/plain": output.get("text", [])})
        text += data["text/plain"] if not any(kind.startswith("image/") for kind in data) else ["a picture"]
    return " ".join("".join(text).split())


def words_of(text: str) -> str:
    """Return the text without numbers and spaces, whose count depends on the numbers."""
    return "".join(NUMBER.sub("#", text).split())


NUMBER = re.compile(r"-?\d+\.?\d*(?:e[-+]?\d+)?")


# Slow: it tracks a recording and draws, as other tests do.
@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, id=path.stem, marks=pytest.mark.slow if path.stem == "first_steps" else ())
        for path in NOTEBOOKS
    ],
)
def test_notebook_reproduces_stored_output(path: Path) -> None:
    notebook = read(path)
    for number, (cell, shown) in enumerate(zip(notebook["cells"], run(notebook), strict=True)):
        if cell["cell_type"] != "code":
            continue
        kept, found = text_of(cell["outputs"]), text_of(shown)
        # The words must be equal; numbers may differ by the arithmetic of another machine.
        assert words_of(found) == words_of(kept), f"cell {number}: run python -m pages.notebooks"
        numbers, before = ([float(n) for n in NUMBER.findall(text)] for text in (found, kept))
        np.testing.assert_allclose(numbers, before, rtol=0.5, atol=0.3, err_msg=f"cell {number}")


def test_notebooks_exist() -> None:
    assert len(NOTEBOOKS) >= 4


@pytest.mark.parametrize("path", NOTEBOOKS, ids=[path.stem for path in NOTEBOOKS])
def test_notebook_is_valid(path: Path) -> None:
    notebook = read(path)
    assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
    assert notebook["metadata"]["kernelspec"]["name"] == "python3"
    assert path.stat().st_size < MOST
    ids = [cell["id"] for cell in notebook["cells"]]
    assert len(set(ids)) == len(ids)
    for cell in notebook["cells"]:
        assert cell["cell_type"] in ("code", "markdown")
        assert cell["metadata"] == {}
        if cell["cell_type"] == "code":
            assert cell["execution_count"] is None
            assert {output["output_type"] for output in cell["outputs"]} <= {"stream", "execute_result"}
    # Formatted as by `python -m pages.notebooks`, whichever program changed it.
    assert path.read_text(encoding="utf-8") == json.dumps(notebook, indent=1, ensure_ascii=False, sort_keys=True) + "\n"


@pytest.mark.parametrize("path", NOTEBOOKS, ids=[path.stem for path in NOTEBOOKS])
def test_notebook_links_exist(path: Path) -> None:
    prose = "\n".join(source_of(cell) for cell in read(path)["cells"] if cell["cell_type"] == "markdown")
    for target in re.findall(r"\]\(([^)\s]+)\)", prose):
        file, _, anchor = target.partition("#")
        page = (path.parent / file).resolve()
        assert page.is_file(), target
        assert page.is_relative_to(REPOSITORY)
        if anchor:
            headings = re.findall(r"(?m)^#+ (.*)$", page.read_text(encoding="utf-8"))
            assert anchor in {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings}, target


def test_notebook_page_has_code_text_and_pictures(tmp_path: Path) -> None:
    (path,) = (path for path in NOTEBOOKS if path.stem == "first_steps")
    page = as_markdown(path, tmp_path / "pictures")
    assert page.startswith("# First steps")
    assert page.count("```") % 2 == 0
    pictures = re.findall(r"!\[[^\]]+\]\((pictures/[\w.]+)\)", page)
    assert len(pictures) == 2
    assert all((tmp_path / picture).stat().st_size > 10_000 for picture in pictures)
