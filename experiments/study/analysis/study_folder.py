"""A study's folder as data: rallies, ball logs, human models and balls; what is not there is named, not an error."""

from __future__ import annotations

import json
import reprlib
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ValidationError

from ballmodel import registry
from ballmodel.distribution import AXES, BallDistribution, load_distribution
from ballmodel.io.yaml import read as read_yaml
from experiments.errors import ConfigError
from experiments.runs.run_dir import CONFIG, Run
from experiments.study.analysis import effect_costs, scoring
from experiments.study.analysis.paper import BY_KEY, BY_SKILL, CROSS, FINAL, IDENTIFIED, IS2R, METHODS, TEN
from experiments.study.analysis.statistics import Models
from experiments.study.paths import EVALUATIONS, SESSIONS, SETTINGS, StudyPaths
from mjx_tt.rally.human_player import FOLDER as VIRTUAL_PLAYERS

ROUNDS = ("M0", "M1", "M2")
DATASETS = ("D0", "D1", "D2")
QUANTITIES = tuple(f"{part} {axis}" for part, axes in AXES.items() for axis in axes)
"""Quantities that a human model bounds: position and velocity at the start, landing point."""
NUMBERS = tuple(f"{quantity} {end}" for quantity in QUANTITIES for end in ("min", "max"))
"""Names of the 16 numbers of a human model."""


@dataclass(frozen=True)
class BallLog:
    """The human's balls of one evaluation, arrays with the n balls last.

    rally: (n,) its rally; touch: (n,) the touch that hit it; first: (n,) bool, begins a rally;
    position, velocity: (3, n) [m], [m/s] at the human's contact; landing: (2, n) [m] on the robot's side;
    hit, returned: (n,) bool; return_landing: (2, n) [m] where the robot's return came down, not finite where there is
    none
    """

    rally: np.ndarray
    touch: np.ndarray
    first: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    landing: np.ndarray
    hit: np.ndarray
    returned: np.ndarray
    return_landing: np.ndarray

    @property
    def features(self) -> np.ndarray:
        """(8, n) position, velocity and landing of the balls that land: what a human model bounds."""
        points = np.concatenate([self.position, self.velocity, self.landing])
        return points[:, np.isfinite(points).all(axis=0)]


LOG_ROWS = {name: 0 for name in BallLog.__dataclass_fields__} | {
    "position": 3,
    "velocity": 3,
    "landing": 2,
    "return_landing": 2,
}
"""Rows of the arrays of a BallLog; 0 for a plain list of balls."""


class _NumberRow(BaseModel, extra="allow"):
    player: str
    model: str
    deviation: float


class _RallyRow(BaseModel, extra="allow"):
    player: str
    statistic: str
    target: float
    reached: float


class _Calibration(BaseModel):
    """calibration.json: deviations of the virtual players' human models, and their rally lengths."""

    medians: dict[str, dict[str, float]] = {}
    numbers: list[_NumberRow] = []
    rallies: list[_RallyRow] = []


@dataclass
class StudyFolder:
    """Content of a study's folder. Every reader raises ConfigError for a damaged file.

    missing: what the study that its settings ask for would have besides, in words
    left_out: what its settings leave out of a whole study, in words
    """

    folder: Path
    settings: dict[str, Any]
    info: dict[str, Any]
    rallies: scoring.Rallies
    missing: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)

    @property
    def paths(self) -> StudyPaths:
        return StudyPaths(self.folder)

    @cached_property
    def seeds(self) -> tuple[int, ...]:
        """Seeds with evaluations or folders."""
        found = {int(path.name[4:]) for path in self.folder.glob("seed*") if path.name[4:].isdigit()}
        return tuple(sorted(found | set(self.rallies.seed.tolist())))

    @cached_property
    def players(self) -> tuple[str, ...]:
        """Players with evaluations or folders, from the lowest to the highest skill."""
        found = {path.name for path in self.folder.glob("seed*/player*")} | set(self.rallies.trainer.tolist())
        return tuple(p for p in BY_SKILL if p in found)

    def pick(
        self,
        models: Models | None = None,
        trainers: Models | None = None,
        own: bool | None = True,
        selected: bool = True,
    ) -> scoring.Rallies:
        """Rallies that count. own: by the trainer (True), by others (False), both (None); selected: reported ones."""
        r = self.rallies
        where = r.selected if selected else ~r.filtered
        for chosen, column in ((models, r.model), (trainers, r.trainer)):
            if chosen is not None:
                where = where & np.isin(column, [chosen] if isinstance(chosen, str) else list(chosen))
        if own is not None:
            where = where & (r.own == own)
        return r.take(where)

    def models_of(self, seed: int, player: str) -> dict[str, BallDistribution]:
        """The human models that were fitted: of M0, M1, M2 those that are there."""
        found = {}
        for name in ROUNDS:
            path = self.paths.human(seed, player, name)
            if path.exists():
                with _reading(path):
                    found[name] = load_distribution(path)
        return found

    def log(self, seed: int, trainer: str, evaluator: str, model: str) -> BallLog | None:
        """The balls of an evaluation; None where there is no file."""
        path = self.paths.evaluation_log(seed, trainer, evaluator, model)
        if not path.exists():
            return None
        with _reading(path):
            return _ball_log(path)

    def logs(self, trainer: str, model: str) -> list[BallLog]:
        """The logs of a policy with its own trainer, of all seeds."""
        found = (self.log(seed, trainer, trainer, model) for seed in self.seeds)
        return [log for log in found if log is not None]

    def metrics(self, seed: int, player: str, model: str) -> list[dict[str, Any]]:
        """The rows of a policy's training or fine-tuning, one per update; none where there is no file.

        An unfinished last line is left out: the run may be under way.
        """
        path = Run(self.paths.model(seed, player, model)).metrics
        if not path.exists():
            return []
        with _reading(path):
            return _metric_rows(path)

    @cached_property
    def calibration(self) -> dict[str, Any]:
        """calibration.json of the folder, or the shipped one of the virtual players; empty with people."""
        path = self.folder / "calibration.json"
        if not path.exists():
            if not self.settings or self.settings.get("robot") is not None:
                return {}
            path = VIRTUAL_PLAYERS / "calibration.json"
        with _reading(path):
            content = json.loads(path.read_bytes())
            try:
                _Calibration.model_validate(content)
            except ValidationError as error:
                first = error.errors()[0]
                place = ".".join(map(str, first["loc"])) or "the file"
                raise ValueError(f"{place}: {first['msg']}, got {reprlib.repr(first['input'])}") from None
            return content

    @cached_property
    def effects(self) -> list[effect_costs.Outcome]:
        """Rallies in realities that lack something."""
        return [o for path in sorted(self.folder.glob(f"seed*/{effect_costs.FILE}")) for o in effect_costs.read(path)]

    @cached_property
    def realities(self) -> dict[int, Any]:
        """The opened realities by seed."""
        found = {}
        for seed in self.seeds:
            path = self.paths.seed(seed) / "reality.yaml"
            if path.exists():
                with _reading(path):
                    found[seed] = read_yaml(path)
        return found


