"""Rallies through the bridge in lock-step: a person of a few lines, and a world that returns balls by itself."""

from __future__ import annotations

from collections import Counter
from functools import cache

import numpy as np
import pytest

from robot_io.control.bridge import BridgeState
from robot_io.emulator.config import RigParams
from robot_io.emulator.lockstep import LockStep
from robot_io.emulator.opponent import Stroke
from robot_io.emulator.tracker import TrackerParams
from robot_io.emulator.world import World
from robot_io.errors import RefusedError
from robot_io.log.messages import Action, Event
from robot_io.log.recorder import NullRecorder
from robot_io.safety.clearance import BLADE, RobotGeometry
from tests.support.lockstep_play import Hold, lockstep
from tests.support.paths import SCENE

BLADE_AT_HOME = RobotGeometry.load().middle(BLADE, RobotGeometry.load().home)


class ReturningWorld(World):
    """A ball that comes near the blade after one bounce flies back, whatever the robot does."""

    def advance(self, setpoint, duration):
        super().advance(setpoint, duration)
        names = [name for _, name, _ in self.touches]
        if names == ["col_table"] and self.ball[1] < BLADE_AT_HOME[1] + 0.12 and self.in_play:
            start, seconds = self.ball, 0.55
            velocity = (np.array([0.1, 0.8, 0.02]) - start) / seconds * [1.0, 1.12, 1.0] + [0, 0, 4.905 * seconds + 0.1]
            self.data.qvel[self._ball_v : self._ball_v + 3] = velocity
            self.touches.append((self.time, "rig_paddle", start))


@cache
def returning_world():
    return ReturningWorld(SCENE)


class Person:
    """Plays every ball to the blade's place at home, and misses every ``miss``-th return."""

    def __init__(self, miss=0, spread=0.0):
        self.miss, self.spread = miss, spread

    def prepare(self):
        self.random, self.answers, self.rests = np.random.default_rng(1), 0, 0

    def serve(self):
        return self._to_paddle(np.array([0.2, 1.3, 0.3]))

    def wish(self):
        return 1.5, 0.1

    def answer(self, ball, landing, seconds):
        self.answers += 1
        assert landing[1] > 0.0 and seconds > 0.1
        return None if self.miss and self.answers % self.miss == 0 else self._to_paddle(ball.position)

    def rest(self):
        self.rests += 1

    def _to_paddle(self, start):
        fall = 0.36  # [s] to a bounce before the blade
        aim = np.array([BLADE_AT_HOME[0], -0.75, 0.02]) + self.spread * self.random.normal(size=3) * [1, 1, 0]
        velocity = (aim - start) / fall * [1.0, 1.06, 1.0] + [0.0, 0.0, 0.5 * 9.81 * fall + 0.05]
        return Stroke(start, velocity, np.zeros(3))


class Memory(NullRecorder):
    """All records."""

    def __init__(self):
        self.records = []

    def put(self, *records):
        self.records += records


def rallies(n, person, identity="ball", noise=0.0, policy=None, **options):
    """The rig after ``n`` rallies."""
    tracker = TrackerParams(identity=identity, noise=noise)
    params = RigParams(**{"pause": 0.1, "tracker": tracker} | options)
    rig = LockStep(SCENE, person, policy or Hold(), params, recorder=Memory(), world=returning_world())
    rig.start()
    rig.throwing = True
    rig.run(8.0 * n, lambda: len(rig.rallies) >= n or rig.bridge.state is BridgeState.FAULT)
    assert len(rig.rallies) >= n, (rig.bridge.state, rig.bridge.gate.faults, rig.rallies)
    return rig


def test_lengths_are_those_of_the_world():
    rig = rallies(4, Person(miss=3, spread=0.06), noise=0.003)
    seen = [rally.touches for rally in rig.thrower.played[:4]]
    assert [rally.length for rally in rig.rallies] == seen and max(seen) >= 3, seen
    for rally, played in zip(rig.rallies, rig.thrower.played, strict=False):
        assert abs(rally.started - played.began) < 0.03
    assert rig.thrower.opponent.rests >= 3
    strokes = [r for r in rig.bridge.recorder.records if isinstance(r, Event) and r.name == "stroke"]
    assert rig.world.strokes - len(strokes) in (0, 1)  # one may just have been struck
    assert sum(isinstance(r, Event) and r.name == "rally" for r in rig.bridge.recorder.records) == len(rig.rallies)


