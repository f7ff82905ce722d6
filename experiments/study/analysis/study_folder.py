"""A study's folder as data: rallies, ball logs, human models and balls; what is not there is named, not an error."""

from __future__ import annotations

import json
import reprlib
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ballmodel import registry
from ballmodel.distribution import AXES, BallDistribution, load_distribution
from ballmodel.io.yaml import read as read_yaml
from experiments.errors import ConfigError
from experiments.runs.run_dir import CONFIG
from experiments.study.analysis import effect_costs, scoring
from experiments.study.analysis.paper import BY_KEY, BY_SKILL, CROSS, FINAL, IS2R, LEARNED, MODELS, TEN
from experiments.study.analysis.statistics import Models
from mjx_tt.rally.human_player import FOLDER as VIRTUAL_PLAYERS

T = TypeVar("T")

ROUNDS = ("M0", "M1", "M2")
DATASETS = ("D0", "D1", "D2")
SETTINGS, EVALUATIONS = "study.yaml", "evaluations.csv"
LOG = {
    "rally": 0,
    "touch": 0,
    "first": 0,
    "position": 3,
    "velocity": 3,
    "landing": 2,
    "hit": 0,
    "returned": 0,
    "return_landing": 2,
}
"""Arrays of a BallLog with their rows; 0 for a plain list of balls."""
NUMBERS = tuple(f"{part} {axis} {end}" for part, axes in AXES.items() for axis in axes for end in ("min", "max"))
"""Names of the 16 numbers of a human model."""


@dataclass(frozen=True)
class BallLog:
    """The human's balls of one evaluation, arrays with the balls last.

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


@dataclass
class Study:
    """Content of a study's folder.

    missing: what the study that its settings ask for would have besides, in words
    left_out: what its settings leave out of a whole study, in words
    """

    folder: Path
    settings: dict[str, Any]
    info: dict[str, Any]
    rallies: scoring.Rallies
    missing: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)

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
        """The human models that were fitted: of M0, M1, M2 those that are there. Raises ConfigError."""
        out = {}
        for name in ROUNDS:
            path = self.folder / f"seed{seed}" / player / "balls" / f"human_{name}.yaml"
            if path.exists():
                out[name] = _read(path, load_distribution)
        return out

    def log(self, seed: int, trainer: str, evaluator: str, model: str) -> BallLog | None:
        """The balls of an evaluation. Raises ConfigError for a file that does not hold the arrays of a BallLog."""
        path = self.folder / "evaluations" / f"{seed}_{trainer}_{evaluator}_{model}.npz"
        return _read(path, _ball_log) if path.exists() else None

    def logs(self, trainer: str, model: str) -> list[BallLog]:
        """The logs of a policy with its own trainer, of all seeds."""
        found = (self.log(seed, trainer, trainer, model) for seed in self.seeds)
        return [log for log in found if log is not None]

    def metrics(self, seed: int, player: str, model: str) -> list[dict[str, Any]]:
        """The rows of a policy's training or fine-tuning, one per update; none where there is no file.

        An unfinished last line is left out: the run may be under way. Raises ConfigError naming any other bad line.
        """
        path = self.folder / f"seed{seed}" / player / model / "metrics.jsonl"
        return _read(path, _metrics) if path.exists() else []

    def trajectories(self, seed: int, player: str, name: str) -> Path | None:
        """The measured balls D0, D1 or D2, the last two as additions."""
        path = self.folder / f"seed{seed}" / player / "balls" / f"{name}.csv"
        return path if path.exists() else None

    @cached_property
    def calibration(self) -> dict[str, Any]:
        """The calibration of the virtual players: the folder's calibration.json or the shipped one; empty with people.

        Raises ConfigError.
        """
        path = self.folder / "calibration.json"
        if path.exists():
            return _read(path, _calibration)
        virtual = self.settings and self.settings.get("robot") is None
        return _read(VIRTUAL_PLAYERS / "calibration.json", _calibration) if virtual else {}

    @cached_property
    def effects(self) -> list[effect_costs.Outcome]:
        """Rallies in realities that lack something. Raises ConfigError."""
        return [o for path in sorted(self.folder.glob(f"seed*/{effect_costs.FILE}")) for o in effect_costs.read(path)]

    @cached_property
    def realities(self) -> dict[int, Any]:
        """The opened realities by seed. Raises ConfigError."""
        paths = {seed: self.folder / f"seed{seed}" / "reality.yaml" for seed in self.seeds}
        return {seed: _read(path, read_yaml) for seed, path in paths.items() if path.exists()}


def numbers(distribution: BallDistribution) -> np.ndarray:
    """(16,) the numbers of a human model in the order of NUMBERS."""
    d = distribution
    return np.array(
        [
            value
            for part, axes in AXES.items()
            for k in range(len(axes))
            for value in (getattr(d, f"{part}_min")[k], getattr(d, f"{part}_max")[k])
        ]
    )


def paper_models(player: str) -> dict[str, BallDistribution]:
    """The paper's M0, M1 and M2 of a player."""
    return {name: registry.load(f"{player}/{name}") for name in ROUNDS}


