"""The algorithms on problems whose answer is known, and a comparison from its YAML to its report."""

from __future__ import annotations

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from brax.envs.base import Env, State
from rich.console import Console

from ballmodel import registry
from experiments.baselines import compare
from experiments.baselines.learners import BudgetSpent, PpoLearner, SacLearner
from experiments.config import baselines, files
from experiments.config import experiment as config
from experiments.config.baselines import Ppo, Sac
from experiments.config.site import Site
from experiments.errors import ConfigError, RunError
from experiments.jobs.site import Workers
from experiments.runs import checkpoint
from mjx_tt.env.brax import OBSERVATION_SIZE
from robot_io.contract import N_JOINTS

# Of what is observed, the best action is a fixed linear function, cut to the allowed range.
WEIGHTS = np.random.default_rng(0).normal(size=(OBSERVATION_SIZE, N_JOINTS)).astype(np.float32) / 12.0


class Aim(Env):
    """Episodes of one step: the reward is minus the squared distance of the action from the best one, which earns 0."""

    observation_size, action_size, backend = OBSERVATION_SIZE, N_JOINTS, "none"

    def reset(self, rng):
        observation = jax.random.normal(rng[0], (rng.shape[0], OBSERVATION_SIZE))
        zero = jnp.zeros(rng.shape[0])
        metrics = {"hit": zero, "returned": zero, "episode_return": zero}
        return State(rng[0], observation, zero, zero, metrics, {"truncation": zero})

    def step(self, state, action):
        reward = -jnp.mean((action - best(state.obs)) ** 2, axis=-1)
        key, draw = jax.random.split(state.pipeline_state)
        metrics = state.metrics | {"episode_return": reward}
        observation = jax.random.normal(draw, state.obs.shape)
        return state.replace(
            pipeline_state=key, obs=observation, reward=reward, done=jnp.ones_like(reward), metrics=metrics
        )


def best(observation):
    return jnp.clip(observation @ WEIGHTS, -0.8, 0.8)


SAC = Sac(
    kind="sac", layers=[64, 64], environments=16, capacity=20_000, random_steps=2_000, gradient_steps=2, batch=128
)


@pytest.mark.optimised
@pytest.mark.slow
@pytest.mark.parametrize(
    "learner, pieces, steps",
    [
        (
            PpoLearner(
                Ppo(kind="ppo", environments=256, unroll=4, minibatches=4, learning_rate=1e-3, gae_lambda=1.0), Aim()
            ),
            120,
            120 * 256 * 4,
        ),
        (SacLearner(SAC, Aim()), 5, 2000 + 5 * 512 * 16),
    ],
    ids=["PPO", "SAC"],
)
def test_a_learner_comes_near_the_best_action(learner, pieces, steps):
    seen = []

    def observe(controller, counts):
        seen.append((controller, counts))
        if counts["steps"] >= steps:
            raise BudgetSpent

    learner.train(0, observe)
    assert [counts["steps"] > 0 for _, counts in seen].count(True) == pieces
    controller, counts = seen[-1]
    assert counts["episodes"] == counts["steps"] == steps
    template = learner.template()
    assert jax.tree.map(jnp.shape, controller) == jax.tree.map(jnp.shape, template)
    observation = jax.random.normal(jax.random.key(9), (500, OBSERVATION_SIZE))
    action = controller.decide(controller.parameters, observation)
    assert np.abs(action).max() <= 1.0
    distance = np.mean((action - best(observation)) ** 2) / np.mean(best(observation) ** 2)
    assert distance < 0.4  # of the squared distance that standing still leaves


SMALL = {
    "name": "small",
    "experiment": {
        "name": "small",
        "balls": "player3/M0",
        "task": {"sim_rate": 75},
        "training": {"pool": 64},
        "evaluation": {"episodes": 512, "sim_rate": 75},
    },
    "reality": {"ball_spin": {"mean_x": 300.0}},
    "algorithms": {"ES": {"kind": "bgs", "optimiser": {"num_directions": 2, "repeats": 2}}},
    "budget": {"episodes": 40},
    "curve": {"points": 2, "episodes": 512},
}


