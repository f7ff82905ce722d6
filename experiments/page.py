"""A page of HTML that needs nothing else: pictures embedded and kept as PNG, tables, sections."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

from matplotlib.figure import Figure

from ballmodel.files import replacing
from mjx_tt.gap.plots import png
from mjx_tt.gap.report import STYLE


class Page:
    """Sections in the order of reading; what is added is HTML, and ``escape`` is the caller's."""

    def __init__(self, title: str, subtitle: str, style: str = "") -> None:
        self.title, self.subtitle, self.style = title, subtitle, style
        self.pictures: dict[str, bytes] = {}
        self._sections: list[tuple[str, str, list[str]]] = []

    def section(self, key: str, heading: str) -> None:
        """What follows stands under this heading; ``key`` is its anchor."""
        self._sections.append((key, heading, []))

    def add(self, html: str) -> None:
        self._sections[-1][2].append(html)

    def paragraph(self, text: str, css: str = "") -> None:
        """Plain text."""
        self.add(f'<p class="{css}">{escape(text)}</p>' if css else f"<p>{escape(text)}</p>")

    def picture(self, name: str, figure: Figure, caption: str, alt: str) -> None:
        """A picture with a caption of plain text; ``alt`` for who cannot see it."""
        self.pictures[name] = png(figure)
        source = base64.b64encode(self.pictures[name]).decode("ascii")
        self.add(
            f'<figure><div class="wide"><img src="data:image/png;base64,{source}" alt="{escape(alt)}"></div>'
            f"<figcaption>{escape(caption)}</figcaption></figure>"
        )

    def html(self) -> str:
        """The page; the anchors of its sections at the top."""
        links = " · ".join(f'<a href="#{key}">{escape(heading)}</a>' for key, heading, _ in self._sections)
        body = "\n".join(
            f'<section id="{key}">\n<h2>{escape(heading)}</h2>\n' + "\n".join(parts) + "\n</section>"
            for key, heading, parts in self._sections
        )
        return (
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<meta name="viewport"'
            f' content="width=device-width, initial-scale=1">\n<title>{escape(self.title)}</title>\n'
            f"<style>{STYLE}{self.style}</style>\n</head>\n<body>\n<header>\n<h1>{escape(self.title)}</h1>\n"
            f'<p class="sub">{escape(self.subtitle)}</p>\n<nav class="note">{links}</nav>\n</header>\n'
            f"<main>\n{body}\n</main>\n</body>\n</html>\n"
        )

    def write(self, folder: Path) -> Path:
        """Writes index.html and the pictures as PNG; returns the page's path."""
        folder.mkdir(parents=True, exist_ok=True)
        for name, data in self.pictures.items():
            with replacing(folder / f"{name}.png") as temporary:
                temporary.write_bytes(data)
        with replacing(folder / "index.html") as temporary:
            temporary.write_text(self.html(), encoding="utf-8")
        return folder / "index.html"


def table(head: Sequence[str], rows: Iterable[Sequence[str]], right: Sequence[int] = ()) -> str:
    """A table; cells are HTML, columns ``right`` hold numbers."""

    def row(tag: str, cells: Sequence[str]) -> str:
        classes = ["" if k not in right else " class=n" for k in range(len(cells))]
        return "<tr>" + "".join(f"<{tag}{c}>{cell}</{tag}>" for c, cell in zip(classes, cells)) + "</tr>"

    top, body = row("th", [escape(h) for h in head]), "".join(row("td", r) for r in rows)
    return f'<div class="wide"><table class="many"><thead>{top}</thead><tbody>{body}</tbody></table></div>'


def details(summary: str, html: str) -> str:
    """Something that opens when it is asked for."""
    return f"<details><summary>{escape(summary)}</summary>{html}</details>"
