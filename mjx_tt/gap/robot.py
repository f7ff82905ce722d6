"""What a joint does with its velocity commands: which of ten drive effects the nominal model gets wrong, and how sure.

One joint at a time. A candidate model is the nominal response with up to MOST effects changed; its parameters are
fitted by Levenberg-Marquardt on a Huber loss of the positions, with a free offset in every window of WINDOW seconds,
so that neither the unknown start nor a slow drift of the integrated velocity speaks for an effect. Effects with a
threshold have no gradient while they are inactive: they start from a grid. An effect is named when dropping it costs
far more than the noise, as correlated as it is, could explain (EVIDENCE), and when it moves the joint by more than
FLOOR. What the catalogue leaves over is held against functions that carry no name (position, velocity, acceleration,
reversals, delayed commands, time); when one of them explains it, the answer is "unexplained", and names that it could
replace are dropped.

The constants were set on simulated logs of another simulator (tests/test_gap_robot.py), 60 s a joint.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter

from mjx_tt.gap.robot_data import JointRecord, merge_names
from robot_io.contract import JOINT_NAMES, JOINT_UNITS, LIMITS

WINDOW = 2.0  # [s] of a free offset and of one cluster of the errors, a tenth of a log of less than 20 s
SAMPLES = 4000  # states of a joint that a fit looks at, evenly spread over the log
MOST = 3  # effects of one joint at a time
EVIDENCE = 30.0  # least gain of the loss in units of the noise, for an effect or a further one
ONE_WINDOW = 12.0  # the same without the window that gains most: one glitch names nothing
RIVAL = 10.0  # two models whose losses differ by less cannot be told apart
FLOOR = 5e-4  # [rad], [m] rms movement below which nothing is named
UNIQUE = 3.5e-4  # [rad], [m] rms of it that no other effect takes over
SMALLEST_DELAY = 2e-3  # [s] below which neither a delay nor a lag is named
SMALLEST_NOISE = 5e-5  # [rad], [m]: no log is believed more exactly
HUBER = 2.5  # noise deviations beyond which a sample counts linearly
CORRELATED = 0.3  # [s] over which noise may remember itself
MOST_CONFIDENT = 0.99
INTERVAL = 1.645  # deviations of a 90 % interval


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
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if math.isnan(value) or (value < 0.0 and field.name not in ("joint_offset", "velocity_gain")):
                raise ValueError(f"JointResponse.{field.name} must not be negative or NaN, got {value}")
        for name in ("velocity_limit", "acceleration_limit"):
            if getattr(self, name) == 0.0:
                raise ValueError(f"JointResponse.{name} must be positive, got 0: the joint could not move")

    def simulate(self, command_time, command_velocity, query_time, start_position: float = 0.0) -> np.ndarray:
        """Measured positions (m,) at ``query_time`` (m,) of a joint that rests until the first command.

        command_time: (n,) [s], increasing; each command holds until the next, the last one for ever.
        start_position: true position [rad], [m] at rest, in the middle of the play.
        Exact: between two commands the response is a ramp and an exponential in closed form. Linear in n and m.
        """
        t = np.asarray(command_time, np.float64) + self.action_delay
        target = self._target(np.asarray(command_velocity, np.float64))
        query = np.asarray(query_time, np.float64) - self.observation_delay
        hold = np.diff(t)
        velocity = self._velocities(target, hold)
        moved, _ = self._advance(velocity[:-1], target[:-1], hold)
        knots = np.concatenate([[0.0], np.cumsum(moved)])
        at = np.searchsorted(t, query, side="right") - 1
        since = query - t[np.maximum(at, 0)]
        i = np.maximum(at, 0)
        position = np.where(at >= 0, knots[i] + self._advance(velocity[i], target[i], np.maximum(since, 0.0))[0], 0.0)
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
            for w, decay in zip(target[:-1].tolist(), np.exp(-hold / tau).tolist()):
                v = w + (v - w) * decay
                append(v)
        else:
            exp, linear = math.exp, limit * tau  # beyond ``linear`` from its target the velocity ramps
            for w, dt in zip(target[:-1].tolist(), hold.tolist()):
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

    def _advance(self, v: np.ndarray, w: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Movement and velocity a time t after the velocity was v with the target w; all (n,)."""
        tau, limit = self.lag, self.acceleration_limit
        d = w - v
        if math.isinf(limit):
            if tau == 0.0:
                return w * t, w
            gone = -np.expm1(-t / tau)
            return w * t - d * tau * gone, w - d * (1.0 - gone)
        away, sign = np.abs(d), np.sign(d)
        ramp = np.minimum(t, np.maximum(away / limit - tau, 0.0))
        left, rest = sign * np.maximum(away - limit * ramp, 0.0), t - ramp
        moved = v * ramp + 0.5 * sign * limit * ramp * ramp + w * rest
        if tau == 0.0:
            return moved, w - left
        gone = -np.expm1(-rest / tau)
        return moved - left * tau * gone, w - left * (1.0 - gone)

    def _play(self, t, target, velocity, knots, hold, query, position) -> np.ndarray:
        """Positions after the play: between two turning points it is closed form, so only those are walked."""
        v, w, q = velocity[:-1], target[:-1], knots[:-1]
        turns = np.flatnonzero((v * w < 0.0) & (self.lag > 0.0 or math.isfinite(self.acceleration_limit)))
        after = self._crossing(v[turns], w[turns])
        inside = after < hold[turns]
        turns, after = turns[inside], after[inside]
        top = q[turns] + self._advance(v[turns], w[turns], after)[0]
        end = max(t[-1], query[-1]) + 1.0
        last = knots[-1] + self._advance(velocity[-1:], target[-1:], np.array([end - t[-1]]))[0]
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
        for turn, rises in zip(np.append(path[begin[1:]], path[-1]).tolist(), up.tolist()):
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


@dataclass(frozen=True)
class RobotCause:
    """One named effect of one joint."""

    name: str  # "joint_2.lag"
    group: tuple[str, ...]  # names that this log cannot tell from it, itself among them
    confidence: float  # that the cause is in the group
    parameters: dict[str, tuple[float, float, float, float, str]]  # nominal, estimate, low, high (90 %), unit
    effect: float  # rms movement that it explains [mrad], a gantry axis [mm]
    separating_measurement: str  # what would tell the members of the group apart; empty for a group of one


