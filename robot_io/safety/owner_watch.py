"""A watch on the program that the operator uses: while the robot is armed, it must show that it reads the keys."""

from __future__ import annotations

BEAT_PERIOD = 0.1  # [s] at least between two signs of life
# [s] without one. A ball takes less than a second, so one or two may be played unwatched. The longest that an owner
# sleeps is 1 s, after a fault; a terminal that redraws slowly on a busy machine must not end the play either.
LONGEST_SILENCE = 2.0
LONGEST_ABSENCE = 30.0  # [s] that an owner may announce while the robot takes no balls, as for an update's computation
LONGEST_STEP = 0.1  # [s] that count of a gap between two ticks: while this process stood still nobody could be heard


class OwnerWatch:
    """The owner's silence, counted from tick to tick. Times are seconds of one monotonic clock, passed in."""

    def __init__(self) -> None:
        self._silence, self._allowed = 0.0, LONGEST_SILENCE
        self._last: float | None = None

    def heard(self, absence: float = 0.0) -> None:
        """A sign of life; ``absence`` [s]: the next one may take so long, up to LONGEST_ABSENCE."""
        self._silence, self._allowed = 0.0, min(max(absence, LONGEST_SILENCE), LONGEST_ABSENCE)

    def ticked(self, now: float) -> str:
        """The reason to stop at this control tick, as a sentence; empty: none."""
        gap = 0.0 if self._last is None else now - self._last
        self._silence, self._last = self._silence + min(max(gap, 0.0), LONGEST_STEP), now
        if self._silence <= self._allowed:
            return ""
        return f"the operator's program was not heard for {self._allowed:g} s: it or its terminal hung"
