"""The program that started the control process and holds the other end of its pipe: what it asks, what it is told."""

from __future__ import annotations

import select
from collections import deque
from collections.abc import Callable
from multiprocessing.connection import Connection

import numpy as np

from robot_io.control import messages
from robot_io.control.bridge import Bridge
from robot_io.control.commissioning.dry import DryAxes
from robot_io.control.commissioning.homing import prepare
from robot_io.control.commissioning.mark import Stay
from robot_io.control.episode import EpisodeSummary
from robot_io.control.interfaces import BridgeState
from robot_io.control.interfaces import Policy as StepPolicy
from robot_io.devices.festo import AxesThread
from robot_io.devices.fixed_base import FixedBase
from robot_io.errors import RefusedError, format_error
from robot_io.policy.policy import Policy
from robot_io.safety.owner_watch import OwnerWatch

STATUS_PERIOD = 0.2  # [s]


class Owner:
    """Requests become calls of the bridge, which refuses what is not safe. Times are the bridge's, passed in.

    compile_policy  the policy in the form that the loop calls
    quits           the owner has asked for the end, or is gone
    """

    def __init__(
        self,
        pipe: Connection,
        bridge: Bridge,
        axes: AxesThread | DryAxes | FixedBase,
        compile_policy: Callable[[Policy], StepPolicy],
    ) -> None:
        self.pipe, self.quits = pipe, False
        self._bridge, self._axes, self._compile = bridge, axes, compile_policy
        self._unsent: deque[messages.Message] = deque()
        self._watch = OwnerWatch()
        self._status_at, self._muting = 0.0, False
        bridge.play.on_episode = self._played
        bridge.play.on_rally = lambda summary: self.tell(messages.RallyOver(summary))

    def listen(self, now: float) -> None:
        """Take the owner's messages; a pipe that ends means stop."""
        try:
            while not self.quits and self.pipe.poll():
                self.obey(self.pipe.recv(), now)
        except (EOFError, OSError):
            self.quits = True

    def obey(self, request: messages.Request, now: float) -> None:
        """Carry out one request; what is refused is answered with the reason."""
        bridge = self._bridge
        self._watch.heard()
        try:
            match request:
                case messages.Beat(absence):
                    may = bridge.paused and not bridge.config.jog and not self._axes.homing
                    self._watch.heard(absence if may else 0.0)
                case messages.Arm():
                    bridge.arm(now)
                case messages.Prepare():
                    prepare(self._axes, lambda: bridge.check_homing(now))
                case messages.Stop():
                    bridge.stop(now)
                case messages.Reset():
                    bridge.reset(now)
                case messages.Discard():
                    self.tell(messages.Discarded(bridge.discard(now)))
                case messages.Jog(step, share, pulled):
                    bridge.jog(np.array(step), share, pulled)
                case messages.Trace():
                    self.tell(messages.Traced(*map(np.array, zip(*bridge.trace, strict=True))))
                case messages.Mute(seconds):
                    bridge.mute.begin(now, seconds, bridge.config.jog and bridge.state is BridgeState.DISARMED)
                    self._muting = True
                case messages.Mark():
                    seen = bridge.tracker.track, bridge.feedback.axes, bridge.feedback.arm
                    self.tell(messages.Marked(*(Stay.of(history, now) for history in seen)))
                case messages.Pause(on):
                    bridge.paused = on or bridge.config.jog
                case messages.SetPolicy(policy, version):
                    bridge.check_exchange()  # before a policy is built, which takes its time
                    bridge.set_policy(self._compile(policy), version)
                    self.tell(messages.PolicySet(version))
                case messages.Quit():
                    self.quits = True
                case _:
                    raise RefusedError(f"unknown request {request!r}")
        except RefusedError as error:
            self.tell(messages.Refused(request, error))
        except Exception as error:  # a request that cannot be carried out must not end the play
            self.tell(messages.Refused(request, RefusedError(f"{type(request).__name__}: {format_error(error)}")))

    def watch(self, now: float) -> None:
        """At each control tick: an armed robot, or axes that search a zero, stop when the owner falls silent."""
        silent = self._watch.ticked(now)
        if silent and (self._bridge.state in (BridgeState.READY, BridgeState.ACTIVE) or self._axes.homing):
            self._bridge.stop(now, silent)

    def report(self, now: float, status: Callable[[float], messages.Status]) -> None:
        """After each control tick: sends what waits, and the status of the moment now and then."""
        if self._muting and not self._bridge.mute.active(now):
            self._muting = False
            self.tell(messages.Muted(self._bridge.mute.lasted))
        if now >= self._status_at:
            self._status_at = now + STATUS_PERIOD
            if not self._unsent:
                self.tell(status(now))
        self.flush()

    def tell(self, message: messages.Message) -> None:
        """Send a message with the next ``report`` or ``flush``."""
        self._unsent.append(message)

    def flush(self) -> None:
        """Send what fits without waiting."""
        try:
            while self._unsent and select.select([], [self.pipe], [], 0.0)[1]:
                self.pipe.send(self._unsent.popleft())
        except (OSError, ValueError):
            self._unsent.clear()

    def _played(self, summary: EpisodeSummary) -> None:
        self.tell(messages.Played(summary, self._bridge.play.track(summary.number)))
