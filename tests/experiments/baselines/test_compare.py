"""The algorithms on problems whose answer is known, and a comparison from its YAML to its report."""

from __future__ import annotations

import csv
import json
import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from brax.envs.base import Env, State
from brax.training.types import Transition
from rich.console import Console

from ballmodel import registry
from experiments.baselines import compare
from experiments.baselines.learners import BudgetSpent, PpoLearner, SacLearner
from experiments.baselines.qt_opt import QtOptLearner, best_action
from experiments.config import baselines
from experiments.config import experiment as config
from experiments.config.baselines import Ppo, QtOpt, Replay, Sac
from experiments.config.site import Site
from experiments.errors import ConfigError, RunError
from experiments.jobs.site import ALONE, Workers
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


REPLAY = Replay(environments=16, capacity=20_000, random_steps=2_000, gradient_steps=2, batch=128)


@pytest.mark.optimised
@pytest.mark.slow
@pytest.mark.parametrize(
    "learner, pieces, steps, left",
    [
        (
            PpoLearner(
                Ppo(kind="ppo", environments=256, unroll=4, minibatches=4, learning_rate=1e-3, gae_lambda=1.0), Aim()
            ),
            120,
            120 * 256 * 4,
            0.4,
        ),
        (
            SacLearner(Sac(kind="sac", layers=[64, 64], replay=REPLAY), Aim()),
            5,
            2000 + 5 * 512 * 16,
            0.4,
        ),
        (
            QtOptLearner(QtOpt(kind="qt_opt", layers=[64, 64], replay=REPLAY), Aim()),
            5,
            2000 + 5 * 512 * 16,
            0.6,
        ),
    ],
    ids=["PPO", "SAC", "QT-Opt"],
)
def test_a_learner_comes_near_the_best_action(learner, pieces, steps, left):
    """``left``: share of the squared distance that standing still leaves."""
    seen = []

    def observe(controller, counts):
        seen.append((controller, counts))
        if counts["steps"] >= steps:
            raise BudgetSpent

    learner.train(0, observe)
    assert [counts["steps"] > 0 for _, counts in seen].count(True) == pieces
    controller, counts = seen[-1]
    assert counts["episodes"] == counts["steps"] == steps and counts["episode_return"] < 0
    template = learner.template()
    assert jax.tree.map(jnp.shape, controller) == jax.tree.map(jnp.shape, template)
    observation = jax.random.normal(jax.random.key(9), (500, OBSERVATION_SIZE))
    action = controller.decide(controller.parameters, observation)
    assert np.abs(action).max() <= 1.0
    distance = np.mean((action - best(observation)) ** 2) / np.mean(best(observation) ** 2)
    assert distance < left


def test_the_search_finds_the_best_action():
    target = jnp.asarray(np.random.default_rng(1).uniform(-0.9, 0.9, (20, N_JOINTS)), jnp.float32).at[0].set(1.5)
    normals = jax.random.normal(jax.random.key(0), (12, 200, N_JOINTS))
    found = best_action(lambda a: -jnp.sum((a - target[:, None]) ** 2, axis=-1), normals, 15)
    assert found.shape == target.shape
    # The first lies outside of what is allowed: there the nearest corner is the best.
    np.testing.assert_allclose(found, np.clip(target, -1, 1), atol=0.05)


