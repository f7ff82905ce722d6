"""How good a policy is: played on fresh balls, counted with an interval, written as evaluation.json."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ballmodel.sampling import BallPool
from experiments.config import build
from experiments.config.build import Experiment
from experiments.runs.load_policy import TrainedPolicy
from experiments.stats import wilson
from mjx_tt.env import reachability, rewards
from mjx_tt.env.policy import Policy
from mjx_tt.env.rollout import RESULT_SPECS, RolloutResult, Simulator
from mjx_tt.env.task import HIT, MISSED, RETURNED

EVALUATION_COLUMNS = 256  # copies of one policy side by side, to fill the vector loops
OUTCOMES = {"missed": MISSED, "hit": HIT, "returned": RETURNED}


@dataclass(frozen=True)
class Rate:
    """A share with its 95 % Wilson interval."""

    value: float
    low: float
    high: float


class Evaluator:
    """Plays one policy at a time on a fixed set of balls, each of them once; compiled once.

    balls     the pool: ``episodes`` balls or more, up to whole rows of at most ``EVALUATION_COLUMNS`` side by side
    incoming  (2, R, P) [m] where the ball of each episode bounces on the robot's side

    Drawing every ball once keeps the episodes independent, which their interval relies on.
    """

    def __init__(self, simulator: Simulator, experiment: Experiment, episodes: int, balls_key) -> None:
        columns = -(-min(EVALUATION_COLUMNS, episodes) // simulator.devices) * simulator.devices
        rows = -(-episodes // columns)
        self.balls = build.pool(experiment, balls_key, rows * columns)
        # Balls of similar arrival in one row: rows run together until their last episode ends.
        order = np.argsort(np.asarray(self.balls.arrival)).reshape(rows, columns)
        self.incoming = np.asarray(self.balls.landing)[:, order]
        thrown = jax.tree.map(lambda x: x[:, order], self.balls.state)
        model = experiment.model

        def play(policy, key, pool, thrown):
            drawn = simulator.draw(key, pool, model.model, model.randomise, rows, columns)
            copies = jnp.repeat(policy.theta[:, None], columns // simulator.devices, axis=1)
            # Balls of a distribution do not spin: what the drawn ones do is the model's.
            spinning = replace(thrown, spin=thrown.spin + drawn.ball.spin)
            return simulator.rollout(replace(policy, theta=copies), simulator.local(replace(drawn, ball=spinning)))

        spread = jax.jit(simulator.on_devices(play, out_specs=RESULT_SPECS))
        fixed = simulator.replicate((self.balls, thrown))
        # One layout for arrays from training and from files: one compilation.
        self._play = lambda *policy_and_key: spread(*simulator.replicate(policy_and_key), *fixed)

    def play(self, policy: Policy, key) -> RolloutResult:
        """Episodes under the key of latencies and noise; arrays are NumPy, (..., R, P)."""
        return jax.tree.map(np.asarray, self._play(policy, key))


@dataclass(frozen=True)
class Played:
    """One policy's evaluation.

    report    what evaluation.json holds
    result    per episode, NumPy arrays (..., R, P)
    incoming  (2, R, P) [m] where each ball bounced on the robot's side
    """

    report: dict[str, Any]
    result: RolloutResult
    incoming: np.ndarray


def evaluate(
    experiment: Experiment, trained: TrainedPolicy, episodes: int, seed: int, reachable_balls: int | None = None
) -> Played:
    """Plays the policy on at least ``episodes`` balls that training has not seen.

    reachable_balls: on how many of the balls to seek a lower bound of the return rate in reach; None: no bound.
    """
    config = experiment.config
    task = replace(experiment.task, sim_rate=config.evaluation.sim_rate or experiment.task.sim_rate)
    simulator = Simulator(task, len(jax.devices()))
    evaluator = Evaluator(simulator, experiment, episodes, build.key(seed, build.EVALUATION_BALLS))
    key = build.key(seed, build.EVALUATION_EPISODES)
    result = evaluator.play(trained.policy, key)
    conditions = {
        "balls": experiment.distribution.to_dict(),
        "acceptance": float(evaluator.balls.acceptance),
        "engine": task.engine,
        "sim_rate": task.sim_rate,
        "randomise": {r.path: [r.low, r.high] for r in experiment.model.randomise},
        "seed": seed,
        "policy": str(trained.source),
        "update": trained.notes.get("update"),
        "training_seconds": trained.notes.get("seconds"),
    }
    reachable = None
    if reachable_balls is not None:
        reachable = _reachable(experiment, simulator, evaluator.balls, key, reachable_balls, trained.policy)
    return Played(summary(result) | {"reachable": reachable} | conditions, result, evaluator.incoming)


def _reachable(
    experiment: Experiment, simulator: Simulator, balls: BallPool, key, count: int, policy: Policy
) -> dict[str, Any]:
    """What the policy or motions optimised ball by ball return, the balls known and without noise."""
    found = reachability.reachable(simulator, balls, experiment.model.model, key, count, policy)
    low, high = wilson(found.returned, found.balls)
    return {"return_rate": found.rate, "low": low, "high": high, "balls": found.balls, "by_policy": found.by_policy}


def summary(result: RolloutResult) -> dict[str, Any]:
    """Rates over all episodes, a non-finite one counting as missed; means of return and terms over the finite ones."""
    rate = return_rate(result)
    counts = {name: int(np.sum(result.outcome == outcome)) for name, outcome in OUTCOMES.items()}
    finite = result.finite
    some = bool(finite.any())
    return {
        "return_rate": rate.value,
        "low": rate.low,
        "high": rate.high,
        "hit_rate": 1.0 - counts["missed"] / finite.size,
        "episodes": int(finite.size),
        "outcomes": counts,
        "non_finite": int(np.sum(~finite)),
        "mean_return": float(result.returns[finite].mean()) if some else None,
        "terms": {
            name: float(result.terms[i][finite].mean()) if some else None for i, name in enumerate(rewards.TERMS)
        },
    }


def return_rate(result: RolloutResult) -> Rate:
    """Share of all episodes that were returned; a non-finite one was not."""
    returned = result.finite & (result.outcome == RETURNED)
    low, high = wilson(int(returned.sum()), returned.size)
    return Rate(float(returned.mean()), low, high)


def selection_score(result: RolloutResult) -> float:
    """``sparse_reward`` in simulation, where a robot faults when it touches itself or the table, or is not finite."""
    collision = result.terms[rewards.TERMS.index("collision")]
    return sparse_reward(result.outcome, ~result.finite | (collision < 0))


def sparse_reward(outcome, fault) -> float:
    """The paper's reward for choosing a seed: +1 hit, +1 landed on the human's side, -2 fault; mean over the episodes."""
    score = (outcome != MISSED).astype(float) + (outcome == RETURNED)
    return float(np.mean(np.where(fault, -2.0, score)))
