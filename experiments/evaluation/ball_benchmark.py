"""Public and own sets of measured balls for ``mjx-tt bench-ball``: read where they lie, scored, shown on one page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np
from markupsafe import Markup, escape
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter
from scipy.stats import chi2

from ballmodel.io import MeasuredStates, SpinDataset, read, read_events, read_spindoe
from ballmodel.io.formats import INDEX
from experiments.errors import ConfigError
from experiments.runs import run_dir
from mjx_tt.prediction.benchmark import WINDOW, Benchmark, Score, benchmark, landing_benchmark
from mjx_tt.sim.model import SimModel
from mjx_tt.viz import html
from mjx_tt.viz.html import Page

# By form: whose it is, and the licence under which it was published.
LICENCES = {
    "aimy": "Intelligent Soft Robots, BSD-3-Clause",
    "spindoe": "SpinDOE, no licence file",
    "events": "Sony Ace, none stated",
    "own": "not known here",
}
ACROSS = {"all": "all flights", "free": "before the bounce", "bounce": "across the bounce"}
COLUMNS = ("set", "licence", "horizon_s", "across", "method", "flights", "rms_mm", "rms_low", "rms_high",
           "median_mm", "median_low", "median_high", "in_regions")  # fmt: skip


def score(paths: Sequence[str], models: Mapping[str, SimModel]) -> list[tuple[Benchmark, str]]:
    """The benchmark of each file, with its licence. Raises ConfigError naming the file."""
    out = []
    for given in paths:
        path, name = Path(given), Path(given).stem
        try:
            if _is_events(path):
                out.append((landing_benchmark(name, read_events(path), models), LICENCES["events"]))
                continue
            spins = path.is_dir() or path.name == INDEX
            measured = read_spindoe(path) if spins else read(path)
            if isinstance(measured, MeasuredStates):
                raise ValueError(f"{path}: holds start states; a benchmark needs flights over time, or events")
            kind = (
                "spindoe" if isinstance(measured, SpinDataset) else "aimy" if path.suffix in (".hdf5", ".h5") else "own"
            )
            out.append((benchmark(name, measured.trajectories, models), LICENCES[kind]))
        except ValueError as error:
            raise ConfigError(str(error)) from None
    return out


def _is_events(path: Path) -> bool:
    if path.suffix.lower() != ".csv" or not path.is_file():
        return False
    with open(path, encoding="utf-8-sig", errors="replace") as file:
        return "ball_spin_out" in file.readline()


def write(folder: Path, found: Sequence[tuple[Benchmark, str]]) -> list[Path]:
    """Writes benchmark.csv and benchmark.html with its pictures; returns the paths."""
    folder.mkdir(parents=True, exist_ok=True)
    table, rows = folder / "benchmark.csv", []
    for b, licence in found:
        for s in b.scores:
            millimetres = [f"{1e3 * v:.2f}" for v in (*s.rms, *s.median)]
            rows.append(
                [b.name, licence, f"{s.horizon:g}", s.across, s.method, s.flights, *millimetres, f"{s.inside:.3f}"]
            )
    run_dir.write_csv(table, COLUMNS, rows)
    page = Page("Predicting balls", f"the state from the first {WINDOW:g} s, every second flight held out")
    for b, licence in found:
        page.section(b.name, b.name)
        page.paragraph(f"{b.flights} flights; licence: {licence}. Errors in mm: RMS and median with 95 % intervals.")
        page.add(html.table(*_table(b), right=(2, 3, 4, 5)))
        page.add(page.picture(f"errors_{b.name}", _figure(b), Markup("Share of held-out flights with smaller errors."),
                              f"Errors of the predictors on {b.name}"))  # fmt: skip
        if b.squares:
            text = Markup("Share of held-out samples inside a region, over what the region promises.")
            page.add(page.picture(f"regions_{b.name}", _regions(b), text, f"Calibration of the regions on {b.name}"))
        for line in b.record.lines():
            page.paragraph(f"Cleaned: {line}")
        if b.learnt:
            page.paragraph(f"The diagnosis of the other half names: {b.learnt}.")
    return [table, *page.write(folder / "benchmark.html", folder / "plots")]


def _table(b: Benchmark) -> tuple[list[str], list[list[str]]]:
    rows = []
    for s in b.scores:
        if s.across == "all" or _apart(b, s):
            place = f"{s.horizon:.2g} s ahead, {ACROSS[s.across]}"
            inside = "" if np.isnan(s.inside) else f"{s.inside:.0%}"
            cells = [escape(place), escape(s.method), s.flights, _cell(s.rms), _cell(s.median), inside]
            rows.append([str(cell) for cell in cells])
    return ["horizon", "method", "flights", "RMS", "median", "in 90 % regions"], rows


def _apart(b: Benchmark, s: Score) -> bool:
    """True where only some of the flights bounced before the horizon: else "all" says the same."""
    return s.flights != b.score(s.method, s.horizon).flights


def _cell(value: tuple[float, float, float]) -> str:
    middle, low, high = (1e3 * v for v in value)
    return f"{middle:.1f} ({low:.1f} to {high:.1f})"


def _regions(b: Benchmark) -> Figure:
    promised = np.linspace(0.0, 1.0, 101)
    with matplotlib.rc_context(html.STYLE):
        figure = Figure(figsize=(0.6 * html.WIDTH, 3.8), layout="constrained")
        ax = figure.subplots()
    ax.plot([0.0, 1.0], [0.0, 1.0], color="0.7", lw=1.0)
    for method, squares in b.squares.items():
        known = squares[np.isfinite(squares)]
        ax.plot(promised, (known[:, None] < chi2.ppf(promised, 3)).mean(axis=0), label=method, lw=1.4)
    ax.set(xlabel="promised", ylabel="share inside")
    ax.legend(fontsize=9, frameon=False)
    return figure


def _figure(b: Benchmark) -> Figure:
    horizons = list(dict.fromkeys(s.horizon for s in b.scores if s.across == "all"))
    rows = [h for h in range(len(horizons)) if any(np.isfinite(e[h]).any() for e in b.errors.values())]
    with matplotlib.rc_context(html.STYLE):
        figure = Figure(figsize=(html.WIDTH, 3.8), layout="constrained")
        axes = np.atleast_1d(figure.subplots(1, len(rows), sharey=True))
    for ax, h in zip(axes, rows, strict=True):
        for method, errors in b.errors.items():
            kept = np.sort(errors[h][np.isfinite(errors[h])])
            ax.step(1e3 * kept, np.arange(1, kept.size + 1) / kept.size, where="post", label=method, lw=1.4)
        ax.set(title=f"{horizons[h]:.2g} s ahead", xlabel="error [mm]", xscale="log")
        ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        ax.xaxis.set_major_formatter("{x:g}")
        ax.xaxis.set_minor_formatter(NullFormatter())  # else written over the others where errors span no decade
    axes[0].set_ylabel("share of flights")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper left", ncols=3, fontsize=9, frameon=False)
    return figure
