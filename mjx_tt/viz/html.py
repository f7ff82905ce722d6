"""A report as one page of HTML that needs nothing else, and how its pictures look: colours, style, embedding.

Pictures are embedded and kept beside the page as PNG. Figures are made without pyplot, so that nothing global keeps
them.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

import matplotlib
from matplotlib.figure import Figure

from ballmodel.io.atomic_files import replacing

INK, FAINT = "#22272e", "#9aa3ad"
LINK = "#0b62a4"
STYLE = {
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


def png(figure: Figure) -> bytes:
    """The figure as a PNG in STYLE."""
    stream = io.BytesIO()
    with matplotlib.rc_context(STYLE):
        if figure.get_layout_engine() is not None:  # laid out once; saving would draw all of it another time to do that
            figure.get_layout_engine().execute(figure)
            figure.set_layout_engine("none")
        figure.savefig(stream, format="png", dpi=130, facecolor="white")
    return stream.getvalue()


class Page:
    """Sections in the order of reading. What is added is HTML, and ``escape`` is the caller's.

    subtitle: plain text; badge: HTML below it; css: besides CSS.
    """

    def __init__(self, title: str, subtitle: str, badge: str = "", css: str = "") -> None:
        self.title, self.subtitle, self.badge, self.css = title, subtitle, badge, css
        self.pictures: dict[str, bytes] = {}
        self._sections: list[tuple[str, str, list[str]]] = []

    def section(self, key: str, heading: str) -> None:
        """What is added from now on stands under this heading; ``key`` is its anchor."""
        self._sections.append((key, heading, []))

    def add(self, html: str) -> None:
        self._sections[-1][2].append(html)

    def paragraph(self, text: str, css: str = "") -> None:
        """Plain text."""
        self.add(f'<p class="{css}">{escape(text)}</p>' if css else f"<p>{escape(text)}</p>")

    def picture(self, name: str, figure: Figure, caption: str, alt: str) -> str:
        """HTML of a picture, which is kept under its name; ``caption`` is HTML, ``alt`` for who cannot see it."""
        self.pictures[name] = png(figure)
        source = base64.b64encode(self.pictures[name]).decode("ascii")
        return (
            f'<figure><div class="wide"><img src="data:image/png;base64,{source}" alt="{escape(alt)}"></div>'
            f"<figcaption>{caption}</figcaption></figure>"
        )

    def html(self) -> str:
        """The page; links to its sections at the top."""
        links = " · ".join(f'<a href="#{key}">{escape(heading)}</a>' for key, heading, _ in self._sections)
        body = "\n".join(
            f'<section id="{key}">\n<h2>{escape(heading)}</h2>\n' + "\n".join(parts) + "\n</section>"
            for key, heading, parts in self._sections
        )
        badge = f"<p>{self.badge}</p>\n" if self.badge else ""
        return (
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<meta name="viewport"'
            f' content="width=device-width, initial-scale=1">\n<title>{escape(self.title)}</title>\n'
            f"<style>{CSS}{self.css}</style>\n</head>\n<body>\n<header>\n<h1>{escape(self.title)}</h1>\n"
            f'<p class="sub">{escape(self.subtitle)}</p>\n{badge}<nav class="note">{links}</nav>\n</header>\n'
            f"<main>\n{body}\n</main>\n</body>\n</html>\n"
        )

    def write(self, path: Path, pictures: Path) -> list[Path]:
        """Writes the page and, into the folder ``pictures``, its pictures; returns all paths, the page first.

        Raises OSError when that cannot be done; what was there stays whole.
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
    """A table; cells are HTML, columns ``right`` hold numbers."""

    def row(tag: str, cells: Sequence[str]) -> str:
        classes = ["" if k not in right else " class=n" for k in range(len(cells))]
        return "<tr>" + "".join(f"<{tag}{c}>{cell}</{tag}>" for c, cell in zip(classes, cells)) + "</tr>"

    top, body = row("th", [escape(h) for h in head]), "".join(row("td", r) for r in rows)
    wide = ' class="many"' if len(head) > 4 else ""
    return f'<div class="wide"><table{wide}><thead>{top}</thead><tbody>{body}</tbody></table></div>'


def details(summary: str, html: str) -> str:
    """Something that opens when it is asked for."""
    return f"<details><summary>{escape(summary)}</summary>{html}</details>"


CSS = f"""
:root {{ color-scheme: light; }}
* {{ box-sizing: border-box; }}
body {{ margin: 0; background: #f4f5f7; color: {INK};
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }}
header, main {{ max-width: 1000px; margin: 0 auto; padding: 0 20px; }}
header {{ padding-top: 28px; }}
h1 {{ font-size: 1.7rem; margin: 0; }}
h2 {{ font-size: 1.25rem; margin: 0 0 .7rem; }}
h3 {{ font-size: 1rem; margin: 1.4rem 0 .4rem; }}
.sub, .note {{ color: #4d5661; }}
.sub {{ margin: .2rem 0 .8rem; overflow-wrap: anywhere; }}
.note {{ font-size: .88rem; }}
section {{ background: #fff; border: 1px solid #dfe3e8; border-radius: 8px; padding: 20px 24px; margin: 18px 0; }}
.badge {{ display: inline-block; padding: .1rem .6rem; border-radius: 4px; color: #fff; background: #4d5661;
  font-weight: 600; }}
figure {{ margin: 0 0 1.2rem; }}
figcaption {{ font-size: .9rem; color: #4d5661; margin-top: .4rem; }}
section > :last-child, section > :last-child > :last-child {{ margin-bottom: 0; }}
li {{ margin-bottom: .45rem; }}
.wide {{ overflow-x: auto; }}
img {{ display: block; width: 100%; min-width: 600px; height: auto; }}
table {{ border-collapse: collapse; width: 100%; font-size: .93rem; margin: .3rem 0 .6rem; }}
table.many {{ min-width: 560px; }}
th, td {{ text-align: left; vertical-align: top; padding: .35rem .8rem .35rem 0; border-bottom: 1px solid #e6e9ed; }}
th {{ font-weight: 600; color: #4d5661; border-bottom-color: {FAINT}; }}
.n {{ text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }}
code {{ font: .9em ui-monospace, SFMono-Regular, Menlo, Consolas, monospace; }}
.hash {{ overflow-wrap: anywhere; }}
summary {{ cursor: pointer; color: {LINK}; margin: .6rem 0; }}
@media (max-width: 640px) {{ section {{ padding: 14px 12px; }}
  header, main {{ padding-left: 10px; padding-right: 10px; }}
  td, th {{ padding-right: .5rem; }} }}
@media print {{ body {{ background: #fff; }} section {{ border: 0; }} }}
"""
