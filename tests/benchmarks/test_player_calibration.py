"""The calibration's bookkeeping: deviations and lengths by hand, and what a round of tuning moves."""

from __future__ import annotations

import csv
import json
import shutil

import numpy as np
import pytest
import yaml

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


def test_the_numbers_are_named_in_their_order():
    numbers = study_folder.numbers(registry.load("player3/M1"))
    by_name = dict(zip(player_calibration.NUMBERS, numbers, strict=True))
    assert by_name["position.z min"] == -0.15 and by_name["velocity.y max"] == -2.19
    assert by_name["landing.x max"] == 0.76 and by_name["velocity.x min"] == -by_name["velocity.x max"] == -2.59


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


def test_tuning_moves_the_ends_that_lack_something_and_no_others(tmp_path, monkeypatch):
    for path in human_player.FOLDER.glob("*.yaml"):
        shutil.copy(path, tmp_path)
    before = yaml.safe_load((tmp_path / "player4.yaml").read_text())
    monkeypatch.setattr(human_player, "FOLDER", tmp_path)
    player_calibration.tune(player_calibration.compare_numbers(reached(0.1)))
    after = yaml.safe_load((tmp_path / "player4.yaml").read_text())
    # x of first balls: the maximum lacks 0.1 m, half of it is made up for.
    assert after["first"]["x"][2] == pytest.approx(before["first"]["x"][2] + 0.05, abs=2e-3)
    assert after["first"]["x"][0] == pytest.approx(before["first"]["x"][0], abs=2e-3)
    # The largest (least negative) velocity along y is the slowest ball: to raise it, the lowest speed goes down.
    assert after["first"]["forward"][0] == pytest.approx(before["first"]["forward"][0] - 0.05, abs=2e-3)
    assert after["ability"] == before["ability"] and after["spin"] == before["spin"]
    human_player.read(tmp_path / "player4.yaml")
