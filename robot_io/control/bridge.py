"""The bridge between policy and robot: what happens at a control tick and when something arrives. No sockets, no clock.

DISARMED  nothing moves; the arm's packets are answered with its own position
READY     goes to the home pose, and waits there for a ball
ACTIVE    the policy plays the ball that is coming
STOPPING  the operator's stop: slows down to rest, then DISARMED
FAULT     slowed down and held until the operator resets it

Once it has been at the home pose since it was armed, the robot takes a ball wherever it is: it heads for home only
while there is time. Everything that is sent has passed ``robot_io.safety.gate``. An exception in here is a fault:
``tick`` and whatever takes what arrives never raise. Times are seconds of one monotonic clock, passed in.
"""

from __future__ import annotations

import math
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from time import perf_counter

import numpy as np

from robot_io.control.commissioning import jog
from robot_io.control.commissioning.homing import HomingGuard
from robot_io.control.commissioning.mute import Mute
from robot_io.control.commissioning.way_home import WayHome
from robot_io.control.episode import STOPPED, Episode, EpisodeSummary
from robot_io.control.interfaces import STANDARD_PLAY, Axes, action_of
from robot_io.control.interfaces import BridgeConfig as BridgeConfig
from robot_io.control.interfaces import BridgeState as BridgeState
from robot_io.control.interfaces import Policy as Policy
from robot_io.control.observation import Feedback, blade, joints, observe
from robot_io.control.play import Play
from robot_io.control.rally import RallySummary
from robot_io.devices.egm.arm_history import ArmHistory
from robot_io.devices.egm.messages import ArmFeedback
from robot_io.devices.egm.session import EgmSession
from robot_io.devices.frame_check import FrameCheck
from robot_io.devices.tracker import Tracker
from robot_io.errors import RefusedError, format_error
from robot_io.history import History
from robot_io.log.messages import Action, Ball, Command, Event, Joints, Level, Observation, Record, Tick, json_text
from robot_io.log.recorder import NullRecorder, SessionRecorder
from robot_io.safety.clearance import RobotGeometry
from robot_io.safety.faults import Cause
from robot_io.safety.gate import GateState, SafetyGate, Sent

CLOCK_EVERY = 10  # seconds of frames between two reports of the tracker's clock
AT_HOME = 0.02  # [m], [rad] of every joint
TRACED = 300  # ticks
LONGEST_STOP = 2.0  # [s] after which a stop ends although the measurement does not come to rest


