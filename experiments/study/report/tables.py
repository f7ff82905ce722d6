"""The tables of a report: the paper's with ours beside them, and those of the statistics; as CSV and as HTML."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ballmodel import registry
from ballmodel.io.atomic_files import replacing
from experiments.stats import holm
from experiments.study.analysis import effect_costs
from experiments.study.analysis.claims import Finding, Measurements, paper_changes, show, span
from experiments.study.analysis.identified import PRIOR, estimates, holds
from experiments.study.analysis.paper import (
    ABLATED,
    BY_KEY,
    CROSS,
    FINAL,
    GROUPS,
    MODELS,
    OTHER_WORLDS,
    SHORT,
    TEN,
    VARIANT,
    level,
    of_level,
)
from experiments.study.analysis.statistics import FEWEST_SEEDS, Interval, chance, share_of, t_mean
from experiments.study.analysis.study_folder import NUMBERS, ROUNDS, Study, numbers, paper_models, widths
from mjx_tt.rally.end_reasons import ROWS, End
from mjx_tt.sim.model import ModelFile


@dataclass(frozen=True)
class Table:
    """A table of text; columns ``right`` hold numbers."""

    head: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    right: tuple[int, ...] = ()

    def write(self, path: Path) -> None:
        """Writes it as CSV."""
        with replacing(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(self.head)
            writer.writerows(self.rows)


def claims(findings: Sequence[Finding]) -> Table:
    """Every claim of the paper with ours and the verdict."""
    rows = []
    for f in findings:
        paper = "" if f.paper is None else show(f.unit, f.paper)
        ours, width = ("", "") if f.interval is None else (show(f.unit, f.interval.value), span(f.unit, f.interval))
        rows.append((f.claim.text, f.claim.source, f.claim.quantity, paper, ours, width, f.verdict, f.why))
    return Table(
        ("claim", "source in the paper", "quantity", "paper", "here", "95 % interval", "verdict", "why"),
        rows,
        (3, 4, 5),
    )


def effects_left_out(study: Study) -> Table:
    """Rally length of each model in a reality without an effect over that with all, with 95 % intervals over seeds."""

    def cell(gain: Interval | None) -> str:
        if gain is None or np.isnan(gain.low):  # one seed has no interval
            return "" if gain is None else f"{gain.value:.2f}"
        return f"{gain.value:.2f} ({gain.low:.2f} to {gain.high:.2f})"

    rows = []
    for world in effect_costs.WORLDS[1:]:
        gains = [effect_costs.gain(study.effects, model, world) for model in effect_costs.MODELS]
        if any(gains):
            rows.append((world, *map(cell, gains)))
    head = ("left out", *(BY_KEY[model].label for model in effect_costs.MODELS))
    return Table(head, rows, tuple(range(1, len(head))))


def models(study: Study, m: Measurements) -> Table:
    """Rally length of every model in every group of players, with the intervals of three sources of chance."""
    fixed, over_seeds = Measurements(study, over_seeds=False), len(study.seeds) >= FEWEST_SEEDS
    rows = []
    for group in GROUPS:
        for model in (*MODELS, *VARIANT, *OTHER_WORLDS, *ABLATED):
            by_rallies, by_seeds = (b.raw.mean(model.key, of_level(group)) for b in (fixed, m))
            if by_rallies is None or by_seeds is None:
                continue
            rallies, seeds = by_rallies.interval, by_seeds.interval
            chosen = study.pick(model.key, of_level(group))
            t, every = t_mean(chosen.length), study.pick(model.key, of_level(group), selected=False)
            quartiles = (f"{q:.0f}" for q in np.percentile(chosen.length, (25, 50, 75)))
            rows.append(
                (
                    group,
                    model.key,
                    str(t.n),
                    f"{seeds.value:.1f}",
                    span("hits", t),
                    span("hits", rallies),
                    span("hits", seeds) if over_seeds else f"fewer than {FEWEST_SEEDS} seeds",
                    *quartiles,
                    f"{chosen.length.max()}",
                    f"{every.length.mean():.1f}",
                    str(len(every)),
                )
            )
    head = (
        "players",
        "model",
        "rallies",
        "mean",
        "t over rallies",
        "bootstrap over rallies",
        "bootstrap over seeds and rallies",
        "25 %",
        "median",
        "75 %",
        "max",
        "mean, unselected",
        "rallies, unselected",
    )
    return Table(head, rows, tuple(range(2, len(head))))


def significance(m: Measurements) -> Table:
    """Differences between the final models, with tests."""
    found = m.differences()
    adjusted = holm(d.p_rallies for *_, d in found)
    rows = [
        (
            group,
            scale,
            f"{SHORT[a]} − {SHORT[b]}",
            f"{d.bootstrap.value:+.2f}",
            span("difference", d.bootstrap),
            span("difference", d.welch),
            _p(d.p_welch),
            _p(d.p_rallies),
            _p(p),
            _p(d.p_policies),
            str(d.pairs),
        )
        for (group, scale, a, b, d), p in zip(found, adjusted, strict=True)
    ]
    head = (
        "players",
        "scale",
        "difference",
        "mean",
        f"95 %, {chance(len(m.study.seeds))}",
        "95 %, Welch",
        "p Welch",
        "p permuted",
        "p permuted, Holm",
        "p policies",
        "pairs of policies",
    )
    return Table(head, rows, tuple(range(3, len(head))))


def skill(study: Study) -> Table:
    """Rally length by player over the ten models, ours above the paper's (table player_skill)."""
    rows: list[tuple[str, ...]] = []
    for player in study.players:
        length = study.pick(TEN, player).length
        paper = registry.skill(player)
        if length.size:
            low, high = np.percentile(length, (25, 75))
            std = length.std(ddof=1) if length.size > 1 else float("nan")
            ours = (
                f"{length.min()}",
                f"{low:.1f}",
                f"{length.mean():.1f}",
                f"{std:.1f}",
                f"{high:.1f}",
                f"{length.max()}",
            )
            rows.append((f"{player} ({level(player)})", "here", *ours, str(length.size)))
        theirs = (f"{v:g}" for v in (paper.min, paper.p25, paper.mean, paper.std, paper.p75, paper.max))
        rows.append((f"{player} ({level(player)})", "paper", *theirs, "500"))
    return Table(("player", "", "min", "25 %", "mean", "std", "75 %", "max", "rallies"), rows, tuple(range(2, 9)))


