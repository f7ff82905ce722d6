"""Where a robot may go whose next commands are late, whose drives are, or to which nobody speaks any more.

Ways are positions (n, N) of its joints, straight between each other; every point of one must be clear. They begin with
a way of braking: references at the ends of control periods, one at a new velocity and braking after it.
"""

from __future__ import annotations

import numpy as np

from robot_io.safety.clearance import RobotGeometry
from robot_io.safety.config import SafetyConfig

AIM = 0.001  # [m] by which a slower velocity is to keep more than the gap that it must
LONGEST = 2.0  # [s] for which a velocity is taken to last, at most
NEAR = 1e-4  # [m], [rad] between two places of which the gaps are compared
BRAKED = np.array([0.0, 0.5, 1.0])  # shares of the time that braking takes at which its way is examined


def leads(config: SafetyConfig, units: tuple[str, ...]) -> np.ndarray:
    """Times (2, n) [s] by which joints may be ahead of the slowest one: linear axes late and the arm early, and the
    other way round."""
    apart = np.where([unit == "m" for unit in units], config.drive_delay_error, -config.drive_delay_error)
    delays = np.maximum(np.array(config.drive_delay) + np.stack([apart, -apart]), 0.0)
    return delays.max(axis=1, keepdims=True) - delays


def between(way: np.ndarray, late: np.ndarray) -> np.ndarray:
    """References (n, M) along the first of two ways (n, N) from one place, back along the second and across each rung:
    a tick that is a little late leads to a place on a rung."""
    rungs = np.stack([late, way, late], axis=2)[:, -2:0:-1].reshape(len(way), -1)
    return np.concatenate([way, late[:, -1:], rungs, way[:, :1]], axis=1)


def delayed(
    way: np.ndarray,
    late: np.ndarray,
    past: tuple[np.ndarray, np.ndarray],
    now: float,
    period: float,
    latest: float,
    leads: np.ndarray,
) -> np.ndarray:
    """Where the robot itself goes, (n, M), while its drives follow two ways (n, N) of references with their delays.

    Along the first way and back along the second, with the delays as far apart as they may be, either way. past: times
    (P,) and references (n, P) before ``now``. The first way's next tick comes after ``period``, the second's after
    ``latest``.
    """
    before, passed = past
    braking = period * np.arange(way.shape[1] - 1)
    ways = []
    for lead in leads:
        for gap, references in ((period, way), (latest, late)):
            times = np.concatenate([before, [now], now + gap + braking])
            values = np.concatenate([passed, references], axis=1)
            there = np.array([np.interp(times + a, times, row) for a, row in zip(lead, values, strict=True)])
            ways.append(there if references is way else there[:, ::-1])
    return np.concatenate(ways, axis=1)


def blocked(way: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Where the robot goes, (n, M), while one of its joints, each in turn, stands still and the others go a way (n, N).

    low, high: (n,) between which a joint may stand unnoticed.
    """
    parts = [way[:, :1]]
    for joint in range(len(way)):
        there, back = way.copy(), way[:, ::-1].copy()
        there[joint], back[joint] = low[joint], high[joint]
        parts += [there, back, way[:, :1]]
    return np.concatenate(parts, axis=1)


def slow_down(
    geometry: RobotGeometry,
    reference: np.ndarray,
    velocity: np.ndarray,
    braked: np.ndarray,
    places: np.ndarray,
    least: np.ndarray,
) -> np.ndarray:
    """A velocity (n,) from a reference (n,), between ``velocity`` and ``braked``, that leads to wider gaps.

    Only the joints brake that lead to the worst of the places (n, N), so far that it keeps gaps of ``least`` (R,), and
    those more that matter more there; the others may go on. To first order: the caller has to prove it anew.
    """
    gaps = geometry.gaps(places) - least[:, None]
    row, worst = np.unravel_index(gaps.argmin(), gaps.shape)
    place = places[:, worst]
    around = geometry.gaps(place[:, None] + np.column_stack([np.zeros_like(place), NEAR * np.eye(len(place))]))
    slope = (around[row, 1:] - around[row, 0]) / NEAR
    # [s] of motion at ``velocity``; a place may lie off for other reasons, which no velocity explains.
    lasts = np.clip((place - reference) / np.where(velocity == 0.0, np.inf, velocity), 0.0, LONGEST)
    gain = np.maximum(-slope * lasts * (velocity - braked), 0.0)  # [m] of gap, if a joint brakes wholly
    wanted = max(0.0, -float(gaps[row, worst])) + AIM
    if gain.sum() < AIM:
        share = np.full_like(gain, 0.5)
    elif gain.sum() < wanted:
        share = (gain > 0.0).astype(float)
    else:
        share = gain * min(wanted / float(gain @ gain), 1.0 / float(gain.max()))
    return velocity - share * (velocity - braked)


class Silence:
    """Each device goes on with its last command until its own time-out, or until the computer speaks again.

    The arm's controller keeps the speed until EGM's CommTimeout, and brakes then. A linear axis runs on for the lead of
    its target, and brakes there. Silence may begin at any period of a way of braking: from each it leads elsewhere.

    ahead         (M, n) [s] by which each joint may be ahead of the slowest one of the arm
    acceleration  (n,) by which each joint brakes
    """

    def __init__(self, config: SafetyConfig, ahead: np.ndarray, acceleration: np.ndarray) -> None:
        self._acceleration = acceleration[:, None, None, None]
        self._ends = (np.array(config.silence) + config.late)[:, None, None, None]  # of what a last tick has asked for
        self._ahead = ahead[:, :, None, None, None]
        first, last = float(self._ends.min()), float(self._ends.max())
        # When the computer speaks again, if it does: where a joint brakes by itself, and where the axes may stand.
        self._gaps = np.unique(np.minimum([0.0, first, 2.0 * first, 3.0 * first, last], last))[:, None]

    def ways(self, starts: np.ndarray, speeds: np.ndarray) -> np.ndarray:
        """Positions (n, N) to which silence may lead from places (n, K) at speeds (n, K)."""
        starts = starts[:, :, None, None]
        mesh = starts + self._moved(speeds[:, :, None, None])  # (M, n, K, gaps, BRAKED)
        # Along every line of the mesh: up one and down the next, first one way, then the other, from where it begins.
        over, along = mesh.copy(), mesh.swapaxes(3, 4).copy()
        for lines in (over, along):
            lines[..., 1::2, :] = lines[..., 1::2, ::-1]
        over, along = (lines.reshape(*mesh.shape[:3], -1) for lines in (over, along))
        begin = np.broadcast_to(starts[..., 0], (*mesh.shape[:3], 1))
        found = np.concatenate([begin, over, along[..., ::-1], begin], axis=3)
        return found.swapaxes(0, 1).reshape(len(speeds), -1)

    def _moved(self, speed: np.ndarray) -> np.ndarray:
        """Displacements (M, n, K, gaps, BRAKED) of joints that go on at ``speed`` (n, K, 1, 1) and then brake."""
        takes = np.abs(speed) / self._acceleration
        told = takes.max(axis=0) * BRAKED  # [s] since they were told to brake; at 0 they have not heard of it
        going = np.where(BRAKED > 0.0, np.minimum(self._gaps, self._ends), self._ends)
        time = self._gaps + told + self._ahead
        braking = np.clip(time - going, 0.0, takes)
        return speed * (np.minimum(going, time) + braking) - 0.5 * np.sign(speed) * self._acceleration * braking**2
