"""The bridge between policy and robot: what happens at a control tick and when something arrives. No sockets, no clock.

DISARMED  nothing moves; the arm's packets are answered with its own position
READY     goes to the home pose and waits there for a ball
ACTIVE    the policy plays the ball that is coming
STOPPING  the operator's stop: slows down to rest, then DISARMED
FAULT     slowed down and held until the operator resets it

Everything that is sent has passed ``robot_io.safety.gate``. An exception in here is a fault: ``tick`` and
whatever takes what arrives never raise. Times are seconds of one monotonic clock, passed in.
"""

from __future__ import annotations

import math
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from enum import Enum
from time import perf_counter
from typing import Protocol

import numpy as np

from robot_io.contract import ABB_JOINTS, FESTO_JOINTS, JOINT_NAMES, LIMITS, N_JOINTS
from robot_io.control.episode import Episode, EpisodeSummary, in_play
from robot_io.control.observation import Feedback, ObservationDelays, joints, observe
from robot_io.devices.egm.session import ArmFeedback, EgmSession
from robot_io.devices.tracker import Tracker
from robot_io.errors import RefusedError
from robot_io.history import History
from robot_io.log.messages import (
    Action,
    Ball,
    Command,
    Event,
    Joints,
    Level,
    Observation,
    Record,
    Tick,
    episode_end,
    episode_start,
    json_text,
)
from robot_io.log.recorder import NullRecorder, SessionRecorder
from robot_io.safety.clearance import BLADE, RobotGeometry
from robot_io.safety.faults import Cause
from robot_io.safety.gate import GateState, SafetyGate

MAX_STEPS = 200  # control ticks of an episode, as in training
AT_HOME = 0.02  # [m], [rad] of every joint
HOMING_GAP = 0.03  # [m] of everything to everything while the linear axes search their references
HOMING_PLACES = 21  # along each axis at which that is looked at
LONGEST_STOP = 2.0  # [s] after which a stop ends although the measurement does not come to rest


class BridgeState(Enum):
    DISARMED = "disarmed"
    READY = "ready"
    ACTIVE = "active"
    STOPPING = "stopping"
    FAULT = "fault"


class Policy(Protocol):
    """``robot_io.policy.numpy_policy.StreamingPolicy`` or one that computes the same."""

    def reset(self) -> None: ...

    def step(self, observation: np.ndarray) -> np.ndarray: ...


class Axes(Protocol):
    """``FestoAxes`` or the thread that drives it."""

    def command(self, position: np.ndarray, velocity: np.ndarray, now: float) -> None: ...

    def stop(self) -> None: ...

    def problem(self, now: float) -> str | None: ...


@dataclass(frozen=True)
class BridgeConfig:
    """Settings of play.

    delays           of the observations
    home             (8,) joint positions to wait at; None: the geometry's
    home_speed       share of the policy's velocity limits on the way home
    home_braking     share of the acceleration limits there
    """

    delays: ObservationDelays = ObservationDelays()
    home: tuple[float, ...] | None = None
    home_speed: float = 0.5
    home_braking: float = 0.3


@dataclass
class Counts:
    """Since the start; for the operator's view."""

    ticks: int = 0
    balls: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    rally: int = 0  # balls returned in a row
    longest_rally: int = 0


