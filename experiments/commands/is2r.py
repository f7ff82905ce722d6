"""``mjx-tt is2r``: a study of the iterative loop."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from experiments import options
from experiments.errors import ConfigError
from experiments.options import count

app = options.command(
    "is2r",
    "run a study of the iterative loop: simulate, play, refine",
    """\
  mjx-tt is2r study_quick.yaml                              five virtual players, twenty minutes, ends in a report
  mjx-tt is2r study_full.yaml --set players=[player3]       the paper's number of balls
  mjx-tt is2r study_full.yaml --site cluster.yaml           its steps on a cluster: docs/how-to/use-a-cluster.md
  mjx-tt is2r anna.yaml                                     with "robot: robot.yaml": docs/how-to/run-a-study.md

Every finished step is kept: the same command continues after an interruption, a crash, or when people have played.
A file name without a folder that is not in the current folder is looked up among the shipped studies.
""",
)


@app.default
def is2r(
    study: Annotated[str, Parameter("YAML")],
    /,
    *,
    out: options.RunsFolder = "runs",
    overrides: options.Overrides = (),
    processes: Annotated[
        int | None,
        count(
            "steps at a time, each on one device (default: one per processor core; one with --devices, an "
            "accelerator or a robot)"
        ),
    ] = None,
    devices: options.Devices = None,
    site: options.Site = None,
) -> int:
    """Returns 130 while the study waits for people."""
    from experiments.config import study as study_config

    loaded = study_config.load(options.find_shipped(study, study_config.shipped()), overrides)
    elsewhere = options.load_site(site, processes=processes, devices=devices)
    if elsewhere is not None and loaded.robot is not None:
        raise ConfigError(f"--site {site}: with a robot the steps are done where it stands; allowed: local")
    options.check_writable(out)
    chosen = loaded.simulation.devices
    options.start_jax(devices or (None if chosen == "auto" else chosen), elsewhere is not None)
    from experiments.interrupts import interruptible
    from experiments.jobs.site import Workers
    from experiments.progress import make_console
    from experiments.study import session

    side_by_side = Workers(
        1 if elsewhere else session.choose_processes(loaded, processes, devices), elsewhere, str(site)
    )
    with interruptible() if loaded.robot is None else nullcontext():
        return 0 if session.run(loaded, Path(out) / loaded.name, make_console(), side_by_side) else 130
