"""Numbers of a simulation that a compiled program takes, and those that decide the program."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from mjx_tt.sim import model as models
from mjx_tt.sim import randomisation
from mjx_tt.sim.arguments import arguments, structure
from mjx_tt.sim.model import SimModel
from mjx_tt.sim.randomisation import Range, Samples

CHANGED = {"ball.table.restitution": 0.8, "drives.joint_2.lag": 0.01, "latency.abb_action": 0.05}
RANDOMISED = (
    Samples(("ball.table.height", "latency.abb_action"), np.array([[0.0, 0.04], [0.01, 0.06]]), np.array([1.0, 3.0])),
    Range("ball.paddle.restitution", 0.8, 0.9),
)


def test_a_model_is_its_structure_and_its_numbers():
    """Put into the model of another with the same structure, the numbers make it the same but for single precision."""
    model = models.with_values(SimModel(), CHANGED)
    other = models.with_values(SimModel(), {path: 1.1 * value for path, value in CHANGED.items()})
    assert structure(model, ()) == structure(other, ())
    rebuilt = models.paths(models.with_values(other, arguments(model, ()).numbers))
    for path, value in models.paths(model).items():
        assert rebuilt[path] == (value if isinstance(value, str) else pytest.approx(value, rel=1e-6))


def test_what_is_drawn_replaces_the_models_number():
    model = models.with_values(SimModel(), CHANGED)
    taken = arguments(model, RANDOMISED)
    assert set(taken.numbers) == CHANGED.keys() - {"latency.abb_action"}
    key = jax.random.key(3)
    drawn = randomisation.drawn(key, taken.drawing, (500,))
    for path, values in randomisation.drawn(key, RANDOMISED, (500,)).items():
        np.testing.assert_array_equal(drawn[path], values)
    assert np.mean(drawn["latency.abb_action"] == np.float32(0.06)) == pytest.approx(0.75, abs=0.06)


@pytest.mark.parametrize(
    ("values", "randomised"),
    [
        ({}, ()),
        (CHANGED | {"ball.table.friction": 0.3}, ()),
        (CHANGED | {"ball.flight.integrator": "paper"}, ()),
        (CHANGED, RANDOMISED),
        (CHANGED, (Range("ball.paddle.restitution", 0.8, 0.9),)),
        (CHANGED, (Range("ball.paddle.restitution", 0.8, 0.95),)),
    ],
)
def test_another_structure_is_another_program(values, randomised):
    nominal = structure(models.with_values(SimModel(), CHANGED), ())
    assert structure(models.with_values(SimModel(), values), randomised) != nominal
