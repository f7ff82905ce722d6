"""The commands of ``mjx-tt``, one typed function each.

Their modules import what is heavy inside the functions that need it, so that help and refusals come at once.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable
from importlib import metadata
from typing import TypeVar

from cyclopts import App, Parameter
from rich.console import Console

DESCRIPTION = """\
From measured human balls to a trained, evaluated and exported table-tennis policy.

The usual way:
  mjx-tt balls                          which players and distributions there are
  mjx-tt train quickstart.yaml          train, evaluate, export: everything lands in runs/quickstart/
  mjx-tt evaluate runs/quickstart       play it again, on other balls if you like
  mjx-tt fit-human rallies.csv --out anna.yaml     a distribution of your own, for an experiment's key "balls"
"""
WIDTH = 120  # [characters] of help in a file or pipe
Function = TypeVar("Function", bound=Callable[..., int | None])
_place = itertools.count()

app = App(
    "mjx-tt",
    help=DESCRIPTION,
    help_format="plaintext",
    console=Console(width=None if sys.stdout.isatty() else WIDTH),
    version=lambda: metadata.version("mjx-tt"),
    default_parameter=Parameter(negative=(), show_default=False),
)


def group(name: str, summary: str | None, examples: str, parent: App = app) -> App:
    """Adds a command that has commands of its own, or a function that ``default`` sets."""
    made = App(name, help=summary, help_epilogue=f"examples:\n{examples}", sort_key=next(_place))
    parent.command(made)
    return made


def command(name: str, examples: str, parent: App = app) -> Callable[[Function], Function]:
    """Adds the function that follows as a command, whose help is its docstring and ``examples``.

    It returns the exit status; None: 0.
    """
    return group(name, None, examples, parent).default
