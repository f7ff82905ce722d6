"""Figures of rally lengths: the paper's and those that it does not have. ``FIGURES`` names them all.

A figure is None where the study holds nothing of it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ballmodel import registry
from experiments.finetuning.report import smooth
from experiments.study.analysis import effect_costs
from experiments.study.analysis.claims import RATIO, Measurements
from experiments.study.analysis.paper import (
    ABLATED,
    BOUND,
    BY_KEY,
    COLOURS,
    CROSS,
    FINAL,
    FRESH,
    IDENTIFIED,
    IS2R,
    LAST,
    LEGEND,
    LEVELS,
    METHODS,
    MODELS,
    ORACLE,
    OTHER_WORLDS,
    RANDOMISED,
    S2R,
    SHORT,
    TEN,
    VARIANT,
    WITHOUT,
    of_level,
)
from experiments.study.analysis.scoring import UNKNOWN
from experiments.study.analysis.statistics import Bootstrap
from experiments.study.report import heatmaps, human_model_figures
from experiments.study.report.plots import (
    DIAMOND,
    Measured,
    add_legend,
    colour,
    draw_bars,
    draw_boxes,
    draw_model_bars,
    draw_ratios,
    error_lengths,
    interval_of,
    level_label,
    line,
    mark_paper,
    note_empty,
    patch,
    player_label,
    show_percent,
)
from mjx_tt.viz.html import FAINT, INK

LENGTH, MEAN, NORMALISED = "rally length", "mean rally length, 95 %", "normalised rally length"
LONGEST = 60  # touches; last bin of the histogram
STAGES = ("sim1", "ft35", "sim2", "ft65", "sim3", "ft100")
STAGE_LABELS = ("sim 1", "fine-tuned\n35 %", "sim 2", "fine-tuned\n65 %", "sim 3", "fine-tuned\n100 %")
CURVES: dict[str, tuple[str | None, ...]] = {  # of each method at the stages
    IS2R: tuple(model.key for model in METHODS[IS2R]),
    S2R: ("is2r-sim1", "is2r-ft35", None, "s2r-ft65", None, "s2r-ft100"),
    ORACLE: (None, None, None, None, "oracle-sim", "oracle-ft"),
    FRESH: ("is2r-sim1", "is2r-ft35", *(model.key for model in METHODS[FRESH])),
}
CYCLES = {  # of fine-tuning in reality, one after the other
    S2R: ("is2r-ft35", "s2r-ft65", "s2r-ft100"),
    IS2R: ("is2r-ft35", "is2r-ft65", "is2r-ft100"),
    ORACLE: ("oracle-ft",),
}
TUNED = {  # zero-shot policy and the same fine-tuned
    "sim 1 → 35 %": ("is2r-sim1", "is2r-ft35"),
    "sim 2 → 65 %": ("is2r-sim2", "is2r-ft65"),
    "sim 3 → 100 %": ("is2r-sim3", "is2r-ft100"),
    "Oracle": ("oracle-sim", "oracle-ft"),
}


def held(boot: Bootstrap, keys: Sequence[str]) -> list[str]:
    """Those of the models that a bootstrap holds."""
    there = {cell[3] for cell in boot.cells}
    return [key for key in keys if key in there]


def draw_aggregated(m: Measurements) -> Figure | None:
    """Boxes of the rally lengths, raw and normalised, and their histogram (all_player_results)."""
    keys, normalised = held(m.raw, LAST), held(m.normalised, LAST)
    if not keys:
        return None
    figure = Figure(figsize=(11, 3.9))
    left, centre, right = figure.subplots(1, 3, width_ratios=(1, 1, 1.25))
    _boxes(left, m.raw, keys, "all", LENGTH, log=True)
    left.set_title("Rally length, all players")
    _boxes(centre, m.normalised, normalised, "all", NORMALISED)
    centre.set_title("Normalised by player")

    edges = np.array([2, *range(5, LONGEST + 1, 5), LONGEST + 1])
    shown = held(m.raw, ("is2r-ft100", "s2r-ft100", "id-ft100"))
    for k, key in enumerate(shown):
        values = m.raw.pooled(key, of_level("all"))
        share = np.histogram(np.clip(values, edges[0], LONGEST), edges)[0] / max(values.size, 1)
        width = 0.84 / len(shown)
        place = np.arange(share.size) + (k - 0.5 * (len(shown) - 1)) * width
        right.bar(place, 100 * share, 0.95 * width, color=colour(key), label=SHORT[key])
    names = [f"{a}-{b - 1}" for a, b in pairwise(edges[:-1])] + [f"{LONGEST}+"]
    right.set_xticks(range(len(names)), names, rotation=60, fontsize=8)
    right.set_xlabel(LENGTH)
    right.set_ylabel("rallies [%]")
    right.set_title("Histogram")
    if shown:
        add_legend(figure, [patch(SHORT[key], colour(key)) for key in shown], "right", ncols=2)
    return figure


def draw_means(m: Measurements, group: str = "all") -> Figure | None:
    """Mean normalised length, its boxes, mean length (app_summary; without the advanced player: its outlier figure)."""
    keys, normalised = held(m.raw, LAST), held(m.normalised, LAST)
    if not keys:
        return None
    figure = Figure(figsize=(11, 3.7))
    left, centre, right = figure.subplots(1, 3)
    _means(left, m.normalised, normalised, group, NORMALISED)
    left.set_title("Mean normalised rally length")
    _boxes(centre, m.normalised, normalised, group, NORMALISED)
    centre.set_title("Normalised rally length")
    _means(right, m.raw, keys, group, LENGTH)
    right.set_title("Mean rally length")
    return figure


def draw_by_skill(m: Measurements) -> Figure | None:
    """Boxes above, means below, by skill level (main_summary_by_skill_level, app_summary_by_skill_level_means)."""
    keys = held(m.raw, LAST)
    if not keys:
        return None
    figure = Figure(figsize=(11, 6.8))
    for group, (upper, lower) in zip(LEVELS, figure.subplots(2, 3).T, strict=True):
        _boxes(upper, m.raw, keys, group, LENGTH, log=True)
        upper.set_title(level_label(group))
        _means(lower, m.raw, keys, group, MEAN)
    return figure


def draw_checkpoints(m: Measurements) -> Figure | None:
    """Mean rally length at the key checkpoints by skill level (main_training_curves)."""
    if not held(m.raw, (*TEN, *(model.key for model in VARIANT))):
        return None
    figure = Figure(figsize=(11, 4.2))
    # Methods of which the study has a model that is no other method's.
    shown = [k for k in CURVES if any(m.raw.mean(x.key, m.study.players) for x in METHODS[k])]
    dashes = {method: "--" if method in (FRESH, S2R) else "-" for method in CURVES}
    shifts = dict(zip(CURVES, (-0.06, 0.06, 0.0, -0.14), strict=True))
    for axes, group in zip(figure.subplots(1, 3), LEVELS, strict=True):
        for method, keys in CURVES.items():
            found = [(i, key, mean) for i, key in enumerate(keys) if key and (mean := _mean(m.raw, key, group))]
            if method == FRESH and not any(BY_KEY[key].method == FRESH for _, key, _ in found):
                continue
            shade = COLOURS[method]
            for i, key, mean in found:
                face = shade if BY_KEY[key].fine_tuned else "white"
                style = {"fmt": "o", "color": shade, "markerfacecolor": face, "linewidth": 1.6, "capsize": 2.5}
                axes.errorbar(i + shifts[method], mean.value, error_lengths(mean), **style)
            x, y = [i + shifts[method] for i, *_ in found], [mean.value for *_, mean in found]
            axes.plot(x, y, dashes[method], color=shade, linewidth=1.6, zorder=1)
        axes.set_xticks(range(len(STAGES)), STAGE_LABELS, fontsize=7.5)
        axes.set_ylim(bottom=0)
        axes.set_title(level_label(group))
        axes.grid(axis="y", alpha=0.25)
        note_empty(axes)
    figure.axes[0].set_ylabel(MEAN)
    add_legend(figure, [line(LEGEND[k], COLOURS[k], linestyle=dashes[k]) for k in shown])
    return figure


def draw_zero_shot(m: Measurements) -> Figure | None:
    """Zero-shot against fine-tuned by skill level."""
    if not held(m.raw, [key for pair in TUNED.values() for key in pair]):
        return None
    figure = Figure(figsize=(11, 3.8))
    for axes, group in zip(figure.subplots(1, 3), LEVELS, strict=True):
        _grouped_means(axes, m.raw, list(TUNED.values()), of_level(group), tuple(TUNED), fontsize=7)
        axes.set_title(level_label(group))
    figure.axes[0].set_ylabel(MEAN)
    labels = ("zero-shot", "fine-tuned", "Oracle, zero-shot", "Oracle, fine-tuned")
    keys = ("is2r-sim1", "is2r-ft35", "oracle-sim", "oracle-ft")
    add_legend(figure, [patch(label, colour(key)) for key, label in zip(keys, labels, strict=True)])
    return figure


def draw_fine_tuning(m: Measurements) -> Figure | None:
    """Share of the balls that the perturbed policies return during fine-tuning in reality, by skill level."""
    curves = {
        (group, method): [c for p in of_level(group) for s in m.study.seeds if (c := _return_rates(m, s, p, keys)).size]
        for group in LEVELS
        for method, keys in CYCLES.items()
    }
    if not any(curves.values()):
        return None
    figure = Figure(figsize=(11, 3.8))
    for axes, group in zip(figure.subplots(1, 3, sharey=True), LEVELS, strict=True):
        for method in CYCLES:
            found, shade = curves[group, method], COLOURS[method]
            for curve in found:
                axes.plot(curve, color=shade, linewidth=0.6, alpha=0.35)
            if found:
                shared = min(map(len, found))
                axes.plot(np.mean([curve[:shared] for curve in found], axis=0), color=shade, linewidth=2.0)
        axes.set_title(level_label(group))
        axes.set_xlabel("updates in reality")
        show_percent(axes.yaxis)
        axes.grid(axis="y", alpha=0.25)
        note_empty(axes)
    figure.axes[0].set_ylim(0.0, max(0.05, figure.axes[0].get_ylim()[1]))  # of all: the axis is shared
    figure.axes[0].set_ylabel("returned while fine-tuning")
    names = {IS2R: "i-S2R", S2R: "S2R+FT", ORACLE: "S2R-Oracle+FT"}
    add_legend(figure, [line(name, COLOURS[method]) for method, name in names.items()])
    return figure


def _return_rates(m: Measurements, seed: int, player: str, keys: Sequence[str]) -> np.ndarray:
    """Return rate over the updates of cycles that follow one another, smoothed within each; NaN between them."""
    parts: list[np.ndarray] = []
    for key in keys:
        rows = m.study.metrics(seed, player, key)
        rate = np.array([row["return_rate"] for row in rows if "return_rate" in row])
        if not rate.size:
            return rate
        parts += [smooth(rate), np.array([np.nan])]
    return np.concatenate(parts)


def draw_effects(m: Measurements) -> Figure | None:
    """Rally length without an effect over that with all, by model."""
    models, worlds = effect_costs.MODELS, effect_costs.WORLDS[1:]
    gains = [[effect_costs.gain(m.study.effects, model, world) for model in models] for world in worlds]
    logs = np.array([[np.nan if gain is None else np.log2(gain.value) for gain in row] for row in gains])
    if not np.isfinite(logs).any():
        return None
    figure = Figure(figsize=(8.6, 4.6))
    axes = figure.subplots()
    limit = max(np.log2(1.5), float(np.nanmax(np.abs(logs))))
    image = axes.imshow(logs, cmap="RdBu", vmin=-limit, vmax=limit, aspect="auto")
    for (row, column), log in np.ndenumerate(logs):
        gain = gains[row][column]
        if gain is not None and np.isfinite(log):
            sure = gain.low > 1.0 or gain.high < 1.0
            style = {"color": "white" if abs(log) > 0.6 * limit else INK, "fontweight": "bold" if sure else "normal"}
            axes.text(column, row, f"{gain.value:.2f}", ha="center", va="center", fontsize=9, **style)
    names = [BY_KEY[key].label.replace(" fine", "\nfine") for key in models]
    axes.set_xticks(range(len(models)), names, fontsize=8)
    axes.set_yticks(range(len(worlds)), worlds)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    axes.set_ylabel("left out of reality")
    figure.colorbar(image, label="rally length, times", format=lambda v, _: f"{2.0**v:.2g}")
    return figure


def draw_cross(m: Measurements) -> Figure | None:
    """Own and cross-evaluations: mean length, mean normalised length, share that is kept (main_cross_eval_summary)."""
    if not any(cell[1] != cell[2] for cell in m.raw.cells):
        return None
    figure = Figure(figsize=(11, 3.9))
    left, centre, right = figure.subplots(1, 3)
    names = [SHORT[key] for key in FINAL]
    for axes, boot, label in ((left, m.raw, MEAN), (centre, m.cross_normalised, f"{NORMALISED}, 95 %")):
        groups = [[boot.mean(key, m.study.players, own) for own in (True, False)] for key in FINAL]
        draw_bars(axes, groups, [[colour(k)] * 2 for k in FINAL], names, label, hatches=(None, "///"), fontsize=8.5)
    left.set_title("Mean rally length")
    centre.set_title("Normalised by the trainer's own")
    draw_bars(right, [[m.kept_ratio([key])] for key in FINAL], [[colour(key)] for key in FINAL], names, fontsize=8.5)
    for k, claim in enumerate(("keeps-is2r", "keeps-s2r")):
        mark_paper(right, k + 0.38, m.findings[claim].paper)
    right.axhline(1.0, color=FAINT, linewidth=0.8)
    show_percent(right.yaxis)
    right.set_title("Kept with other players")
    hatched = patch("other players", "#aaaaaa", hatch="///", edgecolor="white")
    add_legend(figure, [patch("own trainer", "#aaaaaa"), hatched, line("paper", **DIAMOND)])
    return figure


def draw_cross_by_player(m: Measurements) -> Figure | None:
    """Mean and normalised length of each trainer's policies with each evaluator (app:cross_eval_details)."""
    if not any(cell[1] != cell[2] for cell in m.raw.cells):
        return None
    trainers = m.study.players
    figure = Figure(figsize=(10, 2.2 * len(trainers)))
    for (left, right), trainer in zip(figure.subplots(len(trainers), 2, squeeze=False), trainers, strict=True):
        evaluators = (trainer, *CROSS[trainer])
        labels = [f"player {e[-1]}" + (" (own)" if e == trainer else "") for e in evaluators]
        for axes, boot, label in ((left, m.raw, LENGTH), (right, m.cross_normalised, "normalised")):
            groups = [[boot.evaluated(key, trainer, e) for key in FINAL] for e in evaluators]
            draw_bars(axes, groups, [[colour(key) for key in FINAL]] * len(evaluators), labels, label)
        left.set_title(f"Trained by {player_label(trainer)}: mean rally length")
        right.set_title("normalised by the trainer's own")
    add_legend(figure, [patch(SHORT[key], colour(key)) for key in FINAL])
    return figure


