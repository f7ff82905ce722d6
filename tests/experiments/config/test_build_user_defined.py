"""The page "Define your own rewards, observations and network", followed as it stands."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
import yaml

from experiments import cli
from experiments.config import build
from experiments.config import experiment as config
from experiments.errors import ConfigError
from experiments.runs import load_policy
from experiments.training import finalize
from robot_io.policy import artefact, export
from robot_io.policy.backends import choose, make_policy
from tests.support.paths import ROOT

PAGE = (ROOT / "docs" / "how-to" / "define-a-task.md").read_text(encoding="utf-8")
SMALL = {
    "task.sim_rate": 75,
    "task.max_steps": 90,
    "optimiser.num_directions": 4,
    "optimiser.repeats": 2,
    "training.updates": 3,
    "training.pool": 256,
    "training.evaluate_every": "null",
    "training.devices": 1,
    "evaluation.episodes": 16,
    "evaluation.reachable_balls": "null",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The page's two files."""
    place = tmp_path_factory.mktemp("mine")
    for language, name in (("python", "my_task.py"), ("yaml", "my_task.yaml")):
        (place / name).write_text(re.search(rf"```{language}\n(.*?)```", PAGE, re.S).group(1))
    return place


@pytest.fixture(scope="module")
def trained(folder):
    """The folder after a short training as they describe it."""
    sets = [part for key, value in SMALL.items() for part in ("--set", f"{key}={value}")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(finalize, "show_episodes", lambda *_: [])  # pictures take long without a graphics card
        assert cli.main(["train", str(folder / "my_task.yaml"), "--out", str(folder / "runs"), *sets]) == 0
    return folder


@pytest.mark.slow
def test_its_terms_are_measured_and_weigh(trained):
    rows = [json.loads(line) for line in (trained / "runs/mine/metrics.jsonl").read_text().splitlines()]
    assert len(rows) == 3 and all(row["reward/calm_wrist"] < 0.0 <= row["reward/deep"] for row in rows)
    report = json.loads((trained / "runs/mine/evaluation.json").read_text())
    assert list(report["terms"])[-2:] == ["calm_wrist", "deep"]
    experiment = build.experiment(config.load(trained / "my_task.yaml"), "my_task.yaml")
    assert experiment.task.reward_weights[-2:] == (0.2, 0.5)
    assert build.later_weights(experiment.config)[1][-2:] == (0.0, 2.0)


@pytest.mark.slow
def test_the_run_stands_alone(trained):
    """Its configuration holds the file's content, and the same text is the same network to the compiler."""
    saved = load_policy.load(trained / "runs/mine")
    assert saved.config.definitions == (trained / "my_task.py").read_text()
    assert saved.policy.theta.shape == (968,) and saved.policy.network.size == 968
    assert load_policy.load(trained / "runs/mine").policy.network is saved.policy.network


def gru_by_hand(p, observations, mean, inv_std):
    """The page's network in NumPy and float64: actions (T, 8) of one episode."""
    h, actions = np.zeros(12), []
    for x in (observations - mean) * inv_std:
        a, b = p["w"] @ x + p["b"], p["u"] @ h
        z, r = np.split(1.0 / (1.0 + np.exp(-(a[:24] + b[:24]))), 2)
        h = z * h + (1.0 - z) * np.tanh(a[24:] + r * b[24:])
        actions.append(np.tanh(p["out"] @ h + p["bias"]))
    return np.array(actions)


@pytest.mark.slow
def test_the_robots_policy_is_the_network_by_hand(trained):
    loaded = artefact.load(trained / "runs/mine/artefact")
    observations = np.random.default_rng(2).normal(0.0, 1.0, (150, 11))
    arrays = np.load(trained / "runs/mine/artefact/params.npz")
    wanted = gru_by_hand(arrays, observations, loaded.policy.mean, loaded.policy.inv_std)
    backend, said = choose("auto", loaded.policy)
    policy = make_policy(backend, loaded.policy)
    np.testing.assert_allclose(policy.episode(observations), wanted, atol=1e-5)
    assert backend == "jit" and "'gru'" in said
    np.testing.assert_allclose(loaded.streaming().step(observations[0]), wanted[0], atol=1e-5)
    policy.reset()  # forgets the episode
    np.testing.assert_allclose(policy.step(observations[0]), wanted[0], atol=1e-5)
    with pytest.raises(ValueError, match="finite"):
        policy.step(np.full(11, np.nan))
    with pytest.raises(ValueError, match="'gru' is computed by jit only"):
        make_policy("numpy", loaded.policy)
    # What fine-tuning writes has the exported form only; it is the same policy.
    export.write(trained / "again", loaded.policy, {})
    np.testing.assert_array_equal(artefact.load(trained / "again").golden_action.shape, (64, 8))


@pytest.mark.slow
def test_it_is_fine_tuned_on_the_emulated_robot(trained):
    """Over real sockets, in lock-step: two updates, of which the artefact that is left is the last policy."""
    settings = {"updates": 2, "num_directions": 2, "repeats": 1, "evaluation_balls": 2}
    sets = [part for key, value in settings.items() for part in ("--set", f"{key}={value}")]
    out = trained / "tuned"
    assert cli.main(["finetune", str(trained / "runs/mine"), "--robot", "lockstep", "--out", str(out), *sets]) == 0
    before, after = (load_policy.load(place).policy for place in (trained / "runs/mine", out))
    assert after.network.name == "gru" and np.abs(after.theta - before.theta).max() > 1e-6
    loaded = artefact.load(out / "artefact")
    observations = np.random.default_rng(3).normal(0.0, 1.0, (100, 11))
    arrays = np.load(out / "artefact/params.npz")
    wanted = gru_by_hand(arrays, observations, loaded.policy.mean, loaded.policy.inv_std)
    np.testing.assert_allclose(make_policy("jit", loaded.policy).episode(observations), wanted, atol=1e-5)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"network": "cnn"}, "network: expected one of gru, got cnn"),
        ({"task.rewards": "{calm: 1}"}, "task: rewards: calm is no reward term; allowed: .*calm_wrist, deep"),
        ({"definitions": "null"}, "rewards.calm_wrist: unknown reward term; allowed: .*the key definitions"),
    ],
)
def test_mistakes_in_the_yaml_are_named(folder, changes, says):
    overrides = tuple(f"{key}={value}" for key, value in changes.items())
    with pytest.raises(ConfigError, match=says):
        build.experiment(config.load(folder / "my_task.yaml", overrides), "my_task.yaml")


