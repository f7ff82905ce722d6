"""Docstrings begin with a noun or an imperative verb, as those of NumPy and JAX do, not with a question word."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

from tests.support.paths import ROOT

FOLDERS = ("ballmodel", "benchmarks", "bgs", "examples", "experiments", "mjx_tt", "robot_io", "tests")
QUESTIONS = ("What", "How", "Whether", "Where", "Who", "Why", "When")


def docstrings(path: Path) -> Iterator[tuple[str, str]]:
    """Place and text of every docstring of a module, those of fields among them."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        match node:
            case ast.Expr(value=ast.Constant(value=str(text))):
                yield f"{path.relative_to(ROOT)}:{node.lineno}", text.strip()


def questions(folder: Path) -> list[str]:
    """Docstrings below a folder that begin with a question word, one a line: its place and its first line."""
    return [
        f"{place}: {text.splitlines()[0]}"
        for path in sorted(folder.rglob("*.py"))
        for place, text in docstrings(path)
        if text.split()[0].rstrip(",:") in QUESTIONS
    ]


def test_no_docstring_begins_with_a_question_word():
    found = [line for folder in FOLDERS for line in questions(ROOT / folder)]
    assert not found, "begin with a noun or an imperative verb:\n" + "\n".join(found)
