"""The paper's figures of rally lengths. ``FIGURES`` names all figures of the report.

A figure is None where the study holds nothing of it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ballmodel import registry
from experiments.study.analysis import paper
from experiments.study.analysis.claims import Measurements
from experiments.study.analysis.statistics import Bootstrap, Interval
from experiments.study.report import comparisons, heatmaps, human_model_figures, plots
from mjx_tt.viz.html import FAINT, INK

LONGEST = 60  # touches; last bin of the histogram
CURVES: dict[str, tuple[str | None, ...]] = {  # of each method at the stages
    paper.IS2R: tuple(model.key for model in paper.METHODS[paper.IS2R]),
    paper.S2R: ("is2r-sim1", "is2r-ft35", None, "s2r-ft65", None, "s2r-ft100"),
    paper.ORACLE: (None, None, None, None, "oracle-sim", "oracle-ft"),
    paper.FRESH: ("is2r-sim1", "is2r-ft35", *(model.key for model in paper.METHODS[paper.FRESH])),
}
TUNED = {  # zero-shot policy and the same fine-tuned
    "sim 1 → 35 %": ("is2r-sim1", "is2r-ft35"),
    "sim 2 → 65 %": ("is2r-sim2", "is2r-ft65"),
    "sim 3 → 100 %": ("is2r-sim3", "is2r-ft100"),
    "Oracle": ("oracle-sim", "oracle-ft"),
}


def draw_aggregated(m: Measurements) -> Figure | None:
    """Boxes of the rally lengths, raw and normalised, and their histogram (all_player_results)."""
    keys, normalised = plots.held(m.raw, paper.LAST), plots.held(m.normalised, paper.LAST)
    if not keys:
        return None
    figure = Figure(figsize=(11, 3.9))
    left, centre, right = figure.subplots(1, 3, width_ratios=(1, 1, 1.25))
    _boxes(left, m.raw, keys, "all", plots.LENGTH, log=True)
    left.set_title("Rally length, all players")
    _boxes(centre, m.normalised, normalised, "all", plots.NORMALISED)
    centre.set_title("Normalised by player")

    edges = np.array([2, *range(5, LONGEST + 1, 5), LONGEST + 1])
    shown = plots.held(m.raw, ("is2r-ft100", "s2r-ft100", "id-ft100"))
    for k, key in enumerate(shown):
        values = m.raw.pooled(key, paper.of_level("all"))
        share = np.histogram(np.clip(values, edges[0], LONGEST), edges)[0] / max(values.size, 1)
        width = 0.84 / len(shown)
        place = np.arange(share.size) + (k - 0.5 * (len(shown) - 1)) * width
        right.bar(place, 100 * share, 0.95 * width, color=plots.colour(key), label=paper.SHORT[key])
    names = [f"{a}-{b - 1}" for a, b in pairwise(edges[:-1])] + [f"{LONGEST}+"]
    right.set_xticks(range(len(names)), names, rotation=60, fontsize=8)
    right.set_xlabel(plots.LENGTH)
    right.set_ylabel("rallies [%]")
    right.set_title("Histogram")
    if shown:
        plots.add_legend(figure, [plots.patch(paper.SHORT[key], plots.colour(key)) for key in shown], "right", ncols=2)
    return figure


def draw_means(m: Measurements, group: str = "all") -> Figure | None:
    """Mean normalised length, its boxes, mean length (app_summary; without the advanced player: its outlier figure)."""
    keys, normalised = plots.held(m.raw, paper.LAST), plots.held(m.normalised, paper.LAST)
    if not keys:
        return None
    figure = Figure(figsize=(11, 3.7))
    left, centre, right = figure.subplots(1, 3)
    _means(left, m.normalised, normalised, group, plots.NORMALISED)
    left.set_title("Mean normalised rally length")
    _boxes(centre, m.normalised, normalised, group, plots.NORMALISED)
    centre.set_title("Normalised rally length")
    _means(right, m.raw, keys, group, plots.LENGTH)
    right.set_title("Mean rally length")
    return figure


def draw_by_skill(m: Measurements) -> Figure | None:
    """Boxes above, means below, by skill level (main_summary_by_skill_level, app_summary_by_skill_level_means)."""
    keys = plots.held(m.raw, paper.LAST)
    if not keys:
        return None
    figure = Figure(figsize=(11, 6.8))
    for group, (upper, lower) in zip(paper.LEVELS, figure.subplots(2, 3).T, strict=True):
        _boxes(upper, m.raw, keys, group, plots.LENGTH, log=True)
        upper.set_title(plots.level_label(group))
        _means(lower, m.raw, keys, group, plots.MEAN)
    return figure


def draw_checkpoints(m: Measurements) -> Figure | None:
    """Mean rally length at the key checkpoints by skill level (main_training_curves)."""
    if not plots.held(m.raw, (*paper.TEN, *(model.key for model in paper.VARIANT))):
        return None
    figure = Figure(figsize=(11, 4.2))
    # Methods of which the study has a model that is no other method's.
    shown = [k for k in CURVES if any(m.raw.mean(x.key, m.study.players) for x in paper.METHODS[k])]
    dashes = {method: "--" if method in (paper.FRESH, paper.S2R) else "-" for method in CURVES}
    shifts = dict(zip(CURVES, (-0.06, 0.06, 0.0, -0.14), strict=True))
    for axes, group in zip(figure.subplots(1, 3), paper.LEVELS, strict=True):
        for method, keys in CURVES.items():
            found = [(i, key, mean) for i, key in enumerate(keys) if key and (mean := _mean(m.raw, key, group))]
            if (
                not found
                or method == paper.FRESH
                and not any(paper.BY_KEY[key].method == paper.FRESH for _, key, _ in found)
            ):
                continue
            shade = paper.COLOURS[method]
            for i, key, mean in found:
                face = shade if paper.BY_KEY[key].fine_tuned else "white"
                at, lengths = i + shifts[method], plots.error_lengths(mean)
                axes.errorbar(
                    at, mean.value, lengths, fmt="o", color=shade, markerfacecolor=face, linewidth=1.6, capsize=2.5
                )
            x, y = [i + shifts[method] for i, *_ in found], [mean.value for *_, mean in found]
            axes.plot(x, y, dashes[method], color=shade, linewidth=1.6, zorder=1)
        axes.set_xticks(range(len(plots.STAGES)), plots.STAGE_LABELS, fontsize=7.5)
        axes.set_ylim(bottom=0)
        axes.set_title(plots.level_label(group))
        axes.grid(axis="y", alpha=0.25)
        plots.note_empty(axes)
    figure.axes[0].set_ylabel(plots.MEAN)
    plots.add_legend(figure, [plots.line(paper.LEGEND[k], paper.COLOURS[k], linestyle=dashes[k]) for k in shown])
    return figure


def draw_zero_shot(m: Measurements) -> Figure | None:
    """Zero-shot against fine-tuned by skill level."""
    if not plots.held(m.raw, [key for pair in TUNED.values() for key in pair]):
        return None
    figure = Figure(figsize=(11, 3.8))
    for axes, group in zip(figure.subplots(1, 3), paper.LEVELS, strict=True):
        plots.draw_grouped_means(axes, m.raw, list(TUNED.values()), paper.of_level(group), tuple(TUNED), fontsize=7)
        axes.set_title(plots.level_label(group))
    figure.axes[0].set_ylabel(plots.MEAN)
    labels = ("zero-shot", "fine-tuned", "Oracle, zero-shot", "Oracle, fine-tuned")
    keys = ("is2r-sim1", "is2r-ft35", "oracle-sim", "oracle-ft")
    plots.add_legend(figure, [plots.patch(label, plots.colour(key)) for key, label in zip(keys, labels, strict=True)])
    return figure


def draw_cross(m: Measurements) -> Figure | None:
    """Own and cross-evaluations: mean length, mean normalised length, share that is kept (main_cross_eval_summary)."""
    if not any(cell[1] != cell[2] for cell in m.raw.cells):
        return None
    figure = Figure(figsize=(11, 3.9))
    left, centre, right = figure.subplots(1, 3)
    names = [paper.SHORT[key] for key in paper.FINAL]
    for axes, boot, label in ((left, m.raw, plots.MEAN), (centre, m.cross_normalised, f"{plots.NORMALISED}, 95 %")):
        groups = [[boot.mean(key, m.study.players, own) for own in (True, False)] for key in paper.FINAL]
        keys = [[key] * 2 for key in paper.FINAL]
        plots.draw_bars(axes, groups, keys, names, label, hatches=(None, "///"), fontsize=8.5)
    left.set_title("Mean rally length")
    centre.set_title("Normalised by the trainer's own")
    kept = [[m.kept_ratio([key])] for key in paper.FINAL]
    plots.draw_bars(right, kept, [[key] for key in paper.FINAL], names, fontsize=8.5)
    for k, key in enumerate(("keeps-is2r", "keeps-s2r")):
        if (share := m.findings[key].paper) is not None:
            plots.mark_paper(right, k + 0.38, share)
    right.axhline(1.0, color=FAINT, linewidth=0.8)
    plots.show_percent(right.yaxis)
    right.set_title("Kept with other players")
    hatched = plots.patch("other players", "#aaaaaa", hatch="///", edgecolor="white")
    plots.add_legend(figure, [plots.patch("own trainer", "#aaaaaa"), hatched, plots.line("paper", **plots.DIAMOND)])
    return figure


def draw_cross_by_player(m: Measurements) -> Figure | None:
    """Mean and normalised length of each trainer's policies with each evaluator (app:cross_eval_details)."""
    if not any(cell[1] != cell[2] for cell in m.raw.cells):
        return None
    trainers = m.study.players
    figure = Figure(figsize=(10, 2.2 * len(trainers)))
    for (left, right), trainer in zip(figure.subplots(len(trainers), 2, squeeze=False), trainers, strict=True):
        evaluators = (trainer, *paper.CROSS[trainer])
        labels = [f"player {e[-1]}" + (" (own)" if e == trainer else "") for e in evaluators]
        for axes, boot, label in ((left, m.raw, plots.LENGTH), (right, m.cross_normalised, "normalised")):
            groups = [[boot.evaluated(key, trainer, e) for key in paper.FINAL] for e in evaluators]
            plots.draw_bars(axes, groups, [paper.FINAL] * len(evaluators), labels, label)
        left.set_title(f"Trained by {plots.player_label(trainer)}: mean rally length")
        right.set_title("normalised by the trainer's own")
    plots.add_legend(figure, [plots.patch(paper.SHORT[key], plots.colour(key)) for key in paper.FINAL])
    return figure


