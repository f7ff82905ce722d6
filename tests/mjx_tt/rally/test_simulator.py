"""Rallies: the robot's turns against the rollout, touches against the log, every kind of end by its ball."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ballmodel import flight, registry
from ballmodel.flight import ball_params
from ballmodel.partial_params import without_nominal
from ballmodel.sampling import sample_pool
from ballmodel.state import BallState
from mjx_tt.env.episode import MISSED, RETURNED, Episodes
from mjx_tt.env.policy import Policy, initial_theta
from mjx_tt.env.rollout import Simulator
from mjx_tt.env.task import TaskConfig
from mjx_tt.rally import human_player
from mjx_tt.rally.ball_flights import Sent, drive_home, fly_to_player
from mjx_tt.rally.end_reasons import End, find_end
from mjx_tt.rally.human_player import Spread
from mjx_tt.rally.simulator import Box, RallySimulator, RallyState
from mjx_tt.sim.model import LATENCIES, SimModel, with_values
from robot_io.contract import N_JOINTS, N_OBSERVATION, n_parameters
from robot_io.limits import LIMITS

CONFIG = TaskConfig(sim_rate=75.0, max_steps=120)  # one substep: compiles in half the time
LANES = 12
EXACT = with_values(SimModel(), {f"latency.{name}_std": 0.0 for name in LATENCIES} | {"sensing.ball_noise": 0.0})
# A blade like a wall that takes no speed, in thin air: a hard lob comes back from it.
WALL = with_values(
    EXACT,
    {
        "ball.paddle.radius": 1.2,
        "ball.paddle.tilt": 0.01,
        "ball.paddle.restitution": 1.0,
        "ball.paddle.restitution_slope": 0.0,
        "ball.paddle.tangential_gain": 0.0,
        "ball.flight.drag_coefficient": 0.1,
    },
)
EVERYTHING = Box(np.full(8, -99.0, np.float32), np.full(8, 99.0, np.float32))
STILL = np.zeros((n_parameters(), LANES), np.float32)
NORMALISER = (np.zeros(N_OBSERVATION, np.float32), np.ones(N_OBSERVATION, np.float32))


@pytest.fixture(scope="module")
def simulator():
    return RallySimulator(CONFIG)


def spread(model):
    """The model with every leaf of a lane's own and the wall's effects: one compiled program serves all worlds."""

    def own(kept, leaf):
        return None if kept is None else jnp.full(LANES, leaf, jnp.float32)

    return jax.tree.map(own, without_nominal(WALL), model, is_leaf=lambda leaf: leaf is None)


def stacked(**changes):
    """Player 3 in every lane, who hits hard; with those changes."""
    player = human_player.load("player3")
    first = replace(
        player.first,
        y=Spread(1.2, 1.3, 1.4),
        z=Spread(0.35, 0.4, 0.45),
        forward=Spread(5.5, 6.0, 6.5),
        climb=Spread(0.0, 0.8, 2.0),
        landing=Spread(-1.0, -0.85, -0.7),
        sideways=Spread(-0.1, 0.0, 0.1),
    )
    player = replace(player, first=first, strokes=replace(player.strokes, speed=Spread(6.5, 6.8, 7.0), attack=0.0))
    for group, values in changes.items():
        player = replace(player, **{group: replace(getattr(player, group), **values)})
    return human_player.stack([player] * LANES)


def shots(simulator, balls, touches, theta=STILL, model=EXACT, box=EVERYTHING, start=None, key=0):
    """One turn from hand-made balls [(position, velocity), ...], repeated over the lanes."""
    position, velocity = (jnp.asarray([balls[i % len(balls)][k] for i in range(LANES)], jnp.float32).T for k in (0, 1))
    home = jnp.repeat(jnp.asarray(simulator.task.home, jnp.float32)[:, None], LANES, axis=1)
    state = RallyState(
        player=human_player.fresh((LANES,)),
        ball=BallState(position, velocity, jnp.zeros_like(position)),
        touches=jnp.full(LANES, touches, jnp.int32),
        start=home if start is None else start,
        dummy=jnp.zeros(LANES, bool),
    )
    state, result = simulator.shots(
        Policy(theta, *NORMALISER), stacked(), without_nominal(spread(model)), state, jax.random.key(key), box
    )
    return state, jax.tree.map(np.asarray, result)


def test_a_turn_of_the_robot_is_the_rollouts_episode(simulator):
    world = with_values(WALL, {"ball.paddle.radius": 0.4})  # some balls pass the blade
    pool = sample_pool(jax.random.key(0), registry.load("player3/M0"), world.ball, LANES)
    theta = np.stack([initial_theta(jax.random.key(i), 0.3) for i in range(LANES)], axis=1)
    state, result = shots(
        simulator, [(pool.state.position[:, i], pool.state.velocity[:, i]) for i in range(LANES)], 1, theta, world
    )
    rollout = Simulator(CONFIG)
    seconds = jnp.array([getattr(EXACT.latency, name) for name in LATENCIES])
    episodes = Episodes(
        pool.state, jnp.repeat(seconds[:, None], LANES, axis=1), jnp.zeros(LANES, jnp.uint32), without_nominal(world)
    )
    row = jax.tree.map(lambda x: x[..., None, :] if x.ndim else x, replace(episodes, model=spread(world)))
    expected = jax.jit(lambda t, e: rollout.rollout(Policy(t, *NORMALISER), e))(theta, row)
    lanes = ~result.fault
    assert lanes.sum() >= LANES // 2 and len(set(np.asarray(expected.outcome)[0][lanes])) > 1
    np.testing.assert_array_equal(result.outcome[lanes], np.asarray(expected.outcome)[0][lanes])
    np.testing.assert_allclose(result.terms[:, lanes], np.asarray(expected.terms)[:, 0][:, lanes], atol=2e-4)
    hit = lanes & (result.outcome != MISSED)
    np.testing.assert_allclose(result.return_landing[:, hit], np.asarray(expected.landing)[:, 0][:, hit], atol=2e-3)
    np.testing.assert_allclose(result.landing, pool.landing, atol=5e-3)  # another integrator's step


def aim(start, target, seconds):
    """Velocity of the drag-only flight, by shooting in NumPy with Euler's small steps."""
    velocity = (np.array(target) - start) / seconds + [0, 0, 0.5 * 9.81 * seconds]
    k_d = 0.47 * 1.29 * 1.256e-3 / (2 * 0.0027)
    for _ in range(6):
        x, v = np.array(start, float), velocity.copy()
        for _ in range(1000):
            a = np.array([0, 0, -9.81]) - k_d * np.linalg.norm(v) * v
            x, v = x + v * seconds / 1000 + 0.5 * a * (seconds / 1000) ** 2, v + a * seconds / 1000
        velocity = velocity + (np.array(target) - x) / seconds
    return velocity


