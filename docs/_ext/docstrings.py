"""Sphinx extension: the project's docstrings as reStructuredText.

Docstrings are plain text with ``code``, indented blocks and lists of names in columns. Lists become definitions, blocks
literal text, and marks that reStructuredText would read are escaped.
"""

from __future__ import annotations

import dataclasses
import fnmatch
import inspect
import re
import textwrap
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sphinx.application import Sphinx


def setup(app: Sphinx) -> dict[str, Any]:
    """Entry point of the extension."""
    app.connect("autodoc-process-docstring", _readable)
    app.connect("autodoc-process-signature", _short)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _readable(app: Sphinx, what: str, name: str, value: Any, options: Any, lines: list[str]) -> None:
    told = {name for block in "\n".join(lines).split("\n\n") for name in _entries(block.splitlines())}
    lines[:] = as_rest(lines)
    if what == "class" and dataclasses.is_dataclass(value):
        for field, note in field_notes(value)[1].items():
            if field not in told and not any(field in names.split(", ") for names in told):
                lines += [f"``{field}``", f"   {_escaped(note)}", ""]


def _short(app: Sphinx, what: str, name: str, value: Any, options: Any, signature: str, returns: str) -> Any:
    """Signature of a dataclass that Sphinx cannot parse, without the modules of its types."""
    if "<factory>" not in (signature or ""):
        return None  # Sphinx can parse and link it
    return tuple(
        part and re.sub(r"~?(?:[A-Za-z_]\w*\.)+(\w+)", r"\1", part).replace("<factory>", "...")
        for part in (signature, returns)
    )


def as_rest(lines: list[str]) -> list[str]:
    """Docstring as reStructuredText: lists of names as definitions, indented blocks as literal text, marks escaped."""
    found: list[str] = []
    for block in "\n".join(lines).split("\n\n"):
        rows = [row for row in block.splitlines() if row.strip()]
        entries = _entries(rows)
        if entries:
            for name, text in entries.items():
                found += [f"``{name}``", f"   {_escaped(text)}"]
        elif rows and rows[0].startswith(" "):
            found += [".. code-block:: text", "", *("   " + row for row in rows)]
        else:
            found += _paragraph(rows)
        found.append("")
    return found


def field_notes(kind: type) -> tuple[str, dict[str, str]]:
    """First paragraph of a dataclass's docstring, and what docstring and comments say of each field."""
    blocks = (inspect.getdoc(kind) or "").split("\n\n")
    source = inspect.getsource(kind)
    notes = {name: text for text, name in re.findall(r"^    # (.+)\n    (\w+): ", source, re.MULTILINE)}
    notes |= dict(re.findall(r"^    (\w+): .*?  # (.+)$", source, re.MULTILINE))
    for block in blocks[1:]:
        for names, text in _entries(block.splitlines()).items():
            for field in dataclasses.fields(kind):
                if any(fnmatch.fnmatch(field.name, name) for name in names.split(", ")):
                    notes[field.name] = text
    return blocks[0], notes


def _paragraph(rows: list[str]) -> list[str]:
    """Plain rows; from the first indented row behind a colon on, and behind rows of code, literal text."""
    for i, row in enumerate(rows[:-1]):
        if rows[i + 1].startswith("  ") and row.endswith(":"):
            literal = [".. code-block:: text", "", *("   " + r for r in rows[i + 1 :])]
            return [*map(_escaped, rows[: i + 1]), "", *literal]
    return [
        _escaped(row) if row.startswith(("- ", "  ")) and rows[0].startswith("- ") else _escaped(row.strip())
        for row in rows
    ]


def _entries(rows: list[str]) -> dict[str, str]:
    """Rows "name   description", in columns, continued by indented rows; empty for anything else."""
    entries: dict[str, str] = {}
    names = r"[a-z][\w.]*\*?(?:, [a-z][\w.]*\*?)*"
    rows = textwrap.dedent("\n".join(rows)).splitlines()
    first = next(filter(None, (re.match(rf"{names} {{2,}}(?=\S)", row) for row in rows)), None)
    if first is None:
        return {}
    for row in rows:
        head, text = row[: first.end()], row[first.end() :]
        long = re.match(rf"({names})(?: {{2,}}| (?=[(\[]))(\S.*)$", row)
        if head.endswith(" ") and re.fullmatch(names, head.strip()):
            entries[head.strip()] = text
        elif long:
            entries[long[1]] = long[2]
        elif entries and row.startswith("    "):
            entries[list(entries)[-1]] += " " + row.strip()
        else:
            return {}
    return entries


def _escaped(line: str) -> str:
    parts = re.split(r"(``.*?``)", line)
    return "".join(p if p.startswith("``") else re.sub(r"([*|`\\]|_(?=\W|$))", r"\\\1", p) for p in parts)