def draw_by_player(m: Measurements) -> Figure | None:
    """Mean and distribution of the rally length of each model, player by player (app:trainer_details)."""
    keys, players = held(m.raw, (*TEN, *(model.key for model in OTHER_WORLDS))), m.study.players
    if not keys:
        return None
    figure = Figure(figsize=(11, 2.35 * len(players)))
    for (left, right), player in zip(figure.subplots(len(players), 2, squeeze=False), players, strict=True):
        last = player == players[-1]
        draw_model_bars(left, [m.raw.evaluated(key, player, player) for key in keys], keys, "mean, 95 %", last)
        samples = [m.raw.pooled(key, (player,)) for key in keys]
        draw_boxes(right, samples, keys, LENGTH, log=True, labelled=last)
        left.set_title(player_label(player).capitalize())
        left.axhline(registry.skill(player).mean, color=INK, linestyle="--", linewidth=1.0)
    add_legend(figure, [line("paper: mean over the ten models", linestyle="--", linewidth=1.0)], "left")
    return figure


def draw_ablation(m: Measurements) -> Figure | None:
    """Zero-shot rally length by the distribution trained on (arbitarary_distributions)."""
    keys = [model.key for model in ABLATED]
    means = {key: m.raw.mean(key, m.study.players) for key in keys}
    if not any(means.values()):
        return None
    figure = Figure(figsize=(8.5, 3.6))
    left, right = figure.subplots(1, 2)
    draw_model_bars(left, list(means.values()), keys, MEAN)
    left.set_title("Zero-shot, mean")
    _boxes(right, m.raw, keys, "all", LENGTH, log=True)
    right.set_title("Zero-shot, distribution")
    oracle, share = means["oracle"], m.findings["large"].paper
    if oracle is not None and share is not None:
        mark_paper(left, keys.index("large"), share * oracle.value, 7)
        add_legend(figure, [line(f"paper: Large {1.0 - share:.0%} below the Oracle's".replace("%", " %"), **DIAMOND)])
    return figure