def test_qt_opt_fits_the_clipped_double_target():
    """One gradient step against the formula written out: r + gamma (1 - end) min Q'(s', best action of Q'_1)."""
    settings = {"layers": [8], "discount": 0.9, "reward_scale": 0.5, "target_rate": 0.25, "learning_rate": 3e-4}
    learner = QtOptLearner(QtOpt(kind="qt_opt", replay=REPLAY, **settings), Aim())
    state = learner.init(jax.random.PRNGKey(0))  # observations are normalised by mean 0, deviation 1
    rng = np.random.default_rng(3)
    seen, following = rng.normal(size=(2, 6, OBSERVATION_SIZE)).astype(np.float32)
    action = rng.uniform(-1, 1, (6, N_JOINTS)).astype(np.float32)
    reward, discount = rng.normal(size=6).astype(np.float32), np.array([1, 1, 0, 1, 0, 1], np.float32)
    normals = jax.random.normal(jax.random.key(4), (2, 32, N_JOINTS))

    def q(parameters, observation, action):
        """Both critics from their weights."""
        values = []
        for critic in ("MLP_0", "MLP_1"):
            first, last = (parameters["params"][critic][f"hidden_{i}"] for i in range(2))
            x = jnp.concatenate([observation, action], axis=-1)
            hidden = jnp.maximum(x @ first["kernel"] + first["bias"], 0.0)
            values.append((hidden @ last["kernel"] + last["bias"])[..., 0])
        return jnp.stack(values, axis=-1)

    def worth(a):
        return q(state.target, jnp.broadcast_to(following[:, None], (6, a.shape[-2], OBSERVATION_SIZE)), a)[..., 0]

    chosen = best_action(lambda a: worth(jnp.broadcast_to(a, (6, *a.shape[-2:]))), normals, 4)
    wanted = 0.5 * reward + 0.9 * discount * np.min(q(state.target, following, chosen), axis=-1)
    batch = Transition(seen, action, reward, discount, following, {})
    np.testing.assert_allclose(learner.wanted(state, batch, normals), wanted, rtol=1e-5, atol=1e-6)
    after = learner.update(state, batch)
    drawn = learner.wanted(state, batch, learner._draw(jax.random.split(state.key)[0]))
    gradient = jax.grad(lambda critic: jnp.mean((q(critic, seen, action) - drawn[:, None]) ** 2))(state.critic)
    # Adam's first step is the learning rate against the gradient's sign, wherever it is not tiny.
    for before, now, target, g in zip(
        *map(jax.tree.leaves, (state.critic, after.critic, after.target, gradient)), strict=True
    ):
        clear = np.abs(g) > 1e-5
        np.testing.assert_allclose((now - before)[clear], (-3e-4 * np.sign(g))[clear], rtol=2e-3)
        np.testing.assert_allclose(target, 0.75 * before + 0.25 * now, rtol=1e-5, atol=1e-7)


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


@pytest.mark.slow
def test_a_comparison_runs_resumes_and_refuses(tmp_path, capsys):
    path, console = write(tmp_path, SMALL), Console()
    folder = compare.compare(*baselines.load(path), str(path), tmp_path, console)
    run = folder / "ES" / "seed0"
    training = json.loads((run / "training.json").read_text())
    assert [point["episodes"] for point in training["curve"]] == [0, 24, 40]  # 8 an update; after a half and the whole
    rows = list(csv.DictReader((folder / "curves.csv").open()))
    assert [float(row["return_rate"]) for row in rows] == [point["return_rate"] for point in training["curve"]]
    report = json.loads((folder / "comparison.json").read_text())["algorithms"]["ES"]
    assert report["simulation"]["by_seed"]["0"] == report["simulation"]["return_rate"]
    assert report["simulation"]["mean_return"] != report["reality"]["mean_return"]  # only spin differs between the two
    assert 0 < report["restlessness"]["action_change"] < 4
    for name in ("curves.png", "transfer.png", "restlessness.png", "comparison.html"):
        assert (folder / name).stat().st_size > 0

    before = {path: path.stat().st_mtime_ns for path in run.rglob("*.*")}
    compare.compare(*baselines.load(path), str(path), tmp_path, console)
    assert "skipped" in capsys.readouterr().out
    assert before == {path: path.stat().st_mtime_ns for path in run.rglob("*.*")}

    def missing(*overrides):
        return compare.unfinished(compare.prepare(*baselines.load(path, overrides), str(path), tmp_path, console))

    assert missing() == {"ES": []}
    assert missing("seeds=[0, 3]") == {"ES": [3]}
    assert missing("algorithms.P={kind: ppo}") == {"ES": [], "P": [0]}
    assert missing("reality.ball_spin.mean_x=100.0") == {"ES": [0]}  # to be evaluated again
    assert missing("algorithms.ES.balls=narrow", "seeds=[3]") == {"ES": [3]}
    with pytest.raises(RunError, match="ES/seed0.*other settings of model;"):
        missing("algorithms.ES.model={sensing: {ball_noise: 0}}")
    for override in ("budget.episodes=80", "algorithms.ES.optimiser.num_directions=3", "experiment.balls=narrow"):
        with pytest.raises(RunError, match="ES/seed0.*other settings of (budget|algorithm|balls);"):
            missing(override)


@pytest.mark.parametrize("settings", [{"kind": "ppo"}, {"kind": "sac"}, {"kind": "qt_opt"}, {"kind": "bgs"}])
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


