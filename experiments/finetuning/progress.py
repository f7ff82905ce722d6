"""Display of a running fine-tuning: a live line in a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from datetime import timedelta
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from experiments.config.finetuning import FineTuning
from experiments.finetuning.journal import AFTER, BEFORE, Entry

NAMES = {BEFORE: "evaluation before", AFTER: "evaluation after"}


class FineTuningProgress:
    """Counts balls. The remaining time is that of the balls still to play at the rate of this session."""

    def __init__(self, console: Console, name: str, planned: int, settings: FineTuning) -> None:
        self._console, self._name, self._planned, self._settings = console, name, planned, settings
        self._done = self._played = 0
        self._rate: float | None = None  # [s] per ball that counts
        self._last = time.monotonic()
        self._update_text = ""
        self._pausing = False
        self._live = None
        if console.is_terminal:
            columns = (
                TextColumn("{task.description}", markup=False),
                BarColumn(None),
                MofNCompleteColumn(),
                TextColumn("{task.fields[text]}", markup=False),
            )
            self._live = Progress(*columns, console=console, expand=True)
            self._bar = self._live.add_task(name, total=planned, text="")

    def __enter__(self) -> FineTuningProgress:
        if self._live:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.stop()

    def resumed(self, kept: int, attempts: int) -> None:
        """At the start: how many episodes are there already, and how many with the discarded ones."""
        self._done, self._last = kept, time.monotonic()
        if attempts:
            self.note(f"continues after {attempts:,} balls, {attempts - kept:,} of them discarded")

    def paused(self) -> None:
        if not self._pausing:
            self._pausing = True
            self._line("paused", plain=True)
        self._last = time.monotonic()  # waiting says nothing of the rate

    def played(self, entry: Entry) -> None:
        """After every episode, discarded or not."""
        now = time.monotonic()
        self._pausing = False
        self._done += not entry.discarded
        self._played += 1
        seconds = now - self._last
        self._last = now
        self._rate = seconds if self._rate is None else self._rate + (seconds - self._rate) / min(self._played, 50)
        where = NAMES.get(entry.phase) or f"update {entry.update}/{self._settings.updates}"
        outcome = (
            "discarded"
            if entry.discarded
            else f"fault: {entry.summary.fault}"
            if entry.summary.fault
            else entry.summary.outcome
        )
        self._line(f"{where}  {outcome}{self._update_text}  {self._left()} left")

    def updated(self, update: int, row: dict[str, Any]) -> None:
        """After every update with its row of measurements."""
        self._update_text = f"  mean return {row['mean_return']:.2f}, returned {row['return_rate']:.0%}"
        if not self._live:
            self._line(f"update {update}/{self._settings.updates}{self._update_text}  {self._left()} left", plain=True)

    def note(self, text: str) -> None:
        """A line that stays."""
        self._console.print(f"{self._name}: {text}", highlight=False, soft_wrap=True, markup=False)

    def _left(self) -> timedelta:
        return timedelta(seconds=round((self._planned - self._done) * (self._rate or 0.0)))

    def _line(self, text: str, plain: bool = False) -> None:
        if self._live:
            self._live.update(self._bar, completed=self._done, text=text)
        elif plain:
            self.note(f"{self._done}/{self._planned} balls  {text}")
