"""The tables of a report: the paper's with ours beside them, and those of the statistics. ``TABLES`` names them all."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ballmodel import registry
from ballmodel.io.atomic_files import replacing
from experiments.stats import holm
from experiments.study.analysis import effect_costs
from experiments.study.analysis.claims import DIFFERENCE, HITS, Measurements, paper_changes, show, show_interval
from experiments.study.analysis.identified import PRIOR, holds, list_estimates
from experiments.study.analysis.paper import BY_KEY, CROSS, FINAL, GROUPS, LEVELS, SHORT, TEN, level, of_level
from experiments.study.analysis.statistics import FEWEST_SEEDS, compare_models, estimate_share, name_chance, t_mean
from experiments.study.analysis.study_folder import NUMBERS, ROUNDS, StudyFolder, numbers, paper_models, widths
from experiments.study.report.figures import TUNED
from experiments.study.report.plots import Measured, interval_of
from mjx_tt.rally.end_reasons import ROWS
from mjx_tt.sim.model import ModelFile

Row = tuple[str, ...]


@dataclass(frozen=True)
class Table:
    """A table of text; columns ``right`` hold numbers."""

    head: Row
    rows: Sequence[Row]
    right: Sequence[int] = ()

    def write(self, path: Path) -> None:
        """Writes it as CSV."""
        with replacing(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(self.head)
            writer.writerows(self.rows)


def tabulate_claims(m: Measurements) -> Table:
    """Every claim of the paper with ours and the verdict."""
    rows = []
    for f in m.findings.values():
        paper = "" if f.paper is None else show(f.unit, f.paper)
        ours, width = (
            ("", "") if f.interval is None else (show(f.unit, f.interval.value), show_interval(f.unit, f.interval))
        )
        rows.append((f.claim.text, f.claim.source, f.claim.quantity, paper, ours, width, f.verdict, f.why))
    head = ("claim", "source in the paper", "quantity", "paper", "here", "95 % interval", "verdict", "why")
    return Table(head, rows, (3, 4, 5))


def tabulate_quartiles(m: Measurements) -> Table:
    """Mean, median and quartiles of the normalised rally length (all_player_results, centre)."""
    rows = []
    for group in ("all", GROUPS[-1]):
        for key in FINAL:
            mean = interval_of(m.normalised.mean(key, of_level(group)))
            if mean is not None:
                quartiles = np.percentile(m.normalised.pooled(key, of_level(group)), (25, 50, 75))
                numbers_ = (f"{mean.value:+.2f}", show_interval(DIFFERENCE, mean), *(f"{q:+.2f}" for q in quartiles))
                rows.append((group, SHORT[key], *numbers_))
    return Table(("players", "method", "mean", "95 %", "25 %", "median", "75 %"), rows, range(2, 7))


def tabulate_skill(m: Measurements) -> Table:
    """Rally length by player over the ten models, ours above the paper's (table player_skill)."""
    rows: list[Row] = []
    for player in m.study.players:
        length, paper, name = m.study.pick(TEN, player).length, registry.skill(player), _player(player)
        if length.size:
            low, high = np.percentile(length, (25, 75))
            std = length.std(ddof=1) if length.size > 1 else float("nan")
            means = (f"{v:.1f}" for v in (low, length.mean(), std, high))
            rows.append((name, "here", f"{length.min()}", *means, f"{length.max()}", str(length.size)))
        theirs = (f"{v:g}" for v in (paper.min, paper.p25, paper.mean, paper.std, paper.p75, paper.max))
        rows.append((name, "paper", *theirs, "500"))
    return Table(("player", "", "min", "25 %", "mean", "std", "75 %", "max", "rallies"), rows, range(2, 9))


def tabulate_zero_shot(m: Measurements) -> Table:
    """Ratios of mean rally lengths, fine-tuned over zero-shot."""
    rows = [(group, *(_with_interval(m.length_ratio(b, a, group)) for a, b in TUNED.values())) for group in LEVELS]
    head = ("players", "35 % / sim 1", "65 % / sim 2", "100 % / sim 3", "Oracle fine-tuned / sim")
    return Table(head, rows, range(1, 5))


