"""A study as a list of named steps: what is done is marked, what was killed begins again.

A step is done when the journal says so, what it made is there, and the steps whose files it read were done before it.
Steps write their files whole (or resume by themselves, as trainings do), and each draws its own keys from its name, so
a study killed at any moment ends as one that was left alone.
"""

from __future__ import annotations

import json
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from experiments.errors import ExperimentError, RunError
from experiments.runs import lines


class Waiting(ExperimentError):
    """A step that people do is not finished: the message says what is to be done before the same command goes on."""


@dataclass(frozen=True)
class Step:
    """One piece of a study.

    name     such as seed0/player1/is2r-sim1
    inputs   files that it reads, outputs: files that it makes
    run      does it; the sentence that it returns is shown
    program  steps of one program wait for the first of them to compile it, when ``compiled`` is filled or it has ended
    """

    name: str
    inputs: tuple[Path, ...]
    outputs: tuple[Path, ...]
    run: Callable[[], str]
    program: str | None = None
    compiled: Path | None = None


def derive_seed(name: str) -> int:
    """Seed of a step of that name."""
    return zlib.crc32(name.encode()) >> 1


class Journal:
    """The finished steps in the order of their ends: one JSON line each, on the disk before the next step begins.

    Raises RunError for a line, other than an unfinished last one, that is no entry.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.steps = path, list[str]()
        lines.read(path, lambda line: self.steps.append(json.loads(line)["step"]), "step")

    def append(self, name: str, seconds: float) -> None:
        """Marks a step as done. Raises OSError."""
        lines.append(self.path, json.dumps({"step": name, "seconds": round(seconds, 2)}).encode() + b"\n")
        self.steps.append(name)


def list_unfinished(steps: list[Step], journal: Journal) -> list[Step]:
    """The steps that are still to be done, in their order."""
    makers = {path: step.name for step in steps for path in step.outputs}
    marks = {name: i for i, name in enumerate(journal.steps)}  # of each step the last one
    left: dict[str, Step] = {}
    for step in steps:
        mark, sources = marks.get(step.name), {makers[path] for path in step.inputs if path in makers}
        stale = any(source in left or marks.get(source, 0) > (mark or 0) for source in sources)
        if mark is None or stale or not all(path.exists() for path in step.outputs):
            left[step.name] = step
    return list(left.values())


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
