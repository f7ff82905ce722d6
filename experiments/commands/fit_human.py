"""``mjx-tt fit-human``: fit a human ball distribution to measured balls."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from experiments import options
from experiments.errors import ConfigError
from experiments.options import count, option

if TYPE_CHECKING:
    from rich.console import Console

    from ballmodel.distribution import BallDistribution
    from ballmodel.fit_distribution import HumanReport
    from ballmodel.flight import BallParams

app = options.command(
    "fit-human",
    "fit a human ball distribution to measured balls",
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


@app.default
def fit_human(
    *data: Annotated[
        str, Parameter("DATA", help="tracks of any form, .json (DeepMind) or .hdf5 (AIMY launcher)", required=True)
    ],
    out: Annotated[str, option("YAML", "the file to write")],
    name: Annotated[str, option("NAME", "name of the distribution (default: the output file's)")] = "",
    eps: Annotated[
        float | None, option("R", "radius of DBSCAN, in robust standard deviations (default: from the data)")
    ] = None,
    min_samples: Annotated[int, count("balls that make a cluster (default: 5)")] = 5,
    format: options.Format = None,
    fit: Annotated[
        Literal["spins", "gauss-newton", "nelder-mead"],
        Parameter(help="how flights are fitted: with their spins, or in the paper's drag all at once or one by one"),
    ] = "spins",
    model: Annotated[
        str | None, option("YAML", "simulation model of the flights (default: what their own diagnosis finds)")
    ] = None,
    both_players: Annotated[bool, Parameter(help="count the other player's strokes too, turned round")] = False,
    serves: Annotated[bool, Parameter(help="count serves too, from their bounce on the person's side")] = False,
    short_balls: Annotated[
        bool, Parameter(help="also draw balls that bounce twice on the robot's side, as the person plays them")
    ] = False,
    mixture: Annotated[
        str | None, option("YAML", "also fit a mixture over start states with spin; a picture is drawn beside it")
    ] = None,
    tracks: options.TrackFileOptions = options.TRACKS,
) -> None:
    """Fits a distribution, writes its YAML and prints its 16 numbers beside those of the paper's players.

    Raises ConfigError, for balls that cannot be metres and seconds in the table frame with what they look like.
    """
    options.check_suffix(out, ".yaml", ".yml")
    if eps is not None and not 0.0 < eps < float("inf"):
        raise ConfigError(f"--eps {eps:g}: a positive number is wanted")
    options.check_exists(*data, model)
    if fit != "spins" and model is not None:
        raise ConfigError(
            f"--fit {fit} --model {model}: in a model, strokes are fitted with their spins; leave one of the two out"
        )
    if mixture is not None:
        options.check_suffix(mixture, ".yaml", ".yml")
    options.start_jax(None)
    import numpy as np

    from ballmodel import registry
    from ballmodel.distribution import save_distribution
    from ballmodel.fit_distribution import Fit
    from ballmodel.fit_distribution import fit_human as fit_box
    from ballmodel.flight import ball_params
    from ballmodel.trajectory import Dataset
    from experiments.commands.balls import print_numbers
    from experiments.measurements import read_all, start_states
    from experiments.progress import make_console
    from mjx_tt.prediction.benchmark import SATURATING
    from mjx_tt.sim.model import SimModel, with_values

    screen, path = make_console(), Path(out)
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
                measured, ball, eps, min_samples, name or path.stem, serves, by, progress, short_balls, both_players
            )
    except ValueError as error:
        raise ConfigError(f"{', '.join(data)}: {error}") from None
    path.parent.mkdir(parents=True, exist_ok=True)
    save_distribution(path, distribution)
    _print_report(report, screen)
    paper = {each: registry.load(each) for each in registry.names() if each.endswith("/M2")}
    print_numbers({distribution.name: distribution} | paper, screen, bold=[distribution.name])
    screen.print(f"distribution: {path}  (use it in an experiment as  balls: {path.name})")
    if mixture is not None:
        _fit_mixture(report, distribution, ball, Path(mixture), screen)


@contextmanager
def _show_fits(console: Console) -> Iterator[Callable[[int, int], None]]:
    """Progress of flights that are fitted one by one; nothing where they are not."""
    from experiments.progress import ProgressBar, seconds_left

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
    import numpy as np

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
