"""``mjx-tt balls``: the paper's players and ball distributions."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from experiments import options

if TYPE_CHECKING:
    from rich.console import Console

    from ballmodel.distribution import BallDistribution

app = options.command("balls", "list the paper's players and ball distributions", "  mjx-tt balls\n")


@app.default
def list_balls() -> None:
    """Prints the paper's distributions with their 16 numbers, and the players' skill."""
    from rich.table import Table

    from ballmodel import registry
    from experiments.progress import make_console

    screen = make_console()
    print_numbers({name: registry.load(name) for name in registry.names()}, screen)
    table = Table(
        "player", "level", "mean rally", "std", "min", "max", title="Skill (hits per rally)", title_justify="left"
    )
    for player in sorted({name.split("/")[0] for name in registry.names() if "/" in name}):
        skill = registry.skill(player)
        table.add_row(player, skill.level, *(f"{v:g}" for v in (skill.mean, skill.std, skill.min, skill.max)))
    screen.print(table)


def print_numbers(balls: dict[str, BallDistribution], console: Console, bold: Iterable[str] = ()) -> None:
    """Prints the 16 numbers of each distribution; those named in ``bold`` stand out."""
    from rich.table import Table

    from ballmodel.distribution import AXES

    table = Table(
        "balls",
        *(f"{part[0]}{axis}" for part, axes in AXES.items() for axis in axes),
        title="Start position p [m], velocity v [m/s], landing point l [m]: min ... max",
        title_justify="left",
    )
    for name, each in balls.items():
        pairs = [
            f"{low:.2f}\n{high:.2f}"
            for part in AXES
            for low, high in zip(getattr(each, f"{part}_min"), getattr(each, f"{part}_max"), strict=True)
        ]
        table.add_row(name, *pairs, style="bold" if name in bold else None, end_section=True)
    console.print(table)