def draw_variant(m: Measurements) -> Figure | None:
    """The weights carried back to simulation against the variant that does not carry them."""
    if not any(m.raw.mean(model.key, m.study.players) for model in VARIANT):
        return None
    figure = Figure(figsize=(10, 3.6))
    left, right = figure.subplots(1, 2, width_ratios=(1.3, 1))
    pairs = [(f"is2r-{stage}", f"fresh-{stage}") for stage in STAGES[2:]]
    labels = ("sim 2", "fine-tuned 65 %", "sim 3", "fine-tuned 100 %")
    _grouped_means(left, m.raw, pairs, m.study.players, labels)
    left.set_ylabel(MEAN)
    left.set_title("All players")
    entries = {"carried back": IS2R, "not carried back": FRESH}
    add_legend(figure, [patch(label, COLOURS[method]) for label, method in entries.items()], "left")
    groups = ("all", *LEVELS)
    ratios = [m.length_ratio("is2r-ft100", "fresh-ft100", group) for group in groups]
    draw_ratios(right, ratios, groups, [COLOURS[IS2R]] * len(groups))
    right.set_title("Carried back / not, fine-tuned 100 %")
    return figure


def draw_identification(m: Measurements) -> Figure | None:
    """Rallies of i-S2R, round by round, by the world of its simulations."""
    prefixes = {IS2R: "is2r", RANDOMISED: "prior", IDENTIFIED: "id", BOUND: "bound"}
    shown = [k for k in prefixes if any(m.raw.mean(model.key, m.study.players) for model in METHODS[k])]
    if not set(shown) - {IS2R}:
        return None
    believed = m.raw.mean("is2r-sim1", m.study.players) is not None
    if not believed:
        shown = [method for method in shown if method != IS2R]
    labels = LEGEND | {IS2R: "as believed"}
    figure = Figure(figsize=(11 if believed else 6.6, 3.4 + 0.35 * len(set(shown) - {IS2R})))
    left, *right = figure.subplots(1, 1 + believed, width_ratios=(1.6, 1.0)[: 1 + believed], squeeze=False)[0]
    groups = [[f"{prefixes[method]}-{stage}" for method in shown] for stage in STAGES]
    _grouped_means(left, m.raw, groups, m.study.players, STAGE_LABELS)
    left.set_ylabel(MEAN)
    left.set_title("All players")
    add_legend(figure, [patch(labels[k], COLOURS[k]) for k in shown], "left", title="simulated world")
    for axes in right:
        stages = {"sim1": "sim 1", "sim3": "sim 3", "ft100": "100 %"}
        rows = [(stage, method) for stage in stages for method in shown[1:]]
        ratios = [m.length_ratio(f"{prefixes[method]}-{stage}", f"is2r-{stage}") for stage, method in rows]
        names = [f"{labels[method]}, {stages[stage]}" for stage, method in rows]
        draw_ratios(axes, ratios, names, [COLOURS[method] for _, method in rows])
        axes.set_title("Over that as believed")
    return figure


