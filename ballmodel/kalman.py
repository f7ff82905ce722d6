"""Flight and bounces in NumPy, for whoever cannot load the simulation, and an extended Kalman filter on them.

States are (9, n): position [m], velocity [m/s], spin [rad/s] in the table frame. Midpoint steps; a bounce is that of a
thin shell on the table (``ballmodel.contact``). No code is shared with the simulation, which tests compare it with.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ballmodel.constants import BALL_RADIUS, GRAVITY, TABLE_LENGTH, TABLE_WIDTH

STEP = 0.004  # [s] of an integration
DRAG, LIFT = 0.125, 0.0033  # [1/m], []: C_d 0.42 and k 0.55 at 1.2 kg/m^3
RESTITUTION, FRICTION = 0.92, 0.22
DIFFERENCE = np.array([1e-4] * 3 + [1e-3] * 3 + [0.1] * 3)
AROUND = np.concatenate([np.zeros((9, 1)), np.diag(DIFFERENCE)], axis=1)

States = Float[np.ndarray, "9 n"]


@dataclass(frozen=True)
class Physics:
    """What the flight is made of, and how much of it is not known.

    drag, lift             K_d [1/m] and K_m of ``ballmodel.aerodynamics``
    restitution, friction  of the table
    wander                 [m/s^2 sqrt(s)] density of the acceleration that is not known
    bounced                deviations that a bounce adds to velocity across and along the table, velocity upwards [m/s],
                           spin [rad/s]
    """

    drag: float = DRAG
    lift: float = LIFT
    restitution: float = RESTITUTION
    friction: float = FRICTION
    wander: float = 2.0
    bounced: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass
class Kalman:
    """An extended Kalman filter of one ball.

    mean        (9,) of the state
    covariance  (9, 9)
    """

    mean: np.ndarray
    covariance: np.ndarray
    physics: Physics = Physics()

    def predict(self, seconds: float) -> None:
        """Moves on by some seconds, not negative."""
        p = self.physics
        moved, bounced = _move(self.mean[:, None] + AROUND, seconds, p, together=True)
        slope = (moved[:, 1:] - moved[:, :1]) / DIFFERENCE
        self.mean, self.covariance = moved[:, 0], slope @ self.covariance @ slope.T
        across, along = p.wander**2 * seconds**3 / 3, p.wander**2 * seconds
        extra = np.array([across] * 3 + [along] * 3 + [0.0] * 3)
        if bounced[0]:
            level, up, spin = p.bounced
            extra[3:] += np.array([level, level, up, spin, spin, spin]) ** 2
        self.covariance[np.diag_indices(9)] += extra

    def correct(self, residual: np.ndarray, slope: np.ndarray, noise: np.ndarray) -> None:
        """Takes a measurement: measured less expected (m,), d expected / d state (m, 9), covariance of the noise."""
        across = self.covariance @ slope.T
        gain = np.linalg.solve(slope @ across + noise, across.T).T
        self.mean = self.mean + gain @ residual
        covariance = self.covariance - gain @ across.T
        self.covariance = 0.5 * (covariance + covariance.T)


def move(states: States, seconds: float | Float[np.ndarray, " n"], physics: Physics) -> States:
    """States after some seconds, one number or one for each."""
    return _move(states, seconds, physics, together=False)[0]


def _move(
    states: States, seconds: float | Float[np.ndarray, " n"], physics: Physics, together: bool
) -> tuple[States, np.ndarray]:
    """States, and which of them bounced; ``together``: all when the first does, so that slopes are smooth."""
    count = max(int(np.ceil(np.max(seconds) / STEP - 1e-6)), 1)
    dt = np.asarray(seconds) / count
    bounced = np.zeros(states.shape[1], bool)
    for _ in range(count):
        after = _step(states, dt, physics)
        meets = _meets(states, after)
        if together:
            meets[:] = meets[0]
        if meets.any():
            after = np.where(meets, _bounce(states, after, dt, physics), after)
            bounced |= meets
        states = after
    return states, bounced


def _step(states: States, dt: np.ndarray | float, physics: Physics) -> States:
    velocity, spin = states[3:6], states[6:]
    middle = velocity + 0.5 * dt * accelerate(velocity, spin, physics)
    after = np.empty(np.broadcast_shapes(states.shape, np.shape(dt)))
    after[:3], after[6:] = states[:3] + dt * middle, spin
    after[3:6] = velocity + dt * accelerate(middle, spin, physics)
    return after


def accelerate(velocity: np.ndarray, spin: np.ndarray, physics: Physics) -> np.ndarray:
    """Acceleration (3, n) [m/s^2] of balls with velocity and spin (3, n)."""
    (x, y, z), (a, b, c) = velocity, spin
    drag = -physics.drag * np.sqrt(x * x + y * y + z * z)
    out = drag * velocity
    out[0] += physics.lift * (b * z - c * y)
    out[1] += physics.lift * (c * x - a * z)
    out[2] += physics.lift * (a * y - b * x) - GRAVITY
    return out


def _meets(before: States, after: States) -> np.ndarray:
    over = (np.abs(after[0]) < TABLE_WIDTH / 2) & (np.abs(after[1]) < TABLE_LENGTH / 2)
    return over & (before[2] > BALL_RADIUS) & (after[2] <= BALL_RADIUS)


def _bounce(before: States, after: States, dt: np.ndarray | float, physics: Physics) -> States:
    """The states after a step in which the table is met; a share beyond the step is as good, for slopes."""
    fallen = before[2] - after[2]
    share = (before[2] - BALL_RADIUS) / np.where(np.abs(fallen) > 1e-9, fallen, 1e-9)
    at = _step(before, share * dt, physics)
    at[2] = BALL_RADIUS
    slip = np.stack([at[3] - BALL_RADIUS * at[7], at[4] + BALL_RADIUS * at[6]])
    speed = np.sqrt((slip * slip).sum(axis=0)) + 1e-12
    change = -np.minimum(physics.friction * (1.0 + physics.restitution) * np.abs(at[5]) / speed, 0.4) * slip
    at[3:5] += change
    at[5] *= -physics.restitution
    # The impulse acts a radius below the centre of a thin shell, I = 2/3 m r^2.
    at[6] += 1.5 / BALL_RADIUS * change[1]
    at[7] -= 1.5 / BALL_RADIUS * change[0]
    return _step(at, (1.0 - share) * dt, physics)
