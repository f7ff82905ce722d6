"""``mjx-tt robot``: bring a robot into service; ``new``, ``place`` and ``list`` are in ``experiments.robots``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from experiments import options
from experiments.errors import ConfigError
from experiments.options import option
from experiments.runs.locate import artefact_of

app = options.command(
    "robot",
    "define a robot (new, place, list), or bring one into service (check, jog, commission)",
    """\
  mjx-tt robot new my_arm/my_arm.xml                                a first YAML for an MJCF, checked
  mjx-tt robot check --robot robot.yaml                             tracker and arm are heard, nothing is sent
  mjx-tt robot check --robot robot.yaml --artefact runs/quickstart  and a policy plays the balls, simulated
  mjx-tt robot jog --robot robot.yaml                               armed, slow, in small steps
  mjx-tt robot jog my_arm --robot robot.yaml                        a robot of your own; or one that comes with it
  mjx-tt robot commission --robot robot.yaml --artefact runs/quickstart  the first day, step by step; resumes

m notes where ball and joints are, for mjx-tt calibrate.
""",
)


@app.default
def commission(
    action: Annotated[Literal["check", "jog", "commission"], Parameter("ACTION")],
    name: Annotated[
        str | None,
        Parameter("ROBOT", help="the installed robot, by folder or name (default: the policy's, or the paper's)"),
    ] = None,
    /,
    *,
    robot: Annotated[str, option("YAML", "a robot.yaml")],
    artefact: Annotated[str | None, option("FOLDER", "check, commission: a policy, or its run")] = None,
    points: Annotated[str, option("CSV", "file that points are added to")] = "points.csv",
    log: Annotated[str, option("FOLDER", "folder of the MCAP log")] = "runs/robot",
    seconds: Annotated[float | None, option("S", "end after S seconds")] = None,
) -> int:
    """Returns the exit status."""
    options.check_exists(robot, key="--robot")
    options.check_writable(log)
    if action == "jog" and artefact is not None:
        raise ConfigError(f"--artefact {artefact}: jog plays no balls; allowed with check and commission")
    policy = None if artefact is None else Path(artefact_of(artefact))
    options.start_jax(1)
    from experiments.deploy import commissioning
    from experiments.progress import make_console

    if action == "commission":
        from experiments.deploy import first_day

        return first_day.commission(Path(robot), Path(log), make_console(), policy, name)
    job = commissioning.Commissioning(Path(robot), Path(log), Path(points), seconds, name)
    return job.check(make_console(), policy) if action == "check" else job.jog(make_console())