@dataclass(frozen=True)
class Undecided:
    """An effect that this log says nothing about."""

    name: str
    why: str


@dataclass(frozen=True)
class RobotGain:
    """Prediction error of positions on windows that the fit did not see; [rad], a gantry axis [m]."""

    joint: str
    before: float  # rms, nominal model
    after: float  # rms, with the named causes
    low: float  # 90 % bootstrap interval over windows of before - after
    high: float


@dataclass(frozen=True)
class JointResidual:
    """What was measured and predicted, (m,) each, [s] and [rad] or [m]; predictions have each window's offset."""

    joint: str
    time: np.ndarray
    measured: np.ndarray
    nominal: np.ndarray
    extended: np.ndarray


@dataclass(frozen=True)
class RobotFindings:
    """What the logs say about the joints' responses."""

    causes: tuple[RobotCause, ...]
    not_excited: tuple[Undecided, ...]
    not_identifiable: tuple[Undecided, ...]
    unexplained_by_joint: tuple[dict, ...]  # joint, block, where, direction, size [mrad], [mm]; largest first
    held_out: tuple[RobotGain, ...]
    next_experiment: tuple[str, ...]
    residuals: tuple[JointResidual, ...]
    responses: dict[str, JointResponse]  # nominal, extended by the named causes

    @property
    def unexplained(self) -> dict | None:
        """The largest residual that no effect of the catalogue explains."""
        return self.unexplained_by_joint[0] if self.unexplained_by_joint else None


def _log_limits(joint: _Joint, base: float) -> tuple[float, ...]:
    return tuple(joint.fastest * f for f in (0.97, 0.9, 0.8, 0.65, 0.45, 0.25)) + _raised(base)


def _raised(base: float) -> tuple[float, ...]:
    return () if math.isinf(base) else (1.1 * base, 1.5 * base)


def _quantiles(joint: _Joint) -> tuple[float, ...]:
    """Thresholds between the sizes of the commands."""
    sizes = joint.sizes
    if sizes.size < 2:
        return ()
    cuts = np.unique(np.quantile(sizes, np.geomspace(0.01, 0.8, 24)))
    return tuple(float(c) * (1.0 + 1e-9) for c in cuts)


@dataclass(frozen=True)
class _Effect:
    """One entry of the catalogue: a parameter of JointResponse, how a fit moves it and what would show it."""

    name: str
    unit: str  # per position unit "u"
    starts: Callable[[_Joint, float], tuple[float, ...]]  # (joint, nominal value) -> where fits begin
    step: Callable[[_Joint, float], float]  # finite difference at a value
    bounds: Callable[[_Joint], tuple[float, float]]
    interest: Callable[[_Joint, float], float]  # smallest value worth knowing about
    experiment: str  # a log that would show it
    smallest: float = 0.0  # change below which it is not named


# The two delays are one effect: a fit changes their sum, and says so.
CATALOGUE: tuple[_Effect, ...] = (
    _Effect(
        "action_delay", "s", lambda j, b: tuple(max(b + d, 0.0) for d in (-0.05, -0.02, 0.01, 0.03, 0.07, 0.12)),
        lambda j, x: 1e-3, lambda j: (0.0, 0.5), lambda j, b: b + 0.005, "reverse {joint} quickly and often",
        SMALLEST_DELAY,
    ),
    _Effect(
        "lag", "s", lambda j, b: (b + 0.006, b + 0.02, b + 0.06, b + 0.15),
        lambda j, x: 1e-3 + 0.02 * x, lambda j: (0.0, 0.6), lambda j, b: b + 0.01,
        "give {joint} steps of its velocity", SMALLEST_DELAY,
    ),
    _Effect(
        "velocity_gain", "1", lambda j, b: (0.85 * b, 1.1 * b), lambda j, x: 5e-3, lambda j: (0.1, 4.0),
        lambda j, b: 0.98 * b, "sweep {joint} over long ways at two speeds",
    ),
    _Effect(
        "velocity_limit", "u/s", _log_limits, lambda j, x: 0.01 * x, lambda j: (0.02 * j.fastest, 3.0 * j.fastest),
        lambda j, b: 0.9 * min(j.rated_velocity, b), "sweep {joint} up to {velocity:.2g} {unit}/s",
    ),
    _Effect(
        "acceleration_limit", "u/s^2",
        lambda j, b: tuple(j.fastest / s for s in (1.5, 0.5, 0.2, 0.08, 0.03)) + _raised(b),
        lambda j, x: 0.02 * x, lambda j: (0.2 * j.fastest, 1000.0 * j.fastest),
        lambda j, b: 0.9 * min(j.rated_acceleration, b),
        "give {joint} steps of its velocity of {velocity:.2g} {unit}/s",
    ),
    _Effect(
        "backlash", "u", lambda j, b: (b + 0.001, b + 0.003, b + 0.008, b + 0.02, b + 0.06),
        lambda j, x: 1e-4 + 0.03 * x, lambda j: (0.0, 0.5), lambda j, b: b + 0.002,
        "reverse {joint} slowly, with turns more than 5 mrad or 5 mm apart",
    ),
    _Effect(
        "coulomb_friction", "u/s", lambda j, b: tuple(j.fastest * f for f in (0.01, 0.03, 0.1, 0.25)),
        lambda j, x: 0.002 * j.fastest + 0.01 * x, lambda j: (0.0, j.fastest),
        lambda j, b: b + 0.02 * j.rated_velocity, "move {joint} both ways, slowly and fast",
    ),
    _Effect(
        "deadband", "u/s", lambda j, b: _quantiles(j), lambda j, x: 0.005 * j.fastest + 0.04 * x,
        lambda j: (0.0, j.fastest), lambda j, b: b + 0.02 * j.rated_velocity,
        "creep with {joint} at speeds from 0.5 to 10 % of {velocity:.2g} {unit}/s",
    ),
)  # fmt: skip
EFFECTS = {effect.name: effect for effect in CATALOGUE}
NAMES = (*(field.name for field in dataclasses.fields(JointResponse)),)


