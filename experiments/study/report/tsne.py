"""Balls of training and evaluation on a plane by t-SNE: the paper's three sets of pictures.

A ball is its start position, start velocity and landing point, the eight numbers that a human model bounds, each
divided by its standard deviation over all balls of the player. One embedding per player holds all data sets, so that a
place means the same ball in all of its pictures; the paper does not say whether it did so. Up to 500 balls of each data
set, and 250 of each evaluation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.errors import checked
from experiments.study.analysis.paper import IS2R, S2R
from experiments.study.analysis.study_folder import DATASETS, Study
from experiments.study.report.style import COLOUR, player_label, styled
from mjx_tt.viz.html import FAINT

MOST = 500  # balls of a data set, as in the paper
FEWEST = 10
ITERATIONS = 500
PERPLEXITY = 30
EVALUATIONS = ("is2r-ft35", "is2r-ft65", "is2r-ft100", "s2r-ft100")
SHADES = {"D0": "#e69f00", "D1": "#56b4e9", "D2": "#7b4fa3"}
NAMES = {"D0": "D0", "D1": "ΔD1", "D2": "ΔD2"}


@dataclass(frozen=True)
class Plane:
    """A player's balls on the plane: (2, n) by data set, "D0" to "D2" and the keys of evaluated models."""

    player: str
    points: dict[str, np.ndarray]


def embed(study: Study, player: str, seed: int) -> Plane | None:
    """The plane of a player in one seed; None without balls."""
    sets = {name: features for name in DATASETS if (features := trained(study, seed, player, name)) is not None}
    for key in EVALUATIONS:
        log = study.log(seed, player, player, key)
        if log is not None and log.features.shape[1]:
            sets[key] = log.features
    rng = np.random.default_rng(0)
    sets = {name: _some(features, rng, MOST if name in DATASETS else MOST // 2) for name, features in sets.items()}
    total = sum(features.shape[1] for features in sets.values())
    if total < FEWEST:
        return None
    from sklearn.manifold import TSNE  # a second to import, which only this picture needs
    from threadpoolctl import threadpool_limits

    together = np.concatenate(list(sets.values()), axis=1).T
    spread = together.std(axis=0)
    standard = (together - together.mean(axis=0)) / np.where(spread > 0, spread, 1.0)
    perplexity = min(PERPLEXITY, (total - 1) / 3)
    with threadpool_limits(1):  # threads that wait for each other on busy cores take ten times as long
        tsne = TSNE(perplexity=perplexity, init="pca", max_iter=ITERATIONS, angle=0.7, random_state=0)
        placed = tsne.fit_transform(standard)
    edges = np.cumsum([features.shape[1] for features in sets.values()])[:-1]
    return Plane(player, {name: part.T for name, part in zip(sets, np.split(placed, edges), strict=True)})


def trained(study: Study, seed: int, player: str, name: str) -> np.ndarray | None:
    """(8, n) of the measured balls of D0, or of what D1 and D2 add, fitted as the human model is; None without any.

    Raises ConfigError for a file that cannot be read.
    """
    from ballmodel.fit_distribution import fit_human
    from ballmodel.flight import ball_params
    from ballmodel.io.tables import read_csv

    path = study.trajectories(seed, player, name)
    if path is None:
        return None
    data = checked("", read_csv, path)
    keep = np.random.default_rng(0).permutation(len(data.trajectories))[:MOST]
    try:
        _, report = fit_human(
            replace(data, trajectories=tuple(data.trajectories[k] for k in sorted(keep))), ball_params()
        )
    except ValueError:  # too few balls for a model are too few for a picture
        return None
    return np.concatenate([report.landed.position, report.landed.velocity, report.landing])


@styled
def training(planes: list[Plane]) -> Figure | None:
    """Evolution of the training balls: D0, D1 = D0 + ΔD1, D2 = D1 + ΔD2 (app:ball-dist-evo-train)."""
    if not planes:
        return None
    figure, grid = _figure(planes, 3)
    for row, plane in zip(grid, planes, strict=True):
        for k, (axes, name) in enumerate(zip(row, DATASETS, strict=True)):
            _scatter(axes, plane, DATASETS[: k + 1])
            axes.set_title(f"{player_label(plane.player)}: {name}" if not k else name)
    _legend(figure, DATASETS)
    return figure


@styled
def evaluation(planes: list[Plane]) -> Figure | None:
    """The balls of training and, on top, of the evaluation after each round of i-S2R (app:ball-dist-evo-train-eval)."""
    if not planes:
        return None
    figure, grid = _figure(planes, 3)
    for row, plane in zip(grid, planes, strict=True):
        for k, (axes, key) in enumerate(zip(row, EVALUATIONS[:3], strict=True)):
            _scatter(axes, plane, DATASETS[: k + 1], key)
            axes.set_title(f"{player_label(plane.player)}: {key}" if not k else key)
    _legend(figure, DATASETS, (IS2R,))
    return figure


@styled
def methods(planes: list[Plane]) -> Figure | None:
    """The balls of training and those of the final evaluation, i-S2R left, S2R+FT right (app:ball-dist-is2r-s2r)."""
    if not planes:
        return None
    figure, grid = _figure(planes, 2)
    for row, plane in zip(grid, planes, strict=True):
        for axes, key, sets in zip(row, ("is2r-ft100", "s2r-ft100"), (DATASETS, DATASETS[:2]), strict=True):
            _scatter(axes, plane, sets, key)
        row[0].set_title(f"{player_label(plane.player)}: i-S2R")
        row[1].set_title("S2R+FT")
    _legend(figure, DATASETS, (IS2R, S2R))
    return figure


def _figure(planes: list[Plane], columns: int) -> tuple[Figure, np.ndarray]:
    figure = Figure(figsize=(3.5 * columns, 3.1 * len(planes)))
    return figure, figure.subplots(len(planes), columns, squeeze=False)


def _scatter(axes: Axes, plane: Plane, sets: Sequence[str], key: str | None = None) -> None:
    x, y = np.concatenate(list(plane.points.values()), axis=1)
    axes.scatter(x, y, s=2, color="#e9ebee", linewidth=0)  # where balls of this player can be at all
    for name in sets:
        if name in plane.points:
            x, y = plane.points[name]
            axes.scatter(x, y, s=5, color=SHADES[name], alpha=0.75, linewidth=0)
    if key is not None:
        method = S2R if key.startswith("s2r") else IS2R
        if key in plane.points:
            x, y = plane.points[key]
            axes.scatter(x, y, s=12, facecolor="none", edgecolor=COLOUR[method], linewidth=0.6)
        else:
            axes.text(0.5, 0.5, "not in this study", transform=axes.transAxes, ha="center", color=FAINT)
    axes.set_xticks([])
    axes.set_yticks([])


def _legend(figure: Figure, sets: Sequence[str], evaluated: Sequence[str] = ()) -> None:
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], linestyle="", marker="o", markersize=4, color=SHADES[n], label=f"training {NAMES[n]}")
        for n in sets
    ]
    names = {IS2R: "evaluation of i-S2R", S2R: "evaluation of S2R+FT"}
    handles += [
        Line2D([], [], linestyle="", marker="o", markerfacecolor="none", color=COLOUR[k], label=names[k])
        for k in evaluated
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=min(len(handles), 4))


def _some(features: np.ndarray, rng: np.random.Generator, most: int) -> np.ndarray:
    return features[:, rng.permutation(features.shape[1])[:most]]
