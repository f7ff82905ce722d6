"""Motion of an emulated positioning axis: the trapezoid, its smoothing, delayed signals. SI units."""

from __future__ import annotations

import math
from collections import deque

TOUCH = 1e-10  # [m] a stopping point that near to the target is the target


def advance(x: float, v: float, target: float, speed: float, acceleration: float, dt: float) -> tuple[float, float]:
    """Position and velocity after ``dt`` seconds of the fastest motion to rest at ``target``.

    Within ``acceleration``, and ``speed`` once reached from a higher one. Piecewise exact: many short steps give what
    one long step gives.
    """
    while dt > 0.0:
        gap = target - x
        excess = gap - v * abs(v) / (2.0 * acceleration)  # of the target beyond the point where braking now would end
        if abs(excess) < TOUCH:
            if v == 0.0:
                return target, 0.0
            x, v, dt = _at(x, v, -math.copysign(acceleration, v), min(abs(v) / acceleration, dt), dt)
            if dt > 0.0:
                x, v = target, 0.0
            continue
        way = math.copysign(1.0, excess)
        forward, room = way * v, way * gap
        if forward > speed:
            a, phase = -acceleration, (forward - speed) / acceleration
        elif forward < speed:
            peak = min(speed, math.sqrt(max(acceleration * room + 0.5 * forward * forward, 0.0)))
            a, phase = acceleration, max(peak - forward, 0.0) / acceleration
        else:
            a, phase = 0.0, (way * excess) / speed if speed > 0.0 else math.inf
        if phase < 1e-15:  # rounding left nothing of the phase: brake
            x, v, dt = _at(x, v, -math.copysign(acceleration, v), min(abs(v) / acceleration, dt), dt)
            continue
        step = min(phase, dt)
        x, v, dt = _at(x, v, way * a, step, dt)
        if step == phase and forward != speed and abs(way * v - speed) < 1e-12:
            v = way * speed
    return x, v


def _at(x: float, v: float, a: float, step: float, dt: float) -> tuple[float, float, float]:
    after = v + a * step
    if a * v < 0.0 and abs(after) < 1e-12:
        after = 0.0
    return x + 0.5 * (v + after) * step, after, dt - step


def brake(x: float, v: float, acceleration: float, dt: float) -> tuple[float, float]:
    """Position and velocity after ``dt`` seconds of braking to rest."""
    step = min(abs(v) / acceleration, dt)
    x, v, _ = _at(x, v, -math.copysign(acceleration, v), step, dt)
    return x, v if step == dt else 0.0


class Past:
    """Samples of a few numbers over the last ``span`` seconds, read back with linear interpolation."""

    def __init__(self, span: float) -> None:
        self._span = span
        self._samples: deque[tuple[float, ...]] = deque()

    def add(self, time: float, *values: float) -> None:
        samples = self._samples
        samples.append((time, *values))
        while len(samples) > 2 and samples[1][0] <= time - self._span:
            samples.popleft()

    def at(self, time: float) -> tuple[float, ...]:
        """Values at ``time``; the oldest before all samples, the newest after."""
        samples = self._samples
        if time >= samples[-1][0]:
            return samples[-1][1:]
        later = samples[-1]
        for earlier in reversed(samples):
            if earlier[0] <= time:
                share = (time - earlier[0]) / (later[0] - earlier[0])
                return tuple(a + share * (b - a) for a, b in zip(earlier[1:], later[1:], strict=True))
            later = earlier
        return later[1:]
