"""A run's folder: what lies where, what made it, and whether it may be continued."""

from __future__ import annotations

import csv
import fcntl
import json
import platform
import subprocess
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import yaml

from ballmodel.io.atomic_files import replacing
from experiments.config.experiment import Config, parse
from experiments.config.files import read_yaml
from experiments.errors import LockedError, RunError

CONFIG, SESSIONS, LOCK = "config.yaml", "run.json", ".lock"
# What may change between the sessions of a run: none of it touches what an update computes.
CHANGEABLE = (
    "training.max_minutes",
    "training.stop_at_return_rate",
    "training.checkpoint_seconds",
    "training.evaluate_every",
    "training.evaluate_episodes",
    "training.devices",
    "evaluation",
)
_PACKAGES = ("mjx-tt", "jax", "jaxlib", "mujoco", "mujoco-mjx", "optax", "numpy")


class Run:
    """Paths of one run.

    folder           holds config.yaml, run.json, metrics.jsonl, evaluation.json, episode.*
    checkpoints      states to continue from
    artefact         the exported policy
    plots            pictures of the evaluation
    output           lines of a run that is one of several at a time
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.checkpoints = self.folder / "checkpoints"
        self.artefact = self.folder / "artefact"
        self.plots = self.folder / "plots"
        self.tensorboard = self.folder / "tensorboard"
        self.metrics = self.folder / "metrics.jsonl"
        self.evaluation = self.folder / "evaluation.json"
        self.status = self.folder / "status.json"
        self.output = self.folder / "output.txt"

    def config(self) -> Config:
        """The configuration that the run was started with. Raises RunError when the folder is no run."""
        path = self.folder / CONFIG
        if not path.is_file():
            raise RunError(f"{self.folder}: no run, {CONFIG} is missing")
        return parse(read_yaml(path.read_text(encoding="utf-8"), str(path)), str(path))

    def open(self, config: Config) -> None:
        """Makes the folder, or checks that it belongs to the same experiment, and records this session of training.

        Raises RunError naming every differing key, or saying that another process trains here or why the folder cannot
        be written.
        """
        path = self.folder / CONFIG
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with self.locked():  # a run that another process has just begun keeps its records
                self.check(config)
                write_yaml(path, config.to_dict())
                sessions = self.folder / SESSIONS
                before = json.loads(sessions.read_text()) if sessions.exists() else []
                write_json(sessions, [*before, provenance()])
                for mark in (self.status, self.evaluation):  # of an earlier end, which this session moves
                    mark.unlink(missing_ok=True)
        except OSError as error:
            raise RunError(
                f"{self.folder}: cannot be written: {error.strerror or error}; choose another --out"
            ) from error

    def check(self, config: Config) -> None:
        """Raises RunError naming every key in which a run that is already here differs.

        Nothing for a new folder, and for one in which nothing was trained yet: a start that failed must not stand in
        the way of the corrected one.
        """
        if not (self.folder / CONFIG).exists() or self._untouched():
            return
        changed = differences(self.config().to_dict(), config.to_dict(), _changeable)
        if changed:
            raise RunError(
                f"{self.folder}: belongs to another configuration:\n{changed}\n"
                "Restore these values, change the name or --out, or remove the folder"
            )

    def _untouched(self) -> bool:
        """True where the folder holds no more than the records of a start: no checkpoint, no measurement."""
        made = (self.output, self.checkpoints, self.metrics, self.tensorboard)
        kept = {CONFIG, SESSIONS, LOCK, *(path.name for path in made)}
        if any(path.name not in kept for path in self.folder.iterdir()):
            return False
        measured = self.metrics.exists() and self.metrics.stat().st_size > 0
        return not measured and not (self.checkpoints.exists() and any(self.checkpoints.iterdir()))

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keeps a second process out of the folder; the system frees the lock however this one ends.

        Raises LockedError when another process holds it.
        """
        with open(self.folder / LOCK, "w") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise LockedError(
                    f"{self.folder}: another process is training here; wait for it or choose another --out"
                ) from None
            yield

    def trained(self, config: Config) -> bool:
        """True where training has reached its end under this configuration."""
        if not self.status.exists():
            return False
        status = json.loads(self.status.read_text())
        return training_ended(config, status["update"], status["seconds"], status["return_rate"]) is not None

    def done(self, config: Config) -> bool:
        """True where nothing is left to do under this configuration: trained, exported and evaluated."""
        return self.trained(config) and self.evaluation.exists()

    def newest_checkpoint(self) -> str:
        """Name of the last checkpoint, "" before the first."""
        return max((path.name for path in self.checkpoints.glob("[0-9]*.npz")), default="")

    def read_evaluation(self) -> dict[str, Any]:
        """Content of evaluation.json."""
        return json.loads(self.evaluation.read_text())


