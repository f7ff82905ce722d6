"""Episodes made by hand: what they come to, when they end and what they are worth, against an independent calculation
of the ball (``ball_flight``) and MuJoCo's own poses and distances of the robot."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy import stats

from mjx_tt.env.reward_weights import TERMS
from mjx_tt.env.substeps import OUT_OF_REACH
from mjx_tt.env.task import CONTRACT_OBSERVATIONS, Task, TaskConfig, weigh_rewards
from mjx_tt.env.terms import ObservationTerm
from mjx_tt.robot import mjcf, robots
from robot_io.contract import N_JOINTS
from robot_io.limits import LIMITS
from tests.oracles import ball_flight
from tests.oracles.ball_flight import Touch, fly, on_blade, on_table, path
from tests.support.scripted_episodes import TICKS, P, Script, episodes, model, play, script, task

T = 1 / 75


@pytest.fixture(scope="module")
def blade():
    """Centre and normal of the blade at home, from MuJoCo."""
    mj = mjcf.load_model()
    data = mujoco.MjData(mj)
    data.qpos[:] = mjcf.home_qpos(mj)
    mujoco.mj_kinematics(mj, data)
    site = data.site(mjcf.PADDLE_SITE)
    return site.xpos.copy(), site.xmat.reshape(3, 3)[:, 2].copy()


@pytest.fixture(scope="module")
def serves(blade):
    """Eight balls for a robot that stands still."""
    lob = Touch(0.0, np.array([0.2, 0.3, 0.4]), np.array([0.0, -1.0, 1.0]), np.zeros(3))
    return {
        "returned": ball_flight.serve([0.2, 1.2, 0.5], -12.0, *blade),
        "returned off centre": ball_flight.serve([-0.3, 1.3, 0.6], -13.0, *blade, up=0.04),
        "back on the robot's side": ball_flight.serve([0.2, 1.2, 0.4], -5.0, *blade),
        "into the net": ball_flight.serve([0.2, 1.2, 0.5], -9.0, *blade),
        "volley": ball_flight.serve([0.2, 0.8, 0.5], -8.0, *blade, bounces=False),
        "past the paddle": replace(
            ball_flight.serve([0.2, 1.2, 0.4], -5.0, *blade), position=np.array([-0.2, 1.2, 0.4])
        ),
        "two bounces": lob,
        "human's side": Touch(0.0, np.array([0.0, 1.0, 0.3]), np.array([0.0, -1.0, -1.0]), np.zeros(3)),
    }


@pytest.fixture(scope="module")
def record(serves):
    position, velocity = (np.transpose([getattr(s, x) for s in serves.values()]) for x in ("position", "velocity"))
    with jax.enable_x64(True):
        return play(task(), episodes(position, velocity))


def index(serves, name):
    return list(serves).index(name)


def landing(struck: Touch):
    """Landing of the outgoing ball on the table's plane (2,), and the height of its centre over the net."""
    return on_table(struck).position[:2], fly(struck, lambda p: -p[1])[1][2]


@pytest.mark.parametrize("name", ["returned", "returned off centre"])
def test_a_still_blade_returns_the_ball_where_the_differential_equation_says(serves, record, blade, name):
    i = index(serves, name)
    where, height = landing(on_blade(on_table(serves[name]), *blade))
    assert where[1] > 0 and height > 0.2  # by the independent calculation it is a return
    assert record.last.hit[i] and record.back.returned[i] and record.back.crossed[i]
    np.testing.assert_allclose(record.back.landing[:, i], where, rtol=0, atol=1e-3)
    assert record.back.net_height[i] == pytest.approx(height, abs=1e-3)


def test_a_hit_that_falls_short_is_no_return(serves, record, blade):
    i = index(serves, "back on the robot's side")
    where, _ = landing(on_blade(on_table(serves["back on the robot's side"]), *blade))
    assert record.last.hit[i] and not record.back.returned[i] and not record.back.crossed[i]
    np.testing.assert_allclose(record.back.landing[:, i], where, rtol=0, atol=1e-3)
    i = index(serves, "into the net")
    _, height = landing(on_blade(on_table(serves["into the net"]), *blade))
    assert height < 0.1525 - 0.02  # the whole ball under the cord
    assert record.last.hit[i] and not record.back.returned[i] and not record.back.crossed[i]
    assert record.back.landing[1, i] < 0


