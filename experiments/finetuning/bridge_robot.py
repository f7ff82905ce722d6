"""Fine-tuning through the bridge process: a real robot, or the rig in real time, with the operator at the keyboard."""

from __future__ import annotations

from typing import Any

from experiments.deploy.operator_console import KEYS, Keyboard, View
from experiments.deploy.session import RECOVERIES, Session
from experiments.finetuning.robot import PlayedBall
from robot_io.emulator.processes import Rig
from robot_io.errors import RefusedError
from robot_io.policy.policy import Policy


class BridgeRobot:
    """A robot behind a control process, and its operator: both protocols of ``experiments.finetuning.robot``.

    It takes balls only while an episode is asked for. rig: None for a real robot, whose operator recovers from faults.
    """

    repeatable = False

    def __init__(self, session: Session, rig: Rig | None, keyboard: Keyboard, view: View, name: str) -> None:
        self._session, self._rig, self._keyboard, self._view, self._name = session, rig, keyboard, view, name
        self._paused = self._stopped = self._discarded = False
        session.ask("pause", True)

    def describe(self) -> dict[str, Any]:
        return {"robot": self._name}

    def play(self, policy: Policy, episode_number: int) -> PlayedBall:
        """Waits for the person's next ball. Raises RefusedError when the robot cannot be brought back after faults."""
        self._discarded = False
        session, failures = self._session, 0
        session.ask("policy", policy)  # the robot may still be on its way home from the last ball
        session.ask("pause", False)
        while True:
            for message in session.messages(0.1):
                if message[0] == "episode":
                    session.ask("pause", True)
                    summary, track = message[1:]
                    if summary.fault and self._rig is not None:
                        self._session.recover(self._rig)
                    return PlayedBall(summary, track)
                if message[0] == "status":
                    self._view.show(message[1])
                elif message[0] == "refused":
                    self._view.say(message[1])
            self._keys()
            if self._rig is not None:
                self._rig.check()
                if session.status and session.status["faults"]:
                    failures += 1
                    if failures > RECOVERIES:
                        raise RefusedError(f"the rig does not recover: {session.status['faults'][0]['text']}")
                    self._session.recover(self._rig)
                    session.ask("pause", False)

    def _keys(self) -> None:
        key = self._keyboard.pressed()
        if key not in KEYS:
            return
        request = KEYS[key][0]
        self._view.say(request)
        if request == "quit":
            self._stopped = True
            self._session.ask("stop")  # ends the episode in play, which is then played again
        elif request == "pause":
            self._paused = not self._paused
        elif request == "discard":
            self._discarded = True
        else:
            self._session.ask(request)

    # The operator, asked between episodes

    def discarded(self) -> bool:
        return self._discarded

    def paused(self) -> bool:
        """Also keeps the view alive while it waits."""
        for message in self._session.messages(0.0):
            if message[0] == "status":
                self._view.show(message[1])
        self._keys()
        return self._paused and not self._stopped

    def stopped(self) -> bool:
        return self._stopped