def tabulate_changes(m: Measurements) -> Table:
    """Changes of the human models, here (mean over seeds) and in the paper."""
    rows = []
    for player in m.study.players:
        ours, theirs = [v for (_, p), v in m.changes.items() if p == player], paper_changes(player)
        cells = [f"{100 * v:.1f} %" for v in np.mean(ours, axis=0)] if ours else ["", ""]
        rows.append((_player(player), cells[0], f"{100 * theirs[0]:.1f} %", cells[1], f"{100 * theirs[1]:.1f} %"))
    return Table(("player", "M0 to M1, here", "paper", "M1 to M2, here", "paper"), rows, range(1, 5))


def tabulate_deviations(m: Measurements) -> Table:
    """Median deviation of the human models from the paper's over the 16 numbers, in units of each quantity's width."""
    rows = []
    for player in m.study.players:
        theirs, cells = paper_models(player), []
        for model in ROUNDS:
            off = np.abs(_fitted(m.study, player, model) - numbers(theirs[model])) / widths(theirs)
            cells.append(f"{100 * np.median(off):.0f} %" if off.size else "")
        rows.append((player, *cells))
    return Table(("player", *(f"median deviation, {model}" for model in ROUNDS)), rows, (1, 2, 3))


def tabulate_distributions(m: Measurements) -> Table:
    """The numbers of M0, M1 and M2 of each player, mean over seeds and the paper's (table ball_dist)."""
    rows = []
    for player in m.study.players:
        columns = []
        for model, paper in paper_models(player).items():
            ours = _fitted(m.study, player, model)
            columns.append([f"{v:.2f}" for v in ours.mean(axis=0)] if ours.size else [""] * len(NUMBERS))
            columns.append([f"{v:.2f}" for v in numbers(paper)])
        rows += [(player, name, *cells) for name, *cells in zip(NUMBERS, *columns, strict=True)]
    head = ("player", "number [m, m/s]", *(f"{model} {who}" for model in ROUNDS for who in ("here", "paper")))
    return Table(head, rows, range(2, 8))


def tabulate_effects(m: Measurements) -> Table:
    """Rally length of each model in a reality without an effect over that with all, with 95 % intervals over seeds."""
    rows = []
    for world in effect_costs.WORLDS[1:]:
        gains = [effect_costs.estimate_gain(m.study.effects, model, world) for model in effect_costs.MODELS]
        if any(gains):
            rows.append((world, *map(_with_interval, gains)))
    head = ("left out", *(BY_KEY[model].label for model in effect_costs.MODELS))
    return Table(head, rows, range(1, len(head)))


def tabulate_cross(m: Measurements) -> Table:
    """Mean rally length of each trainer's final policies with each evaluator (table cross_eval)."""
    rows = []
    for trainer in m.study.players:
        for evaluator in (trainer, *CROSS[trainer]):
            means = [interval_of(m.raw.evaluated(key, trainer, evaluator)) for key in FINAL]
            if any(means):
                cells = ("" if mean is None else f"{mean.value:.1f} ({show_interval(HITS, mean)})" for mean in means)
                rows.append((trainer, evaluator + (" (own)" if evaluator == trainer else ""), *cells))
    return Table(("trainer", "evaluator", *(SHORT[key] for key in FINAL)), rows, (2, 3, 4))


def tabulate_inside(m: Measurements) -> Table:
    """Share of the balls of the final evaluations that lie inside each human model, over all seeds."""
    rows = []
    for player in m.study.players:
        for key in FINAL:
            shares = []
            for model in ROUNDS:
                found = []
                for seed in m.study.seeds:
                    log, fitted = m.study.log(seed, player, player, key), m.study.models_of(seed, player).get(model)
                    if log is not None and fitted is not None:
                        low, high = numbers(fitted).reshape(-1, 2, 1).transpose(1, 0, 2)
                        found.append(np.all((log.features >= low) & (log.features <= high), axis=0))
                shares.append(f"{100 * np.concatenate(found).mean():.0f} %" if found else "")
            if any(shares):
                rows.append((_player(player), SHORT[key], *shares))
    return Table(("player", "evaluation of", *(f"inside {model}" for model in ROUNDS)), rows, (2, 3, 4))


def tabulate_identified(m: Measurements) -> Table:
    """Parameters that were identified, round by round: 90 % of what training draws, and the opened reality."""
    rows = []
    for seed, player, name, row in _estimates(m.study):
        held, known = holds(row), row.get("truth")
        truth = f"{known:.4g}" if known is not None else "" if seed in m.study.realities else "sealed"
        values = (f"{row[key]:.4g}" for key in ("believed", "low", "high"))
        inside = {None: "", True: "yes", False: "no"}[held]
        rows.append((str(seed), player, name, row["parameter"], row["decided by"], *values, truth, inside))
    head = ("seed", "player", "round", "parameter", "decided by", "believed", "from", "to", "truth", "holds it")
    return Table(head, rows, range(5, 9))


