"""Two emulated axes, ideal plants behind them and ``FestoAxes``, in one process and in lock-step."""

from __future__ import annotations

import numpy as np

from robot_io.devices.festo import AxesConfig, Axis, CmmtProfile, FestoAxes, FhppProfile
from robot_io.emulator.axes import AxisEmulator

STEP, CYCLE = 0.001, 0.008  # [s]
PROFILES = {
    "cmmt": ("cmmt", CmmtProfile()),
    "fhpp": ("fhpp", FhppProfile()),
    "fhpp continuous": ("fhpp", FhppProfile(continuous=True)),
}
LOWER, UPPER = (-1.0, -0.5), (1.0, 0.5)


class LockStep:
    """position, velocity (2,): of the plants; ``each`` is called before every cycle with the time."""

    def __init__(self, profile="cmmt", start=(0.2, -0.1), config=None, kind=AxisEmulator, **emulator):
        name, codec = PROFILES[profile]
        self.emulators = [kind(name, **{"node_guard": 0.1, **emulator}) for _ in range(2)]
        self.axes = FestoAxes(
            [
                Axis(name, emulator, codec, lower, upper)
                for name, emulator, lower, upper in zip(("x", "y"), self.emulators, LOWER, UPPER, strict=True)
            ],
            config or AxesConfig(),
        )
        self.position, self.velocity = np.array(start), np.zeros(2)
        self.now, self.next_cycle = 0.0, 0.0
        self.cycling = True
        self.log: list[tuple] = []

    def run(self, seconds, each=None):
        end = self.now + seconds
        while self.now < end - 1e-9:
            if self.cycling and self.now >= self.next_cycle - 1e-9:
                if each is not None:
                    each(self.now)
                self.axes.cycle(self.now)
                self.next_cycle += CYCLE
            self.step()

    def step(self):
        self.velocity = np.array(
            [e.step(self.now, x, v) for e, x, v in zip(self.emulators, self.position, self.velocity, strict=True)]
        )
        self.log.append((self.now, *self.position, *self.velocity))
        self.position = self.position + self.velocity * STEP
        self.now += STEP

    def start(self):
        """Enables and homes."""
        self.run(0.05)
        self.axes.enable()
        self.run(0.3)
        self.axes.home()
        self.run(1.3)
        assert self.axes.problem(self.now) is None, self.axes.problem(self.now)
        return self

    @property
    def trace(self):
        """(samples, 5): time, positions, velocities."""
        return np.array(self.log)


class Stream:
    """Commands of a policy at 75 Hz that make ``velocity(t)`` (2,), integrated from ``start``."""

    def __init__(self, rig, velocity, rate=75.0, offset=0.0):
        self.rig, self.velocity, self.period = rig, velocity, 1.0 / rate
        self.origin = self.next = rig.now + offset
        self.reference, self.current = rig.position.copy(), np.zeros(2)
        self.log: list[tuple] = []

    def __call__(self, now):
        while now >= self.next - 1e-9:
            if self.next > self.origin:
                self.reference = self.reference + self.current * self.period
            self.current = np.asarray(self.velocity(self.next - self.origin), float)
            self.log.append((self.next, *self.reference, *self.current))
            self.rig.axes.command(self.reference, self.current, self.next)
            self.next += self.period

    @property
    def trace(self):
        return np.array(self.log)
