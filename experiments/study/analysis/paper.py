"""The paper's study as data, read from ``paper.yaml``: models, players, cross-evaluators and claims."""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib import resources
from typing import Any

import yaml

from ballmodel import registry

_DATA = yaml.safe_load(resources.files(__package__).joinpath("paper.yaml").read_text(encoding="utf-8"))


@dataclass(frozen=True)
class Claim:
    """Something that the paper says, and how it is measured and judged; the keys are explained in ``paper.yaml``."""

    key: str
    text: str
    source: str
    quantity: str
    statistic: str
    expect: str
    paper: float | None = None
    of: dict[str, Any] = field(default_factory=dict)


METHODS: dict[str, tuple[str, ...]] = {key: tuple(content["models"]) for key, content in _DATA["methods"].items()}
"""Models of each method in the order of training, by their names in a study's folder."""
COLOURS: dict[str, str] = {method: content["colour"] for method, content in _DATA["methods"].items()}
LEGEND: dict[str, str] = {method: content["legend"] for method, content in _DATA["methods"].items()}
IS2R, S2R, ORACLE, FRESH, IDENTIFIED, ABLATION = METHODS
METHOD_OF = {model: method for method, models in METHODS.items() for model in models}
TEN = METHODS[IS2R] + METHODS[S2R] + METHODS[ORACLE]
SHORT: dict[str, str] = _DATA["final"]
LAST = tuple(SHORT)
FINAL = LAST[:3]
"""The final policies of the paper's methods, which are cross-evaluated."""
CROSS: dict[str, tuple[str, ...]] = {trainer: tuple(evaluators) for trainer, evaluators in _DATA["cross"].items()}
BY_SKILL = tuple(CROSS)
LEVELS = ("beginner", "intermediate", "advanced")
WITHOUT = "all but the advanced"
GROUPS = ("all", *LEVELS, WITHOUT)
CLAIMS = tuple(Claim(key, **content) for key, content in _DATA["claims"].items())


def level(player: str) -> str:
    """Skill level of a player (table player_skill). Raises ValueError for an unknown name."""
    return registry.skill(player).level


def of_level(group: str) -> tuple[str, ...]:
    """Players of one of ``GROUPS``, from the lowest to the highest skill."""
    if group == "all":
        return BY_SKILL
    if group == WITHOUT:
        return tuple(p for p in BY_SKILL if level(p) != "advanced")
    return tuple(p for p in BY_SKILL if level(p) == group)
