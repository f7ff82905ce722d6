"""Finds the paper's distributions by name: ``player1/M0`` to ``player5/M2``, large, medium, narrow, s2r-oracle.

Balls are a box of 16 numbers or a mixture of start states; a YAML with the key ``components`` holds the latter.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

from ballmodel.distribution import BallDistribution, BoxFile, load_distribution, parse_distribution
from ballmodel.io.validation import Section, find, validate
from ballmodel.io.yaml import read as read_yaml
from ballmodel.mixture import BallMixture, parse_mixture

Balls: TypeAlias = BallDistribution | BallMixture

FOLDER = Path(__file__).parent / "data"


@dataclass(frozen=True)
class Skill:
    """A player's level and rally lengths (number of hits) over all evaluations, paper's table player_skill."""

    level: str  # beginner, intermediate or advanced
    min: int
    p25: float
    mean: float
    std: float
    p75: float
    max: int


class PlayerFile(Section):
    """The YAML of one of the paper's players: a box for each round, and the player's skill."""

    name: str
    """Name of the player."""
    source: str
    """Where the numbers come from."""
    paper: Any = None
    """Notes on the published table."""
    skill: Skill
    """Level and rally lengths."""
    models: dict[str, BoxFile]
    """By the name of the round."""


@cache
def _catalogue() -> tuple[dict[str, BallDistribution], dict[str, Skill]]:
    distributions, skills = {}, {}
    for path in sorted(FOLDER.glob("*.yaml")):
        data = read_yaml(path)
        if "models" not in data:
            distribution = load_distribution(path)
            distributions[distribution.name] = distribution
            continue
        player = validate(PlayerFile, data, str(path))
        skills[player.name] = player.skill
        for model, box in player.models.items():
            name = f"{player.name}/{model}"
            distributions[name] = box.box(name, player.source)
    return distributions, skills


def names() -> tuple[str, ...]:
    """The names that ``load`` knows."""
    return tuple(_catalogue()[0])


def load(name: str) -> BallDistribution:
    """The distribution of that name, such as "player3/M1" or "narrow". Raises ValueError listing the valid names."""
    return find(_catalogue()[0], name, "distribution")


def skill(player: str) -> Skill:
    """The skill of "player1" to "player5". Raises ValueError listing the valid names."""
    return find(_catalogue()[1], player, "player")


def parse_balls(data: Any, where: str, name: str = "", source: str = "") -> Balls:
    """Builds a distribution or a mixture from its YAML form; ``where`` opens every message. Raises ValueError."""
    parse = parse_mixture if isinstance(data, dict) and "components" in data else parse_distribution
    return parse(data, where, name, source)


def box_of(balls: Balls) -> BallDistribution:
    """The box itself, or a mixture's bounds."""
    return balls.box if isinstance(balls, BallMixture) else balls


def resolve(name_or_path: str | os.PathLike) -> Balls:
    """The named distribution, or the one or the mixture in the YAML file at that path.

    Raises ValueError or FileNotFoundError.
    """
    path = Path(name_or_path)
    if path.suffix not in (".yaml", ".yml"):
        return load(str(name_or_path))
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; expected a distribution's YAML or one of {', '.join(names())}")
    return parse_balls(read_yaml(path), str(path), path.stem)
