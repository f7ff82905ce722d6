"""A report's frame: tables and pictures in a browser as narrow as a phone, and what a row is there."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure

from mjx_tt.viz.html import WIDTH, Page, details, table
from tests.support.phone import CHROMIUM, beyond_the_edge, needs_browser
from tests.support.phone import WIDTH as PHONE

HEAD = ("parameter", "nominal", "estimate", "90 % interval", "unit", "what it says")


@pytest.fixture
def page(tmp_path):
    figure = Figure(figsize=(WIDTH, 3.0))
    figure.subplots().plot(np.arange(3))
    page = Page("A report", "of " + "a_very_long_name_without_a_space/" * 4, '<span class="badge">done</span>')
    page.section("one", "One")
    page.add(page.picture("line", figure, "A caption", "a line"))
    rows = [
        ("ball.flight.magnus_coefficient_of_a_long_name", "0.4700", "0.4713", "0.4650 to 0.4801", "1", "words " * 12)
    ] * 3
    page.add(table(HEAD, rows, (1, 2, 3)))
    page.add(
        table(("file", "SHA-256"), [("a_folder/of_many/names/log.csv", '<code class="hash">' + "ab" * 32 + "</code>")])
    )
    page.add(details("more", table(HEAD, rows)))
    return page.write(tmp_path / "page.html", tmp_path)[0]


@needs_browser
@pytest.mark.slow
@pytest.mark.parametrize("width", [PHONE, 1280])
def test_nothing_reaches_beyond_the_edge(page, width):
    assert beyond_the_edge(page, width) == []


@needs_browser
@pytest.mark.slow
def test_a_row_on_a_phone_is_a_block_whose_cells_say_their_column(page):
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        window = browser.new_page(viewport={"width": PHONE, "height": 800})
        window.goto(page.absolute().as_uri())
        cells = window.locator("table.many").first.locator("tbody tr").first.locator("td")
        boxes = [cells.nth(i).bounding_box() for i in range(len(HEAD))]
        assert all(a["y"] + a["height"] <= b["y"] + 1 for a, b in zip(boxes, boxes[1:], strict=False)), (
            "one below another"
        )
        shown = cells.nth(2).evaluate("e => getComputedStyle(e, '::before').content")
        assert "estimate" in shown
        assert window.locator("table.many thead").first.is_hidden()
        browser.close()