FROM = np.array([0.3, 1.2, 0.3])
AT_PADDLE = (FROM, aim(FROM, [0.3, -0.9, 0.02], 0.5))  # meets the blade of a robot at home
LOB = (FROM * [-1, 1, 1], aim(FROM * [-1, 1, 1], [-0.4, -0.9, 0.02], 0.5))  # does not
CASES = {
    # ball, touches -> end
    "first to the net": ((FROM, aim(FROM, [0.3, 0.0, 0.08], 0.3)), 1, End.FIRST_NET),
    "first over the table": ((FROM, aim(FROM, [0.3, -2.0, 0.02], 0.6)), 1, End.FIRST_OVER_TABLE),
    "first beside the table": ((FROM, aim(FROM, [1.2, -0.9, 0.02], 0.5)), 1, End.FIRST_OVER_TABLE),
    "nobody reacts": (LOB, 1, End.NO_REACTION),
    "service": ((FROM, aim(FROM, [0.3, 0.5, 0.02], 0.15)), 1, End.SERVICE),
    "grazes the net": ((FROM, aim(FROM, [0.3, 0.0, 0.166], 0.3)), 1, End.HUMAN_GRAZES_NET),
    "later to the net": ((FROM, aim(FROM, [0.3, 0.0, 0.08], 0.3)), 3, End.HUMAN_OVER_TABLE),
    "later over the table": ((FROM, aim(FROM, [0.3, -2.0, 0.02], 0.6)), 3, End.HUMAN_OVER_TABLE),
    "later on the own side": ((FROM, aim(FROM, [0.3, 0.5, 0.02], 0.15)), 3, End.HUMAN_BOUNCES),
    "later to the edge": ((FROM, aim(FROM, [0.74, -0.9, 0.02], 0.5)), 3, End.HUMAN_EDGE),
    "later not reached by the robot": (LOB, 3, End.ROBOT_MISSED),
    "later hit, but not returned": (AT_PADDLE, 3, End.ROBOT_OUT),
}


