"""Pages in a real browser that is as narrow as a phone."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
WIDTH = 390  # [pixels]
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium")

_BEYOND = """() => [...document.querySelectorAll('body, body *')].filter(e => {
  const box = e.getBoundingClientRect();
  return e.tagName != 'IMG' && box.width > 0 && (box.right > innerWidth + 1 || box.left < -1);
}).map(e => e.tagName.toLowerCase() + ': ' + e.textContent.trim().slice(0, 40))"""


def beyond_the_edge(page: Path, width: int = WIDTH) -> list[str]:
    """Elements of a page, everything unfolded, that reach beyond a window of this width; a sideways scroll hides none.

    Pictures alone may scroll sideways, in a frame of their own: on a phone nobody reads their letters. They must
    have loaded, and letters be at least 9 pixels high.
    """
    from playwright.sync_api import sync_playwright  # not where the test is skipped

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        window = browser.new_page(viewport={"width": width, "height": 800})
        window.goto(page.absolute().as_uri())
        window.evaluate("() => document.querySelectorAll('details').forEach(d => { d.open = true })")
        assert window.evaluate("() => [...document.images].every(i => i.complete && i.naturalWidth > 0)")
        smallest = "() => Math.min(...[...document.querySelectorAll('p, td, li')].map(e => "
        assert window.evaluate(smallest + "parseFloat(getComputedStyle(e).fontSize)))") >= 9.0
        found = window.evaluate(_BEYOND)
        assert window.evaluate("() => document.documentElement.scrollWidth") <= width or found
        browser.close()
    return found
