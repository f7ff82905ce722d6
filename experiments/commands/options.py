"""Options that several commands share, and what commands do first."""

from __future__ import annotations

import contextlib
import os
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App, Parameter, Token

from experiments.errors import ConfigError

if TYPE_CHECKING:
    from rich.console import Console

    from experiments.config.build import Experiment
    from experiments.config.site import Site as SiteFile
    from experiments.runs.load_policy import TrainedPolicy

SHIPPED_HINT = (
    "\nA file name without a folder that is not in the current folder is looked up among the shipped experiments.\n"
)


def command(name: str, summary: str, examples: str) -> App:
    """A command without its function, which ``@app.default`` gives it."""
    return App(name, help=summary, help_epilogue=f"examples:\n{examples}")


def option(metavar: str, text: str, name: str | None = None, converter: Callable | None = None) -> Parameter:
    """A parameter that takes one value; ``name`` where it is not that of the function's argument."""
    return Parameter(name, metavar=metavar, help=text, converter=converter, n_tokens=converter and 1)


def at_least_one(_type: Any, tokens: Sequence[Token]) -> int:
    """A converter. Raises ValueError."""
    text = tokens[0].value
    if not text.isdigit() or int(text) < 1:
        raise ValueError(f"{text!r}: a whole number of at least 1 is needed")
    return int(text)


def count(text: str, metavar: str = "N") -> Parameter:
    """A parameter that takes a whole number of at least 1."""
    return option(metavar, text, converter=at_least_one)


def changes(text: str) -> Parameter:
    """The option --set, which may be repeated."""
    return option("KEY=VALUE", text, "--set")


Devices = Annotated[int | None, count("host devices to make (default: one per processor core)")]
Distributed = Annotated[
    str | None,
    option("auto|HOST:PORT", "share the work with other processes, on any hosts: as the cluster says, or by address"),
]
Processes = Annotated[
    int | None, count("how many runs at a time (default: one per processor core); with HOST:PORT, how many take part")
]
Site = Annotated[
    str | None,
    option("local|YAML", "who does the jobs: processes of this machine (default), or the workers of a site's YAML"),
]
Process = Annotated[int | None, option("I", "which of them this one is, from 0 (with HOST:PORT)")]
PolicyFolder = Annotated[str, Parameter("RUN_OR_ARTEFACT", help="folder of a run or of an exported policy")]
Balls = Annotated[str | None, option("NAME_OR_YAML", "other balls, such as player1/M1")]
Model = Annotated[str | None, option("YAML", "another simulation model")]
BallSeed = Annotated[int | None, option("K", "another seed means other balls")]
Format = Annotated[str | None, option("NAME", "csv, mcap, deepmind or aimy (default: from the suffix)")]
RigFile = Annotated[str | None, option("YAML", "another rig: world, delays, network faults")]
RigSeed = Annotated[int, option("K", "of the balls that are thrown")]


def console() -> Console:
    """Output of a command. A file or a pipe gets whole lines: only a terminal's width is one to break them at."""
    from rich.console import Console

    return Console(soft_wrap=not sys.stdout.isatty())


def start_jax(devices: int | None, elsewhere: bool = False) -> None:
    """Configures JAX; called from a process that runs it already, a command takes the devices that are there.

    elsewhere: others do the jobs, so this process leaves accelerators to them.
    """
    # XLA reports slow compilations and the like on stderr; what goes wrong comes as an exception all the same.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    from mjx_tt import platform

    with contextlib.suppress(RuntimeError):
        platform.configure(devices)
        if elsewhere:
            import jax

            jax.config.update("jax_platforms", "cpu")
    # JAX warns of every fork, but git and ffmpeg are started by fork and exec at once, which its threads do not mind.
    warnings.filterwarnings("ignore", message=r"os\.fork\(\) was called", category=RuntimeWarning)


def site_of(name: str | None, **others: Any) -> SiteFile | None:
    """The site, None for this machine; ``others`` are options that do not go with a site. Raises ConfigError."""
    from experiments.config import site

    if name is None or name == site.OWN:
        return None
    loaded = site.load(name)
    for option_name, value in others.items():
        if value is not None:
            raise ConfigError(
                f"--{option_name} {value}: with --site {name} its workers_per_node, cores_per_worker and blocks say so"
            )
    return loaded


# Refusals before anything heavy is imported


def shipped_or_own(name: str, shipped: dict[str, Path]) -> Path:
    """The file of that name, or the one of that name that comes with the program."""
    path = Path(name)
    return path if path.exists() or path.parent != Path() else shipped.get(path.stem, path)


def existing(*paths: str | Path | None, key: str = "") -> None:
    """Raises ConfigError where one of the paths does not exist; ``key`` is the option that gave them."""
    for path in paths:
        if path is not None and not Path(path).exists():
            raise ConfigError(f"{key and f'{key} '}{path}: no such file or folder")


def writable(folder: str | Path) -> None:
    """Raises ConfigError where the folder cannot be made or written to."""
    near = next(place for place in (Path(folder), *Path(folder).absolute().parents) if place.exists())
    if not near.is_dir() or not os.access(near, os.W_OK):
        reason = "Permission denied" if near.is_dir() else "Not a directory"
        raise ConfigError(f"{folder}: cannot be written: {reason}; choose another --out")


def suffix(path: str | Path, *allowed: str) -> None:
    """Raises ConfigError for a file to be written with another suffix."""
    given = Path(path).suffix
    if given not in allowed:
        raise ConfigError(f"--out {path}: suffix {given!r}; allowed: {', '.join(allowed)}")


# A policy's experiment


def experiment_of(trained: TrainedPolicy, balls: str | None = None, model: str | None = None) -> Experiment:
    """The experiment that trained a policy, with the balls and model of the command line in place of its own."""
    from experiments.config import build

    if trained.config is None:
        raise ConfigError(f"{trained.source}: does not say how it was trained; evaluate the run that it came from")
    given = {key: value for key, value in (("balls", balls), ("model", model)) if value}
    return build.experiment(trained.config.model_copy(update={**given, "initial_policy": None}), str(trained.source))
