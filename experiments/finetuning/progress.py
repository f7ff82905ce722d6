"""Progress of a fine-tuning, ball by ball."""

from __future__ import annotations

import time
from typing import Any

from rich.console import Console

from experiments.config.finetuning import FineTuning
from experiments.finetuning.journal import AFTER, BEFORE, Entry
from experiments.progress import ProgressBar, seconds_left

NAMES = {BEFORE: "evaluation before", AFTER: "evaluation after"}


class FineTuningProgress(ProgressBar):
    """Counts balls. The remaining time is that of the balls still to play at the rate of this session."""

    def __init__(self, console: Console, name: str, planned: int, settings: FineTuning) -> None:
        super().__init__(console, name, planned, unit=" balls")
        self._updates = settings.updates
        self._counted = self._played = 0
        self._rate: float | None = None  # [s] per ball
        self._moment = time.monotonic()
        self._update_text = ""
        self._pausing = False

    def resumed(self, kept: int, attempts: int) -> None:
        """At the start: how many episodes are there already, and how many with the discarded ones."""
        self._counted, self._moment = kept, time.monotonic()
        if attempts:
            self.note(f"continues after {attempts:,} balls, {attempts - kept:,} of them discarded")

    def paused(self) -> None:
        if not self._pausing:
            self._pausing = True
            self.show(self._counted, "paused", plain=True)
        self._moment = time.monotonic()  # waiting says nothing of the rate

    def played(self, entry: Entry) -> None:
        """After every episode, discarded or not."""
        now = time.monotonic()
        self._pausing = False
        self._counted += not entry.discarded
        self._played += 1
        seconds, self._moment = now - self._moment, now
        self._rate = seconds if self._rate is None else self._rate + (seconds - self._rate) / min(self._played, 50)
        where = NAMES.get(entry.phase) or f"update {entry.update}/{self._updates}"
        outcome = f"fault: {entry.summary.fault}" if entry.summary.fault else entry.summary.outcome
        outcome = "discarded" if entry.discarded else outcome
        self.show(self._counted, f"{where}  {outcome}{self._update_text}  {self._left()} left", plain=False)

    def retracted(self) -> None:
        """After a ball that counted was discarded."""
        self._counted -= 1
        self.note("the ball before was discarded: it is played again")

    def updated(self, update: int, row: dict[str, Any]) -> None:
        """After every update with its row of measurements."""
        self._update_text = f"  mean return {row['mean_return']:.2f}, returned {row['return_rate']:.0%}"
        text = f"update {update}/{self._updates}{self._update_text}  {self._left()} left"
        self.show(self._counted, text, plain=True)

    def _left(self) -> str:
        return str(seconds_left((self._total - self._counted) * (self._rate or 0.0)))
