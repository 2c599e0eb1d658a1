"""Headless Chromium (Debian's) for page tests, driven by Playwright. Requests of pages are recorded."""

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

__all__ = ["OpenedPage", "launch_browser", "open_page"]

CHROMIUM = Path("/usr/bin/chromium-headless-shell")
# WebGL without a graphics card.
ARGUMENTS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


@dataclass(frozen=True, eq=False)
class OpenedPage:
    """A page in a browser.

    Attributes:
        page: Playwright's.
        errors: errors and warnings on its console, and uncaught exceptions.
        requests: all URLs that it requested, except data URLs.
    """

    page: Page
    errors: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    def state(self, *names: str) -> Any:
        """Return the state that the page's script publishes, or the values of some of its names."""
        state = self.page.evaluate("() => window.sylpose.state()")
        return [state[name] for name in names] if names else state


@contextmanager
def launch_browser() -> Iterator[Browser]:
    """Launch the browser; without one the test is skipped, but not in continuous integration."""
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
def open_page(browser: Browser, url: str, *, online: bool = False, **options: Any) -> Iterator[OpenedPage]:
    """Load a page.

    Args:
        online: whether it may request anything but files.
        options: of the browser's context: `viewport`, `color_scheme`.
    """
    context = browser.new_context(**({"viewport": {"width": 1280, "height": 800}} | options))
    if not online:
        context.set_offline(True)
    context.set_default_timeout(60_000)  # for busy machines
    page = context.new_page()
    text = OpenedPage(page)
    page.on("request", lambda request: None if request.url.startswith("data:") else text.requests.append(request.url))
    page.on("pageerror", lambda error: text.errors.append(str(error)))
    page.on("console", lambda line: text.errors.append(line.text) if line.type in ("error", "warning") else None)
    try:
        page.goto(url)
        yield text
    finally:
        context.close()