@dataclass(frozen=True)
class _Fit:
    """Fitted effects; ``values`` holds the parameter of each, the sum of both delays under action_delay."""

    values: dict[str, float]
    residual: np.ndarray  # (n,) measured - predicted, without each window's offset

    @property
    def names(self) -> frozenset[str]:
        return frozenset(self.values)


class _Joint:
    """One joint's log and nominal response, and the fits to it."""

    def __init__(self, record: JointRecord, nominal: JointResponse):
        self.record, self.nominal = record, nominal
        self.base = {e.name: getattr(nominal, e.name) for e in CATALOGUE}
        self.base["action_delay"] += nominal.observation_delay
        u = record.command_velocity
        keep = np.concatenate([[True], u[1:] != u[:-1]])  # a repeated command changes nothing
        self.command_time, self.command_velocity = record.command_time[keep], u[keep]
        sizes = np.abs(u)
        self.sizes = sizes[sizes > 0.0]
        self.fastest = float(sizes.max())
        known = record.joint in JOINT_NAMES
        i = JOINT_NAMES.index(record.joint) if known else 0
        self.unit = JOINT_UNITS[i] if known else "rad"
        self.rated_velocity = LIMITS.velocity[i] if known else max(self.fastest, 1e-3)
        self.rated_acceleration = LIMITS.acceleration[i] if known else 10.0 * self.rated_velocity
        use = np.flatnonzero(record.state_time >= record.command_time[0])
        self.all = use
        if use.size > SAMPLES:
            use = use[np.round(np.linspace(0, use.size - 1, SAMPLES)).astype(int)]
        self.time, self.measured = record.state_time[use], record.state_position[use]
        self.width = min(max((self.time[-1] - self.time[0]) / 10.0, 0.3), WINDOW)
        self.starts, self.window = self._windows(self.time)
        self.cache: dict[frozenset[str], _Fit] = {}

    def _windows(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First samples of the windows (k,) and each sample's window (n,)."""
        window = np.floor((time - time[0]) / self.width).astype(int)
        starts = np.flatnonzero(np.concatenate([[True], window[1:] != window[:-1]]))
        return starts, np.repeat(np.arange(starts.size), np.diff(np.append(starts, time.size)))

    def response(self, values: Mapping[str, float]) -> JointResponse:
        """The nominal response with the sum of the delays as action_delay and some parameters replaced."""
        return dataclasses.replace(self.nominal, **{**self.base, **values}, observation_delay=0.0, joint_offset=0.0)

    def simulate(self, values: Mapping[str, float], time: np.ndarray | None = None) -> np.ndarray:
        time = self.time if time is None else time
        return self.response(values).simulate(self.command_time, self.command_velocity, time)

    def centred(self, x: np.ndarray, weight: np.ndarray | None = None) -> np.ndarray:
        """x (n, ...) less its mean in each window."""
        if weight is None:
            count = np.diff(np.append(self.starts, self.time.size))
            mean = (np.add.reduceat(x, self.starts, axis=0).T / count).T
        else:
            total = np.add.reduceat((x.T * weight).T, self.starts, axis=0)
            mean = (total.T / np.add.reduceat(weight, self.starts)).T
        return x - mean[self.window]

    def residual(self, values: Mapping[str, float], sigma: float) -> np.ndarray:
        r = self.centred(self.measured - self.simulate(values))
        for _ in range(2):
            r = self.centred(r, _weights(r, sigma))
        return r

    def jacobian(self, values: Mapping[str, float]) -> np.ndarray:
        """Derivatives (n, p) of the prediction by the fitted parameters."""
        here = self.simulate(values)
        columns = []
        for name, value in values.items():
            effect = EFFECTS[name]
            step = effect.step(self, value)
            if value + step > effect.bounds(self)[1]:
                step = -step
            columns.append((self.simulate({**values, name: value + step}) - here) / step)
        return np.array(columns).T.reshape(self.time.size, len(columns))

    def fit(self, start: Mapping[str, float], sigma: float, bounds: Mapping | None = None, mask=None) -> _Fit:
        """Levenberg-Marquardt from ``start``; mask (n,) of the samples that count, all without it."""
        values, names = dict(start), list(start)
        if not names:
            return _Fit({}, self.residual({}, sigma))
        if "deadband" in values:
            values = self._place(values, sigma)
        limits = np.array([(bounds or {}).get(n, EFFECTS[n].bounds(self)) for n in names])
        mask = 1.0 if mask is None else mask
        r = self.residual(values, sigma)
        loss, damping = np.sum(mask * _loss(r, sigma)), 1e-3
        for _ in range(12):
            weight = mask * _weights(r, sigma)
            slopes = self.centred(self.jacobian(values), _weights(r, sigma))
            normal = slopes.T @ (slopes * weight[:, None]) / sigma**2
            right = slopes.T @ (weight * r) / sigma**2
            x, scale = np.array([values[n] for n in names]), np.diag(normal) + 1e-12
            for _ in range(4):
                change = np.linalg.solve(normal + np.diag(damping * scale), right)
                moved = np.clip(x + change, limits[:, 0], limits[:, 1])
                trial = dict(zip(names, moved.tolist()))
                r_trial = self.residual(trial, sigma)
                trial_loss = np.sum(mask * _loss(r_trial, sigma))
                if trial_loss < loss:
                    break
                damping *= 10.0
            else:
                break
            gain, values, r, loss, damping = loss - trial_loss, trial, r_trial, trial_loss, damping * 0.1
            if gain < max(0.5, 1e-4 * loss):
                break
        return _Fit(values, r)

    def _place(self, values: dict[str, float], sigma: float) -> dict[str, float]:
        """The best deadband near the given one: the loss is a staircase in it, so that slopes lead nowhere."""
        best = float(np.sum(_loss(self.residual(values, sigma), sigma)))
        for width in (0.12, 0.04, 0.013, 0.004, 0.0013):
            for factor in (1.0 - 2.0 * width, 1.0 - width, 1.0 + width, 1.0 + 2.0 * width):
                trial = {**values, "deadband": min(values["deadband"] * factor, self.fastest)}
                loss = float(np.sum(_loss(self.residual(trial, sigma), sigma)))
                if loss < best:
                    best, values = loss, trial
        return values

    def extend(self, fit: _Fit, slopes: np.ndarray, name: str, sigma: float) -> tuple[float, dict[str, float]]:
        """Linear guess of the gain from a further effect, and where its fit begins."""
        weight = _weights(fit.residual, sigma)
        best, begin = -math.inf, {}
        here = self.simulate(fit.values)
        for value in EFFECTS[name].starts(self, self.base[name]):
            if value == self.base[name]:
                continue
            column = self.simulate({**fit.values, name: value}) - here
            columns = self.centred(np.column_stack([slopes, column]), weight)
            normal = columns.T @ (columns * weight[:, None])
            right = columns.T @ (weight * fit.residual)
            if normal[-1, -1] / self.time.size < 1e-16:
                continue
            if name == "deadband":  # a command is lost or not: half of the change means nothing
                beside = np.linalg.lstsq(normal[:-1, :-1], right[:-1] - normal[:-1, -1], rcond=1e-10)[0]
                solution = np.append(beside, 1.0)
                gain = 2.0 * right @ solution - solution @ normal @ solution
            else:
                solution = np.linalg.lstsq(normal, right, rcond=1e-10)[0]
                gain = right @ solution * (1.0 if 0.2 < solution[-1] < 5.0 else 0.7 if solution[-1] > 0.0 else 0.1)
            if gain > best:
                shifted = {n: v + s for (n, v), s in zip(fit.values.items(), solution)}
                best, begin = gain, {**{n: _clip(v, EFFECTS[n].bounds(self)) for n, v in shifted.items()}, name: value}
        return best / sigma**2, begin

    def add(self, fit: _Fit, name: str, sigma: float, slopes: np.ndarray | None = None) -> _Fit | None:
        """The fit with one effect more, None where the log does not show that effect; remembered."""
        names = fit.names | {name}
        slopes = self.jacobian(fit.values) if slopes is None else slopes
        gain, begin = self.extend(fit, slopes, name, sigma)
        if not begin:
            return self.cache.get(names)
        new = self.fit(begin, sigma)
        old = self.cache.get(names)
        if old is None or np.sum(_loss(new.residual, sigma)) < np.sum(_loss(old.residual, sigma)):
            self.cache[names] = new
        return self.cache[names]


def _clip(value: float, bounds: tuple[float, float]) -> float:
    return min(max(value, bounds[0]), bounds[1])


def _weights(r: np.ndarray, sigma: float) -> np.ndarray:
    return np.minimum(1.0, HUBER * sigma / np.maximum(np.abs(r), 1e-300))


def _loss(r: np.ndarray, sigma: float) -> np.ndarray:
    """Huber's loss of each sample in squared noise deviations."""
    x = np.abs(r) / sigma
    return np.where(x <= HUBER, x * x, HUBER * (2.0 * x - HUBER))


def _scale(r: np.ndarray) -> float:
    return max(1.4826 * float(np.median(np.abs(r))), SMALLEST_NOISE)


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x * x)))


