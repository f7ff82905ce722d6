"""Nothing raises into the control loop; a robot that is stopped holds the place where it is, not where it was sent."""

from __future__ import annotations

import json

import numpy as np
import pytest

from robot_io.control.bridge import BridgeState
from robot_io.control.commissioning import way_home
from robot_io.limits import LIMITS
from robot_io.log.messages import Event, json_text
from robot_io.log.recorder import NullRecorder
from robot_io.safety.faults import Cause
from tests.support.simulated_clock import Constant, Simulation

V_MAX = np.array(LIMITS.velocity)


def incoming(start):
    """A ball that bounces once on the robot's side, from ``start`` [s] on."""

    def place(now):
        s = now - start
        if not 0 <= s <= 0.62:
            return None
        rise = 0.02 + 2.0 * (s - 0.42) - 4.905 * (s - 0.42) ** 2
        fall = 0.25 + (0.02 - 0.25) * s / 0.42 + 4.905 * s * (0.42 - s)
        return np.array([0.1, 1.7 - 6.2 * s, fall if s < 0.42 else rise])

    return place


class Packing(NullRecorder):
    """Keeps events, after packing everything as the recorder of a session does."""

    def __init__(self):
        self.events = []

    def put(self, *records):
        for record in records:
            record.pack()
            if isinstance(record, Event):
                self.events.append(record)


def armed(policy=None, **options) -> Simulation:
    simulation = Simulation(policy, incoming(11.0), **options)
    simulation.run(0.5)
    simulation.bridge.arm(simulation.now)
    return simulation


# --- exceptions


@pytest.mark.parametrize("start", [0.25, 0.3, 0.35, 0.4])
@pytest.mark.parametrize("length", [0.15, 0.2, 0.25, 0.3])
def test_a_stall_around_the_bounce_is_a_fault_and_no_exception(start, length):
    recorder = Packing()
    simulation = armed(recorder=recorder)
    simulation.stalled = lambda t: start <= t - 11.0 < start + length
    simulation.run(2.1)
    (summary,) = simulation.summaries
    assert summary.fault in ("timing", "stale_policy", "stale_tracker", "stale_arm", "stale_axes")
    assert 0.0 <= summary.closest <= 3.0
    (end,) = [
        json.loads(event.text, parse_constant=pytest.fail) for event in recorder.events if event.name == "episode_end"
    ]
    assert end["closest"] == summary.closest


def test_what_is_logged_never_raises():
    circle: list = []
    circle.append(circle)
    for value in (
        float("nan"),
        float("-inf"),
        np.float32(1.0),
        object(),
        {1j: 2},
        {(1, 2): 3},
        circle,
        {"a": [float("inf")]},
    ):
        json.loads(json_text(value), parse_constant=pytest.fail)
    assert json_text({"a": [float("inf"), 1.5], "b": (2, "x")}) == '{"a": [null, 1.5], "b": [2, "x"]}'


class Raising(NullRecorder):
    def __init__(self, error):
        self.error, self.events = error, []

    def put(self, *records):
        names = [record.name for record in records if isinstance(record, Event)]
        if names and names[0] == "log_error":
            self.events += names
        else:
            raise self.error


def test_a_recorder_that_raises_is_counted_and_play_goes_on():
    recorder = Raising(ValueError("no"))
    simulation = armed(recorder=recorder)
    simulation.run(1.5)
    assert not simulation.bridge.gate.faults and len(simulation.summaries) == 1
    assert simulation.bridge.unlogged > 100 and len(recorder.events) > 100


def test_a_log_that_cannot_be_written_is_a_fault():
    simulation = armed(recorder=Raising(OSError(28, "No space left on device")))
    simulation.run(0.2)
    (fault,) = simulation.bridge.gate.faults
    assert fault.cause is Cause.INTERNAL and "No space left" in fault.sentence


class Own(RuntimeError):
    pass


def fail(*_, **__):
    raise Own("made up")


@pytest.mark.parametrize(
    "part",
    [
        "tracker.receive",
        "axes.problem",
        "axes.command",
        "axes.stop",
        "arm_session.problem",
        "play.on_episode",
        "play.settle",
        "play.strokes.add",
        "play.moved",
        "towards",
        "_ask_policy",
    ],
)
def test_an_exception_anywhere_brakes_the_robot_and_is_a_fault(part, monkeypatch):
    """And the arm gets an answer to every packet, at last one that holds it where it is."""
    simulation = armed(Constant([0, 0, 0.3, 0, 0, 0, 0, 0]))
    simulation.run(0.7)
    assert simulation.bridge.state is BridgeState.ACTIVE
    *path, name = part.split(".")
    owner = simulation.bridge
    for step in path:
        owner = getattr(owner, step)
    monkeypatch.setattr(way_home if name == "towards" else owner, name, fail)
    if part == "axes.stop":
        simulation.bridge.gate.estop(True, simulation.now)
    answered = len(simulation.replies)
    simulation.run(1.0)
    gate = simulation.bridge.gate
    assert simulation.bridge.state is BridgeState.FAULT and gate.at_rest
    assert Cause.INTERNAL in [fault.cause for fault in gate.faults]
    assert "Own: made up" in [fault.sentence for fault in gate.faults]
    assert len(simulation.replies) - answered == 250
    _, position, velocity = simulation.replies[-1]
    assert not velocity.any()
    np.testing.assert_allclose(position, simulation.arm, rtol=0, atol=1e-3)


