"""A real headless Chromium for the tests of the annotating page."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

CHROMIUM = ("chromium", "chromium-browser", "google-chrome", "chrome")
PATIENCE_S = 30.0


@contextmanager
def chromium() -> Iterator[Browser]:
    """Start the browser of playwright, or the system's own; skip where there is neither."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with playwright.sync_playwright() as driver:
        own = Path(driver.chromium.executable_path)
        path = own if own.exists() else next((p for n in CHROMIUM if (p := shutil.which(n))), None)
        if path is None:
            pytest.skip("no Chromium: playwright install chromium, or the system's package")
        browser = driver.chromium.launch(executable_path=str(path), args=["--no-sandbox"])
        try:
            yield browser
        finally:
            browser.close()


def until(page: Page, condition: str) -> Any:
    """Return the value of a JavaScript expression once it is true.

    Playwright's own ``wait_for_function`` evaluates text in the page, which the page's policy forbids.
    """
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        if value := page.evaluate(f"() => {condition}"):
            return value
    raise AssertionError(f"not within {PATIENCE_S} s: {condition}")


def opened(browser: Browser, address: str, size: tuple[int, int] = (1400, 800)) -> Page:
    """Open the annotating page and wait until its open channels are read; errors of the page fail the test."""
    page = browser.new_page(viewport={"width": size[0], "height": size[1]})
    page.on("pageerror", lambda error: page.evaluate("e => { window.failed = e }", str(error)))
    page.goto(address)
    until(
        page,
        "window.marcha && marcha.channels.size > 0 && [...marcha.channels.values()].every(c => c.complete)",
    )
    return page
