"""Positions of the arm, whose speed is measured on the controller's own clock while that clock agrees with arrivals.

Packets bunch up behind whatever stalls: a network, a switch, the scheduler of either end. Ten that were sent over 40 ms
and arrive within one look like a fast joint to whoever divides by arrival times. Their stamps tell when they were sent,
but a clock that stands still, jumps or runs ahead could hide a motion; so it counts only while the packets' least
delays stay the same.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from robot_io.history import History

BLOCK = 0.5  # [s] of packets whose least delay is compared with that of the block before
AGREES = 0.005  # [s] by which least delays may differ; no sender's packets arrive before they were sent


class SenderClock:
    """Compares a sender's stamps with the arrivals of its packets.

    trusted  two blocks in a row had the same least delay, every stamp was later than the one before, and no packet came
             sooner after its stamp than those of the block before
    """

    def __init__(self) -> None:
        self.trusted = False
        self._sent = self._began = math.inf  # the first packet is later than none
        self._before, self._least = math.inf, math.inf  # least delays [s]: of the block before, of this one

    def add(self, sent: float, received: float) -> None:
        """Take a packet's stamp [s, sender's clock] and its arrival [s]; a stamp that is NaN is never trusted."""
        delay, rising, self._sent = received - sent, sent > self._sent, sent
        if not rising or self._before < math.inf and delay < self._before - AGREES:
            self.trusted, self._before, self._least, self._began = False, math.inf, math.inf, received
        if rising:
            self._least = min(self._least, delay)
        if received - self._began >= BLOCK:
            self.trusted = abs(self._least - self._before) <= AGREES
            self._before, self._least, self._began = self._least, math.inf, received


class ArmHistory(History):
    """Positions (6,) [rad] by their arrivals; ``slope`` goes by the controller's stamps while those are trusted."""

    def __init__(self, length: int = 64, longest_hold: float = 0.05) -> None:
        super().__init__(length, longest_hold)
        self.clock = SenderClock()
        self._sent: deque[float] = deque(maxlen=length)

    def add(self, time: float, value: np.ndarray, sent: float = math.nan) -> bool:
        """Take a sample that arrived at ``time`` [s], stamped ``sent`` [s] by the controller."""
        if not super().add(time, value):
            return False
        self._sent.append(sent)
        self.clock.add(sent, time)
        return True

    def clear(self) -> None:
        super().clear()
        self._sent.clear()

    def slope(self, span: float, at_least: int = 0) -> np.ndarray | None:
        """Rate of change, as ``History.slope``, on the controller's clock while it is trusted."""
        return self._slope(self._sent if self.clock.trusted else self._times, span, at_least)
