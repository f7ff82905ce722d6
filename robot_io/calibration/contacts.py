"""Contacts of ball and paddle in a session's log: what ties the tracker's clock and frame to the robot's.

At a contact the ball's surface is on the blade. Where the ball's track turns is known to about a millisecond by itself;
the joints' log says where the blade was some lag later. The lag is that at which half of the contacts leave a gap and
half overlap. It is one number for several errors: the arm's own delay of feedback, a clock that is off, and, by the
blade's speed of some 2 m/s, a ball or a robot that is not where it is said to be.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ballmodel.constants import BALL_RADIUS, GRAVITY, PADDLE_RADIUS, PADDLE_THICKNESS
from robot_io.calibrated import Calibration
from robot_io.log import LogError, SessionLog
from robot_io.safety.clearance import RobotGeometry

SIDE = 4  # samples before and after the turn
TURN = 2.0  # [m/s] by which v_y changes at least
LONGEST = 0.012  # [s] between two samples around it
REACH = BALL_RADIUS + PADDLE_THICKNESS / 2  # [m] from the blade's middle plane to the ball's centre
LAGS = np.arange(-0.03, 0.1001, 0.005)  # [s] that are tried
EDGE = 0.03  # [m] beyond the blade's edge where a contact can still seem to be
STEP = 0.004  # [s] over which the blade's speed is taken
SLOWEST = 0.5  # [m/s] of the blade along its normal, below which a contact tells no time
FEWEST = 8


@dataclass(frozen=True)
class Contacts:
    """Of one session.

    count  contacts that could be used
    lag    [s] by which joint positions are logged later than the ball, NaN for too few; lag_deviation [s]
    spread [m] of the gaps between ball and blade that are left then, a robust standard deviation
    """

    count: int
    lag: float
    lag_deviation: float
    spread: float


def measure(log: SessionLog, calibration: Calibration) -> Contacts:
    """Contacts of a log, with the robot where its calibration says.

    Raises LogError where the robot's blade has no two capsules across each other, whose plane is the blade's.
    """
    geometry = RobotGeometry.of(log.robot).moved(calibration.robot.base)
    blade, across = geometry.blade, geometry.normal
    if np.linalg.norm(across) < 0.5:
        raise LogError(f"{log.path}: no two capsules of {log.robot.robot}'s blade cross; its plane is not known")
    found = [turn for ball in np.unique(log.ball.id) for turn in _turns(log, log.ball.id == ball)]
    time, position = log.joints.time, log.joints.position
    known = np.isfinite(position).all(0)
    time, position = time[known], position[:, known]
    if len(found) < FEWEST or time.size < 2:
        return Contacts(len(found), math.nan, math.nan, math.nan)
    moments, places, before = (np.array(column) for column in zip(*found, strict=True))

    def gaps(lag: float) -> np.ndarray:
        """Gap (n,) [m] at every contact, negative where the blade moves away; NaN beside it or where it rests."""
        hand, later = (
            geometry.hand(np.array([np.interp(moments + lag + dt, time, joint) for joint in position]))
            for dt in (0.0, STEP)
        )
        centre = hand[:, :3, :3] @ blade + hand[:, :3, 3]
        normal = np.asfortranarray(hand[:, :3, :3] @ across)  # the layout decides how einsum rounds
        away = places - centre
        side = np.sign(np.einsum("ni,ni->n", before - places, normal))
        along = np.einsum("ni,ni->n", away, normal)
        beside = np.linalg.norm(away - along[:, None] * normal, axis=1)
        speed = side * np.einsum("ni,ni->n", later[:, :3, :3] @ blade + later[:, :3, 3] - centre, normal) / STEP
        gap = np.sign(speed) * (side * along - REACH)
        return np.where((beside < PADDLE_RADIUS + EDGE) & (np.abs(speed) > SLOWEST), gap, np.nan)

    tried = np.array([gaps(lag) for lag in LAGS])
    known_there = np.isfinite(tried).sum(1)
    middle = np.where(known_there >= FEWEST, np.nanmedian(np.where(known_there[:, None], tried, 0.0), axis=1), np.nan)
    crossing = np.flatnonzero((middle[:-1] > 0.0) & (middle[1:] <= 0.0))
    if not crossing.size:
        return Contacts(int(known_there.max()), math.nan, math.nan, math.nan)
    i = int(crossing[0])
    slope = (middle[i + 1] - middle[i]) / (LAGS[i + 1] - LAGS[i])
    lag = float(LAGS[i] - middle[i] / slope)
    left = gaps(lag)
    left = left[np.isfinite(left)]
    spread = 1.4826 * float(np.median(np.abs(left - np.median(left))))
    return Contacts(left.size, lag, 1.2533 * spread / math.sqrt(left.size) / abs(float(slope)), spread)


def _turns(log: SessionLog, mine: np.ndarray) -> list[tuple[float, np.ndarray, np.ndarray]]:
    """Moment, place and a place before it, of every turn on the robot's side in one ball's track."""
    order = np.argsort(log.ball.capture_time[mine], kind="stable")
    t, p = log.ball.capture_time[mine][order], log.ball.position[:, mine][:, order]
    found: list[tuple[float, np.ndarray, np.ndarray]] = []
    turn = np.full(len(t) + 1, -math.inf)
    for i in range(SIDE, len(t) - SIDE + 1):
        if p[1, i - 1] < -0.3 and np.diff(t[i - SIDE : i + SIDE]).max() <= LONGEST:
            v, w = (np.polyfit(t[s] - t[i - 1], p[1, s], 1)[0] for s in (slice(i - SIDE, i), slice(i, i + SIDE)))
            turn[i] = w - v if v < 0.0 < w else -math.inf
    for i in np.flatnonzero(turn > TURN).tolist():
        if turn[i] < turn[max(i - SIDE, 0) : i + SIDE].max():
            continue  # a sample beside the contact is taken for one of the other side
        a, b = (_line(t[s], p[:, s], t[i]) for s in (slice(i - SIDE, i), slice(i, i + SIDE)))
        since = float((a[0, 1] - b[0, 1]) / (b[1, 1] - a[1, 1]))
        place = a[0] + a[1] * since - np.array([0.0, 0.0, 0.5 * GRAVITY]) * since**2
        found.append((float(t[i]) + since, place, p[:, i - SIDE]))
    return found


def _line(t: np.ndarray, p: np.ndarray, at: float) -> np.ndarray:
    """(2, 3) place and velocity at a moment by a parabola through samples (3, n)."""
    u = t - at
    x = p + 0.5 * GRAVITY * np.outer([0.0, 0.0, 1.0], u**2)
    return np.linalg.lstsq(np.stack([np.ones_like(u), u], axis=1), x.T, rcond=None)[0]
