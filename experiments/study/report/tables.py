"""The tables of a report: the paper's with ours beside them, and those of the statistics. ``TABLES`` names them all."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ballmodel import registry
from experiments.study.analysis.claims import HITS, Measurements, paper_changes, show, show_interval
from experiments.study.analysis.identified import holds, list_estimates
from experiments.study.analysis.paper import CROSS, FINAL, GROUPS, METHOD_OF, SHORT, TEN, level, of_level
from experiments.study.analysis.study_folder import StudyFolder
from mjx_tt.rally.end_reasons import ROWS
from mjx_tt.sim.model import ModelFile

Row = tuple[str, ...]


@dataclass(frozen=True)
class Table:
    """A table of text; columns ``right`` hold numbers."""

    head: Row
    rows: Sequence[Row]
    right: Sequence[int] = ()


def tabulate_claims(m: Measurements) -> Table:
    """Every claim of the paper with ours and the verdict."""
    rows = []
    for f in m.findings.values():
        paper = "" if f.paper is None else show(f.unit, f.paper)
        ours, width = (
            ("", "") if f.interval is None else (show(f.unit, f.interval.value), show_interval(f.unit, f.interval))
        )
        rows.append((f.verdict, f.claim.text, f.claim.source, f.claim.quantity, paper, ours, width, f.why))
    head = ("verdict", "claim", "source in the paper", "quantity", "paper", "here", "95 % interval", "why")
    return Table(head, rows, (4, 5, 6))


def tabulate_skill(m: Measurements) -> Table:
    """Rally length by player over the ten models, ours above the paper's (table player_skill)."""
    rows: list[Row] = []
    for player in m.study.players:
        length, paper, name = m.study.pick(TEN, player).length, registry.skill(player), f"{player} ({level(player)})"
        if length.size:
            low, high = np.percentile(length, (25, 75))
            std = length.std(ddof=1) if length.size > 1 else float("nan")
            means = (f"{v:.1f}" for v in (low, length.mean(), std, high))
            rows.append((name, "here", f"{length.min()}", *means, f"{length.max()}", str(length.size)))
        theirs = (f"{v:g}" for v in (paper.min, paper.p25, paper.mean, paper.std, paper.p75, paper.max))
        rows.append((name, "paper", *theirs, "500"))
    return Table(("player", "", "min", "25 %", "mean", "std", "75 %", "max", "rallies"), rows, range(2, 9))


def tabulate_changes(m: Measurements) -> Table:
    """Changes of the human models, here (mean over seeds) and in the paper."""
    rows = []
    for player in m.study.players:
        ours, theirs = [v for (_, p), v in m.changes.items() if p == player], paper_changes(player)
        cells = [f"{100 * v:.1f} %" for v in np.mean(ours, axis=0)] if ours else ["", ""]
        rows.append((player, cells[0], f"{100 * theirs[0]:.1f} %", cells[1], f"{100 * theirs[1]:.1f} %"))
    return Table(("player", "M0 to M1, here", "paper", "M1 to M2, here", "paper"), rows, range(1, 5))


def tabulate_cross(m: Measurements) -> Table:
    """Mean rally length of each trainer's final policies with each evaluator (table cross_eval)."""
    rows = []
    for trainer in m.study.players:
        for evaluator in (trainer, *CROSS[trainer]):
            means = [m.raw.evaluated(key, trainer, evaluator) for key in FINAL]
            if any(means):
                cells = ("" if x is None else f"{x.value:.1f} ({show_interval(HITS, x.interval)})" for x in means)
                rows.append((trainer, evaluator + (" (own)" if evaluator == trainer else ""), *cells))
    return Table(("trainer", "evaluator", *(SHORT[key] for key in FINAL)), rows, (2, 3, 4))


def tabulate_identified(m: Measurements) -> Table:
    """Parameters that were identified, round by round: 90 % of what training draws, and the opened reality."""
    rows = []
    for seed, player, name, row in _estimates(m.study):
        held, known = holds(row), row.get("truth")
        truth = f"{known:.4g}" if known is not None else "" if seed in m.study.realities else "not opened"
        values = (f"{row[key]:.4g}" for key in ("believed", "low", "high"))
        inside = {None: "", True: "yes", False: "no"}[held]
        rows.append((str(seed), player, name, row["parameter"], row["decided by"], *values, truth, inside))
    head = ("seed", "player", "round", "parameter", "decided by", "believed", "from", "to", "truth", "holds it")
    return Table(head, rows, range(5, 9))


def tabulate_coverage(m: Measurements) -> Table:
    """Share of the opened reality's values in the intervals of 90 %, by what decided them.

    Each interval once: all players of a seed have those of its one log of joints, and those of the prior.
    """
    found: dict[tuple[str, str], dict[tuple[int, str, float, float], bool]] = {}
    for seed, _, name, row in _estimates(m.study):
        if (held := holds(row)) is not None:
            different = found.setdefault((name, row["decided by"]), {})
            different[seed, row["parameter"], row["low"], row["high"]] = held
    rows = [
        (*key, f"{sum(inside.values())} of {len(inside)}", f"{sum(inside.values()) / len(inside):.0%}")
        for key, inside in sorted(found.items())
    ]
    return Table(("round", "decided by", "different intervals of 90 % that hold the truth", "share"), rows, (2, 3))


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


def tabulate_models(m: Measurements) -> Table:
    """Rally length of every model in every group of players."""
    rows = []
    for group in GROUPS:
        players = of_level(group)
        for model in METHOD_OF:
            mean = m.raw.mean(model, players)
            if mean is not None:
                length, every = (m.study.pick(model, players, selected=s).length for s in (True, False))
                quartiles = (f"{q:.0f}" for q in np.percentile(length, (25, 50, 75)))
                means = (f"{mean.value:.1f}", show_interval(HITS, mean.interval))
                rest = (f"{length.max()}", str(len(every)), f"{every.mean():.1f}")
                rows.append((group, model, str(len(length)), *means, *quartiles, *rest))
    head = ("players", "model", "reported", "mean", "95 %", "25 %", "median", "75 %", "max", "counted", "mean of these")
    return Table(head, rows, range(2, len(head)))


TABLES: dict[str, Callable[[Measurements], Table]] = {
    "claims": tabulate_claims,
    "models": tabulate_models,
    "player_skill": tabulate_skill,
    "distances": tabulate_changes,
    "cross": tabulate_cross,
    "coverage": tabulate_coverage,
    "identified": tabulate_identified,
    "ends": tabulate_ends,
}


def _estimates(study: StudyFolder) -> Iterator[tuple[int, str, str, dict[str, Any]]]:
    """Seed, player, round and each row of every world that was identified."""
    for path in sorted(study.folder.glob("seed*/player*/identified/world*.yaml")):
        seed, player = int(path.parents[2].name[4:]), path.parents[1].name
        opened = study.realities.get(seed)
        for row in list_estimates(ModelFile.load(path), None if opened is None else opened["reality"]):
            yield seed, player, path.stem, row
