"""Measured balls: ``mjx-tt balls``, ``fit-human``, ``import``, ``predict`` and ``bench-ball``."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from cyclopts import Parameter
from rich.console import Console
from rich.table import Table

from experiments import options
from experiments.commands import command
from experiments.errors import ConfigError
from experiments.options import argument, between, count, existing, option, suffixed
from experiments.progress import ProgressBar, make_console, seconds_left

if TYPE_CHECKING:
    from ballmodel.distribution import BallDistribution
    from ballmodel.fit_distribution import HumanReport
    from ballmodel.flight import BallParams


@command(
    "fit-human",
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
def fit_human(
    *data: Annotated[
        str, argument("DATA", "tracks of any form, .json (DeepMind) or .hdf5 (AIMY launcher)", existing())
    ],
    out: Annotated[Path, option("YAML", "the file to write", suffixed(".yaml", ".yml"))],
    name: Annotated[str, option("NAME", "name of the distribution (default: the output file's)")] = "",
    eps: Annotated[
        float | None,
        option("R", "radius of DBSCAN, in robust standard deviations (default: from the data)", between(0.0, math.inf)),
    ] = None,
    min_samples: Annotated[int, count("balls that make a cluster (default: 5)")] = 5,
    format: options.Format = None,
    fit: Annotated[
        Literal["spins", "gauss-newton", "nelder-mead"],
        Parameter(help="how flights are fitted: with their spins, or in the paper's drag all at once or one by one"),
    ] = "spins",
    model: Annotated[
        str | None,
        option("YAML", "simulation model of the flights (default: what their own diagnosis finds)", existing()),
    ] = None,
    both_players: Annotated[bool, Parameter(help="count the other player's strokes too, turned round")] = False,
    serves: Annotated[bool, Parameter(help="count serves too, from their bounce on the person's side")] = False,
    short_balls: Annotated[
        bool, Parameter(help="also draw balls that bounce twice on the robot's side, as the person plays them")
    ] = False,
    mixture: Annotated[
        Path | None,
        option(
            "YAML",
            "also fit a mixture over start states with spin; a picture is drawn beside it",
            suffixed(".yaml", ".yml", key="--mixture"),
        ),
    ] = None,
    tracks: options.TrackFileOptions = options.TRACKS,
) -> None:
    """Fits a human ball distribution to measured balls."""
    if fit != "spins" and model is not None:
        raise ConfigError(
            f"--fit {fit} --model {model}: in a model, strokes are fitted with their spins; leave one of the two out"
        )
    options.start_jax(None)
    from ballmodel import registry
    from ballmodel.distribution import save_distribution
    from ballmodel.fit_distribution import Fit
    from ballmodel.fit_distribution import fit_human as fit_box
    from ballmodel.flight import ball_params
    from ballmodel.trajectory import Dataset
    from experiments.measurements import read_all, start_states
    from mjx_tt.prediction.benchmark import SATURATING
    from mjx_tt.sim.model import SimModel, with_values

    screen = make_console()
    measured = read_all(list(data), format, tracks.load(), tracks.frame or "auto")
    if isinstance(measured, Dataset):
        for note in measured.notes:
            screen.print(note)
    if fit == "nelder-mead" and not isinstance(measured, Dataset):
        raise ConfigError(
            f"{', '.join(data)}: holds start states, which need no fit; --fit {fit} is for trajectories, leave it out"
        )
    world = options.load_model(model) if model else None
    if isinstance(measured, Dataset) and fit == "spins":
        measured, world, lines = start_states(measured, world, screen.print)
        screen.print(*lines, sep="\n")
    elif world is None and not isinstance(measured, Dataset) and np.any(measured.state.spin):
        world = with_values(SimModel(), SATURATING)
    ball = ball_params() if world is None else world.ball
    try:
        with _show_fits(screen) as progress:
            by: Fit = "nelder-mead" if fit == "nelder-mead" else "gauss-newton"
            distribution, report = fit_box(
                measured, ball, eps, min_samples, name or out.stem, serves, by, progress, short_balls, both_players
            )
    except ValueError as error:
        raise ConfigError(f"{', '.join(data)}: {error}") from None
    out.parent.mkdir(parents=True, exist_ok=True)
    save_distribution(out, distribution)
    _print_report(report, screen)
    paper = {each: registry.load(each) for each in registry.names() if each.endswith("/M2")}
    _print_numbers({distribution.name: distribution} | paper, screen, bold=distribution.name)
    screen.print(f"distribution: {out}  (use it in an experiment as  balls: {out.name})")
    if mixture is not None:
        _fit_mixture(report, distribution, ball, mixture, screen)


@contextmanager
def _show_fits(console: Console) -> Iterator[Callable[[int, int], None]]:
    """Progress of flights that are fitted one by one; nothing where they are not."""
    began, bar = time.monotonic(), None
    with ExitStack() as stack:

        def show(done: int, flights: int) -> None:
            nonlocal bar
            bar = bar or stack.enter_context(ProgressBar(console, "flights fitted", flights))
            rate = done / max(time.monotonic() - began, 1e-3)
            bar.show(done, f"{rate:.0f} flights/s  {seconds_left((flights - done) / rate)} left")

        yield show


def _fit_mixture(report: HumanReport, box: BallDistribution, ball: BallParams, path: Path, console: Console) -> None:
    """Fits and writes the mixture, compares balls of both with the strokes, and draws them."""
    from ballmodel.distribution import save_distribution
    from ballmodel.fit_distribution import fit_mixture
    from experiments.evaluation import human_likeness

    try:
        fitted, choice = fit_mixture(report.landed, path.stem, box.source)
    except ValueError as error:
        raise ConfigError(f"--mixture {path}: {error}") from None
    path.parent.mkdir(parents=True, exist_ok=True)
    save_distribution(path, replace(fitted, short_balls=box.short_balls))
    size = f"{choice.chosen} components of {choice.balls:,} balls, with spin"
    console.print(f"mixture: {path}  ({size}; balls: {path.name})")
    for line in human_likeness.compare(report.landed, box, ball, path.with_suffix(".png")):
        console.print(f"  {line}")


def _print_report(report: HumanReport, console: Console) -> None:
    console.print(
        f"{report.measured:,} balls measured, {report.too_short} too short, {report.elsewhere} not towards the robot"
    )
    if report.serves:
        console.print(f"{report.serves:,} serves among them, from 20 ms after the bounce on the own side")
    for outcome, number in report.outcomes.items():
        if number:
            console.print(f"  {number:,} {outcome}")
    if report.fit_rms.size:
        low, middle, high = (1e3 * np.percentile(report.fit_rms, [5, 50, 95])).round(1)
        console.print(f"residual of the fitted flights: {middle} mm in the median, {low} to {high} mm in 90 % of them")
    found = report.outliers
    console.print(
        f"{int(found.outlier.sum())} of {found.n} left out as outliers "
        f"(DBSCAN, eps {found.eps:.3g}, min_samples {found.min_samples})"
    )


def _print_numbers(balls: dict[str, BallDistribution], console: Console, bold: str = "") -> None:
    """Prints the 16 numbers of each distribution; that of the name ``bold`` stands out."""
    from ballmodel.distribution import AXES

    table = Table(
        "balls",
        *(f"{part[0]}{axis}" for part, axes in AXES.items() for axis in axes),
        title="Start position p [m], velocity v [m/s], landing point l [m]: min ... max",
        title_justify="left",
    )
    for name, each in balls.items():
        pairs = [
            f"{low:.2f}\n{high:.2f}"
            for part in AXES
            for low, high in zip(getattr(each, f"{part}_min"), getattr(each, f"{part}_max"), strict=True)
        ]
        table.add_row(name, *pairs, style="bold" if name == bold else None, end_section=True)
    console.print(table)


@command(
    "import",
    """\
  mjx-tt import launcher.hdf5 --out launcher.csv
  mjx-tt import rallies.csv --out rallies.mcap