def distributions(study: Study) -> Table:
    """The numbers of M0, M1 and M2 of each player, mean over seeds and the paper's (table ball_dist)."""
    rows = []
    for player in study.players:
        fitted = [study.models_of(seed, player) for seed in study.seeds]
        theirs = {name: numbers(d) for name, d in paper_models(player).items()}
        for k, name in enumerate(NUMBERS):
            cells = []
            for model in ROUNDS:
                found = [numbers(d[model])[k] for d in fitted if model in d]
                cells += [f"{np.mean(found):.2f}" if found else "", f"{theirs[model][k]:.2f}"]
            rows.append((player, name, *cells))
    head = ("player", "number [m, m/s]", *(f"{m} {who}" for m in ROUNDS for who in ("here", "paper")))
    return Table(head, rows, tuple(range(2, 8)))


def deviations(study: Study) -> Table:
    """Median deviation of the human models from the paper's over the 16 numbers, in units of each quantity's width."""
    rows = []
    for player in study.players:
        theirs = paper_models(player)
        scale, cells = widths(theirs), []
        for model in ROUNDS:
            found = [study.models_of(seed, player).get(model) for seed in study.seeds]
            off = [np.abs(numbers(d) - numbers(theirs[model])) / scale for d in found if d is not None]
            cells.append(f"{100 * np.median(off):.0f} %" if off else "")
        rows.append((player, *cells))
    return Table(("player", *(f"median deviation, {m}" for m in ROUNDS)), rows, (1, 2, 3))


