"""The course of a session: what is said of two worlds, and when a policy goes back."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from experiments.config import build
from experiments.practice import beliefs
from experiments.practice.learner import Trial
from experiments.practice.practice import JOURNAL, ODDS, WORSE, Piece, Practice
from mjx_tt.sim.model import ModelFile, SimModel
from mjx_tt.sim.randomisation import Samples

RUBBER, DRAG = "ball.paddle.restitution", "ball.flight.drag_coefficient"


def world(rubber: float, drag: float, seed: int) -> ModelFile:
    """A world of which 256 draws say that the rubber is known to 0.01 and the drag to 0.002."""
    draws = np.random.default_rng(seed).normal([rubber, drag], [0.01, 0.002], (256, 2))
    return ModelFile(SimModel(), (Samples((RUBBER, DRAG), draws, np.ones(256)),))


def test_what_changed_is_named_with_its_interval_and_the_rest_is_not():
    (found,) = beliefs.compare(world(0.9, 0.47, 0), world(0.7, 0.473, 1))
    assert found.path == RUBBER and found.before == pytest.approx(0.9, abs=0.003)
    half = 1.645 * 0.01  # of a normal distribution's 90 % interval
    assert (found.low, found.high) == pytest.approx((0.7 - half, 0.7 + half), abs=0.004)
    assert beliefs.compare(world(0.9, 0.47, 0), world(0.9, 0.47, 1)) == ()
    assert "beyond chance" in beliefs.say(()) and RUBBER in beliefs.say((found,))


class Unused:
    """Stands where nothing is to be trained."""

    def __getattr__(self, name: str):
        raise AssertionError(f"{name} was asked for")


def session(folder: Path) -> Practice:
    return Practice(Path("first"), build.distribution("player3/M0", "balls"), folder, Unused(), lambda text: None)


def journal(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / JOURNAL).read_text().splitlines()]


@pytest.mark.parametrize(("old", "new"), [(0.8, 0.95), (0.5, 0.9)])
def test_a_policy_goes_back_when_its_balls_say_so_at_the_stated_odds(tmp_path, old, new):
    """Wald's test by hand: missed balls multiply the odds by (1 - worse) / (1 - new), and misses alone are played."""
    course = session(tmp_path)
    course.exchange(Path("second"), Trial(old, new, 0.05, 0.2), "a change")
    needed = math.ceil(math.log(ODDS) / math.log((1.0 - (old - WORSE)) / (1.0 - new)))
    for played in range(1, needed):
        course.add(Piece(returned=[False]))
        assert course.back() is None, played
    course.add(Piece(returned=[False]))
    back = course.back()
    assert back is not None and back.policy == Path("first") and back.version == 2
    assert [(e["event"], e["version"], e["policy"]) for e in journal(tmp_path)] == [
        ("exchange", 1, "second"),
        ("exchange", 2, "first"),
    ]
    assert course.back() is None


def test_a_policy_that_returns_what_it_promised_goes_back_in_one_case_of_twenty_at_most(tmp_path):
    """Of 100 such policies five at most are expected; more than 13 have a probability of 0.001."""
    gone, rng = 0, np.random.default_rng(0)
    for i in range(100):
        course = session(tmp_path / str(i))
        course.exchange(Path("second"), Trial(0.8, 0.95, 0.05, 0.2), "a change")
        for returned in rng.random(300) < 0.95:
            course.add(Piece(returned=[bool(returned)]))
        gone += course.back() is not None
    assert gone <= 13
