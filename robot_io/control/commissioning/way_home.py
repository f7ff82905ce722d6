"""The way to the home pose: each joint by itself as long as the gate lets it, else by a place from where it is clear.

Where the gate holds the robot because something would come too near, straight ways in joint space are looked for, one
candidate a control period: home at once, by a place where the robot has just been, away from what is near and then
home, and at last back along the way that it came until the rest is clear. All of a way is checked by the gate's
geometry before it is begun, with more room than the gate keeps where there is some; and every command still passes the
gate, which also knows how far the joints run on while they brake. Where it holds again, the next way is gone slower.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from robot_io.control.commissioning.homing import towards
from robot_io.limits import JointLimits
from robot_io.safety.config import SLACK
from robot_io.safety.gate import SafetyGate, Sent

ROOMS = (0.03, 2.0 * SLACK)  # [m] beyond the gate's margins that a way keeps, in the order that is tried
POINTS = 9  # of a straight way at which gaps are looked at first
SPACING = 0.03  # [m], [rad] between two places of the trail
LONGEST_TRAIL = 400  # places; a longer one keeps every second
BACK = (2, 4, 8, 16, 32, 64, 128, 256, LONGEST_TRAIL)  # places of the trail that are tried, from the newest back
LIFTS, LIFT, LARGEST = 5, 0.05, 0.3  # steps away from what is nearest, [m] of each, [m], [rad] of a joint in one
TINY = 1e-6  # [m], [rad] of a finite difference
THERE, BY = 2e-3, 0.02  # [m], [rad] from a place that counts as reached, and as passed on the way back
ARRIVED = 1e-4  # [m], [rad]
STUCK = 1e-3  # [m/s], [rad/s] below which the gate holds the robot
SLOWER, SLOWEST = 0.5, 0.1  # share of the pace after each failure, and the least
RAMP = 0.9  # share of the acceleration limits

Way = list[tuple[np.ndarray, float]]  # places (n,) and how near to come to each


class WayHome:
    """From wherever the robot is to a target, in steps of one control period.

    gate     its geometry and margins are kept; nothing is asked of it
    scale    by which the gate multiplies what is asked for here, where the last bit of a way is to be gone as fast
    limits   of the joints; speed, braking: (n,) on the way [m/s], [m/s^2], [rad/s], [rad/s^2]
    problem  the reason why there is no way, empty otherwise
    """

    def __init__(
        self, gate: SafetyGate, limits: JointLimits, speed: np.ndarray, braking: np.ndarray, scale: float = 1.0
    ) -> None:
        self.problem = ""
        self._gate, self._geometry, self._margin = gate, gate.geometry, gate.margins
        self.speed, self._braking, self._scale = speed, braking, scale
        self._step = RAMP * np.array(limits.acceleration) * gate.period
        room = np.maximum(limits.margin, gate.config.overshoot)
        self._low, self._high = np.array(limits.lower) + room, np.array(limits.upper) - room
        self._trail: list[np.ndarray] = []  # places since the target, oldest first; each was proven clear
        self._search: Iterator[Way | None] | None = None
        self._way: Way = []
        self._pace = 1.0

    def restart(self) -> None:
        """Forget where the robot was: it may have been moved by others."""
        self._trail = []
        self.give_up()

    def give_up(self) -> None:
        """Forget the way that was found: something else is done now."""
        self._search, self._way, self._pace, self.problem = None, [], 1.0, ""

    def velocity(self, target: np.ndarray) -> np.ndarray:
        """Velocity (n,) to ask for in this period on the way to a target (n,)."""
        at = self._gate.reference
        if self._search is not None:
            self._look()
            return np.zeros_like(at)
        while self._way:
            place, near = self._way[0]
            if np.abs(place - at).max() < near:
                self._way.pop(0)
            else:
                return self._straight(place - at)
        scale = self._scale
        return towards(target, at, scale * self.speed, self._braking, self._gate.period) / scale

    def sent(self, request: np.ndarray, sent: Sent, target: np.ndarray, homeward: bool) -> bool:
        """Take what became of a request; ``homeward``: it was one of ours. True where another way is looked for now."""
        self._remember(sent.position, target)
        held = request.any() and np.abs(sent.velocity).max() < STUCK and "clearance" in sent.changed
        if not (homeward and held) or self._search is not None or self.problem:
            return False
        if self._way:
            self._pace *= SLOWER
        self._way, self._search = [], self._candidates(sent.position, target)
        return True

    def _look(self) -> None:
        """One candidate."""
        way = next(self._search, None) if self._search is not None and self._pace >= SLOWEST else None
        if way is None:
            self._search = None
            self.problem = "the gate holds the robot, and no clear way to its home pose was found: jog it away"
        elif way:
            self._search, self._way = None, way

    def _candidates(self, at: np.ndarray, target: np.ndarray) -> Iterator[Way]:
        """The way for each candidate that is clear, an empty one for each that is not."""
        trail = [self._trail[-back] if back <= len(self._trail) else None for back in BACK]
        places = [place for place in (*trail, *self._trail[:1]) if place is not None]
        for room in ROOMS:
            yield [(target, ARRIVED)] if self._clear(room, at, target) else []
            for place in (*places, *self._away(at)):
                clear = self._clear(room, at, place) and self._clear(room, place, target)
                yield [(place, THERE), (target, ARRIVED)] if clear else []
        for back in range(1, len(self._trail) + 1):  # every stretch was gone before
            came, place = self._trail[-1 : -1 - back : -1], self._trail[-back]
            last = back == len(self._trail)
            if last or back in BACK:
                clear = self._clear(ROOMS[-1], place, target)
                yield [*((passed, BY) for passed in came), (target, ARRIVED)] if clear else []

    def _away(self, at: np.ndarray) -> Iterator[np.ndarray]:
        """Places (n,) farther and farther from what is nearest, each by LIFT more, inside the joints' ranges."""
        beside = TINY * np.concatenate([np.zeros((at.size, 1)), np.eye(at.size)], axis=1)
        for _ in range(LIFTS):
            gaps = self._geometry.gaps(at[:, None] + beside)
            row = gaps[int((gaps[:, 0] - self._margin).argmin())]
            slope = (row[1:] - row[0]) / TINY
            steepness = slope @ slope
            if steepness < TINY:
                return
            step = LIFT * slope / steepness
            step *= min(1.0, LARGEST / np.abs(step).max())
            at = np.clip(at + step, np.minimum(self._low, at), np.maximum(self._high, at))
            yield at

    def _clear(self, room: float, start: np.ndarray, end: np.ndarray) -> bool:
        way = start[:, None] + (end - start)[:, None] * np.linspace(0.0, 1.0, POINTS)
        return self._geometry.first_too_close(way, self._margin + room, SLACK) is None

    def _straight(self, way: np.ndarray) -> np.ndarray:
        """Velocity (n,) along a straight way (n,) in joint space, such that the braking suffices to stop at its end."""
        distance, period = np.abs(way), self._gate.period
        wanted = np.minimum(self._pace * self.speed, np.sqrt(2.0 * self._braking * distance))
        wanted = np.minimum(wanted, distance / (3.0 * period))
        wanted = np.minimum(wanted, np.abs(self._gate.velocity) + self._step)
        moved = distance > 0.0
        return way * (wanted[moved] / distance[moved]).min()

    def _remember(self, place: np.ndarray, target: np.ndarray) -> None:
        """Add a place (n,) to the trail; one that closes a loop takes the loop out, the target takes all."""
        if not np.isfinite(place).all():
            return
        if np.abs(place - target).max() < SPACING:
            self._trail = [place]
            return
        if self._trail and np.abs(place - self._trail[-1]).max() < SPACING:
            return
        if len(self._trail) > 1:
            near = np.flatnonzero((np.abs(np.array(self._trail[:-1]) - place) < 0.5 * SPACING).all(axis=1))
            if near.size:
                del self._trail[int(near[0]) + 1 :]
                return
        self._trail.append(place)
        if len(self._trail) > LONGEST_TRAIL:
            self._trail = self._trail[::2]
