"""Studies: ``mjx-tt is2r``, ``study-report`` and ``blind``."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter
from rich.console import Console
from rich.table import Table

from experiments import options
from experiments.commands import command
from experiments.config import files
from experiments.config import study as study_config
from experiments.errors import ConfigError
from experiments.interrupts import interruptible
from experiments.options import argument, count, option
from experiments.progress import make_console


@command(
    "is2r",
    """\
  mjx-tt is2r study_quick.yaml                              five virtual players, twenty minutes, ends in a report
  mjx-tt is2r study_full.yaml --set players=[player3]       the paper's number of balls
  mjx-tt is2r study_full.yaml --site cluster.yaml           its steps on a cluster: docs/how-to/use-a-cluster.md
  mjx-tt is2r anna.yaml                                     with "robot: robot.yaml": docs/how-to/run-a-study.md

Every finished step is kept: the same command continues after an interruption, a crash, or when people have played.
A file name without a folder that is not in the current folder is looked up among the shipped studies.
""",
)
def is2r(
    study: Annotated[str, Parameter("YAML")],
    /,
    *,
    out: options.RunsFolder = Path("runs"),
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
    """Runs a study of the iterative loop: simulate, play, refine."""
    loaded = study_config.load(files.find_shipped(study, "study"), overrides)
    elsewhere = options.load_site(site, processes=processes, devices=devices)
    if elsewhere is not None and loaded.robot is not None:
        raise ConfigError(f"--site {site}: with a robot the steps are done where it stands; allowed: local")
    options.check_writable(out)
    chosen = loaded.simulation.devices
    options.start_jax(devices or (None if chosen == "auto" else chosen), elsewhere is not None)
    from experiments.jobs.site import Workers
    from experiments.study import session

    processes = 1 if elsewhere else session.choose_processes(loaded, processes, devices)
    with interruptible() if loaded.robot is None else nullcontext():
        done = session.run(loaded, out / loaded.name, make_console(), Workers(processes, elsewhere, str(site)))
    return 0 if done else 130  # while the study waits for people


@command(
    "study-report",
    """\
  mjx-tt study-report runs/study_quick

Writes report/index.html with its pictures and tables: the paper's figures with ours beside them. What a study lacks is
named.
""",
)
def study_report(folder: Annotated[Path, argument("FOLDER", "folder of a study", options.existing())], /) -> None:
    """Writes the report of a study, finished or not, as one HTML page."""
    options.start_jax()
    from experiments.study.report import page

    make_console().print(page.write(folder), soft_wrap=True)


@command(
    "blind",
    """\
  mjx-tt blind make anna-evaluates is2r-ft100=runs/a/artefact s2r-ft100=runs/b/artefact --trainer anna --evaluator anna
  mjx-tt run anna-evaluates/policies/A --robot robot.yaml          and fill in anna-evaluates/sheet.csv; then B, C, ...
  mjx-tt blind sheet anna-evaluates                                how many rallies count so far
  mjx-tt blind open anna-evaluates                                 when all are played: which was which, and the means

The key is sealed in FOLDER/key.sealed; it opens when every code has 50 rallies that count.
docs/how-to/evaluate-blind.md.
""",
)
def blind(
    action: Annotated[Literal["make", "sheet", "open"], Parameter("ACTION")],
    folder: Annotated[Path, Parameter("FOLDER", help="folder of the blind evaluation")],
    /,
    *policies: Annotated[str, Parameter("MODEL=POLICY", help="make: a model's name and its artefact or run")],
    trainer: Annotated[str, option("NAME", "make: who trained the policies")] = "",
    evaluator: Annotated[str, option("NAME", "make: who plays (default: the trainer)")] = "",
    seed: Annotated[int, option("K", "make: seed of the study that the policies belong to")] = 0,
) -> None:
    """Lets people evaluate policies under code names."""
    options.start_jax()
    from experiments.study import blind_protocol
    from experiments.study.analysis import scoring
    from experiments.study.analysis.statistics import t_mean

    screen = make_console()
    if action == "make":
        _make(folder, policies, trainer, evaluator or trainer, seed, screen)
        return
    if policies:
        raise ConfigError(f"blind {action} takes the folder only, got {' '.join(policies)}")
    if not (folder / blind_protocol.KEY).exists():
        raise ConfigError(f"{folder}: holds no sealed key; begin with `mjx-tt blind make {folder} MODEL=POLICY ...`")
    if action == "sheet":
        table = Table("code", "rallies", "that count", f"of {scoring.KEEP}")
        for p in blind_protocol.count_progress(folder):
            table.add_row(p.code, str(p.played), str(p.counted), "done" if p.complete else "open")
        screen.print(table)
        return
    rallies = blind_protocol.open_key(folder)
    table = Table("code", "model", "reported rallies", "mean length (95 %)")
    for model in dict.fromkeys(rallies.model.tolist()):
        mine = rallies.take((rallies.model == model) & rallies.selected)
        mean = t_mean(mine.length)
        table.add_row(str(mine.blind[0]), model, str(mean.n), f"{mean.value:.1f} ({mean.low:.1f} to {mean.high:.1f})")
    screen.print(table)
    screen.print(f"{folder / blind_protocol.EVALUATIONS}, key in {folder / blind_protocol.OPENED}", soft_wrap=True)


def _make(folder: Path, given: tuple[str, ...], trainer: str, evaluator: str, seed: int, console: Console) -> None:
    """Begins a blind evaluation; ``given`` are MODEL=POLICY."""
    from experiments.study import blind_protocol

    policies: dict[str, Path] = {}
    for text in given:
        model, _, path = text.partition("=")
        if not model or not path:
            raise ConfigError(f"{text!r}: a model's name and its policy are wanted, such as is2r-ft100=runs/a/artefact")
        if model in policies:
            raise ConfigError(f"{model}: is given twice")
        policies[model] = Path(path)
    if len(policies) < 2:
        raise ConfigError(f"blind make needs at least two policies, got {len(policies)}")
    if not trainer:
        raise ConfigError(
            "blind make needs --trainer, who trained the policies: for a study's report the player in whose place, "
            "such as --trainer player3; --evaluator is the trainer where it is left out"
        )
    codes = blind_protocol.make(folder, policies, trainer, evaluator, seed)
    where = f"{len(codes)} policies under {folder / blind_protocol.POLICIES}"
    console.print(f"{where}, to be tested in this order: {' '.join(codes)}", soft_wrap=True)
    console.print(f"to print: {folder / blind_protocol.PAGE}", soft_wrap=True)
    console.print(
        f"sheet: {folder / blind_protocol.SHEET}; the key is sealed in {folder / blind_protocol.KEY}", soft_wrap=True
    )