class Bridge:
    """One robot at play.

    arm       EGM session, fed by the owner of its socket before ``arm_received``
    axes      the linear axes; axes_state: their newest state, None before the first
    tracker   fed through ``tracker_received``
    on_episode  called with every EpisodeSummary as soon as its outcome is known, on_rally with every RallySummary
    """

    def __init__(
        self,
        arm: EgmSession,
        axes: Axes,
        tracker: Tracker,
        gate: SafetyGate,
        policy: Policy | None = None,
        config: BridgeConfig = STANDARD_PLAY,
        recorder: SessionRecorder | None = None,
        on_episode: Callable[[EpisodeSummary], None] | None = None,
        on_rally: Callable[[RallySummary], None] | None = None,
    ) -> None:
        self.arm_session, self.axes, self.tracker, self.gate = arm, axes, tracker, gate
        self.config, contract = config, config.contract
        self._axes_rows, self._arm_rows = list(contract.carrying), list(contract.arm)
        self.recorder = recorder or NullRecorder()
        self.play = Play(self._log, on_episode, on_rally, config.box, config.contract.limits)
        self.counts = self.play.counts
        self.frame_check = FrameCheck(0 if config.jog else config.balls_needed)
        self._policy, self.policy_version = policy, 0
        self._geometry: RobotGeometry = gate.geometry
        self._home = np.array(self._geometry.home if config.home is None else config.home, float)
        self.feedback = Feedback(ball=self.play.strokes.track, axes=History(256), arm=ArmHistory(256))  # a second
        self._blade = partial(blade, self.feedback, self._geometry)
        seen = partial(joints, self.feedback, contract)
        self._homing = HomingGuard(arm, axes, seen, self._geometry, contract, gate.config.still, config.overtravel)
        self._state = BridgeState.DISARMED
        # Session and packet of the arm's controller; True when it was started anew since it was armed.
        self._arm_session_id, self._arm_sequence, self._arm_restarted = 0, -1, False
        self._axes_received = self._last_tick = -math.inf
        self._zeros = np.zeros(contract.n_joints)
        self._policy_limit = np.array(contract.limits.policy_velocity)
        speed = (jog.SPEED if config.jog else config.home_speed) * self._policy_limit
        braking = config.home_braking * np.array(contract.limits.acceleration)
        scale = gate.config.speed_scale if config.jog else 1.0
        self._way_home = WayHome(gate, contract.limits, speed, braking, scale)
        self._logged_faults = self._clock_windows = 0
        self.unlogged = self._reported_unlogged = 0  # records that could not be logged
        self._log_failure = ""  # why the log's file cannot be written
        self._errors: set[str] = set()  # of the program, each logged once
        self._stopping_since, self.stopped_because = -math.inf, ""  # the reason of a stop that no operator asked for
        self._pulled, self.mute = False, Mute(arm)
        self.trace: deque[tuple[float, np.ndarray, np.ndarray]] = deque(maxlen=TRACED)
        self._been_home, self.paused = False, config.jog  # at the home pose since it was armed
        self.policy_seconds = 0.0  # of the last tick; 0 when the policy was not asked

    # The operator

    @property
    def state(self) -> BridgeState:
        return BridgeState.FAULT if self.gate.state is GateState.FAULT else self._state

    @property
    def measured(self) -> np.ndarray:
        """Newest positions (8,); NaN for what has not reported."""
        return joints(self.feedback, self.config.contract)[0]

    @property
    def at_home(self) -> bool:
        """At the home pose and at rest, by reference and by measurement."""
        near = np.abs(self.measured - self._home) < 2 * AT_HOME
        return bool(near.all() and (np.abs(self.gate.reference - self._home) < AT_HOME).all() and self.gate.at_rest)

    def set_policy(self, policy: Policy, version: int = 0) -> None:
        """Exchange the policy; ``version`` is in its balls' summaries. Raises RefusedError while it is playing."""
        self.check_exchange()
        self._policy, self.policy_version = policy, version

    def check_exchange(self) -> None:
        """Raise RefusedError while the policy is playing."""
        if self.state is BridgeState.ACTIVE:
            raise RefusedError("the policy is playing: exchange it between balls")

    def arm(self, now: float) -> None:
        """DISARMED to READY: the robot will move to its home pose. Raises RefusedError with the reason."""
        if self.state is not BridgeState.DISARMED:
            raise RefusedError(f"not armed: the state is {self.state.value}, only a disarmed robot can be armed")
        if self._policy is None:
            raise RefusedError("not armed: no policy is loaded")
        arm = self.arm_session.problem(now) or self.arm_session.ramping(now)
        for what, problem in (("arm", arm), ("axes", self.axes.problem(now))):
            if problem:
                raise RefusedError(f"not armed: {what}: {problem}")
        for what, problem in (("tracker: ", self.tracker.problem(now)), ("", self.unproven)):
            if problem:
                raise RefusedError(f"not armed: {what}{problem}")
        measured, velocity = joints(self.feedback, self.config.contract)
        self.gate.arm(measured, now, velocity)
        self._arm_session_id = self.arm_session.session_id
        self._arm_restarted = self._been_home = False
        self.stopped_because = ""
        self._way_home.restart()
        self._home = measured if self.config.jog else self._home
        self._pulled = False
        self.trace.clear()
        self._change(BridgeState.READY, now, "armed by the operator")

    @property
    def unproven(self) -> str | None:
        """What must be seen of the tracker's frame and clock before the robot is armed; None: nothing."""
        check = self.frame_check
        if check.problem or not check.needed:
            return check.problem
        return self.tracker.refused or self.tracker.clock.unready or check.wanted

    def jog(self, step: np.ndarray, share: float = jog.SPEED, pulled: bool = False) -> None:
        """Move on by a step, (n,) or (3,) of the blade, from where it is commanded to be. Raises RefusedError.

        share, pulled: as of ``messages.Jog``.
        """
        if not self.config.jog or self.state is not BridgeState.READY:
            raise RefusedError(f"not jogged: the state is {self.state.value}; arm it first, in mjx-tt robot jog")
        if not 0.0 < share <= 1.0:
            raise RefusedError(f"not jogged: at {share} of the policy's speed; more than 0, at most 1")
        self._way_home.speed, self._pulled = share * self._policy_limit, pulled
        self._home = self.gate.reference + jog.joints_of(step, self._geometry, self.gate.reference)

    def stop(self, now: float, because: str = "") -> None:
        """The operator's stop, or one for a reason: slows down, holds, ends DISARMED. Axes that search a zero stop."""
        self.stopped_because = because or self.stopped_because
        if self.state in (BridgeState.READY, BridgeState.ACTIVE):
            self.gate.brake(now)
            self._stopping_since = now
            self._change(BridgeState.STOPPING, now, because or "stopped by the operator")
            with self._guarded(now):
                self.play.abort(STOPPED, now)
        elif self.gate.at_rest:  # otherwise the gate brakes them
            self.axes.stop()
        if not because or self._state is BridgeState.DISARMED:
            self.event(now, Level.INFO, "operator", because or "stop")

    def reset(self, now: float) -> None:
        """FAULT to DISARMED. Raises RefusedError without a fault, while a cause is present or the robot still moves."""
        if self.state is not BridgeState.FAULT:
            raise RefusedError(f"nothing to reset: the state is {self.state.value}, without a fault")
        if self.frame_check.problem:  # other balls show whether what was done about it has helped
            self.frame_check.restart()
            self.gate.condition(Cause.TRACKER_FRAME, False, "", now)
        self.gate.reset(now)
        self._logged_faults = 0
        self._change(BridgeState.DISARMED, now, "fault reset by the operator")

    def check_homing(self, now: float) -> None:
        """Raise RefusedError unless the linear axes may search their references, as of ``HomingGuard.check``."""
        self._homing.check(self.state.value, now)

    def discard(self, now: float) -> int:
        """Mark the ball that the operator has seen last as not to be used; returns its number, 0 for none."""
        number = self.play.discard(now)
        self.event(now, Level.INFO, "discard", json_text({"episode": number}))
        return number

    def failed(self, error: BaseException, now: float) -> None:
        """Brake for an error of the program, wherever it was raised, and latch it as INTERNAL."""
        sentence = format_error(error)
        self.gate.fault(Cause.INTERNAL, sentence, now)
        with suppress(Exception):  # it brakes by now, and an error may not let itself be described
            if sentence not in self._errors and len(self._errors) < 100:
                self._errors.add(sentence)
                self.event(now, Level.FATAL, "error", "".join(traceback.format_exception(error)))

    @contextmanager
    def _guarded(self, now: float) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # whatever it is, the robot must be braked and the loop go on
            self.failed(error, now)

    # What arrives

    def arm_received(self, now: float) -> bytes | None:
        """Answer the packet that the EGM session has just taken; None when there is nothing to answer."""
        feedback = self.arm_session.feedback
        if feedback is None or self.mute.active(now):
            return None
        hold = feedback.position, np.zeros_like(feedback.position)
        with self._guarded(now):
            position, velocity = self._arm_reference(feedback, now) or hold
            return self.arm_session.reply(position, velocity, now)
        with self._guarded(now):
            return self.arm_session.reply(*hold, now)
        return None

    def _arm_reference(self, feedback: ArmFeedback, now: float) -> tuple[np.ndarray, np.ndarray] | None:
        """Position (6,) and velocity (6,) for the arm at ``now``; None: hold the measured place."""
        if self.feedback.arm.add(feedback.received, feedback.position, feedback.time):
            position, velocity = joints(self.feedback, self.config.contract)
            self._log(Joints(feedback.received, position, velocity))
        # Where the old reference would lead a controller that was started anew, nobody has asked for.
        self._arm_restarted |= feedback.sequence < self._arm_sequence
        self._arm_sequence = feedback.sequence
        moved = self.gate.motion.at(now) if self.gate.engaged and not self._arm_restarted else None
        if moved is None:
            return None
        return moved[0][self._arm_rows], moved[1][self._arm_rows] * (not self._pulled)

    def tracker_received(self, datagram: bytes, source: str, now: float, port: int | None = None) -> None:
        """Take one datagram from an IP address and port; without a port none is checked."""
        with self._guarded(now):
            self._follow_ball(datagram, source, now, port)

    def _follow_ball(self, datagram: bytes, source: str, now: float, port: int | None) -> None:
        sample, clock = self.tracker.receive(datagram, source, now, port), self.tracker.clock
        if clock.windows >= self._clock_windows + CLOCK_EVERY or clock.windows < self._clock_windows:
            self._clock_windows = clock.windows
            self.event(now, Level.INFO, "clock", json_text(clock.report()))
        if sample is None:
            return
        self.frame_check.add(sample)
        if sample.position is None:
            return
        self._log(Ball(sample.captured, now, sample.position, sample.ball))
        self.play.follow(sample, self._blade, now, armed=self.gate.engaged, at_start=self._been_home)

    def axes_received(self, position: np.ndarray, received: float) -> None:
        """The linear axes' newest position (2,) [m], as it was at ``received``."""
        if received > self._axes_received:
            self._axes_received = received
            self.feedback.axes.add(received, position)

    # The control tick

    def tick(self, deadline: float, now: float) -> np.ndarray:
        """One control period: observe, decide, pass the gate, hand over to the devices; the sent velocity (8,)."""
        self.counts.ticks, self.policy_seconds, request = self.counts.ticks + 1, 0.0, self._zeros
        measured, measured_velocity, sent = np.full_like(self._zeros, np.nan), self._zeros, None
        with self._guarded(now):
            measured, measured_velocity = joints(self.feedback, self.config.contract)
            self.play.moved(measured_velocity)
            self.trace.append((now, self.gate.reference, measured))
            request = self._decide(now)
        with self._guarded(now):
            sent = self.gate.command(request, measured, measured_velocity, now)
        if sent is None:  # arm and axes, which get no new command, slow down by themselves
            with self._guarded(now):
                self._after(now)
            return self._zeros.copy()
        start = self.gate.start
        with self._guarded(now):
            if self.gate.engaged:
                self.axes.command(start[self._axes_rows], sent.velocity[self._axes_rows], now)
        with self._guarded(now):
            self._follow_the_way(request, sent, now)
            self._after(now)
        with self._guarded(now):
            n = self.counts.ticks
            timing = Tick(n, now, now - deadline, self.policy_seconds, *reversed(self._ages(now)))
            self._log(timing, Command(n, now, request, sent.velocity, start))
        if self.unlogged > self._reported_unlogged:
            self._reported_unlogged = self.unlogged
            self.event(now, Level.WARNING, "log_error", json_text({"unlogged": self.unlogged}))
        return sent.velocity

    def _decide(self, now: float) -> np.ndarray:
        """The requested velocity (8,), after a look at the devices and at the balls."""
        self._watch(now)
        self.play.settle(now)
        if self._state is BridgeState.ACTIVE and self.play.episode is None:
            self._change(BridgeState.READY, now, "ball over")
        ready = self.state is BridgeState.READY
        self._been_home |= ready and self.at_home
        if self.paused or not (ready or self.state is BridgeState.ACTIVE):
            self.play.pass_over(now)
        elif ready and self._policy is not None and self.play.due(now):
            self.play.begin(self.tracker.ball, self.policy_version, now)
            self._policy.reset()
            self._change(BridgeState.ACTIVE, now, f"ball {self.tracker.ball}")
        if self.state is BridgeState.ACTIVE:
            self._way_home.give_up()
            return self._ask_policy(now, self.play.episode, self._policy)
        return self._way_home.velocity(self._home) if self.state is BridgeState.READY else self._zeros.copy()

    def _ages(self, now: float) -> tuple[float, float, float]:
        """Ages [s] of what was last heard of arm, axes and tracker, infinite for never."""
        arm, seen = self.arm_session.feedback, self.tracker.received
        heard = -math.inf if arm is None else arm.received, -math.inf if seen is None else seen
        return now - heard[0], now - self._axes_received, now - heard[1]

    def _watch(self, now: float) -> None:
        """Tells the gate what is wrong with the devices."""
        since_tick = 0.0 if self._last_tick == -math.inf else now - self._last_tick
        self._last_tick = now
        self.gate.check(now, *self._ages(now), self.state is BridgeState.ACTIVE, since_tick)
        self.gate.unreferenced = not self.axes.homed
        arm, axes = self.arm_session.problem(now), self.axes.problem(now)
        self.gate.condition(Cause.ARM_NOT_READY, arm is not None, arm or "", now)
        # Axes are homed only without a fault: that they must be does not keep one from being reset.
        after_reset = self.state is BridgeState.FAULT and self.gate.at_rest and self.axes.preparable(now)
        self.gate.condition(Cause.AXIS_LOST, axes is not None and not after_reset, axes or "", now)
        if stopped := self._homing.watch(now):
            self.event(now, Level.WARNING, "homing", f"stopped: {stopped}")
        clock = self.tracker.clock.problem
        self.gate.condition(Cause.CLOCK, clock is not None, clock or "", now)
        frame = None if self.config.jog else self.frame_check.problem
        self.gate.condition(Cause.TRACKER_FRAME, frame is not None, frame or "", now)
        armed = self._state in (BridgeState.READY, BridgeState.ACTIVE)
        if armed and self.arm_session.session_id != self._arm_session_id:
            self._arm_session_id = self.arm_session.session_id
            self.gate.fault(Cause.ARM_NOT_READY, "the arm's EGM session started anew: its reference is lost", now)
        log_failure = self.recorder.failure or self._log_failure
        if armed and log_failure:
            self.gate.fault(Cause.INTERNAL, log_failure, now)

    def _ask_policy(self, now: float, episode: Episode | None, policy: Policy | None) -> np.ndarray:
        """The policy's request (8,)."""
        if episode is None or policy is None:
            self.gate.fault(Cause.INTERNAL, "neither ball nor policy to play", now)
            return self._zeros.copy()
        observation = observe(self.feedback, self.config.delays, now, self.config.base)
        if observation is None:
            if self.feedback.ball.at(now - self.config.delays.ball) is None:
                episode.over = True  # frames come, as the gate has checked, but the ball is out of sight
            else:
                self.gate.fault(Cause.INTERNAL, "no joint positions to observe while a ball is in play", now)
            return self._zeros.copy()
        began = perf_counter()
        try:
            action = action_of(policy, observation)
        except Exception as error:  # whatever a policy does, the robot is braked
            self.gate.fault(Cause.MALFORMED_COMMAND, f"the policy failed: {format_error(error)}", now)
            return self._zeros.copy()
        self.policy_seconds = perf_counter() - began
        episode.saw(observation)
        self._log(Observation(self.counts.ticks, now, observation), Action(self.counts.ticks, now, action))
        return action * self._policy_limit

    def _after(self, now: float) -> None:
        """Follows the gate's state."""
        if self.gate.state is GateState.FAULT:
            faults = self.gate.faults
            if len(faults) > self._logged_faults:
                for fault in faults[self._logged_faults :]:
                    text = json_text({"cause": fault.cause.value, "text": fault.sentence})
                    self.event(now, Level.ERROR, "fault", text)
                first, self._logged_faults = self._logged_faults == 0, len(faults)
                if first:
                    self._change(BridgeState.DISARMED, now, f"fault: {faults[0].sentence}")
                    self.play.abort(faults[0].cause.value, now)
            if self.gate.at_rest:
                self.axes.stop()
        elif self._state is BridgeState.STOPPING and self.gate.at_rest:
            self.axes.stop()
            if self.gate.settled or now - self._stopping_since > LONGEST_STOP:
                self.gate.disarm(now)
                self._change(BridgeState.DISARMED, now, "at rest")

    def _follow_the_way(self, request: np.ndarray, sent: Sent, now: float) -> None:
        """Tells the way home what became of it; where there is none the robot is held, and that is a fault."""
        way, ready = self._way_home, self.state is BridgeState.READY
        if way.sent(request, sent, self._home, ready and not self.config.jog):
            self.event(now, Level.INFO, "way_home", "held for a clearance: another way is looked for")
        if way.problem and ready:
            self.gate.fault(Cause.NO_WAY_HOME, way.problem, now)

    def _change(self, state: BridgeState, now: float, why: str) -> None:
        self.event(now, Level.INFO, "state", json_text({"from": self._state.value, "to": state.value, "why": why}))
        self._state = state

    def event(self, now: float, level: Level, name: str, text: str) -> None:
        """Log something that happened."""
        self._log(Event(now, level, name, text))

    def _log(self, *records: Record) -> None:
        """Hand records to the recorder; what it raises is counted and never reaches the loop."""
        try:
            self.recorder.put(*records)
        except Exception as error:
            self.unlogged += len(records)
            if isinstance(error, OSError):  # nothing more will get into the file
                self._log_failure = f"the log cannot be written: {error}"