""",
)
def import_measurements(
    data: Annotated[str, argument("DATA", "trajectories", existing())],
    /,
    *,
    out: Annotated[Path, option("FILE", ".csv or .mcap", suffixed(".csv", ".mcap"))],
    format: options.Format = None,
    tracks: options.TrackFileOptions = options.TRACKS,
) -> None:
    """Converts measured trajectories to CSV or MCAP."""
    options.start_jax()
    from ballmodel.io import write_mcap
    from experiments.measurements import read_trajectories, write_csv

    measured = read_trajectories([data], format, tracks.load(), tracks.frame)
    if out.exists() and out.samefile(data):
        raise ConfigError(f"--out {out}: is the file to be converted")
    out.parent.mkdir(parents=True, exist_ok=True)
    (write_csv if out.suffix == ".csv" else write_mcap)(out, measured)
    samples = sum(len(trajectory) for trajectory in measured)
    made = f"{out}: {len(measured):,} trajectories, {samples:,} samples"
    make_console().print(*measured.notes, made, sep="\n")


@command(
    "predict",
    """\
  mjx-tt predict rallies.csv --out predicted.csv
  mjx-tt predict rallies.csv --model diagnosis/extended.yaml --seen 0.15 --horizon 0.1 --horizon 0.3 --out predicted.csv

