"""Display of a running training: a live line in a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from datetime import timedelta

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

PLAIN_SECONDS = 10.0  # between lines when the output is no terminal


class TrainingProgress:
    """Rates are those of this session; the remaining time assumes that they last."""

    def __init__(self, console: Console, name: str, updates: int, done: int, episodes_per_update: int) -> None:
        self._console, self._name, self._updates = console, name, updates
        self._episodes_per_update = episodes_per_update
        self._rate: float | None = None
        self._last_line = -PLAIN_SECONDS
        self._live = None
        if console.is_terminal:
            columns = (
                TextColumn("{task.description}"),
                BarColumn(None),
                MofNCompleteColumn(),
                TextColumn("{task.fields[text]}"),
            )
            self._live = Progress(*columns, console=console, expand=True)
            self._bar = self._live.add_task(name, total=updates, completed=done, text="compiling ...")

    def __enter__(self) -> TrainingProgress:
        if self._live:
            self._live.start()
        else:
            self._console.print(f"{self._name}: compiling ...", highlight=False)
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.stop()

    def show(self, update: int, updates: int, seconds: float, return_rate: float) -> None:
        """After a batch of ``updates`` that took ``seconds``, the last of which was ``update``."""
        rate = updates / seconds
        self._rate = rate if self._rate is None else 0.8 * self._rate + 0.2 * rate
        left = timedelta(seconds=round((self._updates - update) / self._rate))
        episodes = self._rate * self._episodes_per_update
        text = f"{self._rate:.1f} updates/s  {episodes:,.0f} episodes/s  returned {return_rate:.1%}  {left} left"
        if self._live:
            self._live.update(self._bar, completed=update, text=text)
        elif time.monotonic() - self._last_line >= PLAIN_SECONDS or update == self._updates:
            self._last_line = time.monotonic()
            self._console.print(f"{self._name}: {update}/{self._updates}  {text}", highlight=False, soft_wrap=True)

    def note(self, text: str) -> None:
        """A line that stays."""
        self._console.print(f"{self._name}: {text}", highlight=False, soft_wrap=True)
