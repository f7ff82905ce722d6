"""Balls of training and evaluation on a plane by t-SNE: the paper's three sets of pictures.

A ball is its start position, start velocity and landing point, the eight numbers that a human model bounds, each
divided by its standard deviation over all balls of the player. One embedding per player holds all data sets, so that a
place means the same ball in all of its pictures; the paper does not say whether it did so. Up to 500 balls of each data
set, and 250 of each evaluation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.study.analysis.paper import BY_KEY, COLOURS, IS2R, S2R
from experiments.study.analysis.study_folder import DATASETS, StudyFolder
from experiments.study.report.plots import add_legend, line, note_empty, player_label

MOST = 500  # balls of a data set, as in the paper
FEWEST = 10
ITERATIONS = 500
PERPLEXITY = 30
EVALUATIONS = ("is2r-ft35", "is2r-ft65", "is2r-ft100", "s2r-ft100")
DATASET_COLOURS = {"D0": "#e69f00", "D1": "#56b4e9", "D2": "#7b4fa3"}
Panel = tuple[str, Sequence[str], str | None]  # title, data sets, model whose evaluation is drawn on top
PANELS: dict[str, tuple[Panel, ...]] = {
    # Evolution of the training balls: D0, D1 = D0 + ΔD1, D2 = D1 + ΔD2 (app:ball-dist-evo-train).
    "tsne_training": tuple((name, DATASETS[: k + 1], None) for k, name in enumerate(DATASETS)),
    # On top the evaluation after each round of i-S2R (app:ball-dist-evo-train-eval).
    "tsne_evaluation": tuple((key, DATASETS[: k + 1], key) for k, key in enumerate(EVALUATIONS[:3])),
    # The final evaluation, i-S2R left, S2R+FT right (app:ball-dist-is2r-s2r).
    "tsne_methods": (("i-S2R", DATASETS, "is2r-ft100"), ("S2R+FT", DATASETS[:2], "s2r-ft100")),
}


@dataclass(frozen=True)
class Plane:
    """A player's balls on the plane: (2, n) by data set, "D0" to "D2" and the keys of evaluated models."""

    player: str
    points: dict[str, np.ndarray]


def embed(study: StudyFolder, player: str, seed: int) -> Plane | None:
    """The plane of a player in one seed; None without balls."""
    sets = {name: balls for name in DATASETS if (balls := training_balls(study, seed, player, name)) is not None}
    for key in EVALUATIONS:
        log = study.log(seed, player, player, key)
        if log is not None and log.features.shape[1]:
            sets[key] = log.features
    rng = np.random.default_rng(0)
    for name, balls in sets.items():
        sets[name] = balls[:, rng.permutation(balls.shape[1])[: MOST if name in DATASETS else MOST // 2]]
    total = sum(balls.shape[1] for balls in sets.values())
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
    edges = np.cumsum([balls.shape[1] for balls in sets.values()])[:-1]
    return Plane(player, {name: part.T for name, part in zip(sets, np.split(placed, edges), strict=True)})


def training_balls(study: StudyFolder, seed: int, player: str, name: str) -> np.ndarray | None:
    """(8, n) of the measured balls of D0, or of what D1 and D2 add, fitted as the human model is; None without any.

    Raises ConfigError for a file that cannot be read.
    """
    from ballmodel.fit_distribution import fit_human
    from ballmodel.flight import ball_params
    from experiments.measurements import read_trajectories

    path = study.paths.balls(seed, player, name)
    if not path.exists():
        return None
    data = read_trajectories([path])
    keep = sorted(np.random.default_rng(0).permutation(len(data.trajectories))[:MOST])
    try:
        _, report = fit_human(replace(data, trajectories=tuple(data.trajectories[k] for k in keep)), ball_params())
    except ValueError:  # too few balls for a model are too few for a picture
        return None
    return np.concatenate([report.landed.position, report.landed.velocity, report.landing])


def draw(planes: Sequence[Plane], panels: Sequence[Panel]) -> Figure | None:
    """A row of panels for each player."""
    if not planes:
        return None
    figure = Figure(figsize=(3.5 * len(panels), 3.1 * len(planes)))
    for row, plane in zip(figure.subplots(len(planes), len(panels), squeeze=False), planes, strict=True):
        for axes, (title, sets, key) in zip(row, panels, strict=True):
            _scatter(axes, plane, sets, key)
            axes.set_title(f"{player_label(plane.player)}: {title}" if axes is row[0] else title)
    dot: dict[str, Any] = {"linestyle": "", "marker": "o"}
    names = {"D0": "D0", "D1": "ΔD1", "D2": "ΔD2"}
    handles = [line(f"training {names[n]}", DATASET_COLOURS[n], markersize=4, **dot) for n in DATASETS]
    evaluated = {BY_KEY[key].method for *_, key in panels if key}
    for method, name in ((IS2R, "i-S2R"), (S2R, "S2R+FT")):
        if method in evaluated:
            handles.append(line(f"evaluation of {name}", COLOURS[method], markerfacecolor="none", **dot))
    add_legend(figure, handles, ncols=min(len(handles), 4))
    return figure


def _scatter(axes: Axes, plane: Plane, sets: Sequence[str], key: str | None) -> None:
    if key is not None and key not in plane.points:
        note_empty(axes)
    x, y = np.concatenate(list(plane.points.values()), axis=1)
    axes.scatter(x, y, s=2, color="#e9ebee", linewidth=0)  # where balls of this player can be at all
    for name in sets:
        if name in plane.points:
            x, y = plane.points[name]
            axes.scatter(x, y, s=5, color=DATASET_COLOURS[name], alpha=0.75, linewidth=0)
    if key is not None and key in plane.points:
        shade = COLOURS[BY_KEY[key].method]
        x, y = plane.points[key]
        axes.scatter(x, y, s=12, facecolor="none", edgecolor=shade, linewidth=0.6)
    axes.set_xticks([])
    axes.set_yticks([])
