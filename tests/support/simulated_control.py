"""The control process on a simulated clock: sockets, axes and time are made up, all else is real."""

from __future__ import annotations

import contextlib
import multiprocessing
import threading
from functools import partial
from types import SimpleNamespace

from robot_io.control import messages, process, realtime
from robot_io.control.config import RealTimeConfig, RobotConfig
from robot_io.control.process import Control, ControlOptions
from robot_io.devices.egm.session import EgmConfig
from robot_io.safety.owner_watch import BEAT_PERIOD
from tests.support.simulated_clock import CONTROLLER, Simulation


class ArmSocket:
    """Stand-in for the arm's socket in the control process."""

    def __init__(self, simulation):
        self._simulation = simulation

    def fileno(self):
        return "arm"

    def drain(self):
        packets, self._simulation.packets = self._simulation.packets, []
        return [(packet, CONTROLLER) for packet in packets]

    def send(self, reply, endpoint):
        self._simulation.answered(reply)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass


class FrameSocket(ArmSocket):
    def fileno(self):
        return "tracker"

    def drain(self):
        frames = self._simulation.frames
        while frames and frames[0][0] <= self._simulation.now:
            yield frames.popleft()[1], ("127.0.0.1", 5000)


class Simulated:
    """A control process in this one; ``script``: what happens at moments [s] of its clock.

    beats  whether its owner shows signs of life, on that clock: one in real time cannot
    """

    def __init__(self, artefact, monkeypatch, **options):
        self.simulation = Simulation()
        self.script, self.beats, self._beaten, self._told = [], True, 0.0, []
        self.pipe, theirs = multiprocessing.Pipe()
        sockets = {"arm": ArmSocket(self.simulation), "tracker": FrameSocket(self.simulation)}
        monkeypatch.setattr(process, "UdpSocket", lambda host, port, key: sockets[key])
        monkeypatch.setattr(process, "linear_axes", lambda *_: self.simulation.axes)
        monkeypatch.setattr(process, "EgmConfig", partial(EgmConfig, ramp_in=0.0))  # as the simulation's arm
        monkeypatch.setattr(realtime, "prepare", lambda *_: [])
        clock = SimpleNamespace(monotonic=lambda: self.simulation.now, sleep=self._sleep)
        monkeypatch.setattr(process, "time", clock)
        monkeypatch.setattr(process, "select", SimpleNamespace(select=self._select))
        config = RobotConfig(realtime=RealTimeConfig(spin=0.0))
        options = {"artefact": artefact and str(artefact), "backend": "numpy", "balls_needed": 0} | options
        self.control = Control(config, ControlOptions(**options), theirs)
        self.simulation.bridge = self.control.bridge

    def thread(self, monkeypatch):
        """A thread, not yet started, that is the process of the next session."""

        def control():
            with self.control:
                self.control.run()

        thread = threading.Thread(target=control, daemon=True)
        monkeypatch.setattr(process, "start", lambda *_: (thread, self.pipe))
        return thread

    def _sleep(self, seconds):
        self.simulation.advance()

    def _select(self, read, write, _, seconds):
        if write:
            return [], write, []
        simulation = self.simulation
        end = simulation.now + seconds + 1e-9  # not before a deadline by rounding
        while simulation.now < end and not simulation.packets:
            simulation.advance()
            if self.beats and simulation.now >= self._beaten + BEAT_PERIOD:
                self._beaten = simulation.now
                with contextlib.suppress(OSError):  # the owner has closed its end
                    self.pipe.send(messages.Beat())
            while self.script and self.script[0][0] <= simulation.now:
                self.script.pop(0)[1]()
        ready = ["arm"] * bool(simulation.packets) + ["tracker"] * bool(simulation.frames)
        return [f for f in read if f in ready or (isinstance(f, int) and self.pipe_waits())], [], []

    def pipe_waits(self):
        return self.control.owner.pipe.poll()

    def read(self):
        """Takes what the owner was told, before the pipe is full."""
        while self.pipe.poll():
            self._told.append(self.pipe.recv())

    def words(self):
        """What the owner was told since it was asked last."""
        self.read()
        found, self._told = self._told, []
        return found
