"""Trainings: ``mjx-tt train``, ``compare``, ``curves`` and ``schema``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from ballmodel.io import validation
from experiments import options
from experiments.commands import command
from experiments.config import baselines, files
from experiments.config import experiment as config
from experiments.errors import ConfigError, error_context
from experiments.interrupts import interruptible
from experiments.options import argument, count, option
from experiments.progress import make_console
from experiments.runs.run_dir import Run


@command(
    "train",
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
def train(
    *experiments: Annotated[str, Parameter("YAML", required=True)],
    seeds: Annotated[
        tuple[int, ...],
        options.numbers(
            "0,1,2",
            "one run per seed, in a folder of its own",
            "different whole numbers separated by commas, such as 0,1,2",
            lambda seeds: len(set(seeds)) == len(seeds),
        ),
    ] = (),
    select: Annotated[bool, Parameter(help="play 50 episodes per seed and mark the best (needs --seeds)")] = False,
    robot: Annotated[
        str | None, option("YAML|rig|lockstep", "where --select plays (default: in the simulation of the training)")
    ] = None,
    out: options.RunsFolder = Path("runs"),
    overrides: options.Overrides = (),
    ranks: options.DistributedOptions = options.ALONE,
    site: options.Site = None,
) -> int:
    """Trains experiments, evaluates them and exports their policies."""
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
    paths = [files.find_shipped(name, "train") for name in experiments]
    configs = [(str(path), config.load(path, overrides)) for path in paths]
    elsewhere = options.load_site(site, processes=ranks.processes, devices=ranks.devices)
    options.check_writable(out)
    # As many as the experiment with the most needs; where all leave it open, as many as there are cores.
    most = max((c.training.devices for _, c in configs if c.training.devices != "auto"), default=None)
    # Several processes of several host devices each hang on queued collectives.
    options.start_jax(ranks.devices or (1 if ranks.distributed else most), elsewhere is not None)
    from experiments.jobs.site import Workers
    from experiments.training import sweep
    from experiments.training.ranks import join

    screen = make_console()
    planned = sweep.plan(configs, seeds, out)
    if ranks.distributed:
        together = join(ranks.distributed, ranks.processes, ranks.process)
        screen.quiet = not together.is_first
        with interruptible(), together.failing_fast():
            sweep.run_job(planned[0], screen, together)
        return 0
    side_by_side = 1 if elsewhere else sweep.count_processes(planned, ranks.processes, ranks.devices)
    with interruptible():
        ok = sweep.run_all(planned, screen, out, Workers(side_by_side, elsewhere, str(site)))
        if select and ok:
            from experiments.study.target_domain import play_on_robot

            for name in dict.fromkeys(job.config.name for job in planned):
                seeded = [job for job in planned if job.config.name == name]
                sweep.select(out / name, seeded, screen, robot, play_on_robot.score)
    return 0 if ok else 1


@command(
    "compare",
    """\
  mjx-tt compare compare_quick.yaml                         BGS, ARS, PPO, SAC: three minutes each
  mjx-tt compare mine.yaml --set budget.minutes=60 --set seeds=[0,1,2]
  mjx-tt compare mine.yaml --site cluster.yaml              each training on a cluster: docs/how-to/use-a-cluster.md

Algorithms and seeds that are finished are kept: the same command continues, and one with more of them adds to it.
A file name without a folder that is not in the current folder is looked up among the shipped comparisons.
""",
)
def compare(
    comparison: Annotated[str, Parameter("YAML", help="docs/how-to/compare-algorithms.md explains it")],
    /,
    *,
    out: options.RunsFolder = Path("runs"),
    overrides: options.Overrides = (),
    processes: Annotated[
        int | None, count("trainings at a time (default: one for a budget of minutes, else one per processor core)")
    ] = None,
    site: options.Site = None,
) -> None:
    """Compares learning algorithms on one task."""
    path = files.find_shipped(comparison, "compare")
    loaded, experiment = baselines.load(path, overrides)
    elsewhere = options.load_site(site, processes=processes)
    options.check_writable(out)
    options.start_jax(1, elsewhere is not None)
    from experiments.baselines import compare as comparing
    from experiments.jobs.site import Workers

    screen = make_console()
    workers = Workers(1 if elsewhere else comparing.count_processes(loaded, processes), elsewhere, str(site))
    with interruptible():
        folder = comparing.compare(loaded, experiment, str(path), out, screen, workers)
    screen.print(f"{folder}/comparison.html, with its figures beside it", soft_wrap=True)


@command("curves", "  mjx-tt curves runs/quickstart runs/paper --out curves.png\n")
def curves(
    *runs: Annotated[str, argument("RUN", "folder of a run, finished or under way")],
    out: Annotated[Path, option("PNG", "the picture (default: curves.png)")] = Path("curves.png"),
) -> None:
    """Draws the learning curves of several trainings in one picture."""
    for folder in runs:
        Run(folder).config()
    from experiments.evaluation import learning_curves

    found = [learning_curves.read_curve(folder) for folder in runs]
    with error_context():
        make_console().print(str(learning_curves.draw_curves(out, found)), soft_wrap=True)


@command(
    "schema",
    """\
  mjx-tt schema > schema.json
and as the first line of a YAML:
  # yaml-language-server: $schema=schema.json
""",
)
def schema() -> None:
    """Prints the JSON schema of an experiment YAML, for your editor."""
    print(json.dumps(validation.json_schema(config.Config), indent=2))
