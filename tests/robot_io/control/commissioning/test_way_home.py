"""The way home where the gate holds the first one: gaps along it by MuJoCo, not by the geometry that chose it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import mujoco
import numpy as np
import pytest

from mjx_tt.robot import robots
from robot_io.control.commissioning.homing import towards
from robot_io.control.commissioning.way_home import WayHome
from robot_io.safety.clearance import RobotGeometry
from robot_io.safety.config import SLACK, SafetyConfig
from robot_io.safety.gate import SafetyGate

# Where the joints' own ways home lead into the table's margin, and the gate does not get them round it.
HELD = {
    "fr3_pedestal": (0.0566, 1.5088, -1.4539, -0.8161, -2.2759, 2.8386, 2.1002),
    "ur10e_rail": (0.1571, 2.5301, -2.6103, -1.4905, -4.3653, -6.0512, -5.2109),
}
LONGEST, BY_ITSELF = 20.0, 4.0  # [s]


@dataclass
class Ideal:
    """A robot that is where its gate's reference is."""

    name: str
    places: list[np.ndarray] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.robot = robots.load_shipped(self.name)
        contract = self.robot.contract
        geometry, config = RobotGeometry.of(contract), SafetyConfig.of(contract)
        self.gate = SafetyGate(contract.limits, geometry=geometry, config=config)
        limits = contract.limits
        self.speed, self.braking = 0.5 * np.array(limits.policy_velocity), 0.3 * np.array(limits.acceleration)
        self.way = WayHome(self.gate, limits, self.speed, self.braking)
        self.now = 0.0

    def arm(self, place):
        self.gate.arm(place, self.now, np.zeros(len(place)))
        self.way.restart()

    def tick(self, request, target=None):
        """``target``: of the way home that asked, None: somebody else did."""
        sent = self.gate.command(request, self.gate.reference, self.gate.velocity, self.now)
        began = self.way.sent(request, sent, self.robot.home if target is None else target, target is not None)
        self.now += self.gate.period
        self.places.append(sent.position)
        return began

    def go(self, target, seconds=LONGEST):
        """True where it gets there."""
        end = self.now + seconds
        while self.now < end and not self.way.problem:
            if np.abs(self.gate.reference - target).max() < 1e-3:
                return True
            self.tick(self.way.velocity(target), target)
        return False


def smallest_gap(robot, places):
    """Smallest distance [m] of a watched capsule to the table top by MuJoCo's own distances."""
    model = robot.model()
    data, table = mujoco.MjData(model), model.geom("col_table").id
    watched = [model.geom(name).id for name in robot.file.table]
    found = np.inf
    for place in places:
        data.qpos[: len(place)] = place
        mujoco.mj_kinematics(model, data)
        found = min(found, *(mujoco.mj_geomDistance(model, data, geom, table, 1.0, None) for geom in watched))
    return found


@pytest.mark.parametrize("name", HELD)
def test_a_robot_that_the_gate_holds_gets_home_with_its_margin(name):
    ideal = Ideal(name)
    ideal.arm(np.array(HELD[name]))
    for _ in range(round(BY_ITSELF * 75)):
        request = towards(ideal.robot.home, ideal.gate.reference, ideal.speed, ideal.braking, ideal.gate.period)
        ideal.tick(request)
    assert np.abs(ideal.gate.reference - ideal.robot.home).max() > 0.3  # nothing but a way of its own gets it away
    ideal = Ideal(name)
    ideal.arm(np.array(HELD[name]))
    assert ideal.go(ideal.robot.home) and not ideal.gate.faults
    started = smallest_gap(ideal.robot, [HELD[name]])
    kept = min(started, ideal.gate.config.table_margin) - 2 * SLACK
    assert smallest_gap(ideal.robot, ideal.places) > kept
    velocity = np.diff(ideal.places, axis=0) / ideal.gate.period
    assert (np.abs(velocity).max(axis=0) <= ideal.speed * (1 + 1e-9)).all()


def test_back_along_its_own_way_where_nothing_else_is_clear(monkeypatch):
    """Only short straight ways count as clear: what was gone before is gone back."""
    name = "fr3_pedestal"
    ideal, short = Ideal(name), 0.4
    ideal.arm(ideal.robot.home)
    assert ideal.go(ideal.robot.home)
    held = np.array(HELD[name])
    beside = ideal.robot.home + np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.8, 0.0])
    for target in (beside, held):
        while np.abs(ideal.gate.reference - target).max() > 0.02:
            ideal.tick(ideal.way._straight(target - ideal.gate.reference))
    clear = WayHome._clear
    near = lambda self, room, a, b: np.abs(a - b).max() < short and clear(self, room, a, b)  # noqa: E731
    monkeypatch.setattr(WayHome, "_clear", near)
    monkeypatch.setattr(WayHome, "_away", lambda *_: iter(()))
    home = ideal.robot.home
    while not ideal.tick(ideal.way.velocity(home), home):  # as far as the gate lets it
        assert ideal.now < 60.0
    went, ideal.places = list(ideal.places), []
    assert ideal.go(ideal.robot.home, 60.0) and not ideal.gate.faults
    late = np.array(ideal.places)
    assert max(np.abs(np.array(went) - place).max(axis=1).min() for place in late[::5]) < short
    assert np.abs(late - beside).max(axis=1).min() < 0.1  # by the same bend


def test_a_robot_that_only_creeps_is_held():
    """Beside the joint that the gate stops the others converge, at speeds that never become zero."""
    ideal = Ideal("fr3_pedestal")
    ideal.arm(np.array(HELD["fr3_pedestal"]))
    sent = ideal.gate.command(np.zeros(7), ideal.gate.reference, np.zeros(7), 0.0)
    crept, moves = (replace(sent, velocity=np.full(7, v), changed=("clearance",)) for v in (1e-17, 0.1))
    assert not ideal.way.sent(np.ones(7), moves, ideal.robot.home, True)
    assert ideal.way.sent(np.ones(7), crept, ideal.robot.home, True)


def test_without_a_way_it_holds_and_says_so():
    """Home is in the table: no way to it keeps any margin."""
    ideal = Ideal("fr3_pedestal")
    ideal.arm(ideal.robot.home)
    under = np.array([0.5792, 1.3624, -0.1622, -0.4540, 0.3836, 2.4390, 0.5843])
    assert ideal.gate.geometry.gaps(under[:, None]).min() < 0.0
    assert not ideal.go(under, 60.0)
    assert "jog it away" in ideal.way.problem and ideal.gate.at_rest and not ideal.gate.faults
    assert smallest_gap(ideal.robot, ideal.places) > ideal.gate.config.table_margin - 2 * SLACK
