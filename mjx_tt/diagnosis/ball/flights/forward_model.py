"""Positions that a tracker would have measured under the model: many balls under many variants, in float64.

The flights are those of ``ballmodel.flight``, bounces inside the step, so the diagnosis fits what the simulation does.
Steps end at the samples' times; the camera's geometry and the tracker's filter are applied to what was flown. Variants
(another parameter, another start) are one more batch axis, which is how derivatives are taken: by differences in
float64, which also serve effects that start at a threshold.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from ballmodel import flight
from ballmodel.flight import PaddlePose
from ballmodel.partial_params import value_or, without_nominal
from ballmodel.state import BallState
from ballmodel.trajectory import Trajectory
from mjx_tt.sim.model import SensingParams, SimModel, paths, with_values
from mjx_tt.sim.sensors import FILTER_GATE, SURPRISE, Lag, jump

LONGEST_STEP = 0.01  # [s]; second order: 0.05 mm over a flight
PAD = 16  # numbers of steps are rounded up to it, so that similar logs share one compiled program
WIDTH = 256  # columns, balls x variants, of one call: always the same, for the same reason; few enough to stay in cache
_FLOWN: set[tuple] = set()  # shapes of programs that were compiled


@dataclass(frozen=True)
class Grid:
    """Measured samples of n balls on the steps that lead to them; padded to one length."""

    steps: Float[np.ndarray, "L n"]  # [s] of measured time, zero where there are fewer
    index: Int[np.ndarray, "T n"]  # step after which sample t is taken; 0 is the start
    time: Float[np.ndarray, "T n"]  # [s] since the first sample
    measured: Float[np.ndarray, "3 T n"]  # [m]
    mask: Bool[np.ndarray, "T n"]  # True for a sample
    paddle: PaddlePose | None = None  # the blade at the steps' ends, each quantity (3, L + 1, n)
    surprise: float = SURPRISE  # [m] deviation of the noise in what surprises a tracker's filter

    @property
    def n(self) -> int:
        """Number of balls."""
        return self.mask.shape[1]

    @property
    def last(self) -> Int[np.ndarray, " n"]:
        """Index of each ball's last sample."""
        return len(self.mask) - 1 - np.argmax(self.mask[::-1], axis=0)


