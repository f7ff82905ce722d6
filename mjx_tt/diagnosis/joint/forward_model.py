"""Response of a joint's position to its velocity commands, in closed form from one command to the next."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float

from mjx_tt.sim.model import SimModel
from robot_io.contract import FESTO_JOINTS, JOINT_NAMES


@dataclass(frozen=True)
class JointResponse:
    """Response of one joint's position to velocity commands; defaults are the ideal joint.

    The command is held and delayed by ``action_delay``, zeroed where its size is below ``deadband``, shortened by
    ``coulomb_friction``, multiplied by ``velocity_gain`` and clipped to ``velocity_limit``; the velocity follows it
    with the time constant ``lag`` and at most ``acceleration_limit``; the position follows its integral with the play
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
    ) -> Float[np.ndarray, " m"]:
        """Measured positions at ``query_time`` of a joint that rests until the first command.

        command_time: [s], increasing; each command holds until the next, the last one for ever.
        start_position: true position [rad], [m] at rest, in the middle of the play.
        Exact: between two commands the response is a ramp and an exponential in closed form. Linear in n and m.
        """
        t = np.asarray(command_time, np.float64) + self.action_delay
        target = self._target(np.asarray(command_velocity, np.float64))
        query = np.asarray(query_time, np.float64) - self.observation_delay
        hold = np.diff(t)
        velocity = self._velocities(target, hold)
        knots = np.concatenate([[0.0], np.cumsum(self._moved(velocity[:-1], target[:-1], hold))])
        at = np.searchsorted(t, query, side="right") - 1
        i = np.maximum(at, 0)
        since = np.maximum(query - t[i], 0.0)
        position = np.where(at >= 0, knots[i] + self._moved(velocity[i], target[i], since), 0.0)
        if self.backlash > 0.0:
            position = self._play(t, target, velocity, knots, hold, query, position)
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

    def _play(
        self,
        t: np.ndarray,
        target: np.ndarray,
        velocity: np.ndarray,
        knots: np.ndarray,
        hold: np.ndarray,
        query: np.ndarray,
        position: np.ndarray,
    ) -> np.ndarray:
        """Positions after the play: between two turning points it is closed form, so only those are walked."""
        v, w, q = velocity[:-1], target[:-1], knots[:-1]
        turns = np.flatnonzero((v * w < 0.0) & (self.lag > 0.0 or math.isfinite(self.acceleration_limit)))
        after = self._crossing(v[turns], w[turns])
        inside = after < hold[turns]
        turns, after = turns[inside], after[inside]
        top = q[turns] + self._moved(v[turns], w[turns], after)
        end = max(t[-1], query[-1]) + 1.0
        last = knots[-1] + self._moved(velocity[-1:], target[-1:], np.array([end - t[-1]]))
        times, path = np.concatenate([t, [end]]), np.concatenate([knots, last])
        times, path = np.insert(times, turns + 1, t[turns] + after), np.insert(path, turns + 1, top)
        moves = np.flatnonzero(np.diff(path) != 0.0)
        if moves.size == 0:
            return position
        rising = np.diff(path)[moves] > 0.0
        first = np.concatenate([[True], rising[1:] != rising[:-1]])
        begin, up = moves[first], rising[first]
        half = 0.5 * self.backlash
        out, outputs = path[0], []
        for turn, rises in zip(np.append(path[begin[1:]], path[-1]).tolist(), up.tolist(), strict=True):
            outputs.append(out)
            out = max(out, turn - half) if rises else min(out, turn + half)
        run = np.searchsorted(times[begin], query, side="right") - 1
        at = np.maximum(run, 0)
        held = np.array(outputs)[at]
        moved = np.where(up[at], np.maximum(held, position - half), np.minimum(held, position + half))
        return np.where(run >= 0, moved, 0.0)

    def _crossing(self, v: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Time until a velocity v on its way to a target of the other sign is zero."""
        limit, linear = self.acceleration_limit, self.acceleration_limit * self.lag
        if self.lag == 0.0:
            return np.abs(v) / limit
        away = np.abs(w - v)
        if math.isinf(limit):
            return self.lag * np.log(away / np.abs(w))
        ramp = np.maximum((away - linear) / limit, 0.0)
        soft = ramp + self.lag * np.log(np.maximum(np.minimum(away, linear) / np.abs(w), 1.0))
        return np.where(np.abs(v) <= limit * ramp, np.abs(v) / limit, soft)


def nominal_response(model: SimModel, joint: str) -> JointResponse:
    """Response of a joint in the model: its mean latencies, and its drive where the model has one."""
    axis = "festo" if JOINT_NAMES.index(joint) in FESTO_JOINTS else "abb"
    values = {
        "action_delay": float(getattr(model.latency, f"{axis}_action")),
        "observation_delay": float(getattr(model.latency, f"{axis}_observation")),
        "velocity_gain": float(model.actuation.velocity_gain),
    }
    if model.drives is not None:
        drive = getattr(model.drives, joint)
        for field in fields(JointResponse):
            value = float(getattr(drive, field.name))
            if field.name.endswith("_delay"):
                values[field.name] += value
            elif field.name == "velocity_gain":
                values[field.name] *= value
            else:
                values[field.name] = value
    return JointResponse(**values)
