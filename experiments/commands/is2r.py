"""``mjx-tt is2r``: a study; ``mjx-tt study-report``: its report."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from experiments.commands.options import (
    Devices,
    Site,
    changes,
    command,
    console,
    count,
    existing,
    option,
    shipped_or_own,
    site_of,
    start_jax,
    writable,
)
from experiments.errors import ConfigError

app = command(
    "is2r",
    "simulate, play, refine: the iterative loop and its study",
    """\
  mjx-tt is2r study_quick.yaml                              five virtual players, twenty minutes, ends in a report
  mjx-tt is2r study_full.yaml --set players=[player3]       the paper's number of balls
  mjx-tt is2r study_full.yaml --site cluster.yaml           its steps on a cluster: docs/how-to/use-a-cluster.md
  mjx-tt is2r anna.yaml                                     with "robot: robot.yaml": docs/how-to/run-a-study.md

Every finished step is kept: the same command continues after an interruption, a crash, or when people have played.
A file name without a folder that is not in the current folder is looked up among the shipped studies.
""",
)
report_app = command(
    "study-report",
    "the report of a study, whole or under way: one HTML page",
    """\
  mjx-tt study-report runs/study_quick

Writes report/index.html with its pictures and tables: the paper's figures with ours beside them. What a study lacks is
named.
""",
)


@app.default
def is2r(
    study: Annotated[str, Parameter("YAML")],
    /,
    *,
    out: Annotated[str, option("FOLDER", "where the study's folder goes (default: runs)")] = "runs",
    overrides: Annotated[tuple[str, ...], changes("change one key of the study")] = (),
    processes: Annotated[
        int | None,
        count(
            "how many do steps side by side, on a device each (default: one per processor core; one in all with "
            "--devices, on an accelerator or a robot)"
        ),
    ] = None,
    devices: Devices = None,
    site: Site = None,
) -> int:
    """Returns 130 while the study waits for people."""
    from experiments.config import study as study_config

    loaded = study_config.load(shipped_or_own(study, study_config.shipped()), overrides)
    elsewhere = site_of(site, processes=processes, devices=devices)
    if elsewhere is not None and loaded.robot is not None:
        raise ConfigError(f"--site {site}: with a robot the steps are done where it stands; allowed: local")
    writable(out)
    own = loaded.simulation.devices
    start_jax(devices or (None if own == "auto" else own), elsewhere is not None)
    from experiments.jobs.site import Workers
    from experiments.stages import interruptible
    from experiments.study import session

    side_by_side = Workers(
        1 if elsewhere else session.choose_processes(loaded, processes, devices), elsewhere, str(site)
    )
    with interruptible() if loaded.robot is None else nullcontext():
        return 0 if session.run(loaded, Path(out) / loaded.name, console(), side_by_side) else 130


@report_app.default
def study_report(folder: Annotated[str, Parameter("FOLDER", help="folder of a study")], /) -> None:
    """Prints where it is."""
    existing(folder)
    start_jax(1)
    from experiments.study.report import page

    console().print(page.write(Path(folder)), highlight=False, soft_wrap=True)