class Bridge:
    """One robot at play.

    arm       EGM session, fed by the owner of its socket before ``arm_received``
    axes      the linear axes; axes_state: their newest state, None before the first
    tracker   fed through ``tracker_received``
    on_episode  called with every EpisodeSummary as soon as its outcome is known
    """

    def __init__(
        self,
        arm: EgmSession,
        axes: Axes,
        tracker: Tracker,
        gate: SafetyGate,
        policy: Policy | None = None,
        config: BridgeConfig = BridgeConfig(),
        recorder: SessionRecorder | None = None,
        on_episode: Callable[[EpisodeSummary], None] | None = None,
    ) -> None:
        self.arm_session, self.axes, self.tracker, self.gate = arm, axes, tracker, gate
        self.config = config
        self.recorder = recorder or NullRecorder()
        self.counts = Counts()
        self.episode: Episode | None = None
        self._policy = policy
        self.policy_version = 0
        self._on_episode = on_episode
        self._geometry: RobotGeometry = gate.geometry
        self._home = np.array(self._geometry.home if config.home is None else config.home, float)
        self._feedback = Feedback(ball=tracker.track, axes=History(), arm=History())
        self._state = BridgeState.DISARMED
        self._arm_session_id = 0
        self._arm_sequence, self._arm_restarted = -1, False  # packets of the arm's; anew since it was armed
        self._axes_received = -math.inf
        self._tick_time = -math.inf
        self._last_tick = -math.inf
        self._start = np.full(N_JOINTS, np.nan)  # reference at the start of the period
        self._policy_limit = np.array(LIMITS.policy_velocity)
        self._home_speed = config.home_speed * self._policy_limit
        self._home_braking = config.home_braking * np.array(LIMITS.acceleration)
        self._logged_faults = 0
        self.unlogged = 0  # records that could not be logged
        self._reported_unlogged = 0
        self._log_failure = ""  # why the log's file cannot be written
        self._errors: set[str] = set()  # of the program, each logged once
        self._stopping_since = -math.inf
        self._waiting: deque[Episode] = deque()  # policy's part over, outcome open
        self._last_ball = -1  # number of the ball that was played last
        self._stop_wanted = False
        self.paused = False
        self._tracks: dict[int, list[tuple[float, ...]]] = {}  # incoming samples by episode
        self.policy_seconds = 0.0  # of the last tick; 0 when the policy was not asked

    # The operator

    @property
    def state(self) -> BridgeState:
        return BridgeState.FAULT if self.gate.state is GateState.FAULT else self._state

    @property
    def at_home(self) -> bool:
        """At the home pose and at rest, by reference and by measurement."""
        measured, _ = joints(self._feedback)
        near = np.abs(measured - self._home) < 2 * AT_HOME
        return bool(near.all() and (np.abs(self.gate.reference - self._home) < AT_HOME).all() and self.gate.at_rest)

    def set_policy(self, policy: Policy, version: int = 0) -> None:
        """Exchange the policy; ``version`` is in its balls' summaries. Raises RefusedError while it is playing."""
        if self.state is BridgeState.ACTIVE:
            raise RefusedError("the policy is playing: exchange it between balls")
        self._policy, self.policy_version = policy, version

    def arm(self, now: float) -> None:
        """DISARMED to READY: the robot will move to its home pose. Raises RefusedError with the reason."""
        if self.state is not BridgeState.DISARMED:
            raise RefusedError(f"not armed: the state is {self.state.value}, only a disarmed robot can be armed")
        if self._policy is None:
            raise RefusedError("not armed: no policy is loaded")
        for what, problem in (("arm", self.arm_session.problem(now)), ("axes", self.axes.problem(now))):
            if problem:
                raise RefusedError(f"not armed: {what}: {problem}")
        if self.tracker.received is None or now - self.tracker.received > 0.5:
            raise RefusedError("not armed: the ball tracker is silent: start it, and check its address and clock")
        measured, velocity = joints(self._feedback)
        self.gate.arm(measured, now, velocity)
        self._arm_session_id = self.arm_session.session_id
        self._arm_restarted = False
        self._start = measured
        self._change(BridgeState.READY, now, "armed by the operator")

    def stop(self, now: float) -> None:
        """The operator's stop: slows down, holds, and ends DISARMED."""
        if self.state in (BridgeState.READY, BridgeState.ACTIVE):
            self.gate.brake(now)
            self._stopping_since = now
            self._abort_episodes("stopped", now)
            self._change(BridgeState.STOPPING, now, "stopped by the operator")
        self.event(now, Level.INFO, "operator", "stop")

    def reset(self, now: float) -> None:
        """FAULT to DISARMED. Raises RefusedError without a fault, while a cause is present or the robot still moves."""
        if self.state is not BridgeState.FAULT:
            raise RefusedError(f"nothing to reset: the state is {self.state.value}, without a fault")
        self.gate.reset(now)
        self._logged_faults = 0
        self._change(BridgeState.DISARMED, now, "fault reset by the operator")

    def check_homing(self) -> None:
        """Raise RefusedError unless the linear axes may search their references; where they are is unknown until then.

        The robot must be disarmed, and the arm, where it is measured to be, clear of everything wherever the axes go.
        """
        if self.state not in (BridgeState.DISARMED, BridgeState.FAULT) or not self.gate.at_rest:
            raise RefusedError(f"axes not homed: the state is {self.state.value}; stop the robot first")
        measured, _ = joints(self._feedback)
        if not np.isfinite(measured[list(ABB_JOINTS)]).all():
            raise RefusedError("axes not homed: the arm's position is not known; start its EGM session first")
        places = np.meshgrid(*(np.linspace(LIMITS.lower[i], LIMITS.upper[i], HOMING_PLACES) for i in FESTO_JOINTS))
        q = np.repeat(measured[:, None], places[0].size, axis=1)
        q[list(FESTO_JOINTS)] = [axis.ravel() for axis in places]
        gaps = self._geometry.gaps(q)
        if not gaps.min() > HOMING_GAP:
            row = self._geometry.rows[int(gaps.min(axis=1).argmin())]
            raise RefusedError(
                f"axes not homed: somewhere on their way {row} comes as near as {gaps.min():.3f} m, allowed is "
                f"{HOMING_GAP} m; jog the arm to its home pose first"
            )

    def estop(self, pressed: bool, now: float) -> None:
        """Tells the state of the emergency stop."""
        self.gate.estop(pressed, now)

    def discard(self, now: float) -> None:
        """Marks the ball in play, or the one before, as not to be used."""
        self.event(now, Level.INFO, "operator", "discard")
        for episode in [self.episode, *self._waiting]:
            if episode is not None:
                episode.discarded = True

    def failed(self, error: BaseException, now: float) -> None:
        """Brake for an error of the program, wherever it was raised, and latch it as INTERNAL."""
        sentence = f"{type(error).__name__}: {error}"
        self.gate.fault(Cause.INTERNAL, sentence, now)
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
        if feedback is None:
            return None
        hold = feedback.position, np.zeros(len(ABB_JOINTS))
        with self._guarded(now):
            position, velocity = self._arm_reference(feedback, now) or hold
            return self.arm_session.reply(position, velocity, now)
        with self._guarded(now):
            return self.arm_session.reply(*hold, now)
        return None

    def _arm_reference(self, feedback: ArmFeedback, now: float) -> tuple[np.ndarray, np.ndarray] | None:
        """Position (6,) and velocity (6,) for the arm at ``now``; None: hold the measured place."""
        if self._feedback.arm.add(feedback.received, feedback.position):
            position, velocity = joints(self._feedback)
            self._log(Joints(feedback.received, position, velocity))
        # Where the old reference would lead a controller that was started anew, nobody has asked for.
        self._arm_restarted |= feedback.sequence < self._arm_sequence
        self._arm_sequence = feedback.sequence
        if self.gate.state is GateState.DISARMED or self._arm_restarted or not np.isfinite(self._start).all():
            return None
        rows = list(ABB_JOINTS)
        velocity = self.gate.velocity[rows]
        # A tick that is overdue must not let the reference run away.
        since = min(max(now - self._tick_time, 0.0), 2.0 * self.gate.period)
        return self._start[rows] + velocity * since, velocity

    def tracker_received(self, datagram: bytes, source: str, now: float, port: int | None = None) -> None:
        """Take one datagram from an IP address and port; without a port none is checked."""
        with self._guarded(now):
            self._follow_ball(datagram, source, now, port)

    def _follow_ball(self, datagram: bytes, source: str, now: float, port: int | None) -> None:
        sample = self.tracker.receive(datagram, source, now, port)
        if sample is None or sample.position is None:
            return
        self._log(Ball(sample.captured, now, sample.position, sample.ball))
        if self.episode is not None and not self.episode.over and sample.ball == self.episode.ball:
            self._tracks[self.episode.number].append((sample.captured, *sample.position))
        following = [e for e in (self.episode, *self._waiting) if e is not None]
        if following:
            blade = self._blade(sample.captured)
            for episode in following:
                episode.follow(sample, blade, now)

    def axes_received(self, position: np.ndarray, received: float) -> None:
        """The linear axes' newest position (2,) [m], as it was at ``received``."""
        if received > self._axes_received:
            self._axes_received = received
            self._feedback.axes.add(received, position)

    def _blade(self, time: float) -> np.ndarray:
        """The blade's centre (3,) [m] at ``time``."""
        axes, arm = self._feedback.axes.at(time), self._feedback.arm.at(time)
        if axes is None or arm is None:
            return np.full(3, np.inf)
        return self._geometry.middle(BLADE, np.concatenate([axes, arm]))

    # The control tick

    def tick(self, deadline: float, now: float) -> np.ndarray:
        """One control period: observe, decide, pass the gate, hand over to the devices; the sent velocity (8,)."""
        self.counts.ticks += 1
        self.policy_seconds, request = 0.0, np.zeros(N_JOINTS)
        measured, measured_velocity = np.full(N_JOINTS, np.nan), np.zeros(N_JOINTS)
        with self._guarded(now):
            measured, measured_velocity = joints(self._feedback)
            request = self._decide(now)
        sent = self.gate.command(request, measured, measured_velocity, now)
        self._start = self.gate.start if self.gate.engaged else measured
        self._tick_time = now
        with self._guarded(now):
            if self.gate.engaged:
                festo = list(FESTO_JOINTS)
                self.axes.command(self._start[festo], sent.velocity[festo], now)
        with self._guarded(now):
            self._after(now)
        with self._guarded(now):
            ages, n = self._ages(now), self.counts.ticks
            self._log(
                Tick(n, now, now - deadline, self.policy_seconds, ages["ball"], ages["axes"], ages["arm"]),
                Command(n, now, request, sent.velocity, self._start),
            )
        if self.unlogged > self._reported_unlogged:
            self._reported_unlogged = self.unlogged
            self.event(now, Level.WARNING, "log_error", json_text({"unlogged": self.unlogged}))
        return sent.velocity

    def _decide(self, now: float) -> np.ndarray:
        """The requested velocity (8,), after a look at the devices and at the balls."""
        self._watch(now)
        self._settle_episodes(now)
        if self.paused:
            self._last_ball = self.tracker.ball  # a ball that came while it held is not taken in mid-flight
        if self.state is BridgeState.READY and not self.paused and self.at_home and in_play(self.tracker, now):
            if self.tracker.ball != self._last_ball:
                self._begin(now)
        if self.state is BridgeState.ACTIVE:
            return self._play(now, self.episode, self._policy)
        return self._homeward() if self.state is BridgeState.READY else np.zeros(N_JOINTS)

    def _ages(self, now: float) -> dict[str, float]:
        arm, seen = self.arm_session.feedback, self.tracker.received
        return {
            "arm": math.inf if arm is None else now - arm.received,
            "axes": now - self._axes_received,
            "ball": math.inf if seen is None else now - seen,
        }

    def _watch(self, now: float) -> None:
        """Tells the gate what is wrong with the devices."""
        ages = self._ages(now)
        since_tick = 0.0 if self._last_tick == -math.inf else now - self._last_tick
        self._last_tick = now
        playing = self.state is BridgeState.ACTIVE
        self.gate.check(now, ages["arm"], ages["axes"], ages["ball"], playing, since_tick)
        arm, axes = self.arm_session.problem(now), self.axes.problem(now)
        self.gate.condition(Cause.ARM_NOT_READY, arm is not None, arm or "", now)
        self.gate.condition(Cause.AXIS_LOST, axes is not None, axes or "", now)
        armed = self._state in (BridgeState.READY, BridgeState.ACTIVE)
        if armed and self.arm_session.session_id != self._arm_session_id:
            self._arm_session_id = self.arm_session.session_id
            self.gate.fault(Cause.ARM_NOT_READY, "the arm's EGM session started anew: its reference is lost", now)
        log_failure = self.recorder.failure or self._log_failure
        if armed and log_failure:
            self.gate.fault(Cause.INTERNAL, log_failure, now)

    def _begin(self, now: float) -> None:
        self.counts.balls += 1
        self._last_ball = self.tracker.ball
        self.episode = Episode(self.counts.balls, self.tracker.ball, now, self.policy_version)
        self._tracks[self.counts.balls] = [(t, *x) for t, x in self.tracker.track.samples()]
        if self._policy is not None:  # arming has looked
            self._policy.reset()
        self._log(episode_start(now, self.episode.number, ball=self.episode.ball))
        self._change(BridgeState.ACTIVE, now, f"ball {self.episode.ball}")

    def _play(self, now: float, episode: Episode | None, policy: Policy | None) -> np.ndarray:
        """The policy's request (8,)."""
        if episode is None or policy is None:
            self.gate.fault(Cause.INTERNAL, "neither ball nor policy to play", now)
            return np.zeros(N_JOINTS)
        observation = observe(self._feedback, self.config.delays, now)
        if observation is None:
            if self._feedback.ball.at(now - self.config.delays.ball) is None:
                episode.over = True  # frames come, as the gate has checked, but the ball is out of sight
            else:
                self.gate.fault(Cause.INTERNAL, "no joint positions to observe while a ball is in play", now)
            return np.zeros(N_JOINTS)
        began = perf_counter()
        try:
            action = np.asarray(policy.step(observation), float)
            if action.shape != (N_JOINTS,):
                raise ValueError(f"an action of shape {action.shape}, needed is ({N_JOINTS},)")
        except Exception as error:  # whatever a policy does, the robot is braked
            self.gate.fault(Cause.MALFORMED_COMMAND, f"the policy failed: {type(error).__name__}: {error}", now)
            return np.zeros(N_JOINTS)
        self.policy_seconds = perf_counter() - began
        episode.steps += 1
        self._log(Observation(self.counts.ticks, now, observation), Action(self.counts.ticks, now, action))
        return action * self._policy_limit

    def _homeward(self) -> np.ndarray:
        """Velocity (8,) towards the home pose: as fast as it can still be braked, and slower than the policy may."""
        error = self._home - self.gate.reference
        distance = np.abs(error)
        speed = np.minimum(self._home_speed, np.sqrt(2.0 * self._home_braking * distance))
        speed = np.minimum(speed, distance / (3.0 * self.gate.period))
        return np.where(distance < 1e-4, 0.0, np.sign(error) * speed)

    def _settle_episodes(self, now: float) -> None:
        """Takes the policy off a ball that is over and reports the outcomes that are known."""
        if self.episode is not None:
            self.episode.check(now, MAX_STEPS)
            if self.episode.over:
                self._waiting.append(self.episode)
                self.episode = None
                if self._state is BridgeState.ACTIVE:
                    self._change(BridgeState.READY, now, "ball over")
        while self._waiting:
            episode = self._waiting[0]
            episode.check(now, MAX_STEPS)
            if not episode.decided:
                break
            self._waiting.popleft()
            self._report(episode.summary(), now)

    def _report(self, summary: EpisodeSummary, now: float) -> None:
        self.counts.outcomes[summary.outcome] += 1
        self.counts.rally = self.counts.rally + 1 if summary.outcome == "returned" else 0
        self.counts.longest_rally = max(self.counts.longest_rally, self.counts.rally)
        details = {k: v for k, v in asdict(summary).items() if k not in ("number", "outcome")}
        self._log(episode_end(now, summary.number, summary.outcome, {}, **details))
        try:
            if self._on_episode is not None:
                self._on_episode(summary)
        finally:
            self._tracks.pop(summary.number, None)

    def _abort_episodes(self, cause: str, now: float) -> None:
        for episode in (self.episode, *self._waiting):
            if episode is not None:
                episode.abort(cause, now)

    def _after(self, now: float) -> None:
        """Follows the gate's state."""
        if self.gate.state is GateState.FAULT:
            faults = self.gate.faults
            if len(faults) > self._logged_faults:
                for fault in faults[self._logged_faults :]:
                    self.event(
                        now, Level.ERROR, "fault", json_text({"cause": fault.cause.value, "text": fault.sentence})
                    )
                first, self._logged_faults = self._logged_faults == 0, len(faults)
                if first:
                    self._abort_episodes(faults[0].cause.value, now)
                    self._change(BridgeState.DISARMED, now, f"fault: {faults[0].sentence}")
            if self.gate.at_rest:
                self.axes.stop()
        elif self._state is BridgeState.STOPPING and self.gate.at_rest:
            self.axes.stop()
            if self.gate.settled or now - self._stopping_since > LONGEST_STOP:
                self.gate.disarm(now)
                self._change(BridgeState.DISARMED, now, "at rest")

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

    def ball_track(self, summary: EpisodeSummary) -> np.ndarray:
        """(n, 4) t [s], x, y, z [m] of the incoming ball until it was played; in ``on_episode`` only."""
        return np.array(self._tracks.get(summary.number, [])).reshape(-1, 4)

    def joint_table(self) -> list[tuple[str, float, float]]:
        """Name, measured position and commanded velocity of every joint, for the view."""
        measured, _ = joints(self._feedback)
        return list(zip(JOINT_NAMES, measured.tolist(), self.gate.velocity.tolist(), strict=True))
