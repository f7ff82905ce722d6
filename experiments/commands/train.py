"""``mjx-tt train``: experiments to trained, evaluated and exported policies; ``mjx-tt schema``: their keys."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter, Token

from experiments.commands.options import (
    SHIPPED_HINT,
    Devices,
    Distributed,
    Process,
    Processes,
    Site,
    changes,
    command,
    console,
    option,
    shipped_or_own,
    site_of,
    start_jax,
    writable,
)
from experiments.errors import ConfigError

app = command(
    "train",
    "train experiments, evaluate them and export their policies",
    """\
  mjx-tt train quickstart.yaml
  mjx-tt train narrow.yaml medium.yaml --seeds 0,1,2        six runs: runs/narrow/seed0/ ... runs/medium/seed2/
  mjx-tt train player3_m2.yaml --seeds 0,1,2 --select       and name the best seed, as the paper does
  mjx-tt train my.yaml --set training.updates=500 --set balls=player1/M0
  mjx-tt train my.yaml --seeds 0,1,2,3 --site cluster.yaml   on a cluster's nodes: docs/how-to/use-a-cluster.md
  srun mjx-tt train my.yaml --distributed auto               one training by all processes of a SLURM job

Run the same command again after an interruption: finished runs are skipped, others continue from their last
checkpoint, bit for bit. Ctrl-C saves a checkpoint first.
"""
    + SHIPPED_HINT,
)
schema_app = command(
    "schema",
    "print the JSON schema of an experiment YAML, for your editor",
    """\
  mjx-tt schema > schema.json
and as the first line of a YAML:
  # yaml-language-server: $schema=schema.json
""",
)


def _seeds(_type: Any, tokens: Sequence[Token]) -> tuple[int, ...]:
    text = tokens[0].value
    parts = text.split(",")
    if not all(part.strip().isdigit() for part in parts) or len(set(map(int, parts))) < len(parts):
        raise ValueError(f"{text!r}: different whole numbers separated by commas are needed, such as 0,1,2")
    return tuple(map(int, parts))


@app.default
def train(
    *experiments: Annotated[str, Parameter("YAML", required=True)],
    seeds: Annotated[
        tuple[int, ...], option("0,1,2", "one run per seed, in a folder of its own", converter=_seeds)
    ] = (),
    select: Annotated[bool, Parameter(help="play 50 episodes per seed and mark the best (needs --seeds)")] = False,
    out: Annotated[str, option("FOLDER", "where runs go (default: runs)")] = "runs",
    overrides: Annotated[tuple[str, ...], changes("change one key of every file")] = (),
    devices: Devices = None,
    distributed: Distributed = None,
    processes: Processes = None,
    process: Process = None,
    site: Site = None,
) -> int:
    """Returns the exit status."""
    from experiments.config import experiment as config

    if distributed and (len(experiments) > 1 or seeds):
        raise ConfigError(f"--distributed {distributed}: trains one experiment; start a job for each file and seed")
    if distributed and site:
        raise ConfigError(f"--site {site}: with --distributed each process is started by you, or by srun")
    if select and not seeds:
        raise ConfigError("--select chooses among seeds: give them with --seeds, such as --seeds 0,1,2")
    paths = [shipped_or_own(name, config.shipped()) for name in experiments]
    configs = [(str(path), config.load(path, overrides)) for path in paths]
    elsewhere = site_of(site, processes=processes, devices=devices)
    writable(out)
    # As many as the experiment with the most needs; where all leave it open, as many as there are cores.
    most = max((c.training.devices for _, c in configs if c.training.devices != "auto"), default=None)
    # Several processes of several host devices each hang on queued collectives.
    start_jax(devices or (1 if distributed else most), elsewhere is not None)
    from experiments.jobs.site import Workers
    from experiments.stages import interruptible
    from experiments.training import ranks, sweep

    screen = console()
    planned = sweep.plan(configs, seeds, Path(out))
    if distributed:
        together = ranks.join(distributed, processes, process)
        screen.quiet = not together.first
        with interruptible(), together.together():
            sweep.run_together(planned[0], screen, together)
        return 0
    side_by_side = 1 if elsewhere else sweep.choose(planned, processes, devices)
    workers = Workers(side_by_side, elsewhere, str(site))
    with interruptible():
        ok = sweep.run_all(planned, screen, Path(out), workers)
        if select and ok:
            for name in dict.fromkeys(job.config.name for job in planned):
                sweep.select(Path(out) / name, [job for job in planned if job.config.name == name], screen)
    return 0 if ok else 1


@schema_app.default
def schema() -> None:
    """Prints it."""
    from experiments.config import experiment as config

    print(json.dumps(config.json_schema(), indent=2))
