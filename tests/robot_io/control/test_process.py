"""The control process on a simulated clock: whatever is raised in its loop, the robot stands before it leaves."""

from __future__ import annotations

from operator import itemgetter

import numpy as np
import pytest

from robot_io import contract
from robot_io.control import messages, process
from robot_io.control.interfaces import BridgeState
from robot_io.limits import LIMITS
from robot_io.policy import export
from robot_io.policy.policy import Policy
from robot_io.safety.config import SafetyConfig
from robot_io.safety.owner_watch import LONGEST_SILENCE
from tests.support.simulated_clock import DEAD_TIME
from tests.support.simulated_control import Simulated


class Escaped(BaseException):
    """Neither an error nor anything that somebody thought of."""


@pytest.fixture
def simulated(tmp_path, monkeypatch):
    sizes = contract.n_parameters(), contract.N_OBSERVATION
    export.write(tmp_path / "artefact", Policy(np.zeros(sizes[0]), np.zeros(sizes[1]), np.ones(sizes[1])), {})
    return Simulated(tmp_path / "artefact", monkeypatch)


@pytest.mark.parametrize(
    "part", ["_tick", "owner.obey", "status", "_answer_arm", "bridge.tracker_received", "bridge.tick"]
)
@pytest.mark.parametrize("error", [Escaped, ValueError, KeyboardInterrupt])
def test_an_exception_leaves_the_loop_after_the_robot_stands(simulated, part, error):
    """Raised once, on the way to a home pose far away, at more than 1 rad/s."""
    control, simulation = simulated.control, simulated.simulation
    *path, name = part.split(".")
    owner = getattr(control, path[0]) if path else control
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
        if part == "owner.obey":
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


class Wordless(Exception):
    def __str__(self):
        raise RuntimeError("no words either")


def raising(error):
    def escape(*_, **__):
        raise error("made up")

    return escape


LASTING = ["bridge.gate.command", "_take_axes", "bridge.tick", "_tick", "bridge.play.settle"]


@pytest.mark.parametrize("part", LASTING)
@pytest.mark.parametrize("error", [Escaped, ValueError, Wordless])
def test_an_exception_that_lasts_leaves_the_arm_at_rest_within_its_braking_distance(simulated, part, error):
    """Raised from some moment on for ever, at more than 1 rad/s; the arm answers late, as it does at all times."""
    control, simulation = simulated.control, simulated.simulation
    *path, name = part.split(".")
    owner, gate, seen = control, control.bridge.gate, []
    for step in path:
        owner = getattr(owner, step)

    def move():
        control.bridge._home = control.bridge._home + [0.3, 0.1, 0.8, 0, 0, 1.0, 0, 1.0]
        simulated.pipe.send(messages.Arm())

    def spoil():
        setattr(owner, name, raising(error))
        seen.append((simulation.arm.copy(), gate.velocity[2:]))

    simulated.script = [(10.5, move), (10.8, spoil), (12.0, control.quit)]
    try:
        with control:
            control.run()
    except error:
        pass
    ((place, velocity),) = seen
    assert np.abs(velocity).max() > 1.0
    assert error.__name__ in [fault.sentence.partition(":")[0] for fault in gate.faults]
    assert all(not speed.any() for now, _, speed in simulation.replies if now > 11.3)
    for _ in range(300):
        simulation.advance()
    late = DEAD_TIME + SafetyConfig().late + 2 / 75
    braking = np.abs(velocity) * late + velocity**2 / (2 * np.array(LIMITS.acceleration[2:]))
    assert (np.abs(simulation.arm - place) <= braking + 0.02).all()
    rest = simulation.arm.copy()
    for _ in range(300):
        simulation.advance()
    np.testing.assert_allclose(simulation.arm, rest, rtol=0, atol=1e-3)


def test_an_exception_brakes_also_where_no_fault_can_be_latched(simulated):
    control, simulation = simulated.control, simulated.simulation
    gate = control.bridge.gate

    def move():
        control.bridge._home = control.bridge._home + [0, 0, 0.8, 0, 0, 1.0, 0, 1.0]
        simulated.pipe.send(messages.Arm())

    def spoil():
        gate.fault = raising(ValueError)
        control.owner.obey = raising(ValueError)

    simulated.script = [(10.5, move), (10.8, spoil)]
    with pytest.raises(ValueError, match="made up"), control:
        control.run()
    assert gate.at_rest and not simulation.replies[-1][2].any()
    assert isinstance(simulated.words()[-1], messages.Ended)


