"""From a stream of positions and velocities to targets for a positioning drive.

To follow a velocity v, the target is put beyond the place where braking from v would have to start, so that the drive
runs at the given speed; the speed is v plus a correction,

    u = v + k (r(t - L) - x(t)),   |k (...)| <= max_correction

of the measured position x against the commanded one r as it was the whole latency L ago, which is when it should be
there. The correction is a proportional controller around a pure delay, without overshoot while k L <= 1/e.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from robot_io.devices.festo.config import AxesConfig

MEMORY = 0.1  # [s] kept beyond the latency; of a silence after which a stream is another one


@dataclass(frozen=True)
class Target:
    """positions [m] at ``time`` and velocities [m/s] to go on with, one each axis."""

    position: tuple[float, ...]
    velocity: tuple[float, ...]
    time: float

    def at(self, time: float) -> tuple[float, ...]:
        since = time - self.time
        return tuple(r + v * since for r, v in zip(self.position, self.velocity, strict=True))


@dataclass(frozen=True)
class Move:
    """Motion of one axis: to ``position`` [m] at up to ``speed`` [m/s]; ``velocity`` is the set-point u."""

    position: float
    speed: float
    velocity: float


class Reference:
    """The commanded positions of the stream that is being followed."""

    def __init__(self, latency: float) -> None:
        self._latency = latency
        self._past: deque[tuple[float, tuple[float, ...]]] = deque()

    def restart(self, now: float) -> None:
        """A stream begins; one that broke off for a moment goes on, since what it asked for is still to come."""
        if self._past and now - self._past[-1][0] > MEMORY:
            self._past.clear()

    def add(self, time: float, position: tuple[float, ...]) -> None:
        past = self._past
        past.append((time, position))
        while len(past) > 2 and past[1][0] <= time - self._latency - MEMORY:
            past.popleft()

    def at(self, received: float) -> tuple[float, ...]:
        """Position due in a state of the time ``received``; at first, where the stream began."""
        time, later = received - self._latency, self._past[-1]
        for earlier in reversed(self._past):
            if earlier[0] <= time:
                share = (time - earlier[0]) / (later[0] - earlier[0]) if later is not earlier else 0.0
                return tuple(a + share * (b - a) for a, b in zip(earlier[1], later[1], strict=True))
            later = earlier
        return later[1]


def move(position: float, velocity: float, error: float, bounds: tuple[float, float], config: AxesConfig) -> Move:
    """One axis's: ``position``, ``velocity`` commanded for now, ``error`` [m] of its lag, ``bounds`` [m] of targets."""
    correction = min(max(config.gain * error, -config.max_correction), config.max_correction)
    u = min(max(velocity + correction, -config.speed), config.speed)
    speed, lead = abs(u), 0.0
    if velocity == 0.0:
        speed = max(speed, config.hold_speed)  # the drive goes to the very position
    else:
        lead = math.copysign(0.5 * u * u / config.acceleration + speed * config.lead, u)
    return Move(min(max(position + lead, bounds[0]), bounds[1]), speed, u)