@contextmanager
def continuable(folder: Path, kept: str, what: str) -> Iterator[None]:
    """Says of a disk that refuses, and of a Ctrl-C, what is kept, and that the same command continues ``what``."""
    try:
        yield
    except OSError as error:
        raise RunError(
            f"{error.filename or folder}: {error.strerror or error}; {kept} is kept. "
            "Make room or repair the folder, then run the same command again to continue"
        ) from error
    except KeyboardInterrupt as stopped:
        raise KeyboardInterrupt(f"{stopped}\n{folder}: stopped; the same command continues {what}".lstrip()) from None


def training_ended(config: Config, update: int, seconds: float, return_rate: float | None) -> str | None:
    """The setting that ends training at this point, or None.

    seconds: training time so far; return_rate: of the last evaluation during training, None without one.
    """
    training = config.training
    if update >= training.updates:
        return "updates"
    if training.max_minutes is not None and seconds >= 60 * training.max_minutes:
        return "max_minutes"
    target = training.stop_at_return_rate
    if target is not None and return_rate is not None and return_rate >= target:
        return "stop_at_return_rate"
    return None


def provenance() -> dict[str, Any]:
    """Time, versions and commit, as plain data."""
    return {
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}",
        "versions": {name: _version(name) for name in _PACKAGES},
        "git": git_state(),
    }


def git_state() -> dict[str, Any] | None:
    """Commit of the program's source and whether files differ from it; None outside a repository."""
    asked = ("rev-parse", "HEAD"), ("status", "--porcelain", "--untracked-files=no")
    git = "git", "-C", str(Path(__file__).parents[2])
    try:
        runs = [subprocess.run([*git, *a], capture_output=True, text=True, timeout=10, check=True) for a in asked]
    except (OSError, subprocess.SubprocessError):
        return None
    commit, changes = (run.stdout.strip() for run in runs)
    return {"commit": commit, "modified": bool(changes)}


def write_json(path: Path, data: Any) -> None:
    """Replaces the file by indented JSON, whole or not at all. Raises OSError."""
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(data, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def write_yaml(path: Path, data: dict[str, Any]) -> None:
    """Replaces the file by YAML in the order given, whole or not at all. Raises OSError."""
    with replacing(path) as temporary:
        temporary.write_text(yaml.safe_dump(data, sort_keys=False), encoding="utf-8")


def write_csv(path: Path, head: Sequence[str], rows: Iterable[Iterable[Any]]) -> None:
    """Replaces the file by a table, whole or not at all. Raises OSError."""
    with replacing(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows((head, *rows))


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _changeable(key: str) -> bool:
    return any(key == allowed or key.startswith(f"{allowed}.") for allowed in CHANGEABLE)


def differences(
    found: dict[str, Any], wanted: dict[str, Any], changeable: Callable[[str], bool], owner: str = "run"
) -> str:
    """A line for every dotted key that may not change and did: what the ``owner`` has and what is wanted now."""
    theirs, ours = _flat(found), _flat(wanted)
    return "\n".join(
        f"  {key}: the {owner} has {theirs.get(key)!r}, now {ours.get(key)!r}"
        for key in sorted(set(ours) | set(theirs))
        if ours.get(key) != theirs.get(key) and not changeable(key)
    )


def _flat(data: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Leaves by dotted path."""
    flat: dict[str, Any] = {}
    for key, value in data.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) and value else {f"{prefix}{key}": value}
    return flat
