"""The report of a study: the paper's figures and tables with ours beside them, and what agrees.

All prose is in the templates: ``study.html``, in the order of a reader's questions, and ``findings.txt``, the first
sentences. A part that a study lacks is named in its place.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from functools import cached_property
from pathlib import Path

import matplotlib
import numpy as np
import yaml
from markupsafe import Markup, escape
from matplotlib.figure import Figure

from experiments.study.analysis.claims import NOT_COMPARABLE, PLAYS, VERDICTS, WIDEST, Measurements, show, show_interval
from experiments.study.analysis.paper import FINAL, LEVELS, SHORT, of_level
from experiments.study.analysis.scoring import KEEP
from experiments.study.analysis.statistics import FEWEST_SEEDS, Estimate, Interval, name_chance
from experiments.study.analysis.study_folder import StudyFolder, load
from experiments.study.paths import REPORT
from experiments.study.report import figures, tables, tsne
from experiments.study.report.plots import STYLE
from mjx_tt.rally.end_reasons import End
from mjx_tt.viz.html import Page, details, environment, table

ABSENT = "this study holds nothing of it."
MOST_MISSING = 12  # that are listed at once


def write(folder: Path) -> Path:
    """Writes report/index.html, its pictures and its tables into a study's folder; returns the page's path.

    Raises ConfigError where there is no study or a file of it cannot be read.
    """
    report = Report(load(folder))
    report.compose()
    target = folder / REPORT
    report.page.write(target, target.parent)
    for name, content in report.tables.items():
        content.write(target.parent / f"{name}.csv")
    return target


class Report:
    """Pictures, tables and claims of one study, each by the name that the template calls."""

    def __init__(self, study: StudyFolder) -> None:
        self.study, self.measured = study, Measurements(study)
        self.findings = self.measured.findings
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
        rallies = self.study.rallies
        self._templates.get_template("study.html").render(
            study=self.study,
            section=self._section,
            picture=self._picture,
            table=self._table,
            claims=self._claims,
            note=lambda caller: Markup('<p class="note">{}</p>').format(_line(caller())),
            not_drawn=lambda caller: self._not_drawn(_line(caller())),
            details=lambda title, caller: Markup(details(title, caller())),
            badge=_badge,
            yaml=lambda data: yaml.safe_dump(data, sort_keys=False),
            json=lambda data: json.dumps(data, indent=2),
            sentences=self.sentences(),
            counts=self._counts(),
            broken_off=int(np.sum(rallies.selected & (rallies.end == End.NONE))),
            most_missing=MOST_MISSING,
            fewest_seeds=FEWEST_SEEDS,
            chance=name_chance(len(self.study.seeds)),
            rallies_reported=KEEP,
            widest=f"{WIDEST:g}",
            plays=f"{PLAYS:g}",
            seed=f"Seed {self.study.seeds[0]}. " if self.study.seeds else "",
        )

    def sentences(self) -> list[str]:
        """The findings in plain words, only of what was measured."""
        m = self.measured
        means = {SHORT[key]: mean.value for key in FINAL if (mean := m.raw.mean(key, of_level("all")))}
        unselected = m.length_ratio("is2r-ft100", "s2r-ft100", boot=m.unselected)
        text = self._templates.get_template("findings.txt").render(
            ratio=lambda a, b: _times(m.length_ratio(a, b)),
            found={key: f.interval for key, f in self.findings.items() if f.interval is not None},
            compared=compare,
            means=means,
            levels=LEVELS,
            changes=np.mean(list(m.changes.values()), axis=0).tolist() if m.changes else None,
            unselected=unselected and unselected.interval,
            counts=self._counts(),
            differing=[f.claim.text for f in self.findings.values() if f.verdict == "differs"],
        )
        return [Markup(line).unescape() for line in text.splitlines() if line.strip()]

    @cached_property
    def planes(self) -> list[tsne.Plane]:
        """The first seed's balls of each player."""
        found = (tsne.embed(self.study, player, seed) for seed in self.study.seeds[:1] for player in self.study.players)
        return [plane for plane in found if plane is not None]

    def draw(self, name: str) -> Figure | None:
        """The figure of that name; None where the study holds nothing of it."""
        with matplotlib.rc_context(STYLE):
            if name in tsne.PANELS:
                return tsne.draw(self.planes, tsne.PANELS[name])
            return figures.FIGURES[name](self.measured)

    def _counts(self) -> dict[str, int]:
        counted = Counter(f.verdict for f in self.findings.values())
        return {verdict: counted[verdict] for verdict in VERDICTS}

    # What the template calls

    def _section(self, key: str, heading: str, caller: Callable[[], Markup]) -> str:
        self.page.section(key, heading)
        self.page.add(caller().strip())
        return ""

    def _picture(self, name: str, caller: Callable[[], Markup]) -> Markup:
        caption, figure = _line(caller()), self.draw(name)
        if figure is None:
            return self._not_drawn(f"{caption.split('.')[0].split(':')[0]}: {ABSENT}")
        return Markup(self.page.picture(name, figure, escape(caption), caption.split(". ")[0]))

    def _table(self, name: str, title: str, opened: bool = False) -> Markup:
        content = self.tables[name] = tables.TABLES[name](self.measured)
        if not content.rows:
            return self._not_drawn(f"{title}: {ABSENT}")
        cells = [[_badge(cell) if cell in VERDICTS else escape(cell) for cell in row] for row in content.rows]
        html = Markup(table(content.head, cells, tuple(content.right)))
        return Markup("<h3>{}</h3>{}").format(title, html) if opened else Markup(details(title, html))

    def _claims(self, *keys: str) -> Markup:
        rows = []
        for f in (self.findings[key] for key in keys):
            ours = escape(ABSENT.capitalize())
            if f.interval is not None:
                ours = Markup("<b>{}</b> ({})").format(
                    show(f.unit, f.interval.value), show_interval(f.unit, f.interval)
                )
            said = Markup("{}<br><span class=note>{}</span>").format(f.claim.text, f.claim.source)
            paper = "" if f.paper is None else show(f.unit, f.paper)
            rows.append((_badge(f.verdict), said, escape(f.claim.quantity), paper, ours, escape(f.why)))
        return Markup(table(("", "the paper says", "measured", "paper", "here (95 %)", "why"), rows, (3,)))

    def _not_drawn(self, text: str) -> Markup:
        return Markup("<p>{} {}</p>").format(_badge(NOT_COMPARABLE), text)


def compare(ratio: Interval) -> str:
    """A ratio of rally lengths as what stands before "than": how much longer or shorter, with its interval."""
    value, low, high = (100.0 * (x - 1.0) for x in (ratio.value, ratio.low, ratio.high))
    if low <= 0.0 <= high:
        return f"not clearly longer or shorter ({value:+.0f} %, {low:+.0f} to {high:+.0f} %) than"
    return f"{abs(value):.0f} % {'longer' if value > 0 else 'shorter'} ({low:+.0f} to {high:+.0f} %) than"


def _times(ratio: Estimate | None) -> str | None:
    """A ratio of rally lengths in words, with its interval."""
    if ratio is None:
        return None
    i = ratio.interval
    return f"{i.value:.2f} times ({i.low:.2f} to {i.high:.2f})"


def _line(text: Markup) -> str:
    """The template's prose as plain text on one line."""
    return " ".join(text.unescape().split())


def _badge(verdict: str) -> Markup:
    return Markup('<span class="badge {}">{}</span>').format(verdict.replace(" ", "-"), verdict)


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
