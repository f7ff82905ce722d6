"""Catalogue of the drive effects that a diagnosis can name: their words, and how a fit moves each."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mjx_tt.diagnosis.description import Description
from mjx_tt.diagnosis.joint.log import JointLog
from mjx_tt.sim.actuators import JointDrive

SMALLEST_DELAY = 2e-3  # [s] below which neither a delay nor a lag is named


@dataclass(frozen=True, kw_only=True)
class Effect(Description):
    """One entry of the catalogue: a parameter of JointResponse; in its unit "u" stands for that of the joint's
    position.

    Effects with a threshold have no gradient while they are inactive: every effect starts from a grid. The reading is a
    log that would show the effect, with the fields {joint}, {velocity} (its rated one) and {unit}.
    """

    starts: Callable[[JointLog, float], tuple[float, ...]]  # (log, nominal value) -> where fits begin
    step: Callable[[JointLog, float], float]  # finite difference at a value
    bounds: Callable[[JointLog], tuple[float, float]]
    interest: Callable[[JointLog, float], float]  # (log, nominal value) -> smallest change worth knowing about
    smallest: float = 0.0  # change below which it is not named

    def unit_of(self, log: JointLog) -> str:
        """Unit of the effect at a joint."""
        return self.unit.replace("u", log.unit)

    def reading_of(self, log: JointLog) -> str:
        """Log that would show the effect at a joint."""
        return self.reading.format(joint=log.record.joint, velocity=log.rated_velocity, unit=log.unit)


def _raised(base: float) -> tuple[float, ...]:
    """Limits above the nominal one."""
    return () if math.isinf(base) else (1.1 * base, 1.5 * base)


def _between_sizes(log: JointLog) -> tuple[float, ...]:
    """Thresholds between the sizes of the commands."""
    if log.sizes.size < 2:
        return ()
    cuts = np.unique(np.quantile(log.sizes, np.geomspace(0.01, 0.8, 24)))
    return tuple(float(c) * (1.0 + 1e-9) for c in cuts)


EFFECTS: tuple[Effect, ...] = (
    Effect(
        name="action_delay",  # the sum of both delays, which alone shows in a log
        meaning="delay from command to motion",
        claim="acts {way:later|sooner} on a command than the model says, delay {instead}",
        unit="s",
        reading="reverse {joint} quickly and often",
        starts=lambda log, b: tuple(max(b + d, 0.0) for d in (-0.05, -0.02, 0.01, 0.03, 0.07, 0.12)),
        step=lambda log, x: 1e-3,
        bounds=lambda log: (0.0, 0.5),
        interest=lambda log, b: b + 0.005,
        smallest=SMALLEST_DELAY,
    ),
    Effect(
        name="lag",
        meaning="slow answer of the drive",
        claim="follows its commands with a time constant of {instead}",
        unit="s",
        reading="give {joint} steps of its velocity",
        starts=lambda log, b: (b + 0.006, b + 0.02, b + 0.06, b + 0.15),
        step=lambda log, x: 1e-3 + 0.02 * x,
        bounds=lambda log: (0.0, 0.6),
        interest=lambda log, b: b + 0.01,
        smallest=SMALLEST_DELAY,
    ),
    Effect(
        name="velocity_gain",
        meaning="wrong speed of the drive",
        claim="moves too {way:fast|slowly}, {value} of what it is told instead of {nominal}",
        unit="1",
        reading="sweep {joint} over long ways at two speeds",
        starts=lambda log, b: (0.85 * b, 1.1 * b),
        step=lambda log, x: 5e-3,
        bounds=lambda log: (0.1, 4.0),
        interest=lambda log, b: 0.98 * b,
    ),
    Effect(
        name="velocity_limit",
        meaning="a limit of the velocity",
        claim="gets no faster than {instead}",
        unit="u/s",
        reading="sweep {joint} up to {velocity:.2g} {unit}/s",
        starts=lambda log, b: tuple(log.fastest * f for f in (0.97, 0.9, 0.8, 0.65, 0.45, 0.25)) + _raised(b),
        step=lambda log, x: 0.01 * x,
        bounds=lambda log: (0.02 * log.fastest, 3.0 * log.fastest),
        interest=lambda log, b: 0.9 * min(log.rated_velocity, b),
    ),
    Effect(
        name="acceleration_limit",
        meaning="a limit of the acceleration",
        claim="gathers speed no faster than {instead}",
        unit="u/s^2",
        reading="give {joint} steps of its velocity of {velocity:.2g} {unit}/s",
        starts=lambda log, b: tuple(log.fastest / s for s in (1.5, 0.5, 0.2, 0.08, 0.03)) + _raised(b),
        step=lambda log, x: 0.02 * x,
        bounds=lambda log: (0.2 * log.fastest, 1000.0 * log.fastest),
        interest=lambda log, b: 0.9 * min(log.rated_acceleration, b),
    ),
    Effect(
        name="backlash",
        meaning="play of the gear",
        claim="has a play of {instead}",
        unit="u",
        reading="reverse {joint} slowly, with turns more than 5 mrad or 5 mm apart",
        starts=lambda log, b: (b + 0.001, b + 0.003, b + 0.008, b + 0.02, b + 0.06),
        step=lambda log, x: 1e-4 + 0.03 * x,
        bounds=lambda log: (0.0, 0.5),
        interest=lambda log, b: b + 0.002,
    ),
    Effect(
        name="coulomb_friction",
        meaning="dry friction",
        claim="loses {instead} of every commanded velocity to dry friction",
        unit="u/s",
        reading="move {joint} both ways, slowly and fast",
        starts=lambda log, b: tuple(log.fastest * f for f in (0.01, 0.03, 0.1, 0.25)),
        step=lambda log, x: 0.002 * log.fastest + 0.01 * x,
        bounds=lambda log: (0.0, log.fastest),
        interest=lambda log, b: b + 0.02 * log.rated_velocity,
    ),
    Effect(
        name="deadband",
        meaning="small commands without motion",
        claim="stands still for commands below {instead}",
        unit="u/s",
        reading="creep with {joint} at speeds from 0.5 to 10 % of {velocity:.2g} {unit}/s",
        starts=lambda log, b: _between_sizes(log),
        step=lambda log, x: 0.005 * log.fastest + 0.04 * x,
        bounds=lambda log: (0.0, log.fastest),
        interest=lambda log, b: b + 0.02 * log.rated_velocity,
    ),
)
BY_NAME = {effect.name: effect for effect in EFFECTS}
OBSERVATION_DELAY = Description(  # named in one group with action_delay
    name="observation_delay",
    meaning="delay of the joint's measurement",
    claim="is read {way:later|sooner} than the model says, delay {instead}",
    unit="s",
    reading="stamp a command's arrival at the drive and a state's departure with one clock",
)
JOINT_OFFSET = Description(  # found by encoder_home
    name="joint_offset",
    meaning="zero of the encoder",
    claim="reads {size} too {way:high|low}",
    unit="u",
    reading="hold {joint} still at its home position before it moves",
)
DESCRIPTIONS: dict[str, Description] = {e.name: e for e in (*EFFECTS, OBSERVATION_DELAY, JOINT_OFFSET)}
NAMES = tuple(field.name for field in dataclasses.fields(JointDrive) if field.name in DESCRIPTIONS)


def members(effect: str) -> tuple[str, ...]:
    """Names of the parameters that a fit of this effect moves."""
    return ("action_delay", "observation_delay") if effect == "action_delay" else (effect,)
