"""Allowed ranges of the numbers in a configuration, by dotted path."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

Ranges = Mapping[str, tuple[float, float]]


def check_ranges(config: Any, ranges: Ranges) -> None:
    """Raise ValueError naming the first field outside its range, the value and the range.

    config  a dataclass; a path leads through its fields, and through every entry of a tuple. None is not checked.
    """
    for path, (low, high) in ranges.items():
        for where, value in _values(config, path.split(".")):
            if value is not None and not (low <= value <= high and math.isfinite(value)):
                raise ValueError(f"{where} is {value}, allowed is {low:g} to {high:g}")


def _values(owner: Any, path: list[str], where: str = "") -> list[tuple[str, Any]]:
    if isinstance(owner, tuple):
        return [found for i, entry in enumerate(owner) for found in _values(entry, path, f"{where}[{i}]")]
    if not path:
        return [(where, owner)]
    return _values(getattr(owner, path[0]), path[1:], f"{where}.{path[0]}".removeprefix("."))
