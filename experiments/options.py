"""Options that several commands share, and the refusals that come before anything heavy is imported.

A group is a dataclass whose fields are options; a command names it as the type of an argument. A parameter's check
refuses its value before the command begins.
"""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter, Token

from experiments.config import site, study
from experiments.errors import ConfigError, error_context

if TYPE_CHECKING:
    from ballmodel.io.samples import TrackOptions
    from experiments.config.build import Experiment
    from experiments.runs.load_policy import TrainedPolicy
    from mjx_tt.sim.model import SimModel

RIG, LOCK_STEP = study.RIG, study.LOCK_STEP  # values of --robot that are no file
Check = Callable[[Any, Any], None]  # of a parameter's type and value


# -- refusals ----------------------------------------------------------------------------------------------------------


def check_exists(*paths: str | Path | None, key: str = "") -> None:
    """Raises ConfigError where one of the paths does not exist; ``key`` is the option that gave them."""
    for path in paths:
        if path is not None and not Path(path).exists():
            raise ConfigError(f"{key and f'{key} '}{path}: no such file or folder")


def check_writable(folder: str | Path) -> None:
    """Raises ConfigError where the folder cannot be made or written to."""
    near = next(place for place in (Path(folder), *Path(folder).absolute().parents) if place.exists())
    if not near.is_dir() or not os.access(near, os.W_OK):
        reason = "Permission denied" if near.is_dir() else "Not a directory"
        raise ConfigError(f"{folder}: cannot be written: {reason}; choose another --out")


def existing(key: str = "") -> Check:
    """The check that files or folders exist; ``key`` is the option that gave them."""
    return lambda _, given: check_exists(*(given if isinstance(given, tuple) else (given,)), key=key)


def suffixed(*allowed: str, key: str = "--out") -> Check:
    """The check that a file to be written, or each of several, has one of these suffixes."""

    def check(_: Any, given: Path | tuple[Path, ...]) -> None:
        for path in given if isinstance(given, tuple) else (given,):
            if path is not None and path.suffix not in allowed:
                raise ConfigError(f"{key} {path}: suffix {path.suffix!r}; allowed: {', '.join(allowed)}")

    return check


def between(low: float, high: float) -> Check:
    """The check that a number, or each of several, lies between these ends."""

    def check(_: Any, given: float | tuple[float, ...] | None) -> None:
        for value in given if isinstance(given, tuple) else (given,):
            if value is not None and not low < value < high:
                raise ValueError(f"expected a number above {low:g} and below {high:g}, got {value:g}")

    return check


# -- kinds of parameters -----------------------------------------------------------------------------------------------


def option(metavar: str, text: str, check: Check | None = None, name: str | None = None) -> Parameter:
    """A parameter that takes one value; ``name`` where it is not that of the function's argument."""
    return Parameter(name, metavar=metavar, help=text, validator=check)


def argument(name: str, text: str, check: Check | None = None) -> Parameter:
    """A parameter that is given by its place, at least once."""
    return Parameter(name, help=text, required=True, validator=check)


def count(text: str) -> Parameter:
    """A parameter that takes a whole number of at least 1."""

    def convert(_: Any, tokens: Sequence[Token]) -> int:
        value = tokens[0].value
        if not value.isdigit() or int(value) < 1:
            raise ValueError(f"expected a whole number of at least 1, got {value!r}")
        return int(value)

    return Parameter(metavar="N", help=text, converter=convert, n_tokens=1)


def numbers(metavar: str, text: str, wanted: str, accepted: Callable[[tuple[int, ...]], bool]) -> Parameter:
    """A parameter that takes whole numbers separated by commas; ``wanted`` says in words what is ``accepted``."""

    def convert(_: Any, tokens: Sequence[Token]) -> tuple[int, ...]:
        parts = tokens[0].value.split(",")
        found = tuple(int(part) for part in parts if part.strip().isdigit())
        if len(found) < len(parts) or not accepted(found):
            raise ValueError(f"expected {wanted}, got {tokens[0].value!r}")
        return found

    return Parameter(metavar=metavar, help=text, converter=convert, n_tokens=1)


BallSeed = Annotated[int | None, option("K", "seed of the balls")]
Devices = Annotated[int | None, count("host devices (default: one per processor core)")]
Format = Annotated[
    str | None, option("NAME", "csv, mcap, bag, deepmind, aimy, spindoe or events (default: from the file)")
]
Model = Annotated[str | None, option("YAML", "another simulation model", existing("--model"))]
Overrides = Annotated[tuple[str, ...], option("KEY=VALUE", "change one key of the file; may be repeated", name="--set")]
PolicyFolder = Annotated[
    str, Parameter("RUN_OR_ARTEFACT", help="folder of a run or of an exported policy, or a shipped policy's name")
]
RigFile = Annotated[str | None, option("YAML", "another rig: world, delays, network faults", existing("--rig"))]
RigSeed = Annotated[int, option("K", "seed of the balls that are thrown (default: 0)")]
RunsFolder = Annotated[Path, option("FOLDER", "where the folders of runs go (default: runs)")]
Site = Annotated[
    str | None, option("local|YAML", "where jobs run: this machine (default), or the workers of a site's YAML")
]


