"""All of the ball's parameters at once, from flights of other code."""

from __future__ import annotations

import numpy as np
import pytest

from ballmodel.trajectory import Trajectory
from experiments.config.study import PRIOR
from mjx_tt.diagnosis.ball import posterior
from mjx_tt.diagnosis.ball.flights.fit import first_fit, own_spins
from mjx_tt.diagnosis.ball.flights.linearization import Situation
from mjx_tt.diagnosis.ball.search import SCATTER
from mjx_tt.diagnosis.together import balls as of_balls
from mjx_tt.sim.model import SimModel
from tests.exam.generator.world import World, fly

pytestmark = [pytest.mark.slow, pytest.mark.optimised]
KNOWN = {path: (0.5 * (low + high), (high - low) / 12**0.5) for path, (low, high) in PRIOR.items()}


def thrown(spin: np.ndarray, world: World | None = None, samples: int = 56) -> list[Trajectory]:
    """Balls with spins (n,) [rad/s] across their way by the exam's physics, whose air lifts none; 3 mm of noise."""
    rng, n = np.random.default_rng(7), len(spin)
    position = rng.uniform([[-0.4], [1.0], [0.2]], [[0.4], [1.6], [0.4]], (3, n))
    velocity = rng.uniform([[-0.6], [-6.0], [0.5]], [[0.6], [-4.5], [1.5]], (3, n))
    spins = np.stack([spin, 0.0 * spin, 0.0 * spin])
    time = np.arange(samples) / 125.0
    path = fly(world or World(), np.concatenate([position, velocity, spins]), time[-1] + 0.01)
    seen = path.at(np.repeat(time[:, None], n, axis=1)) + rng.normal(0.0, 0.003, (3, time.size, n))
    flown = np.isfinite(seen).all(axis=0)  # until a ball has left the room
    return [Trajectory("day", str(i), time[flown[:, i]], seen[:, flown[:, i], i]) for i in range(n)]


def test_a_bounce_at_the_edge_decides_nothing():
    """One ball lands 1 cm from the end of the table: all is as if it had not been there."""
    balls, said = thrown(np.zeros(60)), []
    low = int(np.argmin(balls[0].position[2]))
    moved = balls[0].position - np.array([[0.0], [balls[0].position[1, low] + 1.36], [0.0]])
    at_edge = Trajectory("day", "edge", balls[0].time, moved)
    assert [of_balls.clear_of_the_edge(ball) for ball in (*balls[:2], at_edge)] == [True, True, False]
    alone = of_balls.fit(balls, SimModel(), KNOWN)
    found = of_balls.fit([*balls, at_edge], SimModel(), KNOWN, said.append)
    assert "left out, for they bounced at the table's edge: 1" in said
    np.testing.assert_array_equal(found.posterior.theta, alone.posterior.theta)


def test_bounces_that_differ_from_ball_to_ball_are_not_taken_for_spin():
    """Restitution with a deviation of 0.03 from ball to ball, no lift and no spin: both are found as they are.

    Fitted as if all bounces were alike, the restitution was 0.02 too high here (five deviations), the lift 0.2.
    """
    restitution = 0.93 + np.random.default_rng(4).normal(0.0, 0.03, 80)
    balls = thrown(np.zeros(80), World(restitution=restitution), 76)
    found = of_balls.fit(balls, SimModel(), KNOWN)
    values = found.problem.values(found.posterior.theta)
    at = [effect.path for effect in found.problem.effects].index("ball.table.restitution")
    deviation = found.posterior.std[at]
    assert abs(float(values["ball.table.restitution"]) - restitution.mean()) < 3.0 * deviation and deviation < 0.005
    # Spins that air without lift never shows may be of any size: what counts is by how much they bend a flight.
    assert found.spins is not None
    bent = 0.006 * 5.0 * abs(float(values[of_balls.LIFT])) * np.hypot(found.spins.mean, found.spins.std).max()
    assert abs(float(values[of_balls.LIFT])) < 0.05 and bent < 0.05  # [m/s^2]
    # Vertical kicks: 0.03 of some 3 m/s.
    assert 0.06 < found.posterior.noise.scatter[2] < 0.15


@pytest.mark.parametrize("lift", [0.1, 0.6])
def test_lift_of_lobs_that_hardly_spin_is_not_taken_for_larger(lift):
    """300 lobs with a few rad/s of topspin, seen until a tenth of a second after their bounces, which are all alike.

    By the best fits alone, without what the flights' spread costs, these came out at 0.24 and 0.96.
    """
    rng = np.random.default_rng(11)
    whole = thrown(rng.normal(1.3, 3.4, 300), World(magnus_coefficient=lift, restitution=0.92, friction=0.28), 76)
    seen = [slice(int(np.argmin(ball.position[2])) + 12) for ball in whole]
    balls = [Trajectory("day", b.name, b.time[s], b.position[:, s]) for b, s in zip(whole, seen, strict=True)]
    found = of_balls.fit(balls, SimModel(), KNOWN)
    values = found.problem.values(found.posterior.theta)
    at = [effect.path for effect in found.problem.effects].index(of_balls.LIFT)
    assert found.posterior.converged
    assert found.posterior.std[at] < 0.05
    assert abs(float(values[of_balls.LIFT]) - lift) < 1.5 * of_balls.LIFT_ERROR
    assert abs(float(values["ball.table.restitution"]) - 0.92) < 0.003


def test_a_fit_that_did_not_settle_says_as_much_and_states_how_far_it_would_go_on(monkeypatch):
    """After one round, from other code's flights off a slower table: its own errors alone would exclude the truth."""
    settled = of_balls.fit(thrown(np.zeros(60), World(restitution=0.89)), SimModel(), KNOWN)
    problem = settled.problem
    at = [effect.path for effect in problem.effects].index("ball.table.restitution")
    nominal = Situation(np.zeros(len(problem.effects)), first_fit(problem))
    monkeypatch.setattr(posterior, "ROUNDS", 1)
    found = posterior.fit(problem, *own_spins(problem, nominal), (), str, SCATTER)
    assert settled.posterior.converged and not found.converged
    value = float(problem.values(found.theta)["ball.table.restitution"])
    assert abs(value - 0.89) < 2.0 * found.std[at]
    assert found.std[at] > 3.0 * settled.posterior.std[at]


@pytest.mark.parametrize("lift", [0.0, 0.6])
def test_the_better_of_two_beginnings_finds_the_table_in_either_air(lift):
    """Begun without lift alone, balls that air lifts by 0.6 settle at 0.04, with spins of 225 rad/s.

    The draws of the lift stay on the side that air has.
    """
    balls = thrown(np.random.default_rng(5).normal(0.0, 20.0, 120), World(magnus_coefficient=lift, friction=0.22), 76)
    found = of_balls.fit(balls, SimModel(), KNOWN)
    assert found.posterior.converged
    paths = [effect.path for effect in found.problem.effects]
    for path, true in (("ball.table.friction", 0.22), ("ball.table.restitution", 0.93)):
        value, error = float(found.problem.values(found.posterior.theta)[path]), found.posterior.std[paths.index(path)]
        assert abs(value - true) < 3.0 * error and error < 0.01
    samples = found.samples(np.random.default_rng(0).normal(0.0, of_balls.LIFT_ERROR, 200))
    drawn = samples.values[:, samples.paths.index(of_balls.LIFT)]
    assert drawn.min() > -0.05 and np.quantile(drawn, 0.05) - 0.01 <= lift <= np.quantile(drawn, 0.95)
