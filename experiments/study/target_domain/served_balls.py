"""First balls of a virtual player on the emulated robot, as its trackers measure them."""

from __future__ import annotations

import numpy as np

from ballmodel.trajectory import Dataset, Trajectory
from experiments.deploy.virtual_player import VirtualPlayer
from experiments.errors import RunError
from experiments.finetuning.robot import SCENE, BallRecorder
from mjx_tt.diagnosis.logs import before_racket
from robot_io.emulator.config import RigParams
from robot_io.emulator.lockstep import LockStep

LEAST_SAMPLES = 20  # of a ball that is looked at
LONGEST_SERVICE, FEWEST_SERVICES = 2.0, 5  # [s] from ball to ball; one in five at least can be used


class Still:
    """A policy that stays where it is."""

    def reset(self) -> None:
        pass

    def step(self, observation: np.ndarray) -> np.ndarray:
        return np.zeros(len(observation) - 3)


def served(player: str, count: int, seed: int, session: str) -> Dataset:
    """Balls that a virtual player serves, as the emulated trackers measured them; the robot stands still."""
    recorder = BallRecorder()
    rig = LockStep(SCENE, VirtualPlayer(player, seed), Still(), RigParams(seed=seed % 2**31), recorder=recorder)
    rig.throwing = True
    found: tuple[Trajectory, ...] = ()
    while len(found) < count:
        before = len(found)
        rig.run(LONGEST_SERVICE * max(count - before, FEWEST_SERVICES))
        tracks = (recorder.trajectory(ball) for ball in recorder.balls)
        whole = [track for track in tracks if len(track) >= LEAST_SAMPLES]
        found = tuple(Trajectory(session, str(i), t[:, 0], t[:, 1:].T) for i, t in enumerate(whole[:count]))
        if len(found) == before:
            raise RunError(f"{player} serves no ball on the rig")
    return Dataset(tuple(before_racket(t) for t in found), f"{player} on the rig")