# -- groups ------------------------------------------------------------------------------------------------------------


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class PlayOptions:
    """Balls and world in which a policy plays."""

    balls: Annotated[str | None, option("NAME_OR_YAML", "other balls, such as player1/M1")] = None
    model: Model = None
    seed: BallSeed = None

    def experiment(self, trained: TrainedPolicy) -> Experiment:
        """The experiment that trained a policy, with these balls and this model. Raises ConfigError."""
        from experiments.config import build

        if trained.config is None:
            raise ConfigError(f"{trained.source}: does not say how it was trained; name the run that it came from")
        given = {key: value for key, value in (("balls", self.balls), ("model", self.model)) if value}
        config = trained.config.model_copy(update={**given, "initial_policy": None})
        return build.experiment(config, str(trained.source))

    def seed_of(self, experiment: Experiment) -> int:
        """Seed of the balls: the given one, or that of the experiment's evaluation."""
        return experiment.config.evaluation.seed if self.seed is None else self.seed


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class DistributedOptions:
    """Devices of this process, and other processes that share the work."""

    devices: Devices = None
    distributed: Annotated[
        str | None,
        option("auto|HOST:PORT", "share one training with other processes: as the cluster says, or by address"),
    ] = None
    processes: Annotated[
        int | None, count("runs at a time (default: one per processor core); with HOST:PORT, number of processes")
    ] = None
    process: Annotated[int | None, option("I", "index of this process, from 0 (with HOST:PORT)")] = None


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class RobotOptions:
    """How a policy is computed on a robot; of the emulated one also what it is and who plays with it."""

    backend: Annotated[
        Literal["auto", "numpy", "jit"],
        Parameter(help="what computes the policy (auto: JAX unless it is missing or slow)"),
    ] = "auto"
    distribution: Annotated[
        str | None, option("NAME", "distribution of the balls that are thrown (default: the policy's)")
    ] = None
    player: Annotated[
        str | None, option("NAME", "virtual player on the rig instead of thrown balls: player1 to player5")
    ] = None
    rig: RigFile = None
    seed: RigSeed = 0

    def check(self, robot: str) -> None:
        """Refuses a robot that is no file, and a player that does not go with it. Raises ConfigError."""
        emulated = robot in (RIG, LOCK_STEP)
        check_exists(None if emulated else robot, key="--robot")
        if self.player is None:
            return
        given = f"--player {self.player}"
        if not emulated:
            raise ConfigError(f"{given}: virtual players play on the rig only; --robot is {robot}")
        if self.distribution is not None:
            raise ConfigError(f"{given}, --distribution {self.distribution}: a player has balls of their own; give one")
        if self.player not in study.PLAYERS:
            raise ConfigError(f"{given}: unknown; allowed: {', '.join(study.PLAYERS)}")


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class TrackFileOptions:
    """What a person knows about files of tracks; the rest is found out."""

    columns: Annotated[str, option("OURS=THEIRS,...", "columns of t, x, y, z, trajectory, such as t=Timestamp,x=X")] = (
        ""
    )
    units: Annotated[str, option("UNITS", "units of the tracks, such as mm,ms, or frames with --fps")] = ""
    fps: Annotated[float | None, option("HZ", "frames a second, where times are numbers of frames")] = None
    frame: Annotated[
        str | None,
        option("FRAME", "frame of the tracks: table, or words of corner, end, side, floor, x-along joined by +"),
    ] = None
    topic: Annotated[str | None, option("TOPIC", "topic of the ball in a bag or MCAP file")] = None
    salvage: Annotated[bool, Parameter(help="read a log that is damaged up to there")] = False

    def load(self) -> TrackOptions:
        """The options of ``ballmodel.io.read``. Raises ConfigError."""
        from ballmodel.io.samples import LENGTHS, TrackOptions

        pairs = [pair.partition("=")[::2] for pair in self.columns.split(",") if pair]
        given = [unit for unit in self.units.split(",") if unit]
        lengths = [unit for unit in given if unit in LENGTHS]
        times = [unit for unit in given if unit not in LENGTHS] or (["frames"] if self.fps else [])
        if len(lengths) > 1 or len(times) > 1:
            raise ConfigError(f"--units {self.units}: expected one unit of length and one of time, such as mm,ms")
        length, time = (found[0] if found else None for found in (lengths, times))
        with error_context("--units"):
            return TrackOptions(dict(pairs), length, time, self.fps, self.topic, self.salvage)


# Where nothing is given.
PLAY, ALONE, ROBOT, TRACKS = PlayOptions(), DistributedOptions(), RobotOptions(), TrackFileOptions()


# -- before the work ---------------------------------------------------------------------------------------------------


def start_jax(devices: int | None = 1, elsewhere: bool = False, cache: str | None = None) -> None:
    """Configures JAX; in a process that runs it already, its devices stay.

    Args:
        devices: host devices; None: one per processor core.
        elsewhere: others do the jobs, so this process leaves accelerators to them.
        cache: folder of compiled programs; None: the user's.
    """
    # XLA reports slow compilations and the like on stderr; what goes wrong is raised as well.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    from mjx_tt import platform

    with contextlib.suppress(RuntimeError):
        platform.configure(devices, cache)
        if elsewhere:
            import jax

            jax.config.update("jax_platforms", "cpu")
    # JAX warns of every fork, but git and ffmpeg are started by fork and exec at once, which its threads do not mind.
    warnings.filterwarnings("ignore", message=r"os\.fork\(\) was called", category=RuntimeWarning)


def load_site(name: str | None, **others: Any) -> site.Site | None:
    """The site, None for this machine; ``others`` are options that do not go with a site. Raises ConfigError."""
    if name is None or name == site.OWN:
        return None
    loaded = site.load(name)
    for option_name, value in others.items():
        if value is not None:
            raise ConfigError(
                f"--{option_name} {value}: with --site {name} its workers_per_node, cores_per_worker and blocks say so"
            )
    return loaded


def load_model(path: str | Path | None) -> SimModel:
    """The simulation model of a file, None: the nominal one. Raises ConfigError."""
    from mjx_tt.sim.model import ModelFile, SimModel

    with error_context("--model"):
        return SimModel() if path is None else ModelFile.load(path).model
