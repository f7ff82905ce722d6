"""Coverage of identified worlds, and costs of effects, in tables of made-up folders."""

from __future__ import annotations

import json

import numpy as np
import pytest

from experiments.study.analysis import effect_costs, scoring
from experiments.study.analysis.claims import Measurements
from experiments.study.analysis.study_folder import StudyFolder
from experiments.study.report import comparisons, tables
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
    return StudyFolder(folder, {}, {}, scoring.join([]))


def test_joints_that_two_players_share_count_once(tmp_path):
    """Of one seed: two intervals of friction, one of the lag, which is the same for both, and one of the prior."""
    study = folder_of(tmp_path, {0: 0.01}, {0: (0.2, 0.3)})
    logs, prior = tables.tabulate_coverage(Measurements(study)).rows
    assert logs == ("world0", "logs", "2 of 3", "67%", "none: fewer than 5 seeds")
    assert prior == ("world0", "prior", "1 of 1", "100%", "none: given, not estimated")


def test_the_interval_of_coverage_is_over_seeds(tmp_path):
    """Of a seed either all three intervals hold the truth or none does: as wide as that of five yes and five no."""
    lags = {seed: 0.01 if seed < 5 else 0.05 for seed in range(10)}
    frictions = {seed: (0.2 + 1e-4, 0.2 - 1e-4) if seed < 5 else (0.3, 0.1) for seed in range(10)}
    logs = tables.tabulate_coverage(Measurements(folder_of(tmp_path, lags, frictions))).rows[0]
    assert logs[2:4] == ("15 of 30", "50%")
    low, high = (float(end.strip("% ")) for end in logs[4].split(" to "))
    # Of nine draws with 50 %: standard deviation 0.167.
    assert low == pytest.approx(50 - 1.96 * 16.7, abs=6) and high == pytest.approx(50 + 1.96 * 16.7, abs=6)


def outcomes(ratios: dict[tuple[int, str], float]) -> list[effect_costs.Outcome]:
    """Rallies of is2r-sim1 by seed and player, with all effects and without spin."""
    return [
        effect_costs.Outcome(seed, player, "is2r-sim1", world, 50, length)
        for (seed, player), ratio in ratios.items()
        for world, length in ((effect_costs.NOTHING, 10.0), ("spin", 10.0 * ratio))
    ]


def test_one_seeds_effects_have_no_interval_and_are_drawn(tmp_path):
    path = tmp_path / "seed0" / effect_costs.FILE
    path.parent.mkdir()
    effect_costs.write(path, outcomes({(0, "player3"): 2.0, (0, "player5"): 2.1}))
    study = StudyFolder(tmp_path, {}, {}, scoring.join([]))
    table = tables.tabulate_effects(Measurements(study))
    (row,) = table.rows
    assert row[:2] == ("spin", "2.05") and "to" not in "".join(row)
    figure = comparisons.draw_effects(Measurements(study))
    (text,) = figure.axes[0].texts
    assert text.get_text() == "2.05" and text.get_fontweight() == "normal"
