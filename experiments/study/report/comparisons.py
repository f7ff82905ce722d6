"""Figures that the paper does not have: summary, fine-tuning, costs of effects, variants, ends, unselected rallies."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from experiments.finetuning.report import smooth
from experiments.study.analysis import effect_costs, paper
from experiments.study.analysis.claims import Measurements
from experiments.study.analysis.scoring import UNKNOWN
from experiments.study.report import plots
from mjx_tt.viz.html import FAINT, INK

CYCLES = {  # of fine-tuning in reality, one after the other
    paper.S2R: ("is2r-ft35", "s2r-ft65", "s2r-ft100"),
    paper.IS2R: ("is2r-ft35", "is2r-ft65", "is2r-ft100"),
    paper.ORACLE: ("oracle-ft",),
}


def draw_fine_tuning(m: Measurements) -> Figure | None:
    """Share of the balls that the perturbed policies return during fine-tuning in reality, by skill level."""
    curves = {
        (group, method): [
            c for p in paper.of_level(group) for s in m.study.seeds if (c := _return_rates(m, s, p, keys)).size
        ]
        for group in paper.LEVELS
        for method, keys in CYCLES.items()
    }
    if not any(curves.values()):
        return None
    figure = Figure(figsize=(11, 3.8))
    for axes, group in zip(figure.subplots(1, 3, sharey=True), paper.LEVELS, strict=True):
        for method in CYCLES:
            found, shade = curves[group, method], paper.COLOURS[method]
            for curve in found:
                axes.plot(curve, color=shade, linewidth=0.6, alpha=0.35)
            if found:
                shared = min(map(len, found))
                axes.plot(np.mean([curve[:shared] for curve in found], axis=0), color=shade, linewidth=2.0)
        axes.set_title(plots.level_label(group))
        axes.set_xlabel("updates in reality")
        plots.show_percent(axes.yaxis)
        axes.grid(axis="y", alpha=0.25)
        plots.note_empty(axes)
    figure.axes[0].set_ylim(0.0, max(0.05, figure.axes[0].get_ylim()[1]))  # of all: the axis is shared
    figure.axes[0].set_ylabel("returned while fine-tuning")
    names = {paper.IS2R: "i-S2R", paper.S2R: "S2R+FT", paper.ORACLE: "S2R-Oracle+FT"}
    plots.add_legend(figure, [plots.line(name, paper.COLOURS[method]) for method, name in names.items()])
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
    gains = [[effect_costs.estimate_gain(m.study.effects, model, world) for model in models] for world in worlds]
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
            ink, weight = "white" if abs(log) > 0.6 * limit else INK, "bold" if sure else "normal"
            text = f"{gain.value:.2f}"
            axes.text(column, row, text, ha="center", va="center", fontsize=9, color=ink, fontweight=weight)
    names = [paper.BY_KEY[key].label.replace(" fine", "\nfine") for key in models]
    axes.set_xticks(range(len(models)), names, fontsize=8)
    axes.set_yticks(range(len(worlds)), worlds)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    axes.set_ylabel("left out of reality")
    figure.colorbar(image, label="rally length, times", format=lambda v, _: f"{2.0**v:.2g}")
    return figure


def draw_variant(m: Measurements) -> Figure | None:
    """The weights carried back to simulation against the variant that does not carry them."""
    if not any(m.raw.mean(model.key, m.study.players) for model in paper.VARIANT):
        return None
    figure = Figure(figsize=(10, 3.6))
    left, right = figure.subplots(1, 2, width_ratios=(1.3, 1))
    pairs = [(f"is2r-{stage}", f"fresh-{stage}") for stage in plots.STAGES[2:]]
    labels = ("sim 2", "fine-tuned 65 %", "sim 3", "fine-tuned 100 %")
    plots.draw_grouped_means(left, m.raw, pairs, m.study.players, labels)
    left.set_ylabel(plots.MEAN)
    left.set_title("All players")
    entries = {"carried back": paper.IS2R, "not carried back": paper.FRESH}
    plots.add_legend(figure, [plots.patch(label, paper.COLOURS[method]) for label, method in entries.items()], "left")
    groups = ("all", *paper.LEVELS)
    ratios = [m.length_ratio("is2r-ft100", "fresh-ft100", group) for group in groups]
    plots.draw_ratios(right, ratios, groups, [paper.COLOURS[paper.IS2R]] * len(groups))
    right.set_title("Carried back / not, fine-tuned 100 %")
    return figure


def draw_identification(m: Measurements) -> Figure | None:
    """Rallies of i-S2R, round by round, by the world of its simulations."""
    prefixes = {paper.IS2R: "is2r", paper.RANDOMISED: "prior", paper.IDENTIFIED: "id", paper.BOUND: "bound"}
    shown = [k for k in prefixes if any(m.raw.mean(model.key, m.study.players) for model in paper.METHODS[k])]
    if not set(shown) - {paper.IS2R}:
        return None
    believed = m.raw.mean("is2r-sim1", m.study.players) is not None
    if not believed:
        shown = [method for method in shown if method != paper.IS2R]
    labels = paper.LEGEND | {paper.IS2R: "as believed"}
    figure = Figure(figsize=(11 if believed else 6.6, 3.4 + 0.35 * len(set(shown) - {paper.IS2R})))
    left, *right = figure.subplots(1, 1 + believed, width_ratios=(1.6, 1.0)[: 1 + believed], squeeze=False)[0]
    groups = [[f"{prefixes[method]}-{stage}" for method in shown] for stage in plots.STAGES]
    plots.draw_grouped_means(left, m.raw, groups, m.study.players, plots.STAGE_LABELS)
    left.set_ylabel(plots.MEAN)
    left.set_title("All players")
    plots.add_legend(figure, [plots.patch(labels[k], paper.COLOURS[k]) for k in shown], "left", title="simulated world")
    for axes in right:
        stages = {"sim1": "sim 1", "sim3": "sim 3", "ft100": "100 %"}
        rows = [(stage, method) for stage in stages for method in shown[1:]]
        ratios = [m.length_ratio(f"{prefixes[method]}-{stage}", f"is2r-{stage}") for stage, method in rows]
        names = [f"{labels[method]}, {stages[stage]}" for stage, method in rows]
        plots.draw_ratios(axes, ratios, names, [paper.COLOURS[method] for _, method in rows])
        axes.set_title("Over that as believed")
    return figure


def draw_ends(m: Measurements) -> Figure | None:
    """Ends of the rallies by robot and human, by model, over all counted rallies with the own trainer."""
    models = [
        x for x in (*paper.MODELS, *paper.VARIANT, *paper.OTHER_WORLDS) if len(m.study.pick(x.key, selected=False))
    ]
    if not models:
        return None
    figure = Figure(figsize=(9, 0.32 * len(models) + 1.5))
    axes = figure.subplots()
    for row, model in enumerate(models):
        ended, left = m.study.pick(model.key, selected=False).robot_ended, 0.0
        dark = "white" if model.fine_tuned else INK
        for who, shade, ink in ((1, plots.colour(model.key), dark), (0, "#bdbdbd", INK), (UNKNOWN, "#ffffff", INK)):
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
    if not plots.held(m.raw, paper.FINAL):
        return None
    figure = Figure(figsize=(8.5, 3.4))
    kinds = ((m.raw, "longest 5/6 of the first 60", paper.COLOURS[paper.IS2R]), (m.unselected, "every rally", FAINT))
    rows = [(group, *kind) for group in ("all", *paper.LEVELS, paper.WITHOUT) for kind in kinds]
    ratios = [m.length_ratio("is2r-ft100", "s2r-ft100", group, boot=boot) for group, boot, *_ in rows]
    labels = [f"{'all players' if group == 'all' else group}: {name}" for group, _, name, _ in rows]
    shades = [shade for *_, shade in rows]
    plots.draw_ratios(figure.subplots(), ratios, labels, shades, "mean rally length, i-S2R / paper.S2R+FT, 95 %")
    return figure


def draw_summary(m: Measurements) -> Figure | None:
    """The claims about ratios: ours with its interval, the paper's where it states a number."""
    shown = [(f, s) for f in m.findings.values() if f.interval is not None and (s := f.claim.summary) is not None]
    if not shown:
        return None
    figure = Figure(figsize=(10.5, 0.36 * len(shown) + 1.4))
    axes = figure.subplots()
    ratios, labels = [f.interval for f, _ in shown], [s["label"] for _, s in shown]
    shades = [paper.COLOURS[s["method"]] for _, s in shown]
    xlabel = "ratio of mean rally lengths (log scale), 95 % intervals; diamonds: the paper's numbers"
    plots.draw_ratios(axes, ratios, labels, shades, xlabel)
    for row, (f, _) in enumerate(shown):
        if f.paper is not None:
            plots.mark_paper(axes, f.paper, row, 7)
        axes.annotate(f.verdict, (1.01, row), xycoords=("axes fraction", "data"), va="center", fontsize=8.5, color=INK)
    return figure
