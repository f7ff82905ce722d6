"""Flight and bounce of many balls in NumPy, written from the formulas: RK4 with a bisected bounce.

    dv/dt = g (1 - buoyancy) - K_d |u| u + K_m (omega x u),  u = v - wind,  d omega/dt = -decay omega
    K_d = C_d rho A / 2m,  K_m = k rho A r / 2m
    bounce (Nakashima): alpha = min(mu (1 + e) |v_n| / |v_s|, 2/5), dv_t = -alpha v_s, d omega = -3/(2r) n x dv_t

Component axis first, balls last. Every number of a World may be a scalar or an array (B,): an effect that differs from
ball to ball (session, time in session, a rare subset) is a world whose number is an array.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

STEP = 2e-3  # [s] of RK4; a flight's truncation error is below a nanometre
BISECTIONS = 30  # of one step: the time of the bounce to 2e-12 s


@dataclass(frozen=True)
class World:
    """True parameters; the defaults are the nominal simulation."""

    drag_coefficient: float | np.ndarray = 0.47
    air_density: float | np.ndarray = 1.29  # [kg/m^3]
    area: float | np.ndarray = 1.256e-3  # [m^2]
    mass: float | np.ndarray = 0.0027  # [kg]
    radius: float | np.ndarray = 0.020  # [m]
    magnus_coefficient: float | np.ndarray = 0.0
    lift_saturation: float | np.ndarray = 0.0  # c in C_L = k S / (1 + c S), S = |omega| r / |u|
    spin_decay: float | np.ndarray = 0.0  # [1/s]
    buoyancy: float | np.ndarray = 0.0  # fraction of gravity
    gravity_x: float | np.ndarray = 0.0  # [m/s^2]
    gravity_y: float | np.ndarray = 0.0
    gravity_z: float | np.ndarray = -9.81
    wind_x: float | np.ndarray = 0.0  # [m/s]
    wind_y: float | np.ndarray = 0.0
    wind_z: float | np.ndarray = 0.0
    restitution: float | np.ndarray = 0.93
    restitution_slope: float | np.ndarray = 0.0  # [s/m]
    friction: float | np.ndarray = 0.25
    grip: float | np.ndarray = 0.0  # slip that a gripped contact point springs back with, over the slip before
    height: float | np.ndarray = 0.0  # [m]
    tilt_x: float | np.ndarray = 0.0  # dz/dx of the table's surface
    tilt_y: float | np.ndarray = 0.0
    camera_scale: float | np.ndarray = 1.0
    camera_rotation_x: float | np.ndarray = 0.0  # [rad]
    camera_rotation_y: float | np.ndarray = 0.0
    camera_rotation_z: float | np.ndarray = 0.0
    camera_distortion: float | np.ndarray = 0.0  # [1/m^2]
    clock_rate: float | np.ndarray = 1.0
    smoothing: float = 0.0  # [s]
    jitter: float = 0.0  # [s]
    # What is in no catalogue: functions of position and velocity (3, ..., B).
    drag_factor: Callable | None = None  # (velocity) -> multiplies C_d
    field: Callable | None = None  # (position, velocity) -> acceleration (3, ...)
    surface: Callable | None = None  # (x, y) -> height added to the table and its slopes, three arrays
    restitution_map: Callable | None = None  # (x, y) -> added to e
    camera_shift: Callable | None = None  # (position) -> added to the measured position (3, ...)


def _cross(a, b):
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def derivative(world: World, state: np.ndarray) -> np.ndarray:
    """d/dt of position, velocity and spin, (9, ...)."""
    position, velocity, spin = state[:3], state[3:6], state[6:]
    out = np.empty_like(state)
    out[:3] = velocity
    ux, uy, uz = velocity[0] - world.wind_x, velocity[1] - world.wind_y, velocity[2] - world.wind_z
    per_area = world.air_density * world.area / (2.0 * world.mass)
    drag = world.drag_coefficient * per_area
    if world.drag_factor is not None:
        drag = drag * world.drag_factor(velocity)
    drag = drag * np.sqrt(ux * ux + uy * uy + uz * uz)
    weight = 1.0 - world.buoyancy
    out[3] = world.gravity_x * weight - drag * ux
    out[4] = world.gravity_y * weight - drag * uy
    out[5] = world.gravity_z * weight - drag * uz
    if np.any(world.magnus_coefficient):
        lift = world.magnus_coefficient * per_area * world.radius
        if np.any(world.lift_saturation):
            ratio = world.radius * np.sqrt(np.sum(spin**2, axis=0)) / np.sqrt(ux * ux + uy * uy + uz * uz)
            lift = lift / (1.0 + world.lift_saturation * ratio)
        out[3] += lift * (spin[1] * uz - spin[2] * uy)
        out[4] += lift * (spin[2] * ux - spin[0] * uz)
        out[5] += lift * (spin[0] * uy - spin[1] * ux)
    if world.field is not None:
        out[3:6] += world.field(position, velocity)
    out[6:] = -world.spin_decay * spin
    return out


def rk4(world: World, state: np.ndarray, h) -> np.ndarray:
    """One step of length h, a scalar or (B,)."""
    k1 = derivative(world, state)
    k2 = derivative(world, state + h / 2 * k1)
    k3 = derivative(world, state + h / 2 * k2)
    k4 = derivative(world, state + h * k3)
    return state + h / 6 * (k1 + 2 * (k2 + k3) + k4)


def _table(world: World, x, y):
    """Height of the surface under (x, y) and its slopes."""
    z = world.height + world.tilt_x * x + world.tilt_y * y
    slope_x, slope_y = world.tilt_x, world.tilt_y
    if world.surface is not None:
        extra, extra_x, extra_y = world.surface(x, y)
        z, slope_x, slope_y = z + extra, slope_x + extra_x, slope_y + extra_y
    return z, slope_x, slope_y


def clearance(world: World, position: np.ndarray) -> np.ndarray:
    """Distance [m] of the ball's surface from the table's plane, (...)."""
    z, slope_x, slope_y = _table(world, position[0], position[1])
    return (position[2] - z) / np.sqrt(1.0 + slope_x**2 + slope_y**2) - world.radius


def bounce(world: World, state: np.ndarray) -> np.ndarray:
    """State after the impact on the table, (9, B)."""
    position, velocity, spin = state[:3], state[3:6], state[6:]
    x, y = position[0], position[1]
    _, slope_x, slope_y = _table(world, x, y)
    normal = np.stack(np.broadcast_arrays(-slope_x + 0.0 * x, -slope_y + 0.0 * x, np.ones_like(x)))
    normal = normal / np.sqrt(np.sum(normal**2, axis=0))
    v_n = np.sum(velocity * normal, axis=0)
    slip = velocity - v_n * normal + _cross(spin, -world.radius * normal)
    e = world.restitution - world.restitution_slope * np.abs(v_n)
    if world.restitution_map is not None:
        e = e + world.restitution_map(x, y)
    e = np.clip(e, 0.0, 1.0)
    speed = np.sqrt(np.sum(slip**2, axis=0)) + 1e-15
    alpha = np.minimum(world.friction * (1.0 + e) * np.abs(v_n) / speed, 0.4 * (1.0 + world.grip))
    change = -alpha * slip
    after = velocity - (1.0 + e) * v_n * normal + change
    return np.concatenate([position, after, spin - 1.5 / world.radius * _cross(normal, change)])


@dataclass(frozen=True)
class Flight:
    """Paths up to the second contact; times count from the start."""

    step: float
    first: np.ndarray  # (K + 1, 9, B) before the bounce
    second: np.ndarray  # (M + 1, 9, B) after it, from the time of the bounce
    bounce_time: np.ndarray  # (B,), inf without a bounce
    end_time: np.ndarray  # (B,) of the second contact, inf without one
    bounce_state: np.ndarray  # (9, B) just before it

    def at(self, time: np.ndarray) -> np.ndarray:
        """Positions (3, T, B) at times (T, B); NaN after the second contact."""
        before = time < self.bounce_time
        here = _interpolate(self.first, time, self.step)
        if np.all(before):
            return here
        later = np.where(before, 0.0, time - np.where(np.isfinite(self.bounce_time), self.bounce_time, 0.0))
        there = _interpolate(self.second, later, self.step)
        return np.where(time > self.end_time, np.nan, np.where(before, here, there))


def _interpolate(grid: np.ndarray, time: np.ndarray, step: float) -> np.ndarray:
    """Cubic Hermite through the grid's positions and velocities, (3, T, B)."""
    k = np.clip((time / step).astype(int), 0, grid.shape[0] - 2)
    s = (time / step - k)[:, None]
    ball = np.broadcast_to(np.arange(grid.shape[2]), k.shape)
    a, b = grid[k, :, ball], grid[k + 1, :, ball]  # (T, B, 9)
    a, b = np.moveaxis(a, 2, 1), np.moveaxis(b, 2, 1)
    p, v, q, w = a[:, :3], a[:, 3:6] * step, b[:, :3], b[:, 3:6] * step
    value = p + s * (v + s * (3 * (q - p) - 2 * v - w + s * (2 * (p - q) + v + w)))
    return np.moveaxis(value, 0, 1)


