"""Description of an effect, the same for ball and joints: its words, its unit and the reading that settles it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Description:
    """An effect in words, from which verdict, report and reference page are made.

    claim: sentence of a verdict, by default the meaning with the numbers. Its fields: {way:more|less}, one of two words
    by the sign of the change; {value} the estimate, {size} its change, {nominal} the nominal value, {instead} both.
    """

    name: str
    meaning: str  # a few words for readers who do not know the name
    unit: str
    reading: str  # measurement that would settle it
    claim: str = "{meaning}: {instead}"


@dataclass(frozen=True)
class Way:
    """Sign of a change, written in a claim as one of two words."""

    up: bool

    def __format__(self, words: str) -> str:
        return words.split("|")[not self.up]