def change(a: BallDistribution, b: BallDistribution, scale: np.ndarray) -> float:
    """Mean over the 16 numbers of |b - a| in units of ``scale`` (16,)."""
    return float(np.mean(np.abs(numbers(b) - numbers(a)) / scale))


def widths(models: dict[str, BallDistribution]) -> np.ndarray:
    """(16,) the width of each quantity over all given models, the same for its minimum and its maximum."""
    table = np.array([numbers(m) for m in models.values()]).reshape(len(models), -1, 2)
    return np.repeat(table[:, :, 1].max(0) - table[:, :, 0].min(0), 2)


def load(folder: Path) -> Study:
    """Reads a study's folder, whole or partial.

    Raises ConfigError where there is nothing to report on, and for a file that is damaged.
    """
    folder = Path(folder)
    evaluated, asked, sessions = (folder / name for name in (EVALUATIONS, SETTINGS, "study.json"))
    if not evaluated.exists() and not asked.exists():
        raise ConfigError(f"{folder}: is no study: neither {SETTINGS} nor {EVALUATIONS} is there{_instead(folder)}")
    rallies = scoring.read(evaluated) if evaluated.exists() else scoring.join([])
    settings = _read(asked, _settings) if asked.exists() else {}
    info = _read(sessions, _json_mapping) if sessions.exists() else {}
    known, strange = _known(rallies)
    study = Study(folder, settings, info, rallies.take(known))
    if not study.players:
        if strange:
            raise ConfigError(f"{evaluated}: the figures have no place for any of its rallies: {'; '.join(strange)}")
        raise ConfigError(f"{folder}: nothing to report on yet: there is no player's folder and no rally")
    models, cross, study.left_out = _asked_for(settings)
    study.missing.extend([*(f"a place for rallies with {which}" for which in strange), *_missing(study, models, cross)])
    return study


def _instead(folder: Path) -> str:
    """Clause about a folder that is no study but holds a run, with the command for that; empty where it holds none."""
    runs = [path.parent for path in sorted([*folder.glob(CONFIG), *folder.glob(f"*/{CONFIG}")])]
    if not runs:
        return "" if folder.is_dir() else "; there is no such folder"
    return f"; it holds ordinary training, on which `mjx-tt evaluate {runs[0]}` reports"


def _asked_for(settings: dict[str, Any]) -> tuple[tuple[str, ...], bool, list[str]]:
    """Models of the paper and of the identification that a study makes, whether others play them, what it leaves out.

    Without settings, those of the paper.
    """
    baselines = settings.get("baselines", True)
    models = {True: TEN, False: ()}.get(baselines, tuple(m.key for m in MODELS if m.method == IS2R))
    left_out = list(dict.fromkeys(BY_KEY[key].method for key in TEN if key not in models))
    cross = (settings.get("evaluation") or {}).get("cross", True)
    if not cross:
        left_out.append("rallies with players who did not train the policy")
    if settings.get("identification") is not None:
        models += tuple(model.key for model in LEARNED["id"])
    return models, cross, left_out


def _missing(study: Study, models: tuple[str, ...], cross: bool) -> list[str]:
    """Parts that a study lacks of those models and cross-evaluations, in words."""
    out = []
    absent = [p for p in BY_SKILL if p not in study.players]
    if absent:
        out.append(f"players {', '.join(absent)}")
    r = study.rallies
    there = set(zip(r.seed.tolist(), r.trainer.tolist(), r.evaluator.tolist(), r.model.tolist(), strict=True))
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
    short = [
        f"seed {seed}, {trainer} with {evaluator}, {model}: {count} rallies that count of {scoring.POOL}, "
        f"the longest {scoring.kept(count)} are reported"
        for (seed, trainer, evaluator, model), count in counted(r).items()
        if count < scoring.POOL
    ]
    return out + short


