"""No linear axes at all: an arm on a fixed base, in the place of ``FestoAxes`` and of the thread that drives them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike


@dataclass
class FixedBase:
    """Always there, at no position; nothing to home, to stop or to fail."""

    position: np.ndarray = field(default_factory=lambda: np.zeros(0))
    received: float = 0.0
    fault: None = None
    homed: bool = True
    enabled: bool = True
    answering: bool = True
    homing: bool = False
    cycles: int = 0  # none: there is nobody to exchange with
    late: int = 0

    @property
    def state(self) -> FixedBase:
        return self

    def cycle(self, now: float) -> None:
        self.received = now

    def command(self, position: ArrayLike, velocity: ArrayLike, now: float) -> None:
        """Take a target for no axis. Raises ValueError for any number."""
        if np.size(position) or np.size(velocity):
            raise ValueError(f"a fixed base has no axes, got position {position!r} and velocity {velocity!r}")

    def enable(self) -> None: ...

    home = acknowledge = stop = disable = start = close = enable

    def preparable(self, now: float) -> bool:
        return True

    def problem(self, now: float) -> str | None:
        return None
