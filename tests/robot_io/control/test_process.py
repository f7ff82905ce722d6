"""The control process on a simulated clock: whatever is raised in its loop, the robot stands before it leaves."""

from __future__ import annotations

import numpy as np
import pytest

from robot_io import contract
from robot_io.control import messages, process
from robot_io.policy import export
from robot_io.policy.policy import Policy
from tests.support.simulated_control import Simulated


class Escaped(BaseException):
    """Neither an error nor anything that somebody thought of."""


@pytest.fixture
def simulated(tmp_path, monkeypatch):
    sizes = contract.n_parameters(), contract.N_OBSERVATION
    export.write(tmp_path / "artefact", Policy(np.zeros(sizes[0]), np.zeros(sizes[1]), np.ones(sizes[1])), {})
    return Simulated(tmp_path / "artefact", monkeypatch)


@pytest.mark.parametrize("part", ["_tick", "_obey", "status", "_answer_arm", "bridge.tracker_received", "bridge.tick"])
@pytest.mark.parametrize("error", [Escaped, ValueError, KeyboardInterrupt])
def test_an_exception_leaves_the_loop_after_the_robot_stands(simulated, part, error):
    """Raised once, on the way to a home pose far away, at more than 1 rad/s."""
    control, simulation = simulated.control, simulated.simulation
    owner, name = (control.bridge, part[7:]) if part.startswith("bridge.") else (control, part)
    before = getattr(owner, name)
    moved = []

    def escape(*_):
        setattr(owner, name, before)
        moved.append(control.bridge.gate.velocity)
        raise error("made up")

    def move():
        control.bridge._home = control.bridge._home + [0.3, 0.1, 0.8, 0, 0, 1.0, 0, 1.0]
        simulated.pipe.send(messages.Arm())

    def spoil():
        setattr(owner, name, escape)
        if part == "_obey":
            simulated.pipe.send(messages.Discard())

    simulated.script = [(10.5, move), (10.8, spoil)]
    with pytest.raises(error, match="made up"), control:
        control.run()
    assert np.abs(moved[0]).max() > 1.0
    gate = control.bridge.gate
    assert gate.settled and f"{error.__name__}: made up" in [fault.sentence for fault in gate.faults]
    _, position, velocity = simulation.replies[-1]
    np.testing.assert_allclose(position, simulation.arm, rtol=0, atol=1e-3)
    assert not velocity.any() and simulation.axes.stops and simulation.axes.closed
    words = simulated.words()
    assert messages.Failed(f"{error.__name__}: made up") in words and isinstance(words[-1], messages.Ended)
    rest = simulation.arm.copy()
    for _ in range(300):
        simulation.advance()
    np.testing.assert_allclose(simulation.arm, rest, rtol=0, atol=1e-3)


def test_what_fails_for_ever_does_not_keep_the_process(simulated):
    def escape(*_):
        raise Escaped("made up")

    simulated.script = [(10.5, lambda: setattr(simulated.control, "_answer_arm", escape))]
    with pytest.raises(Escaped), simulated.control:
        simulated.control.run()
    assert simulated.simulation.now < 10.6 + process.STOP_TIME


def test_a_request_that_fails_is_refused_and_play_goes_on(simulated):
    pipe, control = simulated.pipe, simulated.control
    wrong = messages.SetPolicy(Policy(np.zeros(7), np.zeros(11), np.ones(11)), 1)
    simulated.script = [
        (10.2, lambda: pipe.send(wrong)),
        (10.4, lambda: pipe.send(("nonsense",))),
        (11.0, lambda: pipe.send(messages.Quit())),
    ]
    with control:
        control.run()
    words = simulated.words()
    refused = [message.sentence for message in words if isinstance(message, messages.Refused)]
    assert "theta has 7 parameters" in refused[0] and "nonsense" in refused[1]
    assert isinstance(words[-1], messages.Ended) and simulated.simulation.now >= 11.0


def test_axes_that_do_not_answer_yet_are_not_homed(simulated):
    """A cable that was out: the drives know where they are, and here nobody knows that they do."""
    pipe, axes = simulated.pipe, simulated.simulation.axes
    axes.homed = axes.answering = False
    simulated.script = [
        (10.2, lambda: pipe.send(messages.Prepare())),
        (10.4, lambda: axes.__dict__.update(homed=True, answering=True)),
        (10.5, lambda: pipe.send(messages.Prepare())),
        (10.7, lambda: pipe.send(messages.Quit())),
    ]
    with simulated.control:
        simulated.control.run()
    refused = [message.sentence for message in simulated.words() if isinstance(message, messages.Refused)]
    assert refused == ["axes not ready: one of them does not answer yet; try again"]


def test_axes_are_homed_only_with_the_arm_clear(simulated):
    pipe, axes, home = simulated.pipe, simulated.simulation.axes, simulated.simulation.arm.copy()
    axes.homed, seen = False, []
    over_the_table = home + [0.0, 1.2, 0.0, 0.0, 0.0, 0.0]
    simulated.simulation.arm = over_the_table
    simulated.script = [
        (10.2, lambda: pipe.send(messages.Prepare())),
        (10.4, lambda: seen.append(axes.homed)),
        (10.4, lambda: setattr(simulated.simulation, "arm", home)),
        (10.5, lambda: pipe.send(messages.Prepare())),
        (10.7, lambda: pipe.send(messages.Quit())),
    ]
    with simulated.control:
        simulated.control.run()
    (refused,) = [message.sentence for message in simulated.words() if isinstance(message, messages.Refused)]
    assert "jog the arm" in refused and seen == [False] and axes.homed


def test_the_robot_stands_before_the_process_quits(simulated):
    control = simulated.control

    def move():
        control.bridge._home = control.bridge._home + [0, 0, 0.8, 0, 0, 1.0, 0, 1.0]
        simulated.pipe.send(messages.Arm())

    simulated.script = [(10.5, move), (10.8, control.quit)]  # as a signal does
    with control:
        control.run()
    simulation = simulated.simulation
    rest = simulation.arm.copy()
    for _ in range(300):
        simulation.advance()
    np.testing.assert_allclose(simulation.arm, rest, rtol=0, atol=1e-3)
