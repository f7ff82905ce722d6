"""Progress of a training."""

from __future__ import annotations

from typing import Self

from rich.console import Console

from experiments.progress import ProgressBar, seconds_left


class TrainingProgress(ProgressBar):
    """Rates are those of this session; the remaining time assumes that they last."""

    def __init__(self, console: Console, name: str, updates: int, done: int, episodes_per_update: int) -> None:
        super().__init__(console, name, updates, done)
        self._updates, self._episodes_per_update = updates, episodes_per_update
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
        left = seconds_left((self._updates - update) / self._rate)
        text = f"{self._rate:.1f} updates/s  {episodes:,.0f} episodes/s  returned {return_rate:.1%}  {left} left"
        self.show(update, text)