def change(study: Study, m: Measurements) -> Table:
    """Changes of the human models, here (mean over seeds) and in the paper."""
    rows = []
    for player in study.players:
        ours = np.array([v for (_, p), v in m.changes.items() if p == player])
        theirs = paper_changes(player)
        cells = [f"{100 * v:.1f} %" for v in ours.mean(axis=0)] if len(ours) else ["", ""]
        rows.append(
            (f"{player} ({level(player)})", cells[0], f"{100 * theirs[0]:.1f} %", cells[1], f"{100 * theirs[1]:.1f} %")
        )
    return Table(("player", "M0 to M1, here", "paper", "M1 to M2, here", "paper"), rows, (1, 2, 3, 4))


def ends(study: Study) -> Table:
    """Counts of each row of the end-of-rally table (table end_of_rally_attribution)."""
    r = study.rallies
    groups = (r.own & np.isin(r.model, TEN), r.own & (r.model == FINAL[0]), r.own & (r.model == FINAL[1]), ~r.own)
    rows = []
    for number, (end, text, ended, filtered) in enumerate(ROWS, 1):
        counts = [int(np.sum(g & (r.end == end))) for g in groups]
        who = "filter" if filtered else {True: "robot", False: "human", None: "-"}[ended]
        rows.append(
            (
                str(number) if number <= 15 else "-",
                text,
                who,
                *(f"{n:,} ({100 * n / max(g.sum(), 1):.1f} %)" for n, g in zip(counts, groups, strict=True)),
            )
        )
    head = ("row", "how the rally ended", "ended by", "ten models", "i-S2R", "S2R+FT", "cross-evaluations")
    return Table(head, rows, (3, 4, 5, 6))


def identified(study: Study) -> Table:
    """Parameters that were identified, round by round: 90 % of what training draws, and the opened reality."""
    rows = []
    for seed, player, name, row in _estimates(study):
        held, known = holds(row), row.get("truth")
        truth = f"{known:.4g}" if known is not None else "" if seed in study.realities else "sealed"
        values = (f"{row[key]:.4g}" for key in ("believed", "low", "high"))
        inside = "" if held is None else "yes" if held else "no"
        rows.append((str(seed), player, name, row["parameter"], row["decided by"], *values, truth, inside))
    head = ("seed", "player", "round", "parameter", "decided by", "believed", "from", "to", "truth", "holds it")
    return Table(head, rows, (5, 6, 7, 8))


def coverage(study: Study) -> Table:
    """Share of the opened reality's values in the intervals of 90 %, by what decided them, over seeds.

    Each interval once: all players of a seed have those of its one log of joints, and those of the prior.
    """
    found: dict[tuple[str, str], dict[tuple[int, str, float, float], bool]] = {}
    for seed, _, name, row in _estimates(study):
        if (held := holds(row)) is not None:
            different = found.setdefault((name, row["decided by"]), {})
            different[seed, row["parameter"], row["low"], row["high"]] = held
    rows = []
    for (name, source), inside in sorted(found.items()):
        share = share_of((seed, held) for (seed, *_), held in inside.items())
        width = f"{100 * share.low:.0f} to {100 * share.high:.0f} %"
        if source == PRIOR:
            width = "none: given, not estimated"
        elif np.isnan(share.low):
            width = f"none: fewer than {FEWEST_SEEDS} seeds"
        rows.append((name, source, f"{sum(inside.values())} of {len(inside)}", f"{share.value:.0%}", width))
    head = ("round", "decided by", "different intervals of 90 % that hold the truth", "share", "95 % over seeds")
    return Table(head, rows, (2, 3, 4))


