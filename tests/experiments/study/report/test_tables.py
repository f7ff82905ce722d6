"""Coverage of identified worlds in tables of made-up folders."""

from __future__ import annotations

import json

import numpy as np

from experiments.study.analysis import scoring
from experiments.study.analysis.claims import Measurements
from experiments.study.analysis.study_folder import StudyFolder
from experiments.study.report import tables
from mjx_tt.sim.model import ModelFile, Range, SimModel
from mjx_tt.sim.randomisation import Samples

FRICTION, LAG, PRIOR = "ball.table.friction", "drives.joint_1.lag", "ball.paddle.restitution"
PLAYERS = ("player3", "player5")


def folder_of(folder, lags: dict[int, float], frictions: dict[int, tuple[float, float]]) -> StudyFolder:
    """A study in which the truth of the lag is 0.01 and of the friction 0.2, with centres of their intervals by seed.

    The lag is the same for both players, as is the prior; the friction is each player's own.
    """
    for seed, lag in lags.items():
        for player, friction in zip(PLAYERS, frictions[seed], strict=True):
            values = np.linspace(-0.002, 0.002, 41)[:, None] + np.array([lag, friction])
            world = ModelFile(SimModel(), (Samples((LAG, FRICTION), values, np.ones(41)), Range(PRIOR, 0.83, 1.0)))
            path = folder / f"seed{seed}" / player / "identified" / "world0.yaml"
            path.parent.mkdir(parents=True)
            world.save(path)
        reality = {"seed": seed, "reality": {FRICTION: 0.2, LAG: 0.01, PRIOR: 0.9}}
        (folder / f"seed{seed}" / "reality.yaml").write_text(json.dumps(reality))
    return StudyFolder(folder, {}, scoring.join([]))


def test_joints_that_two_players_share_count_once(tmp_path):
    """Of one seed: two intervals of friction, one of the lag, which is the same for both, and one of the prior."""
    study = folder_of(tmp_path, {0: 0.01}, {0: (0.2, 0.3)})
    logs, prior = tables.tabulate_coverage(Measurements(study)).rows
    assert logs == ("world0", "logs", "2 of 3", "67%")
    assert prior == ("world0", "prior", "1 of 1", "100%")
