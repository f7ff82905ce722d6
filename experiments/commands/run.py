"""``mjx-tt run``: an exported policy on a robot, real or emulated."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from experiments import options
from experiments.options import count, option
from experiments.runs.locate import artefact_of

app = options.command(
    "run",
    "play with an exported policy on a robot, real or emulated",
    """\
  mjx-tt run runs/quickstart --robot rig --balls 30
  mjx-tt run rallies --robot rig --rallies 20 --player player1
  mjx-tt run runs/quickstart/artefact --robot robot.yaml
  mjx-tt run runs/quickstart/artefact --robot rig --rig worn.yaml --distribution player1/M1

The robot needs the operator: p prepares the axes, a arms, the space bar stops. The rig is switched on, armed and fed
with balls by itself. Read docs/concepts/safety.md and docs/how-to/run-on-the-robot.md before a real arm moves.
""",
)


@app.default
def run(
    artefact: Annotated[
        str, Parameter("ARTEFACT", help="folder of an exported policy or of its run, or a shipped one's name")
    ],
    /,
    *,
    robot: Annotated[str, option("YAML", 'a robot.yaml, or "rig" for the emulated robot')],
    balls: Annotated[int | None, count("end after N balls (default: when the operator quits)")] = None,
    rallies: Annotated[int | None, count("end after N rallies that count")] = None,
    seconds: Annotated[float | None, option("S", "end after S seconds")] = None,
    log: Annotated[str, option("FOLDER", "folder of the MCAP log and the summary")] = "runs/robot",
    setup: options.RobotOptions = options.ROBOT,
) -> int:
    """Returns the exit status."""
    folder = artefact_of(artefact)
    setup.check(robot)
    options.check_writable(log)
    options.start_jax(1)
    from experiments.deploy import play
    from experiments.progress import make_console

    return play.run(Path(folder), robot, Path(log), make_console(), setup, balls, rallies, seconds)
