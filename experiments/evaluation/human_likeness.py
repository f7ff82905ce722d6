"""Likeness of a model's balls to a person's: how well a classifier tells them apart, and how many lie far from all.

Protocol: a random forest, cross-validated, on as many balls of the model as held-out strokes; area under its ROC curve,
0.5 where nothing tells them apart. And the share of the model's balls that lie farther from every known stroke than
99 % of held-out strokes do, in standard deviations of the strokes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import jax
import matplotlib
import numpy as np
from matplotlib.figure import Figure
from sklearn.ensemble import RandomForestClassifier
from sklearn.metrics import roc_auc_score
from sklearn.model_selection import StratifiedKFold, cross_val_predict
from sklearn.neighbors import NearestNeighbors

from ballmodel.distribution import BallDistribution
from ballmodel.fit_distribution import fit_mixture, start_states
from ballmodel.flight import BallParams
from ballmodel.io.atomic_files import replacing
from ballmodel.sampling import sample_pool
from ballmodel.state import BallState
from mjx_tt.viz import html

SEED = 0
TREES = 300
FOLDS = 5
FAR = 0.99  # share of held-out strokes that are no farther from the known ones
DRAWS = 200  # of the bootstrap
HELD_OUT = 1500  # strokes at most, and a quarter of them at most
FEWEST = 60  # held-out strokes that are worth a comparison
DRAWN = 1500  # points of a picture
PANELS = ((0, 2), (4, 2), (4, 5), (0, 3), (4, 6))  # rows of the start state against each other
LABELS = ("x [m]", "y [m]", "z [m]", "$v_x$ [m/s]", "$v_y$ [m/s]", "$v_z$ [m/s]", "$\\omega_x$ [rad/s]")


@dataclass(frozen=True)
class Likeness:
    """Area under the ROC curve with its 95 % interval, and the share of balls unlike every stroke."""

    auc: float
    low: float
    high: float
    far: float

    def __str__(self) -> str:
        return f"AUC {self.auc:.3f} ({self.low:.3f} to {self.high:.3f}), {self.far:.1%} unlike every stroke"


def likeness(balls: np.ndarray, held_out: np.ndarray, known: np.ndarray) -> Likeness:
    """Likeness of a model's balls to held-out strokes, beside the strokes that the model was fitted to.

    Rows (n, 6) or (n, 9) are start states (``start_states``) or their first columns; at most as many
    balls as held-out strokes are used.
    """
    rng = np.random.default_rng(SEED)
    balls = balls[: len(held_out)]
    rows, label = np.concatenate([balls, held_out]), np.repeat([1, 0], [len(balls), len(held_out)])
    folds = StratifiedKFold(FOLDS, shuffle=True, random_state=SEED)
    forest = RandomForestClassifier(TREES, min_samples_leaf=3, random_state=SEED)
    chance = cross_val_predict(forest, rows, label, cv=folds, method="predict_proba")[:, 1]
    draws = []
    for _ in range(DRAWS):
        pick = rng.integers(0, len(label), len(label))
        draws.append(roc_auc_score(label[pick], chance[pick]))
    low, high = np.quantile(draws, [0.025, 0.975])
    spread = known.std(axis=0)
    spread = np.where(spread > 0.0, spread, 1.0)
    near = NearestNeighbors(n_neighbors=1).fit(known / spread)
    usual = np.quantile(near.kneighbors(held_out / spread)[0][:, 0], FAR)
    far = float(np.mean(near.kneighbors(balls / spread)[0][:, 0] > usual))
    return Likeness(float(roc_auc_score(label, chance)), float(low), float(high), far)


def compare(landed: BallState, box: BallDistribution, ball: BallParams, picture: Path) -> list[str]:
    """Lines that compare balls of a mixture, and of the box, with strokes (3, n) that neither was fitted to.

    The mixture is fitted once more without the held-out quarter; the box is the one of all strokes. Draws both.
    """
    rows = start_states(landed)
    order = np.random.default_rng(SEED).permutation(len(rows))
    count = min(HELD_OUT, len(rows) // 4)
    count = count if count >= FEWEST else 0
    held, known = rows[order[:count]], rows[order[count:]]
    mixture = replace(fit_mixture(BallState(*np.split(known.T, 3)), seed=SEED)[0], short_balls=box.short_balls)
    keys = jax.random.split(jax.random.key(SEED))
    drawn = {
        name: start_states(sample_pool(key, balls, ball, max(count, DRAWN)).state)
        for name, balls, key in (("mixture", mixture, keys[0]), ("box", box, keys[1]))
    }
    _draw(rows, drawn, picture)
    lines = [f"{picture}: strokes, mixture and box side by side"]
    if not count:
        return [*lines, f"{len(rows)} strokes are too few to hold out a quarter and compare, {4 * FEWEST} are wanted"]
    for title, columns in (("position and velocity", 6), ("spin as well", 9)):
        for name, balls in drawn.items():
            found = likeness(balls[:, :columns], held[:, :columns], known[:, :columns])
            lines.append(f"{name} against {count:,} held-out strokes, {title}: {found}")
        if not np.any(rows[:, 6:]):
            break
    return lines


def _draw(rows: np.ndarray, drawn: dict[str, np.ndarray], path: Path) -> None:
    """Picture of strokes beside balls of the mixture and the box, two coordinates at a time."""
    with matplotlib.rc_context(html.STYLE):
        figure = Figure(figsize=(11.0, 6.6), layout="constrained")
        axes = figure.subplots(3, len(PANELS), sharex="col", sharey="col")
    for line, (name, points) in zip(axes, {"strokes": rows, **drawn}.items(), strict=True):
        for ax, (i, j) in zip(line, PANELS, strict=True):
            ax.plot(points[:DRAWN, i], points[:DRAWN, j], ".", ms=1.5, alpha=0.4, color=html.LINK)
            if name == "box":
                ax.set_xlabel(LABELS[i])
            ax.set_ylabel(LABELS[j])
        line[0].set_title(name)
    for ax, panel in zip(axes[0], PANELS, strict=True):
        # One wild ball does not set the scale.
        for k, limits in zip(panel, (ax.set_xlim, ax.set_ylim), strict=True):
            low, high = np.percentile(
                np.concatenate([points[:DRAWN, k] for points in (rows, *drawn.values())]), (1, 99)
            )
            limits(low - 0.12 * (high - low), high + 0.12 * (high - low))
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        temporary.write_bytes(html.png(figure))
