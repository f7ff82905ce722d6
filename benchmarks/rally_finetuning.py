"""Credit in fine-tuning through rallies: ``python -m benchmarks.rally_finetuning POLICY --updates 70``.

An impatient virtual player (0 to 1 s between balls, wherever the robot is) rallies with the emulated robot in lock-step
while it is fine-tuned. Every ball of the journal is looked up in the session's log: the actions logged between its
start and its end must be those of the perturbation that it is credited to, for the observations logged beside them.
"""

from __future__ import annotations

import json
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from rich.console import Console

from benchmarks.harness import run
from experiments.config.finetuning import FineTuning
from experiments.deploy.virtual_player import VirtualPlayer
from experiments.errors import RunError
from experiments.finetuning import loop
from experiments.finetuning.journal import Journal
from experiments.finetuning.robot import LockStepRallies, PlayedBall
from experiments.runs.run_dir import Run
from mjx_tt import platform
from robot_io.emulator.config import RigParams
from robot_io.errors import RefusedError
from robot_io.log.messages import Action, Event, Observation, Record
from robot_io.log.recorder import NullRecorder
from robot_io.policy.numpy_policy import StreamingPolicy
from robot_io.policy.policy import Policy


class Memory(NullRecorder):
    """Observations (n, 11) and actions (n, 8) of each episode of a session, by its number."""

    def __init__(self) -> None:
        self.observations: dict[int, list[np.ndarray]] = {}
        self.actions: dict[int, list[np.ndarray]] = {}
        self._number = 0

    def put(self, *records: Record) -> None:
        for record in records:
            if isinstance(record, Event) and record.name == "episode_start":
                self._number = json.loads(record.text)["episode"]
            elif isinstance(record, Observation):
                self.observations.setdefault(self._number, []).append(record.values)
            elif isinstance(record, Action):
                self.actions.setdefault(self._number, []).append(record.values)


class Watched(LockStepRallies):
    """Keeps the policy of each ball that was asked for, in order."""

    def __init__(self, opponent: VirtualPlayer, params: RigParams, log: Memory, minutes: float) -> None:
        super().__init__(opponent, params, recorder=log)
        self._end = time.monotonic() + 60.0 * minutes
        self.asked: list[tuple[Policy, int]] = []  # policy, number of the episode that came back

    def play(self, policy: Policy, episode_number: int) -> PlayedBall:
        if time.monotonic() > self._end:
            raise RefusedError("the time is over")
        played = super().play(policy, episode_number)
        self.asked.append((policy, played.summary.number))
        return played


def main(
    policy: str,
    *,
    player: str = "player3",
    updates: int = 70,
    balls: int = 100,
    pause: float = 1.0,
    minutes: float = 120.0,
    seed: int = 1,
) -> int:
    """Measures and prints; returns 1 when a ball was credited wrongly.

    Args:
        policy: run or artefact
        balls: in each of the evaluations before and after
        pause: [s] longest between two rallies
        minutes: after which what was played is checked
    """
    platform.configure(devices=1)
    log = Memory()
    params = RigParams(patient=False, pause=pause, seed=seed)
    robot = Watched(VirtualPlayer(player, seed), params, log, minutes)
    settings = FineTuning(updates=updates, evaluation_balls=balls)
    with TemporaryDirectory() as folder:
        found = None
        try:
            found = loop.finetune(policy, settings, Run(folder), robot, Console())
        except (RefusedError, RunError) as error:
            print(f"ended early: {error}")
        journal = Journal(Path(folder) / loop.JOURNAL)
        journal.close()
    wrong, unplayed = 0, 0
    for entry, (asked, number) in zip(journal.entries, robot.asked, strict=True):
        seen = log.observations.get(number, [])
        replayed = StreamingPolicy(asked)
        replayed.reset()
        same = all(np.array_equal(replayed.step(o), a) for o, a in zip(seen, log.actions.get(number, []), strict=True))
        wrong += entry.summary.number != number or not same
        unplayed += not seen
    entries = journal.entries
    others = set(log.actions) - {number for _, number in robot.asked}
    replaced = sum(entry.discarded for entry in entries)
    lengths = [rally.length for rally in robot.rallies if not rally.filtered]
    print(f"{len(entries)} balls in the journal, {wrong} credited wrongly, {unplayed} without an action")
    print(f"{replaced} replayed for a fault of the human; {len(others)} played by an earlier policy and not counted")
    print(f"{len(lengths)} rallies of {np.mean(lengths or [0]):.2f} touches, longest {max(lengths, default=0)}")
    print(json.dumps({} if found is None else found["difference"]))
    return int(wrong > 0)


if __name__ == "__main__":
    run(main)
