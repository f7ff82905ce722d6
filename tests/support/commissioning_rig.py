"""The emulated robot and the person beside it, for commissioning: in lock-step, or by the rig's processes."""

from __future__ import annotations

from collections import deque

import numpy as np

from robot_io.control import messages
from robot_io.control.commissioning.homing import prepare
from robot_io.control.commissioning.mark import Stay
from robot_io.control.interfaces import BridgeConfig
from robot_io.control.timings import Timings
from robot_io.emulator.arm import ArmStateError
from robot_io.emulator.config import RigParams
from robot_io.errors import RefusedError
from robot_io.safety.config import SafetyConfig
from tests.support.lockstep_play import lockstep

ANSWERS = {
    "robotware": "6.15.01",
    "firmware": "4.2.1",
    "module": "66",
    "tool": "0 0 326.3",
    "limits_gantry_x": "-0.99 0.99",
    "limits_gantry_y": "-0.49 0.49",
    "calibration": "yes",
}


class _Thread:
    """The axes as their thread shows them."""

    cycles = late = 0

    def __init__(self, axes):
        self.axes = axes

    def __getattr__(self, name):
        return getattr(self.axes, name)


class LockStepSession:
    """A control process's answers, with the bridge in lock-step instead of the process: time passes in ``messages``."""

    def __init__(self, params: RigParams, scale=0.1):
        self.rig = lockstep(params=params, config=BridgeConfig(jog=True), safety=SafetyConfig(speed_scale=scale))
        self.status, self._told, self._status_at, self._muting = None, deque(), 0.0, False

    def send(self, request):
        bridge, now = self.rig.bridge, self.rig.now
        try:
            match request:
                case messages.Arm():
                    bridge.arm(now)
                case messages.Prepare():
                    prepare(_Thread(self.rig.axes), lambda: bridge.check_homing(now))
                case messages.Stop():
                    bridge.stop(now)
                case messages.Reset():
                    bridge.reset(now)
                case messages.Jog(step, share, pulled):
                    bridge.jog(np.array(step), share, pulled)
                case messages.Mark():
                    seen = bridge.tracker.track, bridge.feedback.axes, bridge.feedback.arm
                    self._told.append(messages.Marked(*(Stay.of(history, now) for history in seen)))
                case messages.Trace():
                    self._told.append(messages.Traced(*map(np.array, zip(*bridge.trace, strict=True))))
                case messages.Mute(seconds):
                    bridge.mute(now, seconds)
                    self._muting = True
        except RefusedError as error:
            self._told.append(messages.Refused(request, error))

    def messages(self, seconds):
        rig = self.rig
        end = rig.now + seconds
        while True:
            if rig.now >= self._status_at:
                self._status_at = rig.now + 0.2
                self.status = messages.Status.of(rig.bridge, _Thread(rig.axes), Timings(), 0, rig.now, False)
                self._told.append(self.status)
            if self._muting and not rig.bridge.muting(rig.now):
                self._muting = False
                self._told.append(messages.Muted(rig.bridge.muted))
            while self._told:
                yield self._told.popleft()
            if rig.now >= end - 1e-9:
                return
            rig.run(min(0.02, end - rig.now))


class LockStepHands:
    """The person's hands at the robot in lock-step."""

    def __init__(self, rig):
        self._rig = rig

    def hold(self, place):
        self._rig.world.held = place

    def clip(self, on):
        self._rig.world.on_blade = on

    def throw(self, on):
        self._rig.throwing = on

    def switch_on(self):
        for action in (self._rig.arm.motors_on, self._rig.arm.start_rapid, self._rig.arm.start_egm):
            try:
                action()
            except ArmStateError:
                pass

    def press_stop(self):
        if self._rig.params.hidden.stop_wired:
            self._rig.arm.motors_off()
            for emulator in self._rig.emulators:
                emulator.cut_power()


class Person:
    """Does what is asked for, and answers.

    hands  ``LockStepHands``, or the rig
    """

    def __init__(self, hands, **answers):
        self._hands, self._answers, self.said, self.done = hands, ANSWERS | answers, [], []

    def ask(self, key, question):
        return self._answers[key]

    def say(self, text):
        self.said.append(text)
        print(text, flush=True)

    def do(self, key, instruction):
        self.done.append(key)
        kind, *numbers = key.split()
        match kind:
            case "hold":
                self._hands.hold(np.array([float(x) for x in numbers]))
            case "release":
                self._hands.hold(None)
            case "clip" | "unclip":
                self._hands.clip(kind == "clip")
            case "press":
                self._hands.press_stop()
            case "switch_on":
                self._hands.switch_on()
            case "throw" | "stop_throwing":
                self._hands.throw(kind == "throw")
