"""``mjx-tt robot jog`` for robots with other joints than the paper's, on the emulated robot over real sockets."""

from __future__ import annotations

import time
from collections import deque

import numpy as np
import pytest
from rich.console import Console

from experiments.config import build
from experiments.config import robot as robots
from experiments.deploy import commissioning
from experiments.deploy.commissioning import Commissioning
from mjx_tt.robot import robots as simulated
from mjx_tt.sim.model import SimModel
from robot_io import log
from robot_io.control import messages
from robot_io.emulator.processes import Rig

FR3, UR10E = "fr3_pedestal", "ur10e_rail"
REST = 0.4  # [s] over which a robot that stands does not move


class Operator:
    """Keyboard and View of one who presses keys, each as soon as its condition holds, and hears what is shown."""

    def __init__(self, *steps):
        self.steps, self.said, self.status = deque(steps), [], None

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def pressed(self):
        if not self.steps or not self.steps[0][0]():
            return None
        key = self.steps.popleft()[1]
        return key() if callable(key) else key

    def say(self, text):
        self.said.append(text)

    def take(self, message):
        if isinstance(message, messages.Status):
            self.status = message
        elif isinstance(message, messages.Refused):
            self.say(message.sentence)

    def in_state(self, state):
        return lambda: self.status is not None and self.status.state == state

    def heard(self, text):
        return lambda: any(text in said for said in self.said)


@pytest.fixture(scope="module", params=[pytest.param(FR3, marks=pytest.mark.slow), UR10E])
def rig(request):
    robot = simulated.load_shipped(request.param)
    balls = robots.throws_of(build.distribution("narrow", "test"), SimModel(), 8, 0)
    with Rig(str(robot.scene()), balls, robots.load_rig(None, robot), None, robot.contract) as running:
        yield robot, running


def jog(robot, rig, operator, folder, monkeypatch):
    """The exit status of a session of ``mjx-tt robot jog``."""
    path = folder / "robot.yaml"
    path.write_text(robots.to_yaml(rig.robot))
    monkeypatch.setattr(commissioning, "Keyboard", lambda: operator)
    monkeypatch.setattr(commissioning, "View", lambda *_: operator)
    console = Console(record=True, width=300)
    assert Commissioning(path, folder, folder / "points.csv", 40.0, robot.name).jog(console) == 0
    assert not operator.steps, f"never came to {len(operator.steps)} keys: {operator.said}, {operator.status}"
    return console.export_text()


def switched_on(rig, operator):
    """True when EGM runs, which somebody at the arm's controller starts, again where it timed out without a bridge."""
    asked = 0.0

    def running():
        nonlocal asked
        if operator.status.arm is not None and time.monotonic() > asked + 1.0:
            rig.switch_on()
            asked = time.monotonic()
        return operator.status.arm is None

    return running


@pytest.mark.realtime
@pytest.mark.slow
@pytest.mark.parametrize("doubt", ["cable", "motors", "axis"])
def test_in_doubt_it_slows_down_and_holds(rig, tmp_path, monkeypatch, doubt):
    robot, running = rig
    if doubt == "axis" and not robot.contract.carrying:
        pytest.skip("it has no linear axes")
    operator, places = Operator(), []

    def begin():
        places.append(running.state()[0])
        return "+"

    def cause():
        {
            "cable": lambda: running.connect_arm(False),
            "motors": running.motors_off,
            "axis": lambda: running.connect_axis(0, False),
        }[doubt]()
        return "x"

    def held():
        time.sleep(0.5)
        places.append(running.state()[0])
        return "+"

    def after():
        time.sleep(REST)
        places.append(running.state()[0])
        return "q"

    operator.steps.extend(
        [
            (operator.in_state("disarmed"), ""),
            (switched_on(running, operator), "p"),
            (lambda: not operator.status.missing, "a"),
            (operator.in_state("ready"), "2"),
            (lambda: True, "s"),
            (lambda: True, "s"),
            (lambda: True, begin),
            (lambda: np.abs(running.state()[0] - places[0]).max() > 0.005, cause),
            (operator.in_state("fault"), "2"),
            (lambda: True, held),
            (operator.heard("the state is fault; arm it first"), after),
        ]
    )
    jog(robot, running, operator, tmp_path, monkeypatch)
    start, stopped, later = places
    assert 0.005 < np.abs(stopped - start).max() < 0.04  # of a step of 0.05
    np.testing.assert_allclose(later, stopped, atol=1e-3)
    session = log.read(next(tmp_path.glob("*-jog.mcap")))
    limits = robot.contract.limits
    change = np.abs(np.diff(session.commands.sent, axis=1)).max(axis=1)
    assert (change <= np.array(limits.acceleration) / 75.0 * (1 + 1e-9)).all()
    assert not session.commands.sent[:, -1].any()
    running.connect_arm(True)
    if doubt == "axis":
        running.connect_axis(0, True)