@pytest.mark.parametrize("jog", [False, True])
def test_a_silent_owner_is_a_stop_in_order_with_its_reason(tmp_path, monkeypatch, jog):
    simulated = Simulated(None, monkeypatch, jog=jog)
    bridge, simulation, seen = simulated.control.bridge, simulated.simulation, []

    def move():
        bridge._home = bridge._home + [0, 0, 0.8, 0, 0, 1.0, 0, 1.0]

    def fall_silent():
        seen.append(bridge.state)
        simulated.beats = False

    simulated.script = [
        (10.5, lambda: simulated.pipe.send(messages.Arm())),
        (15.0, fall_silent),
        (15.0 + LONGEST_SILENCE - 0.3, lambda: seen.append(bridge.state)),
        (15.0 + LONGEST_SILENCE - 0.2, move),
        (15.0 + LONGEST_SILENCE + 0.05, lambda: seen.append(bridge.state)),
        (15.0 + LONGEST_SILENCE + 1.0, lambda: seen.append(bridge.state)),
        (15.0 + LONGEST_SILENCE + 1.0, lambda: simulated.pipe.send(messages.Arm())),
        (15.0 + LONGEST_SILENCE + 1.3, lambda: seen.append((bridge.state, bridge.stopped_because))),
        (15.0 + LONGEST_SILENCE + 1.4, simulated.control.quit),
    ]
    simulated.script = sorted(
        [*simulated.script, *((float(t), simulated.read) for t in range(11, 18))], key=itemgetter(0)
    )
    with simulated.control:
        simulated.control.run()
    ready = BridgeState.READY
    assert seen == [ready, ready, BridgeState.STOPPING, BridgeState.DISARMED, (ready, "")]
    stopped = [message for message in simulated.words() if isinstance(message, messages.Status) and message.stopped]
    assert stopped and "was not heard for 2 s" in stopped[-1].stopped
    at_rest = [speed for now, _, speed in simulation.replies if abs(now - 15.9 - LONGEST_SILENCE) < 0.1]
    assert at_rest and not np.any(at_rest) and stopped[-1].halt.text == stopped[-1].stopped


def test_a_silent_owner_ends_the_search_of_the_axes(tmp_path, monkeypatch):
    """Disarmed, but something moves, past the gate; and the stop key is what is not heard either."""
    simulated = Simulated(None, monkeypatch)
    axes, seen = simulated.simulation.axes, []

    def search():
        axes.homed, axes.homing = False, True
        simulated.beats = False

    def stopped():
        seen.append((axes.stops, simulated.control.bridge.stopped_because))
        axes.homing = False

    simulated.script = [
        (11.0, search),
        (11.0 + LONGEST_SILENCE - 0.3, lambda: seen.append(axes.stops)),
        (11.0 + LONGEST_SILENCE + 0.05, stopped),
        (11.0 + LONGEST_SILENCE + 0.5, simulated.control.quit),
    ]
    with simulated.control:
        simulated.control.run()
    before, (after, because) = seen
    assert before == 0 and after >= 1 and "was not heard for 2 s" in because


@pytest.mark.parametrize(("paused", "jog"), [(True, False), (False, False), (False, True)])
def test_an_owner_may_announce_its_absence_only_while_no_balls_are_taken(tmp_path, monkeypatch, paused, jog):
    simulated = Simulated(None, monkeypatch, jog=jog)
    bridge, pipe, seen = simulated.control.bridge, simulated.pipe, []

    def leave():
        pipe.send(messages.Pause(paused))
        pipe.send(messages.Beat(10.0))
        simulated.beats = False

    simulated.script = [
        (10.5, lambda: pipe.send(messages.Arm())),
        (11.0, leave),
        (20.0, lambda: seen.append(bridge.state)),
        (22.0, lambda: seen.append(bridge.state)),
        (22.1, simulated.control.quit),
    ]
    with simulated.control:
        simulated.control.run()
    assert seen == [BridgeState.READY if paused else BridgeState.DISARMED, BridgeState.DISARMED]


def test_a_policy_is_not_built_while_another_plays(simulated):
    pipe, bridge, states = simulated.pipe, simulated.control.bridge, []
    wrong = messages.SetPolicy(Policy(np.zeros(7), np.zeros(11), np.ones(11)), 1)

    def exchange():
        states.append(bridge.state)
        pipe.send(wrong)

    simulated.simulation.ball = lambda now: (
        np.array([0.0, 1.5 - 4.2 * (now - 13.0), max(0.03, 0.35 - 0.5 * (now - 13.0))]) if 13.0 <= now < 13.72 else None
    )
    simulated.script = [(10.5, lambda: pipe.send(messages.Arm())), (13.3, exchange), (13.6, simulated.control.quit)]
    with simulated.control:
        simulated.control.run()
    (refused,) = [message.sentence for message in simulated.words() if isinstance(message, messages.Refused)]
    assert states == [BridgeState.ACTIVE] and refused == "the policy is playing: exchange it between balls"


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
