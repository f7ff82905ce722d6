"""The ball tracker's camera and filter: how a true position becomes a measured one."""

from __future__ import annotations

from typing import Annotated

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from ballmodel import constants as c
from ballmodel.io.ranges import Within
from ballmodel.partial_params import optional, value_or
from ballmodel.state import BallState
from ballmodel.vec import Scalars, dot, row
from mjx_tt.pytrees import pytree
from mjx_tt.sim.constant_acceleration import correct_covariance, predict_covariance

SHORTEST = 1e-9  # [s], keeps the filters' exponents finite
FILTER_GATE = 0.03  # [m]: ten deviations of a usual tracker's noise
SURPRISE = 0.006  # [m] deviation of a usual surprise: noise blurs where a filter starts afresh
SOFTNESS = 2.2  # a step's half width in deviations: the smooth step 3 s^2 - 2 s^3 has a deviation of 0.45 of it
FRESH = 300.0  # variance that an opened filter adds, in the noise's: 5 cm of a ball that is measured to 3 mm
SETTLED = (2.0, 2.0, 1.0, 3.0, 2.0, 2.0)  # of h: covariance of a settled filter that measures without a pause
ROUNDS = 12  # of measurements, after which it is that of a filter that measures now and then
LONGEST = 10.0  # memories between measurements, of a filter that keeps a 20,000th of its lag


@pytree
class SensingParams:
    """The ball tracker: how it measures a position.

    measured = camera_scale R (1 + camera_distortion |p|^2) p + offset + noise,   R = Rz Ry Rx
    with p the ball's position, delayed by ``latency.ball_observation`` times ``clock_rate`` and, with ``smoothing``,
    filtered: df/dt = (p - f) / smoothing. (Filter and camera commute but for the distortion's change along the flight;
    the noise is added behind both.) With ``filter_time`` the tracker predicts by constant acceleration and corrects
    (``Lag``): it is wrong for a moment behind every bounce.
    """

    # Half width of the uniform noise on each coordinate, per control step [m]: "2 x the diameter" is its whole width.
    ball_noise: Annotated[Scalars, Within(0.0, 0.5, "m")] = c.BALL_DIAMETER
    ball_offset_x: Annotated[Scalars, Within(-0.5, 0.5, "m")] = 0.0  # [m], calibration bias
    ball_offset_y: Annotated[Scalars, Within(-0.5, 0.5, "m")] = 0.0
    ball_offset_z: Annotated[Scalars, Within(-0.5, 0.5, "m")] = 0.0
    camera_scale: Annotated[Scalars, Within(0.5, 2.0)] | None = optional(1.0)
    camera_rotation_x: Annotated[Scalars, Within(-1.0, 1.0, "rad")] | None = optional(0.0)  # about the table's axes
    camera_rotation_y: Annotated[Scalars, Within(-1.0, 1.0, "rad")] | None = optional(0.0)
    camera_rotation_z: Annotated[Scalars, Within(-1.0, 1.0, "rad")] | None = optional(0.0)
    camera_distortion: Annotated[Scalars, Within(-1.0, 1.0, "1/m^2")] | None = optional(0.0)  # [1/m^2]
    # Measured over true time. A policy reads no clock: all that this can do to it is to stretch the tracker's latency.
    clock_rate: Annotated[Scalars, Within(0.5, 2.0)] | None = optional(1.0)
    smoothing: Annotated[Scalars, Within(0.0, 1.0, "s")] | None = optional(0.0)  # time constant of a filter
    filter_time: Annotated[Scalars, Within(0.0, 1.0, "s")] | None = optional(0.0)  # memory of a filter that predicts
    # [m] surprise that makes it start afresh
    filter_gate: Annotated[Scalars, Within(0.0001, 10.0, "m")] | None = optional(FILTER_GATE)
    # [s] deviation of the moment of each measurement, Gaussian
    jitter: Annotated[Scalars, Within(0.0, 0.1, "s")] | None = optional(0.0)


@pytree
class Camera:
    """A camera's wrong calibration about the table frame's origin."""

    rows: tuple[tuple[Scalars, Scalars, Scalars], ...]  # 3 x 3, camera_scale Rz Ry Rx
    distortion: Scalars  # [1/m^2]

    def project(self, p: Float[Array, "3 *batch"]) -> Float[Array, "3 *batch"]:
        """Measured position (3, ...) [m] of a ball at p (3, ...) [m], without offset and noise."""
        p = p * row(1.0 + self.distortion * dot(p, p))
        return jnp.stack([dot(row, p) for row in self.rows])