def tabulate_coverage(m: Measurements) -> Table:
    """Share of the opened reality's values in the intervals of 90 %, by what decided them, over seeds.

    Each interval once: all players of a seed have those of its one log of joints, and those of the prior.
    """
    found: dict[tuple[str, str], dict[tuple[int, str, float, float], bool]] = {}
    for seed, _, name, row in _estimates(m.study):
        if (held := holds(row)) is not None:
            different = found.setdefault((name, row["decided by"]), {})
            different[seed, row["parameter"], row["low"], row["high"]] = held
    rows = []
    for (name, source), inside in sorted(found.items()):
        share = estimate_share((seed, held) for (seed, *_), held in inside.items())
        width = f"{100 * share.low:.0f} to {100 * share.high:.0f} %"
        if source == PRIOR:
            width = "none: given, not estimated"
        elif np.isnan(share.low):
            width = f"none: fewer than {FEWEST_SEEDS} seeds"
        rows.append((name, source, f"{sum(inside.values())} of {len(inside)}", f"{share.value:.0%}", width))
    head = ("round", "decided by", "different intervals of 90 % that hold the truth", "share", "95 % over seeds")
    return Table(head, rows, (2, 3, 4))


def tabulate_ends(m: Measurements) -> Table:
    """Counts of each row of the end-of-rally table (table end_of_rally_attribution)."""
    r = m.study.rallies
    groups = (r.own & np.isin(r.model, TEN), r.own & (r.model == FINAL[0]), r.own & (r.model == FINAL[1]), ~r.own)
    rows = []
    for number, (end, text, ended, filtered) in enumerate(ROWS, 1):
        counts = [int(np.sum(g & (r.end == end))) for g in groups]
        who = "filter" if filtered else {True: "robot", False: "human", None: "-"}[ended]
        shares = (f"{n:,} ({100 * n / max(g.sum(), 1):.1f} %)" for n, g in zip(counts, groups, strict=True))
        rows.append((str(number) if number <= 15 else "-", text, who, *shares))
    head = ("row", "how the rally ended", "ended by", "ten models", "i-S2R", "S2R+FT", "cross-evaluations")
    return Table(head, rows, range(3, 7))


def tabulate_significance(m: Measurements) -> Table:
    """Differences between the final models in every group, raw and normalised, with tests."""
    is2r, s2r, oracle = FINAL
    found = [
        (group, scale, a, b, d)
        for group in GROUPS
        for scale, boot in (("raw", m.raw), ("normalised", m.normalised))
        for a, b in ((is2r, s2r), (is2r, oracle), (oracle, s2r))
        if (d := compare_models(boot, a, b, of_level(group))) is not None
    ]
    adjusted = holm(d.p_rallies for *_, d in found)
    rows = []
    for (group, scale, a, b, d), p in zip(found, adjusted, strict=True):
        tests = (_p(x) for x in (d.p_welch, d.p_rallies, p, d.p_policies))
        spans = (show_interval(DIFFERENCE, d.bootstrap), show_interval(DIFFERENCE, d.welch))
        label = f"{SHORT[a]} − {SHORT[b]}"
        rows.append((group, scale, label, f"{d.bootstrap.value:+.2f}", *spans, *tests, str(d.pairs)))
    columns = (f"95 %, {name_chance(len(m.study.seeds))}", "95 %, Welch")
    p_columns = ("p Welch", "p permuted", "p permuted, Holm", "p policies")
    head = ("players", "scale", "difference", "mean", *columns, *p_columns, "pairs of policies")
    return Table(head, rows, range(3, len(head)))