def draw_ends(m: Measurements) -> Figure | None:
    """Ends of the rallies by robot and human, by model, over all counted rallies with the own trainer."""
    models = [x for x in (*MODELS, *VARIANT, *OTHER_WORLDS) if len(m.study.pick(x.key, selected=False))]
    if not models:
        return None
    figure = Figure(figsize=(9, 0.32 * len(models) + 1.5))
    axes = figure.subplots()
    for row, model in enumerate(models):
        ended, left = m.study.pick(model.key, selected=False).robot_ended, 0.0
        dark = "white" if model.fine_tuned else INK
        for who, shade, ink in ((1, colour(model.key), dark), (0, "#bdbdbd", INK), (UNKNOWN, "#ffffff", INK)):
            share = 100 * float(np.mean(ended == who))
            axes.barh(row, share, left=left, color=shade, edgecolor="white", height=0.8)
            if share > 6:
                axes.text(left + share / 2, row, f"{share:.0f}", ha="center", va="center", color=ink, fontsize=8)
            left += share
    axes.set_yticks(range(len(models)), [model.label for model in models], fontsize=8)
    axes.invert_yaxis()
    axes.set_xlim(0, 100)
    axes.set_xlabel("rallies [%]: coloured ended by the robot, grey by the human")
    return figure