# --- where the reference ends


def blocked(joint, speed, seconds=0.25):
    """A robot whose arm joint ran into something at ``speed`` of its limit, at the moment of the fault."""
    action = np.zeros(8)
    action[2 + joint] = speed
    simulation = armed(Constant(action))
    assert simulation.run(3.0, lambda: simulation.bridge.state is BridgeState.ACTIVE)
    simulation.run(seconds)
    simulation.blocked[joint] = True
    assert simulation.run(2.0, lambda: simulation.bridge.state is BridgeState.FAULT)
    return simulation


@pytest.mark.parametrize(("joint", "speed"), [(0, 0.4), (0, 1.0), (2, -0.3), (5, 0.6), (5, 1.0)])
def test_a_fault_does_not_keep_pushing_a_blocked_arm(joint, speed):
    simulation = blocked(joint, speed)
    assert Cause.FOLLOWING_ERROR in [fault.cause for fault in simulation.bridge.gate.faults]
    begin, stuck = len(simulation.replies), simulation.arm.copy()
    simulation.run(2.0)
    lead = np.array([abs(position[joint] - stuck[joint]) for _, position, _ in simulation.replies[begin:]])
    speed = np.array([abs(velocity[joint]) for _, _, velocity in simulation.replies[begin:]])
    # While the set-point speed is braked, 0.1 s at most, it adds its own way to the reference.
    assert lead[10:].max() < 0.1 and lead[50:].max() < 1e-3 and not speed[50:].any()
    np.testing.assert_allclose(simulation.bridge.gate.reference[2:], simulation.arm, rtol=0, atol=1e-4)


def test_when_the_obstacle_goes_the_arm_stays():
    simulation = blocked(0, 0.4)
    simulation.run(0.5)
    stuck = simulation.arm.copy()
    simulation.blocked[:] = False
    simulation.run(2.0)
    np.testing.assert_allclose(simulation.arm, stuck, rtol=0, atol=2e-3)
    simulation.arm = simulation.arm + [0.2, 0, 0, 0, 0, 0]  # somebody moves it
    moved = simulation.arm.copy()
    simulation.run(2.0)
    # What was on its way for the dead time still asks for the old place, at 1/s.
    np.testing.assert_allclose(simulation.arm, moved, rtol=0, atol=0.015)
    assert not simulation.bridge.gate.velocity.any()


@pytest.mark.parametrize("stop", ["stop", "estop"])
def test_a_joint_that_is_blocked_while_it_brakes_is_not_pushed_either(stop):
    simulation = armed(Constant([0, 0, 0.5, 0, 0, 0, 0, 0]))
    assert simulation.run(3.0, lambda: simulation.bridge.state is BridgeState.ACTIVE)
    simulation.run(0.25)
    simulation.blocked[0] = True
    simulation.bridge.stop(simulation.now) if stop == "stop" else simulation.bridge.gate.estop(True, simulation.now)
    simulation.run(1.0)
    _, position, velocity = simulation.replies[-1]
    np.testing.assert_allclose(position, simulation.arm, rtol=0, atol=1e-4)
    assert not velocity.any()


def test_an_arm_that_follows_brakes_along_the_way_that_was_proven():
    simulation = armed(Constant([0.2, 0, 0.5, 0, 0, 0.3, 0, 0.5]))
    assert simulation.run(3.0, lambda: simulation.bridge.state is BridgeState.ACTIVE)
    simulation.run(0.2)
    gate = simulation.bridge.gate
    left = gate.velocity - np.sign(gate.velocity) * np.minimum(
        np.abs(gate.velocity), np.array(LIMITS.acceleration) / 75
    )
    way = gate.braking_way(left)
    simulation.bridge.gate.estop(True, simulation.now)
    assert simulation.run(0.5, lambda: gate.at_rest)
    np.testing.assert_allclose(gate.reference, way[:, -1], rtol=0, atol=1e-12)
    simulation.run(0.5)
    np.testing.assert_allclose(gate.reference[2:], simulation.arm, rtol=0, atol=1e-4)
    assert np.abs(simulation.arm - way[2:, -1]).max() < 0.06  # two packets at full speed


def test_one_false_measurement_does_not_move_the_reference():
    simulation = armed(Constant([0, 0, 0.3, 0, 0, 0, 0, 0]))
    assert simulation.run(3.0, lambda: simulation.bridge.state is BridgeState.ACTIVE)
    simulation.run(0.2)
    gate = simulation.bridge.gate
    measured = gate.reference
    measured[2] += 1.0
    gate.estop(True, simulation.now)
    before = gate.reference
    sent = gate.command(np.zeros(8), measured, np.zeros(8), simulation.now + 1 / 75)
    assert np.abs(sent.position - before).max() < V_MAX.max() / 75
