"""Run the notebooks of examples/notebooks, store their outputs, and convert them to Markdown.

    python -m pages.notebooks [NAME ...]

runs them in this process and stores their outputs. No kernel is needed: cells contain only Python.
"""

from __future__ import annotations

import ast
import base64
import io
import json
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

from PIL import Image

__all__ = ["FOLDER", "NOTEBOOKS", "as_markdown", "read", "run", "source_of"]

FOLDER = Path(__file__).resolve().parent.parent / "examples" / "notebooks"
NOTEBOOKS = tuple(sorted(FOLDER.glob("*.ipynb")))
# Maximal width of stored pictures, pixels: tens of kilobytes (choice).
WIDTH = 760

Cell = dict[str, Any]


def read(path: Path) -> dict[str, Any]:
    """Read a notebook in nbformat 4."""
    notebook: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return notebook


def source_of(cell: Cell) -> str:
    """Return the source text of a cell."""
    return "".join(cell["source"])


def run(notebook: dict[str, Any]) -> list[list[Cell]]:
    """Run all code cells; return the outputs of each cell in nbformat. Exceptions propagate."""
    space: dict[str, Any] = {"__name__": "__main__"}
    shown = []
    for number, cell in enumerate(notebook["cells"]):
        shown.append(_shown(source_of(cell), f"cell {number}", space) if cell["cell_type"] == "code" else [])
    return shown


def _shown(source: str, name: str, space: dict[str, Any]) -> list[Cell]:
    """Run one cell; return what it prints and the value of its last line."""
    tree, printed, value = ast.parse(source, name), io.StringIO(), None
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    with redirect_stdout(printed):
        exec(compile(tree, name, "exec"), space)
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), name, "eval"), space)
    outputs: list[Cell] = []
    if text := printed.getvalue():
        outputs.append({"name": "stdout", "output_type": "stream", "text": text.splitlines(keepends=True)})
    if value is not None:
        data = _data(value)
        outputs.append({"data": data, "execution_count": None, "metadata": {}, "output_type": "execute_result"})
    return outputs


def _data(value: Any) -> dict[str, Any]:
    """Return the representations of a value by media type."""
    data: dict[str, Any] = {"text/plain": repr(value).splitlines(keepends=True)}
    if isinstance(value, Image.Image):  # a photograph
        data["image/jpeg"] = _encoded(_small(value.convert("RGB")), "jpeg", quality=80)
    elif png := getattr(value, "_repr_png_", None):
        drawn = _small(Image.open(io.BytesIO(png())).convert("RGB"))
        data["image/png"] = _encoded(drawn.quantize(256, dither=Image.Dither.NONE), "png", optimize=True)
    elif html := getattr(value, "_repr_html_", None):
        data["text/html"] = html().splitlines(keepends=True)
    return data


def _small(picture: Image.Image) -> Image.Image:
    if picture.width <= WIDTH:
        return picture
    return picture.resize((WIDTH, round(picture.height * WIDTH / picture.width)), Image.Resampling.LANCZOS)


def _encoded(picture: Image.Image, kind: str, **options: Any) -> str:
    file = io.BytesIO()
    picture.save(file, format=kind, **options)
    return base64.b64encode(file.getvalue()).decode()


def keep(path: Path) -> None:
    """Run a notebook and write it with its outputs."""
    notebook = read(path)
    for number, (cell, outputs) in enumerate(zip(notebook["cells"], run(notebook), strict=True)):
        cell["id"] = f"cell-{number}"
        if cell["cell_type"] == "code":
            cell["outputs"], cell["execution_count"] = outputs, None
    path.write_text(json.dumps(notebook, indent=1, ensure_ascii=False, sort_keys=True) + "\n", encoding="utf-8")


def as_markdown(path: Path, pictures: Path) -> str:
    """Convert a notebook with its outputs to Markdown; write its pictures to a folder."""
    parts = []
    for number, cell in enumerate(read(path)["cells"]):
        if cell["cell_type"] == "markdown":
            parts.append(source_of(cell))
            continue
        parts.append(f"```python\n{source_of(cell)}\n```")
        for output in cell["outputs"]:
            data = output.get("data", {"text/plain": output.get("text", "")})
            kind = next((kind for kind in data if kind.startswith("image/")), None)
            if kind is not None:
                name = f"{path.stem}_{number}.{kind.removeprefix('image/')}"
                pictures.mkdir(parents=True, exist_ok=True)
                (pictures / name).write_bytes(base64.b64decode(data[kind]))
                parts.append(f"![Output of the cell]({pictures.name}/{name})")
            elif "text/html" in data:
                parts.append("".join(data["text/html"]))
            else:
                parts.append("```text\n" + "".join(data["text/plain"]).rstrip("\n") + "\n```")
    return "\n\n".join(parts) + "\n"


def main(names: Sequence[str]) -> None:
    for path in NOTEBOOKS:
        if not names or path.stem in names:
            print(path.name, flush=True)
            keep(path)


if __name__ == "__main__":
    main(sys.argv[1:])