def draw_by_player(m: Measurements) -> Figure | None:
    """Mean and distribution of the rally length of each model, player by player (app:trainer_details)."""
    keys, players = plots.held(m.raw, (*paper.TEN, *(model.key for model in paper.OTHER_WORLDS))), m.study.players
    if not keys:
        return None
    figure = Figure(figsize=(11, 2.35 * len(players)))
    for (left, right), player in zip(figure.subplots(len(players), 2, squeeze=False), players, strict=True):
        last = player == players[-1]
        plots.draw_model_bars(left, [m.raw.evaluated(key, player, player) for key in keys], keys, "mean, 95 %", last)
        samples = [m.raw.pooled(key, (player,)) for key in keys]
        plots.draw_boxes(right, samples, keys, plots.LENGTH, log=True, labelled=last)
        left.set_title(plots.player_label(player).capitalize())
        left.axhline(registry.skill(player).mean, color=INK, linestyle="--", linewidth=1.0)
    plots.add_legend(figure, [plots.line("paper: mean over the ten models", linestyle="--", linewidth=1.0)], "left")
    return figure


def draw_ablation(m: Measurements) -> Figure | None:
    """Zero-shot rally length by the distribution trained on (arbitarary_distributions)."""
    keys = [model.key for model in paper.ABLATED]
    means = {key: m.raw.mean(key, m.study.players) for key in keys}
    if not any(means.values()):
        return None
    figure = Figure(figsize=(8.5, 3.6))
    left, right = figure.subplots(1, 2)
    plots.draw_model_bars(left, list(means.values()), keys, plots.MEAN)
    left.set_title("Zero-shot, mean")
    _boxes(right, m.raw, keys, "all", plots.LENGTH, log=True)
    right.set_title("Zero-shot, distribution")
    oracle, share = means["oracle"], m.findings["large"].paper
    if oracle is not None and share is not None:
        plots.mark_paper(left, keys.index("large"), share * oracle.value, 7)
        plots.add_legend(
            figure,
            [plots.line(f"paper: Large {1.0 - share:.0%} below the Oracle's".replace("%", " %"), **plots.DIAMOND)],
        )
    return figure


