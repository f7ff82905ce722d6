"""``mjx-tt train``: experiments to trained, evaluated and exported policies."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter, Token

from experiments import options
from experiments.errors import ConfigError
from experiments.options import option

app = options.command(
    "train",
    "train experiments, evaluate them and export their policies",
    """\
  mjx-tt train quickstart.yaml
  mjx-tt train narrow.yaml medium.yaml --seeds 0,1,2        six runs: runs/narrow/seed0/ ... runs/medium/seed2/
  mjx-tt train player3_m2.yaml --seeds 0,1,2 --select       and name the best seed, in simulation
  mjx-tt train player3_m2.yaml --seeds 0,1,2 --select --robot robot.yaml   the same on the robot, as the paper
  mjx-tt train my.yaml --set training.updates=500 --set balls=player1/M0
  mjx-tt train my.yaml --seeds 0,1,2,3 --site cluster.yaml   on a cluster's nodes: docs/how-to/use-a-cluster.md
  srun mjx-tt train my.yaml --distributed auto               one training by all processes of a SLURM job

Run the same command again after an interruption: finished runs are skipped, others continue from their last
checkpoint, bit for bit. Ctrl-C saves a checkpoint first.

A file name without a folder that is not in the current folder is looked up among the shipped experiments.
""",
)


def _parse_seeds(_type: Any, tokens: Sequence[Token]) -> tuple[int, ...]:
    text = tokens[0].value
    parts = text.split(",")
    if not all(part.strip().isdigit() for part in parts) or len(set(map(int, parts))) < len(parts):
        raise ValueError(f"expected different whole numbers separated by commas, such as 0,1,2, got {text!r}")
    return tuple(map(int, parts))


@app.default
def train(
    *experiments: Annotated[str, Parameter("YAML", required=True)],
    seeds: Annotated[
        tuple[int, ...], option("0,1,2", "one run per seed, in a folder of its own", converter=_parse_seeds)
    ] = (),
    select: Annotated[bool, Parameter(help="play 50 episodes per seed and mark the best (needs --seeds)")] = False,
    robot: Annotated[
        str | None, option("YAML|rig|lockstep", "where --select plays (default: in the simulation of the training)")
    ] = None,
    out: options.RunsFolder = "runs",
    overrides: options.Overrides = (),
    ranks: options.DistributedOptions = options.ALONE,
    site: options.Site = None,
) -> int:
    """Returns the exit status."""
    from experiments.config import experiment as config

    if ranks.distributed and (len(experiments) > 1 or seeds):
        raise ConfigError(
            f"--distributed {ranks.distributed}: trains one experiment; start a job for each file and seed"
        )
    if ranks.distributed and site:
        raise ConfigError(f"--site {site}: with --distributed each process is started by you, or by srun")
    if select and not seeds:
        raise ConfigError("--select chooses among seeds: give them with --seeds, such as --seeds 0,1,2")
    if robot is not None and not select:
        raise ConfigError(f"--robot {robot}: plays the choice among seeds; give --select")
    if robot is not None:
        options.ROBOT.check(robot)
    paths = [options.find_shipped(name, config.shipped()) for name in experiments]
    configs = [(str(path), config.load(path, overrides)) for path in paths]
    elsewhere = options.load_site(site, processes=ranks.processes, devices=ranks.devices)
    options.check_writable(out)
    # As many as the experiment with the most needs; where all leave it open, as many as there are cores.
    most = max((c.training.devices for _, c in configs if c.training.devices != "auto"), default=None)
    # Several processes of several host devices each hang on queued collectives.
    options.start_jax(ranks.devices or (1 if ranks.distributed else most), elsewhere is not None)
    from experiments.interrupts import interruptible
    from experiments.jobs.site import Workers
    from experiments.progress import make_console
    from experiments.training import sweep
    from experiments.training.ranks import join

    screen = make_console()
    planned = sweep.plan(configs, seeds, Path(out))
    if ranks.distributed:
        together = join(ranks.distributed, ranks.processes, ranks.process)
        screen.quiet = not together.is_first
        with interruptible(), together.failing_fast():
            sweep.run_job(planned[0], screen, together)
        return 0
    side_by_side = 1 if elsewhere else sweep.choose(planned, ranks.processes, ranks.devices)
    with interruptible():
        ok = sweep.run_all(planned, screen, Path(out), Workers(side_by_side, elsewhere, str(site)))
        if select and ok:
            from experiments.study.target_domain import play_on_robot

            for name in dict.fromkeys(job.config.name for job in planned):
                seeded = [job for job in planned if job.config.name == name]
                sweep.select(Path(out) / name, seeded, screen, robot, play_on_robot.score)
    return 0 if ok else 1
