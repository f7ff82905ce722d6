"""The command line ``mjx-tt``: its commands, and what it does with their ends and errors."""

from __future__ import annotations

import sys
from importlib import metadata
from pathlib import Path
from typing import Annotated, Literal, NoReturn

from cyclopts import App, CycloptsError, Parameter
from rich.console import Console

from experiments import stages
from experiments.commands import (
    blind,
    calibrate,
    compare,
    evaluate,
    finetune,
    fit_human,
    is2r,
    log,
    options,
    predict,
    render,
    run,
    train,
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
diagnose_app = options.command(
    "diagnose",
    "say what the simulation gets wrong about measured logs",
    """\
  mjx-tt diagnose session1.csv session2.mcap --out diagnosis
  mjx-tt diagnose robot/ --out diagnosis                    a folder with command.csv and state.csv
  mjx-tt diagnose robot/ --home home --out diagnosis        and the encoders' zeros: it began to move at home
  mjx-tt diagnose session1.csv --policy runs/quickstart --out diagnosis          what the defect costs in play
  mjx-tt train my.yaml --set model=diagnosis/extended.yaml                       train with what was found

Writes report.html (look at it first), verdict.json, extended.yaml and plots. Ball logs: session,trajectory,t,x,y,z as
CSV, MCAP, or the launcher's HDF5; robot logs: command.csv (t,joint,velocity) and state.csv (t,joint,position).
""",
)


@diagnose_app.default
def diagnose(
    *logs: Annotated[str, Parameter("LOG", help="a file, or a folder of files", required=True)],
    out: Annotated[str, options.option("DIR", "where report, verdict and extended model go")],
    model: Annotated[str | None, options.option("YAML", "the model to judge; the nominal one by default")] = None,
    spin: Annotated[
        Literal["auto", "none", "free"],
        Parameter(help="whether balls may spin: free where the model has a Magnus force, else a cause (auto)"),
    ] = "auto",
    without: Annotated[tuple[str, ...], options.option("NAMES", "effects to leave out of the catalogue")] = (),
    home: Annotated[
        str,
        options.option("POSE", "where joints truly rest at first: home, or joint_1=0.52,gantry_x=0 [rad, m]"),
    ] = "",
    randomise: Annotated[bool, Parameter(help="extended.yaml draws what the logs leave open")] = False,
    seed: Annotated[int, Parameter(help="of the bootstraps (0)")] = 0,
    policy: Annotated[
        str | None, options.option("POLICY", "a run or artefact: what the defect costs it in play")
    ] = None,
    robot: Annotated[str | None, options.option("FOLDER", "whose joints were logged (default: the paper's)")] = None,
    retrain: Annotated[int, options.option("UPDATES", "and what this much retraining brings back")] = 0,
    episodes: Annotated[int, Parameter(help="of each evaluation (2000)")] = 2000,
) -> None:
    """Writes report, verdict and extended model."""
    options.start_jax(1)
    from experiments.commands import diagnose as diagnosis

    screen, folder = options.console(), Path(out)
    names = tuple(name for part in without for name in part.split(",") if name)
    request = diagnosis.Request(logs, folder, model, spin, names, seed, randomise, policy, retrain, home, robot)
    found = diagnosis.diagnose(request, screen)
    extended = diagnosis.save(found, folder)
    diagnosis.show(found, screen, request.the_robot().contract)
    cost = diagnosis.play(extended, request, episodes, screen) if policy else None
    diagnosis.draw(found, folder, ", ".join(Path(p).name for p in logs), screen, cost)


COMMANDS = (
    train.app,
    evaluate.app,
    evaluate.export_app,
    evaluate.pack_app,
    evaluate.unpack_app,
    fit_human.app,
    fit_human.import_app,
    render.app,
    render.view_app,
    render.curves_app,
    run.app,
    finetune.app,
    is2r.app,
    is2r.report_app,
    blind.app,
    compare.app,
    run.robot_app,
    run.rig_app,
    log.app,
    calibrate.app,
    diagnose_app,
    predict.app,
    predict.bench_app,
    train.schema_app,
    fit_human.balls_app,
)
app = App(
    "mjx-tt",
    help=DESCRIPTION,
    help_format="plaintext",
    console=Console(width=None if sys.stdout.isatty() else WIDTH),
    version=lambda: metadata.version("mjx-tt"),
    default_parameter=Parameter(negative=(), show_default=False),
)
for _command in (robot_command.new_app, robot_command.place_app, robot_command.list_app):
    run.robot_app.command(_command)
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
    stages.leave(main())


if __name__ == "__main__":
    program()
