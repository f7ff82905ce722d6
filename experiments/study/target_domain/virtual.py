"""A virtual reality: fine-tuning, choice among seeds, rallies and logs with a virtual player across the net.

The settings are those of fine-tuning on a robot (``experiments.config.finetuning``): an update's balls are parallel
rallies that go on across updates, as a person keeps playing while the robot tries its perturbations. What comes back is
what a robot and its cameras would tell: rewards, faults, measured balls.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import PRNGKeyArray

from ballmodel.io.atomic_files import replacing
from ballmodel.partial_params import without_nominal
from ballmodel.registry import Balls
from ballmodel.trajectory import Dataset, Trajectory
from bgs import normalizer, strategy
from bgs.normalizer import ObservationStatistics
from bgs.strategy import BGSConfig, BGSInfo, BGSState
from experiments import sparse_reward
from experiments.config import build
from experiments.config.study import Study
from experiments.runs import checkpoint, load_policy, run_dir
from experiments.runs.load_policy import TrainedPolicy
from experiments.runs.run_dir import CONFIG, Run
from experiments.study.analysis import delays, scoring
from experiments.study.target_domain import hidden_effects
from experiments.study.target_domain.lab_logs import HitLog, record_hits, record_joints
from experiments.study.workflow import derive_seed
from experiments.training.update import TrainState
from mjx_tt.diagnosis.joint import JointRecord
from mjx_tt.env.episode import MISSED, RETURNED
from mjx_tt.env.policy import Policy
from mjx_tt.env.task import TaskConfig
from mjx_tt.rally import human_player
from mjx_tt.rally.human_player import Player
from mjx_tt.rally.simulator import Box, RallySimulator, RallyState, ShotResult
from mjx_tt.sim import model as models
from mjx_tt.sim.model import SimModel

SELECTION_SESSIONS = 10  # side by side in which policies are compared
ATTEMPTS = 100  # of a ball, after which a player who brings none onto the robot's half is taken as they are
STUDY, EVALUATION = 6, 7  # purposes of keys, beside those of experiments.config.build
Carry = tuple[BGSState, RallyState, ObservationStatistics]


@dataclass(frozen=True)
class Cycle:
    """Result of a cycle of fine-tuning.

    state  after the last update
    rows   per update: mean return, rates of balls hit and returned and of faults, norms of gradient and step
    balls  the player's hits as the cameras measured them, in the order of play
    """

    state: TrainState
    rows: list[dict[str, float]]
    balls: tuple[Trajectory, ...]


class VirtualReality:
    """One study seed's reality, in which virtual players play with policies. The same key gives the same play.

    model  the reality itself; known: the same without what is nominal. Never for what learns.
    """

    def __init__(self, study: Study, seed: int) -> None:
        self._study, self._settings = study, study.fine_tuning
        self._draw(seed)
        rewards = build.reward_terms(self._settings.rewards)
        self.simulator = RallySimulator(TaskConfig(sim_rate=study.reality.sim_rate, rewards=rewards))
        # Cycles of different lengths share one compiled call of a length that divides all of them.
        self._chunk = math.gcd(*(r.real for r in study.simulation.rounds))
        self._updates = jax.jit(self._updates_of, static_argnames="config")
        self._lobs = jax.jit(human_player.first_ball, static_argnums=3)
        self._compared = jax.jit(self._shots_of, static_argnames="turns")

    def _draw(self, seed: int) -> None:
        self.model = hidden_effects.draw(seed, tuple(self._study.reality.without), tuple(self._study.reality.outside))
        self.known = without_nominal(self.model)

    def at(self, seed: int) -> VirtualReality:
        """The reality of another seed of the same study, with this one's compiled programs."""
        other = copy(self)
        other._draw(seed)
        return other

    def player(self, name: str) -> Player:
        """The virtual person; in a reality without spin their strokes have none."""
        person = human_player.load(name)
        return human_player.without_spin(person) if "spin" in self._study.reality.without else person

    def first_balls(self, player: Player, count: int, key: PRNGKeyArray, session: str) -> Dataset:
        """D0: balls across the table without a robot, as the cameras measured them."""
        ball_key, camera_key = jax.random.split(key)
        balls = self._lobs(player, human_player.fresh((count,)), ball_key, (count,))
        measured = hidden_effects.measure(self.model, balls, self._study.reality.camera_noise, camera_key)
        return Dataset(measured.trajectories(session), session)

    def fine_tune(
        self,
        player: Player,
        theta: ArrayLike,
        statistics: ObservationStatistics,
        updates: int,
        key: PRNGKeyArray,
        session: str,
    ) -> Cycle:
        """``updates`` updates from the parameters theta (976,) on, while the player rallies with the robot."""
        ask_key, rally_key, play_key, camera_key = jax.random.split(key, 4)
        config = build.bgs_config(self._settings.optimiser(), updates)
        sessions = self._settings.episodes_per_update
        rally = self.simulator.start(player, self.known, rally_key, sessions)
        # Strongly typed as what the updates return, so that the first call and the others are one program.
        carry: Carry = jax.tree.map(
            lambda x: jax.lax.convert_element_type(x, x.dtype),
            (strategy.init(jnp.asarray(theta), config), rally, statistics),
        )
        found = []
        for _ in range(updates // self._chunk):
            carry, part = self._updates(carry, player, self.known, ask_key, play_key, config=config)
            found.append(jax.tree.map(np.asarray, part))
        shots, info = jax.tree.map(lambda *x: np.concatenate(x), *found)
        hits = jax.tree.map(lambda x: np.moveaxis(x, 1, 0).reshape(3, -1), shots.ball)  # (updates, 3, L) -> (3, n)
        finite = shots.finite.reshape(-1)
        measured = hidden_effects.measure(
            self.model, jax.tree.map(lambda x: x[:, finite], hits), self._study.reality.camera_noise, camera_key
        )
        rows = [
            {"update": u + 1, **self._row(jax.tree.map(lambda x, u=u: x[u], shots))}
            | {name: float(getattr(info, name)[u]) for name in ("gradient_norm", "update_norm", "elite_std")}
            for u in range(updates)
        ]
        return Cycle(TrainState(carry[0], carry[2], ask_key), rows, measured.trajectories(session))

    def score(self, player: Player, policy: Policy, balls: int, key: PRNGKeyArray) -> float:
        """The paper's sparse reward by which a seed is chosen, over at least ``balls`` balls with the player."""
        turns = -(-balls // SELECTION_SESSIONS)
        outcome, fault, valid = map(np.asarray, self._compared(policy, player, self.known, key, turns=turns))
        return sparse_reward.mean_reward(outcome != MISSED, outcome == RETURNED, fault, valid) or 0.0

    def _updates_of(
        self,
        carry: Carry,
        player: Player,
        model: SimModel,
        key: PRNGKeyArray,
        play_key: PRNGKeyArray,
        config: BGSConfig,
    ) -> tuple[Carry, tuple[ShotResult, BGSInfo]]:
        """``_chunk`` updates: state, rally and statistics after them, and what each one brought."""
        settings, sessions = self._settings, self._settings.episodes_per_update

        def update(carry: Carry, _: None) -> tuple[Carry, tuple[ShotResult, BGSInfo]]:
            state, rally, statistics = carry
            mean, inv_std = normalizer.normaliser(statistics)
            frozen = [_repeat_per_session(x, sessions) for x in (mean, inv_std)]
            population = strategy.ask(jax.random.fold_in(key, state.updates), state, config)
            theta = jnp.repeat(population.members, settings.repeats, axis=1)  # the sessions of a member side by side
            shot_key = jax.random.fold_in(play_key, state.updates)
            rally, shots = self._valid_shots(Policy(theta, *frozen), player, model, rally, shot_key)
            returns = self._returns(shots).reshape(2 * settings.num_directions, settings.repeats).mean(axis=1)
            state, info = strategy.tell(state, population, returns, config)
            if settings.observation_statistics == "merged":
                seen = jnp.where(shots.finite, shots.observed, 0.0).sum(axis=-1)
                steps = jnp.where(shots.finite, shots.steps, 0).sum()
                statistics = normalizer.merge(statistics, normalizer.from_sums(steps, mean, *seen))
            return (state, rally, statistics), (shots, info)

        return jax.lax.scan(update, carry, None, length=self._chunk)

    def _valid_shots(
        self, policy: Policy, player: Player, model: SimModel, rally: RallyState, key: PRNGKeyArray
    ) -> tuple[RallyState, ShotResult]:
        """A ball of every session; one that the player does not bring onto the robot's half is played again."""

        def again(carry: tuple[Array, RallyState, ShotResult]) -> tuple[Array, RallyState, ShotResult]:
            attempt, rally, shots = carry
            played = self.simulator.shots(policy, player, model, rally, jax.random.fold_in(key, attempt))
            replayed = jax.tree.map(partial(jnp.where, shots.valid | shots.fault), (rally, shots), played)
            return attempt + 1, *replayed

        first = self.simulator.shots(policy, player, model, rally, key)
        _, rally, shots = jax.lax.while_loop(
            lambda c: (c[0] < ATTEMPTS) & ~jnp.all(c[2].valid | c[2].fault), again, (jnp.int32(1), *first)
        )
        return rally, shots

    def _returns(self, shots: ShotResult) -> Array:
        """Weighted returns (L,) of what a robot measures; an episode that is not finite has none."""
        weighted = [w * shots.terms[i] for i, w in enumerate(self.simulator.config.reward_weights) if w]
        return jnp.where(shots.finite, sum(weighted), jnp.nan)

    def _shots_of(
        self, policy: Policy, player: Player, model: SimModel, key: PRNGKeyArray, turns: int
    ) -> tuple[Array, Array, Array]:
        """Outcomes, faults and valid balls (turns, SELECTION_SESSIONS) of one policy."""
        policy = jax.tree.map(lambda x: _repeat_per_session(x, SELECTION_SESSIONS), policy)
        start_key, play_key = jax.random.split(key)

        def shoot(rally: RallyState, turn: Array) -> tuple[RallyState, tuple[Array, Array, Array]]:
            rally, shots = self.simulator.shots(policy, player, model, rally, jax.random.fold_in(play_key, turn))
            return rally, (shots.outcome, shots.fault | ~shots.finite, shots.valid)

        rally = self.simulator.start(player, model, start_key, SELECTION_SESSIONS)
        return jax.lax.scan(shoot, rally, jnp.arange(turns))[1]

    def _row(self, shots: ShotResult) -> dict[str, float]:
        """Means over one update's balls."""
        returns, finite = np.asarray(self._returns(jax.tree.map(jnp.asarray, shots))), shots.finite
        return {
            "mean_return": float(returns[finite].mean()) if finite.any() else -math.inf,
            "return_rate": float((shots.outcome == RETURNED).mean()),
            "hit_rate": float((shots.outcome != MISSED).mean()),
            "fault_rate": float(shots.fault.mean()),
        }


def play_rallies(
    study: Study,
    reality: VirtualReality,
    seed: int,
    pairings: Sequence[tuple[str, str, str]],
    policies: Sequence[Policy],
    balls: Sequence[Balls],
) -> scoring.Rallies:
    """Rallies of each pairing (trainer, evaluator, model) in ``evaluation.lanes`` parallel sessions, in turn.

    balls: what each policy was trained for
    """
    settings, sessions = study.evaluation, study.evaluation.lanes

    def stack(*arrays: ArrayLike) -> Array:
        """(..., n * sessions), the sessions of one side by side."""
        return jnp.repeat(jnp.stack([jnp.asarray(a) for a in arrays], axis=-1), sessions, axis=-1)

    people = human_player.stack([reality.player(evaluator) for _, evaluator, _ in pairings])
    boxes = [Box.of(one) for one in balls]
    result = reality.simulator.play(
        jax.tree.map(stack, *policies),
        jax.tree.map(lambda leaf: jnp.repeat(leaf, sessions), people),
        reality.known,
        build.key(seed, EVALUATION),
        settings.rallies // sessions,
        Box(stack(*(b.low for b in boxes)), stack(*(b.high for b in boxes))),
        settings.max_touches,
    )
    # (rallies of a session, sessions of all pairings): those of a pairing count as one session.
    each = zip(*(np.split(np.asarray(x), len(pairings), axis=1) for x in (result.length, result.end)), strict=True)
    return scoring.join(
        scoring.score_rallies(seed, *pairing, "", length.ravel(), end.ravel())
        for pairing, (length, end) in zip(pairings, each, strict=True)
    )


class VirtualWorld:
    """A seed's reality for the loop, as ``RobotWorld``; all chance follows from ``name``, that of a step."""

    def __init__(self, study: Study, seed: int, reality: VirtualReality) -> None:
        self._study, self._seed, self.reality = study, seed, reality.at(seed)

    def _key(self, name: str) -> PRNGKeyArray:
        return jax.random.fold_in(build.key(self._seed, STUDY), derive_seed(name))

    def first_balls(self, player: str, name: str) -> Dataset:
        """The player's balls across the table, without a robot."""
        return self.reality.first_balls(
            self.reality.player(player), self._study.first_balls, self._key(name), Path(name).name
        )

    def joint_log(self, seconds: float, name: str) -> tuple[JointRecord, ...]:
        """Commands and measured positions of all joints in so many seconds of motion without a ball."""
        return record_joints(self.reality.simulator.task, self.reality.known, self._key(name), seconds)

    def hits(self, player: str, source: Path, folder: Path, name: str) -> HitLog:
        """Balls of rallies with the policy of the run ``source``."""
        reality, policy = self.reality, load_policy.load(source).policy
        person, noise = reality.player(player), self._study.reality.camera_noise
        late = models.paths(build.believed(self._study.simulation.model).model)[delays.BALL]
        return record_hits(reality.simulator, reality.known, person, policy, self._key(name), name, noise, late)

    def fine_tune(self, player: str, source: Path, real_updates: int, folder: Path, name: str) -> tuple[Dataset, str]:
        """Fine-tunes the policy of the run ``source`` into the run ``folder``; the player's hits and a sentence."""
        theta, statistics = load_policy.load_statistics(source)
        person = self.reality.player(player)
        cycle = self.reality.fine_tune(person, theta, statistics, real_updates, self._key(name), folder.name)
        run = Run(folder)
        folder.mkdir(parents=True, exist_ok=True)
        config = Run(source).config().model_copy(update={"name": folder.name, "initial_policy": str(source.resolve())})
        run_dir.write_yaml(folder / CONFIG, config.to_dict())
        with replacing(run.metrics) as temporary:
            temporary.write_text("".join(f"{json.dumps(row)}\n" for row in cycle.rows), encoding="utf-8")
        checkpoint.save(run.checkpoints, real_updates, cycle.state, {"seconds": 0.0})
        rates = [row["return_rate"] for row in cycle.rows]
        text = f"{real_updates} updates, {len(cycle.balls):,} balls, returned {np.mean(rates):.0%}"
        return Dataset(cycle.balls, name), text

    def score(self, player: str, name: str) -> Callable[[TrainedPolicy], float]:
        """Function that scores a policy with the player."""
        person, balls, key = self.reality.player(player), self._study.simulation.selection_episodes, self._key(name)
        return lambda p: self.reality.score(person, p.policy, balls, key)


def _repeat_per_session(x: Array, sessions: int) -> Array:
    """One column for each of the sessions: (n,) -> (n, L)."""
    return jnp.broadcast_to(x[:, None], (x.shape[0], sessions))
