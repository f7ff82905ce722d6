"""``mjx-tt fit-human`` and ``mjx-tt import``: measured balls to a distribution or another format; ``mjx-tt balls``."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from experiments.commands.options import (
    Format,
    command,
    console,
    count,
    existing,
    option,
    start_jax,
    suffix,
)
from experiments.errors import ConfigError, checked

if TYPE_CHECKING:
    from rich.console import Console

    from ballmodel.distribution import BallDistribution
    from ballmodel.fit_distribution import HumanReport
    from ballmodel.flight import BallParams

PLAIN_SECONDS = 10.0  # between lines of progress when the output is no terminal

app = command(
    "fit-human",
    "a human ball distribution from measured balls",
    """\
  mjx-tt fit-human rallies.csv --out anna.yaml
  mjx-tt fit-human monday.mcap tuesday.mcap --out anna.yaml --name anna
  mjx-tt fit-human rallies.json --out deepmind.yaml          (DeepMind's ball states)
  mjx-tt fit-human rallies.csv --fit nelder-mead --out anna.yaml     (the paper's fit: a tenth of a second a flight)
  mjx-tt fit-human rallies.csv --model world.yaml --serves --out anna.yaml --mixture anna_mixture.yaml

Then write "balls: anna.yaml" in an experiment, or "balls: anna_mixture.yaml" for balls with spin that keep together
what belongs together.
""",
)
import_app = command(
    "import",
    "convert measured trajectories to CSV or MCAP",
    """\
  mjx-tt import launcher.hdf5 --out launcher.csv
  mjx-tt import rallies.csv --out rallies.mcap
""",
)
balls_app = command("balls", "list the paper's players and ball distributions", "  mjx-tt balls\n")


@app.default
def fit_human(
    *data: Annotated[
        str, Parameter("DATA", help=".csv, .mcap, .json (DeepMind) or .hdf5 (AIMY launcher)", required=True)
    ],
    out: Annotated[str, option("YAML", "the file to write")],
    name: Annotated[str, option("NAME", "of the distribution (default: the name of the file written)")] = "",
    eps: Annotated[
        float | None, option("R", "radius of DBSCAN in robust standard deviations (default: from the data)")
    ] = None,
    min_samples: Annotated[int, count("balls that make a cluster (default: 5)")] = 5,
    format: Format = None,
    fit: Annotated[
        Literal["gauss-newton", "nelder-mead"],
        Parameter(help="of the flights: all at once, or one by one as the paper's; both minimise the same distance"),
    ] = "gauss-newton",
    model: Annotated[
        str | None, option("YAML", "simulation model in which the balls fly; one with lift finds each ball's spin")
    ] = None,
    serves: Annotated[
        bool, Parameter(help="count balls that bounce on the person's own side first, from that bounce on")
    ] = False,
    short_balls: Annotated[
        bool, Parameter(help="draw balls that would bounce twice on the robot's side as well, as the person plays them")
    ] = False,
    mixture: Annotated[
        str | None, option("YAML", "file for a mixture over start states with spin, beside the box; with its picture")
    ] = None,
) -> None:
    """Fits a distribution, writes its YAML and prints its 16 numbers beside those of the paper's players.

    Raises ConfigError, for balls that cannot be metres and seconds in the table frame with what they look like.
    """
    suffix(out, ".yaml", ".yml")
    if eps is not None and not 0.0 < eps < float("inf"):
        raise ConfigError(f"--eps {eps:g}: a positive number is wanted")
    existing(*data, model)
    if fit == "nelder-mead" and model is not None:
        raise ConfigError(
            f"--fit {fit} --model {model}: in a model, strokes are fitted together with their spins, which Nelder-Mead "
            "does not find; leave one of the two out"
        )
    if mixture is not None:
        suffix(mixture, ".yaml", ".yml")
    start_jax(None)
    from ballmodel.distribution import save_distribution
    from ballmodel.fit_distribution import fit_human as fitted_box
    from ballmodel.flight import ball_params
    from ballmodel.trajectory import Dataset
    from experiments.measurements import read_all, start_states
    from mjx_tt import diagnosis
    from mjx_tt.sim.model import ModelFile

    screen, path = console(), Path(out)
    measured = read_all(list(data), format)
    if fit == "nelder-mead" and not isinstance(measured, Dataset):
        raise ConfigError(
            f"{', '.join(data)}: holds start states, which need no fit; --fit {fit} is for trajectories, leave it out"
        )
    world = checked("--model", ModelFile.load, model).model if model else None
    if world is not None and isinstance(measured, Dataset):
        checked("", diagnosis.check, measured.trajectories, measured.source)
        measured, lines = start_states(measured, world)
        screen.print(*lines, sep="\n", highlight=False)
    try:
        ball = world.ball if world is not None else ball_params()
        with _progress(screen) as progress:
            distribution, report = fitted_box(
                measured, ball, eps, min_samples, name or path.stem, serves, fit, progress, short_balls
            )
    except ValueError as error:
        if isinstance(measured, Dataset):
            checked("", diagnosis.check, measured.trajectories, measured.source)
        raise ConfigError(f"{', '.join(data)}: {error}") from None
    path.parent.mkdir(parents=True, exist_ok=True)
    save_distribution(path, distribution)
    _print_report(report, screen)
    _print_numbers(distribution, screen)
    screen.print(f"distribution: {path}  (use it in an experiment as  balls: {path.name})", highlight=False)
    if mixture is not None:
        _fit_mixture(report, distribution, ball, Path(mixture), screen)


@contextmanager
def _progress(console: Console) -> Iterator[Callable[[int, int], None]]:
    """Display of flights fitted one by one: a live line in a terminal, plain lines elsewhere; at first nothing."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    columns = (TextColumn("flights fitted"), BarColumn(None), MofNCompleteColumn(), TextColumn("{task.description}"))
    live = Progress(*columns, console=console, expand=True, disable=not console.is_terminal)
    bar, began, last = None, time.monotonic(), time.monotonic()

    def show(done: int, flights: int) -> None:
        nonlocal bar, last
        now = time.monotonic()
        rate = done / max(now - began, 1e-3)
        text = f"{rate:.0f} flights/s  {timedelta(seconds=round((flights - done) / rate))} left"
        if console.is_terminal:
            if bar is None:
                live.start()
                bar = live.add_task("", total=flights)
            live.update(bar, completed=done, description=text)
        elif now - last >= PLAIN_SECONDS or done == flights:
            last = now
            console.print(f"flights fitted: {done:,}/{flights:,}  {text}", highlight=False)

    try:
        yield show
    finally:
        live.stop()


def _fit_mixture(report: HumanReport, box: BallDistribution, ball: BallParams, path: Path, console: Console) -> None:
    """Fits and writes the mixture, compares balls of both with the strokes, and draws them."""
    from ballmodel.mixture import fit_mixture, save_mixture
    from experiments.evaluation import human_likeness

    name = path.stem
    try:
        fitted, choice = fit_mixture(report.landed, name, box.source)
    except ValueError as error:
        raise ConfigError(f"--mixture {path}: {error}") from None
    fitted = replace(fitted, short_balls=box.short_balls)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_mixture(path, fitted)
    console.print(
        f"mixture: {path}  ({choice.chosen} components of {choice.balls:,} balls, with spin; balls: {path.name})",
        highlight=False,
    )
    for line in human_likeness.compare(report.landed, box, ball, path.with_suffix(".png")):
        console.print(f"  {line}", highlight=False)


@import_app.default
def import_(
    data: Annotated[str, Parameter("DATA", help="trajectories")],
    /,
    *,
    out: Annotated[str, option("FILE", ".csv or .mcap")],
    format: Format = None,
) -> None:
    """Raises ConfigError for another suffix or without trajectories."""
    existing(data)
    suffix(out, ".csv", ".mcap")
    start_jax(1)
    from ballmodel.io import read, write_mcap
    from ballmodel.trajectory import Dataset
    from experiments.measurements import write_csv

    path = Path(out)
    measured = checked("", read, data, format)
    if not isinstance(measured, Dataset):
        raise ConfigError(f"{data}: holds start states, not trajectories; mjx-tt fit-human takes it as it is")
    writers = {".csv": write_csv, ".mcap": write_mcap}
    if path.exists() and path.samefile(data):
        raise ConfigError(f"--out {path}: is the file to be converted")
    path.parent.mkdir(parents=True, exist_ok=True)
    writers[path.suffix](path, measured)
    samples = sum(len(trajectory) for trajectory in measured)
    console().print(f"{path}: {len(measured):,} trajectories, {samples:,} samples", highlight=False)


@balls_app.default
def balls() -> None:
    """Prints the paper's distributions with their 16 numbers, and the players' skill."""
    from rich.table import Table

    from ballmodel import registry

    screen = console()
    _print_numbers(None, screen, registry.names())
    table = Table(
        "player", "level", "mean rally", "std", "min", "max", title="Skill (hits per rally)", title_justify="left"
    )
    for player in sorted({name.split("/")[0] for name in registry.names() if "/" in name}):
        skill = registry.skill(player)
        table.add_row(player, skill.level, *(f"{v:g}" for v in (skill.mean, skill.std, skill.min, skill.max)))
    screen.print(table)


def _print_report(report: HumanReport, console: Console) -> None:
    import numpy as np

    console.print(
        f"{report.measured:,} balls measured, {report.too_short} too short, {report.elsewhere} not towards the robot"
    )
    if report.serves:
        console.print(f"{report.serves:,} serves among them, from 20 ms after the bounce on the own side")
    for outcome, number in report.outcomes.items():
        if number:
            console.print(f"  {number:,} {outcome}", highlight=False)
    if report.fit_rms.size:
        low, middle, high = (1e3 * np.percentile(report.fit_rms, [5, 50, 95])).round(1)
        console.print(f"residual of the fitted flights: {middle} mm in the median, {low} to {high} mm in 90 % of them")
    outliers = report.outliers
    left_out = int(outliers.outlier.sum())
    console.print(
        f"{left_out} of {outliers.n} left out as outliers "
        f"(DBSCAN, eps {outliers.eps:.3g}, min_samples {outliers.min_samples})"
    )


def _print_numbers(
    distribution: BallDistribution | None, console: Console, names: tuple[str, ...] | None = None
) -> None:
    from rich.table import Table

    from ballmodel import registry
    from ballmodel.distribution import AXES

    shown = [] if distribution is None else [(distribution.name, distribution)]
    chosen = names if names is not None else tuple(n for n in registry.names() if n.endswith("/M2"))
    shown += [(name, registry.load(name)) for name in chosen]
    columns = [f"{part[0]}{axis}" for part, axes in AXES.items() for axis in axes]
    table = Table(
        "balls",
        *columns,
        title=r"Start position p \[m], velocity v \[m/s], landing point l \[m]: min ... max",
        title_justify="left",
    )
    for name, each in shown:
        pairs = [
            f"{low:.2f}\n{high:.2f}"
            for part in AXES
            for low, high in zip(getattr(each, f"{part}_min"), getattr(each, f"{part}_max"), strict=True)
        ]
        table.add_row(name, *pairs, style="bold" if each is distribution else None, end_section=True)
    console.print(table)
