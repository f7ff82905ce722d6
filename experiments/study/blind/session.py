"""The command ``mjx-tt blind``: a blind evaluation that people play, from its start to the opened key."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Console
from rich.table import Table

from experiments.errors import ConfigError
from experiments.study.analysis import scoring
from experiments.study.analysis.statistics import t_mean
from experiments.study.blind import protocol


def run(options: argparse.Namespace, console: Console) -> None:
    """make, sheet or open. Raises ConfigError for what cannot be done."""
    folder = Path(options.folder)
    if options.action == "make":
        make(folder, options.policies, options.trainer, options.evaluator or options.trainer, options.seed, console)
        return
    if options.policies:
        raise ConfigError(f"blind {options.action} takes the folder only, got {' '.join(options.policies)}")
    if not (folder / protocol.KEY).exists():
        raise ConfigError(f"{folder}: holds no sealed key; begin with `mjx-tt blind make {folder} MODEL=POLICY ...`")
    if options.action == "sheet":
        show_progress(folder, console)
    else:
        show_opened(protocol.open_key(folder), folder, console)


def make(folder: Path, given: list[str], trainer: str, evaluator: str, seed: int, console: Console) -> None:
    """Begins a blind evaluation; ``given`` are MODEL=POLICY."""
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
    codes = protocol.make(folder, policies, trainer, evaluator, seed)
    console.print(
        f"{len(codes)} policies under {folder / protocol.POLICIES}, to be tested in this order: {' '.join(codes)}",
        highlight=False,
        soft_wrap=True,
    )
    console.print(
        f"sheet: {folder / protocol.SHEET}; the key is sealed in {folder / protocol.KEY}",
        highlight=False,
        soft_wrap=True,
    )


def show_progress(folder: Path, console: Console) -> None:
    """How many rallies each code has."""
    table = Table("code", "rallies", "that count", f"of {scoring.KEEP}")
    for p in protocol.progress(folder):
        table.add_row(p.code, str(p.played), str(p.counted), "done" if p.complete else "open")
    console.print(table)


def show_opened(rallies: scoring.Rallies, folder: Path, console: Console) -> None:
    """Which code was which model, with the mean of the reported rallies."""
    table = Table("code", "model", "reported rallies", "mean length (95 %)")
    for model in dict.fromkeys(rallies.model.tolist()):
        mine = rallies.take((rallies.model == model) & rallies.selected)
        mean = t_mean(mine.length)
        table.add_row(str(mine.blind[0]), model, str(mean.n), f"{mean.value:.1f} ({mean.low:.1f} to {mean.high:.1f})")
    console.print(table)
    console.print(
        f"{folder / protocol.EVALUATIONS}, key in {folder / protocol.OPENED}", highlight=False, soft_wrap=True
    )