def test_every_ball_gets_its_row(simulator):
    for touches in (1, 3):
        chosen = [(name, *case) for name, case in CASES.items() if case[1] == touches]
        _, result = shots(simulator, [ball for _, ball, *_ in chosen], touches)
        for lane, (name, _, _, end) in enumerate(chosen):
            assert End(result.end[lane]) == end, name
    assert np.isnan(result.landing[0, 0])


def test_balls_out_of_distribution(simulator):
    narrow = Box.of(replace(registry.load("narrow"), landing_max=(0.2, -1.2), landing_min=(0.1, -1.3)))
    box = Box(narrow.low, narrow.high)
    _, later = shots(simulator, [LOB], 3, box=box)
    assert set(later.end) == {End.OUT_OF_DISTRIBUTION}
    # A first ball, and a robot that moves: it is not that it did not react.
    theta = np.repeat(np.asarray(initial_theta(jax.random.key(3), 0.3))[:, None], LANES, axis=1)
    _, first = shots(simulator, [LOB], 1, theta, box=box)
    assert set(first.end[(first.outcome != RETURNED) & ~first.fault]) == {End.FIRST_OUT_OF_DISTRIBUTION}


@pytest.mark.slow
def test_a_robot_that_hits_itself_faults_and_gets_a_dummy_ball(simulator):
    # Every action saturated: whatever the ball does, the arm runs into something or is stopped by its limits.
    theta = np.asarray(jax.random.normal(jax.random.key(1), (n_parameters(), LANES))) * 5.0
    state, result = shots(simulator, [LOB], 1, theta)
    assert result.fault.any()
    assert np.all(result.outcome[result.fault] == MISSED)
    assert np.all(result.terms[3][result.fault] == -2.0) and np.all(result.terms[3][~result.fault] == 0.0)
    played = simulator.play(Policy(theta, *NORMALISER), stacked(), spread(EXACT), jax.random.key(0), 6, max_touches=20)
    end, length = np.asarray(played.end), np.asarray(played.length)
    dummy = (end == End.DUMMY_BY_HAND) | (end == End.DUMMY_WITH_PADDLE)
    assert (
        dummy.any()
        and np.all(length[end == End.DUMMY_BY_HAND] == 0)
        and np.all(length[end == End.DUMMY_WITH_PADDLE] == 1)
    )
    assert not np.any(dummy[1:] & dummy[:-1])  # after a dummy ball the robot stands at its start again
    assert set(end[:-1][dummy[1:]]) == {End.ROBOT_MISSED}  # also where the ball was a service, or into the net


def test_rallies_are_the_turns_played_one_by_one(simulator):
    """A rally's length, counted again: each ball is one touch, each that the robot hit another."""
    policy, player, world, key = Policy(STILL, *NORMALISER), stacked(), without_nominal(spread(WALL)), jax.random.key(5)
    played = jax.tree.map(np.asarray, simulator.play(policy, player, world, key, 6, EVERYTHING))
    assert played.length.max() >= 5  # the wall rallies
    start_key, key = jax.random.split(key)
    state, lengths, ends = simulator.start(player, world, start_key, LANES), [], []
    for turn in range(played.length.sum(axis=0).max()):
        state, shot = simulator.shots(
            policy, player, world, state, jax.random.split(jax.random.fold_in(key, turn))[0], EVERYTHING
        )
        lengths.append(1 + (np.asarray(shot.outcome) != MISSED))
        ends.append(np.asarray(shot.end))
    for lane in range(LANES):
        end, touches = np.array(ends)[:, lane], np.cumsum([length[lane] for length in lengths])
        over = np.flatnonzero(end != End.NONE)[:6]
        np.testing.assert_array_equal(played.end[:, lane], end[over])
        np.testing.assert_array_equal(played.length[:, lane], np.diff(touches[over], prepend=0))