class _Judge:
    """Noise of a joint's residual, and whether one fit is better than another by more than it."""

    def __init__(self, joint: _Joint, residual: np.ndarray):
        self.joint, self.sigma = joint, _scale(residual)
        # A smooth effect sums the noise over neighbouring samples: its variance grows by the noise's memory.
        e = residual * _weights(residual, self.sigma)
        spacing = (joint.time[-1] - joint.time[0]) / max(joint.time.size - 1, 1)
        most = min(max(int(CORRELATED / spacing), 1), e.size // 4)
        lags = np.arange(1, most + 1)
        power = e @ e + 1e-300
        memory = np.array([e[k:] @ e[:-k] for k in lags]) / power
        self.inflation = max(1.0, 1.0 + 2.0 * float(np.sum((1.0 - lags / (most + 1)) * memory)))
        self.inflation *= max(1.0, power / e.size / self.sigma**2)

    def gain(self, worse: np.ndarray, better: np.ndarray) -> tuple[float, float]:
        """Gain of the loss over the noise, in all and without the window that gains most."""
        difference = _loss(worse, self.sigma) - _loss(better, self.sigma)
        windows = np.add.reduceat(difference, self.joint.starts) / self.inflation
        return float(windows.sum()), float(windows.sum() - windows.max())

    def convincing(self, worse: np.ndarray, better: np.ndarray) -> bool:
        total, rest = self.gain(worse, better)
        return total > EVIDENCE and rest > ONE_WINDOW and _rms(worse - better) > UNIQUE


@dataclass(frozen=True)
class _Block:
    """Functions without a name, (n, m), that a residual is held against."""

    name: str
    columns: np.ndarray
    where: Callable[[np.ndarray], tuple[str, str]]  # coefficients (m,) -> where and in which direction it is largest
    tried: int = 1  # how many such blocks this one was chosen from


def _hats(x: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Piecewise linear functions (n, count) that sum to one, and their peaks."""
    low, high = np.quantile(x, (0.01, 0.99))
    peaks = np.linspace(low, high, count) if high - low > 1e-9 else np.array([low])
    if peaks.size == 1:
        return np.ones((x.size, 1)), peaks
    width = peaks[1] - peaks[0]
    return np.maximum(0.0, 1.0 - np.abs(np.clip(x, low, high)[:, None] - peaks) / width), peaks


def _blocks(joint: _Joint, fit: _Fit, residual: np.ndarray) -> list[_Block]:
    grid = np.arange(joint.time[0] - 0.5, joint.time[-1] + 0.5, 0.005)
    path = joint.simulate(fit.values, grid)
    velocity = np.gradient(path, 0.005)
    smooth = np.convolve(velocity, np.full(5, 0.2), "same")
    acceleration = np.gradient(smooth, 0.005)

    def on(values: np.ndarray, delay: float = 0.0) -> np.ndarray:
        return np.interp(joint.time - delay, grid, values)

    def integrated(columns: np.ndarray) -> np.ndarray:
        sums = np.cumsum(columns, axis=0) * 0.005
        return np.column_stack([on(column) for column in sums.T])

    unit = joint.unit
    seconds = joint.time - joint.time[0]

    def curve(peaks, what, of):
        def where(coefficients):
            shape = coefficients - coefficients.mean() if coefficients.size > 1 else coefficients
            i = int(np.argmax(np.abs(shape)))
            return f"{what} near {peaks[i]:.3g} {of}", "+" if shape[i] > 0 else "-"

        return where

    moving = np.abs(velocity) > 0.01 * max(joint.fastest, 1e-9)
    direction = np.sign(velocity) * moving
    held = direction[np.maximum.accumulate(np.where(moving, np.arange(grid.size), 0))]
    turned = np.concatenate([[True], held[1:] != held[:-1]])
    since = grid - grid[np.maximum.accumulate(np.where(turned, np.arange(grid.size), 0))]
    decays = np.array([0.03, 0.1, 0.3, 1.0, math.inf])
    reversal = np.column_stack([on(held * np.exp(-since / s)) for s in decays])
    delays = np.concatenate([np.arange(0.0, 0.1, 0.02), np.arange(0.1, 0.45, 0.04)])
    blocks = [_Block("drift", seconds[:, None], lambda c: ("velocity at all times", "+" if c[0] > 0 else "-"))]
    stages, peaks = _hats(grid - grid[0], 7)
    when = curve(peaks, "time in the log", "s")
    blocks.append(_Block("gain over time", integrated(stages * velocity[:, None]), when))
    blocks.append(_Block("delay over time", _hats(seconds, 7)[0] * on(velocity)[:, None], when))
    for name, values, what, of in (
        ("velocity", velocity, "velocity", f"{unit}/s"),
        ("acceleration", acceleration, "acceleration", f"{unit}/s^2"),
    ):
        columns, peaks = _hats(on(values), 9)
        blocks.append(_Block(name, columns, curve(peaks, what, of)))
        columns, peaks = _hats(values, 9)
        blocks.append(_Block(f"drive against {name}", integrated(columns), curve(peaks, what, of)))
    position = joint.measured - residual  # with the noise in it, it would explain the noise
    columns, peaks = _hats(position, 11)
    blocks.append(_Block("position", columns, curve(peaks, "position", unit)))
    columns, peaks = _hats(np.interp(grid, joint.time, position), 9)
    blocks.append(_Block("drive against position", integrated(columns), curve(peaks, "position", unit)))
    blocks.append(_Block("reversal", reversal, curve(decays, "decay after a reversal", "s")))
    lagged = np.column_stack([*(on(velocity, d) for d in delays), on(path)])
    blocks.append(_Block("dynamics", lagged, curve(np.append(delays, math.inf), "response to the command after", "s")))
    for name, x, frequencies, of in (
        ("ripple in position", position, np.geomspace(1.0, 300.0, 240), f"1/{unit}"),
        ("vibration", seconds, 2.0 * np.pi * np.geomspace(0.7, 45.0, 240), "rad/s"),
    ):
        phase = x[:, None] * frequencies
        weight = _weights(residual, _scale(residual)) * residual
        power = (weight @ np.cos(phase)) ** 2 + (weight @ np.sin(phase)) ** 2
        best = frequencies[int(np.argmax(power))]
        columns = np.column_stack([np.cos(best * x), np.sin(best * x)])
        blocks.append(_Block(name, columns, lambda c, best=best, of=of: (f"wave number {best:.3g} {of}", "both"), 240))
    return blocks


@dataclass(frozen=True)
class _Leftover:
    block: _Block
    score: float
    size: float  # [rad], [m] rms that the block predicts on windows it was not fitted to
    coefficients: np.ndarray


def _leftover(joint: _Joint, fit: _Fit, sigma: float) -> _Leftover | None:
    """The block that explains most of a fit's residual, None where none explains anything worth a word."""
    r = fit.residual
    weight = _weights(r, sigma)
    root = np.sqrt(weight)
    blocks = _blocks(joint, fit, r)
    known = joint.centred(joint.jacobian(fit.values), weight) * root[:, None]
    known /= np.linalg.norm(known, axis=0) + 1e-12
    prepared = []
    for block in blocks:
        columns = joint.centred(block.columns, weight) * root[:, None]
        columns = columns - known @ np.linalg.lstsq(known, columns, rcond=1e-8)[0]
        size = np.linalg.norm(columns, axis=0)
        prepared.append(columns / np.maximum(size, 1e-12 + 1e-6 * size.max(initial=0.0)))
    y = root * r
    together = np.concatenate(prepared, axis=1)
    judge = _Judge(joint, y - together @ _ridge(together, y))
    even = joint.window % 2 == 0
    best = None
    for block, columns in zip(blocks, prepared):
        explained = y @ (columns @ _ridge(columns, y)) / judge.sigma**2 / judge.inflation
        count = columns.shape[1]
        score = explained - count - 6.0 * math.sqrt(2.0 * count) - 20.0 - 2.0 * math.log(block.tried)
        predicted = np.where(
            even, columns @ _ridge(columns[~even], y[~even]), columns @ _ridge(columns[even], y[even])
        )
        size = math.sqrt(max(np.mean(y * y) - np.mean((y - predicted) ** 2), 0.0))
        if score > 0.0 and size > FLOOR and (best is None or score > best.score):
            best = _Leftover(block, score, size, _ridge(columns, y))
    return best or _moments(joint, r)


def _moments(joint: _Joint, r: np.ndarray) -> _Leftover | None:
    """Windows in which the joint was somewhere else for a while, which no function of its motion explains."""
    smooth = median_filter(r, 9)
    counts = np.diff(np.append(joint.starts, r.size))
    slow, quick = (np.add.reduceat(x * x, joint.starts) / counts for x in (smooth, r - smooth))
    usual = float(np.median(slow)) + SMALLEST_NOISE**2
    odd = (slow > 25.0 * usual) & (slow > 4.0 * quick)
    size = math.sqrt(float(np.sum(np.where(odd, slow, 0.0) * counts)) / r.size)
    if size < FLOOR:
        return None
    worst = int(np.argmax(np.where(odd, slow, 0.0)))
    columns = joint.centred(smooth * odd[joint.window])[:, None]
    begin = joint.time[joint.starts[worst]] - joint.time[0]
    where = f"{int(odd.sum())} of {odd.size} windows of {joint.width:.2g} s, most at {begin:.1f} s in the log"
    block = _Block("moments", columns, lambda c: (where, "both"))
    return _Leftover(block, 0.0, size, np.ones(1))


def _ridge(columns: np.ndarray, y: np.ndarray) -> np.ndarray:
    normal = columns.T @ columns
    little = 1e-7 * np.trace(normal) / len(normal) + 1e-12
    return np.linalg.solve(normal + little * np.eye(len(normal)), columns.T @ y)


@dataclass(frozen=True)
class _Verdict:
    """What one joint's log says."""

    fit: _Fit  # named and unnamed effects
    named: dict[str, tuple[tuple[str, ...], float]]  # effect -> rivals and confidence
    effects: dict[str, float]  # rms movement of each named effect
    leftover: _Leftover | None
    judge: _Judge


def _search(joint: _Joint, allowed: Sequence[str]) -> tuple[_Fit, _Fit, _Judge]:
    """The smallest set of effects that no larger one beats, what it is measured against, and the noise."""
    nominal = joint.fit({}, _scale(joint.centred(joint.measured - joint.simulate({}))))
    sigma = _scale(nominal.residual)
    # A delay too small to be named must not be named as something else.
    around = joint.base["action_delay"]
    tiny = {"action_delay": (max(around - SMALLEST_DELAY, 0.0), around + SMALLEST_DELAY)}
    still = joint.fit({"action_delay": around}, sigma, tiny) if joint.fastest > 0.0 else nominal
    judge = _Judge(joint, still.residual)
    if joint.fastest == 0.0:
        return nominal, still, judge
    levels: list[list[_Fit]] = [[nominal]]
    for size in range(1, MOST + 1):
        made: dict[frozenset[str], _Fit] = {}
        for parent in levels[-1][: (1, 3, 2)[size - 1]]:
            slopes = joint.jacobian(parent.values)
            choices = [n for n in allowed if n not in parent.values and parent.names | {n} not in made]
            guesses = {n: joint.extend(parent, slopes, n, sigma)[0] for n in choices}
            choices.sort(key=lambda n: -guesses[n])
            for name in choices if size == 1 else choices[:3]:
                new = joint.add(parent, name, sigma, slopes)
                if new is not None:
                    made[new.names] = new
        if not made:
            break
        ranked = sorted(made.values(), key=lambda f: np.sum(_loss(f.residual, sigma)))
        sigma = _scale(ranked[0].residual)
        ranked = [joint.fit(f.values, sigma) for f in ranked[:4]] + ranked[4:]
        ranked.sort(key=lambda f: np.sum(_loss(f.residual, sigma)))
        for f in ranked:
            joint.cache[f.names] = f
        levels.append(ranked)
        judge = _Judge(joint, ranked[0].residual)
        before = still if size == 1 else levels[-2][0]
        if not judge.convincing(before.residual, ranked[0].residual):
            break
        if size > 1 and _leftover(joint, ranked[0], sigma) is None:
            break
    best = levels[0][0]
    for level in levels[1:]:
        against = still if not best.values else best
        if not judge.convincing(against.residual, level[0].residual):
            break
        best = level[0]
    return best, still, judge


def _examine(joint: _Joint, allowed: Sequence[str]) -> _Verdict:
    best, still, judge = _search(joint, allowed)
    sigma = judge.sigma
    named: dict[str, tuple[tuple[str, ...], float]] = {}
    effects: dict[str, float] = {}
    for name in sorted(best.values):
        if abs(best.values[name] - joint.base[name]) < EFFECTS[name].smallest:
            continue
        without = {n: v for n, v in best.values.items() if n != name}
        moved = joint.centred(joint.simulate(best.values) - joint.simulate(without))
        dropped = joint.cache.get(frozenset(without)) if without else still
        dropped = joint.fit(without, sigma) if dropped is None else dropped
        if _rms(moved) < FLOOR or not judge.convincing(dropped.residual, best.residual):
            continue
        needed = judge.gain(dropped.residual, best.residual)[0] - math.log(joint.time.size)
        rivals, doubt = [], math.exp(-0.5 * needed)
        others = _Fit(without, dropped.residual) if without else joint.fit({}, sigma)
        slopes = joint.jacobian(others.values)
        for rival in (n for n in allowed if n not in best.values):
            twin = joint.cache.get(others.names | {rival}) or joint.add(others, rival, sigma, slopes)
            if twin is None:
                continue
            behind = judge.gain(twin.residual, best.residual)[0]
            if behind < RIVAL:
                rivals.append(rival)
            else:
                doubt += math.exp(-0.5 * behind)
        named[name] = (tuple(rivals), min(1.0 / (1.0 + doubt), MOST_CONFIDENT))
        effects[name] = _rms(moved)
    rest = best if best.values else _Fit({}, still.residual)
    leftover = _leftover(joint, rest, sigma) if joint.fastest > 0.0 else None
    if leftover is not None:
        for name in list(named):
            if not _survives(joint, best, name, leftover, judge):
                del named[name], effects[name]
            else:
                share = effects[name] / (effects[name] + 2.0 * leftover.size)
                named[name] = (named[name][0], named[name][1] * share)
    return _Verdict(best, named, effects, leftover, judge)


def _survives(joint: _Joint, fit: _Fit, name: str, leftover: _Leftover, judge: _Judge) -> bool:
    """Whether an effect is needed beside an anonymous block that could stand in for it, and matters more than it."""
    weight = _weights(fit.residual, judge.sigma)
    root = np.sqrt(weight)[:, None]
    without = {n: v for n, v in fit.values.items() if n != name}
    moved = joint.simulate(fit.values) - joint.simulate(without)
    slopes = joint.jacobian(without)
    moved, slopes, anonymous = (
        joint.centred(x, weight) * root for x in (moved[:, None], slopes, leftover.block.columns)
    )

    def beside(columns):
        columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-12)
        return moved - columns @ np.linalg.lstsq(columns, moved, rcond=1e-8)[0]

    alone = _rms(beside(slopes)) if slopes.size else _rms(moved)
    left = beside(np.concatenate([slopes, anonymous], axis=1))
    evidence = float(np.sum(left * left)) / judge.sigma**2 / judge.inflation
    return evidence > EVIDENCE and _rms(left) > max(UNIQUE, 0.3 * alone, leftover.size)


def _intervals(joint: _Joint, fit: _Fit, judge: _Judge) -> dict[str, tuple[float, float]]:
    """90 % intervals of the fitted parameters from window-clustered errors, or from the noise where it says more."""
    names = list(fit.values)
    weight = _weights(fit.residual, judge.sigma)
    slopes = joint.centred(joint.jacobian(fit.values), weight)
    scores = np.add.reduceat(slopes * (weight * fit.residual)[:, None], joint.starts, axis=0)
    bread = np.linalg.pinv(slopes.T @ (slopes * weight[:, None]))
    count = len(scores)
    spread = bread @ (scores.T @ scores) @ bread * count / max(count - 1, 1)
    result = {}
    noise = bread * judge.sigma**2 * judge.inflation
    for i, name in enumerate(names):
        if not slopes[:, i].any():  # any larger limit would do as well
            result[name] = (fit.values[name], math.inf)
            continue
        half = INTERVAL * math.sqrt(max(spread[i, i], noise[i, i], 0.0))
        low, high = fit.values[name] - half, fit.values[name] + half
        if name == "deadband":  # the log cannot place a threshold closer than the sizes of its commands
            below, above = joint.sizes[joint.sizes < fit.values[name]], joint.sizes[joint.sizes >= fit.values[name]]
            low, high = min(low, below.max(initial=0.0)), max(high, above.min(initial=joint.fastest))
        result[name] = (float(max(low, EFFECTS[name].bounds(joint)[0])), float(high))
    return result


def _separate(joint: _Joint, name: str, rivals: Sequence[str]) -> str:
    texts = []
    if rivals:
        texts = [_experiment(joint, n) for n in dict.fromkeys((name, *rivals))]
    if name == "action_delay":
        texts.append("stamp a command's arrival at the drive and a state's departure with one clock")
    return "; ".join(texts)


def _experiment(joint: _Joint, name: str) -> str:
    return EFFECTS[name].experiment.format(joint=joint.record.joint, velocity=joint.rated_velocity, unit=joint.unit)


def _parameters(joint: _Joint, name: str, value: float, interval: tuple[float, float]) -> dict:
    unit = EFFECTS[name].unit.replace("u", joint.unit)
    if name != "action_delay":
        return {name: (joint.base[name], value, *interval, unit)}
    # The sum is known; the change goes to the action delay, and what would make it negative to the observation delay.
    action, observation = joint.nominal.action_delay, joint.nominal.observation_delay
    parts = {name: (action, *(max(v - observation, 0.0) for v in (value, *interval)), unit)}
    if value < observation:
        parts["observation_delay"] = (observation, value, *(min(v, observation) for v in interval), unit)
    return parts


def _home(joint: _Joint, verdict: _Verdict, home: float) -> tuple[float, float] | None:
    """Offset of the measured home position and half of its 90 % interval; None without a rest before any motion."""
    record = joint.record
    moving = np.flatnonzero(record.command_velocity != 0.0)
    begin = record.command_time[moving[0]] if moving.size else math.inf
    delay = verdict.fit.values.get("action_delay", joint.base["action_delay"])
    rest = record.state_position[record.state_time < begin + 0.8 * delay]
    if rest.size < 5:
        return None
    offset = float(np.median(rest)) - home
    noise = max(_scale(rest - np.median(rest)), verdict.judge.sigma)
    return offset, INTERVAL * 1.25 * noise * math.sqrt(min(verdict.judge.inflation / rest.size, 1.0))


def _excited(joint: _Joint, verdict: _Verdict, name: str) -> bool:
    """Whether the effect at the smallest size of interest would have been seen."""
    if joint.fastest == 0.0:
        return False
    value = EFFECTS[name].interest(joint, joint.base[name])
    change = joint.centred(joint.simulate({**verdict.fit.values, name: value}) - joint.simulate(verdict.fit.values))
    windows = np.add.reduceat(change * change, joint.starts) / verdict.judge.sigma**2 / verdict.judge.inflation
    return _rms(change) > FLOOR and windows.sum() > EVIDENCE and windows.sum() - windows.max() > ONE_WINDOW


def _held_out(joint: _Joint, values: Mapping[str, float], sigma: float, rng: np.random.Generator) -> RobotGain:
    odd = joint.window % 2 == 1
    fitted = joint.fit(values, sigma, mask=np.where(odd, 0.0, 1.0)).values if values and odd.any() else dict(values)
    before, after = (joint.centred(joint.measured - joint.simulate(v)) for v in ({}, fitted))
    counts = np.diff(np.append(joint.starts, joint.time.size))
    chosen = np.arange(counts.size) % 2 == 1 if counts.size > 1 else np.ones(1, bool)
    squares = np.array([np.add.reduceat(r * r, joint.starts)[chosen] for r in (before, after)])
    counts = counts[chosen]
    draws = rng.integers(0, counts.size, (400, counts.size))
    spread = np.sqrt(squares[:, draws].sum(axis=-1) / counts[draws].sum(axis=-1))
    low, high = np.quantile(spread[0] - spread[1], (0.05, 0.95))
    total = np.sqrt(squares.sum(axis=-1) / counts.sum())
    return RobotGain(joint.record.joint, float(total[0]), float(total[1]), float(low), float(high))


def _residuals(joint: _Joint, values: Mapping[str, float]) -> JointResidual:
    time, measured = joint.record.state_time[joint.all], joint.record.state_position[joint.all]
    starts, window = joint._windows(time)
    count = np.diff(np.append(starts, time.size))
    lines = []
    for parameters in ({}, values):
        line = joint.simulate(parameters, time)
        lines.append(line + (np.add.reduceat(measured - line, starts) / count)[window])
    return JointResidual(joint.record.joint, time, measured, *lines)


def diagnose_robot(
    records: Sequence[JointRecord],
    nominal: Mapping[str, JointResponse],
    seed: int = 0,
    progress: Callable[[str, int, int], None] | None = None,
    without: Sequence[str] = (),
    home: Mapping[str, float] | None = None,
) -> RobotFindings:
    """Names what the nominal responses of the joints get wrong.

    records: one for each joint.
    nominal: what the simulation believes, for each joint of the records.
    seed: of the bootstrap intervals.
    progress: called with joint, number of joints done and number of joints.
    without: effects left out of the catalogue, "lag" for all joints or "joint_2.lag".
    home: true position [rad], [m] in which a joint rests before its first motion; without it a constant offset of the
        measured position cannot be told from the start.
    Raises ValueError for no record, a joint twice, a joint without a nominal response, and names in without or home
    that do not exist.
    """
    if not records:
        raise ValueError("no record of a joint to diagnose")
    joints = merge_names(records)
    for joint in joints:
        if joint not in nominal:
            raise ValueError(f"no nominal response of {joint}; there are {', '.join(nominal)}")
    for name in without:
        joint, _, effect = name.rpartition(".")
        if effect not in NAMES or (joint and joint not in (*joints, *JOINT_NAMES)):
            raise ValueError(
                f"no robot effect {name!r} to leave out; effects are {', '.join(NAMES)}, with or without a joint"
            )
    home = dict(home or {})
    for name in home:
        if name not in joints:
            raise ValueError(f"home position of {name}, which has no record; there are {', '.join(joints)}")
    streams = np.random.default_rng(seed).spawn(len(records))
    found: dict[str, list] = {f.name: [] for f in dataclasses.fields(RobotFindings) if f.name != "responses"}
    responses = {}
    for i, record in enumerate(records):
        joint = _Joint(record, nominal[record.joint])
        gone = {n.rpartition(".")[2] for n in without if n.rpartition(".")[0] in ("", record.joint)}
        if gone & {"action_delay", "observation_delay"}:
            gone |= {"action_delay"}
        allowed = [e.name for e in CATALOGUE if e.name not in gone]
        verdict = _examine(joint, allowed)
        _report(joint, verdict, home.get(record.joint), gone, allowed, streams[i], found, responses)
        if progress is not None:
            progress(record.joint, i + 1, len(records))
    found["unexplained_by_joint"].sort(key=lambda u: -u["size"])
    found["causes"].sort(key=lambda c: -c.effect)
    return RobotFindings(**{name: tuple(values) for name, values in found.items()}, responses=responses)


def _report(joint, verdict, home, gone, allowed, rng, found, responses) -> None:
    """Adds one joint's verdict to the findings."""
    name = joint.record.joint
    intervals = _intervals(joint, verdict.fit, verdict.judge) if verdict.named else {}
    changes: dict[str, float] = {}
    for effect, (rivals, confidence) in verdict.named.items():
        group = tuple(dict.fromkeys(itertools.chain(*(_both(effect), *map(_both, rivals)))))
        parameters = _parameters(joint, effect, verdict.fit.values[effect], intervals[effect])
        changes |= {key: value[1] for key, value in parameters.items()}
        found["causes"].append(
            RobotCause(
                f"{name}.{effect}", tuple(f"{name}.{g}" for g in group), confidence, parameters,
                1e3 * verdict.effects[effect], _separate(joint, effect, rivals),
            )
        )  # fmt: skip
        if rivals:
            found["next_experiment"].append(_separate(joint, effect, rivals))
    if home is None:
        found["not_identifiable"].append(
            Undecided(f"{name}.joint_offset", "a constant offset needs a position known in absolute terms: home")
        )
    else:
        _judge_home(joint, verdict, home, gone, found, changes)
    if any(effect == "action_delay" for effect in verdict.named):
        found["not_identifiable"].append(
            Undecided(f"{name}.observation_delay", "only the sum of action_delay and observation_delay shows in a log")
        )
    for effect in allowed:
        if effect not in verdict.named and not _excited(joint, verdict, effect):
            value = EFFECTS[effect].interest(joint, joint.base[effect])
            unit = EFFECTS[effect].unit.replace("u", joint.unit)
            unit = "" if unit == "1" else f" {unit}"
            why = "the joint never moves" if joint.fastest == 0.0 else (
                f"{value:.3g}{unit} instead of {joint.base[effect]:.3g} would move the joint by too little to be seen"
            )  # fmt: skip
            for member in _both(effect):
                found["not_excited"].append(Undecided(f"{name}.{member}", why))
            found["next_experiment"].append(_experiment(joint, effect))
    if verdict.leftover is not None:
        where, direction = verdict.leftover.block.where(verdict.leftover.coefficients)
        found["unexplained_by_joint"].append(
            {
                "joint": name, "block": f"{name}: {verdict.leftover.block.name}", "where": where,
                "direction": direction, "size": 1e3 * verdict.leftover.size,
            }
        )  # fmt: skip
    values = {effect: verdict.fit.values[effect] for effect in verdict.named}
    if len(values) < len(verdict.fit.values) and values:
        values = joint.fit(values, verdict.judge.sigma).values
    found["held_out"].append(_held_out(joint, values, verdict.judge.sigma, rng))
    found["residuals"].append(_residuals(joint, values))
    responses[name] = dataclasses.replace(joint.nominal, **changes)


def _both(effect: str) -> tuple[str, ...]:
    return ("action_delay", "observation_delay") if effect == "action_delay" else (effect,)


def _judge_home(joint, verdict, home, gone, found, changes) -> None:
    name, measured = joint.record.joint, _home(joint, verdict, home)
    nominal = joint.nominal.joint_offset
    if measured is None:
        why = "the log has no rest before the first motion"
        found["not_excited"].append(Undecided(f"{name}.joint_offset", why))
        found["next_experiment"].append(f"hold {name} still at its home position before it moves")
        return
    offset, half = measured
    if abs(offset - nominal) < max(FLOOR, 3.0 * half):
        return
    size = 1e3 * abs(offset - nominal)
    if "joint_offset" in gone:
        found["unexplained_by_joint"].append(
            {
                "joint": name, "block": f"{name}: position at home", "where": f"position {home:.3g} {joint.unit}",
                "direction": "+" if offset > nominal else "-", "size": size,
            }
        )  # fmt: skip
        return
    changes["joint_offset"] = offset
    full = f"{name}.joint_offset"
    parameters = {"joint_offset": (nominal, offset, offset - half, offset + half, joint.unit)}
    found["causes"].append(RobotCause(full, (full,), MOST_CONFIDENT, parameters, size, ""))
