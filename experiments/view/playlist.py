"""Order of what is shown: balls of a distribution, one ball again and again, balls that are missed, rallies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np

from ballmodel import registry
from ballmodel.sampling import sample_pool
from experiments.config import build
from experiments.view.recorder import LANES, Recorder
from experiments.view.replay import Replay
from mjx_tt.env.episode import MISSED, RETURNED
from mjx_tt.env.policy import Policy
from mjx_tt.rally import human_player
from mjx_tt.rally.ball_flights import drive_home
from mjx_tt.rally.end_reasons import End
from mjx_tt.rally.simulator import RallySimulator, ShotResult
from mjx_tt.robot import robots
from mjx_tt.robot.robots import Robot
from mjx_tt.sim.model import SimModel

POOL = 512  # balls of a distribution
SEARCHED = 2048  # balls among which those that are missed are looked for
ENOUGH = 12  # of them
UNNAMED = "the experiment's"  # balls without a name


class Playlist(Protocol):
    """Replays by number, one for each table."""

    @property
    def count(self) -> int | None:
        """Number of the entries; None without an end."""
        ...

    @property
    def robot(self) -> Robot: ...

    def replays(self, number: int) -> list[Replay]: ...

    def caption(self, number: int) -> str: ...


@dataclass(frozen=True)
class FixedPlaylist:
    """A finished list; ``robot`` of its replays."""

    entries: Sequence[Sequence[Replay]]
    captions: Sequence[str]
    robot: Robot = field(default_factory=robots.paper)

    @property
    def count(self) -> int | None:
        return len(self.entries)

    def replays(self, number: int) -> list[Replay]:
        return list(self.entries[number])

    def caption(self, number: int) -> str:
        return self.captions[number]


class PolicyPlaylist:
    """Policies on the same simulated balls.

    names, policies  one for each table
    values           of the sliders, in SI units; after a change call ``clear``
    balls            name of the distribution; None: ``ball`` again and again
    ball             (9,) position, velocity, spin of the one ball
    player           of a rally; None: no rally
    """

    count = None

    def __init__(
        self, recorder: Recorder, names: list[str], policies: list[Policy], distribution: registry.Balls, seed: int = 0
    ) -> None:
        self.recorder, self.names, self.policies, self.seed = recorder, names, policies, seed
        self.distribution = distribution
        self.values = recorder.nominal()
        self.balls: str | None = distribution.name or UNNAMED
        self.ball = np.zeros(9)
        self.player: str | None = None
        self.missed: list[int] = []
        self._pools: dict[str, np.ndarray] = {}
        self._blocks: dict[int, list[Replay]] = {}
        self._rally: Rally | None = None

    @property
    def robot(self) -> Robot:
        return self.recorder.simulator.config.robot

    def clear(self) -> None:
        """Forgets replays made with other settings; a rally goes on with the new ones."""
        self._blocks.clear()

    def state(self, number: int) -> np.ndarray:
        """Position, velocity and spin (9,) with which a ball starts."""
        if self.player is not None:
            return self._rallying().starts[number]
        if self.balls is None:
            return self.ball
        pool = self._pool(self.balls)
        return pool[:, self._number(number) % pool.shape[1]]

    def replays(self, number: int) -> list[Replay]:
        if self.player is not None:
            return self._rallying().replays(number)
        width, tables = LANES // len(self.policies), len(self.policies)
        first = 0 if self.balls is None else number - number % width
        if first not in self._blocks:
            self._blocks[first] = self._play(range(first, first + width))
        at = (number - first) % width * tables
        return self._blocks[first][at : at + tables]

    def caption(self, number: int) -> str:
        if self.player is not None:
            return f"Rally with {self.player}, ball {number + 1}"
        if self.balls is None:
            return f"One ball, again and again ({number + 1})"
        if self.missed:
            return f"Missed ball {number % len(self.missed) + 1} of {len(self.missed)} of {self.balls}"
        return f"Ball {number + 1} of {self.balls}"

    def find_missed(self) -> int:
        """Looks for balls that the first policy does not return; plays these from now on. Returns their number."""
        if self.balls is None or self.player is not None:
            return 0
        pool, found = self._pool(self.balls), []
        for first in range(0, SEARCHED, LANES):
            numbers = range(first, first + LANES)
            states = np.stack([pool[:, n % POOL] for n in numbers], axis=1)
            episodes = self.recorder.episodes(self.recorder.draws(states, numbers, self.seed), self.values)
            outcome = self.recorder.record(self.policies[:1] * LANES, episodes)["outcome"]
            found += [n for n, o in zip(numbers, outcome, strict=True) if o != RETURNED]
            if len(found) >= ENOUGH:
                break
        self.missed = found[:ENOUGH]
        self.clear()
        return len(self.missed)

    def _play(self, numbers: Sequence[int]) -> list[Replay]:
        chances = [0 if self.balls is None else self._number(n) for n in numbers]
        states = np.stack([self.state(n) for n in numbers], axis=1)
        lanes = np.repeat(np.arange(len(numbers)), len(self.policies))
        draws = self.recorder.draws(states[:, lanes], [chances[i] for i in lanes], self.seed)
        recorded = self.recorder.record(self.policies * len(numbers), self.recorder.episodes(draws, self.values))
        return self.recorder.replays(recorded, self.names * len(numbers))

    def _number(self, number: int) -> int:
        return self.missed[number % len(self.missed)] if self.missed else number

    def _pool(self, name: str) -> np.ndarray:
        if name not in self._pools:
            key, ball = build.key(self.seed, build.EVALUATION_BALLS), self.recorder.world.model.ball
            distribution = self.distribution if name in (self.distribution.name, UNNAMED) else registry.load(name)
            state = sample_pool(key, distribution, ball, POOL).state
            self._pools[name] = np.concatenate([np.asarray(a) for a in (state.position, state.velocity, state.spin)])
        return self._pools[name]

    def _rallying(self) -> Rally:
        if self._rally is None or self._rally.player != self.player:
            self._rally = Rally(self, self.player or "")
        return self._rally


class Rally:
    """Rallies of a virtual player with every policy, each at its own table."""

    def __init__(self, play: PolicyPlaylist, player: str) -> None:
        self.player, self._play = player, play
        self._simulator = RallySimulator(play.recorder.simulator.config)
        self._person = human_player.load(player)
        self._key = jax.random.key(play.seed)
        self._state = self._simulator.start(self._person, self._model(0), self._key, len(play.policies))
        self._entries: list[list[Replay]] = []
        self.starts: list[np.ndarray] = []
        self.shots: list[ShotResult] = []

    def replays(self, number: int) -> list[Replay]:
        while number >= len(self._entries):
            self._entries.append(self._turn(len(self._entries)))
        return self._entries[number]

    def _model(self, number: int) -> SimModel:
        count = len(self._play.policies)
        draws = self._play.recorder.draws(np.zeros((9, count)), [number] * count, self._play.seed)
        return self._play.recorder.model(draws, self._play.values)

    def _turn(self, number: int) -> list[Replay]:
        recorder, policies = self._play.recorder, self._play.policies
        key, model, ball = jax.random.fold_in(self._key, number), self._model(number), self._state.ball
        self.starts.append(np.concatenate([np.asarray(a)[:, 0] for a in (ball.position, ball.velocity, ball.spin)]))
        episodes = self._simulator.episodes(key, model, self._state)
        replays = recorder.replays(recorder.record(policies, episodes), self._play.names)
        stacked = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(a) for a in x], axis=-1), *policies)
        self._state, shot = self._simulator.shots(stacked, self._person, model, self._state, key)
        self.shots.append(shot)
        return [self._with_player(replay, i, shot) for i, replay in enumerate(replays)]

    def _with_player(self, replay: Replay, i: int, shot: ShotResult) -> Replay:
        """The replay up to the player's contact, the robot on its way home after its own."""
        end, touches = End(int(shot.end[i])), int(shot.touch[i]) + int(shot.outcome[i] != MISSED)
        words = end.name.lower().replace("_", " ")
        text = f"touch {touches}" if end is End.NONE else f"rally of {touches} over: {words}"
        last = replay.frame(float(shot.seconds[i])) if end is End.NONE else len(replay.time) - 1
        qpos, hit = replay.qpos[: last + 1].copy(), replay.frame(replay.decided)
        since = replay.time[hit : last + 1] - replay.decided
        if len(since) and int(shot.outcome[i]) != MISSED:
            at_hit = jnp.repeat(jnp.asarray(qpos[hit], jnp.float32)[:, None], len(replay.time), axis=1)
            seconds = jnp.asarray(np.maximum(replay.time - replay.decided, 0.0), jnp.float32)
            home, limits = self._simulator.task.home, self._simulator.task.contract.limits
            qpos[hit:] = np.asarray(drive_home(home, at_hit, seconds, limits)).T[hit : last + 1]
        time, balls = replay.time[: last + 1], {"ball": replay.balls["ball"][: last + 1]}
        return replace(replay, time=time, qpos=qpos, balls=balls, outcome=f"{replay.outcome}; {text}")
