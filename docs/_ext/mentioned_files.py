"""Sphinx extension: files, modules and commands that pages name, and pages that the source names, have to exist.

Sphinx checks links between pages. This checks what it does not see: inline code such as ``robot_io/limits.py`` and
``python -m tests.exam``, examples of ``mjx-tt`` (parsed, not run), links in README.md, and mentions of ``docs/...`` in
the source and in shipped YAMLs.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cyclopts import CycloptsError
from sphinx.util import logging

if TYPE_CHECKING:
    from sphinx.application import Sphinx

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("ballmodel", "bgs", "mjx_tt", "robot_io", "experiments", "benchmarks", "examples", "tests")
FILE = re.compile(rf"`((?:{'|'.join(PACKAGES)})/[\w./*-]+)`")
MODULE = re.compile(r"python -m ((?:experiments|benchmarks|tests|mjx_tt|robot_io)[\w.]*)")
DOTTED = re.compile(rf"`((?:{'|'.join(PACKAGES)})(?:\.\w+)+)")
LINK = re.compile(r"\]\(((?!https?:)[^)#]+)")
COMMAND = re.compile(r"^mjx-tt (.+?)(?: >.*| &)?$", re.MULTILINE)
PAGE = re.compile(r"\bdocs/[\w./-]+\.(?:md|json|svg|png)\b")


def setup(app: Sphinx) -> dict[str, Any]:
    """Entry point of the extension."""
    app.connect("builder-inited", _check)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _check(app: Sphinx) -> None:
    for place, name in (*missing(), *wrong_commands()):
        logging.getLogger(__name__).warning("%s: there is no %s", place.relative_to(ROOT), name)


def missing() -> Iterator[tuple[Path, str]]:
    """Every mention of a file or module that does not exist, with the file that mentions it."""
    for page in _pages():
        text = page.read_text("utf-8")
        yield from ((page, name) for name in FILE.findall(text) if not any(ROOT.glob(name.rstrip("/"))))
        yield from ((page, name) for name in MODULE.findall(text) if not _module(name.split(".")))
        yield from ((page, name) for name in DOTTED.findall(text) if not _inside_module(name.split(".")))
    for link in LINK.findall((ROOT / "README.md").read_text("utf-8")):
        if not (ROOT / link).exists():
            yield ROOT / "README.md", link
    for package in PACKAGES:
        for path in sorted([*(ROOT / package).rglob("*.py"), *(ROOT / package).rglob("*.yaml")]):
            yield from ((path, name) for name in PAGE.findall(path.read_text("utf-8")) if not (ROOT / name).exists())


def wrong_commands() -> Iterator[tuple[Path, str]]:
    """Every example of ``mjx-tt`` that the command line would refuse, with the file that has it."""
    from experiments import cli

    for page in _pages():
        for command in COMMAND.findall(page.read_text("utf-8")):
            try:
                cli.app.parse_args(shlex.split(command, comments=True), print_error=False, exit_on_error=False)
            except CycloptsError as error:
                yield page, f"mjx-tt {command}: {error}"


def _pages() -> list[Path]:
    pages = sorted((ROOT / "docs").rglob("*.md"))
    return [ROOT / "README.md", *(page for page in pages if not {"_build", "generated"} & set(page.parts))]


def _module(parts: list[str]) -> bool:
    path = ROOT.joinpath(*parts)
    return path.with_suffix(".py").exists() or path.is_dir()


def _inside_module(parts: list[str]) -> bool:
    """True for a module, and for a name that the deepest module among the parts has."""
    for n in range(len(parts), 0, -1):
        path = ROOT.joinpath(*parts[:n])
        sources = [*path.glob("__init__.py*"), *path.parent.glob(f"{path.name}.py")]
        if path.is_dir() or sources:
            return n == len(parts) or any(re.search(rf"\b{parts[n]}\b", s.read_text("utf-8")) for s in sources)
    return False
