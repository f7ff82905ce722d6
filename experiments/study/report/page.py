"""The report of a study: the paper's figures and tables with ours beside them, and what agrees.

The prose, in the order of a reader's questions, is the template study.html. A part that a study lacks is named in its
place.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cached_property
from pathlib import Path

import yaml
from markupsafe import Markup, escape
from matplotlib.figure import Figure

from experiments.study.analysis.claims import NOT_COMPARABLE, VERDICTS, Measurements, findings, show, span
from experiments.study.analysis.claims import __doc__ as RULES
from experiments.study.analysis.paper import LEVELS, RALLIES, WITHOUT
from experiments.study.analysis.statistics import FEWEST_SEEDS, Estimate, chance
from experiments.study.analysis.study_folder import Study, load
from experiments.study.report import figures, further_figures, heatmaps, human_model_figures, tables, tsne
from experiments.study.report import text as words
from mjx_tt.viz.html import Page, details, environment, table

REPORT = "report"
ABSENT = "This study holds nothing of it."
MOST_MISSING = 12  # that are listed at once


def write(folder: Path) -> Path:
    """Writes report/index.html, its pictures and its tables into a study's folder; returns the page's path.

    Raises ConfigError where there is no study or a file of it cannot be read.
    """
    study = load(folder)
    report = Report(study)
    report.compose()
    target = study.folder / REPORT
    path, *_ = report.page.write(target / "index.html", target)
    for name, content in report.tables.items():
        content.write(target / f"{name}.csv")
    return path


class Report:
    """Pictures, tables and claims of one study, each by the name that the template calls."""

    def __init__(self, study: Study) -> None:
        self.study, self.measured = study, Measurements(study)
        self.findings = {f.claim.key: f for f in findings(self.measured)}
        self.tables: dict[str, tables.Table] = {}
        self._templates = environment("experiments.study.report")
        name = study.settings.get("name", study.folder.name)
        subtitle = (
            f"{name}: {_count(len(study.players), 'player')}, {_count(len(study.seeds), 'seed')}, "
            f"{len(study.rallies):,} rallies, of which {int(study.rallies.selected.sum()):,} are reported"
        )
        style = self._templates.get_template("study.css").render()
        self.page = Page("Simulate, play, refine: the paper's study repeated", subtitle, css=style)

    def compose(self) -> None:
        """Fills the page's sections from the template."""
        self._templates.get_template("study.html").render(
            study=self.study,
            section=self._section,
            picture=self._picture,
            table=self._table,
            claims=self._claims,
            all_claims=self._all_claims,
            note=lambda caller: Markup('<p class="note">{}</p>').format(_line(caller())),
            not_drawn=lambda caller: self._not_drawn(_line(caller())),
            details=lambda title, caller: Markup(details(title, caller())),
            badge=_badge,
            yaml=lambda data: yaml.safe_dump(data, sort_keys=False),
            json=lambda data: json.dumps(data, indent=2),
            sentences=words.sentences(self.measured, self.findings),
            counts={v: sum(f.verdict == v for f in self.findings.values()) for v in VERDICTS},
            broken_off=tables.broken_off(self.study),
            most_missing=MOST_MISSING,
            fewest_seeds=FEWEST_SEEDS,
            chance=chance(len(self.study.seeds)),
            rallies_reported=RALLIES,
            seed=f"Seed {self.study.seeds[0]}. " if self.study.seeds else "",
            rules=RULES,
        )

    @cached_property
    def planes(self) -> list[tsne.Plane]:
        """The first seed's balls of each player."""
        found = (tsne.embed(self.study, player, seed) for seed in self.study.seeds[:1] for player in self.study.players)
        return [plane for plane in found if plane is not None]

    # What the template calls

    def _section(self, key: str, heading: str, caller: Callable[[], Markup]) -> str:
        self.page.section(key, heading)
        self.page.add(caller().strip())
        return ""

    def _picture(self, name: str, caller: Callable[[], Markup]) -> Markup:
        caption, figure = _line(caller()), FIGURES[name](self)
        if figure is None:
            return self._not_drawn(f"{caption.split('.')[0].split(':')[0]}: {ABSENT[0].lower() + ABSENT[1:]}")
        return Markup(self.page.picture(name, figure, escape(caption), caption.split(". ")[0]))

    def _table(self, name: str, title: str, opened: bool = False) -> Markup:
        content = self.tables[name] = TABLES[name](self)
        if not content.rows:
            return self._not_drawn(f"{title}: {ABSENT[0].lower() + ABSENT[1:]}")
        html = Markup(table(content.head, [tuple(map(escape, row)) for row in content.rows], content.right))
        return Markup("<h3>{}</h3>{}").format(title, html) if opened else Markup(details(title, html))

    def _claims(self, *keys: str) -> Markup:
        rows = []
        for f in (self.findings[key] for key in keys):
            ours = escape(ABSENT)
            if f.interval is not None:
                ours = Markup("<b>{}</b> ({})").format(show(f.unit, f.interval.value), span(f.unit, f.interval))
            said = Markup("{}<br><span class=note>{}</span>").format(f.claim.text, f.claim.source)
            paper = "" if f.paper is None else show(f.unit, f.paper)
            rows.append((_badge(f.verdict), said, escape(f.claim.quantity), paper, ours, escape(f.why)))
        return Markup(table(("", "the paper says", "measured", "paper", "here (95 %)", "why"), rows, (3,)))

    def _all_claims(self) -> Markup:
        content = self.tables["claims"] = tables.claims(list(self.findings.values()))
        rows = [(*map(escape, row[:6]), _badge(row[6]), escape(row[7])) for row in content.rows]
        return Markup(table(content.head, rows, content.right))

    def _not_drawn(self, text: str) -> Markup:
        return Markup("<p>{} {}</p>").format(_badge(NOT_COMPARABLE), text)


