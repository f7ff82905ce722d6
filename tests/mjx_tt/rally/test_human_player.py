"""Virtual players against an ODE solver, the full ball simulation, closed forms and the ball physics' own signs."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from scipy.integrate import solve_ivp
from scipy.stats import binom

from ballmodel import constants as c
from ballmodel.aerodynamics import FlightParams
from ballmodel.fit_distribution import ROBOT_SIDE
from ballmodel.flight import ball_params
from ballmodel.sampling import KEPT, OWN_SIDE, SECOND_BOUNCE, throw
from ballmodel.state import BallState
from mjx_tt.rally import human_player, shots
from mjx_tt.rally.human_player import Incoming

N = 2000
ANSWER, FIRST_BALL = jax.jit(human_player.answer), jax.jit(human_player.first_ball, static_argnames="shape")
NAMES = ("player1", "player2", "player3", "player4", "player5")


def incoming(x=0.0, y=1.2, z=0.3, velocity=(0.0, 3.5, 0.5), spin=(0.0, 0.0, 0.0), seconds=0.6, n=N):
    def column(values):
        return jnp.repeat(jnp.asarray(values, jnp.float32)[:, None], n, axis=1)

    ball = BallState(column((x, y, z)), column(velocity), column(spin))
    return Incoming(ball, column((x, 0.7)), jnp.full(n, seconds))


def answers(name, ball, key=0, state=None, **changes):
    player = human_player.load(name)
    for group, values in changes.items():
        player = replace(player, **{group: replace(getattr(player, group), **values)})
    state = human_player.fresh((ball.seconds.shape[0],)) if state is None else state
    return ANSWER(player, state, jax.random.key(key), ball, FlightParams())


def test_an_aimed_stroke_lands_where_it_was_aimed_by_an_ode_solver():
    rng = np.random.default_rng(0)
    n = 20
    start = np.stack([rng.uniform(-0.8, 0.8, n), rng.uniform(0.3, 2.2, n), rng.uniform(-0.2, 1.0, n)])
    target = np.stack([rng.uniform(-0.7, 0.7, n), rng.uniform(-1.3, -0.3, n), np.full(n, 0.02)])
    seconds, spin = rng.uniform(0.3, 0.7, n), rng.normal(0, 60, (3, n))
    flight = FlightParams(magnus_coefficient=1.0)
    velocity = np.asarray(shots.aim_stroke(flight, *map(jnp.asarray, (start, target, seconds, spin))))
    k_d, k_m = (k * 1.29 * 1.256e-3 / (2 * 0.0027) for k in (0.47, 0.02))
    for i in range(n):

        def derivative(t, y, w=spin[:, i]):
            v = y[3:]
            return np.concatenate([v, [0, 0, -9.81] - k_d * np.linalg.norm(v) * v + k_m * np.cross(w, v)])

        end = solve_ivp(derivative, (0, seconds[i]), [*start[:, i], *velocity[:, i]], rtol=1e-9).y[:3, -1]
        np.testing.assert_allclose(end, target[:, i], atol=0.01)


def test_the_time_of_a_stroke_clears_the_net_on_a_parabola():
    rng = np.random.default_rng(1)
    start = np.stack([rng.uniform(-0.5, 0.5, N), rng.uniform(0.3, 2.0, N), rng.uniform(0.0, 0.9, N)])
    target = np.stack([rng.uniform(-0.5, 0.5, N), rng.uniform(-1.3, -0.3, N), np.full(N, 0.02)])
    seconds = np.asarray(shots.estimate_stroke_seconds(jnp.asarray(start), jnp.asarray(target), 6.0, 0.1))
    vz = (target[2] - start[2]) / seconds + 0.5 * 9.81 * seconds
    at_net = seconds * start[1] / (start[1] - target[1])
    height = start[2] + vz * at_net - 0.5 * 9.81 * at_net**2
    assert np.all(height > c.NET_HEIGHT + c.BALL_RADIUS + 0.1 - 1e-4)
    quickest = np.hypot(*(target - start)[:2]) / 6.0
    slow = seconds > quickest * 1.001
    assert 0.1 < slow.mean() < 0.9  # both rules matter
    np.testing.assert_allclose(height[slow], c.NET_HEIGHT + c.BALL_RADIUS + 0.1, atol=1e-4)


@pytest.mark.parametrize("name", NAMES)
def test_first_balls_are_lobs_to_the_robots_right_and_sometimes_services_or_misses(name):
    player = human_player.load(name)
    balls = FIRST_BALL(player, human_player.fresh((N,)), jax.random.key(3), shape=(N,))
    thrown = throw(ball_params(), balls, *ROBOT_SIDE)
    outcome = np.asarray(thrown.outcome)
    landed = (outcome == KEPT) | (outcome == SECOND_BOUNCE)
    assert landed.mean() > 0.85
    landing = np.asarray(thrown.landing)[:, landed]
    assert np.mean(landing[0] > 0.0) > 0.8  # the robot's right-hand quadrant
    services = int((outcome == OWN_SIDE).sum())
    assert binom.ppf(1e-4, N, player.first.service) <= services <= binom.ppf(0.9999, N, player.first.service) + 0.02 * N
    assert np.all(np.asarray(balls.position)[1] >= player.first.y.low - 1e-5)


HARDER = {
    "fast": dict(velocity=(0.0, 8.0, 0.5)),
    "spinning": dict(spin=(-150.0, 0.0, 0.0)),
    "wide": dict(x=0.8),
    "short": dict(y=0.3),
    "low": dict(z=-0.3),
    "hurried": dict(x=0.6, seconds=0.35),
}


@pytest.mark.parametrize("how", HARDER)
def test_a_harder_ball_is_answered_worse(how):
    exact = {"strokes": {"steadiness": 1e3}}  # every wish at its usual value: the spread is error alone

    def spread(ball):
        # Relative to the stroke that a player without errors plays.
        hit = answers("player3", ball, ability={"miss": -9.0, "misread": 0.0}, **exact).ball.velocity
        perfect = dict(direction=0.0, elevation=0.0, pace=0.0, miss=-9.0, misread=0.0)
        meant = answers("player3", ball, ability=perfect, **exact).ball.velocity
        return float(
            np.sqrt(np.mean(np.sum(np.asarray(hit - meant) ** 2, axis=0) / np.sum(np.asarray(meant) ** 2, axis=0)))
        )

    easy, hard = incoming(), incoming(**HARDER[how])
    assert spread(hard) > 1.05 * spread(easy)
    missed = [1.0 - float(np.mean(answers("player3", ball).hit)) for ball in (easy, hard)]
    assert missed[1] >= missed[0]


def test_unread_topspin_lifts_the_answer_and_the_robot_becomes_familiar():
    n = 4000
    spinning = incoming(spin=(-100.0, 0.0, 0.0), n=n)  # topspin of a ball that flies along +y
    stranger, friend = human_player.fresh((n,)), replace(human_player.fresh((n,)), familiarity=jnp.ones(n))
    rise = []
    for state in (stranger, friend):
        v = np.asarray(answers("player3", spinning, state=state, ability={"misread": 0.1}).ball.velocity)
        rise.append(np.mean(np.arctan2(v[2], np.hypot(v[0], v[1]))))
    assert rise[0] - rise[1] == pytest.approx(0.1, abs=0.02)


def test_tiring_and_getting_used_to_the_robot_follow_their_geometric_laws():
    player = human_player.load("player5")
    state, ball = human_player.fresh((1,)), incoming(n=1)
    for k in range(40):
        state = ANSWER(player, state, jax.random.key(k), ball, FlightParams()).state
    tired = 1.0 - (1.0 - player.person.tiring) ** 40
    assert float(state.tiredness[0]) == pytest.approx(tired, rel=1e-4)
    assert float(state.familiarity[0]) == pytest.approx(1.0 - (1.0 - player.person.adapting) ** 40, rel=1e-4)
    assert float(human_player.rested(player, state).tiredness[0]) == pytest.approx(
        tired * (1.0 - player.person.rest), rel=1e-4
    )
    speed = float(jnp.linalg.norm(ball.ball.velocity[:, 0]))
    np.testing.assert_allclose(np.asarray(state.expected)[:, 0], [0.0, 0.7, speed], atol=0.02)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d["first"].update(x=[1.0, 0.0, 2.0]), r"first\.x: expected .* ascending order, got \[1.0, "),
        (lambda d: d["ability"].update(miss="often"), r"ability\.miss: expected a finite number, got 'often'"),
        (lambda d: d["ability"].update(rech=1.0), r"ability\.rech: expected .*; did you mean 'reach'\?"),
        (lambda d: d.pop("spin"), r"spin: expected a mapping .*, got nothing"),
        (lambda d: d.update(person=3), r"person: expected a mapping .*, got 3"),
    ],
)
def test_errors_name_file_and_key(tmp_path, change, message):
    data = human_player.to_dict(human_player.load("player1"))
    change(data)
    path = tmp_path / "bad.yaml"
    path.write_text(yaml.safe_dump(data))
    with pytest.raises(ValueError, match=message) as error:
        human_player.read(path)
    assert str(path) in str(error.value)
