"""Progress on the screen: one line per stage with its seconds, and a bar for long work."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from datetime import timedelta
from typing import IO, Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

Stage = Callable[[str], AbstractContextManager[None]]
PLAIN_SECONDS = 10.0  # between lines where the output is no terminal


def make_console(file: IO[str] | None = None, width: int | None = None) -> Console:
    """A console that prints text as it is, without markup and colours of its own.

    Files and pipes get whole lines: only a terminal's width is one to break them at.
    """
    wraps = not (file or sys.stdout).isatty()
    return Console(file=file, width=width, markup=False, highlight=False, soft_wrap=wraps)


def print_files(console: Console, files: dict[str, object]) -> None:
    """A line for each file that there is, by what it is."""
    for name, file in files.items():
        if file:
            console.print(f"  {name:<11}{file}", soft_wrap=True)


def silent(_text: str) -> AbstractContextManager[None]:
    """A stage without a line."""
    return nullcontext()


def print_stages(console: Console, name: str) -> Stage:
    """Stages whose lines begin with ``name``: the text at the start, the seconds at the end."""

    @contextmanager
    def stage(text: str) -> Iterator[None]:
        console.print(f"{name}: {text} ...", end="", soft_wrap=True)
        began, end = time.monotonic(), ""
        try:
            yield
            end = f" {time.monotonic() - began:.1f} s"
        finally:
            console.print(end)

    return stage


class ProgressBar:
    """Progress towards ``total``: a live line in a terminal, now and then a plain line elsewhere."""

    def __init__(self, console: Console, name: str, total: int, done: int = 0, unit: str = "") -> None:
        self._console, self._name, self._total, self._done, self._unit = console, name, total, done, unit
        self._last = -PLAIN_SECONDS
        self._text = ""
        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(None),
            MofNCompleteColumn(),
            TextColumn("{task.fields[text]}", markup=False),
        )
        self._live = Progress(*columns, console=console, expand=True, disable=not console.is_terminal)

    def __enter__(self) -> Self:
        self._live.start()
        self._task = self._live.add_task(self._name, total=self._total, completed=self._done, text=self._text)
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def show(self, done: int, text: str, plain: bool | None = None) -> None:
        """Draws ``done`` and a text.

        plain: whether to print a line where there is no terminal; None: every 10 s and at the end.
        """
        self._done, self._text = done, text
        if self._console.is_terminal:
            self._live.update(self._task, completed=done, text=text)
            return
        now = time.monotonic()
        if now - self._last >= PLAIN_SECONDS or done == self._total if plain is None else plain:
            self._last = now
            self.note(f"{done:,}/{self._total:,}{self._unit}  {text}")

    def note(self, text: str) -> None:
        """Prints a line that stays."""
        self._console.print(f"{self._name}: {text}", soft_wrap=True)


class TrainingProgress(ProgressBar):
    """Of updates; rates are those of this session, and the remaining time assumes that they last."""

    def __init__(self, console: Console, name: str, updates: int, done: int, episodes_per_update: int) -> None:
        super().__init__(console, name, updates, done)
        self._episodes_per_update = episodes_per_update
        self._rate: float | None = None
        self._text = "compiling ..."

    def __enter__(self) -> Self:
        super().__enter__()
        if not self._console.is_terminal:
            self.note(self._text)
        return self

    def updated(self, update: int, updates: int, seconds: float, return_rate: float) -> None:
        """After a batch of ``updates`` that took ``seconds``, the last of which was ``update``."""
        rate = updates / seconds
        self._rate = rate if self._rate is None else 0.8 * self._rate + 0.2 * rate
        episodes = self._rate * self._episodes_per_update
        left = seconds_left((self._total - update) / self._rate)
        text = f"{self._rate:.1f} updates/s  {episodes:,.0f} episodes/s  returned {return_rate:.1%}  {left} left"
        self.show(update, text)


def seconds_left(seconds: float) -> timedelta:
    """A remaining time in whole seconds, to be shown."""
    return timedelta(seconds=round(seconds))