@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_trackers_play_the_same_rallies(noise):
    """One number per rally and one per stroke, bit for bit; a ball that is out of sight on the human's side, alike."""
    found = {name: rallies(2, Person(miss=2, spread=0.05), name, noise) for name in ("ball", "stroke", "lost")}
    same = [(r.length, r.end, r.started) for r in found["ball"].rallies]
    assert same == [(r.length, r.end, r.started) for r in found["stroke"].rallies]
    actions = [
        [r.values.tolist() for r in rig.bridge.recorder.records if isinstance(r, Action)] for rig in found.values()
    ]
    assert actions[0] == actions[1]
    assert [(r.length, r.end) for r in found["lost"].rallies[:2]] == [r[:2] for r in same[:2]]


def test_a_ball_is_taken_wherever_the_robot_is():
    """Answers come before the robot is back at home, and are played all the same."""

    class Away(Hold):
        """Plays the first ball of each rally by holding, then drives off."""

        def step(self, observation):
            self.steps += 1
            return np.array([0.2, 0, 0, 0, 0, 0, 0, 0]) if self.steps > 12 else np.zeros(8)

    rig = rallies(1, Person(miss=3), policy=Away())
    assert any(rally.length >= 2 for rally in rig.rallies)
    second = [s for s in rig.summaries if s.number > 1]
    assert second and all(s.steps > 5 for s in second)


def test_how_rallies_end():
    class Faulty(Person):
        """Into the net, over the table, on the own side, by turns."""

        def serve(self):
            self.answers += 1
            velocity = [(0.0, -5.0, 0.6), (0.0, -9.0, 3.0), (0.0, -3.5, -1.2)][self.answers % 3]
            return Stroke(np.array([0.2, 1.3, 0.3]), np.array(velocity), np.zeros(3))

    rig = rallies(6, Faulty())
    ends = Counter(rally.end for rally in rig.rallies[:6])
    assert ends == {"FIRST_NET": 2, "FIRST_OVER_TABLE": 2, "SERVICE": 2}, ends
    assert {s.human_fault for s in rig.summaries} == {"net", "long", "own side"}
    assert all(rally.filtered and rally.length == 1 for rally in rig.rallies[:6])
    missing = rallies(3, Person(miss=1))
    assert {rally.end for rally in missing.rallies} == {"HUMAN_BOUNCES"} and missing.rallies[0].length == 2
    assert missing.rallies[0].by_robot is False


def test_nothing_is_played_or_counted_before_the_robot_is_armed_and_was_at_home():
    rig = lockstep(Hold(), balls=Person(), params=RigParams(pause=0.1, patient=False))
    rig.arm.motors_on()
    rig.arm.start_rapid()
    rig.arm.start_egm()
    rig.throwing = True
    start = rig.world.qpos
    rig.run(3.0)
    assert rig.world.strokes >= 2 and not rig.rallies and not rig.summaries and rig.bridge.play.episode is None
    np.testing.assert_allclose(rig.world.qpos, start, rtol=0, atol=1e-4)
    rig.axes.enable()
    rig.run(1.0, lambda: rig.axes.state is not None and rig.axes.state.enabled)
    rig.axes.home()
    rig.run(3.0, lambda: rig.axes.problem(rig.now) is None)
    rig.run(0.1)
    rig.bridge.arm(rig.now)
    assert rig.run(10.0, lambda: len(rig.rallies) >= 2)


def test_a_stop_ends_the_rally_and_the_next_one_counts_anew():
    rig = rallies(1, Person(miss=2))
    rig.run(5.0, lambda: rig.bridge.state is BridgeState.ACTIVE)
    rig.bridge.stop(rig.now)
    assert rig.rallies[-1].end == "ROBOT_MISSED" and rig.summaries[-1].fault == "stopped"
    before = len(rig.rallies)
    rig.run(3.0, lambda: rig.bridge.state is BridgeState.DISARMED)
    with pytest.raises(RefusedError):
        rig.bridge.reset(rig.now)
    rig.run(2.0)
    assert len(rig.rallies) == before
    rig.recover()
    assert rig.run(10.0, lambda: len(rig.rallies) > before)
