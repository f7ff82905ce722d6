"""Reference of a robot that is being stopped: it ends where the arm is measured to be, not where it was sent.

A device goes on towards its reference, so a reference that stays ahead of a blocked joint keeps pushing, and leads the
joint there when the obstacle goes away. While the gate brakes, a joint that follows keeps the way that was proven
clear. A joint whose measurement the commands of the last ``delay`` seconds do not explain may be led by its
reference no further than braking from its measured velocity takes it; every joint at rest takes its measured position.
"""

from __future__ import annotations

import math

import numpy as np

from robot_io.contract import JOINT_UNITS
from robot_io.limits import JointLimits
from robot_io.safety.config import SafetyConfig

UNEXPLAINED = {"m": 0.01, "rad": 0.03}  # [m], [rad] from which on a joint does not follow
JITTER = 0.02  # [s] by which the time between two measurements may differ from that between two ticks


class StopReference:
    """Corrects a reference from the first command of a stop until the gate is armed again."""

    def __init__(self, limits: JointLimits, config: SafetyConfig, units: tuple[str, ...] = JOINT_UNITS) -> None:
        self._acceleration = np.array(limits.acceleration)
        self._fastest = config.overspeed * np.array(limits.velocity)
        self._still = np.array(config.still)
        self._latency = config.delay
        self._unexplained = np.array([UNEXPLAINED[unit] for unit in units])
        self._lost = np.zeros(len(units), bool)  # joints that were found not to follow in this stop
        self._at_rest_since = math.inf  # [s] of the commands
        self._last: tuple[float, np.ndarray] | None = None  # time and measured position

    def restart(self) -> None:
        """Every joint counts as following; called when the gate is armed."""
        self._lost[:] = False
        self._at_rest_since = math.inf

    def credible(self, position: np.ndarray, now: float) -> bool:
        """Compare a measurement (8,) with the one before: False for a jump that no joint can make. Once per tick."""
        last, self._last = self._last, (now, position)
        if last is None:
            return True
        reach = self._fastest * (max(now - last[0], 0.0) + JITTER)
        return bool((np.abs(position - last[1]) <= reach).all())

    def settled(self, velocity: np.ndarray, now: float) -> np.ndarray:
        """Joints (8,) at rest: zero was commanded longer than the latency ago and the measured speed is ``still``."""
        return (now - self._at_rest_since >= self._latency) & (np.abs(velocity) <= self._still)

    def corrected(
        self,
        reference: np.ndarray,
        commanded: np.ndarray,
        position: np.ndarray,
        velocity: np.ndarray,
        unexplained: np.ndarray,
        now: float,
    ) -> np.ndarray:
        """Reference (8,) to go on from.

        commanded            (8,) velocity in force
        position, velocity   (8,) as measured
        unexplained          (8,) distance of ``position`` from where the reference was during the latency
        """
        if commanded.any():
            self._at_rest_since = math.inf
        elif self._at_rest_since == math.inf:
            self._at_rest_since = now
        self._lost |= unexplained > self._unexplained
        way = velocity * self._latency + velocity * np.abs(velocity) / (2.0 * self._acceleration)
        led = np.clip(reference, position + np.minimum(way, 0.0), position + np.maximum(way, 0.0))
        return np.where(self.settled(velocity, now), position, np.where(self._lost, led, reference))

    def give_up(self) -> None:
        """No joint counts as following: ``corrected`` bounds the lead of all."""
        self._lost[:] = True
