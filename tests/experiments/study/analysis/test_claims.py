"""Changes of the human models: intervals over seeds, or over the players of a single one, which the reason says."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from experiments.study.analysis import scoring
from experiments.study.analysis.claims import Measurements, paper_changes
from experiments.study.analysis.study_folder import StudyFolder
from mjx_tt.rally.end_reasons import End

BEGINNERS, INTERMEDIATE = ("player3", "player5"), ("player2", "player4")


def measured(tmp_path, second: dict[tuple[int, str], float]) -> Measurements:
    """Of a study whose first changes are all 1, with these second ones by seed and player."""
    found = Measurements(StudyFolder(tmp_path, {}, scoring.join([])))
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


def test_a_group_has_the_changes_of_its_players_alone(tmp_path):
    m = measured(tmp_path, {(s, p): 0.2 if p in BEGINNERS else 0.6 for s in (0, 1) for p in BEGINNERS + INTERMEDIATE})
    assert m.model_change(group="beginner").value == pytest.approx(0.2)
    assert m.model_change(group="intermediate").value == pytest.approx(0.6)
    assert m.findings["change-beginner"].paper == pytest.approx(
        math.sqrt(math.prod(b / a for a, b in map(paper_changes, BEGINNERS)))
    )


def play(model: str, lengths: list[int]) -> scoring.Rallies:
    ends = [End.ROBOT_MISSED] * len(lengths)
    return scoring.score_rallies(0, "player3", "player3", model, "", lengths, ends)


def test_the_longest_rally_is_of_all_that_count(tmp_path):
    rallies = scoring.join([play("is2r-ft100", [3] * 99 + [151]), play("s2r-ft100", [400] * 100)])
    found = Measurements(StudyFolder(tmp_path, {}, rallies)).longest_rally("is2r-ft100")
    assert found.value == 151
    # One rally of a hundred is drawn again with probability 1 - 0.99^100.
    assert np.mean(found.draws == 151) == pytest.approx(1.0 - 0.99**100, abs=0.04)


def test_a_poor_zero_shot_policy_costs_the_updates_to_an_equal_level(tmp_path):
    """Two fine-tunings that rise alike, from 0.1 and from 0.4: to 0.645, the average that both reach."""
    rallies = scoring.join([play("is2r-sim1", [2] * 60), play("oracle-sim", [8] * 60)])
    m = Measurements(StudyFolder(tmp_path, {}, rallies))
    for model, start in (("is2r-ft35", 0.1), ("oracle-ft", 0.4)):
        folder = m.study.paths.model(0, "player3", model)
        folder.mkdir(parents=True)
        rows = ({"update": k + 1, "return_rate": start + 0.01 * k} for k in range(60))
        (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert m.tuning_cost() is None  # one player of one seed has no interval
    shutil.copytree(tmp_path / "seed0", tmp_path / "seed1")
    second = rallies.copy()
    second.seed = 1
    m = Measurements(replace(m.study, rallies=scoring.join([rallies, second])))
    assert m.tuning_cost().value == pytest.approx(60 / 30)
