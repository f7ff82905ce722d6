"""Pictures that the paper does not have: summary, zero-shot and fine-tuned, the variant, ends, unselected."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from experiments.finetuning.report import smooth
from experiments.study.analysis import effect_costs
from experiments.study.analysis.claims import RATIO, Finding, Measurements
from experiments.study.analysis.paper import (
    ABLATION,
    BY_KEY,
    FINAL,
    FRESH,
    IS2R,
    LEARNED,
    LEVELS,
    MODELS,
    ORACLE,
    OTHER_WORLDS,
    S2R,
    VARIANT,
    WITHOUT,
    of_level,
)
from experiments.study.analysis.scoring import UNKNOWN
from experiments.study.analysis.study_folder import Study
from experiments.study.report.style import (
    COLOUR,
    bar,
    colour,
    forest,
    has,
    interval_of,
    level_label,
    mean_of,
    note_empty,
    styled,
)
from mjx_tt.viz.html import FAINT, INK

CYCLES = {
    S2R: ("is2r-ft35", "s2r-ft65", "s2r-ft100"),
    IS2R: ("is2r-ft35", "is2r-ft65", "is2r-ft100"),
    ORACLE: ("oracle-ft",),
}
PAIRS = (
    ("is2r-sim1", "is2r-ft35"),
    ("is2r-sim2", "is2r-ft65"),
    ("is2r-sim3", "is2r-ft100"),
    ("oracle-sim", "oracle-ft"),
)


@styled
def zero_shot(study: Study, m: Measurements) -> Figure | None:
    """Zero-shot against fine-tuned by skill level."""
    if not has(m.raw, [key for pair in PAIRS for key in pair]):
        return None
    figure = Figure(figsize=(11, 3.8))
    names = ("sim 1 → 35 %", "sim 2 → 65 %", "sim 3 → 100 %", "Oracle")
    for axes, name in zip(figure.subplots(1, 3), LEVELS, strict=True):
        for k, pair in enumerate(PAIRS):
            for key, offset in zip(pair, (-0.2, 0.2), strict=True):
                bar(axes, k + offset, mean_of(m.raw, key, name), colour(key), 0.38)
        axes.set_xticks(range(len(PAIRS)), names, fontsize=7)
        axes.set_title(level_label(name))
        note_empty(axes)
    figure.axes[0].set_ylabel("mean rally length, 95 %")
    labels = {
        "is2r-sim1": "zero-shot",
        "is2r-ft35": "fine-tuned",
        "oracle-sim": "Oracle, zero-shot",
        "oracle-ft": "Oracle, fine-tuned",
    }
    handles = [Patch(facecolor=colour(key), label=label) for key, label in labels.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=4)
    return figure


@styled
def fine_tuning(study: Study, m: Measurements) -> Figure | None:
    """Share of the balls that the perturbed policies return during fine-tuning in reality, by skill level."""
    curves = {
        (name, method): [c for p in of_level(name) for seed in study.seeds if (c := _tuned(study, seed, p, keys)).size]
        for name in LEVELS
        for method, keys in CYCLES.items()
    }
    if not any(curves.values()):
        return None
    figure = Figure(figsize=(11, 3.8))
    for axes, name in zip(figure.subplots(1, 3, sharey=True), LEVELS, strict=True):
        for method in CYCLES:
            found = curves[name, method]
            for curve in found:
                axes.plot(curve, color=COLOUR[method], linewidth=0.6, alpha=0.35)
            if found:
                shared = min(map(len, found))
                axes.plot(np.mean([curve[:shared] for curve in found], axis=0), color=COLOUR[method], linewidth=2.0)
        axes.set_title(level_label(name))
        axes.set_xlabel("updates in reality")
        axes.yaxis.set_major_formatter(lambda v, _: f"{v:.0%}")
        axes.grid(axis="y", alpha=0.25)
        note_empty(axes)
    figure.axes[0].set_ylim(0.0, max(0.05, figure.axes[0].get_ylim()[1]))  # of all: the axis is shared
    figure.axes[0].set_ylabel("returned while fine-tuning")
    handles = [
        Line2D([], [], color=COLOUR[k], label=label)
        for k, label in ((IS2R, "i-S2R"), (S2R, "S2R+FT"), (ORACLE, "S2R-Oracle+FT"))
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure


def _tuned(study: Study, seed: int, player: str, keys: tuple[str, ...]) -> np.ndarray:
    """Return rate over the updates of cycles that follow one another, smoothed within each; NaN between them."""
    parts: list[np.ndarray] = []
    for key in keys:
        rate = np.array([row["return_rate"] for row in study.metrics(seed, player, key) if "return_rate" in row])
        if not rate.size:
            return np.zeros(0)
        parts += [smooth(rate), np.array([np.nan])]
    return np.concatenate(parts)


@styled
def effects_left_out(study: Study) -> Figure | None:
    """Rally length without an effect over that with all, by model."""
    table = {
        (model, world): effect_costs.gain(study.effects, model, world)
        for model in effect_costs.MODELS
        for world in effect_costs.WORLDS[1:]
    }
    if not any(table.values()):
        return None
    ratio = np.array(
        [
            [np.nan if (g := table[model, world]) is None else g.value for model in effect_costs.MODELS]
            for world in effect_costs.WORLDS[1:]
        ]
    )
    figure = Figure(figsize=(8.6, 4.6))
    axes = figure.subplots()
    limit = max(np.log2(1.5), float(np.nanmax(np.abs(np.log2(ratio)))))
    image = axes.imshow(np.log2(ratio), cmap="RdBu", vmin=-limit, vmax=limit, aspect="auto")
    for row, column in np.ndindex(ratio.shape):
        found = table[effect_costs.MODELS[column], effect_costs.WORLDS[1 + row]]
        if found is not None and np.isfinite(found.value):
            sure = not (np.isnan(found.low) or found.low <= 1.0 <= found.high)
            dark = abs(np.log2(found.value)) > 0.6 * limit
            axes.text(
                column,
                row,
                f"{found.value:.2f}",
                ha="center",
                va="center",
                fontsize=9,
                color="white" if dark else INK,
                fontweight="bold" if sure else "normal",
            )
    axes.set_xticks(
        range(len(effect_costs.MODELS)),
        [BY_KEY[k].label.replace(" fine", "\nfine") for k in effect_costs.MODELS],
        fontsize=8,
    )
    axes.set_yticks(range(len(effect_costs.WORLDS) - 1), effect_costs.WORLDS[1:])
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    axes.set_ylabel("left out of reality")
    figure.colorbar(image, label="rally length, times", format=lambda v, _: f"{2.0**v:.2g}")
    return figure


@styled
def variant(study: Study, m: Measurements) -> Figure | None:
    """The weights carried back to simulation against the variant that does not carry them."""
    if all(m.raw.mean(model.key, study.players) is None for model in VARIANT):
        return None
    figure = Figure(figsize=(10, 3.6))
    left, right = figure.subplots(1, 2, width_ratios=(1.3, 1))
    stages = ("sim2", "ft65", "sim3", "ft100")
    for k, stage in enumerate(stages):
        for key, offset in ((f"is2r-{stage}", -0.2), (f"fresh-{stage}", 0.2)):
            bar(left, k + offset, interval_of(m.raw.mean(key, study.players)), colour(key), 0.38)
    left.set_xticks(range(4), ("sim 2", "fine-tuned 65 %", "sim 3", "fine-tuned 100 %"))
    left.set_ylabel("mean rally length, 95 %")
    left.set_title("All players")
    figure.legend(
        handles=[
            Patch(facecolor=COLOUR[IS2R], label="carried back"),
            Patch(facecolor=COLOUR[FRESH], label="not carried back"),
        ],
        loc="outside lower left",
        ncols=2,
    )
    groups = ("all", *LEVELS)
    ratios = [interval_of(m.ratio("is2r-ft100", "fresh-ft100", group)) for group in groups]
    forest(right, ratios, groups, [COLOUR[IS2R]] * len(groups))
    right.set_title("Carried back / not, fine-tuned 100 %")
    return figure


@styled
def identification(study: Study, m: Measurements) -> Figure | None:
    """Rallies of i-S2R, round by round, by the world of its simulations."""
    played = [p for p, models in LEARNED.items() if any(m.raw.mean(x.key, study.players) is not None for x in models)]
    if not played:
        return None
    believed = m.raw.mean("is2r-sim1", study.players) is not None
    figure = Figure(figsize=(11 if believed else 6.6, 3.4 + 0.35 * len(played)))
    widths = (1.6, 1.0) if believed else (1.0,)
    left, *right = figure.subplots(1, len(widths), width_ratios=widths, squeeze=False)[0]
    stages = ("sim1", "ft35", "sim2", "ft65", "sim3", "ft100")
    methods = {
        "is2r": "as believed",
        "prior": "drawn from the prior",
        "id": "identified",
        "bound": "the reality itself",
    }
    shown = [prefix for prefix in methods if prefix in (("is2r", *played) if believed else played)]
    width = 0.8 / len(shown)
    for k, stage in enumerate(stages):
        for i, prefix in enumerate(shown):
            key = f"{prefix}-{stage}"
            place = k + (i - 0.5 * (len(shown) - 1)) * width
            bar(left, place, interval_of(m.raw.mean(key, study.players)), colour(key), 0.95 * width)
    names = ("sim 1", "fine-tuned\n35 %", "sim 2", "fine-tuned\n65 %", "sim 3", "fine-tuned\n100 %")
    left.set_xticks(range(len(stages)), names)
    left.set_ylabel("mean rally length, 95 %")
    left.set_title("All players")
    figure.legend(
        handles=[Patch(facecolor=colour(f"{prefix}-ft100"), label=methods[prefix]) for prefix in shown],
        title="simulated world",
        loc="outside lower left",
        ncols=len(shown),
    )
    if not right:
        return figure
    compared = [(prefix, stage) for stage in ("sim1", "sim3", "ft100") for prefix in shown[1:]]
    ratios = [interval_of(m.ratio(f"{prefix}-{stage}", f"is2r-{stage}", "all")) for prefix, stage in compared]
    labels = [
        f"{methods[prefix]}, {stage.replace('sim', 'sim ').replace('ft100', '100 %')}" for prefix, stage in compared
    ]
    forest(right[0], ratios, labels, [colour(f"{prefix}-ft100") for prefix, _ in compared])
    right[0].set_title("Over that as believed")
    return figure


@styled
def ends(study: Study, m: Measurements) -> Figure | None:
    """Ends of the rallies by robot and human, by model, over all counted rallies with the own trainer."""
    keys = [model.key for model in (*MODELS, *VARIANT, *OTHER_WORLDS) if len(study.pick(model.key, selected=False))]
    if not keys:
        return None
    figure = Figure(figsize=(9, 0.32 * len(keys) + 1.5))
    axes = figure.subplots()
    for row, key in enumerate(keys):
        ended = study.pick(key, selected=False).robot_ended
        shares = [100 * np.mean(ended == value) for value in (1, 0, UNKNOWN)]
        left = 0.0
        for share, shade, text in zip(
            shares,
            (colour(key), "#bdbdbd", "#ffffff"),
            (INK if not BY_KEY[key].fine_tuned else "white", INK, INK),
            strict=True,
        ):
            axes.barh(row, share, left=left, color=shade, edgecolor="white", height=0.8)
            if share > 6:
                axes.text(left + share / 2, row, f"{share:.0f}", ha="center", va="center", color=text, fontsize=8)
            left += share
    axes.set_yticks(range(len(keys)), [BY_KEY[key].label for key in keys], fontsize=8)
    axes.invert_yaxis()
    axes.set_xlim(0, 100)
    axes.set_xlabel("rallies [%]: coloured ended by the robot, grey by the human")
    return figure


@styled
def unselected(study: Study, m: Measurements) -> Figure | None:
    """The comparison of i-S2R and S2R+FT on the reported rallies and on all that count."""
    if not has(m.raw, FINAL):
        return None
    figure = Figure(figsize=(8.5, 3.4))
    axes = figure.subplots()
    groups = ("all", *LEVELS, WITHOUT)
    rows, labels, colours = [], [], []
    for group in groups:
        for boot, name, shade in (
            (m.raw, "longest 5/6 of the first 60", COLOUR[IS2R]),
            (m.unselected, "every rally", FAINT),
        ):
            rows.append(interval_of(m.ratio("is2r-ft100", "s2r-ft100", group, boot=boot)))
            labels.append(f"{group + ' players' if group == 'all' else group}: {name}")
            colours.append(shade)
    forest(axes, rows, labels, colours)
    axes.set_xlabel("mean rally length, i-S2R / S2R+FT, 95 %")
    return figure


@styled
def summary(findings: Sequence[Finding]) -> Figure | None:
    """The claims about ratios: ours with its interval, the paper's where it states a number."""
    shown = [f for f in findings if f.unit == RATIO and f.interval is not None and f.claim.key in SUMMARY]
    if not shown:
        return None
    figure = Figure(figsize=(10.5, 0.36 * len(shown) + 1.4))
    axes = figure.subplots()
    shades = [COLOUR[SUMMARY[f.claim.key][1]] for f in shown]
    forest(axes, [f.interval for f in shown], [SUMMARY[f.claim.key][0] for f in shown], shades)
    for row, f in enumerate(shown):
        if f.paper is not None:
            axes.plot(f.paper, row, "D", color=INK, markerfacecolor="white", markersize=7, zorder=6)
        axes.annotate(f.verdict, (1.01, row), xycoords=("axes fraction", "data"), va="center", fontsize=8.5, color=INK)
    axes.set_xlabel("ratio of mean rally lengths (log scale), 95 % intervals; diamonds: the paper's numbers")
    return figure


