"""Lines about stages, and progress where there is no terminal."""

from __future__ import annotations

import io

from rich.console import Console

from experiments.progress import ProgressBar


def test_without_a_terminal_progress_is_a_line_now_and_then_and_at_the_end():
    text = io.StringIO()
    with ProgressBar(Console(file=text), "run", 1200, unit=" balls") as bar:
        bar.show(1, "first")
        bar.show(2, "too soon")
        bar.show(3, "asked for", plain=True)
        bar.show(1200, "last")
        bar.show(1200, "not asked for", plain=False)
    assert text.getvalue().splitlines() == [
        "run: 1/1,200 balls  first",
        "run: 3/1,200 balls  asked for",
        "run: 1,200/1,200 balls  last",
    ]
