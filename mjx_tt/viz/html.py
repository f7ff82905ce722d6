"""Reports as one page of HTML that needs no other file: Jinja2 templates, embedded figures, and the figures' style.

Figures are embedded and written beside the page as PNG. No pyplot: nothing global keeps them.
A report with templates of its own calls ``environment("its.package")``; ``macros.html`` holds tables, figures and
folded parts. Content is escaped unless it is Markup.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import matplotlib
from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib import RcParams
from matplotlib.figure import Figure

from ballmodel.io.atomic_files import replacing

INK, FAINT = "#22272e", "#9aa3ad"
WIDTH = 7.6  # [inch] of a figure: its letters stay legible where a phone shows it 350 pixels wide
LINK = "#0b62a4"
STYLE = RcParams(
    {
        "font.size": 10,
        "font.family": "sans-serif",
        "text.color": INK,
        "axes.edgecolor": FAINT,
        "axes.labelcolor": INK,
        "axes.linewidth": 0.8,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.titlesize": 10.5,
        "axes.titlelocation": "left",
        "axes.axisbelow": True,
        "axes.unicode_minus": True,
        "xtick.color": INK,
        "ytick.color": INK,
        "legend.frameon": False,
    }
)


def png(figure: Figure) -> bytes:
    """PNG of a figure in STYLE."""
    stream = io.BytesIO()
    with matplotlib.rc_context(STYLE):
        engine = figure.get_layout_engine()
        if engine is not None:  # laid out once; saving would draw all of it another time to do that
            engine.execute(figure)
            figure.set_layout_engine("none")
        figure.savefig(stream, format="png", dpi=160, facecolor="white")
    return stream.getvalue()


def environment(*packages: str) -> Environment:
    """Jinja2 environment of these packages' folders ``templates``; page.html and macros.html lie behind them."""
    loaders = [PackageLoader(name) for name in (*packages, "mjx_tt.viz")]
    made = Environment(
        loader=ChoiceLoader(loaders), autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=StrictUndefined
    )
    made.globals.update(ink=INK, faint=FAINT, link=LINK)
    return made


_environment = environment()


def _macro(name: str) -> Callable[..., Markup]:
    return getattr(_environment.get_template("macros.html").module, name)


@dataclass
class Section:
    """A part of the page; ``key`` is its anchor."""

    key: str
    heading: str
    parts: list[Markup] = field(default_factory=list)


class Page:
    """Sections in the order of reading. Added parts are HTML: rendered templates, or text the caller has escaped.

    subtitle: plain text; badge: HTML below it; css: added to that of every page.
    """

    def __init__(self, title: str, subtitle: str, badge: str = "", css: str = "") -> None:
        self.title, self.subtitle, self.badge, self.css = title, subtitle, Markup(badge), Markup(css)
        self.pictures: dict[str, bytes] = {}
        self.sections: list[Section] = []

    def section(self, key: str, heading: str) -> None:
        """Opens a section, to which later parts are added."""
        self.sections.append(Section(key, heading))

    def add(self, html: str) -> None:
        """Adds HTML to the section."""
        self.sections[-1].parts.append(Markup(html))

    def paragraph(self, text: str) -> None:
        """Adds plain text."""
        self.add(Markup("<p>{}</p>").format(text))

    def embed(self, name: str, figure: Figure) -> str:
        """Source of an image that holds the figure, which is kept under its name."""
        self.pictures[name] = png(figure)
        return "data:image/png;base64," + base64.b64encode(self.pictures[name]).decode("ascii")

    def picture(self, name: str, figure: Figure, caption: str, alt: str) -> str:
        """HTML of a figure, which is kept under its name; ``caption`` is HTML, ``alt`` plain text."""
        return str(_macro("figure")(self.embed(name, figure), alt, caller=lambda: Markup(caption)))

    def html(self) -> str:
        """Complete page, with links to its sections at the top."""
        return _environment.get_template("page.html").render(page=self) + "\n"

    def write(self, path: Path, pictures: Path) -> list[Path]:
        """Writes the page and, into the folder ``pictures``, its figures; returns all paths, the page first.

        Raises OSError when that cannot be done; files that were there stay whole.
        """
        path.parent.mkdir(parents=True, exist_ok=True)
        pictures.mkdir(parents=True, exist_ok=True)
        written = []
        for name, data in self.pictures.items():
            written.append(pictures / f"{name}.png")
            with replacing(written[-1]) as temporary:
                temporary.write_bytes(data)
        with replacing(path) as temporary:
            temporary.write_text(self.html(), encoding="utf-8")
        return [path, *written]


def table(head: Sequence[str], rows: Iterable[Sequence[str]], right: Sequence[int] = ()) -> str:
    """Table of plain headings and cells of HTML; columns ``right`` hold numbers."""
    return str(_macro("table")(head, [[Markup(cell) for cell in row] for row in rows], right))


def details(summary: str, html: str) -> str:
    """HTML that is folded under a plain summary."""
    return str(_macro("details")(summary, caller=lambda: Markup(html)))
