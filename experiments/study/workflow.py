"""A study as a list of named steps: what is done is marked, what was killed begins again, what is left is estimated.

A step is done when the journal says so, what it made is there, and the steps whose files it read were done before it.
Steps write their files whole (or resume by themselves, as trainings do), and each draws its own keys from its name, so
a study killed at any moment ends as one that was left alone.
"""

from __future__ import annotations

import json
import os
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path

from rich.console import Console

from ballmodel.io.atomic_files import sync_folder
from experiments.errors import ExperimentError, RunError


class Waiting(ExperimentError):
    """A step that people do is not finished: the message says what is to be done before the same command goes on."""


@dataclass(frozen=True)
class Step:
    """One piece of a study.

    name     such as seed0/player1/is2r-sim1
    kind     steps of a kind take time in proportion to their ``work``
    inputs   files that it reads, outputs: files that it makes
    run      does it; the sentence that it returns is shown
    program  steps of one program wait for the first of them to compile it, when ``compiled`` is filled or it has ended
    """

    name: str
    kind: str
    work: float
    inputs: tuple[Path, ...]
    outputs: tuple[Path, ...]
    run: Callable[[], str]
    program: str | None = None
    compiled: Path | None = None


class Journal:
    """The finished steps in the order of their ends: one JSON line each, on the disk before the next step begins.

    Raises RunError for a line, other than an unfinished last one, that is no entry.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.entries = path, []
        lines = path.read_bytes().splitlines(keepends=True) if path.exists() else []
        whole = 0
        for i, line in enumerate(lines):
            try:
                entry = json.loads(line)
                entry["step"], entry["kind"], entry["work"], entry["seconds"]
            except (ValueError, KeyError, TypeError) as error:
                if i < len(lines) - 1:
                    raise RunError(f"{path}: line {i + 1} is no step ({error}); restore the file") from None
                break
            if not line.endswith(b"\n"):
                break
            self.entries.append(entry)
            whole += len(line)
        if path.exists():
            os.truncate(path, whole)

    def append(self, step: Step, seconds: float) -> None:
        """Marks a step as done. Raises OSError."""
        entry = {"step": step.name, "kind": step.kind, "work": step.work, "seconds": round(seconds, 2)}
        with open(self.path, "ab") as file:
            file.write(json.dumps(entry).encode() + b"\n")
            file.flush()
            os.fsync(file.fileno())
        sync_folder(self.path.parent)
        self.entries.append(entry)

    def index(self, step: Step) -> int | None:
        """Index of the step's last mark; None without one."""
        return max((i for i, entry in enumerate(self.entries) if entry["step"] == step.name), default=None)

    def seconds_per_work(self) -> dict[str, float]:
        """Median of the seconds that a unit of work of each kind took so far, all sessions together: the first steps of
        a kind compile besides."""
        rates: dict[str, list[float]] = {}
        for entry in self.entries:
            if entry["work"]:
                rates.setdefault(entry["kind"], []).append(entry["seconds"] / entry["work"])
        return {kind: statistics.median(each) for kind, each in rates.items()}


def list_unfinished(steps: list[Step], journal: Journal) -> list[Step]:
    """The steps that are still to be done, in their order."""
    makers = {path: step for step in steps for path in step.outputs}
    left: list[Step] = []
    for step in steps:
        mark = journal.index(step)
        sources = {makers[path].name: makers[path] for path in step.inputs if path in makers}.values()
        stale = any(source in left or (journal.index(source) or 0) > (mark or 0) for source in sources)
        if mark is None or stale or not all(path.exists() for path in step.outputs):
            left.append(step)
    return left


def perform(step: Step) -> tuple[str, float]:
    """Does a step: its sentence, and how long it took [s].

    Raises what the step raises; RunError where an input is missing or an output was not made.
    """
    missing = [str(path) for path in step.inputs if not path.exists()]
    if missing:
        raise RunError(f"{step.name}: {', '.join(missing)} is missing, though the step that makes it is done")
    for path in step.outputs:
        path.parent.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    text = step.run()
    for path in step.outputs:
        if not path.exists():
            raise RunError(f"{step.name}: did not make {path}")
    return text, time.monotonic() - began


class Session:
    """Steps of one session, marked and announced as they end; ``left`` are those still to be done, in their order."""

    def __init__(self, steps: list[Step], journal: Journal, console: Console, processes: int = 1) -> None:
        self._journal, self._console, self._processes = journal, console, processes
        self.left, self._total = list_unfinished(steps, journal), len(steps)
        done = self._total - len(self.left)
        if done:
            console.print(f"{done} of {self._total} steps were done before, {len(self.left)} are left", highlight=False)

    def mark(self, step: Step, text: str, seconds: float) -> None:
        """Marks a step that took ``seconds`` as done. Raises OSError."""
        self._journal.append(step, seconds)
        self.left.remove(step)
        number, rest = self._total - len(self.left), estimate_remaining(self.left, self._journal, self._processes)
        line = f"[{number}/{self._total}] {step.name}: {text}  ({seconds:.1f} s; {rest})"
        self._console.print(line, highlight=False, soft_wrap=True, markup=False)


def run_all(steps: list[Step], journal: Journal, console: Console) -> None:
    """Does what is not done yet, one step after the other. Raises what a step raises, and what ``perform`` does."""
    session = Session(steps, journal, console)
    for step in list(session.left):
        session.mark(step, *perform(step))


def estimate_remaining(steps: list[Step], journal: Journal, processes: int = 1) -> str:
    """An estimate in words of how long these steps take, from what others of their kinds took."""
    rates = journal.seconds_per_work()
    known = sum(rates[step.kind] * step.work for step in steps if step.kind in rates) / processes
    unknown = sorted({step.kind for step in steps} - rates.keys())
    if unknown:
        return f"at least {timedelta(seconds=round(known))} left, not yet timed: {', '.join(unknown)}"
    return f"about {timedelta(seconds=round(known))} left"
