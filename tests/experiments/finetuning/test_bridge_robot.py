"""Fine-tuning through the bridge: each ball is credited to the policy that played it, and to no other."""

from __future__ import annotations

from collections import deque

import numpy as np
import pytest

from experiments.finetuning.on_robot import COMPUTING, BridgeRobot
from robot_io.control import messages
from robot_io.errors import RefusedError
from robot_io.policy.policy import Policy
from tests.support.simulated_clock import Constant, Simulation

PIPE = 0.03  # [s] from one end to the other, on a busy machine


class Session:
    """The control process behind a pipe that takes its time, on the simulated clock."""

    status = None

    def __init__(self, balls):
        self.simulation = Simulation(Constant(), self._ball, on_episode=self._played)
        self._balls, self._requests, self._reports = balls, deque(), deque()
        self.simulation.run(0.5)
        self.simulation.bridge.arm(self.simulation.now)

    def _ball(self, now):
        for number, start in enumerate(self._balls, 1):
            if 0 <= now - start < 0.72:
                s, self.simulation.number = now - start, number
                return np.array([0.0, 1.5 - 4.2 * s, max(0.03, 0.35 - 0.5 * s)])
        return None

    def _played(self, summary):
        self._report(messages.Played(summary, np.zeros((0, 4))))

    def _report(self, message):
        self._reports.append((self.simulation.now + PIPE, message))

    def send(self, request):
        self._requests.append((self.simulation.now + PIPE, request))

    def last_requests(self):
        return [request for _, request in list(self._requests)[-2:]]

    def messages(self, seconds):
        end = self.simulation.now + seconds
        assert end < 40.0, "no more balls"
        while self.simulation.now < end:
            self.simulation.step()
            while self._requests and self._requests[0][0] <= self.simulation.now:
                self._obey(self._requests.popleft()[1])
            while self._reports and self._reports[0][0] <= self.simulation.now:
                yield self._reports.popleft()[1]

    def _obey(self, request):
        bridge = self.simulation.bridge
        try:
            if isinstance(request, messages.SetPolicy):
                bridge.set_policy(Constant(1e-4 * np.ones(8) * float(request.policy.theta[0])), request.version)
                self._report(messages.PolicySet(request.version))
            elif isinstance(request, messages.Pause):
                bridge.paused = request.on
            elif isinstance(request, messages.Discard):
                self._report(messages.Discarded(bridge.discard(self.simulation.now)))
        except RefusedError as error:
            self._report(messages.Refused(request, error))


class Nobody:
    def pressed(self):
        return None

    def take(self, message):
        pass

    def say(self, text):
        pass


@pytest.mark.parametrize("gap", [0.62, 0.9, 2.5])
def test_a_ball_is_credited_to_the_policy_that_played_it(gap):
    """Balls in quick succession, also while the outcome of the one before is open."""
    session = Session([12.0 + gap * i for i in range(20)])
    robot = BridgeRobot(session, None, Nobody(), Nobody())
    bridge, played = session.simulation.bridge, {}
    step = Constant.step

    def watched(policy, observation):
        played.setdefault(bridge.play.episode.number, set()).add(round(1e4 * float(policy.action[0])))
        return step(policy, observation)

    Constant.step = watched
    try:
        credited = {}
        for member in range(1, 5):
            theta = np.full(976, float(member))
            found = robot.play(Policy(theta, np.zeros(11), np.ones(11)), 0)
            credited[found.summary.number] = member
    finally:
        Constant.step = step
    assert len(credited) == 4
    # Nobody reads the keys while the next policy is computed: it says so, once no balls are taken any more.
    assert session.last_requests() == [messages.Pause(True), messages.Beat(COMPUTING)]
    for number, member in credited.items():
        assert played[number] == {member}, (credited, played)


@pytest.mark.parametrize("late", [0.1, 0.55])
def test_a_late_discard_is_about_the_ball_that_was_seen(late):
    """The next ball is struck soon after; it is another one's."""
    session = Session([12.0 + 1.2 * i for i in range(20)])
    keyboard = Nobody()
    robot = BridgeRobot(session, None, keyboard, Nobody())
    policy = Policy(np.ones(976), np.zeros(11), np.ones(11))
    first = robot.play(policy, 0).summary
    assert not robot.retracts()
    press(keyboard, session, first.ended + late)
    second = robot.play(policy, 1).summary
    assert second.ball > first.ball and not second.discarded and robot.retracts() and not robot.retracts()
    press(keyboard, session, second.ended + 0.2)
    assert robot.retracts(0.5)  # before anybody plays on


def test_a_discard_in_mid_play_is_about_that_ball():
    session = Session([12.0 + 2.4 * i for i in range(20)])
    keyboard = Nobody()
    robot = BridgeRobot(session, None, keyboard, Nobody())
    policy = Policy(np.ones(976), np.zeros(11), np.ones(11))
    first = robot.play(policy, 0).summary
    press(keyboard, session, first.started + 2.4 + 0.6)
    second = robot.play(policy, 1).summary
    assert second.discarded and second.unfit and not robot.retracts()


def press(keyboard, session, time):
    """Presses d once, at a time of the simulated clock."""
    waiting = [time]

    def pressed():
        if not waiting or session.simulation.now < waiting[0]:
            return None
        waiting.clear()
        return "d"

    keyboard.pressed = pressed
