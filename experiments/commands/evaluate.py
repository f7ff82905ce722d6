"""``mjx-tt evaluate``: a policy on fresh balls."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from experiments import options
from experiments.options import count, option
from experiments.runs.locate import find_policy, is_exported
from experiments.runs.run_dir import CONFIG

app = options.command(
    "evaluate",
    "play a policy on fresh balls: rates, interval, pictures",
    """\
  mjx-tt evaluate runs/quickstart
  mjx-tt evaluate runs/quickstart --balls player1/M1 --episodes 5000
  mjx-tt evaluate artefacts/anna --model measured.yaml --out anna-on-measured

Without --out, a run on its own balls and model writes into its own folder; anything else into a folder beside it.
""",
)


@app.default
def evaluate(
    policy: options.PolicyFolder,
    /,
    *,
    play: options.PlayOptions = options.PLAY,
    episodes: Annotated[int | None, count("balls to play (default: the experiment's)")] = None,
    no_reachable: Annotated[bool, Parameter(help="skip the bound on what is in reach, which takes a minute")] = False,
    out: Annotated[str | None, option("FOLDER", "folder of evaluation.json and plots/")] = None,
    ranks: options.DistributedOptions = options.ALONE,
) -> None:
    """Writes evaluation.json and plots, and prints the report."""
    find_policy(policy)
    play.check()
    folder = Path(out) if out else default_folder(Path(policy), play.balls, play.model)
    options.check_writable(folder)
    options.start_jax(ranks.devices or (1 if ranks.distributed else None))
    import jax

    from experiments.evaluation import evaluate as evaluation
    from experiments.interrupts import interruptible
    from experiments.progress import make_console, print_stages
    from experiments.runs import load_policy
    from experiments.training import finalize
    from experiments.training.ranks import join

    screen = make_console()
    together = join(ranks.distributed, ranks.processes, ranks.process)
    screen.quiet = not together.is_first
    trained = load_policy.load(policy)
    experiment = play.experiment(trained)
    settings = experiment.config.evaluation
    stage = print_stages(screen, str(trained.source))
    with interruptible(), together.failing_fast():
        played = evaluation.evaluate(
            experiment,
            trained,
            episodes or settings.episodes,
            play.seed_of(experiment),
            None if no_reachable else settings.reachable_balls,
            stage,
            jax.device_count(),
        )
        together.disconnect()
        if not together.is_first:
            return
        with stage("drawing pictures"):
            finalize.save_evaluation(folder, played, experiment)
    finalize.print_report(screen, played.report, str(trained.source))
    screen.print(f"  {folder}/evaluation.json, pictures in {folder}/plots", soft_wrap=True)


def default_folder(policy: Path, *others: str | None) -> Path:
    """Folder of an evaluation without --out; ``others``: balls and model that are not the policy's own."""
    changed = [Path(text).with_suffix("").as_posix().replace("/", "-") for text in others if text]
    if (policy / CONFIG).exists() and not is_exported(policy):
        return policy / f"evaluation-{'-'.join(changed)}" if changed else policy
    # An artefact holds its own files only, a run that was passed on those that it came with.
    policy = policy if policy.name else policy.absolute()
    return policy.with_name("-".join([f"{policy.name}-evaluation", *changed]))
