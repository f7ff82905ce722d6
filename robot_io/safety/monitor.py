"""Checks of measured positions and velocities: are they numbers, within limits, clear, and where the robot was sent."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import ArrayLike

from robot_io.limits import JointLimits
from robot_io.safety.clearance import RobotGeometry
from robot_io.safety.config import SafetyConfig
from robot_io.safety.faults import Cause

EXACT = 0.002  # [m], [rad] by which a robot may go beside its reference unnoticed
FORGOTTEN = 1.0  # [s] in which a controller takes a deviation away: EGM's position correction with gain 1
WORSE = 1.5  # times the deviations seen: the next one may be larger than all of them
# [m/s], [rad/s] that a measured speed may exceed its scaled limit by, however low that is: noise, and the position
# corrections of axes and arm, which no scale lowers.
UNSCALED = {"m": 0.3, "rad": 0.5}
EARLY = 0.1  # [s] by which a measurement may be looked at before the end of the newest period


class FeedbackMonitor:
    """Compares measurements with limits, geometry and the references that were sent.

    limits  unscaled: those of the speed are scaled here, as the commands are
    """

    def __init__(self, limits: JointLimits, geometry: RobotGeometry, config: SafetyConfig) -> None:
        self._lower, self._upper = np.array(limits.lower), np.array(limits.upper)
        fastest = config.overspeed * np.array(limits.velocity)
        floor = np.array([UNSCALED[unit] for unit in geometry.units])
        self._fastest = np.minimum(fastest, config.speed_scale * fastest + floor)
        self._geometry, self._config = geometry, config
        self._joints, self._units = geometry.joints, geometry.units
        self._tolerance = np.array(config.following_error)
        self._past: deque[tuple[float, np.ndarray]] = deque()  # times and references at the ends of periods
        self._low = self._high = np.zeros(len(limits.joints))  # of the references in the window
        self.reach = self._low, self._high  # between which a joint may be, for all that is known
        self._off = 0  # measurements in a row with a following error
        self._beside: deque[tuple[float, np.ndarray]] = deque()  # times and deviations

    def restart(self, position: np.ndarray, now: float) -> None:
        """The reference (8,) has been here until now."""
        self._past, self._off = deque([(now, position)]), 0
        self._beside.clear()

    def sent(self, reference: np.ndarray, time: float) -> None:
        """The reference (8,) will be here at ``time``, on a straight way from the one before."""
        self._past.append((time, reference))
        self._forget(time - self._config.delay - EARLY)

    def past(self, now: float, span: float) -> tuple[np.ndarray, np.ndarray]:
        """Times (N,) and references (8, N) of the last ``span`` seconds before ``now``, and the one before them."""
        earlier = [(time, reference) for time, reference in self._past if time < now]
        first = next((i for i, (time, _) in enumerate(earlier) if time > now - span), len(earlier))
        kept = earlier[max(first - 1, 0) :]
        return np.array([time for time, _ in kept]), np.array([r for _, r in kept]).reshape(-1, len(self._joints)).T

    def conditions(self, position: np.ndarray, velocity: np.ndarray) -> dict[Cause, str]:
        """Faults of a measurement of finite numbers, each (8,); an empty sentence: nothing."""
        return {Cause.LIMIT: self._limit(position, velocity), Cause.CLEARANCE: self.contact(position)}

    def contact(self, position: np.ndarray) -> str:
        """Contact at a position (8,), as a sentence; empty: nothing."""
        with np.errstate(all="ignore"):  # of numbers that no robot can measure
            gaps = self._geometry.gaps(position[:, None])[:, 0]
        row = int(gaps.argmin())
        return "" if gaps[row] > 0.0 else f"{self._geometry.rows[row]}: {gaps[row]:.4f} m"

    def unexplained(self, position: np.ndarray, now: float) -> np.ndarray:
        """Distance (8,) of the measured position from every place where the reference was during the longest delay.

        Zero or less: the commands that are under way explain the position.
        """
        self._forget(now - self._config.delay)
        seen = [r for i, (_, r) in enumerate(self._past) if i == 0 or self._past[i - 1][0] < now]
        self._low, self._high = np.min(seen, axis=0), np.max(seen, axis=0)
        self.reach = np.minimum(self._low, position), np.maximum(self._high, position)
        return np.maximum(self._low - position, position - self._high)

    def deviation(self, position: np.ndarray, now: float) -> np.ndarray:
        """Vector (8,) from the nearest place in the window of ``unexplained`` to the position; zero below EXACT."""
        found = position - np.clip(position, self._low, self._high)
        found = np.where(np.abs(found) > EXACT, found, 0.0)
        while self._beside and self._beside[0][0] < now - FORGOTTEN:
            self._beside.popleft()
        if found.any():
            self._beside.append((now, found))
        return found

    @property
    def beside(self) -> np.ndarray:
        """Deviations (8, K) of the last ``FORGOTTEN`` seconds times ``WORSE``: where a noisy robot may be next."""
        return WORSE * np.array([found for _, found in self._beside]).reshape(-1, len(self._joints)).T

    def offset(self, deviation: np.ndarray, before: np.ndarray, period: float) -> np.ndarray:
        """Distance (8,) by which the robot is taken to go beside its reference: ``deviation``, while it can be told.

        Behind a reference that moves a deviation hides in the window; the one ``before`` is kept then, and forgotten in
        the time in which a controller takes it away.
        """
        kept = before * np.exp(-period / FORGOTTEN)
        told = (self._high - self._low < EXACT) | (np.abs(deviation) > np.abs(kept))
        return np.where(told, deviation, kept)

    def following_error(self, error: np.ndarray) -> str:
        """Following error over the actuation-delay window as a sentence; empty: none. error (8,): ``unexplained``."""
        self._off = self._off + 1 if (error > self._tolerance).any() else 0
        if self._off < self._config.following_ticks:
            return ""
        return f"away from the reference: {worst(self._geometry, np.maximum(error, 0.0), self._tolerance)}"

    def _forget(self, time: float) -> None:
        while len(self._past) > 1 and self._past[1][0] <= time:
            self._past.popleft()

    def _limit(self, position: np.ndarray, velocity: np.ndarray) -> str:
        outside = np.maximum(self._lower - position, position - self._upper)
        if (outside > 0.0).any():
            i = int(outside.argmax())
            allowed = f"[{self._lower[i]:.4f}, {self._upper[i]:.4f}]"
            return f"{self._joints[i]} is at {position[i]:.4f} {self._units[i]}, its range is {allowed}"
        if (np.abs(velocity) > self._fastest).any():
            return f"measured speed: {worst(self._geometry, velocity, self._fastest, '/s')}"
        return ""


def numbers_of(
    joints: tuple[str, ...], values: ArrayLike, what: str, normal: bool = False
) -> tuple[np.ndarray | None, str]:
    """A finite float64 number for each joint, and what is wrong instead; None where they are not as many numbers.

    normal: subnormal numbers are wrong too. No motion is that slow: bytes that were taken for numbers often look so.
    """
    try:
        given = np.asarray(values)
    except Exception as error:  # whatever an array-like object does when it is converted
        return None, f"{what} is not an array: {error}"
    if given.shape != (len(joints),) or given.dtype.kind not in "fiu":
        return None, f"{what} is {given.dtype} {given.shape}, needed are {len(joints)} real numbers"
    numbers = given.astype(np.float64)
    for i in np.flatnonzero(~np.isfinite(numbers)):
        return numbers, f"{what}: {joints[i]} is {numbers[i]}"
    tiny = np.finfo(given.dtype if given.dtype.kind == "f" else np.float64).tiny if normal else 0.0
    for i in np.flatnonzero((numbers != 0.0) & (np.abs(numbers) < tiny)):
        return numbers, f"{what}: {joints[i]} is {numbers[i]}, a subnormal number"
    return numbers, ""


def worst(geometry: RobotGeometry, values: np.ndarray, bound: np.ndarray, per: str = "") -> str:
    """Names the joint that exceeds its bound the most; all (n,)."""
    i = int(np.argmax(np.abs(values) / bound))
    return f"{geometry.joints[i]} {values[i]:.4g}, allowed is {bound[i]:.4g} {geometry.units[i]}{per}"