def make_camera(params: SensingParams) -> Camera | None:
    """The camera of these parameters; None where all of them are omitted."""
    names = ("camera_scale", *(f"camera_rotation_{axis}" for axis in "xyz"), "camera_distortion")
    values = [getattr(params, name) for name in names]
    if all(value is None for value in values):
        return None
    scale, x, y, z, distortion = (
        value_or(value, nominal) for value, nominal in zip(values, (1.0, 0.0, 0.0, 0.0, 0.0), strict=True)
    )
    (cx, cy, cz), (sx, sy, sz) = (tuple(map(f, (x, y, z))) for f in (jnp.cos, jnp.sin))
    rotation = (
        (cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx),
        (sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx),
        (-sy, cy * sx, cy * cx),
    )
    return Camera(tuple((scale * a, scale * b, scale * c) for a, b, c in rotation), distortion)


def step_smoothing(
    time_constant: Scalars,
    filtered: Float[Array, "3 *batch"],
    before: Float[Array | np.ndarray, "3 *batch"],
    after: Float[Array | np.ndarray, "3 *batch"],
    timestep: float,
) -> Float[Array, "3 *batch"]:
    """The filtered position (3, ...) [m] at a substep's end: df/dt = (p - f) / time_constant, solved exactly for a ball
    that goes straight from ``before`` to ``after`` (3, ...) within the substep."""
    tau = row(jnp.maximum(time_constant, SHORTEST))
    behind = (after - before) * (tau / timestep)  # by which f follows a steady p
    return jnp.asarray(after) - behind + (filtered - before + behind) * jnp.exp(-timestep / tau)


@pytree
class Lag:
    """Estimate minus truth of a Kalman filter that assumes constant acceleration.

    State: position, velocity, acceleration; driven by a white jerk of density q, measured with a noise of density r
    (variance times interval). What it leaves of a truth depends on one number, its memory (r / q)^(1/6) [s]: settled
    and measured often, the filter's poles are those of the third-order Butterworth filter of that time (Kalman and
    Bucy, New Results in Linear Filtering and Prediction Theory, 1961). A flight shows no lag; a jump of the velocity
    leaves one that fades. A surprise beyond the gate opens the filter: its covariance grows by FRESH, so that it
    believes what it measures until it has settled again.
    """

    position: Float[Array, "3 *batch"]  # [m]
    velocity: Float[Array, "3 *batch"]  # [m/s]
    acceleration: Float[Array, "3 *batch"]  # [m/s^2]
    # of ``constant_acceleration``; unit of length: the deviation of the measurements' noise, of time: the memory
    covariance: Float[Array, "6 *batch"]

    @classmethod
    def settle(cls, dt: Scalars, memory: Scalars, like: Float[Array | np.ndarray, "3 *batch"]) -> Lag:
        """A filter that has watched a flight, measured every ``dt`` [s]: no lag. memory [s]."""
        zero = jnp.zeros_like(like)
        h = jnp.broadcast_to(dt / _shown(memory, dt), zero.shape[1:])
        covariance = jnp.asarray(row(h) * jnp.stack([jnp.full_like(h, x) for x in SETTLED]))
        for _ in range(ROUNDS):
            covariance = _correct(jnp.stack(predict_covariance(covariance, h, h)))[1]
        return cls(zero, zero, zero, covariance)

    def predict(self, dt: Scalars, jump: Float[Array, "3 *batch"], since: Scalars) -> Lag:
        """The lag after ``dt`` [s] without a measurement; jump: of the ball's velocity [m/s], ``since`` [s] ago."""
        moved = self.position + row(dt) * self.velocity + row(0.5 * dt**2) * self.acceleration - row(since) * jump
        return Lag(moved, self.velocity + row(dt) * self.acceleration - jump, self.acceleration, self.covariance)

    def correct(
        self, dt: Scalars, usual: Scalars, memory: Scalars, gate: Scalars, blur: float | Array = SURPRISE
    ) -> Lag:
        """The lag after a measurement, ``dt`` [s] after the one before. memory [s], zero: no lag; gate [m].

        usual: interval [s] of measurements for which the filter was made. blur: deviation [m] of surprises' noise.
        """
        time = _shown(memory, usual)
        h = usual / time
        surprise = jnp.sqrt(dot(self.position, self.position) + SHORTEST**2)
        share = jnp.clip(0.5 - 0.5 * (surprise - gate) / (SOFTNESS * blur), 0.0, 1.0)
        shut = share * share * (3.0 - 2.0 * share)  # of balls whose filter did not open
        # The noise's variance and the memory are the units: the jerk's density is the usual interval.
        grown = jnp.stack(predict_covariance(self.covariance, dt / time, h))
        opened = jnp.stack([grown[0] + FRESH, *grown[1:3], grown[3] + FRESH / h**2, grown[4], grown[5] + FRESH / h**4])
        (closed_gains, closed), (open_gains, wide) = _correct(grown), _correct(opened)
        gains = [shut * a + (1.0 - shut) * b for a, b in zip(closed_gains, open_gains, strict=True)]
        mixed = row(shut) * closed + row(1.0 - shut) * wide
        there = row(memory) > 0.0
        return Lag(
            jnp.where(there, row(1.0 - gains[0]) * self.position, 0.0),
            jnp.where(there, self.velocity - row(gains[1] / time) * self.position, 0.0),
            jnp.where(there, self.acceleration - row(gains[2] / time**2) * self.position, 0.0),
            jnp.asarray(mixed),
        )