def test_learning_keeps_its_shapes_on_another_robot(tmp_path):
    """Traced, not compiled: play as all learners from steps do it, and QT-Opt's learning."""
    path = write(tmp_path, SMALL | {"robot": "fr3_pedestal"})
    comparison, config = baselines.load(path, ("algorithms.X={kind: qt_opt}",))
    common = compare.prepare(comparison, config, str(path), tmp_path, Console())
    learner = compare.learner(common.comparison.algorithms["X"], common.experiment)
    state = jax.eval_shape(learner.init, jax.random.PRNGKey(0))
    assert state.env.obs.shape == (64, 8 * 10)
    after = jax.eval_shape(learner._piece, jax.eval_shape(learner._fill, state))
    assert jax.tree.map(jnp.shape, after) == jax.tree.map(jnp.shape, state)
    assert after.env.metrics.keys() == {"hit", "returned", "episode_return"}


@pytest.mark.slow
def test_a_comparison_on_another_robot_runs(tmp_path):
    path = write(tmp_path, SMALL | {"robot": "fr3_pedestal"})
    folder = compare.compare(*baselines.load(path), str(path), tmp_path, Console())
    report = json.loads((folder / "comparison.json").read_text())["algorithms"]["ES"]
    assert np.isfinite(report["simulation"]["mean_return"])
    assert compare.unfinished(compare.prepare(*baselines.load(path), str(path), tmp_path, Console())) == {"ES": []}
    with pytest.raises(RunError, match="ES/seed0.*other settings of robot"):
        compare.unfinished(
            compare.prepare(*baselines.load(path, ("robot=ur10e_rail",)), str(path), tmp_path, Console())
        )


@pytest.mark.parametrize(
    "override, message",
    [
        ("algorithms.X={kind: pp}", r"algorithms\.X\.kind.*pp"),
        ("algorithms.X={kind: ppo, minibatches: 7}", r"algorithms\.X: .*minibatches 7 .*1024"),
        ("algorithms.X={kind: qt_opt, elites: 40}", r"algorithms\.X: .*elites 40 .*32"),
        (
            "algorithms.X={kind: ppo, minibatch: 7}",
            r"algorithms\.X\.minibatch: expected .*; did you mean 'minibatches'",
        ),
        ("algorithms.a/b={kind: ppo}", r"algorithms\.a/b"),
        ("budget={clock: cpu}", r"minutes, episodes or both"),
        ("algorithms.X={kind: sac, first_entropy_weight: 0.1}", r"algorithms\.X: .*no key any more.*reward_scale"),
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


@pytest.mark.parametrize("name", baselines.shipped())
def test_a_shipped_comparison_is_valid(name):
    comparison, experiment = baselines.load(baselines.shipped()[name])
    assert comparison.name == name


def test_the_pillars_change_elites_and_orthogonality_of_the_papers_settings_alone():
    comparison, experiment = baselines.load(baselines.shipped()["compare_pillars"])
    paper = config.load(config.shipped()["paper"])
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
def test_a_site_trains_the_same(tmp_path):
    """In this process, and by a worker of Parsl's: the same policies, curves and evaluations."""
    path = write(tmp_path, SMALL | {"seeds": [1]})
    here = Site.model_validate({"provider": {"kind": "local"}, "workers_per_node": 1, "memory_per_worker": 1.0})
    for out, workers in (("alone", ALONE), ("site", Workers(1, here, "here.yaml"))):
        compare.compare(*baselines.load(path), str(path), tmp_path / out, Console(), workers)
    alone, site = (tmp_path / out / "small" / "ES" / "seed1" for out in ("alone", "site"))
    arrays, others = (checkpoint.read_latest(folder / "policy")[0] for folder in (alone, site))
    assert arrays.keys() == others.keys() and len(arrays) > 0
    assert all(arrays[name].tobytes() == others[name].tobytes() for name in arrays)
    assert (alone / "evaluation.json").read_bytes() == (site / "evaluation.json").read_bytes()
    curves = [json.loads((folder / "training.json").read_text())["curve"] for folder in (alone, site)]
    timeless = [[p | {"seconds": 0, "cpu_seconds": 0} for p in curve] for curve in curves]
    assert timeless[0] == timeless[1]


def test_trainings_at_a_time():
    parsed = baselines.Comparison.model_validate(SMALL | {"seeds": [0, 1, 2]})
    if jax.default_backend() == "cpu":
        assert compare.choose(parsed, None) == min(3, len(os.sched_getaffinity(0)))
    assert compare.choose(parsed, 2) == 2 and compare.choose(parsed, 9) == 3
    timed = parsed.model_copy(update={"budget": baselines.Budget(minutes=1.0)})
    assert compare.choose(timed, None) == 1
