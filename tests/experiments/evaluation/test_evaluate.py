"""Counting: rates, the paper's selection score, pictures of what was counted, and likeness of balls to strokes."""

from __future__ import annotations

import json

import jax
import numpy as np
import pytest
from PIL import Image

from ballmodel import registry
from ballmodel.distribution import BallMixture
from experiments import cli
from experiments.config import build
from experiments.config import experiment as config
from experiments.evaluation import evaluate, figures
from experiments.evaluation.evaluate import Played
from experiments.evaluation.human_likeness import likeness
from mjx_tt.env import reward_weights
from mjx_tt.env.episode import HIT, MISSED, RETURNED
from mjx_tt.env.evaluator import Evaluator
from mjx_tt.env.policy import Policy
from mjx_tt.env.rollout import RolloutResult, Simulator
from mjx_tt.env.substeps import OUT_OF_REACH
from robot_io.contract import N_OBSERVATION, n_parameters
from robot_io.limits import LIMITS
from tests.mjx_tt.prediction.test_predict import spinning
from tests.oracles import ball_flight

N_TERMS = len(reward_weights.TERMS)


def result(outcome: list[int], finite: list[bool] | None = None, collision: list[float] | None = None) -> RolloutResult:
    """Episodes (N, 1) with these outcomes."""
    shape = (len(outcome), 1)
    finite = np.ones(shape, bool) if finite is None else np.array(finite).reshape(shape)
    terms = np.zeros((N_TERMS, *shape))
    terms[reward_weights.TERMS.index("collision")] = 0 if collision is None else np.array(collision).reshape(shape)
    terms[0] = np.where(finite, 2.0, np.nan)
    rng = np.random.default_rng(0)
    return RolloutResult(
        terms=terms,
        returns=np.where(finite, 3.0, np.nan),
        outcome=np.array(outcome).reshape(shape),
        landing=rng.uniform([[[-0.7]], [[0.1]]], [[[0.7]], [[1.3]]], (2, *shape)),
        finite=finite,
        steps=np.full(shape, 80),
        peak_velocity=np.array(LIMITS.velocity)[:, None, None] * rng.uniform(0.2, 1, (8, *shape)),
        observation_sums=np.zeros((2, 11, 1)),
        observation_counts=np.zeros(1, int),
    )


def test_summary_counts_a_non_finite_episode_as_missed_and_leaves_it_out_of_means():
    report = evaluate.summary(result([RETURNED, RETURNED, HIT, MISSED, MISSED], [True, True, True, True, False]))
    assert report["return_rate"] == pytest.approx(2 / 5)
    assert report["hit_rate"] == pytest.approx(3 / 5)
    assert report["episodes"] == 5
    assert report["outcomes"] == {"missed": 2, "hit": 1, "returned": 2}
    assert report["non_finite"] == 1
    assert report["mean_return"] == 3.0
    assert report["terms"]["state_transition"] == 2.0
    assert list(report["terms"]) == list(reward_weights.TERMS)
    json.dumps(report, allow_nan=False)


def test_an_evaluation_plays_the_spin_of_its_model():
    """Past a robot that stands still, balls go out of reach when SciPy says: a spinning one leaves the table fast."""
    topspin = 250.0
    data = {"name": "a", "balls": "narrow", "model": {"ball_spin": {"mean_x": topspin}}, "training": {"pool": 64}}
    data["task"] = {"sim_rate": 150.0}
    experiment = build.experiment(config.parse(data, "a"), "a")
    simulator = Simulator(experiment.task)
    balls = evaluate.draw_balls(experiment, simulator, 32, jax.random.key(0))
    evaluator = Evaluator(simulator, balls, experiment.model.model, experiment.model.randomise)
    eleven = np.ones(N_OBSERVATION, np.float32)
    played = evaluator.play(Policy(np.zeros(n_parameters(), np.float32), 0.0 * eleven, eleven), jax.random.key(1))
    missed = played.outcome == MISSED
    assert missed.sum() > 16
    position, velocity = (np.asarray(x, float).T for x in (balls.state.position, balls.state.velocity))
    for i, steps in zip(evaluator.order[missed], played.steps[missed], strict=True):
        start = ball_flight.Touch(0.0, position[i], velocity[i], np.array([topspin, 0.0, 0.0]))
        end, _ = ball_flight.fly(
            ball_flight.on_table(start), lambda p: min(p[1] - OUT_OF_REACH[0], p[2] - OUT_OF_REACH[1])
        )
        assert steps == pytest.approx(end * experiment.task.control_rate, abs=1.5)


