"""Response of a joint's position to its velocity commands, in closed form from one command to the next."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mjx_tt.robot import robots
from mjx_tt.robot.robots import Robot
from mjx_tt.robot.servo import servos
from mjx_tt.sim.model import SimModel

CLOSE = 1e-5
Motion = tuple[np.ndarray, np.ndarray]  # times [s] and positions [rad], [m]


@dataclass(frozen=True)
class JointResponse:
    """Response of one joint's position to velocity commands; defaults are the ideal joint.

    The command is held and delayed by ``action_delay``, zeroed where its size is below ``deadband``, shortened by
    ``coulomb_friction``, multiplied by ``velocity_gain`` and clipped to ``velocity_limit``; the drive's velocity
    follows it with the time constant ``lag`` and at most ``acceleration_limit``; the simulated servo follows that with
    the time constant ``servo`` and the gain ``servo_gain``; the position follows the integral with the play
    ``backlash`` (whole width), and is read ``observation_delay`` later, off by ``joint_offset``.
    """

    action_delay: float = 0.0  # [s]
    observation_delay: float = 0.0  # [s]
    lag: float = 0.0  # [s]
    velocity_gain: float = 1.0
    joint_offset: float = 0.0  # [rad], [m]
    velocity_limit: float = math.inf  # [rad/s], [m/s]
    acceleration_limit: float = math.inf  # [rad/s^2], [m/s^2]
    backlash: float = 0.0  # [rad], [m]
    coulomb_friction: float = 0.0  # [rad/s], [m/s]
    deadband: float = 0.0  # [rad/s], [m/s]
    servo: float = 0.0  # [s]
    servo_gain: float = 1.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if math.isnan(value) or (value < 0.0 and field.name not in ("joint_offset", "velocity_gain")):
                raise ValueError(f"JointResponse.{field.name} must not be negative or NaN, got {value}")
        for name in ("velocity_limit", "acceleration_limit"):
            if getattr(self, name) == 0.0:
                raise ValueError(f"JointResponse.{name} must be positive, got 0: the joint could not move")

    def simulate(
        self,
        command_time: Float[np.ndarray, " n"],
        command_velocity: Float[np.ndarray, " n"],
        query_time: Float[np.ndarray, " m"],
        start_position: float = 0.0,
        beside: Motion | None = None,
    ) -> Float[np.ndarray, " m"]:
        """Measured positions at ``query_time`` of a joint that rests until the first command.

        command_time: [s], increasing; each command holds until the next, the last one for ever.
        start_position: true position [rad], [m] at rest, in the middle of the play.
        beside: measured times and movements that the servo makes besides; not between the commands but straight lines.
        Exact: between two commands the response is a ramp and an exponential in closed form. Linear in n and m.
        """
        t = np.asarray(command_time, np.float64) + self.action_delay
        target = self._target(np.asarray(command_velocity, np.float64))
        query = np.asarray(query_time, np.float64) - self.observation_delay
        hold = np.diff(t)
        velocity = self._velocities(target, hold)
        knots = np.concatenate([[0.0], np.cumsum(self._moved(velocity[:-1], target[:-1], hold))])
        path = _Path(self._pieces(t, target, velocity, knots), self.lag, self.servo)

        def driven(time: np.ndarray) -> np.ndarray:
            alone = self.servo_gain * path.at(time)[0]
            return alone if beside is None else alone + np.interp(time + self.observation_delay, *beside)

        position = driven(query)
        if self.backlash > 0.0:
            position = self._play(path.turns(max(t[-1], query[-1]) + 1.0), driven, query, position)
        return start_position + self.joint_offset + position

    def _target(self, u: np.ndarray) -> np.ndarray:
        """Velocities that the joint is driven to."""
        u = np.where(np.abs(u) < self.deadband, 0.0, u)
        u = np.sign(u) * np.maximum(np.abs(u) - self.coulomb_friction, 0.0)
        return np.clip(self.velocity_gain * u, -self.velocity_limit, self.velocity_limit)

    def _velocities(self, target: np.ndarray, hold: np.ndarray) -> np.ndarray:
        """Velocity at each command, before it acts."""
        tau, limit = self.lag, self.acceleration_limit
        if tau == 0.0 and math.isinf(limit):
            return np.concatenate([[0.0], target[:-1]])
        v, velocities = 0.0, [0.0]
        append = velocities.append
        if math.isinf(limit):
            for w, decay in zip(target[:-1].tolist(), np.exp(-hold / tau).tolist(), strict=True):
                v = w + (v - w) * decay
                append(v)
        else:
            exp, linear = math.exp, limit * tau  # beyond ``linear`` from its target the velocity ramps
            for w, dt in zip(target[:-1].tolist(), hold.tolist(), strict=True):
                d = w - v
                away = abs(d)
                if away - linear >= limit * dt:
                    v += math.copysign(limit * dt, d)
                elif tau == 0.0:
                    v = w
                else:
                    ramp = max(0.0, (away - linear) / limit)
                    v = w - math.copysign(min(away, linear) * exp((ramp - dt) / tau), d)
                append(v)
        return np.array(velocities)

    def _moved(self, v: np.ndarray, w: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Movement in a time t from the velocity v with the target w; all (n,)."""
        tau, limit = self.lag, self.acceleration_limit
        d = w - v
        if math.isinf(limit):
            if tau == 0.0:
                return w * t
            return w * t + d * tau * np.expm1(-t / tau)
        away, sign = np.abs(d), np.sign(d)
        ramp = np.minimum(t, np.maximum(away / limit - tau, 0.0))
        left, rest = sign * np.maximum(away - limit * ramp, 0.0), t - ramp
        moved = v * ramp + 0.5 * sign * limit * ramp * ramp + w * rest
        if tau == 0.0:
            return moved
        return moved + left * tau * np.expm1(-rest / tau)

    def _pieces(self, t: np.ndarray, target: np.ndarray, velocity: np.ndarray, knots: np.ndarray) -> _Pieces:
        """The drive's way: one piece for each command, two where its acceleration is limited."""
        gap, limit, tau = target - velocity, self.acceleration_limit, self.lag
        if math.isinf(limit):
            return _Pieces(t, knots, target, np.zeros_like(t), gap * tau)
        sign = np.sign(gap)
        ramp = np.minimum(np.maximum(np.abs(gap) / limit - tau, 0.0), np.append(np.diff(t), np.inf))
        reached = knots + velocity * ramp + 0.5 * sign * limit * ramp**2
        left = sign * np.maximum(np.abs(gap) - limit * ramp, 0.0)
        zero = np.zeros_like(t)
        pairs = (t, t + ramp), (knots, reached), (velocity, target), (0.5 * sign * limit, zero), (zero, left * tau)
        return _Pieces(*(np.column_stack(pair).ravel() for pair in pairs))

    def _play(
        self, times: np.ndarray, motion: Callable[[np.ndarray], np.ndarray], query: np.ndarray, position: np.ndarray
    ) -> np.ndarray:
        """Positions after the play: between two turning points it is closed form, so only those are walked."""
        driven = motion(times)
        moves = np.flatnonzero(np.diff(driven) != 0.0)
        if moves.size == 0:
            return position
        rising = np.diff(driven)[moves] > 0.0
        first = np.concatenate([[True], rising[1:] != rising[:-1]])
        begin, up = moves[first], rising[first]
        half = 0.5 * self.backlash
        out, outputs = driven[0], []
        for turn, rises in zip(np.append(driven[begin[1:]], driven[-1]).tolist(), up.tolist(), strict=True):
            outputs.append(out)
            out = max(out, turn - half) if rises else min(out, turn + half)
        run = np.searchsorted(times[begin], query, side="right") - 1
        at = np.maximum(run, 0)
        held = np.array(outputs)[at]
        moved = np.where(up[at], np.maximum(held, position - half), np.minimum(held, position + half))
        return np.where(run >= 0, moved, 0.0)


