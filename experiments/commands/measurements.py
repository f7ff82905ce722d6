"""Measured balls on the command line: any format to CSV or MCAP, and to a human ball distribution."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from ballmodel import registry
from ballmodel.distribution import AXES, BallDistribution, save_distribution
from ballmodel.fit_distribution import HumanReport, fit_human
from ballmodel.flight import ball_params
from ballmodel.io import read, write_mcap
from ballmodel.trajectory import Dataset
from experiments.errors import ConfigError, checked
from experiments.measurements import read_all, write_csv
from mjx_tt import diagnosis


def fit(
    paths: list[str], format: str | None, out: Path, name: str, eps: float | None, min_samples: int, console: Console
) -> None:
    """Fits a distribution, writes its YAML and prints its 16 numbers beside those of the paper's players.

    Raises ConfigError, for balls that cannot be metres and seconds in the table frame with what they look like.
    """
    if out.suffix not in (".yaml", ".yml"):
        raise ConfigError(f"--out {out}: suffix {out.suffix!r}; allowed: .yaml, .yml")
    if eps is not None and not 0.0 < eps < float("inf"):
        raise ConfigError(f"--eps {eps:g}: a positive number is wanted")
    measured = read_all(paths, format)
    try:
        distribution, report = fit_human(measured, ball_params(), eps, min_samples, name or out.stem)
    except ValueError as error:
        if isinstance(measured, Dataset):
            checked("", diagnosis.check, measured.trajectories, measured.source)
        raise ConfigError(f"{', '.join(paths)}: {error}") from None
    out.parent.mkdir(parents=True, exist_ok=True)
    save_distribution(out, distribution)
    _print_report(report, console)
    _print_numbers(distribution, console)
    console.print(f"distribution: {out}  (use it in an experiment as  balls: {out.name})", highlight=False)


def convert(path: str, format: str | None, out: Path, console: Console) -> None:
    """Writes trajectories as .csv or .mcap. Raises ConfigError for another suffix or without trajectories."""
    data = checked("", read, path, format)
    if not isinstance(data, Dataset):
        raise ConfigError(f"{path}: holds start states, not trajectories; mjx-tt fit-human takes it as it is")
    writers = {".csv": write_csv, ".mcap": write_mcap}
    if out.suffix not in writers:
        raise ConfigError(f"{out}: suffix {out.suffix!r}; allowed: {', '.join(writers)}")
    if out.exists() and out.samefile(path):
        raise ConfigError(f"--out {out}: is the file to be converted")
    out.parent.mkdir(parents=True, exist_ok=True)
    writers[out.suffix](out, data)
    samples = sum(len(trajectory) for trajectory in data)
    console.print(f"{out}: {len(data):,} trajectories, {samples:,} samples", highlight=False)


def print_catalogue(console: Console) -> None:
    """The paper's distributions with their 16 numbers, and the players' skill."""
    _print_numbers(None, console, registry.names())
    table = Table(
        "player", "level", "mean rally", "std", "min", "max", title="Skill (hits per rally)", title_justify="left"
    )
    for player in sorted({name.split("/")[0] for name in registry.names() if "/" in name}):
        skill = registry.skill(player)
        table.add_row(player, skill.level, *(f"{v:g}" for v in (skill.mean, skill.std, skill.min, skill.max)))
    console.print(table)


def _print_report(report: HumanReport, console: Console) -> None:
    console.print(
        f"{report.measured:,} balls measured, {report.too_short} too short, {report.elsewhere} not towards the robot"
    )
    for outcome, count in report.outcomes.items():
        if count:
            console.print(f"  {count:,} {outcome}", highlight=False)
    if report.fit_rms.size:
        low, middle, high = (1e3 * np.percentile(report.fit_rms, [5, 50, 95])).round(1)
        console.print(f"residual of the fitted flights: {middle} mm in the median, {low} to {high} mm in 90 % of them")
    outliers = report.outliers
    count = int(outliers.outlier.sum())
    console.print(
        f"{count} of {outliers.n} left out as outliers "
        f"(DBSCAN, eps {outliers.eps:.3g}, min_samples {outliers.min_samples})"
    )


def _print_numbers(
    distribution: BallDistribution | None, console: Console, names: tuple[str, ...] | None = None
) -> None:
    shown = [] if distribution is None else [(distribution.name, distribution)]
    chosen = names if names is not None else tuple(n for n in registry.names() if n.endswith("/M2"))
    shown += [(name, registry.load(name)) for name in chosen]
    columns = [f"{part[0]}{axis}" for part, axes in AXES.items() for axis in axes]
    table = Table(
        "balls",
        *columns,
        title="Start position p [m], velocity v [m/s], landing point l [m]: min ... max",
        title_justify="left",
    )
    for name, each in shown:
        pairs = [
            f"{low:.2f}\n{high:.2f}"
            for part in AXES
            for low, high in zip(getattr(each, f"{part}_min"), getattr(each, f"{part}_max"))
        ]
        table.add_row(name, *pairs, style="bold" if each is distribution else None, end_section=True)
    console.print(table)
