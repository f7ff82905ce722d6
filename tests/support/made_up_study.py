"""A study's folder with made-up numbers that are known exactly, for tests of the report and for looking at it.

Rally lengths are geometric: the means of ``MEANS`` for player 3, times ``SKILL`` for the others; with another player
they are ``KEPT`` times as long. Human models are the paper's.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from ballmodel import registry
from ballmodel.distribution import save_distribution
from experiments.study.analysis import scoring
from experiments.study.analysis.paper import ABLATION, BY_SKILL, CROSS, FINAL, FRESH, IDENTIFIED, METHODS, TEN
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
}
SKILL = {"player3": 1.0, "player5": 1.4, "player4": 2.0, "player2": 2.4, "player1": 2.8}
KEPT = {"is2r-ft100": 0.7, "s2r-ft100": 0.35, "oracle-ft": 0.65}
RALLIES = 80
REALITY = {"ball.table.friction": 0.2, "ball.paddle.restitution": 0.97}
ROBOT_SHARE = 0.85  # of the counted rallies
FILTERED_SHARE = 0.08
ABLATION_PLAYER = "player4"


def mean_length(player: str, model: str, own: bool = True) -> float:
    """The known mean of a policy's rallies; the advanced player's S2R+FT is better than its i-S2R, as in the paper."""
    mean = MEANS[model] * SKILL[player] * (1.0 if own else KEPT[model])
    return 1.0 + (mean - 1.0) * (3.5 if player == "player1" and model.startswith("s2r") and own else 1.0)


def make(folder: Path, seeds=(0,), names=BY_SKILL, rallies: int = RALLIES, cross: bool = True) -> Path:
    """Writes a study's folder."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "study.yaml").write_text(f"name: made-up\nseeds: {list(seeds)}\nplayers: {list(names)}\n")
    parts = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        for player in names:
            models = folder / f"seed{seed}" / player / "balls"
            models.mkdir(parents=True)
            for name in ("M0", "M1", "M2"):
                save_distribution(models / f"human_{name}.yaml", registry.load(f"{player}/{name}"))
            wanted = [(player, key) for key in (*TEN, *METHODS[FRESH], *METHODS[IDENTIFIED])]
            wanted += [(other, key) for other in CROSS[player] for key in FINAL] if cross else []
            wanted += [(player, key) for key in METHODS[ABLATION]] if player == ABLATION_PLAYER else []
            _world(folder / f"seed{seed}" / player / "identified" / "world0.yaml")
            for evaluator, model in wanted:
                parts.append(_play(seed, player, evaluator, model, rallies, rng))
        (folder / f"seed{seed}" / "reality.yaml").write_text(json.dumps({"seed": seed, "reality": REALITY}))
    scoring.write(folder / "evaluations.csv", scoring.join(parts))
    return folder


def _play(seed, trainer, evaluator, model, rallies, rng) -> scoring.Rallies:
    mean = mean_length(trainer, model, trainer == evaluator) * np.exp(rng.normal(0.0, 0.05))
    length = 1 + rng.geometric(1.0 / max(mean - 1.0, 1.01), rallies)
    human = rng.choice([End.HUMAN_OVER_TABLE, End.ROBOT_CORNER, End.HUMAN_BOUNCES], rallies)
    robot = rng.choice([End.ROBOT_MISSED, End.ROBOT_OUT, End.OUT_OF_DISTRIBUTION], rallies, p=[0.4, 0.4, 0.2])
    end = np.where(rng.random(rallies) < ROBOT_SHARE, robot, human)
    dropped = rng.random(rallies) < FILTERED_SHARE
    end = np.where(dropped, rng.choice([End.FIRST_NET, End.SERVICE, End.DUMMY_BY_HAND], rallies), end)
    return scoring.score_rallies(seed, trainer, evaluator, model, "", np.where(dropped, 1, length), end)


def _world(path: Path) -> None:
    """An identified world that holds the table's friction, and not the paddle's restitution."""
    path.parent.mkdir(parents=True)
    drawn = (Range("ball.table.friction", 0.19, 0.21), Range("ball.paddle.restitution", 0.8, 0.95))
    ModelFile(SimModel(), drawn).save(path)
