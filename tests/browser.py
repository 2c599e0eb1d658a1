"""A browser for the tests of pages: Debian's headless Chromium, driven by Playwright. What pages ask for is kept."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

__all__ = ["Opened", "launched", "opened"]

CHROMIUM = Path("/usr/bin/chromium-headless-shell")
# WebGL without a graphics card.
ARGUMENTS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


@dataclass(frozen=True, eq=False)
class Opened:
    """A page in a browser.

    Attributes:
        page: Playwright's.
        errors: what it said on its console that was an error or a warning, and exceptions that nobody caught.
        requests: all URLs that it asked for, but for data within itself.
    """

    page: Page
    errors: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    def state(self, *names: str) -> Any:
        """What the page's script says of itself, or the values of some of its names."""
        state = self.page.evaluate("() => window.sylpose.state()")
        return [state[name] for name in names] if names else state


@contextmanager
def launched() -> Iterator[Browser]:
    """The browser; the test is skipped where there is none, but not in continuous integration."""
    missing = "" if os.access(CHROMIUM, os.X_OK) else f"{CHROMIUM}: no such browser (`make browser`, on Debian)"
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        missing = "playwright is not installed"
    if missing:
        assert os.environ.get("CI") != "true", missing
        pytest.skip(missing)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=str(CHROMIUM), args=ARGUMENTS)
        try:
            yield browser
        finally:
            browser.close()


@contextmanager
def opened(browser: Browser, url: str, *, online: bool = False, **options: Any) -> Iterator[Opened]:
    """A page, loaded.

    Args:
        online: whether it may ask for anything but files.
        options: of the browser's context: `viewport`, `color_scheme`.
    """
    context = browser.new_context(**({"viewport": {"width": 1280, "height": 800}} | options))
    if not online:
        context.set_offline(True)
    context.set_default_timeout(60_000)  # of a busy machine
    page = context.new_page()
    said = Opened(page)
    page.on("request", lambda request: None if request.url.startswith("data:") else said.requests.append(request.url))
    page.on("pageerror", lambda error: said.errors.append(str(error)))
    page.on("console", lambda line: said.errors.append(line.text) if line.type in ("error", "warning") else None)
    try:
        page.goto(url)
        yield said
    finally:
        context.close()
