"""The journal of fine-tuning: one JSON line per episode, on the disk before the next ball is played.

Everything but their order is in the lines: parameters, curves and the human's balls can be made from them again. A ball
that is discarded after its line was written has a second one. Each line ends in a checksum of everything before it in
the file, so that a line that was changed, doubled or taken out is noticed. Lines without one, of journals that were
begun before there were checksums, are covered by the next that has one.
"""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments.errors import RunError
from experiments.runs import lines
from robot_io.control.episode import EpisodeSummary

BEFORE, TRAINING, AFTER = "before", "training", "after"
PHASES = (BEFORE, TRAINING, AFTER)
_CHECKSUM = re.compile(rb', "checksum": "([0-9a-f]{16})"}\n$')


@dataclass(frozen=True)
class Entry:
    """One episode.

    phase       "training", or the evaluation "before" or "after" it
    update      whose members are compared, from 1; in an evaluation the updates done before it
    member      0..2N-1: theta + sigma delta_i for i < N, theta - sigma delta_(i - N) above; 0 in an evaluation
    repeat      of the member; in an evaluation the number of the ball
    episode     number given to the robot; it never comes twice in a phase
    summary     what happened
    terms       reward terms by name, unweighted
    returns     weighted sum of the terms
    discarded   to be played again
    trajectory  (n, 4) measured ball: t [s], x, y, z [m]
    """

    phase: str
    update: int
    member: int
    repeat: int
    episode: int
    summary: EpisodeSummary
    terms: dict[str, float]
    returns: float
    discarded: bool
    trajectory: np.ndarray

    @property
    def slot(self) -> tuple[str, int, int, int]:
        """The part of the fine-tuning that the episode was played for."""
        return self.phase, self.update, self.member, self.repeat


class Journal:
    """Appends entries to a file and reads back what an earlier session left there.

    A last line that was not finished when the power went is dropped. Raises RunError for any other line that is no
    entry or does not follow the lines before it: the file was changed by someone.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.entries: list[Entry] = []
        self._lines, self._sealed = 0, False  # lines so far, and whether they have checksums
        self._digest = hashlib.sha256()  # of all lines
        lines.read(path, self._take_line, "episode")

    def append(self, entry: Entry) -> None:
        """Adds an entry; it is on the disk when this returns. Raises OSError when the disk refuses."""
        line = self._checked(json.dumps(_to_json(entry), allow_nan=False).encode())
        lines.append(self.path, line)
        self._lines += 1
        self._digest.update(line)
        self._take(entry)

    def _take(self, entry: Entry) -> None:
        """A line about the episode before, which was discarded late, stands in its place."""
        if self.entries and (self.entries[-1].phase, self.entries[-1].episode) == (entry.phase, entry.episode):
            self.entries.pop()
        self.entries.append(entry)

    def _checked(self, content: bytes) -> bytes:
        """The line of a JSON object: with the checksum of the lines before it and of itself."""
        digest = self._digest.copy()
        digest.update(content)
        return content[:-1] + f', "checksum": "{digest.hexdigest()[:16]}"}}\n'.encode()

    def _take_line(self, line: bytes) -> None:
        self._sealed |= _CHECKSUM.search(line) is not None
        if self._sealed and line != self._checked(_CHECKSUM.sub(b"}", line)):
            raise RunError(
                f"{self.path}: line {self._lines + 1} was changed, or lines before it were changed, doubled or taken "
                "out; restore the file or start a new run"
            )
        self._take(_from_json(json.loads(line)))
        self._lines += 1
        self._digest.update(line)


def _to_json(entry: Entry) -> dict[str, Any]:
    data = asdict(entry) | {"trajectory": entry.trajectory.tolist()}
    return {"return" if name == "returns" else name: value for name, value in data.items()}


def _from_json(data: dict[str, Any]) -> Entry:
    summary = dict(data.pop("summary"))
    summary |= {name: tuple(value) for name, value in summary.items() if isinstance(value, list)}
    trajectory = np.array(data.pop("trajectory"), float).reshape(-1, 4)
    data.pop("checksum", None)
    return Entry(summary=EpisodeSummary(**summary), returns=data.pop("return"), trajectory=trajectory, **data)