def grid(trajectories: Sequence[Trajectory], steps: int = 0, samples: int = 0) -> Grid:
    """Puts trajectories on one padded grid, of at least so many steps and samples."""
    counts = [np.maximum(np.ceil(np.diff(t.time) / LONGEST_STEP * (1.0 - 1e-9)), 1.0).astype(int) for t in trajectories]
    n, samples = len(trajectories), max(samples, *map(len, trajectories))
    length = -(-max(steps, *(int(c.sum()) for c in counts)) // PAD) * PAD
    step, index, time = np.zeros((length, n)), np.zeros((samples, n), int), np.zeros((samples, n))
    measured, mask = np.zeros((3, samples, n)), np.zeros((samples, n), bool)
    for i, (t, count) in enumerate(zip(trajectories, counts, strict=True)):
        k, m = len(t), int(count.sum())
        step[:m, i] = np.repeat(np.diff(t.time) / count, count)
        index[1:k, i] = np.cumsum(count)
        index[k:, i] = m
        time[:k, i], time[k:, i] = t.time - t.time[0], t.time[-1] - t.time[0]
        measured[:, :k, i], measured[:, k:, i] = t.position, t.position[:, -1:]
        mask[:k, i] = True
    return Grid(step, index, time, measured, mask)


def picked(g: Grid, index: Int[np.ndarray, " m"]) -> Grid:
    """The grid of the balls with these indices, which may repeat."""
    paddle = g.paddle and jax.tree.map(lambda x: x[..., index], g.paddle)
    steps, step, time, measured, mask = (x[..., index] for x in (g.steps, g.index, g.time, g.measured, g.mask))
    return Grid(steps, step, time, measured, mask, paddle, g.surprise)


@dataclass(frozen=True)
class Flown:
    """Predictions for n balls under v variants."""

    measured: Float[np.ndarray, "3 T v n"]  # [m] report of the tracker
    position: Float[np.ndarray, "3 T s n"]  # [m] true, of the first s variants
    velocity: Float[np.ndarray, "3 T s n"]  # [m/s] true
    bounce_time: Float[np.ndarray, "v n"]  # [s] of the first bounce since the first sample; inf without one
    bounce: Float[np.ndarray, "3 v n"]  # [m] place of the bounce
    bounce_velocity: Float[np.ndarray, "3 v n"]  # [m/s] before it
    hit_time: Float[np.ndarray, "v n"]  # [s] of the paddle's contact since the first sample; inf without one


def heading_axes(velocity: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, "3 3 n"]:
    """Axes in which a ball's spin is told, by its first velocity: topspin, against its way, sidespin.

    For a ball that flies towards -y they are the table's x, y and z.
    """
    across = np.stack([-velocity[1], velocity[0]]) / np.maximum(np.hypot(velocity[0], velocity[1]), 1e-9)
    x, y = across
    zero = np.zeros_like(x)
    return np.stack([np.stack([x, -y, zero]), np.stack([y, x, zero]), np.stack([zero, zero, zero + 1.0])])


def predict(
    model: SimModel,
    values: Mapping[str, np.ndarray],
    start: Float[np.ndarray, "k v n"],
    g: Grid,
    axes: Float[np.ndarray, "3 3 n"],
    states: int = 1,
) -> Flown:
    """Flies every ball under every variant.

    values: leaves of ``model`` to replace, each broadcastable to (v, n). start: position, velocity, spin at the
    first sample, and, where there are twelve rows, what its first bounce adds to its velocity; these two in ``axes``:
    component, axis, ball. states: number of variants of which position and velocity are given.
    """
    if len(start) == 9:
        start = np.concatenate([start, np.zeros_like(start[:3])])
    own = [np.einsum("can,avn->cvn", axes, part) for part in (start[6:9], start[9:])]
    start = np.concatenate([start[:6], *own])
    v, n = start.shape[1:]
    ball = np.tile(np.arange(n), v)  # column -> ball
    flat = {k: np.broadcast_to(np.asarray(values[k], np.float64), (v, n)).ravel() for k in sorted(values)}
    columns = start.reshape(len(start), -1)

    def part(first: int) -> list[np.ndarray]:
        # The last part is filled up with its last column: one shape, one compiled program.
        mine = np.minimum(np.arange(first, first + WIDTH), v * n - 1)
        some = ball[mine]
        paddle = g.paddle and jax.tree.map(lambda x: np.moveaxis(x[..., some], 1, 0), g.paddle)
        with jax.enable_x64(True):
            flown = _fly(
                model,
                {k: x[mine] for k, x in flat.items()},
                columns[:, mine],
                g.steps[:, some],
                g.index[:, some],
                paddle,
                g.surprise,
            )
            return [np.asarray(x)[..., : v * n - first] for x in flown]

    begins = [*range(0, v * n, WIDTH)]
    shape = (len(g.steps), len(g.index), g.paddle is None, *flat)
    parts = [] if shape in _FLOWN else [part(begins.pop(0))]  # alone: it may have to be compiled
    _FLOWN.add(shape)
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as cores:
        parts += cores.map(part, begins)

    def joined(some: Sequence[np.ndarray], variants: int) -> np.ndarray:
        x = np.concatenate(some[: -(-variants * n // WIDTH)], axis=-1)[..., : variants * n]
        return x.reshape(*x.shape[:-1], variants, n)

    counts = (v, states, states, v, v, v, v)
    return Flown(*(joined(some, count) for some, count in zip(zip(*parts, strict=True), counts, strict=True)))


@jax.jit
def _fly(
    model: SimModel,
    values: dict[str, Array],
    start: Array,
    steps: Array,
    index: Array,
    paddle: PaddlePose | None,
    surprise: float | Array,
) -> tuple[Array, ...]:
    """Fields of Flown for columns (12, c) of starts; values (c,), steps (L, c), index (T, c), paddle (L + 1, 3, c)."""
    nominal_latency = model.latency.ball_observation
    model = with_values(without_nominal(model), values)
    ball = replace(model.ball, flight=replace(model.ball.flight, integrator="midpoint"))
    sensing = model.sensing
    shape = start.shape[1:]
    rate = jnp.broadcast_to(jnp.asarray(value_or(sensing.clock_rate, 1.0), start.dtype), shape)
    smoothing = jnp.broadcast_to(jnp.asarray(value_or(sensing.smoothing, 0.0), start.dtype), shape)
    tau = jnp.maximum(smoothing, 1e-9)
    memory = jnp.broadcast_to(jnp.asarray(value_or(sensing.filter_time, 0.0), start.dtype), shape)
    gate = jnp.maximum(value_or(sensing.filter_gate, FILTER_GATE), 1e-3)  # [m]
    gate = jnp.broadcast_to(jnp.asarray(gate, start.dtype), shape)

    def follow(filtered: Array, before: Array, after: Array, dt: Array) -> Array:
        """The filter's output after a piece of straight motion: exact."""
        slope = (after - before) / jnp.maximum(dt, 1e-9)
        out = after - tau * slope + (filtered - before + tau * slope) * jnp.exp(-dt / tau)
        return jnp.where(dt > 0.0, out, filtered)

    # A ball that is stamped late meets the paddle of an earlier moment.
    late = jnp.asarray(model.latency.ball_observation, start.dtype) - nominal_latency

    def moved(pose: PaddlePose) -> PaddlePose:
        turned = jnp.cross(pose.angular_velocity, pose.normal, axis=0)
        return replace(pose, position=pose.position - late * pose.velocity, normal=pose.normal - late * turned)

    def advance(carry: tuple, inputs: tuple) -> tuple[tuple, tuple[Array, ...]]:
        state, filtered, (lag, unmeasured), elapsed, bounced, at, incoming, struck = carry
        dt, sampled, *blade = inputs
        dt = dt / rate
        pair = tuple(jax.tree.map(lambda x: jnp.broadcast_to(x, (3, *shape)), moved(pose)) for pose in blade) or None
        # What was measured flew on: a trial start that grazes the net must not be stopped by it.
        new, events = flight.step(ball, state, dt, pair, with_net=False)
        moving = dt > 0.0
        new = jax.tree.map(lambda a, b: jnp.where(moving, a, b), new, state)
        landed = events.table & moving
        hit = landed | (events.paddle & moving)
        t = jnp.where(hit, events.time, dt)
        first = landed & (bounced == jnp.inf)
        extra = jnp.where(first, start[9:], 0.0)
        new = replace(new, position=new.position + (dt - t) * extra, velocity=new.velocity + extra)
        corner = jnp.where(hit, events.position, new.position)
        filtered = follow(follow(filtered, state.position, corner, t), corner, new.position, dt - t)
        kick = jnp.where(hit, jump(state.velocity, new.velocity, dt), 0.0)
        lag, unmeasured = lag.predict(dt, kick, dt - t), unmeasured + dt
        met = lag.correct(unmeasured, usual, memory, gate, surprise)
        lag = jax.tree.map(lambda a, b: jnp.where(sampled, a, b), met, lag)
        unmeasured = jnp.where(sampled, 0.0, unmeasured)
        bounced = jnp.where(first, (elapsed + t) * rate, bounced)
        at = jnp.where(first, events.position, at)
        incoming = jnp.where(first, state.velocity, incoming)
        struck = jnp.where(events.paddle & moving & (struck == jnp.inf), (elapsed + events.time) * rate, struck)
        carry = (new, filtered, (lag, unmeasured), elapsed + dt, bounced, at, incoming, struck)
        return carry, (new.position, new.velocity, filtered, lag.position)

    state = BallState(start[:3], start[3:6], start[6:9])
    zero = jnp.zeros_like(start[0])
    # In steady motion the filter trails by tau v: it was running before the first sample.
    filtered = start[:3] - smoothing * start[3:6]
    still = jnp.zeros_like(start[:3])
    # Steps at whose end the tracker measures: behind a ball's last sample nothing moves.
    columns = jnp.arange(shape[0])
    frames = jnp.zeros((len(steps) + 1, *shape), bool).at[index, columns].set(True)[1:]
    usual = jnp.sum(steps, axis=0) / jnp.maximum(jnp.sum(frames, axis=0), 1)  # [s] between measurements
    lag = Lag.settle(usual, memory, still)
    carry = (state, filtered, (lag, zero), zero, zero + jnp.inf, still, still, zero + jnp.inf)
    ends = () if paddle is None else (slice(None, -1), slice(1, None))
    blades = tuple(jax.tree.map(lambda x, part=part: x[part], paddle) for part in ends)
    inputs = (steps, frames, *blades)
    (_, _, _, _, bounced, at, incoming, struck), (x, v, y, behind) = jax.lax.scan(advance, carry, inputs)

    def taken(first: Array | np.ndarray, later: Array) -> Array:
        at_steps = jnp.moveaxis(jnp.concatenate([first[None], later]), 0, 1)  # (3, L + 1, ...)
        return jnp.take_along_axis(at_steps, index[None], axis=1)

    position, velocity = taken(state.position, x), taken(state.velocity, v)
    seen = jnp.where(smoothing > 0.0, taken(filtered, y), position) + taken(still, behind)
    return _camera(sensing, seen), position, velocity, bounced, at, incoming, struck


def _camera(sensing: SensingParams, p: Array) -> Array:
    """Positions (3, ...) as the calibrated camera reports them: scale R (1 + k |p|^2) p + offset, R = Rz Ry Rx."""
    bend, turns = value_or(sensing.camera_distortion, 0.0), ("x", "y", "z")
    x, y, z = p * (1.0 + bend * jnp.sum(p * p, axis=0)) * value_or(sensing.camera_scale, 1.0)
    angles = [value_or(getattr(sensing, f"camera_rotation_{axis}"), 0.0) for axis in turns]
    c, s = jnp.cos(angles[0]), jnp.sin(angles[0])
    y, z = c * y - s * z, s * y + c * z
    c, s = jnp.cos(angles[1]), jnp.sin(angles[1])
    x, z = c * x + s * z, c * z - s * x
    c, s = jnp.cos(angles[2]), jnp.sin(angles[2])
    x, y = c * x - s * y, s * x + c * y
    return jnp.stack([x + sensing.ball_offset_x, y + sensing.ball_offset_y, z + sensing.ball_offset_z])


def leaves(model: SimModel) -> dict[str, float]:
    """Nominal values of the model's numbers by dotted path."""
    return {k: float(v) for k, v in paths(model).items() if isinstance(v, int | float)}
