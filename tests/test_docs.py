"""Names in backticks, links, commands and YAML keys of the documentation and of docstrings exist.

A name counts as existing if the source has it outside of docstrings and comments, so a sentence that outlives a module,
a function or a key is found.
"""

from __future__ import annotations

import ast
import re
import shlex
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from cyclopts import CycloptsError

from tests.support.paths import ROOT

PACKAGES = ("ballmodel", "bgs", "mjx_tt", "robot_io", "experiments", "benchmarks", "examples", "tests")
PAGES = sorted({*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("docs/[!_]*/*.md")} - {ROOT / "CHANGELOG.md"})
MODULES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
DATA = [*ROOT.glob("*.toml"), *ROOT.glob("*.txt"), ROOT / "Makefile", *ROOT.glob(".ci/*"), *ROOT.glob(".git*/**/*.yml")]
DATA += [path for package in PACKAGES for kind in ("yaml", "xml", "json", "html", "mod", "cfg", "txt", "c", "pyi")
         for path in (ROOT / package).rglob(f"*.{kind}")]  # fmt: skip

WORD = re.compile(r"[A-Za-z_]\w+")
FENCED = re.compile(r"^```(\{?[\w-]*\}?).*?\n(.*?)^```", re.MULTILINE | re.DOTALL)
CODE = re.compile(r"(?<!`)(`{1,2})(?!`)((?:[^`\n]|\n(?!\s*\n))+)\1(?!`)")
FILE = re.compile(rf"^(?:{'|'.join(PACKAGES)}|docs)/[\w./*-]+$")
DOTTED = re.compile(rf"^(?:{'|'.join(PACKAGES)})(?:\.\w+)+$")
PAGE = re.compile(r"\bdocs/[\w./-]+\.(?:md|json|svg|png)\b")
LINK = re.compile(r"\]\(((?!https?:)[^)#]+)")
COMMAND = re.compile(r"^mjx-tt (.+?)(?: >.*| &)?$", re.MULTILINE)
KEY = re.compile(r"(?:^|[{,]) *-? *([a-z]\w+): ", re.MULTILINE)
# Words of other programs and standards, and names that a reader fills in.
FOREIGN = set(
    "Args EGMStreamStart EGM_STOP_RAMP_DOWN JobSet RESULTS Raises Returns SESSION TRobEGM "
    "T_ROB1 a0 ars_algorithm etc human_M0 icp_map launch_param profidrive rerun security sha256sum ssh telegram111 "
    "ulimit".split()
)


@cache
def vocabulary() -> frozenset[str]:
    """Words of the source outside of docstrings and comments, of data files, of file names, and FOREIGN."""
    words = set(FOREIGN)
    for path in MODULES:
        tree = ast.parse(path.read_text("utf-8"))
        ignored = {id(constant) for constant, _ in docstrings(tree)}
        for node in ast.walk(tree):
            if id(node) not in ignored:
                values = (
                    v for _, value in ast.iter_fields(node) for v in (value if isinstance(value, list) else [value])
                )
                words.update(word for v in values if isinstance(v, str) for word in WORD.findall(v))
    for path in DATA:
        words.update(WORD.findall(path.read_text("utf-8")))
    for path in (*MODULES, *DATA, *PAGES):
        words.update(WORD.findall(str(path.relative_to(ROOT))))
    return frozenset(words)


def docstrings(tree: ast.Module) -> Iterator[tuple[ast.Constant, int]]:
    """Every string that stands as a statement, which includes those of fields, with its line."""
    for node in ast.walk(tree):
        match node:
            case ast.Expr(value=ast.Constant(value=str()) as constant):
                yield constant, node.lineno


def unknown(code: str) -> list[str]:
    """What of a piece of inline code does not exist; empty if all of it does."""
    code = " ".join(code.split())
    if FILE.match(code):
        return [] if any(ROOT.glob(code.rstrip("/"))) else [code]
    if DOTTED.match(code):
        return [] if in_module(code.split(".")) else [code]
    if match := re.match(r"mjx-tt ([a-z][\w-]*)", code):
        return [] if match[1] in commands() else [code]
    return [word for word in WORD.findall(code) if word not in vocabulary()]


def in_module(parts: list[str]) -> bool:
    """True for a module, and for a name that stands in the deepest module among the parts."""
    for n in range(len(parts), 0, -1):
        path = ROOT.joinpath(*parts[:n])
        sources = [*path.glob("__init__.py*"), *path.parent.glob(f"{path.name}.py")]
        if path.is_dir() or sources:
            return n == len(parts) or any(
                re.search(rf"\b{parts[n]}\b", source.read_text("utf-8")) for source in sources
            )
    return False


@cache
def commands() -> frozenset[str]:
    """Names of the commands of ``mjx-tt``."""
    from experiments import cli

    return frozenset(name for command in cli.COMMANDS for name in command.name)


def text_of(page: Path) -> str:
    return page.read_text("utf-8")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_names_of_a_page_exist(page):
    prose = FENCED.sub("", text_of(page))
    missing = [f"`{code}`: {word}" for _, code in CODE.findall(prose) for word in unknown(code)]
    for language, block in FENCED.findall(text_of(page)):
        if language == "yaml":
            missing += [f"key {key}" for key in KEY.findall(block) if key not in vocabulary()]
    assert not missing, "\n".join(missing)


def test_names_in_docstrings_exist():
    missing = [
        f"{path.relative_to(ROOT)}:{line}: `{code}`: {word}"
        for path in MODULES
        for constant, line in docstrings(ast.parse(text_of(path)))
        for _, code in CODE.findall(constant.value)
        for word in unknown(code)
    ]
    assert not missing, "\n".join(missing)


def test_pages_that_the_source_names_exist():
    named = [(path, page) for path in (*MODULES, *DATA) for page in PAGE.findall(text_of(path))]
    assert not [f"{path.relative_to(ROOT)}: {page}" for path, page in named if not (ROOT / page).exists()]


def test_links_of_pages_outside_of_the_documentation_exist():
    pages = [page for page in PAGES if page.parent == ROOT]  # Sphinx checks the others
    assert not [f"{page.name}: {link}" for page in pages for link in LINK.findall(text_of(page))
                if not (ROOT / link).exists() and "/generated/" not in link]  # fmt: skip


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_of_a_page_are_accepted(page, monkeypatch):
    from experiments import cli, options

    monkeypatch.setattr(options, "check_exists", lambda *_, key="": None)  # the files that a page speaks of
    refused = []
    for command in (line for _, block in FENCED.findall(text_of(page)) for line in COMMAND.findall(block)):
        try:
            cli.app.parse_args(shlex.split(command, comments=True), print_error=False, exit_on_error=False)
        except CycloptsError as error:
            refused.append(f"mjx-tt {command}: {error}")
    assert not refused, "\n".join(refused)


def test_the_path_from_datagram_to_command_is_as_long_as_its_page_says():
    rows = re.findall(
        r"^\| `(robot_io/[\w/]+\.py)` \| (\d+) \|", (ROOT / "docs/concepts/bridge.md").read_text("utf-8"), re.MULTILINE
    )
    found = {path: len((ROOT / path).read_text("utf-8").splitlines()) for path, _ in rows}
    assert len(found) == 12 and sum(found.values()) <= 2500, found
    assert all(abs(found[path] - int(lines)) <= 20 for path, lines in rows), found
