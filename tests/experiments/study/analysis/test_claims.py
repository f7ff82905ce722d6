"""Changes of the human models: intervals over seeds, or over the players of a single one, which the reason says."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from experiments.study.analysis import scoring
from experiments.study.analysis.claims import Measurements
from experiments.study.analysis.study_folder import StudyFolder

BEGINNERS, INTERMEDIATE = ("player3", "player5"), ("player2", "player4")


def measured(tmp_path, second: dict[tuple[int, str], float]) -> Measurements:
    """Of a study whose first changes are all 1, with these second ones by seed and player."""
    found = Measurements(StudyFolder(tmp_path, {}, {}, scoring.join([])))
    found.changes = {at: (1.0, change) for at, change in second.items()}
    return found


def test_changes_of_several_seeds_have_intervals_over_seeds(tmp_path):
    by_seed = {0: 0.1, 1: 0.2, 2: 0.15}
    second = {
        (s, p): x * (2.0 if p in BEGINNERS else 1.0) for s, x in by_seed.items() for p in BEGINNERS + INTERMEDIATE
    }
    m, logs = measured(tmp_path, second), np.log([*by_seed.values()])
    half = stats.t.ppf(0.975, 2) * logs.std(ddof=1) / math.sqrt(3)
    found = m.model_change()
    assert found.value == pytest.approx(math.sqrt(2.0) * math.exp(logs.mean())) and found.n == 3
    assert found.high / found.value == pytest.approx(math.exp(half)) and not found.over
    levels = m.model_change_by_level()
    assert (levels.value, levels.low, levels.high) == pytest.approx((2.0, 2.0, 2.0))  # the seeds' part cancels


def test_changes_of_one_seed_are_over_its_players_and_say_so(tmp_path):
    m = measured(tmp_path, {(0, "player3"): 0.1, (0, "player5"): 0.2, (0, "player2"): 0.1, (0, "player4"): 0.1})
    expected = stats.ttest_1samp(np.log([0.1, 0.2, 0.1, 0.1]), 0.0).confidence_interval()
    found = m.model_change()
    assert (found.low, found.high) == pytest.approx(tuple(np.exp(expected)))
    assert "players of one seed" in found.over and "players of one seed" in m.model_change_by_level().over
    whys = {key: found.why for key, found in m.findings.items()}
    assert "over the players of one seed alone" in whys["model-change"]
    assert measured(tmp_path, {(0, "player3"): 0.1}).model_change() is None
