"""Build the documentation as a static site.

    python -m pages.build [--out site]

Pages are the Markdown files of docs/ and of the repository, the notebooks and the API, in the order of pages/nav.toml.
They are first copied to one folder with adapted links; they contain no syntax of one generator. Sphinx (with MyST, which
reads GitHub's Markdown) builds the site, and stops at a dead link.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import sys
import tomllib
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

import sylpose
from pages import api, notebooks

__all__ = ["REPOSITORY", "build", "navigation", "stage"]

REPOSITORY = Path(__file__).resolve().parent.parent
NAV = Path(__file__).with_name("nav.toml")
# Files of the pages that are not in docs/, by name.
ELSEWHERE = {path.stem.lower(): path for path in sorted(REPOSITORY.glob("*.md")) if path.stem != "README"}
# Nominal paths of generated pages, to which their links are relative.
MADE = {"api": REPOSITORY / "pages" / "api.md"}
# In Markdown outside of code: [text](target) and ![text](target).
LINK = re.compile(r"(\]\()([^)\s]+)(\))")
CONF = """project = "sylpose"
version = release = {version!r}
extensions = ["myst_parser"]
myst_heading_anchors = 4
html_theme = "furo"
html_title = "sylpose {version}"
html_copy_source = html_show_sourcelink = html_show_copyright = False
# Pygments lacks some languages, and fails at the first line of OpenCV's YAML.
suppress_warnings = ["misc.highlighting_failure"]
"""


def sources() -> dict[str, Path]:
    """Return the source files of all pages by name."""
    docs = REPOSITORY / "docs"
    pages = {path.relative_to(docs).with_suffix("").as_posix(): path for path in sorted(docs.rglob("*.md"))}
    pages |= {f"notebooks/{path.stem}": path for path in notebooks.NOTEBOOKS}
    return {"index": REPOSITORY / "README.md", **ELSEWHERE, **pages, **MADE}


def navigation() -> list[tuple[str, list[str]]]:
    """Return the sections of nav.toml with their existing pages; other pages come last.

    Raises:
        ValueError: a page is listed twice.
    """
    known = sources()
    sections = [(s["title"], s["pages"]) for s in tomllib.loads(NAV.read_text(encoding="utf-8"))["section"]]
    named = [page for _, pages in sections for page in pages]
    if twice := sorted({page for page in named if named.count(page) > 1}):
        raise ValueError(f"{NAV}: {', '.join(twice)} twice")
    rest = [page for page in known if page not in named and page != "index"]
    found = [(title, [page for page in pages if page in known]) for title, pages in sections]
    return [*found, *([("More", rest)] if rest else [])]


def stage(folder: Path) -> None:
    """Copy all pages, pictures and files to a folder, with adapted links.

    Raises:
        ValueError: a link's target does not exist; the message names the page.
    """
    pages = sources()
    at = {path.resolve(): name for name, path in pages.items()}
    shutil.copytree(REPOSITORY / "docs" / "images", folder / "images")
    for name, path in pages.items():
        page = folder / f"{name}.md"
        page.parent.mkdir(parents=True, exist_ok=True)
        if name == "api":
            text = api.markdown()
        elif path.suffix == ".ipynb":
            text = notebooks.as_markdown(path, page.parent / "pictures")
        else:
            text = path.read_text(encoding="utf-8")
        page.write_text(_relinked(text, name, path, at, folder), encoding="utf-8")


def _relinked(text: str, name: str, path: Path, at: Mapping[Path, str], folder: Path) -> str:
    """Adapt a page's links to the folder; copy targets that are no pages or pictures to files/."""

    def link(match: re.Match[str]) -> str:
        target, _, anchor = match[2].partition("#")
        if not target or "://" in match[2] or (folder / name).parent.joinpath(target).is_file():
            return match[0]
        wanted = (path.parent / target).resolve()
        if not wanted.exists() or not wanted.is_relative_to(REPOSITORY):
            raise ValueError(f"{path.name}: a link to {target}, which is not there")
        if wanted in at:
            goal = f"{at[wanted]}.md"
        elif wanted.is_relative_to(REPOSITORY / "docs" / "images"):
            goal = f"images/{wanted.name}"
        else:
            goal = _copied(wanted, folder)
        relative = os.path.relpath(folder / goal, (folder / name).parent)
        return f"{match[1]}{Path(relative).as_posix()}{'#' + anchor if anchor else ''}{match[3]}"

    parts = re.split(r"(?ms)(^ *```.*?^ *```$)", text)
    return "".join(part if part.lstrip().startswith("```") else LINK.sub(link, part) for part in parts)


def _copied(file: Path, folder: Path) -> str:
    """Copy a file for download, or write a list of a folder's files; return its path."""
    goal = Path("files") / file.relative_to(REPOSITORY)
    (folder / goal).parent.mkdir(parents=True, exist_ok=True)
    if file.is_dir():
        goal = goal.with_name(f"{goal.name}.txt")
        inside = sorted(
            path.relative_to(file).as_posix() for path in file.rglob("*") if path.suffix in (".py", ".ipynb")
        )
        (folder / goal).write_text("\n".join(inside) + "\n", encoding="utf-8")
    else:
        shutil.copy(file, folder / goal)
    return goal.as_posix()


def build(out: Path) -> None:
    """Build the site in a folder, which is replaced.

    Raises:
        RuntimeError: Sphinx failed; its messages are on stderr.
    """
    from sphinx.cmd.build import build_main

    with TemporaryDirectory() as temporary:
        folder = Path(temporary) / "pages"
        folder.mkdir()
        stage(folder)
        (folder / "conf.py").write_text(CONF.format(version=sylpose.__version__), encoding="utf-8")
        trees = [
            f"```{{toctree}}\n:hidden:\n:caption: {title}\n\n" + "\n".join(pages) + "\n```"
            for title, pages in navigation()
        ]
        with (folder / "index.md").open("a", encoding="utf-8") as index:
            index.write("\n\n" + "\n\n".join(trees) + "\n")
        made = Path(temporary) / "site"
        if build_main(["-q", "-W", "--keep-going", "-d", str(Path(temporary) / "trees"), str(folder), str(made)]):
            raise RuntimeError("the site could not be made: see the messages above")
        shutil.rmtree(out, ignore_errors=True)
        shutil.move(made, out)


def main() -> None:
    parser = argparse.ArgumentParser(description="Build the documentation as a static site.")
    parser.add_argument("--out", type=Path, default=REPOSITORY / "site", help="output folder, which is replaced")
    asked = parser.parse_args()
    try:
        build(asked.out)
    except (ValueError, RuntimeError) as error:
        sys.exit(f"pages: {error}")
    print(f"{asked.out / 'index.html'}")


if __name__ == "__main__":
    main()