def _steps(world: World, state: np.ndarray, count: int, step: float) -> np.ndarray:
    grid = np.empty((count + 1, *state.shape))
    grid[0] = state
    for k in range(count):
        grid[k + 1] = rk4(world, grid[k], step)
    return grid


def _contact(world: World, grid: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Time (B,), inf without one, and state (9, B) of the first descent through the table's surface."""
    distance = clearance(world, np.moveaxis(grid[:, :3], 1, 0))
    crossing = (distance[:-1] > 0.0) & (distance[1:] <= 0.0)
    meets = np.any(crossing, axis=0)
    k = np.argmax(crossing, axis=0)
    origin = grid[k, :, np.arange(grid.shape[2])].T
    low, high = np.zeros(grid.shape[2]), np.full(grid.shape[2], step)
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        above = clearance(world, rk4(world, origin, middle)[:3]) > 0.0
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    return np.where(meets, k * step + low, np.inf), rk4(world, origin, low)


def fly(world: World, start: np.ndarray, duration: float, step: float = STEP) -> Flight:
    """Flies balls from states (9, B) for ``duration`` [s]."""
    count = int(np.ceil(duration / step)) + 1
    first = _steps(world, start, count, step)
    time, state = _contact(world, first, step)
    after = bounce(world, state)
    left = duration - float(np.min(time, initial=duration))  # of the ball that bounces first
    second = _steps(world, after, int(np.ceil(left / step)) + 1, step)
    # The rebound starts on the surface: its first point counts as above it.
    lifted = second.copy()
    lifted[0, 2] += 1e-6
    again, _ = _contact(world, lifted, step)
    return Flight(step, first, second, time, time + again, state)


def rotation(angle_x, angle_y, angle_z):
    """Rz Ry Rx as a nested list of entries, each a scalar or (B,)."""
    cx, sx, cy, sy, cz, sz = (f(a) for a in (angle_x, angle_y, angle_z) for f in (np.cos, np.sin))
    return [
        [cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx],
        [sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx],
        [-sy, cy * sx, cy * cx],
    ]


def camera(world: World, position: np.ndarray) -> np.ndarray:
    """Camera's image of true positions (3, ..., B): camera_scale R (1 + camera_distortion |p|^2) p."""
    r = rotation(world.camera_rotation_x, world.camera_rotation_y, world.camera_rotation_z)
    stretch = world.camera_scale * (1.0 + world.camera_distortion * np.sum(position**2, axis=0))
    seen = np.stack([stretch * sum(r[i][j] * position[j] for j in range(3)) for i in range(3)])
    return seen if world.camera_shift is None else seen + world.camera_shift(position)


def seen(world: World, flight: Flight, stamp: np.ndarray) -> np.ndarray:
    """Tracker's samples of a flight, without noise: positions (3, T, B) at its stamps (T, B) since the start.

    Its filter, of time constant ``smoothing``, runs between the samples and ran before the first one.
    """
    if world.smoothing <= 0.0:
        return camera(world, flight.at(stamp / world.clock_rate))
    step = 2e-4  # [s]; one of 1e-3 cuts the corner at the bounce by itself, as 0.01 ms of the filter would
    grid = np.arange(int(np.ceil(stamp.max() / step)) + 2)[:, None] * step + np.zeros(stamp.shape[1])
    image = camera(world, flight.at(grid / world.clock_rate))
    out, slope = np.empty_like(image), np.diff(image, axis=1) / step
    behind = world.smoothing * slope  # distance at which the filter follows a straight line
    out[:, 0] = image[:, 0] - behind[:, 0]
    decay = np.exp(-step / world.smoothing)
    for k in range(1, grid.shape[0]):
        missing = out[:, k - 1] - image[:, k - 1] + behind[:, k - 1]
        out[:, k] = image[:, k] - behind[:, k - 1] + decay * missing
    k = np.clip((stamp / step).astype(int), 0, grid.shape[0] - 2)
    share, ball = stamp / step - k, np.arange(stamp.shape[1])
    return out[:, k, ball] * (1.0 - share) + out[:, k + 1, ball] * share


def filtered(noise: np.ndarray, interval: float, constant: float) -> np.ndarray:
    """The same filter over samples (3, T, ...), from rest."""
    if constant <= 0.0:
        return noise
    gain = 1.0 - np.exp(-interval / constant)
    out = gain * noise
    for k in range(1, noise.shape[1]):
        out[:, k] += (1.0 - gain) * out[:, k - 1]
    return out
