"""``mjx-tt blind``: a blind evaluation that people play, from its start to the opened key."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from experiments import options
from experiments.errors import ConfigError
from experiments.options import option

if TYPE_CHECKING:
    from rich.console import Console

    from experiments.study.analysis.scoring import Rallies

app = options.command(
    "blind",
    "let people evaluate policies under code names",
    """\
  mjx-tt blind make anna-evaluates is2r-ft100=runs/a/artefact s2r-ft100=runs/b/artefact --trainer anna --evaluator anna
  mjx-tt run anna-evaluates/policies/A --robot robot.yaml          and fill in anna-evaluates/sheet.csv; then B, C, ...
  mjx-tt blind sheet anna-evaluates                                how many rallies count so far
  mjx-tt blind open anna-evaluates                                 when all are played: which was which, and the means

The key is sealed in FOLDER/key.sealed; it opens when every code has 50 rallies that count.
docs/how-to/evaluate-blind.md.
""",
)


@app.default
def blind(
    action: Annotated[Literal["make", "sheet", "open"], Parameter("ACTION")],
    folder: Annotated[str, Parameter("FOLDER", help="folder of the blind evaluation")],
    /,
    *policies: Annotated[str, Parameter("MODEL=POLICY", help="make: a model's name and its artefact or run")],
    trainer: Annotated[str, option("NAME", "make: who trained the policies")] = "",
    evaluator: Annotated[str, option("NAME", "make: who plays (default: the trainer)")] = "",
    seed: Annotated[int, option("K", "make: seed of the study that the policies belong to")] = 0,
) -> None:
    """Raises ConfigError for what cannot be done."""
    options.start_jax(1)
    from experiments.progress import make_console
    from experiments.study import blind_protocol

    screen, place = make_console(), Path(folder)
    if action == "make":
        _make(place, policies, trainer, evaluator or trainer, seed, screen)
        return
    if policies:
        raise ConfigError(f"blind {action} takes the folder only, got {' '.join(policies)}")
    if not (place / blind_protocol.KEY).exists():
        raise ConfigError(f"{folder}: holds no sealed key; begin with `mjx-tt blind make {folder} MODEL=POLICY ...`")
    if action == "sheet":
        _show_progress(place, screen)
    else:
        _show_opened(blind_protocol.open_key(place), place, screen)


def _make(folder: Path, given: tuple[str, ...], trainer: str, evaluator: str, seed: int, console: Console) -> None:
    """Begins a blind evaluation; ``given`` are MODEL=POLICY."""
    from experiments.study import blind_protocol

    policies: dict[str, Path] = {}
    for text in given:
        model, sign, path = text.partition("=")
        if not sign or not model or not path:
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


def _show_progress(folder: Path, console: Console) -> None:
    """Number of rallies of each code."""
    from rich.table import Table

    from experiments.study import blind_protocol
    from experiments.study.analysis import scoring

    table = Table("code", "rallies", "that count", f"of {scoring.KEEP}")
    for p in blind_protocol.count_progress(folder):
        table.add_row(p.code, str(p.played), str(p.counted), "done" if p.complete else "open")
    console.print(table)


def _show_opened(rallies: Rallies, folder: Path, console: Console) -> None:
    """Which code was which model, with the mean of the reported rallies."""
    from rich.table import Table

    from experiments.study import blind_protocol
    from experiments.study.analysis.statistics import t_mean

    table = Table("code", "model", "reported rallies", "mean length (95 %)")
    for model in dict.fromkeys(rallies.model.tolist()):
        mine = rallies.take((rallies.model == model) & rallies.selected)
        mean = t_mean(mine.length)
        table.add_row(str(mine.blind[0]), model, str(mean.n), f"{mean.value:.1f} ({mean.low:.1f} to {mean.high:.1f})")
    console.print(table)
    console.print(f"{folder / blind_protocol.EVALUATIONS}, key in {folder / blind_protocol.OPENED}", soft_wrap=True)
