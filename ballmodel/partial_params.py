"""Parameters that a compiled program leaves out where they are at their nominal value.

A nominal extra (a tilt of zero, a drive without lag) would cost its arithmetic in every step of every episode. As None
it is an empty branch of the pytree: what is traced with it is the program that never knew of it, bit for bit.
"""

from __future__ import annotations

import dataclasses
from dataclasses import field
from typing import Any, TypeVar

from ballmodel.vec import Scalars

T = TypeVar("T")


def optional(nominal: float) -> Any:
    """A dataclass field with this nominal value, which ``without_nominal`` may replace by None."""
    return field(default=nominal, metadata={"optional": True})


def without_nominal(params: T) -> T:
    """The same dataclass with every ``optional`` field None that is a plain number equal to its nominal value.

    Arrays stay, zero or not: a traced value may become anything.
    """
    if not dataclasses.is_dataclass(params) or isinstance(params, type):
        return params
    changed: dict[str, Any] = {}
    for f in dataclasses.fields(params):
        value = getattr(params, f.name)
        if dataclasses.is_dataclass(value):
            changed[f.name] = without_nominal(value)
        elif f.metadata.get("optional") and isinstance(value, int | float) and value == f.default:
            changed[f.name] = None
    return dataclasses.replace(params, **changed)


def value_or(value: Scalars | None, nominal: float) -> Scalars:
    """``value``, or ``nominal`` where it was left out."""
    return nominal if value is None else value
