"""The command line ``mjx-tt``: its commands, and what it does with their ends and errors."""

from __future__ import annotations

import sys
from importlib import metadata
from typing import NoReturn

from cyclopts import App, CycloptsError, Parameter
from rich.console import Console

from experiments import interrupts
from experiments.commands import (
    balls,
    bench_ball,
    blind,
    calibrate,
    compare,
    curves,
    diagnose,
    evaluate,
    export,
    finetune,
    fit_human,
    import_,
    is2r,
    log,
    pack,
    predict,
    render,
    rig,
    robot,
    run,
    schema,
    study_report,
    train,
    unpack,
    view,
    vision,
)
from experiments.errors import explained
from experiments.robots import command as robot_command

DESCRIPTION = """\
From measured human balls to a trained, evaluated and exported table-tennis policy.

The usual way:
  mjx-tt balls                          which players and distributions there are
  mjx-tt train quickstart.yaml          train, evaluate, export: everything lands in runs/quickstart/
  mjx-tt evaluate runs/quickstart       play it again, on other balls if you like
  mjx-tt fit-human rallies.csv --out anna.yaml     a distribution of your own, for an experiment's key "balls"
"""
WIDTH = 120  # [characters] of help in a file or pipe
MODULES = (
    *(train, evaluate, export, pack, unpack, fit_human, import_, render, view, curves, run, finetune, is2r),
    *(study_report, blind, compare, robot, rig, log, calibrate, diagnose, predict, bench_ball, vision, schema, balls),
)
COMMANDS = tuple(module.app for module in MODULES)
app = App(
    "mjx-tt",
    help=DESCRIPTION,
    help_format="plaintext",
    console=Console(width=None if sys.stdout.isatty() else WIDTH),
    version=lambda: metadata.version("mjx-tt"),
    default_parameter=Parameter(negative=(), show_default=False),
)
for _command in (robot_command.new_app, robot_command.place_app, robot_command.list_app):
    robot.app.command(_command)
for _place, _command in enumerate(COMMANDS):
    _command.sort_key = _place
    app.command(_command)


def main(arguments: list[str] | None = None) -> int:
    """Runs one command; returns the exit status: 0 done, 1 failed with a message, 2 not understood, 130 interrupted."""
    try:
        given = sys.argv[1:] if arguments is None else arguments
        function, bound, _ = app.parse_args(given, exit_on_error=False, print_error=False)
        return function(*bound.args, **bound.kwargs) or 0
    except CycloptsError as error:
        print(f"mjx-tt: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as interruption:
        print(str(interruption) or "interrupted", file=sys.stderr)
        return 130
    except Exception as error:
        if not explained(error):
            raise
        print(f"mjx-tt: error: {error}", file=sys.stderr)
        return 1


def program() -> NoReturn:
    """Entry point of the shell."""
    interrupts.end_process(main())


if __name__ == "__main__":
    program()
