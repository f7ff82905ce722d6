"""The calibration's bookkeeping: deviations and lengths by hand, and what a round of tuning moves."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest

from ballmodel import registry
from benchmarks import player_calibration
from experiments.study.analysis import study_folder
from mjx_tt.rally import human_player


def reached(shift=0.0):
    """Every player's numbers exactly the paper's, but all maxima lower by ``shift``."""
    found = {}
    for name in human_player.names():
        numbers = {}
        for model in ("M0", "M1", "M2"):
            numbers[model] = study_folder.numbers(registry.load(f"{name}/{model}"))
            numbers[model][1::2] -= shift
        found[name] = player_calibration.Reached(numbers, np.arange(2, 62), {m: 10 for m in numbers})
    return found


def test_deviations_are_shares_of_each_range_and_lengths_leave_the_shortest_sixth_out(tmp_path):
    numbers, lengths = (
        f(reached(0.1)) for f in (player_calibration.compare_numbers, player_calibration.compare_lengths)
    )
    assert len(numbers) == 5 * 3 * 16
    row = next(r for r in numbers if (r["player"], r["model"], r["number"]) == ("player3", "M1", "position.x max"))
    assert row["target"] == 0.79 and row["reached"] == 0.69
    assert row["deviation"] == pytest.approx(0.1 / (0.79 + 0.93), abs=1e-3)
    assert all(r["deviation"] == 0.0 for r in numbers if r["number"].endswith("min"))
    rows = {r["statistic"]: r for r in lengths if r["player"] == "player1"}
    assert rows["min"]["reached"] == 12 and rows["max"]["reached"] == 61 and rows["mean"]["reached"] == 36.5
    assert rows["mean"]["target"] == 19.4 and rows["mean"]["rallies"] == 50

    player_calibration.write(tmp_path, numbers, lengths)
    with open(tmp_path / "calibration.csv", encoding="utf-8") as file:
        assert len(list(csv.DictReader(file))) == 240
    assert set(json.loads((tmp_path / "calibration.json").read_text())["medians"]) == set(human_player.names())
    assert (tmp_path / "calibration.png").stat().st_size > 20_000