def test_the_pages_observation_term_is_seen_by_a_network_of_its_size(folder, tmp_path):
    """The page's few further lines; the rows themselves are tested with the task."""
    code, setting = re.search(r"## Observation terms.*?```python\n(.*?)```.*?```yaml\n(.*?)```", PAGE, re.S).groups()
    observed = yaml.safe_load(setting)["task"]["observations"]
    text = (folder / "my_task.py").read_text() + code
    overrides = (f"task.observations={json.dumps(observed)}", f"definitions={tmp_path / 'my_task.py'}")
    (tmp_path / "my_task.py").write_text(text)
    with pytest.raises(ConfigError, match=r"(?s)network 'gru': line \d+.*dot_general"):
        build.experiment(config.load(folder / "my_task.yaml", overrides), "my_task.yaml")
    smaller, larger = re.search(r"`w` is `(.*?)` instead of `(.*?)`", PAGE).groups()[::-1]
    (tmp_path / "my_task.py").write_text(text.replace(smaller, larger))
    experiment = build.experiment(config.load(folder / "my_task.yaml", overrides), "my_task.yaml")
    last = experiment.task.observations[-1]
    with pytest.raises(ConfigError, match="observations: last_command: the paper's network takes ball and joints only"):
        build.experiment(config.load(folder / "my_task.yaml", (*overrides, "network=null")), "my_task.yaml")
    assert (last.name, last.weight, experiment.task.n_observation) == ("last_command", 0.1, 19)
    assert experiment.network.size == 968 + 36 * 8