def draw_unselected(m: Measurements) -> Figure | None:
    """The comparison of i-S2R and S2R+FT on the reported rallies and on all that count."""
    if not held(m.raw, FINAL):
        return None
    figure = Figure(figsize=(8.5, 3.4))
    kinds = ((m.raw, "longest 5/6 of the first 60", COLOURS[IS2R]), (m.unselected, "every rally", FAINT))
    rows = [(group, *kind) for group in ("all", *LEVELS, WITHOUT) for kind in kinds]
    ratios = [m.length_ratio("is2r-ft100", "s2r-ft100", group, boot=boot) for group, boot, *_ in rows]
    labels = [f"{'all players' if group == 'all' else group}: {name}" for group, _, name, _ in rows]
    shades = [shade for *_, shade in rows]
    draw_ratios(figure.subplots(), ratios, labels, shades, "mean rally length, i-S2R / S2R+FT, 95 %")
    return figure


def draw_summary(m: Measurements) -> Figure | None:
    """The claims about ratios: ours with its interval, the paper's where it states a number."""
    shown = [f for f in m.findings.values() if f.unit == RATIO and f.interval is not None and f.claim.summary]
    if not shown:
        return None
    figure = Figure(figsize=(10.5, 0.36 * len(shown) + 1.4))
    axes = figure.subplots()
    labels, methods = ([f.claim.summary[key] for f in shown] for key in ("label", "method"))
    xlabel = "ratio of mean rally lengths (log scale), 95 % intervals; diamonds: the paper's numbers"
    draw_ratios(axes, [f.interval for f in shown], labels, [COLOURS[method] for method in methods], xlabel)
    for row, f in enumerate(shown):
        if f.paper is not None:
            mark_paper(axes, f.paper, row, 7)
        axes.annotate(f.verdict, (1.01, row), xycoords=("axes fraction", "data"), va="center", fontsize=8.5, color=INK)
    return figure


