"""Allowed ranges of the numbers in files, as annotations of their fields: ``Annotated[float, Within(0.0, 1.0, "s")]``.

Pydantic reads such a field as a finite number (``ballmodel.io.validation``), and ``check_fields`` looks at what a
program has built, without pydantic, which the robot's side does not load.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from numbers import Real
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin, get_type_hints

if TYPE_CHECKING:
    from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
    from pydantic.json_schema import JsonSchemaValue
    from pydantic_core import CoreSchema


@dataclass(frozen=True)
class Within:
    """A finite number from ``low`` to ``high``, in SI units; the ends are allowed.

    Files hold one number, also where a program may put an array of a batch. A whole number stays one.
    """

    low: float = -math.inf
    high: float = math.inf
    unit: str = ""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        from pydantic_core import core_schema

        low, high = (end if math.isfinite(end) else None for end in (self.low, self.high))
        if source is int:
            least, most = low if low is None else math.ceil(low), high if high is None else math.floor(high)
            return core_schema.int_schema(ge=least, le=most)
        return core_schema.float_schema(ge=low, le=high, allow_inf_nan=False)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        return handler(schema) | ({"unit": self.unit} if self.unit else {})

    def __str__(self) -> str:
        if math.isinf(self.high):
            ends = "a finite number" if math.isinf(self.low) else f"at least {self.low:g}"
        else:
            ends = f"{self.low:g} to {self.high:g}" if self.low < self.high else f"{self.low:g}"
        return f"{ends}{self.unit and ' '}{self.unit}"


FINITE = Within()


@cache
def type_hints(kind: type) -> dict[str, Any]:
    """Type hints of a dataclass with their annotations."""
    return get_type_hints(kind, include_extras=True)


def find_note(hint: Any) -> Any:
    """The ``Within`` or ``Literal`` in a type hint that says which values are allowed; None where there is none."""
    if get_origin(hint) is Literal:
        return hint
    if get_origin(hint) is Annotated:
        return next((note for note in get_args(hint)[1:] if isinstance(note, Within)), None)
    return next((found for found in map(find_note, get_args(hint)) if found), None)


def check_fields(config: Any) -> None:
    """Checks annotated numbers and choices of a dataclass and of the dataclasses in it; None is allowed.

    Raises ValueError naming the first field at fault, what is allowed and the value.
    """
    _check("", config, None)


def _check(path: str, value: Any, allowed: Any) -> None:
    if isinstance(value, tuple):
        for i, entry in enumerate(value):
            _check(f"{path}[{i}]", entry, allowed)
    elif is_dataclass(value):
        owner: Any = type(value)
        hints = type_hints(owner)
        for field in fields(value):
            _check(f"{path}.{field.name}".lstrip("."), getattr(value, field.name), find_note(hints[field.name]))
    elif allowed is not None and value is not None:
        if isinstance(allowed, Within):
            number = isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
            right, words = number and allowed.low <= value <= allowed.high, str(allowed)
        else:
            right, words = value in get_args(allowed), " or ".join(map(repr, get_args(allowed)))
        if not right:
            raise ValueError(f"{path}: expected {words}, got {value!r}")
