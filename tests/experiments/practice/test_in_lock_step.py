"""A whole practice on the emulated robot, whose physics is MuJoCo C's: its rubber is worn, and nobody says so."""

from __future__ import annotations

import json

import numpy as np
import pytest
from rich.console import Console

from experiments.options import RobotOptions
from experiments.practice import in_lock_step
from experiments.practice.growing_log import GrowingLog
from experiments.runs.locate import find_policy
from mjx_tt.sim.model import ModelFile
from mjx_tt.sim.randomisation import Samples
from robot_io.log import read


@pytest.mark.slow
@pytest.mark.optimised
def test_the_worn_rubber_is_identified_from_the_log_while_it_is_written(tmp_path):
    rig = tmp_path / "worn.yaml"
    rig.write_text("world: {paddle_restitution: 0.5}\n")
    status = in_lock_step.practise(
        find_policy("quickstart"),
        tmp_path,
        Console(quiet=True),
        RobotOptions(rig=str(rig), seed=1),
        updates=2,
        balls=45,
    )
    assert status == 0
    (log,) = tmp_path.glob("*.mcap")
    lines = (log.with_suffix("") / "journal.jsonl").read_text().splitlines()
    events = [json.loads(line) for line in lines]
    identified = next(event for event in events if event["event"] == "identified")
    world = ModelFile.load(log.with_suffix("") / identified["world"])
    (samples,) = (one for one in world.randomise if isinstance(one, Samples))
    rubber = samples.values[:, samples.paths.index("ball.paddle.restitution")]
    assert 0.4 < np.median(rubber) < 0.62  # believed: 0.917; the prior ends at 0.83
    assert [event["event"] for event in events][:2] == ["identified", "trained"]
    # Nothing was lost or taken twice: what came in pieces is what the finished log holds.
    balls, returned, joints = GrowingLog(log).read()
    assert len(returned) == sum(bool(episode.outcome) for episode in read(log).episodes)
    assert len({ball.time[0] for ball in balls}) == len(balls) and len(joints) == 8
