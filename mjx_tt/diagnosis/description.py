"""Description of an effect, the same for ball and joints: its words, its unit and the reading that settles it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Description:
    """An effect in words, from which verdict, report and reference page are made.

    claim: sentence of a verdict, by default the meaning with the numbers. Its fields: {way} is ``more`` or ``less``,
    by the sign of the change; {value} the estimate, {size} its change, {nominal} the nominal value, {instead} both
    values.
    """

    name: str
    meaning: str  # a few words for readers who do not know the name
    unit: str
    reading: str  # measurement that would settle it
    claim: str = "{meaning}: {instead}"
    more: str = ""
    less: str = ""
