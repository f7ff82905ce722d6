"""The operator's keys in a session, and the one after a fault: axes on, reset, home, arm, each when it is safe."""

from __future__ import annotations

import time

from experiments.deploy.control_session import ControlSession
from experiments.deploy.operator_console import KEYS, RECOVER, Keyboard, View
from robot_io.control.messages import Arm, Message, Prepare, Refused, Request, Reset, Status
from robot_io.safety.faults import Cause

LONGEST = 20.0  # [s] from the key, or from the end of the axes' search, until the robot is armed


class Recovery:
    """Steps from a fault to an armed robot, one per status of the control process.

    Repairs (a cable, the emergency stop, the arm's controller) bring hands near the robot. It therefore homes and arms
    by itself only if, from the key on, nothing was missing but what Prepare does: power and references of the axes.
    Otherwise it ends after the reset, and ``message`` asks for the operator's next key.

    status    the newest at the key, None: none has come
    emulated  nothing real moves: it waits for whatever is missing, and continues by itself
    message   for the operator at the end; empty: nothing
    """

    def __init__(self, now: float, status: Status | None, emulated: bool = False) -> None:
        self.done, self.message = False, ""
        self._emulated = emulated
        self._by_itself = emulated or (status is not None and only_unprepared(status))
        self._end, self._refusal = now + LONGEST, ""
        self._prepared = self._reset = False  # asked for once
        self._again = False  # Prepare, which was refused or could not home before the reset

    def refused(self, refusal: Refused) -> bool:
        """Take a refusal; True when it ends the recovery."""
        if not isinstance(refusal.request, Prepare):
            return True
        self._again, self._refusal = True, refusal.sentence
        return False

    def step(self, status: Status, now: float) -> Request | None:
        """Request that is due in this state; None: wait. Raises TimeoutError with what is missing."""
        self._by_itself = self._emulated or (self._by_itself and only_unprepared(status))
        waits = [status.missing, *status.present.values(), status.unproven]
        reasons = "; ".join(dict.fromkeys(filter(None, waits)))
        if status.homing:  # which has a time limit of its own
            self._end = now + LONGEST
        if now > self._end:
            reasons = "; ".join(filter(None, [self._refusal, reasons]))
            raise TimeoutError(f"not recovered within {LONGEST:g} s: {reasons or status.state}")
        if status.state in ("ready", "active"):  # a fault that comes later is not the one that the key was for
            self._end_with("nothing to recover: the robot is armed")
            return None
        if not self._prepared:
            self._prepared = True
            if status.state != "fault" and not self._by_itself:
                self._end_with(f"not armed: {reasons}")
            return Prepare()
        if status.state == "fault":
            return self._leave_fault(status)
        if not self._by_itself:
            if reasons != f"arm: {status.ramping}":  # that passes by itself
                self._end_with(f"reset, not armed: {reasons}" if reasons else "all is well: press a to arm")
            return None
        if self._again and status.axes:
            self._again = False
            return Prepare()
        if reasons or status.state != "disarmed":
            return None
        self.done = True
        return Arm()

    def _leave_fault(self, status: Status) -> Request | None:
        if not status.present and not self._reset:
            self._reset = self._again = True
            return Reset()
        if status.present and self._again and not self._reset:  # axes whose cable was out answer later
            self._again = False
            return Prepare()
        return None

    def _end_with(self, message: str) -> None:
        self.done, self.message = True, message


def only_unprepared(status: Status) -> bool:
    """Nothing is missing or present but axes without power or reference, which Prepare gives them."""
    others = set(status.present) - {Cause.AXIS_LOST.value}
    return not (status.arm or status.ramping or status.tracker or others) and (not status.axes or status.preparable)


class Controls:
    """Keys and view of a session, with the recovery that a key begins. emulated: as of ``Recovery``."""

    def __init__(self, session: ControlSession, keyboard: Keyboard, view: View, emulated: bool) -> None:
        self._session, self._keyboard, self.view, self._emulated = session, keyboard, view, emulated
        self._recovery: Recovery | None = None

    def take(self, message: Message) -> None:
        """Shows a message of the session, and does the step of a recovery that is due."""
        self.view.take(message)
        if self._recovery is not None and not self._goes_on(self._recovery, message):
            self._recovery = None

    def _goes_on(self, recovery: Recovery, message: Message) -> bool:
        """Does the step that is due; False when the recovery has ended."""
        if isinstance(message, Refused):
            return not recovery.refused(message)
        if not isinstance(message, Status):
            return True
        try:
            request = recovery.step(message, time.monotonic())
        except TimeoutError as error:
            self.view.say(str(error))
            return False
        if request is not None:
            self._session.send(request)
        if recovery.message:
            self.view.say(recovery.message)
        return not recovery.done

    def pressed(self) -> str | None:
        """The key that was pressed, if any; its request has been sent."""
        key = self._keyboard.pressed()
        if key is not None:  # whatever it is, the operator wants something else
            begins = key == RECOVER
            self._recovery = Recovery(time.monotonic(), self._session.status, self._emulated) if begins else None
        if key in KEYS:
            if (request := KEYS[key].request) is not None:
                self._session.send(request)
            self.view.say(KEYS[key].text)
        return key