def test_selection_score_is_the_papers_sparse_reward():
    """Missed 0, hit +1, landed +1 more; a touch of robot or table, or a failed episode, -2 whatever the ball did."""
    played = result(
        [MISSED, HIT, RETURNED, RETURNED, MISSED],
        finite=[True, True, True, True, False],
        collision=[0.0, 0.0, 0.0, -1.0, 0.0],
    )
    assert evaluate.selection_score(played) == pytest.approx((0 + 1 + 2 - 2 - 2) / 5)


def share(path, colour) -> float:
    """Share of a picture's pixels within 12 levels of a colour "#rrggbb"."""
    wanted = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])
    pixels = np.asarray(Image.open(path).convert("RGB")).astype(int)
    return float((np.abs(pixels - wanted).max(axis=-1) <= 12).mean())


def test_pictures_show_what_was_counted(tmp_path):
    def draw(folder, outcome):
        played = result([outcome] * 400)
        rng = np.random.default_rng(1)
        incoming = rng.uniform([[[-0.7]], [[-1.3]]], [[[0.7]], [[-0.1]]], (2, 400, 1))
        return figures.draw_evaluation(
            tmp_path / folder, Played(evaluate.summary(played), played, incoming), (1.0,) * N_TERMS
        )

    returned, missed = draw("returned", RETURNED), draw("missed", MISSED)
    assert [path.name for path in returned] == [
        "landing_map.png",
        "return_rate_map.png",
        "rewards.png",
        "joint_speeds.png",
    ]
    assert share(returned[0], "#000000") < 0.5  # a picture, not a black frame
    dots = [np.asarray(Image.open(paths[0]).convert("RGB")).astype(int) for paths in (returned, missed)]
    green = [((d[..., 1] > d[..., 0] + 25) & (d[..., 1] > d[..., 2] + 25)).mean() for d in dots]
    assert green[0] > 10 * green[1]
    assert share(returned[1], "#006837") > 0.05  # the colour map's green end fills the robot's half
    assert share(missed[1], "#a50026") > 0.05  # and its red end


@pytest.mark.slow
def test_likeness_tells_a_box_from_its_gaussian():
    rng = np.random.default_rng(0)
    mixed = rng.standard_normal((6, 6))
    known, held, same = (rng.standard_normal((n, 6)) @ mixed for n in (600, 200, 200))
    box = rng.uniform(known.min(axis=0), known.max(axis=0), (200, 6))
    alike, unlike = likeness(same, held, known), likeness(box, held, known)
    assert alike.low < 0.5 < alike.high + 0.06 and alike.far < 0.06
    assert unlike.auc > 0.9 and unlike.far > 0.6 and unlike.low < unlike.auc < unlike.high


@pytest.mark.slow
def test_fit_human_finds_spins_of_trajectories_and_writes_a_mixture(tmp_path, capsys):
    tracks, _, spins = spinning()
    rows = [
        f"{t.session},{t.name},{s},{x},{y},{z}"
        for t in tracks
        for s, (x, y, z) in zip(t.time, t.position.T, strict=True)
    ]
    (tmp_path / "log.csv").write_text("\n".join(["session,trajectory,t,x,y,z", *rows]) + "\n")
    (tmp_path / "lift.yaml").write_text("ball: {flight: {magnus_coefficient: 0.6, drag_coefficient: 0.4}}\n")
    given = ["fit-human", str(tmp_path / "log.csv"), "--model", str(tmp_path / "lift.yaml")]
    out = ["--out", str(tmp_path / "box.yaml"), "--mixture", str(tmp_path / "mixture.yaml")]
    assert cli.main([*given, *out]) == 0
    assert "too few to hold out a quarter" in " ".join(capsys.readouterr().out.split())
    mixture = registry.resolve(tmp_path / "mixture.yaml")
    assert isinstance(mixture, BallMixture) and (tmp_path / "mixture.png").stat().st_size > 10_000
    assert abs(float(mixture.weights @ mixture.means[:, 6]) - spins[0].mean()) < 20.0  # of those that clear the net
