"""Change detection: run lengths against simulated ones, and changes hidden in balls by other code's physics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ballmodel.trajectory import Trajectory
from mjx_tt.diagnosis.monitor.cusum import DRIFT, FEWEST, RESERVE, Cusum, threshold
from mjx_tt.diagnosis.monitor.scores import NAMES, Scorer
from mjx_tt.sim import model as models
from mjx_tt.sim.model import SimModel
from tests.exam.generator.world import World, camera, fly

BEFORE, AFTER = 60, 30  # balls


def first_passage(rng: np.random.Generator, height: float, drift: float, most: int) -> int:
    sums = 0.0
    for step, z in enumerate(rng.normal(size=most), 1):
        sums = max(sums + z - drift, 0.0)
        if sums > height:
            return step
    return most


def test_height_gives_the_run_length_that_simulated_sums_have():
    rng = np.random.default_rng(0)
    lengths = [first_passage(rng, threshold(300.0, 0.5), 0.5, 20_000) for _ in range(400)]
    assert 0.85 < np.mean(lengths) / 300.0 < 1.15  # five standard errors are a quarter


def scores(rng: np.random.Generator, n: int, shift: float = 0.0) -> np.ndarray:
    """Five scores of other means and sizes than the standard ones; the third moves by some of its deviations."""
    out = rng.normal(size=(n, 5)) * [1.0, 5.0, 0.2, 3.0, 1.0] + [0.0, 40.0, -1.0, 0.0, 2.0]
    out[:, 2] += 0.2 * shift
    return out


NAMED = ("a", "b", "c", "d", "e")


def test_a_shift_is_found_by_its_name_soon_after_it_began():
    rng = np.random.default_rng(1)
    test = Cusum(NAMED, scores(rng, 40), 12_000)
    assert all(test.add(row) is None for row in scores(rng, 100))
    found = next(alarm for row in scores(rng, 60, shift=-2.5) if (alarm := test.add(row)) is not None)
    assert found.name == "c" and found.shift == pytest.approx(-2.5, abs=1.0)
    assert 95 <= found.since <= 105 and found.at < 115


def test_false_alarms_are_as_rare_as_they_may_be_though_the_reference_is_short():
    """Forty reference balls, 1,000 balls each time: one alarm in 12,000 allows for 2.5 among 30,000."""
    alarms = 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        test = Cusum(NAMED, scores(rng, 40), 12_000)
        alarms += any(test.add(row) is not None for row in scores(rng, 1_000))
    assert alarms <= 8  # the Poisson distribution of 2.5 has 99.9 % of its mass up to there
    assert 0.0 < RESERVE < DRIFT


def test_what_too_few_balls_show_raises_no_alarm():
    rng = np.random.default_rng(2)
    reference = scores(rng, 40)
    reference[FEWEST - 1 :, 2] = np.nan
    test = Cusum(NAMED, reference, 12_000)
    assert all(test.add(row) is None for row in scores(rng, 60, shift=20.0))
    holes = scores(rng, 60)
    holes[::2] = np.nan
    assert all(test.add(row) is None for row in holes)


def balls(world: World, count: int, seed: int) -> list[Trajectory]:
    """Balls towards the robot by the tests' own physics, with 3 mm of noise, each with a spin of its own."""
    rng = np.random.default_rng(seed)
    position = rng.uniform([[-0.4], [1.0], [0.2]], [[0.4], [1.6], [0.4]], (3, count))
    velocity = rng.uniform([[-0.6], [-6.0], [0.5]], [[0.6], [-4.5], [1.5]], (3, count))
    start = np.concatenate([position, velocity, rng.normal(0.0, 30.0, (3, count))])
    time = np.arange(70) / 125.0
    seen = camera(world, fly(world, start, time[-1] + 0.01).at(np.repeat(time[:, None], count, axis=1)))
    seen = seen + rng.normal(0.0, 0.003, seen.shape)
    return [Trajectory("s", str(i), time + 3.0 * i, seen[:, :, i]) for i in range(count)]


@pytest.fixture(scope="module")
def scorer() -> tuple[Scorer, np.ndarray]:
    """Of a believed world with spins, which the balls' own world is, and the scores of the reference."""
    spins = {f"ball_spin.std_{axis}": 30.0 for axis in "xyz"} | {"ball.flight.magnus_coefficient": 0.6}
    made = Scorer(models.with_values(SimModel(), spins))
    return made, made.score(balls(World(magnus_coefficient=0.6), BEFORE, 0), ())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({}, None),
        ({"restitution": 0.87}, "table_restitution"),
        ({"wind_x": 2.0}, "flight_misfit"),
        ({"drag_coefficient": 0.65}, "drag_coefficient"),
        ({"height": -0.02}, "table_height"),
    ],
    ids=lambda value: "+".join(value) or "nothing" if isinstance(value, dict) else "",
)
def test_a_change_of_the_world_is_noticed_and_its_score_is_among_those_that_moved(scorer, change, name):
    made, reference = scorer
    test = Cusum(NAMES, reference, 12_000)
    world = replace(World(magnus_coefficient=0.6), **change)
    alarms = [test.add(row) for row in made.score(balls(world, AFTER, 1), ())]
    found = next((alarm for alarm in alarms if alarm is not None), None)
    assert (name in (found.name, *found.others) and found.at < 20) if found else name is None
