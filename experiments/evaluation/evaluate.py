"""Evaluation of a policy: played on fresh balls, counted with an interval, written as evaluation.json."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from ballmodel.sampling import BallPool
from experiments.config import build
from experiments.config.build import Experiment
from experiments.evaluation import reachability
from experiments.progress import Stage, silent
from experiments.runs.load_policy import TrainedPolicy
from experiments.sparse_reward import mean_reward
from experiments.stats import wilson
from mjx_tt.env.episode import HIT, MISSED, RETURNED
from mjx_tt.env.evaluator import COLUMNS, Evaluator
from mjx_tt.env.reward_weights import TERMS
from mjx_tt.env.rollout import RolloutResult, Simulator
from mjx_tt.sim import randomisation

OUTCOMES = {"missed": MISSED, "hit": HIT, "returned": RETURNED}


@dataclass(frozen=True)
class Rate:
    """A share with its 95 % Wilson interval."""

    value: float
    low: float
    high: float


def draw_balls(experiment: Experiment, simulator: Simulator, episodes: int, key: jax.Array) -> BallPool:
    """At least ``episodes`` fresh balls: whole rows of the width in which they are played."""
    columns = -(-min(COLUMNS, episodes) // simulator.devices) * simulator.devices
    return build.pool(experiment, key, -(-episodes // columns) * columns)


@dataclass(frozen=True)
class Played:
    """One policy's evaluation.

    report    content of evaluation.json
    result    per episode, NumPy arrays (..., n)
    incoming  (2, n) [m] where each ball bounced on the robot's side
    """

    report: dict[str, Any]
    result: RolloutResult
    incoming: np.ndarray


def evaluate(
    experiment: Experiment,
    trained: TrainedPolicy,
    episodes: int,
    seed: int,
    reachable_balls: int | None = None,
    stage: Stage = silent,
    devices: int | None = None,
    unknown_balls: int | None = None,
) -> Played:
    """Plays the policy on at least ``episodes`` balls that training has not seen.

    reachable_balls: on how many of the balls to seek a lower bound of the return rate in reach, the balls known and
    without noise; None: no bound. stage: shows what is being done. devices: this process' own by default, or all of
    several processes, each of which calls this. unknown_balls: on how many to play as well, each in a world of its own
    that is drawn from the prior.
    """
    config = experiment.config
    task = replace(experiment.task, sim_rate=config.evaluation.sim_rate or experiment.task.sim_rate)
    simulator = Simulator(task, devices or jax.local_device_count())
    key = build.key(seed, build.EVALUATION_EPISODES)
    with stage("compiling the evaluation"):
        balls = draw_balls(experiment, simulator, episodes, build.key(seed, build.EVALUATION_BALLS))
        evaluator = Evaluator(simulator, balls, experiment.model.model, experiment.model.randomise)
        evaluator.compile(trained.policy, key)
    with stage(f"evaluating on {episodes:,} fresh balls"):
        result, incoming = evaluator.play(trained.policy, key), np.asarray(balls.landing)[:, evaluator.order]
    conditions = {
        "balls": experiment.distribution.to_dict(),
        "acceptance": float(balls.acceptance),
        "engine": task.engine,
        "sim_rate": task.sim_rate,
        "randomise": randomisation.ends(experiment.model.randomise),
        "seed": seed,
        "policy": str(trained.source),
        "update": trained.notes.get("update"),
        "training_seconds": trained.notes.get("seconds"),
    }
    reachable = None
    if reachable_balls is not None:
        with stage(f"finding what is in reach of {reachable_balls} of them"):
            model = experiment.model.model
            r = reachability.reachable(simulator, balls, model, key, reachable_balls, trained.policy)
            low, high = wilson(r.returned, r.balls)
            reachable = {"return_rate": r.rate, "low": low, "high": high, "balls": r.balls, "by_policy": r.by_policy}
    unknown, drawn = None, None if unknown_balls is None else build.unknown_worlds(experiment)
    if unknown_balls is not None and drawn is not None:  # there is none for another robot
        report = evaluate(drawn, trained, unknown_balls, seed, stage=stage, devices=devices).report
        unknown = {name: report[name] for name in ("return_rate", "low", "high", "episodes")}
    found = {"reachable": reachable, "unknown_worlds": unknown}
    return Played(summary(result, task.terms) | found | conditions, result, incoming)


def summary(result: RolloutResult, terms: tuple[str, ...] = TERMS) -> dict[str, Any]:
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
        "terms": {name: float(result.terms[i][finite].mean()) if some else None for i, name in enumerate(terms)},
    }


def return_rate(result: RolloutResult) -> Rate:
    """Share of all episodes that were returned; a non-finite one was not."""
    returned = result.finite & (result.outcome == RETURNED)
    low, high = wilson(int(returned.sum()), returned.size)
    return Rate(float(returned.mean()), low, high)


def selection_score(result: RolloutResult) -> float:
    """Mean sparse reward in simulation, where a robot faults when it touches itself or the table, or is not finite."""
    collision = result.terms[TERMS.index("collision")]
    fault = ~result.finite | (collision < 0)
    return mean_reward(result.outcome != MISSED, result.outcome == RETURNED, fault) or 0.0
