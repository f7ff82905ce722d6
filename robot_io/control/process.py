"""The control process: one thread around select() for the arm, the tracker, the operator and the 75 Hz tick.

Started by ``start``; requests and reports travel over a pipe: ``robot_io.control.messages``.
When the owner goes away, the robot is stopped and the process ends. An exception ends it too, once the robot stands.
"""

from __future__ import annotations

import json
import multiprocessing
import select
import signal
import time
from contextlib import ExitStack, closing, suppress
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess

import numpy as np

from robot_io import log
from robot_io.contract import n_parameters
from robot_io.control import messages, realtime
from robot_io.control.bridge import Bridge, BridgeConfig
from robot_io.control.bridge import Policy as StepPolicy
from robot_io.control.commissioning.dry import DryArm, DryAxes
from robot_io.control.config import RobotConfig, linear_axes
from robot_io.control.interfaces import ControlOptions as ControlOptions
from robot_io.control.owner import Owner
from robot_io.control.timings import Timings
from robot_io.devices.egm.session import EgmConfig, EgmSession
from robot_io.devices.fixed_base import FixedBase
from robot_io.devices.tracker import Tracker
from robot_io.devices.udp import UdpSocket
from robot_io.errors import format_error
from robot_io.policy import artefact as artefacts
from robot_io.policy.backends import choose, make_policy
from robot_io.policy.policy import Policy
from robot_io.safety.clearance import RobotGeometry
from robot_io.safety.config import SLACK
from robot_io.safety.gate import SafetyGate

STOP_TIME = 2.0  # [s] for coming to rest before the process ends
AFTER_REST = 0.05  # [s] in which the arm is told to hold the place where it stands


def start(config: RobotConfig, options: ControlOptions) -> tuple[BaseProcess, Connection]:
    """Starts the process; the first message on the pipe is "ready" or "failed"."""
    context = multiprocessing.get_context("spawn")
    mine, theirs = context.Pipe()
    process = context.Process(target=_main, args=(config, options, theirs), name="control")
    process.start()
    theirs.close()
    return process, mine


def _main(config: RobotConfig, options: ControlOptions, pipe: Connection) -> None:
    realtime.leave_terminal()  # Ctrl-C goes to the owner, who asks for an orderly stop
    try:
        control = Control(config, options, pipe)
    except Exception as error:
        pipe.send(messages.Failed(f"{error}" or type(error).__name__))
        return
    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT):
        signal.signal(number, lambda *_: control.quit())
    with control:
        control.run()


