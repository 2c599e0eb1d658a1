"""A headless browser for the pages, and what goes wrong in it; tests that need one skip where there is none."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import pytest

__all__ = ["Opened", "opened", "started"]

PROGRAMS = ("chromium-headless-shell", "chromium", "google-chrome")
# WebGL is drawn by the processor, so that it is the same everywhere.
ARGUMENTS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


@dataclass(frozen=True)
class Opened:
    """A page, what its console said that is an error, and the addresses that it asked for."""

    page: Any
    errors: list[str] = field(default_factory=list)
    asked: list[str] = field(default_factory=list)


@contextmanager
def started() -> Iterator[Any]:
    """A browser, which takes a second or two to start; what `tests/conftest.py` gives as `browser`."""
    playwright = pytest.importorskip("playwright.sync_api", reason="pages are tested with playwright")
    program = next(filter(None, map(shutil.which, PROGRAMS)), None)
    if program is None:
        pytest.skip(f"no browser here: {', '.join(PROGRAMS)}")
    with playwright.sync_playwright() as running:
        browser = running.chromium.launch(executable_path=program, args=ARGUMENTS)
        yield browser
        browser.close()


@contextmanager
def opened(browser: Any, url: str, *, width: int = 1200, height: int = 900, dark: bool = False) -> Iterator[Opened]:
    """A page of its own in it, which is closed at the end."""
    scheme = "dark" if dark else "light"
    found = Opened(browser.new_page(viewport={"width": width, "height": height}, color_scheme=scheme))
    found.page.on("console", lambda said: found.errors.append(said.text) if said.type == "error" else None)
    found.page.on("pageerror", lambda error: found.errors.append(str(error)))
    found.page.on("request", lambda request: found.asked.append(request.url))
    found.page.goto(url)
    yield found
    found.page.close()
