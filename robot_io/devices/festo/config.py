"""Settings of the two linear axes, and what they report. SI units."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ballmodel.io.ranges import Within


@dataclass(frozen=True)
class AxesConfig:
    """Settings of the motion and of the supervision; SI units.

    speed, acceleration  highest that are commanded
    latency              L: from a commanded velocity to its effect in the position that is read back [s]
    gain, max_correction k [1/s] and the bound of the correction [m/s]
    lead                 how far ahead of the braking distance the target lies, in time at the speed [s]; longer than
                         the longest gap between two cycles plus the timing error of the position
    hold_speed           for reaching a target whose velocity is 0
    max_error            deviation from the commanded position that is a fault [m]
    node_guard           silence after which a drive stops by itself [s]; set at start-up where the profile can
    command_timeout      age of a command at which the axes stop and hold [s]; never more than the gate's ``late``
    state_timeout        age of the state at which it counts as unknown [s]
    acknowledge_timeout, enable_timeout, homing_timeout [s]
    overtravel           how far beyond either end of the range a search for the reference may take an axis [m]: to
                         switches and stops, as measured on the robot
    """

    speed: Annotated[float, Within(0.01, 2.0, "m/s")] = 2.0
    acceleration: Annotated[float, Within(0.1, 15.0, "m/s^2")] = 15.0
    latency: Annotated[float, Within(0.001, 0.3, "s")] = 0.0645 + 0.033
    gain: Annotated[float, Within(0.001, 20.0, "1/s")] = 3.0
    max_correction: Annotated[float, Within(0.001, 0.5, "m/s")] = 0.3
    lead: Annotated[float, Within(0.001, 0.1, "s")] = 0.05
    hold_speed: Annotated[float, Within(0.001, 0.5, "m/s")] = 0.1
    max_error: Annotated[float, Within(0.005, 0.15, "m")] = 0.1
    node_guard: Annotated[float, Within(0.02, 0.2, "s")] = 0.1
    command_timeout: Annotated[float, Within(0.02, 0.1, "s")] = 0.03
    state_timeout: Annotated[float, Within(0.02, 0.1, "s")] = 0.05
    acknowledge_timeout: Annotated[float, Within(0.1, 10.0, "s")] = 1.0
    enable_timeout: Annotated[float, Within(0.1, 30.0, "s")] = 5.0
    homing_timeout: Annotated[float, Within(0.1, 120.0, "s")] = 30.0
    overtravel: Annotated[float, Within(0.0, 0.5, "m")] = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (math.isfinite(value) and (value > 0 or (value == 0 and name == "overtravel"))):
                raise ValueError(f"{name}: expected a positive, finite number, got {value}")
        if self.gain * self.latency > 1 / math.e:
            raise ValueError(
                f"gain: expected at most {1 / math.e / self.latency:.2f} / s with a latency of {self.latency} s, got "
                f"{self.gain}; more overshoots"
            )


@dataclass(frozen=True, eq=False)
class AxesState:
    """State of the drives by their answers.

    position  (2,) [m], velocity (2,) [m/s], read-only
    received  ``now`` of the older of the two answers [s]
    enabled, homed  both are
    """

    position: np.ndarray
    velocity: np.ndarray
    received: float
    enabled: bool
    homed: bool


@dataclass(frozen=True)
class AxesFault:
    """Reason why the axes were stopped: a short name and a sentence.

    Names: axis_lost, drive_fault, switched_off, acknowledge_timeout, enable_timeout, homing_timeout, node_guard,
    units, bad_answer, following_error.
    """

    cause: str
    sentence: str