class Control:
    """Sockets, thread and recorder around a ``Bridge``; use as a context manager."""

    def __init__(self, config: RobotConfig, options: ControlOptions, pipe: Connection) -> None:
        self._config, self._options = config, options
        arm, found = config.arm, config.calibration.robot
        contract = options.contract  # not the policy's: it must not bring the limits that guard it
        loaded = None if options.artefact is None else artefacts.load(options.artefact, contract)
        config.check_joints(contract)
        if loaded is None:
            seen = contract.n_observation
            chosen = Policy(np.zeros(n_parameters(contract.n_joints)), np.zeros(seen), np.ones(seen))
            backend, self._computed = "numpy", "no policy given: at play the robot stands still"
        else:
            chosen = loaded.policy
            backend, self._computed = choose(options.backend, chosen, contract)
        policy = make_policy(backend, chosen, contract)
        self.timings = Timings()
        self._opened = ExitStack()  # closed in the opposite order, so that the axes stop before the log ends
        try:
            opened = self._opened.enter_context
            self._arm_socket = opened(UdpSocket(arm.host, arm.port, "arm"))
            self._tracker_socket = opened(UdpSocket(config.tracker.host, config.tracker.port, "tracker"))
            recorder: log.SessionRecorder = log.NullRecorder()
            if options.log_folder is not None:
                metadata = {
                    "artefact": options.artefact,
                    "artefact_sha256": loaded.digest if loaded else "",
                    "robot": config.name,
                    "robot_base": [found.base_position, found.base_rotation],
                }
                recorder = log.Recorder(
                    options.log_folder,
                    options.log_name,
                    metadata | dict(options.metadata),
                    dict(options.attachments),
                    contract,
                )
            self._recorder = opened(closing(recorder))
            geometry = RobotGeometry.of(contract).moved(found.base)
            gate = SafetyGate(contract.limits, geometry=geometry, config=config.safety)
            zeros = found.zeros(len(contract.arm))
            egm = EgmConfig(arm.controller, arm.controller_port, timeout=arm.timeout, zeros=zeros)
            home = gate.geometry.home
            self._session = DryArm(egm, home[list(contract.arm)]) if options.dry else EgmSession(egm)
            axes = (
                FixedBase()
                if not contract.carrying
                else DryAxes(home[list(contract.carrying)])
                if options.dry
                else None
            )
            self._axes = opened(closing(axes or linear_axes(config, contract)))
            beyond = config.axes_motion.overtravel
            play = BridgeConfig(
                config.delays,
                box=options.box,
                base=found.base,
                jog=options.jog,
                overtravel=beyond,
                contract=contract,
                balls_needed=0 if options.dry else options.balls_needed,
            )
            tracker = Tracker(config.tracker, config.calibration)
            self.bridge = Bridge(self._session, self._axes, tracker, gate, policy, play, recorder)
            self.owner = Owner(pipe, self.bridge, self._axes, lambda chosen: make_policy(backend, chosen, contract))
            self._warm_up(policy, gate)
        except BaseException:
            self._opened.close()
            raise
        self._period = 1.0 / config.rate

    def __enter__(self) -> Control:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._opened.close()

    @staticmethod
    def _warm_up(policy: StepPolicy, gate: SafetyGate) -> None:
        """First calls import, load machine code and allocate: not in the loop."""
        for _ in range(20):
            policy.step(np.zeros(3 + len(gate.geometry.joints)))
        way = np.zeros((len(gate.geometry.joints), 2))
        gate.geometry.gaps(way)
        gate.geometry.first_too_close(way, gate.margins, SLACK)
        np.linalg.lstsq(np.eye(4), np.ones(4), rcond=None)  # once memory is locked, LAPACK's buffer takes 0.1 s
        policy.reset()

    def run(self) -> None:
        """Until told to quit."""
        report = realtime.prepare(self._config.realtime.priority, self._config.realtime.lock_memory)
        self._axes.start()  # afterwards: a thread inherits the scheduling of the one that starts it
        if self._options.dry:
            self._take_axes()  # known at once
        self.owner.pipe.send(messages.Ready([*report, self._computed]))
        self.bridge.event(time.monotonic(), log.Level.INFO, "policy", self._computed)
        # What waited while this process started would be taken for a slow clock, what found no room for lost packets.
        while any([*self._tracker_socket.drain(), *self._arm_socket.drain()]):
            pass
        try:
            self._loop()
        except BaseException as error:  # nothing leaves the loop before the robot stands
            self._bring_to_rest(error)
            self.owner.tell(messages.Failed(format_error(error)))
            raise
        finally:
            self.owner.tell(messages.Ended(self.timings.summary()))
            self.owner.flush()

    def quit(self) -> None:
        """Stop the robot and end the loop when it stands; from a signal handler too."""
        self.owner.quits = True

    def _bring_to_rest(self, error: BaseException) -> None:
        """Brake through the gate and answer the arm until the robot stands, with as little of the loop as possible.

        Each step is by itself: whatever fails for ever, the others go on, and an arm without ticks is slowed down.
        """
        now = time.monotonic()
        with suppress(BaseException):
            self.bridge.failed(error, now)
        with suppress(BaseException):  # where even the fault cannot be latched
            self.bridge.gate.brake(now)
        deadline, end = now, now + STOP_TIME
        while now < end:
            try:
                if self.bridge.gate.settled:
                    end = min(end, now + AFTER_REST)
                if select.select([self._arm_socket.fileno()], [], [], max(deadline - now, 0.0))[0]:
                    self._answer_arm()
            except BaseException:
                time.sleep(0.001)
            now = time.monotonic()
            if now >= deadline:
                deadline = now + self._period
                with suppress(BaseException):
                    self._take_axes()
                with suppress(BaseException):
                    self.bridge.tick(now, now)

    def _loop(self) -> None:
        spin, bridge = self._config.realtime.spin, self.bridge
        arm, tracker, pipe = self._arm_socket.fileno(), self._tracker_socket.fileno(), self.owner.pipe.fileno()
        deadline = time.monotonic() + self._period
        end: float | None = None
        while True:
            now = time.monotonic()
            watched = [arm, tracker] if self.owner.quits else [arm, tracker, pipe]
            ready, _, _ = select.select(watched, [], [], max(deadline - now - spin, 0.0))
            if arm in ready:
                self._answer_arm()
            if tracker in ready:
                now = time.monotonic()
                for datagram, (host, port) in self._tracker_socket.drain():
                    bridge.tracker_received(datagram, host, now, port)
            if pipe in ready:
                self.owner.listen(time.monotonic())
            now = time.monotonic()
            if now < deadline - spin:
                continue
            while now < deadline:
                now = time.monotonic()
            self._tick(deadline, now)
            deadline += self._period
            missed = int((time.monotonic() - deadline) / self._period)
            if missed > 0:
                self.timings.missed += missed
                deadline += missed * self._period
                self.bridge.event(now, log.Level.WARNING, "ticks_missed", json.dumps({"missed": missed}))
            if self.owner.quits:
                if end is None:
                    end = now + STOP_TIME
                    bridge.stop(now)
                if bridge.gate.settled:
                    end = min(end, now + AFTER_REST)
                if now >= end:
                    return

    def _answer_arm(self) -> None:
        began = time.monotonic()
        # Everything that waits is read and only the newest is answered: an arm takes one message a cycle.
        if any([self._session.receive(*packet, began) for packet in self._arm_socket.drain()]):
            reply = self.bridge.arm_received(began)
            endpoint = self._session.endpoint
            if reply is not None and endpoint is not None:
                self._arm_socket.send(reply, endpoint)
                self.timings.reply.add(time.monotonic() - began)

    def _take_axes(self) -> None:
        if isinstance(self._axes, DryAxes | FixedBase):
            now = time.monotonic()
            self._axes.cycle(now)
            if isinstance(self._session, DryArm):
                self._session.pretend(now, self.bridge.gate.engaged)
                self.bridge.arm_received(now)
        state = self._axes.state
        if state is not None:
            self.bridge.axes_received(state.position, state.received)

    def _tick(self, deadline: float, now: float) -> None:
        self.owner.watch(now)
        self._take_axes()
        self.bridge.tick(deadline, now)
        self.timings.lateness.add(now - deadline)
        if self.bridge.policy_seconds:
            self.timings.policy.add(self.bridge.policy_seconds)
        self.timings.tick.add(time.monotonic() - now)
        self.owner.report(now, self.status)

    def status(self, now: float) -> messages.Status:
        """State of everything at ``now``."""
        return messages.Status.of(self.bridge, self._axes, self.timings, self._recorder.dropped, now, self._options.dry)
