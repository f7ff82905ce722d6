"""A second, independent calculation of a rally in NumPy and SciPy: adaptive integration of the drag equation with event
detection, the table's bounce and the rubber's, each written from its formula and not from ``ballmodel``."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve

G, RADIUS, MASS = 9.81, 0.02, 0.0027
DRAG = 0.47 * 1.29 * 1.256e-3 / (2 * MASS)  # [1/m]
TABLE_E, TABLE_MU = 0.93, 0.25
RUBBER_E, RUBBER_SLOPE, RUBBER_GAIN = 0.917, 0.0217, 0.68
HALF_BLADE = 0.006  # [m]


@dataclass(frozen=True)
class Touch:
    """A moment of contact: time [s], position [m], velocity [m/s] and spin [rad/s] just after it, each (3,)."""

    time: float
    position: np.ndarray
    velocity: np.ndarray
    spin: np.ndarray


def _derivative(t, y):
    return np.concatenate([y[3:], -DRAG * np.linalg.norm(y[3:]) * y[3:] - [0, 0, G]])


def _solve(start: Touch, until, **options):
    y0 = np.concatenate([start.position, start.velocity])
    return solve_ivp(_derivative, (start.time, until), y0, rtol=1e-11, atol=1e-12, **options)


def fly(start: Touch, distance, seconds=3.0):
    """Flight until ``distance(position)`` falls to zero: time, position and velocity (6,); None if it never does."""

    def event(t, y):
        return distance(y[:3])

    event.terminal, event.direction = True, -1
    found = _solve(start, start.time + seconds, events=event)
    return (found.t_events[0][0], found.y_events[0][0]) if found.t_events[0].size else None


def path(start: Touch, moments):
    """Positions (3, n) of the free flight at increasing ``moments`` (n,)."""
    return _solve(start, moments[-1], t_eval=moments).y[:3]


def bounce(velocity, spin, normal, e, alpha):
    """Impact of a thin shell on a resting surface; ``alpha(v_n, slip)`` is the share of the slip that is taken away."""
    v_n = velocity @ normal
    slip = velocity - v_n * normal + np.cross(spin, -RADIUS * normal)
    change = -alpha(abs(v_n), np.linalg.norm(slip)) * slip
    return velocity - (1 + e) * v_n * normal + change, spin - 1.5 / RADIUS * np.cross(normal, change)


def on_table(start: Touch) -> Touch:
    """The first bounce on the table."""
    time, y = fly(start, lambda p: p[2] - RADIUS)
    up = np.array([0.0, 0.0, 1.0])
    return Touch(
        time, y[:3], *bounce(y[3:], start.spin, up, TABLE_E, lambda v, s: min(TABLE_MU * (1 + TABLE_E) * v / s, 0.4))
    )


def on_blade(start: Touch, centre, normal) -> Touch:
    """The impact on the plane of a blade at rest whose normal looks at the ball."""
    time, y = fly(start, lambda p: (p - centre) @ normal - RADIUS - HALF_BLADE)
    e = RUBBER_E - RUBBER_SLOPE * abs(y[3:] @ normal)
    return Touch(time, y[:3], *bounce(y[3:], start.spin, normal, e, lambda v, s: RUBBER_GAIN))


def serve(start, speed, centre, normal, up=0.0, bounces=True) -> Touch:
    """The serve from ``start`` (3,) whose ball, after one bounce or none, meets the blade ``up`` [m] above its centre.

    speed: velocity along y (negative); the other two components are solved for.
    """
    target = centre + up * np.cross(np.cross(normal, [0.0, 0.0, 1.0]), normal) + (RADIUS + HALF_BLADE) * normal

    def thrown(v):
        return Touch(0.0, np.asarray(start, float), np.array([v[0], speed, v[1]]), np.zeros(3))

    def miss(v):
        contact = on_blade(on_table(thrown(v)) if bounces else thrown(v), centre, normal)
        return (contact.position - target)[[0, 2]]

    distance = start[1] + 0.8 if bounces else start[1] - centre[1]  # for a first guess: a bounce before the robot
    fall = distance / -speed
    height = (RADIUS if bounces else centre[2]) - start[2]
    v, _, converged, message = fsolve(miss, [0.0, height / fall + G * fall / 2], xtol=1e-10, full_output=True)
    if converged != 1:
        raise ValueError(f"no serve from {start} at {speed} m/s meets the blade: {message}")
    return thrown(v)