SUMMARY = {
    "all-ratio": ("i-S2R / S2R+FT, all players", IS2R),
    "beginner": ("i-S2R / S2R+FT, beginners", IS2R),
    "intermediate": ("i-S2R / S2R+FT, intermediate", IS2R),
    "advanced": ("i-S2R / S2R+FT, advanced", IS2R),
    "cross": ("i-S2R / S2R+FT, other players", IS2R),
    "keeps-is2r": ("other players / own, i-S2R", IS2R),
    "keeps-s2r": ("other players / own, S2R+FT", S2R),
    "oracle-beginner": ("S2R-Oracle+FT / i-S2R, beginners", ORACLE),
    "oracle-intermediate": ("S2R-Oracle+FT / i-S2R, intermediate", ORACLE),
    "fine-tuning": ("fine-tuned 35 % / sim 1", IS2R),
    "drop-sim2": ("sim 2 / fine-tuned 35 %", IS2R),
    "drop-sim3": ("sim 3 / fine-tuned 65 %", IS2R),
    "converge-beginner": ("fine-tuned 100 % / 65 %, beginners", IS2R),
    "converge-intermediate": ("fine-tuned 100 % / 65 %, intermediate", IS2R),
    "carried": ("weights carried back / not", FRESH),
    "large": ("Large / Oracle distribution, zero-shot", ABLATION),
    "medium": ("Medium / Oracle distribution, zero-shot", ABLATION),
}
