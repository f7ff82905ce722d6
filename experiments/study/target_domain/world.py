"""Interface of the loop to a reality, and the virtual one that implements it."""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from ballmodel.io.atomic_files import replacing
from ballmodel.trajectory import Dataset
from experiments.config import build
from experiments.config.study import Study
from experiments.runs import checkpoint, load_policy, run_dir
from experiments.runs.load_policy import TrainedPolicy
from experiments.runs.run_dir import CONFIG, Run
from experiments.study.analysis import delays
from experiments.study.target_domain import hit_log, joint_log
from experiments.study.target_domain.finetuning import VirtualReality
from experiments.study.target_domain.hit_log import HitLog
from mjx_tt.diagnosis.joint import JointRecord
from mjx_tt.sim import model as models
from mjx_tt.sim.model import SimModel

STROKES = 512  # from which the spin of a player's strokes is known
STUDY = 6  # purpose of a key, beside those of experiments.config.build


class World(Protocol):
    """A seed's reality for the loop. ``name`` is that of the step, from which all chance follows."""

    def first_balls(self, player: str, name: str) -> Dataset:
        """The player's balls across the table, without a robot."""

    def fine_tune(self, player: str, source: Path, real_updates: int, folder: Path, name: str) -> tuple[Dataset, str]:
        """Fine-tunes the policy of the run ``source`` into the run ``folder``; the player's hits and a sentence."""

    def hits(self, player: str, source: Path, folder: Path, name: str) -> HitLog:
        """Balls of rallies with the run ``source`` or, where it was just fine-tuned, ``folder``: ball and joints by one
        clock."""

    def score(self, player: str, name: str) -> Callable[[TrainedPolicy], float] | None:
        """Function that scores a policy with the player; None where scores are not needed."""


def with_spin(reality: VirtualReality, player: str, key: PRNGKeyArray) -> SimModel:
    """The reality's model with mean and spread of the spin of a player's strokes."""
    state = reality.simulator.start(reality.player(player), reality.known, key, STROKES)
    spin = np.asarray(state.ball.spin)
    mean, std = (
        {f"ball_spin.{kind}_{axis}": float(x) for axis, x in zip("xyz", values, strict=True)}
        for kind, values in (("mean", spin.mean(axis=1)), ("std", spin.std(axis=1)))
    )
    return models.with_values(reality.model, mean | std)


class VirtualWorld:
    """The virtual reality of a seed."""

    def __init__(self, study: Study, seed: int, reality: VirtualReality) -> None:
        self._study, self._seed, self.reality = study, seed, reality.at(seed)

    def _key(self, name: str) -> PRNGKeyArray:
        return jax.random.fold_in(build.key(self._seed, STUDY), zlib.crc32(name.encode()) >> 1)

    def first_balls(self, player: str, name: str) -> Dataset:
        return self.reality.first_balls(
            self.reality.player(player), self._study.first_balls, self._key(name), Path(name).name
        )

    def with_spin(self, player: str, name: str) -> SimModel:
        """The reality as a training could have it at best: with mean and spread of the spin of the player's strokes."""
        return with_spin(self.reality, player, self._key(name))

    def joint_log(self, seconds: float, name: str) -> tuple[JointRecord, ...]:
        """Commands and measured positions of all joints in so many seconds of motion without a ball."""
        return joint_log.record(self.reality.simulator.task, self.reality.known, self._key(name), seconds)

    def hits(self, player: str, source: Path, folder: Path, name: str) -> HitLog:
        """Balls of rallies with the policy of the run ``source``."""
        reality, policy = self.reality, load_policy.load(source).policy
        person, noise = reality.player(player), self._study.reality.camera_noise
        late = models.paths(build.believed(self._study.simulation.model).model)[delays.BALL]
        return hit_log.record(reality.simulator, reality.known, person, policy, self._key(name), name, noise, late)

    def fine_tune(self, player: str, source: Path, real_updates: int, folder: Path, name: str) -> tuple[Dataset, str]:
        theta, statistics = load_policy.load_statistics(source)
        person = self.reality.player(player)
        cycle = self.reality.fine_tune(person, theta, statistics, real_updates, self._key(name), folder.name)
        run = Run(folder)
        folder.mkdir(parents=True, exist_ok=True)
        config = Run(source).config().model_copy(update={"name": folder.name, "initial_policy": str(source.resolve())})
        run_dir.write_yaml(folder / CONFIG, config.to_dict())
        _write_lines(run.metrics, cycle.rows)
        checkpoint.save(run.checkpoints, real_updates, cycle.state, {"seconds": 0.0})
        tenth = max(1, real_updates // 10)
        first, last = (
            sum(r["return_rate"] for r in part) / tenth for part in (cycle.rows[:tenth], cycle.rows[-tenth:])
        )
        text = f"{real_updates} updates, {len(cycle.balls):,} balls, returned {first:.0%} at first, {last:.0%} at last"
        return Dataset(cycle.balls, name), text

    def score(self, player: str, name: str) -> Callable[[TrainedPolicy], float] | None:
        if self._study.simulation.seeds == 1:
            return None
        person, balls, key = self.reality.player(player), self._study.simulation.selection_episodes, self._key(name)
        return lambda p: self.reality.score(person, p.policy, balls, key)


def _write_lines(path: Path, rows: list[dict[str, float]]) -> None:
    with replacing(path) as temporary:
        temporary.write_text("".join(f"{json.dumps(row)}\n" for row in rows), encoding="utf-8")