def tabulate_models(m: Measurements) -> Table:
    """Rally length of every model in every group of players, with the intervals of three sources of chance."""
    fixed, over_seeds = Measurements(m.study, over_seeds=False), len(m.study.seeds) >= FEWEST_SEEDS
    rows = []
    for group in GROUPS:
        players = of_level(group)
        for model in BY_KEY:
            rallies, seeds = (interval_of(boot.mean(model, players)) for boot in (fixed.raw, m.raw))
            if rallies is None or seeds is None:
                continue
            length, every = (m.study.pick(model, players, selected=s).length for s in (True, False))
            t = t_mean(length)
            quartiles = (f"{q:.0f}" for q in np.percentile(length, (25, 50, 75)))
            spans = [show_interval(HITS, interval) for interval in (t, rallies, seeds)]
            if not over_seeds:
                spans[2] = f"fewer than {FEWEST_SEEDS} seeds"
            rest = (f"{length.max()}", f"{every.mean():.1f}", str(len(every)))
            rows.append((group, model, str(t.n), f"{seeds.value:.1f}", *spans, *quartiles, *rest))
    columns = ("t over rallies", "bootstrap over rallies", "bootstrap over seeds and rallies")
    statistics = ("25 %", "median", "75 %", "max", "mean, unselected", "rallies, unselected")
    head = ("players", "model", "rallies", "mean", *columns, *statistics)
    return Table(head, rows, range(2, len(head)))


def tabulate_rallies(m: Measurements) -> Table:
    """Numbers of rallies of each model."""
    r, rows = m.study.rallies, []
    for model in BY_KEY:
        mine = r.take(r.model == model)
        if len(mine):
            counts = (len(mine), *(np.sum(~mine.filtered & (mine.own == own)) for own in (True, False)))
            rows.append((model, *(f"{n:,}" for n in (*counts, np.sum(mine.selected)))))
    return Table(("model", "rallies played", "counted, own", "counted, others", "reported"), rows, range(1, 5))


def tabulate_calibration_medians(m: Measurements) -> Table:
    """Median deviations of the virtual players without a study."""
    medians = m.study.calibration.get("medians", {})
    rows = [(p, *(f"{100 * by[r]:.0f} %" if r in by else "" for r in ROUNDS)) for p, by in medians.items()]
    return Table(("player", *ROUNDS), rows, (1, 2, 3))


def _calibration_rows(part: str) -> Callable[[Measurements], Table]:
    def tabulate(m: Measurements) -> Table:
        rows = m.study.calibration[part]
        head = tuple(rows[0])
        return Table(head, [tuple(str(row.get(key, "")) for key in head) for row in rows])

    return tabulate


TABLES: dict[str, Callable[[Measurements], Table]] = {
    "claims": tabulate_claims,
    "normalised": tabulate_quartiles,
    "player_skill": tabulate_skill,
    "zero_shot": tabulate_zero_shot,
    "distances": tabulate_changes,
    "deviations": tabulate_deviations,
    "ball_distributions": tabulate_distributions,
    "effects": tabulate_effects,
    "cross": tabulate_cross,
    "inside": tabulate_inside,
    "identified": tabulate_identified,
    "coverage": tabulate_coverage,
    "ends": tabulate_ends,
    "significance": tabulate_significance,
    "models": tabulate_models,
    "rallies": tabulate_rallies,
    "calibration_medians": tabulate_calibration_medians,
    "calibration_numbers": _calibration_rows("numbers"),
    "calibration_rallies": _calibration_rows("rallies"),
}


def _fitted(study: StudyFolder, player: str, model: str) -> np.ndarray:
    """(seeds, 16) the numbers of a player's human model in the seeds that have it."""
    models = [study.models_of(seed, player).get(model) for seed in study.seeds]
    return np.array([numbers(d) for d in models if d is not None]).reshape(-1, len(NUMBERS))


def _estimates(study: StudyFolder) -> Iterator[tuple[int, str, str, dict[str, Any]]]:
    """Seed, player, round and each row of every world that was identified."""
    for path in sorted(study.folder.glob("seed*/player*/identified/world*.yaml")):
        seed, player = int(path.parents[2].name[4:]), path.parents[1].name
        opened = study.realities.get(seed)
        for row in list_estimates(ModelFile.load(path), None if opened is None else opened["reality"]):
            yield seed, player, path.stem, row


def _with_interval(measured: Measured) -> str:
    """A ratio with its interval, if it has one."""
    interval = interval_of(measured)
    if interval is None:
        return ""
    value = f"{interval.value:.2f}"
    return value if np.isnan(interval.low) else f"{value} ({interval.low:.2f} to {interval.high:.2f})"


def _player(name: str) -> str:
    return f"{name} ({level(name)})"


def _p(p: float) -> str:
    return "< 0.001" if p < 0.001 else f"{p:.3f}"
