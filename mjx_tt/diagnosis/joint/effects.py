"""The drive effects that a diagnosis can name: how a fit moves each, and what would show it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mjx_tt.diagnosis.joint.forward_model import JointResponse
from mjx_tt.diagnosis.joint.log import JointLog

SMALLEST_DELAY = 2e-3  # [s] below which neither a delay nor a lag is named


@dataclass(frozen=True)
class Effect:
    """One entry of the catalogue: a parameter of JointResponse.

    Effects with a threshold have no gradient while they are inactive: every effect starts from a grid.
    """

    name: str
    unit: str  # "u" stands for the unit of the joint's position
    starts: Callable[[JointLog, float], tuple[float, ...]]  # (log, nominal value) -> where fits begin
    step: Callable[[JointLog, float], float]  # finite difference at a value
    bounds: Callable[[JointLog], tuple[float, float]]
    interest: Callable[[JointLog, float], float]  # (log, nominal value) -> smallest change worth knowing about
    experiment: str  # a log that would show it
    smallest: float = 0.0  # change below which it is not named

    def unit_of(self, log: JointLog) -> str:
        return self.unit.replace("u", log.unit)

    def experiment_for(self, log: JointLog) -> str:
        return self.experiment.format(joint=log.record.joint, velocity=log.rated_velocity, unit=log.unit)


def _raised(base: float) -> tuple[float, ...]:
    """Limits above the nominal one."""
    return () if math.isinf(base) else (1.1 * base, 1.5 * base)


def _between_sizes(log: JointLog) -> tuple[float, ...]:
    """Thresholds between the sizes of the commands."""
    if log.sizes.size < 2:
        return ()
    cuts = np.unique(np.quantile(log.sizes, np.geomspace(0.01, 0.8, 24)))
    return tuple(float(c) * (1.0 + 1e-9) for c in cuts)


CATALOGUE: tuple[Effect, ...] = (
    Effect(
        "action_delay",  # the sum of both delays, which alone shows in a log
        "s",
        starts=lambda log, b: tuple(max(b + d, 0.0) for d in (-0.05, -0.02, 0.01, 0.03, 0.07, 0.12)),
        step=lambda log, x: 1e-3,
        bounds=lambda log: (0.0, 0.5),
        interest=lambda log, b: b + 0.005,
        experiment="reverse {joint} quickly and often",
        smallest=SMALLEST_DELAY,
    ),
    Effect(
        "lag",
        "s",
        starts=lambda log, b: (b + 0.006, b + 0.02, b + 0.06, b + 0.15),
        step=lambda log, x: 1e-3 + 0.02 * x,
        bounds=lambda log: (0.0, 0.6),
        interest=lambda log, b: b + 0.01,
        experiment="give {joint} steps of its velocity",
        smallest=SMALLEST_DELAY,
    ),
    Effect(
        "velocity_gain",
        "1",
        starts=lambda log, b: (0.85 * b, 1.1 * b),
        step=lambda log, x: 5e-3,
        bounds=lambda log: (0.1, 4.0),
        interest=lambda log, b: 0.98 * b,
        experiment="sweep {joint} over long ways at two speeds",
    ),
    Effect(
        "velocity_limit",
        "u/s",
        starts=lambda log, b: tuple(log.fastest * f for f in (0.97, 0.9, 0.8, 0.65, 0.45, 0.25)) + _raised(b),
        step=lambda log, x: 0.01 * x,
        bounds=lambda log: (0.02 * log.fastest, 3.0 * log.fastest),
        interest=lambda log, b: 0.9 * min(log.rated_velocity, b),
        experiment="sweep {joint} up to {velocity:.2g} {unit}/s",
    ),
    Effect(
        "acceleration_limit",
        "u/s^2",
        starts=lambda log, b: tuple(log.fastest / s for s in (1.5, 0.5, 0.2, 0.08, 0.03)) + _raised(b),
        step=lambda log, x: 0.02 * x,
        bounds=lambda log: (0.2 * log.fastest, 1000.0 * log.fastest),
        interest=lambda log, b: 0.9 * min(log.rated_acceleration, b),
        experiment="give {joint} steps of its velocity of {velocity:.2g} {unit}/s",
    ),
    Effect(
        "backlash",
        "u",
        starts=lambda log, b: (b + 0.001, b + 0.003, b + 0.008, b + 0.02, b + 0.06),
        step=lambda log, x: 1e-4 + 0.03 * x,
        bounds=lambda log: (0.0, 0.5),
        interest=lambda log, b: b + 0.002,
        experiment="reverse {joint} slowly, with turns more than 5 mrad or 5 mm apart",
    ),
    Effect(
        "coulomb_friction",
        "u/s",
        starts=lambda log, b: tuple(log.fastest * f for f in (0.01, 0.03, 0.1, 0.25)),
        step=lambda log, x: 0.002 * log.fastest + 0.01 * x,
        bounds=lambda log: (0.0, log.fastest),
        interest=lambda log, b: b + 0.02 * log.rated_velocity,
        experiment="move {joint} both ways, slowly and fast",
    ),
    Effect(
        "deadband",
        "u/s",
        starts=lambda log, b: _between_sizes(log),
        step=lambda log, x: 0.005 * log.fastest + 0.04 * x,
        bounds=lambda log: (0.0, log.fastest),
        interest=lambda log, b: b + 0.02 * log.rated_velocity,
        experiment="creep with {joint} at speeds from 0.5 to 10 % of {velocity:.2g} {unit}/s",
    ),
)
EFFECTS = {effect.name: effect for effect in CATALOGUE}
# Beside the catalogue a verdict names observation_delay, in one group with action_delay, and joint_offset (home.py).
NAMES = tuple(field.name for field in dataclasses.fields(JointResponse))


def members(effect: str) -> tuple[str, ...]:
    """Names of what a fit of this effect moves."""
    return ("action_delay", "observation_delay") if effect == "action_delay" else (effect,)
