"""Allowed ranges of the numbers in a configuration, by dotted path."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import is_dataclass
from numbers import Real
from typing import Any

Ranges = Mapping[str, tuple[float, float]]


def check_ranges(config: Any, ranges: Ranges) -> None:
    """Raise ValueError naming the first field outside its range, the value and the range.

    config  a dataclass; a path leads through its fields, and through every entry of a tuple. None is not checked.

    Raises AttributeError for a path through a field that a dataclass does not have.
    """
    for where, value, allowed in outside(config, ranges):
        raise ValueError(f"{where} is {value}, allowed is {allowed}")


def outside(config: Any, ranges: Ranges) -> Iterator[tuple[str, Any, str]]:
    """Values that are no number in their range: where each stands, what it is, and what is allowed in words.

    config  a dataclass, or what a file of it holds; omitted keys and None are not looked at
    """
    for path, (low, high) in ranges.items():
        allowed = f"{low:g} to {high:g}" if low < high else f"{low:g}"
        for where, value in _values(config, path.split(".")):
            if value is None or (is_number(value) and low <= value <= high):
                continue
            yield where, value, allowed


def is_number(value: Any) -> bool:
    """True for a real number; booleans are none."""
    return isinstance(value, Real) and not isinstance(value, bool)


def _values(owner: Any, path: list[str], where: str = "") -> list[tuple[str, Any]]:
    if isinstance(owner, (tuple, list)):
        return [found for i, entry in enumerate(owner) for found in _values(entry, path, f"{where}[{i}]")]
    if not path:
        return [(where, owner)]
    if is_dataclass(owner):
        below = getattr(owner, path[0])  # an error for a path that is none: it would check nothing
    else:
        below = owner.get(path[0]) if isinstance(owner, dict) else None
    return _values(below, path[1:], f"{where}.{path[0]}".removeprefix("."))
