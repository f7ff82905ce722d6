"""Finds the paper's distributions by name: ``player1/M0`` to ``player5/M2``, large, medium, narrow, s2r-oracle."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

from ballmodel.distribution import BallDistribution, BallMixture, BoxFile, MixtureFile
from ballmodel.io import validation, yaml
from ballmodel.io.validation import Section, find, validate

Balls: TypeAlias = BallDistribution | BallMixture

PAPER = Path(__file__).parent / "data" / "paper.yaml"


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


class PaperFile(Section):
    """The YAML of the paper's balls and players."""

    source: str
    """Where the numbers of a ball come from that names no other."""
    balls: dict[str, BoxFile]
    """By name; of a player for each round."""
    skills: dict[str, Skill]
    """Levels and rally lengths of the players."""


@cache
def _paper() -> PaperFile:
    return validation.read(PaperFile, PAPER)


def names() -> tuple[str, ...]:
    """The names that ``load`` knows."""
    return tuple(_paper().balls)


def load(name: str) -> BallDistribution:
    """The distribution of that name, such as "player3/M1" or "narrow". Raises ValueError listing the valid names."""
    return find(_paper().balls, name, "distribution").build(name, _paper().source)


def skill(player: str) -> Skill:
    """The skill of "player1" to "player5". Raises ValueError listing the valid names."""
    return find(_paper().skills, player, "player")


def parse_balls(data: Any, where: str, name: str = "", source: str = "") -> Balls:
    """A distribution, or a mixture, from its YAML form.

    Args:
        data: what the YAML holds.
        where: file and key, which open every message.
        name, source: stand in for missing ones.

    Raises:
        ValueError: naming the key at fault, what was given and what is allowed.
    """
    if not (isinstance(data, dict) and "components" in data):
        return validate(BoxFile, data, where).build(name, source)
    file = validate(MixtureFile, data, where)
    try:
        return file.build(name, source)
    except ValueError as error:
        raise ValueError(f"{where}: components: {error}") from None


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
    return parse_balls(yaml.read(path), str(path), path.stem)
