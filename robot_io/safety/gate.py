"""The gate that every velocity command passes last on its way to the robot, once per control period.

Concepts, proofs and limits: docs/concepts/safety.md.

The gate keeps a reference: the joint positions that its commands add up to. What it has accepted so far can always be
braked: from the reference and the last velocity every joint, slowing down at its acceleration limit, comes to rest
inside its range, and the robot on its way keeps its margins to table, floor and itself. A request is accepted only when
the same holds after it; otherwise the gate brakes, along the way that was proven before. Any doubt means the same:
brake, hold, and remember why.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike

from robot_io.contract import CONTROL_RATE
from robot_io.errors import JogFirstError, RefusedError, format_error
from robot_io.limits import LIMITS, JointLimits, limit_velocity
from robot_io.safety.clearance import RobotGeometry
from robot_io.safety.coasting import Coasting
from robot_io.safety.config import SLACK
from robot_io.safety.config import SafetyConfig as SafetyConfig
from robot_io.safety.faults import Cause, Fault, FaultLatch
from robot_io.safety.monitor import FeedbackMonitor, numbers_of, worst
from robot_io.safety.stopping import StopReference
from robot_io.safety.ways import Silence, between, blocked, delayed, leads, slow_down

TRIES = 3  # velocities that are examined before the gate brakes
HALVINGS = 5  # of the way from braking to the limited request, in search of what keeps the blade's limits
TOUCH = 0.01  # [m] smallest gap of the way that lies beside the reference by the measured deviation
STRIDE = 2  # periods between two places of a way beside which a joint may be blocked
INSIDE = 1e-6  # [m] by which a gap must miss its margin to count as inside: more than rounding
ROUNDING = 1e-9  # of each limit, allowed in the check of our own results
LONGEST_LEAD = 3.0  # control periods that commands may come ahead of the clock


class GateState(Enum):
    """State of the safety gate."""

    DISARMED = "disarmed"  # nothing moves; the reference is the measured position
    ARMED = "armed"  # requests pass as far as they are safe
    STOPPING = "stopping"  # slowing down to rest, then holding
    FAULT = "fault"  # as stopping, until the operator resets the faults


@dataclass(frozen=True)
class Sent:
    """Command that the gate lets pass; the only thing that may be sent to the robot.

    velocity  (8,) for the coming control period [m/s], [rad/s]
    position  (8,) reference at that period's end [m], [rad]; NaN while no finite position was ever measured
    changed   names of the rules that changed the request, in order: speed_scale, escape, velocity, acceleration,
              position, blade_speed, blade_acceleration or clearance, or the state's name when it is not armed; empty:
              sent as requested
    state     after this command
    """

    velocity: np.ndarray
    position: np.ndarray
    changed: tuple[str, ...]
    state: GateState


class SafetyGate:
    """One robot's gate. Times are seconds of one monotonic clock, passed in by the caller.

    limits    kinematic limits; the simulation's
    period    control period [s]
    geometry  the robot's, None: the shipped one
    """

    def __init__(
        self,
        limits: JointLimits = LIMITS,
        period: float = 1.0 / CONTROL_RATE,
        geometry: RobotGeometry | None = None,
        config: SafetyConfig | None = None,
    ) -> None:
        self.config = config = config or SafetyConfig()
        if not 0.0 < period <= config.late:
            raise ValueError(f"period is {period} s, expected more than 0 s and at most late, {config.late} s")
        self.geometry = geometry or RobotGeometry.load()
        n, joints = len(limits.joints), self.geometry.joints
        if joints != limits.joints or len(config.still) != n:
            raise ValueError(
                f"the limits are of {limits.joints}, the geometry of {joints}, the safety settings of "
                f"{len(config.still)} joints: they must be one robot's"
            )
        self.period = period
        velocity = tuple(config.speed_scale * config.head_room * v for v in limits.velocity)
        asked = (min(config.speed_scale * p, v) for p, v in zip(limits.policy_velocity, velocity, strict=True))
        self.limits = replace(limits, velocity=velocity, policy_velocity=tuple(asked))
        self._v_max, self._a = np.array(self.limits.velocity), np.array(limits.acceleration)
        self._step = self._a * period
        # Beyond the limiter's own margin by this the limiter still leads back within a period or two.
        outside = np.array(limits.margin) - 0.25 * self._step * period
        self._low, self._high = np.array(limits.lower) + outside, np.array(limits.upper) - outside
        margin = np.maximum(limits.margin, config.overshoot)
        self._overshooting = replace(self.limits, margin=tuple(margin.tolist()))
        margins = {"table": config.table_margin, "self": config.self_margin, "floor": config.floor_margin}
        self._margin = np.array([margins[kind] for kind in self.geometry.kinds])
        self._touch = np.minimum(self._margin, TOUCH)
        self._inside = np.zeros(self._margin.shape, bool)  # gaps that have been below their margin since arming
        self._still = np.array(config.still)
        self._leads = leads(config, self.geometry.units)
        ahead = self._leads - self._leads[:, [unit == "rad" for unit in self.geometry.units]].min(axis=1, keepdims=True)
        self._silence = Silence(config, ahead, self._a)
        self._monitor = FeedbackMonitor(limits, self.geometry, config)
        self._stop = StopReference(limits, config, self.geometry.units)
        self._latch = FaultLatch()
        self._mode = GateState.DISARMED  # apart from faults
        self._engaged = False  # whether the reference is ours, not the measured position
        self._velocity, self._acceleration = np.zeros(n), np.zeros(n)
        self._reference = np.full(n, np.nan)
        self._start = self._reference  # where the period in force starts
        self._measured: tuple[np.ndarray, np.ndarray] | None = None  # position and velocity, when credible
        self._unexplained = np.zeros(n)
        self._deviation = np.zeros(n)  # of the measured position from the way of the reference
        self._offset = np.zeros(n)  # the same, remembered while the reference moves
        self._measured_velocity: np.ndarray | None = None
        self._last: float | None = None  # time of the command before
        self.motion = Coasting(period, config.late, self._a)  # as the devices are told it, between ticks and without
        self._lead = 0.0  # [s] that commands are ahead of the clock
        self._armed_at = 0.0
        # The linear axes do not know where they are. Set by whoever sees them; while nothing moves, what they say then
        # is no limit or contact that keeps a fault from being reset: axes are homed only without one.
        self.unreferenced = False

    @property
    def state(self) -> GateState:
        return GateState.FAULT if self._latch else self._mode

    @property
    def margins(self) -> np.ndarray:
        """Smallest gaps (R,) [m] that are kept, in the order of the geometry's rows."""
        return self._margin.copy()

    @property
    def at_rest(self) -> bool:
        """True when the command in force is zero velocity."""
        return not self._velocity.any()

    @property
    def engaged(self) -> bool:
        """True when the reference is the gate's: from arming to disarming or reset. Otherwise nothing may be sent."""
        return self._engaged

    @property
    def velocity(self) -> np.ndarray:
        """Velocity (8,) that was sent last."""
        return self._velocity.copy()

    @property
    def reference(self) -> np.ndarray:
        """Reference (8,) that was sent last."""
        return self._reference.copy()

    @property
    def start(self) -> np.ndarray:
        """Reference (8,) at the start of the period in force, from which ``velocity`` goes on."""
        return self._start.copy()

    @property
    def settled(self) -> bool:
        """Nothing is commanded to move, and what was commanded before has come to rest as measured."""
        if not self._engaged:
            return True
        velocity = None if self._measured is None else self._measured[1]
        return velocity is not None and bool(self._stop.settled(velocity, self._last or 0.0).all())

    @property
    def faults(self) -> tuple[Fault, ...]:
        """Latched faults: the one that stopped the robot, then what came later."""
        return self._latch.all

    @property
    def present(self) -> dict[Cause, str]:
        """Conditions that keep the gate from being armed or reset at the moment."""
        return self._latch.present

    def arm(self, measured: ArrayLike, now: float, measured_velocity: ArrayLike | None = None) -> None:
        """Takes the measured position (8,) as reference and lets requests pass from now on.

        measured_velocity (8,): None takes what the last ``command`` was told. Raises RefusedError, and changes nothing,
        when a fault is latched or present, the position is outside its range or in contact, or the robot moves.
        """
        if self._latch:
            raise RefusedError(f"not armed: {self._latch.first}; reset it first")
        if self._mode is GateState.ARMED or not self.at_rest:
            raise RefusedError("not armed: it is armed or still stopping")
        if not math.isfinite(now):
            raise RefusedError(f"not armed: the time is {now}")
        position, problem = numbers_of(self.geometry.joints, measured, "measured position")
        if problem or position is None:
            raise RefusedError(f"not armed: {problem}")
        outside = (position < self._low) | (position > self._high)
        if outside.any():
            i = int(outside.argmax())
            allowed = f"[{self._low[i]:.4f}, {self._high[i]:.4f}] {self.geometry.units[i]}"
            found = f"{self.geometry.joints[i]} is at {position[i]:.4f}"
            by_hand = "move it by its drive's own program, or by hand without power"
            how = by_hand if self.geometry.units[i] == "m" else "jog it back"
            raise JogFirstError(f"not armed: {found}, allowed is {allowed}; {how}")
        touching = self._monitor.contact(position)
        if touching:
            raise JogFirstError(f"not armed: {touching}; jog it away")
        if self._latch.present:
            listed = "; ".join(f"{cause.name}: {sentence}" for cause, sentence in self._latch.present.items())
            raise RefusedError(f"not armed: {listed}")
        given = self._measured_velocity if measured_velocity is None else measured_velocity
        if given is None:
            raise RefusedError("not armed: no measured velocity yet")
        velocity, problem = numbers_of(self.geometry.joints, given, "measured velocity")
        if problem or velocity is None:
            raise RefusedError(f"not armed: {problem}")
        if (np.abs(velocity) > self._still).any():
            raise RefusedError(f"not armed: {worst(self.geometry, velocity, self._still, '/s')}, it must be at rest")
        self._mode, self._engaged, self._armed_at = GateState.ARMED, True, now
        self._velocity, self._acceleration = np.zeros_like(self._velocity), np.zeros_like(self._velocity)
        self._reference = self._start = position
        self._inside = np.ones(self._margin.shape, bool)
        self._stop.restart()
        self._deviation, self._offset = np.zeros_like(self._velocity), np.zeros_like(self._velocity)
        self._lead, self._last = 0.0, None
        self._monitor.restart(position, now)
        self.motion.ticked(position, self._velocity, now)

    def brake(self, now: float) -> None:
        """Slows down to rest from the next command on and holds; no fault. Armed again by ``arm``."""
        if self._mode is GateState.ARMED:
            self._mode = GateState.STOPPING

    def disarm(self, now: float) -> None:
        """Gives the reference up. Raises RefusedError while the robot is commanded to move: brake first."""
        if not self.at_rest:
            raise RefusedError("not disarmed: it still moves; brake first")
        self._mode, self._engaged = GateState.DISARMED, False

    def fault(self, cause: Cause, sentence: str, now: float) -> None:
        """Latches something that has happened, and brakes."""
        self._latch.event(cause, sentence, now)
        if self._mode is GateState.ARMED:
            self._mode = GateState.STOPPING

    def condition(self, cause: Cause, present: bool, sentence: str, now: float) -> None:
        """Says whether something lasts that must not be: brakes and latches it, and neither ``reset`` nor ``arm`` works
        until it is said to be over. While disarmed it is only noted, but for the emergency stop."""
        self._latch.condition(cause, present, sentence, now, latch=self._engaged or cause is Cause.ESTOP)
        if present and self._mode is GateState.ARMED:
            self._mode = GateState.STOPPING

    def estop(self, pressed: bool, now: float) -> None:
        """Tells the state of the emergency stop."""
        self.condition(Cause.ESTOP, pressed, "the emergency stop is pressed", now)

    def reset(self, now: float) -> None:
        """The operator's: forgets the faults; the gate is disarmed then. Without a fault it does nothing.

        Raises RefusedError, and forgets nothing, while the robot is commanded to move or a cause is present.
        """
        if not self._latch:
            return
        if not self.at_rest:
            raise RefusedError("cannot reset: it still moves")
        self._latch.reset()
        self._mode, self._engaged = GateState.DISARMED, False

    def check(
        self, now: float, arm_age: float, axes_age: float, tracker_age: float, ball_in_play: bool, policy_age: float
    ) -> None:
        """Watchdogs: ages [s] of what was last heard of each device, infinite for never; NaN counts as too old.

        The policy's age matters only while armed and is counted from arming at the earliest.
        """
        c = self.config
        if self._mode is GateState.ARMED and not self._latch:
            policy_age = min(policy_age, now - self._armed_at) if policy_age == policy_age else math.nan
        else:
            policy_age = 0.0
        for cause, what, age, allowed in (
            (Cause.STALE_ARM, "the arm's controller", arm_age, c.stale_arm),
            (Cause.STALE_AXES, "the linear axes", axes_age, c.stale_axes),
            (Cause.STALE_TRACKER, "the tracker", tracker_age if ball_in_play else 0.0, c.stale_tracker),
            (Cause.STALE_POLICY, "the policy", policy_age, c.stale_policy),
        ):
            sentence = f"nothing heard from {what} for {age:.3f} s, allowed is {allowed} s"
            self.condition(cause, not age <= allowed, sentence, now)

    def command(self, request: ArrayLike, measured: ArrayLike, measured_velocity: ArrayLike, now: float) -> Sent:
        """One control tick: from requested velocity, measured velocity and position, each (8,), to the command to send.

        Never raises: whatever is wrong with the inputs is a fault, and what comes back then is the braked motion.
        """
        now = self._timing(now)
        held = self._coast(now)
        self._watch(measured, measured_velocity, now)
        if held and self._measured is not None:
            self._reference = self._start = self._measured[0]
            self._monitor.sent(self._reference, now)
        wanted = self._request(request, now)
        if not self._engaged:
            self._start = self._reference
            return Sent(np.zeros_like(self._velocity), self._reference.copy(), (self.state.value,), self.state)
        if self.state is not GateState.ARMED:
            self._follow_the_arm(now)
        left = np.abs(self._velocity) - self._step
        braked = np.where(left > ROUNDING * self._step, np.copysign(left, self._velocity), 0.0)
        velocity = braked
        changed: tuple[str, ...] = (self.state.value,)
        if self.state is GateState.ARMED:
            try:
                velocity, changed = self._allowed(wanted, braked)
                broken = self._broken(velocity)
            except Exception as error:  # a mistake of ours must still brake the robot
                broken = format_error(error)
            if broken:
                self.fault(Cause.INTERNAL, broken, now)
                velocity, changed = braked, (self.state.value,)
        self._acceleration = (velocity - self._velocity) / self.period
        self._velocity = velocity
        self._start = self._reference
        self._reference = self._reference + velocity * self.period
        self.motion.ticked(self._start, velocity, now)
        self._monitor.sent(self._reference, now + self.period)
        return Sent(velocity.copy(), self._reference.copy(), changed, self.state)

    def _coast(self, now: float) -> bool:
        """Takes over the motion that the devices were told while ticks were missing: it has slowed down by itself, and
        whoever brakes on from the last tick's velocity would make them faster again. True: they hold the measured place
        by now, wherever that is."""
        if not self._engaged or not self.motion.missed(now):
            return False
        moved = self.motion.at(now)
        if moved is None:
            self._velocity = np.zeros_like(self._velocity)
            return True
        self._reference, self._velocity = moved
        self._start = self._reference - self._velocity * self.period
        self._monitor.sent(self._reference, now)
        return False

    def _follow_the_arm(self, now: float) -> None:
        """While stopping: a reference that the measured arm explains. Without a credible measurement it stays."""
        if self._measured is None:
            return
        position, velocity = self._measured
        reference = self._stop.corrected(self._reference, self._velocity, position, velocity, self._unexplained, now)
        if (reference == self._reference).all():
            return
        self._reference = reference
        try:
            way = self.braking_way(self._velocity)
            clear = self.geometry.first_too_close(way, self._margin, SLACK) is None
        except Exception:  # a mistake of ours must not keep the reference from the arm
            clear = False
        if not clear:  # of all places the one where the arm is needs no motion
            self._stop.give_up()
            self._reference = position.copy()

    def _allowed(self, wanted: np.ndarray, braked: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
        """The first velocity (8,) on the way from the limited request to braking that is clear, and the rules."""
        rules = []
        scaled = wanted * self.config.speed_scale
        if (scaled != wanted).any():
            rules.append("speed_scale")
        if self._inside.any():  # what has reached its margin keeps it
            self._inside &= self.geometry.gaps(self._reference[:, None])[:, 0] < self._margin - INSIDE
        if self._inside.any():  # slow enough to stop within a period: the way ends where this command leads
            slow = np.minimum(self.config.escape_speed * self._v_max, 0.9 * self._step)
            slowed = np.clip(scaled, -slow, slow)
            if (slowed != scaled).any():
                rules.append("escape")
            scaled = slowed
        velocity = limit_velocity(scaled, self._velocity, self._reference, self.period, self.limits)
        inner = limit_velocity(velocity, self._velocity, self._reference, self.period, self._overshooting)
        # Nothing is led out of the room for the overshoot, but nothing goes farther into it.
        velocity = np.where(
            inner < velocity,
            np.maximum(inner, np.minimum(velocity, 0.0)),
            np.minimum(inner, np.maximum(velocity, 0.0)),
        )
        if self._offset.any():  # what is measured keeps the range as well, not only the reference
            beside = limit_velocity(velocity, self._velocity, self._reference + self._offset, self.period, self.limits)
            beside = np.clip(beside, self._velocity - self._step, self._velocity + self._step)
            velocity = np.where(self._offset > 0.0, np.minimum(velocity, beside), np.maximum(velocity, beside))
        clipped = np.clip(scaled, -self._v_max, self._v_max)
        rated = np.clip(clipped, self._velocity - self._step, self._velocity + self._step)
        for name, before, after in (
            ("velocity", scaled, clipped),
            ("acceleration", clipped, rated),
            ("position", rated, velocity),
        ):
            if (before != after).any():
                rules.append(name)
        if (velocity == braked).all():  # cleared before, or at rest
            return velocity, tuple(rules)
        # Between two velocities that keep the kinematic limits every one does: they bound each joint by itself.
        whole, rule = self._blade_share(braked, velocity)
        if rule:
            rules.append(rule)
        tried = velocity if whole == 1.0 else braked + whole * (velocity - braked)
        for _ in range(TRIES):
            way = self.braking_way(tried)
            if self._too_fast(way):
                tried = 0.5 * (braked + tried)
                continue
            close = self._too_close(way, tried)
            if close is None:
                return tried, tuple(rules)
            if rules[-1:] != ["clearance"]:
                rules.append("clearance")
            tried = slow_down(self.geometry, self._reference, tried, braked, *close)
        return braked, tuple(rules)

    def _blade_share(self, braked: np.ndarray, velocity: np.ndarray) -> tuple[float, str]:
        """Share of the way from braking to a velocity (8,) that keeps the blade's limits, and the limit that binds."""
        rule = self._too_fast(self.braking_way(velocity))
        if not rule:
            return 1.0, ""
        low, high = 0.0, 1.0
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            fast = self._too_fast(self.braking_way(braked + middle * (velocity - braked)))
            low, high = (low, middle) if fast else (middle, high)
        return low, rule

    def _too_fast(self, way: np.ndarray) -> str:
        """The limit of the blade that is broken on a way (8, N) of this period and of braking after it; empty: none."""
        way = np.concatenate([self._start[:, None], way, way[:, -1:]], axis=1)  # with the period in force and rest
        velocity = np.diff(self.geometry.middles(self.geometry.tip, way)) / self.period
        if np.linalg.norm(velocity[:, 1:], axis=0).max() > self.config.blade_speed:
            return "blade_speed"
        acceleration = np.linalg.norm(np.diff(velocity), axis=0) / self.period
        return "blade_acceleration" if acceleration.max() > self.config.blade_acceleration else ""

    def _too_close(self, way: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Places (n, N) and the gaps (R,) that they must keep and do not, of the first proof that fails; None: clear.

        A way of this period at ``velocity`` (8,) and of braking keeps the margins, or leaves one that is missed
        already, whenever the next tick comes: until then, up to ``late``, the robot goes on at that velocity, and all
        that comes after this period is shifted by it. And where none comes any more, nothing is touched.
        """
        late = way.copy()
        late[:, 1:] += (self.config.late - self.period) * velocity[:, None]
        for places, least in self._proofs(way, late, velocity):
            if self.geometry.first_too_close(places, least, SLACK) is not None:
                return places, least
        beside = self._monitor.beside
        if beside.size and not all(self.geometry.clear_beside(each, beside, self._touch) for each in (way, late)):
            return late, self._touch
        if self._inside.any():
            gaps = self.geometry.gaps(way)[self._inside]
            if not (gaps[:, -1] > gaps[:, 0]).all():
                return way, self._margin
        return None

    def _proofs(
        self, way: np.ndarray, late: np.ndarray, velocity: np.ndarray
    ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Places (n, N) to which a velocity may lead, and the gaps (R,) that they must keep."""
        # What fails most comes first.
        yield self._silence.ways(way[:, :-1] + self._deviation[:, None], np.diff(way) / self.period), self._touch
        ways, now = between(way, late), self._last or 0.0
        yield ways, self._margin
        past = self._monitor.past(now, float(self._leads.max()) + self.period)
        yield delayed(way, late, past, now, self.period, self.config.late, self._leads), self._touch
        if self._deviation.any():  # the robot goes beside its reference: it must not touch anything there
            yield ways + self._deviation[:, None], self._touch
        if self._inside.any():  # it creeps away; for a joint that blocks, even where it is counts as too close
            return
        low, high = self._monitor.reach
        gone = np.concatenate([self._monitor.past(now, self.config.delay)[1], way], axis=1)
        ends = np.minimum(low, way.min(axis=1)), np.maximum(high, way.max(axis=1))
        yield blocked(gone[:, ::-STRIDE], *ends), self._touch

    def braking_way(self, velocity: np.ndarray) -> np.ndarray:
        """References (8, N) now and after each period until rest: one period at ``velocity``, then braking."""
        periods = max(1, math.ceil(float((np.abs(velocity) / self._step).max())))
        left = np.maximum(np.abs(velocity)[:, None] - self._step[:, None] * np.arange(periods), 0.0)
        moved = np.cumsum(np.sign(velocity)[:, None] * left * self.period, axis=1)
        return np.concatenate([self._reference[:, None], self._reference[:, None] + moved], axis=1)

    def _broken(self, velocity: np.ndarray) -> str:
        """The limit that an accepted velocity breaks, as a sentence; empty: none. Checks what was computed above."""
        acceleration = (velocity - self._velocity) / self.period
        jerk = (acceleration - self._acceleration) / self.period
        position = self._reference + velocity * self.period
        for name, values, bound in (
            ("velocity", velocity, self._v_max),
            ("acceleration", acceleration, self._a),
            ("jerk", jerk, 2.0 * self._a / self.period),
        ):
            if not (np.abs(values) <= bound * (1.0 + ROUNDING)).all():
                return f"accepted {name}: {worst(self.geometry, values, bound)}"
        if not ((position >= self._low - ROUNDING) & (position <= self._high + ROUNDING)).all():
            return f"accepted position {position} is outside {self._low} to {self._high}"
        return ""

    def _timing(self, now: float) -> float:
        """Watches the rhythm of the commands; returns the time to go on with."""
        last, self._last = self._last, now
        if not math.isfinite(now):
            self._last = last
            self.fault(Cause.TIMING, f"the time is {now}", last or 0.0)
            return last or 0.0
        if last is None or not self._engaged:
            return now
        gap = now - last
        self._lead = max(0.0, self._lead + self.period - gap)
        if gap < 0.0:
            self.fault(Cause.TIMING, f"time went back by {-gap:.4f} s", now)
        elif gap > self.config.late:
            self.fault(Cause.TIMING, f"{gap:.3f} s between two commands, allowed is {self.config.late} s", now)
        elif self._lead > LONGEST_LEAD * self.period:
            self.fault(Cause.TIMING, f"commands come faster than every {self.period:.5f} s", now)
        return now

    def _request(self, request: ArrayLike, now: float) -> np.ndarray:
        """The requested velocity (8,), zero when it cannot be used."""
        values, problem = numbers_of(self.geometry.joints, request, "requested velocity", normal=True)
        finite = values is None or bool(np.isfinite(values).all())
        self.condition(Cause.NON_FINITE_COMMAND, not finite, problem, now)
        self.condition(Cause.MALFORMED_COMMAND, bool(problem) and finite, problem, now)
        return np.zeros_like(self._velocity) if problem or values is None else values

    def _watch(self, measured: ArrayLike, measured_velocity: ArrayLike, now: float) -> None:
        """Looks at what was measured."""
        position, problem = numbers_of(self.geometry.joints, measured, "measured position")
        velocity, second = numbers_of(self.geometry.joints, measured_velocity, "measured velocity")
        problem = problem or second
        self.condition(Cause.NON_FINITE_FEEDBACK, bool(problem), problem, now)
        self._measured_velocity = None if problem else velocity
        self._measured = None
        if problem or position is None or velocity is None:
            return
        if self._stop.credible(position, now):
            self._measured = (position, velocity)
        if not self._engaged:
            self._reference = position
        unknown = self.unreferenced and self._mode is not GateState.ARMED and self.at_rest
        for cause, sentence in self._monitor.conditions(position, velocity).items():
            self.condition(cause, bool(sentence) and not unknown, sentence, now)
        if not self._engaged:
            return
        self._unexplained = self._monitor.unexplained(position, now)
        self._deviation = self._monitor.deviation(position, now)
        self._offset = self._monitor.offset(self._deviation, self._offset, self.period)
        if not self._latch:
            sentence = self._monitor.following_error(self._unexplained)
            if sentence:
                self.fault(Cause.FOLLOWING_ERROR, sentence, now)
