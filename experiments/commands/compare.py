"""``mjx-tt compare``: several learning algorithms on one task."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from experiments import options
from experiments.options import count

app = options.command(
    "compare",
    "compare learning algorithms on one task",
    """\
  mjx-tt compare compare_quick.yaml                         BGS, ARS, PPO, SAC: three minutes each
  mjx-tt compare mine.yaml --set budget.minutes=60 --set seeds=[0,1,2]
  mjx-tt compare mine.yaml --site cluster.yaml              each training on a cluster: docs/how-to/use-a-cluster.md

Algorithms and seeds that are finished are kept: the same command continues, and one with more of them adds to it.
A file name without a folder that is not in the current folder is looked up among the shipped comparisons.
""",
)


@app.default
def compare(
    comparison: Annotated[str, Parameter("YAML", help="docs/how-to/compare-algorithms.md explains it")],
    /,
    *,
    out: options.RunsFolder = "runs",
    overrides: options.Overrides = (),
    processes: Annotated[
        int | None,
        count("trainings at a time (default: one for a budget of minutes, else one per processor core)"),
    ] = None,
    site: options.Site = None,
) -> None:
    """Prints where the comparison is."""
    from experiments.config import baselines

    path = options.find_shipped(comparison, baselines.shipped())
    loaded, experiment = baselines.load(path, overrides)
    elsewhere = options.load_site(site, processes=processes)
    options.check_writable(out)
    options.start_jax(1, elsewhere is not None)
    from experiments.baselines import compare as comparing
    from experiments.interrupts import interruptible
    from experiments.jobs.site import Workers
    from experiments.progress import make_console

    screen = make_console()
    workers = Workers(1 if elsewhere else comparing.choose(loaded, processes), elsewhere, str(site))
    with interruptible():
        folder = comparing.compare(loaded, experiment, str(path), Path(out), screen, workers)
    screen.print(f"{folder}/comparison.html, with its figures beside it", highlight=False, soft_wrap=True)