def test_players_meet_the_return_where_finer_steps_have_it():
    """The contact, by the full ball simulation at 1,200 Hz."""
    position = np.array([[0.2, -0.6, 0.3], [0.0, -1.2, 0.2], [-0.3, -1.0, 0.25], [0.1, -0.8, 0.3]])
    target = np.array([[0.1, 0.7, 0.02], [0.5, 0.9, 0.02], [-0.2, 0.4, 0.02], [0.0, 1.0, 0.02]])
    velocity = np.stack([aim(p, t, s) for p, t, s in zip(position, target, (0.45, 0.6, 0.6, 0.4), strict=True)])
    plane, height = np.array([1.3, 1.5, 1.6, 1.4]), np.array([0.2, -0.1, 0.25, 0.3])
    ball = BallState(*(jnp.asarray(x.T, jnp.float32) for x in (position, velocity, 0 * velocity)))
    fly = jax.jit(
        lambda b: fly_to_player(SimModel().ball, b, jnp.ones(4, bool), jnp.asarray(plane), jnp.asarray(height), 1 / 75)
    )
    met = jax.tree.map(np.asarray, fly(ball))
    assert np.all(met.reached)
    fine, params = 1200, ball_params()

    def advance(state, _):
        new, events = flight.step(params, state, 1.0 / fine)
        return new, (new.position, new.velocity, events.table)

    _, (positions, velocities, table) = jax.lax.scan(advance, ball, None, length=2 * fine)
    for i in range(4):
        bounce = int(np.argmax(table[:, i]))
        np.testing.assert_allclose(met.incoming.landing[:, i], positions[bounce, :2, i], atol=0.01)
        assert met.incoming.landing[1, i] == pytest.approx(target[i, 1], abs=0.02)
        y, z, vz = positions[:, 1, i], positions[:, 2, i], velocities[:, 2, i]
        ready = np.arange(len(y)) > bounce + 0.06 * fine
        over = (y < 1.37) & (np.abs(positions[:, 0, i]) < 0.7625)
        fallen = (z <= np.where(over, max(height[i], human_player.OVER_TABLE), height[i])) & (vz < 0)
        first = int(np.argmax(ready & ((y >= plane[i]) | fallen)))
        # The contact is looked for once per control period.
        assert met.incoming.seconds[i] == pytest.approx((first + 1) / fine, abs=1.01 / 75)
        late = round(met.incoming.seconds[i] * fine) - 1
        np.testing.assert_allclose(met.incoming.ball.position[:, i], positions[late, :, i], atol=0.01)


def test_corner_and_cord_of_the_robots_return():
    """A ball out of the player's reach after a corner or a net cord has that row of the table."""
    position = np.array([[0.0, -1.0, 0.3], [0.3, -0.6, 0.25]])
    velocity = np.stack([aim(position[0], [0.7, 1.3, 0.02], 0.6), aim(position[1], [0.3, 0.0, 0.168], 0.25)])
    ball = BallState(*(jnp.asarray(x.T, jnp.float32) for x in (position, velocity, 0 * velocity)))
    wish = jnp.array([1.5, 1.5]), jnp.array([0.2, 0.2])
    met = jax.jit(lambda b: fly_to_player(SimModel().ball, b, jnp.ones(2, bool), *wish, 1 / 75))(ball)
    assert list(np.asarray(met.net)) == [False, True]
    side, line = 0.7625 - abs(float(met.incoming.landing[0, 0])), 1.37 - float(met.incoming.landing[1, 0])
    assert side < 0.25 and line < 0.25
    sent = Sent(*(jnp.array([flag] * 2) for flag in (False, False, True)), jnp.array([[0.3] * 2, [-0.9] * 2]))
    false = jnp.zeros(2, bool)
    end = find_end(false, sent, jnp.full(2, RETURNED), false, false, met, false, ~false)
    assert [End(e) for e in np.asarray(end)] == [End.ROBOT_CORNER, End.ROBOT_GRAZES_NET]


def test_the_robot_is_as_far_on_its_way_home_as_the_bridge_drives_it(simulator):
    """Against the bridge's law of motion, stepped: speed min(half the limit, sqrt(2 b d)), begun 0.1 s after a hit."""
    rng = np.random.default_rng(0)
    home = np.asarray(simulator.task.home)[:, None]
    lower, upper = np.asarray(LIMITS.lower)[:, None], np.asarray(LIMITS.upper)[:, None]
    qpos = np.clip(
        home + rng.uniform(-1.0, 1.0, (N_JOINTS, 40)) * np.array([0.7, 0.4, *[1.2] * 6])[:, None], lower, upper
    )
    seconds = rng.uniform(0.0, 1.2, 40)
    speed, braking = 0.5 * np.asarray(LIMITS.policy_velocity)[:, None], 0.3 * np.asarray(LIMITS.acceleration)[:, None]
    at, dt = qpos.copy(), 1e-4
    for k in range(12000):
        moving = (k * dt >= 0.1) & (k * dt < seconds)
        error = home - at
        at = at + moving * np.sign(error) * np.minimum(
            np.minimum(speed, np.sqrt(2 * braking * np.abs(error))) * dt, np.abs(error)
        )
    found = np.asarray(
        drive_home(simulator.task.home, jnp.asarray(qpos, jnp.float32), jnp.asarray(seconds, jnp.float32))
    )
    np.testing.assert_allclose(found, at, atol=2e-3)