def _shown(memory: Scalars, usual: Scalars) -> Array:
    """The memory [s], where it is a share of the interval between measurements; below that no filter shows."""
    return jnp.maximum(memory, jnp.maximum(usual, SHORTEST) / LONGEST)


def _correct(grown: Float[Array, "6 *batch"]) -> tuple[Array, Array]:
    """Gains (3, ...), and the covariance after a measurement whose noise is the unit."""
    gains = jnp.asarray(grown[:3] / row(grown[0] + 1.0))
    return gains, jnp.stack(correct_covariance(grown, gains, 1.0))


def jump(
    before: Float[Array | np.ndarray, "3 *batch"], after: Float[Array | np.ndarray, "3 *batch"], dt: Scalars
) -> Float[Array, "3 *batch"]:
    """Jump of a velocity (3, ...) [m/s] at a contact within ``dt`` [s], in which gravity acted as well."""
    return jnp.stack([after[0] - before[0], after[1] - before[1], after[2] - before[2] + c.GRAVITY * dt])


@pytree
class Filters:
    """Memories of the tracker's filters of a ball; None for one that the parameters omit."""

    smooth: Float[Array | np.ndarray, "3 *batch"] | None  # [m]
    lag: Lag | None

    @classmethod
    def settle(cls, params: SensingParams, position: Float[Array | np.ndarray, "3 *batch"], timestep: float) -> Filters:
        """Filters that have settled on a position [m], with a substep of ``timestep`` [s]."""
        lag = None if params.filter_time is None else Lag.settle(timestep, params.filter_time, position)
        return cls(None if params.smoothing is None else position, lag)

    def see(self, position: Float[Array | np.ndarray, "3 *batch"]) -> Float[Array | np.ndarray, "3 *batch"]:
        """The position [m] that the filters make of one."""
        seen = position if self.smooth is None else self.smooth
        return seen if self.lag is None else seen + self.lag.position

    def step(
        self,
        params: SensingParams,
        before: BallState,
        after: BallState,
        contact: Bool[Array, "*batch"],
        since: Scalars,
        timestep: float,
    ) -> Filters:
        """The filters a substep later. contact: True where something struck the ball in it, ``since`` [s] ago."""
        smooth, lag = self.smooth, self.lag
        if smooth is not None and params.smoothing is not None:
            smooth = step_smoothing(params.smoothing, jnp.asarray(smooth), before.position, after.position, timestep)
        if lag is not None and params.filter_time is not None:
            struck = jnp.where(contact, jump(before.velocity, after.velocity, timestep), 0.0)
            gate = value_or(params.filter_gate, FILTER_GATE)
            lag = lag.predict(timestep, struck, jnp.where(contact, since, 0.0)).correct(
                timestep, timestep, params.filter_time, gate
            )
        return Filters(smooth, lag)
