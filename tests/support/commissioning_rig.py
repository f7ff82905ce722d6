"""The emulated robot and the person beside it, for commissioning: in lock-step, or by the rig's processes."""

from __future__ import annotations

import multiprocessing
from contextlib import suppress

import numpy as np

from robot_io.control import messages
from robot_io.control.interfaces import BridgeConfig
from robot_io.control.owner import Owner
from robot_io.control.timings import Timings
from robot_io.emulator.arm import ArmStateError
from robot_io.emulator.config import RigParams
from robot_io.policy.numpy_policy import StreamingPolicy
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
        self.status = None
        ours, self._theirs = multiprocessing.Pipe()
        self._owner = Owner(ours, self.rig.bridge, _Thread(self.rig.axes), StreamingPolicy)

    def send(self, request):
        self._owner.obey(request, self.rig.now)

    def messages(self, seconds):
        rig = self.rig
        end = rig.now + seconds
        while True:
            self._owner.report(rig.now, self._status)
            while self._theirs.poll():
                yield self._theirs.recv()
            if rig.now >= end - 1e-9:
                return
            rig.run(min(0.02, end - rig.now))

    def _status(self, now):
        self.status = messages.Status.of(self.rig.bridge, _Thread(self.rig.axes), Timings(), 0, now, False)
        return self.status


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
        with suppress(ArmStateError):  # it still brakes
            self._rig.arm.switch_on()

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