def _mean(boot: Bootstrap, key: str, group: str) -> Interval | None:
    return plots.interval_of(boot.mean(key, paper.of_level(group)))


def _means(axes: Axes, boot: Bootstrap, keys: Sequence[str], group: str, ylabel: str) -> None:
    plots.draw_model_bars(axes, [_mean(boot, key, group) for key in keys], keys, ylabel)


def _boxes(axes: Axes, boot: Bootstrap, keys: Sequence[str], group: str, ylabel: str, log: bool = False) -> None:
    plots.draw_boxes(axes, [boot.pooled(key, paper.of_level(group)) for key in keys], keys, ylabel, log)


FIGURES: dict[str, Callable[[Measurements], Figure | None]] = {
    "summary": comparisons.draw_summary,
    "aggregated": draw_aggregated,
    "aggregated_means": draw_means,
    "by_skill": draw_by_skill,
    "without_advanced": lambda m: draw_means(m, paper.WITHOUT),
    "checkpoints": draw_checkpoints,
    "zero_shot": draw_zero_shot,
    "fine_tuning": comparisons.draw_fine_tuning,
    "evolution": human_model_figures.draw_evolution,
    "changes": human_model_figures.draw_changes,
    "effects": comparisons.draw_effects,
    "cross": draw_cross,
    "cross_players": draw_cross_by_player,
    "players": draw_by_player,
    "heatmap_incoming": lambda m: heatmaps.draw_heatmaps(m.study, heatmaps.incoming),
    "heatmap_outgoing": lambda m: heatmaps.draw_heatmaps(m.study, heatmaps.outgoing),
    "ablation": draw_ablation,
    "variant": comparisons.draw_variant,
    "identification": comparisons.draw_identification,
    "ends": comparisons.draw_ends,
    "unselected": comparisons.draw_unselected,
    "calibration": human_model_figures.draw_calibration,
}
