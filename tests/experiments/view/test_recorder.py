"""Replays of simulated balls against the rollouts of the Python face."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_tt
from experiments.view.recorder import Recorder
from mjx_tt.env.episode import MISSED, RETURNED
from mjx_tt.env.task import TaskConfig
from mjx_tt.rally.end_reasons import End
from mjx_tt.sim.model import ModelFile, Range, SimModel, with_values
from robot_io.contract import JOINT_NAMES

CHANGED = {"ball.table.restitution": 0.7, "latency.abb_action": 0.1, "drives.joint_2.velocity_gain": 0.8}


def face(pair, values):
    """Terms and outcomes of the first balls as ``Simulator.rollout`` plays them in the world with these values."""
    numbers = range(8)
    states = np.stack([pair.state(n) for n in numbers], axis=1)
    world = Recorder(pair.recorder.simulator.config, ModelFile(with_values(SimModel(), values)))
    episodes = world.episodes(world.draws(states, numbers, pair.seed), {})
    episodes = jax.tree.map(lambda x: x[..., :, None] if jnp.ndim(x) else x, episodes)
    policy = pair.policies[0]
    single = mjx_tt.Policy(policy.theta[:, None], policy.mean, policy.inv_std)
    return mjx_tt.Simulator(pair.recorder.simulator.config).rollout(single, episodes)


@pytest.mark.slow
@pytest.mark.parametrize("values", [{}, CHANGED], ids=["nominal", "moved"])
def test_a_film_shows_what_the_rollout_does(pair, values):
    pair.values = pair.recorder.nominal() | values
    pair.clear()
    rollout = face(pair, values)
    for n in range(8):
        replay = pair.replays(n)[0]
        terms = np.array([value for value, _ in replay.terms.values()])
        np.testing.assert_allclose(terms, np.asarray(rollout.terms)[:, n, 0], atol=2e-3)
        assert replay.outcome.startswith("returned") == (int(rollout.outcome[n, 0]) == RETURNED)


def test_a_moved_slider_changes_the_play_and_compiles_nothing(pair):
    before = pair.replays(0)
    np.testing.assert_array_equal(before[0].qpos, before[1].qpos)  # the same policy at both tables
    programs = pair.recorder._record._cache_size()
    for path, value in CHANGED.items():
        pair.values = pair.recorder.nominal() | {path: value}
        pair.clear()
        assert np.abs(pair.replays(0)[0].qpos[:200] - before[0].qpos[:200]).max() > 1e-3, path
    assert pair.recorder._record._cache_size() == programs == 1


def test_inputs_and_outputs_are_the_policys(pair):
    """The shipped network, applied to the recorded inputs, gives the recorded outputs."""
    replay = pair.replays(0)[0]
    ball, joints, output = replay.series.values()
    seen = np.concatenate([ball.values, joints.values], axis=1).T
    assert joints.names == JOINT_NAMES
    history = np.concatenate([np.repeat(seen[:, :1], 7, axis=1), seen], axis=1)
    wanted = [pair.policies[0].apply(history[:, k : k + 8].T) for k in range(seen.shape[1])]
    np.testing.assert_allclose(output.values, wanted, atol=1e-4)


def test_a_randomised_parameter_is_drawn_until_its_slider_is_moved():
    path = "ball.table.restitution"
    recorder = Recorder(TaskConfig(), ModelFile(SimModel(), (Range(path, 0.8, 0.9),)))
    draws = recorder.draws(np.zeros((9, 6)), range(6), 0)
    drawn = np.asarray(recorder.model(draws, recorder.nominal()).ball.table.restitution)
    assert len(set(drawn)) == 6 and (drawn >= 0.8).all() and (drawn <= 0.9).all()
    moved = recorder.model(draws, recorder.nominal() | {path: 0.5})
    np.testing.assert_allclose(moved.ball.table.restitution, 0.5)


@pytest.mark.slow
def test_a_rally_is_shown_as_the_simulator_plays_it(pair):
    pair.player = "player3"
    for n in range(6):
        replays = pair.replays(n)
        rally = pair._rallying()
        shot = rally.shots[n]
        for i, replay in enumerate(replays):
            assert replay.outcome.startswith("missed") == (int(shot.outcome[i]) == MISSED)
            if End(int(shot.end[i])) is End.NONE:
                assert abs(replay.seconds - float(shot.seconds[i])) < 0.02
                ball = np.asarray(rally.shots[n].ball.position)[:, i]
                np.testing.assert_allclose(replay.balls["ball"][0], ball, atol=1e-6)