class _Pieces(NamedTuple):
    """Pieces (p,) of a way: place + speed x + curve x^2 + decay (exp(-x / lag) - 1), x [s] from each one's begin."""

    begin: np.ndarray  # [s]
    place: np.ndarray
    speed: np.ndarray
    curve: np.ndarray
    decay: np.ndarray

    def of(self, index: np.ndarray) -> _Pieces:
        """The pieces with these indices."""
        return _Pieces(*(part[index] for part in self))


class _Path:
    """Position of a servo that follows a drive's way piece by piece, in closed form; at rest at 0 before the first.

    lag, servo: time constants [s] of the drive and of the servo.
    """

    def __init__(self, pieces: _Pieces, lag: float, servo: float) -> None:
        # Two equal time constants would make another form; so close to it they differ by nothing.
        lag = servo * (1.0 + CLOSE) if lag > 0.0 and abs(servo / lag - 1.0) < CLOSE else lag
        self._pieces, self._lag, self._servo = pieces, lag, servo
        if servo == 0.0:
            return
        every, length = np.arange(pieces.begin.size), np.diff(pieces.begin)
        first = self._steady(every, np.zeros_like(pieces.begin))
        jumps = self._steady(every[:-1], length) - first[1:]
        behind, away = -float(first[0]), [-float(first[0])]  # of the servo from its steady motion, at each begin
        for jump, fades in zip(jumps.tolist(), np.exp(-length / servo).tolist(), strict=True):
            behind = jump + behind * fades
            away.append(behind)
        self._away = np.array(away)

    def _drive(self, piece: np.ndarray, x: np.ndarray) -> np.ndarray:
        _, place, speed, curve, decay = self._pieces.of(piece)
        position = place + speed * x + curve * x * x
        return position if self._lag == 0.0 else position + decay * np.expm1(-x / self._lag)

    def _steady(self, piece: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Position of a servo that has followed a piece for ever."""
        _, place, speed, curve, decay = self._pieces.of(piece)
        tau = self._servo
        position = place + speed * (x - tau) + curve * (x * x - 2.0 * tau * x + 2.0 * tau * tau)
        if self._lag == 0.0:
            return position
        return position + decay * (np.exp(-x / self._lag) / (1.0 - tau / self._lag) - 1.0)

    def at(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions and velocities at times, all (m,); velocities only of a servo with a time constant."""
        last = np.searchsorted(self._pieces.begin, time, side="right") - 1
        piece = np.maximum(last, 0)
        x = np.maximum(time - self._pieces.begin[piece], 0.0)
        drive = position = self._drive(piece, x)
        if self._servo > 0.0:
            position = self._steady(piece, x) + self._away[piece] * np.exp(-x / self._servo)
        velocity = (drive - position) / max(self._servo, 1e-12)
        return np.where(last >= 0, position, 0.0), np.where(last >= 0, velocity, 0.0)

    def turns(self, end: float) -> np.ndarray:
        """Times (k,), up to ``end``, between which the position moves one way; the turning points among them."""
        begin = np.append(self._pieces.begin, end)
        if self._servo == self._lag == 0.0 and not self._pieces.curve.any():
            return begin
        times = np.append((begin[:-1, None] + np.diff(begin)[:, None] * (0.0, 0.5)).ravel(), end)
        velocity = self._velocity(times)
        at = np.flatnonzero(velocity[:-1] * velocity[1:] < 0.0)
        low, high, below, above = times[at], times[at + 1], velocity[at], velocity[at + 1]
        for _ in range(3):  # false position, which the curve's end that stays would hold up
            apart = below - above
            root = low + (high - low) * below / np.where(apart == 0.0, 1.0, apart)
            here = self._velocity(root)
            first = here * below > 0.0
            low, below, above = (
                np.where(first, root, low),
                np.where(first, here, below),
                np.where(first, above / 2, here),
            )
            high = np.where(first, high, root)
        return np.insert(times, at + 1, root)

    def _velocity(self, time: np.ndarray) -> np.ndarray:
        if self._servo > 0.0:
            return self.at(time)[1]
        piece = np.maximum(np.searchsorted(self._pieces.begin, time, side="right") - 1, 0)
        x = np.maximum(time - self._pieces.begin[piece], 0.0)
        _, _, speed, curve, decay = self._pieces.of(piece)
        velocity = speed + 2.0 * curve * x
        return velocity if self._lag == 0.0 else velocity - decay / self._lag * np.exp(-x / self._lag)


def nominal_response(model: SimModel, joint: str, robot: Robot | None = None) -> JointResponse:
    """Response of a joint in the model: its mean latencies, its drive where there is one, and its servo at home.

    robot: whose joint; None: the paper's.
    """
    robot = robots.paper() if robot is None else robot
    place = robot.contract.joints.index(joint)
    axis = "festo" if place in robot.contract.carrying else "abb"
    values = {
        "action_delay": float(getattr(model.latency, f"{axis}_action")),
        "observation_delay": float(getattr(model.latency, f"{axis}_observation")),
        "velocity_gain": float(model.actuation.velocity_gain),
    }
    if model.drives is not None:
        drive = getattr(model.drives, joint)
        for field in fields(drive):
            value = float(getattr(drive, field.name))
            if field.name.endswith("_delay"):
                values[field.name] += value
            elif field.name == "velocity_gain":
                values[field.name] *= value
            elif field.name != "resonance":  # which no encoder sees
                values[field.name] = value
    servo = servos(robot)[place]
    return JointResponse(**values, servo=servo.time_constant, servo_gain=servo.gain)
