"""A study's folder with made-up numbers that are known exactly, for tests of the report and for looking at it.

Rally lengths are geometric: the means of ``MEANS`` for player 3, times ``SKILL`` for the others; with another player
they are ``KEPT`` times as long. Balls are drawn from the paper's distributions and fly with drag.
"""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np

from ballmodel import constants as c
from ballmodel import registry
from ballmodel.distribution import save_distribution
from experiments.study.analysis import scoring
from experiments.study.analysis.paper import ABLATED, BY_SKILL, CROSS, FINAL, IDENTIFIED, METHODS, MODELS, VARIANT
from mjx_tt.rally.end_reasons import End
from mjx_tt.sim.model import ModelFile, Range, SimModel

MEANS = {
    "is2r-sim1": 3.0,
    "is2r-ft35": 5.5,
    "is2r-sim2": 4.5,
    "is2r-ft65": 8.5,
    "is2r-sim3": 6.5,
    "is2r-ft100": 9.0,
    "s2r-ft65": 5.0,
    "s2r-ft100": 5.5,
    "oracle-sim": 6.0,
    "oracle-ft": 8.8,
    "fresh-sim2": 4.2,
    "fresh-ft65": 7.0,
    "fresh-sim3": 6.0,
    "fresh-ft100": 8.0,
    "id-sim1": 7.0,
    "id-ft35": 8.0,
    "id-sim2": 9.0,
    "id-ft65": 10.0,
    "id-sim3": 11.0,
    "id-ft100": 12.0,
    "large": 3.5,
    "medium": 5.8,
    "narrow": 3.0,
    "oracle": 6.0,
}
SKILL = {"player3": 1.0, "player5": 1.4, "player4": 2.0, "player2": 2.4, "player1": 2.8}
KEPT = {"is2r-ft100": 0.7, "s2r-ft100": 0.35, "oracle-ft": 0.65}
RALLIES = 80
REALITY = {"ball.table.friction": 0.2, "ball.paddle.restitution": 0.97}
ROBOT_SHARE = 0.85  # of the counted rallies
FILTERED_SHARE = 0.08
ABLATION_PLAYER = "player4"
DRAG = 0.47 * 1.29 * 1.256e-3 / (2 * 0.0027)  # [1/m] the paper's K_d


def mean_length(player: str, model: str, own: bool = True) -> float:
    """The known mean of a policy's rallies; the advanced player's S2R+FT is better than its i-S2R, as in the paper."""
    mean = MEANS[model] * SKILL[player] * (1.0 if own else KEPT[model])
    return 1.0 + (mean - 1.0) * (3.5 if player == "player1" and model.startswith("s2r") and own else 1.0)


def make(folder: Path, seeds=(0,), names=BY_SKILL, balls: int = 60, rallies: int = RALLIES, cross: bool = True) -> Path:
    """Writes a study's folder; ``balls`` are the trajectories of each data set."""
    folder = Path(folder)
    (folder / "evaluations").mkdir(parents=True, exist_ok=True)
    (folder / "study.yaml").write_text(f"name: made-up\nseeds: {list(seeds)}\nplayers: {list(names)}\n")
    parts = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        for player in names:
            pools = _balls(folder / f"seed{seed}" / player / "balls", player, balls, rng)
            wanted = [(player, m.key) for m in (*MODELS, *VARIANT, *METHODS[IDENTIFIED])]
            wanted += [(other, key) for other in CROSS[player] for key in FINAL] if cross else []
            wanted += [(player, m.key) for m in ABLATED] if player == ABLATION_PLAYER else []
            _world(folder / f"seed{seed}" / player / "identified" / "world0.yaml")
            for evaluator, model in wanted:
                one = _play(seed, player, evaluator, model, "", rallies, rng)
                parts.append(one)
                if model in (*FINAL, "is2r-ft35", "is2r-ft65"):
                    _log(folder / "evaluations" / f"{seed}_{player}_{evaluator}_{model}.npz", one, pools[-1], rng)
        (folder / f"seed{seed}" / "reality.yaml").write_text(json.dumps({"seed": seed, "reality": REALITY}))
    scoring.write(folder / "evaluations.csv", scoring.join(parts))
    return folder