Writes session,trajectory,t,x,y,z and the deviations sd_x,sd_y,sd_z [m] and covariances of each stroke's prediction.
""",
)
def predict(
    *data: Annotated[str, argument("DATA", "tracks of any form", existing())],
    out: Annotated[Path, option("CSV", "the file to write", suffixed(".csv"))],
    model: options.Model = None,
    horizon: Annotated[
        tuple[float, ...],
        option("S", "seconds after the last sample used; may be repeated (default: 0.3)", between(0.0, 5.0)),
    ] = (0.3,),
    seen: Annotated[float | None, option("S", "use only the first S seconds of each stroke")] = None,
    format: options.Format = None,
    tracks: options.TrackFileOptions = options.TRACKS,
) -> None:
    """Predicts a log's balls some time ahead, with the uncertainty."""
    options.start_jax()
    from experiments.evaluation import ball_predictions
    from experiments.measurements import read_trajectories

    measured = read_trajectories(data, format, tracks.load(), tracks.frame or "auto")
    lines = ball_predictions.write(out, measured, options.load_model(model), tuple(sorted(horizon)), seen)
    make_console().print(*measured.notes, *lines, sep="\n")


@command(
    "bench-ball",
    """\
  mjx-tt bench-ball launcher/topspin.hdf5 launcher/no_spin.hdf5 --out benchmark
  mjx-tt bench-ball rallies.csv --model diagnosis/extended.yaml --out benchmark

Sets: session,trajectory,t,x,y,z as CSV or MCAP, AIMY's HDF5, a folder in SpinDOE's form, a CSV of events in Ace's form.
Nothing is downloaded or copied. Writes benchmark.html (look at it first) and benchmark.csv.
""",
)
def bench_ball(
    *data: Annotated[str, argument("SET", "a file, or a folder in SpinDOE's form", existing())],
    out: Annotated[Path, option("DIR", "where page and table go")],
    model: Annotated[tuple[str, ...], option("YAML", "another model to compare; may be repeated", existing())] = (),
) -> None:
    """Compares predictors of the ball on measured sets."""
    options.check_writable(out)
    options.start_jax()
    from experiments.evaluation import ball_benchmark

    found = ball_benchmark.score(data, {Path(path).stem: options.load_model(path) for path in model})
    screen = make_console()
    for b, licence in found:
        screen.print(f"{b.name}: {b.flights} flights ({licence})", style="bold")
        for s in b.scores:
            if s.across == "all":
                rms = " to ".join(f"{1e3 * v:.1f}" for v in s.rms[1:])
                inside = "" if math.isnan(s.inside) else f", {s.inside:.0%} in 90 % regions"
                text = f"{1e3 * s.rms[0]:6.1f} mm ({rms}), median {1e3 * s.median[0]:.1f}{inside}"
                screen.print(f"  {s.horizon:4.2f} s  {s.method:32} {text}")
    for path in ball_benchmark.write(out, found)[:2]:
        screen.print(f"  {path}")


@command("balls", "  mjx-tt balls\n")
def balls() -> None:
    """Lists the paper's players and ball distributions."""
    from ballmodel import registry

    screen = make_console()
    _print_numbers({name: registry.load(name) for name in registry.names()}, screen)
    table = Table(
        "player", "level", "mean rally", "std", "min", "max", title="Skill (hits per rally)", title_justify="left"
    )
    for player in sorted({name.split("/")[0] for name in registry.names() if "/" in name}):
        skill = registry.skill(player)
        table.add_row(player, skill.level, *(f"{v:g}" for v in (skill.mean, skill.std, skill.min, skill.max)))
    screen.print(table)