def write(folder, data):
    path = folder / "small.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """The YAML and the folder of a comparison by this process alone."""
    folder = tmp_path_factory.mktemp("alone")
    path = write(folder, SMALL)
    return path, compare.compare(*baselines.load(path), str(path), folder, Console())


@pytest.mark.slow
def test_a_comparison_runs_resumes_and_refuses(compared, capsys):
    (path, folder), console = compared, Console()
    out, run = folder.parent, folder / "ES" / "seed0"
    training = json.loads((run / "training.json").read_text())
    assert [point["episodes"] for point in training["curve"]] == [0, 24, 40]  # 8 an update; after a half and the whole
    report = json.loads((folder / "comparison.json").read_text())["algorithms"]["ES"]
    assert report["simulation"]["by_seed"]["0"] == report["simulation"]["return_rate"]
    assert report["simulation"]["mean_return"] != report["reality"]["mean_return"]  # only spin differs between the two
    for name in ("curves.png", "comparison.html"):
        assert (folder / name).stat().st_size > 0

    before = {path: path.stat().st_mtime_ns for path in run.rglob("*.*")}
    compare.compare(*baselines.load(path), str(path), out, console)
    assert "skipped" in capsys.readouterr().out
    assert before == {path: path.stat().st_mtime_ns for path in run.rglob("*.*")}

    def missing(*overrides):
        return compare.unfinished(compare.prepare(*baselines.load(path, overrides), str(path), out, console))

    assert missing() == {"ES": []}
    assert missing("seeds=[0, 3]") == {"ES": [3]}
    assert missing("algorithms.P={kind: ppo}") == {"ES": [], "P": [0]}
    assert missing("algorithms.ES.balls=narrow", "seeds=[3]") == {"ES": [3]}
    with pytest.raises(RunError, match="ES/seed0.*other settings of model;"):
        missing("algorithms.ES.model={sensing: {ball_noise: 0}}")
    for override in ("budget.episodes=80", "reality.ball_spin.mean_x=100.0", "experiment.balls=narrow"):
        with pytest.raises(RunError, match="ES/seed0.*other settings of (budget|reality|balls);"):
            missing(override)


@pytest.mark.parametrize("settings", [{"kind": "ppo"}, {"kind": "bgs"}])
def test_every_algorithm_has_the_joints_of_the_robot(tmp_path, settings):
    """Traced, not compiled: shapes of states, transitions and actions."""
    path = write(tmp_path, SMALL | {"robot": "fr3_pedestal"})
    comparison, config = baselines.load(path, (f"algorithms.X={settings}",))
    common = compare.prepare(comparison, config, str(path), tmp_path, Console())
    assert common.conditions("X")["robot"] == "fr3_pedestal" == common.comparison.to_dict()["robot"]
    controller = compare.learner(common.comparison.algorithms["X"], common.experiment).template()
    seen = jax.ShapeDtypeStruct((10, 5), jnp.float32)
    action = jax.eval_shape(lambda c, o: c.act(jnp.int32(0), c.start(o), o)[0], controller, seen)
    assert action.shape == (7, 5) and controller.mean.shape == (10,)


@pytest.mark.parametrize(
    "override, message",
    [
        ("algorithms.X={kind: pp}", r"algorithms\.X\.kind.*pp"),
        ("algorithms.X={kind: ppo, minibatches: 7}", r"algorithms\.X: .*minibatches 7 .*1024"),
        (
            "algorithms.X={kind: ppo, minibatch: 7}",
            r"algorithms\.X\.minibatch: expected .*; did you mean 'minibatches'",
        ),
        ("algorithms.a/b={kind: ppo}", r"algorithms\.a/b"),
        ("budget={clock: cpu}", r"minutes, episodes or both"),
        ("seeds=[1, 1]", r"seeds.*different"),
        ("experiment.training.later_rewards={after: 0.5, rewards: real}", r"later_rewards"),
        ("experiment.initial_policy=runs/quickstart", r"experiment: initial_policy: .*runs/quickstart.*random weights"),
        ("experiment.ball=narrow", r"experiment.*unknown key 'ball'"),
    ],
)
def test_a_mistake_in_the_yaml_is_named(tmp_path, override, message):
    with pytest.raises(ConfigError, match=message) as error:
        baselines.load(write(tmp_path, SMALL), (override,))
    assert "small.yaml" in str(error.value)


def test_an_algorithm_trains_in_a_world_of_its_own_and_is_judged_in_that_of_all(tmp_path):
    """The training alone has another model and other balls."""
    own = {"model": {"sensing": {"ball_noise": 0.0}, "latency": {"ball_observation": 0.0}}, "balls": "mine.yaml"}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(registry.load("player3/M1").to_dict()))
    data = SMALL | {"algorithms": SMALL["algorithms"] | {"own": SMALL["algorithms"]["ES"] | own}}
    path = write(tmp_path, data)
    common = compare.prepare(*baselines.load(path), str(path), tmp_path, Console())
    shared, alone = (compare.learner(common.comparison.algorithms[n], common.trains_in[n]) for n in ("ES", "own"))
    models = [x.trainer._model for x in (shared, alone)]
    assert [float(m.sensing.ball_noise) for m in models] == [0.04, 0.0]
    assert [float(m.latency.ball_observation) for m in models] == [0.04, 0.0]
    assert common.trains_in["ES"] is common.experiment
    first, second = (np.asarray(x.trainer.pool.state.position) for x in (shared, alone))
    box = registry.load("player3/M1")
    assert np.all(
        (second >= np.reshape(box.position_min, (3, 1)) - 1e-6)
        & (second <= np.reshape(box.position_max, (3, 1)) + 1e-6)
    )
    assert not np.array_equal(first, second)
    # The request that is kept holds what it needs, wherever it lies.
    assert common.comparison.to_dict()["algorithms"]["own"]["balls"] == registry.load("player3/M1").to_dict()
    mistakes = {
        "model={sensing: {ball_nois: 0}}": r"algorithms\.own.*ball_nois",
        "balls=nobody": r"algorithms\.own: balls.*nobody",
    }
    for override, message in mistakes.items():
        with pytest.raises(ConfigError, match=message):
            compare.prepare(*baselines.load(path, (f"algorithms.own.{override}",)), str(path), tmp_path, Console())


@pytest.mark.parametrize("name", files.shipped("compare"))
def test_a_shipped_comparison_is_valid(name):
    comparison, experiment = baselines.load(files.find_shipped(name, "compare"))
    assert comparison.name == name


def test_the_pillars_change_elites_and_orthogonality_of_the_papers_settings_alone():
    comparison, experiment = baselines.load(files.find_shipped("compare_pillars", "compare"))
    paper = config.load(files.find_shipped("paper", "train"))
    assert (experiment.task, experiment.model) == (paper.task, paper.model)
    rows = {name: learning.optimiser for name, learning in comparison.algorithms.items()}
    assert rows["difference-orthogonal"] == paper.optimiser
    for name, found in rows.items():
        rule, directions = name.split("-")
        rank = {"difference": "abs", "signed": "signed", "maximum": "max", "all": "abs"}[rule]
        changed = {"rank": rank, "elite_fraction": 1.0 if rule == "all" else 0.3}
        changed["orthogonal"] = directions == "orthogonal"
        assert found == paper.optimiser.model_copy(update=changed), name
    assert len(rows) == 8 and comparison.budget.episodes == 10_000 * 6_000


@pytest.mark.slow
def test_a_site_trains_the_same(compared, tmp_path):
    """In this process, and by a worker of Parsl's: the same policies, curves and evaluations."""
    path, folder = compared
    here = Site.model_validate({"provider": {"kind": "local"}, "workers_per_node": 1, "memory_per_worker": 1.0})
    compare.compare(*baselines.load(path), str(path), tmp_path, Console(), Workers(1, here, "here.yaml"))
    alone, site = (place / "ES" / "seed0" for place in (folder, tmp_path / "small"))
    arrays, others = (checkpoint.read_latest(folder / "policy")[0] for folder in (alone, site))
    assert arrays.keys() == others.keys() and len(arrays) > 0
    assert all(arrays[name].tobytes() == others[name].tobytes() for name in arrays)
    assert (alone / "evaluation.json").read_bytes() == (site / "evaluation.json").read_bytes()
    curves = [json.loads((folder / "training.json").read_text())["curve"] for folder in (alone, site)]
    timeless = [[p | {"seconds": 0, "cpu_seconds": 0} for p in curve] for curve in curves]
    assert timeless[0] == timeless[1]