def _estimates(study: Study) -> Iterator[tuple[int, str, str, dict[str, Any]]]:
    """Seed, player, round and each row of every world that was identified."""
    for path in sorted(study.folder.glob("seed*/player*/identified/world*.yaml")):
        seed, player = int(path.parents[2].name[4:]), path.parents[1].name
        opened = study.realities.get(seed)
        truth = None if opened is None else opened["reality"]
        for row in estimates(ModelFile.load(path), truth):
            yield seed, player, path.stem, row


def cross(study: Study, m: Measurements) -> Table:
    """Mean rally length of each trainer's final policies with each evaluator (table cross_eval)."""
    rows = []
    for trainer in study.players:
        for evaluator in (trainer, *CROSS[trainer]):
            means = [m.raw.evaluated(key, trainer, evaluator) for key in FINAL]
            if any(means):
                cells = ["" if e is None else f"{e.value:.1f} ({span('hits', e.interval)})" for e in means]
                rows.append((trainer, evaluator + (" (own)" if evaluator == trainer else ""), *cells))
    return Table(("trainer", "evaluator", *(SHORT[key] for key in FINAL)), rows, (2, 3, 4))


def inside(study: Study) -> Table:
    """Share of the balls of the final evaluations that lie inside each human model, over all seeds."""
    rows = []
    for player in study.players:
        for key in FINAL:
            shares = []
            for model in ROUNDS:
                found = []
                for seed in study.seeds:
                    log, fitted = study.log(seed, player, player, key), study.models_of(seed, player).get(model)
                    if log is not None and fitted is not None:
                        low, high = numbers(fitted).reshape(-1, 2).T
                        found.append(np.all((log.features >= low[:, None]) & (log.features <= high[:, None]), axis=0))
                shares.append(f"{100 * np.concatenate(found).mean():.0f} %" if found else "")
            if any(shares):
                rows.append((f"{player} ({level(player)})", SHORT[key], *shares))
    return Table(("player", "evaluation of", *(f"inside {model}" for model in ROUNDS)), rows, (2, 3, 4))


def quartiles(study: Study, m: Measurements) -> Table:
    """Mean, median and quartiles of the normalised rally length (all_player_results, centre)."""
    rows = []
    for group in ("all", *GROUPS[-1:]):
        for key in FINAL:
            chosen = of_level(group)
            estimate = m.normalised.mean(key, chosen)
            if estimate is not None:
                mean = estimate.interval
                cells = [v for c, v in m.normalised.cells.items() if c[3] == key and c[1] in chosen]
                values = np.concatenate(cells)
                rows.append(
                    (
                        group,
                        SHORT[key],
                        f"{mean.value:+.2f}",
                        span("difference", mean),
                        *(f"{q:+.2f}" for q in np.percentile(values, (25, 50, 75))),
                    )
                )
    return Table(("players", "method", "mean", "95 %", "25 %", "median", "75 %"), rows, (2, 3, 4, 5, 6))


def ball_counts(study: Study) -> Table:
    """Blind protocol and volume: how many rallies each evaluation has."""
    rows = []
    for model in BY_KEY:
        own, cross_ = study.pick(model, selected=False), study.pick(model, own=False, selected=False)
        every = int(np.sum(study.rallies.model == model))
        if every:
            rows.append(
                (
                    model,
                    f"{every:,}",
                    f"{len(own):,}",
                    f"{len(cross_):,}",
                    f"{int(np.sum(study.rallies.selected & (study.rallies.model == model))):,}",
                )
            )
    return Table(("model", "rallies played", "counted, own", "counted, others", "reported"), rows, (1, 2, 3, 4))


def broken_off(study: Study) -> int:
    """Reported rallies that were broken off at the largest number of touches."""
    return int(np.sum(study.rallies.selected & (study.rallies.end == End.NONE)))


def _p(p: float) -> str:
    return "< 0.001" if p < 0.001 else f"{p:.3f}"
