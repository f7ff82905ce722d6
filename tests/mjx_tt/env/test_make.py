"""The short way in: rollouts of any size by one compiled program, environments by name."""

from __future__ import annotations

import subprocess
import sys

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import mjx_tt.env.gymnasium as table_tennis
from mjx_tt.env import evaluator, make
from mjx_tt.env.policy import Policy, initial_theta
from mjx_tt.env.task import TaskConfig
from robot_io.policy import export
from tests.support.paths import ROOT

QUICK = TaskConfig(sim_rate=75.0)


@pytest.fixture(scope="module")
def policy():
    return Policy(np.asarray(initial_theta(jax.random.key(0))), np.zeros(11, np.float32), np.ones(11, np.float32))


@pytest.fixture(scope="module")
def play():
    return make.make_rollout("narrow", task=QUICK, devices=1)


@pytest.fixture(scope="module")
def played(play, policy):
    return play(policy, 300, seed=3)


def test_another_number_of_episodes_compiles_nothing(play, policy, played):
    programs = play._evaluator._traced._cache_size()
    at_once = evaluator.ROWS * evaluator.COLUMNS
    for episodes in (1, 40, at_once + 1):
        assert play(policy, episodes, seed=1).returns.shape == (episodes,)
    assert play._evaluator._traced._cache_size() == programs == 1
    again = play(policy, 300, seed=3)
    np.testing.assert_array_equal(again.returns, played.returns)
    np.testing.assert_array_equal(again.ball, played.ball)


def test_a_policy_is_loaded_from_artefact_and_file(policy, tmp_path):
    export.write(tmp_path / "artefact", policy, {})
    policy.save(tmp_path / "policy.npz")
    for place in ("artefact", "policy.npz"):
        loaded = make.load_policy(tmp_path / place)
        for name in ("theta", "mean", "inv_std"):
            np.testing.assert_array_equal(getattr(loaded, name), getattr(policy, name))
            assert getattr(loaded, name).dtype == np.float32
    np.savez(tmp_path / "other.npz", theta=policy.theta)
    with pytest.raises(ValueError, match=r"other\.npz: .*missing are \['inverse_scale', 'mean'\]"):
        make.load_policy(tmp_path / "other.npz")


@pytest.mark.slow
def test_gymnasium_steps_many_balls():
    envs = gymnasium.make_vec(table_tennis.ID, num_envs=16, balls="narrow", task=QUICK, pool=64)
    observation, _ = envs.reset(seed=4)
    assert observation.shape == envs.observation_space.shape == (16, 88)
    first, ended, earned = observation, 0, 0.0
    for _ in range(150):
        observation, reward, terminated, truncated, info = envs.step(np.zeros((16, 8), np.float32))
        assert envs.observation_space.contains(observation) and not truncated.any()
        ended += terminated.sum()
        earned += reward.sum()
        if terminated.any():
            assert set(info) == {"hit", "returned", "episode_return", "_episode"}
    assert ended >= 16 and earned != 0.0
    np.testing.assert_array_equal(envs.reset(seed=4)[0], first)
    assert (envs.reset(seed=5)[0] != first).any()
    with pytest.raises(ValueError, match=r"shape \(3, 8\), wanted is \(16, 8\)"):
        envs.step(np.zeros((3, 8)))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*Box observation space")
def test_gymnasium_checks_the_single_environment():
    check_env(gymnasium.make(table_tennis.ID, balls="narrow", task=QUICK, pool=64).unwrapped, skip_render_check=True)


@pytest.mark.parametrize("package", ["mjx_tt", "ballmodel"])
def test_public_names_load_when_they_are_used(package):
    code = f"""
import sys, {package}
assert "jax" not in sys.modules, "importing {package} loads JAX"
names = [name for name in dir({package}) if not name.startswith("_")]
assert len(names) > 5
for name in {package}.__all__:
    getattr({package}, name)
"""
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)
