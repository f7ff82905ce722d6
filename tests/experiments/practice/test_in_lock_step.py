"""A log that is read while the emulated robot plays and writes it, against what the finished log holds."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.finetuning import loop
from experiments.practice.growing_log import GrowingLog
from experiments.runs import load_policy
from experiments.runs.locate import find_policy
from robot_io.emulator.lockstep import LockStep
from robot_io.log import read
from robot_io.log.recorder import FileRecorder
from robot_io.policy.backends import make_policy


@pytest.mark.slow
def test_what_comes_in_pieces_is_what_the_finished_log_holds(tmp_path):
    source = find_policy("quickstart")
    experiment, policy = loop.experiment_of(source), load_policy.load(source).policy.astype(np.float32)
    robot, pieces, returned = experiment.task.robot, [], []
    growing = GrowingLog(tmp_path / "play.mcap")
    assert growing.read() == ((), [], ())  # nothing is there yet
    with FileRecorder(tmp_path, "play", {}) as recorder:
        rig = LockStep(
            robot.scene(),
            loop.throws_of(experiment, 1),
            make_policy("numpy", policy, robot.contract),
            recorder=recorder,
        )
        rig.start()
        rig.throwing = True
        for _ in range(6):
            rig.run(2.5)
            recorder.flush()
            balls, outcomes, joints = growing.read()
            pieces += balls
            returned += outcomes
    log = read(tmp_path / "play.mcap")
    whole, all_returned, _ = GrowingLog(tmp_path / "play.mcap").read()
    assert len(pieces) >= 3 and len(joints) == 8
    assert [b.time[0] for b in pieces] == [b.time[0] for b in whole][: len(pieces)]
    for piece, ball in zip(pieces, whole, strict=False):
        np.testing.assert_array_equal(piece.position, ball.position)
    assert returned == all_returned[: len(returned)] == [e.outcome == "returned" for e in log.episodes][: len(returned)]
