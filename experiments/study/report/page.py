"""The report of a study: the paper's figures and tables with ours beside them, and what agrees.

All prose is in the template ``study.html``. A part that a study lacks is named in its place.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path

import matplotlib
import yaml
from markupsafe import Markup, escape

from experiments.runs import run_dir
from experiments.study.analysis.claims import NOT_COMPARABLE, PLAYS, VERDICTS, WIDEST, Measurements
from experiments.study.analysis.scoring import KEEP
from experiments.study.analysis.statistics import FEWEST_SEEDS, name_chance
from experiments.study.analysis.study_folder import StudyFolder, load
from experiments.study.paths import REPORT
from experiments.study.report import figures, tables
from mjx_tt.rally.end_reasons import End
from mjx_tt.viz.html import Page, details, environment, table


def write(folder: Path) -> Path:
    """Writes report/index.html, its pictures and its tables into a study's folder; returns the page's path.

    Raises ConfigError where there is no study or a file of it cannot be read.
    """
    target = folder / REPORT
    page, found = compose(load(folder))
    page.write(target, target.parent)
    for name, content in found.items():
        run_dir.write_csv(target.parent / f"{name}.csv", content.head, content.rows)
    return target


def compose(study: StudyFolder) -> tuple[Page, dict[str, tables.Table]]:
    """The page of a study, and its tables by name: the template calls what it shows."""
    measured, rallies, found = Measurements(study), study.rallies, dict[str, tables.Table]()
    templates = environment("experiments.study.report")
    subtitle = (
        f"{study.settings.get('name', study.folder.name)}: {len(study.players)} players, {len(study.seeds)} seeds, "
        f"{len(rallies):,} rallies, of which {int(rallies.selected.sum()):,} are reported"
    )
    page = Page(
        "Simulate, play, refine: the paper's study repeated", subtitle, css=templates.get_template("study.css").render()
    )

    def section(key: str, heading: str, caller: Callable[[], Markup]) -> str:
        page.section(key, heading)
        page.add(caller().strip())
        return ""

    def picture(name: str, caller: Callable[[], Markup]) -> Markup:
        caption = " ".join(caller().unescape().split())
        with matplotlib.rc_context(figures.STYLE):
            figure = figures.FIGURES[name](measured)
        if figure is None:
            return Markup("<p>{} {}: this study holds nothing of it.</p>").format(_badge(NOT_COMPARABLE), name)
        return Markup(page.picture(name, figure, escape(caption), caption.split(". ")[0]))

    def tabulate(name: str, title: str) -> Markup:
        content = found[name] = tables.TABLES[name](measured)
        if not content.rows:
            return Markup("<p>{} {}: this study holds nothing of it.</p>").format(_badge(NOT_COMPARABLE), title)
        cells = [[_badge(cell) if cell in VERDICTS else escape(cell) for cell in row] for row in content.rows]
        return Markup(details(title, Markup(table(content.head, cells, tuple(content.right)))))

    counted = Counter(f.verdict for f in measured.findings.values())
    templates.get_template("study.html").render(
        study=study,
        section=section,
        picture=picture,
        table=tabulate,
        details=lambda title, caller: Markup(details(title, caller())),
        badge=_badge,
        yaml=lambda data: yaml.safe_dump(data, sort_keys=False),
        counts={verdict: counted[verdict] for verdict in VERDICTS},
        broken_off=int((rallies.selected & (rallies.end == End.NONE)).sum()),
        fewest_seeds=FEWEST_SEEDS,
        chance=name_chance(len(study.seeds)),
        rallies_reported=KEEP,
        widest=f"{WIDEST:g}",
        plays=f"{PLAYS:g}",
    )
    return page, found


def _badge(verdict: str) -> Markup:
    return Markup('<span class="badge {}">{}</span>').format(verdict.replace(" ", "-"), verdict)