def _mean(boot: Bootstrap, key: str, group: str) -> Measured:
    return interval_of(boot.mean(key, of_level(group)))


def _means(axes: Axes, boot: Bootstrap, keys: Sequence[str], group: str, ylabel: str) -> None:
    draw_model_bars(axes, [_mean(boot, key, group) for key in keys], keys, ylabel)


def _boxes(axes: Axes, boot: Bootstrap, keys: Sequence[str], group: str, ylabel: str, log: bool = False) -> None:
    draw_boxes(axes, [boot.pooled(key, of_level(group)) for key in keys], keys, ylabel, log)


def _grouped_means(
    axes: Axes,
    boot: Bootstrap,
    groups: Sequence[Sequence[str]],
    players: Sequence[str],
    labels: Sequence[str],
    **label_style: object,
) -> None:
    """Bars of the mean length of groups of models."""
    means = [[boot.mean(key, players) for key in group] for group in groups]
    draw_bars(axes, means, [[colour(key) for key in group] for group in groups], labels, **label_style)


FIGURES: dict[str, Callable[[Measurements], Figure | None]] = {
    "summary": draw_summary,
    "aggregated": draw_aggregated,
    "aggregated_means": draw_means,
    "by_skill": draw_by_skill,
    "without_advanced": lambda m: draw_means(m, WITHOUT),
    "checkpoints": draw_checkpoints,
    "zero_shot": draw_zero_shot,
    "fine_tuning": draw_fine_tuning,
    "evolution": human_model_figures.draw_evolution,
    "changes": human_model_figures.draw_changes,
    "effects": draw_effects,
    "cross": draw_cross,
    "cross_players": draw_cross_by_player,
    "players": draw_by_player,
    "heatmap_incoming": lambda m: heatmaps.draw_heatmaps(m.study, heatmaps.incoming),
    "heatmap_outgoing": lambda m: heatmaps.draw_heatmaps(m.study, heatmaps.outgoing),
    "ablation": draw_ablation,
    "variant": draw_variant,
    "identification": draw_identification,
    "ends": draw_ends,
    "unselected": draw_unselected,
    "calibration": human_model_figures.draw_calibration,
}