def _known(rallies: scoring.Rallies) -> tuple[np.ndarray, list[str]]:
    """Which rallies the figures have a place for, (n,) bool, and in words those for which they have none."""
    where, out = np.ones(len(rallies), bool), []
    for column, known in (("trainer", BY_SKILL), ("evaluator", BY_SKILL), ("model", BY_KEY)):
        fits = np.isin(getattr(rallies, column), list(known))
        where &= fits
        strange = sorted(set(getattr(rallies, column)[~fits].tolist()))
        if strange:
            out.append(f"{column} {', '.join(strange)} (known are {', '.join(sorted(known))})")
    return where, out


def counted(rallies: scoring.Rallies) -> dict[tuple[int, str, str, str], int]:
    """Rallies that are not filtered, by seed, trainer, evaluator and model."""
    out: dict[tuple[int, str, str, str], int] = {}
    for s, t, e, m, f in zip(
        *(getattr(rallies, name).tolist() for name in ("seed", "trainer", "evaluator", "model", "filtered")),
        strict=True,
    ):
        out[s, t, e, m] = out.get((s, t, e, m), 0) + (not f)
    return out


def _read(path: Path, parse: Callable[[Path], T]) -> T:
    """Result of ``parse`` on a file; raises its errors as a ConfigError that names the file."""
    try:
        return parse(path)
    except (ValueError, OSError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
        said = str(error).removeprefix(f"{path}: ") or type(error).__name__
        raise ConfigError(f"{path}: cannot be read: {said}; restore the file") from None


def _settings(path: Path) -> dict[str, Any]:
    return _mapping(read_yaml(path))


def _json_mapping(path: Path) -> dict[str, Any]:
    return _mapping(json.loads(path.read_text(encoding="utf-8")))


def _mapping(content: Any) -> dict[str, Any]:
    if not isinstance(content, dict):
        raise ValueError(f"a mapping is wanted, got {reprlib.repr(content)}")
    return content


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _metrics(path: Path) -> list[dict[str, Any]]:
    rows = []
    lines = path.read_bytes().splitlines(keepends=True)
    for number, line in enumerate(lines, 1):
        try:
            row = _mapping(json.loads(line))
            if not _number(row.get("return_rate", 0.0)):
                raise ValueError(f"return_rate is {row['return_rate']!r}, a number is wanted")
        except ValueError as error:
            if number == len(lines) and not line.endswith(b"\n"):
                break
            raise ValueError(f"line {number}: {error}") from None
        rows.append(row)
    return rows


def _calibration(path: Path) -> dict[str, Any]:
    """medians: {player: {model: number}}; numbers, rallies: lists of rows with the same keys."""
    content = _json_mapping(path)
    for player, by_model in _mapping(content.get("medians", {})).items():
        if not all(map(_number, _mapping(by_model).values())):
            raise ValueError(f"medians.{player}: numbers are wanted, got {by_model!r}")
    for part, texts, values in (
        ("numbers", ("player", "model"), ("deviation",)),
        ("rallies", ("player", "statistic"), ("target", "reached")),
    ):
        rows = content.get(part, [])
        if not isinstance(rows, list):
            raise ValueError(f"{part}: a list is wanted, got {reprlib.repr(rows)}")
        for k, row in enumerate(rows):
            fits = isinstance(row, dict) and row.keys() == rows[0].keys()
            fits = fits and all(isinstance(row.get(n), str) for n in texts) and all(_number(row.get(n)) for n in values)
            if not fits:
                wanted = f"{', '.join(texts)} as text and {', '.join(values)} as numbers"
                raise ValueError(f"{part}[{k}]: {wanted} are wanted, the same keys in every row, got {row!r}")
    return content


def _ball_log(path: Path) -> BallLog:
    with open(path, "rb") as file:
        if not zipfile.is_zipfile(file):
            raise ValueError("it is no NumPy archive (.npz)")
    with np.load(path, allow_pickle=False) as data:
        lacking = [name for name in LOG if name not in data]
        if lacking:
            raise ValueError(f"has no array {', '.join(lacking)}; wanted: {', '.join(LOG)}")
        arrays = {name: data[name] for name in LOG}
    count = arrays["rally"].size
    for name, rows in LOG.items():
        wanted, array = (rows, count) if rows else (count,), arrays[name]
        if array.shape != wanted or array.dtype.kind not in "biuf":
            raise ValueError(f"array {name} is {array.dtype} {array.shape}; numbers of shape {wanted} are wanted")
    return BallLog(**arrays)