def _zero_shot(report: Report) -> tables.Table:
    rows = [
        (name, *(_ratio_text(report.measured.ratio(b, a, name)) for a, b in further_figures.PAIRS)) for name in LEVELS
    ]
    head = ("players", "35 % / sim 1", "65 % / sim 2", "100 % / sim 3", "Oracle fine-tuned / sim")
    return tables.Table(head, rows, (1, 2, 3, 4))


def _calibration_medians(report: Report) -> tables.Table:
    rows = [
        (player, *(f"{100 * by[m]:.0f} %" if m in by else "" for m in ("M0", "M1", "M2")))
        for player, by in report.study.calibration.get("medians", {}).items()
    ]
    return tables.Table(("player", "M0", "M1", "M2"), rows, (1, 2, 3))


def _calibration(name: str) -> Callable[[Report], tables.Table]:
    def made(report: Report) -> tables.Table:
        lines = report.study.calibration[name]
        head = tuple(lines[0])
        return tables.Table(head, [tuple(str(line[key]) for key in head) for line in lines])

    return made


FIGURES: dict[str, Callable[[Report], Figure | None]] = {
    "summary": lambda r: further_figures.summary(list(r.findings.values())),
    "aggregated": lambda r: figures.aggregated(r.study, r.measured),
    "aggregated_means": lambda r: figures.means(r.study, r.measured),
    "by_skill": lambda r: figures.by_skill(r.study, r.measured),
    "without_advanced": lambda r: figures.means(r.study, r.measured, WITHOUT),
    "checkpoints": lambda r: figures.checkpoints(r.study, r.measured),
    "zero_shot": lambda r: further_figures.zero_shot(r.study, r.measured),
    "fine_tuning": lambda r: further_figures.fine_tuning(r.study, r.measured),
    "evolution": lambda r: human_model_figures.evolution(r.study, r.measured),
    "changes": lambda r: human_model_figures.changes(r.study, r.measured),
    "effects": lambda r: further_figures.effects_left_out(r.study),
    "cross": lambda r: figures.cross(r.study, r.measured),
    "cross_players": lambda r: figures.cross_by_player(r.study, r.measured),
    "players": lambda r: figures.by_player(r.study, r.measured),
    "tsne_training": lambda r: tsne.training(r.planes),
    "tsne_evaluation": lambda r: tsne.evaluation(r.planes),
    "tsne_methods": lambda r: tsne.methods(r.planes),
    "heatmap_incoming": lambda r: heatmaps.heatmaps(r.study, heatmaps.incoming),
    "heatmap_outgoing": lambda r: heatmaps.heatmaps(r.study, heatmaps.outgoing),
    "ablation": lambda r: figures.ablation(r.study, r.measured),
    "variant": lambda r: further_figures.variant(r.study, r.measured),
    "identification": lambda r: further_figures.identification(r.study, r.measured),
    "ends": lambda r: further_figures.ends(r.study, r.measured),
    "unselected": lambda r: further_figures.unselected(r.study, r.measured),
    "calibration": lambda r: human_model_figures.calibration(r.study.calibration),
}
TABLES: dict[str, Callable[[Report], tables.Table]] = {
    "normalised": lambda r: tables.quartiles(r.study, r.measured),
    "player_skill": lambda r: tables.skill(r.study),
    "zero_shot": _zero_shot,
    "distances": lambda r: tables.change(r.study, r.measured),
    "deviations": lambda r: tables.deviations(r.study),
    "ball_distributions": lambda r: tables.distributions(r.study),
    "effects": lambda r: tables.effects_left_out(r.study),
    "cross": lambda r: tables.cross(r.study, r.measured),
    "inside": lambda r: tables.inside(r.study),
    "identified": lambda r: tables.identified(r.study),
    "coverage": lambda r: tables.coverage(r.study),
    "ends": lambda r: tables.ends(r.study),
    "significance": lambda r: tables.significance(r.measured),
    "models": lambda r: tables.models(r.study, r.measured),
    "rallies": lambda r: tables.ball_counts(r.study),
    "calibration_medians": _calibration_medians,
    "calibration_numbers": _calibration("numbers"),
    "calibration_rallies": _calibration("rallies"),
}


def _line(text: Markup) -> str:
    """The template's prose as plain text on one line."""
    return " ".join(text.unescape().split())


def _ratio_text(estimate: Estimate | None) -> str:
    if estimate is None:
        return ""
    i = estimate.interval
    return f"{i.value:.2f} ({i.low:.2f} to {i.high:.2f})"


def _badge(verdict: str) -> Markup:
    return Markup('<span class="badge {}">{}</span>').format(verdict.replace(" ", "-"), verdict)


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
