"""Scoring of rallies: the end-of-rally table, "top 60, then top 50", and the file that keeps every rally.

Abeyruwan et al. 2022, Details on Rally Score Evaluations: rallies whose end the table marks "Filter" are removed; of
the others the "top 60" are taken and sorted by length, and the 50 longest of these are reported. Both numbers matter
only if the 60 are the first in the order of play, so that is how they are read here. Of fewer than 60 the same share is
reported, five sixths: to take 50 of 52 and 50 of 60 would favour the policy that has more rallies to drop.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from experiments.errors import ConfigError, error_context
from experiments.runs import run_dir
from mjx_tt.rally.end_reasons import ROWS, End

POOL = 60
KEEP = 50
FILTERED = frozenset(end for end, _, _, filtered in ROWS if filtered)
ROBOT_ENDED = {end: ended for end, _, ended, _ in ROWS}
NUMBERS = {str(number): end for number, (end, *_) in enumerate(ROWS, 1)}
"""End by its number on a scoring sheet, that of the row in the paper's table."""
UNKNOWN = -1  # whether the robot ended the rally, where the table has no entry
COLUMNS = tuple("seed trainer evaluator model blind rally length end robot_ended filtered selected".split())
KINDS = (int, object, object, object, object, int, int, int, int, bool, bool)
DTYPE = [*zip(COLUMNS, KINDS, strict=True), ("pooled", bool)]


def parse_end(text: str) -> End:
    """The end by its row's number (from 1; the first 15 are the paper's) or by its name.

    Raises ValueError listing what is allowed.
    """
    text = str(text).strip()
    if text in NUMBERS:
        return NUMBERS[text]
    try:
        return End[text.upper()]
    except KeyError:
        names = ", ".join(end.name.lower() for end, *_ in ROWS)
        raise ValueError(f"{text!r} is no end of a rally; 1 to {len(ROWS)} are allowed, or {names}") from None


def count_reported(pooled: int) -> int:
    """Number of rallies that are reported of a pool of so many: five sixths, 50 of 60."""
    return round(pooled * KEEP / POOL)


def choose_pool(filtered: ArrayLike) -> np.ndarray:
    """(n,) bool, the rallies of one evaluation among which the longest are reported: the first 60 that count."""
    counted = ~np.asarray(filtered, bool)
    return counted & (np.cumsum(counted) <= POOL)


def choose_reported(length: ArrayLike, filtered: ArrayLike) -> np.ndarray:
    """(n,) bool, the rallies that are reported, of one evaluation's in the order of play.

    length: (n,) touches; filtered: (n,) bool. Of the pool the longest five sixths; of equal lengths the earlier.
    """
    length, first = np.asarray(length), np.flatnonzero(choose_pool(filtered))
    chosen = np.zeros(length.size, bool)
    chosen[first[np.argsort(-length[first], kind="stable")[: count_reported(first.size)]]] = True
    return chosen


class Rallies(np.recarray):
    """Rallies of any number of evaluations, with the columns of DTYPE.

    robot_ended is 1, 0 or UNKNOWN; length counts the paddle touches of human and robot; pooled: among the first 60 of
    an evaluation that count, of which the longest are ``selected``.
    """

    def take(self, where: np.ndarray) -> Rallies:  # type: ignore[override]
        """The rallies at a mask or at indices."""
        return self[where]

    @property
    def own(self) -> np.ndarray:
        """(n,) bool: played by the policy's own trainer."""
        return self.trainer == self.evaluator


def score_rallies(
    seed: int,
    trainer: str,
    evaluator: str,
    model: str,
    blind: str,
    length: ArrayLike,
    end: ArrayLike,
    rally: ArrayLike | None = None,
) -> Rallies:
    """One evaluation's rallies, in the order of play.

    length: (n,) touches; end: (n,) End; rally: (n,) their numbers, from 0 by default.
    """
    length, end = np.asarray(length, int), np.asarray(end, int)
    rallies = np.recarray(length.size, DTYPE).view(Rallies)
    for name, value in zip(COLUMNS, (seed, trainer, evaluator, model, blind), strict=False):
        rallies[name] = value
    rallies.length, rallies.end = length, end
    rallies.rally = np.arange(length.size) if rally is None else rally
    ended = [ROBOT_ENDED.get(End(e)) for e in end.tolist()]
    rallies.robot_ended = [UNKNOWN if e is None else int(e) for e in ended]
    rallies.filtered = np.isin(end, [int(e) for e in FILTERED])
    rallies.pooled = choose_pool(rallies.filtered)
    rallies.selected = choose_reported(length, rallies.filtered)
    return rallies


def join(parts: Iterable[Rallies]) -> Rallies:
    """Rallies one after the other; without any, an empty one."""
    return np.concatenate([np.recarray(0, DTYPE), *parts]).view(Rallies)


def write(path: Path, rallies: Rallies) -> None:
    """Writes evaluations.csv, one line a rally; the end by its name."""
    columns = {name: getattr(rallies, name).tolist() for name in COLUMNS}
    columns["end"] = [End(e).name.lower() for e in columns["end"]]
    columns["robot_ended"] = ["" if e == UNKNOWN else e for e in columns["robot_ended"]]
    for name in ("filtered", "selected"):
        columns[name] = [int(flag) for flag in columns[name]]
    run_dir.write_csv(path, COLUMNS, zip(*columns.values(), strict=True))


def read(path: Path) -> Rallies:
    """Reads evaluations.csv. What counts follows from lengths and ends, so a sheet edited by hand is scored anew.

    Raises ConfigError naming file and line.
    """
    evaluations: dict[tuple[int, str, str, str, str], list[tuple[int, int, End]]] = {}
    with error_context(str(path)), open(path, newline="", encoding="utf-8-sig") as file:
        rows = list(csv.DictReader(file, restval=""))
    for number, row in enumerate(rows, 2):
        try:
            group = (int(row["seed"]), row["trainer"], row["evaluator"], row["model"], row["blind"])
            played = (int(row["rally"]), int(row["length"]), End[row["end"].strip().upper()])
            if not all(group[1:4]) or played[1] < 0:
                raise ValueError("names and lengths are needed")
        except (KeyError, ValueError) as error:
            wanted = f"wanted are {', '.join(COLUMNS[:8])}, an end as {', '.join(e.name.lower() for e in End)}"
            raise ConfigError(f"{path}: line {number}: {error}; {wanted}") from None
        evaluations.setdefault(group, []).append(played)
    parts = []
    for group, played_ones in evaluations.items():
        numbers, lengths, ends = zip(*sorted(played_ones, key=lambda p: p[0]), strict=True)
        parts.append(score_rallies(*group, lengths, ends, numbers))
    return join(parts)