@pytest.mark.parametrize("name", ["volley", "past the paddle", "two bounces", "human's side"])
def test_everything_else_is_no_hit(serves, record, name):
    i = index(serves, name)
    assert not record.last.hit[i] and not record.last.live[i]
    assert not record.back.returned[i] and not record.back.crossed[i]


def end(name, serve, blade):
    """Time at which nothing more can happen, and by how much that moment may be noticed late."""
    if name == "human's side":
        return on_table(serve).time, 0.0
    if name == "volley":
        return on_blade(serve, *blade).time, 0.0
    first = on_table(serve)
    if name == "two bounces":
        return on_table(first).time, 0.0
    if name == "past the paddle":  # noticed at the next substep
        y_min, z_min = OUT_OF_REACH
        return min(fly(first, lambda p: p[1] - y_min)[0], fly(first, lambda p: p[2] - z_min)[0]), 1 / 300
    return on_blade(first, *blade).time, 0.0


def test_episodes_end_as_soon_as_nothing_more_can_happen(serves, record, blade):
    for i, (name, serve) in enumerate(serves.items()):
        time, late = end(name, serve, blade)
        steps = {int(moment // T) + 1 for moment in (time, time + late)}
        assert record.last.accumulators.steps[i] in steps, name
        assert int(record.live[:, i].sum()) + 1 in steps, name
        assert (np.diff(record.live[:, i].astype(int)) <= 0).all()
        after = record.ball[int(record.last.accumulators.steps[i]) :, :, i]
        np.testing.assert_array_equal(after, np.broadcast_to(after[0], after.shape))  # the ball is left alone


def test_reward_terms_of_a_still_robot_by_hand(serves, record, blade):
    terms = {name: record.terms[i] for i, name in enumerate(TERMS)}
    for name in ("jerk", "acceleration", "velocity", "joint_angle"):
        np.testing.assert_array_equal(terms[name], 1.0)
    for name in ("fault", "collision", "paddle_height", "style"):
        np.testing.assert_array_equal(terms[name], 0.0)
    returned = [name.startswith("returned") for name in serves]
    np.testing.assert_array_equal(terms["hit_and_land"], returned)

    for name in ("returned", "returned off centre"):
        where, height = landing(on_blade(on_table(serves[name]), *blade))
        near = np.exp(-np.hypot(where[0], where[1] - 0.685) / 0.7)
        assert terms["state_transition"][index(serves, name)] == pytest.approx(3 + 1 + near, abs=1e-3)
        over_net = np.exp(-(((height - 0.35) / 0.25) ** 2))
        assert terms["net_clearance"][index(serves, name)] == pytest.approx(over_net, abs=3e-3)
    short = index(serves, "back on the robot's side")
    where, _ = landing(on_blade(on_table(serves["back on the robot's side"]), *blade))
    near = np.exp(-np.hypot(where[0], where[1] - 0.685) / 0.7)
    assert terms["state_transition"][short] == pytest.approx(3 + 0.5 * near, abs=1e-3)
    assert terms["net_clearance"][short] == 0

    # How near the missed ball came after its bounce: the simulation looks at substeps, at most 10 mm of path away.
    missed, first = index(serves, "past the paddle"), on_table(serves["past the paddle"])
    ball = path(first, np.linspace(first.time, first.time + 0.5, 2000))
    closest = np.linalg.norm(ball - blade[0][:, None], axis=0).min()
    assert terms["state_transition"][missed] == pytest.approx(3 * np.exp(-closest / 0.25), rel=0.01)
    assert 0.3 < terms["state_transition"][missed] < 3
    # A ball that never bounced on the robot's side was never near: 3 m stand for that.
    for name in ("volley", "human's side"):
        assert terms["state_transition"][index(serves, name)] == pytest.approx(3 * np.exp(-3 / 0.25))


@pytest.fixture(scope="module")
def flailing():
    """A robot that is pushed around hard, with a ball that hangs in the air."""
    with jax.enable_x64(True):
        return play(task(), hanging(), script(pushed()))


def hanging(p=P, **simulation):
    """Episodes with a ball that hangs in the air."""
    return episodes([0.0, 1.0, 0.5], [0.0, 0.0, 0.0], simulation=model(gravity=0.0, **simulation), p=p)


def pushed() -> np.ndarray:
    """Actions (TICKS, joints, P) that drive the robot into the table and itself."""
    actions = np.repeat(np.random.default_rng(0).uniform(-1, 1, (TICKS // 10, N_JOINTS, P)), 10, axis=0)
    actions[:, 1] = 1.0  # up to the table
    actions[:, 3] = np.abs(actions[:, 3])  # the upper arm forwards
    return actions


def test_motion_terms_equal_a_recount_of_the_commands(flailing):
    command = np.concatenate([np.zeros((1, N_JOINTS, P)), flailing.command])
    acceleration = np.diff(command, axis=0, prepend=0) / T
    a_max = np.array(LIMITS.acceleration)[:, None]
    measures = {
        "velocity": np.abs(command[1:]) / np.array(LIMITS.velocity)[:, None],
        "acceleration": np.abs(acceleration[1:]) / a_max,
        "jerk": np.abs(np.diff(acceleration, axis=0) / T) / (2 * a_max / T),
    }
    for name, share in measures.items():
        assert share.max() <= 1 + 1e-9
        np.testing.assert_allclose(flailing.terms[TERMS.index(name)], 1 - share.mean(axis=(0, 1)), atol=1e-12)
    np.testing.assert_allclose(flailing.last.accumulators.peak_velocity, np.abs(command).max(axis=0))
    lower, upper = np.array(LIMITS.lower)[:, None], np.array(LIMITS.upper)[:, None]
    soft = 0.05 * (upper - lower)
    safe = ((flailing.qpos > lower + soft) & (flailing.qpos < upper - soft)).all(axis=1).mean(axis=0)
    np.testing.assert_allclose(flailing.terms[TERMS.index("joint_angle")], safe, atol=1e-12)
    assert 0 < safe.min() < safe.max() <= 1


@pytest.fixture(scope="module")
def recounted(flailing):
    """By MuJoCo's poses and distances: periods (3, TICKS, P) in contact, with a low blade, with a blade aside."""
    mj, watched = mjcf.load_model(), robots.paper().file
    data, site = mujoco.MjData(mj), mj.site(mjcf.PADDLE_SITE).id

    def gap(pairs):
        return min(mujoco.mj_geomDistance(mj, data, mj.geom(a).id, mj.geom(b).id, 1.0, None) for a, b in pairs)

    table, low = ([(name, "col_table") for name in names] for names in (watched.table, watched.blade))
    found = np.zeros((3, TICKS, P), bool)
    for tick, i in np.ndindex(TICKS, P):
        data.qpos[:] = flailing.qpos[tick, :, i]
        mujoco.mj_kinematics(mj, data)
        found[:, tick, i] = gap([*watched.pairs, *table]) <= 0, gap(low) < 0.05, data.site_xmat[site, 5] < 0.3
    return found


def test_pose_terms_equal_a_recount_in_mujoco(flailing, recounted):
    for name, count in zip(("collision", "paddle_height", "style"), recounted.sum(axis=1), strict=True):
        assert 0 < count.sum() < TICKS * P  # the flailing robot does all of it, but not all the time
        np.testing.assert_array_equal(flailing.terms[TERMS.index(name)], -count, err_msg=name)


def test_a_contact_ends_the_episode_where_it_is_asked_for(flailing, recounted):
    """The first period after which MuJoCo finds the robot in contact; until then nothing differs."""
    with jax.enable_x64(True):
        ends = Task(replace(task().config, contact_ends_episode=True))
        stopped = play(ends, hanging(), script(pushed()))
    touched = np.logical_or.accumulate(recounted[0], axis=0)
    assert flailing.live.all() and touched.any()
    np.testing.assert_array_equal(stopped.live, ~touched)
    np.testing.assert_array_equal(stopped.terms[TERMS.index("collision")], -touched.any(axis=0).astype(float))


def test_commands_keep_the_kinematic_limits(flailing):
    reference = task().home[:, None] + np.cumsum(flailing.command, axis=0) * T
    change = np.diff(flailing.command, axis=0, prepend=0) / T
    for values, bound in ((flailing.command, LIMITS.velocity), (change, LIMITS.acceleration)):
        assert (np.abs(values) <= np.array(bound)[:, None] * (1 + 1e-9)).all()
    assert (reference <= np.array(LIMITS.upper)[:, None]).all() and (reference >= np.array(LIMITS.lower)[:, None]).all()


def test_a_further_observation_term_follows_the_contracts_rows():
    further = (*CONTRACT_OBSERVATIONS, ObservationTerm("last_command", lambda sensed: sensed.command, 0.5))
    config = TaskConfig(sim_rate=75.0, observations=further)
    assert config.n_observation == 19
    each, balls, command = Task(config), hanging(p=2), np.random.default_rng(0).normal(size=(N_JOINTS, 2))
    state = each.reset(balls, Script(jnp.zeros((1, N_JOINTS, 2)), jnp.zeros(19)))
    np.testing.assert_array_equal(state.controller[11:], 0.0)  # nothing was commanded before the first step
    state = replace(state, command=jnp.asarray(command, jnp.float32))
    seen = each.observe(1, state, balls, each.prepare(balls))
    np.testing.assert_allclose(seen[:3], [[0.0] * 2, [1.0] * 2, [0.5] * 2], atol=1e-6)
    np.testing.assert_allclose(seen[3:11], np.broadcast_to(each.home[:, None], (N_JOINTS, 2)), atol=1e-6)
    np.testing.assert_allclose(seen[11:], 0.5 * command, rtol=1e-6)


def test_ball_noise_is_two_diameters_wide_and_the_joints_have_none(flailing):
    """Noise of +-40 mm on each coordinate of the ball plus the tracker's offset, new at every step."""
    offset = {"ball_offset_x": 0.01, "ball_offset_y": -0.02, "ball_offset_z": 0.03}
    with jax.enable_x64(True):
        balls = hanging(ball_noise=0.04)
        sensing = replace(balls.model.sensing, **{name: jnp.full(P, value) for name, value in offset.items()})
        seen = play(task(), replace(balls, model=replace(balls.model, sensing=sensing))).controller
    noise = seen[:, :3] - np.array([0.0, 1.0, 0.5])[:, None] - np.array([0.01, -0.02, 0.03])[:, None]
    assert (np.abs(noise) < 0.04).all()
    assert stats.kstest(noise.ravel(), "uniform", (-0.04, 0.08)).pvalue > 1e-3
    np.testing.assert_allclose(seen[:, 3:], np.broadcast_to(task().home[:, None], (TICKS, N_JOINTS, P)), atol=1e-12)


def test_mistakes_in_the_configuration_are_named():
    for change, message in (
        (dict(engine="bullet"), r"engine 'bullet' is not one of \('fused', 'mjx'\)"),
        (dict(sim_rate=320.0), "sim_rate 320.0 Hz is not a whole multiple of control_rate 75.0 Hz"),
        (dict(sim_rate=50.0), "not a whole multiple"),
        (dict(max_steps=0), "max_steps is 0"),
        (dict(rewards=2 * weigh_rewards({})), "rewards has a name twice"),
        (dict(observations=()), "observations must begin with ball and joints"),
    ):
        with pytest.raises(ValueError, match=message):
            TaskConfig(**change)
    with pytest.raises(ValueError, match="rewards: styl is no reward term; allowed: .*style"):
        weigh_rewards({"styl": 1.0})