def numbers(distribution: BallDistribution) -> np.ndarray:
    """(16,) the numbers of a human model in the order of NUMBERS."""
    ends = [[v for part in AXES for v in getattr(distribution, f"{part}_{end}")] for end in ("min", "max")]
    return np.array(ends).T.ravel()


def paper_models(player: str) -> dict[str, BallDistribution]:
    """The paper's M0, M1 and M2 of a player."""
    return {name: registry.load(f"{player}/{name}") for name in ROUNDS}


def widths(models: dict[str, BallDistribution]) -> np.ndarray:
    """(16,) the width of each quantity over all given models, the same for its minimum and its maximum."""
    table = np.array([numbers(m) for m in models.values()]).reshape(len(models), -1, 2)
    return np.repeat(table[:, :, 1].max(0) - table[:, :, 0].min(0), 2)


def changes_of(models: dict[str, BallDistribution]) -> tuple[float, float]:
    """Changes M0 to M1 and M1 to M2: mean over the 16 numbers, in units of each quantity's width over the models."""
    scale, (m0, m1, m2) = widths(models), (numbers(models[name]) for name in ROUNDS)
    return float(np.mean(np.abs(m1 - m0) / scale)), float(np.mean(np.abs(m2 - m1) / scale))


def load(folder: Path) -> StudyFolder:
    """Reads a study's folder, whole or partial.

    Raises ConfigError where there is nothing to report on, and for a file that is damaged.
    """
    folder = Path(folder)
    evaluated, asked, sessions = (folder / name for name in (EVALUATIONS, SETTINGS, SESSIONS))
    if not evaluated.exists() and not asked.exists():
        raise ConfigError(f"{folder}: is no study: neither {SETTINGS} nor {EVALUATIONS} is there{_suggestion(folder)}")
    rallies = scoring.read(evaluated) if evaluated.exists() else scoring.join([])
    settings, info = _mapping_of(asked), _mapping_of(sessions)
    known, unknown = _known(rallies)
    study = StudyFolder(folder, settings, info, rallies.take(known))
    if not study.players:
        if unknown:
            raise ConfigError(f"{evaluated}: the figures have no place for any of its rallies: {'; '.join(unknown)}")
        raise ConfigError(f"{folder}: nothing to report on yet: there is no player's folder and no rally")
    models, cross, study.left_out = _asked_for(settings)
    study.missing = [*(f"a place for rallies with {which}" for which in unknown), *_missing(study, models, cross)]
    return study


def _suggestion(folder: Path) -> str:
    """A clause that says what to do with a folder that is no study."""
    runs = [path.parent for path in sorted([*folder.glob(CONFIG), *folder.glob(f"*/{CONFIG}")])]
    if not runs:
        return "" if folder.is_dir() else "; there is no such folder"
    return f"; it holds ordinary training, on which `mjx-tt evaluate {runs[0]}` reports"