def _play(seed, trainer, evaluator, model, code, rallies, rng) -> scoring.Rallies:
    mean = mean_length(trainer, model, trainer == evaluator) * np.exp(rng.normal(0.0, 0.05))
    length = 1 + rng.geometric(1.0 / max(mean - 1.0, 1.01), rallies)
    human = rng.choice([End.HUMAN_OVER_TABLE, End.ROBOT_CORNER, End.HUMAN_BOUNCES], rallies)
    robot = rng.choice([End.ROBOT_MISSED, End.ROBOT_OUT, End.OUT_OF_DISTRIBUTION], rallies, p=[0.4, 0.4, 0.2])
    end = np.where(rng.random(rallies) < ROBOT_SHARE, robot, human)
    dropped = rng.random(rallies) < FILTERED_SHARE
    end = np.where(dropped, rng.choice([End.FIRST_NET, End.SERVICE, End.DUMMY_BY_HAND], rallies), end)
    return scoring.score_rallies(seed, trainer, evaluator, model, code, np.where(dropped, 1, length), end)


def _world(path: Path) -> None:
    """An identified world that holds the table's friction, and not the paddle's restitution."""
    path.parent.mkdir(parents=True)
    drawn = (Range("ball.table.friction", 0.19, 0.21), Range("ball.paddle.restitution", 0.8, 0.95))
    ModelFile(SimModel(), drawn).save(path)


def _log(path: Path, rallies: scoring.Rallies, balls: np.ndarray, rng) -> None:
    """The human's balls: touches 1, 3, 5 ... of each rally; the robot does not return the last one."""
    count = (rallies.length + 1) // 2
    rally = np.repeat(rallies.rally, count)
    touch = 1 + 2 * np.concatenate([np.arange(n) for n in count])
    last = np.concatenate([np.arange(n) == n - 1 for n in count])
    drawn = balls[:, rng.integers(0, balls.shape[1], rally.size)]
    drawn = drawn + rng.normal(0.0, 0.01, drawn.shape)  # no two balls are the same
    hit = ~last | (rng.random(rally.size) < 0.4)
    back = rng.normal((0.0, 0.75), (0.35, 0.35), (rally.size, 2)).T
    inside = (np.abs(back[0]) < c.TABLE_WIDTH / 2) & (back[1] > 0.0) & (back[1] < c.TABLE_LENGTH / 2)
    np.savez_compressed(
        path,
        rally=rally,
        touch=touch,
        first=touch == 1,
        position=drawn[:3],
        velocity=drawn[3:6],
        landing=drawn[6:],
        hit=hit,
        returned=hit & ~last & inside,
        return_landing=np.where(hit, back, np.nan),
    )


def _balls(folder: Path, player: str, count: int, rng) -> list[np.ndarray]:
    """Writes D0, D1, D2 and the human models; returns (8, n) of each data set."""
    folder.mkdir(parents=True, exist_ok=True)
    out = []
    for dataset, model in (("D0", "M0"), ("D1", "M1"), ("D2", "M2")):
        distribution = registry.load(f"{player}/{model}")
        save_distribution(folder / f"human_{model}.yaml", distribution)
        flights, points = _fly(distribution, count, rng)
        with open(folder / f"{dataset}.csv", "w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(("session", "trajectory", "t", "x", "y", "z"))
            for k, flight in enumerate(flights):
                writer.writerows((dataset, k, f"{t:.4f}", *(f"{v:.5f}" for v in p)) for t, p in flight)
        out.append(points)
    return out


def _fly(d, count: int, rng) -> tuple[list, np.ndarray]:
    """Balls that clear the net and land in their box: samples at 125 Hz, and (8, n) start and landing."""
    flights, points, dt = [], [], 1.0 / 250.0
    while len(flights) < count:
        x = rng.uniform(d.position_min, d.position_max)
        v = rng.uniform(d.velocity_min, d.velocity_max)
        start, flight, step, clear = np.concatenate([x, v]), [], 0, True
        while x[2] > c.BALL_RADIUS and x[1] > -c.TABLE_LENGTH / 2 and step < 500:
            if step % 2 == 0:
                flight.append((step * dt, x))
            a = np.array([0.0, 0.0, -9.81]) - DRAG * np.linalg.norm(v) * v
            before, x, v = x[1], x + dt * v + 0.5 * dt * dt * a, v + dt * a
            clear &= not (before > 0.0 >= x[1] and x[2] < c.NET_HEIGHT + c.BALL_RADIUS)
            step += 1
        low, high = d.landing_min, d.landing_max
        if clear and len(flight) > 8 and low[0] <= x[0] <= high[0] and low[1] <= x[1] <= high[1] and x[1] < 0:
            flights.append(flight)
            points.append(np.concatenate([start, x[:2]]))
    return flights, np.array(points).T
