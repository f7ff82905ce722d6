"""``mjx-tt evaluate``: a policy on fresh balls; ``mjx-tt export``: a run's policy as an artefact; ``mjx-tt pack`` and
``mjx-tt unpack``: a policy as one file to pass on."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from experiments.commands.options import (
    Balls,
    BallSeed,
    Devices,
    Distributed,
    Model,
    PolicyFolder,
    Process,
    Processes,
    command,
    console,
    count,
    existing,
    experiment_of,
    option,
    start_jax,
    suffix,
    writable,
)
from experiments.runs.locate import find_policy, is_exported, run_of
from experiments.runs.run_dir import CONFIG, Run

app = command(
    "evaluate",
    "play a policy on fresh balls: rates, interval, pictures",
    """\
  mjx-tt evaluate runs/quickstart
  mjx-tt evaluate runs/quickstart --balls player1/M1 --episodes 5000
  mjx-tt evaluate artefacts/anna --model measured.yaml --out anna-on-measured

Without --out, a run on its own balls and model writes into its own folder; anything else into a folder beside it.
""",
)
export_app = command(
    "export",
    "write a run's policy as an artefact that a robot can run",
    """\
  mjx-tt export runs/quickstart
  mjx-tt export runs/quickstart --out artefacts/anna
""",
)
pack_app = command(
    "pack",
    "make one file of a policy, to pass on: artefact, configuration, evaluation, a card",
    """\
  mjx-tt pack runs/quickstart
  mjx-tt pack runs/quickstart --out anna.mjxtt.zip --licence CC-BY-4.0
""",
)
unpack_app = command(
    "unpack",
    "check a packed policy and put it into a folder, which stands for a run",
    """\
  mjx-tt unpack quickstart.mjxtt.zip
  mjx-tt unpack quickstart.mjxtt.zip --out runs/anna
  mjx-tt view runs/anna
""",
)


@app.default
def evaluate(
    policy: PolicyFolder,
    /,
    *,
    balls: Balls = None,
    model: Model = None,
    episodes: Annotated[int | None, count("balls to play (default: the experiment's)")] = None,
    seed: BallSeed = None,
    no_reachable: Annotated[bool, Parameter(help="skip the minute that the bound on what is in reach takes")] = False,
    out: Annotated[str | None, option("FOLDER", "for evaluation.json and plots/")] = None,
    devices: Devices = None,
    distributed: Distributed = None,
    processes: Processes = None,
    process: Process = None,
) -> None:
    """Writes evaluation.json and plots, and prints the report."""
    find_policy(policy)
    existing(model, key="--model")
    folder = Path(out) if out else _folder(Path(policy), balls, model)
    writable(folder)
    start_jax(devices or (1 if distributed else None))
    import jax

    from experiments.evaluation import evaluate as evaluation
    from experiments.runs import load_policy
    from experiments.stages import interruptible, printed
    from experiments.training import finalize, ranks

    screen = console()
    together = ranks.join(distributed, processes, process) if distributed else ranks.ALONE
    screen.quiet = not together.first
    trained = load_policy.load(policy)
    experiment = experiment_of(trained, balls, model)
    settings = experiment.config.evaluation
    stage = printed(screen, str(trained.source))
    with interruptible(), together.together():
        played = evaluation.evaluate(
            experiment,
            trained,
            episodes or settings.episodes,
            settings.seed if seed is None else seed,
            None if no_reachable else settings.reachable_balls,
            stage,
            jax.device_count(),
        )
        together.part()
        if not together.first:
            return
        with stage("drawing pictures"):
            finalize.save_evaluation(folder, played, experiment)
    finalize.print_report(screen, played.report, str(trained.source))
    screen.print(f"  {folder}/evaluation.json, pictures in {folder}/plots", highlight=False, soft_wrap=True)


def _folder(policy: Path, *others: str | None) -> Path:
    """Default folder of an evaluation; ``others``: balls and model that are not the policy's own."""
    changed = [Path(text).with_suffix("").as_posix().replace("/", "-") for text in others if text]
    if (policy / CONFIG).exists() and not is_exported(policy):
        return policy / f"evaluation-{'-'.join(changed)}" if changed else policy
    # An artefact holds its own files only, a run that was passed on those that it came with.
    policy = policy if policy.name else policy.absolute()
    return policy.with_name("-".join([f"{policy.name}-evaluation", *changed]))


@export_app.default
def export(
    folder: Annotated[str, Parameter("RUN", help="folder of a run")],
    /,
    *,
    out: Annotated[str | None, option("FOLDER", "default: RUN/artefact")] = None,
) -> int:
    """Returns 1 for a policy that the robot cannot run."""
    run = Run(run_of(folder))
    artefact = Path(out) if out else run.artefact
    writable(artefact)
    start_jax(1)
    from experiments.runs import load_policy
    from experiments.training import finalize

    screen = console()
    trained = load_policy.load(run.folder)
    report = run.read_evaluation() if run.evaluation.exists() else None
    written = finalize.export_policy(artefact, trained, experiment_of(trained), report, screen)
    if written:
        screen.print(f"artefact: {artefact}", highlight=False)
    return 0 if written else 1


@pack_app.default
def pack(
    policy: PolicyFolder,
    /,
    *,
    out: Annotated[str | None, option("FILE", "default: the run's name with .mjxtt.zip, in the current folder")] = None,
    licence: Annotated[str | None, option("NAME", "for the card, such as CC-BY-4.0")] = None,
) -> None:
    """Writes the file and prints its SHA-256."""
    folder = run_of(policy)
    from experiments.sharing import packed

    path = Path(out or f"{folder.absolute().name}{packed.SUFFIX}")
    suffix(path, ".zip")
    writable(path.parent)
    digest = packed.pack(folder, path, licence)
    console().print(f"{path}: {path.stat().st_size:,} bytes, SHA-256 {digest}", highlight=False, soft_wrap=True)


@unpack_app.default
def unpack(
    file: Annotated[str, Parameter("FILE", help="a packed policy")],
    /,
    *,
    out: Annotated[str | None, option("FOLDER", "default: the file's name, in the current folder")] = None,
) -> None:
    """Checks every byte before anything is written."""
    existing(file)
    from experiments.sharing import packed

    path = Path(file)
    folder = Path(out or path.name.removesuffix(".zip").removesuffix(".mjxtt"))
    value, low, high, count, _ = packed.unpack(path, folder)["returned"]
    screen = console()
    said = f"{value:.1%} of {count:,} balls returned (95 % interval {low:.1%} to {high:.1%})"
    screen.print(f"{folder}: {said}; {folder}/README.md says where", highlight=False, soft_wrap=True)