def _asked_for(settings: dict[str, Any]) -> tuple[tuple[str, ...], bool, list[str]]:
    """Models of the paper and of the identification that a study makes, whether others play them, what it leaves out.

    Without settings, those of the paper.
    """
    baselines = settings.get("baselines", True)
    models = {True: TEN, False: ()}.get(baselines, tuple(m.key for m in METHODS[IS2R]))
    left_out = list(dict.fromkeys(BY_KEY[key].method for key in TEN if key not in models))
    cross = (settings.get("evaluation") or {}).get("cross", True)
    if not cross:
        left_out.append("rallies with players who did not train the policy")
    if settings.get("identification") is not None:
        models += tuple(model.key for model in METHODS[IDENTIFIED])
    return models, cross, left_out


def _missing(study: StudyFolder, models: tuple[str, ...], cross: bool) -> list[str]:
    """Parts that a study lacks of those models and cross-evaluations, in words."""
    out = []
    absent = [p for p in BY_SKILL if p not in study.players]
    if absent:
        out.append(f"players {', '.join(absent)}")
    r = study.rallies
    evaluations = list(zip(*(a.tolist() for a in (r.seed, r.trainer, r.evaluator, r.model)), strict=True))
    there = set(evaluations)
    for seed in study.seeds:
        for player in study.players:
            lacking = [m for m in models if (seed, player, player, m) not in there]
            if lacking:
                count = "ten" if models == TEN else str(len(models))
                what = f"all {count} models" if len(lacking) == len(models) else ", ".join(lacking)
                out.append(f"seed {seed}, {player}: evaluation of {what}")
            others = [e for e in CROSS[player] if any((seed, player, e, m) not in there for m in FINAL)]
            if others and cross:
                out.append(f"seed {seed}, {player}: cross-evaluation by {', '.join(others)}")
            fitted = study.models_of(seed, player)
            if len(fitted) < len(ROUNDS) and "is2r-sim1" in models:
                out.append(f"seed {seed}, {player}: human model {', '.join(m for m in ROUNDS if m not in fitted)}")
    counted = Counter({key: 0 for key in evaluations})
    counted.update(key for key, filtered in zip(evaluations, r.filtered.tolist(), strict=True) if not filtered)
    short = [
        f"seed {seed}, {trainer} with {evaluator}, {model}: {count} rallies that count of {scoring.POOL}, "
        f"the longest {scoring.count_reported(count)} are reported"
        for (seed, trainer, evaluator, model), count in counted.items()
        if count < scoring.POOL
    ]
    return out + short


def _known(rallies: scoring.Rallies) -> tuple[np.ndarray, list[str]]:
    """Which rallies the figures have a place for, (n,) bool, and in words those for which they have none."""
    where, out = np.ones(len(rallies), bool), []
    for column, known in (("trainer", BY_SKILL), ("evaluator", BY_SKILL), ("model", BY_KEY)):
        fits = np.isin(getattr(rallies, column), list(known))
        where &= fits
        unknown = sorted(set(getattr(rallies, column)[~fits].tolist()))
        if unknown:
            out.append(f"{column} {', '.join(unknown)} (known are {', '.join(sorted(known))})")
    return where, out


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Errors of reading a file become a ConfigError that names it."""
    try:
        yield
    except (ValueError, OSError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
        lines = [line.removeprefix(f"{path}: ") for line in str(error).splitlines()]
        text = "; ".join(lines) or type(error).__name__
        raise ConfigError(f"{path}: cannot be read: {text}; restore the file") from None


def _mapping_of(path: Path) -> dict[str, Any]:
    """Content of a YAML or JSON file; empty where there is none."""
    if not path.exists():
        return {}
    with _reading(path):
        return _mapping(json.loads(path.read_bytes()) if path.suffix == ".json" else read_yaml(path))


def _mapping(content: Any) -> dict[str, Any]:
    if not isinstance(content, dict):
        raise ValueError(f"a mapping is wanted, got {reprlib.repr(content)}")
    return content


def _metric_rows(path: Path) -> list[dict[str, Any]]:
    rows = []
    lines = path.read_bytes().splitlines(keepends=True)
    for number, line in enumerate(lines, 1):
        try:
            row = _mapping(json.loads(line))
            if not isinstance(row.get("return_rate", 0.0), int | float):
                raise ValueError(f"return_rate is {row['return_rate']!r}, a number is wanted")
        except ValueError as error:
            if number == len(lines) and not line.endswith(b"\n"):
                break
            raise ValueError(f"line {number}: {error}") from None
        rows.append(row)
    return rows


def _ball_log(path: Path) -> BallLog:
    if path.stat().st_size and not zipfile.is_zipfile(path):
        raise ValueError("it is no NumPy archive (.npz)")
    with np.load(path, allow_pickle=False) as data:
        lacking = [name for name in LOG_ROWS if name not in data]
        if lacking:
            raise ValueError(f"has no array {', '.join(lacking)}; wanted: {', '.join(LOG_ROWS)}")
        arrays = {name: data[name] for name in LOG_ROWS}
    count = arrays["rally"].size
    for name, rows in LOG_ROWS.items():
        wanted, array = (rows, count) if rows else (count,), arrays[name]
        if array.shape != wanted or array.dtype.kind not in "biuf":
            raise ValueError(f"array {name} is {array.dtype} {array.shape}; numbers of shape {wanted} are wanted")
    return BallLog(**arrays)
